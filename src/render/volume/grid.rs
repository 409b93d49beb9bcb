//! Voxels as flights walk through them: exactly, voxel by voxel, past empty bricks in one step.
//!
//! A voxel is eight bytes. Bricks of 8 x 8 x 8 voxels that hold any density are stored, each in one piece; the others are
//! known to be empty. Coordinates of the walk count voxels from the tile's corner; x and y repeat.

mod null;

use super::extinction::{Extinction, Scores};
use crate::base::{Error, Result};
use crate::fabric::VoxelTile;
use crate::scatter::MAX_ROWS;
use glam::DVec3;

/// Voxels along the side of a brick, as a power of two.
const LOG: i32 = 3;
const SIDE: i32 = 1 << LOG;

/// No brick is stored here.
const EMPTY: u32 = u32::MAX;

/// A flight longer than this many voxels has left for good: only flights within 1e-6 of the horizontal come that far.
const FAR: f64 = 1e8;

/// Full scale of directions' components.
const UNIT: f32 = i16::MAX as f32;

/// Density in parts of the densest voxel's, and fiber direction, both to 2e-5.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C, align(8))]
struct Voxel {
    direction: [i16; 3],
    density: u16,
}

/// The voxels of a tile.
pub(super) struct Grid {
    shape: [i32; 3],
    side: f64,
    /// Height of the lowest layer that holds anything, millimeters.
    bottom: f64,
    bricks: [i32; 3],
    /// Where each brick's voxels begin, in bricks.
    places: Vec<u32>,
    voxels: Vec<Voxel>,
    /// The densest voxel's density.
    densest: f64,
}

/// Where a flight ended.
#[derive(Debug, Clone, Copy)]
pub(super) enum End {
    /// Above the cloth.
    Up,
    /// Below it.
    Down,
    /// In a voxel, after this many millimeters.
    Met { distance: f64, fiber: DVec3 },
}

/// A flight through the voxels.
#[derive(Debug, Clone, Copy)]
pub(super) struct Flight {
    pub(super) end: End,
    /// Optical depth it passed.
    pub(super) depth: f64,
    /// Derivatives of the logarithm of its density: `-int n de ds`, and `de/e` where it met something.
    pub(super) scores: Scores,
}

impl Grid {
    /// # Errors
    /// When all voxels are empty, or there are more than can be numbered.
    pub(super) fn new(tile: &VoxelTile) -> Result<Self> {
        let [nx, ny, nz] = tile.shape();
        let layer = |k: &usize| {
            tile.density()[k * nx * ny..][..nx * ny]
                .iter()
                .any(|d| *d > 0.0)
        };
        let (low, high) = match ((0..nz).find(layer), (0..nz).rev().find(layer)) {
            (Some(low), Some(high)) => (low, high + 1),
            _ => {
                return Err(Error::new(
                    "the volume holds nothing: all its voxels are empty",
                ));
            }
        };
        let counts = [nx, ny, high - low];
        if counts.iter().any(|n| *n > 1 << 24) {
            return Err(Error::new(format!(
                "a volume of {counts:?} voxels is too large"
            )));
        }
        let shape = counts.map(|n| n as i32);
        let bricks = shape.map(|n| (n + SIDE - 1) >> LOG);
        let densest = tile.density().iter().fold(0.0_f32, |a, b| a.max(*b));
        let mut grid = Self {
            shape,
            side: tile.side(),
            bottom: tile.bottom() + low as f64 * tile.side(),
            bricks,
            places: Vec::new(),
            voxels: Vec::new(),
            densest: f64::from(densest),
        };
        for bz in 0..bricks[2] {
            for by in 0..bricks[1] {
                for bx in 0..bricks[0] {
                    let place = grid.add_brick(tile, [bx, by, bz], low);
                    grid.places.push(place);
                }
            }
        }
        Ok(grid)
    }

    fn add_brick(&mut self, tile: &VoxelTile, brick: [i32; 3], low: usize) -> u32 {
        let mut voxels = [Voxel::default(); 1 << (3 * LOG)];
        let mut any = false;
        for (local, voxel) in (0_i32..).zip(&mut voxels) {
            let inside = [
                local & (SIDE - 1),
                (local >> LOG) & (SIDE - 1),
                local >> (2 * LOG),
            ];
            let cell: [i32; 3] = std::array::from_fn(|a| (brick[a] << LOG) + inside[a]);
            if (0..3).any(|a| cell[a] >= self.shape[a]) {
                continue;
            }
            let [i, j, k] = cell.map(|c| c as usize);
            let place = tile.place([i, j, k + low]);
            let part = f64::from(tile.density()[place]) / self.densest;
            voxel.density = (part * f64::from(u16::MAX)).round() as u16;
            voxel.direction = tile
                .direction(place)
                .to_array()
                .map(|c| (c * f64::from(UNIT)).round() as i16);
            any |= voxel.density > 0;
        }
        if !any {
            return EMPTY;
        }
        let place = (self.voxels.len() >> (3 * LOG)) as u32;
        self.voxels.extend_from_slice(&voxels);
        place
    }

    /// From the lowest to the highest layer that holds anything, millimeters.
    pub(super) fn z_range(&self) -> [f64; 2] {
        [
            self.bottom,
            self.bottom + f64::from(self.shape[2]) * self.side,
        ]
    }

    /// Memory of the voxels, bytes.
    pub(super) fn bytes(&self) -> usize {
        size_of_val(&*self.voxels) + size_of_val(&*self.places)
    }

    /// Height of the uppermost voxel that holds anything above a point of the tile; the bottom where there is none.
    pub(super) fn surface(&self, x: f64, y: f64) -> f64 {
        let cell = [x, y].map(|p| (p / self.side).floor() as i32);
        let [i, j] = [0, 1].map(|a| cell[a].rem_euclid(self.shape[a]));
        let full = |k: &i32| self.voxel([i, j, *k]).is_some_and(|v| v.density > 0);
        let top = (0..self.shape[2]).rev().find(full).map_or(0, |k| k + 1);
        self.bottom + f64::from(top) * self.side
    }

    fn voxel(&self, cell: [i32; 3]) -> Option<Voxel> {
        let place = self.places[self.brick(cell.map(|c| c >> LOG))];
        (place != EMPTY).then(|| self.voxels[local(cell) + ((place as usize) << (3 * LOG))])
    }

    fn brick(&self, [i, j, k]: [i32; 3]) -> usize {
        (i + self.bricks[0] * (j + self.bricks[1] * k)) as usize
    }

    /// Flies from a point until an optical depth of `budget` is passed, or out. `scale` is the density n of the voxels over
    /// theirs, 1/mm.
    pub(super) fn fly(
        &self,
        (extinction, scale): (&Extinction, f64),
        origin: DVec3,
        direction: DVec3,
        budget: f64,
    ) -> Flight {
        let mut walk = match Walk::new(self, origin, direction) {
            Ok(walk) => walk,
            Err(end) => return Flight::clear(end),
        };
        // Optical depth per part of the densest, per voxel's side.
        let unit = scale * self.densest * self.side / f64::from(u16::MAX);
        let mut flight = Flight::clear(End::Up);
        let mut slopes = [0.0; MAX_ROWS];
        flight.end = loop {
            let place = self.places[self.brick(walk.wrapped.map(|c| c >> LOG))];
            if place == EMPTY {
                if let Some(end) = walk.leave_brick(self) {
                    break end;
                }
                continue;
            }
            let voxels = &self.voxels[(place as usize) << (3 * LOG)..][..1 << (3 * LOG)];
            let ended = walk.through_brick(self, voxels, |voxel, length| {
                let sine = voxel.sine(walk_direction(direction));
                let density = unit * f64::from(voxel.density);
                let rate = density * extinction.at(sine);
                if flight.depth + rate * length < budget {
                    flight.depth += rate * length;
                    extinction.add_slopes(sine, -density * length, &mut slopes);
                    return None;
                }
                let flown = (budget - flight.depth) / rate;
                flight.depth = budget;
                extinction.add_slopes(sine, density * (1.0 / rate - flown), &mut slopes);
                Some(flown)
            });
            if let Some(end) = ended {
                break end;
            }
        };
        flight.scores = slopes;
        flight
    }
}

#[inline]
fn walk_direction(d: DVec3) -> [f32; 3] {
    d.to_array().map(|c| c as f32)
}

impl Flight {
    fn clear(end: End) -> Self {
        Self {
            end,
            depth: 0.0,
            scores: [0.0; MAX_ROWS],
        }
    }
}

impl Voxel {
    /// Sine of the angle between a unit vector and the fiber, from the cross product: exact where they are nearly parallel.
    #[inline]
    fn sine(self, [x, y, z]: [f32; 3]) -> f32 {
        let [u, v, w] = self.direction.map(|c| f32::from(c) * (1.0 / UNIT));
        let cross = [y * w - z * v, z * u - x * w, x * v - y * u];
        (cross[0] * cross[0] + cross[1] * cross[1] + cross[2] * cross[2]).sqrt()
    }

    fn fiber(self) -> DVec3 {
        DVec3::from_array(self.direction.map(f64::from)).normalize()
    }
}

/// Place of a voxel in its brick.
#[inline]
fn local([i, j, k]: [i32; 3]) -> usize {
    let part = SIDE - 1;
    ((i & part) | ((j & part) << LOG) | ((k & part) << (2 * LOG))) as usize
}

/// A ray on its way, lengths in voxels.
struct Walk {
    origin: [f64; 3],
    direction: [f64; 3],
    inverse: [f64; 3],
    step: [i32; 3],
    side: f64,
    /// How far it has come.
    t: f64,
    /// The voxel it is in, unwrapped, and in the tile.
    cell: [i32; 3],
    wrapped: [i32; 3],
}

impl Walk {
    /// A walk that begins where the ray is or enters the voxels' layers; or the end where it does not.
    fn new(grid: &Grid, origin: DVec3, direction: DVec3) -> std::result::Result<Self, End> {
        let mut p = origin / grid.side;
        p.z = (origin.z - grid.bottom) / grid.side;
        // Kept near the tile, so that cells can be counted in 32 bits.
        for a in 0..2 {
            p[a] -= (p[a] / f64::from(grid.shape[a])).floor() * f64::from(grid.shape[a]);
        }
        let top = f64::from(grid.shape[2]);
        if p.z >= top && direction.z >= 0.0 {
            return Err(End::Up);
        }
        if p.z <= 0.0 && direction.z <= 0.0 {
            return Err(End::Down);
        }
        let t = match () {
            () if p.z > top => (top - p.z) / direction.z,
            () if p.z < 0.0 => -p.z / direction.z,
            () => 0.0,
        };
        if t > FAR {
            return Err(if direction.z < 0.0 {
                End::Down
            } else {
                End::Up
            });
        }
        let at = p + direction * t;
        let mut cell = at.to_array().map(|x| x.floor() as i32);
        cell[2] = cell[2].clamp(0, grid.shape[2] - 1);
        let wrapped = [
            cell[0].rem_euclid(grid.shape[0]),
            cell[1].rem_euclid(grid.shape[1]),
            cell[2],
        ];
        let direction = direction.to_array();
        Ok(Self {
            origin: p.to_array(),
            direction,
            inverse: direction.map(|d| 1.0 / d),
            step: direction.map(|d| if d < 0.0 { -1 } else { 1 }),
            side: grid.side,
            t,
            cell,
            wrapped,
        })
    }

    /// By how much cells are counted on beyond the tile.
    fn turn(&self) -> [i32; 3] {
        std::array::from_fn(|a| self.cell[a] - self.wrapped[a])
    }

    /// Where the ray crosses into the cell whose near side along an axis is `plane`.
    #[inline]
    fn crossing(&self, axis: usize, plane: i32) -> f64 {
        if self.direction[axis] == 0.0 {
            return f64::INFINITY;
        }
        (f64::from(plane) - self.origin[axis]) * self.inverse[axis]
    }

    /// The cells of the present brick along an axis, unwrapped.
    #[inline]
    fn brick_cells(&self, grid: &Grid, axis: usize) -> [i32; 2] {
        let low = self.wrapped[axis] & !(SIDE - 1);
        let high = (low + SIDE).min(grid.shape[axis]);
        let turn = self.cell[axis] - self.wrapped[axis];
        [low + turn, high + turn]
    }

    /// Steps out of the present brick; tells the end when that is out of the volume.
    fn leave_brick(&mut self, grid: &Grid) -> Option<End> {
        let cells: [[i32; 2]; 3] = std::array::from_fn(|a| self.brick_cells(grid, a));
        let forward = |a: usize| usize::from(self.step[a] > 0);
        let exits: [f64; 3] = std::array::from_fn(|a| self.crossing(a, cells[a][forward(a)]));
        let axis = nearest(exits);
        self.t = self.t.max(exits[axis]);
        for a in 0..3 {
            let [low, high] = cells[a];
            let cell = if a == axis {
                if self.step[a] > 0 { high } else { low - 1 }
            } else {
                let x = self.origin[a] + self.direction[a] * self.t;
                (x.floor() as i32).clamp(low, high - 1)
            };
            self.wrapped[a] += cell - self.cell[a];
            self.cell[a] = cell;
        }
        self.settle(grid, axis)
    }

    /// Walks through the voxels of the present brick; `one` hears of each and how long the ray is in it, and tells how far
    /// into it the flight ends. Tells the end of the flight if it comes.
    #[inline]
    fn through_brick(
        &mut self,
        grid: &Grid,
        voxels: &[Voxel],
        mut one: impl FnMut(Voxel, f64) -> Option<f64>,
    ) -> Option<End> {
        let cells: [[i32; 2]; 3] = std::array::from_fn(|a| self.brick_cells(grid, a));
        let ahead = |a: usize, cell: i32| cell + i32::from(self.step[a] > 0);
        let mut next: [f64; 3] = std::array::from_fn(|a| self.crossing(a, ahead(a, self.cell[a])));
        loop {
            let axis = nearest(next);
            let length = (next[axis] - self.t).max(0.0);
            let voxel = voxels[local(self.wrapped)];
            if voxel.density > 0
                && let Some(flown) = one(voxel, length)
            {
                let distance = (self.t + flown.min(length)) * self.side;
                return Some(End::Met {
                    distance,
                    fiber: voxel.fiber(),
                });
            }
            self.t = self.t.max(next[axis]);
            self.cell[axis] += self.step[axis];
            self.wrapped[axis] += self.step[axis];
            if !(cells[axis][0]..cells[axis][1]).contains(&self.cell[axis]) {
                return self.settle(grid, axis);
            }
            let plane = self.cell[axis] + i32::from(self.step[axis] > 0);
            next[axis] = (f64::from(plane) - self.origin[axis]) * self.inverse[axis];
        }
    }

    /// After a step along `axis` into another brick: back into the tile, or out.
    #[inline]
    fn settle(&mut self, grid: &Grid, axis: usize) -> Option<End> {
        let n = grid.shape[axis];
        if (0..n).contains(&self.wrapped[axis]) && self.t <= FAR {
            return None;
        }
        if axis == 2 || self.t > FAR {
            return Some(if self.direction[2] < 0.0 {
                End::Down
            } else {
                End::Up
            });
        }
        self.wrapped[axis] = self.wrapped[axis].rem_euclid(n);
        None
    }
}

/// The axis of the smallest of three numbers.
#[inline]
fn nearest(t: [f64; 3]) -> usize {
    let low = usize::from(t[1] < t[0]);
    if t[2] < t[low] { 2 } else { low }
}
