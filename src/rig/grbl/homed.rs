//! Whether `$H` was really a homing cycle: `ok` alone is no proof, because a damaged command may be another one.

use super::fault::Fault;
use super::motion::{LETTERS, ROUNDING, must_be_idle};
use super::{Grbl, Status};

/// No homing cycle is over sooner, seconds: it seeks, waits for the switch to settle, and pulls off.
const SHORTEST_HOMING: f64 = 0.25;

impl Grbl<'_> {
    /// Fails unless the report after `$H` is that of a board that has homed. grblHAL says so itself. Grbl 1.1 must stand
    /// where homing leaves every axis; that proves something only when it stood elsewhere before, otherwise the `ok`
    /// must have taken its time.
    pub(super) fn has_homed(
        &self,
        status: &Status,
        before: Option<&[f64]>,
        seconds: f64,
    ) -> Result<(), Fault> {
        must_be_idle(status)?;
        if self.is_grblhal() {
            return match self.link.homed() {
                Some(true) => Ok(()),
                _ => Err(not_homed("it does not say that it is homed (H:1)")),
            };
        }
        let position = self.position_of(status)?;
        let tested = self.stands_pulled_off(&position)?;
        if (tested && before.is_some_and(|b| b != position)) || seconds >= SHORTEST_HOMING {
            return Ok(());
        }
        Err(not_homed(&format!("an 'ok' came {seconds:.2} s")))
    }

    /// Fails when an axis is not at one of the two places homing leaves it, the pull-off `$27` from either end of its
    /// travel. False when that cannot be tested: the build sets 0 instead (`Z` in its options), or settings are missing.
    fn stands_pulled_off(&self, position: &[f64]) -> Result<bool, Fault> {
        let pull_off = self.settings.get(&27).copied();
        let Some(pull_off) = pull_off.filter(|_| !self.homes_to_zero()) else {
            return Ok(false);
        };
        for (i, p) in position.iter().enumerate() {
            let Some(travel) = self.settings.get(&(130 + i as u16)) else {
                return Ok(false);
            };
            let room = self.step(i) + ROUNDING;
            let near = |place: f64| (p - place).abs() <= room;
            if ![pull_off, -pull_off, pull_off - travel]
                .into_iter()
                .any(near)
            {
                return Err(not_homed(&format!(
                    "axis {} stands at {p:.4}, not {pull_off} ($27) from an end of its travel,",
                    LETTERS.get(i).unwrap_or(&'?')
                )));
            }
        }
        Ok(true)
    }
}

fn not_homed(what: &str) -> Fault {
    Fault::unexpected(
        format!("{what} after '$H': no homing cycle has run"),
        "the command was damaged on its way, or the board homes in a way this program does not know; check for noise on the cable, then home again",
    )
}
