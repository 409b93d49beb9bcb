//! How bright the lamp was: the sample at the reference geometry, shot again and again.
//!
//! A visit's rate is the mean raw value over the crop less its dark, over the exposure time, exposures combined by exposed
//! time; its level is that rate over the first visit's, on the exposures usable in both. Texture, vignetting and shutter
//! cancel in the ratio. Between two visits of a stretch the level runs in a straight line, outside them it is the nearest
//! visit's. What it does not do: see anything the lamp does between two visits, or a pose that is not come back to.

use super::dark::Darks;
use super::frames::{Loader, Moment, Region, Taken, same_exposure};
use super::noise::Cell;
use super::stack::{Stack, read_stacks};
use crate::base::{Error, Result};
use rayon::prelude::*;
use serde::Serialize;

/// A change of the lamp over the session that is worth a warning.
const LARGE: f64 = 0.05;

/// A change between neighboring visits that is worth a warning; also the least that is taken as unknown of a lamp that
/// was switched on again and not looked at.
const STEP: f64 = 0.02;

/// One visit of the reference pose.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LampVisit {
    /// The number in the journal.
    pub visit: u32,
    /// Stretch of work it belongs to, from 0; the lamp was switched off and on between stretches.
    pub stretch: usize,
    /// Mean time of its frames, seconds on the journal's clock.
    pub elapsed_s: f64,
    /// Brightness relative to the first visit, r, g, b.
    pub level: [f64; 3],
    /// Its standard error, r, g, b; the first visit's level is one by definition.
    pub standard_error: [f64; 3],
    /// Exposures used, milliseconds.
    pub exposures_ms: Vec<f64>,
}

/// The lamp's brightness over the session.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct LampReport {
    /// In the order of stretches and time; empty without reference frames, and nothing is corrected then.
    pub visits: Vec<LampVisit>,
    /// Change of the lamp between the white frames and the first visit, relative, if it went on as between the first two
    /// visits; not corrected. None when there is nothing to tell it from.
    pub before_first_visit: Option<[f64; 3]>,
}

/// The lamp's level in one exposure: a mean of visits' levels.
#[derive(Debug, Clone)]
pub(super) struct Level {
    /// Relative to the first visit, r, g, b.
    pub(super) value: [f64; 3],
    /// Each visit's share.
    shares: Vec<f64>,
    /// Share of frames in stretches without a visit.
    unknown: f64,
}

impl Default for Level {
    fn default() -> Self {
        Self {
            value: [1.0; 3],
            shares: Vec::new(),
            unknown: 0.0,
        }
    }
}

/// A relative variance, `a shot + rest` with `a` the slope of the photon transfer.
#[derive(Debug, Clone, Copy, Default)]
struct Variance {
    shot: f64,
    rest: f64,
}

impl Variance {
    fn at(&self, a: f64) -> f64 {
        a * self.shot.max(0.0) + self.rest
    }
}

struct Visit {
    number: u32,
    at: Moment,
    level: [f64; 3],
    /// Of its own rate, the noise of the darks it shares with the first visit included.
    own: [Variance; 3],
    /// Of the first visit's rate on the same exposures.
    first: [Variance; 3],
    exposures_ms: Vec<f64>,
}

/// What is known of the lamp.
#[derive(Default)]
pub(super) struct Lamp {
    visits: Vec<Visit>,
    /// Visits that could not be used, and why.
    unused: Vec<String>,
    /// Seconds from the white frames to the first visit, when both are of one stretch.
    white_lead_s: Option<f64>,
}

impl Lamp {
    /// Reads all visits. Also returns what their frames say of the noise.
    ///
    /// # Errors
    /// As [`read_stacks`], or a visit is not brighter than the dark.
    pub(super) fn read(
        loader: &Loader<'_>,
        frames: &[&Taken],
        region: &Region,
        darks: &Darks,
        usable_fraction: f64,
    ) -> Result<(Self, Vec<Cell>)> {
        let key = |t: &Taken| (t.moment.stretch, t.record.visit);
        let mut frames = frames.to_vec();
        frames.sort_by_key(|t| key(t));
        let groups: Vec<&[&Taken]> = frames.chunk_by(|a, b| key(a) == key(b)).collect();
        let dark_room = Self::default();
        let read = groups.par_iter().map(|group| {
            let (stacks, cells) =
                read_stacks(loader, group, region, darks, &dark_room, usable_fraction)?;
            let usable = stacks.iter().filter(|s| s.clipped == 0);
            let exposures: Vec<Exposure> = usable.map(|s| Exposure::of(region, s)).collect();
            Ok((group[0].record.visit, exposures, cells))
        });
        let read: Vec<Result<_>> = read.collect();
        let mut lamp = Self::default();
        let mut cells = Vec::new();
        let mut visits = Vec::new();
        for visit in read {
            let (number, exposures, more) = visit?;
            cells.extend(more);
            if exposures.is_empty() {
                lamp.unused.push(format!(
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
        if let Some((_, first)) = visits.first() {
            for (number, exposures) in &visits {
                match Visit::against(first, *number, exposures)? {
                    Some(visit) => lamp.visits.push(visit),
                    None => lamp.unused.push(format!(
                        "reference visit {number} shares no usable exposure with the first and is left out"
                    )),
                }
            }
        }
        Ok((lamp, cells))
    }

    /// Tells when the white frames were shot.
    pub(super) fn note_white(&mut self, whites: &[&Taken]) {
        let Some(first) = self.visits.first() else {
            return;
        };
        let here = whites
            .iter()
            .filter(|w| w.moment.stretch == first.at.stretch);
        let times: Vec<f64> = here.map(|w| w.moment.elapsed_s).collect();
        let lead = first.at.elapsed_s - times.iter().sum::<f64>() / times.len() as f64;
        self.white_lead_s = (lead > 0.0).then_some(lead);
    }

    /// The mean level at these moments.
    pub(super) fn level(&self, moments: &[Moment]) -> Level {
        if self.visits.is_empty() || moments.is_empty() {
            return Level::default();
        }
        let part = 1.0 / moments.len() as f64;
        let mut level = Level {
            value: [0.0; 3],
            shares: vec![0.0; self.visits.len()],
            unknown: 0.0,
        };
        for moment in moments {
            self.add_shares(moment, part, &mut level);
        }
        for (share, visit) in level.shares.iter().zip(&self.visits) {
            for (value, of_visit) in level.value.iter_mut().zip(visit.level) {
                *value += share * of_visit;
            }
        }
        level
    }

    fn add_shares(&self, moment: &Moment, part: f64, level: &mut Level) {
        let mut of_stretch =
            (0..self.visits.len()).filter(|&v| self.visits[v].at.stretch == moment.stretch);
        let Some(first) = of_stretch.next() else {
            level.unknown += part;
            let even = part / self.visits.len() as f64;
            level.shares.iter_mut().for_each(|s| *s += even);
            return;
        };
        let last = of_stretch.next_back().unwrap_or(first);
        let time = |v: usize| self.visits[v].at.elapsed_s;
        let after = (first..=last).find(|&v| time(v) > moment.elapsed_s);
        match after {
            None => level.shares[last] += part,
            Some(v) if v == first => level.shares[first] += part,
            Some(v) => {
                let along = (moment.elapsed_s - time(v - 1)) / (time(v) - time(v - 1));
                level.shares[v] += part * along;
                level.shares[v - 1] += part * (1.0 - along);
            }
        }
    }

    /// The relative variance that levels leave in a ratio of `sample` to `white` signals, each a mean of exposures with
    /// their weights. The errors of one visit are the same wherever it has a share, and so are those of the first.
    pub(super) fn relative_variance(
        &self,
        sample: &[(f64, &Level)],
        white: &[(f64, &Level)],
        channel: usize,
        a: f64,
    ) -> f64 {
        let (mut own, mut first) = (0.0, 0.0);
        for (v, visit) in self.visits.iter().enumerate().skip(1) {
            let part = |levels: &[(f64, &Level)]| -> f64 {
                let parts = levels
                    .iter()
                    .map(|(w, l)| w * l.shares[v] / l.value[channel]);
                parts.sum()
            };
            let part = (part(sample) - part(white)) * visit.level[channel];
            own += part * part * visit.own[channel].at(a);
            first += part * visit.first[channel].at(a).sqrt();
        }
        let unknown = |levels: &[(f64, &Level)]| -> f64 {
            levels.iter().map(|(w, l)| w * l.unknown).sum::<f64>() * self.unknown(channel)
        };
        own + first * first + unknown(sample).powi(2) + unknown(white).powi(2)
    }

    /// The standard uncertainty of the level in a stretch nobody looked at the lamp in: the range of all levels seen, or
    /// [`STEP`] where that is more.
    fn unknown(&self, channel: usize) -> f64 {
        (self.range(channel) - 1.0).max(STEP)
    }

    /// Brightest over faintest level.
    fn range(&self, channel: usize) -> f64 {
        let levels = self.visits.iter().map(|v| v.level[channel]);
        let (low, high) = levels.fold((f64::MAX, 0.0_f64), |(l, h), x| (l.min(x), h.max(x)));
        high / low
    }

    pub(super) fn report(&self, a: f64) -> LampReport {
        let visits = self.visits.iter().enumerate().map(|(v, visit)| {
            let error = |c: usize| {
                let relative = visit.own[c].at(a) + visit.first[c].at(a);
                visit.level[c] * relative.sqrt()
            };
            LampVisit {
                visit: visit.number,
                stretch: visit.at.stretch,
                elapsed_s: visit.at.elapsed_s,
                level: visit.level,
                standard_error: if v == 0 {
                    [0.0; 3]
                } else {
                    [0, 1, 2].map(error)
                },
                exposures_ms: visit.exposures_ms.clone(),
            }
        });
        let before = match &self.visits[..] {
            [first, second, ..] if first.at.stretch == second.at.stretch => {
                let gap = second.at.elapsed_s - first.at.elapsed_s;
                let change = |lead| second.level.map(|l| (l - 1.0) * lead / gap);
                self.white_lead_s.map(change)
            }
            _ => None,
        };
        LampReport {
            visits: visits.collect(),
            before_first_visit: before,
        }
    }

    /// What the operator should know, given when all measured frames were shot.
    pub(super) fn warnings(&self, moments: impl Iterator<Item = Moment>) -> Vec<String> {
        let mut warnings = self.unused.clone();
        let stretches: std::collections::BTreeSet<usize> = moments.map(|m| m.stretch).collect();
        if self.visits.is_empty() {
            if stretches.len() > 1 {
                warnings.push(format!(
                    "the capture was continued {} times and has no reference frames: a lamp that came back brighter or fainter goes unseen",
                    stretches.len() - 1
                ));
            }
            return warnings;
        }
        let percent = |x: f64| 100.0 * x;
        for stretch in stretches {
            if !self.visits.iter().any(|v| v.at.stretch == stretch) {
                let unknown = [0, 1, 2].map(|c| self.unknown(c)).into_iter();
                warnings.push(format!(
                    "no reference frame in stretch {stretch} of the capture: the lamp is taken as its mean elsewhere, +- {:.1} %",
                    percent(unknown.fold(0.0, f64::max))
                ));
            }
        }
        let range = [0, 1, 2].map(|c| self.range(c) - 1.0);
        let range = range.into_iter().fold(0.0, f64::max);
        if range > LARGE {
            warnings.push(format!(
                "the lamp changed by {:.1} % over the session; let it warm up longer",
                percent(range)
            ));
        }
        for pair in self.visits.windows(2) {
            let steps = [0, 1, 2].map(|c| (pair[1].level[c] / pair[0].level[c] - 1.0).abs());
            let step = steps.into_iter().fold(0.0, f64::max);
            if pair[0].at.stretch == pair[1].at.stretch && step > STEP {
                warnings.push(format!(
                    "the lamp changed by {:.1} % between reference visits {} and {}: visit the reference more often",
                    percent(step),
                    pair[0].number,
                    pair[1].number
                ));
            }
        }
        warnings
    }
}

/// One exposure of one visit: crop means of the dark-subtracted raw value, and what their variances are made of.
struct Exposure {
    exposure_ms: f64,
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
    fn of(region: &Region, stack: &Stack) -> Self {
        let mut area = [0.0; 3];
        for pixel in &region.pixels {
            area[pixel.channel] += pixel.weight;
        }
        let (mut signal, mut shot, mut squares) = ([0.0; 3], [0.0; 3], [0.0; 3]);
        for (pixel, &value) in region.pixels.iter().zip(&stack.signal) {
            let c = pixel.channel;
            let w = pixel.weight / area[c];
            signal[c] += w * value;
            shot[c] += w * w * value;
            squares[c] += w * w;
        }
        Self {
            exposure_ms: stack.exposure_ms,
            repeats: stack.repeats,
            signal,
            shot: shot.map(|s| s / stack.repeats),
            read: squares.map(|s| s * stack.dark_variance / stack.repeats),
            dark: squares.map(|s| s * stack.dark_variance / stack.dark_count),
            moments: stack.moments.clone(),
        }
    }

    fn mean_moment(exposures: &[Self]) -> Moment {
        let moments: Vec<&Moment> = exposures.iter().flat_map(|e| &e.moments).collect();
        let sum: f64 = moments.iter().map(|m| m.elapsed_s).sum();
        Moment {
            stretch: moments.first().map_or(0, |m| m.stretch),
            elapsed_s: sum / moments.len() as f64,
        }
    }

    /// Exposed time.
    fn time(&self) -> f64 {
        self.repeats * self.exposure_ms
    }
}

/// Rate of one channel over some exposures, and the relative variance of its own frames.
fn rate(exposures: &[&Exposure], channel: usize) -> (f64, Variance) {
    let total: f64 = exposures.iter().map(|e| e.time()).sum();
    let mut signal = 0.0;
    let mut variance = Variance::default();
    for e in exposures {
        signal += e.repeats * e.signal[channel];
        variance.shot += e.repeats * e.repeats * e.shot[channel];
        variance.rest += e.repeats * e.repeats * e.read[channel];
    }
    variance.shot /= signal * signal;
    variance.rest /= signal * signal;
    (signal / total, variance)
}

impl Visit {
    /// A visit compared with the first one; none when no exposure is usable in both.
    fn against(first: &[Exposure], number: u32, exposures: &[Exposure]) -> Result<Option<Self>> {
        let pairs: Vec<(&Exposure, &Exposure)> = exposures
            .iter()
            .filter_map(|e| {
                let same = |f: &&Exposure| same_exposure(f.exposure_ms, e.exposure_ms);
                first.iter().find(same).map(|f| (e, f))
            })
            .collect();
        if pairs.is_empty() {
            return Ok(None);
        }
        let (here, there): (Vec<_>, Vec<_>) = pairs.into_iter().unzip();
        let mut visit = Self {
            number,
            at: Exposure::mean_moment(exposures),
            level: [0.0; 3],
            own: [Variance::default(); 3],
            first: [Variance::default(); 3],
            exposures_ms: here.iter().map(|e| e.exposure_ms).collect(),
        };
        let time = |list: &[&Exposure]| list.iter().map(|e| e.time()).sum::<f64>();
        let (time_here, time_there) = (time(&here), time(&there));
        for c in 0..3 {
            let (rate_here, mut own) = rate(&here, c);
            let (rate_there, of_first) = rate(&there, c);
            for rate in [rate_here, rate_there] {
                if !(f64::MIN_POSITIVE..f64::MAX).contains(&rate) {
                    return Err(Error::new(format!(
                        "reference visit {number}: {} is not brighter than the dark ({rate} raw values per millisecond)",
                        ["red", "green", "blue"][c]
                    ))
                    .with_hint("was the lamp on for the reference frames, and off for the darks?"));
                }
            }
            for (e, f) in here.iter().zip(&there) {
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
