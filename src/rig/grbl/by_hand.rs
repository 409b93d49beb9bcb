//! What a person at the rig asks of one board: does it think it is homed, is its lamp on, and a small motion before it
//! is homed.

use super::fault::Fault;
use super::motion::LETTERS;
use super::replies::Reply;
use super::{Grbl, REPLY_TIMEOUT};
use crate::base::Result;

/// Asks grblHAL for a status report with every field; other firmware drops the byte.
const FULL_REPORT: &[u8] = b"\x87";
/// Seconds between looks at a jog.
const LOOK: f64 = 0.05;

impl Grbl<'_> {
    /// True when the firmware itself says that it is homed. Only grblHAL does; Grbl 1.1 never says.
    ///
    /// # Errors
    /// It does not answer.
    pub(super) fn reported_homed(&mut self) -> Result<bool> {
        if self.homed {
            return Ok(true);
        }
        if !self.is_grblhal() {
            return Ok(false);
        }
        let result = self.ask_homed();
        self.checked(result)
    }

    fn ask_homed(&mut self) -> Result<bool, Fault> {
        let idle = self.link.status()?.is("Idle");
        self.link.send(FULL_REPORT)?;
        let deadline = self.link.clock.now() + 1.0;
        while let Some(reply) = self.link.next_reply(deadline)? {
            if let Reply::Status(status) = reply
                && let Some(homed) = status.homed
            {
                return Ok(homed && idle && status.is("Idle"));
            }
        }
        Ok(false)
    }

    /// Whether `$G` says that the spindle output is on.
    ///
    /// # Errors
    /// As [`Grbl::command`].
    pub(super) fn lamp_state(&mut self) -> Result<Option<bool>> {
        let replies = self.command("$G")?;
        Ok(Self::says_lit(&replies))
    }

    /// Jogs one axis although the position is not known, unlocking the board if need be; returns by how many units it
    /// moved. A jog out of the board's soft limits is refused without an alarm.
    ///
    /// # Errors
    /// As [`Grbl::command`], or it does not come to rest in time.
    pub(super) fn jog_unhomed(&mut self, letter: char, units: f64, speed: f64) -> Result<f64> {
        let axis = self.axis_number(letter)?;
        let result = self.jog_and_wait(axis, units, 60.0 * speed);
        self.homed = false;
        let moved = self.checked(result)?;
        self.moving = false;
        Ok(moved)
    }

    fn jog_and_wait(&mut self, axis: usize, units: f64, feed: f64) -> Result<f64, Fault> {
        if self.link.status()?.is("Alarm") {
            self.link.exchange("$X", REPLY_TIMEOUT)?;
            self.link.take_position_lost();
        }
        let before = self.at(axis)?.0;
        self.moving = true;
        self.link.halted = false;
        let line = format!("$J=G91G21{}{units:.4}F{feed:.1}", LETTERS[axis]);
        self.link.exchange(&line, REPLY_TIMEOUT)?;
        let deadline = self.link.clock.now() + 60.0 * units.abs() / feed + 5.0;
        let mut at_rest = 0;
        while self.link.clock.now() < deadline {
            let (position, idle) = self.at(axis)?;
            at_rest = if idle { at_rest + 1 } else { 0 };
            if at_rest >= 2 {
                return Ok(position - before);
            }
            self.link.clock.sleep(LOOK);
        }
        Err(Fault::unexpected(
            format!("axis {} does not come to rest after a jog", LETTERS[axis]),
            "look at the axis before doing anything else",
        ))
    }

    /// Where an axis stands, and whether the board is idle; nothing but idle and jogging is expected.
    fn at(&mut self, axis: usize) -> Result<(f64, bool), Fault> {
        let status = self.link.status()?;
        if !status.is("Idle") && !status.is("Jog") {
            return Err(Fault::unexpected(
                format!("state {} during a jog", status.state_text()),
                "clear the cause at the board and start again",
            ));
        }
        let position = self.link.machine_position(&status);
        let position = position.and_then(|p| p.get(axis).copied()).ok_or_else(|| {
            Fault::unexpected(
                "it does not report its position",
                "set $10=1 so that the status has MPos",
            )
        })?;
        Ok((position, status.is("Idle")))
    }
}
