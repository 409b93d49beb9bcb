//! How well found fibers agree with true ones.

use super::near::Near;
use crate::fabric::{FiberTile, curves};
use glam::DVec3;
use serde::Serialize;

/// Directions further apart than this are of different fibers (cosine).
const SAME: f64 = 0.866;

/// Found fibers beside true ones. Lengths are millimeters, angles degrees.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FiberScore {
    /// Share of true fiber length that has a found line within the fiber, at most 30 degrees off.
    pub recall: f64,
    /// The same for fibers that are steeper than 45 degrees; 0 where there are none.
    pub recall_steep: f64,
    /// Share of found length inside a true fiber, at most 30 degrees off.
    pub precision: f64,
    /// Median angle between found lines and the nearest true axis.
    pub direction_median: f64,
    /// The angle that 90 % do not exceed.
    pub direction_90: f64,
    /// Root mean square distance of found lines inside true fibers from their axes.
    pub position_rms: f64,
    /// Found lines that leave one true fiber for another, per millimeter of line.
    pub switches_per_mm: f64,
    /// Found lines for each true fiber.
    pub pieces: f64,
    /// Median length of found lines.
    pub length_median: f64,
}

/// Compares fibers on the same periodic tile.
pub fn compare(truth: &FiberTile, found: &FiberTile) -> FiberScore {
    let radius = truth.segments.iter().map(|s| s.radius).fold(0.0, f64::max);
    let (true_lines, true_near) = indexed(truth, radius);
    let (found_lines, found_near) = indexed(found, radius);
    let (mut recalled, mut recalled_steep) = ([0.0; 2], [0.0; 2]);
    for line in &true_lines.lines {
        for (p, along, length) in samples(line, 0.5 * radius) {
            let near = found_near.nearest(wrapped(p, truth.size));
            let hit = near.is_some_and(|n| found_near.along(n.1).dot(along).abs() >= SAME);
            let counts = [&mut recalled, &mut recalled_steep];
            let steep = along.z.abs() > 0.707;
            for sum in counts.into_iter().take(1 + usize::from(steep)) {
                sum[0] += length * f64::from(u8::from(hit));
                sum[1] += length;
            }
        }
    }
    let (mut inside, mut all, mut square, mut switches) = (0.0, 0.0, 0.0, 0_u32);
    let mut angles = Vec::new();
    let mut lengths = Vec::new();
    for line in &found_lines.lines {
        let mut last: Option<usize> = None;
        let mut whole = 0.0;
        for (p, along, length) in samples(line, 0.5 * radius) {
            (all, whole) = (all + length, whole + length);
            let p = wrapped(p, truth.size);
            let Some((distance, index)) = true_near.nearest(p) else {
                continue;
            };
            let cos = true_near.along(index).dot(along).abs().min(1.0);
            angles.push(cos.acos().to_degrees());
            if cos >= SAME {
                inside += length;
                square += length * distance * distance;
            }
            let fiber = true_lines.owner[index];
            // Where fibers run into each other the nearest may change without the line leaving the one it was in.
            let left =
                last.is_some_and(|f| f != fiber && !true_lines.within(f, p, radius, truth.size));
            if left || last.is_none() {
                switches += u32::from(left);
                last = Some(fiber);
            }
        }
        lengths.push(whole);
    }
    angles.sort_by(f64::total_cmp);
    lengths.sort_by(f64::total_cmp);
    let at = |list: &[f64], share: f64| {
        let place = (share * list.len() as f64) as usize;
        list.get(place).or(list.last()).copied().unwrap_or(0.0)
    };
    let share = |[part, whole]: [f64; 2]| if whole > 0.0 { part / whole } else { 0.0 };
    FiberScore {
        recall: share(recalled),
        recall_steep: share(recalled_steep),
        precision: share([inside, all]),
        direction_median: at(&angles, 0.5),
        direction_90: at(&angles, 0.9),
        position_rms: share([square, inside]).sqrt(),
        switches_per_mm: share([f64::from(switches), all]),
        pieces: share([
            found_lines.lines.len() as f64,
            true_lines.lines.len() as f64,
        ]),
        length_median: at(&lengths, 0.5),
    }
}

/// Fibers and which of them each entered segment is of.
struct Lines {
    lines: Vec<Vec<DVec3>>,
    owner: Vec<usize>,
}

impl Lines {
    /// Whether a point of the tile is within a fiber.
    fn within(&self, fiber: usize, p: DVec3, radius: f64, size: [f64; 2]) -> bool {
        self.lines[fiber].windows(2).any(|w| {
            let middle = 0.5 * (w[0] + w[1]);
            let near = |d: f64, size: f64| d - size * (d / size).round();
            let d = p - middle;
            let d = DVec3::new(near(d.x, size[0]), near(d.y, size[1]), d.z);
            super::near::distance(middle + d, w[0], w[1]) <= radius
        })
    }
}

/// Fibers as polylines, and their segments within the tile and a border around it.
fn indexed(tile: &FiberTile, reach: f64) -> (Lines, Near) {
    let lines: Vec<Vec<DVec3>> = curves(tile).into_iter().map(|c| c.points).collect();
    let (mut segments, mut owner) = (Vec::new(), Vec::new());
    let [sx, sy] = tile.size;
    for (index, line) in lines.iter().enumerate() {
        for pair in line.windows(2) {
            let first = wrapped(pair[0], tile.size);
            let way = pair[1] - pair[0];
            for (x, y) in [-1.0, 0.0, 1.0]
                .into_iter()
                .flat_map(|x| [-1.0, 0.0, 1.0].map(|y| (x, y)))
            {
                let a = first + DVec3::new(x * sx, y * sy, 0.0);
                let (low, high) = (a.min(a + way) - reach, a.max(a + way) + reach);
                if high.x >= 0.0 && high.y >= 0.0 && low.x <= sx && low.y <= sy {
                    segments.push([a, a + way]);
                    owner.push(index);
                }
            }
        }
    }
    (Lines { lines, owner }, Near::new(segments, reach))
}

/// The point's copy in the tile.
fn wrapped(p: DVec3, size: [f64; 2]) -> DVec3 {
    DVec3::new(p.x.rem_euclid(size[0]), p.y.rem_euclid(size[1]), p.z)
}

/// Points about `step` apart along a polyline, with direction and the length each stands for.
fn samples(line: &[DVec3], step: f64) -> impl Iterator<Item = (DVec3, DVec3, f64)> + '_ {
    line.windows(2).flat_map(move |w| {
        let (a, way) = (w[0], w[1] - w[0]);
        let length = way.length();
        let n = (length / step).ceil().max(1.0);
        let along = way.normalize_or(DVec3::X);
        (0..n as usize).map(move |k| (a + way * ((k as f64 + 0.5) / n), along, length / n))
    })
}
