//! The controller as the rig sees it: [`Motion`] and [`Light`] over the dialogue.

use super::motion::LETTERS;
use super::{Grbl, Obey};
use crate::base::{Error, Result};
use crate::rig::description::Homing;
use crate::rig::devices::{AxisLimits, Light, Motion, Target, Travel};

impl Grbl<'_> {
    pub(super) fn axis_number(&self, letter: char) -> Result<usize> {
        LETTERS
            .iter()
            .position(|l| *l == letter)
            .filter(|i| self.settings.contains_key(&(110 + *i as u16)))
            .ok_or_else(|| {
                Error::new(format!("board '{}' has no axis {letter}", self.name))
                    .with_hint("correct the axis letters in the rig file")
            })
    }

    fn setting(&self, number: u16) -> Result<f64> {
        self.settings.get(&number).copied().ok_or_else(|| {
            Error::new(format!("board '{}' does not report ${number}", self.name))
                .with_hint("the firmware must be Grbl 1.1 or grblHAL, and the cable free of noise")
        })
    }

    /// Feed along the path, units per minute, at which no axis exceeds its speed.
    fn feed(&self, from: &[f64], targets: &[Target]) -> Result<f64> {
        let (mut squared, mut seconds) = (0.0, 0.0_f64);
        let mut fastest = 0.0_f64;
        for target in targets {
            let way = (target.units - from[self.axis_number(target.letter)?]).abs();
            squared += way * way;
            seconds = seconds.max(way / target.speed);
            fastest = fastest.max(60.0 * target.speed);
        }
        Ok(if seconds > 0.0 {
            (60.0 * f64::sqrt(squared) / seconds).max(1.0)
        } else {
            fastest
        })
    }
}

impl Motion for Grbl<'_> {
    fn name(&self) -> &str {
        &self.name
    }

    fn firmware(&self) -> String {
        self.firmware.clone()
    }

    fn dump(&self) -> Vec<String> {
        let settings = self.settings.iter().map(|(n, v)| format!("${n}={v}"));
        std::iter::once(self.firmware.clone())
            .chain(settings)
            .collect()
    }

    fn check(&self, homing: Homing) -> Result<()> {
        let name = &self.name;
        let inches = self.setting(13)?;
        if inches != 0.0 {
            return Err(
                Error::new(format!("board '{name}' reports inches ($13={inches})"))
                    .with_hint("send $13=0"),
            );
        }
        if homing == Homing::Cycle && self.setting(22)? <= 0.0 {
            return Err(Error::new(format!(
                "board '{name}' shall be homed with $H but has homing switched off ($22=0)"
            ))
            .with_hint("send $22=1, or set homing = \"by_hand\" in the rig file"));
        }
        Ok(())
    }

    fn axis_limits(&self, letter: char) -> Result<AxisLimits> {
        let axis = self.axis_number(letter)? as u16;
        // Stock Grbl (no Z among its build options) has its machine space below zero; grblHAL may put it elsewhere.
        let stock = !self.firmware.contains("HAL")
            && !self.options.split(',').next().unwrap_or("").contains('Z');
        let travel = if self.setting(20)? > 0.0 {
            let length = self.setting(130 + axis)?;
            Some(if stock {
                Travel::Between([-length, 0.0])
            } else {
                Travel::Length(length)
            })
        } else {
            None
        };
        Ok(AxisLimits {
            travel,
            max_speed: self.setting(110 + axis)? / 60.0,
            acceleration: self.setting(120 + axis)?,
        })
    }

    fn moves_in_line(&self) -> bool {
        true
    }

    fn is_homed(&self) -> bool {
        self.homed
    }

    fn home(&mut self) -> Result<()> {
        Grbl::home(self)
    }

    fn trust_position(&mut self) -> Result<()> {
        Grbl::trust_position(self)
    }

    fn state(&mut self) -> Result<String> {
        Ok(self.status()?.state_text())
    }

    fn positions(&mut self, letters: &[char]) -> Result<Vec<f64>> {
        let all = self.position()?;
        letters
            .iter()
            .map(|l| {
                let axis = self.axis_number(*l)?;
                all.get(axis).copied().ok_or_else(|| {
                    Error::new(format!("board '{}' reports no axis {l}", self.name))
                        .with_hint("correct the axis letters in the rig file")
                })
            })
            .collect()
    }

    fn start_move(&mut self, targets: &[Target]) -> Result<()> {
        let from = self.position()?;
        let feed = self.feed(&from, targets)?;
        Grbl::start_move(self, targets, feed)
    }

    fn finish_move(&mut self, targets: &[Target], timeout: f64) -> Result<Vec<f64>> {
        Grbl::finish_move(self, targets, timeout)
    }

    fn verify_at(&mut self, targets: &[Target]) -> Result<Vec<f64>> {
        Grbl::verify_at(self, targets)
    }

    fn may_be_moving(&self) -> bool {
        Grbl::may_be_moving(self)
    }

    fn may_be_homing(&self) -> bool {
        Grbl::may_be_homing(self)
    }

    fn brake(&mut self) {
        self.hold();
    }

    fn make_safe(&mut self, _at_once: bool) -> Result<String> {
        Grbl::make_safe(self)
    }

    fn says_homed(&mut self) -> Result<bool> {
        self.reported_homed()
    }

    fn nudge(&mut self, letter: char, units: f64, speed: f64) -> Result<f64> {
        self.jog_unhomed(letter, units, speed)
    }

    fn lamp(&mut self) -> Option<&mut dyn Light> {
        Some(self)
    }
}

impl Light for Grbl<'_> {
    fn check(&mut self, power: f64) -> Result<()> {
        self.check_lamp_settings(power)
    }

    fn switch_on(&mut self, power: f64) -> Result<()> {
        self.lamp_on(power)
    }

    fn switch_off(&mut self) -> Result<()> {
        // What the operator asked for must not keep the lamp on.
        let obey = std::mem::replace(&mut self.link.obey, Obey::Nothing);
        let off = self.lamp_off();
        self.link.obey = obey;
        off
    }

    fn is_on(&mut self) -> Result<Option<bool>> {
        self.lamp_state()
    }

    fn identity(&self) -> String {
        format!("spindle output of board '{}'", self.name)
    }
}
