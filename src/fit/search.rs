//! The search: stochastic Gauss-Newton on fresh render pairs inside the parameters' bounds.
//!
//! Every iteration renders one new pair at the present point, adds it to the [`Pool`], and minimizes the pool's linear
//! model in the box of the bounds cut by a trust region (a box too). Because the pool's minimizer is the weighted mean
//! of all iterates minus one common Newton step, an iteration's share in the answer is about its share of the paths:
//! stochastic approximation with a matrix gain `n_k / sum n` (Polyak and Juditsky 1992), with renders made far away
//! forgotten. Path counts grow once steps are lost in noise. Finds a local minimum; does not restart from elsewhere.

use super::linear::{Matrix, box_quadratic, inverse};
use super::objective::{Objective, PairedValue, RenderPair, rms_of};
use super::options::{Budget, Options};
use super::pool::{LinearModel, Pool};
use super::result::Iteration;
use super::space::SearchSpace;
use crate::base::{Result, Watch};
use crate::render::{Effort, Scene};

/// Share of the budget for the search; the rest judges the result on fresh pairs.
const SEARCH_SHARE: f64 = 0.75;
/// Farthest a coordinate may move in one step, at first, at least and at most.
const TRUST: (f64, f64, f64) = (0.8, 0.05, 1.5);
/// How far from the minimum a coordinate is thought to be when a step is weighed against its noise.
const REACH: f64 = 0.6;
/// Growth of the path count once a step is smaller than twice its noise.
const GROWTH: f64 = 1.5;
/// Camera paths of the first pair, per configuration.
const FIRST_PATHS: u64 = 1500;
/// No iteration takes more than this share of the search's budget.
const LARGEST_SHARE: f64 = 0.25;
/// Monte Carlo error that no longer matters, as a fraction of the measurements' part of the error.
const BESIDE_MEASUREMENT: f64 = 0.3;

/// Why the search ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Stop {
    Accuracy,
    BesideMeasurement,
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
}

/// What stays the same during a fit.
pub(super) struct Problem<'a> {
    pub(super) scene: &'a dyn Scene,
    pub(super) objective: &'a Objective,
    pub(super) space: &'a SearchSpace,
    pub(super) options: &'a Options,
}

impl Problem<'_> {
    /// A pair of `paths` camera paths in all at `u`.
    pub(super) fn render(
        &self,
        u: &[f64],
        paths: u64,
        shares: &[f64],
        index: u64,
        watch: &dyn Watch,
    ) -> Result<RenderPair> {
        let effort = Effort::Total {
            paths: (paths / 2).max(shares.len() as u64),
            shares: shares.to_vec(),
        };
        RenderPair::render(
            self.scene,
            &self.objective.configurations(),
            &self.space.to_parameters(u),
            &effort,
            self.options.seed,
            index,
            watch,
        )
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
    let mut pool = Pool::new(objective);
    let mut history: Vec<Iteration> = Vec::new();
    let mut shares = vec![1.0; n_configurations];
    let mut paths = first_paths(&options.budget, n_configurations);
    let mut u = start.to_vec();
    let mut trust = TRUST.0;
    let mut accepted: Option<(Vec<f64>, PairedValue)> = None;
    let mut last: Option<Found> = None;
    for index in 0.. {
        let stretch = stretch(&options.budget, spent, paths, watch);
        let pair = match problem.render(&u, paths, &shares, index, &stretch) {
            Ok(pair) => pair,
            Err(_) if watch.cancelled() && last.is_some() => break,
            Err(error) => return Err(error),
        };
        spent.add(paths, &pair);
        let parameters = space.to_parameters(&u);
        pool.push(space, &u, &parameters, objective, &pair);
        let value = objective.paired(&pair);

        // Judge the step that led here by the paired objective; go back when it is worse beyond the noise.
        let worse = accepted.as_ref().is_some_and(|(_, before)| {
            value.value - before.value > 3.0 * value.standard_error.hypot(before.standard_error)
        });
        if worse {
            trust = (0.5 * trust).max(TRUST.1);
        } else {
            accepted = Some((u.clone(), value));
        }
        let base = accepted
            .as_ref()
            .map_or_else(|| u.clone(), |(u, _)| u.clone());

        let (next, model, curvature) = minimize(&pool, space, &base, trust);
        let Some(inverse_curvature) = inverse(&curvature) else {
            break;
        };
        let step: Vec<f64> = next.iter().zip(&base).map(|(a, b)| a - b).collect();
        let n = objective.n_numbers() as f64;
        let moved = (curvature.form(&step, &step) / n).sqrt();
        let noise = model.fitted_rms(&inverse_curvature, &model.monte_carlo, pool.weights());
        let measured = model.fitted_rms(&inverse_curvature, &model.measurement, pool.weights());
        if !worse && step.iter().any(|s| s.abs() > 0.99 * trust) {
            trust = (1.3 * trust).min(TRUST.2);
        }
        let (rms, rms_se) = rms_of(value, objective.n_numbers());
        history.push(Iteration {
            paths,
            total_paths: spent.paths,
            wall_s: spent.wall_s,
            parameters: parameters.to_json(),
            paired_objective: value.value,
            paired_objective_se: value.standard_error,
            weighted_rms_percent: 100.0 * rms,
            weighted_rms_se_percent: 100.0 * rms_se,
            monte_carlo_percent: 100.0 * noise,
            accepted: !worse,
        });
        shares = pool.shares(&model, Some(&inverse_curvature));
        let settled = index >= 4 && moved <= 2.0 * noise && !worse;
        let enough = match options.budget.accuracy {
            Some(accuracy) if noise <= accuracy => Some(Stop::Accuracy),
            None if measured > 0.0 && noise <= BESIDE_MEASUREMENT * measured => {
                Some(Stop::BesideMeasurement)
            }
            _ => None,
        };
        u.clone_from(&next);
        last = Some(Found {
            u: next,
            check_shares: pool.shares(&model, None),
            model,
            curvature,
            history: Vec::new(),
            stop: Stop::Cancelled,
            monte_carlo_rms: noise,
            measurement_rms: measured,
        });
        if watch.cancelled() {
            break;
        }
        let stop = if let (true, Some(stop)) = (settled, enough) {
            Some(stop)
        } else {
            next_paths(
                &mut paths,
                moved <= 2.0 * noise,
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

/// Minimizes the pool's model within the trust region around `base`, weighting renders anew by their distance to the
/// minimizer until both agree.
fn minimize(
    pool: &Pool,
    space: &SearchSpace,
    base: &[f64],
    trust: f64,
) -> (Vec<f64>, LinearModel, Matrix) {
    let mut target = base.to_vec();
    let mut model = pool.model(base, None);
    for _ in 0..3 {
        model = pool.model(&target, Some(&model.jacobian));
        let curvature = model.damped_curvature(REACH);
        let gradient = model.gradient_at(base, &model.curvature);
        let lower: Vec<f64> = (0..space.len())
            .map(|j| (space.lower()[j] - base[j]).max(-trust))
            .collect();
        let upper: Vec<f64> = (0..space.len())
            .map(|j| (space.upper()[j] - base[j]).min(trust))
            .collect();
        let step = box_quadratic(&curvature, &gradient, &lower, &upper);
        let moved: Vec<f64> = base.iter().zip(&step).map(|(b, s)| b + s).collect();
        target = space.clamped(&moved);
    }
    let curvature = model.damped_curvature(REACH);
    (target, model, curvature)
}

fn first_paths(budget: &Budget, n_configurations: usize) -> u64 {
    let usual = FIRST_PATHS * n_configurations as u64;
    let least = 64 * n_configurations as u64;
    budget
        .paths
        .map_or(usual, |n| usual.min((0.02 * n as f64) as u64))
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
