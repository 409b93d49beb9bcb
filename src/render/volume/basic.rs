//! The reference tracker: slow, short, and without a trick, so that the fast one can be held against it.
//!
//! Delta tracking (Woodcock et al. 1965): a flight makes collisions as in a medium of one density everywhere and all along it, and
//! keeps each with the probability that it is real; a connection multiplies the probabilities that all of its collisions are not
//! (ratio tracking, Novak et al. 2014). It reads the tile itself and asks the medium for every extinction. One configuration, one
//! path, one point of the lamp at a time; nothing weighs one strategy against another.
//!
//! Scores (docs/decisions/0008-media.md): `de/e` at a collision, `-n de / (M - n e)` at one that is not real.

use super::VolumeScene;
use crate::base::{Result, Watch};
use crate::fabric::VoxelTile;
use crate::math::{Frame, Random};
use crate::render::basic::{Graded, Plain, constant, estimate_with, scattered, times};
use crate::render::light::Lamp;
use crate::render::path::cosine_direction;
use crate::render::scene::Plate;
use crate::render::{Estimates, Request};
use crate::scatter::media::Medium;
use crate::scatter::{CHANNELS, MAX_ROWS};
use crate::session::Configuration;
use glam::DVec3;
use std::f64::consts::PI;

/// How far the majorant is above the largest extinction: scores of null collisions have no bounded variance where they meet.
const ABOVE: f64 = 1.3;

pub(super) fn estimate(
    scene: &VolumeScene,
    tile: &VoxelTile,
    medium: &dyn Medium,
    request: &Request<'_>,
    watch: &dyn Watch,
) -> Result<Estimates> {
    let densest = tile.density().iter().fold(0.0_f32, |a, b| a.max(*b));
    let tracer = |c: &Configuration, random| Tracer {
        scene,
        tile,
        medium,
        rows: request.parameters.infos().len(),
        majorant: ABOVE * scene.density * f64::from(densest) * medium.majorant(),
        lamp: Lamp::new(scene.options.light, c.light_in_sample()),
        random,
        found: constant([0.0; CHANNELS]),
    };
    estimate_with(tracer, request, watch)
}

struct Tracer<'a> {
    scene: &'a VolumeScene,
    tile: &'a VoxelTile,
    medium: &'a dyn Medium,
    rows: usize,
    /// 1/mm.
    majorant: f64,
    lamp: Lamp,
    random: Random,
    /// Normalized radiance the present path has found.
    found: Graded,
}

/// A ray of the path, and what the light that comes along it is multiplied with.
struct Ray {
    origin: DVec3,
    direction: DVec3,
    carried: Graded,
}

/// What there is at a point.
struct Matter {
    frame: Frame,
    /// Density n, 1/mm.
    density: f64,
}

/// One, with these derivatives.
fn of_scores(value: f64, scores: [f64; MAX_ROWS]) -> Graded {
    let mut graded = constant([value; CHANNELS]);
    for (row, score) in graded[1..].iter_mut().zip(scores) {
        *row = [score; CHANNELS];
    }
    graded
}

impl Plain for Tracer<'_> {
    fn path(&mut self, toward_camera: DVec3) -> Graded {
        let options = &self.scene.options;
        let through = options.start(&mut self.random);
        let back = options.view.toward_camera(through, toward_camera);
        let height = self.scene.grid.z_range()[1].max(0.0);
        let mut next = Some(Ray {
            origin: through + back * (height / back.z),
            direction: -back,
            carried: constant([1.0; CHANNELS]),
        });
        self.found = constant([0.0; CHANNELS]);
        while let Some(ray) = next {
            next = self.fly(ray);
        }
        self.found
    }
}

impl Tracer<'_> {
    /// To the next possible collision, or out of the cloth; none below and above it.
    fn step(&mut self, origin: DVec3, direction: DVec3) -> Option<DVec3> {
        let [low, high] = self.scene.grid.z_range();
        let flown = -self.random.uniform_open().ln() / self.majorant;
        let at = origin + direction * flown;
        (low..high).contains(&at.z).then_some(at)
    }

    fn matter(&self, at: DVec3) -> Option<Matter> {
        let shape = self.tile.shape();
        let side = self.tile.side();
        let around = |x: f64, n: usize| ((x / side).floor() as i64).rem_euclid(n as i64) as usize;
        let k = ((at.z - self.tile.bottom()) / side).floor().max(0.0) as usize;
        let cell = [
            around(at.x, shape[0]),
            around(at.y, shape[1]),
            k.min(shape[2] - 1),
        ];
        let place = self.tile.place(cell);
        let density = self.scene.density * f64::from(self.tile.density()[place]);
        (density > 0.0).then(|| Matter {
            frame: Frame::from_tangent(self.tile.direction(place)),
            density,
        })
    }

    fn fly(&mut self, mut ray: Ray) -> Option<Ray> {
        while let Some(at) = self.step(ray.origin, ray.direction) {
            ray.origin = at;
            let Some(matter) = self.matter(at) else {
                continue;
            };
            let wo = matter.frame.to_local(-ray.direction);
            let e = self.medium.extinction(wo);
            let slopes = self.medium.extinction_slopes(wo);
            let n = matter.density;
            let real = self.random.uniform() * self.majorant < n * e;
            let scores = match real {
                true => slopes.map(|s| s / e),
                false => slopes.map(|s| -n * s / (self.majorant - n * e)),
            };
            ray.carried = times(&ray.carried, &of_scores(1.0, scores), self.rows);
            if real {
                return self.scatter(&ray, &matter.frame, wo);
            }
        }
        match self.scene.options.plate {
            Plate::Diffuse(albedo) if ray.direction.z < 0.0 => self.plate(&ray, albedo),
            _ => None,
        }
    }

    fn scatter(&mut self, ray: &Ray, frame: &Frame, wo: DVec3) -> Option<Ray> {
        if let Some(light) = self.lamp.sample(ray.origin, &mut self.random) {
            let e = self.medium.evaluate(frame.to_local(light.direction), wo);
            let carried = times(&ray.carried, &scattered(&e, 1.0, 0), self.rows);
            self.connect(ray.origin, light.direction, &carried, light.pdf);
        }
        let outgoing = self.medium.outgoing(wo, ray.carried[0]);
        let s = self.medium.sample(&outgoing, &mut self.random);
        let e = self.medium.evaluate(s.wi, wo);
        let carried = times(&ray.carried, &scattered(&e, 1.0 / s.pdf, 0), self.rows);
        Some(Ray {
            origin: ray.origin,
            direction: frame.to_world(s.wi),
            carried: self.roulette(carried)?,
        })
    }

    /// Adds the light of the lamp that comes through.
    fn connect(&mut self, from: DVec3, direction: DVec3, carried: &Graded, pdf: f64) {
        if direction.z <= 0.0 && self.scene.options.plate != Plate::Open {
            return;
        }
        let mut at = from;
        let mut carried = *carried;
        while let Some(next) = self.step(at, direction) {
            at = next;
            if let Some(matter) = self.matter(at) {
                let w = matter.frame.to_local(direction);
                let part = matter.density / self.majorant;
                let left = 1.0 - part * self.medium.extinction(w);
                let slopes = self.medium.extinction_slopes(w).map(|s| -part * s);
                carried = times(&carried, &of_scores(left, slopes), self.rows);
            }
        }
        let light = self.lamp.normalized_radiance() / pdf;
        let terms = carried.as_flattened().iter();
        (self.found.as_flattened_mut().iter_mut().zip(terms))
            .for_each(|(sum, x)| *sum += x * light);
    }

    /// A Lambertian surface: reflectance `albedo / pi`.
    fn plate(&mut self, ray: &Ray, albedo: [f64; CHANNELS]) -> Option<Ray> {
        let fall = (self.scene.grid.z_range()[0] - ray.origin.z) / ray.direction.z;
        let origin = ray.origin + ray.direction * fall;
        let carried = times(&ray.carried, &constant(albedo), self.rows);
        if let Some(light) = self.lamp.sample(origin, &mut self.random) {
            let cosine = constant([light.direction.z / PI; CHANNELS]);
            let carried = times(&carried, &cosine, self.rows);
            self.connect(origin, light.direction, &carried, light.pdf);
        }
        let carried = self.roulette(carried)?;
        let (direction, _) = cosine_direction(&mut self.random);
        Some(Ray {
            origin,
            direction,
            carried,
        })
    }

    /// Ends the path with a probability that is not differentiated; it has a floor, as derivatives go on where the value has
    /// died.
    fn roulette(&mut self, carried: Graded) -> Option<Graded> {
        let survival = carried[0].into_iter().fold(0.05, f64::max).min(1.0);
        let survives = self.random.uniform() < survival;
        survives.then(|| carried.map(|row| row.map(|x| x / survival)))
    }
}
