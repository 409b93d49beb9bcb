//! Gray voxels held in memory, read with any border around them.

use super::{Volume, nrrd};
use crate::base::{Context, Error, Result, Watch};
use crate::fabric::aside::write_aside;
use std::path::Path;

/// A volume of cubic gray voxels in memory; voxel `[i, j, k]` is at `i + nx * (j + ny * k)`.
#[derive(Debug, Clone, PartialEq)]
pub struct Gray {
    /// Voxels along x, y, z.
    pub shape: [usize; 3],
    /// Side of a voxel, millimeters.
    pub side: f64,
    /// Where the lowest voxels begin, millimeters.
    pub bottom: f64,
    /// The voxels.
    pub values: Vec<f32>,
    /// Whether the volume repeats in x and y; else, and always in z, what lies beyond is taken as the nearest voxel.
    pub periodic: bool,
}

impl Gray {
    /// Reads a whole volume, four bytes a voxel.
    ///
    /// # Errors
    /// Voxels are not cubes, the file cannot be read, or the watch cancelled.
    pub fn read(volume: &Volume, memory: usize, watch: &dyn Watch) -> Result<Self> {
        let (side, shape) = (volume.cubic_voxel_mm()?, volume.dims());
        let mut values = Vec::with_capacity(shape.iter().product());
        volume.sweep(memory, "reading", watch, |block| {
            values.extend_from_slice(&block.values);
            Ok(())
        })?;
        Ok(Self {
            shape,
            side,
            bottom: volume.origin_mm()[2] - 0.5 * side,
            values,
            periodic: false,
        })
    }

    /// Writes single precision NRRD, with the lower corner at x = y = 0.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write(&self, out: &Path) -> Result<()> {
        let first = 0.5 * self.side;
        let header = nrrd::written(self.shape, self.side, [first, first, self.bottom + first]);
        write_aside(out, |file| {
            let what = || format!("{} cannot be written", out.display());
            file.write_all(header.as_bytes()).context(what)?;
            for value in &self.values {
                file.write_all(&value.to_le_bytes()).context(what)?;
            }
            Ok(())
        })
    }

    /// Refuses volumes whose voxels are all alike or not numbers.
    pub(super) fn check(&self) -> Result<()> {
        let [nx, ny, _] = self.shape;
        if let Some(bad) = self.values.iter().position(|v| !v.is_finite()) {
            return Err(Error::new(format!(
                "voxel ({}, {}, {}) is {}: expected a number",
                bad % nx,
                bad / nx % ny,
                bad / (nx * ny),
                self.values[bad]
            )));
        }
        let first = self.values.first().copied().unwrap_or_default();
        if self.values.iter().all(|v| v.to_bits() == first.to_bits()) {
            return Err(Error::new(format!(
                "every voxel is {first}: the volume is empty"
            )));
        }
        Ok(())
    }

    /// The voxels of a box that may reach beyond the volume.
    pub(super) fn padded(&self, area: &Area, map: impl Fn(f32) -> f32) -> Vec<f32> {
        let place = |axis: usize, k: usize| {
            let n = self.shape[axis] as i64;
            let at = area.low[axis] + k as i64;
            let inside = if self.periodic && axis < 2 {
                at.rem_euclid(n)
            } else {
                at.clamp(0, n - 1)
            };
            inside as usize
        };
        let across: Vec<usize> = (0..area.dims[0]).map(|i| place(0, i)).collect();
        let mut found = Vec::with_capacity(area.dims.iter().product());
        for k in 0..area.dims[2] {
            for j in 0..area.dims[1] {
                let row = self.shape[0] * (place(1, j) + self.shape[1] * place(2, k));
                found.extend(across.iter().map(|i| map(self.values[row + i])));
            }
        }
        found
    }
}

/// A box of voxels that may reach beyond a volume.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Area {
    /// The first voxel.
    pub(super) low: [i64; 3],
    /// Voxels along x, y, z.
    pub(super) dims: [usize; 3],
}

impl Area {
    /// The box with a border around it.
    pub(super) fn grown(&self, by: usize) -> Self {
        Self {
            low: self.low.map(|v| v - by as i64),
            dims: self.dims.map(|n| n + 2 * by),
        }
    }

    /// Boxes of at most this many voxels along each axis that fill a volume.
    pub(super) fn filling(shape: [usize; 3], size: [usize; 3]) -> Vec<Self> {
        let starts = |axis: usize| (0..shape[axis]).step_by(size[axis]);
        let mut list = Vec::new();
        for z in starts(2) {
            for y in starts(1) {
                for x in starts(0) {
                    let low = [x, y, z];
                    list.push(Self {
                        low: low.map(|v| v as i64),
                        dims: [0, 1, 2].map(|k| size[k].min(shape[k] - low[k])),
                    });
                }
            }
        }
        list
    }

    /// Place in a list of all voxels of `shape` of the first voxel of each row, for a box inside the volume.
    pub(super) fn rows(&self, shape: [usize; 3]) -> impl Iterator<Item = usize> + use<> {
        let [x, y, z] = self.low.map(|v| v as usize);
        let [_, ny, nz] = self.dims;
        (0..nz).flat_map(move |k| (0..ny).map(move |j| x + shape[0] * (y + j + shape[1] * (z + k))))
    }
}
