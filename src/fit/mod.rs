//! Objective, bounded parameters, optimizer, uncertainty.
//!
//! Knows parameters by name and never a concrete model; never sees a port or a photograph. The method in equations, with
//! what is unbiased and what only consistent, is in docs/fit.md.

mod adam;
mod choice;
mod goodness;
mod gradient;
mod information;
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
mod search;
mod space;
mod suggest;
mod summary;
mod uncertainty;
mod validate;

pub use adam::AdamOptions;
pub use objective::{Objective, PairedValue, RenderPair, TAU, rms_of};
pub use options::{Budget, Method, Options};
pub use predict::{Compared, Comparison, Prediction, compare, predict};
pub use published::{Selection, SgdOptions};
pub use rescaling::{Increment, RescalingOptions};
pub use result::{
    ConfigurationResult, Correlation, Cost, FitResult, Goodness, IntervalMethod, Iteration,
    ObjectiveResult, ParameterResult, Pattern, Truth, Verdict, refuse_existing,
};
pub use suggest::{
    Aim, Knowledge, MeasuredPose, SuggestOptions, SuggestedShot, Suggestion, suggest,
};
pub use summary::three_digits;
pub use validate::{Refit, validate};

use crate::base::{Result, Watch};
use crate::render::Scene;
use crate::scatter::Parameters;
use crate::session::Measurements;
use search::{Problem, Spent};
use space::SearchSpace;

/// Finds the parameters of the scene's model that reproduce `measurements`, and how well they are known.
///
/// With a budget in paths the result is a function of the inputs and the seed alone (times excepted). The caller fills
/// in `fabric`, `measurements`, `synthetic` and `command` of the result. Cancelling keeps the best so far, with a short
/// final check.
///
/// # Errors
/// When a measurement is negative or not finite, the start is outside the bounds, a render fails or gives numbers that
/// are not finite, or the fit is cancelled before its first render is whole.
pub fn fit(
    scene: &dyn Scene,
    measurements: &Measurements,
    options: &Options,
    watch: &dyn Watch,
) -> Result<FitResult> {
    options.check()?;
    let objective = Objective::new(measurements)?;
    let start = match &options.start {
        Some(start) => start.clone(),
        None => Parameters::defaults(scene.model()),
    };
    let space = SearchSpace::new(&start)?;
    let problem = Problem {
        scene,
        objective: &objective,
        space: &space,
        options,
    };
    let mut spent = Spent::default();
    let u = space.to_search(&start)?;
    let (found, note) = match options.method {
        Method::GaussNewton => (
            search::search(&problem, &u, &mut spent, watch)?,
            String::new(),
        ),
        Method::Sgd => published::search(&problem, &u, &mut spent, watch)?,
        Method::Adam => adam::search(&problem, &u, &mut spent, watch)?,
    };
    let check = summary::FreshCheck::render(&problem, &found, &mut spent, watch)?;
    let mut result = summary::summarize(&problem, &start, &found, &check, spent)?;
    if !note.is_empty() {
        result.reason = format!("{} [{note}]", result.reason);
    }
    Ok(result)
}
