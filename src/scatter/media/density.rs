//! Media whose density is a parameter too: a factor on the density of every voxel.
//!
//! The published fits hold the density fixed (4000 times the value of the CT image, Khungurn 2015 Table II). What a voxel's density
//! is, with its unit, the volume says; the factor is a pure number and 1 where nothing else is known.

use super::{CHANNELS, MAX_ROWS, Medium, MediumModel, Outgoing, Scattered, check, models as plain};
use crate::base::Result;
use crate::math::Random;
use crate::scatter::{Evaluation, ParameterInfo, Parameters, Parametric, Unit};
use glam::DVec3;
use std::sync::LazyLock;

/// What is added to a model's name.
const SUFFIX: &str = "-density";

/// No range is published: a factor of ten both ways.
const DENSITY: ParameterInfo = ParameterInfo {
    name: "density_scale",
    per_channel: false,
    unit: Unit::One,
    lower: 0.1,
    upper: 10.0,
    default: 1.0,
};

/// One of [`models`](plain) with [`DENSITY`] as its last parameter.
struct WithDensity {
    of: &'static dyn MediumModel,
    name: &'static str,
    infos: &'static [ParameterInfo],
}

/// All of them, made once: names and descriptions of parameters live as long as the program.
static ALL: LazyLock<Vec<WithDensity>> =
    LazyLock::new(|| plain().iter().map(|m| WithDensity::new(*m)).collect());

/// The models with the density as a parameter.
pub(super) fn models() -> impl Iterator<Item = &'static dyn MediumModel> {
    ALL.iter().map(|m| m as &dyn MediumModel)
}

impl WithDensity {
    fn new(of: &'static dyn MediumModel) -> Self {
        let infos: Vec<ParameterInfo> = of.parameters().iter().copied().chain([DENSITY]).collect();
        Self {
            of,
            name: format!("{}{SUFFIX}", of.name()).leak(),
            infos: infos.leak(),
        }
    }
}

impl Parametric for WithDensity {
    fn name(&self) -> &'static str {
        self.name
    }

    fn parameters(&self) -> &'static [ParameterInfo] {
        self.infos
    }
}

impl MediumModel for WithDensity {
    fn prepare(&self, parameters: &Parameters) -> Result<Box<dyn Medium>> {
        let scale = parameters.scalar(DENSITY.name);
        check(self.name, &DENSITY, scale, 1e-6, 1e6)?;
        let defaults = Parameters::defaults(self.of);
        let own = parameters.values()[..defaults.values().len()].to_vec();
        Ok(Box::new(Scaled {
            of: self.of.prepare(&defaults.with_values(own))?,
            scale,
            row: self.infos.len() - 1,
        }))
    }
}

/// A medium of `scale` times the density.
struct Scaled {
    of: Box<dyn Medium>,
    scale: f64,
    row: usize,
}

impl Medium for Scaled {
    fn extinction(&self, w: DVec3) -> f64 {
        self.scale * self.of.extinction(w)
    }

    fn extinction_slopes(&self, w: DVec3) -> [f64; MAX_ROWS] {
        let mut slopes = self.of.extinction_slopes(w).map(|slope| self.scale * slope);
        slopes[self.row] = self.of.extinction(w);
        slopes
    }

    fn majorant(&self) -> f64 {
        self.scale * self.of.majorant()
    }

    fn albedo(&self) -> [f64; CHANNELS] {
        self.of.albedo()
    }

    fn evaluate(&self, wi: DVec3, wo: DVec3) -> Evaluation {
        self.of.evaluate(wi, wo)
    }

    fn outgoing(&self, wo: DVec3, carried: [f64; CHANNELS]) -> Outgoing {
        self.of.outgoing(wo, carried)
    }

    fn importance(&self, wi: DVec3, o: &Outgoing) -> ([f64; CHANNELS], f64) {
        self.of.importance(wi, o)
    }

    fn sample(&self, o: &Outgoing, random: &mut Random) -> Scattered {
        self.of.sample(o, random)
    }
}
