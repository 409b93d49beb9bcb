//! Scenes, acceleration structure, paths, parameter derivatives.
//!
//! Knows neither files nor fitting. A [`Scene`] is anything that can estimate the mean normalized radiance of a list of
//! configurations, with standard errors and derivatives by parameter name.

mod allocation;
mod basic;
mod estimate;
mod geometry;
mod guide;
mod image;
#[cfg(test)]
mod laws;
mod light;
mod path;
mod picture;
mod probe;
mod record;
mod scene;
mod summation;
mod volume;
mod within;

pub use light::LightShape;
pub use picture::{Layer, Picture, PictureEffort, PictureRequest, Pictured, Region};
pub use probe::RaySpeed;
pub use record::{
    ConfigurationTrust, Recalled, RecordOptions, Recording, RecordingPair, TRUST_THRESHOLD, Trust,
};
pub use scene::{FiberScene, FiberSceneOptions, Integrator, Plate, View};
pub use volume::{DEFAULT_DENSITY, FlightSpeed, VolumeScene};

use crate::base::{Error, Result, Watch};
use crate::scatter::{Parameters, Parametric};
use crate::session::Configuration;

/// Fewest paths per configuration an estimate can be made from: below, batch means say nothing about the error.
const MIN_PATHS: u64 = 64;

/// How much work an estimate may cost.
#[derive(Debug, Clone, PartialEq)]
pub enum Effort {
    /// Camera paths for each configuration.
    Paths(u64),
    /// Camera paths in all, shared out in proportion to `shares` (one per configuration, positive). Configurations that
    /// share their camera paths count once, with the largest of their shares.
    Total {
        /// Camera paths traced.
        paths: u64,
        /// Relative number of paths per configuration.
        shares: Vec<f64>,
    },
    /// As many paths as make the weighted rms standard error of all numbers (weights of Khungurn 2015 eq. 20,
    /// tau = 0.02) this small a fraction.
    Accuracy(f64),
}

/// What is to be estimated.
#[derive(Debug, Clone)]
pub struct Request<'a> {
    /// The poses.
    pub configurations: &'a [Configuration],
    /// The model's parameter values.
    pub parameters: &'a Parameters,
    /// How much work.
    pub effort: Effort,
    /// The user's seed.
    pub seed: u64,
    /// Which of the independent streams of this seed: two requests that differ here share no random number.
    pub stream: u64,
}

impl Request<'_> {
    /// Refuses a request that no scene can answer.
    fn check(&self) -> Result<()> {
        let n = self.configurations.len();
        if n == 0 {
            return Err(Error::new(
                "nothing to render: the plan has no configurations",
            ));
        }
        match &self.effort {
            Effort::Paths(paths) if *paths < MIN_PATHS => Err(Error::new(format!(
                "{paths} paths per configuration are too few"
            ))
            .with_hint(format!(
                "at least {MIN_PATHS} are needed for a standard error"
            ))),
            Effort::Total { shares, .. }
                if shares.len() != n || !shares.iter().all(|s| *s > 0.0 && s.is_finite()) =>
            {
                Err(Error::new(format!(
                    "path shares: expected {n} positive numbers, found {shares:?}"
                )))
            }
            Effort::Accuracy(a) if !(1e-5..=0.5).contains(a) => Err(Error::new(format!(
                "accuracy {a} is out of range: expected 0.00001 to 0.5"
            ))
            .with_hint("write 1% or 0.01 for a weighted rms standard error of one percent")),
            _ => Ok(()),
        }
    }
}

/// The estimate for one configuration.
///
/// Mean +- 1.96 standard errors is a 95 % interval where the error is below a twentieth of the mean (`tests/render_coverage.rs`).
/// Above, the rarest bright paths have not been seen often enough: such intervals held the truth in 86 to 93 % of runs.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate {
    /// The configuration's id.
    pub config: u32,
    /// Mean normalized radiance over the sample square, per channel.
    pub mean: [f64; 3],
    /// Standard error of each mean, from batch means.
    pub standard_error: [f64; 3],
    /// `derivative[row][channel]`, rows in the model's parameter order (angles per radian).
    pub derivative: Vec<[f64; 3]>,
    /// Standard error of each derivative, from batch means.
    pub derivative_se: Vec<[f64; 3]>,
    /// Camera paths used.
    pub paths: u64,
}

/// Estimates of all configurations of a request, in its order.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimates {
    /// One per configuration.
    pub configurations: Vec<Estimate>,
    /// CPU time of all threads, seconds.
    pub cpu_s: f64,
    /// Elapsed time, seconds.
    pub wall_s: f64,
}

/// Anything that estimates means and derivatives.
pub trait Scene: Sync {
    /// The model whose parameters it takes.
    fn model(&self) -> &'static dyn Parametric;

    /// Unbiased estimates of the request's means and derivatives; the same request gives the same numbers on any number
    /// of threads.
    ///
    /// # Errors
    /// When the parameters have no meaning for the model, the work is too little for a standard error, a path gave a
    /// number that is not finite, or `watch` cancels.
    fn estimate(&self, request: &Request<'_>, watch: &dyn Watch) -> Result<Estimates>;

    /// The request's paths, recorded to be evaluated at other parameters; none where the scene cannot record.
    ///
    /// # Errors
    /// As [`Scene::estimate`].
    fn recall(&self, _request: &Request<'_>, _watch: &dyn Watch) -> Result<Option<RecordedPaths>> {
        Ok(None)
    }
}

/// Recorded paths, and what recording them took.
pub struct RecordedPaths {
    /// The paths.
    pub paths: Box<dyn Recall>,
    /// CPU time of all threads, seconds.
    pub cpu_s: f64,
    /// Elapsed time, seconds.
    pub wall_s: f64,
}

/// Recorded paths: estimates at other parameters without tracing, always from the same random numbers.
pub trait Recall: Send + Sync {
    /// Means and derivatives at `parameters`, and whether to trust them.
    ///
    /// # Errors
    /// When the parameters have no meaning for the model, or a number is not finite.
    fn recall(&self, parameters: &Parameters) -> Result<Recalled>;
}

/// Configurations darker than this, in normalized radiance, get no more weight (Khungurn 2015 eq. 20).
pub const TAU: f64 = 0.02;

/// The weight of a configuration with channel means `mean` (Khungurn 2015 eq. 20): `1 / max(mean over channels, tau)^2`.
pub fn relative_error_weight(mean: [f64; 3], tau: f64) -> f64 {
    let brightness = (mean[0] + mean[1] + mean[2]) / 3.0;
    1.0 / brightness.max(tau).powi(2)
}

/// The weighted rms of 3 numbers per configuration: `sqrt(sum_i w_i sum_c e_ic^2 / (3 n))`, a relative error.
pub fn weighted_rms(rows: impl Iterator<Item = (f64, [f64; 3])>) -> f64 {
    let (sum, n) = rows.fold((0.0, 0.0), |(sum, n), (w, e)| {
        (sum + w * e.iter().map(|e| e * e).sum::<f64>(), n + 3.0)
    });
    (sum / n).sqrt()
}
