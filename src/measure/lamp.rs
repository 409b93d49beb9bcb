//! How bright the lamp was at every moment, from the visits of the reference pose.
//!
//! Between two visits of a stretch the level runs along the mean of the parabolas through them and a neighbor, outside them
//! it is the nearest visit's. How far that may be off is told from how much the parabolas differ. What it does not do: see a
//! flicker between two visits.

use super::frames::{Moment, Taken};
use super::noise::Scatter;
use super::visit::Visit;
use serde::Serialize;
use std::ops::RangeInclusive;

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
    /// Each visit's share, r, g, b.
    shares: Vec<[f64; 3]>,
    /// Share of frames in stretches without a visit.
    unknown: f64,
    /// By visit: the sum of these parts of the levels is how far the course between visits may be off, r, g, b.
    bend: Vec<[f64; 3]>,
}

impl Default for Level {
    fn default() -> Self {
        Self {
            value: [1.0; 3],
            shares: Vec::new(),
            unknown: 0.0,
            bend: Vec::new(),
        }
    }
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
    /// A lamp known from these visits, in the order of stretches and time; `unused` says which others there were.
    pub(super) fn new(visits: Vec<Visit>, unused: Vec<String>) -> Self {
        Self {
            visits,
            unused,
            white_lead_s: None,
        }
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
            shares: vec![[0.0; 3]; self.visits.len()],
            unknown: 0.0,
            bend: vec![[0.0; 3]; self.visits.len()],
        };
        for moment in moments {
            self.add_shares(moment, part, &mut level);
        }
        for (shares, visit) in level.shares.iter().zip(&self.visits) {
            for c in 0..3 {
                level.value[c] += shares[c] * visit.level[c];
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
            level
                .shares
                .as_flattened_mut()
                .iter_mut()
                .for_each(|s| *s += even);
            return;
        };
        let last = of_stretch.next_back().unwrap_or(first);
        for c in 0..3 {
            let time = |v: usize| self.visits[v].seconds[c];
            let after = (first..=last).find(|&v| time(v) > moment.elapsed_s);
            match after {
                None => level.shares[last][c] += part,
                Some(v) if v == first => level.shares[first][c] += part,
                Some(v) => {
                    let along = (moment.elapsed_s - time(v - 1)) / (time(v) - time(v - 1));
                    level.shares[v][c] += part * along;
                    level.shares[v - 1][c] += part * (1.0 - along);
                    let area = (moment.elapsed_s - time(v - 1)) * (moment.elapsed_s - time(v));
                    self.bend(v, first..=last, c, part * area, level);
                }
            }
        }
    }

    /// Bends the straight line between visits v - 1 and v to the mean of the parabolas with the visit before and with the
    /// one after, as far as they are of this stretch. The course is uncertain by half of what those two differ by; where
    /// there is but one, by what it differs from its neighbor; and where there is no other, by the whole bend.
    fn bend(
        &self,
        v: usize,
        stretch: RangeInclusive<usize>,
        c: usize,
        area: f64,
        level: &mut Level,
    ) {
        let (first, last) = stretch.into_inner();
        let before = (v >= first + 2).then(|| v - 2);
        let after = (v < last).then(|| v - 1);
        let parabolas: Vec<usize> = before.into_iter().chain(after).collect();
        let neighbor = match parabolas[..] {
            [one] if before.is_some() => (one > first).then(|| one - 1),
            [one] => (one + 3 <= last).then(|| one + 1),
            _ => None,
        };
        let each = area / parabolas.len() as f64;
        let add = |parts: &mut [[f64; 3]], at: usize, factor: f64| {
            for (part, by) in parts[at..].iter_mut().zip(self.second_difference(at, c)) {
                part[c] += factor * by;
            }
        };
        for &at in &parabolas {
            add(&mut level.shares, at, each);
        }
        if let [one, other] = parabolas[..] {
            add(&mut level.bend, one, 0.5 * area);
            add(&mut level.bend, other, -0.5 * area);
        } else if let [one] = parabolas[..] {
            add(&mut level.bend, one, area);
            if let Some(other) = neighbor {
                add(&mut level.bend, other, -area);
            }
        }
    }

    /// The second divided difference of the levels of visit `at` and the next two, per level.
    fn second_difference(&self, at: usize, channel: usize) -> [f64; 3] {
        let [a, b, c] = [0, 1, 2].map(|k| self.visits[at + k].seconds[channel]);
        if !(a < b && b < c) {
            // A clock that stood still between two visits tells no slope.
            return [0.0; 3];
        }
        [
            1.0 / ((b - a) * (c - a)),
            -1.0 / ((b - a) * (c - b)),
            1.0 / ((c - a) * (c - b)),
        ]
    }

    /// The variance that levels leave in a ratio of `sample` to `white` signals, each given as its parts by exposure, both with
    /// the ratio as their sum. The errors of one visit are the same wherever it has a share, and so are those of the first.
    pub(super) fn variance(
        &self,
        sample: &[(f64, &Level)],
        white: &[(f64, &Level)],
        channel: usize,
        scatter: &Scatter,
    ) -> f64 {
        let (mut own, mut first) = (0.0, 0.0);
        let (mut bend, mut of_noise) = (0.0, 0.0);
        for (v, visit) in self.visits.iter().enumerate() {
            let part = |of: fn(&Level) -> &[[f64; 3]]| -> f64 {
                let sum = |levels: &[(f64, &Level)]| -> f64 {
                    let parts = levels.iter();
                    parts
                        .map(|(w, l)| w * of(l)[v][channel] / l.value[channel])
                        .sum()
                };
                (sum(sample) - sum(white)) * visit.level[channel]
            };
            let variance = visit.own[channel].at(scatter, channel);
            let off = part(|l| &l.bend);
            bend += off;
            of_noise += off * off * variance;
            if v == 0 {
                // Its level is 1 by definition; its noise is in the others'.
                continue;
            }
            let part = part(|l| &l.shares);
            own += part * part * variance;
            first += part * visit.first[channel].at(scatter, channel).sqrt();
        }
        let unknown = |levels: &[(f64, &Level)]| -> f64 {
            levels.iter().map(|(w, l)| w * l.unknown).sum::<f64>() * self.unknown(channel)
        };
        // The visits' noise alone makes parabolas differ.
        let bend = (bend * bend - of_noise).max(0.0);
        own + first * first + bend + unknown(sample).powi(2) + unknown(white).powi(2)
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

    pub(super) fn report(&self, scatter: &Scatter) -> LampReport {
        let visits = self.visits.iter().enumerate().map(|(v, visit)| {
            let error = |c: usize| {
                let relative = visit.own[c].at(scatter, c) + visit.first[c].at(scatter, c);
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
            [first, second, ..]
                if first.at.stretch == second.at.stretch
                    && first.at.elapsed_s < second.at.elapsed_s =>
            {
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
