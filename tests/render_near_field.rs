//! Promise: the renderer tells a near-field model where across the fiber it was met, goes straight on through the fiber, and
//! does not see the joints between a fiber's own segments from inside.
#![allow(clippy::unwrap_used, missing_docs)]

use glam::DVec3;
use goniofit::base::Unwatched;
use goniofit::fabric::{FiberTile, NO_SEGMENT, Segment};
use goniofit::math::statistics::sidak_level;
use goniofit::math::{GaussLegendre, PolarDirection};
use goniofit::render::{
    Effort, Estimate, FiberScene, FiberSceneOptions, LightShape, Plate, Request, Scene,
};
use goniofit::scatter::{Chiang, Parameters};
use goniofit::session::Configuration;
use statrs::distribution::{ContinuousCDF, Normal};
use std::f64::consts::{FRAC_PI_2, PI};

const RADIUS: f64 = 0.1;
const SIZE: f64 = 8.0;

fn seed() -> u64 {
    std::env::var("SEED").map_or(2016, |s| s.parse().unwrap())
}

fn parameters(color: [f64; 3], beta_m: f64, beta_n: f64) -> Parameters {
    let [r, g, b] = color;
    Parameters::defaults(&Chiang).with_values(vec![r, g, b, beta_m, beta_n])
}

/// A straight fiber along x at this y, closed over the seam, in `n` segments that know their neighbors or do not.
fn fiber(y: f64, n: u32, linked: bool) -> FiberTile {
    let at = |k: u32| DVec3::new(SIZE * f64::from(k) / f64::from(n), y, 0.0);
    let link = |k: u32| if linked { k % n } else { NO_SEGMENT };
    FiberTile {
        size: [SIZE; 2],
        segments: (0..n)
            .map(|k| Segment {
                start: at(k),
                end: at(k + 1),
                radius: RADIUS,
                yarn_system: 0,
                previous: link(k + n - 1),
                next: link(k + 1),
            })
            .collect(),
    }
}

fn render(
    tile: &FiberTile,
    sample_square: f64,
    poses: &[[f64; 4]],
    p: &Parameters,
    paths: u64,
) -> Vec<Estimate> {
    let options = FiberSceneOptions {
        light: LightShape {
            side: 400.0,
            distance: 610.0,
        },
        sample_square,
        plate: Plate::Open,
        ..FiberSceneOptions::default()
    };
    let scene = FiberScene::new(tile, &Chiang, options).unwrap();
    let configurations: Vec<Configuration> = (1..)
        .zip(poses)
        .map(
            |(id, &[light_theta, light_phi, theta, phi])| Configuration {
                id,
                light: PolarDirection::from_degrees(light_theta, light_phi),
                camera: PolarDirection::from_degrees(theta, phi),
                rotation: 0.0,
            },
        )
        .collect();
    let request = Request {
        configurations: &configurations,
        parameters: p,
        effort: Effort::Paths(paths),
        seed: seed(),
        stream: 0,
    };
    let estimates = scene.estimate(&request, &Unwatched).unwrap();
    estimates.configurations
}

#[test]
fn a_flank_reflects_to_its_own_side() {
    // A black, smooth fiber seen from above: its +y flank is a mirror toward +y. A wrong sign of h exchanges the two.
    let p = parameters([0.0; 3], 0.3, 0.1);
    let poses = [[70.0, 90.0, 0.0, 0.0], [70.0, 270.0, 0.0, 0.0]];
    for (y, own) in [(-0.5 * RADIUS, 0), (0.5 * RADIUS, 1)] {
        let found = render(&fiber(y, 1, true), 0.9 * RADIUS, &poses, &p, 20_000);
        let (same, other) = (&found[own], &found[1 - own]);
        assert!(
            same.mean[0] > 5.0 * other.mean[0] + 5.0 * same.standard_error[0],
            "{same:?} {other:?}"
        );
    }
}

const POSES: [[f64; 4]; 4] = [
    [32.0, 180.0, 32.0, 0.0],
    [70.0, 170.0, 65.0, 10.0],
    [64.0, 90.0, 32.0, 0.0],
    [40.0, 0.0, 70.0, 60.0],
];

#[test]
fn a_lone_fiber_has_the_far_field_mean_over_its_width() {
    // M = coverage * mean over h of the light's integral of S cos(theta_i) * pi / E_normal; a straight fiber is met once. 4 poses
    // x 3 channels; standard errors near 0.4 % see a fault of about 2 %.
    let p = parameters([0.95, 0.5, 0.05], 0.4, 0.4);
    let found = render(&fiber(0.3, 1, true), SIZE, &POSES, &p, 400_000);
    let limit = Normal::standard().inverse_cdf(1.0 - 0.5 * sidak_level(1e-3, 12));
    let mut caught = 0.0_f64;
    for (estimate, pose) in found.iter().zip(POSES) {
        let expected = lone_fiber(&p, pose, 1.0);
        let halved = lone_fiber(&p, pose, 0.5);
        for c in 0..3 {
            let (mean, se) = (estimate.mean[c], estimate.standard_error[c]);
            let z = (mean - expected[c]) / se;
            assert!(
                z.abs() < limit,
                "{pose:?} channel {c}: {mean} +- {se} (n {}) against {}, z {z}",
                estimate.paths,
                expected[c]
            );
            // Negative control: h only from the middle half of the fiber.
            caught = caught.max(((mean - halved[c]) / se).abs());
        }
    }
    assert!(caught > limit, "the mean cannot tell which h it saw");
}

/// The closed form, with h from the middle `part` of the fiber's width.
fn lone_fiber(p: &Parameters, [tl, pl, tc, pc]: [f64; 4], part: f64) -> [f64; 3] {
    use goniofit::scatter::Model;
    let s = Chiang.prepare(p).unwrap();
    let wo = PolarDirection::from_degrees(tc, pc).vector();
    let coverage = 2.0 * RADIUS * (1.0 - wo.x * wo.x).sqrt() / (wo.z * SIZE);
    // The light's square: a tensor rule over its two edges.
    let (side, distance) = (400.0, 610.0);
    let toward = PolarDirection::from_degrees(tl, pl);
    let w = toward.vector();
    let (st, ct) = toward.theta.sin_cos();
    let (sp, cp) = toward.phi.sin_cos();
    let u = DVec3::new(-sp, cp, 0.0);
    let v = DVec3::new(ct * cp, ct * sp, -st);
    let (rule, over_h) = (GaussLegendre::new(12), GaussLegendre::new(48));
    let mut normal_irradiance = 0.0;
    let mut sum = [0.0; 3];
    for (a, weight_a) in rule.on(-0.5 * side, 0.5 * side) {
        for (b, weight_b) in rule.on(-0.5 * side, 0.5 * side) {
            let to = w * distance + u * a + v * b;
            let wi = to.normalize();
            let solid_angle = weight_a * weight_b * wi.dot(w) / to.length_squared();
            normal_irradiance += solid_angle * wi.dot(w);
            let cosine = wi.y.hypot(wi.z);
            for (gamma, weight) in over_h.on(-FRAC_PI_2, FRAC_PI_2) {
                let (value, _) = s.importance(wi, &s.outgoing(wo, part * gamma.sin(), [1.0; 3]));
                for c in 0..3 {
                    sum[c] += solid_angle * 0.5 * weight * gamma.cos() * value[c] * cosine;
                }
            }
        }
    }
    sum.map(|x| x * coverage * PI / normal_irradiance)
}

#[test]
fn a_fiber_of_many_short_segments_is_the_fiber_of_one() {
    // Segments of half a radius: a ray that crosses the fiber passes four joints. 4 poses x 3 channels, standard errors
    // near 0.4 %: sees a fault of 3 %.
    let p = parameters([0.95, 0.5, 0.05], 0.6, 0.6);
    let limit = Normal::standard().inverse_cdf(1.0 - 0.5 * sidak_level(1e-3, 12));
    let mean = |tile: &FiberTile| render(tile, SIZE, &POSES, &p, 400_000);
    let whole: Vec<[f64; 3]> = POSES
        .iter()
        .map(|&pose| lone_fiber(&p, pose, 1.0))
        .collect();
    let worst = |found: &[Estimate]| {
        let z = |e: &Estimate, w: &[f64; 3], c: usize| (e.mean[c] - w[c]) / e.standard_error[c];
        found
            .iter()
            .zip(&whole)
            .flat_map(|(e, w)| (0..3).map(move |c| z(e, w, c).abs()))
            .fold(0.0, f64::max)
    };
    let chain = mean(&fiber(0.3, 160, true));
    let z = worst(&chain);
    assert!(
        z < limit,
        "largest z {z}, limit {limit}: {chain:?} against {whole:?}"
    );
    // Negative control: segments that do not know their neighbors stop rays at their round ends.
    let unlinked = worst(&mean(&fiber(0.3, 160, false)));
    assert!(unlinked > 2.0 * limit, "{unlinked}");
}
