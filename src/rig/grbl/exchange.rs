//! Questions and answers: one line in flight, its `ok` told apart from whatever else arrives, noise passed over a bounded
//! number of times.

use super::fault::Fault;
use super::link::Link;
use super::replies::Reply;
use super::route::Route;
use super::status::Status;

/// Seconds between two status requests while waiting for motion.
const POLL: f64 = 0.1;
/// Seconds without any status report, while asking for it, after which a controller counts as silent.
const POLL_SILENCE: f64 = 4.0;
/// Seconds a single look at a move waits for its report.
const GLANCE: f64 = 0.05;
/// Seconds of idleness after which the `ok` of the barrier counts as lost.
const LOST_OK: f64 = 2.0;
/// Characters a line may have.
const MAX_LINE: usize = 79;
/// Lines of one listing.
const MAX_LISTING: usize = 4096;
/// The barrier: acknowledged when the motion before it has ended.
const BARRIER: &str = "G4P0.01";
/// grblHAL's request for a report with all its fields.
const FULL_REPORT: &[u8] = b"\x87";

impl Link<'_> {
    /// What has arrived unasked; anything but reports, messages and a little noise is a fault.
    fn drain(&mut self, during: &str) -> Result<(), Fault> {
        let now = self.clock.now();
        while let Some(reply) = self.next_reply(now)? {
            if !(self.halted && reply == Reply::Ok) {
                self.unsolicited(reply, during)?;
            }
        }
        Ok(())
    }

    /// What a line means that is no answer.
    fn unsolicited(&mut self, reply: Reply, during: &str) -> Result<(), Fault> {
        let during = during.to_owned();
        match reply {
            Reply::Alarm(number) => Err(Fault::Alarm { number, during }),
            Reply::Banner(_) => Err(Fault::Restarted { during }),
            Reply::Garbled(bytes) => {
                let fault = Fault::Garbled { bytes, during };
                match fault.noise() {
                    Some(reason) if self.pass_over(&reason) => Ok(()),
                    _ => Err(fault),
                }
            }
            Reply::Ok if self.pass_over(&format!("an 'ok' too many before {during}")) => Ok(()),
            Reply::Ok | Reply::Error(_) => Err(Fault::unexpected(
                format!("a reply nobody waited for before {during}"),
                "is another program writing to this port?",
            )),
            _ => Ok(()),
        }
    }

    /// Asks for the state.
    pub(super) fn status(&mut self) -> Result<Status, Fault> {
        self.status_by(b"?")?.ok_or_else(|| Fault::Silent {
            during: "'?'".to_owned(),
            seconds: 3.0,
        })
    }

    /// Asks for the state with all its fields, where the firmware has a request for that.
    pub(super) fn full_status(&mut self) -> Result<Status, Fault> {
        if self.gives_full_reports {
            if let Some(status) = self.status_by(FULL_REPORT)? {
                return Ok(status);
            }
            self.gives_full_reports = false;
        }
        self.status()
    }

    fn status_by(&mut self, request: &[u8]) -> Result<Option<Status>, Fault> {
        let during = "'?'";
        self.drain(during)?;
        for _ in 0..3 {
            self.send(request)?;
            let deadline = self.clock.now() + 1.0;
            while let Some(reply) = self.next_reply(deadline)? {
                let damaged = matches!(reply, Reply::Garbled(_));
                match reply {
                    Reply::Status(status) => {
                        self.heard_well();
                        return Ok(Some(status));
                    }
                    other => self.unsolicited(other, during)?,
                }
                if damaged {
                    break;
                }
            }
        }
        Ok(None)
    }

    fn send_line(&mut self, line: &str) -> Result<String, Fault> {
        let during = format!("'{line}'");
        let plain = line.bytes().all(|b| b.is_ascii_graphic() || b == b' ');
        if line.len() > MAX_LINE || !plain || line.contains(['?', '!', '~']) {
            return Err(Fault::unexpected(
                format!("{during} is not a line that can be sent"),
                "lines are plain ASCII of at most 79 characters without ? ! ~",
            ));
        }
        self.drain(&during)?;
        self.send(format!("{line}\n").as_bytes())?;
        Ok(during)
    }

    /// Sends a line and waits for its `ok`; returns the listing that came before it.
    pub(super) fn exchange(&mut self, line: &str, timeout: f64) -> Result<Vec<String>, Fault> {
        let during = self.send_line(line)?;
        let deadline = self.clock.now() + timeout;
        let mut listing = Vec::new();
        while let Some(reply) = self.next_reply(deadline)? {
            match reply {
                // Whether it was the `ok` nobody can tell.
                Reply::Garbled(bytes) => return Err(Fault::Garbled { bytes, during }),
                Reply::Listing(_) if listing.len() >= MAX_LISTING => {
                    return Err(Fault::unexpected(
                        format!("endless listing after {during}"),
                        "is this a Grbl controller?",
                    ));
                }
                Reply::Listing(text) => listing.push(text),
                other => {
                    if self.is_acknowledged(other, &during)? {
                        return Ok(listing);
                    }
                }
            }
        }
        Err(Fault::Silent {
            during,
            seconds: timeout,
        })
    }

    /// True for the `ok` of the line in flight; its error, an alarm and a banner are faults.
    fn is_acknowledged(&mut self, reply: Reply, during: &str) -> Result<bool, Fault> {
        match reply {
            Reply::Ok => {
                self.halted = false;
                self.heard_well();
                Ok(true)
            }
            Reply::Error(number) => {
                self.clear_error()?;
                Err(Fault::Refused {
                    number,
                    line: during.to_owned(),
                })
            }
            other => self.unsolicited(other, during).map(|()| false),
        }
    }

    /// Waits for the end of a motion with a barrier line, and asks for the state all the while: a state in which the
    /// motion will not end by itself is a fault, and so is a position off the way.
    pub(super) fn barrier(&mut self, timeout: f64, route: &mut Route) -> Result<(), Fault> {
        let during = self.send_line(BARRIER)?;
        let start = self.clock.now();
        let deadline = start + timeout;
        let mut last_report = start;
        let mut next_poll = start + POLL;
        let mut idle_since: Option<f64> = None;
        loop {
            let now = self.clock.now();
            if now >= deadline {
                return Err(Fault::unexpected(
                    format!("a move has not ended after {timeout:.0} s"),
                    "compare the board's speeds and accelerations ($110.. and $120..) with the rig file",
                ));
            }
            let heard = idle_since.map_or(last_report + POLL_SILENCE, |t| t + LOST_OK);
            if now > heard.min(last_report + POLL_SILENCE) {
                return Err(Fault::Silent {
                    during,
                    seconds: now - idle_since.unwrap_or(last_report),
                });
            }
            if now >= next_poll {
                self.send(b"?")?;
                next_poll = self.clock.now() + POLL;
            }
            let acknowledged = match self.next_reply(deadline.min(next_poll))? {
                None => false,
                Some(Reply::Status(status)) => {
                    self.heard_well();
                    last_report = self.clock.now();
                    self.on_way(&status, route, &during)?;
                    idle_since = status.is("Idle").then(|| idle_since.unwrap_or(last_report));
                    false
                }
                Some(other) => self.is_acknowledged(other, &during)?,
            };
            if acknowledged {
                return Ok(());
            }
        }
    }

    /// One look at a move: asks for the state and waits for it a moment; a report that comes later is seen by the next
    /// look. True when the board is idle.
    pub(super) fn glance(&mut self, route: &mut Route) -> Result<bool, Fault> {
        let during = "a move";
        self.send(b"?")?;
        let deadline = self.clock.now() + GLANCE;
        while let Some(reply) = self.next_reply(deadline)? {
            let Reply::Status(status) = reply else {
                self.unsolicited(reply, during)?;
                continue;
            };
            self.heard_well();
            self.on_way(&status, route, during)?;
            route.heard(self.clock.now());
            return Ok(status.is("Idle"));
        }
        let seconds = self.clock.now() - route.last_heard();
        if seconds > POLL_SILENCE {
            let during = during.to_owned();
            return Err(Fault::Silent { during, seconds });
        }
        Ok(false)
    }

    /// Checks a report that came while a move ran.
    pub(super) fn on_way(
        &self,
        status: &Status,
        route: &mut Route,
        during: &str,
    ) -> Result<(), Fault> {
        if !matches!(status.state.as_str(), "Run" | "Idle" | "Jog") {
            return Err(Fault::unexpected(
                format!("state {} during {during}", status.state_text()),
                "somebody pressed hold or reset, or a door is open; clear it and start again",
            ));
        }
        match self.machine_position(status) {
            Some(position) if status.is("Idle") => route.check(&position),
            Some(position) => route.check_running(&position, self.clock.now()),
            None => Ok(()),
        }
    }

    /// Ends whatever half line the controller holds, and reads until it is quiet; true when an empty line was
    /// acknowledged. An alarm or a banner meanwhile is a fault.
    pub(super) fn resync(&mut self) -> Result<bool, Fault> {
        let during = "finding the thread again";
        let limit = self.clock.now() + 10.0;
        // The first may end half a line, whose refusal sticks to grblHAL until the second.
        for _ in 0..2 {
            self.send(b"\n")?;
            let (mut acknowledged, mut refused) = (false, false);
            while let Some(reply) = self.next_reply(self.clock.now() + 0.3)? {
                match reply {
                    Reply::Ok => acknowledged = true,
                    Reply::Error(_) => refused = true,
                    Reply::Garbled(bytes) => {
                        let during = during.to_owned();
                        let fault = Fault::Garbled { bytes, during };
                        if fault.noise().is_none() {
                            return Err(fault);
                        }
                    }
                    other => self.unsolicited(other, during)?,
                }
                if self.clock.now() > limit {
                    return Err(Fault::unexpected(
                        "the device talks without end",
                        "is this the right port and baud rate?",
                    ));
                }
            }
            self.forget_half_line();
            if acknowledged && !refused {
                self.heard_well();
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// grblHAL repeats an error for every later line until it gets an empty one; Grbl does not mind.
    fn clear_error(&mut self) -> Result<(), Fault> {
        self.send(b"\n")?;
        let deadline = self.clock.now() + 1.0;
        while let Some(reply) = self.next_reply(deadline)? {
            match reply {
                Reply::Ok => break,
                Reply::Error(_) => {}
                other => self.unsolicited(other, "clearing an error")?,
            }
        }
        Ok(())
    }
}
