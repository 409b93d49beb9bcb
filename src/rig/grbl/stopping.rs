//! Stopping: without losing steps where that is possible, or at once.

use super::Grbl;
use super::fault::Fault;
use crate::base::{Error, Result};
use crate::rig::obey::Obey;
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

impl Grbl<'_> {
    /// Sends the feed hold of a stop and does not wait; with several boards all of them begin to brake before the first
    /// is waited for.
    pub(super) fn hold(&mut self) {
        if !self.lost && !self.held {
            // Only a reset clears the hold. A board that cannot be reached tells it in the stop that follows.
            self.faulted = true;
            self.held = self.send_hold().is_ok();
        }
    }

    fn send_hold(&mut self) -> Result<(), Fault> {
        if self.link.halted && !self.homing {
            return Ok(());
        }
        self.link.send(b"!")
    }

    /// Stops what moves and switches the lamp off, whatever happened before; says what was done.
    pub(super) fn stop(&mut self, at_once: bool) -> Result<String> {
        if self.lost {
            return Err(Error::new(format!("board '{}' is disconnected", self.name))
                .with_hint("check by eye that its lamp is off and nothing moves"));
        }
        if at_once && (self.moving || self.faulted || self.lamp_on) {
            return self.reset_at_once();
        }
        if self.lamp_on && !(self.moving || self.faulted) && self.lamp_off_regardless().is_ok() {
            return Ok(format!("board '{}': lamp off", self.name));
        }
        if self.moving || self.faulted || self.lamp_on {
            let report = self.controlled_stop()?;
            return Ok(format!("board '{}': {report}", self.name));
        }
        Ok(format!("board '{}': at rest, lamp off", self.name))
    }

    /// 0x18 without a hold before it: the fastest end of motion, and of the knowledge where the axes are.
    fn reset_at_once(&mut self) -> Result<String> {
        self.homed = false;
        self.rest = None;
        let obey = std::mem::replace(&mut self.link.obey, Obey::Nothing);
        let result = self.link.reset();
        self.link.obey = obey;
        self.checked(result)?;
        self.nothing_pending();
        Ok(format!(
            "board '{}': reset at once, lamp off, position unknown, home before moving",
            self.name
        ))
    }

    /// After a reset.
    fn nothing_pending(&mut self) {
        self.moving = false;
        self.homing = false;
        self.held = false;
        self.lamp_on = false;
        self.faulted = false;
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
        let (report, place) = self.checked(result)?;
        self.homed = trusted && report.position_kept;
        self.rest = place.filter(|_| self.homed);
        self.nothing_pending();
        Ok(report)
    }

    /// The stop, and where the axes stand after it.
    pub(super) fn stop_in_order(&mut self) -> Result<(StopReport, Option<Vec<f64>>), Fault> {
        let obey = std::mem::replace(&mut self.link.obey, Obey::Nothing);
        let report = self.brake_and_reset();
        self.link.obey = obey;
        report
    }

    fn brake_and_reset(&mut self) -> Result<(StopReport, Option<Vec<f64>>), Fault> {
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
                Some(status) => {
                    // The hold was lost on its way, or comes to the board after the question.
                    if status.is("Run") || status.is("Jog") {
                        self.link.send(b"!")?;
                    }
                    self.link.clock.sleep(0.1);
                }
            }
        }
        let lost_earlier = self.link.take_position_lost();
        let alarm = self.link.reset()?;
        let status = self.link.status_tolerant(1.0, 2)?;
        let after = status.as_ref().and_then(|s| self.link.machine_position(s));
        let idle = status.as_ref().is_some_and(|s| s.is("Idle"));
        let report = StopReport {
            position_kept: idle && !alarm && !lost_earlier && before.is_some() && before == after,
            state: status.map(|s| s.state_text()),
        };
        Ok((report, after))
    }
}
