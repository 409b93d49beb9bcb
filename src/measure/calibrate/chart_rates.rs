//! What the patches of a color chart read: linear rates by channel.

use super::chart::Chart;
use super::darks::{Darks, wanted};
use super::patch::{NAMES, Patch};
use super::recording::Recording;
use crate::base::{Context, Error, Result, Watch};
use crate::measure::RawFrame;
use crate::measure::calibration::{Calibrations, FlatField};
use crate::measure::frames::Taken;
use crate::measure::linear::Curve;
use crate::session::{CameraFacts, Configuration, Coverage, Projection};

/// A channel's mean over a patch and its standard error.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Mean {
    pub(super) value: f64,
    pub(super) se: f64,
}

/// Linear raw values per millisecond of every patch.
pub(super) struct Rates {
    pub(super) patches: Vec<[Mean; 3]>,
}

/// Which patch a pixel belongs to.
const NONE: u16 = u16::MAX;

impl Rates {
    pub(super) fn read(
        recording: &Recording<'_>,
        known: &Calibrations,
        chart: &Chart,
        pose: &Configuration,
        frames: &[Taken],
        watch: &dyn Watch,
    ) -> Result<Self> {
        let camera = camera(&recording.manifest.camera, known);
        let projection = Projection::new(&camera, pose);
        let mut owners = vec![NONE; camera.width * camera.height];
        let mut all = Coverage { rows: Vec::new() };
        for (k, patch) in (0..).zip(&chart.patches) {
            let coverage = projection.coverage_of(&patch.corners());
            let coverage = coverage.context(|| format!("patch {}", patch.name))?;
            for (x, y, w) in coverage.pixels() {
                // Pixels on the edge are not the patch's alone.
                if w > 1.0 - 1e-9 {
                    owners[y * camera.width + x] = k;
                }
            }
            all.rows.extend(coverage.rows);
        }
        let dark_frames = wanted(recording, frames);
        let list = [&dark_frames[..], frames].concat();
        let (reader, _) = recording.reader(&list, watch)?;
        let mut pixels = Patch::covered(&reader, &all);
        let darks = Darks::read(&reader, &dark_frames, &mut pixels, frames, known)?;
        let linearity = known.linearity.as_ref().map(|d| &d.value);
        let sums = Summing {
            pixels: &pixels,
            owners: &owners,
            curve: Curve::known(linearity, darks.bias),
            response: known.flat.as_ref().map(|d| &d.value),
            limit: super::USABLE_FRACTION * reader.white,
            values_per_pixel: reader.layout.values_per_pixel(),
        };
        let mut found = vec![[Sum::default(); 3]; chart.patches.len()];
        for taken in frames {
            let frame = reader.load(taken)?;
            let dark = &darks.find(taken)?.mean;
            let own = sums.of(&frame, dark, taken, chart.patches.len());
            for (sum, new) in found.iter_mut().flatten().zip(own.iter().flatten()) {
                sum.add(new, taken.record.exposure_ms);
            }
        }
        let mut patches = Vec::new();
        for (patch, sums) in chart.patches.iter().zip(&found) {
            let mut means = [Mean::default(); 3];
            for c in 0..3 {
                means[c] = sums[c].mean().ok_or_else(|| {
                    Error::new(format!(
                        "patch {}: {} has fewer than two pixels, or is clipped in every frame",
                        patch.name, NAMES[c]
                    ))
                    .with_hint("shoot a shorter exposure too, and check the patch's place and size in the chart's file")
                })?;
            }
            patches.push(means);
        }
        Ok(Self { patches })
    }
}

/// The session's camera with what is known of its geometry.
fn camera(stated: &CameraFacts, known: &Calibrations) -> CameraFacts {
    let mut camera = stated.clone();
    if let Some(found) = &known.geometry {
        camera.pixel_mm = found.value.pixel_mm;
        camera.center_px = found.value.center_px;
        camera.lens = found.value.lens;
    }
    camera
}

/// How the values of a frame are summed up by patch.
struct Summing<'a> {
    pixels: &'a Patch,
    owners: &'a [u16],
    curve: Curve,
    response: Option<&'a FlatField>,
    limit: f64,
    values_per_pixel: usize,
}

/// One channel of a patch in one frame: how many values, their sum, their squares' sum, and how many are clipped.
#[derive(Debug, Clone, Copy, Default)]
struct Single {
    n: f64,
    sum: f64,
    squares: f64,
    clipped: usize,
}

impl Summing<'_> {
    fn of(
        &self,
        frame: &RawFrame,
        dark: &[f32],
        taken: &Taken,
        patches: usize,
    ) -> Vec<[Single; 3]> {
        let mut sums = vec![[Single::default(); 3]; patches];
        for (k, spot) in self
            .pixels
            .spots()
            .enumerate()
            .filter(|(_, s)| s.weight > 0.0)
        {
            let owner = self.owners[spot.index / self.values_per_pixel];
            if owner == NONE {
                continue;
            }
            let raw = f64::from(frame.data[spot.index]);
            let bias = self.curve.bias[spot.place];
            let light = self.curve.at(raw - bias) - self.curve.at(f64::from(dark[k]) - bias);
            let response = self
                .response
                .map_or(1.0, |f| f64::from(f.response[spot.index]));
            let value = light / response;
            for c in self.pixels.channels(taken.record.filter, spot.place) {
                let sum = &mut sums[usize::from(owner)][c];
                sum.n += 1.0;
                sum.sum += value;
                sum.squares += value * value;
                let bright = raw >= self.limit || raw - bias > self.curve.brightest;
                sum.clipped += usize::from(bright);
            }
        }
        sums
    }
}

/// One channel of a patch over all frames that are not clipped there.
#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    exposed_ms: f64,
    signal: f64,
    variance: f64,
}

impl Sum {
    fn add(&mut self, frame: &Single, exposure_ms: f64) {
        if frame.n < 2.0 || frame.clipped > 0 {
            return;
        }
        let mean = frame.sum / frame.n;
        let scatter = (frame.squares - frame.sum * mean) / (frame.n - 1.0);
        self.exposed_ms += exposure_ms;
        self.signal += mean;
        self.variance += scatter / frame.n;
    }

    fn mean(&self) -> Option<Mean> {
        (self.exposed_ms > 0.0).then(|| Mean {
            value: self.signal / self.exposed_ms,
            se: self.variance.sqrt() / self.exposed_ms,
        })
    }
}
