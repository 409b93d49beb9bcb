//! Fibers as capsules on a tile that repeats forever in x and y, in an acceleration structure.
//!
//! Every capsule that reaches into the tile's cell, from whichever periodic copy, is listed in one grid of boxes; a ray
//! walks from cell to cell and only hits inside the current cell count. Does not know how fibers scatter.
//!
//! The same ray gives the same hit, bit for bit, on every processor that fuses multiplication and addition (x86 since
//! about 2013, all 64-bit ARM); on others the last digits of f32 differ.

mod capsules;
mod cell;
mod grid;
#[cfg(test)]
mod peer;
mod processor;
#[cfg(test)]
mod tests;

use crate::base::Result;
use crate::fabric::{FiberTile, NO_SEGMENT, Segment};
use capsules::{LANES, NO_CAPSULE, Ray};
use cell::Cell;
use glam::{DVec3, Vec3};
use grid::{Grid, Meter};
use processor::{Processor, Task};

/// One periodic copy of a segment: which segment, moved by how many whole tiles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Image {
    pub(super) segment: u32,
    pub(super) cell: [i32; 2],
}

const NO_IMAGE: Image = Image {
    segment: NO_SEGMENT,
    cell: [0, 0],
};

/// The segments a ray that leaves a fiber must not see: the one it leaves and its two neighbors.
#[derive(Debug, Clone, Copy)]
pub(super) struct Skip([Image; 3]);

impl Skip {
    pub(super) const NOTHING: Self = Self([NO_IMAGE; 3]);

    #[cfg(test)]
    fn contains(&self, image: Image) -> bool {
        self.0.contains(&image)
    }
}

/// Where a ray enters a fiber.
#[derive(Debug, Clone, Copy)]
pub(super) struct Hit {
    /// Distance along the ray, millimeters.
    pub(super) distance: f64,
    pub(super) image: Image,
}

/// How a ray ended.
#[derive(Debug, Clone, Copy)]
pub(super) enum Ended {
    /// It enters a fiber.
    Fiber(Hit),
    /// It leaves the cloth upward.
    Up,
    /// It leaves the cloth downward.
    Down,
}

/// What rays cost, apart from time.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Work {
    /// Boxes of the grid looked into.
    pub(super) boxes: u64,
    /// Capsules tested.
    pub(super) capsules: u64,
    /// Groups of capsules tested at once.
    pub(super) groups: u64,
}

impl Meter for Work {
    fn looked(&mut self, capsules: usize) {
        self.boxes += 1;
        self.capsules += capsules as u64;
        self.groups += capsules.div_ceil(LANES) as u64;
    }
}

/// All fibers of a tile, ready for rays.
pub(super) struct Geometry {
    grid: Grid,
    /// Which copy each capsule of the grid is, the copies of one segment together.
    images: Vec<Image>,
    /// Where each segment's copies start in `images`, and the end of the last.
    first: Vec<u32>,
    segments: Vec<Segment>,
    /// Whole-tile step from a segment to its `previous` and its `next`.
    steps: Vec<[[i32; 2]; 2]>,
    size: [f64; 2],
    z_range: [f64; 2],
    processor: Processor,
}

/// Farthest a ray is followed inside the cloth, millimeters, and in sides of the tile: only a ray within 1e-5 of
/// horizontal can get there, and the real sample has ended long before.
const REACH: f64 = 1e4;
const REACH_TILES: f64 = 1e5;

/// Farthest cell, in tiles, where a ray may start; beyond (or not a number) it meets nothing.
const FARTHEST: f64 = 1e9;

impl Geometry {
    pub(super) fn new(tile: &FiberTile) -> Result<Self> {
        cell::check(tile)?;
        let Cell {
            capsules,
            images,
            first,
            z_range,
        } = Cell::new(tile);
        let [width, height] = tile.size;
        let low = Vec3::new(0.0, 0.0, z_range[0] as f32);
        let high = DVec3::new(width, height, z_range[1]).as_vec3();
        let steps = tile
            .segments
            .iter()
            .map(|s| cell::neighbor_steps(tile, s))
            .collect();
        Ok(Self {
            grid: Grid::new(capsules, low, high)?,
            images,
            first,
            segments: tile.segments.clone(),
            steps,
            size: tile.size,
            z_range,
            processor: Processor::detect(),
        })
    }

    /// Lowest and highest z of any fiber, millimeters.
    pub(super) fn z_range(&self) -> [f64; 2] {
        self.z_range
    }

    /// Start, end and radius of a copy.
    pub(super) fn placed(&self, image: Image) -> (DVec3, DVec3, f64) {
        let s = &self.segments[image.segment as usize];
        let offset = self.offset(image.cell);
        (s.start + offset, s.end + offset, s.radius)
    }

    /// The yarn system it belongs to.
    pub(super) fn system(&self, image: Image) -> usize {
        self.segments[image.segment as usize].yarn_system.into()
    }

    /// The copies that continue this one along its fiber, before and after.
    pub(super) fn neighbors(&self, image: Image) -> [Option<Image>; 2] {
        let Skip([_, before, after]) = self.skip(image);
        [before, after].map(|i| (i != NO_IMAGE).then_some(i))
    }

    /// What a ray that leaves this copy must not see.
    pub(super) fn skip(&self, image: Image) -> Skip {
        let s = &self.segments[image.segment as usize];
        let neighbor = |segment: u32, step: [i32; 2]| match segment {
            NO_SEGMENT => NO_IMAGE,
            _ => Image {
                segment,
                cell: [image.cell[0] + step[0], image.cell[1] + step[1]],
            },
        };
        let [before, after] = self.steps[image.segment as usize];
        Skip([image, neighbor(s.previous, before), neighbor(s.next, after)])
    }

    /// The first fiber a ray enters; `direction` is a unit vector.
    pub(super) fn closest(&self, origin: DVec3, direction: DVec3, skip: &Skip) -> Ended {
        self.processor.run(Closest {
            geometry: self,
            origin,
            direction,
            skip,
            meter: &mut (),
        })
    }

    /// [`Geometry::closest`], with its work added to `work`.
    pub(super) fn closest_counted(
        &self,
        origin: DVec3,
        direction: DVec3,
        skip: &Skip,
        work: &mut Work,
    ) -> Ended {
        self.processor.run(Closest {
            geometry: self,
            origin,
            direction,
            skip,
            meter: work,
        })
    }

    /// True when the ray leaves the cloth, up or down, without entering a fiber.
    pub(super) fn passes(&self, origin: DVec3, direction: DVec3, skip: &Skip) -> bool {
        self.processor.run(Passes {
            geometry: self,
            origin,
            direction,
            skip,
        })
    }

    /// Segments of the tile.
    pub(super) fn segments(&self) -> usize {
        self.segments.len()
    }

    /// Memory held, bytes.
    pub(super) fn bytes(&self) -> usize {
        self.grid.bytes()
            + size_of_val(&self.images[..])
            + size_of_val(&self.first[..])
            + size_of_val(&self.segments[..])
            + size_of_val(&self.steps[..])
    }

    /// The capsules of `cell` that are the images to skip.
    #[inline(always)]
    fn hidden(&self, skip: &Skip, cell: [i32; 2]) -> [u32; 3] {
        let mut hidden = [NO_CAPSULE; 3];
        for (hidden, image) in hidden.iter_mut().zip(&skip.0) {
            if image.segment == NO_SEGMENT {
                continue;
            }
            let local = [image.cell[0] - cell[0], image.cell[1] - cell[1]];
            let segment = image.segment as usize;
            for i in self.first[segment]..self.first[segment + 1] {
                if self.images[i as usize].cell == local {
                    *hidden = i;
                }
            }
        }
        hidden
    }

    fn offset(&self, cell: [i32; 2]) -> DVec3 {
        DVec3::new(
            f64::from(cell[0]) * self.size[0],
            f64::from(cell[1]) * self.size[1],
            0.0,
        )
    }
}

/// A ray on its way through the cells between the cloth's lowest and highest z.
///
/// A loop over [`Walk::step`], not a function that takes a closure: a closure would not be compiled for the caller's
/// instructions.
struct Walk<'a> {
    geometry: &'a Geometry,
    origin: DVec3,
    direction: DVec3,
    cell: [i32; 2],
    /// How far it has come, and where it leaves the slab.
    at: f64,
    end: f64,
}

/// The piece of a ray inside one cell.
struct Piece {
    /// In the cell's coordinates.
    ray: Ray,
    cell: [i32; 2],
    /// Where the piece begins on the whole ray.
    walked: f64,
}

impl<'a> Walk<'a> {
    #[inline(always)]
    fn new(geometry: &'a Geometry, origin: DVec3, direction: DVec3) -> Self {
        let mut walk = Self {
            geometry,
            origin,
            direction,
            cell: [0, 0],
            at: 0.0,
            end: REACH.min(REACH_TILES * geometry.size[0].min(geometry.size[1])),
        };
        let z = geometry.z_range;
        if direction.z != 0.0 {
            let (a, b) = (
                (z[0] - origin.z) / direction.z,
                (z[1] - origin.z) / direction.z,
            );
            walk.at = a.min(b).max(0.0);
            walk.end = a.max(b).min(walk.end);
        } else if !(z[0]..=z[1]).contains(&origin.z) {
            walk.end = 0.0;
        }
        let start = origin + direction * walk.at;
        let size = geometry.size;
        // Not true for numbers that are none.
        let near = start.x.abs() < FARTHEST * size[0] && start.y.abs() < FARTHEST * size[1];
        if near && start.z.is_finite() && direction.length_squared() < 4.0 {
            walk.cell = [
                (start.x / size[0]).floor() as i32,
                (start.y / size[1]).floor() as i32,
            ];
        } else {
            walk.end = 0.0;
        }
        walk
    }

    /// The piece in the present cell, if the ray has not left; goes on to the next cell.
    #[inline(always)]
    fn step(&mut self) -> Option<Piece> {
        if self.at >= self.end {
            return None;
        }
        let (o, d) = (self.origin, self.direction);
        let (tx, ty) = (self.wall(0, o.x, d.x), self.wall(1, o.y, d.y));
        let next = tx.min(ty).min(self.end).max(self.at);
        let local = o + d * self.at - self.geometry.offset(self.cell);
        let piece = Piece {
            ray: Ray {
                origin: local.as_vec3().to_array(),
                direction: d.as_vec3().to_array(),
                end: (next - self.at) as f32,
            },
            cell: self.cell,
            walked: self.at,
        };
        self.at = next;
        if tx <= ty {
            self.cell[0] += if d.x > 0.0 { 1 } else { -1 };
        } else {
            self.cell[1] += if d.y > 0.0 { 1 } else { -1 };
        }
        Some(piece)
    }

    /// Distance to the cell's wall ahead along one axis.
    #[inline(always)]
    fn wall(&self, axis: usize, o: f64, d: f64) -> f64 {
        let wall = f64::from(self.cell[axis] + i32::from(d > 0.0)) * self.geometry.size[axis];
        if d == 0.0 {
            f64::INFINITY
        } else {
            (wall - o) / d
        }
    }

    /// How the ray ends when it enters no fiber.
    #[inline(always)]
    fn ended(&self) -> Ended {
        if self.direction.z > 0.0 {
            Ended::Up
        } else {
            Ended::Down
        }
    }
}

/// The first fiber a ray enters.
struct Closest<'a, M> {
    geometry: &'a Geometry,
    origin: DVec3,
    direction: DVec3,
    skip: &'a Skip,
    meter: &'a mut M,
}

impl<M: Meter> Task for Closest<'_, M> {
    type Out = Ended;

    #[inline(always)]
    fn run<const FUSED: bool>(self) -> Ended {
        let geometry = self.geometry;
        let mut walk = Walk::new(geometry, self.origin, self.direction);
        while let Some(Piece { ray, cell, walked }) = walk.step() {
            let skip = geometry.hidden(self.skip, cell);
            let (t, capsule) = geometry.grid.trace::<FUSED, false>(&ray, skip, self.meter);
            if capsule != NO_CAPSULE {
                let local = geometry.images[capsule as usize];
                return Ended::Fiber(Hit {
                    distance: walked + f64::from(t),
                    image: Image {
                        segment: local.segment,
                        cell: [local.cell[0] + cell[0], local.cell[1] + cell[1]],
                    },
                });
            }
        }
        walk.ended()
    }
}

/// Whether a ray leaves the cloth without entering a fiber.
struct Passes<'a> {
    geometry: &'a Geometry,
    origin: DVec3,
    direction: DVec3,
    skip: &'a Skip,
}

impl Task for Passes<'_> {
    type Out = bool;

    #[inline(always)]
    fn run<const FUSED: bool>(self) -> bool {
        let geometry = self.geometry;
        let mut walk = Walk::new(geometry, self.origin, self.direction);
        while let Some(Piece { ray, cell, .. }) = walk.step() {
            let skip = geometry.hidden(self.skip, cell);
            let (_, capsule) = geometry.grid.trace::<FUSED, true>(&ray, skip, &mut ());
            if capsule != NO_CAPSULE {
                return false;
            }
        }
        true
    }
}
