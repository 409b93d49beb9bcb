//! The files of a calibration folder.

use super::{ColorMatrix, DarkCurrent, FlatField, Geometry, LampDrift, Linearity, WhiteStandard};
use crate::base::{Context, Error, Result};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// What a calibration is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// [`DarkCurrent`].
    Dark,
    /// [`Linearity`].
    Linearity,
    /// [`FlatField`].
    Flat,
    /// [`WhiteStandard`].
    White,
    /// [`ColorMatrix`].
    Color,
    /// [`Geometry`].
    Geometry,
    /// [`LampDrift`].
    Drift,
}

impl Kind {
    /// The name in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Dark => "dark",
            Self::Linearity => "linearity",
            Self::Flat => "flat",
            Self::White => "white",
            Self::Color => "color",
            Self::Geometry => "geometry",
            Self::Drift => "drift",
        }
    }
}

/// Where a calibration comes from, and what it is for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Header {
    /// Always [`Header::FORMAT`].
    pub format: String,
    /// What it is of.
    pub kind: Kind,
    /// The rig, by name.
    pub rig: String,
    /// The camera, as in the session's manifest.
    pub camera: String,
    /// Visible size of its frames, pixels.
    pub size_px: [usize; 2],
    /// UTC time of the session it was made from, RFC 3339.
    pub date_utc: String,
    /// The sessions it was made from.
    pub sessions: Vec<Source>,
    /// True when no camera saw anything: frames come from a virtual camera.
    pub synthetic: bool,
    /// Program version that wrote it.
    pub program: String,
}

impl Header {
    /// The value of [`Header::format`].
    pub const FORMAT: &'static str = "goniofit-calibration-1";
}

/// A session a calibration was made from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Source {
    /// Name of its folder.
    pub session: String,
    /// SHA-256 of its journal, hexadecimal.
    pub journal_sha256: String,
}

/// A calibration with its header: one file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dated<T> {
    /// Where it comes from.
    pub header: Header,
    /// What was found.
    pub value: T,
}

/// The newest calibration of each kind, as far as there is one.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Calibrations {
    /// What pixels read without light.
    pub dark: Option<Dated<DarkCurrent>>,
    /// How raw values grow with light.
    pub linearity: Option<Dated<Linearity>>,
    /// Relative response of the pixels.
    pub flat: Option<Dated<FlatField>>,
    /// The white standard.
    pub white: Option<Dated<WhiteStandard>>,
    /// Color space.
    pub color: Option<Dated<ColorMatrix>>,
    /// Scale, pointing, lens.
    pub geometry: Option<Dated<Geometry>>,
    /// The lamp.
    pub drift: Option<Dated<LampDrift>>,
}

impl Calibrations {
    /// Reads the newest file of each kind in a folder (`YYYY-MM-DD_KIND.json`, further letters after the date allowed).
    ///
    /// # Errors
    /// The folder or a file cannot be read, a file is damaged or of another format, or a map does not match its file.
    pub fn read(folder: &Path) -> Result<Self> {
        let mut names = Vec::new();
        let what = || format!("calibration folder {} cannot be read", folder.display());
        for entry in std::fs::read_dir(folder).context(what)? {
            let name = entry.context(what)?.file_name();
            names.push(name.to_string_lossy().into_owned());
        }
        names.sort();
        let newest = |kind: Kind| -> Option<PathBuf> {
            let end = format!("_{}.json", kind.name());
            let name = names.iter().rev().find(|n| n.ends_with(&end))?;
            Some(folder.join(name))
        };
        let mut found = Self {
            dark: read_newest(newest(Kind::Dark))?,
            linearity: read_newest(newest(Kind::Linearity))?,
            flat: read_newest(newest(Kind::Flat))?,
            white: read_newest(newest(Kind::White))?,
            color: read_newest(newest(Kind::Color))?,
            geometry: read_newest(newest(Kind::Geometry))?,
            drift: read_newest(newest(Kind::Drift))?,
        };
        if let Some(flat) = &mut found.flat {
            flat.value.read_map(folder, flat.header.size_px)?;
        }
        Ok(found)
    }
}

/// What a calibration file can hold.
pub trait Value: Serialize {
    /// Writes what lies beside the file (`STEM.json`) into the folder, and notes it in the value.
    ///
    /// # Errors
    /// The disk refuses.
    fn write_beside(&mut self, folder: &Path, stem: &str, size_px: [usize; 2]) -> Result<()> {
        let _ = (folder, stem, size_px);
        Ok(())
    }
}

impl Value for DarkCurrent {}
impl Value for Linearity {}
impl Value for WhiteStandard {}
impl Value for ColorMatrix {}
impl Value for Geometry {}
impl Value for LampDrift {}

impl<T: Value> Dated<T> {
    /// Writes the calibration as `YYYY-MM-DD_KIND.json`, by the date of its session; with a letter b, c, ... after the date
    /// when there is such a file already. Returns the path. Nothing is overwritten.
    ///
    /// # Errors
    /// The header's date is none, there are 26 files of the day, or the disk refuses.
    pub fn write(&mut self, folder: &Path) -> Result<PathBuf> {
        std::fs::create_dir_all(folder)
            .context(|| format!("calibration folder {} cannot be made", folder.display()))?;
        let stem = free_stem(folder, &self.header)?;
        self.value
            .write_beside(folder, &stem, self.header.size_px)?;
        let text = serde_json::to_string_pretty(self)
            .context(|| format!("calibration {stem} cannot be written"))?;
        let path = folder.join(format!("{stem}.json"));
        crate::session::files::write_new(&path, (text + "\n").as_bytes())?;
        Ok(path)
    }
}

/// The first name of the day that no file has.
fn free_stem(folder: &Path, header: &Header) -> Result<String> {
    let shape = b"dddd-dd-dd";
    let fits = |(&c, &s): (&u8, &u8)| {
        if s == b'd' {
            c.is_ascii_digit()
        } else {
            c == s
        }
    };
    let date = header.date_utc.get(..shape.len()).unwrap_or("");
    if date.len() != shape.len() || !date.as_bytes().iter().zip(shape).all(fits) {
        return Err(Error::new(format!(
            "the session's date '{}' is none, expected RFC 3339 as in 2026-11-22T09:30:00Z",
            header.date_utc
        ))
        .with_hint("the calibration's file is named after it: mend started_utc in session.json"));
    }
    let letters = std::iter::once(String::new()).chain(('b'..='z').map(String::from));
    let mut stems = letters.map(|l| format!("{date}{l}_{}", header.kind.name()));
    let free = |stem: &String| {
        !["json", "exr"]
            .iter()
            .any(|end| folder.join(format!("{stem}.{end}")).exists())
    };
    stems.find(free).ok_or_else(|| {
        Error::new(format!(
            "{} holds 26 {} calibrations of {date} already",
            folder.display(),
            header.kind.name()
        ))
        .with_hint("move the ones that are not needed elsewhere")
    })
}

/// What to do about a calibration that cannot be used.
pub(super) const AGAIN: &str =
    "restore it from a copy, or calibrate again; a folder without it is read without it";

fn read_newest<T: DeserializeOwned>(path: Option<PathBuf>) -> Result<Option<Dated<T>>> {
    let Some(path) = path else {
        return Ok(None);
    };
    let text = crate::session::files::read_text(&path)?;
    let dated: Dated<T> = serde_json::from_str(&text)
        .context(|| format!("calibration {} is damaged", path.display()))
        .map_err(|e| e.with_hint(AGAIN))?;
    if dated.header.format != Header::FORMAT {
        return Err(Error::new(format!(
            "calibration {}: format '{}' where '{}' was expected",
            path.display(),
            dated.header.format,
            Header::FORMAT
        ))
        .with_hint(AGAIN));
    }
    Ok(Some(dated))
}
