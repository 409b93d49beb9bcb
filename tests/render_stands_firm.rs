//! The renderer where it is hard: colors at their ends, narrow and wide lobes, grazing, odd cloths, odd sizes.
//!
//! Each case renders two poses with both integrators, 32 seeds each. The pooled estimates must agree (z-test on means and
//! derivatives), and the scatter over the seeds must be what the stated standard errors promise (chi-square, both
//! tails); family-wise level 1e-3 in each case. Seen are differences of about 4.5 joint standard errors of the pools, and
//! standard errors stated too small by a factor of 1.6 or too large by 1.9. Non-finite numbers would be errors of the
//! request. The light is wide: with the small light of the real rig a few thousand paths do not make honest errors.
//!
//! Each case prints its noise. As measured (standard error of the noisiest mean at 100,000 paths, fast and basic): 1 to 3 % in
//! most; where it is more, the test's comment says so. 20 s in all on two cores.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

#[path = "common/render_scenes.rs"]
mod render_scenes;

use glam::DVec3;
use goniofit::fabric::FiberTile;
use goniofit::math::statistics::{Running, sidak_level};
use goniofit::math::{Frame, PolarDirection};
use goniofit::render::{Effort, Estimate, FiberSceneOptions, Integrator, LightShape, Plate};
use goniofit::session::Configuration;
use render_scenes::{
    SOFT, Scores, Subject, WIDE, felt, khungurn, numbers, one_fiber, parameters, pose, seed,
    segment, z_bound,
};
use statrs::distribution::{ChiSquared, ContinuousCDF};
use std::f64::consts::PI;
use std::path::Path;

const RUNS: u64 = 32;
const BOTH: [Integrator; 2] = [Integrator::Fast, Integrator::Basic];

/// One number over the seeds.
struct Pooled {
    name: String,
    estimates: Running,
    /// Mean of the squared standard errors.
    variance: f64,
}

impl Pooled {
    /// `(n - 1) s^2 / sigma^2`; the expected value when nothing scatters and nothing should.
    fn chi_square(&self, error_factor: f64) -> f64 {
        let freedom = (RUNS - 1) as f64;
        let scatter = self.estimates.variance() + self.variance;
        if scatter > 0.0 {
            freedom * self.estimates.variance() / (self.variance * error_factor.powi(2))
        } else {
            freedom
        }
    }
}

fn pool(
    subject: &Subject<'_>,
    poses: &[Configuration],
    paths: u64,
    integrator: Integrator,
) -> Vec<Pooled> {
    let runs: Vec<Vec<Estimate>> = (0..RUNS)
        .map(|run| {
            subject.render(
                integrator,
                poses,
                Effort::Paths(paths),
                1000 * seed(21) + run,
            )
        })
        .collect();
    let mut pools = Vec::new();
    for index in 0..poses.len() {
        let names = numbers(&runs[0][index]).into_iter().map(|(name, ..)| name);
        let mut pose: Vec<Pooled> = names
            .map(|name| Pooled {
                name: format!("pose {}, {name}", poses[index].id),
                estimates: Running::default(),
                variance: 0.0,
            })
            .collect();
        for run in &runs {
            for (pool, (_, x, se)) in pose.iter_mut().zip(numbers(&run[index])) {
                pool.estimates.push(x);
                pool.variance += se * se / RUNS as f64;
            }
        }
        pools.extend(pose);
    }
    pools
}

/// The chi-square farthest out of its two-sided limits over all numbers: true with its sentence when it is outside.
fn misstated(pools: &[Pooled], error_factor: f64) -> (bool, String) {
    let law = ChiSquared::new((RUNS - 1) as f64).unwrap();
    let tail = 0.5 * sidak_level(1e-3, pools.len());
    let limits = [law.inverse_cdf(tail), law.inverse_cdf(1.0 - tail)];
    let far = |p: &Pooled| {
        let x = p.chi_square(error_factor);
        (x / limits[1]).max(limits[0] / x)
    };
    // Where one run cannot tell a number from half of it, a few paths make its error: nothing can be said of that.
    let told = |p: &&Pooled| p.variance.sqrt() <= 0.5 * p.estimates.mean().abs();
    let worst = pools
        .iter()
        .filter(told)
        .max_by(|a, b| far(a).total_cmp(&far(b)))
        .unwrap();
    let (x, scatter, stated) = (
        worst.chi_square(error_factor),
        worst.estimates.variance().sqrt(),
        worst.variance.sqrt(),
    );
    let sentence = format!(
        "{}: {} scatters by {scatter:.3e} over {RUNS} seeds, stated {stated:.3e}; chi-square {x:.1}, limits {limits:.1?}",
        worst.name,
        worst.estimates.mean()
    );
    (far(worst) >= 1.0 || far(worst).is_nan(), sentence)
}

/// Both integrators agree and both state honest errors.
fn stands(subject: &Subject<'_>, poses: &[Configuration], paths: u64) -> [Vec<Pooled>; 2] {
    let pools = BOTH.map(|i| pool(subject, poses, paths, i));
    let mut scores = Scores::default();
    let at = |p: &Pooled| (p.estimates.mean(), (p.variance / RUNS as f64).sqrt());
    for (a, b) in pools[0].iter().zip(&pools[1]) {
        scores.add(&a.name, at(a), at(b));
    }
    let noise = |pools: &[Pooled]| {
        let of = |p: &Pooled| p.variance.sqrt() / p.estimates.mean();
        let means = pools.chunks(18).flat_map(|pose| pose[..3].iter().map(of));
        100.0 * means.fold(0.0, f64::max) * (paths as f64 / 1e5).sqrt()
    };
    println!(
        "standard error of the noisiest mean at 100,000 paths: fast {:.1} %, basic {:.1} %",
        noise(&pools[0]),
        noise(&pools[1])
    );
    println!("{}", scores.sentence);
    let verdicts = [&pools[0], &pools[1]].map(|p| misstated(p, 1.0));
    for (_, sentence) in &verdicts {
        println!("{sentence}");
    }
    scores.assert_agree();
    for (integrator, (bad, sentence)) in BOTH.iter().zip(verdicts) {
        assert!(!bad, "{integrator:?}: {sentence}");
    }
    pools
}

fn subject<'a>(tile: &'a FiberTile, plate: Plate, flat_deg: [f64; 9]) -> Subject<'a> {
    let options = FiberSceneOptions {
        light: WIDE,
        plate,
        ..FiberSceneOptions::default()
    };
    let parameters = parameters(flat_deg);
    Subject {
        tile,
        options,
        parameters,
    }
}

fn poses() -> [Configuration; 2] {
    [
        pose(1, [32.0, 180.0], [40.0, 0.0]),
        pose(2, [60.0, 90.0], [65.0, 10.0]),
    ]
}

#[test]
fn misstated_errors_are_seen() {
    let tile = felt(60, 0.2);
    let pools = pool(
        &subject(&tile, Plate::Black, SOFT),
        &poses(),
        2000,
        Integrator::Fast,
    );
    let (honest, sentence) = misstated(&pools, 1.0);
    assert!(!honest, "{sentence}");
    for factor in [0.5, 2.5] {
        let (seen, sentence) = misstated(&pools, factor);
        assert!(seen, "errors times {factor}: {sentence}");
    }
}

/// Nothing is absorbed but by the plate.
#[test]
fn fibers_that_transmit_all() {
    let tile = felt(60, 0.2);
    let white = [0.001, 0.001, 0.001, 0.999, 0.999, 0.999, 5.0, 20.0, 30.0];
    stands(&subject(&tile, Plate::Black, white), &poses(), 3000);
}

#[test]
fn fibers_that_reflect_all() {
    let tile = felt(60, 0.2);
    let mirror = [0.999, 0.999, 0.999, 0.001, 0.5, 0.999, 5.0, 20.0, 30.0];
    stands(&subject(&tile, Plate::Black, mirror), &poses(), 3000);
    // At exactly 1 nothing is transmitted, but the derivative by C_R tells what would be.
    let perfect = [1.0, 1.0, 1.0, 0.5, 0.5, 0.9, 2.0, 30.0, 30.0];
    stands(&subject(&tile, Plate::Black, perfect), &poses(), 3000);
}

#[test]
fn sharp_reflection_with_camera_and_lamp_at_80_degrees() {
    let tile = felt(60, 0.2);
    let sharp = [0.3, 0.3, 0.3, 0.6, 0.6, 0.6, 1.0, 10.0, 10.0];
    let grazing = [
        pose(1, [80.0, 180.0], [80.0, 0.0]),
        pose(2, [80.0, 90.0], [80.0, 0.0]),
    ];
    stands(&subject(&tile, Plate::Black, sharp), &grazing, 6000);
}

/// Noisy at 1 degree: 4 % fast, 14 % basic, for which the lamp is hard to find through so narrow a lobe.
#[test]
fn the_narrowest_and_the_widest_azimuth() {
    let tile = felt(60, 0.2);
    for gamma in [1.0, 45.0] {
        let material = [0.05, 0.1, 0.05, 0.9, 0.7, 0.4, 5.0, 15.0, gamma];
        stands(&subject(&tile, Plate::Black, material), &poses(), 4000);
    }
}

/// At a color of exactly zero a path's value dies where its derivative lives on. Noisy above the black plate (what is left is
/// grazing reflection): 10 % and 4 % fast, 1.5 % and 3 % basic.
#[test]
fn black_fibers() {
    let tile = felt(60, 0.2);
    for color in [0.001, 0.0] {
        let black = [color, color, color, color, color, color, 8.0, 25.0, 30.0];
        stands(&subject(&tile, Plate::Black, black), &poses(), 4000);
        stands(
            &subject(&tile, Plate::Diffuse([0.8; 3]), black),
            &poses(),
            3000,
        );
    }
}

/// As before, with lobes so different in width that the reflection lobe is near or at zero in `f64` where the transmission
/// lobe is not. Noisy: 5 % fast, 3 % basic; derivatives by c_tt come from paths of almost no value, which the fast
/// integrator follows rarely, and have ten times the standard error of basic's.
#[test]
fn almost_black_transmission_beside_a_sharp_reflection() {
    let tile = felt(60, 0.2);
    let dim = [0.1, 0.1, 0.1, 0.001, 0.001, 0.001, 1.0, 40.0, 30.0];
    stands(&subject(&tile, Plate::Black, dim), &poses(), 4000);
}

#[test]
fn black_transmission_beside_a_sharp_reflection() {
    let tile = felt(60, 0.2);
    let black = [0.1, 0.1, 0.1, 0.0, 0.0, 0.0, 1.0, 40.0, 30.0];
    stands(&subject(&tile, Plate::Black, black), &poses(), 4000);
}

/// Midpoint rule over the light seen from the sample's center: `sum f(w) dw pi / E_normal`, 1.
fn over_the_light(shape: LightShape, toward: PolarDirection, f: impl Fn(DVec3) -> f64) -> f64 {
    let facing = Frame::from_tangent(toward.vector());
    // The square's edges: one horizontal, one toward the pole.
    let horizontal = DVec3::Z.cross(facing.x).try_normalize().unwrap_or(DVec3::Y);
    let upward = facing.x.cross(horizontal);
    let n = 200;
    let cell = shape.side / f64::from(n);
    let (mut sum, mut irradiance) = (0.0, 0.0);
    for i in 0..n {
        for j in 0..n {
            let at = |k: i32| (f64::from(k) + 0.5) * cell - 0.5 * shape.side;
            let to = facing.x * shape.distance + horizontal * at(i) + upward * at(j);
            let w = to.normalize();
            let cosine = w.dot(facing.x);
            let solid_angle = cosine * cell * cell / to.length_squared();
            sum += f(w) * solid_angle;
            irradiance += cosine * solid_angle;
        }
    }
    sum * PI / irradiance
}

/// Against the closed form of single scattering, `coverage x integral of S cos(theta_i) pi / E`: the fibers are dark
/// and far apart, and the light lies on their cone of reflection, so that a second scattering adds less than 3e-3 of the value.
#[test]
fn a_single_fiber_has_its_closed_form() {
    let (size, radius) = (10.0, 0.2);
    let tile = one_fiber(size, radius);
    let dim = subject(
        &tile,
        Plate::Black,
        [0.05, 0.1, 0.02, 0.05, 0.02, 0.1, 8.0, 25.0, 30.0],
    );
    let poses = [
        pose(1, [32.0, 180.0], [40.0, 0.0]),
        pose(2, [40.0, 250.0], [50.0, 80.0]),
    ];
    let pools = stands(&dim, &poses, 15_000);
    let scattering = khungurn().prepare(&dim.parameters).unwrap();
    let bound = z_bound(12);
    let mut caught = 0.0_f64;
    for pools in pools {
        for (pose, pools) in poses.iter().zip(pools.chunks(18)) {
            let wc = pose.camera.vector();
            let coverage = 2.0 * radius * (1.0 - wc.x * wc.x).sqrt() / (wc.z * size);
            let fiber = Frame::from_tangent(DVec3::X);
            for (c, pool) in pools[..3].iter().enumerate() {
                let expected = coverage
                    * over_the_light(WIDE, pose.light, |w| {
                        let wi = fiber.to_local(w);
                        scattering.evaluate(wi, fiber.to_local(wc), 0.0).value[c] * wi.y.hypot(wi.z)
                    });
                let (mean, se) = (pool.estimates.mean(), (pool.variance / RUNS as f64).sqrt());
                let z = (mean - expected) / se;
                assert!(
                    z.abs() < bound,
                    "{}: {mean} +- {se} against {expected}",
                    pool.name
                );
                // Negative control: 10 % more.
                caught = caught.max((mean - 1.1 * expected).abs() / se);
            }
        }
    }
    assert!(caught > bound, "10 % are not seen: {caught}");
}

/// Fibers that touch, that cross through each other, that lie in one another, and one in the tile twice.
#[test]
fn fibers_that_touch_and_overlap() {
    let along = |y: f64, z: f64, radius: f64| {
        segment(DVec3::new(-0.2, y, z), DVec3::new(0.9, y, z), radius)
    };
    let across = |x: f64, z: f64| segment(DVec3::new(x, -0.1, z), DVec3::new(x, 0.8, z), 0.03);
    let tile = FiberTile {
        size: [1.0, 1.0],
        segments: vec![
            along(0.2, 0.1, 0.03),
            along(0.26, 0.1, 0.03),
            along(0.23, 0.1 + 0.06 * 0.75_f64.sqrt(), 0.03),
            across(0.3, 0.1),
            across(0.5, 0.16),
            along(0.6, 0.1, 0.05),
            along(0.6, 0.11, 0.02),
            across(0.7, 0.1),
            across(0.7, 0.1),
        ],
    };
    stands(
        &subject(&tile, Plate::Diffuse([0.3; 3]), SOFT),
        &poses(),
        6000,
    );
}

/// The camera looks along fibers: upright ones from the zenith, leaning ones at 60 degrees; and the light's center shines
/// along them. The plate carries most of the light: above a black one the standard error was 50 to 90 %.
#[test]
fn directions_parallel_to_a_fiber() {
    for (theta, phi) in [(0.0, 0.0), (60.0, 30.0)] {
        let axis = PolarDirection::from_degrees(theta, phi).vector();
        let foot = |i: usize| DVec3::new(0.37 * (i % 5) as f64, 0.23 * (i / 5) as f64, 0.0);
        let fiber = |i: usize| segment(foot(i), foot(i) + axis * 0.5, 0.05);
        let tile = FiberTile {
            size: [1.85, 1.15],
            segments: (0..25).map(fiber).collect(),
        };
        let poses = [
            pose(1, [40.0, 180.0], [theta, phi]),
            pose(2, [theta, phi], [50.0, 100.0]),
            pose(3, [theta, phi], [theta, phi]),
        ];
        stands(
            &subject(&tile, Plate::Diffuse([0.3; 3]), SOFT),
            &poses,
            3000,
        );
    }
}

/// Fibers along the axes, camera and light at the zenith or in a coordinate plane: ray directions with zeros of either sign.
#[test]
fn axis_aligned_rays() {
    let mut segments = Vec::new();
    for i in 0..5 {
        let at = 0.2 * f64::from(i) + 0.1;
        segments.push(segment(
            DVec3::new(0.0, at, 0.0),
            DVec3::new(1.0, at, 0.0),
            0.04,
        ));
        segments.push(segment(
            DVec3::new(at, 0.0, 0.1),
            DVec3::new(at, 1.0, 0.1),
            0.04,
        ));
    }
    let size = [1.0, 1.0];
    let tile = FiberTile { size, segments };
    let poses = [
        pose(1, [0.0, 0.0], [0.0, 0.0]),
        pose(2, [0.0, 180.0], [60.0, 90.0]),
        pose(3, [60.0, 270.0], [0.0, -180.0]),
    ];
    stands(
        &subject(&tile, Plate::Diffuse([0.5; 3]), SOFT),
        &poses,
        3000,
    );
}

/// Many bounces: nothing absorbs, and what passes the cloth comes back from the plate.
#[test]
fn thick_white_cloth_on_white() {
    let tile = felt(300, 1.0);
    let white = [0.1, 0.1, 0.1, 0.999, 0.99, 0.9, 8.0, 25.0, 30.0];
    stands(
        &subject(&tile, Plate::Diffuse([1.0; 3]), white),
        &poses(),
        1000,
    );
}

/// The same cloth on tiles of 10 micrometers and of 1 centimeter, all lengths scaled, and the small one under the light as
/// it is. At 1 micrometer the acceleration structure, which cuts rays at 1e-4, loses hits: the means are 5 % too high.
#[test]
fn micrometer_and_centimeter_tiles() {
    let scaled = |by: f64| {
        let mut tile = felt(60, 0.2);
        tile.size = tile.size.map(|s| s * by);
        for s in &mut tile.segments {
            (s.start, s.end, s.radius) = (s.start * by, s.end * by, s.radius * by);
        }
        tile
    };
    let tile = felt(60, 0.2);
    let millimeters = subject(&tile, Plate::Diffuse([0.5; 3]), SOFT);
    let ask = |s: &Subject<'_>, i, n| s.render(i, &poses(), Effort::Paths(40_000), seed(22) + n);
    let mut scores = Scores::default();
    let mut wrong = Scores::default();
    for integrator in BOTH {
        let expected = ask(&millimeters, integrator, 0);
        for (by, surroundings) in [(0.01, 0.01), (0.01, 1.0), (10.0, 10.0)] {
            let tile = scaled(by);
            let mut other = subject(&tile, Plate::Diffuse([0.5; 3]), SOFT);
            other.options.light.side *= surroundings;
            other.options.light.distance *= surroundings;
            other.options.sample_square *= surroundings;
            let what = format!(
                "{integrator:?}, tile {by} mm, light at {} mm",
                other.options.light.distance
            );
            scores.compare(&what, &expected, &ask(&other, integrator, 1));
            // Negative control: fibers too thick by 30 %.
            let mut thick = scaled(by);
            thick.segments.iter_mut().for_each(|s| s.radius *= 1.3);
            let other = Subject {
                tile: &thick,
                ..other
            };
            wrong.compare(&what, &expected, &ask(&other, integrator, 2));
        }
    }
    println!("{}", scores.sentence);
    scores.assert_agree();
    wrong.assert_differ();
}

/// Lamps in the far tail of every lobe, where values are near the least number there is: with both seeds a product of such a
/// value once underflowed to zero and was divided by.
#[test]
fn lamps_in_the_far_tail_of_every_lobe() {
    let cloth = goniofit::fabric::load(Path::new("fabrics/gabardine.toml")).unwrap();
    let mut s = subject(
        &cloth.tile,
        Plate::Black,
        [
            0.333_429_264_122_308_2,
            0.006_847_483_096_241_856,
            0.013_860_879_825_968_19,
            0.971_748_509_104_208_8,
            0.848_017_541_195_946_9,
            0.837_325_294_886_504_2,
            3.043_846_165_835_601,
            13.246_804_758_012_379,
            2.382_737_770_460_365_4,
        ],
    );
    s.options.light = LightShape::default();
    let turned = |pose: Configuration| Configuration {
        rotation: 0.5 * PI,
        ..pose
    };
    let poses = [
        pose(1, [64.0, 0.0], [48.0, 0.0]),
        turned(pose(2, [64.0, 0.0], [48.0, 0.0])),
        turned(pose(3, [32.0, 90.0], [32.0, 0.0])),
    ];
    for seed in [2, 6] {
        s.render(Integrator::Fast, &poses, Effort::Paths(30_000), seed);
    }
}

/// Between the fibers there is the plate alone: nothing at all when black; albedo times the light's irradiance when diffuse.
#[test]
fn a_camera_that_sees_no_fiber() {
    let tile = one_fiber(100.0, 0.008);
    let poses = [
        pose(1, [0.0, 0.0], [0.0, 0.0]),
        pose(2, [50.0, 60.0], [30.0, 20.0]),
    ];
    let of = |plate| {
        let mut s = subject(&tile, plate, SOFT);
        s.options.sample_square = 1.0;
        s
    };
    let (black, albedo) = (of(Plate::Black), [0.9, 0.5, 0.0]);
    let white = of(Plate::Diffuse(albedo));
    for integrator in BOTH {
        for e in black.render(integrator, &poses, Effort::Paths(2000), seed(23)) {
            for (name, x, se) in numbers(&e) {
                assert!(x.abs() + se <= 0.0, "pose {} {name}: {x} +- {se}", e.config);
            }
        }
        let mut scores = Scores::default();
        let mut caught = Scores::default();
        let lit = white.render(integrator, &poses, Effort::Paths(20_000), seed(23));
        for (pose, e) in poses.iter().zip(lit) {
            let irradiance = over_the_light(WIDE, pose.light, |w| w.z.max(0.0)) / PI;
            for c in 0..3 {
                let found = (e.mean[c], e.standard_error[c]);
                let what = format!("{integrator:?} pose {} channel {c}", pose.id);
                scores.add(&what, found, (albedo[c] * irradiance, 0.0));
                caught.add(&what, found, (1.01 * albedo[c] * irradiance, 0.0));
            }
            let derivatives = e.derivative.as_flattened();
            assert!(
                derivatives.iter().all(|d| d.abs() < 1e-4),
                "{derivatives:?}"
            );
        }
        scores.assert_agree();
        caught.assert_differ();
    }
}
