//! From the frames of the reference pose to how bright the lamp was at each visit.
//!
//! A visit's rate is the mean raw value over the crop less its dark, over the exposure time, exposures combined by exposed
//! time; its level is that rate over the first visit's, on the exposures usable in both. Texture, vignetting and shutter
//! cancel in the ratio. A pose that is not come back to exactly does not.

use super::MeasureOptions;
use super::dark::Darks;
use super::field::Weights;
use super::frames::{Loader, Moment, Taken, same_exposure};
use super::lamp::Lamp;
use super::noise::{Cell, Scatter};
use super::reduce::COLORS;
use super::stack::{Stack, Target, read_stacks};
use crate::base::{Error, Result};
use crate::session::Filter;
use rayon::prelude::*;

/// A relative variance, `a shot + rest + f^2 flicker` with `a` the slope of the photon transfer and `f` the relative
/// standard deviation from frame to frame.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Variance {
    shot: f64,
    rest: f64,
    flicker: f64,
}

impl Variance {
    /// Its value.
    pub(super) fn at(&self, scatter: &Scatter, channel: usize) -> f64 {
        let shot = scatter.slope[channel] * self.shot.max(0.0);
        shot + self.rest + scatter.between_frames.powi(2) * self.flicker
    }
}

/// One visit, compared with the first.
pub(super) struct Visit {
    pub(super) number: u32,
    pub(super) at: Moment,
    /// By channel: mean time of the frames that show it. Through filters the channels are shot one after another.
    pub(super) seconds: [f64; 3],
    pub(super) level: [f64; 3],
    /// Of its own rate, the noise of the darks it shares with the first visit included.
    pub(super) own: [Variance; 3],
    /// Of the first visit's rate on the same exposures.
    pub(super) first: [Variance; 3],
    pub(super) exposures_ms: Vec<f64>,
}

/// Reads all visits. Also returns what their frames say of the noise.
///
/// # Errors
/// As [`read_stacks`], or a visit is not brighter than the dark.
pub(super) fn read_lamp(
    loader: &Loader<'_>,
    frames: &[&Taken],
    target: &Target<'_>,
    darks: &Darks,
    options: &MeasureOptions,
) -> Result<(Lamp, Vec<Cell>)> {
    let key = |t: &Taken| (t.moment.stretch, t.record.visit);
    let mut frames = frames.to_vec();
    frames.sort_by_key(|t| key(t));
    let groups: Vec<&[&Taken]> = frames.chunk_by(|a, b| key(a) == key(b)).collect();
    let unknown = Lamp::default();
    let read = groups.par_iter().map(|group| {
        let (stacks, cells) = read_stacks(loader, group, target, darks, &unknown, options)?;
        let usable = stacks.iter().filter(|s| s.clipped_in_crop == 0);
        let exposures: Vec<Exposure> = usable.map(|s| Exposure::of(target.weights, s)).collect();
        Ok((group[0].record.visit, exposures, cells))
    });
    let read: Vec<Result<_>> = read.collect();
    let mut unused = Vec::new();
    let mut cells = Vec::new();
    let mut visits = Vec::new();
    for visit in read {
        let (number, exposures, more) = visit?;
        cells.extend(more);
        if exposures.is_empty() {
            unused.push(format!(
                "reference visit {number} is saturated in every exposure and left out"
            ));
        } else {
            visits.push((number, exposures));
        }
    }
    visits.sort_by(|(_, a), (_, b)| {
        let (a, b) = (Exposure::mean_moment(a), Exposure::mean_moment(b));
        let by_stretch = a.stretch.cmp(&b.stretch);
        by_stretch.then(a.elapsed_s.total_cmp(&b.elapsed_s))
    });
    let mut compared = Vec::new();
    if let Some((_, first)) = visits.first() {
        for (number, exposures) in &visits {
            if let Some(visit) = Visit::against(first, *number, exposures)? {
                compared.push(visit);
            } else {
                unused.push(format!(
                    "reference visit {number} has no usable exposure in common with the first: left out"
                ));
            }
        }
    }
    Ok((Lamp::new(compared, unused), cells))
}

/// One exposure of one visit: crop means of the dark-subtracted raw value, and what their variances are made of.
struct Exposure {
    exposure_ms: f64,
    filter: Option<Filter>,
    /// How messages call its first frame.
    title: String,
    repeats: f64,
    signal: [f64; 3],
    /// `sum w^2 signal / repeats`.
    shot: [f64; 3],
    /// `sum w^2 dark_variance / repeats`.
    read: [f64; 3],
    /// `sum w^2 dark_variance / dark frames`: the same error in every visit.
    dark: [f64; 3],
    moments: Vec<Moment>,
}

impl Exposure {
    fn of(weights: &Weights, stack: &Stack) -> Self {
        let means = [0, 1, 2].map(|c| stack.crop_mean(weights, c));
        Self {
            exposure_ms: stack.exposure_ms,
            filter: stack.filter,
            title: stack.title.clone(),
            repeats: stack.repeats,
            signal: means.map(|m| m.signal),
            shot: means.map(|m| m.shot),
            read: means.map(|m| m.squares * stack.dark_variance / stack.repeats),
            dark: means.map(|m| m.squares * stack.dark_variance / stack.dark_count),
            moments: stack.moments.clone(),
        }
    }

    fn sees(&self, channel: usize) -> bool {
        self.filter.is_none_or(|f| f.channel() == channel)
    }

    fn mean_moment(exposures: &[Self]) -> Moment {
        let moments: Vec<&Moment> = exposures.iter().flat_map(|e| &e.moments).collect();
        let sum: f64 = moments.iter().map(|m| m.elapsed_s).sum();
        Moment {
            stretch: moments.first().map_or(0, |m| m.stretch),
            elapsed_s: sum / moments.len() as f64,
        }
    }

    /// Mean time of the frames that show a channel.
    fn mean_seconds(exposures: &[Self], channel: usize) -> f64 {
        let of_channel = exposures.iter().filter(|e| e.sees(channel));
        let moments: Vec<&Moment> = of_channel.flat_map(|e| &e.moments).collect();
        moments.iter().map(|m| m.elapsed_s).sum::<f64>() / moments.len() as f64
    }

    /// Exposed time.
    fn time(&self) -> f64 {
        self.repeats * self.exposure_ms
    }
}

/// Rate of one channel over some exposures, and the relative variance of its own frames.
fn rate(exposures: &[&Exposure], channel: usize) -> (f64, Variance) {
    let of_channel = || exposures.iter().filter(|e| e.sees(channel));
    let total: f64 = of_channel().map(|e| e.time()).sum();
    let mut signal = 0.0;
    let mut variance = Variance::default();
    for e in of_channel() {
        signal += e.repeats * e.signal[channel];
        variance.shot += e.repeats * e.repeats * e.shot[channel];
        variance.rest += e.repeats * e.repeats * e.read[channel];
    }
    variance.shot /= signal * signal;
    variance.rest /= signal * signal;
    variance.flicker = of_channel()
        .map(|e| e.time() / total * (e.time() / total) / e.repeats)
        .sum();
    (signal / total, variance)
}

impl Visit {
    /// A visit compared with the first one; none when no exposure is usable in both.
    fn against(first: &[Exposure], number: u32, exposures: &[Exposure]) -> Result<Option<Self>> {
        let pairs: Vec<(&Exposure, &Exposure)> = exposures
            .iter()
            .filter_map(|e| {
                let same = |f: &&Exposure| {
                    f.filter == e.filter && same_exposure(f.exposure_ms, e.exposure_ms)
                };
                first.iter().find(same).map(|f| (e, f))
            })
            .collect();
        if !(0..3).all(|c| pairs.iter().any(|(e, _)| e.sees(c))) {
            return Ok(None);
        }
        let (here, there): (Vec<_>, Vec<_>) = pairs.into_iter().unzip();
        let mut visit = Self {
            number,
            at: Exposure::mean_moment(exposures),
            seconds: [0, 1, 2].map(|c| Exposure::mean_seconds(exposures, c)),
            level: [0.0; 3],
            own: [Variance::default(); 3],
            first: [Variance::default(); 3],
            exposures_ms: here.iter().map(|e| e.exposure_ms).collect(),
        };
        for c in 0..3 {
            let time = |list: &[&Exposure]| {
                let of_channel = list.iter().filter(|e| e.sees(c));
                of_channel.map(|e| e.time()).sum::<f64>()
            };
            let (time_here, time_there) = (time(&here), time(&there));
            let (rate_here, mut own) = rate(&here, c);
            let (rate_there, of_first) = rate(&there, c);
            for rate in [rate_here, rate_there] {
                if !(f64::MIN_POSITIVE..f64::MAX).contains(&rate) {
                    return Err(Error::new(format!(
                        "reference visit {number}: {} is not brighter than the dark ({rate} raw values per millisecond in {})",
                        COLORS[c],
                        here.iter().find(|e| e.sees(c)).map_or("no frame", |e| &e.title)
                    ))
                    .with_hint("was the lamp on for the reference frames, and off for the darks?"));
                }
            }
            for (e, f) in here.iter().zip(&there).filter(|(e, _)| e.sees(c)) {
                let share =
                    e.repeats / (time_here * rate_here) - f.repeats / (time_there * rate_there);
                own.rest += e.dark[c] * share * share;
            }
            visit.level[c] = rate_here / rate_there;
            visit.own[c] = own;
            visit.first[c] = of_first;
        }
        Ok(Some(visit))
    }
}
