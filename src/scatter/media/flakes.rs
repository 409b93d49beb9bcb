//! The Gaussian distribution of flakes about a fiber (Zhao 2011 sec. 4), and what a beam sees of it.
//!
//! ```text
//! D(m)  = exp(-mu^2/(2 gamma^2)) / ((2 pi)^1.5 gamma erf(1/(sqrt2 gamma)))     mu = m . x;  int D dm = 1
//! s(w)  = int |w . m| D(m) dm                                                   projected area per unit of flake area
//! ```
//!
//! `gamma` is a standard deviation in the cosine to the fiber, not an angle. Flakes have two equal sides: D and s are even.

use crate::math::special::{erf_inv, erfc_inv};
use crate::math::{GaussLegendre, Random};
use crate::scatter::direction::FiberAngles;
use crate::scatter::piecewise::Piecewise;
use glam::DVec3;
use std::f64::consts::{FRAC_1_SQRT_2, PI, SQRT_2, TAU};

/// Beyond this many gammas the Gaussian is below 2e-16 of its peak.
const REACH: f64 = 8.5;

/// Nodes in each part of the integral over mu.
const NODES: usize = 64;

/// Pieces of the table of s.
const PIECES: usize = 24;

/// How far below `gamma` the table of s is stretched about the fiber's axis.
const STRETCH: f64 = 4.0;

/// Most flakes proposed for one event. At least 0.44 of the proposals are taken, whatever gamma and direction: all being refused
/// has a probability below 1e-30, less than what rounding does to the uniform numbers.
const MOST_PROPOSALS: usize = 128;

/// The distribution at one width `gamma > 0`.
#[derive(Debug, Clone)]
pub struct FlakeDistribution {
    gamma: f64,
    /// `erf(1/(sqrt2 gamma))`, and one minus that, which is not lost where the former rounds to 1.
    error: f64,
    error_complement: f64,
    /// `1 - exp(-1/(2 gamma^2))`.
    complement: f64,
    /// D on the plane across the fiber.
    peak: f64,
    half_inverse_square: f64,
    inverse_cube: f64,
    /// `d ln(peak) / d gamma`.
    log_peak_by_gamma: f64,
    /// s along the fiber, which is also the mean of |mu|.
    along: f64,
    /// s across the fiber: the largest.
    across: f64,
    /// `(along/across)^2`.
    flattening: f64,
    /// `STRETCH min(gamma, 1)`.
    stretch: f64,
    /// s and ds/dgamma over [`FlakeDistribution::ellipse`], which takes the steep part, as functions of
    /// `sin theta (1 + stretch) / (sin theta + stretch)`, `theta` the angle to the fiber.
    table: Piecewise<2>,
}

impl FlakeDistribution {
    /// Precomputes what depends on gamma alone, in about a millisecond.
    pub fn new(gamma: f64) -> Self {
        let error = libm::erf(FRAC_1_SQRT_2 / gamma);
        let half_inverse_square = 0.5 / (gamma * gamma);
        let complement = -(-half_inverse_square).exp_m1();
        let slope = (1.0 - complement) * 2.0 / (TAU.sqrt() * error * gamma * gamma);
        let mut flakes = Self {
            gamma,
            error,
            error_complement: libm::erfc(FRAC_1_SQRT_2 / gamma),
            complement,
            peak: 1.0 / (TAU * TAU.sqrt() * gamma * error),
            half_inverse_square,
            inverse_cube: gamma.powi(-3),
            log_peak_by_gamma: slope - 1.0 / gamma,
            along: gamma * (2.0 / PI).sqrt() * complement / error,
            across: 0.0,
            flattening: 0.0,
            stretch: STRETCH * gamma.min(1.0),
            table: Piecewise::new(1, |_| [0.0; 2]),
        };
        let rule = GaussLegendre::new(NODES);
        flakes.across = flakes.integrate_by(&rule, 1.0)[0];
        flakes.flattening = (flakes.along / flakes.across).powi(2);
        let k = flakes.stretch;
        flakes.table = Piecewise::new(PIECES, |v| {
            let sine = k * v / (1.0 + k - v);
            let ellipse = flakes.ellipse(sine);
            flakes.integrate_by(&rule, sine).map(|x| x / ellipse)
        });
        flakes
    }

    /// `D` where the cosine to the fiber is `mu`, 1/sr, and `d ln D / d gamma`.
    #[inline]
    pub fn density(&self, mu: f64) -> (f64, f64) {
        let square = mu * mu;
        (
            self.peak * (-square * self.half_inverse_square).exp(),
            square * self.inverse_cube + self.log_peak_by_gamma,
        )
    }

    /// `s` and `ds/dgamma` for a beam at an angle of this sine, in [0, 1], to the fiber: from a table, to 1e-12 relative
    /// (ds/dgamma: of s/gamma).
    #[inline]
    pub fn projected_area(&self, sine: f64) -> [f64; 2] {
        // Rounding may leave the sine of a unit vector a little above 1.
        let v = sine * (1.0 + self.stretch) / (sine + self.stretch);
        let ellipse = self.ellipse(sine);
        self.table.at(v).map(|x| x * ellipse)
    }

    /// Radius toward this sine of an ellipse with the axes of s; s is within 5 % of a multiple of it.
    #[inline]
    fn ellipse(&self, sine: f64) -> f64 {
        (self.flattening + (1.0 - self.flattening) * (sine * sine)).sqrt()
    }

    /// `s` across the fiber: the largest of any direction.
    pub fn largest_projected_area(&self) -> f64 {
        self.across
    }

    /// `s` and `ds/dgamma` by quadrature over mu, to 1e-14; slow.
    ///
    /// The azimuth integrates in closed form: with A = |mu cos theta| and B = sin theta sqrt(1 - mu^2) it is `2 pi A` where
    /// A >= B, else `4 (sqrt(B^2 - A^2) + A asin(A/B))`; and `B^2 - A^2 = sin^2 theta - mu^2`.
    pub fn integrate(&self, sine: f64) -> [f64; 2] {
        self.integrate_by(&GaussLegendre::new(NODES), sine)
    }

    fn integrate_by(&self, rule: &GaussLegendre, sine: f64) -> [f64; 2] {
        let cosine = ((1.0 - sine) * (1.0 + sine)).max(0.0).sqrt();
        let end = (REACH * self.gamma).min(1.0);
        let kink = sine.min(end);
        let mut sum = [0.0; 2];
        for (low, high) in [(0.0, kink), (kink, end)] {
            if high <= low {
                continue;
            }
            for (t, weight) in rule.on(0.0, 1.0) {
                // Both ends of a part may hold a root: nodes crowd there.
                let (half, angle) = (0.5 * (high - low), PI * t);
                let mu = low + half * (1.0 - angle.cos());
                let a = mu * cosine;
                let around = if mu >= sine {
                    TAU * a
                } else {
                    let b = sine * ((1.0 - mu) * (1.0 + mu)).sqrt();
                    4.0 * (((sine - mu) * (sine + mu)).sqrt() + a * (a / b).min(1.0).asin())
                };
                let (density, slope) = self.density(mu);
                let part = 2.0 * weight * half * PI * angle.sin() * density * around;
                sum[0] += part;
                sum[1] += part * slope;
            }
        }
        sum
    }

    /// The cosine to the fiber above which a share `xi` in [0, 1] of all flakes lies: the closed inverse of Zhao 2011's F(theta). The
    /// ends are 1 and -1, where `erf` alone would not know how far to go.
    pub fn cosine(&self, xi: f64) -> f64 {
        if xi < 0.5 {
            self.quantile(1.0 - 2.0 * xi, 2.0 * xi)
        } else {
            -self.quantile(2.0 * xi - 1.0, 2.0 * (1.0 - xi))
        }
    }

    /// The cosine within which a share `inside` of the flakes lies; `inside + outside = 1`.
    fn quantile(&self, inside: f64, outside: f64) -> f64 {
        let y = if inside < 0.5 {
            erf_inv(inside * self.error)
        } else {
            erfc_inv(outside + inside * self.error_complement)
        };
        // Rounding alone, and the infinity where 1 is many gammas away.
        (SQRT_2 * self.gamma * y).min(1.0)
    }

    /// A flake normal `m` from the flakes that a beam along `wo` (of these angles) sees: density `|wo . m| D(m) / s(wo)`, and
    /// `wo . m`. `m` and `-m` are one flake, so its x component is never negative. A direction that is NaN gives NaN.
    ///
    /// Exact, by rejection: with `A = |mu cos theta|`, `wo . m = +-A + B cos psi` is at most `A + sin theta`, which is a mixture of two
    /// proposals with a closed inverse each: flakes in proportion to `mu D` and to `D`.
    pub(super) fn sample_seen(&self, wo: &FiberAngles, random: &mut Random) -> (DVec3, f64) {
        // cos and sin of the angle to the fiber.
        let (c, s) = (wo.sin_theta, wo.cos_theta);
        let along = c.abs() * self.along;
        for _ in 0..MOST_PROPOSALS {
            let u = random.uniform();
            let mu = if random.uniform() * (along + s) < along {
                (self.gamma * (-2.0 * (-u * self.complement).ln_1p()).sqrt()).min(1.0)
            } else {
                self.quantile(u, 1.0 - u)
            };
            let across = ((1.0 - mu) * (1.0 + mu)).sqrt();
            let (sin_psi, cos_psi) = (TAU * random.uniform()).sin_cos();
            let cosine = c * mu + s * across * cos_psi;
            if random.uniform() * (c.abs() * mu + s) < cosine.abs() {
                let (y, z) = (across * cos_psi, across * sin_psi);
                let m = DVec3::new(mu, y * wo.az_y - z * wo.az_z, y * wo.az_z + z * wo.az_y);
                return (m, cosine);
            }
        }
        (DVec3::NAN, f64::NAN)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_follows_the_quadrature_at_every_width() {
        for gamma in [0.001, 0.005, 0.013, 0.1, 0.37, 1.0, 1.5, 10.0, 100.0] {
            let flakes = FlakeDistribution::new(gamma);
            let (mut worst, mut worst_slope) = (0.0_f64, 0.0_f64);
            for k in 0..=4000 {
                // Half of them within ten gammas of the axis.
                let x = f64::from(k) / 4000.0;
                let sine = if k % 2 == 0 {
                    x
                } else {
                    (10.0 * gamma * x).min(1.0)
                };
                let [s, slope] = flakes.integrate(sine);
                let [found, found_slope] = flakes.projected_area(sine);
                worst = worst.max((found / s - 1.0).abs());
                worst_slope = worst_slope.max((found_slope - slope).abs() * gamma / s);
            }
            println!("gamma {gamma}: s {worst:.1e}, ds/dgamma {worst_slope:.1e}");
            assert!(worst < 1e-12 && worst_slope < 1e-12, "{gamma}");
        }
    }

    #[test]
    fn the_area_is_largest_across_the_fiber_and_closed_along_it() {
        for gamma in [0.001, 0.005, 0.1, 0.7, 1.5, 100.0] {
            let flakes = FlakeDistribution::new(gamma);
            let mut before = 0.0;
            for k in 0..=1000 {
                let s = flakes.projected_area(f64::from(k) / 1000.0)[0];
                assert!(
                    s > before * (1.0 - 1e-12),
                    "gamma {gamma}, {k}: {s} {before}"
                );
                before = s;
            }
            let top = flakes.largest_projected_area();
            assert!((before / top - 1.0).abs() < 1e-12, "{before} {top}");
            let along = flakes.integrate(0.0)[0];
            assert!((along / flakes.along - 1.0).abs() < 1e-13, "{along}");
        }
    }

    /// The constant of [`MOST_PROPOSALS`]: the share of proposals that is taken is `s / (|cos| s_along + sin)`.
    #[test]
    fn at_least_44_of_100_proposals_are_taken_and_as_many_as_that_says() {
        let mut least = 1.0_f64;
        for gamma in [0.001, 0.005, 0.05, 0.3, 0.6, 1.0, 1.5, 10.0, 100.0] {
            let flakes = FlakeDistribution::new(gamma);
            for k in 0..=900 {
                let (s, c) = (f64::from(k) * 0.1).to_radians().sin_cos();
                least = least.min(flakes.projected_area(s)[0] / (c * flakes.along + s));
            }
        }
        println!("least share: {least:.4}");
        assert!((0.44..0.5).contains(&least), "{least}");
        let refused_always = (1.0 - least).powi(MOST_PROPOSALS as i32);
        assert!(refused_always < 1e-30, "{refused_always}");
    }

    #[test]
    fn a_direction_that_is_not_a_number_ends() {
        let flakes = FlakeDistribution::new(0.1);
        let (m, cosine) =
            flakes.sample_seen(&FiberAngles::new(DVec3::NAN), &mut Random::keyed(&[1]));
        assert!(m.is_nan() && cosine.is_nan());
    }
}
