//! The integrands as Irawan 2008 samples them: staple yarns along u, filament yarns along v (algorithms 1 to 4).
//!
//! For comparison, and for textures, which need to know where in the segment the highlight is.

use super::segment::Segment;
use glam::DVec3;
use std::f64::consts::{FRAC_PI_2, PI};

/// The fiber that reflects, at one place along a segment (staple) or across it (filament).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Glint {
    /// The other coordinate of the fiber: v for staple yarns, u for filament yarns, radians.
    pub angle: f64,
    /// `G f_c A` there, mm^2/rad^2.
    pub strength: f64,
}

impl Segment {
    /// True when the fibers lie along the yarn.
    pub fn is_filament(&self) -> bool {
        self.shape().twist == 0.0
    }

    /// What reflects at the inclination u of a staple yarn (Irawan 2008 eq. 7.4, 7.6, 7.8, 7.9); nothing where no fiber does, or it is not
    /// seen.
    pub fn staple_glint(&self, wi: DVec3, wr: DVec3, u: f64) -> Option<Glint> {
        let (sin_u, cos_u) = u.sin_cos();
        let h = (wi + wr).normalize();
        let across = |w: DVec3| w.y * sin_u + w.z * cos_u;
        let c = across(h);
        let (sin_psi, cos_psi) = self.shape().twist.sin_cos();
        let d = (h.y * cos_u - h.z * sin_u) * cos_psi / sin_psi;
        let n = h.x * h.x + c * c;
        let square = n - d * d;
        if square.is_nan() || square <= 0.0 {
            return None;
        }
        let m = square.sqrt();
        let (sin_v, cos_v) = ((h.x * m - c * d) / n, (c * m + h.x * d) / n);
        let seen = |w: DVec3| w.x * sin_v + across(w) * cos_v;
        let (x, y) = (seen(wi), seen(wr));
        (x > 0.0 && y > 0.0 && cos_v > 0.0).then(|| {
            let area = x / (x + y) * (y / (x + y)) / sin_psi.abs();
            Glint {
                angle: sin_v.atan2(cos_v),
                strength: area * self.band(u, cos_v) * self.phase_and_fade(wi, wr, u),
            }
        })
    }

    /// What reflects at the normal v of a filament yarn (Irawan 2008 eq. 7.5, 7.7, 7.8, 7.10).
    pub fn filament_glint(&self, wi: DVec3, wr: DVec3, v: f64) -> Option<Glint> {
        let sum = wi + wr;
        let u = sum.y.atan2(sum.z);
        let (sin_u, cos_u) = u.sin_cos();
        let (sin_v, cos_v) = v.sin_cos();
        let seen = |w: DVec3| w.x * sin_v + (w.y * sin_u + w.z * cos_u) * cos_v;
        let (x, y) = (seen(wi), seen(wr));
        let inside = u.abs() < self.shape().inclination;
        (inside && x > 0.0 && y > 0.0 && cos_v > 0.0).then(|| {
            let area = x / (x + y) * (y / sum.y.hypot(sum.z));
            Glint {
                angle: u,
                strength: area * self.band(u, cos_v) * self.phase_and_fade(wi, wr, u),
            }
        })
    }

    /// The trapezoid rule with `samples` points over -u_max .. u_max (staple) or -pi/2 .. pi/2 (filament).
    pub fn trapezoid(&self, wi: DVec3, wr: DVec3, samples: usize) -> f64 {
        if wi.is_nan() || wr.is_nan() {
            return f64::NAN;
        }
        if samples < 2 || wi.z <= 0.0 || wr.z <= 0.0 {
            return 0.0;
        }
        let half = match self.is_filament() {
            true => FRAC_PI_2,
            false => self.shape().inclination,
        };
        let step = 2.0 * half / (samples - 1) as f64;
        let sum: f64 = (0..samples)
            .map(|k| {
                let x = -half + step * k as f64;
                let glint = match self.is_filament() {
                    true => self.filament_glint(wi, wr, x),
                    false => self.staple_glint(wi, wr, x),
                };
                let weight = if k == 0 || k == samples - 1 { 0.5 } else { 1.0 };
                weight * glint.map_or(0.0, |g| g.strength)
            })
            .sum();
        step * sum
    }

    /// The texture of a segment (Irawan 2008 eq. 8.5): what the place `(x, y)`, millimeters from the segment's center, x across the yarn,
    /// scatters through a highlight band that takes `share` of the width (staple) or of the length (filament). Its mean over
    /// the segment's rectangle is the integral that [`Segment::value`] gives.
    pub fn texture(&self, wi: DVec3, wr: DVec3, (x, y): (f64, f64), share: f64) -> f64 {
        if wi.is_nan() || wr.is_nan() {
            return f64::NAN;
        }
        if wi.z <= 0.0 || wr.z <= 0.0 {
            return 0.0;
        }
        let shape = self.shape();
        let (glint, scale, at, extent, largest) = if self.is_filament() {
            let glint = self.filament_glint(wi, wr, PI * x / shape.width);
            let v_range = PI;
            (glint, v_range, y, shape.length, shape.inclination)
        } else {
            let u = 2.0 * shape.inclination * y / shape.length;
            let glint = self.staple_glint(wi, wr, u);
            (glint, 2.0 * shape.inclination, x, shape.width, FRAC_PI_2)
        };
        let Some(glint) = glint else { return 0.0 };
        // The band keeps its width at the segment's sides.
        let room = 0.5 * (1.0 - share) * extent;
        let center = (0.5 * extent * glint.angle / largest).clamp(-room, room);
        if (at - center).abs() < 0.5 * share * extent {
            scale * glint.strength / share
        } else {
            0.0
        }
    }
}
