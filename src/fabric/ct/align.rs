//! How prepared voxels lie in the scan: yarns along the axes, cloth in the plane, the plane made flat.

use super::Volume;
use super::coarse::Coarse;
use super::quadratic::{Fit, Quadratic};
use crate::base::Result;
use glam::{DMat3, DQuat, DVec3};

/// A point q of the prepared volume is, in the scan, `center + axes (q + (0, 0, p(q_x, q_y)))`. Lengths are millimeters;
/// the scan's are counted from its lower corner.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Map {
    pub(super) center: DVec3,
    pub(super) axes: DMat3,
    inverse: DMat3,
    /// Height of the cloth's middle, to be subtracted (Zhao 2011 section 5).
    pub(super) surface: Option<Quadratic>,
}

impl Map {
    /// Turns weft (radians counter-clockwise off x) and warp (off y) onto the axes; equal angles are a rotation, others
    /// also a shear. Lengths along both yarns stay.
    pub(super) fn of_yarns(volume: &Volume, weft: f64, warp: f64) -> Self {
        let along_weft = DVec3::new(weft.cos(), weft.sin(), 0.0);
        let along_warp = DVec3::new(-warp.sin(), warp.cos(), 0.0);
        let axes = DMat3::from_cols(along_weft, along_warp, DVec3::Z);
        Self {
            center: 0.5 * size(volume),
            axes,
            inverse: axes.inverse(),
            surface: None,
        }
    }

    /// Adds the rotation that brings the plane through the cloth's middle level.
    pub(super) fn leveled(
        mut self,
        weights: &dyn Fn(DVec3, f64) -> f64,
        coarse: &Coarse,
        half: [f64; 2],
    ) -> Result<Self> {
        let [a, b] = self.fit(weights, coarse, half)?.slopes();
        let normal = DVec3::new(-a, -b, 1.0).normalize();
        self.axes *= DMat3::from_quat(DQuat::from_rotation_arc(DVec3::Z, normal));
        self.inverse = self.axes.inverse();
        Ok(self)
    }

    /// Adds the quadratic through the cloth's middle.
    pub(super) fn flattened(
        mut self,
        weights: &dyn Fn(DVec3, f64) -> f64,
        coarse: &Coarse,
        half: [f64; 2],
    ) -> Result<Self> {
        self.surface = Some(self.fit(weights, coarse, half)?);
        Ok(self)
    }

    fn fit(
        &self,
        weight: &dyn Fn(DVec3, f64) -> f64,
        coarse: &Coarse,
        half: [f64; 2],
    ) -> Result<Quadratic> {
        let mut fit = Fit::over([0.0; 2], half);
        for (place, value) in coarse.points() {
            let w = weight(place, value);
            if w > 0.0 {
                let q = self.inverse * (place - self.center);
                fit.add(q.x, q.y, q.z, w);
            }
        }
        fit.solve("the surface of the cloth")
    }

    /// How far the cloth's middle lies above the plane z = 0.
    pub(super) fn lift(&self, x: f64, y: f64) -> f64 {
        self.surface.map_or(0.0, |p| p.at(x, y))
    }

    /// Where a point lies in the scan, given the lift there.
    pub(super) fn in_scan(&self, q: DVec3, lift: f64) -> DVec3 {
        self.center + self.axes * (q + DVec3::Z * lift)
    }

    /// Where a point of the scan comes to lie, but for flattening.
    pub(super) fn before_flattening(&self, place: DVec3) -> DVec3 {
        self.inverse * (place - self.center)
    }
}

/// Sides of a volume, millimeters.
pub(super) fn size(volume: &Volume) -> DVec3 {
    let (dims, voxel) = (volume.dims(), volume.voxel_mm());
    DVec3::from_array([0, 1, 2].map(|k| dims[k] as f64 * voxel[k]))
}

/// The corners of a box.
pub(super) fn corners(low: DVec3, high: DVec3) -> [DVec3; 8] {
    [0, 1, 2, 3, 4, 5, 6, 7].map(|k| {
        let pick = |bit: u8, a: f64, b: f64| if k & bit == 0 { a } else { b };
        DVec3::new(
            pick(1, low.x, high.x),
            pick(2, low.y, high.y),
            pick(4, low.z, high.z),
        )
    })
}
