//! Volumes with known answers: slabs of one fiber direction, empty space, flights along fibers, and what has to hold of any estimate.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

#[path = "common/render_scenes.rs"]
mod render_scenes;
#[path = "common/volumes.rs"]
mod volumes;

use glam::DVec3;
use goniofit::base::Unwatched;
use goniofit::fabric::VoxelTile;
use goniofit::math::{Frame, GaussLegendre, PolarDirection};
use goniofit::render::{
    Effort, Estimate, FiberSceneOptions, Integrator, LightShape, Plate, Request, Scene, VolumeScene,
};
use goniofit::scatter::Parameters;
use goniofit::scatter::media::{self, Medium};
use goniofit::session::Configuration;
use render_scenes::{Scores, felt, pose, seed};
use serde_json::json;
use volumes::{Volume, medium, random_voxels, slab, soft_volume, voxelized, wide_flakes};

/// A light so small and far that it has one direction.
const POINT: LightShape = LightShape {
    side: 1.0,
    distance: 10_000.0,
};

fn options(plate: Plate) -> FiberSceneOptions {
    FiberSceneOptions {
        light: POINT,
        sample_square: 0.5,
        plate,
        ..FiberSceneOptions::default()
    }
}

fn directions(c: &Configuration) -> [DVec3; 2] {
    [c.light, c.camera].map(PolarDirection::vector)
}

/// Light scattered once in a homogeneous slab of optical depths `tau_i`, `tau_o` (along light and camera), over the albedo:
/// `pi int p e(o) n exp(-n s (..))` = `pi p e_o/cos_o (1 - exp(-(e_i/cos_i + e_o/cos_o) n d)) / (e_i/cos_i + e_o/cos_o)`,
/// per normal irradiance of the light.
fn single(medium: &dyn Medium, fiber: DVec3, n_d: f64, c: &Configuration) -> [f64; 3] {
    let [i, o] = directions(c);
    let frame = Frame::from_tangent(fiber);
    let [wi, wo] = [i, o].map(|w| frame.to_local(w));
    let [a, b] = [(wi, i), (wo, o)].map(|(w, world)| medium.extinction(w) / world.z);
    let value = medium.evaluate(wi, wo).value;
    let depth = b * (1.0 - (-(a + b) * n_d).exp()) / (a + b);
    value.map(|p| std::f64::consts::PI * p * depth)
}

fn poses() -> [Configuration; 4] {
    [
        pose(1, [30.0, 180.0], [30.0, 0.0]),
        pose(2, [64.0, 0.0], [48.0, 20.0]),
        pose(3, [10.0, 270.0], [70.0, 45.0]),
        pose(4, [60.0, 120.0], [5.0, 0.0]),
    ]
}

/// The light's own spread and its finite distance change these by less than 1e-3.
const LIGHT: f64 = 1e-3;

#[test]
fn scattered_once_as_in_closed_form() {
    // An albedo of 1e-3 leaves 1e-3 of what is scattered once to the second scattering. Sees an error of 1 % in extinction or phase
    // function; the control has the fibers turned by 5 degrees.
    let fiber = DVec3::new(0.8, 0.5, 0.33).normalize();
    let turned = Frame::from_tangent(fiber).to_world(fiber_off(5.0));
    for (name, file) in [
        (
            "microflake",
            r#"{"albedo": [1e-3, 1e-3, 1e-3], "gamma": 0.3}"#,
        ),
        ("khungurn-volume", SOFT_DARK),
    ] {
        let (model, parameters) = medium(name, file);
        let prepared = model.prepare(&parameters).unwrap();
        let tile = slab(6, 0.01, 0.7, fiber);
        let volume = Volume {
            tile: &tile,
            density: 40.0,
            options: options(Plate::Black),
            medium: (model, parameters),
        };
        let found = volume.render(Integrator::Fast, &poses(), Effort::Paths(40_000), seed(31));
        let against = |fiber: DVec3| {
            let mut scores = Scores::default();
            for (e, c) in found.iter().zip(&poses()) {
                let expected = single(&*prepared, fiber, 40.0 * 0.7 * 0.06, c);
                for k in 0..3 {
                    let what = format!("{name} pose {} channel {k}", c.id);
                    let se = e.standard_error[k].hypot(2.0 * LIGHT * expected[k]);
                    scores.add(&what, (e.mean[k], se), (expected[k], 0.0));
                }
            }
            println!("{}", scores.sentence);
            scores
        };
        against(fiber).assert_agree();
        against(turned).assert_differ();
    }
}

const SOFT_DARK: &str = r#"{"c_r": [0.1, 0.3, 0.05], "c_tt": [0.85, 0.6, 0.9], "beta_r_deg": 10.0,
    "beta_tt_deg": 25.0, "gamma_tt_deg": 30.0, "albedo": [1e-3, 1e-3, 1e-3]}"#;

fn fiber_off(degrees: f64) -> DVec3 {
    let (sin, cos) = degrees.to_radians().sin_cos();
    DVec3::new(cos, sin, 0.0)
}

/// What a white plate shows through a slab that scatters nothing back: `cos_i T_i T_o`.
#[test]
fn a_plate_seen_through_a_slab() {
    // Derivatives of the closed form by the density and gamma too. Sees 1 % in an optical depth.
    let file = r#"{"albedo": [0.0, 0.0, 0.0], "gamma": 0.2, "density_scale": 1.5}"#;
    let (model, parameters) = medium("microflake-density", file);
    let prepared = model.prepare(&parameters).unwrap();
    let fiber = DVec3::new(0.6, -0.3, 0.74).normalize();
    let tile = slab(5, 0.01, 0.5, fiber);
    let (density, n_d) = (20.0, 20.0 * 0.5 * 0.05);
    let volume = |density| Volume {
        tile: &tile,
        density,
        options: options(Plate::Diffuse([1.0, 0.5, 0.25])),
        medium: (model, parameters.clone()),
    };
    let frame = Frame::from_tangent(fiber);
    let against = |found: &[Estimate]| {
        let mut scores = Scores::default();
        for (e, c) in found.iter().zip(&poses()) {
            let sides = directions(c).map(|w| (frame.to_local(w), w.z));
            let depth: f64 = sides
                .iter()
                .map(|(w, z)| prepared.extinction(*w) / z * n_d)
                .sum();
            let slope = |row: usize| -> f64 {
                let of = |(w, z): &(DVec3, f64)| prepared.extinction_slopes(*w)[row] / z * n_d;
                -sides.iter().map(of).sum::<f64>()
            };
            for (k, albedo) in [1.0, 0.5, 0.25].into_iter().enumerate() {
                let value = albedo * sides[0].1 * (-depth).exp();
                let cell = |row: Option<usize>| match row {
                    None => (e.mean[k], e.standard_error[k], value),
                    Some(r) => (e.derivative[r][k], e.derivative_se[r][k], value * slope(r)),
                };
                for row in [None, Some(1), Some(2)] {
                    let (mean, se, expected) = cell(row);
                    let what = format!("pose {} channel {k} row {row:?}", c.id);
                    let se = se.hypot(2.0 * LIGHT * expected);
                    scores.add(&what, (mean, se), (expected, 0.0));
                }
            }
        }
        println!("{}", scores.sentence);
        scores
    };
    for integrator in [Integrator::Fast, Integrator::Basic] {
        let render =
            |density| volume(density).render(integrator, &poses(), Effort::Paths(60_000), seed(32));
        against(&render(density)).assert_agree();
        against(&render(1.05 * density)).assert_differ();
    }
}

/// The derivative by the albedo at zero is what is scattered once: the closed form again.
#[test]
fn black_media_keep_their_derivatives() {
    let (model, parameters) = medium("microflake", r#"{"albedo": [0, 0, 0], "gamma": 0.3}"#);
    let one = parameters.with_values(vec![1.0, 1.0, 1.0, 0.3]);
    let fiber = DVec3::new(0.5, 0.5, 0.7).normalize();
    let tile = slab(6, 0.01, 0.7, fiber);
    let volume = Volume {
        tile: &tile,
        density: 40.0,
        options: options(Plate::Black),
        medium: (model, parameters),
    };
    let found = volume.render(Integrator::Fast, &poses(), Effort::Paths(20_000), seed(33));
    let mut scores = Scores::default();
    for (e, c) in found.iter().zip(&poses()) {
        let white = model.prepare(&one).unwrap();
        let expected = single(&*white, fiber, 40.0 * 0.7 * 0.06, c)[0];
        assert!(e.mean.iter().all(|m| *m == 0.0), "{:?}", e.mean);
        let se = e.derivative_se[0][0].hypot(2.0 * LIGHT * expected);
        scores.add("albedo", (e.derivative[0][0], se), (expected, 0.0));
    }
    scores.assert_agree();
}

/// Along the fibers nothing of the volume BCSDF is met: the plate is seen as if there were no volume.
#[test]
fn along_the_fiber_nothing_is_met() {
    let (model, parameters) = medium("khungurn-volume", SOFT_DARK);
    let tile = slab(4, 0.01, 1.0, DVec3::Z);
    let volume = |options| Volume {
        tile: &tile,
        density: 4000.0,
        options,
        medium: (model, parameters.clone()),
    };
    let overhead = [pose(1, [0.0, 0.0], [0.0, 0.0])];
    let render = |o| volume(o).render(Integrator::Fast, &overhead, Effort::Paths(4096), seed(34));
    let found = &render(options(Plate::Diffuse([0.5; 3])))[0];
    // The light's half width, 1e-4, times an optical depth of 160 across leaves 0.7 %.
    assert!((found.mean[0] - 0.5).abs() < 0.01, "{:?}", found.mean);
    // Control: with a camera at 3 degrees the optical depth is 8.
    let tilted = [pose(1, [0.0, 0.0], [3.0, 0.0])];
    let request = volume(options(Plate::Diffuse([0.5; 3])));
    let dark = &request.render(Integrator::Fast, &tilted, Effort::Paths(4096), seed(34))[0];
    assert!(dark.mean[0] < 0.01, "{:?}", dark.mean);
}

/// Empty layers around a volume, a tile repeated, and one that begins elsewhere are the same cloth.
#[test]
fn how_the_tile_is_cut_does_not_matter() {
    let tile = random_voxels();
    let [nx, ny, nz] = tile.shape();
    let cut = |shape: [usize; 3], offset: [usize; 3], sink: f64| {
        let mut other = VoxelTile::empty(shape, tile.side(), tile.bottom() - sink).unwrap();
        for k in 0..nz {
            for j in 0..shape[1] {
                for i in 0..shape[0] {
                    let from = tile.place([(i + offset[0]) % nx, (j + offset[1]) % ny, k]);
                    let to = other.place([i, j, k + offset[2]]);
                    let density = tile.density()[from];
                    other.set(to, density, tile.direction(from)).unwrap();
                }
            }
        }
        other
    };
    let render = |tile: &VoxelTile, s: u64| {
        let volume = Volume {
            tile,
            density: 40.0,
            options: FiberSceneOptions {
                light: render_scenes::WIDE,
                ..FiberSceneOptions::default()
            },
            medium: soft_volume(),
        };
        volume.render(Integrator::Fast, &poses(), Effort::Paths(20_000), seed(s))
    };
    let plain = render(&tile, 35);
    let sunk = cut([nx, ny, nz + 8], [0, 0, 5], 5.0 * tile.side());
    // The same random numbers: equal but for rounding at the layers' heights.
    for (a, b) in plain.iter().zip(render(&sunk, 35)) {
        for k in 0..3 {
            assert!((a.mean[k] / b.mean[k] - 1.0).abs() < 0.02, "{a:?} {b:?}");
        }
    }
    let others = [
        ("twice", cut([2 * nx, 3 * ny, nz], [0; 3], 0.0)),
        ("moved", cut([nx, ny, nz], [5, 3, 0], 0.0)),
    ];
    for (what, other) in others {
        let mut scores = Scores::default();
        for (a, b) in plain.iter().zip(render(&other, 36)) {
            for k in 0..3 {
                let of = |e: &Estimate| (e.mean[k], e.standard_error[k]);
                scores.add(what, of(a), of(&b));
            }
        }
        println!("{}", scores.sentence);
        scores.assert_agree();
    }
}

#[test]
fn the_same_on_any_number_of_threads() {
    let tile = random_voxels();
    let volume = Volume {
        tile: &tile,
        density: 40.0,
        options: options(Plate::Black),
        medium: wide_flakes(),
    };
    let on = |threads: usize, s: u64| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let render = || volume.render(Integrator::Fast, &poses(), Effort::Paths(2000), s);
        pool.unwrap().install(render)
    };
    assert_eq!(on(1, 5), on(3, 5));
    assert_ne!(on(1, 5), on(1, 6));
}

#[test]
fn standard_errors_are_honest() {
    // 40 renders: the scatter of z about the mean of all; chi-square with 40 x 12 cells, correlated within poses, so the bounds are
    // wide: sees errors stated 25 % too small.
    let tile = random_voxels();
    let volume = Volume {
        tile: &tile,
        density: 40.0,
        options: FiberSceneOptions {
            light: render_scenes::WIDE,
            ..FiberSceneOptions::default()
        },
        medium: wide_flakes(),
    };
    let runs: Vec<Vec<Estimate>> = (0..40)
        .map(|run| {
            let seed = seed(37) + 1000 * run;
            volume.render(Integrator::Fast, &poses(), Effort::Paths(1024), seed)
        })
        .collect();
    let (mut sum, mut n) = (0.0, 0.0);
    for p in 0..poses().len() {
        for k in 0..3 {
            let mean = runs.iter().map(|r| r[p].mean[k]).sum::<f64>() / 40.0;
            for r in &runs {
                sum += ((r[p].mean[k] - mean) / r[p].standard_error[k]).powi(2);
                n += 1.0 - 1.0 / 40.0;
            }
        }
    }
    let ratio: f64 = sum / n;
    println!("scatter over stated variance: {ratio:.3}");
    assert!((0.7..1.4).contains(&ratio), "{ratio}");
    // Control: errors stated at 3/4 would be outside.
    assert!(!(0.7..1.4).contains(&(ratio / 0.75_f64.powi(2))), "{ratio}");
}

#[test]
fn unusable_scenes_are_refused() {
    let model = media::model("microflake").unwrap();
    let refused = |tile: VoxelTile, density: f64| {
        let scene = VolumeScene::new(tile, density, model, FiberSceneOptions::default());
        scene.unwrap_err().report()
    };
    let empty = VoxelTile::empty([2, 2, 2], 0.01, 0.0).unwrap();
    assert!(refused(empty, 400.0).contains("holds nothing"));
    assert!(refused(random_voxels(), -1.0).contains("per mm"));
    assert!(refused(random_voxels(), f64::NAN).contains("per mm"));
    let scene = VolumeScene::new(random_voxels(), 400.0, model, FiberSceneOptions::default());
    let wrong = Parameters::defaults(model).with_values(vec![0.5, 0.5, 1.5, 0.1]);
    let request = Request {
        configurations: &poses(),
        parameters: &wrong,
        effort: Effort::Paths(100),
        seed: 1,
        stream: 0,
    };
    let error = scene.unwrap().estimate(&request, &Unwatched).unwrap_err();
    assert!(error.report().contains("albedo"), "{}", error.report());
}

/// Chandrasekhar's H function of isotropic scattering at `mu`, from its integral equation (Radiative Transfer, 1960, ch. V):
/// `1/H(mu) = sqrt(1 - albedo) + albedo/2 int_0^1 t H(t) / (mu + t) dt`.
fn h_function(albedo: f64, at: &[f64]) -> Vec<f64> {
    let rule = GaussLegendre::new(64);
    let points: Vec<(f64, f64)> = rule.on(0.0, 1.0).collect();
    let mut h = vec![1.0; points.len()];
    let next = |h: &[f64], mu: f64| {
        let terms = points.iter().zip(h).map(|((t, w), h)| w * t * h / (mu + t));
        1.0 / ((1.0 - albedo).sqrt() + 0.5 * albedo * terms.sum::<f64>())
    };
    for _ in 0..3000 {
        // Half steps: whole ones swing.
        let new = points
            .iter()
            .zip(&h)
            .map(|((mu, _), old)| 0.5 * (next(&h, *mu) + old));
        h = new.collect();
    }
    at.iter().map(|mu| next(&h, *mu)).collect()
}

#[test]
fn a_deep_isotropic_medium_reflects_as_chandrasekhar_says() {
    // His table gives H(1) = 2.9078 and H(0.5) = 2.0128 at albedo 1.
    let published = h_function(1.0, &[1.0, 0.5]);
    assert!((published[0] - 2.9078).abs() < 2e-3, "{published:?}");
    assert!((published[1] - 2.0128).abs() < 2e-3, "{published:?}");
    // Flakes that point everywhere alike; optical depth 60; all orders of scattering. Sees 2 % in the reflected light, which an
    // albedo off by 1 % changes by 5 % in red.
    let albedos = [0.95, 0.7, 0.3];
    let file = json!({"albedo": albedos, "gamma": 100.0}).to_string();
    let tile = slab(30, 0.01, 1.0, DVec3::X);
    let volume = Volume {
        tile: &tile,
        density: 400.0,
        options: options(Plate::Black),
        medium: medium("microflake", &file),
    };
    let found = volume.render(Integrator::Fast, &poses(), Effort::Paths(20_000), seed(38));
    let against = |albedos: [f64; 3]| {
        let mut scores = Scores::default();
        for (e, c) in found.iter().zip(&poses()) {
            let [i, o] = directions(c).map(|w| w.z);
            for (k, albedo) in albedos.into_iter().enumerate() {
                let h = h_function(albedo, &[i, o]);
                let expected = 0.25 * albedo * i / (i + o) * h[0] * h[1];
                let se = e.standard_error[k].hypot(2.0 * LIGHT * expected);
                let what = format!("pose {} albedo {albedo}", c.id);
                scores.add(&what, (e.mean[k], se), (expected, 0.0));
            }
        }
        println!("{}", scores.sentence);
        scores
    };
    against(albedos).assert_agree();
    against(albedos.map(|a| 0.98 * a)).assert_differ();
}

/// Khungurn 2015 Figure 7: a density from 500 to 5000 per cm hardly changes cloth lit from the camera's side, but cloth lit from
/// behind.
#[test]
fn density_shows_in_transmitted_light() {
    let tile = voxelized(&felt(400, 0.2), 0.02);
    let (model, parameters) = medium("khungurn-volume", SOFT_BRIGHT);
    let both = [
        pose(1, [30.0, 180.0], [30.0, 0.0]),
        pose(2, [150.0, 180.0], [30.0, 0.0]),
    ];
    let mean = |density: f64| {
        let volume = Volume {
            tile: &tile,
            density,
            options: FiberSceneOptions {
                light: render_scenes::WIDE,
                plate: Plate::Open,
                ..FiberSceneOptions::default()
            },
            medium: (model, parameters.clone()),
        };
        let found = volume.render(Integrator::Fast, &both, Effort::Paths(8192), seed(39));
        [0, 1].map(|p| found[p].mean[0])
    };
    let [thin, dense] = [mean(50.0), mean(500.0)];
    println!("500 per cm: {thin:?}, 5000 per cm: {dense:?}");
    let [reflected, transmitted] = [0, 1].map(|p| (dense[p] / thin[p]).ln().abs());
    assert!(
        reflected < 0.4 && transmitted > 3.0 * reflected,
        "{reflected} {transmitted}"
    );
}

const SOFT_BRIGHT: &str = r#"{"c_r": [0.1, 0.3, 0.05], "c_tt": [0.85, 0.6, 0.9], "beta_r_deg": 10.0,
    "beta_tt_deg": 25.0, "gamma_tt_deg": 30.0, "albedo": [0.9, 0.9, 0.9]}"#;
