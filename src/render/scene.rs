//! A woven or imported fiber tile as a scene: flat swatch, a plate below, square light, camera.

use super::estimate::{CameraRay, Clock, Followed, Rules};
use super::geometry::{Ended, Geometry, Skip};
use super::guide::{Guide, StateMap};
use super::image::pictures;
use super::light::{Lamp, LightShape};
use super::path::{Stage, Visitor};
use super::picture::{Picture, PictureRequest, Pictured, Region};
use super::summation::Rows;
use super::{Estimates, RecordOptions, RecordedPaths, Request, Scene, basic, estimate};
use crate::base::{Error, Result, Watch};
use crate::fabric::FiberTile;
use crate::math::Random;
use crate::scatter::{Model, Parametric, Scattering};
use crate::session::Configuration;
use glam::DVec3;
use std::collections::BTreeSet;

/// What lies under the cloth, at its lowest fiber.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Plate {
    /// Nothing: light may come from below, and leaves there.
    Open,
    /// A surface that absorbs everything.
    Black,
    /// A Lambertian surface of this albedo per channel.
    Diffuse([f64; 3]),
}

/// How the camera projects the sample square.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum View {
    /// All rays parallel to the configuration's camera direction.
    Orthographic,
    /// All rays through one point at this distance from the sample's center, millimeters.
    Pinhole {
        /// From the sample's center to the camera's entrance pupil, millimeters.
        distance: f64,
    },
}

impl View {
    /// Unit vector from a point of the sample toward the camera whose direction from the sample's center is `direction`.
    pub(super) fn toward_camera(self, point: DVec3, direction: DVec3) -> DVec3 {
        match self {
            Self::Orthographic => direction,
            Self::Pinhole { distance } => (direction * distance - point).normalize(),
        }
    }
}

/// How paths are followed and made estimates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Integrator {
    /// Made for speed.
    #[default]
    Fast,
    /// Made to be read: the same means and derivatives from plain path tracing, for tests.
    Basic,
}

/// What surrounds the cloth, and how it is rendered.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FiberSceneOptions {
    /// The light's size and distance.
    pub light: LightShape,
    /// Side of the square on the sample, centered, over which means are taken, millimeters.
    pub sample_square: f64,
    /// What lies under the cloth.
    pub plate: Plate,
    /// How the camera projects.
    pub view: View,
    /// How paths are followed.
    pub integrator: Integrator,
}

impl FiberSceneOptions {
    /// Refuses sizes and distances that are not positive, and albedos outside 0..=1.
    pub(super) fn check(&self) -> Result<()> {
        let mut lengths = vec![
            ("the light's side", self.light.side),
            ("the light's distance", self.light.distance),
            ("the sample square", self.sample_square),
        ];
        if let View::Pinhole { distance } = self.view {
            lengths.push(("the camera's distance", distance));
        }
        for (what, length) in lengths {
            if !(length > 0.0 && length.is_finite()) {
                return Err(Error::new(format!(
                    "{what} is {length} mm, expected a positive number"
                )));
            }
        }
        match self.plate {
            Plate::Diffuse(albedo) if !albedo.iter().all(|a| (0.0..=1.0).contains(a)) => Err(
                Error::new(format!("the plate's albedo is {albedo:?}, expected 0 to 1")),
            ),
            _ => Ok(()),
        }
    }

    pub(super) fn lamps(&self, configurations: impl Iterator<Item = Configuration>) -> Vec<Lamp> {
        configurations
            .map(|c| Lamp::new(self.light, c.light_in_sample()))
            .collect()
    }

    /// Refuses poses whose light or camera stands inside the cloth.
    pub(super) fn check_poses(
        &self,
        [bottom, top]: [f64; 2],
        configurations: &[Configuration],
    ) -> Result<()> {
        for c in configurations {
            let height = self.light.distance * c.light.theta.cos();
            if (bottom..=top).contains(&height) {
                return Err(Error::new(format!(
                    "configuration {}: the light's center is {height:.3} mm above the sample plane, in the cloth, which \
                     reaches from {bottom:.3} to {top:.3} mm",
                    c.id
                ))
                .with_hint("a larger light distance, or a light that is not in the sample plane"));
            }
        }
        let View::Pinhole { distance } = self.view else {
            return Ok(());
        };
        for c in configurations {
            let height = distance * c.camera.theta.cos();
            if height <= top {
                return Err(Error::new(format!(
                    "configuration {}: the camera is {height:.3} mm above the sample plane, in the cloth, which reaches \
                     {top:.3} mm",
                    c.id
                ))
                .with_hint("a larger camera distance"));
            }
        }
        Ok(())
    }

    /// A uniform point of the sample square on the plane z = 0.
    pub(super) fn start(&self, random: &mut Random) -> DVec3 {
        let side = self.sample_square;
        DVec3::new(
            (random.uniform() - 0.5) * side,
            (random.uniform() - 0.5) * side,
            0.0,
        )
    }
}

impl Default for FiberSceneOptions {
    /// The light of Khungurn 2015, its 1 cm crop and its black turntable, seen from afar.
    fn default() -> Self {
        Self {
            light: LightShape::default(),
            sample_square: 10.0,
            plate: Plate::Black,
            view: View::Orthographic,
            integrator: Integrator::Fast,
        }
    }
}

/// Where the guide's states are, from the fibers seen from above.
pub(super) fn surface_map(geometry: &Geometry, size: [f64; 2]) -> StateMap {
    let [low, high] = geometry.z_range();
    let above = high + (high - low);
    StateMap::new(size, [low, high], |x, y| {
        let from = DVec3::new(x, y, above);
        match geometry.closest(from, -DVec3::Z, &Skip::NOTHING) {
            Ended::Fiber(hit) => above - hit.distance,
            Ended::Up | Ended::Down => low,
        }
    })
}

/// Refuses a tile whose yarn systems are not those of `model`, where that has parameters for each.
fn check_systems(tile: &FiberTile, model: &dyn Model) -> Result<()> {
    let known = model.systems();
    if known.is_empty() {
        return Ok(());
    }
    let found: BTreeSet<usize> = tile.segments.iter().map(|s| s.yarn_system.into()).collect();
    if found.iter().copied().eq(0..known.len()) {
        return Ok(());
    }
    let expected = known.iter().enumerate();
    let expected: Vec<String> = expected.map(|(i, s)| format!("{i} ({s})")).collect();
    Err(Error::new(format!(
        "the fabric has fibers of the yarn systems {found:?}, model {} has parameters for {}",
        model.name(),
        expected.join(" and ")
    ))
    .with_hint("one set of parameters serves any fabric"))
}

/// Fibers on a periodic tile above a plate.
pub struct FiberScene {
    pub(super) geometry: Geometry,
    map: StateMap,
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
    /// When the tile has no segments, its size has no meaning, a segment is not finite, or an option is out of range; when
    /// the tile's yarn systems are not those that have parameters of their own in `model`.
    pub fn new(
        tile: &FiberTile,
        model: &'static dyn Model,
        options: FiberSceneOptions,
    ) -> Result<Self> {
        options.check()?;
        check_systems(tile, model)?;
        let geometry = Geometry::new(tile)?;
        Ok(Self {
            map: surface_map(&geometry, tile.size),
            geometry,
            model,
            options,
            tile_size: tile.size,
        })
    }

    /// Refuses poses whose light or camera stands inside the cloth.
    pub(super) fn check_poses(&self, configurations: &[Configuration]) -> Result<()> {
        let z_range = self.geometry.z_range();
        self.options.check_poses(z_range, configurations)
    }

    pub(super) fn stage<'a>(
        &'a self,
        sets: &'a [Box<dyn Scattering + 'a>],
        lamps: &'a [Lamp],
        worth: &'a [f64],
        guide: &'a Guide,
    ) -> Stage<'a> {
        Stage {
            geometry: &self.geometry,
            sets,
            lamps,
            worth,
            plate: self.options.plate,
            map: &self.map,
            guide,
        }
    }
}

/// A scene of fibers at fixed parameters.
pub(super) struct FiberPaths<'a> {
    pub(super) scene: &'a FiberScene,
    /// The scattering functions: of all fibers, or of each yarn system's.
    pub(super) sets: &'a [Box<dyn Scattering + 'a>],
}

impl Followed for FiberPaths<'_> {
    fn options(&self) -> &FiberSceneOptions {
        &self.scene.options
    }

    fn follow<V: Visitor>(
        &self,
        rules: &Rules<'_>,
        ray: CameraRay,
        random: &mut Random,
        v: &mut V,
    ) {
        let stage = (self.scene).stage(self.sets, rules.lamps, rules.worth, rules.guide);
        stage.follow(ray.through, ray.toward_camera, random, v);
    }
}

impl Scene for FiberScene {
    fn model(&self) -> &'static dyn Parametric {
        self.model
    }

    fn estimate(&self, request: &Request<'_>, watch: &dyn Watch) -> Result<Estimates> {
        request.check()?;
        self.check_poses(request.configurations)?;
        match self.options.integrator {
            Integrator::Fast => {
                let clock = Clock::now();
                let sets = self.model.prepare_each(request.parameters)?;
                let paths = FiberPaths {
                    scene: self,
                    sets: &sets,
                };
                estimate::estimate(&paths, Rows::of(self.model), &clock, request, watch)
            }
            Integrator::Basic => basic::estimate(self, request, watch),
        }
    }

    fn recall(&self, request: &Request<'_>, watch: &dyn Watch) -> Result<Option<RecordedPaths>> {
        if self.options.integrator != Integrator::Fast {
            return Ok(None);
        }
        let clock = Clock::now();
        let options = RecordOptions {
            defensive: 0.0,
            ..RecordOptions::default()
        };
        let recording = self.record(request, &options, watch)?;
        Ok(Some(RecordedPaths {
            paths: Box::new(recording),
            cpu_s: clock.cpu_s(),
            wall_s: clock.wall_s(),
        }))
    }
}

impl Pictured for FiberScene {
    fn sample_square(&self) -> Region {
        Region::square(self.options.sample_square)
    }

    fn tile(&self) -> Region {
        Region::from_origin(self.tile_size)
    }

    fn pictures(&self, request: &PictureRequest<'_>, watch: &dyn Watch) -> Result<Vec<Picture>> {
        request.check()?;
        self.check_poses(request.configurations)?;
        let sets = self.model.prepare_each(request.parameters)?;
        let paths = FiberPaths {
            scene: self,
            sets: &sets,
        };
        pictures(&paths, Rows::of(self.model), request, watch)
    }
}
