//! The wire log: every byte to and from every board with its time, one JSON object per line.
//!
//! ```text
//! {"t":1.018,"board":"main","dir":"<","text":"Grbl 1.1h ['$' for help]\r\n"}
//! {"t":2.006,"board":"main","dir":">","text":"\u0018"}
//! {"t":2.307,"board":"main","dir":">","hex":"fe"}
//! ```
//! `dir` is `>` for bytes to the board; bytes beyond ASCII make the entry hexadecimal. Empty lines and lines that begin
//! with `#` are comments. A log can be played back by [`super::replay`].

use super::transport::{Clock, Transport};
use crate::base::{Context, Error, Result};
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::sync::{Arc, Mutex};

/// Which way bytes went.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Way {
    /// To the board.
    #[serde(rename = ">")]
    ToBoard,
    /// From the board.
    #[serde(rename = "<")]
    FromBoard,
}

/// One piece of a dialogue.
#[derive(Debug, Clone, PartialEq)]
pub struct WireEntry {
    /// Seconds on the recording clock.
    pub t: f64,
    /// Which board.
    pub board: String,
    /// Which way.
    pub way: Way,
    /// The bytes, at least one.
    pub bytes: Vec<u8>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    t: f64,
    board: String,
    dir: Way,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    text: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    hex: Option<String>,
}

impl WireEntry {
    /// The entry as one line of a wire log, with its newline.
    pub fn to_line(&self) -> String {
        let ascii = self.bytes.is_ascii();
        let line = Line {
            t: self.t,
            board: self.board.clone(),
            dir: self.way,
            text: ascii.then(|| String::from_utf8_lossy(&self.bytes).into_owned()),
            hex: (!ascii).then(|| self.bytes.iter().map(|b| format!("{b:02x}")).collect()),
        };
        serde_json::to_string(&line).expect("plain strings and numbers always serialize") + "\n"
    }

    fn from_line(text: &str) -> Result<Self> {
        let line: Line = serde_json::from_str(text).context(|| "not a wire log entry")?;
        let bytes = match (line.text, line.hex) {
            (Some(text), None) if text.is_ascii() => text.into_bytes(),
            (None, Some(hex)) => from_hex(&hex)?,
            _ => return Err(Error::new("expected either ASCII `text` or `hex`")),
        };
        if bytes.is_empty() || !(0.0..f64::INFINITY).contains(&line.t) {
            return Err(Error::new("expected at least one byte and a time t >= 0"));
        }
        Ok(Self {
            t: line.t,
            board: line.board,
            way: line.dir,
            bytes,
        })
    }
}

fn from_hex(hex: &str) -> Result<Vec<u8>> {
    let digits: Option<Vec<u8>> = hex
        .chars()
        .map(|c| c.to_digit(16).map(|d| d as u8))
        .collect();
    match digits {
        Some(d) if d.len() % 2 == 0 => Ok(d.chunks(2).map(|p| p[0] * 16 + p[1]).collect()),
        _ => Err(Error::new(format!("'{hex}' is not a hexadecimal string"))),
    }
}

/// Parses the text of a wire log.
///
/// # Errors
/// With the line number, when a line is neither a comment nor an entry.
pub fn parse_wire_log(text: &str) -> Result<Vec<WireEntry>> {
    text.lines()
        .enumerate()
        .filter(|(_, l)| !l.trim().is_empty() && !l.starts_with('#'))
        .map(|(i, l)| WireEntry::from_line(l).context(|| format!("wire log line {}", i + 1)))
        .collect()
}

/// Reads a wire log file; see [`parse_wire_log`].
///
/// # Errors
/// When the file cannot be read, or as [`parse_wire_log`].
pub fn read_wire_log(path: &Path) -> Result<Vec<WireEntry>> {
    let text = crate::session::files::read_text(path)?;
    parse_wire_log(&text).context(|| format!("wire log {}", path.display()))
}

/// Bytes as a person reads them: printable ASCII, escapes for the rest.
pub fn show_bytes(bytes: &[u8]) -> String {
    let shown: String = bytes
        .iter()
        .map(|b| std::ascii::escape_default(*b).to_string())
        .collect();
    format!("'{}'", shown.replace("\\'", "'"))
}

enum Sink {
    Memory(String),
    File(File),
}

/// A wire log being written; clones write to the same log. Kept in memory until [`WireLog::write_to`] names its file.
#[derive(Clone)]
pub struct WireLog {
    sink: Arc<Mutex<Sink>>,
    /// Why an entry of recorded traffic could not be added.
    failure: Arc<Mutex<Option<String>>>,
}

impl Default for WireLog {
    fn default() -> Self {
        Self {
            sink: Arc::new(Mutex::new(Sink::Memory(String::new()))),
            failure: Arc::default(),
        }
    }
}

impl WireLog {
    /// An empty log in memory.
    pub fn new() -> Self {
        Self::default()
    }

    /// Moves the log into a new file; later entries are appended to it at once.
    ///
    /// # Errors
    /// When the file exists already or cannot be written.
    pub fn write_to(&self, path: &Path) -> Result<()> {
        let what = || format!("wire log {} cannot be written", path.display());
        let mut file = File::create_new(path).context(what)?;
        let mut sink = self.sink.lock().expect("the log's lock is never poisoned");
        if let Sink::Memory(text) = &*sink {
            file.write_all(text.as_bytes()).context(what)?;
        }
        *sink = Sink::File(file);
        Ok(())
    }

    /// The log's text so far, when it is still in memory.
    pub fn text(&self) -> Option<String> {
        match &*self.sink.lock().expect("the log's lock is never poisoned") {
            Sink::Memory(text) => Some(text.clone()),
            Sink::File(_) => None,
        }
    }

    /// Adds one entry.
    ///
    /// # Errors
    /// When the file cannot take it.
    pub fn add(&self, entry: &WireEntry) -> io::Result<()> {
        match &mut *self.sink.lock().expect("the log's lock is never poisoned") {
            Sink::Memory(text) => text.push_str(&entry.to_line()),
            Sink::File(file) => file.write_all(entry.to_line().as_bytes())?,
        }
        Ok(())
    }

    fn fail(&self, why: &io::Error) {
        let mut failure = self
            .failure
            .lock()
            .expect("the log's lock is never poisoned");
        failure.get_or_insert_with(|| why.to_string());
    }

    /// Fails when recorded traffic is missing from the log.
    ///
    /// # Errors
    /// With the reason of the first entry that could not be written.
    pub fn check(&self) -> Result<()> {
        match &*self
            .failure
            .lock()
            .expect("the log's lock is never poisoned")
        {
            None => Ok(()),
            Some(why) => Err(Error::new(format!("the wire log cannot be written: {why}"))
                .with_hint("is the disk full?")),
        }
    }
}

/// Wraps a transport and logs what passes. A log that cannot be written (a full disk) keeps no byte from the board and
/// none from the driver; [`WireLog::check`] tells of it.
pub struct RecordingTransport {
    inner: Box<dyn Transport>,
    board: String,
    clock: Arc<dyn Clock>,
    log: WireLog,
}

impl RecordingTransport {
    /// Logs the traffic of `inner` under the name `board`, with the times of `clock`.
    pub fn new(
        inner: Box<dyn Transport>,
        board: &str,
        clock: Arc<dyn Clock>,
        log: WireLog,
    ) -> Self {
        Self {
            inner,
            board: board.to_owned(),
            clock,
            log,
        }
    }

    fn record(&self, way: Way, bytes: &[u8]) {
        let added = self.log.add(&WireEntry {
            t: self.clock.now(),
            board: self.board.clone(),
            way,
            bytes: bytes.to_vec(),
        });
        if let Err(e) = added {
            self.log.fail(&e);
        }
    }
}

impl Transport for RecordingTransport {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.record(Way::ToBoard, bytes);
        self.inner.write(bytes)
    }

    fn read(&mut self, buffer: &mut [u8], timeout: f64) -> io::Result<usize> {
        let n = self.inner.read(buffer, timeout)?;
        if n > 0 {
            self.record(Way::FromBoard, &buffer[..n]);
        }
        Ok(n)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_byte_value_survives_the_round_trip() {
        for bytes in [
            (0..=255).collect::<Vec<u8>>(),
            (0..128).collect(),
            b"\x18".to_vec(),
        ] {
            let entry = WireEntry {
                t: 0.1 + 0.2,
                board: "main".into(),
                way: Way::FromBoard,
                bytes,
            };
            assert_eq!(parse_wire_log(&entry.to_line()).unwrap(), [entry]);
        }
    }

    #[test]
    fn a_full_disk_keeps_no_byte_from_the_board_and_is_told() {
        struct Board(Arc<Mutex<Vec<u8>>>);
        impl Transport for Board {
            fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
                self.0.lock().unwrap().extend_from_slice(bytes);
                Ok(())
            }
            fn read(&mut self, buffer: &mut [u8], _: f64) -> io::Result<usize> {
                buffer[0] = b'k';
                Ok(1)
            }
        }
        let Ok(full) = File::options().write(true).open("/dev/full") else {
            println!("skipped: no /dev/full here");
            return;
        };
        let log = WireLog::new();
        log.check().unwrap();
        *log.sink.lock().unwrap() = Sink::File(full);
        let heard = Arc::new(Mutex::new(Vec::new()));
        let clock = Arc::new(crate::rig::VirtualClock::new());
        let board = Box::new(Board(heard.clone()));
        let mut wire = RecordingTransport::new(board, "main", clock, log.clone());
        wire.write(b"!").unwrap();
        assert_eq!(wire.read(&mut [0; 8], 0.1).unwrap(), 1);
        assert_eq!(*heard.lock().unwrap(), b"!");
        let error = log.check().unwrap_err().report();
        assert!(error.contains("the wire log cannot be written"), "{error}");
    }

    #[test]
    fn a_damaged_log_is_refused_with_the_line() {
        let error = |text: &str| parse_wire_log(text).unwrap_err().report();
        assert!(error("# ok\n{\"t\":0,\"board\":\"a\",\"dir\":\">\"}").contains("line 2"));
        assert!(
            error("{\"t\":0,\"board\":\"a\",\"dir\":\">\",\"hex\":\"0\"}").contains("hexadecimal")
        );
        assert!(
            error("{\"t\":-1,\"board\":\"a\",\"dir\":\">\",\"text\":\"x\"}").contains("t >= 0")
        );
    }
}
