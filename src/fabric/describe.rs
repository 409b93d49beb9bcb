//! What a tile of fibers is made of, in numbers.

use super::overlap::{fiber_overlap, yarn_overlap};
use super::woven::{Closing, Swatch, WovenSystem};
use super::{FiberTile, NO_SEGMENT, curves};
use std::f64::consts::PI;

/// Overlap above which the report adds a hint.
const LARGE_OVERLAP: f64 = 0.05;
/// Fraction of fiber length inside other fibers above which the report adds a hint.
const LARGE_AXIS_INSIDE: f64 = 0.25;

/// Facts about a fabric, computed from its segments (and, for a woven one, its yarns).
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct FabricReport {
    /// Tile size in x and y, millimeters.
    pub tile_mm: [f64; 2],
    /// Fibers; one that closes across the seam counts once.
    pub fibers: usize,
    /// Fibers without ends.
    pub closed_fibers: usize,
    /// Straight segments.
    pub segments: usize,
    /// Smallest and largest fiber radius, micrometers.
    pub fiber_radius_um: [f64; 2],
    /// Lowest and highest point of any fiber's surface, millimeters.
    pub z_range_mm: [f64; 2],
    /// Extent in z, millimeters.
    pub thickness_mm: f64,
    /// Volume of all fibers over tile area times thickness; shared volume counts twice.
    pub fiber_volume_fraction: f64,
    /// Fiber length per area, 1/mm.
    pub fiber_length_per_mm2: f64,
    /// Mass per area, g/m^2, when the densities are known.
    pub mass_g_per_m2: Option<f64>,
    /// Largest angle between neighboring segments, degrees.
    pub largest_joint_deg: f64,
    /// Fraction of fiber length that runs into another fiber (sampled): axes nearer than the sum of the radii.
    pub fiber_overlap: f64,
    /// Fraction of fiber length whose axis lies inside another fiber (sampled).
    pub fiber_axis_inside: f64,
    /// Fraction of yarn volume inside a yarn of the other system (woven fabrics).
    pub yarn_overlap: Option<f64>,
    /// Largest distance of a fiber's curve from its segments, checked at their middles (with `tolerance_um` at seven points
    /// of each), micrometers (woven fabrics).
    pub chord_error_um: Option<f64>,
    /// Warp and weft (woven fabrics).
    pub systems: Vec<SystemReport>,
    /// Rates that were rounded so that the tile closes.
    pub closings: Vec<Closing>,
    /// What deserves a look, in words.
    pub notes: Vec<String>,
}

/// Facts about one yarn system of a woven fabric.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct SystemReport {
    /// `warp` or `weft`.
    pub system: &'static str,
    /// Yarns on the tile.
    pub yarns: usize,
    /// Distance between neighboring yarns, millimeters.
    pub pitch_mm: f64,
    /// Fibers in each yarn.
    pub fibers_per_yarn: u32,
    /// Segments of each fiber; with `tolerance_um` their mean, rounded.
    pub segments_per_fiber: usize,
    /// Twist turns of a yarn on the tile.
    pub twist_per_tile: i32,
    /// Migration periods of a fiber on the tile.
    pub migration_per_tile: i32,
    /// Area of the fibers' sections over the area of the yarn's elliptical section.
    pub packing: f64,
    /// Center line length over straight length, minus one: mean over yarns.
    pub crimp: f64,
    /// Smallest radius of curvature of a center line, millimeters.
    pub min_bend_radius_mm: f64,
    /// That radius over half the yarn's thickness; fibers fold where it is under 1.
    pub bend_ratio: f64,
    /// Fraction of yarn volume inside the next yarn of this system.
    pub side_overlap: f64,
}

impl FabricReport {
    /// Measures a tile; `densities` (g/cm^3) are by yarn system, the last one serving all further systems.
    pub(crate) fn of_tile(tile: &FiberTile, densities: &[Option<f64>]) -> Self {
        let segments = &tile.segments;
        let (mut z, mut radius) = ([f64::INFINITY, f64::NEG_INFINITY], [f64::INFINITY, 0.0_f64]);
        let (mut length, mut volume, mut mass) = (0.0, 0.0, Some(0.0));
        let mut sharpest = 1.0_f64;
        for s in segments {
            z[0] = z[0].min(s.start.z.min(s.end.z) - s.radius);
            z[1] = z[1].max(s.start.z.max(s.end.z) + s.radius);
            radius = [radius[0].min(s.radius), radius[1].max(s.radius)];
            let own = s.start.distance(s.end);
            length += own;
            let own_volume = own * PI * s.radius * s.radius;
            volume += own_volume;
            let last = densities.len().saturating_sub(1);
            let density = densities
                .get(last.min(s.yarn_system.into()))
                .copied()
                .flatten();
            // mm^3 g/cm^3 = mg
            mass = mass.zip(density).map(|(m, d)| m + own_volume * d);
            if s.next != NO_SEGMENT {
                let next = &segments[s.next as usize];
                let cosine = (s.end - s.start)
                    .normalize()
                    .dot((next.end - next.start).normalize());
                sharpest = sharpest.min(cosine);
            }
        }
        let area = tile.size[0] * tile.size[1];
        let list = curves(tile);
        let closed = |c: &super::Curve| {
            super::link::apart(c.points[0], c.points[c.points.len() - 1], tile.size)
                <= super::link::SAME_POINT
        };
        let [overlap, axis_inside] = fiber_overlap(tile);
        Self {
            tile_mm: tile.size,
            fibers: list.len(),
            closed_fibers: list.iter().filter(|c| closed(c)).count(),
            segments: segments.len(),
            fiber_radius_um: radius.map(|r| r * 1e3),
            z_range_mm: z,
            thickness_mm: z[1] - z[0],
            fiber_volume_fraction: volume / (area * (z[1] - z[0])),
            fiber_length_per_mm2: length / area,
            mass_g_per_m2: mass.map(|mg| 1e3 * mg / area),
            largest_joint_deg: sharpest.clamp(-1.0, 1.0).acos().to_degrees(),
            fiber_overlap: overlap,
            fiber_axis_inside: axis_inside,
            yarn_overlap: None,
            chord_error_um: None,
            systems: Vec::new(),
            closings: Vec::new(),
            notes: crowded(axis_inside).into_iter().collect(),
        }
    }

    /// Adds what is known of a woven tile's yarns.
    pub(crate) fn add_swatch(&mut self, swatch: &Swatch) {
        let overlap = yarn_overlap(swatch);
        self.yarn_overlap = Some(overlap.between);
        self.chord_error_um = Some(1e3 * swatch.chord_error);
        self.closings = swatch.closings.clone();
        for closing in &swatch.closings {
            self.notes.push(format!(
                "{}: {:.4} {} per tile rounded to {} so that the tile closes",
                closing.system, closing.asked_per_tile, closing.quantity, closing.used_per_tile
            ));
        }
        if overlap.between > LARGE_OVERLAP {
            self.notes.push(format!(
                "warp and weft yarns run into each other: {:.0} % of their volume is shared; higher crown_mm or thinner yarns lessen it",
                100.0 * overlap.between
            ));
        }
        for (system, beside) in swatch.systems.iter().zip(overlap.beside) {
            self.add_system(system, beside);
        }
    }

    fn add_system(&mut self, system: &WovenSystem, side_overlap: f64) {
        let shape = &system.shape;
        let yarns = &system.yarns;
        let section = 0.25 * PI * shape.width * shape.thickness;
        let fibers = f64::from(shape.fibers) * PI * system.fiber_radius * system.fiber_radius;
        let bend = yarns
            .iter()
            .map(|y| y.min_bend_radius(64))
            .fold(f64::INFINITY, f64::min);
        let length: f64 = yarns.iter().map(|y| y.center_length(64)).sum();
        let straight: f64 = yarns.iter().map(|y| y.length).sum();
        let report = SystemReport {
            system: system.name,
            yarns: yarns.len(),
            pitch_mm: system.pitch,
            fibers_per_yarn: shape.fibers,
            segments_per_fiber: system.segments_per_fiber(),
            twist_per_tile: shape.turns,
            migration_per_tile: shape.migrations,
            packing: fibers / section,
            crimp: length / straight - 1.0,
            min_bend_radius_mm: bend,
            bend_ratio: bend / (0.5 * shape.thickness),
            side_overlap,
        };
        if report.bend_ratio < 1.0 {
            self.notes.push(format!(
                "{}: bends of {:.3} mm radius are sharper than half the yarn's thickness ({:.3} mm), fibers fold there; lower crown_mm, larger join_cells or thinner yarns lessen it",
                system.name, bend, 0.5 * shape.thickness
            ));
        }
        if report.packing > 0.9 {
            self.notes.push(format!(
                "{}: the fibers fill {:.0} % of the yarn's section, more than circles can (91 %)",
                system.name,
                100.0 * report.packing
            ));
        }
        if side_overlap > LARGE_OVERLAP {
            self.notes.push(format!(
                "{}: neighboring yarns share {:.0} % of their volume; a larger pitch_mm or smaller yarn_width_mm lessens it",
                system.name,
                100.0 * side_overlap
            ));
        }
        self.systems.push(report);
    }
}

/// The remark on fibers that run along inside each other.
fn crowded(axis_inside: f64) -> Option<String> {
    (axis_inside > LARGE_AXIS_INSIDE).then(|| {
        format!(
            "{:.0} % of fiber length has its axis inside another fiber: fibers are placed without regard to contact; fewer or thinner fibers, wider yarns or a smaller migration_depth lessen it",
            100.0 * axis_inside
        )
    })
}
