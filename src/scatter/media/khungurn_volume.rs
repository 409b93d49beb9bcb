//! The volume version of the fiber BCSDF of Khungurn et al. 2015 (sec. 4.4).
//!
//! ```text
//! e(w)         = |sin(w, fiber)|
//! p_c(wi | wo) = S_c(wi, wo) / Z_c(theta_o),   Z_c = int S_c(wi, wo) dwi          per color channel, no cosine
//!              = [C_R r_1 + r_5 + C_TT (1 - C_R) tt_1] / Z_c
//! ```
//!
//! with the lobes `r = gbar_R/(2 pi)` and `tt = gbar_TT N` of the BCSDF times `1 - w5` (index 1) or `w5 = (1 - cos theta_i)^5` (index
//! 5). The colors of the lobes stand outside of them, so Z needs three one-dimensional integrals for all channels, and a
//! mixture of the channels' phase functions is a mixture of the same three lobes: one path serves three channels.
//!
//! C_R and C_TT set the mixture of the lobes alone; the color of the medium is its albedo. What the model does not do: it is not
//! reciprocal, and only light that is equal from everywhere is kept as it is by an albedo of 1: a narrow beam gains or loses by
//! `int sin(theta_o) p dwo / sin(theta_i)`. Along the fiber nothing is met, and free paths are infinite.

use super::incoming::{Incoming, Part};
use super::{Kept, Medium, MediumModel, Outgoing, Scattered};
use crate::base::{Error, Result};
use crate::math::Random;
use crate::scatter::direction::FiberAngles;
use crate::scatter::khungurn::{LEAST_COLOR, Lobes, check, color, width};
use crate::scatter::{
    CHANNELS, Evaluation, Khungurn, KhungurnScattering, MAX_ROWS, ParameterInfo, Parameters,
    Parametric, Scattering,
};
use glam::DVec3;
use std::f64::consts::TAU;

/// The model `khungurn-volume`: rows `c_r, c_tt, beta_r, beta_tt, gamma_tt, albedo`.
#[derive(Debug, Clone, Copy)]
pub struct KhungurnVolume;

/// Ranges and defaults of Khungurn 2015, Table II.
const PARAMETERS: &[ParameterInfo] = &[
    color("c_r", 0.1),
    color("c_tt", 0.85),
    width("beta_r", 1.0, 10.0, 5.0),
    width("beta_tt", 10.0, 45.0, 10.0),
    width("gamma_tt", 1.0, 45.0, 10.0),
    color("albedo", 0.85),
];

/// The row of the albedo; the rows before it are the BCSDF's.
const ALBEDO: usize = 5;

/// Least share of reflected and transmitted light together: from black fibers there is no phase function.
const LEAST_LIGHT: f64 = 1e-6;

impl Parametric for KhungurnVolume {
    fn name(&self) -> &'static str {
        "khungurn-volume"
    }

    fn parameters(&self) -> &'static [ParameterInfo] {
        PARAMETERS
    }
}

impl MediumModel for KhungurnVolume {
    fn prepare(&self, parameters: &Parameters) -> Result<Box<dyn Medium>> {
        for info in PARAMETERS {
            for value in parameters.channels(info.name) {
                check(self.name(), info, value)?;
            }
        }
        let (c_r, c_tt) = (parameters.channels("c_r"), parameters.channels("c_tt"));
        for c in 0..CHANNELS {
            if c_r[c] + c_tt[c] * (1.0 - c_r[c]) < LEAST_LIGHT {
                return Err(Error::new(format!(
                    "khungurn-volume: 'c_r' {} and 'c_tt' {} leave no light to scatter, expected one of them above {LEAST_LIGHT}",
                    c_r[c], c_tt[c]
                ))
                .with_hint("a dark medium has a low 'albedo'; 'c_r' and 'c_tt' say only how its light is spread"));
            }
        }
        let fiber = Parameters::defaults(&Khungurn);
        let own = parameters.values()[..fiber.values().len()].to_vec();
        let fiber = KhungurnScattering::new(&fiber.with_values(own))?;
        Ok(Box::new(Volume::new(
            fiber,
            [c_r, c_tt],
            parameters.channels("albedo"),
        )))
    }
}

/// The medium at fixed parameters.
struct Volume {
    fiber: KhungurnScattering,
    r: Incoming,
    tt: Incoming,
    /// C_R and C_TT.
    colors: [[f64; CHANNELS]; 2],
    albedo: [f64; CHANNELS],
    /// The colors and albedo by which paths are followed: at a value of zero a path carries derivatives where it carries no
    /// light.
    followed_colors: [[f64; CHANNELS]; 2],
    followed_albedo: [f64; CHANNELS],
}

/// What the direction toward the camera and the channels decide. Lobes in the order `r_1, r_5, tt_1`.
#[derive(Debug, Clone, Copy)]
pub(super) struct CameraSide {
    angles: FiberAngles,
    theta: f64,
    /// Probabilities of the lobes.
    shares: [f64; 3],
    /// The density is this times the lobes, which are not normalized.
    density: [f64; 3],
    /// Per channel: the albedo over Z, both as followed.
    albedo_over_z: [f64; CHANNELS],
}

/// `Z` of a channel with the colors `c_r` and `c_tt`, from the integrals of the lobes.
#[inline]
fn normalizer(c_r: f64, c_tt: f64, [r_1, r_5, tt_1]: [f64; 3]) -> f64 {
    c_r * r_1 + r_5 + c_tt * (1.0 - c_r) * tt_1
}

/// The three lobes at a pair of directions.
#[inline]
fn parts(lobes: &Lobes) -> [f64; 3] {
    let w1 = 1.0 - lobes.w5;
    [w1 * lobes.r, lobes.w5 * lobes.r, w1 * lobes.tt]
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

impl Volume {
    fn new(
        fiber: KhungurnScattering,
        colors: [[f64; CHANNELS]; 2],
        albedo: [f64; CHANNELS],
    ) -> Self {
        let [c_r, c_tt] = colors;
        Self {
            r: Incoming::new(&fiber.r),
            tt: Incoming::new(&fiber.tt),
            fiber,
            colors,
            albedo,
            followed_colors: [
                c_r.map(|c| c.clamp(LEAST_COLOR, 1.0 - LEAST_COLOR)),
                c_tt.map(|c| c.max(LEAST_COLOR)),
            ],
            followed_albedo: albedo.map(|a| a.max(LEAST_COLOR)),
        }
    }

    fn camera_side(&self, wo: DVec3, carried: [f64; CHANNELS]) -> CameraSide {
        let angles = FiberAngles::new(wo);
        let ([r_1, r_5, ..], [tt_1, ..]) =
            (self.r.integrals(angles.t), self.tt.integrals(angles.t));
        let integrals = [r_1, r_5, tt_1];
        let [c_r, c_tt] = self.followed_colors;
        let worth: [f64; CHANNELS] = std::array::from_fn(|c| carried[c] * self.followed_albedo[c]);
        let total: f64 = worth.iter().sum();
        let mut density = [0.0; 3];
        let albedo_over_z = std::array::from_fn(|c| {
            let inverse = 1.0 / normalizer(c_r[c], c_tt[c], integrals);
            let share = if total <= 0.0 {
                1.0 / CHANNELS as f64
            } else {
                worth[c] / total
            };
            density[0] += share * c_r[c] * inverse;
            density[1] += share * inverse;
            density[2] += share * c_tt[c] * (1.0 - c_r[c]) * inverse;
            self.followed_albedo[c] * inverse
        });
        CameraSide {
            theta: self.fiber.theta(&angles),
            angles,
            shares: std::array::from_fn(|k| density[k] * integrals[k]),
            density,
            albedo_over_z,
        }
    }

    fn side(&self, o: &Outgoing) -> CameraSide {
        match o.kept {
            Kept::KhungurnVolume(side) => side,
            Kept::Microflake(_) => self.camera_side(o.wo, o.carried),
        }
    }

    /// Albedo times phase function, as followed.
    fn followed(&self, parts: [f64; 3], side: &CameraSide) -> [f64; CHANNELS] {
        let [c_r, c_tt] = self.followed_colors;
        std::array::from_fn(|c| side.albedo_over_z[c] * normalizer(c_r[c], c_tt[c], parts))
    }
}

impl Medium for Volume {
    fn extinction(&self, w: DVec3) -> f64 {
        (w.y * w.y + w.z * w.z).sqrt()
    }

    fn extinction_slopes(&self, _w: DVec3) -> [f64; MAX_ROWS] {
        [0.0; MAX_ROWS]
    }

    fn majorant(&self) -> f64 {
        1.0
    }

    fn albedo(&self) -> [f64; CHANNELS] {
        self.albedo
    }

    fn evaluate(&self, wi: DVec3, wo: DVec3) -> Evaluation {
        let mut s = self.fiber.evaluate(wi, wo, 0.0);
        let t = FiberAngles::new(wo).t;
        let [r_1, r_5, r_1_by_beta, r_5_by_beta] = self.r.integrals(t);
        let [tt_1, _, tt_1_by_beta, _] = self.tt.integrals(t);
        for c in 0..CHANNELS {
            let (c_r, c_tt) = (self.colors[0][c], self.colors[1][c]);
            let inverse = 1.0 / normalizer(c_r, c_tt, [r_1, r_5, tt_1]);
            let phase = s.value[c] * inverse;
            // dZ by the rows; gamma_TT integrates out.
            let slopes = [
                r_1 - c_tt * tt_1,
                (1.0 - c_r) * tt_1,
                c_r * r_1_by_beta + r_5_by_beta,
                c_tt * (1.0 - c_r) * tt_1_by_beta,
                0.0,
            ];
            for (row, slope) in slopes.into_iter().enumerate() {
                let of_s = s.derivative[row][c];
                s.derivative[row][c] = self.albedo[c] * (of_s - phase * slope) * inverse;
            }
            s.derivative[ALBEDO][c] = phase;
            s.value[c] = self.albedo[c] * phase;
        }
        s
    }

    fn outgoing(&self, wo: DVec3, carried: [f64; CHANNELS]) -> Outgoing {
        Outgoing {
            wo,
            carried,
            kept: Kept::KhungurnVolume(self.camera_side(wo, carried)),
        }
    }

    fn importance(&self, wi: DVec3, o: &Outgoing) -> ([f64; CHANNELS], f64) {
        let (i, side) = (FiberAngles::new(wi), self.side(o));
        let delta = self.fiber.theta(&i) + side.theta;
        let parts = parts(&self.fiber.lobes_at(&i, &side.angles, delta));
        (self.followed(parts, &side), dot(side.density, parts))
    }

    /// One of the three lobes is chosen and drawn from exactly.
    fn sample(&self, o: &Outgoing, random: &mut Random) -> Scattered {
        let side = self.side(o);
        let u = random.uniform() * side.shares.iter().sum::<f64>();
        let reflected = u < side.shares[0] + side.shares[1];
        let (incoming, lobe, part) = match (reflected, u < side.shares[0]) {
            (true, true) => (&self.r, &self.fiber.r, Part::One),
            (true, false) => (&self.r, &self.fiber.r, Part::Five),
            (false, _) => (&self.tt, &self.fiber.tt, Part::One),
        };
        let (theta, sin_theta, cos_theta) = incoming.sample(lobe, part, side.theta, random);
        // Azimuth relative to phi_o + pi, as cosine and sine.
        let (cos_az, sin_az) = if reflected {
            let (sin, cos) = (TAU * random.uniform()).sin_cos();
            (cos, sin)
        } else {
            self.fiber.azimuthal.sample(random)
        };
        let i = side.angles.beyond(sin_theta, cos_theta, cos_az, sin_az);
        let parts = parts(&self.fiber.lobes_at(&i, &side.angles, theta + side.theta));
        let pdf = dot(side.density, parts);
        Scattered {
            wi: DVec3::new(sin_theta, cos_theta * i.az_y, cos_theta * i.az_z),
            weight: self.followed(parts, &side).map(|value| value / pdf),
            pdf,
        }
    }
}
