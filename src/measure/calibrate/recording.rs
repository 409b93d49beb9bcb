//! A recorded session as calibrating sees it: its frames by kind, read one after another.

use crate::base::{Context, Error, Result, Watch};
use crate::measure::RawFrame;
use crate::measure::calibration::{Header, Kind, Source};
use crate::measure::frames::{Loader, Taken, taken};
use crate::session::{FrameKind, Layout, Manifest, SessionFolder, read_journal, sha256};

/// A session: what it is, and its journaled frames.
pub(super) struct Recording<'a> {
    session: &'a SessionFolder,
    pub(super) manifest: Manifest,
    pub(super) frames: Vec<Taken>,
    journal_sha256: String,
}

impl<'a> Recording<'a> {
    pub(super) fn open(session: &'a SessionFolder) -> Result<Self> {
        let path = session.journal_path();
        let bytes = std::fs::read(&path)
            .context(|| format!("journal {} cannot be read", path.display()))?;
        Ok(Self {
            session,
            manifest: session.manifest()?,
            frames: taken(read_journal(&path)?),
            journal_sha256: sha256(&bytes),
        })
    }

    /// The frames of a kind, shortest exposure first, in the order shot for one exposure.
    pub(super) fn of(&self, kind: FrameKind) -> Vec<Taken> {
        let of_kind = self.frames.iter().filter(|f| f.record.kind == kind);
        let mut frames: Vec<Taken> = of_kind.cloned().collect();
        frames.sort_by(|a, b| a.record.exposure_ms.total_cmp(&b.record.exposure_ms));
        frames
    }

    /// The frames of a kind that a calibration cannot do without; `how` says how to shoot them.
    pub(super) fn need(&self, kind: FrameKind, how: &str) -> Result<Vec<Taken>> {
        let frames = self.of(kind);
        if frames.is_empty() {
            return Err(Error::new(format!(
                "session {} has no {} frames",
                self.session.root().display(),
                kind.name()
            ))
            .with_hint(how));
        }
        Ok(frames)
    }

    /// Starts reading these frames (each as often as it is listed); the first is read at once, to learn what it is like.
    pub(super) fn reader(
        &'a self,
        frames: &[Taken],
        watch: &'a dyn Watch,
    ) -> Result<(Reader<'a>, RawFrame)> {
        let Some(first) = frames.first() else {
            return Err(Error::new("no frames to read"));
        };
        let mut listed = vec![first.clone()];
        listed.extend_from_slice(frames);
        let loader = Loader::new(self.session, &self.manifest, &listed, watch)?;
        let frame = loader.load(&first.record)?;
        let reader = Reader {
            loader,
            layout: frame.layout,
            white: f64::from(frame.white),
            size: [frame.width, frame.height],
        };
        Ok((reader, frame))
    }

    pub(super) fn header(&self, kind: Kind) -> Header {
        let root = self.session.root();
        let name = root.canonicalize().unwrap_or_else(|_| root.to_owned());
        let name = name.file_name().unwrap_or(name.as_os_str());
        Header {
            format: Header::FORMAT.to_owned(),
            kind,
            rig: self.manifest.rig.clone(),
            camera: self.manifest.camera.name.clone(),
            size_px: [self.manifest.camera.width, self.manifest.camera.height],
            date_utc: self.manifest.started_utc.clone(),
            sessions: vec![Source {
                session: name.to_string_lossy().into_owned(),
                journal_sha256: self.journal_sha256.clone(),
            }],
            synthetic: self.manifest.synthetic,
            program: env!("CARGO_PKG_VERSION").to_owned(),
        }
    }
}

/// Reads frames of one camera, each checked against the journal.
pub(super) struct Reader<'a> {
    loader: Loader<'a>,
    pub(super) layout: Layout,
    /// Raw value at which pixels saturate.
    pub(super) white: f64,
    /// Pixels per row, rows.
    pub(super) size: [usize; 2],
}

impl Reader<'_> {
    pub(super) fn load(&self, frame: &Taken) -> Result<RawFrame> {
        let read = self.loader.load(&frame.record)?;
        if read.layout != self.layout {
            return Err(Error::new(format!(
                "frame {} is {}, the others are {}",
                frame.record.file, read.layout, self.layout
            ))
            .with_hint("all frames of a session must come from one camera"));
        }
        Ok(read)
    }

    /// Values in a frame.
    pub(super) fn values(&self) -> usize {
        self.size[0] * self.size[1] * self.layout.values_per_pixel()
    }

    /// Which place of the layout a value belongs to.
    pub(super) fn place(&self, index: usize) -> usize {
        self.layout.place(self.size[0], index)
    }
}
