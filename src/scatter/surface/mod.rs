//! Reflectance of cloth as a surface: one file per model, one contract for all. No paths are traced.
//!
//! All directions are unit vectors in the frame of the sample (x weft, y warp, z normal) and point away from it: `wi` toward the
//! light, `wr` toward the camera. Values are BRDFs, 1/sr, without a cosine: `L_r(wr) = int f(wi, wr) L_i(wi) cos(theta_i) dwi`.
//! A BRDF is zero when either direction is not above the surface.

mod ggx;
mod lambert;
pub mod woven;

pub use ggx::Ggx;
pub use lambert::Lambert;
pub use woven::Woven;

use super::{CHANNELS, ParameterInfo, Parameters, Parametric, Unit};
use crate::base::{Error, Result};
use crate::math::GaussLegendre;
use glam::DVec3;
use std::f64::consts::TAU;

/// Upper limit on the rows of a surface model.
pub const MAX_SURFACE_ROWS: usize = 16;

/// Value of a BRDF and its derivatives at one pair of directions.
#[derive(Debug, Clone, Copy)]
pub struct SurfaceEvaluation {
    /// BRDF per channel, 1/sr.
    pub value: [f64; CHANNELS],
    /// `derivative[row][channel]`: by the model's parameter `row` ([`Parametric::parameters`] order; angles per radian). For a
    /// per-channel parameter it is by that channel's own value. Rows past the model's length are zero.
    pub derivative: [[f64; CHANNELS]; MAX_SURFACE_ROWS],
}

impl SurfaceEvaluation {
    fn zero() -> Self {
        Self {
            value: [0.0; CHANNELS],
            derivative: [[0.0; CHANNELS]; MAX_SURFACE_ROWS],
        }
    }
}

/// A BRDF at fixed parameters.
pub trait Surface: Send + Sync {
    /// The BRDF per channel, 1/sr.
    fn value(&self, wi: DVec3, wr: DVec3) -> [f64; CHANNELS];

    /// The BRDF and its derivatives.
    fn evaluate(&self, wi: DVec3, wr: DVec3) -> SurfaceEvaluation;

    /// The derivatives by the per-channel parameters, of which the BRDF is a linear function, by row: the same in all channels, and
    /// independent of those parameters. Zero in other rows.
    fn colors(&self, wi: DVec3, wr: DVec3) -> [f64; MAX_SURFACE_ROWS];
}

/// A reflectance model: a named list of at most [`MAX_SURFACE_ROWS`] parameters, and the BRDFs they make. Every model is linear in its per-channel parameters, so
/// that they can be had by linear least squares.
pub trait SurfaceModel: Parametric {
    /// The BRDF at `parameters`.
    ///
    /// # Errors
    /// When a value is not finite, or where the model has no meaning. Values outside the stated range but meaningful are
    /// accepted.
    fn prepare(&self, parameters: &Parameters) -> Result<Box<dyn Surface>>;
}

/// All reflectance models, from simple to rich; woven ones with the segments of `layout`.
pub fn models(layout: &woven::Layout) -> Vec<Box<dyn SurfaceModel>> {
    let mut models: Vec<Box<dyn SurfaceModel>> = vec![Box::new(Lambert), Box::new(Ggx)];
    for rung in woven::RUNGS {
        models.push(Box::new(Woven::new(rung, layout.clone())));
    }
    models
}

/// The reflectance model with this name, e.g. `woven-9`.
///
/// # Errors
/// When there is none; the hint lists those that exist.
pub fn model(name: &str, layout: &woven::Layout) -> Result<Box<dyn SurfaceModel>> {
    let all = models(layout);
    let known: Vec<_> = all.iter().map(|m| m.name()).collect();
    all.into_iter().find(|m| m.name() == name).ok_or_else(|| {
        Error::new(format!("unknown reflectance model '{name}'"))
            .with_hint(format!("known models: {}", known.join(", ")))
    })
}

/// Share of the light from `wi` that is reflected, `int f(wi, wr) cos(theta_r) dwr`, by a rule with `points` in the
/// square of the sine of the polar angle and four times as many azimuths.
pub fn directional_albedo(surface: &dyn Surface, wi: DVec3, points: usize) -> [f64; CHANNELS] {
    let azimuths = 4 * points;
    let mut albedo = [0.0; CHANNELS];
    for (square, weight) in GaussLegendre::new(points).on(0.0, 1.0) {
        let (sin, cos) = (square.sqrt(), (1.0 - square).sqrt());
        for k in 0..azimuths {
            let (sp, cp) = (TAU * (k as f64 + 0.5) / azimuths as f64).sin_cos();
            let value = surface.value(wi, DVec3::new(sin * cp, sin * sp, cos));
            // cos dw = d(sin^2)/2 dphi
            let w = 0.5 * weight * TAU / azimuths as f64;
            (0..CHANNELS).for_each(|c| albedo[c] += w * value[c]);
        }
    }
    albedo
}

/// A color between 0 and 1 (a coefficient may be larger).
const fn coefficient(name: &'static str, upper: f64, default: f64) -> ParameterInfo {
    ParameterInfo {
        name,
        per_channel: true,
        unit: Unit::One,
        lower: 0.0,
        upper,
        default,
    }
}

const fn scalar(name: &'static str, lower: f64, upper: f64, default: f64) -> ParameterInfo {
    ParameterInfo {
        name,
        per_channel: false,
        unit: Unit::One,
        lower,
        upper,
        default,
    }
}

/// Checks that the values of a row lie in [lower, upper].
fn check(
    model: &str,
    info: &ParameterInfo,
    values: [f64; CHANNELS],
    lower: f64,
    upper: f64,
) -> Result<[f64; CHANNELS]> {
    let Some(wrong) = values.iter().find(|v| !(lower..=upper).contains(*v)) else {
        return Ok(values);
    };
    Err(Error::new(format!(
        "{model}: '{}' is {wrong}, expected {lower} to {upper}",
        info.name
    ))
    .with_hint(format!(
        "the usual range of '{}' is {} to {} (radians for angles)",
        info.name, info.lower, info.upper
    )))
}

/// True when both directions are above the surface, or are not numbers (which then show in the result).
fn above(wi: DVec3, wr: DVec3) -> bool {
    !(wi.z <= 0.0 || wr.z <= 0.0)
}
