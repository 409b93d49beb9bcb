//! Finding each segment's neighbors from end points.

use super::{NO_SEGMENT, Segment};
use glam::DVec3;
use std::collections::HashMap;

/// Two end points closer than this (modulo the tile) are one point of one fiber, millimeters.
pub(crate) const SAME_POINT: f64 = 1e-5;

/// Fills `previous` and `next`: first between consecutive segments whose end and start coincide, then between the free
/// ends and free starts that are left, nearest first within [`SAME_POINT`]; always modulo the tile and within one yarn
/// system, each point used once.
///
/// A fiber whose segments point in opposite directions stays in pieces where they meet.
pub(crate) fn link(segments: &mut [Segment], size: [f64; 2]) {
    for segment in segments.iter_mut() {
        (segment.previous, segment.next) = (NO_SEGMENT, NO_SEGMENT);
    }
    for k in 1..segments.len() {
        let (a, b) = (&segments[k - 1], &segments[k]);
        if a.yarn_system == b.yarn_system && apart(a.end, b.start, size) <= SAME_POINT {
            join(segments, k - 1, k);
        }
    }
    let grid = Grid::new(size);
    let mut free_starts: HashMap<[i64; 3], Vec<usize>> = HashMap::new();
    for (k, segment) in segments.iter().enumerate() {
        if segment.previous == NO_SEGMENT {
            free_starts
                .entry(grid.cell(segment.start))
                .or_default()
                .push(k);
        }
    }
    let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
    for (k, segment) in segments.iter().enumerate() {
        if segment.next != NO_SEGMENT {
            continue;
        }
        for cell in grid.around(segment.end) {
            for &other in free_starts.get(&cell).into_iter().flatten() {
                let distance = apart(segment.end, segments[other].start, size);
                if distance <= SAME_POINT && segments[other].yarn_system == segment.yarn_system {
                    pairs.push((distance, k, other));
                }
            }
        }
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    for (_, a, b) in pairs {
        if segments[a].next == NO_SEGMENT && segments[b].previous == NO_SEGMENT {
            join(segments, a, b);
        }
    }
}

fn join(segments: &mut [Segment], a: usize, b: usize) {
    segments[a].next = b as u32;
    segments[b].previous = a as u32;
}

/// Distance of two points modulo the tile, millimeters.
pub(crate) fn apart(a: DVec3, b: DVec3, size: [f64; 2]) -> f64 {
    let d = a - b;
    let near = |d: f64, size: f64| d - size * (d / size).round();
    DVec3::new(near(d.x, size[0]), near(d.y, size[1]), d.z).length()
}

/// Cells of ten times [`SAME_POINT`] or a little more that divide the tile evenly.
struct Grid {
    size: [f64; 2],
    count: [i64; 2],
}

impl Grid {
    fn new(size: [f64; 2]) -> Self {
        Self {
            size,
            count: size.map(|s| ((s / (10.0 * SAME_POINT)).floor() as i64).max(1)),
        }
    }

    fn cell(&self, p: DVec3) -> [i64; 3] {
        let wrapped = |x: f64, axis: usize| {
            let fraction = (x / self.size[axis]).rem_euclid(1.0);
            ((fraction * self.count[axis] as f64) as i64).rem_euclid(self.count[axis])
        };
        let z = (p.z / (10.0 * SAME_POINT)).floor() as i64;
        [wrapped(p.x, 0), wrapped(p.y, 1), z]
    }

    /// The cell of `p` and those its [`SAME_POINT`] neighborhood reaches.
    fn around(&self, p: DVec3) -> Vec<[i64; 3]> {
        let mut cells: Vec<[i64; 3]> = (0..8)
            .map(|corner| {
                let sign = |bit: i32| if corner & bit == 0 { -1.0 } else { 1.0 };
                self.cell(p + SAME_POINT * DVec3::new(sign(1), sign(2), sign(4)))
            })
            .collect();
        cells.sort_unstable();
        cells.dedup();
        cells
    }
}
