//! A periodic tile of voxels: density and fiber direction of each, as found in a scan or made from fibers.

mod nrrd;

use crate::base::{Error, Result};
use glam::DVec3;

/// Voxels on a rectangular tile that repeats forever in x and y; above and below it is air.
///
/// Voxel `[i, j, k]` spans x from `i * side` to `(i + 1) * side`, y alike, and z from `bottom + k * side`; its place in
/// lists is `i + nx * (j + ny * k)`.
#[derive(Debug, Clone, PartialEq)]
pub struct VoxelTile {
    shape: [usize; 3],
    side: f64,
    bottom: f64,
    density: Vec<f32>,
    direction: Vec<PackedDirection>,
}

impl VoxelTile {
    /// A tile of empty voxels, `shape` along x, y, z, with cubic voxels of this side, the lowest of which begin at z =
    /// `bottom`, millimeters.
    ///
    /// # Errors
    /// When a side is not positive and finite, or there are no voxels or too many to count.
    pub fn empty(shape: [usize; 3], side: f64, bottom: f64) -> Result<Self> {
        if !(side > 0.0 && side.is_finite() && bottom.is_finite()) {
            return Err(Error::new(format!(
                "voxels of {side} mm from z = {bottom} mm: expected a positive side and a finite height"
            )));
        }
        let count = Self::check_shape(shape)?;
        Ok(Self {
            shape,
            side,
            bottom,
            density: vec![0.0; count],
            direction: vec![PackedDirection::default(); count],
        })
    }

    /// The number of voxels.
    fn check_shape(shape: [usize; 3]) -> Result<usize> {
        let count = shape.iter().try_fold(1_usize, |n, s| n.checked_mul(*s));
        count
            .filter(|n| (1..1 << 40).contains(n))
            .ok_or_else(|| Error::new(format!("a volume of {shape:?} voxels has no meaning")))
    }

    /// A tile of these voxels, in the order of the lists.
    ///
    /// # Errors
    /// As [`VoxelTile::empty`]; when there are not as many voxels as the shape says, or a density is negative or not
    /// finite.
    pub fn from_parts(
        shape: [usize; 3],
        side: f64,
        bottom: f64,
        density: Vec<f32>,
        direction: Vec<PackedDirection>,
    ) -> Result<Self> {
        let mut tile = Self::empty([1; 3], side, bottom)?;
        let count = Self::check_shape(shape)?;
        if count != density.len() || count != direction.len() {
            return Err(Error::new(format!(
                "{} densities and {} directions for {shape:?} voxels",
                density.len(),
                direction.len()
            )));
        }
        if let Some(place) = density.iter().position(|d| !(d.is_finite() && *d >= 0.0)) {
            return Err(Error::new(format!(
                "voxel {place}: density {}: expected at least 0",
                density[place]
            )));
        }
        (tile.shape, tile.density, tile.direction) = (shape, density, direction);
        Ok(tile)
    }

    /// Voxels along x, y and z.
    pub fn shape(&self) -> [usize; 3] {
        self.shape
    }

    /// Side of a voxel, millimeters.
    pub fn side(&self) -> f64 {
        self.side
    }

    /// Where the lowest voxels begin, millimeters.
    pub fn bottom(&self) -> f64 {
        self.bottom
    }

    /// Size of the tile along x and y, millimeters.
    pub fn size(&self) -> [f64; 2] {
        [0, 1].map(|k| self.shape[k] as f64 * self.side)
    }

    /// Density of each voxel: 0 is empty, 1 solid fiber where the scan was evened out so. Not negative.
    pub fn density(&self) -> &[f32] {
        &self.density
    }

    /// Unit vector along the fiber in the voxel at this place of the list. Its sign means nothing; empty voxels have any.
    pub fn direction(&self, place: usize) -> DVec3 {
        self.direction[place].unpack()
    }

    /// Place of a voxel in the lists.
    pub fn place(&self, [i, j, k]: [usize; 3]) -> usize {
        i + self.shape[0] * (j + self.shape[1] * k)
    }

    /// Sets the voxel at this place of the list.
    ///
    /// # Errors
    /// When the density is negative or not finite, or the direction of a voxel that is not empty is not a unit vector.
    pub fn set(&mut self, place: usize, density: f32, direction: DVec3) -> Result<()> {
        let unit = (direction.length_squared() - 1.0).abs() < 1e-3;
        if !(density.is_finite() && density >= 0.0 && (unit || density == 0.0)) {
            return Err(Error::new(format!(
                "voxel {place}: density {density} and direction {direction}: expected a density of at least 0 and a unit vector"
            )));
        }
        self.density[place] = density;
        self.direction[place] = if unit {
            PackedDirection::pack(direction)
        } else {
            PackedDirection::default()
        };
        Ok(())
    }
}

/// A unit vector in four bytes by the octahedral map (Meyer et al. 2010), off by less than 0.004 degrees.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PackedDirection([i16; 2]);

impl PackedDirection {
    /// Packs a unit vector.
    pub fn pack(v: DVec3) -> Self {
        let v = v / (v.x.abs() + v.y.abs() + v.z.abs());
        let folded = |a: f64, b: f64| (1.0 - b.abs()).copysign(a);
        let (x, y) = match v.z < 0.0 {
            true => (folded(v.x, v.y), folded(v.y, v.x)),
            false => (v.x, v.y),
        };
        Self([x, y].map(|c| (c * f64::from(i16::MAX)).round() as i16))
    }

    /// The unit vector.
    pub fn unpack(self) -> DVec3 {
        let [x, y] = self.0.map(|c| f64::from(c) / f64::from(i16::MAX));
        let z = 1.0 - x.abs() - y.abs();
        let t = (-z).max(0.0);
        DVec3::new(x - t.copysign(x), y - t.copysign(y), z).normalize()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    #[test]
    fn directions_survive_packing() {
        // Sees an error above 0.004 degrees, and any fold gone wrong.
        let mut random = Random::keyed(&[17]);
        let axes = [DVec3::X, DVec3::Y, DVec3::Z].into_iter();
        let some =
            axes.flat_map(|a| [a, -a]).chain((0..20_000).map(|_| {
                DVec3::new(random.normal(), random.normal(), random.normal()).normalize()
            }));
        for v in some {
            let angle = PackedDirection::pack(v)
                .unpack()
                .angle_between(v)
                .to_degrees();
            assert!(angle < 0.004, "{v}: off by {angle} degrees");
        }
    }

    #[test]
    fn bad_voxels_are_refused() {
        assert!(VoxelTile::empty([0, 1, 1], 0.005, 0.0).is_err());
        assert!(VoxelTile::empty([2, 1, 1], f64::NAN, 0.0).is_err());
        let mut tile = VoxelTile::empty([2, 1, 1], 0.005, 0.0).unwrap();
        assert!(tile.set(0, 0.5, DVec3::X).is_ok());
        assert!(tile.set(0, 0.0, DVec3::ZERO).is_ok());
        assert!(tile.set(0, -0.5, DVec3::X).is_err());
        assert!(tile.set(0, f32::NAN, DVec3::X).is_err());
        assert!(tile.set(0, 0.5, DVec3::splat(0.9)).is_err());
    }
}
