//! The lamp on a board's spindle output.

use super::Grbl;
use super::fault::Fault;
use super::replies::listed;
use crate::base::{Error, Result};
use crate::rig::devices::Light;
use crate::rig::obey::Obey;

impl Grbl<'_> {
    fn switch_lamp(&mut self, line: &str, power: Option<f64>) -> Result<(), Fault> {
        self.ask(line, |_| true)?;
        let listing = self.ask("$G", |l| listed(l, "GC:").is_some())?;
        let words: Vec<&str> = listed(&listing, "GC:")
            .unwrap_or_default()
            .split(' ')
            .collect();
        let speed = words
            .iter()
            .find_map(|w| w.strip_prefix('S')?.parse::<f64>().ok());
        let as_wanted = match power {
            Some(p) => words.contains(&"M3") && speed.is_some_and(|s| (s - p).abs() <= 0.5),
            None => words.contains(&"M5"),
        };
        if as_wanted {
            return Ok(());
        }
        Err(Fault::unexpected(
            format!(
                "the lamp is not in the state set with {line}: '{}'",
                words.join(" ")
            ),
            "is another program or a button changing the board's state?",
        ))
    }

    /// Whether a listing of `$G` says that the lamp is on.
    pub(super) fn says_lit(listing: &[String]) -> Option<bool> {
        let words = listed(listing, "GC:")?;
        Some(words.split(' ').any(|word| matches!(word, "M3" | "M4")))
    }

    /// Switches off a lamp that somebody left on, and verifies it. A locked board refuses the line but not a reset.
    pub(super) fn put_out(&mut self) -> Result<(), Fault> {
        self.lamp_on = true;
        match self.switch_lamp("M5", None) {
            Err(Fault::Refused { .. }) => {
                self.link.reset()?;
                let modes = self.ask("$G", |l| listed(l, "GC:").is_some())?;
                if Self::says_lit(&modes) != Some(false) {
                    return Err(Fault::unexpected(
                        "its lamp stays on after a reset",
                        "cut the lamp's power",
                    ));
                }
            }
            other => other?,
        }
        self.lamp_on = false;
        self.link.note("its lamp was on: switched off".to_owned());
        Ok(())
    }

    /// Switches the lamp off whatever the operator asked for: that must not keep it on.
    pub(super) fn lamp_off_regardless(&mut self) -> Result<()> {
        let obey = std::mem::replace(&mut self.link.obey, Obey::Nothing);
        let result = self.switch_lamp("M5", None);
        self.link.obey = obey;
        self.checked(result)?;
        self.lamp_on = false;
        Ok(())
    }
}

/// Power is the spindle speed `S`.
impl Light for Grbl<'_> {
    /// Laser mode must be off (`$32=0`, else a standing lamp goes dark) and the power inside the spindle's range,
    /// `$31..$30`.
    fn check(&mut self, power: f64) -> Result<()> {
        let laser = self.setting(32)?;
        if laser != 0.0 {
            return Err(Error::new(format!(
                "board '{}' is in laser mode ($32={laser})",
                self.name
            ))
            .with_hint(
                "send $32=0: in laser mode the lamp goes dark whenever the axes stand still",
            ));
        }
        let (low, high) = (self.setting(31)?, self.setting(30)?);
        if !(low..=high).contains(&power) || power <= 0.0 {
            return Err(Error::new(format!(
                "lamp power S{power} is outside the range of board '{}', {low} to {high}",
                self.name
            ))
            .with_hint("change lamp.power_s in the rig file, or $30 and $31 on the board"));
        }
        Ok(())
    }

    fn switch_on(&mut self, power: f64) -> Result<()> {
        self.lamp_on = true;
        let result = self.switch_lamp(&format!("M3S{power}"), Some(power));
        self.checked(result)
    }

    fn switch_off(&mut self) -> Result<()> {
        self.lamp_off_regardless()
    }

    fn is_on(&mut self) -> Result<Option<bool>> {
        self.lamp_state()
    }

    fn identity(&self) -> String {
        format!("spindle output of board '{}'", self.name)
    }
}
