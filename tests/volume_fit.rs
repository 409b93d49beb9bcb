//! Fits, predictions and renders of volumes: by the library, and by the commands with a fabric of voxels.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

#[path = "common/render_scenes.rs"]
mod render_scenes;
#[path = "common/volumes.rs"]
mod volumes;

use assert_cmd::Command;
use glam::DVec3;
use goniofit::base::Unwatched;
use goniofit::fabric::VoxelTile;
use goniofit::fit::{Budget, FitResult, Options, fit};
use goniofit::render::{Effort, FiberSceneOptions, Integrator, Request, Scene};
use goniofit::scatter::Parameters;
use goniofit::scatter::media::MediumModel;
use goniofit::session::{Configuration, Intensity, Measurements};
use render_scenes::{WIDE, pose, seed};
use serde_json::Value;
use std::path::Path;
use tempfile::TempDir;
use volumes::{Volume, medium, random_voxels, slab};

fn poses() -> Vec<Configuration> {
    vec![
        pose(1, [20.0, 180.0], [30.0, 0.0]),
        pose(2, [45.0, 180.0], [30.0, 0.0]),
        pose(3, [60.0, 0.0], [30.0, 0.0]),
        pose(4, [45.0, 90.0], [30.0, 0.0]),
        pose(5, [70.0, 180.0], [65.0, 0.0]),
        pose(6, [70.0, 90.0], [65.0, 0.0]),
    ]
}

/// A fit of what a volume shows at `truth`.
fn fitted(
    tile: &VoxelTile,
    (model, truth): (&'static dyn MediumModel, &Parameters),
    paths: u64,
) -> FitResult {
    let volume = Volume {
        tile,
        density: 40.0,
        options: FiberSceneOptions {
            light: WIDE,
            ..FiberSceneOptions::default()
        },
        medium: (model, truth.clone()),
    };
    let scene = volume.scene(Integrator::Fast);
    let request = Request {
        configurations: &poses(),
        parameters: truth,
        effort: Effort::Paths(100_000),
        seed: seed(41),
        stream: 77,
    };
    let rendered = scene.estimate(&request, &Unwatched).unwrap();
    let intensities = poses().into_iter().zip(rendered.configurations);
    let intensity = |(configuration, e): (Configuration, goniofit::render::Estimate)| Intensity {
        configuration,
        mean: e.mean,
        standard_error: e.standard_error,
        present: [true; 3],
    };
    let measurements = Measurements {
        intensities: intensities.map(intensity).collect(),
    };
    let budget = Budget {
        paths: Some(paths),
        ..Budget::default()
    };
    fit(
        &scene,
        &measurements,
        &Options::new(seed(42), budget),
        &Unwatched,
    )
    .unwrap()
}

/// Within twice its 95 % interval, four standard errors, that must be narrower than `most`.
fn assert_found(result: &FitResult, truth: &Parameters, place: usize, most: f64) {
    let (p, value) = (&result.uncertainty[place], truth.values()[place]);
    let [low, high] = p.interval_95;
    let half = 0.5 * (high - low);
    println!(
        "{}: truth {value}, {}",
        truth.flat_names()[place],
        p.sentence
    );
    assert!(half < most, "interval {low} to {high}");
    assert!(
        (p.value - value).abs() < 2.0 * half + 1e-3,
        "{} is not {value}: {low} {high}",
        p.value
    );
}

#[test]
fn a_fit_returns_the_flakes_of_a_volume() {
    let file = r#"{"albedo": [0.6, 0.9, 0.3], "gamma": 0.3}"#;
    let (model, truth) = medium("microflake", file);
    // Aligned fibers: of fibers in all directions gamma could not be told.
    let tile = slab(8, 0.02, 0.6, DVec3::new(0.9, 0.3, 0.3).normalize());
    let result = fitted(&tile, (model, &truth), 600_000);
    (0..3).for_each(|place| assert_found(&result, &truth, place, 0.05));
    assert_found(&result, &truth, 3, 0.2);
}

#[test]
fn a_fit_explains_a_volume_of_twelve_parameters() {
    let file = r#"{"c_r": [0.2, 0.1, 0.3], "c_tt": [0.7, 0.8, 0.6], "beta_r_deg": 7.0, "beta_tt_deg": 20.0,
                   "gamma_tt_deg": 25.0, "albedo": [0.9, 0.7, 0.5]}"#;
    let (model, truth) = medium("khungurn-volume", file);
    let result = fitted(&random_voxels(), (model, &truth), 600_000);
    // Six poses do not tell twelve parameters apart, but albedos they tell, and the means they explain.
    (9..12).for_each(|place| assert_found(&result, &truth, place, 0.2));
    println!("misfit {} %", result.objective.misfit_percent);
    assert!(result.objective.misfit_percent < 3.0);
}

fn goniofit(arguments: &[&str], folder: &Path) -> (i32, String, String) {
    let mut command = Command::cargo_bin("goniofit").unwrap();
    let done = command
        .current_dir(folder)
        .args(arguments)
        .output()
        .unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (
        done.status.code().unwrap(),
        text(&done.stdout),
        text(&done.stderr),
    )
}

/// A folder with a fabric of voxels.
fn place() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    random_voxels()
        .write(&folder.path().join("cloth.nrrd"))
        .unwrap();
    let fabric =
        "kind = \"voxels\"\nname = \"cloth\"\nfile = \"cloth.nrrd\"\ndensity_per_mm = 40.0\n";
    std::fs::write(folder.path().join("cloth.toml"), fabric).unwrap();
    let parameters = r#"{"albedo": [0.6, 0.9, 0.3], "gamma": 0.3}"#;
    std::fs::write(folder.path().join("flakes.json"), parameters).unwrap();
    folder
}

const POSES: [&str; 4] = [
    "--pose",
    "light=20,180 camera=30,0 rotation=0",
    "--pose",
    "light=60,0 camera=30,0 rotation=0",
];

#[test]
fn commands_take_fabrics_of_voxels() {
    let folder = place();
    let means = [
        &[
            "render",
            "means",
            "--fabric",
            "cloth.toml",
            "--model",
            "microflake",
            "--params",
            "flakes.json",
        ][..],
        &["--paths", "20000", "--json", "--derivatives"],
        &POSES,
    ]
    .concat();
    let (code, out, error) = goniofit(&means, folder.path());
    assert_eq!(code, 0, "{error}");
    let rendered: Value = serde_json::from_str(&out).unwrap();
    assert!(rendered["configs"][0]["derivatives"]["gamma"][0].is_number());
    // The file of voxels alone is a fabric too, of the usual density, ten times as dense.
    let alone: Vec<&str> = (means.iter())
        .map(|word| word.strip_suffix("toml").map_or(*word, |_| "cloth.nrrd"))
        .collect();
    let (code, out, error) = goniofit(&alone, folder.path());
    assert_eq!(code, 0, "{error}");
    let denser: Value = serde_json::from_str(&out).unwrap();
    assert_ne!(denser["configs"][0]["mean"], rendered["configs"][0]["mean"]);

    let mut csv = "config,light_theta_deg,light_phi_deg,camera_theta_deg,camera_phi_deg,rotation_deg,r,g,b,r_se,g_se,b_se\n".to_owned();
    for (row, pose) in rendered["configs"]
        .as_array()
        .unwrap()
        .iter()
        .zip(["20,180,30,0,0", "60,0,30,0,0"])
    {
        let numbers = |key: &str| -> Vec<String> {
            row[key]
                .as_array()
                .unwrap()
                .iter()
                .map(Value::to_string)
                .collect()
        };
        csv += &format!(
            "{},{pose},{},{}\n",
            row["config"],
            numbers("mean").join(","),
            numbers("se").join(",")
        );
    }
    std::fs::write(folder.path().join("m.csv"), csv).unwrap();
    let fit = [
        "fit",
        "--measurements",
        "m.csv",
        "--fabric",
        "cloth.toml",
        "--model",
        "microflake",
        "--paths",
        "200000",
        "--out",
        "fit",
    ];
    let (code, _, error) = goniofit(&fit, folder.path());
    assert!(code < 2, "{error}");
    let predict = [
        "predict",
        "--fit",
        "fit",
        "--measurements",
        "m.csv",
        "--paths",
        "20000",
        "--json",
    ];
    let (code, out, error) = goniofit(&predict, folder.path());
    assert_eq!(code, 0, "{error}");
    assert!(out.contains("configs"), "{out}");
    let validate = [
        "validate",
        "--fit",
        "fit",
        "--measurements",
        "m.csv",
        "--fabric",
        "cloth.toml",
        "--fast",
        "--predict-paths",
        "20000",
        "--json",
    ];
    let (code, _, error) = goniofit(&validate, folder.path());
    assert!(code < 2, "{error}");
}

#[test]
fn wrong_pairs_of_fabric_and_model_are_refused() {
    let folder = place();
    let fails = |more: &[&str], expected: &str| {
        let arguments = [&["render", "means", "--paths", "64"], more, &POSES[..]].concat();
        let (code, _, error) = goniofit(&arguments, folder.path());
        assert!(
            code == 2 && error.contains(expected) && error.contains("hint:"),
            "{code} {error}"
        );
    };
    for voxels in ["cloth.toml", "cloth.nrrd"] {
        fails(&["--fabric", voxels], "describes voxels, expected fibers");
    }
    let twill = concat!(env!("CARGO_MANIFEST_DIR"), "/fabrics/bench_twill22.toml");
    fails(
        &["--fabric", twill, "--model", "microflake"],
        "describes fibers, model microflake",
    );
    fails(
        &["--fabric", "cloth.toml", "--model", "microflakes"],
        "unknown model",
    );
    let bytes = std::fs::read(folder.path().join("cloth.nrrd")).unwrap();
    std::fs::write(folder.path().join("cloth.nrrd"), &bytes[..bytes.len() - 8]).unwrap();
    let model = ["--fabric", "cloth.toml", "--model", "microflake"];
    let arguments = [
        &["render", "means", "--paths", "64"],
        &model[..],
        &POSES[..],
    ]
    .concat();
    let (code, _, error) = goniofit(&arguments, folder.path());
    assert!(code == 2 && error.contains("cloth.nrrd"), "{code} {error}");
}
