//! A camera that hands out the frames of an existing session.

use crate::base::{Context, Error, Result};
use crate::rig::{Camera, CapturedFrame, Shot};
use crate::session::{CameraFacts, FrameRecord, SessionFolder, sha256};
use std::path::Path;

/// Plays back the frames of a session, each at most once, by kind, configuration, exposure and repeat.
#[derive(Debug)]
pub struct ReplayCamera {
    session: SessionFolder,
    facts: CameraFacts,
    synthetic: bool,
    frames: Vec<(FrameRecord, bool)>,
}

impl ReplayCamera {
    /// Opens the session folder whose frames shall be handed out.
    ///
    /// # Errors
    /// It is no session, or its manifest or journal is damaged.
    pub fn open(folder: &Path) -> Result<Self> {
        let session = SessionFolder::open(folder)?;
        let manifest = session.manifest()?;
        let frames = session.frames()?.into_iter().map(|f| (f, false)).collect();
        Ok(Self {
            facts: manifest.camera,
            synthetic: manifest.synthetic,
            session,
            frames,
        })
    }

    /// True when the frames came from a virtual camera.
    pub fn is_synthetic(&self) -> bool {
        self.synthetic
    }

    /// Files of the session that were not asked for.
    pub fn unused(&self) -> Vec<&str> {
        let unused = self.frames.iter().filter(|f| !f.1);
        unused.map(|(record, _)| record.file.as_str()).collect()
    }
}

impl Camera for ReplayCamera {
    fn facts(&self) -> CameraFacts {
        self.facts.clone()
    }

    fn expose(&mut self, shot: &Shot) -> Result<CapturedFrame> {
        let found = self.frames.iter_mut().find(|(f, used)| {
            !used
                && f.kind == shot.kind
                && f.config == shot.config
                && f.repeat == shot.repeat
                && f.visit == shot.visit
                && (f.asked_ms() - shot.exposure_ms).abs() <= 1e-6 * shot.exposure_ms
        });
        let (record, used) = found.ok_or_else(|| {
            Error::new(format!(
                "the recorded session {} has no (further) {} frame{}, exposure {} ms, repeat {}",
                self.session.root().display(),
                shot.kind.name(),
                shot.config
                    .map_or(String::new(), |c| format!(" of configuration {c}")),
                shot.exposure_ms,
                shot.repeat
            ))
            .with_hint("replay needs the plan, exposures and repeats of the recording")
        })?;
        let path = self.session.frame_path(&record.file);
        let bytes =
            std::fs::read(&path).context(|| format!("{} cannot be read", path.display()))?;
        let hash = sha256(&bytes);
        if hash != record.sha256 {
            return Err(Error::new(format!(
                "{} is damaged: its SHA-256 is {hash}, the journal says {}",
                path.display(),
                record.sha256
            ))
            .with_hint("restore the file from a copy"));
        }
        *used = true;
        let extension = path.extension().map(|e| e.to_string_lossy().into_owned());
        Ok(CapturedFrame {
            bytes,
            extension: extension.unwrap_or_default(),
            exposure_ms: record.exposure_ms,
        })
    }
}
