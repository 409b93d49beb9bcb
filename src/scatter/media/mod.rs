//! Scattering in volumes of fibers: one file per model, one contract for all.
//!
//! The radiative transfer equation of an anisotropic medium (Jakob et al. 2010; Zhao 2011 eq. 1), with directions that point away
//! from the event, `wi` toward the light and `wo` toward the camera:
//!
//! ```text
//! (-wo . grad) L(wo) = sigma_t(wo) [ alpha int p(wi | wo) L(wi) dwi - L(wo) ]         alpha, p per color channel
//! sigma_t(x, w) = n(x) e(w)         n: density of the voxel, 1/mm;  e: Medium::extinction, a pure number
//! int p(wi | wo) dwi = 1            over the directions toward the light, for every wo
//! ```
//!
//! All directions are unit vectors in the fiber frame of the voxel, x along the fiber. `e` has no colors, so one flight serves all
//! channels; colors are in `alpha p` alone. docs/decisions/0008-media.md has the reasons and says how to differentiate a
//! path.

mod density;
mod flakes;
mod incoming;
mod khungurn_volume;
mod microflake;

pub use flakes::FlakeDistribution;
pub use khungurn_volume::KhungurnVolume;
pub use microflake::Microflake;

use super::{CHANNELS, Evaluation, MAX_ROWS, ParameterInfo, Parameters, Parametric};
use crate::base::{Error, Result};
use crate::math::Random;
use glam::DVec3;

/// A medium at fixed parameters.
pub trait Medium: Send + Sync {
    /// Extinction along `w` over the density of the voxel; even in `w`, zero along the fiber in some media.
    fn extinction(&self, w: DVec3) -> f64;

    /// Derivatives of [`Medium::extinction`] by the rows of [`Parametric::parameters`] (angles per radian).
    fn extinction_slopes(&self, w: DVec3) -> [f64; MAX_ROWS];

    /// The largest [`Medium::extinction`] of any direction: the majorant of a voxel is its density times this.
    fn majorant(&self) -> f64;

    /// Share of the extinction that is scattering.
    fn albedo(&self) -> [f64; CHANNELS];

    /// Albedo times phase function, `alpha p(wi | wo)`, 1/sr, and its derivatives by the rows of
    /// [`Parametric::parameters`]. Need not be symmetric in its directions.
    fn evaluate(&self, wi: DVec3, wo: DVec3) -> Evaluation;

    /// Computes ahead what all looks from one event need of its camera side. `carried` is how much each channel of the path
    /// counts, in any common unit, none negative: directions are drawn for what the channels carry.
    fn outgoing(&self, wo: DVec3, carried: [f64; CHANNELS]) -> Outgoing;

    /// What is worth following, and the density per solid angle with which [`Medium::sample`] chooses `wi`, 1/sr: albedo times
    /// phase function, but not zero where only its derivatives live, as at an albedo of zero.
    fn importance(&self, wi: DVec3, o: &Outgoing) -> ([f64; CHANNELS], f64);

    /// Draws `wi` given the camera side. Its density is the mean of the channels' phase functions, weighted by what they
    /// carry: within the bounds of [`Parametric::parameters`] weights vary only because channels differ, and what the channels carry
    /// in sum varies hardly at all.
    fn sample(&self, o: &Outgoing, random: &mut Random) -> Scattered;
}

/// The camera side of an event, made by [`Medium::outgoing`]. It belongs to the medium that made it.
#[derive(Debug, Clone, Copy)]
pub struct Outgoing {
    /// Toward the camera side (unit, fiber frame).
    pub wo: DVec3,
    /// How much each channel of the path counts.
    pub carried: [f64; CHANNELS],
    kept: Kept,
}

/// What a medium keeps of a camera side.
#[derive(Debug, Clone, Copy)]
enum Kept {
    Microflake(microflake::CameraSide),
    KhungurnVolume(khungurn_volume::CameraSide),
}

/// A sampled direction toward the light.
#[derive(Debug, Clone, Copy)]
pub struct Scattered {
    /// The sampled direction (unit, fiber frame).
    pub wi: DVec3,
    /// `alpha p(wi | wo) / pdf` per channel, as [`Medium::importance`] has it.
    pub weight: [f64; CHANNELS],
    /// Density per solid angle with which `wi` was chosen, 1/sr.
    pub pdf: f64,
}

/// A model of media: a named list of at most [`MAX_ROWS`] parameters, and the media they make.
pub trait MediumModel: Parametric {
    /// The medium at `parameters`.
    ///
    /// # Errors
    /// When a value is not finite, or where the model has no meaning. Values outside the published box but meaningful
    /// are accepted.
    fn prepare(&self, parameters: &Parameters) -> Result<Box<dyn Medium>>;
}

/// All models of media, in the order `--help` lists them.
pub fn models() -> &'static [&'static dyn MediumModel] {
    &[&Microflake, &KhungurnVolume]
}

/// The model of media with this name, e.g. `microflake`, or `microflake-density` for the same with a factor on the density as
/// its last parameter.
///
/// # Errors
/// When there is none; the hint lists those that exist.
pub fn model(name: &str) -> Result<&'static dyn MediumModel> {
    let mut all = models().iter().copied().chain(density::models());
    all.find(|m| m.name() == name).ok_or_else(|| {
        let known: Vec<_> = models().iter().map(|m| m.name()).collect();
        Error::new(format!("unknown model of media '{name}'")).with_hint(format!(
            "known models: {}; with the density as a parameter: {}-density",
            known.join(", "),
            known[0]
        ))
    })
}

/// Checks that a value lies in [lower, upper].
fn check(model: &str, info: &ParameterInfo, value: f64, lower: f64, upper: f64) -> Result<()> {
    if (lower..=upper).contains(&value) {
        return Ok(());
    }
    let key = info.file_key();
    Err(Error::new(format!(
        "{model}: '{key}' is {value}, expected {lower} to {upper}"
    ))
    .with_hint(format!(
        "the published range of '{key}' is {} to {}",
        info.lower, info.upper
    )))
}
