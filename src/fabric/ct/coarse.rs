//! Some voxels of a volume, evenly spread, held in memory.

use super::Volume;
use crate::base::{Result, Watch};
use glam::DVec3;

/// At most this many.
const MOST: usize = 4_000_000;

/// Every n-th voxel along each axis.
pub(super) struct Coarse {
    stride: [usize; 3],
    dims: [usize; 3],
    voxel: [f64; 3],
    values: Vec<f32>,
}

impl Coarse {
    /// Reads all of a volume; keeps the whole of a small one.
    pub(super) fn of(volume: &Volume, memory: usize, watch: &dyn Watch) -> Result<Self> {
        let (dims, mut stride) = (volume.dims(), [1; 3]);
        let kept = |stride: [usize; 3]| [0, 1, 2].map(|k| dims[k].div_ceil(stride[k]));
        while kept(stride).iter().product::<usize>() > MOST {
            let counts = kept(stride);
            let longest = (0..3).max_by_key(|k| counts[*k]).unwrap_or(0);
            stride[longest] += 1;
        }
        let mut values = Vec::with_capacity(kept(stride).iter().product());
        volume.sweep(memory, "sampling", watch, |block| {
            let [nx, ny, nz] = block.dims;
            for z in (0..nz).filter(|z| (block.low[2] + z) % stride[2] == 0) {
                for y in (0..ny).step_by(stride[1]) {
                    let row = (z * ny + y) * nx;
                    values.extend(block.values[row..row + nx].iter().step_by(stride[0]));
                }
            }
            Ok(())
        })?;
        Ok(Self {
            stride,
            dims: kept(stride),
            voxel: volume.voxel_mm(),
            values,
        })
    }

    /// Values with their places from the lower corner of the volume, millimeters.
    pub(super) fn points(&self) -> impl Iterator<Item = (DVec3, f64)> + '_ {
        let [nx, ny, _] = self.dims;
        self.values.iter().enumerate().map(move |(i, value)| {
            let index = [i % nx, i / nx % ny, i / (nx * ny)];
            let place =
                [0, 1, 2].map(|k| ((index[k] * self.stride[k]) as f64 + 0.5) * self.voxel[k]);
            (DVec3::from_array(place), f64::from(*value))
        })
    }

    /// Half the way between neighbors along each axis, millimeters.
    pub(super) fn reach(&self) -> f64 {
        let along = (0..3).map(|k| self.stride[k] as f64 * self.voxel[k]);
        along.fold(0.0, f64::max)
    }
}
