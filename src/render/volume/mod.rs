//! A tile of voxels as a scene: a medium of fibers above a plate, lit and seen as cloth of fibers is.
//!
//! Flights walk from voxel to voxel, in each of which the extinction along the flight is known exactly (`grid.rs`); paths
//! are followed as through fibers (`path.rs`), by the same estimator. The reference (`basic.rs`) tracks with null collisions and
//! shares none of this.

mod basic;
mod extinction;
mod grid;
mod path;
mod probe;

use super::estimate::{self, Clock};
use super::guide::StateMap;
use super::image::pictures;
use super::picture::{Picture, PictureRequest, Pictured, Region};
use super::scene::{FiberSceneOptions, Integrator};
use super::summation::Rows;
use super::{Estimates, Request, Scene};
use crate::base::{Error, Result, Watch};
use crate::fabric::VoxelTile;
use crate::scatter::Parametric;
use crate::scatter::media::MediumModel;
use crate::session::Configuration;
use grid::Grid;
use path::VolumePaths;
pub use probe::FlightSpeed;

/// Density of a voxel of value 1, 1/mm, where nothing else is said: the density multiplier 4000 of Khungurn 2015 (sec. 7),
/// taken per centimeter (docs/decisions/0008-media.md).
pub const DEFAULT_DENSITY: f64 = 400.0;

/// Voxels of a medium on a periodic tile above a plate, which lies at the lowest layer that holds anything.
pub struct VolumeScene {
    grid: Grid,
    /// The tile itself, for the reference.
    tile: Option<VoxelTile>,
    map: StateMap,
    model: &'static dyn MediumModel,
    /// Density n of a voxel of value 1, 1/mm.
    density: f64,
    options: FiberSceneOptions,
    tile_size: [f64; 2],
}

impl std::fmt::Debug for VolumeScene {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("VolumeScene")
            .field("model", &self.model.name())
            .field("density", &self.density)
            .field("bytes", &self.grid.bytes())
            .finish_non_exhaustive()
    }
}

impl VolumeScene {
    /// The voxels of `tile` as a medium whose density n is `density` (1/mm) times theirs.
    ///
    /// # Errors
    /// When no voxel holds anything, or the density or an option is out of range.
    pub fn new(
        tile: VoxelTile,
        density: f64,
        model: &'static dyn MediumModel,
        options: FiberSceneOptions,
    ) -> Result<Self> {
        options.check()?;
        if !(density > 0.0 && density.is_finite()) {
            return Err(Error::new(format!(
                "the density is {density} per mm, expected a positive number"
            ))
            .with_hint("the published fits take 400 per mm times the value of a voxel"));
        }
        let grid = Grid::new(&tile)?;
        let map = StateMap::new(tile.size(), grid.z_range(), |x, y| grid.surface(x, y));
        let tile_size = tile.size();
        let keep = options.integrator == Integrator::Basic;
        Ok(Self {
            grid,
            tile: keep.then_some(tile),
            map,
            model,
            density,
            options,
            tile_size,
        })
    }

    /// Refuses poses whose light or camera stands inside the cloth.
    fn check_poses(&self, configurations: &[Configuration]) -> Result<()> {
        let z_range = self.grid.z_range();
        self.options.check_poses(z_range, configurations)
    }
}

impl Scene for VolumeScene {
    fn model(&self) -> &'static dyn Parametric {
        self.model
    }

    fn estimate(&self, request: &Request<'_>, watch: &dyn Watch) -> Result<Estimates> {
        request.check()?;
        self.check_poses(request.configurations)?;
        let clock = Clock::now();
        let medium = self.model.prepare(request.parameters)?;
        match &self.tile {
            Some(tile) => basic::estimate(self, tile, &*medium, request, watch),
            None => {
                let paths = VolumePaths::new(self, medium);
                estimate::estimate(&paths, Rows::of(self.model), &clock, request, watch)
            }
        }
    }
}

impl Pictured for VolumeScene {
    fn sample_square(&self) -> Region {
        Region::square(self.options.sample_square)
    }

    fn tile(&self) -> Region {
        Region::from_origin(self.tile_size)
    }

    /// By the fast tracker, whatever the integrator of means.
    fn pictures(&self, request: &PictureRequest<'_>, watch: &dyn Watch) -> Result<Vec<Picture>> {
        request.check()?;
        self.check_poses(request.configurations)?;
        let paths = VolumePaths::new(self, self.model.prepare(request.parameters)?);
        pictures(&paths, Rows::of(self.model), request, watch)
    }
}
