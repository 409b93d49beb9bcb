//! Plays a recorded dialogue back byte for byte, on its own clock.
//!
//! Strict: what the driver writes must equal what was written then, and at the end nothing may be left over. The order
//! of bytes decides, not their times: bytes that came from the board are handed out as soon as the driver reads, and a
//! read where the recording shows the driver writing next times out. Times only set the clock.

use super::transport::{Clock, Transport, VirtualClock, timed_out};
use super::wire_log::{Way, WireEntry, show_bytes};
use crate::base::{Error, Result};
use std::io;
use std::sync::{Arc, Mutex};

/// A recorded dialogue being played back, over all its boards.
pub struct Replay {
    tape: Arc<Mutex<Tape>>,
    clock: Arc<VirtualClock>,
}

struct Tape {
    entries: Vec<WireEntry>,
    /// The entry being played, and how many of its bytes are done.
    at: usize,
    offset: usize,
    /// The first divergence; everything after it fails.
    divergence: Option<String>,
}

impl Replay {
    /// A replay of these entries.
    pub fn new(entries: Vec<WireEntry>) -> Self {
        Self {
            tape: Arc::new(Mutex::new(Tape {
                entries,
                at: 0,
                offset: 0,
                divergence: None,
            })),
            clock: Arc::new(VirtualClock::new()),
        }
    }

    /// The clock of the recording.
    pub fn clock(&self) -> Arc<VirtualClock> {
        self.clock.clone()
    }

    /// The end of the line to one board.
    pub fn transport(&self, board: &str) -> ReplayTransport {
        ReplayTransport {
            tape: self.tape.clone(),
            clock: self.clock.clone(),
            board: board.to_owned(),
        }
    }

    /// Checks that the dialogue did not diverge and was used up.
    ///
    /// # Errors
    /// With the divergence, or with the first entry that was not played.
    pub fn finish(&self) -> Result<()> {
        let tape = self.tape.lock().expect("the tape's lock is never poisoned");
        if let Some(divergence) = &tape.divergence {
            return Err(diverged(divergence));
        }
        match tape.entries.get(tape.at) {
            None => Ok(()),
            Some(entry) => Err(Error::new(format!(
                "replay ended early: entry {} of {} ({}) was not reached",
                tape.at + 1,
                tape.entries.len(),
                describe(entry, tape.offset)
            ))
            .with_hint("the recording was made with another plan, rig or program version")),
        }
    }
}

fn diverged(text: &str) -> Error {
    Error::new(text.to_owned()).with_hint(
        "replay needs the same plan and rig file as the recording; record again if the program changed",
    )
}

fn describe(entry: &WireEntry, offset: usize) -> String {
    let way = match entry.way {
        Way::ToBoard => "to",
        Way::FromBoard => "from",
    };
    format!(
        "{way} board '{}' at {:.3} s: {}",
        entry.board,
        entry.t,
        show_bytes(&entry.bytes[offset..])
    )
}

/// One board's end of a [`Replay`].
pub struct ReplayTransport {
    tape: Arc<Mutex<Tape>>,
    clock: Arc<VirtualClock>,
    board: String,
}

impl Tape {
    fn step(&mut self, n: usize) {
        self.offset += n;
        if self.offset == self.entries[self.at].bytes.len() {
            self.at += 1;
            self.offset = 0;
        }
    }

    fn fail(&mut self, text: String) -> io::Error {
        let text = self.divergence.get_or_insert(text).clone();
        io::Error::new(io::ErrorKind::InvalidData, diverged(&text))
    }
}

impl Transport for ReplayTransport {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        let mut tape = self.tape.lock().expect("the tape's lock is never poisoned");
        let mut done = 0;
        while done < bytes.len() {
            let rest = &bytes[done..];
            let found = format!("board '{}' was sent {}", self.board, show_bytes(rest));
            let Some(entry) = tape.entries.get(tape.at).cloned() else {
                return Err(tape.fail(format!(
                    "replay diverged at its end: expected nothing more, {found}"
                )));
            };
            let expected = &entry.bytes[tape.offset..];
            let same = expected
                .iter()
                .zip(rest)
                .take_while(|(a, b)| a == b)
                .count();
            let complete = same == expected.len() || same == rest.len();
            if entry.way != Way::ToBoard || entry.board != self.board || !complete {
                let text = format!(
                    "replay diverged at entry {}, byte {}: expected {}, {found}",
                    tape.at + 1,
                    tape.offset + same + 1,
                    describe(&entry, tape.offset)
                );
                return Err(tape.fail(text));
            }
            self.clock.advance_to(entry.t);
            tape.step(same);
            done += same;
        }
        Ok(())
    }

    fn read(&mut self, buffer: &mut [u8], timeout: f64) -> io::Result<usize> {
        let mut tape = self.tape.lock().expect("the tape's lock is never poisoned");
        if tape.divergence.is_some() {
            return Err(tape.fail(String::new()));
        }
        let offset = tape.offset;
        match tape.entries.get(tape.at) {
            Some(e) if e.way == Way::FromBoard && e.board == self.board => {
                let bytes = &e.bytes[offset..];
                let n = bytes.len().min(buffer.len());
                buffer[..n].copy_from_slice(&bytes[..n]);
                self.clock.advance_to(e.t);
                tape.step(n);
                Ok(n)
            }
            _ => {
                self.clock.sleep(timeout);
                Err(timed_out())
            }
        }
    }
}
