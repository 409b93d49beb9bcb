//! Fibers of a yarn around its center line, Li 2024 eq. 7-8.
//!
//! Offsets lie in the plane *normal to the center line*, not in the vertical plane of the paper: a vertical plane makes the
//! yarn thinner where it is steep. The price is that a yarn bent more sharply than its own half thickness would fold; the
//! report tells how near that is. Fibers are endless: no fiber ends, no hairs that leave the yarn, no plies, no noise
//! field (Li 2024 eq. 9 states no amplitude), and no contact between fibers.

use super::centerline::CenterLine;
use crate::math::Random;
use glam::DVec3;
use std::f64::consts::TAU;

/// Turns between consecutive fibers, Li 2024's zeta.
pub const ZETA: f64 = 0.137;
/// Exponent of the radial distribution, Li 2024 eq. 7.
pub const RADIAL_EXPONENT: f64 = 0.3;

/// Distance of fiber `i` of `m` (1-based) from the yarn's center, Li 2024 eq. 7: `e_yarn ((i/m)^0.3 + J S)`.
///
/// `jitter` is J and `normal` is S. Negative for a strongly negative S: the fiber then lies at that distance on the
/// opposite side.
pub fn base_radius(e_yarn: f64, i: u32, m: u32, jitter: f64, normal: f64) -> f64 {
    e_yarn * ((f64::from(i) / f64::from(m)).powf(RADIAL_EXPONENT) + jitter * normal)
}

/// Angle of fiber `i` (1-based) around the yarn: `2 pi zeta i`.
pub fn base_angle(i: u32) -> f64 {
    TAU * ZETA * f64::from(i)
}

/// Distance from the center after migration, Li 2024 eq. 8: `(1 - G) R + (G R / 2)(cos(phase) + 1)`, with
/// `phase = s theta + theta0`.
pub fn migrated_radius(radius: f64, depth: f64, phase: f64) -> f64 {
    (1.0 - depth) * radius + 0.5 * depth * radius * (phase.cos() + 1.0)
}

/// Offset of a fiber from the center line (lateral, up), Li 2024 eq. 8.
pub fn offset(radius: f64, angle: f64) -> [f64; 2] {
    let (sin, cos) = angle.sin_cos();
    [radius * cos, radius * sin]
}

/// How the fibers of one yarn system are laid, over one tile length.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct YarnShape {
    /// Fibers per yarn.
    pub(crate) fibers: u32,
    /// Full width of the yarn's elliptical section, millimeters.
    pub(crate) width: f64,
    /// Full thickness of the section, millimeters.
    pub(crate) thickness: f64,
    /// Upper limit of the uniform J.
    pub(crate) jitter: f64,
    /// Migration depth G.
    pub(crate) migration_depth: f64,
    /// Whole twist turns per tile length; positive is a right-handed helix (Z twist).
    pub(crate) turns: i32,
    /// Whole migration periods per tile length.
    pub(crate) migrations: i32,
}

/// One yarn of the tile: where it runs and its center line.
#[derive(Debug, Clone)]
pub(crate) struct Yarn {
    /// Point of the yarn's axis (z = 0) at parameter 0.
    pub(crate) origin: DVec3,
    /// Unit vector along the yarn.
    pub(crate) axis: DVec3,
    /// Unit vector to its side; `axis x lateral` = +z.
    pub(crate) lateral: DVec3,
    /// Length within the tile, millimeters.
    pub(crate) length: f64,
    /// Length of one weave cell along the yarn, millimeters.
    pub(crate) cell: f64,
    /// Height over the cells.
    pub(crate) line: CenterLine,
    /// Angle of the twist at parameter 0, radians.
    pub(crate) phase: f64,
}

/// One fiber's own numbers.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Strand {
    /// Distance relative to the yarn's half axes (R_i with e_yarn = 1).
    radius: f64,
    /// Angle around the yarn at parameter 0, radians.
    angle: f64,
    /// Migration phase at parameter 0, radians.
    migration: f64,
}

impl Strand {
    /// Fiber `i` (1-based) of a yarn; `random` gives J, S and theta0 in this order.
    pub(crate) fn draw(shape: &YarnShape, i: u32, phase: f64, random: &mut Random) -> Self {
        let jitter = shape.jitter * random.uniform();
        let normal = random.normal();
        Self {
            radius: base_radius(1.0, i, shape.fibers, jitter, normal),
            angle: base_angle(i) + phase,
            migration: TAU * random.uniform(),
        }
    }
}

impl Yarn {
    /// The fiber's point at `s` millimeters along the yarn's axis.
    pub(crate) fn point(&self, shape: &YarnShape, strand: &Strand, s: f64) -> DVec3 {
        let turn = TAU * s / self.length;
        let radius = migrated_radius(
            strand.radius,
            shape.migration_depth,
            f64::from(shape.migrations) * turn + strand.migration,
        );
        let [u, v] = offset(radius, strand.angle + f64::from(shape.turns) * turn);
        let (u, v) = (0.5 * shape.width * u, 0.5 * shape.thickness * v);
        let center = self.line.at(s / self.cell);
        // Unit normal of the center line in the plane of axis and z.
        let slope = center.slope / self.cell;
        let cosine = 1.0 / slope.hypot(1.0);
        self.origin
            + self.axis * (s - v * slope * cosine)
            + self.lateral * u
            + DVec3::Z * (center.value + v * cosine)
    }

    /// Smallest radius of curvature of the center line, millimeters, from `steps` points per cell.
    pub(crate) fn min_bend_radius(&self, steps: usize) -> f64 {
        let cells = (self.length / self.cell).round() as usize;
        let largest = (0..cells * steps)
            .map(|k| {
                let at = self.line.at((k as f64 + 0.5) / steps as f64);
                let (slope, bend) = (at.slope / self.cell, at.bend / (self.cell * self.cell));
                bend.abs() / slope.hypot(1.0).powi(3)
            })
            .fold(0.0, f64::max);
        1.0 / largest
    }

    /// Length of the center line within the tile, millimeters, from `steps` pieces per cell.
    pub(crate) fn center_length(&self, steps: usize) -> f64 {
        let cells = (self.length / self.cell).round() as usize;
        let step = self.cell / steps as f64;
        (0..cells * steps)
            .map(|k| {
                let slope = self.line.at((k as f64 + 0.5) / steps as f64).slope / self.cell;
                step * slope.hypot(1.0)
            })
            .sum()
    }
}
