//! The final check: a render pair at the result that the search has never seen, and paths recorded there for profiles.

use super::linear::{box_quadratic, inverse};
use super::objective::{PairedValue, RenderPair};
use super::pool::Pool;
use super::profile::Recorded;
use super::search::{AFTER_INTERRUPT, Found, Problem, Spent, Stop, Stretch};
use crate::base::{Result, Watch};
use crate::render::{Effort, Request};

/// Pair index of the final check, far from those of the search.
const CHECK_INDEX: u64 = 1 << 40;
/// Pair index of the recorded paths, not one of predictions either.
const RECORD_INDEX: u64 = 3 << 40;
/// Most paths that are recorded, both sets together: evaluating them once takes about 0.02 seconds.
const MOST_RECORDED: u64 = 200_000;

/// A pair at the fitted parameters that the search has never seen.
pub(super) struct FreshCheck {
    pub(super) pair: RenderPair,
    /// Paths for profiles, where the scene can record.
    pub(super) recorded: Option<Recorded>,
    pub(super) paths: u64,
    pub(super) value: PairedValue,
    /// Weighted rms change of the means that a full Newton step from this pair would make, and its noise.
    pub(super) moved: (f64, f64),
}

impl FreshCheck {
    /// Renders the pair with what the search left of the budget, at most a third of what it used. After an interrupt, also
    /// one of this very pair, a short one that cannot be interrupted.
    pub(super) fn render(
        problem: &Problem<'_>,
        found: &mut Found,
        spent: &mut Spent,
        watch: &dyn Watch,
    ) -> Result<Self> {
        let objective = problem.objective;
        let least = 64 * objective.intensities().len() as u64;
        let left = spent.left(&problem.options.budget, 1.0).unwrap_or(u64::MAX);
        let stretch = |interruptible: bool| Stretch {
            watch,
            stage: "fit: final check",
            done: 0.0,
            each: 0.5,
            state: std::sync::Mutex::new((0, 0.0)),
            interruptible,
        };
        let mut recorded = None;
        let mut whole = None;
        if found.stop != Stop::Cancelled {
            let all = (spent.paths / 3).min(left).max(least);
            let ended = Self::recorded_and_rendered(problem, found, all, spent, &stretch(true));
            match ended {
                Err(_) if watch.cancelled() => {}
                ended => (recorded, whole) = ended.map(|(r, pair)| (r, Some(pair)))?,
            }
        }
        let (pair, paths) = match whole {
            Some(rendered) => rendered,
            None => {
                found.stop = Stop::Cancelled;
                let (index, paths) = (
                    AFTER_INTERRUPT + CHECK_INDEX,
                    spent.moment().min(left).max(least),
                );
                let stretch = stretch(false);
                let pair = problem.render(&found.u, paths, &found.check_shares, index, &stretch)?;
                (pair, paths)
            }
        };
        spent.add(paths, &pair);
        Ok(Self {
            value: objective.paired(&pair),
            moved: newton_move(problem, found, &pair),
            pair,
            recorded,
            paths,
        })
    }

    /// With `paths` in all: a recording where the scene can make one, and the pair with its paths.
    fn recorded_and_rendered(
        problem: &Problem<'_>,
        found: &Found,
        paths: u64,
        spent: &mut Spent,
        watch: &dyn Watch,
    ) -> Result<(Option<Recorded>, (RenderPair, u64))> {
        let recorded = record(problem, found, paths / 4, spent, watch)?;
        let paths = match &recorded {
            Some(_) => paths - (paths / 4).min(MOST_RECORDED),
            None => paths,
        };
        let pair = problem.render(&found.u, paths, &found.check_shares, CHECK_INDEX, watch)?;
        Ok((recorded, (pair, paths)))
    }
}

/// Records paths for profiles, two times half of `paths` or of the most.
fn record(
    problem: &Problem<'_>,
    found: &Found,
    paths: u64,
    spent: &mut Spent,
    watch: &dyn Watch,
) -> Result<Option<Recorded>> {
    let paths = paths.min(MOST_RECORDED);
    let configurations = problem.objective.configurations();
    // Profiles know of no gain.
    if paths < 128 * configurations.len() as u64 || problem.space.gain().is_some() {
        return Ok(None);
    }
    let request = Request {
        configurations: &configurations,
        parameters: &problem.space.to_parameters(&found.u),
        effort: Effort::Total {
            paths: paths / 2,
            shares: found.check_shares.clone(),
        },
        seed: problem.options.seed,
        stream: 0,
    };
    let recorded = Recorded::new(problem.scene, &request, RECORD_INDEX, watch)?;
    if let Some(recorded) = &recorded {
        spent.paths += paths;
        spent.wall_s += recorded.wall_s;
        spent.cpu_s += recorded.cpu_s;
    }
    Ok(recorded)
}

fn newton_move(problem: &Problem<'_>, found: &Found, pair: &RenderPair) -> (f64, f64) {
    let (space, objective) = (problem.space, problem.objective);
    let mut pool = Pool::new(objective);
    pool.push(
        space,
        &found.u,
        &space.to_parameters(&found.u),
        objective,
        pair,
    );
    let fresh = pool.model();
    let offset =
        |side: &[f64]| -> Vec<f64> { side.iter().zip(&found.u).map(|(s, u)| s - u).collect() };
    let step = box_quadratic(
        &found.curvature,
        &fresh.gradient,
        &offset(space.lower()),
        &offset(space.upper()),
    );
    let n = objective.n_numbers() as f64;
    let noise = inverse(&found.curvature).map_or(0.0, |inverse| {
        fresh.fitted_rms(&inverse, &fresh.monte_carlo, pool.weights())
    });
    (
        (found.curvature.form(&step, &step) / n).sqrt(),
        noise.hypot(found.monte_carlo_rms),
    )
}
