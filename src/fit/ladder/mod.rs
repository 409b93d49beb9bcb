//! No more model than the measurement needs: models of a cloth from cheap to costly are fitted in turn, and a rule says which is
//! the simplest that the data support, and apart from that whether it is good enough.
//!
//! Reflectance models come first, path-traced ones after them. The rule is in one place and replaceable ([`Rule`], [`Sparing`]);
//! rungs are anything that gives [`Evidence`] ([`Rung`]). What the ladder does *not* do: tell which cloth was measured, or vouch for
//! poses far from the measured ones. Deterministic up to the seeds of its rungs, but for the seconds.

mod facts;
mod rule;
mod surface;
mod traced;
mod words;

pub use facts::{Facts, Spread};
pub use rule::{Choice, Rule, Sparing};
pub use surface::SurfaceRung;
pub use traced::evidence;

use crate::base::{Error, Result, Watch};
use crate::scatter::{CHANNELS, Parameters};
use crate::session::Measurements;
use serde::Serialize;
use serde_json::Value;
use std::time::Instant;

/// One model of the ladder.
pub trait Rung {
    /// Name of the model.
    fn name(&self) -> String;

    /// Numbers that a fit may move.
    fn free(&self) -> usize;

    /// Whether its means are rendered by following paths; otherwise they are a formula.
    fn traced(&self) -> bool;

    /// Fits the model. `earlier` are the rungs below that were tried.
    ///
    /// # Errors
    /// As the fit's.
    fn climb(&self, facts: &Facts<'_>, earlier: &[Evidence], watch: &dyn Watch)
    -> Result<Evidence>;
}

/// What a fitted rung shows. Errors are relative to the brightness, with the weights of a fit (Khungurn 2015 eq. 20).
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Evidence {
    /// Name of the model.
    pub model: String,
    /// Numbers that the fit could move.
    pub free: usize,
    /// Whether paths were traced.
    pub traced: bool,
    /// Weighted rms residual; unbiased below the root where paths are traced.
    pub residual: f64,
    /// Its standard error by the noise of renders; 0 of formulas.
    pub residual_se: f64,
    /// Errors at the poses fitted.
    pub errors: Spread,
    /// Errors at poses whose geometry was left out of the fit; none when too few numbers are left for one.
    pub unseen: Option<Spread>,
    /// Mean squared errors of each geometry left out, in the order of [`Facts::geometries`].
    pub unseen_squares: Vec<f64>,
    /// Pose with the largest error (root mean square over channels), and that error.
    pub worst_pose: (u32, f64),
    /// Parameters on a bound.
    pub at_bounds: Vec<String>,
    /// Parameters that the poses do not determine.
    pub undetermined: Vec<String>,
    /// Starts that ended at the best optimum, and all; none where there is one start.
    pub starts: Option<[usize; 2]>,
    /// The parameters, as a file's object.
    pub parameters: Value,
    /// The same, for the rungs above to begin from.
    #[serde(skip)]
    pub begin: Option<Parameters>,
    /// Share of light at normal incidence that is reflected, per channel; none where paths are traced.
    pub albedo: Option<[f64; CHANNELS]>,
    /// Corrected information criterion over numbers at distinct geometries, residuals below the noise counted as the noise.
    pub criterion: f64,
    /// Seconds of fitting, leave-outs included.
    pub seconds: f64,
}

impl Evidence {
    /// The residual and its standard error: what renders leave unknown counts against a model.
    pub fn at_most(&self) -> f64 {
        self.residual + self.residual_se
    }
}

/// A rung of a ladder that was climbed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Step {
    /// Name of the model.
    pub model: String,
    /// Numbers that a fit may move.
    pub free: usize,
    /// Whether paths are traced.
    pub traced: bool,
    /// What it shows; none when it was not tried.
    pub evidence: Option<Evidence>,
    /// Why it was not tried, or that it cannot be told from the chosen one; may be empty.
    pub note: String,
}

/// What is asked of a ladder.
#[derive(Debug, Clone)]
pub struct LadderOptions {
    /// Weighted rms residual up to which a model is good enough.
    pub tolerance: f64,
    /// Try every rung for which there are enough numbers.
    pub all_rungs: bool,
}

/// A ladder that was climbed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Ladder {
    /// Always `goniofit-ladder-1`.
    pub format: String,
    /// All rungs, from the lowest.
    pub steps: Vec<Step>,
    /// Numbers measured, and those at distinct geometries.
    pub numbers: [usize; 2],
    /// What errors of the measurements alone leave, weighted rms.
    pub noise: f64,
    /// Residual up to which a model is good enough.
    pub tolerance: f64,
    /// The verdicts.
    pub choice: Choice,
    /// What to do, one sentence.
    pub advice: String,
    /// What the numbers must not be used for.
    pub warnings: Vec<String>,
}

impl Ladder {
    /// What the chosen rung shows.
    pub fn chosen(&self) -> Option<&Evidence> {
        let mut tried = self.steps.iter().filter_map(|s| s.evidence.as_ref());
        tried.find(|e| e.model == self.choice.model)
    }
}

/// Climbs `rungs`, the cheapest first.
///
/// # Errors
/// No rung can be fitted, or the work was cancelled before one was.
pub fn climb(
    rungs: &[Box<dyn Rung + '_>],
    measurements: &Measurements,
    options: &LadderOptions,
    rule: &dyn Rule,
    watch: &dyn Watch,
) -> Result<Ladder> {
    let facts = Facts::of(measurements, options.tolerance)?;
    let mut tried: Vec<Evidence> = Vec::new();
    let mut steps: Vec<Step> = Vec::new();
    for rung in rungs {
        let mut step = Step {
            model: rung.name(),
            free: rung.free(),
            traced: rung.traced(),
            evidence: None,
            note: String::new(),
        };
        match tried_or_not(rung.as_ref(), &facts, &tried, options, rule, watch)? {
            Ok(evidence) => {
                tried.push(evidence.clone());
                step.evidence = Some(evidence);
            }
            Err(reason) => step.note = reason,
        }
        steps.push(step);
    }
    if tried.is_empty() {
        let reasons: Vec<&str> = steps.iter().map(|s| s.note.as_str()).collect();
        return Err(
            Error::new(format!("no model could be fitted: {}", reasons.join("; ")))
                .with_hint("more poses, or one model by --model"),
        );
    }
    let banned = steps.iter().any(|s| too_few(&facts, s.free).is_some());
    let choice = rule.choose(&facts, &tried, banned);
    for step in &mut steps {
        if choice.not_separable.contains(&step.model) {
            step.note = format!("not separable from {}", choice.model);
        }
    }
    Ok(words::told(&facts, steps, choice))
}

/// Evidence, or why there is none.
fn tried_or_not(
    rung: &dyn Rung,
    facts: &Facts<'_>,
    tried: &[Evidence],
    options: &LadderOptions,
    rule: &dyn Rule,
    watch: &dyn Watch,
) -> Result<std::result::Result<Evidence, String>> {
    if let Some(reason) = too_few(facts, rung.free()) {
        return Ok(Err(reason));
    }
    if !options.all_rungs
        && let Some(reason) = rule.needless(facts, tried, rung)
    {
        return Ok(Err(reason));
    }
    if watch.cancelled() {
        return Ok(Err("interrupted before".to_owned()));
    }
    let begun = Instant::now();
    match rung.climb(facts, tried, watch) {
        Ok(evidence) => Ok(Ok(Evidence {
            criterion: facts.criterion(evidence.at_most(), evidence.free),
            seconds: begun.elapsed().as_secs_f64(),
            ..evidence
        })),
        Err(_) if watch.cancelled() => Ok(Err("interrupted".to_owned())),
        Err(error) if tried.is_empty() => Err(error),
        Err(error) => Ok(Err(format!("failed: {error}"))),
    }
}

/// Said of a rung with more parameters than the criterion can weigh.
fn too_few(facts: &Facts<'_>, free: usize) -> Option<String> {
    (facts.n_distinct <= free + 2).then(|| {
        format!(
            "needs {} numbers at distinct geometries, there are {}",
            free + 3,
            facts.n_distinct
        )
    })
}
