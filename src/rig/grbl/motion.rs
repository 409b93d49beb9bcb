//! Homing, moving with the position verified, and stopping without losing steps.

use super::fault::Fault;
use super::link::Obey;
use super::{Grbl, REPLY_TIMEOUT, Status};
use crate::base::Result;
use crate::rig::devices::Target;
use std::fmt;

/// How a controlled stop ended.
#[derive(Debug, Clone, PartialEq)]
pub struct StopReport {
    /// The controller stands still with its position known.
    pub position_kept: bool,
    /// Its state afterwards, or none when it did not say.
    pub state: Option<String>,
}

impl fmt::Display for StopReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let position = if self.position_kept {
            "position kept"
        } else {
            "position unknown, home before moving"
        };
        write!(f, "stopped, lamp off, {position}")
    }
}

/// Letters in the order of a status report's coordinates.
pub(super) const LETTERS: [char; 8] = ['X', 'Y', 'Z', 'A', 'B', 'C', 'U', 'V'];

impl Grbl<'_> {
    /// Homes with `$H` and takes the position as known.
    ///
    /// # Errors
    /// Homing is off, fails, or takes more than 3 minutes.
    pub fn home(&mut self) -> Result<()> {
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
        Ok(())
    }

    fn home_and_prepare(&mut self) -> Result<(), Fault> {
        self.link.exchange("$H", 180.0)?;
        // What the lock said before homing no longer counts.
        self.link.take_position_lost();
        self.prepare()
    }

    /// Takes the position as known on the operator's word (boards without limit switches), unlocking if need be.
    ///
    /// # Errors
    /// The board is neither idle nor merely locked.
    pub fn trust_position(&mut self) -> Result<()> {
        let result = (|| {
            if self.link.status()?.is("Alarm") {
                self.link.exchange("$X", REPLY_TIMEOUT)?;
                self.link.take_position_lost();
            }
            self.prepare()
        })();
        self.checked(result)?;
        self.homed = true;
        Ok(())
    }

    /// Lamp off; the controller must be idle.
    fn prepare(&mut self) -> Result<(), Fault> {
        let status = self.link.status()?;
        if !status.is("Idle") {
            return Err(Fault::unexpected(
                format!("state {} where Idle was expected", status.state_text()),
                "clear the cause at the board and start again",
            ));
        }
        self.link.exchange("M5", REPLY_TIMEOUT)?;
        Ok(())
    }

    /// Sends a straight move in machine space at `feed` units per minute; returns when it is queued.
    ///
    /// # Errors
    /// The position is not known, or as [`Grbl::command`].
    pub fn start_move(&mut self, targets: &[Target], feed: f64) -> Result<()> {
        let line = self.move_line(targets, feed);
        let line = self.checked(line)?;
        self.moving = true;
        let result = self.link.exchange(&line, REPLY_TIMEOUT);
        self.checked(result)?;
        Ok(())
    }

    fn move_line(&self, targets: &[Target], feed: f64) -> Result<String, Fault> {
        if !self.homed {
            return Err(Fault::unexpected(
                "its position is not known",
                "home the rig before moving it",
            ));
        }
        let numbers = targets.iter().map(|t| t.units).chain([feed]);
        if !numbers.clone().all(f64::is_finite) || !(1.0..1e6).contains(&feed) {
            return Err(Fault::unexpected(
                format!("a move to {targets:?} at feed {feed} makes no sense"),
                "feed rates must lie in 1 to 1000000 units per minute",
            ));
        }
        let axes: String = targets
            .iter()
            .map(|t| format!("{}{:.4}", t.letter, t.units + 0.0))
            .collect();
        // Modes are in the line itself: a reset may have changed them.
        Ok(format!("G21G90G94G53G1{axes}F{feed:.1}"))
    }

    /// Waits until the move has ended and verifies it: the barrier's `ok`, then twice Idle at the target. Returns the
    /// positions read back, in the order of `targets`.
    ///
    /// # Errors
    /// It takes longer than `timeout` seconds, ends elsewhere, or as [`Grbl::command`].
    pub fn finish_move(&mut self, targets: &[Target], timeout: f64) -> Result<Vec<f64>> {
        let result = (|| {
            self.link.exchange_watching("G4P0.01", timeout, true)?;
            let deadline = self.link.clock.now() + 2.0;
            let mut idle_reports = 0;
            loop {
                let status = self.link.status()?;
                idle_reports = if status.is("Idle") {
                    idle_reports + 1
                } else {
                    0
                };
                if idle_reports >= 2 {
                    return self.verified(&status, targets);
                }
                if self.link.clock.now() > deadline {
                    return Err(Fault::unexpected(
                        format!("state {} after the end of a move", status.state_text()),
                        "is another program moving the board?",
                    ));
                }
                self.link.clock.sleep(0.02);
            }
        })();
        let positions = self.checked(result)?;
        self.moving = false;
        Ok(positions)
    }

    /// Checks that the board stands idle at `targets` with no override active; returns the positions read back.
    ///
    /// # Errors
    /// It does not, or as [`Grbl::status`].
    pub fn verify_at(&mut self, targets: &[Target]) -> Result<Vec<f64>> {
        let result = self
            .link
            .status()
            .and_then(|status| self.verified(&status, targets));
        self.checked(result)
    }

    fn verified(&self, status: &Status, targets: &[Target]) -> Result<Vec<f64>, Fault> {
        if !status.is("Idle") {
            return Err(Fault::unexpected(
                format!("state {} where Idle was expected", status.state_text()),
                "clear the cause at the board and start again",
            ));
        }
        if let Some(percent) = self.link.overrides()
            && percent.iter().any(|p| (p - 100.0).abs() > 0.5)
        {
            return Err(Fault::unexpected(
                format!("overrides are {percent:?} percent, expected 100"),
                "noise on the cable or a pendant changed them; reset the board",
            ));
        }
        let position = self.link.machine_position(status).ok_or_else(|| {
            Fault::unexpected(
                "it does not report its position",
                "set $10=1 so that the status has MPos",
            )
        })?;
        targets
            .iter()
            .map(|t| {
                let index = LETTERS.iter().position(|l| *l == t.letter);
                let found = index.and_then(|i| position.get(i)).copied().ok_or_else(|| {
                    Fault::unexpected(
                        format!("it has no axis {}", t.letter),
                        "correct the axis letters in the rig file",
                    )
                })?;
                if (found - t.units).abs() <= t.tolerance {
                    return Ok(found);
                }
                Err(Fault::unexpected(
                    format!(
                        "axis {} stands at {found:.4}, expected {:.4} within {:.4}",
                        t.letter, t.units, t.tolerance
                    ),
                    "the move was not executed as sent; check for noise on the cable, then home again",
                ))
            })
            .collect()
    }

    /// The machine position now, controller units by axis.
    ///
    /// # Errors
    /// It does not report one, or as [`Grbl::status`].
    pub fn position(&mut self) -> Result<Vec<f64>> {
        let result = self.link.status().and_then(|status| {
            self.link.machine_position(&status).ok_or_else(|| {
                Fault::unexpected(
                    "it does not report its position",
                    "set $10=1 so that the status has MPos",
                )
            })
        });
        self.checked(result)
    }

    /// Sends the feed hold of a stop and does not wait; [`Grbl::controlled_stop`] must follow. With several boards all of
    /// them begin to brake before the first is waited for.
    pub fn hold(&mut self) {
        if !self.lost && !self.held {
            // Only a reset clears the hold. A board that cannot be reached tells it in the stop that follows.
            self.faulted = true;
            self.held = self.send_hold().is_ok();
        }
    }

    /// True while axes may be moving, as far as is known here.
    pub fn may_be_moving(&self) -> bool {
        self.moving
    }

    /// True while a homing cycle may be running: a hold does not stop it.
    pub fn may_be_homing(&self) -> bool {
        self.homing
    }

    fn send_hold(&mut self) -> Result<(), Fault> {
        if self.link.halted && !self.homing {
            return Ok(());
        }
        self.link.send(b"!")
    }

    /// Feed hold, standstill, then reset: stops without losing steps where that is possible. Switches the lamp off. A
    /// homing cycle, which obeys no hold, is reset at once.
    ///
    /// # Errors
    /// When the board is gone or does not even answer a reset.
    pub fn controlled_stop(&mut self) -> Result<StopReport> {
        let trusted = self.homed;
        let result = self.stop_in_order();
        // The banner of the reset was expected; what counts is in the report.
        self.link.take_position_lost();
        let report = self.checked(result)?;
        self.homed = trusted && report.position_kept;
        self.moving = false;
        self.homing = false;
        self.lamp_on = false;
        self.faulted = false;
        Ok(report)
    }

    pub(super) fn stop_in_order(&mut self) -> Result<StopReport, Fault> {
        let obey = std::mem::replace(&mut self.link.obey, Obey::Nothing);
        let report = self.brake_and_reset();
        self.link.obey = obey;
        report
    }

    fn brake_and_reset(&mut self) -> Result<StopReport, Fault> {
        if !std::mem::take(&mut self.held) {
            self.send_hold()?;
        }
        let deadline = self.link.clock.now() + 15.0;
        let mut before = None;
        while !self.homing && self.link.clock.now() < deadline {
            match self.link.status_tolerant(1.0, 2)? {
                // Silent: a critical alarm. Only the reset helps.
                None => break,
                Some(status) if status.is_standstill() => {
                    before = self.link.machine_position(&status);
                    break;
                }
                Some(status) if status.is("Alarm") || status.is("Home") => break,
                Some(_) => self.link.clock.sleep(0.1),
            }
        }
        let lost_earlier = self.link.take_position_lost();
        let alarm = self.link.reset()?;
        let status = self.link.status_tolerant(1.0, 2)?;
        let after = status.as_ref().and_then(|s| self.link.machine_position(s));
        let idle = status.as_ref().is_some_and(|s| s.is("Idle"));
        Ok(StopReport {
            position_kept: idle && !alarm && !lost_earlier && before.is_some() && before == after,
            state: status.map(|s| s.state_text()),
        })
    }
}
