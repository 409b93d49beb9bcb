//! One file per scattering model, one contract for all.
//!
//! Knows neither fibers' geometry nor sessions. A *model* names its parameters, bounds, units and defaults; given
//! values it becomes a [`Scattering`], which is what a renderer evaluates and samples. All directions are unit vectors
//! in the fiber frame (x along the fiber) and point away from the fiber; `wi` toward the light, `wo` toward the
//! camera. Models need not be reciprocal, so the order matters.
//!
//! Volumes of fibers have a contract of their own, in [`media`], and so has cloth as a surface, in [`surface`].

pub mod albedo;
mod any;
mod batch;
pub mod chiang;
mod defensive;
mod direction;
pub mod khungurn;
pub mod media;
pub mod normalizer;
mod parameters;
mod per_system;
mod piecewise;
pub mod surface;

pub use any::AnyModel;
pub use batch::{BatchEvaluate, BatchValues, Footprint, MAX_COLUMNS, OneByOne};
pub use chiang::{Chiang, ChiangScattering};
pub use defensive::Defensive;
pub use direction::{fiber_direction, longitudinal_angle};
pub use khungurn::{Khungurn, KhungurnScattering};
pub use parameters::{ParameterInfo, Parameters, Unit};
use per_system::has_per_system;
pub use per_system::{YARN_SYSTEMS, per_system};

use crate::base::{Error, Result};
use crate::math::Random;
use glam::DVec3;

/// The number of color channels everywhere.
pub const CHANNELS: usize = 3;

/// Upper limit on the rows of one [`Scattering`], so that hot loops can use arrays.
pub const MAX_ROWS: usize = 8;

/// Upper limit on [`Parametric::parameters`]'s length: [`MAX_ROWS`] for each yarn system.
pub const MAX_DERIVATIVES: usize = YARN_SYSTEMS.len() * MAX_ROWS;

/// Value of a scattering function and its derivatives at one pair of directions.
#[derive(Debug, Clone, Copy)]
pub struct Evaluation {
    /// Scattering function per channel, 1/sr; no cosine inside.
    pub value: [f64; CHANNELS],
    /// `derivative[row][channel]`: by the model's parameter `row` ([`Parametric::parameters`] order; angles per radian).
    /// For a per-channel parameter it is by that channel's own value. Rows past the model's length are zero.
    pub derivative: [[f64; CHANNELS]; MAX_ROWS],
}

/// A sampled direction toward the light.
#[derive(Debug, Clone, Copy)]
pub struct Sampled {
    /// The sampled direction (unit, fiber frame).
    pub wi: DVec3,
    /// `S(wi, wo) cos(theta_i) / pdf` per channel, with `S` as [`Scattering::importance`] has it. May exceed 1.
    pub weight: [f64; CHANNELS],
    /// Density per solid angle with which `wi` was chosen, 1/sr.
    pub pdf: f64,
}

/// The camera side of an event, made by [`Scattering::outgoing`] to look at many directions toward the light. It belongs to the
/// function that made it.
#[derive(Debug, Clone, Copy)]
pub struct Outgoing {
    /// Toward the camera side (unit, fiber frame).
    pub wo: DVec3,
    /// Where across the fiber the camera side meets it, see [`Scattering`].
    pub h: f64,
    /// How much each channel of the path counts, in any common unit: sampling for a channel that the path has lost would let
    /// the weights of the others grow from event to event.
    pub carried: [f64; CHANNELS],
    kept: Kept,
}

/// What a model keeps of a camera side.
#[expect(
    clippy::large_enum_variant,
    reason = "made at every hit: a box would allocate there"
)]
#[derive(Debug, Clone, Copy)]
enum Kept {
    Nothing,
    Khungurn(khungurn::CameraSide),
    Chiang(chiang::CameraSide),
}

impl Outgoing {
    /// Nothing computed ahead: any function takes it.
    pub fn new(wo: DVec3, h: f64, carried: [f64; CHANNELS]) -> Self {
        Self {
            wo,
            h,
            carried,
            kept: Kept::Nothing,
        }
    }
}

/// Where a path that meets a fiber leaves it again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Passage {
    /// At the same longitudinal coordinate, at the far side of the cross-section along the new direction's azimuth: for
    /// far-field functions, which have averaged over the cross-section.
    Across,
    /// Straight on from the point that was hit, through the fiber if the new direction points into it: for near-field
    /// functions, whose lobes depend on that point.
    Straight,
}

/// A scattering function at fixed parameters.
///
/// `h` in (-1, 1) is where across the fiber the camera side of the path meets it: the sine of the azimuth from the outward
/// normal at the hit to `wo` (`gamma_o` of Chiang 2016). Far-field functions do not use it.
pub trait Scattering: Send + Sync {
    /// Scattering function and derivatives.
    fn evaluate(&self, wi: DVec3, wo: DVec3, h: f64) -> Evaluation;

    /// Computes ahead what [`Scattering::importance`], [`Scattering::sample`] and [`Scattering::light_points`] need of the
    /// camera side.
    fn outgoing(&self, wo: DVec3, h: f64, carried: [f64; CHANNELS]) -> Outgoing {
        Outgoing::new(wo, h, carried)
    }

    /// What is worth following, and the density per solid angle with which [`Scattering::sample`] chooses `wi`, 1/sr: the
    /// scattering function, but not zero where only its derivatives live, as at a color of zero.
    fn importance(&self, wi: DVec3, o: &Outgoing) -> ([f64; CHANNELS], f64);

    /// Draws `wi` given `wo`, in proportion to roughly `S cos(theta_i)`. `None` when no light can come back.
    fn sample(&self, o: &Outgoing, random: &mut Random) -> Option<Sampled>;

    /// How many points on a light of angular radius `half_angle` seen toward about `wi` make its integral smooth.
    fn light_points(&self, _wi: DVec3, _o: &Outgoing, _half_angle: f64) -> usize {
        1
    }

    /// Where a path leaves the fiber.
    fn passage(&self) -> Passage {
        Passage::Across
    }

    /// A kernel for many events at once, when the model has one (at all parameters or at none); else [`OneByOne`] serves.
    fn batch(&self) -> Option<Box<dyn BatchEvaluate>> {
        None
    }

    /// Standard deviation of the narrowest lobe, radians, for whoever chooses a quadrature rule; at most 10 degrees.
    fn narrowest(&self) -> f64 {
        10_f64.to_radians()
    }
}

/// A named list of parameters: what fits, files and renders know of a model, whether of fibers ([`Model`]) or of media
/// ([`media::MediumModel`]).
pub trait Parametric: Send + Sync {
    /// The name used on the command line and in files, e.g. `khungurn`.
    fn name(&self) -> &'static str;

    /// The parameters in the order of [`Evaluation::derivative`]'s rows; at most [`MAX_ROWS`] for each of
    /// [`Parametric::systems`].
    fn parameters(&self) -> &'static [ParameterInfo];

    /// The yarn systems that have parameters of their own, in the order of their numbers: [`Parametric::parameters`] lists
    /// the same rows for each of them. Empty when one set of parameters serves all fibers.
    fn systems(&self) -> &'static [&'static str] {
        &[]
    }
}

/// A model of single fibers: a named list of parameters, and the scattering functions they make.
pub trait Model: Parametric {
    /// The scattering function at `parameters`.
    ///
    /// # Errors
    /// When a value is missing, not finite, or where the model has no meaning (width zero, color below zero). Values
    /// outside the published box but meaningful are accepted. When there is one for each of [`Parametric::systems`].
    fn prepare(&self, parameters: &Parameters) -> Result<Box<dyn Scattering>>;

    /// The scattering functions at `parameters`: one for each of [`Parametric::systems`], or the one for all fibers.
    ///
    /// # Errors
    /// As [`Model::prepare`].
    fn prepare_each(&self, parameters: &Parameters) -> Result<Vec<Box<dyn Scattering>>> {
        Ok(vec![self.prepare(parameters)?])
    }

    /// A value of parameter `row` with lobes about `factor` times as wide: an angle times `factor`, but never above a full
    /// turn, unless the model knows better.
    fn wider(&self, row: usize, value: f64, factor: f64) -> f64 {
        match self.parameters()[row].unit {
            Unit::Angle => (factor * value).min(std::f64::consts::TAU),
            Unit::One => value,
        }
    }

    /// `parameters` with lobes about `factor` times as wide, for [`Defensive`] sampling.
    fn widened(&self, parameters: &Parameters, factor: f64) -> Parameters {
        let values = parameters.places().into_iter().zip(parameters.values());
        let wider = |((row, _), value): ((usize, usize), &f64)| self.wider(row, *value, factor);
        parameters.with_values(values.map(wider).collect())
    }
}

/// All models with one set of parameters, in the order `--help` lists them.
pub fn models() -> &'static [&'static dyn Model] {
    &[&Khungurn, &Chiang]
}

/// The model with this name, e.g. `khungurn`, or `khungurn-per-system` for what [`per_system`] makes of it.
///
/// # Errors
/// When there is none; the hint lists those that exist.
pub fn model(name: &str) -> Result<&'static dyn Model> {
    models()
        .iter()
        .copied()
        .find(|m| m.name() == name)
        .or_else(|| per_system::named(name))
        .ok_or_else(|| {
            let known: Vec<_> = models().iter().map(|m| m.name()).collect();
            Error::new(format!("unknown model '{name}'")).with_hint(format!(
                "known models: {}; parameters for each yarn system: {}-per-system",
                known.join(", "),
                known[0]
            ))
        })
}
