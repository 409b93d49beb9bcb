//! Albedos of any scattering function by quadrature over the sphere.
//!
//! For tests, tables and charts; too slow for rendering (tens of milliseconds each).

use super::{CHANNELS, Scattering, fiber_direction};
use crate::math::GaussLegendre;
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// How finely the sphere is divided: enough for lobes of width `narrowest`.
#[derive(Debug, Clone)]
pub struct SphereRule {
    rule: GaussLegendre,
    theta_panels: usize,
    azimuths: usize,
}

impl SphereRule {
    /// A rule for lobes no narrower than `narrowest` radians (standard deviation): panels of ten points, two widths
    /// wide in the longitudinal angle, and azimuths half a width apart (the trapezoid rule on a circle converges
    /// exponentially). Better than 1e-9 relative for Gaussian lobes.
    pub fn new(narrowest: f64) -> Self {
        Self {
            rule: GaussLegendre::new(10),
            theta_panels: ((PI / (2.0 * narrowest)).ceil() as usize).max(16),
            azimuths: ((2.0 * TAU / narrowest).ceil() as usize).max(64),
        }
    }

    /// `int f(theta, phi) dtheta dphi` over theta in [-pi/2, pi/2] and one turn of phi: no cosine inside.
    pub fn integrate(&self, mut f: impl FnMut(f64, f64) -> [f64; CHANNELS]) -> [f64; CHANNELS] {
        let mut sum = [0.0; CHANNELS];
        let step = TAU / self.azimuths as f64;
        let edge = |k: usize| -FRAC_PI_2 + PI * k as f64 / self.theta_panels as f64;
        for panel in 0..self.theta_panels {
            for (theta, weight) in self.rule.on(edge(panel), edge(panel + 1)) {
                for k in 0..self.azimuths {
                    let value = f(theta, step * (k as f64 + 0.5));
                    for c in 0..CHANNELS {
                        sum[c] += weight * step * value[c];
                    }
                }
            }
        }
        sum
    }
}

/// Directional albedo `int S(wi, wo) cos(theta_o) dwo` for light from the longitudinal angle `theta_i`: the share of the
/// incident power that leaves again. Models that conserve energy keep it at most 1.
pub fn directional_albedo(
    scattering: &dyn Scattering,
    theta_i: f64,
    rule: &SphereRule,
) -> [f64; CHANNELS] {
    let wi = fiber_direction(theta_i, 0.0);
    rule.integrate(|theta, phi| {
        let cos = theta.cos();
        let s = scattering
            .evaluate(wi, fiber_direction(theta, phi), 0.0)
            .value;
        s.map(|s| s * cos * cos)
    })
}

/// Reverse albedo `int S(wi, wo) cos(theta_i) dwi` for a camera at the longitudinal angle `theta_o`: the radiance a fiber
/// shows in uniform light of radiance 1. For a model that is not reciprocal it differs from the directional albedo and may
/// exceed 1.
pub fn reverse_albedo(
    scattering: &dyn Scattering,
    theta_o: f64,
    rule: &SphereRule,
) -> [f64; CHANNELS] {
    let wo = fiber_direction(theta_o, 0.0);
    rule.integrate(|theta, phi| {
        let cos = theta.cos();
        let s = scattering
            .evaluate(fiber_direction(theta, phi), wo, 0.0)
            .value;
        s.map(|s| s * cos * cos)
    })
}
