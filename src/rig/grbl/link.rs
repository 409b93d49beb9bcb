//! Lines over a byte transport: one in flight, unsolicited lines sorted out, every wait bounded and interruptible.

use super::fault::Fault;
use super::replies::Reply;
use super::status::Status;
use crate::base::Watch;
use crate::rig::transport::{Clock, Transport};
use std::io;
use std::sync::Arc;

/// Seconds between two status requests while waiting for motion.
const POLL: f64 = 0.25;
/// Seconds without any status report, while asking for it, after which a controller counts as silent.
const POLL_SILENCE: f64 = 4.0;
/// Characters a line may have.
const MAX_LINE: usize = 79;
/// Seconds after which a wait looks at its [`Watch`] again.
const LOOK: f64 = 0.05;
/// Lines in a row that are still handed out after their deadline; a buffer holds fewer.
const LATE_LINES: u32 = 512;
/// Reads in a row after the deadline that may bring bytes and no line end.
const LATE_READS: u32 = 100;

/// Which requests of the operator end a wait.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Obey {
    /// To end early or at once: nothing has moved yet.
    Any,
    /// Only to stop at once.
    Urgent,
    /// None: a stop is under way.
    Nothing,
}

pub(super) struct Link<'a> {
    transport: Box<dyn Transport>,
    pub(super) clock: Arc<dyn Clock>,
    watch: &'a dyn Watch,
    pub(super) obey: Obey,
    input: Vec<u8>,
    /// An alarm or a banner was seen since the last look.
    position_lost: bool,
    /// An alarm or a banner came and no line was acknowledged since: nothing moves, outstanding `ok`s are void.
    pub(super) halted: bool,
    /// The last work offset reported, for controllers that report work positions.
    work_offset: Option<Vec<f64>>,
    /// The last overrides reported since the last start, percent: most reports leave them out.
    overrides: Option<[f64; 3]>,
    /// Lines handed out in a row after their deadline.
    late_lines: u32,
}

impl<'a> Link<'a> {
    pub(super) fn new(
        transport: Box<dyn Transport>,
        clock: Arc<dyn Clock>,
        watch: &'a dyn Watch,
    ) -> Self {
        Self {
            transport,
            clock,
            watch,
            obey: Obey::Any,
            input: Vec::new(),
            position_lost: false,
            halted: false,
            work_offset: None,
            overrides: None,
            late_lines: 0,
        }
    }

    /// Fails when the operator asked for what this wait obeys.
    fn interrupted(&self) -> Result<(), Fault> {
        let asked = match self.obey {
            Obey::Any => self.watch.cancelled() || self.watch.urgent(),
            Obey::Urgent => self.watch.urgent(),
            Obey::Nothing => false,
        };
        if asked { Err(Fault::Stopped) } else { Ok(()) }
    }

    /// The last overrides reported since the last start.
    pub(super) fn overrides(&self) -> Option<[f64; 3]> {
        self.overrides
    }

    /// True once after an alarm or a banner.
    pub(super) fn take_position_lost(&mut self) -> bool {
        std::mem::take(&mut self.position_lost)
    }

    pub(super) fn send(&mut self, bytes: &[u8]) -> Result<(), Fault> {
        self.transport.write(bytes).map_err(Fault::Disconnected)
    }

    /// The next line, classified; none when `deadline` passes first. Lines that had arrived by then are handed out after
    /// it, but not without end.
    pub(super) fn next_reply(&mut self, deadline: f64) -> Result<Option<Reply>, Fault> {
        let mut late_reads = 0;
        loop {
            self.interrupted()?;
            let late = self.clock.now() > deadline;
            if !late {
                self.late_lines = 0;
            } else if self.late_lines >= LATE_LINES {
                self.late_lines = 0;
                return Ok(None);
            }
            if let Some(end) = self.input.iter().position(|b| *b == b'\n') {
                let mut line: Vec<u8> = self.input.drain(..=end).collect();
                while matches!(line.last(), Some(b'\n' | b'\r')) {
                    line.pop();
                }
                self.late_lines += u32::from(late);
                return Ok(Some(self.noted(Reply::of(&line))));
            }
            late_reads += u32::from(late);
            if self.input.len() > 4096 || (late_reads > LATE_READS && !self.input.is_empty()) {
                self.late_lines = LATE_LINES;
                let mut bytes = std::mem::take(&mut self.input);
                bytes.truncate(64);
                return Ok(Some(Reply::Garbled(bytes)));
            }
            let wait = (deadline - self.clock.now()).clamp(0.0, LOOK);
            let mut buffer = [0; 512];
            match self.transport.read(&mut buffer, wait) {
                Ok(0) => return Err(Fault::Disconnected(io::ErrorKind::BrokenPipe.into())),
                Ok(n) => self.input.extend_from_slice(&buffer[..n]),
                Err(e) if e.kind() == io::ErrorKind::TimedOut => {
                    if self.clock.now() >= deadline {
                        return Ok(None);
                    }
                }
                Err(e) => return Err(Fault::Disconnected(e)),
            }
        }
    }

    fn noted(&mut self, reply: Reply) -> Reply {
        match &reply {
            Reply::Alarm(_) | Reply::Banner(_) => {
                self.position_lost = true;
                self.halted = true;
                self.overrides = None;
            }
            Reply::Status(s) => {
                self.overrides = s.overrides.or(self.overrides);
                self.position_lost |= s.is("Alarm");
                if let Some(offset) = &s.work_offset {
                    self.work_offset = Some(offset.clone());
                }
            }
            _ => {}
        }
        reply
    }

    /// Machine position of a report, from the work position when the controller reports that.
    pub(super) fn machine_position(&self, status: &Status) -> Option<Vec<f64>> {
        if status.machine_position.is_some() {
            return status.machine_position.clone();
        }
        let (work, offset) = (status.work_position.as_ref()?, self.work_offset.as_ref()?);
        (work.len() == offset.len()).then(|| work.iter().zip(offset).map(|(a, b)| a + b).collect())
    }

    /// Reads and drops everything until nothing comes for `quiet` seconds (at most 20 s).
    pub(super) fn read_until_quiet(&mut self, quiet: f64) -> Result<(), Fault> {
        let limit = self.clock.now() + 20.0;
        while self.clock.now() < limit {
            if self.next_reply(self.clock.now() + quiet)?.is_none() {
                // Half a line of start-up noise is no reply either.
                self.input.clear();
                return Ok(());
            }
        }
        Err(Fault::unexpected(
            "the device talks without end",
            "is this the right port and baud rate?",
        ))
    }

    /// Sends an empty line; true when it is acknowledged. Start-up text is not a reply, and a banner voids the `ok`.
    pub(super) fn probe(&mut self, timeout: f64) -> Result<bool, Fault> {
        self.send(b"\n")?;
        let deadline = self.clock.now() + timeout;
        while let Some(reply) = self.next_reply(deadline)? {
            match reply {
                Reply::Ok => {
                    self.halted = false;
                    return Ok(true);
                }
                Reply::Banner(_) => {
                    self.read_until_quiet(0.3)?;
                    return Ok(false);
                }
                _ => {}
            }
        }
        Ok(false)
    }

    /// Asks for the state, leaving aside whatever else arrives; none when nothing answers `attempts` times.
    pub(super) fn status_tolerant(
        &mut self,
        timeout: f64,
        attempts: u32,
    ) -> Result<Option<Status>, Fault> {
        for _ in 0..attempts {
            let now = self.clock.now();
            while self.next_reply(now)?.is_some() {}
            self.send(b"?")?;
            let deadline = self.clock.now() + timeout;
            while let Some(reply) = self.next_reply(deadline)? {
                match reply {
                    Reply::Status(status) => return Ok(Some(status)),
                    Reply::Banner(_) => {
                        self.read_until_quiet(0.3)?;
                        break;
                    }
                    _ => {}
                }
            }
        }
        Ok(None)
    }

    /// What has arrived unasked; anything but reports and messages is a fault.
    fn drain(&mut self, during: &str) -> Result<(), Fault> {
        let now = self.clock.now();
        while let Some(reply) = self.next_reply(now)? {
            if !(self.halted && reply == Reply::Ok) {
                Self::unsolicited(reply, during)?;
            }
        }
        Ok(())
    }

    /// What a line means that is no answer.
    fn unsolicited(reply: Reply, during: &str) -> Result<(), Fault> {
        let during = during.to_owned();
        match reply {
            Reply::Alarm(number) => Err(Fault::Alarm { number, during }),
            Reply::Banner(_) => Err(Fault::Restarted { during }),
            Reply::Garbled(bytes) => Err(Fault::Garbled { bytes, during }),
            Reply::Ok | Reply::Error(_) => Err(Fault::unexpected(
                format!("a reply nobody waited for before {during}"),
                "is another program writing to this port?",
            )),
            _ => Ok(()),
        }
    }

    /// Asks for the state.
    pub(super) fn status(&mut self) -> Result<Status, Fault> {
        let during = "'?'";
        self.drain(during)?;
        for _ in 0..2 {
            self.send(b"?")?;
            let deadline = self.clock.now() + 1.0;
            while let Some(reply) = self.next_reply(deadline)? {
                match reply {
                    Reply::Status(status) => return Ok(status),
                    other => Self::unsolicited(other, during)?,
                }
            }
        }
        Err(Fault::Silent {
            during: during.to_owned(),
            seconds: 2.0,
        })
    }

    /// Sends a line and waits for its `ok`; returns the listing that came before it.
    pub(super) fn exchange(&mut self, line: &str, timeout: f64) -> Result<Vec<Reply>, Fault> {
        self.exchange_watching(line, timeout, false)
    }

    /// As [`Link::exchange`]; with `watch` the state is asked for all the while, and a state in which the motion will not
    /// end by itself is a fault.
    pub(super) fn exchange_watching(
        &mut self,
        line: &str,
        timeout: f64,
        watch: bool,
    ) -> Result<Vec<Reply>, Fault> {
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
        let start = self.clock.now();
        let deadline = start + timeout;
        let mut last_report = start;
        let mut next_poll = if watch { start + POLL } else { f64::INFINITY };
        let mut listing = Vec::new();
        loop {
            let now = self.clock.now();
            if now >= deadline || (watch && now - last_report > POLL_SILENCE) {
                let seconds = if watch { now - last_report } else { timeout };
                return Err(Fault::Silent { during, seconds });
            }
            if now >= next_poll {
                self.send(b"?")?;
                next_poll = now + POLL;
            }
            match self.next_reply(deadline.min(next_poll))? {
                None => {}
                Some(Reply::Ok) => {
                    self.halted = false;
                    return Ok(listing);
                }
                Some(Reply::Error(number)) => {
                    self.clear_error()?;
                    return Err(Fault::Refused {
                        number,
                        line: during,
                    });
                }
                Some(Reply::Status(status)) => {
                    last_report = self.clock.now();
                    if watch && !matches!(status.state.as_str(), "Run" | "Idle" | "Jog") {
                        return Err(Fault::unexpected(
                            format!("state {} during {during}", status.state_text()),
                            "somebody pressed hold or reset, or a door is open; clear it and start again",
                        ));
                    }
                }
                Some(Reply::Message(_) | Reply::Setting(..)) if listing.len() > 4096 => {
                    return Err(Fault::unexpected(
                        format!("endless listing after {during}"),
                        "is this a Grbl controller?",
                    ));
                }
                Some(reply @ (Reply::Message(_) | Reply::Setting(..))) => listing.push(reply),
                Some(other) => Self::unsolicited(other, &during)?,
            }
        }
    }

    /// grblHAL repeats an error for every later line until it gets an empty one; Grbl does not mind.
    fn clear_error(&mut self) -> Result<(), Fault> {
        self.send(b"\n")?;
        let deadline = self.clock.now() + 1.0;
        while let Some(reply) = self.next_reply(deadline)? {
            match reply {
                Reply::Ok => break,
                Reply::Error(_) => {}
                other => Self::unsolicited(other, "clearing an error")?,
            }
        }
        Ok(())
    }

    /// 0x18, then waits for the banner; `ok`s and the rest that come before it belong to aborted lines. True when the
    /// controller reported an alarm.
    pub(super) fn reset(&mut self) -> Result<bool, Fault> {
        self.send(b"\x18")?;
        let deadline = self.clock.now() + 4.0;
        let mut alarm = false;
        while let Some(reply) = self.next_reply(deadline)? {
            match reply {
                Reply::Alarm(_) => alarm = true,
                Reply::Banner(_) => {
                    let quiet = self.clock.now() + 0.2;
                    while let Some(reply) = self.next_reply(quiet)? {
                        alarm |= matches!(reply, Reply::Alarm(_));
                    }
                    return Ok(alarm);
                }
                _ => {}
            }
        }
        Err(Fault::Silent {
            during: "a reset".to_owned(),
            seconds: 4.0,
        })
    }

    /// The last bytes to a controller that is let go: stop if it moves, lamp off. Errors have nobody to go to.
    pub(super) fn last_words(&mut self, moving: bool, homing: bool) {
        if moving {
            let _ = self.transport.write(b"!");
            // A hold does not stop homing, and then there is no position to keep.
            self.clock.sleep(if homing { 0.0 } else { 1.0 });
            let _ = self.transport.write(b"\x18");
        } else {
            let _ = self.transport.write(b"M5\n");
        }
    }
}
