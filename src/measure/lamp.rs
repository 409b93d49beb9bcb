//! How bright the lamp was at every moment, from the visits of the reference pose.
//!
//! Between two visits of a stretch the level runs in a straight line, outside them it is the nearest visit's. How far the
//! line may be off is told from how the visits bend. What it does not do: see a flicker between two visits.

use super::frames::{Moment, Taken};
use super::noise::Scatter;
use super::visit::Visit;
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
    /// Each visit's share, r, g, b.
    shares: Vec<[f64; 3]>,
    /// Share of frames in stretches without a visit.
    unknown: f64,
    /// How far a parabola through neighboring visits lies off the straight line, r, g, b.
    bend: [f64; 3],
}

impl Default for Level {
    fn default() -> Self {
        Self {
            value: [1.0; 3],
            shares: Vec::new(),
            unknown: 0.0,
            bend: [0.0; 3],
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
            bend: [0.0; 3],
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
                    level.bend[c] += part * area * self.curvature(v, &(first..=last), c);
                }
            }
        }
    }

    /// Second divided difference of the level around the gap between visits v - 1 and v: the mean of those with the visit
    /// before and with the one after, as far as they are of this stretch; 0 with neither.
    fn curvature(&self, v: usize, stretch: &std::ops::RangeInclusive<usize>, c: usize) -> f64 {
        let time = |i: usize| self.visits[i].seconds[c];
        // A clock that stood still between two visits tells no slope.
        let over = |change: f64, s: f64| if s > 0.0 { change / s } else { 0.0 };
        let level = |i: usize| self.visits[i].level[c];
        let slope = |i: usize| over(level(i + 1) - level(i), time(i + 1) - time(i));
        let triple = |i: usize| over(slope(i + 1) - slope(i), time(i + 2) - time(i));
        let before = (v > *stretch.start() + 1).then(|| triple(v - 2));
        let after = (v < *stretch.end()).then(|| triple(v - 1));
        match (before, after) {
            (Some(a), Some(b)) => 0.5 * (a + b),
            (one, other) => one.or(other).unwrap_or(0.0),
        }
    }

    /// The variance that levels leave in a ratio of `sample` to `white` signals, each given as its parts by exposure, both with
    /// the ratio as their sum. The errors of one visit are the same wherever it has a share, and so are those of the first.
    /// The bend between visits is taken as one standard deviation of what a straight line leaves out.
    pub(super) fn variance(
        &self,
        sample: &[(f64, &Level)],
        white: &[(f64, &Level)],
        channel: usize,
        scatter: &Scatter,
    ) -> f64 {
        let (mut own, mut first) = (0.0, 0.0);
        for (v, visit) in self.visits.iter().enumerate().skip(1) {
            let part = |levels: &[(f64, &Level)]| -> f64 {
                let parts = levels
                    .iter()
                    .map(|(w, l)| w * l.shares[v][channel] / l.value[channel]);
                parts.sum()
            };
            let part = (part(sample) - part(white)) * visit.level[channel];
            own += part * part * visit.own[channel].at(scatter, channel);
            first += part * visit.first[channel].at(scatter, channel).sqrt();
        }
        let unknown = |levels: &[(f64, &Level)]| -> f64 {
            levels.iter().map(|(w, l)| w * l.unknown).sum::<f64>() * self.unknown(channel)
        };
        let bend = |levels: &[(f64, &Level)]| -> f64 {
            let bends = levels
                .iter()
                .map(|(w, l)| w * l.bend[channel] / l.value[channel]);
            bends.sum()
        };
        let bend = bend(sample) - bend(white);
        own + first * first + bend * bend + unknown(sample).powi(2) + unknown(white).powi(2)
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
