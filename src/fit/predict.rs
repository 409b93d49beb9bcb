//! Means at any pose from an earlier fit, with what is not known of them, and how they compare with measurements.
//!
//! To first order in the parameters' errors: the covariance of the fit, whose density is cut off at the bounds, goes through
//! the derivatives at the fitted parameters. A fitted gain multiplies the predictions: they are what that session would have
//! measured. Errors common to all measurements (the white standard's factor) are not seen.

use super::information::{self, Place};
use super::linear::Matrix;
use super::objective::{RenderPair, brightness, channels_of, relative_weights};
use super::result::{FitResult, rms_against};
use crate::base::{Error, Result, Watch};
use crate::render::{Effort, Scene};
use crate::scatter::{CHANNELS, Parameters};
use crate::session::{Configuration, Intensity, Measurements};

/// Index of the pair, far from those of a search and its check: the same seed shares no random number with the fit.
const PREDICT_INDEX: u64 = 1 << 41;

/// Angles between directions below this are none, radians.
const SAME: f64 = 1e-6;

/// The predicted mean normalized radiance of a pose.
#[derive(Debug, Clone, PartialEq)]
pub struct Prediction {
    /// The pose.
    pub configuration: Configuration,
    /// Mean of two independent renders at the fitted parameters.
    pub mean: [f64; CHANNELS],
    /// Standard error from the parameters' uncertainty.
    pub parameter_se: [f64; CHANNELS],
    /// Standard error of the renders.
    pub monte_carlo_se: [f64; CHANNELS],
    /// Error of the model itself as the fit's residual shows it (`misfit_percent` of the brightness).
    pub model_se: [f64; CHANNELS],
    /// The two renders.
    pub renders: [[f64; CHANNELS]; 2],
    /// Whether the fit has seen this pose: then a small residual proves nothing.
    pub in_fit: bool,
    /// Camera paths of both renders.
    pub paths: u64,
}

impl Prediction {
    /// All errors of the prediction together.
    pub fn standard_error(&self) -> [f64; CHANNELS] {
        std::array::from_fn(|c| {
            let [a, b] = [self.parameter_se[c], self.monte_carlo_se[c]];
            a.hypot(b).hypot(self.model_se[c])
        })
    }
}

/// Predicts the means of `configurations` from `fit`, whose model is the scene's.
///
/// # Errors
/// When the fit is of another model, was made before covariances were kept, or a render fails.
pub fn predict(
    scene: &dyn Scene,
    fit: &FitResult,
    configurations: &[Configuration],
    effort: &Effort,
    seed: u64,
    watch: &dyn Watch,
) -> Result<Vec<Prediction>> {
    let parameters = parameters_of(scene, fit)?;
    let place = Place::new(&parameters)?;
    let covariance = covariance_of(fit, &place)?;
    let pair = RenderPair::render(
        scene,
        configurations,
        &parameters,
        effort,
        seed,
        PREDICT_INDEX,
        watch,
    )?
    .scaled(fit.gain_value());
    // The fit knows nothing of a channel that it never saw, so no brightness either.
    let seen = channels_of(fit.configs.iter().map(|f| f.measured.map(|m| m.is_some())));
    let with = |(c, [a, b]): (&Configuration, [&crate::render::Estimate; 2])| {
        let mean = std::array::from_fn(|k| 0.5 * (a.mean[k] + b.mean[k]));
        let [ja, jb] = [a, b].map(|e| place.jacobian(e, [1.0; CHANNELS]));
        Prediction {
            configuration: *c,
            mean,
            parameter_se: std::array::from_fn(|k| {
                information::variance(&covariance, ja.row(k), jb.row(k)).sqrt()
            }),
            monte_carlo_se: std::array::from_fn(|k| {
                0.5 * a.standard_error[k].hypot(b.standard_error[k])
            }),
            model_se: [0.01 * fit.objective.misfit_percent * brightness(mean, seen, fit.tau);
                CHANNELS],
            renders: [a.mean, b.mean],
            in_fit: fit.configs.iter().any(|f| same(&f.configuration, c)),
            paths: a.paths + b.paths,
        }
    };
    Ok(configurations
        .iter()
        .zip(pair.estimates())
        .map(with)
        .collect())
}

/// Whether two poses show the sample the same.
pub(super) fn same(a: &Configuration, b: &Configuration) -> bool {
    let apart = |d: fn(&Configuration) -> crate::math::PolarDirection| {
        d(a).vector().distance(d(b).vector())
    };
    apart(Configuration::light_in_sample) < SAME && apart(Configuration::camera_in_sample) < SAME
}

/// The fitted parameters, as those of the scene's model.
pub(super) fn parameters_of(scene: &dyn Scene, fit: &FitResult) -> Result<Parameters> {
    if fit.model != scene.model().name() {
        return Err(Error::new(format!(
            "the fit is of model {}, the scene of {}",
            fit.model,
            scene.model().name()
        )));
    }
    Parameters::from_json(scene.model(), &fit.parameters)
}

/// The covariance of a fit's parameters in the units of a place.
fn covariance_of(fit: &FitResult, place: &Place) -> Result<Matrix> {
    let (p, kept) = (place.len(), &fit.correlation);
    let whole = kept.matrix.len() == p && kept.matrix.iter().all(|row| row.len() == p);
    if kept.search_sd.len() != p || !whole {
        return Err(
            Error::new("the fit does not keep the covariance of its parameters").with_hint(
                "it was made by an earlier version; repeat it (its file holds the command)",
            ),
        );
    }
    let sd = |j: usize| kept.search_sd[j] / place.units()[j];
    let mut covariance = Matrix::zeros(p, p);
    for i in 0..p {
        for j in 0..p {
            covariance[(i, j)] = kept.matrix[i][j] * sd(i) * sd(j);
        }
    }
    Ok(covariance)
}

/// A prediction beside the measurement of the same pose.
#[derive(Debug, Clone, PartialEq)]
pub struct Compared {
    /// The prediction.
    pub prediction: Prediction,
    /// The measurement.
    pub measured: Intensity,
    /// Predicted minus measured; none of a channel that was not measured.
    pub residual: [Option<f64>; CHANNELS],
    /// The residual divided by all errors together: parameters, renders, model and measurement.
    pub z: [Option<f64>; CHANNELS],
}

/// Predictions and measurements, compared.
#[derive(Debug, Clone, PartialEq)]
pub struct Comparison {
    /// One row per pose.
    pub rows: Vec<Compared>,
    /// Weighted rms residual, percent, and its standard error. Below the root unbiased where the renders compared are
    /// independent of each other and of the prediction; not with `Refit::Linear`, whose step shares their noise.
    pub weighted_rms_percent: [f64; 2],
    /// Root mean square of all z: 1 when the stated errors are right.
    pub rms_z: f64,
}

/// Compares every prediction with the measurement of the same id; residuals count as with the fit's `tau`.
///
/// # Errors
/// When a pose was not measured, or the measurement of its id is of another pose.
pub fn compare(
    predictions: &[Prediction],
    measurements: &Measurements,
    tau: f64,
) -> Result<Comparison> {
    let rows = predictions
        .iter()
        .map(|p| Compared::new(p, measurements))
        .collect::<Result<Vec<_>>>()?;
    Ok(Comparison::of(rows, tau))
}

impl Compared {
    fn new(prediction: &Prediction, measurements: &Measurements) -> Result<Self> {
        let c = &prediction.configuration;
        let of_id = |i: &&Intensity| i.configuration.id == c.id;
        let measured = measurements.intensities.iter().find(of_id).ok_or_else(|| {
            Error::new(format!("configuration {} was not measured", c.id))
                .with_hint("leave out --plan to predict the measured poses")
        })?;
        if !same(c, &measured.configuration) {
            return Err(Error::new(format!(
                "configuration {} of the plan is not the pose that was measured under this number",
                c.id
            )));
        }
        let measured = measured.cleared();
        let residual = measured.where_present(std::array::from_fn(|k| {
            prediction.mean[k] - measured.mean[k]
        }));
        let se = prediction.standard_error();
        Ok(Self {
            prediction: prediction.clone(),
            measured,
            z: std::array::from_fn(|k| {
                residual[k].map(|r| r / se[k].hypot(measured.standard_error[k]))
            }),
            residual,
        })
    }
}

impl Comparison {
    /// The summary of some rows.
    pub(super) fn of(rows: Vec<Compared>, tau: f64) -> Self {
        let (rms, se) = rms_against(rows.iter().map(|r| {
            let p = &r.prediction;
            let weights = relative_weights(&r.measured, tau);
            (weights, p.renders, p.monte_carlo_se, r.measured.mean)
        }));
        let z = rows.iter().flat_map(|r| r.z).flatten();
        let (squares, n) = z.fold((0.0, 0.0), |(sum, n), z| (sum + z * z, n + 1.0));
        Self {
            weighted_rms_percent: [100.0 * rms, 100.0 * se],
            rms_z: (squares / n).sqrt(),
            rows,
        }
    }
}
