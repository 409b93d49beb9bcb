//! What is known of each parameter, of the gain, and of how parameters trade off.

use serde::{Deserialize, Serialize};

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
