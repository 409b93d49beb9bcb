//! Microflakes (Jakob et al. 2010) with the Gaussian distribution of Zhao 2011: mirrors that lie along the fiber.
//!
//! ```text
//! e(w)       = s(w) = int |w . m| D(m) dm                   Zhao 2011 eq. 1: sigma_t = a rho s, n = a rho
//! p(wi | wo) = D(h) / (2 s(wo)),  h = (wi + wo)/|wi + wo|    D is even; wo is the paper's w, -wi its w'
//! ```
//!
//! Reciprocal: `e(wo) p(wi | wo) = D(h)/2` does not change when the directions are exchanged. Not in the model: flakes that let
//! light through, and any color but the albedo's. Where `wi = -wo` h is undefined: any flake seen edge on does it, and those on
//! the plane across the fiber are meant.

use super::flakes::FlakeDistribution;
use super::{Kept, Medium, MediumModel, Outgoing, Scattered, check};
use crate::base::Result;
use crate::math::Random;
use crate::scatter::direction::FiberAngles;
use crate::scatter::khungurn::{LEAST_COLOR, color};
use crate::scatter::{CHANNELS, Evaluation, MAX_ROWS, ParameterInfo, Parameters, Parametric, Unit};
use glam::DVec3;

/// The model `microflake`: rows `albedo, gamma`.
#[derive(Debug, Clone, Copy)]
pub struct Microflake;

/// Range of gamma: Zhao 2011 sec. 4. No default is published: the value of most fits in Khungurn 2015, Table IV.
const PARAMETERS: &[ParameterInfo] = &[
    color("albedo", 0.85),
    ParameterInfo {
        name: "gamma",
        per_channel: false,
        unit: Unit::One,
        lower: 0.005,
        upper: 1.5,
        default: 0.013,
    },
];

impl Parametric for Microflake {
    fn name(&self) -> &'static str {
        "microflake"
    }

    fn parameters(&self) -> &'static [ParameterInfo] {
        PARAMETERS
    }
}

impl MediumModel for Microflake {
    fn prepare(&self, parameters: &Parameters) -> Result<Box<dyn Medium>> {
        let (albedo, gamma) = (parameters.channels("albedo"), parameters.scalar("gamma"));
        for value in albedo {
            check(self.name(), &PARAMETERS[0], value, 0.0, 1.0)?;
        }
        check(self.name(), &PARAMETERS[1], gamma, 0.001, 100.0)?;
        Ok(Box::new(Flakes {
            albedo,
            followed: albedo.map(|a| a.max(LEAST_COLOR)),
            flakes: FlakeDistribution::new(gamma),
        }))
    }
}

/// The medium at fixed parameters.
struct Flakes {
    albedo: [f64; CHANNELS],
    /// The albedo by which paths are followed: at an albedo of zero a path carries derivatives where it carries no light.
    followed: [f64; CHANNELS],
    flakes: FlakeDistribution,
}

/// What the direction toward the camera decides.
#[derive(Debug, Clone, Copy)]
pub(super) struct CameraSide {
    angles: FiberAngles,
    /// `1 / (2 s(wo))`.
    factor: f64,
}

/// Cosine of the half vector to the fiber.
#[inline]
fn half_cosine(wi: DVec3, wo: DVec3) -> f64 {
    let sum = wi + wo;
    let length = sum.length();
    if length == 0.0 { 0.0 } else { sum.x / length }
}

fn sine(w: DVec3) -> f64 {
    (w.y * w.y + w.z * w.z).sqrt()
}

impl Flakes {
    fn camera_side(&self, wo: DVec3) -> CameraSide {
        let angles = FiberAngles::new(wo);
        CameraSide {
            angles,
            factor: 0.5 / self.flakes.projected_area(angles.cos_theta)[0],
        }
    }

    fn side(&self, o: &Outgoing) -> CameraSide {
        match o.kept {
            Kept::Microflake(side) => side,
            Kept::KhungurnVolume(_) => self.camera_side(o.wo),
        }
    }
}

impl Medium for Flakes {
    fn extinction(&self, w: DVec3) -> f64 {
        self.flakes.projected_area(sine(w))[0]
    }

    fn extinction_slopes(&self, w: DVec3) -> [f64; MAX_ROWS] {
        let mut slopes = [0.0; MAX_ROWS];
        slopes[1] = self.flakes.projected_area(sine(w))[1];
        slopes
    }

    fn majorant(&self) -> f64 {
        self.flakes.largest_projected_area()
    }

    fn albedo(&self) -> [f64; CHANNELS] {
        self.albedo
    }

    fn evaluate(&self, wi: DVec3, wo: DVec3) -> Evaluation {
        let [s, s_by_gamma] = self.flakes.projected_area(sine(wo));
        let (density, log_slope) = self.flakes.density(half_cosine(wi, wo));
        let phase = 0.5 * density / s;
        let by_gamma = phase * (log_slope - s_by_gamma / s);
        let mut derivative = [[0.0; CHANNELS]; MAX_ROWS];
        derivative[0] = [phase; CHANNELS];
        derivative[1] = self.albedo.map(|albedo| albedo * by_gamma);
        Evaluation {
            value: self.albedo.map(|albedo| albedo * phase),
            derivative,
        }
    }

    fn outgoing(&self, wo: DVec3, carried: [f64; CHANNELS]) -> Outgoing {
        Outgoing {
            wo,
            carried,
            kept: Kept::Microflake(self.camera_side(wo)),
        }
    }

    fn importance(&self, wi: DVec3, o: &Outgoing) -> ([f64; CHANNELS], f64) {
        let phase = self.side(o).factor * self.flakes.density(half_cosine(wi, o.wo)).0;
        (self.followed.map(|albedo| albedo * phase), phase)
    }

    /// The mirror image of `wo` in a flake that it sees. The density is the phase function itself.
    fn sample(&self, o: &Outgoing, random: &mut Random) -> Scattered {
        let side = self.side(o);
        let (m, cosine) = self.flakes.sample_seen(&side.angles, random);
        Scattered {
            wi: (2.0 * cosine * m - o.wo).normalize(),
            weight: self.followed,
            pdf: side.factor * self.flakes.density(m.x).0,
        }
    }
}
