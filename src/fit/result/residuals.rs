//! What is left between measurements and renders: by configuration, in all, in groups.

use crate::fit::objective::{NumberWeights, PairedValue, rms_of};
use crate::scatter::CHANNELS;
use crate::session::Configuration;
use serde::{Deserialize, Serialize};

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

/// Two independent renders of a configuration beside what they are to show: weights (0 where there is no target), renders,
/// standard error of the renders' mean, target.
pub(in crate::fit) type RenderedTarget = (
    NumberWeights,
    [[f64; CHANNELS]; 2],
    [f64; CHANNELS],
    [f64; CHANNELS],
);

/// Weighted rms of rendered means against other intensities, and its standard error; unbiased below the root.
pub(in crate::fit) fn rms_against(rows: impl Iterator<Item = RenderedTarget>) -> (f64, f64) {
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
