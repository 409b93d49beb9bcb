//! Laws of the path tracer, each with a negative control: furnace, single scattering in closed form, an independent
//! estimator, and derivatives along one path.

use super::geometry::{Ended, Geometry, Skip};
use super::guide::Guide;
use super::light::{Lamp, LightShape};
use super::path::{Event, Stage, Visitor};
use super::scene::surface_map;
use super::summation::{Rows, Summation};
use super::{Effort, FiberScene, FiberSceneOptions, Plate, Request, Scene};
use crate::base::Unwatched;
use crate::fabric::{FiberTile, NO_SEGMENT, Segment};
use crate::math::statistics::{Running, sidak_level};
use crate::math::{Frame, PolarDirection, Random};
use crate::scatter::{self, Model, Parameters, Scattering};
use crate::session::Configuration;
use glam::DVec3;
use std::f64::consts::{FRAC_PI_2, PI, TAU};

fn seed(named: u64) -> u64 {
    std::env::var("SEED")
        .ok()
        .and_then(|s| s.parse().ok())
        .unwrap_or(named)
}

fn khungurn() -> &'static dyn Model {
    scatter::model("khungurn").unwrap()
}

fn parameters(flat_deg: [f64; 9]) -> Parameters {
    let values = flat_deg
        .iter()
        .enumerate()
        .map(|(i, v)| if i < 6 { *v } else { v.to_radians() })
        .collect();
    Parameters::defaults(khungurn()).with_values(values)
}

/// Table IV of Khungurn 2015, fibers: Gabardine with beta_TT 12 degrees instead of the bound.
fn gabardine() -> Parameters {
    parameters([
        0.185, 0.047, 0.069, 0.999, 0.330, 0.354, 2.141, 12.0, 23.548,
    ])
}

/// One straight fiber along x through the middle of the tile.
fn one_fiber(size: f64, radius: f64) -> FiberTile {
    let start = DVec3::new(0.0, 0.5 * size, 0.0);
    let end = DVec3::new(size, 0.5 * size, 0.0);
    FiberTile {
        size: [size; 2],
        segments: vec![Segment {
            start,
            end,
            radius,
            yarn_system: 0,
            previous: 0,
            next: 0,
        }],
    }
}

/// A loose felt: random short fibers, dense enough for several hits per path.
fn felt(n: usize) -> FiberTile {
    let mut random = Random::keyed(&[77]);
    let segments = (0..n)
        .map(|_| {
            let mut u = || random.uniform();
            let start = DVec3::new(u(), u(), 0.2 * u());
            let turn = TAU * u();
            let end = start + DVec3::new(turn.cos(), turn.sin(), 0.3 * (u() - 0.5)) * 0.4;
            Segment {
                start,
                end,
                radius: 0.02,
                yarn_system: 0,
                previous: NO_SEGMENT,
                next: NO_SEGMENT,
            }
        })
        .collect();
    FiberTile {
        size: [1.0, 1.0],
        segments,
    }
}

/// Composite midpoint rule over the sphere around a fiber: `sum f(theta, phi) d theta d phi`.
fn over_the_sphere(n_theta: usize, n_phi: usize, f: impl Fn(f64, f64) -> f64) -> f64 {
    let (dt, dp) = (PI / n_theta as f64, TAU / n_phi as f64);
    let row = |i: usize| {
        let theta = -FRAC_PI_2 + (i as f64 + 0.5) * dt;
        (0..n_phi)
            .map(|j| f(theta, (j as f64 + 0.5) * dp))
            .sum::<f64>()
    };
    (0..n_theta).map(row).sum::<f64>() * dt * dp
}

fn fiber_direction(theta: f64, phi: f64) -> DVec3 {
    let (s, c) = theta.sin_cos();
    DVec3::new(s, c * phi.cos(), c * phi.sin())
}

/// Everything scattered once and leaving counts 1: the light comes from everywhere.
struct Furnace {
    throughput: [f64; 3],
    bounces: u32,
}

impl Visitor for Furnace {
    fn bounce(&mut self, depth: usize, event: Event<'_>) {
        // A lone fiber is convex; what goes on within 1e-5 of horizontal meets its copy a meter away.
        if depth == 0 {
            self.bounces += 1;
            self.throughput = event.weight();
        }
    }
    fn reflect(&mut self, _depth: usize, _weight: [f64; 3]) {}
    fn connect(&mut self, _depth: usize, _lamp: usize, _event: Event<'_>) {}
    fn arrive(&mut self, _depth: usize, _lamp: usize, _factor: [f64; 3]) {}
}

/// |mean - expected| in standard errors.
fn z(sample: &Running, expected: f64) -> f64 {
    (sample.mean() - expected) / sample.standard_error()
}

/// The two-sided normal quantile of `level`, by bisection on erfc.
fn limit(level: f64) -> f64 {
    let (mut low, mut high) = (0.0, 20.0);
    for _ in 0..80 {
        let middle: f64 = 0.5 * (low + high);
        if libm::erfc(middle / 2.0_f64.sqrt()) > level {
            low = middle
        } else {
            high = middle
        }
    }
    low
}

#[test]
fn a_single_fiber_in_a_furnace_reflects_its_reverse_albedo() {
    // 5 views x 3 channels at family-wise 1e-3; a standard error near 0.3 % sees a fault of about 1.3 %.
    let bound = limit(sidak_level(1e-3, 15));
    let geometry = Geometry::new(&one_fiber(1000.0, 0.008)).unwrap();
    let guide = Guide::FRESH;
    let map = surface_map(&geometry, [1000.0; 2]);
    let p = parameters([0.9, 0.3, 0.0, 0.05, 0.6, 1.0, 2.0, 45.0, 23.0]);
    let sets = khungurn().prepare_each(&p).unwrap();
    let scattering = &sets[0];
    let mut worst_wrong: f64 = 0.0;
    for (view, theta_deg) in [0.0, 30.0, 60.0, 75.0, 85.0_f64].into_iter().enumerate() {
        // The camera's elevation from the fiber's normal plane is theta; the fiber lies along x.
        let toward_camera = PolarDirection::from_degrees(theta_deg, 0.0).vector();
        let mut random = Random::keyed(&[seed(1), view as u64]);
        let mut means = [Running::default(); 3];
        let stage = Stage {
            geometry: &geometry,
            sets: &sets,
            lamps: &[],
            worth: &[],
            plate: Plate::Black,
            map: &map,
            guide: &guide,
        };
        for _ in 0..40_000 {
            let across = 0.016 * (random.uniform() - 0.5) * 0.999;
            let mut furnace = Furnace {
                throughput: [1.0; 3],
                bounces: 0,
            };
            let through = DVec3::new(500.0, 500.0 + across, 0.0);
            stage.follow(through, toward_camera, &mut random, &mut furnace);
            let ended = f64::from(furnace.bounces);
            (0..3).for_each(|c| means[c].push(ended * furnace.throughput[c]));
        }
        let wo = fiber_direction(-theta_deg.to_radians(), 0.0);
        let wo = DVec3::new(-wo.x, wo.y, wo.z);
        for c in 0..3 {
            let reverse = over_the_sphere(3000, 400, |t, f| {
                scattering.evaluate(fiber_direction(t, f), wo, 0.0).value[c] * t.cos() * t.cos()
            });
            let score = z(&means[c], reverse);
            assert!(
                score.abs() < bound,
                "view {theta_deg} channel {c}: {} +- {} (n {}) against {reverse}",
                means[c].mean(),
                means[c].standard_error(),
                means[c].count()
            );
            // Negative control: the reverse albedo is not 1.
            worst_wrong = worst_wrong.max(z(&means[c], 1.0).abs());
        }
    }
    assert!(
        worst_wrong > bound,
        "the furnace test cannot tell the reverse albedo from 1"
    );
}

/// Contributions scattered once.
struct SingleScattering {
    throughput: f64,
    bounces: u32,
    sum: f64,
}

impl Visitor for SingleScattering {
    fn bounce(&mut self, _depth: usize, event: Event<'_>) {
        self.bounces += 1;
        self.throughput *= event.weight()[1];
    }
    fn reflect(&mut self, _depth: usize, _weight: [f64; 3]) {}
    fn connect(&mut self, _depth: usize, _lamp: usize, event: Event<'_>) {
        if self.bounces == 0 {
            self.sum += event.weight()[1];
        }
    }
    fn arrive(&mut self, _depth: usize, _lamp: usize, factor: [f64; 3]) {
        if self.bounces == 1 {
            self.sum += self.throughput * factor[1];
        }
    }
}

#[test]
fn single_scattering_by_a_straight_fiber_has_its_closed_form() {
    // M = coverage * integral over the light of S cos(theta_i) dw * pi / E_normal; coverage of the plane by the fiber's
    // shadow along the view: 2 r sqrt(1 - x^2) / (z W). 4 geometries at family-wise 1e-3; se about 1 %.
    let bound = limit(sidak_level(1e-3, 4));
    let (size, radius) = (10.0, 0.4);
    let geometry = Geometry::new(&one_fiber(size, radius)).unwrap();
    let guide = Guide::FRESH;
    let map = surface_map(&geometry, [size; 2]);
    let p = parameters([0.2, 0.3, 0.1, 0.8, 0.7, 0.9, 8.0, 30.0, 30.0]);
    let sets = khungurn().prepare_each(&p).unwrap();
    let scattering = &sets[0];
    let poses = [
        (32.0, 180.0, 32.0, 0.0),
        (80.0, 90.0, 32.0, 0.0),
        (64.0, 0.0, 48.0, 0.0),
        (32.0, 90.0, 80.0, 45.0),
    ];
    let mut caught = 0.0_f64;
    for (pose, (tl, pl, tc, pc)) in poses.into_iter().enumerate() {
        let toward_light = PolarDirection::from_degrees(tl, pl);
        let wc = PolarDirection::from_degrees(tc, pc).vector();
        let lamps = [Lamp::new(LightShape::default(), toward_light)];
        let stage = Stage {
            geometry: &geometry,
            sets: &sets,
            lamps: &lamps,
            worth: &[0.02],
            plate: Plate::Black,
            map: &map,
            guide: &guide,
        };
        let mut random = Random::keyed(&[seed(2), pose as u64]);
        let mut mean = Running::default();
        for _ in 0..150_000 {
            let through = DVec3::new(
                (random.uniform() - 0.5) * size,
                (random.uniform() - 0.5) * size,
                0.0,
            );
            let mut path = SingleScattering {
                throughput: 1.0,
                bounces: 0,
                sum: 0.0,
            };
            stage.follow(through, wc, &mut random, &mut path);
            mean.push(path.sum);
        }
        let coverage = 2.0 * radius * (1.0 - wc.x * wc.x).sqrt() / (wc.z * size);
        // The light, by a midpoint rule over the square seen from the center: d w = cos dA / d^2.
        let frame = Frame::from_tangent(DVec3::X);
        let mut points = Random::keyed(&[5]);
        let n = 20_000;
        let mut light = 0.0;
        for _ in 0..n {
            let s = lamps[0].sample(DVec3::ZERO, &mut points).unwrap();
            let wi = frame.to_local(s.direction);
            light += scattering.evaluate(wi, frame.to_local(wc), 0.0).value[1] * wi.y.hypot(wi.z)
                / s.pdf
                / f64::from(n);
        }
        let expected = coverage * light * lamps[0].normalized_radiance();
        let score = z(&mean, expected);
        assert!(
            score.abs() < bound,
            "pose {pose}: {} +- {} (n {}) against {expected}",
            mean.mean(),
            mean.standard_error(),
            mean.count()
        );
        // Negative control: the cosine to the surface normal instead of the fiber's normal plane, on average pi / 4.
        caught = caught.max(z(&mean, expected * PI / 4.0).abs());
    }
    assert!(
        caught > bound,
        "the closed form cannot tell the fiber's cosine from the surface's"
    );
}

/// Path tracing without next-event estimation, roulette or shared code for connections: sample, follow, and see whether
/// the ray that leaves meets the lamp. `kept` scales every scattering (1 but for the negative control).
fn naive_path(
    scene: &FiberScene,
    scattering: &dyn Scattering,
    lamp: &Lamp,
    toward_camera: DVec3,
    random: &mut Random,
    kept: f64,
) -> [f64; 3] {
    let geometry = &scene.geometry;
    let through = scene.options.start(random);
    let mut direction = -toward_camera;
    let mut origin = through + toward_camera * (geometry.z_range()[1] / toward_camera.z);
    let mut weight = [1.0; 3];
    let mut skip = Skip::NOTHING;
    loop {
        match geometry.closest(origin, direction, &skip) {
            Ended::Down => return [0.0; 3],
            Ended::Up => {
                let seen = lamp.pdf(origin, direction).is_some();
                return weight.map(|w| {
                    if seen {
                        w * lamp.normalized_radiance()
                    } else {
                        0.0
                    }
                });
            }
            Ended::Fiber(hit) => {
                let (start, end, radius) = geometry.placed(hit.image);
                let frame = Frame::from_tangent((end - start).normalize());
                let wo = frame.to_local(-direction);
                let Some(s) = scattering.sample(&scattering.outgoing(wo, 0.0, weight), random)
                else {
                    return [0.0; 3];
                };
                let at = frame.to_local(origin + direction * hit.distance - start);
                weight = std::array::from_fn(|c| weight[c] * s.weight[c] * kept);
                // Leave on the circle: solve |at + k u| = radius in the cross-section for the larger root.
                let u = DVec3::new(0.0, s.wi.y, s.wi.z);
                let (a, b) = (u.length_squared(), at.y * u.y + at.z * u.z);
                let c = at.y * at.y + at.z * at.z - radius * radius;
                let k = (-b + (b * b - a * c).max(0.0).sqrt()) / a;
                origin = start + frame.to_world(at + u * k);
                direction = frame.to_world(s.wi);
                skip = geometry.skip(hit.image);
            }
        }
    }
}

#[test]
fn the_path_tracer_agrees_with_a_naive_one() {
    // 3 poses x 3 channels at family-wise 1e-3. A wide lamp lets naive paths find it; standard errors near 1 %.
    let bound = limit(sidak_level(1e-3, 9));
    let options = FiberSceneOptions {
        light: LightShape {
            side: 700.0,
            distance: 610.0,
        },
        ..FiberSceneOptions::default()
    };
    let scene = FiberScene::new(&felt(60), khungurn(), options).unwrap();
    let p = parameters([0.1, 0.3, 0.05, 0.85, 0.4, 0.9, 6.0, 20.0, 30.0]);
    let scattering = khungurn().prepare(&p).unwrap();
    let pose = |id, tl, pl, tc| Configuration {
        id,
        light: PolarDirection::from_degrees(tl, pl),
        camera: PolarDirection::from_degrees(tc, 0.0),
        rotation: 0.0,
    };
    let poses = [
        pose(1, 32.0, 180.0, 32.0),
        pose(2, 60.0, 90.0, 70.0),
        pose(3, 50.0, 0.0, 20.0),
    ];
    let effort = Effort::Paths(60_000);
    let request = Request {
        configurations: &poses,
        parameters: &p,
        effort,
        seed: seed(3),
        stream: 0,
    };
    let fast = scene.estimate(&request, &Unwatched).unwrap();
    let mut caught = 0.0_f64;
    for (pose, estimate) in poses.iter().zip(&fast.configurations) {
        let lamp = Lamp::new(options.light, pose.light);
        let view = pose.camera.vector();
        for kept in [1.0, 0.95] {
            let mut random = Random::keyed(&[seed(4), u64::from(pose.id)]);
            let mut naive = [Running::default(); 3];
            for _ in 0..60_000 {
                let path = naive_path(&scene, &*scattering, &lamp, view, &mut random, kept);
                (0..3).for_each(|c| naive[c].push(path[c]));
            }
            for (c, naive) in naive.iter().enumerate() {
                let se = naive.standard_error().hypot(estimate.standard_error[c]);
                let score = (naive.mean() - estimate.mean[c]) / se;
                // Negative control: 5 % lost at every scattering.
                if kept < 1.0 {
                    caught = caught.max(score.abs());
                    continue;
                }
                assert!(
                    score.abs() < bound,
                    "pose {} channel {c}: {} +- {} against naive {} +- {}",
                    pose.id,
                    estimate.mean[c],
                    estimate.standard_error[c],
                    naive.mean(),
                    naive.standard_error()
                );
            }
        }
    }
    assert!(
        caught > bound,
        "the comparison cannot see 5 % lost at every scattering: {caught}"
    );
}

/// One step of a recorded path, with the factor that does not depend on parameters.
#[derive(Clone, Copy)]
enum Step {
    Bounce { wi: DVec3, wo: DVec3, factor: f64 },
    Connect { wi: DVec3, wo: DVec3, factor: f64 },
    Arrive { factor: f64 },
}

#[derive(Default)]
struct Recorder(Vec<Step>);

impl Visitor for Recorder {
    fn bounce(&mut self, _depth: usize, event: Event<'_>) {
        self.0.push(Step::Bounce {
            wi: event.wi,
            wo: event.wo,
            factor: event.factor,
        });
    }
    fn reflect(&mut self, _depth: usize, _weight: [f64; 3]) {}
    fn connect(&mut self, _depth: usize, _lamp: usize, event: Event<'_>) {
        self.0.push(Step::Connect {
            wi: event.wi,
            wo: event.wo,
            factor: event.factor,
        });
    }
    fn arrive(&mut self, _depth: usize, _lamp: usize, factor: [f64; 3]) {
        self.0.push(Step::Arrive { factor: factor[0] });
    }
}

/// What the recorded path contributes at other parameters, with connections evaluated by `connections` (another one is the fault of
/// the negative control).
fn contribution(steps: &[Step], at: &dyn Scattering, connections: &dyn Scattering) -> [f64; 3] {
    let (mut throughput, mut sum) = ([1.0; 3], [0.0; 3]);
    for step in steps {
        match *step {
            Step::Bounce { wi, wo, factor } => {
                let s = at.evaluate(wi, wo, 0.0).value;
                throughput = std::array::from_fn(|c| throughput[c] * s[c] * factor);
            }
            Step::Connect { wi, wo, factor } => {
                let s = connections.evaluate(wi, wo, 0.0).value;
                sum = std::array::from_fn(|c| sum[c] + throughput[c] * s[c] * factor);
            }
            Step::Arrive { factor } => {
                sum = std::array::from_fn(|c| sum[c] + throughput[c] * factor)
            }
        }
    }
    sum
}

#[test]
fn derivatives_match_finite_differences_along_one_path() {
    let scene = FiberScene::new(&felt(60), khungurn(), FiberSceneOptions::default()).unwrap();
    let extremes = parameters([0.001, 0.999, 0.5, 0.999, 0.001, 0.5, 1.0, 10.0, 1.0]);
    let (mut compared, mut caught) = (0, 0);
    for p in [gabardine(), extremes] {
        let sets = khungurn().prepare_each(&p).unwrap();
        let at = &sets[0];
        let light = PolarDirection::from_degrees(40.0, 170.0);
        let lamps = [Lamp::new(
            LightShape {
                side: 400.0,
                distance: 610.0,
            },
            light,
        )];
        let guide = Guide::FRESH;
        let stage = scene.stage(&sets, &lamps, &[0.01], &guide);
        let toward_camera = PolarDirection::from_degrees(50.0, 10.0).vector();
        for path in 0..400 {
            let mut random = Random::keyed(&[9, path]);
            let through = scene.options.start(&mut random);
            let mut again = random.clone();
            let mut recorder = Recorder::default();
            stage.follow(through, toward_camera, &mut random, &mut recorder);
            let mut summation = Summation::new(Rows::of(khungurn()), 1);
            stage.follow(through, toward_camera, &mut again, &mut summation);
            let base = contribution(&recorder.0, &**at, &**at);
            for (slot, (row, only)) in p.places().into_iter().enumerate() {
                let value = p.values()[slot];
                let h = 1e-5 * value.abs().max(1e-3);
                let moved = |sign: f64| {
                    let mut values = p.values().to_vec();
                    values[slot] += sign * h;
                    khungurn().prepare(&p.with_values(values)).unwrap()
                };
                let (up, down) = (moved(1.0), moved(-1.0));
                let difference = |connections: [&dyn Scattering; 2]| {
                    let (a, b) = (
                        contribution(&recorder.0, &*up, connections[0]),
                        contribution(&recorder.0, &*down, connections[1]),
                    );
                    std::array::from_fn::<f64, 3, _>(|c| (a[c] - b[c]) / (2.0 * h))
                };
                let (right, frozen) = (difference([&*up, &*down]), difference([&**at, &**at]));
                let channels = if p.infos()[row].per_channel {
                    only..only + 1
                } else {
                    0..3
                };
                for c in channels {
                    let exact = summation.lamps[0].derivative[row][c];
                    let scale = exact.abs() + base[c] / value.abs().max(1e-3);
                    assert!(
                        (base[c] - summation.lamps[0].value[c]).abs() <= 1e-9 * base[c],
                        "the replay is the path"
                    );
                    assert!(
                        (right[c] - exact).abs() <= 2e-5 * scale + 1e-30,
                        "path {path} {} channel {c}: {exact} against {}",
                        p.infos()[row].name,
                        right[c]
                    );
                    compared += usize::from(exact != 0.0);
                    caught += usize::from((frozen[c] - exact).abs() > 2e-5 * scale + 1e-30);
                }
            }
        }
    }
    assert!(compared > 1000, "{compared}");
    // Negative control: with the connections' own dependence left out the comparison fails.
    assert!(caught > 100, "{caught}");
}

#[test]
fn the_same_seed_gives_the_same_numbers_on_any_number_of_threads() {
    let scene = FiberScene::new(&felt(40), khungurn(), FiberSceneOptions::default()).unwrap();
    let p = gabardine();
    let pose = |id, rotation: f64| Configuration {
        id,
        light: PolarDirection::from_degrees(32.0, 180.0),
        camera: PolarDirection::from_degrees(32.0, 0.0),
        rotation,
    };
    let poses = [pose(1, 0.0), pose(2, 1.0)];
    let estimate = |threads: usize, seed: u64, effort: Effort| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        let request = Request {
            configurations: &poses,
            parameters: &p,
            effort,
            seed,
            stream: 0,
        };
        pool.install(|| scene.estimate(&request, &Unwatched).unwrap().configurations)
    };
    for effort in [
        Effort::Paths(2000),
        Effort::Accuracy(0.2),
        Effort::Total {
            paths: 3000,
            shares: vec![1.0, 2.0],
        },
    ] {
        let one = estimate(1, 5, effort.clone());
        assert_eq!(one, estimate(3, 5, effort.clone()));
        assert_ne!(one, estimate(1, 6, effort));
    }
}
