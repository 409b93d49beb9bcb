//! Plane cuts through a volume.

use super::{Block, Volume};
use crate::base::{Error, Result, Watch};

/// One cut.
#[derive(Debug, Clone, PartialEq)]
pub struct Plane {
    /// The axis it is perpendicular to: 0, 1, 2 for x, y, z.
    pub axis: usize,
    /// Its voxel index along that axis.
    pub index: usize,
    /// Voxels across and up: (y, z), (x, z) or (x, y).
    pub size: [usize; 2],
    /// Values, first across, from below.
    pub values: Vec<f32>,
}

impl Plane {
    fn empty(volume: &Volume, axis: usize, index: usize) -> Self {
        let dims = volume.dims();
        let [across, up] = across(axis);
        let size = [dims[across], dims[up]];
        Self {
            axis,
            index,
            size,
            values: Vec::with_capacity(size[0] * size[1]),
        }
    }

    /// Takes the layers of a slab that is above all earlier ones.
    fn take(&mut self, slab: &Block) {
        let [nx, ny, nz] = slab.dims;
        for z in 0..nz {
            let layer = &slab.values[z * nx * ny..(z + 1) * nx * ny];
            match self.axis {
                0 => self
                    .values
                    .extend(layer.iter().skip(self.index).step_by(nx)),
                1 => self
                    .values
                    .extend(&layer[self.index * nx..(self.index + 1) * nx]),
                _ if slab.low[2] + z == self.index => self.values.extend(layer),
                _ => {}
            }
        }
    }
}

/// The two axes a cut shows, across and up.
fn across(axis: usize) -> [usize; 2] {
    [[1, 2], [0, 2], [0, 1]][axis]
}

/// Cuts a volume at the voxel indices `wanted` along x, y and z, and hands each cut over; reads the volume as often as
/// the cuts need to fit into `memory` bytes.
///
/// # Errors
/// An index is outside the volume, the file cannot be read, `each` fails, or the watch cancelled.
pub fn slices(
    volume: &Volume,
    wanted: &[Vec<usize>; 3],
    memory: usize,
    watch: &dyn Watch,
    mut each: impl FnMut(Plane) -> Result<()>,
) -> Result<()> {
    let dims = volume.dims();
    let mut waiting = Vec::new();
    for axis in [2, 1, 0] {
        for index in &wanted[axis] {
            if *index >= dims[axis] {
                return Err(Error::new(format!(
                    "slice {index} along axis {axis}: expected at most {}",
                    dims[axis] - 1
                )));
            }
            waiting.push(Plane::empty(volume, axis, *index));
        }
    }
    let bytes = |p: &Plane| 4 * p.size[0] * p.size[1];
    let largest = waiting.iter().map(bytes).max().unwrap_or(1);
    let at_once = (memory / 2 / largest).max(1);
    let total = waiting.len().div_ceil(at_once);
    for (pass, planes) in waiting.chunks_mut(at_once).enumerate() {
        let stage = format!("cutting, pass {} of {total}", pass + 1);
        volume.sweep(memory / 2, &stage, watch, |slab| {
            planes.iter_mut().for_each(|p| p.take(slab));
            Ok(())
        })?;
        for plane in planes {
            let values = std::mem::take(&mut plane.values);
            each(Plane {
                values,
                ..plane.clone()
            })?;
        }
    }
    Ok(())
}
