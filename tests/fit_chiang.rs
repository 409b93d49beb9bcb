//! A fit takes a second model by its parameters' names: on a small felt it returns the hair color it was rendered with.
#![allow(
    clippy::unwrap_used,
    clippy::float_cmp,
    clippy::print_stdout,
    missing_docs
)]

#[path = "common/render_scenes.rs"]
mod render_scenes;

use goniofit::base::Unwatched;
use goniofit::fit::{Budget, Options, fit};
use goniofit::math::PolarDirection;
use goniofit::render::{Effort, FiberScene, FiberSceneOptions, LightShape, Request, Scene};
use goniofit::scatter::{Chiang, Parameters};
use goniofit::session::{Configuration, Intensity, Measurements};
use render_scenes::felt;

fn seed() -> u64 {
    std::env::var("SEED").map_or(31, |s| s.parse().unwrap())
}

#[test]
fn a_fit_returns_the_hair_color_of_a_felt() {
    let options = FiberSceneOptions {
        light: LightShape {
            side: 300.0,
            distance: 610.0,
        },
        ..FiberSceneOptions::default()
    };
    let scene = FiberScene::new(&felt(120, 0.2), &Chiang, options).unwrap();
    let configurations: Vec<Configuration> = (1..)
        .zip([
            (20.0, 180.0),
            (45.0, 180.0),
            (60.0, 0.0),
            (45.0, 90.0),
            (70.0, 180.0),
        ])
        .map(|(id, (theta, phi))| Configuration {
            id,
            light: PolarDirection::from_degrees(theta, phi),
            camera: PolarDirection::from_degrees(30.0, 0.0),
            rotation: 0.0,
        })
        .collect();
    let truth = [0.6, 0.3, 0.12, 0.35, 0.45];
    let truth = Parameters::defaults(&Chiang).with_values(truth.to_vec());
    let request = Request {
        configurations: &configurations,
        parameters: &truth,
        effort: Effort::Paths(100_000),
        seed: seed(),
        stream: 77,
    };
    let rendered = scene.estimate(&request, &Unwatched).unwrap();
    let intensities = configurations
        .iter()
        .zip(rendered.configurations)
        .map(|(configuration, e)| Intensity {
            configuration: *configuration,
            mean: e.mean,
            standard_error: e.standard_error,
            present: [true; 3],
        })
        .collect();
    let budget = Budget {
        paths: Some(600_000),
        ..Budget::default()
    };
    let fitted = fit(
        &scene,
        &Measurements { intensities },
        &Options::new(seed(), budget),
        &Unwatched,
    )
    .unwrap();
    let names = truth.flat_names();
    assert_eq!(names[..3], ["color.r", "color.g", "color.b"]);
    for (j, (p, name)) in fitted.uncertainty.iter().zip(&names).enumerate() {
        let (value, [low, high]) = (truth.values()[j], p.interval_95);
        println!("{name}: truth {value}, {}", p.sentence);
        if j < 3 {
            // Twice the interval: four standard errors of three numbers.
            let half = 0.5 * (high - low);
            assert!((p.value - value).abs() < 2.0 * half, "{name}: {low} {high}");
            // Green and blue must also be determined, and the start, 0.5, excluded.
            assert!(j == 0 || (half < 0.1 && high < 0.5), "{name}: {low} {high}");
        }
    }
}
