//! Lines over a byte transport: unsolicited lines sorted out, every wait bounded and interruptible.

use super::fault::Fault;
use super::replies::Reply;
use super::status::Status;
use crate::base::Watch;
use crate::rig::obey::Obey;
use crate::rig::transport::{Clock, Transport};
use std::io;
use std::sync::Arc;

/// Seconds after which a wait looks at its [`Watch`] again.
const LOOK: f64 = 0.05;
/// Lines in a row that are still handed out after their deadline; a buffer holds fewer.
const LATE_LINES: u32 = 512;
/// Reads in a row after the deadline that may bring bytes and no line end.
const LATE_READS: u32 = 100;
/// Damaged or surplus lines in a row that are passed over.
const NOISE_LINES: u32 = 2;
/// Notes kept until somebody takes them.
const MAX_NOTES: usize = 1000;

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
    /// The last machine position reported.
    last_position: Option<Vec<f64>>,
    /// The last work offset reported, for controllers that report work positions.
    work_offset: Option<Vec<f64>>,
    /// The last overrides reported since the last start, percent: most reports leave them out.
    overrides: Option<[f64; 3]>,
    /// Alarms and banners so far.
    pub(super) stops: u32,
    /// It knows grblHAL's request for a report with all its fields.
    pub(super) gives_full_reports: bool,
    /// The last word of a grblHAL on whether its axes are homed.
    homed: Option<bool>,
    /// Lines handed out in a row after their deadline.
    late_lines: u32,
    /// Damaged or surplus lines passed over since the last good one.
    noise_lines: u32,
    /// What was not as expected and was dealt with.
    notes: Vec<String>,
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
            last_position: None,
            work_offset: None,
            overrides: None,
            stops: 0,
            gives_full_reports: false,
            homed: None,
            late_lines: 0,
            noise_lines: 0,
            notes: Vec::new(),
        }
    }

    /// Fails when the operator asked for what this wait obeys.
    fn interrupted(&self) -> Result<(), Fault> {
        if self.obey.ends(self.watch) {
            return Err(Fault::Stopped);
        }
        Ok(())
    }

    /// The last overrides reported since the last start.
    pub(super) fn overrides(&self) -> Option<[f64; 3]> {
        self.overrides
    }

    /// The last machine position reported.
    pub(super) fn last_position(&self) -> Option<&[f64]> {
        self.last_position.as_deref()
    }

    /// A homing cycle ended: what was said before it no longer counts.
    pub(super) fn forget_homed(&mut self) {
        self.homed = None;
    }

    /// The last word of a grblHAL on whether its axes are homed, since the last start.
    pub(super) fn homed(&self) -> Option<bool> {
        self.homed
    }

    /// Keeps a line for whoever asks what was not as expected.
    pub(super) fn note(&mut self, line: String) {
        if self.notes.len() < MAX_NOTES {
            self.notes.push(line);
        }
    }

    /// The notes since the last look.
    pub(super) fn take_notes(&mut self) -> Vec<String> {
        std::mem::take(&mut self.notes)
    }

    /// True when a damaged or surplus line may be passed over once more; notes it.
    pub(super) fn pass_over(&mut self, what: &str) -> bool {
        self.noise_lines += 1;
        let may = self.noise_lines <= NOISE_LINES;
        if may {
            self.note(format!(
                "{what}: passed over ({} of {NOISE_LINES} in a row)",
                self.noise_lines
            ));
        }
        may
    }

    /// A line came as it should.
    pub(super) fn heard_well(&mut self) {
        self.noise_lines = 0;
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
                self.stops += 1;
                self.overrides = None;
                self.homed = None;
            }
            Reply::Status(s) => {
                self.overrides = s.overrides.or(self.overrides);
                self.homed = s.homed.or(self.homed);
                self.position_lost |= s.is("Alarm");
                if let Some(offset) = &s.work_offset {
                    self.work_offset = Some(offset.clone());
                }
                self.last_position = self.machine_position(s).or(self.last_position.take());
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
                self.forget_half_line();
                return Ok(());
            }
        }
        Err(Fault::unexpected(
            "the device talks without end",
            "is this the right port and baud rate?",
        ))
    }

    /// Drops the beginning of a line whose end does not come: noise is no reply either.
    pub(super) fn forget_half_line(&mut self) {
        self.input.clear();
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

    /// 0x18, then waits for the banner; `ok`s and the rest that come before it belong to aborted lines. True when the
    /// controller reported an alarm. A lost banner is asked for once more.
    pub(super) fn reset(&mut self) -> Result<bool, Fault> {
        let mut alarm = false;
        for _ in 0..2 {
            self.send(b"\x18")?;
            let deadline = self.clock.now() + 4.0;
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
        }
        Err(Fault::Silent {
            during: "a reset".to_owned(),
            seconds: 8.0,
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
