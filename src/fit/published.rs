//! The published search: stochastic gradient descent in rescaled parameters (Khungurn 2015 sec. 5.4, 5.5, eq. 21).
//!
//! ```text
//! s <- project(s - a_i df/ds),   a_i = a / i,   i = 50 .. 109
//! ```
//! from the start, once for each of six multipliers a; the best of the six goes on for ten iterations at a tenth of the
//! last rate. Every iteration renders a fresh pair and uses the unbiased gradient of [`super::Objective::gradient`].
//! What the paper leaves open, and what is done here, stands with [`SgdOptions`]. Does not stop early, and does not look
//! at its own noise: the budget alone says how many paths an iteration has.

use super::gradient::Walk;
use super::objective::RenderPair;
use super::rescaling::{Rescaling, RescalingOptions};
use super::search::{Found, Problem, Spent};
use crate::base::{Error, Result, Watch};
use crate::scatter::Parameters;
use std::ops::Range;

/// Work of the pair that judges the end of a run, in pairs of one iteration.
const SELECTION_PAIRS: f64 = 4.0;
/// When runs cannot be judged by fresh renders, by the mean of so many of their last iterations.
const RECENT: usize = 5;
/// By how much the last iterations' rate is less than the last rate before them.
const FINAL_FACTOR: f64 = 0.1;
/// Pair indices of the stages begin here.
const ITERATION_INDEX: u64 = 3 << 32;
const SELECTION_INDEX: u64 = 4 << 32;
const FINAL_INDEX: u64 = 5 << 32;

/// How the best of the runs is chosen among noisy values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Selection {
    /// By a fresh pair at the end of each run, with the paths of four iterations: unbiased.
    #[default]
    FreshRenders,
    /// By the lowest value any iteration of the run reported, going on from there. The least of many noisy values is
    /// too low, the more so the noisier: it may name a worse run.
    LowestReported,
}

/// What may be asked of the published descent; the defaults are the published choices, and ours where the paper is
/// silent.
#[derive(Debug, Clone, PartialEq)]
pub struct SgdOptions {
    /// Multipliers a of the learning rates `a / i`, each a run of its own. Published: six, exponentially bracketed,
    /// values unknown. Here `4 * 4^k` for k = -2 .. 3, so that first steps are 0.005 to 5 times the gradient; Newton's step along a
    /// single axis would be about 0.2 to 4 times.
    pub rates: Vec<f64>,
    /// Iterations of each run: 60 (published).
    pub iterations: u32,
    /// The first i: 50 (published).
    pub first_index: u32,
    /// Iterations after the choice, at a tenth of the last rate: 10. The paper makes them "in some instances", where
    /// the run still oscillated; here always. 0 for none.
    pub final_iterations: u32,
    /// How the best run is chosen. Published: the lowest reported value, of which iteration is not said.
    pub selection: Selection,
    /// How parameters are rescaled.
    pub rescaling: RescalingOptions,
}

impl Default for SgdOptions {
    fn default() -> Self {
        Self {
            rates: (-2..=3).map(|k| 4.0 * 4.0_f64.powi(k)).collect(),
            iterations: 60,
            first_index: 50,
            final_iterations: 10,
            selection: Selection::default(),
            rescaling: RescalingOptions::default(),
        }
    }
}

impl SgdOptions {
    pub(super) fn check(&self) -> Result<()> {
        let r = &self.rescaling;
        let fault = if self.rates.is_empty() {
            "at least one learning rate is needed"
        } else if !self.rates.iter().all(|a| (1e-12..1e12).contains(a)) {
            "learning rates must be positive numbers"
        } else if self.rates.len() > 1000 || self.iterations > 1_000_000 {
            "at most 1000 learning rates and 1000000 iterations are possible"
        } else if self.iterations == 0 || self.first_index == 0 {
            "the number of iterations and the first index must be at least 1"
        } else if !(3..=1000).contains(&r.knots) {
            "3 to 1000 knots are possible"
        } else if !(0.1..=10.0).contains(&r.power) {
            "the power of the knots must be between 0.1 and 10"
        } else if !(1e-9..=0.1).contains(&r.smallest) {
            "the smallest increment must be between 1e-9 and 0.1 of the whole"
        } else {
            return Ok(());
        };
        Err(Error::new(format!("sgd: {fault}")))
    }

    /// The learning rate `a / i` of iteration `k`, counted from 0.
    fn rate(&self, a: f64, k: u32) -> f64 {
        a / (f64::from(self.first_index) + f64::from(k))
    }
}

/// One descent with one multiplier.
struct Run {
    a: f64,
    s: Vec<f64>,
    /// Reported objectives, and where.
    reported: Vec<(f64, Vec<f64>)>,
    /// Its iterations in the record.
    recorded: Range<usize>,
}

impl Run {
    fn recent(&self) -> f64 {
        let last = &self.reported[self.reported.len().saturating_sub(RECENT)..];
        last.iter().map(|(value, _)| value).sum::<f64>() / last.len() as f64
    }

    fn lowest(&self) -> Option<&(f64, Vec<f64>)> {
        self.reported.iter().min_by(|a, b| a.0.total_cmp(&b.0))
    }
}

struct Descent<'a> {
    walk: Walk<'a>,
    rescaling: Rescaling,
    options: &'a SgdOptions,
}

impl Descent<'_> {
    fn parameters(&self, s: &[f64]) -> Parameters {
        let template = Parameters::defaults(self.walk.problem.scene.model());
        template.with_values(self.rescaling.to_values(s))
    }

    fn coordinates(&self, s: &[f64]) -> Result<Vec<f64>> {
        self.walk.problem.space.to_search(&self.parameters(s))
    }

    /// One iteration of `run` at the learning rate `rate`; false when the schedule was cut short.
    fn step(&mut self, run: &mut Run, rate: f64, index: u64) -> Result<bool> {
        let u = self.coordinates(&run.s)?;
        let Some(pair) = self.walk.render(&u, 1.0, index)? else {
            return Ok(false);
        };
        let slopes = self.rescaling.slopes(&run.s);
        self.record(&u, &pair, rate, &slopes);
        let objective = self.walk.problem.objective;
        run.reported
            .push((objective.paired(&pair).value, run.s.clone()));
        let gradient = objective.gradient(&pair, &self.parameters(&run.s));
        let moved: Vec<f64> = (0..run.s.len())
            .map(|j| run.s[j] - rate * gradient[j] * slopes[j])
            .collect();
        run.s = self.rescaling.projected(&moved);
        Ok(true)
    }

    fn record(&mut self, u: &[f64], pair: &RenderPair, rate: f64, slopes: &[f64]) {
        let space = self.walk.problem.space;
        let of_space = space.slopes(&space.to_parameters(u));
        let gain = |(of_s, of_u): (&f64, &f64)| rate * (of_s / of_u).powi(2);
        let gains: Vec<f64> = slopes.iter().zip(&of_space).map(gain).collect();
        self.walk.record(u, pair, &gains);
    }

    /// All runs, as far as the budget goes; those without an iteration are left out.
    fn runs(&mut self, start: &[f64]) -> Result<Vec<Run>> {
        let options = self.options;
        let mut runs = Vec::new();
        for (number, &a) in options.rates.iter().enumerate() {
            let first = self.walk.n_recorded();
            let mut run = Run {
                a,
                s: start.to_vec(),
                reported: Vec::new(),
                recorded: first..first,
            };
            for k in 0..options.iterations {
                let index = ITERATION_INDEX + ((number as u64) << 20) + u64::from(k);
                if !self.step(&mut run, options.rate(a, k), index)? {
                    break;
                }
            }
            run.recorded.end = self.walk.n_recorded();
            if !run.reported.is_empty() {
                runs.push(run);
            }
            if self.walk.stopped() {
                break;
            }
        }
        Ok(runs)
    }

    /// The best run, and how it was chosen; `None` when there is no run.
    fn choose(&mut self, mut runs: Vec<Run>) -> Result<Option<(Run, &'static str)>> {
        let mut scores = Vec::new();
        let by = match self.options.selection {
            Selection::LowestReported => {
                scores.extend(runs.iter().filter_map(|r| r.lowest().map(|l| l.0)));
                "the lowest value reported"
            }
            Selection::FreshRenders => {
                for (number, run) in runs.iter().enumerate() {
                    let u = self.coordinates(&run.s)?;
                    let index = SELECTION_INDEX + number as u64;
                    let Some(pair) = self.walk.render(&u, SELECTION_PAIRS, index)? else {
                        break;
                    };
                    scores.push(self.walk.problem.objective.paired(&pair).value);
                }
                "fresh renders"
            }
        };
        let by = if scores.len() < runs.len() {
            scores = runs.iter().map(Run::recent).collect();
            "the last iterations, because the schedule was cut short"
        } else {
            by
        };
        let best = (0..runs.len()).min_by(|&i, &j| scores[i].total_cmp(&scores[j]));
        let Some(best) = best else { return Ok(None) };
        let mut run = runs.swap_remove(best);
        if self.options.selection == Selection::LowestReported {
            let lowest = run.lowest().map(|(_, s)| s.clone());
            run.s = lowest.unwrap_or(run.s);
        }
        Ok(Some((run, by)))
    }

    /// The last iterations of the chosen run.
    fn finish(&mut self, run: &mut Run) -> Result<()> {
        let options = self.options;
        let rate = FINAL_FACTOR * options.rate(run.a, options.iterations - 1);
        for k in 0..options.final_iterations {
            if !self.step(run, rate, FINAL_INDEX + u64::from(k))? {
                break;
            }
        }
        Ok(())
    }
}

/// Runs the descent from `start` (coordinates of the search space); the second answer says in words what was done.
///
/// # Errors
/// When a render fails, the budget is too small, or the fit is interrupted before the first iteration.
pub(super) fn search(
    problem: &Problem<'_>,
    start: &[f64],
    spent: &mut Spent,
    watch: &dyn Watch,
) -> Result<(Found, String)> {
    let options = &problem.options.sgd;
    let n_rates = options.rates.len();
    let n_rows = problem.scene.model().parameters().len();
    let n_knots = n_rows * options.rescaling.knots as usize;
    let fresh = match options.selection {
        Selection::FreshRenders => n_rates as f64 * SELECTION_PAIRS,
        Selection::LowestReported => 0.0,
    };
    let iterations = n_rates as f64 * f64::from(options.iterations);
    let pairs = n_knots as f64 + iterations + fresh + f64::from(options.final_iterations);
    let mut walk = Walk::new(problem, start, pairs, spent, watch)?;
    let Some(rescaling) = Rescaling::render(&mut walk, &options.rescaling)? else {
        return Ok((walk.finish(start.to_vec())?, String::new()));
    };
    let rescaling_paths = walk.spent_paths();
    let values = problem.space.to_parameters(start);
    let s = rescaling.to_search(values.values());
    let mut descent = Descent {
        walk,
        rescaling,
        options,
    };
    let runs = descent.runs(&s)?;
    let n_runs = runs.len();
    let Some((mut run, by)) = descent.choose(runs)? else {
        return Ok((descent.walk.finish(start.to_vec())?, String::new()));
    };
    let last = descent.walk.n_recorded();
    descent.finish(&mut run)?;
    let u = descent.coordinates(&run.s)?;
    let mut walk = descent.walk;
    walk.accept_only(&run.recorded, last);
    let note = format!(
        "published descent: {n_runs} of {n_rates} learning rates, {} iterations of each run of {}; rescaling took \
         {rescaling_paths} camera paths for {n_knots} pairs; a = {} chosen by {by}",
        options.iterations,
        walk.cost_in_words(),
        run.a
    );
    Ok((walk.finish(u)?, note))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_defaults_are_the_published_schedule() {
        let options = SgdOptions::default();
        assert!(options.check().is_ok());
        assert_eq!(options.rates, [0.25, 1.0, 4.0, 16.0, 64.0, 256.0]);
        // i = 50 .. 109: the rate falls 2.18 times.
        let fall = options.rate(1.0, 0) / options.rate(1.0, 59);
        assert!((fall - 2.18).abs() < 1e-9, "{fall}");
        assert!((options.rate(5.0, 0) - 0.1).abs() < 1e-15);
    }

    #[test]
    fn senseless_options_are_refused() {
        let good = SgdOptions::default;
        let knots = |knots| RescalingOptions {
            knots,
            ..RescalingOptions::default()
        };
        let bad = [
            SgdOptions {
                rates: vec![],
                ..good()
            },
            SgdOptions {
                rates: vec![1.0, -1.0],
                ..good()
            },
            SgdOptions {
                rates: vec![f64::NAN],
                ..good()
            },
            SgdOptions {
                iterations: 0,
                ..good()
            },
            SgdOptions {
                first_index: 0,
                ..good()
            },
            SgdOptions {
                rescaling: knots(1),
                ..good()
            },
        ];
        for options in bad {
            assert!(options.check().is_err(), "{options:?}");
        }
    }
}
