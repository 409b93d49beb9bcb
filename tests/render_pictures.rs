//! Pictures agree with the means, and say how well their pixels are known.
#![allow(clippy::unwrap_used, missing_docs)]

use goniofit::base::{Unwatched, Watch};
use goniofit::fabric;
use goniofit::math::statistics::sidak_level;
use goniofit::render::{
    Effort, FiberScene, FiberSceneOptions, Layer, Picture, PictureEffort, PictureRequest, Pictured,
    Region, Request, Scene, View,
};
use goniofit::scatter::{self, Parameters};
use goniofit::session::Configuration;
use statrs::distribution::{ContinuousCDF, Normal};
use std::path::Path;

const FABRIC: &str = "fabrics/bench_twill22.toml";

fn seed(named: u64) -> u64 {
    std::env::var("SEED").map_or(named, |s| s.parse().unwrap())
}

fn scene(view: View) -> FiberScene {
    let options = FiberSceneOptions {
        sample_square: 2.0,
        view,
        ..FiberSceneOptions::default()
    };
    let tile = fabric::load(Path::new(FABRIC)).unwrap().tile;
    FiberScene::new(&tile, scatter::model("khungurn").unwrap(), options).unwrap()
}

/// Wide lobes and little color: no rare bright paths, so that z-scores are normal at these path counts.
fn parameters() -> Parameters {
    let values = [0.1, 0.2, 0.05, 0.5, 0.4, 0.3, 0.15, 0.4, 0.5];
    Parameters::defaults(scatter::model("khungurn").unwrap()).with_values(values.into())
}

/// The first two share their camera paths.
fn poses() -> [Configuration; 3] {
    [
        Configuration::from_degrees(1, [32.0, 180.0], [32.0, 0.0], 0.0).unwrap(),
        Configuration::from_degrees(7, [50.0, 90.0], [32.0, 0.0], 0.0).unwrap(),
        Configuration::from_degrees(4, [60.0, 0.0], [70.0, 0.0], 30.0).unwrap(),
    ]
}

fn pictures(scene: &FiberScene, seed: u64, side: usize, paths: u64) -> Vec<Picture> {
    let request = PictureRequest {
        configurations: &poses(),
        parameters: &parameters(),
        region: scene.sample_square(),
        resolution: [side; 2],
        effort: PictureEffort::PathsPerPixel(paths),
        derivatives: &[4, 3, 2, 1, 0],
        seed,
    };
    scene.pictures(&request, &Unwatched).unwrap()
}

#[test]
fn the_mean_of_a_picture_is_the_mean_and_so_are_its_derivatives() {
    // 2 views x 3 poses x 3 channels x (1 mean + 5 derivatives), family-wise 1e-3. Standard errors of the means are near
    // 1 %, so a fault of 6 % in one of them would be seen, or a derivative in another's place. 45 paths per pixel are odd on
    // purpose: strata of two and of three.
    let cells = 108;
    let bound = Normal::new(0.0, 1.0)
        .unwrap()
        .inverse_cdf(1.0 - 0.5 * sidak_level(1e-3, cells));
    let (mut seen, mut wrong_mean, mut wrong_row) = (0, 0.0_f64, 0.0_f64);
    for (k, view) in [View::Orthographic, View::Pinhole { distance: 4.0 }]
        .into_iter()
        .enumerate()
    {
        let scene = scene(view);
        let request = Request {
            configurations: &poses(),
            parameters: &parameters(),
            effort: Effort::Paths(24_000),
            seed: seed(1) + k as u64,
            stream: 0,
        };
        let means = scene.estimate(&request, &Unwatched).unwrap();
        let pictures = pictures(&scene, seed(1) + k as u64, 16, 45);
        for (estimate, picture) in means.configurations.iter().zip(&pictures) {
            assert_eq!(estimate.config, picture.config);
            let scores = |layer: &Layer, mean: [f64; 3], se: [f64; 3], factor: f64| {
                let (value, error) = layer.mean();
                [0, 1, 2].map(|c| (factor * value[c] - mean[c]) / se[c].hypot(factor * error[c]))
            };
            let mut check = |what: &str, layer: &Layer, mean: [f64; 3], se: [f64; 3]| {
                for (c, z) in scores(layer, mean, se, 1.0).into_iter().enumerate() {
                    seen += 1;
                    assert!(
                        z.abs() < bound,
                        "{view:?}, pose {}, {what} {c}: z = {z}; {:?} against {mean:?} +- {se:?}",
                        estimate.config,
                        layer.mean()
                    );
                }
            };
            check(
                "mean",
                &picture.radiance,
                estimate.mean,
                estimate.standard_error,
            );
            for (layer, row) in picture.derivatives.iter().zip((0..5).rev()) {
                let (d, se) = (estimate.derivative[row], estimate.derivative_se[row]);
                check(&format!("row {row}"), layer, d, se);
            }
            // Negative controls.
            let z = scores(
                &picture.radiance,
                estimate.mean,
                estimate.standard_error,
                1.08,
            );
            wrong_mean = z.iter().fold(wrong_mean, |a, b| a.max(b.abs()));
            let (d, se) = (estimate.derivative[0], estimate.derivative_se[0]);
            let z = scores(&picture.derivatives[0], d, se, 1.0);
            wrong_row = z.iter().fold(wrong_row, |a, b| a.max(b.abs()));
        }
    }
    assert_eq!(seen, cells);
    assert!(
        wrong_mean > bound,
        "8 % too bright was not seen: {wrong_mean}"
    );
    assert!(
        wrong_row > bound,
        "a wrong derivative was not seen: {wrong_row}"
    );
}

#[test]
fn stated_standard_errors_explain_how_pixels_differ_between_seeds() {
    // Mean squared z over 576 pixels of one channel: standard error near 0.1 (chi-square 0.06, heavy tails the rest), so
    // errors stated 1.4 times too small or too large would be seen.
    let scene = scene(View::Orthographic);
    let [a, b] = [0, 1].map(|k| pictures(&scene, seed(11) + k, 24, 200));
    for (a, b) in a.iter().zip(&b) {
        for (what, a, b) in [
            ("radiance", &a.radiance, &b.radiance),
            ("derivative", &a.derivatives[3], &b.derivatives[3]),
        ] {
            let ratio = |factor: f64| {
                let pixels = a.value.iter().zip(&b.value);
                let errors = a.standard_error.iter().zip(&b.standard_error);
                let z2 = pixels.zip(errors).map(|((x, y), (s, t))| {
                    let error = factor * f64::from(s[1]).hypot(f64::from(t[1]));
                    ((f64::from(x[1]) - f64::from(y[1])) / error).powi(2)
                });
                z2.sum::<f64>() / a.value.len() as f64
            };
            let fits = |r: f64| (0.7..1.5).contains(&r);
            assert!(fits(ratio(1.0)), "{what}: mean squared z {}", ratio(1.0));
            assert!(
                !fits(ratio(0.7)) && !fits(ratio(1.4)),
                "{what}: {}",
                ratio(1.0)
            );
        }
    }
}

#[test]
fn an_asked_accuracy_of_pixels_is_reached() {
    let scene = scene(View::Orthographic);
    let request = PictureRequest {
        configurations: &poses()[2..],
        parameters: &parameters(),
        region: scene.tile(),
        resolution: [8, 8],
        effort: PictureEffort::Accuracy(0.1),
        derivatives: &[],
        seed: seed(5),
    };
    let picture = &scene.pictures(&request, &Unwatched).unwrap()[0];
    let (mean, _) = picture.radiance.mean();
    let errors = picture.radiance.standard_error.iter().flatten();
    let rms = (errors.map(|e| f64::from(*e).powi(2)).sum::<f64>() / 192.0).sqrt();
    let relative = rms / (mean.iter().sum::<f64>() / 3.0);
    assert!(
        (0.06..0.11).contains(&relative),
        "{relative} with {} paths",
        picture.paths
    );
}

#[test]
fn what_cannot_be_pictured_is_refused_by_the_library() {
    struct Impatient;
    impl Watch for Impatient {
        fn progress(&self, _: &str, _: u64, _: u64) {}
        fn cancelled(&self) -> bool {
            true
        }
    }
    let scene = scene(View::Pinhole { distance: 0.2 });
    let parameters = parameters();
    let good = PictureRequest {
        configurations: &poses()[..1],
        parameters: &parameters,
        region: scene.tile(),
        resolution: [2, 2],
        effort: PictureEffort::PathsPerPixel(2),
        derivatives: &[],
        seed: 1,
    };
    let error = |r: &PictureRequest<'_>, watch: &dyn Watch| scene.pictures(r, watch).unwrap_err();
    assert!(scene.pictures(&good, &Unwatched).is_ok());
    assert!(error(&good, &Impatient).report().contains("interrupted"));
    let grazing = [Configuration::from_degrees(3, [10.0, 0.0], [89.0, 0.0], 0.0).unwrap()];
    let inside = PictureRequest {
        configurations: &grazing,
        ..good.clone()
    };
    assert!(error(&inside, &Unwatched).report().contains("camera is"));
    let level = [Configuration::from_degrees(3, [89.99, 0.0], [10.0, 0.0], 0.0).unwrap()];
    let in_the_cloth = PictureRequest {
        configurations: &level,
        ..good.clone()
    };
    let report = error(&in_the_cloth, &Unwatched).report();
    assert!(report.contains("light's center"), "{report}");
    for resolution in [[0, 3], [3, 0], [usize::MAX, 2], [1 << 20, 1 << 20]] {
        let request = PictureRequest {
            resolution,
            ..good.clone()
        };
        assert!(
            error(&request, &Unwatched)
                .report()
                .contains("expected at least 1")
        );
    }
    for size in [[0.0, 1.0], [1.0, f64::NAN], [f64::INFINITY, 1.0]] {
        let center = [0.0; 2];
        let request = PictureRequest {
            region: Region { center, size },
            ..good.clone()
        };
        assert!(
            error(&request, &Unwatched)
                .report()
                .contains("finite region")
        );
    }
    for effort in [
        PictureEffort::PathsPerPixel(1),
        PictureEffort::Accuracy(0.0),
    ] {
        let request = PictureRequest {
            effort,
            ..good.clone()
        };
        scene.pictures(&request, &Unwatched).unwrap_err();
    }
}
