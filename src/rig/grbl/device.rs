//! The controller as the rig sees it: [`Motion`] over the dialogue.

use super::Grbl;
use super::fault::Fault;
use super::motion::LETTERS;
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

    /// Homing makes where it ends 0 (`Z` among the build options of Grbl).
    pub(super) fn homes_to_zero(&self) -> bool {
        self.options.split(',').next().unwrap_or("").contains('Z')
    }

    pub(super) fn setting(&self, number: u16) -> Result<f64> {
        self.settings.get(&number).copied().ok_or_else(|| {
            Error::new(format!("board '{}' does not report ${number}", self.name))
                .with_hint("the firmware must be Grbl 1.1 or grblHAL, and the cable free of noise")
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
        self.said.clone()
    }

    fn take_notes(&mut self) -> Vec<String> {
        let notes = self.link.take_notes();
        let name = &self.name;
        notes
            .into_iter()
            .map(|n| format!("board '{name}': {n}"))
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
        // A number on Grbl, bit flags on grblHAL: bit 0 enables homing.
        let flags = self.setting(22)?;
        if homing == Homing::Cycle && (flags as u32) & 1 == 0 {
            return Err(Error::new(format!(
                "board '{name}' shall be homed with $H but has homing switched off ($22={flags})"
            ))
            .with_hint("send $22=1 (an odd number on grblHAL), or set homing = \"by_hand\" in the rig file"));
        }
        Ok(())
    }

    fn axis_limits(&self, letter: char) -> Result<AxisLimits> {
        let axis = self.axis_number(letter)? as u16;
        // Stock Grbl (no Z among its build options) has its machine space below zero; grblHAL may put it elsewhere.
        let stock = !self.is_grblhal() && !self.homes_to_zero();
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
        self.homed = false;
        self.moving = true;
        self.homing = true;
        let result = self.home_and_prepare();
        // After an alarm or a restart the cycle is over; after anything else it may still run.
        self.homing = !matches!(
            result,
            Ok(()) | Err(Fault::Alarm { .. } | Fault::Restarted { .. } | Fault::Refused { .. })
        );
        self.checked(result)?;
        self.moving = false;
        self.homed = true;
        self.homed_by_switches = true;
        Ok(())
    }

    fn trust_position(&mut self) -> Result<()> {
        let result = self.unlock_and_prepare();
        self.checked(result)?;
        self.homed = true;
        self.homed_by_switches = false;
        Ok(())
    }

    fn state(&mut self) -> Result<String> {
        Ok(self.status()?.state_text())
    }

    fn positions(&mut self, letters: &[char]) -> Result<Vec<f64>> {
        let result = self.link.status().and_then(|s| self.position_of(&s));
        let all = self.checked(result)?;
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
        let result = self.begin_move(targets);
        self.checked(result)
    }

    fn finish_move(&mut self, targets: &[Target], timeout: f64) -> Result<Vec<f64>> {
        let result = self.end_move(targets, timeout);
        let positions = self.checked(result)?;
        self.moving = false;
        Ok(positions)
    }

    fn look_on_the_way(&mut self) -> Result<bool> {
        let result = self.glance();
        self.checked(result)
    }

    fn verify_at(&mut self, targets: &[Target]) -> Result<Vec<f64>> {
        let result = self
            .link
            .full_status()
            .and_then(|status| self.verified(&status, targets));
        self.checked(result)
    }

    fn may_be_moving(&self) -> bool {
        self.moving
    }

    fn may_be_homing(&self) -> bool {
        self.homing
    }

    fn brake(&mut self) {
        self.hold();
    }

    fn make_safe(&mut self, at_once: bool) -> Result<String> {
        self.stop(at_once)
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
