//! All shots of one thing, exposure by exposure.

use super::dark::Darks;
use super::frames::{Loader, Moment, Region, Taken, same_exposure, title};
use super::lamp::{Lamp, Level};
use super::noise::{Cell, Sample, pair_cells};
use crate::base::{Error, Result};

/// All shots of one thing at one exposure.
pub(super) struct Stack {
    pub(super) exposure_ms: f64,
    /// Mean over the repeats of raw value minus dark, per pixel of the region; empty when there is no dark.
    pub(super) signal: Vec<f64>,
    pub(super) repeats: f64,
    pub(super) dark_count: f64,
    /// Variance of one raw value without light.
    pub(super) dark_variance: f64,
    /// Pixels of the region at or above the usable range, in the worst repeat.
    pub(super) clipped: usize,
    /// How messages call its first frame.
    pub(super) title: String,
    /// When its repeats were shot.
    pub(super) moments: Vec<Moment>,
    /// The lamp's mean level over the repeats.
    pub(super) level: Level,
    /// Why there is no dark for it: a fault only where the stack is used.
    without_dark: Option<Error>,
}

impl Stack {
    /// The exposure time that would have given this signal at the lamp's level one, milliseconds.
    pub(super) fn time(&self, channel: usize) -> f64 {
        self.exposure_ms * self.level.value[channel]
    }

    fn new(taken: &Taken) -> Self {
        Self {
            exposure_ms: taken.record.exposure_ms,
            signal: Vec::new(),
            repeats: 0.0,
            dark_count: 1.0,
            dark_variance: 0.0,
            clipped: 0,
            title: title(&taken.record),
            moments: Vec::new(),
            level: Level::default(),
            without_dark: None,
        }
    }

    fn add(&mut self, sample: &Sample) {
        self.repeats += 1.0;
        if self.signal.is_empty() {
            self.signal.clone_from(&sample.values);
            self.dark_count = sample.dark_count;
            self.dark_variance = sample.dark_variance;
            return;
        }
        for (mean, value) in self.signal.iter_mut().zip(&sample.values) {
            *mean += (value - *mean) / self.repeats;
        }
    }
}

/// Reads all shots of one thing, grouped by exposure (ascending), and compares successive usable ones for their noise. A
/// step of the lamp between them does not count: the ratio of the signals is taken from the frames.
///
/// # Errors
/// A frame is missing, changed or of another camera, or one that is not clipped has no dark of its exposure.
pub(super) fn read_stacks(
    loader: &Loader<'_>,
    frames: &[&Taken],
    region: &Region,
    darks: &Darks,
    lamp: &Lamp,
    usable_fraction: f64,
) -> Result<(Vec<Stack>, Vec<Cell>)> {
    let mut frames = frames.to_vec();
    frames.sort_by(|a, b| {
        let by_time = a.record.exposure_ms.total_cmp(&b.record.exposure_ms);
        by_time.then(a.record.repeat.cmp(&b.record.repeat))
    });
    let mut stacks: Vec<Stack> = Vec::new();
    let mut cells = Vec::new();
    let mut previous: Option<Sample> = None;
    for taken in frames {
        let record = &taken.record;
        let frame = loader.load(record)?;
        let limit = (usable_fraction * f64::from(frame.white)) as u16;
        let clipped = region.indices().filter(|&i| frame.data[i] >= limit).count();
        let mut stack = match stacks.pop() {
            Some(last) if same_exposure(last.exposure_ms, record.exposure_ms) => last,
            other => {
                stacks.extend(other);
                Stack::new(taken)
            }
        };
        stack.clipped = stack.clipped.max(clipped);
        stack.moments.push(taken.moment);
        let sample = match darks.find(record) {
            Ok(dark) => {
                let values = region
                    .indices()
                    .map(|i| f64::from(frame.data[i]) - f64::from(dark.mean[i]));
                let sample = Sample {
                    exposure_ms: record.exposure_ms,
                    values: values.collect(),
                    dark_variance: dark.variance,
                    dark_count: dark.count as f64,
                };
                stack.add(&sample);
                (clipped == 0).then_some(sample)
            }
            Err(error) => {
                stack.without_dark = Some(error);
                None
            }
        };
        stacks.push(stack);
        if let (Some(first), Some(second)) = (&previous, &sample) {
            cells.extend(pair_cells(first, second, region));
        }
        previous = sample;
    }
    for stack in &mut stacks {
        stack.level = lamp.level(&stack.moments);
        if stack.clipped == 0
            && let Some(error) = stack.without_dark.take()
        {
            return Err(error);
        }
    }
    Ok((stacks, cells))
}
