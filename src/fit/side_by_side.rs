//! Several models fitted to the same measurements, side by side: `compare.json`.
//!
//! Residuals are those of fresh renders (`predict`), weighted as in the fit. Does not choose a model.

use super::objective::relative_weights;
use super::predict::{Compared, Comparison};
use super::result::{FitResult, flat_value, rms_against};
use super::{ParameterResult, Verdict};
use crate::base::{Context, Error, Result};
use crate::scatter::CHANNELS;
use crate::session::{Configuration, files};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::Path;

/// The content of `compare.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SideBySide {
    /// Always `goniofit-compare-1`.
    pub format: String,
    /// The fabric all models stand for.
    pub fabric: String,
    /// Whether the measurements were rendered.
    pub synthetic: bool,
    /// The model the measurements were rendered with, if they were.
    pub truth_model: Option<String>,
    /// Its parameters, as a parameter file's object.
    pub truth: Option<Value>,
    /// How the scan was made and what was found in it.
    pub scan: Value,
    /// The user's seed.
    pub seed: u64,
    /// The command that made it.
    pub command: String,
    /// The models, in the order of the report.
    pub models: Vec<FittedModel>,
}

/// One model's fit, and how it reproduces measurements.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FittedModel {
    /// Short name.
    pub name: String,
    /// The scattering model.
    pub model: String,
    /// The fabric it was rendered on.
    pub fabric: String,
    /// Whether the fit converged, and why or why not.
    pub converged: bool,
    /// See `converged`.
    pub reason: String,
    /// Seconds of rendering of the fit.
    pub wall_s: f64,
    /// Its CPU seconds.
    pub cpu_s: f64,
    /// Its camera paths.
    pub paths: u64,
    /// Fitted parameters; angles in degrees.
    pub parameters: Vec<FittedParameter>,
    /// At the poses of the fit.
    pub fitted: Residuals,
    /// At poses that no fit has seen.
    pub validation: Option<Residuals>,
}

/// A fitted parameter beside the truth.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FittedParameter {
    /// Flat name: `c_r.r`, `beta_tt`, ...
    pub name: String,
    /// `degrees` or `1`.
    pub unit: String,
    /// Fitted value.
    pub value: f64,
    /// 95 % interval.
    pub interval_95: [f64; 2],
    /// What can be said about it.
    pub verdict: Verdict,
    /// The value of this name in the truth, if there is one: of the same meaning where the model is the truth's.
    pub truth: Option<f64>,
}

/// How well a model reproduces a list of measurements.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Residuals {
    /// Weighted rms residual, percent.
    pub weighted_rms_percent: f64,
    /// Its standard error.
    pub weighted_rms_se_percent: f64,
    /// Root mean square residual in units of all stated errors.
    pub rms_z: f64,
    /// Pose by pose.
    pub configs: Vec<PoseResidual>,
}

/// A pose, measured and predicted. Relative numbers are residuals times the square root of the weight: percent of the pose's
/// brightness, and of tau below it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PoseResidual {
    /// The pose.
    #[serde(flatten)]
    pub configuration: Configuration,
    /// Measured normalized radiance.
    pub measured: [Option<f64>; CHANNELS],
    /// Its standard error.
    pub measured_se: [Option<f64>; CHANNELS],
    /// Predicted normalized radiance.
    pub predicted: [f64; CHANNELS],
    /// Standard error of the renders it comes from.
    pub predicted_se: [f64; CHANNELS],
    /// Predicted minus measured, relative.
    pub relative_percent: [Option<f64>; CHANNELS],
    /// Its standard error from renders and measurement.
    pub relative_se_percent: [Option<f64>; CHANNELS],
    /// Mean of `relative_percent` over the channels: how much too bright the model is.
    pub brightness_percent: f64,
    /// Its standard error; channels share paths, so theirs add.
    pub brightness_se_percent: f64,
    /// Weighted rms of the pose's channels, unbiased below the root.
    pub rms_percent: f64,
    /// Its standard error, of the renders.
    pub rms_se_percent: f64,
}

impl FittedModel {
    /// A fit with its comparisons at the poses it was made from and, if there are any, at others.
    pub fn new(
        name: &str,
        fit: &FitResult,
        truth: Option<&Value>,
        fitted: &Comparison,
        validation: Option<&Comparison>,
    ) -> Self {
        let beside = |p: &ParameterResult| FittedParameter {
            name: p.name.clone(),
            unit: p.unit.clone(),
            value: p.value,
            interval_95: p.interval_95,
            verdict: p.verdict,
            truth: truth.and_then(|t| flat_value(t, &p.name)),
        };
        Self {
            name: name.to_owned(),
            model: fit.model.clone(),
            fabric: fit.fabric.clone(),
            converged: fit.converged,
            reason: fit.reason.clone(),
            wall_s: fit.time.wall_s,
            cpu_s: fit.time.cpu_s,
            paths: fit.time.paths,
            parameters: fit.uncertainty.iter().map(beside).collect(),
            fitted: Residuals::new(fitted, fit.tau),
            validation: validation.map(|v| Residuals::new(v, fit.tau)),
        }
    }

    /// Names of the parameters with one of these verdicts.
    pub fn named(&self, verdicts: &[Verdict]) -> Vec<&str> {
        let chosen = |p: &&FittedParameter| verdicts.contains(&p.verdict);
        let chosen = self.parameters.iter().filter(chosen);
        chosen.map(|p| p.name.as_str()).collect()
    }
}

impl Residuals {
    fn new(comparison: &Comparison, tau: f64) -> Self {
        let [rms, se] = comparison.weighted_rms_percent;
        let pose = |row: &Compared| PoseResidual::new(row, tau);
        Self {
            weighted_rms_percent: rms,
            weighted_rms_se_percent: se,
            rms_z: comparison.rms_z,
            configs: comparison.rows.iter().map(pose).collect(),
        }
    }
}

impl PoseResidual {
    fn new(row: &Compared, tau: f64) -> Self {
        let (p, m) = (&row.prediction, &row.measured);
        let weights = relative_weights(m, tau);
        let relative = |c: usize| Some(100.0 * weights[c].sqrt() * row.residual[c]?);
        let error = |c: usize| {
            let se = p.monte_carlo_se[c].hypot(m.standard_error[c]);
            m.present[c].then_some(100.0 * weights[c].sqrt() * se)
        };
        let relative_percent = std::array::from_fn(relative);
        let relative_se_percent = std::array::from_fn(error);
        let (rms, rms_se) = rms_against(std::iter::once((
            weights,
            p.renders,
            p.monte_carlo_se,
            m.mean,
        )));
        Self {
            configuration: p.configuration,
            measured: m.where_present(m.mean),
            measured_se: m.where_present(m.standard_error),
            predicted: p.mean,
            predicted_se: p.monte_carlo_se,
            brightness_percent: mean(&relative_percent),
            brightness_se_percent: mean(&relative_se_percent),
            relative_percent,
            relative_se_percent,
            rms_percent: 100.0 * rms,
            rms_se_percent: 100.0 * rms_se,
        }
    }
}

/// The mean of those that are there; a pose has at least one.
fn mean(numbers: &[Option<f64>; CHANNELS]) -> f64 {
    let present = numbers.iter().flatten();
    present.clone().sum::<f64>() / present.count().max(1) as f64
}

impl SideBySide {
    /// The value of [`SideBySide::format`].
    pub const FORMAT: &'static str = "goniofit-compare-1";

    /// The text of `compare.json`.
    ///
    /// # Errors
    /// Only if the JSON writer fails.
    pub fn to_json(&self) -> Result<String> {
        let text = serde_json::to_string_pretty(self);
        Ok(text.context(|| "the comparison cannot be written as JSON")? + "\n")
    }

    /// Reads a `compare.json`.
    ///
    /// # Errors
    /// When the file cannot be read or is not one.
    pub fn read(path: &Path) -> Result<Self> {
        let what = || format!("{} is not a compare.json", path.display());
        let found: Self = serde_json::from_str(&files::read_text(path)?).context(what)?;
        if found.format != Self::FORMAT {
            return Err(Error::new(format!(
                "{}: format '{}' where '{}' was expected",
                path.display(),
                found.format,
                Self::FORMAT
            )));
        }
        Ok(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::Prediction;
    use crate::session::Intensity;

    #[test]
    fn a_pose_is_as_far_off_as_its_brightness_says() {
        // Brightness 0.2, so weight 25; residuals 0.02 in red and -0.01 in blue: +10 and -5 %.
        let configuration = Configuration::from_degrees(3, [30.0, 0.0], [40.0, 90.0], 0.0).unwrap();
        let measured = Intensity {
            configuration,
            mean: [0.1, 9.0, 0.3],
            standard_error: [0.003, 9.0, 0.003],
            present: [true, false, true],
        };
        let mean = [0.12, 0.5, 0.29];
        let row = Compared {
            prediction: Prediction {
                configuration,
                mean,
                parameter_se: [0.0; 3],
                monte_carlo_se: [0.004; 3],
                model_se: [0.0; 3],
                renders: [mean; 2],
                in_fit: true,
                paths: 1,
            },
            measured: measured.cleared(),
            residual: [Some(0.02), None, Some(-0.01)],
            z: [Some(4.0), None, Some(-2.0)],
        };
        let pose = PoseResidual::new(&row, 0.02);
        let near = |a: f64, b: f64| assert!((a - b).abs() < 1e-9, "{a} {b}");
        near(pose.relative_percent[0].unwrap(), 10.0);
        near(pose.relative_percent[2].unwrap(), -5.0);
        assert_eq!(pose.relative_percent[1], None);
        near(pose.relative_se_percent[0].unwrap(), 2.5);
        near(pose.brightness_percent, 2.5);
        near(pose.brightness_se_percent, 2.5);
        near(pose.rms_percent, 100.0 * (25.0 * 0.0005 / 2.0_f64).sqrt());
        let json = serde_json::to_string(&pose).unwrap();
        let back: PoseResidual = serde_json::from_str(&json).unwrap();
        assert_eq!(back.configuration.id, 3);
        assert!(json.contains("\"light_theta_deg\""), "{json}");
    }
}
