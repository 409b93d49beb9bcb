//! One command in flight: numbered, summed, and repeated where that can do no harm.

use super::fault::Fault;
use super::flags::{self, Effect};
use super::frame::{self, Message, Reply};
use crate::base::Watch;
use crate::rig::obey::Obey;
use crate::rig::transport::{Clock, Transport};
use crate::rig::wire_log::show_bytes;
use std::io;
use std::sync::Arc;

/// Seconds a reply may take.
const REPLY_TIMEOUT: f64 = 0.5;
/// Seconds after which a wait looks at its [`Watch`] again.
const LOOK: f64 = 0.05;
/// Lines in a row that are still handed out after their deadline.
const LATE_LINES: u32 = 64;
/// Bytes a line may have.
const LONGEST_LINE: usize = 512;
/// Repetitions that are remembered.
const REMEMBERED: usize = 200;

pub(super) struct Link<'a> {
    transport: Box<dyn Transport>,
    pub(super) clock: Arc<dyn Clock>,
    watch: &'a dyn Watch,
    pub(super) obey: Obey,
    /// The device's number in its chain.
    address: u8,
    /// Lines without checksum count: only until checksums are switched on.
    pub(super) plain: bool,
    /// The last message ID.
    id: u8,
    input: Vec<u8>,
    /// Lines handed out in a row after their deadline.
    late_lines: u32,
    /// The flag of an alert that came unasked, with its axis.
    alert: Option<(u8, String)>,
    /// What was sent again, and why.
    pub(super) retries: Vec<String>,
    /// How many of them were told.
    told: usize,
}

impl<'a> Link<'a> {
    /// The retries since the last call.
    pub(super) fn take_notes(&mut self) -> Vec<String> {
        let fresh = self.retries.get(self.told..).unwrap_or_default().to_vec();
        self.told = self.retries.len();
        fresh
    }

    pub(super) fn new(
        transport: Box<dyn Transport>,
        clock: Arc<dyn Clock>,
        watch: &'a dyn Watch,
        address: u8,
    ) -> Self {
        Self {
            transport,
            clock,
            watch,
            obey: Obey::Any,
            address,
            plain: true,
            id: 0,
            input: Vec::new(),
            late_lines: 0,
            alert: None,
            retries: Vec::new(),
            told: 0,
        }
    }

    /// Fails when the operator asked for what this wait obeys.
    fn interrupted(&self) -> Result<(), Fault> {
        if self.obey.ends(self.watch) {
            return Err(Fault::Stopped);
        }
        Ok(())
    }

    /// Lets time pass.
    pub(super) fn pause(&self, seconds: f64) -> Result<(), Fault> {
        let end = self.clock.now() + seconds;
        loop {
            self.interrupted()?;
            let rest = end - self.clock.now();
            if rest <= 0.0 {
                return Ok(());
            }
            self.clock.sleep(rest.min(LOOK));
        }
    }

    /// Sends a command and does not wait; whatever answers it is left aside.
    pub(super) fn send(&mut self, axis: u8, text: &str) -> Result<(), Fault> {
        self.id = (self.id + 1) % 100;
        let bytes = frame::command(self.address, axis, self.id, text);
        self.transport.write(&bytes).map_err(Fault::Disconnected)
    }

    /// Sends a command and waits for its reply, whatever that says. Without an intact reply it is sent again, `tries`
    /// times in all and each time under a new number, so that no late reply to an earlier one is ever taken for it.
    pub(super) fn ask(&mut self, axis: u8, text: &str, tries: u32) -> Result<Reply, Fault> {
        let during = format!("'{text}'");
        let mut reason = String::new();
        for attempt in 1..=tries {
            if attempt > 1 && self.retries.len() < REMEMBERED {
                self.retries.push(format!("{during} sent again: {reason}"));
            }
            self.send(axis, text)?;
            match self.answer(axis)? {
                Ok(reply) => return Ok(reply),
                Err(why) => reason = why,
            }
        }
        Err(Fault::Unanswered {
            during,
            tries,
            reason,
        })
    }

    /// As [`Link::ask`]; a rejection is a fault, and so is an alert that came since.
    pub(super) fn accepted(&mut self, axis: u8, text: &str, tries: u32) -> Result<Reply, Fault> {
        let reply = self.ask(axis, text, tries)?;
        let during = || format!("'{text}'");
        if !reply.accepted {
            return Err(Fault::Rejected {
                during: during(),
                reason: reply.data,
            });
        }
        if let Some((axis, flag)) = self.alert.take() {
            let during = format!("{} (an alert of axis {axis})", during());
            return Err(Fault::Flagged { during, flag });
        }
        Ok(reply)
    }

    /// Forgets alerts.
    pub(super) fn clear_alert(&mut self) {
        self.alert = None;
    }

    /// The reply to the last command, or why there is none.
    fn answer(&mut self, axis: u8) -> Result<Result<Reply, String>, Fault> {
        let deadline = self.clock.now() + REPLY_TIMEOUT;
        let mut damaged = None;
        while let Some(line) = self.next_line(deadline)? {
            match Message::of(&line, self.plain) {
                Message::Reply(reply)
                    if (reply.address, reply.axis, reply.id)
                        == (self.address, axis, Some(self.id)) =>
                {
                    return Ok(Ok(reply));
                }
                // A late reply, another device of the chain, or text for people.
                Message::Reply(_) | Message::Info => {}
                Message::Alert {
                    address,
                    axis,
                    flag,
                } => self.note_alert(address, axis, flag),
                Message::Garbled => damaged = Some(line),
            }
        }
        Ok(Err(match damaged {
            Some(mut line) => {
                line.truncate(80);
                format!("garbled reply {}", show_bytes(&line))
            }
            None => format!("nothing came within {REPLY_TIMEOUT} s"),
        }))
    }

    fn note_alert(&mut self, address: u8, axis: u8, flag: Option<String>) {
        let grave = flag.filter(|f| {
            matches!(
                flags::meaning(f).0,
                Effect::Trouble | Effect::PositionLost | Effect::NotHomed
            )
        });
        if let Some(flag) = grave.filter(|_| address == self.address) {
            self.alert = Some((axis, flag));
        }
    }

    /// The next line without its end; none when `deadline` passes first. Lines that had arrived by then are
    /// handed out after it, but not without end.
    fn next_line(&mut self, deadline: f64) -> Result<Option<Vec<u8>>, Fault> {
        loop {
            self.interrupted()?;
            let late = self.clock.now() > deadline;
            if !late {
                self.late_lines = 0;
            } else if self.late_lines >= LATE_LINES {
                return Ok(None);
            }
            if let Some(end) = self.input.iter().position(|b| *b == b'\n') {
                let line: Vec<u8> = self.input.drain(..=end).collect();
                let text = line.strip_suffix(b"\n").unwrap_or(&line);
                let text = text.strip_suffix(b"\r").unwrap_or(text);
                self.late_lines += u32::from(late);
                return Ok(Some(text.to_vec()));
            }
            if self.input.len() > LONGEST_LINE {
                return Ok(Some(std::mem::take(&mut self.input)));
            }
            if late {
                return Ok(None);
            }
            let wait = (deadline - self.clock.now()).clamp(0.0, LOOK);
            let mut buffer = [0; 256];
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

    /// Reads and drops everything until nothing comes for `quiet` seconds (at most 5 s).
    pub(super) fn read_until_quiet(&mut self, quiet: f64) -> Result<(), Fault> {
        let limit = self.clock.now() + 5.0;
        while self.clock.now() < limit {
            if self.next_line(self.clock.now() + quiet)?.is_none() {
                self.input.clear();
                return Ok(());
            }
        }
        Err(Fault::unexpected(
            "the device talks without end",
            "is this the right port and baud rate?",
        ))
    }
}
