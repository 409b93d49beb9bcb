//! The acceleration structure: a regular grid of boxes over one periodic cell, each with the list of capsules that reach
//! into it.
//!
//! Cloth fills its slab so evenly, and a ray in it ends so soon (after two or three boxes), that finding the first box
//! without descending any tree is worth more than a hierarchy's better fit: docs/decisions/0005-ray-tracing.md has the
//! measurement. The side of the boxes follows from how crowded the boxes are where fibers are. Does not know periodicity.

use super::capsules::{Capsule, LANES, NO_CAPSULE, Nearest, Ray};
use crate::base::{Error, Result};
use glam::Vec3;

/// Capsules in a box, averaged over the lists' entries, that a grid is sized for.
const CROWD: f64 = 18.0;
/// Most boxes per capsule (and a few more), so that a thin cloth with one high hair stays affordable.
const MOST_BOXES: f64 = 16.0;
/// Most list entries per capsule, where that is not for the sake of few capsules.
const MOST_ENTRIES: usize = 64;
/// Capsules are listed in every box they come this near to, relative to the grid's extent: some thirty roundings of f32.
pub(super) const PAD: f32 = 4e-6;

pub(super) struct Grid {
    low: [f32; 3],
    /// Side of a box, and one over it.
    side: [f32; 3],
    per_side: [f32; 3],
    count: [i32; 3],
    /// Where each box's list starts in `entries`, and the end of the last.
    starts: Vec<u32>,
    /// Indices into `capsules`, box after box, and `LANES` spare ones.
    entries: Vec<u32>,
    capsules: Vec<Capsule>,
}

/// What a traversal tells about its work.
pub(super) trait Meter {
    /// It looked into a box with so many capsules.
    fn looked(&mut self, capsules: usize);
}

/// Nobody asks.
impl Meter for () {
    #[inline(always)]
    fn looked(&mut self, _: usize) {}
}

impl Grid {
    /// Lists `capsules` in the boxes from `low` to `high`.
    pub(super) fn new(capsules: Vec<Capsule>, low: Vec3, high: Vec3) -> Result<Self> {
        let extent = high - low;
        let volume = f64::from(extent.x) * f64::from(extent.y) * f64::from(extent.z);
        let mut side = 1.3 * (volume / (capsules.len() + 1) as f64).cbrt();
        let least = (volume / (MOST_BOXES * capsules.len() as f64 + 4096.0)).cbrt();
        let mut grid = Self::sized(capsules, low, extent, side.max(least));
        for _ in 0..4 {
            let counts = grid.counts()?;
            let sum: f64 = counts.iter().map(|&n| f64::from(n)).sum();
            let squares: f64 = counts.iter().map(|&n| f64::from(n).powi(2)).sum();
            let crowd = squares / sum.max(1.0);
            // Lists grow about with the square of the side: fibers are lines.
            let wanted = (side * (CROWD / crowd.max(1.0)).sqrt()).max(least);
            if (0.85..1.2).contains(&(wanted / side)) {
                return grid.fill(&counts);
            }
            side = wanted;
            grid = Self::sized(grid.capsules, low, extent, side);
        }
        let counts = grid.counts()?;
        grid.fill(&counts)
    }

    fn sized(capsules: Vec<Capsule>, low: Vec3, extent: Vec3, side: f64) -> Self {
        let count = extent
            .to_array()
            .map(|e| (f64::from(e) / side).ceil().clamp(1.0, 2048.0) as i32);
        let sides = [0, 1, 2].map(|k| extent[k] / count[k] as f32);
        Self {
            low: low.to_array(),
            side: sides,
            per_side: sides.map(|s| 1.0 / s),
            count,
            starts: Vec::new(),
            entries: Vec::new(),
            capsules,
        }
    }

    /// How many capsules reach into each box.
    fn counts(&self) -> Result<Vec<u32>> {
        let boxes = self.count.iter().map(|&n| n as usize).product();
        let mut counts = vec![0_u32; boxes];
        let mut entries = 0;
        let most = MOST_ENTRIES * self.capsules.len() + (1 << 24);
        for capsule in &self.capsules {
            self.boxes_of(capsule, |at| {
                counts[at] += 1;
                entries += 1;
            });
            if entries > most.min(u32::MAX as usize - LANES) {
                return Err(Error::new(format!(
                    "the fibers reach into more than {entries} boxes of the ray grid: expected at most {most}"
                ))
                .with_hint("are a few fibers very much longer or thicker than all others?"));
            }
        }
        Ok(counts)
    }

    fn fill(mut self, counts: &[u32]) -> Result<Self> {
        let mut starts = Vec::with_capacity(counts.len() + 1);
        let mut sum = 0;
        starts.push(sum);
        starts.extend(counts.iter().map(|n| {
            sum += n;
            sum
        }));
        let mut next = starts.clone();
        let mut entries = vec![0; sum as usize + LANES];
        for (index, capsule) in (0_u32..).zip(&self.capsules) {
            self.boxes_of(capsule, |at| {
                entries[next[at] as usize] = index;
                next[at] += 1;
            });
        }
        self.starts = starts;
        self.entries = entries;
        Ok(self)
    }

    /// Visits the boxes within the capsule's radius of its axis.
    fn boxes_of(&self, capsule: &Capsule, mut visit: impl FnMut(usize)) {
        let (low, side) = (Vec3::from(self.low), Vec3::from(self.side));
        let extent = side * Vec3::from(self.count.map(|n| n as f32));
        let radius = capsule.radius() + PAD * extent.max_element();
        let half = Vec3::from(capsule.half());
        let (start, axis) = (Vec3::from(capsule.middle()) - half, 2.0 * half);
        let bounds = [
            start.min(start + axis) - radius - low,
            start.max(start + axis) + radius - low,
        ];
        let [first, last] = bounds.map(|p| {
            [0, 1, 2].map(|k| ((p[k] * self.per_side[k]) as i32).clamp(0, self.count[k] - 1))
        });
        for z in first[2]..=last[2] {
            for y in first[1]..=last[1] {
                for x in first[0]..=last[0] {
                    let corner = low + side * Vec3::new(x as f32, y as f32, z as f32);
                    if near_box(start, axis, corner, corner + side, radius) {
                        visit(((z * self.count[1] + y) * self.count[0] + x) as usize);
                    }
                }
            }
        }
    }

    /// The nearest capsule the ray enters (`ANY`: some capsule) and the distance to it; the ray's end and [`NO_CAPSULE`]
    /// when there is none.
    #[inline(always)]
    pub(super) fn trace<const FUSED: bool, const ANY: bool>(
        &self,
        ray: &Ray,
        skip: [u32; 3],
        meter: &mut impl Meter,
    ) -> (f32, u32) {
        let (mut x, mut y, mut z) = (self.enter(ray, 0), self.enter(ray, 1), self.enter(ray, 2));
        let mut at = (z.index * self.count[1] + y.index) * self.count[0] + x.index;
        let strides = [1, self.count[0], self.count[0] * self.count[1]];
        let steps = [
            strides[0] * x.step,
            strides[1] * y.step,
            strides[2] * z.step,
        ];
        let mut nearest = Nearest::new(ray.end);
        let mut distance = ray.end;
        loop {
            let (first, end) = (
                self.starts[at as usize] as usize,
                self.starts[at as usize + 1] as usize,
            );
            meter.looked(end - first);
            if first < end {
                let (mut from, mut left) = (first, end - first);
                while let Some(list) = self.entries[from..].first_chunk() {
                    nearest.test::<FUSED>(ray, &self.capsules, list, left, skip);
                    if left <= LANES {
                        break;
                    }
                    (from, left) = (from + LANES, left - LANES);
                }
                distance = nearest.distance();
                if ANY && distance < ray.end {
                    break;
                }
            }
            // Into the next box, through the wall that comes first.
            let across_x = (x.wall_at <= y.wall_at) & (x.wall_at <= z.wall_at);
            let across_y = !across_x & (y.wall_at <= z.wall_at);
            let across_z = !across_x & !across_y;
            let leaves_at = x.wall_at.min(y.wall_at).min(z.wall_at);
            if leaves_at >= distance {
                break;
            }
            x.advance::<FUSED>(across_x);
            y.advance::<FUSED>(across_y);
            z.advance::<FUSED>(across_z);
            if (x.left == 0) | (y.left == 0) | (z.left == 0) {
                break;
            }
            at += if across_x {
                steps[0]
            } else if across_y {
                steps[1]
            } else {
                steps[2]
            };
        }
        let capsule = if distance < ray.end {
            nearest.capsule(distance)
        } else {
            NO_CAPSULE
        };
        (distance, capsule)
    }

    /// Where a ray stands along one axis at its origin.
    #[inline(always)]
    fn enter(&self, ray: &Ray, k: usize) -> Along {
        let (o, d) = (ray.origin[k], ray.direction[k]);
        // Some wall far away for a ray parallel to the walls, whatever the sign of its zero.
        let per_d = if d.abs() < 1e-20 {
            1e20_f32.copysign(d)
        } else {
            1.0 / d
        };
        let index = (((o - self.low[k]) * self.per_side[k]) as i32).clamp(0, self.count[k] - 1);
        let up = per_d > 0.0;
        let mut along = Along {
            index,
            step: if up { 1 } else { -1 },
            left: if up { self.count[k] - index } else { index + 1 },
            wall: (index + i32::from(up)) as f32,
            wall_step: if up { 1.0 } else { -1.0 },
            per_wall: self.side[k] * per_d,
            at_zero: (self.low[k] - o) * per_d,
            wall_at: 0.0,
        };
        along.wall_at = along.wall * along.per_wall + along.at_zero;
        along
    }

    /// Memory of lists and capsules, bytes.
    pub(super) fn bytes(&self) -> usize {
        4 * (self.starts.len() + self.entries.len()) + size_of_val(&self.capsules[..])
    }
}

/// Progress of a ray through the grid along one axis.
struct Along {
    index: i32,
    step: i32,
    /// Boxes until the grid ends, this one included.
    left: i32,
    /// Number of the wall ahead, as a float.
    wall: f32,
    wall_step: f32,
    /// Distance between walls along the ray (negative when it runs down), and that to wall 0. Every wall's distance is
    /// made from these, not from the one before, so that no error piles up.
    per_wall: f32,
    at_zero: f32,
    /// Distance to the wall ahead.
    wall_at: f32,
}

impl Along {
    #[inline(always)]
    fn advance<const FUSED: bool>(&mut self, across: bool) {
        self.left -= i32::from(across);
        self.wall += if across { self.wall_step } else { 0.0 };
        self.wall_at = super::capsules::fused::<FUSED>(self.wall, self.per_wall, self.at_zero);
    }
}

/// Whether the segment comes within `radius` of the box; in doubt yes.
///
/// Projects back and forth between the two convex bodies; as soon as a plane between them leaves a gap wider than the
/// radius the answer is no.
fn near_box(start: Vec3, axis: Vec3, low: Vec3, high: Vec3, radius: f32) -> bool {
    let length2 = axis.length_squared();
    let mut on_segment = start + 0.5 * axis;
    for _ in 0..4 {
        let in_box = on_segment.clamp(low, high);
        let normal = on_segment - in_box;
        let apart2 = normal.length_squared();
        if apart2 <= radius * radius {
            return true;
        }
        let segment_from = normal.dot(start).min(normal.dot(start + axis));
        let box_to = normal.dot(Vec3::select(normal.cmpgt(Vec3::ZERO), high, low));
        let gap = segment_from - box_to;
        if gap > 0.0 && gap * gap > radius * radius * apart2 {
            return false;
        }
        let u = (in_box - start).dot(axis) / length2;
        on_segment = start
            + axis
                * if u.is_finite() {
                    u.clamp(0.0, 1.0)
                } else {
                    0.0
                };
    }
    true
}
