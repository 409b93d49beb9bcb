//! From density and direction to fibers (Khungurn 2015 section 6; docs/ct.md has what it finds of known fibers).
//!
//! Voxels are divided by the axis they run along most of all; in the slices across each axis fibers are centers found at
//! the scale of their radius; centers are chained to lines by where each foretells the next, lines joined where they go on
//! in each other, and smoothed. Fibers do not touch the seams of the tile: each ends there.

mod centers;
mod near;
mod radius;
mod score;
mod smooth;
mod track;

pub use radius::FoundRadius;
pub use score::{FiberScore, compare};

use crate::base::{Error, Result, Watch};
use crate::fabric::{Curve, FiberTile, PackedDirection, VoxelTile, from_curves};
use centers::{Finder, averaged, main_axis};
use glam::DVec3;
use near::Near;
use rayon::prelude::*;
use serde::Serialize;
use track::{Line, joined, track};

/// Radius looked for where none is known, voxels.
const FIRST_GUESS: f64 = 1.8;
/// Shorter lines are not joined to others, vertices.
const LEAST_TO_JOIN: usize = 4;
/// Tangent of the angle off an axis from which fibers count as oblique.
const OBLIQUE: f64 = 0.466;
/// Radii that this library looks for, voxels.
const RADII: std::ops::RangeInclusive<f64> = 0.8..=30.0;

/// How fibers are traced.
#[derive(Debug, Clone, PartialEq)]
pub struct Tracing {
    /// Radius of the fibers, millimeters; without it one is found (see [`FoundRadius`]).
    pub radius: Option<f64>,
    /// A radius for each yarn system where it is found, not one for all.
    pub per_system: bool,
    /// Largest distance of a center from where it was foretold, radii.
    pub gate: f64,
    /// Least response of a center, as a share of the mean density of fiber.
    pub least_response: f64,
    /// Join lines end to end.
    pub join: bool,
    /// Shorter lines are dropped, vertices about a voxel apart.
    pub least_vertices: usize,
    /// Weight of the places found against smoothness (Khungurn 2015 eq. 25).
    pub alpha: f64,
}

impl Default for Tracing {
    fn default() -> Self {
        Self {
            radius: None,
            per_system: false,
            gate: 0.75,
            least_response: 0.12,
            join: true,
            least_vertices: 10,
            alpha: 0.1,
        }
    }
}

/// What was found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TraceReport {
    /// Radius the fibers were looked for with, voxels.
    pub expected_radius_voxels: f64,
    /// Centers in the slices across x, y and z.
    pub centers: [usize; 3],
    /// Joints between lines.
    pub joints: usize,
    /// Lines kept.
    pub fibers: usize,
    /// Their length, millimeters.
    pub length_mm: f64,
    /// Median number of vertices of a line.
    pub vertices_median: usize,
    /// Radius of the warp (system 0) and weft (1), millimeters.
    pub radius_mm: [f64; 2],
    /// How the radius was found, where it was not given: for both systems, or for warp and weft.
    pub found_radius: Vec<FoundRadius>,
    /// Share of voxels steeper than 45 degrees.
    pub steep_share: f64,
    /// Share of voxels that, seen from above, run more than 25 degrees off x and y.
    pub oblique_share: f64,
    /// What a person should know.
    pub notes: Vec<String>,
}

/// Traces the fibers of a tile of voxels.
///
/// # Errors
/// The tile is empty, a number has no meaning, the radius is outside 0.8 to 30 voxels, no fiber is found, or the watch
/// cancelled.
pub fn trace(
    tile: &VoxelTile,
    options: &Tracing,
    watch: &dyn Watch,
) -> Result<(FiberTile, TraceReport)> {
    check(tile, options)?;
    let given = options.radius.map(|r| r / tile.side());
    let mut expected = given.unwrap_or(FIRST_GUESS);
    let (mut lines, mut counts) = lines(tile, options, expected, watch)?;
    if given.is_none() {
        // Once more with the radius found with a guess.
        if let Some(found) = radius::best_radius(tile, segments(&lines, None), |_| true) {
            expected = (found.radius / tile.side()).clamp(*RADII.start(), *RADII.end());
            (lines, counts) = self::lines(tile, options, expected, watch)?;
        }
    }
    let lines: Vec<Line> = lines
        .into_iter()
        .filter(|l| l.points.len() >= options.least_vertices)
        .map(|l| Line {
            points: smooth::smooth(&l.points, options.alpha),
            along: l.along,
        })
        .collect();
    if lines.is_empty() {
        return Err(Error::new(format!(
            "no fiber of at least {} vertices and a radius near {:.2} voxels",
            options.least_vertices, expected
        ))
        .with_hint("is the radius right, and do fibers run nearly along x, y or z? goniofit ct view draws them"));
    }
    let (radii, found_radius) = radii(tile, options, &lines, expected);
    let curves: Vec<Curve> = lines.iter().map(|line| curve(line, tile, radii)).collect();
    let mut sizes: Vec<usize> = lines.iter().map(|l| l.points.len()).collect();
    sizes.sort_unstable();
    let length: f64 = lines.iter().map(length).sum();
    let (steep, oblique) = off_axes(tile);
    let report = TraceReport {
        expected_radius_voxels: expected,
        centers: counts.centers,
        joints: counts.joints,
        fibers: lines.len(),
        length_mm: length * tile.side(),
        vertices_median: sizes[sizes.len() / 2],
        radius_mm: radii,
        found_radius,
        steep_share: steep,
        oblique_share: oblique,
        notes: notes(steep, oblique, expected),
    };
    Ok((from_curves(tile.size(), &curves), report))
}

/// A tile whose voxels near fibers have the fibers' directions (Khungurn 2015 section 6), within `reach` millimeters; of
/// several fibers the nearest counts. Returns also the share of voxels changed.
///
/// # Errors
/// The fibers are on a tile of another size, or the reach has no meaning.
pub fn transfer(tile: &VoxelTile, fibers: &FiberTile, reach: f64) -> Result<(VoxelTile, f64)> {
    let same = (0..2).all(|k| (tile.size()[k] - fibers.size[k]).abs() < 0.5 * tile.side());
    if !(same && reach > 0.0 && reach.is_finite()) {
        return Err(Error::new(format!(
            "fibers on {:?} mm, voxels on {:?} mm, within {reach} mm: expected the same tile and a distance above 0",
            fibers.size,
            tile.size()
        )));
    }
    let segments = fibers.segments.iter().map(|s| [s.start, s.end]);
    let near = Near::new(segments.collect(), reach);
    let [nx, ny, _] = tile.shape();
    let low = DVec3::new(0.0, 0.0, tile.bottom());
    let found: Vec<(PackedDirection, bool)> = (0..tile.density().len())
        .into_par_iter()
        .map(|place| {
            let voxel = [place % nx, place / nx % ny, place / (nx * ny)].map(|v| v as f64 + 0.5);
            let p = low + DVec3::from_array(voxel) * tile.side();
            let hit = Some(p)
                .filter(|_| tile.density()[place] > 0.0)
                .and_then(|p| near.nearest(p));
            match hit {
                Some((_, index)) => (PackedDirection::pack(near.along(index)), true),
                None => (PackedDirection::pack(tile.direction(place)), false),
            }
        })
        .collect();
    let solid = tile.density().iter().filter(|d| **d > 0.0).count();
    let changed = found.iter().filter(|f| f.1).count();
    let directions = found.into_iter().map(|f| f.0).collect();
    let moved = VoxelTile::from_parts(
        tile.shape(),
        tile.side(),
        tile.bottom(),
        tile.density().to_vec(),
        directions,
    )?;
    Ok((moved, changed as f64 / solid.max(1) as f64))
}

fn check(tile: &VoxelTile, options: &Tracing) -> Result<()> {
    if tile.density().iter().all(|d| *d <= 0.0) {
        return Err(Error::new("every voxel is empty")
            .with_hint("goniofit ct orient says what its thresholds keep"));
    }
    let given = options.radius.map(|r| r / tile.side());
    if let Some(r) = given.filter(|r| !RADII.contains(r)) {
        return Err(Error::new(format!(
            "a fiber radius of {r:.3} voxels ({} um in voxels of {} um): expected {} to {}",
            options.radius.unwrap_or_default() * 1e3,
            tile.side() * 1e3,
            RADII.start(),
            RADII.end()
        ))
        .with_hint(
            "fibers thinner than a voxel and a half across cannot be told apart: scan finer",
        ));
    }
    let Tracing {
        gate,
        least_response,
        alpha,
        least_vertices,
        ..
    } = *options;
    let fine = (0.05..=10.0).contains(&gate)
        && (0.0..10.0).contains(&least_response)
        && (1e-9..=1e9).contains(&alpha);
    if !fine || least_vertices < 2 {
        return Err(Error::new(format!(
            "gate {gate}, least response {least_response}, alpha {alpha}, least vertices {least_vertices}: expected 0.05 to 10, at least 0, above 0 and at least 2"
        )));
    }
    if tile.shape().iter().any(|n| *n < 3) {
        return Err(Error::new(format!(
            "a tile of {:?} voxels: expected at least 3 along each axis",
            tile.shape()
        )));
    }
    Ok(())
}

struct Counts {
    centers: [usize; 3],
    joints: usize,
}

/// Lines before smoothing, in voxels.
fn lines(
    tile: &VoxelTile,
    options: &Tracing,
    radius: f64,
    watch: &dyn Watch,
) -> Result<(Vec<Line>, Counts)> {
    let solid = tile.density().iter().filter(|d| **d > 0.0);
    let (n, sum) = solid.fold((0.0, 0.0), |(n, s), d| (n + 1.0, s + f64::from(*d)));
    let density = averaged(tile, radius);
    let mut all = Vec::new();
    let mut counts = Counts {
        centers: [0; 3],
        joints: 0,
    };
    for axis in 0..3 {
        let finder = Finder {
            tile,
            density: &density,
            axis,
            radius,
            least: options.least_response * sum / n,
        };
        let slices = finder.all(watch)?;
        counts.centers[axis] = slices.iter().map(Vec::len).sum();
        all.extend(track(&slices, axis, options.gate * radius));
    }
    if options.join {
        all.retain(|l| l.points.len() >= LEAST_TO_JOIN);
        (all, counts.joints) = joined(all, 6.0 * radius, 0.9 * radius);
    }
    Ok((all, counts))
}

/// Segments of lines, of all or of those of a system.
fn segments(lines: &[Line], system: Option<u8>) -> Vec<[DVec3; 2]> {
    let chosen = lines
        .iter()
        .filter(|l| system.is_none_or(|s| yarn_system(l) == s));
    chosen
        .flat_map(|l| l.points.windows(2).map(|w| [w[0], w[1]]))
        .collect()
}

/// Weft (1) where a line runs more along x than along y, else warp (0); steep lines too.
fn yarn_system(line: &Line) -> u8 {
    let sum: DVec3 = line.along.iter().map(|d| d.abs()).sum();
    u8::from(sum.x > sum.y)
}

/// Radius of warp and weft, millimeters, and how it was found.
fn radii(
    tile: &VoxelTile,
    options: &Tracing,
    lines: &[Line],
    expected: f64,
) -> ([f64; 2], Vec<FoundRadius>) {
    if let Some(radius) = options.radius {
        return ([radius; 2], Vec::new());
    }
    let fallback = expected * tile.side();
    if !options.per_system {
        let found = radius::best_radius(tile, segments(lines, None), |_| true);
        return (
            [found.map_or(fallback, |f| f.radius); 2],
            found.into_iter().collect(),
        );
    }
    let found = [0_u8, 1].map(|system| {
        let belong = |place: usize| {
            let d = tile.direction(place).abs();
            u8::from(d.x > d.y) == system
        };
        radius::best_radius(tile, segments(lines, Some(system)), belong)
    });
    (
        found.map(|f| f.map_or(fallback, |f| f.radius)),
        found.into_iter().flatten().collect(),
    )
}

/// A line in millimeters.
fn curve(line: &Line, tile: &VoxelTile, radii: [f64; 2]) -> Curve {
    let low = DVec3::new(0.0, 0.0, tile.bottom());
    let points: Vec<DVec3> = line.points.iter().map(|p| low + *p * tile.side()).collect();
    let yarn_system = yarn_system(line);
    Curve {
        radii: vec![radii[usize::from(yarn_system)]; points.len() - 1],
        points,
        yarn_system,
    }
}

fn length(line: &Line) -> f64 {
    line.points.windows(2).map(|w| w[0].distance(w[1])).sum()
}

/// Shares of voxels along z most of all, and of others that are more than 25 degrees off x and y seen from above.
fn off_axes(tile: &VoxelTile) -> (f64, f64) {
    let (mut all, mut steep, mut oblique) = (0.0, 0.0, 0.0);
    for place in (0..tile.density().len()).filter(|p| tile.density()[*p] > 0.0) {
        let d = tile.direction(place);
        all += 1.0;
        let (x, y) = (d.x.abs(), d.y.abs());
        if main_axis(d) == 2 {
            steep += 1.0;
        } else if x.min(y) > OBLIQUE * x.max(y) {
            oblique += 1.0;
        }
    }
    (steep / f64::max(all, 1.0), oblique / f64::max(all, 1.0))
}

fn notes(steep: f64, oblique: f64, radius: f64) -> Vec<String> {
    let mut notes = Vec::new();
    if oblique > 0.1 {
        notes.push(format!(
            "{:.0} % of the fiber runs more than 25 degrees off x and y, and lines break toward 45: is the cloth aligned? (goniofit ct prepare --weft-deg --warp-deg)",
            100.0 * oblique
        ));
    }
    if steep > 0.05 {
        notes.push(format!(
            "{:.0} % of the fiber is steeper than 45 degrees: its lines belong to warp or weft by the way they lean",
            100.0 * steep
        ));
    }
    if radius < 2.0 {
        notes.push(format!(
            "fibers of {radius:.2} voxels radius: a quarter or more of what touches is missed, and many lines are pieces; finer voxels help most"
        ));
    }
    notes
}
