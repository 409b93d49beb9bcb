//! The frames of a session, each checked against the journal before anything is read off it.

use super::{RawFrame, Unviewed, Viewer, decode};
use crate::base::{Context, Error, Result, Watch};
use crate::session::{
    Entry, Event, FrameKind, FrameRecord, Layout, Manifest, SessionFolder, sha256,
};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

/// True when two exposure times are the same setting (they are read back from the camera: to 0.1 %).
pub(super) fn same_exposure(a: f64, b: f64) -> bool {
    (a / b - 1.0).abs() < 1e-3
}

/// When a frame was shot. Times compare within a stretch only: between stretches the lamp was switched off and on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Moment {
    /// 0 for the first stretch of work, 1 after the first interruption, ...
    pub(super) stretch: usize,
    pub(super) elapsed_s: f64,
}

/// A journaled frame and when it was shot.
#[derive(Debug, Clone)]
pub(super) struct Taken {
    pub(super) record: FrameRecord,
    pub(super) moment: Moment,
}

/// The frames of a journal, in its order, each with when it was shot.
pub(super) fn taken(journal: Vec<Entry>) -> Vec<Taken> {
    let mut ready = 0_usize;
    let mut frames = Vec::new();
    for entry in journal {
        match entry.event {
            Event::Ready { .. } => ready += 1,
            Event::Frame(record) => frames.push(Taken {
                record,
                moment: Moment {
                    stretch: ready.saturating_sub(1),
                    elapsed_s: entry.elapsed_s,
                },
            }),
            _ => {}
        }
    }
    frames
}

/// How messages call a frame.
pub(super) fn title(record: &FrameRecord) -> String {
    let place = match (record.kind, record.config) {
        (FrameKind::Sample, Some(id)) => format!("configuration {id}"),
        (FrameKind::Sample, None) => "no configuration".to_owned(),
        (FrameKind::Reference, _) => format!("reference, visit {}", record.visit),
        (kind, _) => kind.name().to_owned(),
    };
    let filter = record
        .filter
        .map_or(String::new(), |f| format!(", filter {}", f.name()));
    format!(
        "frame {} ({place}{filter}, {} ms)",
        record.file, record.exposure_ms
    )
}

/// What must not change within a session.
#[derive(Clone, PartialEq)]
struct Camera {
    make: String,
    model: String,
    iso: Option<u32>,
    aperture: Option<f64>,
    layout: Layout,
    white: u16,
}

impl std::fmt::Display for Camera {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let iso = self.iso.map_or("unknown".to_owned(), |i| i.to_string());
        let aperture = self
            .aperture
            .map_or(String::new(), |a| format!(", aperture f/{a}"));
        write!(
            f,
            "{} {}, ISO {iso}{aperture}, pattern {}, white level {}",
            self.make, self.model, self.layout, self.white
        )
    }
}

/// Reads frames, and counts them.
pub(super) struct Loader<'a> {
    session: &'a SessionFolder,
    manifest: &'a Manifest,
    watch: &'a dyn Watch,
    viewer: &'a dyn Viewer,
    total: u64,
    done: AtomicU64,
    without_exif: AtomicU64,
    camera: OnceLock<(Camera, String)>,
}

impl<'a> Loader<'a> {
    /// Checks that every journaled frame is there.
    pub(super) fn new(
        session: &'a SessionFolder,
        manifest: &'a Manifest,
        frames: &[Taken],
        watch: &'a dyn Watch,
    ) -> Result<Self> {
        for record in frames.iter().map(|f| &f.record) {
            if !session.frame_path(&record.file).is_file() {
                return Err(Error::new(format!(
                    "{} is missing: {} is not there",
                    title(record),
                    session.frame_path(&record.file).display()
                ))
                .with_hint("restore the file from a copy, or capture again into a new folder"));
            }
            if !(1e-6..1e9).contains(&record.exposure_ms) {
                return Err(Error::new(format!(
                    "{}: the journal states an exposure of {} ms",
                    title(record),
                    record.exposure_ms
                ))
                .with_hint("restore journal.jsonl from a copy, or capture this frame again"));
            }
        }
        Ok(Self {
            session,
            manifest,
            watch,
            viewer: &Unviewed,
            total: frames.len() as u64,
            done: AtomicU64::new(0),
            without_exif: AtomicU64::new(0),
            camera: OnceLock::new(),
        })
    }

    /// Shows every frame that is read to `viewer`.
    pub(super) fn viewed_by(mut self, viewer: &'a dyn Viewer) -> Self {
        self.viewer = viewer;
        self
    }

    /// Which channels the camera's pixels have; reads one frame if none was read yet.
    pub(super) fn layout(&self, frames: &[Taken]) -> Result<Layout> {
        if self.camera.get().is_none()
            && let Some(first) = frames.first()
        {
            self.load(&first.record)?;
            // It is read again.
            self.done.store(0, Ordering::Relaxed);
            self.without_exif.store(0, Ordering::Relaxed);
        }
        let layout = self.camera.get().map(|(camera, _)| camera.layout);
        layout.ok_or_else(|| Error::new("the session has no frames"))
    }

    /// How many frames did not say how long they were exposed.
    pub(super) fn without_exif(&self) -> u64 {
        self.without_exif.load(Ordering::Relaxed)
    }

    /// Reads one frame: hash, size, exposure and camera must be as stated.
    pub(super) fn load(&self, record: &FrameRecord) -> Result<RawFrame> {
        if self.watch.cancelled() {
            return Err(Error::new("measuring was interrupted"));
        }
        let bytes = std::fs::read(self.session.frame_path(&record.file))
            .context(|| format!("{} cannot be read", title(record)))
            .map_err(|e| e.with_hint("check the disk and the file's permissions"))?;
        let hash = sha256(&bytes);
        if hash != record.sha256 {
            return Err(Error::new(format!(
                "{} is not the file that was captured: its SHA-256 is {hash}, the journal has {}",
                title(record),
                record.sha256
            ))
            .with_hint("the file was changed or torn; restore it from a copy"));
        }
        let frame = decode(&bytes)
            .context(|| format!("{} cannot be decoded", title(record)))
            .map_err(|e| {
                e.with_hint("the file is as it was captured: take this frame again, or restore it from a copy")
            })?;
        self.check(record, &frame)?;
        self.viewer.frame(record, &frame)?;
        let done = self.done.fetch_add(1, Ordering::Relaxed) + 1;
        self.watch.progress("measuring frames", done, self.total);
        Ok(frame)
    }

    fn check(&self, record: &FrameRecord, frame: &RawFrame) -> Result<()> {
        let facts = &self.manifest.camera;
        if (frame.width, frame.height) != (facts.width, facts.height) {
            return Err(Error::new(format!(
                "{} has {} x {} pixels, the session's camera has {} x {}",
                title(record),
                frame.width,
                frame.height,
                facts.width,
                facts.height
            ))
            .with_hint("the camera's image size was changed during the session"));
        }
        match frame.exposure_ms {
            // Cameras round nominal times (1/60 s for 1/64 s), so only gross differences are faults.
            Some(ms) if !(0.85..1.18).contains(&(ms / record.exposure_ms)) => {
                return Err(Error::new(format!(
                    "{} says by EXIF that it was exposed {ms} ms",
                    title(record)
                ))
                .with_hint(
                    "journal and file do not belong together, or the camera was on automatic",
                ));
            }
            Some(_) => {}
            None => {
                self.without_exif.fetch_add(1, Ordering::Relaxed);
            }
        }
        let camera = Camera {
            make: frame.make.clone(),
            model: frame.model.clone(),
            iso: frame.iso,
            aperture: frame.aperture,
            layout: frame.layout,
            white: frame.white,
        };
        let title_here = title(record);
        let (first, name) = self
            .camera
            .get_or_init(|| (camera.clone(), title_here.clone()));
        if *first == camera {
            return Ok(());
        }
        Err(Error::new(format!(
            "{title_here} was taken with {camera}; {name} with {first}"
        ))
        .with_hint(
            "all frames of a session must come from one camera at one sensitivity and aperture: take this frame again, or measure without it",
        ))
    }
}
