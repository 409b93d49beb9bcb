//! How much fibers and yarns run into each other. Measured, never mended.

use super::woven::{Swatch, WovenSystem};
use super::{FiberTile, NO_SEGMENT};
use glam::DVec3;
use std::collections::HashMap;

/// Points of fiber axes looked at by [`fiber_overlap`].
const SAMPLES: usize = 4000;
/// Most columns per weave cell and axis in [`yarn_overlap`], and on the whole tile.
const COLUMNS: usize = 48;
const ALL_COLUMNS: usize = 1_000_000;

/// Fractions of fiber length that run into another fiber (axes nearer than the sum of the radii) and whose axis even lies
/// inside another fiber (nearer than its radius), at up to 4000 segment middles evenly spread over the tile's segments,
/// nearest periodic image.
pub(crate) fn fiber_overlap(tile: &FiberTile) -> [f64; 2] {
    let segments = &tile.segments;
    let fiber = fiber_numbers(tile);
    let stride = segments.len().div_ceil(SAMPLES);
    let samples: Vec<usize> = (0..segments.len()).step_by(stride).collect();
    let longest = segments
        .iter()
        .map(|s| 0.5 * s.start.distance(s.end) + s.radius)
        .fold(0.0, f64::max);
    let widest = segments.iter().map(|s| s.radius).fold(0.0, f64::max);
    let cells = Cells::new(tile.size, longest + widest);
    // Samples are entered in all cells around them, so that each segment needs to look at one cell only.
    let mut near: HashMap<[i64; 3], Vec<usize>> = HashMap::new();
    for (index, &k) in samples.iter().enumerate() {
        let middle = 0.5 * (segments[k].start + segments[k].end);
        for cell in cells.around(middle) {
            near.entry(cell).or_default().push(index);
        }
    }
    // Depth per sample: 0 apart, 1 run into, 2 axis inside.
    let mut depth = vec![0_u8; samples.len()];
    for (j, other) in segments.iter().enumerate() {
        let Some(list) = near.get(&cells.cell(0.5 * (other.start + other.end))) else {
            continue;
        };
        for &index in list {
            let k = samples[index];
            if depth[index] == 2 || fiber[k] == fiber[j] {
                continue;
            }
            let point = 0.5 * (segments[k].start + segments[k].end);
            let distance = axis_distance(point, other.start, other.end, tile.size);
            let found = u8::from(distance < segments[k].radius + other.radius)
                + u8::from(distance < other.radius);
            depth[index] = depth[index].max(found);
        }
    }
    let length = |k: usize| segments[k].start.distance(segments[k].end);
    let all: f64 = samples.iter().map(|&k| length(k)).sum();
    [1, 2].map(|least| {
        let reached = samples.iter().zip(&depth).filter(|(_, d)| **d >= least);
        reached.fold(0.0, |sum, (&k, _)| sum + length(k)) / all
    })
}

/// The number of the fiber each segment belongs to.
pub(crate) fn fiber_numbers(tile: &FiberTile) -> Vec<u32> {
    let mut fiber = vec![NO_SEGMENT; tile.segments.len()];
    let mut count = 0;
    for start in 0..tile.segments.len() {
        if fiber[start] != NO_SEGMENT {
            continue;
        }
        for forward in [true, false] {
            let step = |k: usize| {
                let s = &tile.segments[k];
                if forward { s.next } else { s.previous }
            };
            fiber[start] = count;
            let mut k = step(start);
            while k != NO_SEGMENT && fiber[k as usize] == NO_SEGMENT {
                fiber[k as usize] = count;
                k = step(k as usize);
            }
        }
        count += 1;
    }
    fiber
}

/// Distance of `point` from the segment `a b`, taken at the periodic image whose middle is nearest.
fn axis_distance(point: DVec3, a: DVec3, b: DVec3, size: [f64; 2]) -> f64 {
    let middle = 0.5 * (a + b);
    let half = 0.5 * (b - a);
    let d = point - middle;
    let near = |d: f64, size: f64| d - size * (d / size).round();
    let d = DVec3::new(near(d.x, size[0]), near(d.y, size[1]), d.z);
    let t = (d.dot(half) / half.length_squared()).clamp(-1.0, 1.0);
    (d - half * t).length()
}

/// A periodic grid whose cells are at least `reach` wide.
struct Cells {
    size: [f64; 2],
    count: [i64; 2],
    reach: f64,
}

impl Cells {
    fn new(size: [f64; 2], reach: f64) -> Self {
        Self {
            size,
            count: size.map(|s| ((s / reach).floor() as i64).max(1)),
            reach,
        }
    }

    fn cell(&self, p: DVec3) -> [i64; 3] {
        let wrapped = |x: f64, axis: usize| {
            let fraction = (x / self.size[axis]).rem_euclid(1.0);
            ((fraction * self.count[axis] as f64) as i64).rem_euclid(self.count[axis])
        };
        let z = (p.z / self.reach).floor() as i64;
        [wrapped(p.x, 0), wrapped(p.y, 1), z]
    }

    fn around(&self, p: DVec3) -> Vec<[i64; 3]> {
        let [x, y, z] = self.cell(p);
        let mut cells = Vec::with_capacity(27);
        for dx in -1..=1 {
            for dy in -1..=1 {
                for dz in -1..=1 {
                    let x = (x + dx).rem_euclid(self.count[0]);
                    let y = (y + dy).rem_euclid(self.count[1]);
                    cells.push([x, y, z + dz]);
                }
            }
        }
        cells.sort_unstable();
        cells.dedup();
        cells
    }
}

/// Shared volume of the yarns' ideal elliptical tubes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct YarnOverlap {
    /// Fraction of the yarns' volume that lies inside a yarn of the other system.
    pub(crate) between: f64,
    /// Fraction of the volume of warp, weft that lies inside the next yarn of its own system.
    pub(crate) beside: [f64; 2],
}

/// Measures the overlap of yarn tubes on vertical columns, 48 x 48 to a weave cell (fewer above a million on the tile).
///
/// The tube's vertical extent is that of an ellipse across the center line, enlarged by the slope: exact for a straight
/// yarn, good to second order in curvature times thickness.
pub(crate) fn yarn_overlap(swatch: &Swatch) -> YarnOverlap {
    let [warp, weft] = &swatch.systems;
    let cells = warp.yarns.len() * weft.yarns.len();
    let columns = (ALL_COLUMNS / cells).isqrt().clamp(1, COLUMNS);
    let counts = [warp.yarns.len() * columns, weft.yarns.len() * columns];
    let (mut volume, mut between, mut beside) = ([0.0; 2], 0.0, [0.0; 2]);
    for i in 0..counts[0] {
        let x = (i as f64 + 0.5) / columns as f64;
        for j in 0..counts[1] {
            let y = (j as f64 + 0.5) / columns as f64;
            let spans = [intervals(warp, x, y), intervals(weft, y, x)];
            for (system, list) in spans.iter().enumerate() {
                volume[system] += list.iter().map(|s| s[1] - s[0]).sum::<f64>();
                for (k, a) in list.iter().enumerate() {
                    beside[system] += list[k + 1..].iter().map(|b| shared(*a, *b)).sum::<f64>();
                }
            }
            for a in &spans[0] {
                between += spans[1].iter().map(|b| shared(*a, *b)).sum::<f64>();
            }
        }
    }
    YarnOverlap {
        between: 2.0 * between / (volume[0] + volume[1]),
        beside: [2.0 * beside[0] / volume[0], 2.0 * beside[1] / volume[1]],
    }
}

/// Vertical spans of the system's yarns at `across` pitches (yarn k has its axis at k + 0.5) and `along` cells.
fn intervals(system: &WovenSystem, across: f64, along: f64) -> Vec<[f64; 2]> {
    let pitch = system.pitch;
    let n = system.yarns.len() as i64;
    let reach = 0.5 * system.shape.width / pitch;
    let first = (across - 0.5 - reach).ceil() as i64;
    let last = (across - 0.5 + reach).floor() as i64;
    (first..=last)
        .map(|k| {
            let yarn = &system.yarns[k.rem_euclid(n) as usize];
            let d = (across - 0.5 - k as f64) / reach;
            let at = yarn.line.at(along);
            let half = 0.5
                * system.shape.thickness
                * (1.0 - d * d).max(0.0).sqrt()
                * (at.slope / yarn.cell).hypot(1.0);
            [at.value - half, at.value + half]
        })
        .collect()
}

fn shared(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[1].min(b[1]) - a[0].max(b[0])).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fabric::{Curve, from_curves};

    fn straight(y: f64, z: f64) -> Curve {
        Curve {
            points: (0..=10)
                .map(|k| DVec3::new(0.1 * f64::from(k), y, z))
                .collect(),
            radii: vec![0.01; 10],
            yarn_system: 0,
        }
    }

    fn percent(tile: &FiberTile) -> [i32; 2] {
        fiber_overlap(tile)
            .map(|f| (1e6 * f).round() as i32)
            .map(|ppm| {
                assert_eq!(ppm % 10_000, 0, "{ppm}");
                ppm / 10_000
            })
    }

    #[test]
    fn overlapping_fibers_are_counted_and_touching_ones_are_not() {
        let size = [1.0, 1.0];
        let apart = from_curves(size, &[straight(0.1, 0.0), straight(0.1201, 0.0)]);
        assert_eq!(percent(&apart), [0, 0]);
        let close = from_curves(size, &[straight(0.1, 0.0), straight(0.1199, 0.0)]);
        assert_eq!(percent(&close), [100, 0]);
        let deep = from_curves(size, &[straight(0.1, 0.0), straight(0.1, 0.009)]);
        assert_eq!(percent(&deep), [100, 100]);
        // Half of the four fibers touch, one pair across the seam.
        let seam = from_curves(
            size,
            &[
                straight(0.995, 0.0),
                straight(0.005, 0.0),
                straight(0.5, 0.0),
                straight(0.7, 0.0),
            ],
        );
        assert_eq!(percent(&seam), [50, 0]);
    }
}
