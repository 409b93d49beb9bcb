//! Asking again after noise on the wire, where that can do no harm.
//!
//! Only lines that may be executed twice are sent twice: absolute moves, the lamp's `M3` and `M5`, the barrier, listings,
//! and `$H` once. Between the two: an empty line, silence, and the state and position read back; a board that is neither
//! where it was nor on the way it was sent is a fault. An alarm, a banner and a disconnect are never retried.

use super::fault::Fault;
use super::route::Route;
use super::{Grbl, REPLY_TIMEOUT, Status};

/// How often one line is sent again.
const RETRIES: u32 = 2;
/// Seconds a homing cycle may take.
const HOMING_TIMEOUT: f64 = 180.0;

impl Grbl<'_> {
    /// Sends a line that moves nothing and may be executed twice; returns its listing. `is_whole` says whether that has
    /// all it must have.
    pub(super) fn ask(
        &mut self,
        line: &str,
        is_whole: impl Fn(&[String]) -> bool,
    ) -> Result<Vec<String>, Fault> {
        let mut again = 0;
        loop {
            let listing = self.link.exchange(line, REPLY_TIMEOUT);
            let whole = listing.and_then(|l| {
                if is_whole(&l) {
                    Ok(l)
                } else {
                    Err(Fault::Incomplete {
                        line: line.to_owned(),
                    })
                }
            });
            match whole {
                Err(fault) if fault.noise().is_some() && again < RETRIES => {
                    again += 1;
                    let reason = fault.noise().unwrap_or_default();
                    let status = self.found_again(fault)?;
                    self.still_at_rest(&status)?;
                    self.link.note(format!(
                        "{reason}: state {}, sent again ({again} of {RETRIES})",
                        status.state_text()
                    ));
                }
                other => return other,
            }
        }
    }

    /// Gets the controller to acknowledge and report again after `fault`.
    fn found_again(&mut self, fault: Fault) -> Result<Status, Fault> {
        if !self.link.resync()? {
            return Err(fault);
        }
        self.link.status()
    }

    /// Fails when the board is not where it last stood, or not at rest.
    fn still_at_rest(&mut self, status: &Status) -> Result<(), Fault> {
        let locked = self.rest.is_none() && status.is("Alarm");
        if !(status.is("Idle") || locked) {
            return Err(Fault::unexpected(
                format!("state {} where Idle was expected", status.state_text()),
                "clear the cause at the board and start again",
            ));
        }
        match (&self.rest, self.link.machine_position(status)) {
            (Some(rest), Some(now)) => self.compare_with_rest(rest, &now),
            _ => Ok(()),
        }
    }

    /// Sends the line of a move; when its answer is lost, the position says whether the board took it.
    pub(super) fn send_move(&mut self, line: &str, route: &mut Route) -> Result<(), Fault> {
        let mut again = 0;
        loop {
            let fault = match self.link.exchange(line, REPLY_TIMEOUT) {
                Err(fault) if fault.noise().is_some() && again < RETRIES => fault,
                other => return other.map(|_| ()),
            };
            again += 1;
            let reason = fault.noise().unwrap_or_default();
            let status = self.found_again(fault)?;
            self.link.on_way(&status, route, line)?;
            let place = self.link.machine_position(&status).unwrap_or_default();
            let taken = !status.is("Idle") || route.is_at_end(&place);
            if !taken && !route.is_at_start(&place) {
                return Err(stands_still(&place, &reason));
            }
            let what = if taken {
                "the board has taken the line".to_owned()
            } else {
                format!("sent again ({again} of {RETRIES})")
            };
            self.link
                .note(format!("{reason}: state {}, {what}", status.state_text()));
            if taken {
                return Ok(());
            }
        }
    }

    /// Waits for the end of the motion; a lost answer to the barrier is asked for again once the board is idle.
    pub(super) fn pass_barrier(&mut self, timeout: f64, route: &mut Route) -> Result<(), Fault> {
        let deadline = self.link.clock.now() + timeout;
        let mut again = 0;
        loop {
            let rest = (deadline - self.link.clock.now()).max(1.0);
            let fault = match self.link.barrier(rest, route) {
                Err(fault) if fault.noise().is_some() && again < RETRIES => fault,
                other => return other,
            };
            again += 1;
            let reason = fault.noise().unwrap_or_default();
            let status = self.link.status()?;
            self.link.on_way(&status, route, "the barrier")?;
            if status.is("Idle") {
                let place = self.position_of(&status)?;
                if !route.is_at_end(&place) {
                    return Err(stands_still(&place, &reason));
                }
                if !self.link.resync()? {
                    return Err(fault);
                }
            }
            self.link.note(format!(
                "{reason}: state {}, asked again ({again} of {RETRIES})",
                status.state_text()
            ));
        }
    }

    /// `$H`, and once more when its answer was garbled and the cycle is over: homing again does no harm. Returns the
    /// seconds until its `ok`.
    pub(super) fn run_homing(&mut self) -> Result<f64, Fault> {
        let stops = self.link.stops;
        let fault = match self.send_homing() {
            Err(fault @ Fault::Garbled { .. }) if fault.noise().is_some() => fault,
            other => return other,
        };
        let reason = fault.noise().unwrap_or_default();
        let deadline = self.link.clock.now() + HOMING_TIMEOUT;
        let state = loop {
            // A homing Grbl is silent, a grblHAL says so.
            match self.link.status_tolerant(1.0, 1)? {
                Some(s) if s.is("Idle") || s.is("Alarm") => break s.state_text(),
                Some(s) if !s.is("Home") => {
                    return Err(Fault::unexpected(
                        format!("state {} after {reason}", s.state_text()),
                        "clear the cause at the board and start again",
                    ));
                }
                _ if self.link.clock.now() > deadline => return Err(fault),
                _ => self.link.clock.sleep(0.1),
            }
        };
        if self.link.stops > stops || !self.link.resync()? {
            return Err(fault);
        }
        self.link
            .note(format!("{reason}: state {state}, homed once more (1 of 1)"));
        self.send_homing()
    }

    /// One `$H`. A damaged one may be another command, whose answer says more than a homing cycle does.
    fn send_homing(&mut self) -> Result<f64, Fault> {
        let start = self.link.clock.now();
        let listing = self.link.exchange("$H", HOMING_TIMEOUT)?;
        match listing.iter().find(|l| !self.belongs_to_homing(l)) {
            None => Ok(self.link.clock.now() - start),
            Some(line) => Err(Fault::unexpected(
                format!("it answered '{line}' to '$H', which no homing cycle does"),
                "the command was damaged on its way; check for noise on the cable, then home again",
            )),
        }
    }

    /// Start-up lines run after homing and are echoed; grblHAL also has messages of its plugins.
    fn belongs_to_homing(&self, line: &str) -> bool {
        let message = line.starts_with("[MSG:") && !line.contains("Unlocked");
        line.starts_with('>') || (message && self.is_grblhal())
    }
}

fn stands_still(place: &[f64], reason: &str) -> Fault {
    Fault::unexpected(
        format!("it stands still on its way at {place:?}: {reason}"),
        "check the board's power and for noise on the cable, then home again",
    )
}
