//! The journal: one fsynced line per event, append-only; a torn last line is what a crash leaves and is tolerated.

use super::plan::ConfigurationRow;
use super::{Configuration, Filter};
use crate::base::{Context, Error, Result};
use serde::{Deserialize, Serialize};
use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

/// What a frame shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FrameKind {
    /// The sample, light on.
    Sample,
    /// The sample's place, light off: electronics and stray light at this exposure.
    Dark,
    /// The white standard at the session's reference geometry, light on.
    White,
    /// The sample at the white's reference geometry, light on: how bright the lamp is now.
    Reference,
    /// Something evenly bright over the whole image (a diffuser on the lens, a panel), light on.
    Flat,
    /// A color chart in the sample's place, light on.
    Chart,
    /// A checkerboard in the sample's place, light on.
    Board,
}

impl FrameKind {
    /// The name in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Sample => "sample",
            Self::Dark => "dark",
            Self::White => "white",
            Self::Reference => "reference",
            Self::Flat => "flat",
            Self::Chart => "chart",
            Self::Board => "board",
        }
    }
}

/// How well a frame is exposed over its crop, per channel r, g, b; 0 = black level, 1 = white level.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Exposedness {
    /// Brightest pixel.
    pub peak: [f64; 3],
    /// Mean.
    pub mean: [f64; 3],
}

/// One finished shot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameRecord {
    /// File name inside `frames/`.
    pub file: String,
    /// What it shows.
    pub kind: FrameKind,
    /// The plan's configuration for a sample, flat, chart or board frame; none for darks, whites and references.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub config: Option<u32>,
    /// Exposure time read back from the camera, milliseconds.
    pub exposure_ms: f64,
    /// Exposure time asked for, milliseconds; the camera may round it. Absent in old sessions: as read back.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub requested_ms: Option<f64>,
    /// 0 for the first shot of this kind, configuration, visit and exposure, 1 for its first repeat, ...
    #[serde(default)]
    pub repeat: u32,
    /// Which visit of the reference pose (0, 1, ...); 0 for every other kind.
    #[serde(skip_serializing_if = "is_zero", default)]
    pub visit: u32,
    /// The filter in front of the lens; none for a camera that sees color itself.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub filter: Option<Filter>,
    /// How well it is exposed, when somebody looked.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub exposed: Option<Exposedness>,
    /// UTC time of the shot, RFC 3339.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub utc: Option<String>,
    /// Axis positions read back at the shot, degrees, by axis name.
    #[serde(default)]
    pub axes_deg: std::collections::BTreeMap<String, f64>,
    /// SHA-256 of the file's bytes, hexadecimal.
    pub sha256: String,
}

fn is_zero(n: &u32) -> bool {
    *n == 0
}

impl FrameRecord {
    /// The exposure time that was asked for, milliseconds.
    pub fn asked_ms(&self) -> f64 {
        self.requested_ms.unwrap_or(self.exposure_ms)
    }
}

/// Something that happened in a capture session.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// The rig is connected, checked and homed: a stretch of work begins, the first or one after an interruption.
    /// Positions, and the lamp's brightness, are not comparable across it without a reference shot.
    Ready {
        /// Firmware's own description.
        firmware: String,
        /// UTC time, RFC 3339.
        #[serde(skip_serializing_if = "Option::is_none", default)]
        utc: Option<String>,
    },
    /// A frame is on disk.
    Frame(FrameRecord),
    /// All shots of the plan are on disk.
    Finished,
    /// The capture ended early.
    Stopped {
        /// Why.
        reason: String,
    },
}

/// One line of the journal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Entry {
    /// 0, 1, 2, ... without gaps.
    pub sequence: u64,
    /// Seconds since the capture started, monotonic.
    pub elapsed_s: f64,
    /// What happened.
    #[serde(flatten)]
    pub event: Event,
}

/// An open journal; the only way to add to one.
#[derive(Debug)]
pub struct Journal {
    file: File,
    path: PathBuf,
    next: u64,
}

impl Journal {
    /// Starts the journal of a new session.
    ///
    /// # Errors
    /// When the file exists already or cannot be created.
    pub fn create(path: &Path) -> Result<Self> {
        let file = OpenOptions::new()
            .append(true)
            .create_new(true)
            .open(path)
            .context(|| format!("journal {} cannot be created", path.display()))?;
        own(&file, path)?;
        Ok(Self {
            file,
            path: path.to_owned(),
            next: 0,
        })
    }

    /// Opens the journal of an interrupted session for more events, cutting off a torn last line; also what it holds.
    ///
    /// # Errors
    /// When it cannot be opened or a line other than the last is damaged.
    pub fn reopen(path: &Path) -> Result<(Self, Vec<Entry>)> {
        let what = || format!("journal {} cannot be opened", path.display());
        let mut file = OpenOptions::new()
            .read(true)
            .append(true)
            .open(path)
            .context(what)?;
        own(&file, path)?;
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes).context(what)?;
        let (entries, whole) = parse(&bytes).context(|| format!("journal {}", path.display()))?;
        file.set_len(whole as u64).context(what)?;
        let journal = Self {
            file,
            path: path.to_owned(),
            next: entries.len() as u64,
        };
        Ok((journal, entries))
    }

    /// Appends one event and waits until it is on the disk.
    ///
    /// # Errors
    /// When the disk refuses (full, unplugged); the event is then not part of the session.
    pub fn append(&mut self, elapsed_s: f64, event: Event) -> Result<()> {
        let what = || format!("journal {} cannot be written", self.path.display());
        let mut line = serde_json::to_vec(&Entry {
            sequence: self.next,
            elapsed_s,
            event,
        })
        .context(what)?;
        line.push(b'\n');
        let whole = self.file.metadata().context(what)?.len();
        let written = self
            .file
            .write_all(&line)
            .and_then(|()| self.file.sync_data());
        if written.is_err() {
            // A torn line may only be the last one: take it back, so that a later line is not lost behind it.
            let _ = self.file.set_len(whole);
        }
        written.context(what)?;
        self.next += 1;
        Ok(())
    }
}

/// One writer per journal: held until the file is closed, whatever ends the process.
fn own(file: &File, path: &Path) -> Result<()> {
    use rustix::fs::{FlockOperation, flock};
    flock(file, FlockOperation::NonBlockingLockExclusive)
        .context(|| {
            format!(
                "journal {} is being written by another process",
                path.display()
            )
        })
        .map_err(|e| e.with_hint("a capture into this session is running; wait for it or stop it"))
}

/// Reads a journal; a torn last line (no newline at its end) is left out.
///
/// # Errors
/// When the file cannot be read, a whole line is not an entry, or sequence numbers have a gap.
pub fn read_journal(path: &Path) -> Result<Vec<Entry>> {
    let bytes =
        std::fs::read(path).context(|| format!("journal {} cannot be read", path.display()))?;
    Ok(parse(&bytes)
        .context(|| format!("journal {}", path.display()))?
        .0)
}

/// The entries, and how many bytes the whole lines take.
fn parse(bytes: &[u8]) -> Result<(Vec<Entry>, usize)> {
    let whole = bytes.iter().rposition(|&b| b == b'\n').map_or(0, |i| i + 1);
    let mut entries = Vec::new();
    for (i, line) in bytes[..whole]
        .split(|&b| b == b'\n')
        .filter(|l| !l.is_empty())
        .enumerate()
    {
        let entry: Entry = serde_json::from_slice(line).context(|| format!("line {} is damaged", i + 1)).map_err(|e| {
            e.with_hint("only a torn last line is tolerated; restore the file from a copy, or capture again into a new folder")
        })?;
        if entry.sequence != i as u64 {
            return Err(Error::new(format!(
                "line {}: sequence {} where {i} was expected",
                i + 1,
                entry.sequence
            ))
            .with_hint("lines were removed or doubled; restore the file from a copy"));
        }
        entries.push(entry);
    }
    Ok((entries, whole))
}

/// The pose a frame was taken at, as files write it.
impl Serialize for Configuration {
    fn serialize<S: serde::Serializer>(
        &self,
        serializer: S,
    ) -> std::result::Result<S::Ok, S::Error> {
        ConfigurationRow::from(*self).serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for Configuration {
    fn deserialize<D: serde::Deserializer<'de>>(
        deserializer: D,
    ) -> std::result::Result<Self, D::Error> {
        ConfigurationRow::deserialize(deserializer)?
            .checked()
            .map_err(|e| serde::de::Error::custom(e.report()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(n: u32) -> Event {
        Event::Frame(FrameRecord {
            file: format!("{n}.dng"),
            kind: FrameKind::Sample,
            config: Some(n),
            exposure_ms: 10.0,
            requested_ms: None,
            repeat: 0,
            visit: 0,
            filter: None,
            exposed: None,
            utc: None,
            axes_deg: [("light_elevation".to_owned(), 32.0)].into(),
            sha256: "00".to_owned(),
        })
    }

    #[test]
    fn a_journal_cut_at_any_byte_keeps_every_whole_line_and_goes_on() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("journal.jsonl");
        let mut journal = Journal::create(&path).unwrap();
        for n in 0..3 {
            journal.append(f64::from(n), frame(n)).unwrap();
        }
        drop(journal);
        let bytes = std::fs::read(&path).unwrap();
        for cut in 0..=bytes.len() {
            std::fs::write(&path, &bytes[..cut]).unwrap();
            let lines = bytes[..cut].iter().filter(|&&b| b == b'\n').count();
            assert_eq!(read_journal(&path).unwrap().len(), lines, "cut at {cut}");
            let (mut again, entries) = Journal::reopen(&path).unwrap();
            assert_eq!(entries.len(), lines);
            assert!(
                Journal::reopen(&path)
                    .unwrap_err()
                    .report()
                    .contains("another process")
            );
            again.append(9.0, Event::Finished).unwrap();
            // A write that the disk did not take whole is taken back; the next one follows the last whole line.
            let whole = std::fs::metadata(&path).unwrap().len();
            again.append(9.5, Event::Finished).unwrap();
            again.next -= 1;
            again.file.set_len(whole).unwrap();
            again.append(9.5, frame(7)).unwrap();
            let entries = read_journal(&path).unwrap();
            assert_eq!(entries.len(), lines + 2);
            assert_eq!(entries[lines].event, Event::Finished);
        }
    }

    #[test]
    fn a_damaged_line_in_the_middle_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("journal.jsonl");
        let mut journal = Journal::create(&path).unwrap();
        for n in 0..3 {
            journal.append(f64::from(n), frame(n)).unwrap();
        }
        let text = std::fs::read_to_string(&path).unwrap();
        std::fs::write(&path, text.replacen("\"sequence\":1", "\"sequence\":x", 1)).unwrap();
        let message = read_journal(&path).unwrap_err().report();
        assert!(
            message.contains("line 2 is damaged") && message.contains("hint:"),
            "{message}"
        );
        let skipped: Vec<&str> = text
            .lines()
            .enumerate()
            .filter(|(i, _)| *i != 1)
            .map(|(_, l)| l)
            .collect();
        std::fs::write(&path, skipped.join("\n") + "\n").unwrap();
        assert!(
            read_journal(&path)
                .unwrap_err()
                .report()
                .contains("sequence 2 where 1 was expected")
        );
        assert!(
            Journal::create(&path).is_err(),
            "an existing journal is never started over"
        );
    }
}
