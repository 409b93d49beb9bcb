//! What a fit found, and its file `fit.json`.
//!
//! All numbers are finite; angles wear degrees as in parameter files. Does not know how the numbers were found.

use super::bounds::Bounds;
use super::objective::{NumberWeights, PairedValue, TAU, rms_of};
use crate::base::{Context, Error, Result};
use crate::scatter::{CHANNELS, YARN_SYSTEMS};
use crate::session::{Configuration, files};
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

/// One configuration, measured and rendered at the fitted parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ConfigurationResult {
    /// The pose; in files its columns are those of `measurements.csv`.
    #[serde(flatten)]
    pub configuration: Configuration,
    /// Measured normalized radiance, r, g, b; null of a channel that was not measured.
    pub measured: [Option<f64>; CHANNELS],
    /// Its standard error.
    pub measured_se: [Option<f64>; CHANNELS],
    /// Rendered normalized radiance, times the gain if there is one: the mean of the two fresh renders.
    pub rendered: [f64; CHANNELS],
    /// Its standard error.
    pub rendered_se: [f64; CHANNELS],
    /// Rendered minus measured.
    pub residual: [Option<f64>; CHANNELS],
    /// The residual times the square root of the weight: relative to the measured channel mean (not below tau).
    pub relative_residual: [Option<f64>; CHANNELS],
    /// Weight of the channels present in the objective (Khungurn 2015 eq. 20).
    pub weight: f64,
    /// By what a robust loss has multiplied the weight; 1 without one.
    #[serde(default = "one")]
    pub robust_weight: f64,
    /// The two independent fresh renders by themselves.
    pub renders: [[f64; CHANNELS]; 2],
    /// Camera paths of both.
    pub paths: u64,
}

fn one() -> f64 {
    1.0
}

/// How well the fitted parameters reproduce the measurements, from fresh pairs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ObjectiveResult {
    /// `sum w (R1 - M)(R2 - M)`: unbiased, may be negative. With a robust loss the weights are those times `robust_weight`,
    /// here and in the residual below.
    pub paired: f64,
    /// Its standard error.
    pub se: f64,
    /// `sqrt(max(0, paired) / n)`, percent.
    pub weighted_rms_percent: f64,
    /// Its standard error, percent.
    pub weighted_rms_se_percent: f64,
    /// What measurement errors alone would leave: `sqrt(sum w se^2 / n)`, percent.
    pub measurement_rms_percent: f64,
    /// Part of the weighted rms error of the *fitted means* that comes from the fit's Monte Carlo noise, percent.
    pub fit_monte_carlo_percent: f64,
    /// Part of the same that comes from measurement errors, percent.
    pub fit_measurement_percent: f64,
    /// Relative model error added to the measurement errors in the intervals because the residual is larger than those
    /// explain, percent; 0 when they explain it.
    pub misfit_percent: f64,
    /// Numbers compared.
    pub n: usize,
    /// Camera paths of the fresh pair.
    pub paths: u64,
}

/// What can be said about a parameter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// The 95 % interval takes at most a fifth of the range.
    Determined,
    /// It takes between a fifth and a half of the range.
    WeaklyDetermined,
    /// It takes more than half of the range.
    NotDetermined,
    /// The best value lies at or beyond the lower bound.
    AtLowerBound,
    /// The best value lies at or beyond the upper bound.
    AtUpperBound,
}

impl Verdict {
    /// In words.
    pub fn words(self) -> &'static str {
        match self {
            Self::Determined => "determined",
            Self::WeaklyDetermined => "weakly determined",
            Self::NotDetermined => "not determined",
            Self::AtLowerBound => "at its lower bound",
            Self::AtUpperBound => "at its upper bound",
        }
    }
}

/// How an interval was found (docs/fit.md).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum IntervalMethod {
    /// From the curvature of the objective at the fit.
    #[default]
    Quadratic,
    /// From the objective itself, minimized over the other parameters.
    Profile,
}

impl IntervalMethod {
    /// In one word.
    pub fn word(self) -> &'static str {
        match self {
            Self::Quadratic => "quadratic",
            Self::Profile => "profile",
        }
    }
}

/// One flat parameter with its uncertainty; angles in degrees.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ParameterResult {
    /// Flat name: `c_r.r`, `beta_tt`, ...
    pub name: String,
    /// `degrees` or `1`.
    pub unit: String,
    /// Fitted value.
    pub value: f64,
    /// Where the search began.
    pub initial: f64,
    /// Lower bound.
    pub lower_bound: f64,
    /// Upper bound.
    pub upper_bound: f64,
    /// Half width of the central 68 % of the uncertainty.
    pub standard_error: f64,
    /// 68 % interval, inside the bounds.
    pub interval_68: [f64; 2],
    /// 95 % interval, inside the bounds.
    pub interval_95: [f64; 2],
    /// The distribution the intervals come from: values below which the parameter lies with the probabilities
    /// [`ParameterResult::QUANTILE_LEVELS`]. Empty in files of earlier versions.
    #[serde(default)]
    pub quantiles: Vec<f64>,
    /// Where that distribution comes from; quadratic in files of earlier versions.
    #[serde(default)]
    pub interval_method: IntervalMethod,
    /// Share of the range (in search coordinates) the 95 % interval takes.
    pub range_share: f64,
    /// The judgement.
    pub verdict: Verdict,
    /// The judgement as a sentence.
    pub sentence: String,
}

/// A scale common to all measurements, fitted beside the parameters: `measured = gain * rendered`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GainResult {
    /// The gain.
    pub value: f64,
    /// Standard deviation of the prior of its logarithm.
    pub prior_sd: f64,
    /// Half width of the central 68 % of the uncertainty.
    pub standard_error: f64,
    /// 68 % interval.
    pub interval_68: [f64; 2],
    /// 95 % interval.
    pub interval_95: [f64; 2],
    /// The same as a sentence.
    pub sentence: String,
}

impl ParameterResult {
    /// The probabilities of [`ParameterResult::quantiles`].
    pub const QUANTILE_LEVELS: [f64; 15] = [
        0.005, 0.025, 0.05, 0.1, 0.16, 0.25, 0.375, 0.5, 0.625, 0.75, 0.84, 0.9, 0.95, 0.975, 0.995,
    ];

    /// The probability that the parameter lies below `value` (in the result's unit), linear between the kept quantiles and
    /// on to the bounds; `None` when no quantiles were kept.
    pub fn probability_below(&self, value: f64) -> Option<f64> {
        let levels = Self::QUANTILE_LEVELS.into_iter();
        if self.quantiles.len() != levels.len() {
            return None;
        }
        let kept = levels.zip(self.quantiles.iter().copied());
        let mut before = (0.0, self.lower_bound);
        for (level, quantile) in kept.chain([(1.0, self.upper_bound)]) {
            if value <= quantile {
                let width = quantile - before.1;
                let part = if width > 0.0 {
                    ((value - before.1) / width).max(0.0)
                } else {
                    1.0
                };
                return Some(before.0 + part * (level - before.0));
            }
            before = (level, quantile);
        }
        Some(1.0)
    }
}

/// Whether the residuals are as large as errors explain (docs/fit.md).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Goodness {
    /// `sum e^2 / (measurement variance + render variance)` over all numbers, e the residuals of the final check.
    pub statistic: f64,
    /// Its mean when the model is right: less than the count of numbers by what the fit absorbs.
    pub expected: f64,
    /// Estimated degrees of freedom: those of a chi-square distribution with the same mean and variance, scaled.
    pub degrees_of_freedom: f64,
    /// Probability of a larger statistic when the model is right.
    pub probability: f64,
    /// The same in words.
    pub sentence: String,
}

/// The mean residual of numbers that have something in common.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Pattern {
    /// What they have in common.
    pub name: String,
    /// How many they are.
    pub numbers: usize,
    /// Mean of their relative residuals (rendered minus measured), percent.
    pub mean_percent: f64,
    /// What measurement and render errors would leave of it after the fit (standard deviation), percent.
    pub se_percent: f64,
    /// Probability of a mean as far from zero when the model is right.
    pub probability: f64,
    /// Whether it is too improbable to be the luckiest of all patterns looked at (1 % for all together).
    pub significant: bool,
    /// In words.
    pub sentence: String,
}

/// Correlations between the parameters' uncertainties.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Correlation {
    /// Flat names of rows and columns.
    pub names: Vec<String>,
    /// Symmetric, 1 on the diagonal.
    pub matrix: Vec<Vec<f64>>,
    /// Standard deviations in the coordinates of the search (docs/fit.md): with the matrix the covariance. Empty in files of
    /// earlier versions.
    #[serde(default)]
    pub search_sd: Vec<f64>,
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
    TAU
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

/// Two independent renders of a configuration beside what they are to show: weights (0 where there is no target), renders,
/// standard error of the renders' mean, target.
pub(super) type RenderedTarget = (
    NumberWeights,
    [[f64; CHANNELS]; 2],
    [f64; CHANNELS],
    [f64; CHANNELS],
);

/// Weighted rms of rendered means against other intensities, and its standard error; unbiased below the root.
pub(super) fn rms_against(rows: impl Iterator<Item = RenderedTarget>) -> (f64, f64) {
    let (mut value, mut variance, mut n) = (0.0, 0.0, 0);
    for (weights, renders, se, target) in rows {
        let mut of_configuration = 0.0_f64;
        for c in 0..CHANNELS {
            let e = renders.map(|r| r[c] - target[c]);
            // Each render has twice the variance of their mean.
            let s2 = 2.0 * se[c].powi(2);
            value += weights[c] * e[0] * e[1];
            // Channels of a configuration share paths: standard errors add.
            of_configuration += weights[c] * (2.0 * (e[0] * e[1]).max(0.0) * s2 + s2 * s2).sqrt();
        }
        variance += of_configuration.powi(2);
        n += weights.iter().filter(|w| **w > 0.0).count();
    }
    let paired = PairedValue {
        value,
        standard_error: variance.sqrt(),
    };
    rms_of(paired, n)
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
fn flat_value(parameters: &Value, name: &str) -> Option<f64> {
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
