//! Lambert's law and one lobe of microfacets with the distribution of Trowbridge and Reitz (Walter et al. 2007, "GGX").

use super::lambert::DIFFUSE;
use super::{
    MAX_SURFACE_ROWS, Surface, SurfaceEvaluation, SurfaceModel, above, check, coefficient, scalar,
};
use crate::base::Result;
use crate::scatter::{CHANNELS, ParameterInfo, Parameters, Parametric};
use glam::DVec3;
use std::f64::consts::{FRAC_1_PI, PI};

/// The model `ggx`: `f = k_d/pi + k_s D V`, rows `k_d, k_s, roughness`. Seven numbers.
///
/// `D(h) = a^2 / (pi (a^2 cos^2 + sin^2)^2)`, so that `int D cos(theta_h) dh = 1`, with a the roughness itself; V is Smith's masking with
/// the heights of light and camera correlated (Heitz 2014 eq. 99) over `4 cos(theta_i) cos(theta_r)`. No Fresnel term: `k_s` is the
/// reflectance of a facet, the same at all angles, and the lobe is linear in it. The albedo is at most `k_d + k_s`.
#[derive(Debug, Clone, Copy)]
pub struct Ggx;

const PARAMETERS: &[ParameterInfo] = &[
    DIFFUSE,
    coefficient("k_s", 1.0, 0.05),
    scalar("roughness", 0.05, 1.0, 0.4),
];

impl Parametric for Ggx {
    fn name(&self) -> &'static str {
        "ggx"
    }

    fn parameters(&self) -> &'static [ParameterInfo] {
        PARAMETERS
    }
}

impl SurfaceModel for Ggx {
    fn prepare(&self, parameters: &Parameters) -> Result<Box<dyn Surface>> {
        let row = |k: usize, lower: f64, upper: f64| {
            let values = parameters.channels(PARAMETERS[k].name);
            check(self.name(), &PARAMETERS[k], values, lower, upper)
        };
        Ok(Box::new(Glossy {
            k_d: row(0, 0.0, 1e6)?,
            k_s: row(1, 0.0, 1e6)?,
            roughness: row(2, 1e-3, 10.0)?[0],
        }))
    }
}

struct Glossy {
    k_d: [f64; CHANNELS],
    k_s: [f64; CHANNELS],
    roughness: f64,
}

impl Glossy {
    /// `D V` and its derivative by the roughness.
    fn lobe(&self, wi: DVec3, wr: DVec3) -> (f64, f64) {
        let a2 = self.roughness * self.roughness;
        let h = (wi + wr).normalize();
        let (cos2, sin2) = (h.z * h.z, h.x * h.x + h.y * h.y);
        let t = a2 * cos2 + sin2;
        let d = a2 / (PI * t * t);
        let slant = |z: f64| (a2 + (1.0 - a2) * z * z).sqrt();
        let (s_i, s_r) = (slant(wi.z), slant(wr.z));
        let sum = wr.z * s_i + wi.z * s_r;
        let value = d * 0.5 / sum;
        let by_slant = |z: f64, s: f64| self.roughness * (1.0 - z * z) / s;
        let sum_slope = wr.z * by_slant(wi.z, s_i) + wi.z * by_slant(wr.z, s_r);
        let log_slope = 2.0 / self.roughness - 4.0 * self.roughness * cos2 / t - sum_slope / sum;
        (value, value * log_slope)
    }
}

impl Surface for Glossy {
    fn value(&self, wi: DVec3, wr: DVec3) -> [f64; CHANNELS] {
        self.evaluate(wi, wr).value
    }

    fn evaluate(&self, wi: DVec3, wr: DVec3) -> SurfaceEvaluation {
        let mut e = SurfaceEvaluation::zero();
        if !above(wi, wr) {
            return e;
        }
        let (lobe, slope) = self.lobe(wi, wr);
        for c in 0..CHANNELS {
            e.value[c] = self.k_d[c] * FRAC_1_PI + self.k_s[c] * lobe;
            e.derivative[2][c] = self.k_s[c] * slope;
        }
        e.derivative[0] = [FRAC_1_PI; CHANNELS];
        e.derivative[1] = [lobe; CHANNELS];
        e
    }

    fn colors(&self, wi: DVec3, wr: DVec3) -> [f64; MAX_SURFACE_ROWS] {
        let mut rows = [0.0; MAX_SURFACE_ROWS];
        if above(wi, wr) {
            (rows[0], rows[1]) = (FRAC_1_PI, self.lobe(wi, wr).0);
        }
        rows
    }
}
