//! The near-field hair BSDF of Chiang et al. 2016 without scale tilt: reflection R, transmission TT, one internal
//! reflection TRT, and all the rest as a fourth lobe.
//!
//! ```text
//! S = sum_p M_p A_p N_p / cos(theta_i)                              p = 0, 1, 2, 3; A_p per color channel
//! M_p = exp(-sin theta_i sin theta_o / v_p) I_0(cos theta_i cos theta_o / v_p) / (2 v_p sinh(1 / v_p))
//! N_p = trimmed logistic of phi_i - phi_o - (2 p gamma_t - 2 gamma_o + p pi), scale s;  N_3 = 1 / (2 pi)
//! A_0 = F,  A_1 = (1 - F)^2 T,  A_2 = A_1 T F,  A_3 = A_2 T F / (1 - T F)
//! T = exp(-2 sigma_a cos(gamma_t) / cos(theta_t))                   sigma_a per fiber radius
//! ```
//!
//! Everything that depends on where the fiber is met (`sin gamma_o = h`), on refraction and on absorption belongs to the
//! camera side: `theta_t`, `gamma_t`, F and T come from `theta_o` and `h`. The index of refraction is 1.55 and fixed; `v_p`
//! follows from `beta_m`, `s` and `sigma_a` from `beta_n` and the color by the published fits, which make the color about that of
//! a dense mass of such fibers.
//!
//! What the model does not do: no tilted scales, no elliptic cross-section, no medulla. It is not reciprocal, as refraction
//! and absorption look at the camera side alone. Light leaves where the fiber was met, so a ray goes straight on through the
//! fiber ([`Passage::Straight`]).
//!
//! Stable forms: `cos theta_i cos theta_o - sin theta_i sin theta_o - 1` is `-(x_i (1 + cos theta_o) + x_o (1 + cos theta_i))^2 /
//! (2 (1 + cos theta_i)(1 + cos theta_o))`, so M_p is one exponential times `exp(-x) I_0(x)` and neither overflows nor cancels; 1 - F has
//! its own formula and `1 - T F = (1 - T) + T (1 - F)`, so that grazing views and clear fibers lose no digits.

use super::direction::{FiberAngles, ON_AXIS};
use super::piecewise::Piecewise;
use super::{
    CHANNELS, Evaluation, Kept, MAX_ROWS, Model, Outgoing, ParameterInfo, Parameters, Parametric,
    Passage, Sampled, Scattering, Unit,
};
use crate::base::{Error, Result};
use crate::math::Random;
use crate::math::special::{bessel_ratio_deficit, i0e};
use glam::DVec3;
use std::f64::consts::{PI, TAU};

/// The model `chiang`: rows `color, beta_m, beta_n`.
#[derive(Debug, Clone, Copy)]
pub struct Chiang;

/// Index of refraction of the fiber.
const ETA: f64 = 1.55;

/// Least roughness that is accepted; its TT lobe is 0.2 degrees wide.
const LEAST_ROUGHNESS: f64 = 0.01;

const PARAMETERS: &[ParameterInfo] = &[
    ParameterInfo {
        name: "color",
        per_channel: true,
        unit: Unit::One,
        lower: 0.001,
        upper: 0.999,
        default: 0.5,
    },
    roughness("beta_m"),
    roughness("beta_n"),
];

/// The published domain is 0 to 1; below 0.05 the lobes are those of a polished glass fiber.
const fn roughness(name: &'static str) -> ParameterInfo {
    ParameterInfo {
        name,
        per_channel: false,
        unit: Unit::One,
        lower: 0.05,
        upper: 1.0,
        default: 0.3,
    }
}

impl Parametric for Chiang {
    fn name(&self) -> &'static str {
        "chiang"
    }

    fn parameters(&self) -> &'static [ParameterInfo] {
        PARAMETERS
    }
}

impl Model for Chiang {
    fn prepare(&self, parameters: &Parameters) -> Result<Box<dyn Scattering>> {
        Ok(Box::new(ChiangScattering::new(parameters)?))
    }

    /// Both roughnesses are widths.
    fn wider(&self, row: usize, value: f64, factor: f64) -> f64 {
        if PARAMETERS[row].per_channel {
            value
        } else {
            (factor * value).min(1.0)
        }
    }
}

/// R, TT, TRT and the rest.
const LOBES: usize = 4;

/// The BSDF of Chiang 2016 at fixed parameters.
#[derive(Debug, Clone)]
pub struct ChiangScattering {
    absorption: [Absorption; CHANNELS],
    longitudinal: Longitudinal,
    azimuthal: TrimmedLogistic,
}

impl ChiangScattering {
    /// Precomputes what depends on the parameters alone, in about 0.1 ms.
    ///
    /// # Errors
    /// A color outside [0, 1], or a roughness outside [0.01, 1].
    pub fn new(parameters: &Parameters) -> Result<Self> {
        for info in PARAMETERS {
            for value in parameters.channels(info.name) {
                check(info, value)?;
            }
        }
        let beta_n = parameters.scalar("beta_n");
        Ok(Self {
            absorption: parameters
                .channels("color")
                .map(|c| Absorption::new(c, beta_n)),
            longitudinal: Longitudinal::new(parameters.scalar("beta_m")),
            azimuthal: TrimmedLogistic::new(beta_n),
        })
    }

    /// `S cos(theta_i)` per channel and the density of [`Scattering::sample`].
    #[inline(always)]
    fn sums(o: &CameraSide, lobes: &[Lobe; LOBES]) -> ([f64; CHANNELS], f64) {
        let sum = |strength: &[f64; LOBES]| -> f64 {
            strength.iter().zip(lobes).map(|(a, l)| a * l.value).sum()
        };
        (
            std::array::from_fn(|c| sum(&o.attenuation[c])),
            sum(&o.share),
        )
    }

    /// `M_p N_p` and its logarithmic derivatives; an optimizer drops the latter where they are not used.
    #[inline(always)]
    fn lobes(&self, i: &FiberAngles, o: &CameraSide) -> [Lobe; LOBES] {
        let w = &o.direction;
        let phi = (w.az_y * i.az_z - w.az_z * i.az_y).atan2(w.az_y * i.az_y + w.az_z * i.az_z);
        let m = self.longitudinal.at(i, w);
        std::array::from_fn(|p| {
            let along = m[p.min(2)];
            if p == 3 {
                return Lobe {
                    value: along.value / TAU,
                    by_beta_m: along.by_beta,
                    by_beta_n: 0.0,
                };
            }
            let around = self.azimuthal.density(phi - o.azimuth(p));
            Lobe {
                value: along.value * around.value,
                by_beta_m: along.by_beta,
                by_beta_n: around.by_beta,
            }
        })
    }

    fn evaluate_directions(&self, i: &FiberAngles, o: &CameraSide) -> Evaluation {
        let lobes = self.lobes(i, o);
        let (sums, _) = Self::sums(o, &lobes);
        let inverse_cos = 1.0 / i.cos_theta;
        let mut derivative = [[0.0; CHANNELS]; MAX_ROWS];
        for c in 0..CHANNELS {
            let (mut by_sigma, mut by_beta_m, mut by_beta_n) = (0.0, 0.0, 0.0);
            for (p, lobe) in lobes.iter().enumerate() {
                let share = o.attenuation[c][p] * lobe.value;
                by_beta_m += share * lobe.by_beta_m;
                by_beta_n += share * lobe.by_beta_n;
                by_sigma += o.by_sigma[c][p] * lobe.value;
            }
            let a = &self.absorption[c];
            // Where the fiber is black both factors' limits are zero times infinity, and the product's limit is zero.
            let through = |rate: f64| {
                if by_sigma == 0.0 {
                    0.0
                } else {
                    by_sigma * rate
                }
            };
            derivative[0][c] = through(a.by_color) * inverse_cos;
            derivative[1][c] = by_beta_m * inverse_cos;
            derivative[2][c] = (by_beta_n + through(a.by_beta_n)) * inverse_cos;
        }
        Evaluation {
            value: sums.map(|s| s * inverse_cos),
            derivative,
        }
    }
}

impl Scattering for ChiangScattering {
    fn evaluate(&self, wi: DVec3, wo: DVec3, h: f64) -> Evaluation {
        let o = CameraSide::new(wo, h, &self.absorption, [1.0; CHANNELS]);
        self.evaluate_directions(&FiberAngles::new(wi), &o)
    }

    fn outgoing(&self, wo: DVec3, h: f64, carried: [f64; CHANNELS]) -> Outgoing {
        Outgoing {
            kept: Kept::Chiang(CameraSide::new(wo, h, &self.absorption, carried)),
            ..Outgoing::new(wo, h, carried)
        }
    }

    fn importance(&self, wi: DVec3, o: &Outgoing) -> ([f64; CHANNELS], f64) {
        let i = FiberAngles::new(wi);
        let (sums, pdf) = self.with_side(o, |o| Self::sums(o, &self.lobes(&i, o)));
        let inverse_cos = 1.0 / i.cos_theta;
        (sums.map(|s| s * inverse_cos), pdf)
    }

    /// A lobe by the root mean square of what the channels carry of A_p; then both of its factors exactly (d'Eon et al. 2011
    /// for M_p), so that the density is `sum_p share_p M_p N_p`.
    fn sample(&self, o: &Outgoing, random: &mut Random) -> Option<Sampled> {
        self.with_side(o, |o| Some(self.sample_from(o, random)))
    }

    fn passage(&self) -> Passage {
        Passage::Straight
    }

    fn narrowest(&self) -> f64 {
        let azimuthal = self.azimuthal.s * PI / 3.0_f64.sqrt();
        let longitudinal = self.longitudinal.variance[1].sqrt();
        azimuthal.min(longitudinal).min(10_f64.to_radians())
    }
}

impl ChiangScattering {
    /// What was computed of a camera side ahead, or now.
    fn with_side<T>(&self, o: &Outgoing, f: impl FnOnce(&CameraSide) -> T) -> T {
        match &o.kept {
            Kept::Chiang(side) => f(side),
            _ => f(&CameraSide::new(o.wo, o.h, &self.absorption, o.carried)),
        }
    }

    fn sample_from(&self, o: &CameraSide, random: &mut Random) -> Sampled {
        let mut left = random.uniform();
        let p = o.share[..LOBES - 1].iter().position(|share| {
            left -= share;
            left < 0.0
        });
        let p = p.unwrap_or(LOBES - 1);
        let (sin_theta, cos_theta) = self.longitudinal.sample(p, &o.direction, random);
        let phi = if p == 3 {
            TAU * random.uniform()
        } else {
            o.azimuth(p) + self.azimuthal.sample(random)
        };
        let (sin, cos) = phi.sin_cos();
        let w = &o.direction;
        let (az_y, az_z) = (w.az_y * cos - w.az_z * sin, w.az_z * cos + w.az_y * sin);
        let i = FiberAngles::of_parts(sin_theta, cos_theta, az_y, az_z);
        let (sums, pdf) = Self::sums(o, &self.lobes(&i, o));
        Sampled {
            wi: DVec3::new(sin_theta, cos_theta * az_y, cos_theta * az_z),
            weight: sums.map(|s| s / pdf),
            pdf,
        }
    }
}

/// One lobe's `M_p N_p`, and the derivatives of its logarithm.
#[derive(Debug, Clone, Copy)]
struct Lobe {
    value: f64,
    by_beta_m: f64,
    by_beta_n: f64,
}

/// One factor of a lobe, and the derivative of its logarithm by its roughness.
#[derive(Debug, Clone, Copy)]
struct Factor {
    value: f64,
    by_beta: f64,
}

/// What the direction toward the camera and the place where it meets the fiber decide.
#[derive(Debug, Clone, Copy)]
pub(super) struct CameraSide {
    direction: FiberAngles,
    gamma_o: f64,
    gamma_t: f64,
    /// A_p.
    attenuation: [[f64; LOBES]; CHANNELS],
    /// `d A_p / d sigma_a`.
    by_sigma: [[f64; LOBES]; CHANNELS],
    /// The probability of sampling each lobe.
    share: [f64; LOBES],
}

impl CameraSide {
    #[inline(always)]
    fn new(
        wo: DVec3,
        h: f64,
        absorption: &[Absorption; CHANNELS],
        carried: [f64; CHANNELS],
    ) -> Self {
        let direction = FiberAngles::new(wo);
        let (sin2, cos_o) = (
            direction.sin_theta * direction.sin_theta,
            direction.cos_theta,
        );
        // sin gamma_t = h / eta', eta' = sqrt(eta^2 - sin^2 theta_o) / cos theta_o.
        let root = (ETA * ETA - sin2).sqrt();
        let sin_gamma_t = h * cos_o / root;
        let cos_gamma_t = ((1.0 - sin_gamma_t) * (1.0 + sin_gamma_t)).sqrt();
        // 2 cos gamma_t / cos theta_t, in fiber radii.
        let path = 2.0 * cos_gamma_t * ETA / root;
        let (reflected, entered) = fresnel(cos_o * ((1.0 - h) * (1.0 + h)).sqrt());

        let mut side = Self {
            direction,
            gamma_o: h.asin(),
            gamma_t: sin_gamma_t.asin(),
            attenuation: [[0.0; LOBES]; CHANNELS],
            by_sigma: [[0.0; LOBES]; CHANNELS],
            share: [0.0; LOBES],
        };
        for (c, a) in absorption.iter().enumerate() {
            let optical = a.sigma * path;
            let t = (-optical).exp();
            // 1 - T F, and (1 - F) / (1 - T F), whose limit for a clear fiber seen edge-on is not needed: it is
            // multiplied by 1 - F = 0 there.
            let missing = -(-optical).exp_m1() + t * entered;
            let ratio = if entered == 0.0 {
                0.0
            } else {
                entered / missing
            };
            let tt = entered * entered * t;
            let trt = tt * t * reflected;
            let rest = entered * ratio * (t * t * t) * (reflected * reflected);
            side.attenuation[c] = [reflected, tt, trt, rest];
            side.by_sigma[c] = [
                0.0,
                -path * tt,
                -2.0 * path * trt,
                -path * (3.0 * rest + ratio * ratio * (t * reflected).powi(3) * t),
            ];
            for p in 0..LOBES {
                side.share[p] += (carried[c] * side.attenuation[c][p]).powi(2);
            }
        }
        side.share = side.share.map(f64::sqrt);
        let total: f64 = side.share.iter().sum();
        side.share = if total > 0.0 {
            side.share.map(|s| s / total)
        } else {
            [1.0 / LOBES as f64; LOBES]
        };
        side
    }

    /// Azimuth from `wo` at which lobe `p` is centered.
    fn azimuth(&self, p: usize) -> f64 {
        p as f64 * (2.0 * self.gamma_t + PI) - 2.0 * self.gamma_o
    }
}

/// Unpolarized Fresnel reflectance of the fiber's surface, and one minus it without cancellation.
#[inline(always)]
fn fresnel(cos_i: f64) -> (f64, f64) {
    let cos_t = (1.0 - (1.0 - cos_i * cos_i) / (ETA * ETA)).sqrt();
    let (s, p) = (cos_i + ETA * cos_t, ETA * cos_i + cos_t);
    let (r_s, r_p) = ((cos_i - ETA * cos_t) / s, (ETA * cos_i - cos_t) / p);
    let entered = 2.0 * ETA * cos_i * cos_t * (1.0 / (s * s) + 1.0 / (p * p));
    (0.5 * (r_s * r_s + r_p * r_p), entered)
}

/// Absorption in one channel: `sigma_a = (ln C / g(beta_n))^2` per fiber radius.
#[derive(Debug, Clone, Copy)]
struct Absorption {
    sigma: f64,
    by_color: f64,
    by_beta_n: f64,
}

impl Absorption {
    fn new(color: f64, beta_n: f64) -> Self {
        // Coefficients of g by powers of beta_n (Chiang 2016 eq. 9).
        const G: [f64; 6] = [5.969, -0.215, 2.532, -10.73, 5.574, 0.245];
        let (g, slope) = G
            .iter()
            .rev()
            .fold((0.0, 0.0), |(g, d), a| (g * beta_n + a, d * beta_n + g));
        let root = color.ln() / g;
        let sigma = root * root;
        Self {
            sigma,
            by_color: 2.0 * root / (g * color),
            by_beta_n: -2.0 * sigma * slope / g,
        }
    }
}

/// M_0, M_1 and M_2 = M_3: variances v, v/4 and 4 v.
#[derive(Debug, Clone)]
struct Longitudinal {
    variance: [f64; 3],
    /// `1 / (v (1 - exp(-2 / v)))`.
    scale: [f64; 3],
    /// `(2 / v) / (exp(2 / v) - 1) - 1`.
    offset: [f64; 3],
    /// `d ln v / d beta_m`, the same for all lobes.
    rate: f64,
    bessel: BesselTable,
}

impl Longitudinal {
    fn new(beta: f64) -> Self {
        let deviation = 0.726 * beta + 0.812 * beta * beta + 3.7 * beta.powi(20);
        let slope = 0.726 + 1.624 * beta + 74.0 * beta.powi(19);
        let v = deviation * deviation;
        let variance = [v, 0.25 * v, 4.0 * v];
        Self {
            variance,
            scale: variance.map(|v| -1.0 / (v * (-2.0 / v).exp_m1())),
            offset: variance.map(|v| (2.0 / v) / (2.0 / v).exp_m1() - 1.0),
            rate: 2.0 * slope / deviation,
            bessel: BesselTable::new(),
        }
    }

    #[inline(always)]
    fn at(&self, i: &FiberAngles, o: &FiberAngles) -> [Factor; 3] {
        let (plus_i, plus_o) = (1.0 + i.cos_theta, 1.0 + o.cos_theta);
        let across = i.sin_theta * plus_o + o.sin_theta * plus_i;
        // 1 - cos(theta_i + theta_o).
        let deficit = 0.5 * across * across / (plus_i * plus_o);
        let cosines = i.cos_theta * o.cos_theta;
        let q = (-deficit / self.variance[2]).exp();
        let (q2, q4) = (q * q, (q * q) * (q * q));
        let q8 = (q2 * q2) * q4;
        let exponential = [q4, q8 * q8, q];
        std::array::from_fn(|p| {
            let x = cosines / self.variance[p];
            let (i0e, x_deficit) = self.bessel.at(x);
            Factor {
                value: self.scale[p] * exponential[p] * i0e,
                by_beta: self.rate * (deficit / self.variance[p] + x_deficit + self.offset[p]),
            }
        })
    }

    /// Sine and cosine of theta_i by lobe `p`: M_p is the longitudinal part of a von Mises-Fisher lobe on the sphere about the
    /// mirrored direction.
    fn sample(&self, p: usize, o: &FiberAngles, random: &mut Random) -> (f64, f64) {
        let v = self.variance[p.min(2)];
        // 1 - cos of the angle from the mirrored direction.
        let deficit = -v * (random.uniform_open() * (-2.0 / v).exp_m1()).ln_1p();
        let (cos, sin) = (1.0 - deficit, (deficit * (2.0 - deficit)).max(0.0).sqrt());
        let (sin_turn, cos_turn) = (TAU * random.uniform()).sin_cos();
        let along = -cos * o.sin_theta + sin * cos_turn * o.cos_theta;
        let outward = cos * o.cos_theta + sin * cos_turn * o.sin_theta;
        let sideways = sin * sin_turn;
        let cos_theta = (outward * outward + sideways * sideways).sqrt();
        (
            along,
            if cos_theta < ON_AXIS {
                ON_AXIS
            } else {
                cos_theta
            },
        )
    }
}

/// `exp(-x) I_0(x)` and `x (1 - I_1(x) / I_0(x))` for any `x >= 0`, to about 1e-14 relative.
#[derive(Debug, Clone)]
struct BesselTable(Piecewise<2>);

impl BesselTable {
    /// Sets how the axis is compressed: `t = x / (x + HALF)`.
    const HALF: f64 = 2.0;

    fn new() -> Self {
        Self(Piecewise::new(32, |t| {
            let x = Self::HALF * t / (1.0 - t);
            [
                i0e(x) * (x + Self::HALF).sqrt(),
                x * bessel_ratio_deficit(x),
            ]
        }))
    }

    #[inline(always)]
    fn at(&self, x: f64) -> (f64, f64) {
        let inverse = 1.0 / (x + Self::HALF);
        let [scaled, x_deficit] = self.0.at(x * inverse);
        (scaled * inverse.sqrt(), x_deficit)
    }
}

/// The logistic distribution of scale `s`, cut to [-pi, pi].
#[derive(Debug, Clone, Copy)]
struct TrimmedLogistic {
    s: f64,
    inverse: f64,
    /// `exp(-pi / s)`.
    tail: f64,
    /// `1 / (s tanh(pi / 2 s))`.
    scale: f64,
    /// The part of `d ln N / d s` that does not depend on the angle.
    offset: f64,
    /// `ds / d beta_n`.
    rate: f64,
}

impl TrimmedLogistic {
    fn new(beta: f64) -> Self {
        let factor = (PI / 8.0).sqrt();
        let s = factor * (0.265 * beta + 1.194 * beta * beta + 5.372 * beta.powi(22));
        let tail = (-PI / s).exp();
        Self {
            s,
            inverse: 1.0 / s,
            tail,
            scale: (1.0 + tail) / (s * (1.0 - tail)),
            offset: (TAU * tail / (s * (1.0 - tail * tail)) - 1.0) / s,
            rate: factor * (0.265 + 2.388 * beta + 118.184 * beta.powi(21)),
        }
    }

    /// At any angle, which is first brought into [-pi, pi].
    #[inline(always)]
    fn density(&self, angle: f64) -> Factor {
        let x = (angle - TAU * (angle / TAU).round()).abs() * self.inverse;
        let e = (-x).exp();
        let sum = 1.0 + e;
        Factor {
            value: self.scale * e / (sum * sum),
            by_beta: self.rate * (x * self.inverse * (1.0 - e) / sum + self.offset),
        }
    }

    fn sample(&self, random: &mut Random) -> f64 {
        let u = random.uniform_open();
        let v = 1.0 - u;
        self.s * ((u + v * self.tail) / (v + u * self.tail)).ln()
    }
}

fn check(info: &ParameterInfo, value: f64) -> Result<()> {
    let lower = if info.per_channel {
        0.0
    } else {
        LEAST_ROUGHNESS
    };
    if (lower..=1.0).contains(&value) {
        return Ok(());
    }
    let name = info.name;
    Err(Error::new(format!(
        "chiang: '{name}' is {value}, expected {lower} to 1"
    ))
    .with_hint(format!(
        "a fit searches '{name}' from {} to {}",
        info.lower, info.upper
    )))
}
