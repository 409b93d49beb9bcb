//! A woven or imported fiber tile as a scene: flat swatch, black plate below, square light, orthographic camera.

use super::geometry::Geometry;
use super::light::{Lamp, LightShape};
use super::path::Stage;
use super::{Estimates, Request, Scene, estimate};
use crate::base::{Result, Watch};
use crate::fabric::FiberTile;
use crate::math::Random;
use crate::scatter::Model;
use crate::session::Configuration;
use glam::DVec3;

/// What surrounds the cloth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FiberSceneOptions {
    /// The light's size and distance.
    pub light: LightShape,
    /// Side of the square on the sample, centered, over which means are taken, millimeters.
    pub sample_square: f64,
}

impl Default for FiberSceneOptions {
    /// The light of Khungurn 2015 and its 1 cm crop.
    fn default() -> Self {
        Self {
            light: LightShape::default(),
            sample_square: 10.0,
        }
    }
}

/// Fibers on a periodic tile above a black plate.
pub struct FiberScene {
    pub(super) geometry: Geometry,
    pub(super) model: &'static dyn Model,
    pub(super) options: FiberSceneOptions,
    pub(super) tile_size: [f64; 2],
}

impl std::fmt::Debug for FiberScene {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("FiberScene")
            .field("model", &self.model.name())
            .field("tile_size", &self.tile_size)
            .finish()
    }
}

impl FiberScene {
    /// Builds the acceleration structure of `tile`.
    ///
    /// # Errors
    /// When the tile has no segments, its size has no meaning, or a segment is not finite.
    pub fn new(
        tile: &FiberTile,
        model: &'static dyn Model,
        options: FiberSceneOptions,
    ) -> Result<Self> {
        Ok(Self {
            geometry: Geometry::new(tile)?,
            model,
            options,
            tile_size: tile.size,
        })
    }

    pub(super) fn lamps(&self, configurations: impl Iterator<Item = Configuration>) -> Vec<Lamp> {
        configurations
            .map(|c| Lamp::new(self.options.light, c.light_in_sample()))
            .collect()
    }

    /// A uniform point of the sample square on the plane z = 0.
    pub(super) fn start(&self, random: &mut Random) -> DVec3 {
        let side = self.options.sample_square;
        DVec3::new(
            (random.uniform() - 0.5) * side,
            (random.uniform() - 0.5) * side,
            0.0,
        )
    }

    pub(super) fn stage<'a>(
        &'a self,
        scattering: &'a dyn crate::scatter::Scattering,
        lamps: &'a [Lamp],
        worth: &'a [f64],
    ) -> Stage<'a> {
        Stage {
            geometry: &self.geometry,
            scattering,
            lamps,
            worth,
        }
    }
}

impl Scene for FiberScene {
    fn model(&self) -> &'static dyn Model {
        self.model
    }

    fn estimate(&self, request: &Request<'_>, watch: &dyn Watch) -> Result<Estimates> {
        estimate::estimate(self, request, watch)
    }
}
