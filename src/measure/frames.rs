//! The frames of a session, each checked against the journal before anything is read off it.

use super::{RawFrame, decode};
use crate::base::{Context, Error, Result, Watch};
use crate::session::{
    CfaPattern, Coverage, Entry, Event, FrameKind, FrameRecord, Manifest, SessionFolder,
};
use sha2::Digest;
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
    format!("frame {} ({place}, {} ms)", record.file, record.exposure_ms)
}

/// What must not change within a session.
#[derive(PartialEq)]
struct Camera {
    make: String,
    model: String,
    iso: Option<u32>,
    cfa: CfaPattern,
    white: u16,
}

/// Reads frames, and counts them.
pub(super) struct Loader<'a> {
    session: &'a SessionFolder,
    manifest: &'a Manifest,
    watch: &'a dyn Watch,
    total: u64,
    done: AtomicU64,
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
                )));
            }
        }
        Ok(Self {
            session,
            manifest,
            watch,
            total: frames.len() as u64,
            done: AtomicU64::new(0),
            camera: OnceLock::new(),
        })
    }

    /// Reads one frame: hash, size, exposure and camera must be as stated.
    pub(super) fn load(&self, record: &FrameRecord) -> Result<RawFrame> {
        if self.watch.cancelled() {
            return Err(Error::new("measuring was interrupted"));
        }
        let bytes = std::fs::read(self.session.frame_path(&record.file))
            .context(|| format!("{} cannot be read", title(record)))?;
        let hash = sha2::Sha256::digest(&bytes);
        let hash: String = hash.iter().map(|b| format!("{b:02x}")).collect();
        if hash != record.sha256 {
            return Err(Error::new(format!(
                "{} is not the file that was captured: its SHA-256 is {hash}, the journal has {}",
                title(record),
                record.sha256
            ))
            .with_hint("the file was changed or torn; restore it from a copy"));
        }
        let frame = decode(&bytes).context(|| format!("{} cannot be decoded", title(record)))?;
        self.check(record, &frame)?;
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
        // Cameras round nominal times (1/60 s for 1/64 s), so only gross differences are faults.
        if let Some(ms) = frame.exposure_ms
            && !(0.85..1.18).contains(&(ms / record.exposure_ms))
        {
            return Err(Error::new(format!(
                "{} says by EXIF that it was exposed {ms} ms",
                title(record)
            ))
            .with_hint("journal and file do not belong together, or the camera was on automatic"));
        }
        let camera = Camera {
            make: frame.make.clone(),
            model: frame.model.clone(),
            iso: frame.iso,
            cfa: frame.cfa(),
            white: frame.white,
        };
        let Some((first, name)) = self.camera.get() else {
            // The first frame is read before any thread starts.
            let _ = self.camera.set((camera, title(record)));
            return Ok(());
        };
        if *first == camera {
            return Ok(());
        }
        let iso = |i: Option<u32>| i.map_or("unknown".to_owned(), |i| i.to_string());
        Err(Error::new(format!(
            "{} was taken with {} {}, ISO {}, pattern {}, white level {}; {name} with {} {}, ISO {}, pattern {}, white level {}",
            title(record),
            camera.make,
            camera.model,
            iso(camera.iso),
            camera.cfa,
            camera.white,
            first.make,
            first.model,
            iso(first.iso),
            first.cfa,
            first.white
        ))
        .with_hint("all frames of a session must come from one camera at one sensitivity"))
    }
}

/// One pixel of a region.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pixel {
    pub(super) x: usize,
    pub(super) y: usize,
    /// Area it stands for, pixels.
    pub(super) weight: f64,
    /// 0 red, 1 green, 2 blue.
    pub(super) channel: usize,
    /// Place in the 2x2 block.
    pub(super) place: usize,
}

/// The pixels something is measured on; hot pixels are left out.
pub(super) struct Region {
    pub(super) pixels: Vec<Pixel>,
    /// Variance of (channel mean - area mean) per unit of pixel variance of texture that is uncorrelated from pixel to
    /// pixel, because a channel sees only its own pixels.
    pub(super) sampling: [f64; 3],
    width: usize,
}

impl Region {
    /// All pixels of a box (left, top, right, bottom; one past the end), one weight for all.
    pub(super) fn whole_box(
        bounds: [usize; 4],
        width: usize,
        cfa: CfaPattern,
        hot: &[bool],
    ) -> Self {
        let [left, top, right, bottom] = bounds;
        let places = (top..bottom).flat_map(|y| (left..right).map(move |x| (x, y)));
        let pixels = places
            .filter(|&(x, y)| !hot[y * width + x])
            .map(|(x, y)| pixel(cfa, x, y, 1.0))
            .collect();
        Self {
            pixels,
            sampling: [0.0; 3],
            width,
        }
    }

    /// The pixels that carry a projected square. A channel's pixel stands for its own covered area and, at the places of
    /// other channels around it, for its share in linear interpolation; so a channel mean is exact for every radiance
    /// that is linear across the square, however few rows a grazing view leaves of it.
    pub(super) fn covered(
        coverage: &Coverage,
        [width, height]: [usize; 2],
        cfa: CfaPattern,
        hot: &[bool],
    ) -> Self {
        let [left, top, right, bottom] = coverage.bounds();
        let (x0, y0) = (left.saturating_sub(1), top.saturating_sub(1));
        let (x1, y1) = ((right + 1).min(width), (bottom + 1).min(height));
        let columns = x1 - x0;
        let mut weights = vec![[0.0; 3]; columns * (y1 - y0)];
        for (x, y, weight) in coverage.pixels() {
            for channel in [0, 1, 2] {
                let around = interpolation(cfa, channel, x, y)
                    .filter(|&(x, y)| (x0..x1).contains(&x) && (y0..y1).contains(&y))
                    .filter(|&(x, y)| !hot[y * width + x]);
                let around: Vec<_> = around.collect();
                for &(x, y) in &around {
                    let share = weight / around.len() as f64;
                    weights[(y - y0) * columns + x - x0][channel] += share;
                }
            }
        }
        let total = [0, 1, 2].map(|c| weights.iter().map(|w| w[c]).sum::<f64>());
        let area = coverage.area();
        // sum_p (W_p / sum W - w_p / sum w)^2 over all pixels, from sum W^2, sum W w and sum w^2.
        let mut sampling =
            [coverage.pixels().map(|(_, _, w)| w * w).sum::<f64>() / (area * area); 3];
        for (x, y, w) in coverage.pixels() {
            let own = weights[(y - y0) * columns + x - x0];
            for channel in 0..3 {
                sampling[channel] -= 2.0 * own[channel] * w / (total[channel] * area);
            }
        }
        let mut pixels = Vec::new();
        for (i, own) in weights.iter().enumerate() {
            for (channel, &weight) in own.iter().enumerate().filter(|(_, w)| **w > 0.0) {
                sampling[channel] += (weight / total[channel]).powi(2);
                pixels.push(pixel(cfa, x0 + i % columns, y0 + i / columns, weight));
            }
        }
        Self {
            pixels,
            sampling,
            width,
        }
    }

    pub(super) fn indices(&self) -> impl Iterator<Item = usize> + '_ {
        self.pixels.iter().map(|p| p.y * self.width + p.x)
    }
}

fn pixel(cfa: CfaPattern, x: usize, y: usize, weight: f64) -> Pixel {
    Pixel {
        x,
        y,
        weight,
        channel: cfa.channel(y, x),
        place: CfaPattern::position(y, x),
    }
}

/// The pixels of a channel whose plain mean is its linear interpolation at (x, y): the pixel itself, or its nearest
/// neighbors of that channel (two or four). Places beyond the left and top edge are left out.
fn interpolation(
    cfa: CfaPattern,
    channel: usize,
    x: usize,
    y: usize,
) -> impl Iterator<Item = (usize, usize)> {
    let has = |dx: usize, dy: usize| cfa.channel(y + dy, x + dx) == channel;
    let offsets: &[(isize, isize)] = if has(0, 0) {
        &[(0, 0)]
    } else if has(1, 0) && has(0, 1) {
        &[(-1, 0), (1, 0), (0, -1), (0, 1)]
    } else if has(1, 0) {
        &[(-1, 0), (1, 0)]
    } else if has(0, 1) {
        &[(0, -1), (0, 1)]
    } else {
        &[(-1, -1), (1, -1), (-1, 1), (1, 1)]
    };
    offsets
        .iter()
        .filter_map(move |&(dx, dy)| x.checked_add_signed(dx).zip(y.checked_add_signed(dy)))
}
