//! Where the fibers of a yarn segment lie so that they reflect one direction into another: the highlight curve of Irawan 2008
//! (sec. 7.3), and the area it stands for (sec. 7.4) times the attenuation (sec. 7.6).
//!
//! With `H = wi + wr`, `rho = hypot(H_y, H_z)/|H|`, `b = atan2(H_y, H_z)`, `s = u - b` and `q = sin(psi)/rho`, fibers with `h . t = 0`
//! have
//!
//! ```text
//! y = sin(s)/q,  m = n . h = sqrt(1 - y^2)        C = rho cos(s),  D = -cos(psi) y,  N = m^2 + D^2
//! sin v = (h_x m - C D)/N,   cos v = (C m + h_x D)/N
//! ```
//!
//! so that for q < 1 the angle `phi = asin(y)` runs along the whole curve without a singular end, and
//! `G_v A du = a (R + a cos v) XY/(X + Y) / (|H| rho cos s) dphi`, `X = wi . n`, `Y = wr . n`. For psi = 0 that is
//! `G_u A dv`: staple and filament yarns are one integral, and no twist is singular. For q >= 1 every u has its fiber and u itself is the
//! variable. A negative twist is the mirror image in x of a positive one.

use super::shape::Shape;
use glam::DVec3;
use std::f64::consts::FRAC_PI_2;

/// One pair of directions as a segment sees it, with the twist made positive.
#[derive(Debug, Clone, Copy)]
pub(super) struct Highlight {
    /// True when phi is the variable, false when s is.
    by_phi: bool,
    pub(super) lower: Limit,
    pub(super) upper: Limit,
    sin_psi: f64,
    cos_psi: f64,
    q: f64,
    h_x: f64,
    rho: f64,
    sin_b: f64,
    cos_b: f64,
    /// |H|.
    length: f64,
    light: Seen,
    camera: Seen,
}

/// A direction: its x, and its component along the spine's normal, `along cos(s) + across sin(s)`.
#[derive(Debug, Clone, Copy)]
struct Seen {
    x: f64,
    along: f64,
    across: f64,
}

/// An end of the curve.
#[derive(Debug, Clone, Copy)]
pub(super) struct Limit {
    pub(super) at: f64,
    /// True when the end of the segment's inclinations makes it.
    pub(super) inclined: bool,
}

/// One place of the highlight curve.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    pub(super) sin_s: f64,
    pub(super) cos_s: f64,
    pub(super) y: f64,
    pub(super) m: f64,
    pub(super) sin_v: f64,
    pub(super) cos_v: f64,
    /// `wi . n` and `wr . n`.
    pub(super) light: f64,
    pub(super) camera: f64,
    i_c: f64,
    r_c: f64,
    pub(super) sin_u: f64,
    pub(super) cos_u: f64,
}

/// How a place and its weight move with the twist while the variable stays.
#[derive(Debug, Clone, Copy)]
pub(super) struct ByTwist {
    pub(super) weight: f64,
    pub(super) u: f64,
    pub(super) cos_v: f64,
}

impl Place {
    /// True where light and camera both see the fiber.
    #[inline]
    pub(super) fn visible(&self) -> bool {
        self.light > 0.0 && self.camera > 0.0 && self.cos_v > 0.0
    }
}

impl Highlight {
    /// The curve for directions in the segment's frame (y along the yarn, z up, both above the surface); none when it leaves
    /// the segment.
    #[inline]
    pub(super) fn new(shape: &Shape, wi: DVec3, wr: DVec3) -> Option<Self> {
        let mirror = 1.0_f64.copysign(shape.twist);
        let sum = wi + wr;
        // Directions that are nearly opposite have a sum whose square may underflow.
        let largest = sum.abs().max_element();
        let scaled = sum / largest;
        let scaled_length = scaled.length();
        let length = scaled_length * largest;
        let across = scaled.y.hypot(scaled.z);
        let rho = across / scaled_length;
        let (sin_b, cos_b) = (scaled.y / across, scaled.z / across);
        let (sin_psi, cos_psi) = shape.twist.abs().sin_cos();
        let q = sin_psi / rho;
        let by_phi = q < 1.0;
        let b = sin_b.atan2(cos_b);
        let (low, high) = (-shape.inclination - b, shape.inclination - b);
        let h_x = mirror * scaled.x / scaled_length;
        let (lower, upper) = if by_phi {
            phi_limits(low, high, q, h_x, rho)?
        } else {
            (Limit::inclined(low), Limit::inclined(high))
        };
        let seen = |w: DVec3| Seen {
            x: mirror * w.x,
            along: w.y * sin_b + w.z * cos_b,
            across: w.y * cos_b - w.z * sin_b,
        };
        Some(Self {
            by_phi,
            lower,
            upper,
            sin_psi,
            cos_psi,
            q,
            h_x,
            rho,
            sin_b,
            cos_b,
            length,
            light: seen(wi),
            camera: seen(wr),
        })
    }

    /// True when the sign of cos v has to be looked for: in phi its end is a [`Limit`].
    pub(super) fn turns_away(&self) -> bool {
        !self.by_phi
    }

    /// The place at a value of the variable.
    #[inline]
    pub(super) fn place(&self, x: f64) -> Place {
        let (sin, cos) = x.sin_cos();
        let (sin_s, cos_s, y, m) = if self.by_phi {
            let sin_s = self.q * sin;
            (sin_s, ((1.0 - sin_s) * (1.0 + sin_s)).sqrt(), sin, cos)
        } else {
            let y = sin / self.q;
            (sin, cos, y, ((1.0 - y) * (1.0 + y)).sqrt())
        };
        let (c, d) = (self.rho * cos_s, -self.cos_psi * y);
        let n = m * m + d * d;
        let sin_v = (self.h_x * m - c * d) / n;
        let cos_v = (c * m + self.h_x * d) / n;
        let i_c = self.light.along * cos_s + self.light.across * sin_s;
        let r_c = self.camera.along * cos_s + self.camera.across * sin_s;
        Place {
            sin_s,
            cos_s,
            y,
            m,
            sin_v,
            cos_v,
            light: self.light.x * sin_v + i_c * cos_v,
            camera: self.camera.x * sin_v + r_c * cos_v,
            i_c,
            r_c,
            sin_u: sin_s * self.cos_b + cos_s * self.sin_b,
            cos_u: cos_s * self.cos_b - sin_s * self.sin_b,
        }
    }

    /// `G A` over `a (R + a cos v)`, per unit of the variable; not negative where the place is visible.
    #[inline]
    pub(super) fn weight(&self, p: &Place) -> f64 {
        // In this order nothing underflows at grazing directions, and exchanged directions give the same digits.
        let sum = p.light + p.camera;
        let attenuation = p.light.max(p.camera) / sum * p.light.min(p.camera);
        if self.by_phi {
            attenuation / (self.length * self.rho * p.cos_s)
        } else {
            attenuation / sum / self.sin_psi
        }
    }

    /// Derivatives by the absolute value of the twist.
    #[inline]
    pub(super) fn by_twist(&self, p: &Place, weight: f64) -> ByTwist {
        let cot = self.cos_psi / self.sin_psi;
        let (y_slope, s_slope) = if self.by_phi {
            (0.0, self.cos_psi / self.rho * p.y / p.cos_s)
        } else {
            (-p.y * cot, 0.0)
        };
        let c_slope = -self.rho * p.sin_s * s_slope;
        let d_slope = self.sin_psi * p.y - self.cos_psi * y_slope;
        let v_slope = -(d_slope + p.sin_v * c_slope) / p.m;
        let turn = |w: &Seen, w_c: f64| {
            (w.x * p.cos_v - w_c * p.sin_v) * v_slope
                + p.cos_v * (w.across * p.cos_s - w.along * p.sin_s) * s_slope
        };
        let sum = p.light + p.camera;
        let (x, y) = (p.light / sum, p.camera / sum);
        let (x_slope, y_slope) = (turn(&self.light, p.i_c), turn(&self.camera, p.r_c));
        let weight = if self.by_phi {
            (y * y * x_slope + x * x * y_slope) / (self.length * self.rho * p.cos_s)
                + weight * p.sin_s / p.cos_s * s_slope
        } else {
            (y - x) * (y * x_slope - x * y_slope) / (sum * self.sin_psi) - weight * cot
        };
        ByTwist {
            weight,
            u: s_slope,
            cos_v: -p.sin_v * v_slope,
        }
    }

    /// How fast the variable moves with u there.
    pub(super) fn by_u(&self, p: &Place) -> f64 {
        if self.by_phi {
            p.cos_s / (self.q * p.m)
        } else {
            1.0
        }
    }

    /// How the variable moves with the twist at an end of the inclinations, where u stays.
    pub(super) fn end_by_twist(&self, p: &Place) -> f64 {
        if self.by_phi {
            -p.y / p.m * self.cos_psi / self.sin_psi
        } else {
            0.0
        }
    }

    /// How s moves with the twist where cos v changes its sign, `tan(s) = +-tan(psi)`.
    pub(super) fn turn_by_twist(&self, p: &Place) -> f64 {
        1.0_f64.copysign(p.sin_s * p.cos_s)
    }

    /// The value of the variable at the inclination u, when the curve gets there.
    pub(super) fn variable(&self, u: f64) -> Option<f64> {
        let s = u - self.sin_b.atan2(self.cos_b);
        if !self.by_phi {
            return Some(s);
        }
        let y = s.sin() / self.q;
        (s.abs() < FRAC_PI_2 && y.abs() < 1.0).then(|| y.asin())
    }
}

impl Limit {
    fn inclined(at: f64) -> Self {
        Self { at, inclined: true }
    }

    fn fixed(at: f64) -> Self {
        Self {
            at,
            inclined: false,
        }
    }
}

/// The part of -pi/2 .. pi/2 where s lies between `low` and `high` and cos v is positive. The latter ends where `|y| = rho`, on the side
/// of h_x.
fn phi_limits(low: f64, high: f64, q: f64, h_x: f64, rho: f64) -> Option<(Limit, Limit)> {
    let reach = q.asin();
    if low >= reach || high <= -reach {
        return None;
    }
    let mut lower = if low <= -reach {
        Limit::fixed(-FRAC_PI_2)
    } else {
        Limit::inclined((low.sin() / q).max(-1.0).asin())
    };
    let mut upper = if high >= reach {
        Limit::fixed(FRAC_PI_2)
    } else {
        Limit::inclined((high.sin() / q).min(1.0).asin())
    };
    let side = rho.min(1.0).asin();
    if h_x > 0.0 && upper.at > side {
        upper = Limit::fixed(side);
    }
    if h_x < 0.0 && lower.at < -side {
        lower = Limit::fixed(-side);
    }
    (lower.at < upper.at).then_some((lower, upper))
}
