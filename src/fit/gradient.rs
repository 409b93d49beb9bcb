//! What the gradient methods share: a fixed schedule of render pairs that fits the budget, the record of iterations, and
//! the linear model at the end.
//!
//! A schedule counts its work in pairs of one iteration. How many camera paths such a pair takes is either asked for, or
//! what the search's share of the budget holds, divided by the pairs that are left. Does not know how parameters move.

use super::linear::{Matrix, inverse};
use super::objective::{RenderPair, rms_of};
use super::options::Budget;
use super::pool::Pool;
use super::result::Iteration;
use super::search::{AFTER_INTERRUPT, Found, Problem, REACH, SEARCH_SHARE, Spent, Stop, Stretch};
use crate::base::{Error, Result, Watch};
use std::ops::Range;

/// Camera paths of one published iteration: 16 configurations, 2 renders, 64 x 64 pixels, 64 samples (Khungurn 2015
/// sec. 7.1).
pub(super) const PUBLISHED_PATHS: u64 = 16 * 2 * 64 * 64 * 64;
/// Work of the pair at the result that the linear model is made from, as a share of all work before it.
const MODEL_SHARE: f64 = 0.25;
/// Camera paths per configuration of the pair that measures the speed when only time is limited.
const PROBE_PATHS: u64 = 1000;
/// Fewest camera paths per configuration of a pair: two renders that can state their errors.
const LEAST_PATHS: u64 = 128;
/// Pair indices of the probe and of the last pair; those of the methods lie between.
const PROBE_INDEX: u64 = 1 << 32;
const MODEL_INDEX: u64 = 1 << 39;

/// A schedule being worked off.
pub(super) struct Walk<'a> {
    pub(super) problem: &'a Problem<'a>,
    spent: &'a mut Spent,
    watch: &'a dyn Watch,
    /// Work of the whole schedule, the pair at the result included, and what is left of it.
    pairs: f64,
    pairs_left: f64,
    /// Camera paths of the latest pair of one iteration.
    iteration_paths: u64,
    history: Vec<Iteration>,
    stop: Option<Stop>,
}

impl<'a> Walk<'a> {
    /// A schedule of `pairs`, from `u`.
    ///
    /// # Errors
    /// When the budget's paths do not hold the schedule, or the first render fails.
    pub(super) fn new(
        problem: &'a Problem<'a>,
        u: &[f64],
        pairs: f64,
        spent: &'a mut Spent,
        watch: &'a dyn Watch,
    ) -> Result<Self> {
        let pairs = pairs * (1.0 + MODEL_SHARE);
        let walk = Self {
            problem,
            spent,
            watch,
            pairs,
            pairs_left: pairs,
            iteration_paths: 0,
            history: Vec::new(),
            stop: None,
        };
        walk.refuse_small_budget()?;
        let options = problem.options;
        if options.budget.time_s.is_some() && options.iteration_paths.is_none() {
            let paths = PROBE_PATHS * walk.n_configurations();
            let pair = walk.problem.render(
                u,
                paths,
                &walk.equal_shares(),
                PROBE_INDEX,
                &walk.stretch(0.0, true),
            )?;
            walk.spent.add(paths, &pair);
        }
        Ok(walk)
    }

    fn n_configurations(&self) -> u64 {
        self.problem.objective.intensities().len() as u64
    }

    fn least_paths(&self) -> u64 {
        LEAST_PATHS * self.n_configurations()
    }

    fn equal_shares(&self) -> Vec<f64> {
        vec![1.0; self.problem.objective.intensities().len()]
    }

    fn refuse_small_budget(&self) -> Result<()> {
        let options = self.problem.options;
        let Some(budget) = options.budget.paths else {
            return Ok(());
        };
        let each = options.iteration_paths.unwrap_or(self.least_paths());
        let needed = (self.pairs * each as f64 / SEARCH_SHARE).ceil();
        if budget as f64 >= needed {
            return Ok(());
        }
        Err(Error::new(format!(
            "{budget} paths do not hold the schedule of {}: with {each} paths in each iteration it takes {needed}",
            options.method.name()
        ))
        .with_hint("give the fit more paths, or fewer to each iteration, or use another method"))
    }

    /// Camera paths of a pair of one iteration, at the speed seen so far.
    fn pair_paths(&self) -> u64 {
        let options = self.problem.options;
        options.iteration_paths.unwrap_or_else(|| {
            self.spent
                .left(&options.budget, SEARCH_SHARE)
                .map_or(PUBLISHED_PATHS, |left| {
                    (left as f64 / self.pairs_left) as u64
                })
                .max(self.least_paths())
        })
    }

    /// Which limit does not allow `paths` more.
    fn limit_met(&self, paths: u64) -> Option<Stop> {
        let budget = &self.problem.options.budget;
        let short = |budget: &Budget| {
            self.spent
                .left(budget, SEARCH_SHARE)
                .is_some_and(|left| left < paths)
        };
        let by_time = Budget {
            paths: None,
            ..*budget
        };
        match (short(budget), short(&by_time)) {
            (_, true) => Some(Stop::Time),
            (true, _) => Some(Stop::Paths),
            _ => None,
        }
    }

    fn stretch(&self, pairs: f64, interruptible: bool) -> Stretch<'a> {
        Stretch {
            watch: self.watch,
            stage: "fit: search",
            done: 1.0 - self.pairs_left / self.pairs,
            each: 0.5 * pairs / self.pairs,
            state: std::sync::Mutex::new((0, 0.0)),
            interruptible,
        }
    }

    /// A pair with the work of `pairs` iterations at `u`, every configuration with equally many paths; `None` when the
    /// budget is used up or the fit interrupted.
    ///
    /// # Errors
    /// When the scene fails.
    pub(super) fn render(
        &mut self,
        u: &[f64],
        pairs: f64,
        index: u64,
    ) -> Result<Option<RenderPair>> {
        let each = self.pair_paths();
        let paths = (pairs * each as f64) as u64;
        if self.watch.cancelled() {
            self.stop = Some(Stop::Cancelled);
        } else if self.stop.is_none() {
            self.stop = self.limit_met(paths);
        }
        if self.stop.is_some() {
            return Ok(None);
        }
        let stretch = self.stretch(pairs, true);
        let pair = match self
            .problem
            .render(u, paths, &self.equal_shares(), index, &stretch)
        {
            Ok(pair) => pair,
            Err(_) if self.watch.cancelled() => {
                self.stop = Some(Stop::Cancelled);
                return Ok(None);
            }
            Err(error) => return Err(error),
        };
        self.spent.add(paths, &pair);
        self.pairs_left -= pairs;
        self.iteration_paths = each;
        Ok(Some(pair))
    }

    /// Camera paths spent so far.
    pub(super) fn spent_paths(&self) -> u64 {
        self.spent.paths
    }

    /// Whether the budget was used up, or the fit interrupted, before the schedule's end.
    pub(super) fn stopped(&self) -> bool {
        self.stop.is_some()
    }

    /// Writes down the iteration that this pair at `u` was rendered for. Its step moves each coordinate by minus `gain`
    /// times the derivative of the objective.
    pub(super) fn record(&mut self, u: &[f64], pair: &RenderPair, gain: &[f64]) {
        let mut gains = Matrix::zeros(gain.len(), gain.len());
        for (j, gain) in gain.iter().enumerate() {
            // The model's gradient is that of half the objective.
            gains[(j, j)] = 2.0 * gain;
        }
        self.write_down(u, pair, Some(gains));
    }

    /// The same for a search without gradients; its Monte Carlo part is that of what this pair alone would find.
    pub(super) fn record_search(&mut self, u: &[f64], pair: &RenderPair) {
        self.write_down(u, pair, None);
    }

    fn write_down(&mut self, u: &[f64], pair: &RenderPair, gains: Option<Matrix>) {
        let (space, objective) = (self.problem.space, self.problem.objective);
        let parameters = space.to_parameters(u);
        let value = objective.paired(pair);
        let (rms, rms_se) = rms_of(value, objective.n_numbers());
        let mut pool = Pool::new(objective);
        pool.push(space, u, &parameters, objective, pair);
        let model = pool.model();
        let gains = gains
            .or_else(|| inverse(&model.damped_curvature(REACH)))
            .unwrap_or_else(|| Matrix::zeros(u.len(), u.len()));
        self.history.push(Iteration {
            paths: self.iteration_paths,
            total_paths: self.spent.paths,
            wall_s: self.spent.wall_s,
            parameters: parameters.to_json(),
            paired_objective: value.value,
            paired_objective_se: value.standard_error,
            weighted_rms_percent: 100.0 * rms,
            weighted_rms_se_percent: 100.0 * rms_se,
            monte_carlo_percent: 100.0
                * model.fitted_rms(&gains, &model.monte_carlo, pool.weights()),
            accepted: true,
        });
    }

    /// How many iterations have been written down.
    pub(super) fn n_recorded(&self) -> usize {
        self.history.len()
    }

    /// Marks the iterations before `last` as not gone on from, those in `kept` excepted.
    pub(super) fn accept_only(&mut self, kept: &Range<usize>, last: usize) {
        for (k, iteration) in self.history.iter_mut().enumerate() {
            iteration.accepted = kept.contains(&k) || k >= last;
        }
    }

    /// What one iteration cost, and where that number comes from, in words.
    pub(super) fn cost_in_words(&self) -> String {
        let options = self.problem.options;
        let from = match (options.iteration_paths, options.budget) {
            (Some(_), _) => "as asked",
            (None, b) if b.paths.is_none() && b.time_s.is_none() => "the published number",
            _ => "so that all fit in the budget",
        };
        format!("{} camera paths each, {from}", self.iteration_paths)
    }

    /// Renders the pair at the result `u` and makes the linear model there.
    ///
    /// # Errors
    /// When there was no iteration, or the render fails.
    pub(super) fn finish(mut self, u: Vec<f64>) -> Result<Found> {
        if self.history.is_empty() {
            return Err(Error::new(match self.stop {
                Some(Stop::Cancelled) => "interrupted before the first iteration",
                _ => "the budget was used up before the first iteration",
            })
            .with_hint("give the fit more paths or time, or each iteration fewer paths"));
        }
        let pair = self.last_pair(&u)?;
        let Problem {
            objective,
            space,
            options,
            ..
        } = self.problem;
        let mut pool = Pool::new(objective);
        pool.push(space, &u, &space.to_parameters(&u), objective, &pair);
        let model = pool.model();
        let curvature = model.damped_curvature(REACH);
        let inverse_curvature = inverse(&curvature).ok_or_else(|| {
            Error::new("the curvature of the last render pair is not usable")
                .with_hint("give the fit more paths")
        })?;
        let fitted = |noise: &Matrix| model.fitted_rms(&inverse_curvature, noise, pool.weights());
        let (monte_carlo_rms, measurement_rms) =
            (fitted(&model.monte_carlo), fitted(&model.measurement));
        let accurate = options
            .budget
            .accuracy
            .is_some_and(|a| monte_carlo_rms <= a);
        let stop = match self.stop {
            Some(stop) => stop,
            None if accurate => Stop::Accuracy,
            None => Stop::Schedule,
        };
        Ok(Found {
            check_shares: pool.shares(&model, None),
            u,
            model,
            curvature,
            history: self.history,
            stop,
            monte_carlo_rms,
            measurement_rms,
        })
    }

    /// The pair at the result; after an interrupt, also one of this very pair, a short one that cannot be interrupted.
    fn last_pair(&mut self, u: &[f64]) -> Result<RenderPair> {
        let pairs = self.pairs * MODEL_SHARE / (1.0 + MODEL_SHARE);
        let usual = (pairs * self.iteration_paths as f64) as u64;
        // A schedule cut short may have half of what is left for the check.
        let half = 0.5 * (1.0 + SEARCH_SHARE);
        let left = self.spent.left(&self.problem.options.budget, half);
        self.pairs_left = self.pairs * MODEL_SHARE;
        if self.stop != Some(Stop::Cancelled) {
            match self.at_result(u, usual, left, MODEL_INDEX) {
                Err(_) if self.watch.cancelled() => self.stop = Some(Stop::Cancelled),
                rendered => return rendered,
            }
        }
        let moment = self.spent.moment();
        self.at_result(u, moment, left, AFTER_INTERRUPT + MODEL_INDEX)
    }

    fn at_result(
        &mut self,
        u: &[f64],
        usual: u64,
        left: Option<u64>,
        index: u64,
    ) -> Result<RenderPair> {
        let paths = usual.min(left.unwrap_or(u64::MAX)).max(self.least_paths());
        let pairs = paths as f64 / self.iteration_paths as f64;
        let stretch = self.stretch(pairs, index < AFTER_INTERRUPT);
        let shares = self.equal_shares();
        let pair = self.problem.render(u, paths, &shares, index, &stretch)?;
        self.spent.add(paths, &pair);
        Ok(pair)
    }
}
