//! What the tests and benches of volumes share: tiles of voxels, media, and the comparison of two lists of estimates.

#![allow(dead_code)]

use glam::DVec3;
use goniofit::base::Unwatched;
use goniofit::fabric::{FiberTile, VoxelTile};
use goniofit::math::Random;
use goniofit::render::{
    Effort, Estimate, FiberSceneOptions, Integrator, Request, Scene, VolumeScene,
};
use goniofit::scatter::Parameters;
use goniofit::scatter::media::{self, MediumModel};
use goniofit::session::Configuration;

/// Voxels of random density and direction, three fifths of them empty; no side is a multiple of a brick's.
pub(crate) fn random_voxels() -> VoxelTile {
    let mut random = Random::keyed(&[91]);
    let mut tile = VoxelTile::empty([13, 11, 9], 0.02, -0.03).unwrap();
    for place in 0..tile.density().len() {
        let d = DVec3::new(random.normal(), random.normal(), random.normal()).normalize();
        if random.uniform() > 0.6 {
            let density = 0.2 + 0.8 * random.uniform();
            tile.set(place, density as f32, d).unwrap();
        }
    }
    tile
}

/// A slab of one density and direction, from z = 0 up.
pub(crate) fn slab(layers: usize, side: f64, density: f32, direction: DVec3) -> VoxelTile {
    let mut tile = VoxelTile::empty([3, 5, layers], side, 0.0).unwrap();
    for place in 0..tile.density().len() {
        tile.set(place, density, direction).unwrap();
    }
    tile
}

/// The fibers of a tile as voxels about `side` wide: density is the part of the voxel's volume that is fiber, from 4^3
/// points in each; the direction is that of the fiber nearest to its middle.
pub(crate) fn voxelized(fibers: &FiberTile, side: f64) -> VoxelTile {
    let reach = |pick: fn(f64, f64) -> f64, start: f64, sign: f64| {
        let ends = fibers
            .segments
            .iter()
            .flat_map(|s| [s.start.z + sign * s.radius, s.end.z + sign * s.radius]);
        ends.fold(start, pick)
    };
    let low = reach(f64::min, f64::INFINITY, -1.0);
    let high = reach(f64::max, f64::NEG_INFINITY, 1.0);
    let nx = (fibers.size[0] / side).round().max(1.0);
    let side = fibers.size[0] / nx;
    let ny = (fibers.size[1] / side).round();
    assert!(
        (ny * side / fibers.size[1] - 1.0).abs() < 1e-9,
        "voxels would not be cubes"
    );
    let shape = [
        nx as usize,
        ny as usize,
        ((high - low) / side).ceil() as usize,
    ];
    let mut tile = VoxelTile::empty(shape, side, low).unwrap();
    let mut found = vec![(0_u64, f64::INFINITY, DVec3::X); tile.density().len()];
    for s in &fibers.segments {
        let axis = s.end - s.start;
        let range = [0, 1, 2].map(|a| {
            let base = if a == 2 { low } else { 0.0 };
            let [p, q] = [s.start[a], s.end[a]].map(|x| (x - base) / side);
            let r = s.radius / side;
            (p.min(q) - r).floor() as i64..=(p.max(q) + r).floor() as i64
        });
        for k in range[2].clone() {
            if !(0..shape[2] as i64).contains(&k) {
                continue;
            }
            for j in range[1].clone() {
                for i in range[0].clone() {
                    let corner = DVec3::new(i as f64, j as f64, k as f64);
                    let distance = |inside: DVec3| {
                        let p = (corner + inside) * side + DVec3::new(0.0, 0.0, low) - s.start;
                        let along = (p.dot(axis) / axis.length_squared()).clamp(0.0, 1.0);
                        (p - axis * along).length()
                    };
                    let mut bits = 0_u64;
                    for point in 0..64_u32 {
                        let at = [point % 4, point / 4 % 4, point / 16];
                        let [x, y, z] = at.map(|c| (f64::from(c) + 0.5) / 4.0);
                        bits |= u64::from(distance(DVec3::new(x, y, z)) < s.radius) << point;
                    }
                    if bits == 0 {
                        continue;
                    }
                    let cell = [
                        i.rem_euclid(shape[0] as i64) as usize,
                        j.rem_euclid(shape[1] as i64) as usize,
                        k as usize,
                    ];
                    let mine = &mut found[tile.place(cell)];
                    mine.0 |= bits;
                    let middle = distance(DVec3::splat(0.5));
                    if middle < mine.1 {
                        (mine.1, mine.2) = (middle, axis.normalize());
                    }
                }
            }
        }
    }
    for (place, (bits, _, direction)) in found.into_iter().enumerate() {
        tile.set(place, bits.count_ones() as f32 / 64.0, direction)
            .unwrap();
    }
    tile
}

/// Parameters of a medium as in a parameter file.
pub(crate) fn medium(name: &str, file: &str) -> (&'static dyn MediumModel, Parameters) {
    let model = media::model(name).unwrap();
    let object = serde_json::from_str(file).unwrap();
    (model, Parameters::from_json(model, &object).unwrap())
}

/// Bright, wide flakes whose density is a parameter.
pub(crate) fn wide_flakes() -> (&'static dyn MediumModel, Parameters) {
    let file = r#"{"albedo": [0.9, 0.6, 0.2], "gamma": 0.3, "density_scale": 1.2}"#;
    medium("microflake-density", file)
}

/// Thin flakes.
pub(crate) fn thin_flakes() -> (&'static dyn MediumModel, Parameters) {
    medium(
        "microflake",
        r#"{"albedo": [0.95, 0.7, 0.3], "gamma": 0.05}"#,
    )
}

/// Wide lobes, different in each channel, and the density.
pub(crate) fn soft_volume() -> (&'static dyn MediumModel, Parameters) {
    let file = r#"{"c_r": [0.1, 0.3, 0.05], "c_tt": [0.85, 0.6, 0.9], "beta_r_deg": 8.0, "beta_tt_deg": 25.0,
                   "gamma_tt_deg": 30.0, "albedo": [0.95, 0.8, 0.5], "density_scale": 0.8}"#;
    medium("khungurn-volume-density", file)
}

/// A narrow reflection: Silk's widths.
pub(crate) fn silk_volume() -> (&'static dyn MediumModel, Parameters) {
    let file = r#"{"c_r": [0.745, 0.008, 0.07], "c_tt": [0.62, 0.553, 0.562], "beta_r_deg": 1.0, "beta_tt_deg": 10.0,
                   "gamma_tt_deg": 19.823, "albedo": [0.9, 0.8, 0.6]}"#;
    medium("khungurn-volume", file)
}

/// Voxels in their surroundings, at their parameters.
pub(crate) struct Volume<'a> {
    pub(crate) tile: &'a VoxelTile,
    pub(crate) density: f64,
    pub(crate) options: FiberSceneOptions,
    pub(crate) medium: (&'static dyn MediumModel, Parameters),
}

impl Volume<'_> {
    pub(crate) fn scene(&self, integrator: Integrator) -> VolumeScene {
        let options = FiberSceneOptions {
            integrator,
            ..self.options
        };
        VolumeScene::new(self.tile.clone(), self.density, self.medium.0, options).unwrap()
    }

    pub(crate) fn render(
        &self,
        integrator: Integrator,
        configurations: &[Configuration],
        effort: Effort,
        seed: u64,
    ) -> Vec<Estimate> {
        let request = Request {
            configurations,
            parameters: &self.medium.1,
            effort,
            seed,
            stream: 0,
        };
        let estimates = self.scene(integrator).estimate(&request, &Unwatched);
        estimates.unwrap().configurations
    }
}

/// All numbers of an estimate with their standard errors, and what they are called.
pub(crate) fn numbers(e: &Estimate, model: &dyn MediumModel) -> Vec<(String, f64, f64)> {
    let rows = e.derivative.iter().zip(&e.derivative_se);
    let derivatives = model
        .parameters()
        .iter()
        .zip(rows)
        .flat_map(|(info, (d, se))| {
            (0..3).map(move |c| (format!("d/d{} {c}", info.name), d[c], se[c]))
        });
    (0..3)
        .map(|c| (format!("mean {c}"), e.mean[c], e.standard_error[c]))
        .chain(derivatives)
        .collect()
}
