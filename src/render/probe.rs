//! How fast rays are traced in a scene, apart from all shading.
//!
//! The rays are laid out before the clock starts: paths through the cloth that leave each fiber they meet in a uniformly
//! random direction, as bounces do. They are timed in path order (neighbors in the list are neighbors in the cloth) and
//! shuffled (every ray starts somewhere else), on the calling thread. Says nothing about shading or derivatives.

use super::geometry::{Ended, Geometry, Skip, Work};
use super::scene::FiberScene;
use crate::math::Random;
use glam::DVec3;
use std::f64::consts::TAU;

/// Rays per microsecond of one core's CPU time, and the work per ray.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct RaySpeed {
    /// Bounce rays traced, each several times.
    pub rays: usize,
    /// Nearest fiber, path order, million rays per CPU second.
    pub mrays_closest: f64,
    /// Any fiber, path order, million rays per CPU second.
    pub mrays_any: f64,
    /// Nearest fiber, shuffled, million rays per CPU second.
    pub mrays_closest_shuffled: f64,
    /// Any fiber, shuffled, million rays per CPU second.
    pub mrays_any_shuffled: f64,
    /// Boxes of the acceleration structure looked into, per ray to the nearest fiber.
    pub boxes_per_ray: f64,
    /// Capsules tested, per ray to the nearest fiber.
    pub tests_per_ray: f64,
    /// Groups of eight capsules tested at once, per ray to the nearest fiber.
    pub groups_per_ray: f64,
    /// Mean distance to the fiber entered, millimeters.
    pub mean_distance: f64,
    /// Fraction of the rays that leave the cloth.
    pub leaving: f64,
    /// Memory of the acceleration structure and the segments, bytes per segment of the tile.
    pub bytes_per_segment: f64,
}

#[derive(Clone, Copy)]
struct Bounce {
    origin: DVec3,
    direction: DVec3,
    skip: Skip,
}

/// Each list is traced this often; the fastest counts, because other work on the machine only ever slows it.
const REPEATS: usize = 5;

/// A path is given up after so many bounces.
const LONGEST: usize = 64;

impl FiberScene {
    /// Traces about `rays` (at least one) random bounce rays and tells how fast that went.
    pub fn ray_speed(&self, rays: usize, seed: u64) -> RaySpeed {
        let geometry = &self.geometry;
        let mut random = Random::keyed(&[seed]);
        let mut list = Vec::with_capacity(rays.max(1) + LONGEST);
        while list.len() < rays.max(1) {
            bounces(geometry, self.tile_size, &mut random, &mut list);
        }
        let (mut work, mut distance, mut hits) = (Work::default(), 0.0, 0);
        for ray in &list {
            let ended = geometry.closest_counted(ray.origin, ray.direction, &ray.skip, &mut work);
            if let Ended::Fiber(hit) = ended {
                distance += hit.distance;
                hits += 1;
            }
        }
        let (closest, any) = (closest_speed(geometry, &list), any_speed(geometry, &list));
        for i in (1..list.len()).rev() {
            list.swap(i, (random.uniform() * (i + 1) as f64) as usize);
        }
        let n = list.len() as f64;
        RaySpeed {
            rays: list.len(),
            mrays_closest: closest,
            mrays_any: any,
            mrays_closest_shuffled: closest_speed(geometry, &list),
            mrays_any_shuffled: any_speed(geometry, &list),
            boxes_per_ray: work.boxes as f64 / n,
            tests_per_ray: work.capsules as f64 / n,
            groups_per_ray: work.groups as f64 / n,
            mean_distance: distance / f64::from(hits.max(1)),
            leaving: 1.0 - f64::from(hits) / n,
            bytes_per_segment: geometry.bytes() as f64 / geometry.segments() as f64,
        }
    }
}

/// One path from above, its rays after the first appended to `list`.
fn bounces(geometry: &Geometry, size: [f64; 2], random: &mut Random, list: &mut Vec<Bounce>) {
    let top = geometry.z_range()[1];
    let mut direction = sphere(random);
    direction.z = -direction.z.abs();
    let start = DVec3::new(random.uniform() * size[0], random.uniform() * size[1], top);
    let mut ray = Bounce {
        origin: start,
        direction,
        skip: Skip::NOTHING,
    };
    for _ in 0..LONGEST {
        let Ended::Fiber(hit) = geometry.closest(ray.origin, ray.direction, &ray.skip) else {
            return;
        };
        ray = Bounce {
            origin: ray.origin + ray.direction * hit.distance,
            direction: sphere(random),
            skip: geometry.skip(hit.image),
        };
        list.push(ray);
    }
}

fn sphere(random: &mut Random) -> DVec3 {
    let z = 2.0 * random.uniform() - 1.0;
    let (sin, cos) = (TAU * random.uniform()).sin_cos();
    let r = (1.0 - z * z).sqrt();
    DVec3::new(r * cos, r * sin, z)
}

fn closest_speed(geometry: &Geometry, list: &[Bounce]) -> f64 {
    speed(list, |ray| {
        matches!(
            geometry.closest(ray.origin, ray.direction, &ray.skip),
            Ended::Fiber(_)
        )
    })
}

fn any_speed(geometry: &Geometry, list: &[Bounce]) -> f64 {
    speed(list, |ray| {
        !geometry.passes(ray.origin, ray.direction, &ray.skip)
    })
}

/// Million calls of `trace` per CPU second of this thread.
fn speed(list: &[Bounce], trace: impl Fn(&Bounce) -> bool) -> f64 {
    let once = || {
        let start = thread_seconds();
        let hits = list.iter().filter(|ray| trace(ray)).count();
        std::hint::black_box(hits);
        thread_seconds() - start
    };
    let best = (0..REPEATS).map(|_| once()).fold(f64::INFINITY, f64::min);
    1e-6 * list.len() as f64 / best.max(1e-9)
}

/// CPU time of this thread so far, seconds.
fn thread_seconds() -> f64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    t.tv_sec as f64 + t.tv_nsec as f64 * 1e-9
}
