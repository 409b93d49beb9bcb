//! New voxels from old ones: trilinear interpolation, a block at a time.

use super::align::{Map, corners};
use super::equalize::Levels;
use super::{Block, Volume, check_going_on};
use crate::base::{Error, Result, Watch};
use glam::DVec3;
use rayon::prelude::*;

/// A grid of cubic voxels in the prepared volume.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Grid {
    pub(super) dims: [usize; 3],
    pub(super) voxel: f64,
    /// Lower corner, millimeters.
    pub(super) low: DVec3,
}

impl Grid {
    fn center(&self, index: [usize; 3]) -> DVec3 {
        let offset = index.map(|i| (i as f64 + 0.5) * self.voxel);
        self.low + DVec3::from_array(offset)
    }
}

/// Everything that makes a new value.
pub(super) struct Resampling<'a> {
    pub(super) volume: &'a Volume,
    pub(super) map: &'a Map,
    pub(super) grid: Grid,
    pub(super) levels: Option<&'a Levels>,
    /// The value outside the scan.
    pub(super) outside: f32,
    /// Bytes for blocks of the scan and of the result.
    pub(super) memory: usize,
    lifts: Vec<f64>,
}

/// A box of the result.
#[derive(Clone, Copy)]
struct Part {
    low: [usize; 3],
    high: [usize; 3],
}

impl<'a> Resampling<'a> {
    pub(super) fn new(
        volume: &'a Volume,
        map: &'a Map,
        grid: Grid,
        levels: Option<&'a Levels>,
        outside: f32,
        memory: usize,
    ) -> Self {
        let [nx, ny, _] = grid.dims;
        let lift = |i: usize| {
            let q = grid.center([i % nx, i / nx, 0]);
            map.lift(q.x, q.y)
        };
        Self {
            volume,
            map,
            grid,
            levels,
            outside,
            memory,
            lifts: (0..nx * ny).into_par_iter().map(lift).collect(),
        }
    }

    /// From the lowest to the highest point of the surface, millimeters.
    pub(super) fn lift_range(&self) -> f64 {
        let low = self.lifts.iter().copied().fold(f64::INFINITY, f64::min);
        let high = self.lifts.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        high - low
    }

    /// All layers from below, a few at a time, each with the number of its voxels that lie outside the scan.
    pub(super) fn sweep(
        &self,
        watch: &dyn Watch,
        mut each: impl FnMut(&[f32], u64) -> Result<()>,
    ) -> Result<()> {
        let [nx, ny, nz] = self.grid.dims;
        let layers = (self.memory / 4 / (4 * nx * ny)).clamp(1, nz);
        let mut out = vec![0.0; nx * ny * layers];
        for z in (0..nz).step_by(layers) {
            let end = (z + layers).min(nz);
            let slab = &mut out[..nx * ny * (end - z)];
            let part = Part {
                low: [0, 0, z],
                high: [nx, ny, end],
            };
            let outside = self.fill(part, z, slab, watch)?;
            each(slab, outside)?;
            watch.progress("resampling", end as u64, nz as u64);
        }
        Ok(())
    }

    /// Fills a part of the slab that begins at `z`; halves it as long as what it needs of the scan does not fit.
    fn fill(&self, part: Part, z: usize, slab: &mut [f32], watch: &dyn Watch) -> Result<u64> {
        check_going_on(watch)?;
        let needed = self.needed(part);
        let sides = [0, 1, 2].map(|k| part.high[k] - part.low[k]);
        let longest = (0..3).max_by_key(|k| sides[*k]).unwrap_or(0);
        if let Some((low, high)) = needed {
            let voxels: usize = (0..3).map(|k| high[k] - low[k]).product();
            let bytes = voxels * (self.volume.held_bytes());
            if bytes > self.memory * 3 / 4 && sides[longest] > 1 {
                let middle = part.low[longest] + sides[longest] / 2;
                let (mut first, mut second) = (part, part);
                first.high[longest] = middle;
                second.low[longest] = middle;
                return Ok(self.fill(first, z, slab, watch)? + self.fill(second, z, slab, watch)?);
            }
        }
        let block = needed
            .map(|(low, high)| self.volume.read(low, high))
            .transpose()?;
        let [nx, ny, _] = self.grid.dims;
        let counts = slab.par_chunks_mut(nx).enumerate().map(|(row, values)| {
            let (y, layer) = (row % ny, z + row / ny);
            let mine = (part.low[1]..part.high[1]).contains(&y)
                && (part.low[2]..part.high[2]).contains(&layer);
            let mut outside = 0;
            if mine {
                for (x, value) in values
                    .iter_mut()
                    .enumerate()
                    .take(part.high[0])
                    .skip(part.low[0])
                {
                    let found = block.as_ref().and_then(|b| self.value(b, [x, y, layer]));
                    outside += u64::from(found.is_none());
                    *value = found.unwrap_or(self.outside);
                }
            }
            outside
        });
        Ok(counts.sum())
    }

    /// The box of the scan that a part is interpolated from; `None` when it lies outside.
    fn needed(&self, part: Part) -> Option<([usize; 3], [usize; 3])> {
        let nx = self.grid.dims[0];
        let rows = (part.low[1]..part.high[1])
            .flat_map(|y| &self.lifts[y * nx + part.low[0]..y * nx + part.high[0]]);
        let (least, most) = rows.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| {
            (a.min(*v), b.max(*v))
        });
        let first = self.grid.center(part.low) + DVec3::Z * least;
        let last = self.grid.center(part.high.map(|h| h - 1)) + DVec3::Z * most;
        let placed = corners(first, last).map(|q| self.index(self.map.in_scan(q, 0.0)));
        let low = placed.iter().fold(DVec3::INFINITY, |a, b| a.min(*b));
        let high = placed.iter().fold(DVec3::NEG_INFINITY, |a, b| a.max(*b));
        let dims = self.volume.dims();
        let mut found = ([0; 3], [0; 3]);
        for k in 0..3 {
            let n = dims[k] as f64;
            if !(high[k] >= -0.501 && low[k] <= n - 0.499) {
                return None;
            }
            // A voxel more on either side covers rounding.
            found.0[k] = (low[k].floor() - 1.0).clamp(0.0, n - 1.0) as usize;
            found.1[k] = ((high[k].floor() + 3.0).clamp(1.0, n)) as usize;
        }
        Some(found)
    }

    /// A place in the scan in voxels, 0 the center of the first.
    fn index(&self, place: DVec3) -> DVec3 {
        place / DVec3::from_array(self.volume.voxel_mm()) - 0.5
    }

    /// The new value, or `None` outside the scan. Within half a voxel of the scan's faces the outermost voxel goes on.
    fn value(&self, block: &Block, at: [usize; 3]) -> Option<f32> {
        let lift = self.lifts[at[1] * self.grid.dims[0] + at[0]];
        let place = self.map.in_scan(self.grid.center(at), lift);
        let index = self.index(place);
        let dims = self.volume.dims();
        let mut cell = [0; 3];
        let mut weight = [0.0; 3];
        let mut step = [0; 3];
        for k in 0..3 {
            let last = (dims[k] - 1) as f64;
            // 1e-9: a center that lies on a face but for rounding is inside.
            if !(-0.5 - 1e-9..=last + 0.5 + 1e-9).contains(&index[k]) {
                return None;
            }
            let i = nearly_whole(index[k].clamp(0.0, last));
            let below = i.floor();
            cell[k] = below as usize - block.low[k];
            weight[k] = i - below;
            step[k] = usize::from(weight[k] > 0.0);
        }
        let [bx, by, _] = block.dims;
        let at = |dx: usize, dy: usize, dz: usize| {
            f64::from(block.values[((cell[2] + dz) * by + cell[1] + dy) * bx + cell[0] + dx])
        };
        let mix = |a: f64, b: f64, w: f64| a + (b - a) * w;
        let row = |dy: usize, dz: usize| mix(at(0, dy, dz), at(step[0], dy, dz), weight[0]);
        let layer = |dz: usize| mix(row(0, dz), row(step[1], dz), weight[1]);
        let value = mix(layer(0), layer(step[2]), weight[2]);
        Some(
            self.levels
                .map_or(value, |l| l.even(place.x, place.y, value)) as f32,
        )
    }
}

/// Removes rounding of places that were meant to be voxel centers, so that unchanged voxels stay bit for bit.
fn nearly_whole(index: f64) -> f64 {
    let whole = index.round();
    if (index - whole).abs() < 1e-7 {
        whole
    } else {
        index
    }
}

impl Grid {
    /// Checks that the grid has voxels and can be written.
    pub(super) fn checked(self) -> Result<Self> {
        super::header::byte_count(self.dims, super::SampleType::F32)
            .map_err(|e| Error::new("nothing is left of the volume, or too much").with_source(e))?;
        Ok(self)
    }
}
