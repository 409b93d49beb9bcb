//! What a fit found, and its file `fit.json`.
//!
//! All numbers are finite; angles wear degrees as in parameter files. Does not know how the numbers were found.

mod certainty;
mod residuals;

pub use certainty::{Correlation, GainResult, IntervalMethod, ParameterResult, Verdict};
pub(super) use residuals::rms_against;
pub use residuals::{ConfigurationResult, Goodness, ObjectiveResult, Pattern};

use super::bounds::Bounds;
use crate::base::{Context, Error, Result};
use crate::scatter::{CHANNELS, YARN_SYSTEMS};
use crate::session::files;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

/// One iteration of the search.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Iteration {
    /// Camera paths of this iteration's pair.
    pub paths: u64,
    /// Camera paths so far.
    pub total_paths: u64,
    /// Seconds of rendering so far.
    pub wall_s: f64,
    /// Where the pair was rendered, as a parameter file's object.
    pub parameters: Value,
    /// Unbiased estimate of the objective there.
    pub paired_objective: f64,
    /// Its standard error.
    pub paired_objective_se: f64,
    /// Weighted rms residual there, percent.
    pub weighted_rms_percent: f64,
    /// Its standard error.
    pub weighted_rms_se_percent: f64,
    /// Monte Carlo part of the weighted rms error of the fitted means after this iteration, percent.
    pub monte_carlo_percent: f64,
    /// False when the search did not go on from here: the objective had grown beyond the noise, or another learning rate
    /// was better.
    pub accepted: bool,
}

/// What the fit cost.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cost {
    /// Seconds of rendering.
    pub wall_s: f64,
    /// CPU seconds of all threads.
    pub cpu_s: f64,
    /// Camera paths, search and final check together.
    pub paths: u64,
}

/// The known truth of a synthetic session.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    /// The true parameters, as a parameter file's object.
    pub parameters: Value,
    /// The same as flat values, in the order and units of [`FitResult::uncertainty`].
    pub values: Vec<f64>,
    /// Noise-free normalized radiances, in the order of [`FitResult::configs`].
    pub intensities: Vec<[f64; CHANNELS]>,
    /// Weighted rms of the fitted means against them where they were measured, percent, from the fresh pair (unbiased below
    /// the root).
    pub weighted_rms_percent: f64,
    /// Its standard error, percent.
    pub weighted_rms_se_percent: f64,
}

/// The outcome of a fit: the content of `fit.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FitResult {
    /// Always `goniofit-fit-1`.
    pub format: String,
    /// Fitted parameters, as a parameter file's object.
    pub parameters: Value,
    /// The scattering model.
    pub model: String,
    /// The fabric the renders show; filled in by the caller.
    pub fabric: String,
    /// Where the measurements came from; filled in by the caller.
    pub measurements: String,
    /// Whether the measurements are synthetic, when known.
    pub synthetic: Option<bool>,
    /// Whether parameters came to rest, accurately enough, at a residual within the tolerance.
    pub converged: bool,
    /// Why, or why not.
    pub reason: String,
    /// Fit quality.
    pub objective: ObjectiveResult,
    /// Whether the residuals are as large as errors explain; none where a number has no error, and in files of earlier
    /// versions.
    #[serde(default)]
    pub goodness: Option<Goodness>,
    /// Mean residuals of groups of configurations and of channels. Empty in files of earlier versions.
    #[serde(default)]
    pub patterns: Vec<Pattern>,
    /// Names of parameters the data do not determine.
    pub not_determined: Vec<String>,
    /// Every flat parameter with its intervals.
    pub uncertainty: Vec<ParameterResult>,
    /// The scale of all measurements, when it was fitted; not a parameter of the model.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub gain: Option<GainResult>,
    /// How residuals count: `squared`, or a robust loss.
    #[serde(default = "squared")]
    pub loss: String,
    /// Configurations darker than this have no more weight; the published 0.02 in files of earlier versions.
    #[serde(default = "published_tau")]
    pub tau: f64,
    /// Bounds that were asked for, narrower than the model's own: angles in degrees.
    #[serde(skip_serializing_if = "Bounds::is_empty", default)]
    pub bounds: Bounds,
    /// What lay under the cloth, as a command line says it; filled in by the caller. None where it was not said: black.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub plate: Option<String>,
    /// Correlations of those.
    pub correlation: Correlation,
    /// Every configuration, measured and rendered.
    pub configs: Vec<ConfigurationResult>,
    /// Where the search began.
    pub initial_parameters: Value,
    /// The search method.
    pub method: String,
    /// The user's seed.
    pub seed: u64,
    /// Residual above which the model is said not to explain the data, percent.
    pub tolerance_percent: f64,
    /// Program versions.
    pub versions: BTreeMap<String, String>,
    /// What it cost.
    pub time: Cost,
    /// The search, iteration by iteration.
    pub history: Vec<Iteration>,
    /// The command that repeats the fit; filled in by the caller.
    pub command: String,
    /// The truth, when the session is synthetic and it is known.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub truth: Option<Truth>,
}

fn published_tau() -> f64 {
    crate::render::TAU
}

fn squared() -> String {
    super::Loss::Squared.name()
}

impl FitResult {
    /// By what the renders are multiplied before they are compared with measurements; 1 when no gain was fitted.
    pub fn gain_value(&self) -> f64 {
        self.gain.as_ref().map_or(1.0, |g| g.value)
    }

    /// Which configurations a robust loss let count less, as a sentence; none when the loss was not robust.
    pub fn outliers_in_words(&self) -> Option<String> {
        if self.loss == squared() {
            return None;
        }
        let list: Vec<String> = self
            .configs
            .iter()
            .filter(|c| c.robust_weight < 1.0)
            .map(|c| format!("{} to {:.3}", c.configuration.id, c.robust_weight))
            .collect();
        Some(match list.len() {
            0 => format!("robust loss {}: no configuration counts less", self.loss),
            _ => format!(
                "robust loss {}: weights reduced of configuration {}; the residual is weighted so",
                self.loss,
                list.join(", ")
            ),
        })
    }

    /// The value of [`FitResult::format`].
    pub const FORMAT: &'static str = "goniofit-fit-1";

    /// Adds the known truth of a synthetic session: parameters as a file's object, and noise-free intensities in the
    /// order of [`FitResult::configs`].
    ///
    /// # Errors
    /// When a parameter is missing or the number of intensities differs.
    pub fn add_truth(
        &mut self,
        parameters: Value,
        intensities: Vec<[f64; CHANNELS]>,
    ) -> Result<()> {
        if intensities.len() != self.configs.len() {
            return Err(Error::new(format!(
                "truth: {} intensities for {} configurations",
                intensities.len(),
                self.configs.len()
            )));
        }
        let values = self
            .uncertainty
            .iter()
            .map(|p| {
                flat_value(&parameters, &p.name)
                    .ok_or_else(|| Error::new(format!("truth: parameter {} is missing", p.name)))
            })
            .collect::<Result<_>>()?;
        let gain = self.gain_value();
        let (weighted_rms, se) =
            rms_against(self.configs.iter().zip(&intensities).map(|(c, truth)| {
                let weights = c.measured.map(|m| m.map_or(0.0, |_| c.weight));
                let renders = c.renders.map(|r| r.map(|x| x / gain));
                (weights, renders, c.rendered_se.map(|x| x / gain), *truth)
            }));
        self.truth = Some(Truth {
            parameters,
            values,
            intensities,
            weighted_rms_percent: 100.0 * weighted_rms,
            weighted_rms_se_percent: 100.0 * se,
        });
        Ok(())
    }

    /// The text of `fit.json`.
    ///
    /// # Errors
    /// Only if the JSON writer fails.
    pub fn to_json(&self) -> Result<String> {
        let text =
            serde_json::to_string_pretty(self).context(|| "fit cannot be written as JSON")?;
        Ok(text + "\n")
    }

    /// Reads a `fit.json`.
    ///
    /// # Errors
    /// When the file cannot be read or is not one.
    pub fn read(path: &Path) -> Result<Self> {
        let text = files::read_text(path)?;
        let result: Self = serde_json::from_str(&text)
            .context(|| format!("{} is not a fit.json", path.display()))
            .map_err(|e| e.with_hint("make one with `goniofit fit`"))?;
        if result.format != Self::FORMAT {
            return Err(Error::new(format!(
                "{}: format '{}' where '{}' was expected",
                path.display(),
                result.format,
                Self::FORMAT
            )));
        }
        Ok(result)
    }

    /// Writes `fit.json` whole or not at all.
    ///
    /// # Errors
    /// When the file exists and `force` is false, or the disk refuses.
    pub fn write(&self, path: &Path, force: bool) -> Result<()> {
        if !force {
            refuse_existing(path)?;
        }
        files::write_atomic(path, self.to_json()?.as_bytes())
    }
}

/// Fails when there is a fit at `path` already: to be asked before any work is done.
///
/// # Errors
/// When the file exists.
pub fn refuse_existing(path: &Path) -> Result<()> {
    if path.exists() {
        return Err(Error::new(format!("{} exists already", path.display()))
            .with_hint("choose another --out folder, or --force to replace the fit"));
    }
    Ok(())
}

/// The number a flat name (`c_r.g`, `beta_tt`, `weft.c_r.g`) has in a parameter file's object; one without yarn systems
/// serves all of them.
pub(super) fn flat_value(parameters: &Value, name: &str) -> Option<f64> {
    if let Some((system, own)) = name.split_once('.')
        && YARN_SYSTEMS.contains(&system)
    {
        return flat_value(parameters.get(system).unwrap_or(parameters), own);
    }
    let (key, channel) = match name.split_once('.') {
        Some((key, channel)) => (key, ["r", "g", "b"].iter().position(|c| *c == channel)?),
        None => (name, 0),
    };
    let value = parameters
        .get(key)
        .or_else(|| parameters.get(format!("{key}_deg")))?;
    match value {
        Value::Array(list) => list.get(channel)?.as_f64(),
        number => number.as_f64(),
    }
}
