//! The fiber BCSDF of Khungurn et al. 2015 (eq. 3-9 and Appendix A): a surface reflection lobe R and a transmission
//! lobe TT.
//!
//! ```text
//! S = M_R / (2 pi) + M_TT N_TT                                    per color channel
//! M_R  = F(theta_i) gbar(theta_o; -theta_i, beta_R)               F = C_R + (1 - C_R)(1 - cos theta_i)^5
//! M_TT = C_TT (1 - F(theta_i)) gbar(theta_o; -theta_i, beta_TT)
//! N_TT = exp(k cos(phi_o - phi_i - pi)) / (2 pi I_0(k))           k = gamma_TT^-2
//! ```
//!
//! The printed eq. 5 reads as if `gamma^-2` stood before the exponential; only the form above integrates to 1.
//!
//! What the model does not do: it is not reciprocal (F and G use theta_i alone), it has no TRT lobe, no tilt of the
//! fiber's scales, and no dependence on where across the fiber the ray strikes. Its azimuth is undefined along the axis:
//! a direction exactly on the axis takes azimuth zero, which keeps the lobe normalized.
//!
//! Evaluation uses no trigonometric function of single angles: with `t = tan(theta/2) = x/(1 + cos theta)` it is
//! `theta_i + theta_o = 2 atan2(t_i + t_o, 1 - t_i t_o)`, `1 - cos theta = x t`, and with unit azimuth vectors `a`
//! `cos(phi_o - phi_i - pi) - 1 = -|a_i + a_o|^2 / 2`, which does not cancel where the lobe is.

mod batch;

use super::direction::FiberAngles;
use super::normalizer::NormalizerTable;
use super::piecewise::Piecewise;
use super::{
    BatchEvaluate, CHANNELS, Evaluation, Kept, MAX_ROWS, Model, Outgoing, ParameterInfo,
    Parameters, Parametric, Sampled, Scattering, Unit,
};
use crate::base::{Error, Result};
use crate::math::Random;
use crate::math::special::{bessel_ratio_deficit, i0e};
use glam::DVec3;
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// The model `khungurn`: rows `c_r, c_tt, beta_r, beta_tt, gamma_tt`.
#[derive(Debug, Clone, Copy)]
pub struct Khungurn;

const DEGREE: f64 = PI / 180.0;

/// Ranges and defaults of Khungurn 2015, Table II.
const PARAMETERS: &[ParameterInfo] = &[
    color("c_r", 0.1),
    color("c_tt", 0.85),
    width("beta_r", 1.0, 10.0, 5.0),
    width("beta_tt", 10.0, 45.0, 10.0),
    width("gamma_tt", 1.0, 45.0, 10.0),
];

pub(super) const fn color(name: &'static str, default: f64) -> ParameterInfo {
    ParameterInfo {
        name,
        per_channel: true,
        unit: Unit::One,
        lower: 0.001,
        upper: 0.999,
        default,
    }
}

pub(super) const fn width(
    name: &'static str,
    lower_deg: f64,
    upper_deg: f64,
    default_deg: f64,
) -> ParameterInfo {
    ParameterInfo {
        name,
        per_channel: false,
        unit: Unit::Angle,
        lower: lower_deg * DEGREE,
        upper: upper_deg * DEGREE,
        default: default_deg * DEGREE,
    }
}

impl Parametric for Khungurn {
    fn name(&self) -> &'static str {
        "khungurn"
    }

    fn parameters(&self) -> &'static [ParameterInfo] {
        PARAMETERS
    }
}

impl Model for Khungurn {
    fn prepare(&self, parameters: &Parameters) -> Result<Box<dyn Scattering>> {
        Ok(Box::new(KhungurnScattering::new(parameters)?))
    }
}

/// Least share of the samples that each lobe gets, so that derivatives by a color near zero stay sampled.
const LEAST_SHARE: f64 = 0.05;

/// Least color by which paths are followed: at a color of zero, a path carries derivatives where it carries no light. So it
/// does where C_R = 1 leaves nothing to transmit.
pub(super) const LEAST_COLOR: f64 = 0.01;

/// Most points of a light that are looked at.
const MOST_LIGHT_POINTS: usize = 16;

/// The BCSDF of Khungurn 2015 at fixed parameters.
#[derive(Debug, Clone)]
pub struct KhungurnScattering {
    c_r: [f64; CHANNELS],
    c_tt: [f64; CHANNELS],
    /// The colors by which paths are sampled and followed.
    followed: [[f64; CHANNELS]; 2],
    pub(super) r: LongitudinalLobe,
    pub(super) tt: LongitudinalLobe,
    pub(super) azimuthal: VonMises,
    /// `2 atan(t)` on [0, 1], good to 3e-15.
    angle: Piecewise<1>,
}

/// Pieces of the table of `2 atan(t)`.
const ANGLE_PIECES: usize = 16;

impl KhungurnScattering {
    /// Precomputes what depends on the parameters alone: 0.1 to 0.4 ms within Table II, growing as the inverse of the widths.
    ///
    /// # Errors
    /// A color outside [0, 1], or a width outside 0.01 to 360 degrees. That is wider than Table II.
    pub fn new(parameters: &Parameters) -> Result<Self> {
        for info in PARAMETERS {
            for value in parameters.channels(info.name) {
                check("khungurn", info, value)?;
            }
        }
        let (c_r, c_tt) = (parameters.channels("c_r"), parameters.channels("c_tt"));
        Ok(Self {
            c_r,
            c_tt,
            followed: [
                c_r.map(|c| c.clamp(LEAST_COLOR, 1.0 - LEAST_COLOR)),
                c_tt.map(|c| c.max(LEAST_COLOR)),
            ],
            r: LongitudinalLobe::new(parameters.scalar("beta_r")),
            tt: LongitudinalLobe::new(parameters.scalar("beta_tt")),
            azimuthal: VonMises::new(parameters.scalar("gamma_tt")),
            angle: Piecewise::new(ANGLE_PIECES, |t| [2.0 * t.atan()]),
        })
    }

    fn camera_side(&self, wo: DVec3, carried: [f64; CHANNELS]) -> CameraSide {
        let angles = FiberAngles::new(wo);
        let share_of_r = self.share_of_r(&angles, carried);
        CameraSide {
            share_of_r,
            theta: self.theta(&angles),
            per_gauss: [
                share_of_r / self.r.table.mass(angles.t),
                (1.0 - share_of_r) / self.tt.table.mass(angles.t),
            ],
            angles,
        }
    }

    /// What was computed of a camera side ahead, or now.
    #[inline(always)]
    fn with_side<T>(&self, o: &Outgoing, f: impl FnOnce(&CameraSide) -> T) -> T {
        match &o.kept {
            Kept::Khungurn(side) => f(side),
            _ => f(&self.camera_side(o.wo, o.carried)),
        }
    }

    /// The longitudinal angle.
    #[inline]
    pub(super) fn theta(&self, w: &FiberAngles) -> f64 {
        self.angle.at(w.t.abs())[0].copysign(w.t)
    }

    /// The probability that [`Scattering::sample`] draws from the R lobe: by the two lobes' strengths at
    /// `theta_i = -theta_o`, as the root mean square of what the channels carry of them, held within 5 and 95 percent.
    fn share_of_r(&self, o: &FiberAngles, carried: [f64; CHANNELS]) -> f64 {
        let w5 = o.schlick();
        let (mut r, mut tt) = (0.0, 0.0);
        for c in 0..CHANNELS {
            let [c_r, c_tt] = self.followed.map(|color| color[c]);
            let f = c_r + (1.0 - c_r) * w5;
            r += (carried[c] * f).powi(2);
            tt += (carried[c] * c_tt * (1.0 - f)).powi(2);
        }
        let (r, tt) = (r.sqrt(), tt.sqrt());
        let share = if r + tt <= 0.0 { 0.5 } else { r / (r + tt) };
        share.clamp(LEAST_SHARE, 1.0 - LEAST_SHARE)
    }

    /// The lobes at a pair of directions whose longitudinal angles add up to `delta`, each with strength 1.
    #[inline]
    pub(super) fn lobes_at(&self, i: &FiberAngles, o: &FiberAngles, delta: f64) -> Lobes {
        let square = delta * delta;
        // R = gbar/(2 pi), TT = gbar N. One exponential each.
        let (az_y, az_z) = (i.az_y + o.az_y, i.az_z + o.az_z);
        let cos_minus_1 = -0.5 * (az_y * az_y + az_z * az_z);
        let gauss_r = self.r.scale * (-square * self.r.half_inverse_square).exp() / TAU;
        let gauss_tt = self.tt.scale
            * self.azimuthal.scale
            * (self.azimuthal.k * cos_minus_1 - square * self.tt.half_inverse_square).exp();
        let (g_r, g_r_by_sigma) = self.r.table.normalizer(i.t);
        let (g_tt, g_tt_by_sigma) = self.tt.table.normalizer(i.t);
        let (inverse_r, inverse_tt) = (1.0 / g_r, 1.0 / g_tt);
        Lobes {
            square,
            cos_minus_1,
            gauss_r,
            gauss_tt,
            r: gauss_r * inverse_r,
            tt: gauss_tt * inverse_tt,
            log_g_r_by_sigma: g_r_by_sigma * inverse_r,
            log_g_tt_by_sigma: g_tt_by_sigma * inverse_tt,
            w5: i.schlick(),
        }
    }

    /// `S` per channel, for fibers of colors C_R and C_TT.
    fn value(lobes: &Lobes, [c_r, c_tt]: [[f64; CHANNELS]; 2]) -> [f64; CHANNELS] {
        std::array::from_fn(|c| {
            let f = c_r[c] + (1.0 - c_r[c]) * lobes.w5;
            f * lobes.r + c_tt[c] * (1.0 - f) * lobes.tt
        })
    }

    /// The mixture that `sample` draws from, as a density of (theta, phi) rather than of solid angle: it stays finite at
    /// the poles.
    fn mixture(lobes: &Lobes, o: &CameraSide) -> f64 {
        o.per_gauss[0] * lobes.gauss_r + o.per_gauss[1] * lobes.gauss_tt
    }
}

/// What the direction toward the camera and the channels decide.
#[derive(Debug, Clone, Copy)]
pub(super) struct CameraSide {
    angles: FiberAngles,
    theta: f64,
    share_of_r: f64,
    /// Of R and TT: the probability of the lobe over the share of its Gaussian inside [-pi/2, pi/2].
    per_gauss: [f64; 2],
}

/// What value and derivatives share.
pub(super) struct Lobes {
    /// `(theta_i + theta_o)^2`.
    square: f64,
    /// `cos(phi_o - phi_i - pi) - 1`.
    cos_minus_1: f64,
    /// The lobes before division by G.
    gauss_r: f64,
    gauss_tt: f64,
    pub(super) r: f64,
    pub(super) tt: f64,
    /// `d ln G / d sigma`.
    log_g_r_by_sigma: f64,
    log_g_tt_by_sigma: f64,
    /// `(1 - cos theta_i)^5`.
    pub(super) w5: f64,
}

impl Scattering for KhungurnScattering {
    fn evaluate(&self, wi: DVec3, wo: DVec3, _h: f64) -> Evaluation {
        let (i, o) = (FiberAngles::new(wi), FiberAngles::new(wo));
        let lobes = self.lobes_at(&i, &o, 2.0 * (i.t + o.t).atan2(1.0 - i.t * o.t));
        // d ln(lobe) / d width.
        let log_r = (2.0 * lobes.square * self.r.half_inverse_square - 1.0) * self.r.inverse_width
            - lobes.log_g_r_by_sigma;
        let log_tt = (2.0 * lobes.square * self.tt.half_inverse_square - 1.0)
            * self.tt.inverse_width
            - lobes.log_g_tt_by_sigma;
        let log_gamma = (lobes.cos_minus_1 + self.azimuthal.deficit) * self.azimuthal.k_by_gamma;
        let mut derivative = [[0.0; CHANNELS]; MAX_ROWS];
        for c in 0..CHANNELS {
            let f = self.c_r[c] + (1.0 - self.c_r[c]) * lobes.w5;
            let tt_by_c_tt = (1.0 - f) * lobes.tt;
            let tt = self.c_tt[c] * tt_by_c_tt;
            derivative[0][c] = (1.0 - lobes.w5) * (lobes.r - self.c_tt[c] * lobes.tt);
            derivative[1][c] = tt_by_c_tt;
            derivative[2][c] = f * lobes.r * log_r;
            derivative[3][c] = tt * log_tt;
            derivative[4][c] = tt * log_gamma;
        }
        Evaluation {
            value: Self::value(&lobes, [self.c_r, self.c_tt]),
            derivative,
        }
    }

    fn outgoing(&self, wo: DVec3, h: f64, carried: [f64; CHANNELS]) -> Outgoing {
        Outgoing {
            kept: Kept::Khungurn(self.camera_side(wo, carried)),
            ..Outgoing::new(wo, h, carried)
        }
    }

    fn importance(&self, wi: DVec3, o: &Outgoing) -> ([f64; CHANNELS], f64) {
        let i = FiberAngles::new(wi);
        self.with_side(o, |o| {
            let lobes = self.lobes_at(&i, &o.angles, self.theta(&i) + o.theta);
            let pdf = Self::mixture(&lobes, o) / i.cos_theta;
            (Self::value(&lobes, self.followed), pdf)
        })
    }

    /// One for each width of the R lobe within the light's angular radius, where that lobe matters.
    fn light_points(&self, wi: DVec3, o: &Outgoing, half_angle: f64) -> usize {
        if half_angle < 2.0 * self.r.width {
            return 1;
        }
        let off = self.with_side(o, |o| self.theta(&FiberAngles::new(wi)) + o.theta);
        if off.abs() > half_angle + 4.0 * self.r.width {
            return 1;
        }
        ((half_angle / self.r.width) as usize).clamp(1, MOST_LIGHT_POINTS)
    }

    /// One of the lobes is chosen; theta_i is normal about -theta_o, truncated to [-pi/2, pi/2]; the azimuth is uniform for
    /// R and von Mises about phi_o + pi for TT. The density is that of the mixture.
    fn sample(&self, o: &Outgoing, random: &mut Random) -> Option<Sampled> {
        self.with_side(o, |o| Some(self.sample_from(o, random)))
    }

    fn batch(&self) -> Option<Box<dyn BatchEvaluate>> {
        Some(Box::new(batch::KhungurnBatch::new(self)))
    }

    fn narrowest(&self) -> f64 {
        let azimuthal = self.azimuthal.k.powf(-0.5);
        self.r
            .width
            .min(self.tt.width)
            .min(azimuthal)
            .min(10_f64.to_radians())
    }
}

impl KhungurnScattering {
    fn sample_from(&self, side: &CameraSide, random: &mut Random) -> Sampled {
        let o = &side.angles;
        let from_r = random.uniform() < side.share_of_r;
        let lobe = if from_r { &self.r } else { &self.tt };
        let theta = lobe.sample(-side.theta, random);
        let (sin_theta, cos_theta) = theta.sin_cos();
        // Azimuth relative to phi_o + pi, as cosine and sine.
        let (cos_az, sin_az) = if from_r {
            let (sin, cos) = (TAU * random.uniform()).sin_cos();
            (cos, sin)
        } else {
            self.azimuthal.sample(random)
        };
        let i = o.beyond(sin_theta, cos_theta, cos_az, sin_az);
        let lobes = self.lobes_at(&i, o, theta + side.theta);
        let density = Self::mixture(&lobes, side);
        // S cos(theta_i) / pdf = S cos^2(theta_i) / density: no division by a cosine.
        let factor = cos_theta * cos_theta / density;
        Sampled {
            wi: DVec3::new(sin_theta, cos_theta * i.az_y, cos_theta * i.az_z),
            weight: Self::value(&lobes, self.followed).map(|s| s * factor),
            pdf: density / cos_theta,
        }
    }
}

/// A Gaussian in the longitudinal angle with its normalizer.
#[derive(Debug, Clone)]
pub(super) struct LongitudinalLobe {
    pub(super) width: f64,
    inverse_width: f64,
    /// `1 / (2 width^2)`.
    half_inverse_square: f64,
    /// `1 / (width sqrt(2 pi))`.
    scale: f64,
    pub(super) table: NormalizerTable,
}

impl LongitudinalLobe {
    pub(super) fn new(width: f64) -> Self {
        Self {
            width,
            inverse_width: 1.0 / width,
            half_inverse_square: 0.5 / (width * width),
            scale: 1.0 / (width * TAU.sqrt()),
            table: NormalizerTable::new(width),
        }
    }

    /// A normal number about `center` (in [-pi/2, pi/2]), truncated to [-pi/2, pi/2], by rejection; at least four in ten
    /// proposals are taken at any width. A NaN center is returned, not tried forever.
    fn sample(&self, center: f64, random: &mut Random) -> f64 {
        loop {
            if self.width < 1.0 {
                let theta = center + self.width * random.normal();
                if theta.is_nan() || theta.abs() <= FRAC_PI_2 {
                    return theta;
                }
            } else {
                let theta = PI * (random.uniform_open() - 0.5);
                let delta = theta - center;
                let keep = (-delta * delta * self.half_inverse_square).exp();
                if keep.is_nan() || random.uniform() < keep {
                    return theta + 0.0 * center;
                }
            }
        }
    }
}

/// The von Mises distribution of concentration `k = gamma^-2` about zero.
#[derive(Debug, Clone)]
pub(super) struct VonMises {
    k: f64,
    /// `dk/dgamma = -2 gamma^-3`.
    k_by_gamma: f64,
    /// `exp(k) / (2 pi I_0(k))`: the density's peak.
    scale: f64,
    /// `1 - I_1(k)/I_0(k)`.
    deficit: f64,
    /// `r - 1` of Best and Fisher 1979.
    envelope: f64,
}

impl VonMises {
    fn new(gamma: f64) -> Self {
        let k = gamma.powi(-2);
        let tau = 1.0 + (1.0 + 4.0 * k * k).sqrt();
        let rho = (tau - (2.0 * tau).sqrt()) / (2.0 * k);
        Self {
            k,
            k_by_gamma: -2.0 * gamma.powi(-3),
            scale: 1.0 / (TAU * i0e(k)),
            deficit: bessel_ratio_deficit(k),
            envelope: (1.0 - rho) * (1.0 - rho) / (2.0 * rho),
        }
    }

    /// Cosine and sine of a von Mises angle (Best and Fisher 1979: rejection from a wrapped Cauchy envelope; written with
    /// `r - 1` and `1 - f`, which do not cancel when the lobe is narrow).
    pub(super) fn sample(&self, random: &mut Random) -> (f64, f64) {
        loop {
            let z = (PI * random.uniform()).cos();
            let one_minus_f = self.envelope * (1.0 - z) / (self.envelope + (1.0 + z));
            let c = self.k * (self.envelope + one_minus_f);
            let u = random.uniform_open();
            if c * (2.0 - c) > u || (c / u).ln() + 1.0 - c >= 0.0 {
                let sin = (one_minus_f * (2.0 - one_minus_f)).sqrt();
                let sign = if random.bits() >> 63 == 0 { 1.0 } else { -1.0 };
                return (1.0 - one_minus_f, sign * sin);
            }
        }
    }
}

/// Checks a value of `model`: a color in [0, 1], a width of 0.01 to 360 degrees.
pub(super) fn check(model: &str, info: &ParameterInfo, value: f64) -> Result<()> {
    let (shown, lower, upper, box_lower, box_upper) = match info.unit {
        Unit::One => (value, 0.0, 1.0, info.lower, info.upper),
        Unit::Angle => (
            value.to_degrees(),
            0.01,
            360.0,
            info.lower.to_degrees(),
            info.upper.to_degrees(),
        ),
    };
    // Degrees that went through radians may miss a bound by rounding.
    let slack = 1e-12 * upper;
    if (lower - slack * lower..=upper + slack).contains(&shown) {
        return Ok(());
    }
    let key = info.file_key();
    Err(Error::new(format!(
        "{model}: '{key}' is {shown}, expected {lower} to {upper}"
    ))
    .with_hint(format!(
        "the published range of '{key}' is {box_lower:.4} to {box_upper:.4}"
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_of_angles_is_good_to_its_stated_error() {
        let table = Piecewise::new(ANGLE_PIECES, |t| [2.0 * t.atan()]);
        let error = |i: i32| {
            let t = f64::from(i) / 1e5;
            (table.at(t)[0] - 2.0 * t.atan()).abs()
        };
        let worst = (0..=100_000).map(error).fold(0.0, f64::max);
        assert!(worst < 3e-15, "{worst}");
    }
}
