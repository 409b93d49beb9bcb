//! All shots of one thing, exposure by exposure.

use super::dark::Darks;
use super::field::{Weights, Window};
use super::frames::{Loader, Moment, Taken, same_exposure, title};
use super::lamp::{Lamp, Level};
use super::linear::linear_window;
use super::noise::{Cell, Sample, pair_cells};
use super::{MeasureOptions, RawFrame};
use crate::base::{Error, Result};
use crate::session::{Filter, FrameRecord, Layout};
use rayon::prelude::*;

/// Saturated pixels may spill charge this far, pixels.
const BLOOMING: usize = 2;

/// A pixel at this fraction of the white level may spill.
const SATURATED: f64 = 0.995;

/// All shots of one thing at one exposure through one filter.
pub(super) struct Stack {
    pub(super) exposure_ms: f64,
    pub(super) filter: Option<Filter>,
    /// Mean over the repeats of linear raw value minus dark, per value of the window; empty when there is no dark.
    pub(super) signal: Vec<f32>,
    /// Per value of the window: too bright in some repeat, or next to a saturated pixel.
    pub(super) clipped: Vec<bool>,
    /// How many of them carry the crop.
    pub(super) clipped_in_crop: usize,
    /// The signal from which on values are too bright.
    pub(super) limit: f64,
    pub(super) repeats: f64,
    pub(super) dark_count: f64,
    /// Variance of one raw value without light.
    pub(super) dark_variance: f64,
    /// How messages call its first frame.
    pub(super) title: String,
    /// When its repeats were shot.
    pub(super) moments: Vec<Moment>,
    /// The lamp's mean level over the repeats.
    pub(super) level: Level,
    /// Weighted mean over the crop of each repeat, by channel.
    pub(super) repeat_means: Vec<[f64; 3]>,
    /// Why there is no dark for it: a fault only where the stack is used.
    without_dark: Option<Error>,
}

/// A weighted mean over the crop, and what its variance is made of: `a shot + squares r^2 / repeats`.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct CropMean {
    pub(super) signal: f64,
    /// `sum w^2 signal / repeats`.
    pub(super) shot: f64,
    /// `sum w^2`.
    pub(super) squares: f64,
}

impl Stack {
    /// The exposure time that would have given this signal at the lamp's level one, milliseconds.
    pub(super) fn time(&self, channel: usize) -> f64 {
        self.exposure_ms * self.level.value[channel]
    }

    /// True when its frames show this channel.
    pub(super) fn sees(&self, channel: usize) -> bool {
        self.filter.is_none_or(|f| f.channel() == channel)
    }

    /// The crop's mean in one channel, every value of the crop counted.
    pub(super) fn crop_mean(&self, weights: &Weights, channel: usize) -> CropMean {
        let mut mean = CropMean::default();
        for value in &weights.channels[channel] {
            let w = value.weight / weights.total[channel];
            let signal = f64::from(self.signal[value.index]);
            mean.signal += w * signal;
            mean.shot += w * w * signal / self.repeats;
            mean.squares += w * w;
        }
        mean
    }

    fn new(taken: &Taken, window: &Window) -> Self {
        Self {
            exposure_ms: taken.record.exposure_ms,
            filter: taken.record.filter,
            signal: Vec::new(),
            clipped: vec![false; window.len()],
            clipped_in_crop: 0,
            limit: 0.0,
            repeats: 0.0,
            dark_count: 1.0,
            dark_variance: 0.0,
            title: title(&taken.record),
            moments: Vec::new(),
            level: Level::default(),
            repeat_means: Vec::new(),
            without_dark: None,
        }
    }

    fn is_of(&self, record: &FrameRecord) -> bool {
        self.filter == record.filter && same_exposure(self.exposure_ms, record.exposure_ms)
    }

    fn add(&mut self, sample: &Sample, weights: &Weights) {
        self.repeats += 1.0;
        let mean = |c: usize| {
            let list = &weights.channels[c];
            let sum: f64 = list
                .iter()
                .map(|v| v.weight * f64::from(sample.values[v.index]))
                .sum();
            sum / weights.total[c]
        };
        self.repeat_means.push([0, 1, 2].map(mean));
        if self.signal.is_empty() {
            self.signal.clone_from(&sample.values);
            self.dark_count = sample.dark_count;
            self.dark_variance = sample.dark_variance;
            return;
        }
        let part = 1.0 / self.repeats as f32;
        for (mean, value) in self.signal.iter_mut().zip(&sample.values) {
            *mean += (value - *mean) * part;
        }
    }
}

/// What is read: a window of the frames, the values in it that count, and which are hot.
pub(super) struct Target<'a> {
    pub(super) window: Window,
    pub(super) weights: &'a Weights,
    pub(super) hot: &'a [bool],
}

/// Reads all shots of one thing, grouped by filter and exposure (ascending), and compares successive ones that are not
/// clipped for their noise. A step of the lamp between them does not count: the ratio of the signals is taken from the
/// frames.
///
/// # Errors
/// A frame is missing, changed or of another camera, or one that is not clipped has no dark of its exposure.
pub(super) fn read_stacks(
    loader: &Loader<'_>,
    frames: &[&Taken],
    target: &Target<'_>,
    darks: &Darks,
    lamp: &Lamp,
    options: &MeasureOptions,
) -> Result<(Vec<Stack>, Vec<Cell>)> {
    let mut frames = frames.to_vec();
    frames.sort_by(|a, b| {
        let by_filter = a.record.filter.cmp(&b.record.filter);
        let by_time = a.record.exposure_ms.total_cmp(&b.record.exposure_ms);
        by_filter
            .then(by_time)
            .then(a.record.repeat.cmp(&b.record.repeat))
    });
    let mut stacks: Vec<Stack> = Vec::new();
    let mut cells = Vec::new();
    let mut previous: Option<Sample> = None;
    // As many frames are in memory as there are threads to decode them.
    for some in frames.chunks(rayon::current_num_threads().max(1)) {
        let decoded: Vec<Result<Seen>> = some
            .par_iter()
            .map(|taken| Seen::read(loader, &taken.record, target, darks, options))
            .collect();
        for (taken, seen) in some.iter().zip(decoded) {
            let seen = seen?;
            let mut stack = match stacks.pop() {
                Some(last) if last.is_of(&taken.record) => last,
                other => {
                    stacks.extend(other);
                    Stack::new(taken, &target.window)
                }
            };
            stack.moments.push(taken.moment);
            for (mine, new) in stack.clipped.iter_mut().zip(&seen.clipped) {
                *mine |= new;
            }
            let mut compared = None;
            match seen.sample {
                Ok(sample) => {
                    stack.add(&sample, target.weights);
                    stack.limit = seen.limit;
                    compared = (seen.clipped_in_crop == 0).then_some(sample);
                }
                Err(error) => stack.without_dark = Some(error),
            }
            stacks.push(stack);
            if let (Some(first), Some(second)) = (&previous, &compared) {
                cells.extend(pair_cells(first, second, target));
            }
            previous = compared;
        }
    }
    for stack in &mut stacks {
        stack.level = lamp.level(&stack.moments);
        let crop = target.weights.values();
        stack.clipped_in_crop = crop.filter(|(_, v)| stack.clipped[v.index]).count();
        if stack.clipped_in_crop == 0
            && let Some(error) = stack.without_dark.take()
        {
            return Err(error);
        }
    }
    Ok((stacks, cells))
}

/// One frame's part of the window.
struct Seen {
    /// The signal from which on values are too bright.
    limit: f64,
    clipped: Vec<bool>,
    clipped_in_crop: usize,
    sample: Result<Sample>,
}

impl Seen {
    fn read(
        loader: &Loader<'_>,
        record: &FrameRecord,
        target: &Target<'_>,
        darks: &Darks,
        options: &MeasureOptions,
    ) -> Result<Self> {
        let frame = loader.load(record)?;
        if record.filter.is_some() && frame.layout != Layout::Mono {
            return Err(Error::new(format!(
                "{}: the journal names a filter, but the camera sees color itself",
                title(record)
            ))
            .with_hint("filters are for monochrome cameras; leave the filter out of the list"));
        }
        let usable = options.usable_fraction * f64::from(frame.white);
        let limit = darks.response.limit.map_or(usable, |l| l.min(usable));
        let clipped = clipped(&frame, target, limit);
        let crop = target.weights.values();
        let clipped_in_crop = crop.filter(|(_, v)| clipped[v.index]).count();
        let mut signal_limit = 0.0;
        let sample = darks.find(record).map(|dark| {
            signal_limit = darks.response.linear(limit.min(65535.0) as u16, 0) - dark.level;
            let mut values = linear_window(&darks.response, &target.window, &frame.data);
            let rows = target.window.rows_within(&darks.field);
            let dark_values = rows.into_iter().flat_map(|row| &dark.mean[row]);
            for (value, dark) in values.iter_mut().zip(dark_values) {
                *value -= dark;
            }
            Sample {
                exposure_ms: record.exposure_ms,
                filter: record.filter,
                values,
                dark_variance: dark.variance,
                dark_count: dark.count as f64,
            }
        });
        Ok(Self {
            limit: signal_limit,
            clipped,
            clipped_in_crop,
            sample,
        })
    }
}

/// Which values of the window are too bright, or next to a saturated pixel. Hot pixels are never counted.
fn clipped(frame: &RawFrame, target: &Target<'_>, limit: f64) -> Vec<bool> {
    let window = &target.window;
    let white = f64::from(frame.white);
    let mut bright = Vec::with_capacity(window.len());
    let mut saturated = Vec::new();
    for row in window.rows() {
        for &raw in &frame.data[row] {
            let index = bright.len();
            let counts = !target.hot[index] && f64::from(raw) >= limit;
            if counts && f64::from(raw) >= SATURATED * white {
                saturated.push(index);
            }
            bright.push(counts);
        }
    }
    let n = window.layout.values_per_pixel();
    let [left, top, right, bottom] = window.bounds;
    for index in saturated {
        let (x, y) = window.pixel(index);
        for j in y.saturating_sub(BLOOMING).max(top)..(y + BLOOMING + 1).min(bottom) {
            let first = x.saturating_sub(BLOOMING).max(left);
            let last = (x + BLOOMING + 1).min(right);
            let row = (j - top) * window.width();
            bright[(row + first - left) * n..(row + last - left) * n].fill(true);
        }
    }
    bright
}
