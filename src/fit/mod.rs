//! Objective, bounded parameters, optimizer, uncertainty.
//!
//! Knows parameters by name and never a concrete model; never sees a port or a photograph. The method in equations, with
//! what is unbiased and what only consistent, is in docs/fit.md.

mod adam;
mod binary;
mod bounds;
mod certainty;
mod check;
mod choice;
mod gain;
mod goodness;
mod gradient;
mod information;
mod journal;
pub mod ladder;
mod linear;
mod objective;
mod options;
mod patterns;
mod pool;
mod predict;
mod profile;
mod published;
mod rescaling;
mod result;
mod robust;
mod search;
mod side_by_side;
mod space;
mod suggest;
mod summary;
pub mod surface;
mod uncertainty;
mod validate;
mod verdict;

pub use crate::render::TAU;
pub use adam::AdamOptions;
pub use bounds::Bounds;
pub use certainty::three_digits;
pub use journal::{Journal, JournalHeader};
pub use objective::{Objective, PairedValue, RenderPair, rms_of};
pub use options::{Budget, Method, Options};
pub use predict::{Compared, Comparison, Prediction, compare, predict};
pub use published::{Selection, SgdOptions};
pub use rescaling::{Increment, RescalingOptions};
pub use result::{
    ConfigurationResult, Correlation, Cost, FitResult, GainResult, Goodness, IntervalMethod,
    Iteration, ObjectiveResult, ParameterResult, Pattern, Truth, Verdict, refuse_existing,
};
pub use robust::Loss;
pub use side_by_side::{FittedModel, FittedParameter, PoseResidual, Residuals, SideBySide};
pub use suggest::{
    Aim, Knowledge, MeasuredPose, SuggestOptions, SuggestedShot, Suggestion, suggest,
};
pub use validate::{Refit, validate};

use crate::base::{Context, Result, Watch};
use crate::render::Scene;
use crate::scatter::Parameters;
use crate::session::Measurements;
use search::{Found, Problem, Spent, Stop};
use space::SearchSpace;

/// Finds the parameters of the scene's model that reproduce `measurements`, and how well they are known.
///
/// With a budget in paths the result is a function of the inputs and the seed alone (times excepted). The caller fills
/// in `fabric`, `measurements`, `synthetic` and `command` of the result. Cancelling keeps the best so far, with a short
/// final check. A start outside `options.bounds` is moved inside.
///
/// # Errors
/// When a measurement is negative or not finite, the start is outside the model's bounds, a render fails or gives numbers that
/// are not finite, or the fit is cancelled before its first render is whole.
pub fn fit(
    scene: &dyn Scene,
    measurements: &Measurements,
    options: &Options,
    watch: &dyn Watch,
) -> Result<FitResult> {
    fit_with_journal(scene, measurements, options, None, watch)
}

/// As [`fit`]; every render pair that `journal` has is taken from it, and every other one added to it, so that a fit that
/// ended early goes on where it was. With a budget in paths the result is that of the uninterrupted fit.
///
/// # Errors
/// As [`fit`]; also when the journal cannot be written, or has another pair where one is asked for.
pub fn fit_with_journal(
    scene: &dyn Scene,
    measurements: &Measurements,
    options: &Options,
    journal: Option<&Journal>,
    watch: &dyn Watch,
) -> Result<FitResult> {
    options.check()?;
    let mut objective = Objective::with_tau(measurements, options.tau)?;
    let start = match &options.start {
        Some(start) => start.clone(),
        None => Parameters::defaults(scene.model()),
    };
    let space = SearchSpace::new(&start)?
        .within(&options.bounds)?
        .with_gain(options.gain_prior);
    let mut spent = Spent::default();
    let mut u = space.to_search(&start)?;
    let start = space.inside(&start);
    u.extend(space.gain().map(|_| 0.0));
    let mut history = Vec::new();
    let mut interrupted = None;
    let mut earlier = None;
    for (number, stage) in (1..).zip(options.loss.early_stages(options)) {
        let problem = Problem {
            scene,
            objective: &objective,
            space: &space,
            options: &stage,
            journal,
        };
        let ended = searched(&problem, &u, earlier.take(), &mut spent, watch);
        let (mut found, note) = ended.context(|| {
            format!("stage {number} of the robust fit, which has a share of the limits")
        })?;
        if found.stop == Stop::Cancelled {
            interrupted = Some((found, note));
            break;
        }
        let factors = match robust::factors(&problem, &found, &mut spent, watch) {
            Err(_) if watch.cancelled() => {
                found.stop = Stop::Cancelled;
                interrupted = Some((found, note));
                break;
            }
            factors => factors?,
        };
        history.append(&mut found.history);
        objective = objective.with_factors(factors);
        u.clone_from(&found.u);
        earlier = Some(found);
    }
    let problem = Problem {
        scene,
        objective: &objective,
        space: &space,
        options,
        journal,
    };
    let (mut found, note) = match interrupted {
        Some(found) => found,
        None => searched(&problem, &u, earlier, &mut spent, watch)?,
    };
    found.history.splice(0..0, history);
    let check = check::FreshCheck::render(&problem, &mut found, &mut spent, watch)?;
    let mut result = summary::summarize(&problem, &start, &found, &check, spent)?;
    if !note.is_empty() {
        result.reason = format!("{} [{note}]", result.reason);
    }
    Ok(result)
}

/// Where the method asked for ends from `u`, and what it has to say. An interrupt before there is anything new leaves what
/// an `earlier` stage found.
fn searched(
    problem: &Problem<'_>,
    u: &[f64],
    earlier: Option<Found>,
    spent: &mut Spent,
    watch: &dyn Watch,
) -> Result<(Found, String)> {
    let ended = match problem.options.method {
        Method::GaussNewton => {
            search::search(problem, u, spent, watch).map(|found| (found, String::new()))
        }
        Method::Sgd => published::search(problem, u, spent, watch),
        Method::Adam => adam::search(problem, u, spent, watch),
        Method::BinarySearch => binary::search(problem, u, spent, watch),
    };
    match (ended, earlier) {
        (Err(_), Some(mut found)) if watch.cancelled() => {
            found.stop = Stop::Cancelled;
            Ok((found, String::new()))
        }
        (ended, _) => ended,
    }
}
