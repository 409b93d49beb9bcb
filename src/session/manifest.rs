//! The session folder and its manifest.

use super::journal::{self, Entry, Event, FrameKind, FrameRecord, Journal};
use super::{Configuration, Plan, files};
use crate::base::{Context, Error, Result};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// What must be known about the camera to read its frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CameraFacts {
    /// Maker and model, as in the frames.
    pub name: String,
    /// Visible width, pixels.
    pub width: usize,
    /// Visible height, pixels.
    pub height: usize,
    /// Millimeters on a plane through the sample center, perpendicular to the view, per pixel.
    pub pixel_mm: f64,
    /// Image point (x right, y down, pixels; integer = pixel corner) the sample center projects to.
    pub center_px: [f64; 2],
    /// How the lens departs from that.
    #[serde(default, skip_serializing_if = "Lens::is_ideal")]
    pub lens: Lens,
}

/// How a lens and its mount depart from an orthographic camera that looks at the sample center from every pose. All zero:
/// not at all.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Lens {
    /// The image is turned by this about the sample center, from x (right) toward y (down), radians.
    pub roll: f64,
    /// One over the distance from the entrance pupil to the sample center, 1/mm; 0: orthographic.
    pub perspective: f64,
    /// Radial distortion: an image point at distance r from the middle of the image is moved to `r (1 + distortion r^2)`, r
    /// in units of half the image diagonal.
    pub distortion: f64,
    /// How the image of the sample center moves, pixels, when the camera arm bends: by `sag_px[0] sin(theta)` and
    /// `sag_px[1] (1 - cos(theta))` at camera polar angle theta.
    pub sag_px: [[f64; 2]; 2],
}

impl Lens {
    /// True when nothing departs.
    pub fn is_ideal(&self) -> bool {
        *self == Self::default()
    }

    /// True when the numbers are finite and an image point has one place on the sample: a perspective of 0..0.1 1/mm and
    /// a distortion of at most 0.3 either way.
    pub fn is_sound(&self) -> bool {
        let others = self.sag_px.as_flattened().iter().chain([&self.roll]);
        (0.0..0.1).contains(&self.perspective)
            && (-0.3..=0.3).contains(&self.distortion)
            && others.into_iter().all(|v| v.is_finite())
    }
}

/// How the white standard was shot: `E_normal = pi L_white / (reflectance_factor cos(theta_light))`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WhiteReference {
    /// The reference geometry; its id is not one of the plan's.
    pub configuration: Configuration,
    /// The standard's reflectance factor at that geometry, r, g, b (1 = perfect diffuser).
    pub reflectance_factor: [f64; 3],
    /// Its standard error, r, g, b.
    pub reflectance_factor_se: [f64; 3],
}

/// What a session is: written once, before the first frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Always `goniofit-session-1`.
    pub format: String,
    /// Program version that wrote it.
    pub program: String,
    /// UTC start time, RFC 3339.
    pub started_utc: String,
    /// Free text by the operator.
    pub note: String,
    /// True when no camera saw any cloth: frames come from a virtual camera. Every page and table repeats it.
    pub synthetic: bool,
    /// Name of the rig description (a copy is in `rig.toml`).
    pub rig: String,
    /// The camera.
    pub camera: CameraFacts,
    /// The white standard.
    pub white: WhiteReference,
    /// Side of the measured square on the sample, centered, millimeters.
    pub sample_square_mm: f64,
    /// Exposure times of the bracket, milliseconds, ascending.
    pub exposures_ms: Vec<f64>,
    /// Where the session comes from.
    #[serde(default)]
    pub provenance: Provenance,
}

/// What a later reader needs to know to trust or repeat a session; empty where nobody knew.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Provenance {
    /// SHA-256 of the texts of `rig.toml` and `plan.toml`, hexadecimal.
    pub config_sha256: String,
    /// SHA-256 of the program file, hexadecimal.
    pub program_sha256: String,
    /// All that each controller said of its version and settings, by board.
    pub firmware: std::collections::BTreeMap<String, Vec<String>>,
    /// The camera's serial number, as it says itself.
    pub camera_serial: String,
    /// Name of the computer.
    pub host: String,
}

impl Manifest {
    /// The value of [`Manifest::format`].
    pub const FORMAT: &'static str = "goniofit-session-1";
}

/// A session on disk.
#[derive(Debug, Clone)]
pub struct SessionFolder {
    root: PathBuf,
}

impl SessionFolder {
    /// Lays out a new session: folder, manifest, plan, rig description; returns it with its empty journal.
    ///
    /// # Errors
    /// When the folder already holds a session (nothing is overwritten), or the disk refuses.
    pub fn create(
        root: &Path,
        manifest: &Manifest,
        plan: &Plan,
        rig_toml: &str,
    ) -> Result<(Self, Journal)> {
        Self::refuse_existing(root)?;
        std::fs::create_dir_all(root.join("frames"))
            .context(|| format!("{} cannot be created", root.display()))?;
        let session = Self {
            root: root.to_owned(),
        };
        files::write_atomic(&root.join("plan.toml"), plan.to_toml()?.as_bytes())?;
        files::write_atomic(&root.join("rig.toml"), rig_toml.as_bytes())?;
        // Left by a start that was cut short before there was a session.
        let leftover = session.journal_path();
        if std::fs::metadata(&leftover).is_ok_and(|m| m.len() == 0) {
            std::fs::remove_file(&leftover)
                .context(|| format!("{} cannot be replaced", leftover.display()))?;
        }
        let journal = Journal::create(&session.journal_path())?;
        let text = serde_json::to_string_pretty(manifest)
            .context(|| "session manifest cannot be written")?;
        files::write_atomic(&root.join("session.json"), (text + "\n").as_bytes())?;
        Ok((session, journal))
    }

    /// Passes where a new session may be laid out.
    ///
    /// # Errors
    /// The folder holds a session already, finished or not.
    pub fn refuse_existing(root: &Path) -> Result<()> {
        if !root.join("session.json").exists() {
            return Ok(());
        }
        Err(Error::new(format!("{} already holds a session", root.display())).with_hint(
            "a session is never overwritten: go on with it (`goniofit capture --resume DIR`) or choose another folder",
        ))
    }

    /// Opens an interrupted session for more frames; also what its journal holds. Files in `frames/` that the journal
    /// does not know (a shot was cut short) are moved to `frames/unjournaled/`; nothing is deleted but half-written
    /// temporary files.
    ///
    /// # Errors
    /// It is no session, another process writes it, its journal is damaged, or a journaled frame is missing.
    pub fn resume(root: &Path) -> Result<(Self, Journal, Vec<Entry>)> {
        let session = Self::open(root)?;
        let (journal, entries) = Journal::reopen(&session.journal_path())?;
        let mut known = std::collections::BTreeSet::new();
        for entry in &entries {
            if let Event::Frame(record) = &entry.event {
                let path = session.frame_path(&record.file);
                if !std::fs::metadata(&path).is_ok_and(|m| m.len() > 0) {
                    return Err(Error::new(format!(
                        "{} is missing, but the journal has it",
                        path.display()
                    ))
                    .with_hint(
                        "restore the file from a copy, or capture again into a new folder",
                    ));
                }
                known.insert(record.file.clone());
            }
        }
        session.set_aside(&known)?;
        Ok((session, journal, entries))
    }

    fn set_aside(&self, known: &std::collections::BTreeSet<String>) -> Result<()> {
        let frames = self.root.join("frames");
        let what = || format!("{} cannot be tidied", frames.display());
        std::fs::create_dir_all(&frames).context(what)?;
        for file in std::fs::read_dir(&frames).context(what)? {
            let file = file.context(what)?;
            let name = file.file_name().to_string_lossy().into_owned();
            if known.contains(&name) || file.file_type().context(what)?.is_dir() {
                continue;
            }
            if files::is_temporary(&name) {
                std::fs::remove_file(file.path()).context(what)?;
                continue;
            }
            let aside = frames.join("unjournaled");
            std::fs::create_dir_all(&aside).context(what)?;
            let place = (0..)
                .map(|n| aside.join(format!("{n}_{name}")))
                .find(|p| !p.exists())
                .unwrap_or_else(|| aside.join(&name));
            std::fs::rename(file.path(), place).context(what)?;
        }
        Ok(())
    }

    /// Opens an existing session.
    ///
    /// # Errors
    /// When there is no manifest.
    pub fn open(root: &Path) -> Result<Self> {
        if !root.join("session.json").is_file() {
            return Err(Error::new(format!("{} holds no session", root.display()))
                .with_hint("a session folder has a session.json; make one with `goniofit capture` or `goniofit simulate`"));
        }
        Ok(Self {
            root: root.to_owned(),
        })
    }

    /// The folder.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Where a frame's file lies.
    pub fn frame_path(&self, file: &str) -> PathBuf {
        self.root.join("frames").join(file)
    }

    /// Where the journal lies.
    pub fn journal_path(&self) -> PathBuf {
        self.root.join("journal.jsonl")
    }

    /// Reads and checks the manifest.
    ///
    /// # Errors
    /// When it cannot be read, is of another format, or a number in it has no meaning.
    pub fn manifest(&self) -> Result<Manifest> {
        let path = self.root.join("session.json");
        let manifest: Manifest = serde_json::from_str(&files::read_text(&path)?)
            .context(|| format!("{} is damaged", path.display()))?;
        let bad = |what: &str| Err(Error::new(format!("{}: {what}", path.display())));
        if manifest.format != Manifest::FORMAT {
            return bad(&format!(
                "format '{}' where '{}' was expected",
                manifest.format,
                Manifest::FORMAT
            ));
        }
        if !(manifest.camera.pixel_mm > 0.0 && manifest.camera.pixel_mm.is_finite()) {
            return bad("camera.pixel_mm must be positive");
        }
        if !manifest.camera.lens.is_sound() {
            return bad(
                "camera.lens needs finite numbers, perspective in 0..0.1 and distortion in -0.3..0.3",
            );
        }
        if !(manifest.sample_square_mm > 0.0 && manifest.sample_square_mm.is_finite()) {
            return bad("sample_square_mm must be positive");
        }
        if !manifest
            .white
            .reflectance_factor
            .iter()
            .all(|f| (0.01..=2.0).contains(f))
        {
            return bad("white.reflectance_factor must lie in 0.01..2");
        }
        Ok(manifest)
    }

    /// Reads the plan.
    ///
    /// # Errors
    /// As [`Plan::read`].
    pub fn plan(&self) -> Result<Plan> {
        Plan::read(&self.root.join("plan.toml"))
    }

    /// The records of all finished shots, in order.
    ///
    /// # Errors
    /// As [`super::read_journal`].
    pub fn frames(&self) -> Result<Vec<FrameRecord>> {
        let entries = journal::read_journal(&self.journal_path())?;
        Ok(entries
            .into_iter()
            .filter_map(|e| match e.event {
                Event::Frame(record) => Some(record),
                _ => None,
            })
            .collect())
    }

    /// Stores a frame's bytes and journals it; returns the record with `sha256` filled in.
    ///
    /// # Errors
    /// When a file of that name exists, or the disk refuses; the shot then does not count.
    pub fn add_frame(
        &self,
        journal: &mut Journal,
        elapsed_s: f64,
        mut record: FrameRecord,
        bytes: &[u8],
    ) -> Result<FrameRecord> {
        record.sha256 = files::sha256(bytes);
        files::write_new(&self.frame_path(&record.file), bytes)?;
        journal.append(elapsed_s, Event::Frame(record.clone()))?;
        Ok(record)
    }
}

impl FrameRecord {
    /// The standard file name: running number, kind, configuration, exposure.
    pub fn standard_name(
        number: usize,
        kind: FrameKind,
        config: Option<u32>,
        exposure_ms: f64,
        extension: &str,
    ) -> String {
        let kind = kind.name();
        let config = config.map(|c| format!("_c{c:02}")).unwrap_or_default();
        format!("{number:04}_{kind}{config}_{exposure_ms}ms.{extension}")
    }
}
