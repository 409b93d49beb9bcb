//! Albedos of any scattering function by quadrature over the sphere.
//!
//! For tests, tables and charts; too slow for rendering (tens of milliseconds each). A near-field function is averaged over
//! where across the fiber it is met, as a camera that does not resolve the fiber sees it.

use super::{CHANNELS, Passage, Scattering, fiber_direction};
use crate::math::GaussLegendre;
use glam::DVec3;
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

/// A scattering function averaged over `h`.
struct Mean<'a> {
    scattering: &'a dyn Scattering,
    /// `h` and weight.
    places: Vec<(f64, f64)>,
}

impl<'a> Mean<'a> {
    fn new(scattering: &'a dyn Scattering) -> Self {
        let places = match scattering.passage() {
            Passage::Across => vec![(0.0, 1.0)],
            // h = sin(gamma): the integrand is smooth in gamma up to the rim.
            Passage::Straight => GaussLegendre::new(24)
                .on(-FRAC_PI_2, FRAC_PI_2)
                .map(|(gamma, weight)| (gamma.sin(), 0.5 * weight * gamma.cos()))
                .collect(),
        };
        Self { scattering, places }
    }

    fn value(&self, wi: DVec3, wo: DVec3) -> [f64; CHANNELS] {
        let mut mean = [0.0; CHANNELS];
        for &(h, weight) in &self.places {
            let value = self.scattering.evaluate(wi, wo, h).value;
            for c in 0..CHANNELS {
                mean[c] += weight * value[c];
            }
        }
        mean
    }
}

/// Directional albedo `int S(wi, wo) cos(theta_o) dwo` for light from the longitudinal angle `theta_i`: the share of the
/// incident power that leaves again. Models that conserve energy keep it at most 1.
pub fn directional_albedo(
    scattering: &dyn Scattering,
    theta_i: f64,
    rule: &SphereRule,
) -> [f64; CHANNELS] {
    let (wi, mean) = (fiber_direction(theta_i, 0.0), Mean::new(scattering));
    rule.integrate(|theta, phi| {
        let cos = theta.cos();
        let s = mean.value(wi, fiber_direction(theta, phi));
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
    let (wo, mean) = (fiber_direction(theta_o, 0.0), Mean::new(scattering));
    rule.integrate(|theta, phi| {
        let cos = theta.cos();
        let s = mean.value(fiber_direction(theta, phi), wo);
        s.map(|s| s * cos * cos)
    })
}
