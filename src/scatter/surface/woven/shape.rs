//! The shape of a yarn segment: its parameters, what of them has a meaning, and the curve of its spine.

use crate::base::{Error, Result};
use crate::math::special::{bessel_ratio_deficit, i0e};
use std::f64::consts::{FRAC_PI_2, TAU};

/// What a yarn segment is made of and how it lies (Irawan 2008, Table 8.1, without its coefficients).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shape {
    /// Twist of the fibers about the yarn, psi, radians; 0 for filament yarns.
    pub twist: f64,
    /// Inclination of the spine at the ends of the segment, u_max, radians.
    pub inclination: f64,
    /// Curvature of the spine, kappa: 0 is a circle, below it is straighter near the ends, above it is flatter in the middle.
    pub curvature: f64,
    /// Uniform scattering of the fibers, alpha.
    pub uniform: f64,
    /// Forward scattering of the fibers, beta: the concentration of a von Mises lobe.
    pub forward: f64,
    /// Filament smoothing, delta: the share of the inclinations over which the ends of a highlight fade.
    pub smoothing: f64,
    /// Width of the segment, w, millimeters.
    pub width: f64,
    /// Length of the segment, l, millimeters.
    pub length: f64,
}

/// How many numbers a [`Shape`] is.
pub const SHAPE_ROWS: usize = 8;

impl Default for Shape {
    /// A matte staple yarn, Irawan 2008 sec. 9.3.
    fn default() -> Self {
        Self {
            twist: -30_f64.to_radians(),
            inclination: 30_f64.to_radians(),
            curvature: 0.0,
            uniform: 0.01,
            forward: 4.0,
            smoothing: 0.0,
            width: 0.4,
            length: 1.2,
        }
    }
}

impl Shape {
    /// The numbers in the order of the fields, which is that of derivatives.
    pub fn numbers(&self) -> [f64; SHAPE_ROWS] {
        [
            self.twist,
            self.inclination,
            self.curvature,
            self.uniform,
            self.forward,
            self.smoothing,
            self.width,
            self.length,
        ]
    }

    /// The shape with these numbers.
    pub fn from_numbers(numbers: [f64; SHAPE_ROWS]) -> Self {
        let [
            twist,
            inclination,
            curvature,
            uniform,
            forward,
            smoothing,
            width,
            length,
        ] = numbers;
        Self {
            twist,
            inclination,
            curvature,
            uniform,
            forward,
            smoothing,
            width,
            length,
        }
    }

    /// Checks that the formulas have a meaning.
    ///
    /// # Errors
    /// A number is outside its domain, or the segment is too short for its width and inclination
    /// (Irawan 2008, below eq. 6.4).
    pub fn check(&self) -> Result<()> {
        let quarter = FRAC_PI_2 * (1.0 + 1e-12);
        within("twist", self.twist, -quarter, quarter)?;
        within("inclination", self.inclination, 1e-4, quarter)?;
        within("curvature", self.curvature, -1.0 + 1e-6, 1e3)?;
        within("uniform", self.uniform, 0.0, 100.0)?;
        within("forward", self.forward, 0.0, 1e4)?;
        within("smoothing", self.smoothing, 0.0, 1.0)?;
        within("width", self.width, 1e-4, 1e3)?;
        within("length", self.length, 1e-4, 1e4)?;
        let straight = 0.5 * (self.length - self.width * self.inclination.sin());
        if straight > 0.0 {
            return Ok(());
        }
        Err(Error::new(format!(
            "woven segment: a length of {} mm is too short for a width of {} mm at an inclination of {:.1} degrees: expected \
             more than width times the sine of the inclination",
            self.length,
            self.width,
            self.inclination.to_degrees()
        ))
        .with_hint("the width is across the yarn, the length along it, both as seen from above"))
    }
}

fn within(name: &str, value: f64, lower: f64, upper: f64) -> Result<()> {
    if (lower..=upper).contains(&value) {
        return Ok(());
    }
    Err(Error::new(format!(
        "woven segment: '{name}' is {value}, expected {lower} to {upper}"
    ))
    .with_hint("angles are radians inside and degrees in files; lengths are millimeters"))
}

/// Radius of curvature of the spine over the half length `L = l/2 - (w/2) sin(u_max)` that is left to it (Irawan 2008
/// eq. 6.5 to 6.8), in one form for ellipse, parabola and hyperbola:
///
/// ```text
/// R(u)/L = sqrt(cos^2 u_max + s sin^2 u_max) / (sin u_max (cos^2 u + s sin^2 u)^1.5)
/// s = r|r|,  r = 1 + kappa (1 + cot u_max)
/// ```
#[derive(Debug, Clone, Copy)]
pub struct Spine {
    /// `s - 1`.
    excess: f64,
    /// The part of R/L that does not depend on u.
    factor: f64,
    /// Derivatives of ln R/L at fixed s: by u_max.
    log_by_inclination: f64,
    /// By s, the part that does not depend on u.
    log_by_s: f64,
    s_by_inclination: f64,
    s_by_curvature: f64,
}

/// R/L and its derivatives at one u.
#[derive(Debug, Clone, Copy)]
pub struct SpineSlopes {
    /// R/L.
    pub value: f64,
    /// By u.
    pub by_u: f64,
    /// By u_max at fixed u.
    pub by_inclination: f64,
    /// By kappa.
    pub by_curvature: f64,
}

impl Spine {
    /// The spine with this inclination at its ends and this curvature.
    pub fn new(inclination: f64, curvature: f64) -> Self {
        let (sin, cos) = inclination.sin_cos();
        let cot = cos / sin;
        let r = 1.0 + curvature * (1.0 + cot);
        let excess = r * r.abs() - 1.0;
        let end = 1.0 + excess * sin * sin;
        Self {
            excess,
            factor: end.sqrt() / sin,
            log_by_inclination: sin * cos * excess / end - cot,
            log_by_s: 0.5 * sin * sin / end,
            s_by_inclination: -2.0 * r.abs() * curvature / (sin * sin),
            s_by_curvature: 2.0 * r.abs() * (1.0 + cot),
        }
    }

    /// R/L where the spine is inclined by u; takes `sin(u)`.
    #[inline]
    pub fn radius(&self, sin_u: f64) -> f64 {
        let k = 1.0 + self.excess * sin_u * sin_u;
        self.factor / (k * k.sqrt())
    }

    /// R/L and its derivatives.
    #[inline]
    pub fn slopes(&self, sin_u: f64, cos_u: f64) -> SpineSlopes {
        let k = 1.0 + self.excess * sin_u * sin_u;
        let value = self.factor / (k * k.sqrt());
        let log_by_s = self.log_by_s - 1.5 * sin_u * sin_u / k;
        SpineSlopes {
            value,
            by_u: -3.0 * value * self.excess * sin_u * cos_u / k,
            by_inclination: value * (self.log_by_inclination + log_by_s * self.s_by_inclination),
            by_curvature: value * log_by_s * self.s_by_curvature,
        }
    }
}

/// The phase function of a fiber, `alpha + exp(beta cos x) / (2 pi I_0(beta))` with `cos x = -wi . wr` (Irawan 2008 eq. 7.8),
/// 1/rad.
#[derive(Debug, Clone, Copy)]
pub struct Phase {
    uniform: f64,
    forward: f64,
    /// `1 / (2 pi exp(-beta) I_0(beta))`.
    scale: f64,
    /// `1 - I_1/I_0` at beta.
    deficit: f64,
}

impl Phase {
    /// The phase function of a shape.
    pub fn new(shape: &Shape) -> Self {
        Self {
            uniform: shape.uniform,
            forward: shape.forward,
            scale: 1.0 / (TAU * i0e(shape.forward)),
            deficit: bessel_ratio_deficit(shape.forward),
        }
    }

    /// The value where the directions have this scalar product, and its derivative by beta; that by alpha is 1.
    #[inline]
    pub fn value(&self, product: f64) -> (f64, f64) {
        // 1 - cos x, without cancellation problems: products of unit vectors.
        let below = 1.0 + product;
        let lobe = self.scale * (-self.forward * below).exp();
        (self.uniform + lobe, lobe * (self.deficit - below))
    }
}

/// The smoothing of a highlight's ends, `1 - smoothstep((|u| - (1 - delta) u_max) / (delta u_max))` (Irawan 2008 eq. 7.10).
#[derive(Debug, Clone, Copy)]
pub(super) struct Fade {
    inclination: f64,
    smoothing: f64,
}

/// The smoothing and its derivatives at one u.
#[derive(Debug, Clone, Copy)]
pub(super) struct FadeSlopes {
    /// 0 to 1.
    pub(super) value: f64,
    /// By u.
    pub(super) by_u: f64,
    /// By u_max at fixed u.
    pub(super) by_inclination: f64,
    /// By delta.
    pub(super) by_smoothing: f64,
}

impl Fade {
    /// The smoothing of a shape; none when its delta is 0.
    pub(super) fn new(shape: &Shape) -> Option<Self> {
        (shape.smoothing > 0.0).then_some(Self {
            inclination: shape.inclination,
            smoothing: shape.smoothing,
        })
    }

    fn place(&self, u: f64) -> f64 {
        let place = 1.0 + (u.abs() / self.inclination - 1.0) / self.smoothing;
        place.clamp(0.0, 1.0)
    }

    /// The share that is left at u.
    #[inline]
    pub(super) fn value(&self, u: f64) -> f64 {
        let x = self.place(u);
        1.0 - x * x * (3.0 - 2.0 * x)
    }

    /// The share that is left at u and its derivatives; zero past the ends, where nothing is integrated.
    #[inline]
    pub(super) fn slopes(&self, u: f64) -> FadeSlopes {
        let x = self.place(u);
        let by_place = -6.0 * x * (1.0 - x);
        let rise = 1.0 / (self.smoothing * self.inclination);
        FadeSlopes {
            value: 1.0 - x * x * (3.0 - 2.0 * x),
            by_u: by_place * rise.copysign(u),
            by_inclination: -by_place * rise * u.abs() / self.inclination,
            by_smoothing: by_place * (1.0 - x) / self.smoothing,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The derivative by parameter of R/L, of the phase function and of the smoothing against central differences: sees a
    /// fault of 1e-6.
    #[test]
    fn slopes_agree_with_differences() {
        let near = |found: f64, plus: f64, minus: f64| {
            let expected = (plus - minus) / 2e-6;
            (found - expected).abs() < 1e-6 * (1.0 + expected.abs())
        };
        let h = 1e-6;
        for (um, kappa) in [(0.5, 0.3), (0.5, -0.6), (1.4, 2.0), (0.2, -0.9)] {
            for u in [-0.15, 0.02, 0.19_f64] {
                let at = |um: f64, kappa: f64, u: f64| Spine::new(um, kappa).radius(u.sin());
                let s = Spine::new(um, kappa).slopes(u.sin(), u.cos());
                assert!(near(s.by_u, at(um, kappa, u + h), at(um, kappa, u - h)));
                assert!(near(
                    s.by_inclination,
                    at(um + h, kappa, u),
                    at(um - h, kappa, u)
                ));
                assert!(near(
                    s.by_curvature,
                    at(um, kappa + h, u),
                    at(um, kappa - h, u)
                ));
                assert!(!near(
                    1.001 * s.by_u + 1e-4,
                    at(um, kappa, u + h),
                    at(um, kappa, u - h)
                ));
            }
        }
        for u in [-0.45, 0.1, 0.4] {
            let fade = |inclination: f64, smoothing: f64, u: f64| {
                Fade {
                    inclination,
                    smoothing,
                }
                .value(u)
            };
            let s = Fade {
                inclination: 0.5,
                smoothing: 0.6,
            }
            .slopes(u);
            assert!(near(s.by_u, fade(0.5, 0.6, u + h), fade(0.5, 0.6, u - h)));
            assert!(near(
                s.by_inclination,
                fade(0.5 + h, 0.6, u),
                fade(0.5 - h, 0.6, u)
            ));
            assert!(near(
                s.by_smoothing,
                fade(0.5, 0.6 + h, u),
                fade(0.5, 0.6 - h, u)
            ));
        }
        for forward in [0.0 + h, 2.0, 40.0] {
            let at = |forward: f64| {
                Phase::new(&Shape {
                    forward,
                    ..Shape::default()
                })
            };
            for product in [-1.0, -0.7, 0.2, 1.0] {
                let slope = at(forward).value(product).1;
                let (plus, minus) = (at(forward + h), at(forward - h));
                assert!(near(slope, plus.value(product).0, minus.value(product).0));
            }
        }
    }
}
