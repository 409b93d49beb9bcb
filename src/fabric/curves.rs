//! Fibers as polylines: the form in which curve files store them.

use super::{FiberTile, NO_SEGMENT, Segment};
use glam::DVec3;

/// One fiber (or one round of a fiber that closes across the seam) as a polyline.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// At least two points, millimeters, unwrapped (a point may lie outside the tile).
    pub points: Vec<DVec3>,
    /// Radius of each segment, millimeters: one fewer than points.
    pub radii: Vec<f64>,
    /// Yarn system of the fiber.
    pub yarn_system: u8,
}

/// All fibers as polylines, in the order of their first segment. A closed fiber starts at its lowest-numbered segment and
/// ends one round later, at the same point in another copy of the tile.
pub fn curves(tile: &FiberTile) -> Vec<Curve> {
    let segments = &tile.segments;
    let mut seen = vec![false; segments.len()];
    let mut curves = Vec::new();
    let open = |k: &usize| segments[*k].previous == NO_SEGMENT;
    let mut starts: Vec<usize> = (0..segments.len()).filter(open).collect();
    for &k in &starts {
        follow(segments, k, &mut seen, |_| ());
    }
    for k in 0..segments.len() {
        if !seen[k] {
            starts.push(k);
            follow(segments, k, &mut seen, |_| ());
        }
    }
    starts.sort_unstable();
    seen.fill(false);
    for start in starts {
        let first = &segments[start];
        let mut curve = Curve {
            points: vec![first.start],
            radii: Vec::new(),
            yarn_system: first.yarn_system,
        };
        follow(segments, start, &mut seen, |segment| {
            // A neighbor stored in another copy of the tile is moved by whole tiles to where this one ends.
            let at = *curve.points.last().unwrap_or(&segment.start);
            let d = at - segment.start;
            let shift = DVec3::new(
                tile.size[0] * (d.x / tile.size[0]).round(),
                tile.size[1] * (d.y / tile.size[1]).round(),
                0.0,
            );
            curve.points.push(segment.end + shift);
            curve.radii.push(segment.radius);
        });
        curves.push(curve);
    }
    curves
}

/// Visits segments from `start` on until the fiber ends or comes back.
fn follow(segments: &[Segment], start: usize, seen: &mut [bool], mut visit: impl FnMut(&Segment)) {
    let mut k = start;
    while !seen[k] {
        seen[k] = true;
        visit(&segments[k]);
        if segments[k].next == NO_SEGMENT {
            return;
        }
        k = segments[k].next as usize;
    }
}

/// The tile made of polylines; neighbors across curves and across the seam are found by position.
pub fn from_curves(size: [f64; 2], curves: &[Curve]) -> FiberTile {
    let mut segments = Vec::with_capacity(curves.iter().map(|c| c.radii.len()).sum());
    for curve in curves {
        for (pair, &radius) in curve.points.windows(2).zip(&curve.radii) {
            segments.push(Segment {
                start: pair[0],
                end: pair[1],
                radius,
                yarn_system: curve.yarn_system,
                previous: NO_SEGMENT,
                next: NO_SEGMENT,
            });
        }
    }
    super::link::link(&mut segments, size);
    FiberTile { size, segments }
}
