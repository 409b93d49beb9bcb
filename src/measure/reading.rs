//! One configuration's frames, read and merged, but not yet reduced to numbers.

use super::checks::{CheckOptions, CropChecks, check_crop};
use super::crop::{ChannelSums, channel_sums};
use super::dark::Darks;
use super::field::{Weights, Window};
use super::frames::{Loader, Taken};
use super::geometry::{GeometryErrors, Movable};
use super::lamp::{Lamp, Level};
use super::merge::{MOST_EXPOSURES, Merged};
use super::noise::{Cell, Scatter};
use super::radiance::{Radiance, scale};
use super::repeat::{Deviation, deviations};
use super::stack::{Stack, Target, read_stacks};
use super::texture::Texture;
use super::white::{Flat, White};
use super::{CropRule, MeasureOptions, Viewer};
use crate::base::{Error, Result};
use crate::session::{CameraFacts, Configuration, Coverage, FrameKind, Projection, RowSpan};

/// One configuration, read but not yet reduced.
pub(super) struct Reading {
    pub(super) configuration: Configuration,
    pub(super) area_px: f64,
    pub(super) bounds: [usize; 4],
    pub(super) exposures: Vec<Exposure>,
    /// None when nothing was captured or nothing is usable.
    pub(super) channels: Option<[ChannelSums; 3]>,
    pub(super) texture: Texture,
    /// Variance from pose, pointing, scale and height.
    pub(super) geometry: [f64; 3],
    pub(super) cells: Vec<Cell>,
    pub(super) deviations: Vec<Deviation>,
    /// What saturated, when nothing is usable.
    pub(super) saturated: Option<String>,
    pub(super) captured: bool,
    /// The channel no frame shows: frames through its filter are missing.
    pub(super) unseen: Option<usize>,
    /// Exposure, milliseconds, and values of the crop left out of it.
    pub(super) masked: Vec<(f64, usize)>,
    /// What a careful eye sees in the crop.
    pub(super) checks: Option<CropChecks>,
}

/// One stack of a configuration.
pub(super) struct Exposure {
    pub(super) exposure_ms: f64,
    /// How messages call its first frame.
    pub(super) title: String,
    pub(super) level: Level,
    pub(super) repeats: f64,
    /// By channel: mean signal, and its variance `a shot + constant`; none where it does not see the channel or has no dark.
    pub(super) mean: [Option<(f64, f64, f64)>; 3],
}

/// Where a configuration's mean is taken.
#[derive(Debug, Clone, PartialEq)]
pub struct Footprint {
    /// Pixels and how much of each counts.
    pub coverage: Coverage,
    /// Corners in pixels of the visible area, in order around it.
    pub corners: Vec<[f64; 2]>,
}

impl Footprint {
    /// The crop of a configuration; `side_mm` is the side of the sample square.
    ///
    /// # Errors
    /// It leaves the image, or covers less than one pixel.
    pub fn of(
        rule: CropRule,
        camera: &CameraFacts,
        configuration: &Configuration,
        side_mm: f64,
    ) -> Result<Self> {
        match rule {
            CropRule::Square => {
                let projection = Projection::new(camera, configuration);
                Ok(Self {
                    coverage: projection.coverage(side_mm)?,
                    corners: projection.outline(side_mm),
                })
            }
            CropRule::Rectangle(c) => {
                let inside = |start: usize, size: usize, whole: usize| {
                    size >= 2 && start.checked_add(size).is_some_and(|end| end <= whole)
                };
                if !inside(c.x, c.width, camera.width) || !inside(c.y, c.height, camera.height) {
                    return Err(Error::new(format!(
                        "crop {},{},{},{} does not lie in the visible area of {} x {} pixels",
                        c.x, c.y, c.width, c.height, camera.width, camera.height
                    ))
                    .with_hint("a crop is X,Y,WIDTH,HEIGHT, at least 2 x 2 pixels"));
                }
                let row = |y| RowSpan {
                    y,
                    x: c.x,
                    weights: vec![1.0; c.width],
                };
                let [left, top] = [c.x as f64, c.y as f64];
                let [right, bottom] = [left + c.width as f64, top + c.height as f64];
                Ok(Self {
                    coverage: Coverage {
                        rows: (c.y..c.y + c.height).map(row).collect(),
                    },
                    corners: vec![[left, top], [right, top], [right, bottom], [left, bottom]],
                })
            }
        }
    }
}

/// What all configurations are read with.
pub(super) struct Reader<'a> {
    pub(super) loader: &'a Loader<'a>,
    pub(super) frames: &'a [Taken],
    pub(super) camera: &'a CameraFacts,
    pub(super) side_mm: f64,
    pub(super) darks: &'a Darks,
    pub(super) lamp: &'a Lamp,
    pub(super) white: &'a White,
    pub(super) errors: GeometryErrors,
    pub(super) margin: usize,
    /// What is known beforehand of the noise; it steers weights, not stated errors.
    pub(super) scatter: Scatter,
    pub(super) options: &'a MeasureOptions,
    pub(super) viewer: &'a dyn Viewer,
}

impl Reader<'_> {
    /// Reads one configuration.
    ///
    /// # Errors
    /// As [`read_stacks`]; or the crop leaves the image when it is moved by its uncertainty.
    pub(super) fn read(&self, configuration: &Configuration) -> Result<Reading> {
        let crop = Footprint::of(self.options.crop, self.camera, configuration, self.side_mm)?;
        let crop = &crop;
        let own = |f: &&Taken| {
            f.record.kind == FrameKind::Sample && f.record.config == Some(configuration.id)
        };
        let own: Vec<&Taken> = self.frames.iter().filter(own).collect();
        let field = &self.darks.field;
        let size = [self.camera.width, self.camera.height];
        let window = Window::around([crop.coverage.bounds()], self.margin, size, field.layout);
        let hot = self.darks.hot_on(&window);
        let weights = Weights::covered(&crop.coverage, &window, &hot);
        let target = Target {
            window,
            weights: &weights,
            hot: &hot,
        };
        let read = read_stacks(
            self.loader,
            &own,
            &target,
            self.darks,
            self.lamp,
            self.options,
        );
        let (stacks, cells) = read?;
        let mut reading = Reading {
            configuration: *configuration,
            area_px: crop.coverage.area(),
            bounds: crop.coverage.bounds(),
            exposures: stacks.iter().map(|s| Exposure::of(s, &weights)).collect(),
            channels: None,
            texture: Texture::default(),
            geometry: [0.0; 3],
            cells,
            deviations: deviations(&stacks, &weights),
            saturated: None,
            captured: !stacks.is_empty(),
            unseen: (0..3).find(|&c| !stacks.iter().any(|s| s.sees(c))),
            masked: Vec::new(),
            checks: None,
        };
        if reading.unseen.is_some() {
            return Ok(reading);
        }
        if stacks.len() > MOST_EXPOSURES {
            return Err(Error::new(format!(
                "configuration {}: {} exposures in one bracket, expected at most {MOST_EXPOSURES}",
                configuration.id,
                stacks.len()
            ))
            .with_hint("leave some out of the journal, or measure in two sessions"));
        }
        let merged = Merged::of(&stacks, &target, self.scatter.slope);
        let of_stack = |&(stack, n): &(usize, usize)| (stacks[stack].exposure_ms, n);
        reading.masked = merged.masked.iter().map(of_stack).collect();
        if merged.saturated.iter().any(|&n| n > 0) {
            reading.saturated = saturated(&merged, &stacks, &weights, crop);
            return Ok(reading);
        }
        self.fill(&mut reading, &merged, &stacks, &target, crop)?;
        Ok(reading)
    }

    fn fill(
        &self,
        reading: &mut Reading,
        merged: &Merged,
        stacks: &[Stack],
        target: &Target<'_>,
        crop: &Footprint,
    ) -> Result<()> {
        let flat = Flat::of(
            self.options.calibrations.flat.as_ref().map(|f| &f.value),
            &target.window,
        );
        let flat = flat.as_ref();
        let response = &self.darks.response;
        let sums = |c: usize| channel_sums(c, merged, stacks, target, self.white, flat, response);
        reading.channels = Some([0, 1, 2].map(sums));
        let radiance = Radiance::of(merged, stacks, target, self.white, flat);
        reading.texture = Texture::measure(&radiance, merged, &target.window, target.weights);
        let movable = Movable {
            camera: self.camera,
            configuration: &reading.configuration,
            rule: self.options.crop,
            side_mm: self.side_mm,
            coverage: &crop.coverage,
            window: &target.window,
            weights: target.weights,
            hot: target.hot,
            radiance: &radiance,
        };
        reading.geometry = movable.variance(&self.errors)?;
        let corners = crop.corners.clone();
        let picture = radiance.picture(merged, target, &crop.coverage, corners, &self.scatter);
        let options = CheckOptions {
            vignetting: Some(self.vignetting(target, flat)),
            ..CheckOptions::default()
        };
        reading.checks = Some(check_crop(&picture, &options));
        self.viewer.crop(&reading.configuration, &picture)
    }
}

impl Reader<'_> {
    /// Largest over smallest correction of lens and pixels within the crop, in green.
    fn vignetting(&self, target: &Target<'_>, flat: Option<&Flat>) -> f64 {
        let greens = target.weights.channels[1].iter();
        let corrections = greens.map(|v| {
            let at = target.window.pixel(v.index);
            scale(self.white, flat, 1, v.index, at)
        });
        let (low, high) = corrections.fold((f64::MAX, 0.0_f64), |(l, h), s| (l.min(s), h.max(s)));
        high / low
    }
}

impl Reading {
    /// The exposures some pixel of the crop is used of, milliseconds; all when none is usable.
    pub(super) fn used_exposures(&self) -> Vec<f64> {
        let used = |stack: usize| {
            let channels = self.channels.iter().flatten();
            self.channels.is_none() || channels.into_iter().any(|c| c.shares[stack] != 0.0)
        };
        let exposures = self.exposures.iter().enumerate();
        let mut times: Vec<f64> = exposures
            .filter(|(stack, _)| used(*stack))
            .map(|(_, e)| e.exposure_ms)
            .collect();
        times.sort_by(f64::total_cmp);
        times.dedup();
        times
    }
}

impl Exposure {
    fn of(stack: &Stack, weights: &Weights) -> Self {
        let mean = |c: usize| {
            (stack.sees(c) && !stack.signal.is_empty()).then(|| {
                let mean = stack.crop_mean(weights, c);
                let each = 1.0 / stack.repeats + 1.0 / stack.dark_count;
                let constant = mean.squares * stack.dark_variance * each;
                (mean.signal, mean.shot.max(0.0), constant)
            })
        };
        Self {
            exposure_ms: stack.exposure_ms,
            title: stack.title.clone(),
            level: stack.level.clone(),
            repeats: stack.repeats,
            mean: [0, 1, 2].map(mean),
        }
    }
}

/// What is saturated: the channel with the most such pixels, in its shortest exposure.
fn saturated(
    merged: &Merged,
    stacks: &[Stack],
    weights: &Weights,
    crop: &Footprint,
) -> Option<String> {
    let channel = (0..3).rev().max_by_key(|&c| merged.saturated[c])?;
    let of_channel = stacks.iter().filter(|s| s.sees(channel));
    let shortest = of_channel.min_by(|a, b| a.exposure_ms.total_cmp(&b.exposure_ms))?;
    let all: usize = merged.saturated.iter().sum();
    let (count, pixels) = match shortest.filter {
        Some(_) => (merged.saturated[channel], weights.channels[channel].len()),
        None => (all, weights.values().count()),
    };
    let [left, top, right, bottom] = crop.coverage.bounds();
    Some(format!(
        "saturated: {count} of {pixels} pixels of {} are too bright, and in every longer exposure (crop in columns {left} to {right}, rows {top} to {bottom}); take it again with an exposure below {} ms",
        shortest.title, shortest.exposure_ms
    ))
}
