//! The search: stochastic Gauss-Newton on fresh render pairs inside the parameters' bounds.
//!
//! First it descends: every iteration renders a new pair at the present point and takes one Gauss-Newton step from that
//! pair alone, inside the bounds and a trust region (a box too). Renders made elsewhere are forgotten: while steps are
//! large they say little about the minimum. When the paired objective no longer falls beyond its noise, it averages: pairs
//! grow, and the last few of them together, a [`Pool`], make a linear model that is minimized in the bounds. The pool's
//! minimizer is the path-weighted mean of the iterates minus one common Newton step, stochastic approximation with the
//! matrix gain `n_k / sum n` (Polyak and Juditsky 1992). Finds a local minimum; does not restart from elsewhere.

use super::journal::{Asked, Journal};
use super::linear::{Matrix, box_quadratic, inverse};
use super::objective::{Objective, PairedValue, RenderPair, rms_of};
use super::options::{Budget, Options};
use super::pool::{LinearModel, Pool};
use super::result::Iteration;
use super::space::SearchSpace;
use crate::base::{Result, Watch};
use crate::render::{Effort, Scene};

/// Share of the budget for the search; the rest judges the result on fresh pairs.
pub(super) const SEARCH_SHARE: f64 = 0.8;
/// Farthest a coordinate may move in one step, at first, at least and at most.
const TRUST: (f64, f64, f64) = (0.8, 0.05, 1.5);
/// Renders are near each other, near enough for one linear model, when the step between them moves the fitted means by no
/// more than so many standard errors.
const NEAR: f64 = 5.0;
/// How far from the minimum a coordinate is thought to be when a step is weighed against its noise.
pub(super) const REACH: f64 = 0.6;
/// Growth of the path count from pair to pair while averaging.
const GROWTH: f64 = 1.5;
/// The descent ends when the mean of this many objectives is not clearly below that of as many before.
const TREND: usize = 3;
/// How many pairs are averaged: with the growth above the last three hold 70 % of all paths.
const AVERAGED: usize = 3;
/// The descent takes at most this share of the budget.
const DESCENT_SHARE: f64 = 0.45;
/// Camera paths of the first pair, per configuration: far away a rough step is as good as a fine one.
const FIRST_PATHS: u64 = 2_000;
/// Camera paths of the descent's other pairs, per configuration.
const DESCENT_PATHS: u64 = 12_000;
/// No iteration takes more than this share of the search's budget.
const LARGEST_SHARE: f64 = 0.25;
/// Pairs from this index on are rendered after an interrupt: they judge what there is and belong to no search.
pub(super) const AFTER_INTERRUPT: u64 = 1 << 48;
/// Seconds, about, that such a pair may take.
const AFTER_INTERRUPT_S: f64 = 1.5;
/// Monte Carlo error that no longer matters, as a fraction of the measurements' part of the error.
const BESIDE_MEASUREMENT: f64 = 0.3;

/// Why the search ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Stop {
    Accuracy,
    BesideMeasurement,
    Schedule,
    Paths,
    Time,
    Cancelled,
}

/// Where the search ended.
pub(super) struct Found {
    pub(super) u: Vec<f64>,
    pub(super) model: LinearModel,
    /// Damped curvature at the end.
    pub(super) curvature: Matrix,
    pub(super) history: Vec<Iteration>,
    /// How the paths of the final check are best shared over configurations.
    pub(super) check_shares: Vec<f64>,
    pub(super) stop: Stop,
    /// Monte Carlo part of the weighted rms error of the fitted means.
    pub(super) monte_carlo_rms: f64,
    /// Measurement part of the same.
    pub(super) measurement_rms: f64,
}

/// What has been spent so far; the only clock is the scenes' own report.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Spent {
    pub(super) paths: u64,
    pub(super) wall_s: f64,
    pub(super) cpu_s: f64,
}

impl Spent {
    pub(super) fn add(&mut self, paths: u64, pair: &RenderPair) {
        self.paths += paths;
        self.wall_s += pair.wall_s();
        self.cpu_s += pair.cpu_s();
    }

    /// Camera paths that `share` of the budget still allows, at the speed seen so far; `None` when unlimited.
    pub(super) fn left(&self, budget: &Budget, share: f64) -> Option<u64> {
        let by_paths = budget
            .paths
            .map(|n| ((n as f64 * share) as u64).saturating_sub(self.paths));
        let by_time = budget
            .time_s
            .filter(|_| self.wall_s > 0.0)
            .map(|t| ((t * share - self.wall_s).max(0.0) * self.paths as f64 / self.wall_s) as u64);
        by_paths.into_iter().chain(by_time).min()
    }

    /// Camera paths of a pair after an interrupt: a tenth of all, in a moment at the speed seen so far.
    pub(super) fn moment(&self) -> u64 {
        let speed = self.paths as f64 / self.wall_s.max(1e-9);
        (self.paths / 10).min((AFTER_INTERRUPT_S * speed) as u64)
    }
}

/// What stays the same during a fit.
pub(super) struct Problem<'a> {
    pub(super) scene: &'a dyn Scene,
    pub(super) objective: &'a Objective,
    pub(super) space: &'a SearchSpace,
    pub(super) options: &'a Options,
    /// Where pairs are kept, if anywhere.
    pub(super) journal: Option<&'a Journal>,
}

impl Problem<'_> {
    /// A pair of `paths` camera paths in all at `u`; the one that was kept when there is one.
    pub(super) fn render(
        &self,
        u: &[f64],
        paths: u64,
        shares: &[f64],
        index: u64,
        watch: &dyn Watch,
    ) -> Result<RenderPair> {
        let parameters = self.space.to_parameters(u);
        let configurations = self.objective.configurations();
        let paths = (paths / 2).max(shares.len() as u64);
        let journal = self.journal.filter(|_| index < AFTER_INTERRUPT);
        let seed = self.options.seed;
        let asked = Asked::new(seed, index, paths, shares, &parameters);
        let gain = self.space.gain_at(u);
        if let Some(renders) = journal.map(|j| j.recall(&asked)).transpose()?.flatten() {
            let pair = RenderPair::recalled(renders, &configurations, &parameters)?;
            return Ok(pair.scaled(gain));
        }
        let effort = Effort::Total {
            paths,
            shares: shares.to_vec(),
        };
        let pair = RenderPair::render(
            self.scene,
            &configurations,
            &parameters,
            &effort,
            seed,
            index,
            watch,
        )?;
        if let Some(journal) = journal {
            journal.keep(asked, pair.renders())?;
        }
        Ok(pair.scaled(gain))
    }
}

/// Shows the two renders of a pair as one stretch of a longer progress bar.
pub(super) struct Stretch<'a> {
    pub(super) watch: &'a dyn Watch,
    pub(super) stage: &'static str,
    /// Fraction of the bar done before, and the fraction one render of the pair adds.
    pub(super) done: f64,
    pub(super) each: f64,
    /// Renders finished, and whether the scene has been seen past its middle.
    pub(super) state: std::sync::Mutex<(u32, f64)>,
    /// Whether an interrupt is passed on to the scene.
    pub(super) interruptible: bool,
}

impl Watch for Stretch<'_> {
    fn progress(&self, _stage: &str, done: u64, total: u64) {
        let Ok(mut state) = self.state.lock() else {
            return;
        };
        let fraction = done as f64 / total.max(1) as f64;
        // The second render begins where the first one's progress falls back.
        if fraction < state.1 - 0.5 && state.0 == 0 {
            state.0 = 1;
        }
        state.1 = fraction;
        let fraction = self.done + self.each * (f64::from(state.0) + fraction);
        let thousandths = (1000.0 * fraction.clamp(0.0, 1.0)) as u64;
        self.watch.progress(self.stage, thousandths, 1000);
    }

    fn cancelled(&self) -> bool {
        self.interruptible && self.watch.cancelled()
    }
}

/// Where the search stands.
struct State<'a> {
    problem: &'a Problem<'a>,
    /// Renders the next step is taken from.
    pool: Pool,
    /// Where the next pair is rendered.
    u: Vec<f64>,
    /// Where the next step begins.
    base: Vec<f64>,
    trust: f64,
    descending: bool,
    /// Whether the last step was short.
    near: bool,
    /// The best pair of the descent: its pool, place and paired objective.
    best: Option<(Pool, Vec<f64>, PairedValue)>,
    /// Paired objectives of the descent.
    values: Vec<PairedValue>,
}

/// A step, and what is known where it leads.
struct Step {
    u: Vec<f64>,
    model: LinearModel,
    curvature: Matrix,
    inverse_curvature: Matrix,
    /// Weighted rms change of the means that the step makes.
    moved: f64,
    /// Monte Carlo and measurement part of the weighted rms error of the fitted means.
    noise: f64,
    measured: f64,
}

impl<'a> State<'a> {
    fn new(problem: &'a Problem<'a>, start: &[f64]) -> Self {
        Self {
            problem,
            pool: Pool::new(problem.objective),
            u: start.to_vec(),
            base: start.to_vec(),
            trust: TRUST.0,
            descending: true,
            near: false,
            best: None,
            values: Vec::new(),
        }
    }

    /// Adds a pair rendered at `u`; false when it went back from there.
    fn take_in(&mut self, pair: &RenderPair) -> bool {
        let Problem {
            objective, space, ..
        } = self.problem;
        let value = objective.paired(pair);
        let parameters = space.to_parameters(&self.u);
        let averaging = !self.descending && self.near;
        let kept = if averaging { AVERAGED - 1 } else { 0 };
        self.pool.keep_latest(kept);
        self.pool.push(space, &self.u, &parameters, objective, pair);
        self.base.clone_from(&self.u);
        if !self.descending {
            return true;
        }
        self.values.push(value);
        if let Some((pool, u, best)) = &self.best {
            let noise = value.standard_error.hypot(best.standard_error);
            if value.value - best.value > 3.0 * noise {
                // Beyond doubt worse: a shorter step from the best pair.
                self.pool.clone_from(pool);
                self.base.clone_from(u);
                self.trust = (0.5 * self.trust).max(TRUST.1);
                return false;
            }
        }
        if self
            .best
            .as_ref()
            .is_none_or(|(_, _, best)| value.value < best.value)
        {
            self.best = Some((self.pool.clone(), self.u.clone(), value));
        }
        true
    }

    /// True while the paired objectives of the descent still fall beyond their noise.
    fn still_falls(&self) -> bool {
        let Some(first) = self.values.len().checked_sub(2 * TREND) else {
            return true;
        };
        let mean =
            |values: &[PairedValue]| values.iter().map(|v| v.value).sum::<f64>() / TREND as f64;
        let (before, now) = self.values[first..].split_at(TREND);
        let variance: f64 = self.values[first..]
            .iter()
            .map(|v| v.standard_error.powi(2))
            .sum();
        mean(before) - mean(now) > variance.sqrt() / TREND as f64
    }

    /// Minimizes the pool's model inside the bounds and the trust region; `None` when its curvature is not usable.
    fn step(&mut self) -> Option<Step> {
        let Problem {
            objective, space, ..
        } = self.problem;
        let model = self.pool.model();
        let curvature = model.marquardt_curvature();
        let gradient = model.gradient_at(&self.base, &model.curvature);
        let side = |bounds: &[f64], toward: f64| -> Vec<f64> {
            let room = |(bound, base): (&f64, &f64)| {
                toward * (toward * (bound - base)).clamp(0.0, self.trust)
            };
            bounds.iter().zip(&self.base).map(room).collect()
        };
        let (lower, upper) = (side(space.lower(), -1.0), side(space.upper(), 1.0));
        let step = box_quadratic(&curvature, &gradient, &lower, &upper);
        let next: Vec<f64> = self.base.iter().zip(&step).map(|(b, s)| b + s).collect();
        let damped = model.damped_curvature(REACH);
        let inverse_curvature = inverse(&damped)?;
        if step.iter().any(|s| s.abs() > 0.99 * self.trust) {
            self.trust = (1.3 * self.trust).min(TRUST.2);
        }
        let fitted =
            |noise: &Matrix| model.fitted_rms(&inverse_curvature, noise, self.pool.weights());
        let moved = (curvature.form(&step, &step) / objective.n_numbers() as f64).sqrt();
        let noise = fitted(&model.monte_carlo);
        self.near = moved <= NEAR * noise;
        Some(Step {
            u: space.clamped(&next),
            moved,
            noise,
            measured: fitted(&model.measurement),
            model,
            curvature: damped,
            inverse_curvature,
        })
    }
}

/// Runs the search from `start`.
///
/// # Errors
/// When a render fails, or is cancelled before the first pair is whole.
pub(super) fn search(
    problem: &Problem<'_>,
    start: &[f64],
    spent: &mut Spent,
    watch: &dyn Watch,
) -> Result<Found> {
    let Problem {
        objective,
        space,
        options,
        ..
    } = problem;
    let n_configurations = objective.intensities().len();
    let mut state = State::new(problem, start);
    let mut history: Vec<Iteration> = Vec::new();
    let mut shares = vec![1.0; n_configurations];
    let mut paths = at_most(FIRST_PATHS, &options.budget, n_configurations);
    let mut last: Option<Found> = None;
    for index in 0.. {
        let stretch = stretch(&options.budget, spent, paths, watch);
        let pair = match problem.render(&state.u, paths, &shares, index, &stretch) {
            Ok(pair) => pair,
            Err(_) if watch.cancelled() && last.is_some() => break,
            Err(error) => return Err(error),
        };
        spent.add(paths, &pair);
        let rendered_at = space.to_parameters(&state.u);
        let accepted = state.take_in(&pair);
        let Some(step) = state.step() else { break };
        let value = objective.paired(&pair);
        let (rms, rms_se) = rms_of(value, objective.n_numbers());
        history.push(Iteration {
            paths,
            total_paths: spent.paths,
            wall_s: spent.wall_s,
            parameters: rendered_at.to_json(),
            paired_objective: value.value,
            paired_objective_se: value.standard_error,
            weighted_rms_percent: 100.0 * rms,
            weighted_rms_se_percent: 100.0 * rms_se,
            monte_carlo_percent: 100.0 * step.noise,
            accepted,
        });
        let leverage = (!state.descending).then_some(&step.inverse_curvature);
        shares = state.pool.shares(&step.model, leverage);
        let settled = !state.descending && step.moved <= 2.0 * step.noise;
        let enough = match options.budget.accuracy {
            Some(accuracy) if step.noise <= accuracy => Some(Stop::Accuracy),
            None if step.measured > 0.0 && step.noise <= BESIDE_MEASUREMENT * step.measured => {
                Some(Stop::BesideMeasurement)
            }
            _ => None,
        };
        state.u.clone_from(&step.u);
        last = Some(Found {
            check_shares: state.pool.shares(&step.model, None),
            u: step.u,
            model: step.model,
            curvature: step.curvature,
            history: Vec::new(),
            stop: Stop::Cancelled,
            monte_carlo_rms: step.noise,
            measurement_rms: step.measured,
        });
        if watch.cancelled() {
            break;
        }
        if state.descending
            && (!state.still_falls() || spent.left(&options.budget, DESCENT_SHARE) == Some(0))
        {
            state.descending = false;
        }
        if state.descending {
            paths = at_most(DESCENT_PATHS, &options.budget, n_configurations);
        }
        let stop = if let (true, Some(stop)) = (settled, enough) {
            Some(stop)
        } else {
            next_paths(
                &mut paths,
                !state.descending,
                options,
                spent,
                n_configurations,
            )
        };
        if let (Some(stop), Some(found)) = (stop, last.as_mut()) {
            found.stop = stop;
            break;
        }
    }
    let mut found = last.ok_or_else(|| {
        crate::base::Error::new("the curvature of the first render pair is not usable")
            .with_hint("give the fit more paths")
    })?;
    found.history = history;
    Ok(found)
}

/// Camera paths of a pair with `each` for each configuration, but no more than a twentieth of the budget.
fn at_most(each: u64, budget: &Budget, n_configurations: usize) -> u64 {
    let usual = each * n_configurations as u64;
    let least = 64 * n_configurations as u64;
    budget
        .paths
        .map_or(usual, |n| usual.min((0.05 * n as f64) as u64))
        .max(least)
}

/// Chooses the next pair's paths, or says that the budget is spent.
fn next_paths(
    paths: &mut u64,
    lost_in_noise: bool,
    options: &Options,
    spent: &Spent,
    n_configurations: usize,
) -> Option<Stop> {
    let budget = &options.budget;
    if lost_in_noise {
        *paths = (*paths as f64 * GROWTH) as u64;
    }
    // The whole search's budget at the speed seen so far bounds one iteration.
    let Some(left) = spent.left(budget, SEARCH_SHARE) else {
        *paths = (*paths).min(spent.paths);
        return None;
    };
    let whole = (left + spent.paths) as f64;
    let largest = (LARGEST_SHARE * whole) as u64;
    *paths = (*paths).min(largest).max(64 * n_configurations as u64);
    if left < *paths + *paths / 2 {
        // One last pair takes what is left, if that is worth a pair.
        if left < *paths / 2 {
            let time_ended = budget.time_s.is_some()
                && spent.left(
                    &Budget {
                        paths: None,
                        ..*budget
                    },
                    SEARCH_SHARE,
                ) == Some(left);
            return Some(if time_ended { Stop::Time } else { Stop::Paths });
        }
        *paths = left;
    }
    None
}

fn stretch<'a>(budget: &Budget, spent: &Spent, paths: u64, watch: &'a dyn Watch) -> Stretch<'a> {
    let whole = spent
        .left(budget, 1.0)
        .or(budget.paths)
        .map_or(2.0 * (spent.paths + paths) as f64, |left| {
            (left + spent.paths) as f64
        })
        .max(1.0);
    Stretch {
        watch,
        stage: "fit: search",
        done: spent.paths as f64 / whole,
        each: 0.5 * paths as f64 / whole,
        state: std::sync::Mutex::new((0, 0.0)),
        interruptible: true,
    }
}
