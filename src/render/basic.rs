//! The reference integrator: slow, short, and without a trick, so that the fast one can be held against it.
//!
//! One configuration at a time, one camera path at a time. At every hit one uniform point of the lamp is asked for its
//! light, and one direction is drawn from the scattering function to go on. Nothing weighs one strategy against another, no
//! connection is left to chance, no two configurations share a path. It shares with the fast integrator the geometry, the
//! lamp and the model, and no line of how a path is followed.
//!
//! Where it is noisy: light is found by the lamp's point alone, so a lobe much narrower than the lamp is hit rarely.

use super::estimate::Clock;
use super::geometry::{Ended, Hit, Skip};
use super::light::Lamp;
use super::scene::{FiberScene, Plate};
use super::{Effort, Estimate, Estimates, MIN_PATHS, Request};
use crate::base::{Error, Result, Watch};
use crate::math::statistics::Running;
use crate::math::{Frame, Random};
use crate::scatter::{CHANNELS, Evaluation, MAX_DERIVATIVES, Passage, Scattering};
use crate::session::Configuration;
use glam::DVec3;
use rayon::prelude::*;
use std::f64::consts::{PI, TAU};
use std::sync::atomic::{AtomicU64, Ordering};

/// Row 0: a value per channel; the others: its derivatives by the model's rows, then zeros.
pub(super) type Graded<T = f64> = [[T; CHANNELS]; 1 + MAX_DERIVATIVES];

pub(super) fn constant(value: [f64; CHANNELS]) -> Graded {
    std::array::from_fn(|row| if row == 0 { value } else { [0.0; CHANNELS] })
}

/// What an event multiplies with, its derivatives by the rows from `first` on.
pub(super) fn scattered(e: &Evaluation, factor: f64, first: usize) -> Graded {
    let mut graded = constant(e.value.map(|x| x * factor));
    for (row, derivative) in graded[1 + first..].iter_mut().zip(e.derivative) {
        *row = derivative.map(|x| x * factor);
    }
    graded
}

/// The product rule: what Khungurn 2015 eq. 17 writes as a sum of scores, without dividing by a value that may be zero.
pub(super) fn times(a: &Graded, b: &Graded, rows: usize) -> Graded {
    let mut product = *a;
    for c in 0..CHANNELS {
        product[0][c] *= b[0][c];
        for row in 1..=rows {
            product[row][c] = a[row][c] * b[0][c] + a[0][c] * b[row][c];
        }
    }
    product
}

/// A ray of the path, and what the light that comes along it is multiplied with.
struct Ray {
    origin: DVec3,
    direction: DVec3,
    skip: Skip,
    carried: Graded,
}

struct Tracer<'a> {
    scene: &'a FiberScene,
    /// One for all fibers, or one for each yarn system.
    scattering: &'a [Box<dyn Scattering>],
    /// Rows of all of them.
    rows: usize,
    lamp: Lamp,
    random: Random,
    /// Normalized radiance the present path has found.
    found: Graded,
}

impl Plain for Tracer<'_> {
    /// The normalized radiance of a camera ray that meets the plane z = 0 in a uniform point of the sample square.
    fn path(&mut self, toward_camera: DVec3) -> Graded {
        let through = self.scene.options.start(&mut self.random);
        let back = (self.scene.options.view).toward_camera(through, toward_camera);
        let height = self.scene.geometry.z_range()[1].max(0.0);
        let mut next = Some(Ray {
            origin: through + back * (height / back.z),
            direction: -back,
            skip: Skip::NOTHING,
            carried: constant([1.0; CHANNELS]),
        });
        self.found = constant([0.0; CHANNELS]);
        while let Some(ray) = next {
            let geometry = &self.scene.geometry;
            let ended = match self.passage() {
                Passage::Across => geometry.closest(ray.origin, ray.direction, &ray.skip),
                Passage::Straight => {
                    geometry.closest_from_within(ray.origin, ray.direction, &ray.skip)
                }
            };
            next = match (ended, self.scene.options.plate) {
                (Ended::Fiber(hit), _) => self.fiber(&ray, hit),
                (Ended::Down, Plate::Diffuse(albedo)) if ray.direction.z < 0.0 => {
                    self.plate(&ray, albedo)
                }
                (Ended::Down | Ended::Up, _) => None,
            };
        }
        self.found
    }
}

impl Tracer<'_> {
    fn fiber(&mut self, ray: &Ray, hit: Hit) -> Option<Ray> {
        let (start, end, _) = self.scene.geometry.placed(hit.image);
        let skip = self.scene.geometry.skip(hit.image);
        let frame = Frame::from_tangent((end - start).normalize_or(DVec3::X));
        let wo = frame.to_local(-ray.direction);
        let at = frame.to_local(ray.origin + ray.direction * hit.distance - start);
        let h = (wo.z.atan2(wo.y) - at.z.atan2(at.y)).sin();
        let system = self.scene.geometry.system(hit.image);
        let system = system.min(self.scattering.len() - 1);
        let (scattering, first) = (
            &self.scattering[system],
            system * self.rows / self.scattering.len(),
        );
        let passage = self.passage();
        let exit = |w: DVec3| {
            let across = DVec3::new(0.0, w.y, w.z).normalize_or_zero();
            let ahead = at.dot(across);
            let moved = match passage {
                // Beside the axis as before, but ahead of it: where the fiber was met is forgotten.
                Passage::Across => at + across * (ahead.abs() - ahead),
                Passage::Straight => at,
            };
            start + frame.to_world(moved)
        };

        if let Some(light) = self.lamp.sample(start + frame.x * at.x, &mut self.random) {
            let wi = frame.to_local(light.direction);
            if self.sees_lamp(exit(wi), light.direction, &skip) {
                let e = scattering.evaluate(wi, wo, h);
                self.find(
                    &times(
                        &ray.carried,
                        &scattered(&e, wi.y.hypot(wi.z), first),
                        self.rows,
                    ),
                    light.pdf,
                );
            }
        }
        let outgoing = scattering.outgoing(wo, h, ray.carried[0]);
        let s = scattering.sample(&outgoing, &mut self.random)?;
        let e = scattering.evaluate(s.wi, wo, h);
        let factor = s.wi.y.hypot(s.wi.z) / s.pdf;
        let carried = self.roulette(times(
            &ray.carried,
            &scattered(&e, factor, first),
            self.rows,
        ))?;
        Some(Ray {
            origin: exit(s.wi),
            direction: frame.to_world(s.wi),
            skip,
            carried,
        })
    }

    /// A Lambertian surface: reflectance `albedo / pi`.
    fn plate(&mut self, ray: &Ray, albedo: [f64; CHANNELS]) -> Option<Ray> {
        let fall = (self.scene.geometry.z_range()[0] - ray.origin.z) / ray.direction.z;
        let (origin, skip) = (ray.origin + ray.direction * fall, Skip::NOTHING);
        let carried = times(&ray.carried, &constant(albedo), self.rows);
        if let Some(light) = self.lamp.sample(origin, &mut self.random)
            && self.sees_lamp(origin, light.direction, &skip)
        {
            let cosine = constant([light.direction.z / PI; CHANNELS]);
            self.find(&times(&carried, &cosine, self.rows), light.pdf);
        }
        let carried = self.roulette(carried)?;
        // Density cos / pi: a uniform point of the disk, lifted to the hemisphere (Malley).
        let (radius, turn) = (self.random.uniform().sqrt(), TAU * self.random.uniform());
        let direction = DVec3::new(
            radius * turn.cos(),
            radius * turn.sin(),
            (1.0 - radius * radius).sqrt(),
        );
        Some(Ray {
            origin,
            direction,
            skip,
            carried,
        })
    }

    /// The same for all fibers: they have one model.
    fn passage(&self) -> Passage {
        self.scattering[0].passage()
    }

    fn sees_lamp(&self, origin: DVec3, direction: DVec3, skip: &Skip) -> bool {
        let open = self.scene.options.plate == Plate::Open;
        let geometry = &self.scene.geometry;
        (open || direction.z > 0.0)
            && match self.passage() {
                Passage::Across => geometry.passes(origin, direction, skip),
                Passage::Straight => geometry.passes_from_within(origin, direction, skip),
            }
    }

    fn find(&mut self, carried: &Graded, pdf: f64) {
        let light = self.lamp.normalized_radiance() / pdf;
        let terms = carried.as_flattened().iter();
        (self.found.as_flattened_mut().iter_mut().zip(terms))
            .for_each(|(sum, x)| *sum += x * light);
    }

    /// Ends the path with a probability that is not differentiated. At a color of zero the derivative goes on where the value
    /// has died, so the probability to go on has a floor.
    fn roulette(&mut self, carried: Graded) -> Option<Graded> {
        let survival = carried[0].into_iter().fold(0.05, f64::max).min(1.0);
        let survives = self.random.uniform() < survival;
        survives.then(|| carried.map(|row| row.map(|x| x / survival)))
    }
}

/// Keeps the random streams apart from those of the fast integrator.
const BASIC: u64 = 0xba51c;
/// The round whose paths are kept; those before it are pilots.
const LAST: u64 = 6;
/// Paths of one task: fixed, so that the numbers do not depend on the threads.
const TASK_PATHS: u64 = 256;

/// See [`super::Scene::estimate`]. Every configuration gets paths of its own. For an accuracy all get equally many: pilots,
/// thrown away, grow until one is an eighth of the work it predicts. Standard errors are from batches of one path.
pub(super) fn estimate(
    scene: &FiberScene,
    request: &Request<'_>,
    watch: &dyn Watch,
) -> Result<Estimates> {
    let scattering = scene.model.prepare_each(request.parameters)?;
    let tracer = |c: &Configuration, random| Tracer {
        scene,
        scattering: &scattering,
        rows: request.parameters.infos().len(),
        lamp: Lamp::new(scene.options.light, c.light_in_sample()),
        random,
        found: constant([0.0; CHANNELS]),
    };
    estimate_with(tracer, request, watch)
}

/// Whoever follows plain paths for one configuration.
pub(super) trait Plain {
    /// The normalized radiance of one camera path, and its derivatives.
    fn path(&mut self, toward_camera: DVec3) -> Graded;
}

/// The estimates from the paths of whom `tracer` makes for a configuration and a stream of random numbers.
pub(super) fn estimate_with<T: Plain>(
    tracer: impl Fn(&Configuration, Random) -> T + Sync,
    request: &Request<'_>,
    watch: &dyn Watch,
) -> Result<Estimates> {
    let clock = Clock::now();
    let rows = request.parameters.infos().len();
    let all = request.configurations;
    let render = |round: u64, paths: &[u64]| {
        let one = |(index, c): (usize, &Configuration)| {
            let tracer = |task: u64| {
                let place = [request.stream, round, index as u64, task];
                let [stream, round, index, task] = place;
                let key = [BASIC, request.seed, stream, round, index, task];
                tracer(c, Random::keyed(&key))
            };
            let stage = format!("configuration {} of {}", index + 1, all.len());
            finished(
                c,
                &scatter(tracer, rows, c, paths[index], &stage, watch)?,
                request,
            )
        };
        let configurations = all.iter().enumerate().map(one).collect::<Result<_>>()?;
        let (wall_s, cpu_s) = (clock.wall_s(), clock.cpu_s());
        Ok::<_, Error>(Estimates {
            configurations,
            cpu_s,
            wall_s,
        })
    };
    let paths = match &request.effort {
        Effort::Paths(n) => vec![*n; all.len()],
        Effort::Total { paths, shares } => {
            let per_share = *paths as f64 / shares.iter().sum::<f64>();
            shares
                .iter()
                .map(|s| ((per_share * s).round() as u64).max(MIN_PATHS))
                .collect()
        }
        Effort::Accuracy(target) => {
            let mut n = 8 * 1024_u64;
            for round in 0..LAST {
                let pilot = n.div_ceil(8).max(MIN_PATHS);
                let error = render(round, &vec![pilot; all.len()])?.weighted_rms_error();
                n = (pilot as f64 * (error / target).powi(2)).ceil() as u64;
                if n <= 9 * pilot {
                    break;
                }
            }
            vec![n.max(MIN_PATHS); all.len()]
        }
    };
    render(LAST, &paths)
}

/// Mean and scatter of a configuration's paths.
fn scatter<T: Plain>(
    tracer: impl Fn(u64) -> T + Sync,
    rows: usize,
    configuration: &Configuration,
    paths: u64,
    stage: &str,
    watch: &dyn Watch,
) -> Result<Graded<Running>> {
    let toward_camera = configuration.camera_in_sample().vector();
    let done = AtomicU64::new(0);
    let task = |number: u64| {
        let n = TASK_PATHS.min(paths - number * TASK_PATHS);
        let (mut tracer, mut sums) = (tracer(number), Graded::<Running>::default());
        for _ in 0..n {
            let path = tracer.path(toward_camera);
            let used = path[..=rows].as_flattened();
            let terms = sums.as_flattened_mut().iter_mut().zip(used);
            terms.for_each(|(sum, x)| sum.push(*x));
        }
        watch.progress(stage, done.fetch_add(n, Ordering::Relaxed) + n, paths);
        (!watch.cancelled()).then_some(sums)
    };
    let tasks = (0..paths.div_ceil(TASK_PATHS)).into_par_iter().map(task);
    let tasks: Vec<_> = tasks
        .collect::<Option<_>>()
        .ok_or_else(|| Error::new("interrupted"))?;
    let mut all = Graded::<Running>::default();
    for sums in tasks {
        let terms = all.as_flattened_mut().iter_mut().zip(sums.as_flattened());
        terms.for_each(|(all, sum)| all.merge(sum));
    }
    Ok(all)
}

fn finished(c: &Configuration, sums: &Graded<Running>, request: &Request<'_>) -> Result<Estimate> {
    let used = &sums[..=request.parameters.infos().len()];
    if !(used.iter().flatten()).all(|r| r.standard_error().is_finite()) {
        let (config, at) = (c.id, request.parameters.to_json());
        return Err(Error::new(format!("configuration {config}: the render is not finite at {at}"))
            .with_hint("this is a fault of the model at these parameters; please report it with the parameters"));
    }
    let (value, derivative) = (&used[0], &used[1..]);
    Ok(Estimate {
        config: c.id,
        mean: value.map(|r| r.mean()),
        standard_error: value.map(|r| r.standard_error()),
        derivative: derivative.iter().map(|row| row.map(|r| r.mean())).collect(),
        derivative_se: derivative
            .iter()
            .map(|row| row.map(|r| r.standard_error()))
            .collect(),
        paths: value[0].count(),
    })
}
