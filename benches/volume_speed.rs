//! CPU seconds to 1 % over Khungurn's 48 numbers on a volume, one JSON line per medium and tracker, and what a flight costs.
//!
//! `cargo bench --bench volume_speed [-- --quick] [--only NAME] [--side UM] [--error E]`
//!
//! The volume is `fabrics/bench_twill22.toml` in voxels of 20 um (`--side`), 400 per mm dense. Media: the volume BCSDF with the
//! published fibers (Khungurn 2015 Table IV; their albedo is taken to be what a fiber sends on, `C_R + C_TT (1 - C_R)`), and
//! microflakes of the same albedo. Errors are weighted rms over the 48 numbers as a run states them (Khungurn 2015 eq. 20).
//! Derivatives and pilots are included. Processor time depends on what else the machine does: compare within one run.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

#[path = "../tests/common/volumes.rs"]
mod volumes;

use goniofit::base::Unwatched;
use goniofit::fabric::{self, VoxelTile};
use goniofit::render::{
    DEFAULT_DENSITY, Effort, Estimates, FiberSceneOptions, Integrator, Request, Scene, VolumeScene,
};
use goniofit::scatter::Parameters;
use goniofit::scatter::media::{self, MediumModel};
use goniofit::session::Plan;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

const MATERIALS: [&str; 4] = ["fleece", "gabardine", "silk", "cotton"];

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn argument(name: &str) -> Option<String> {
    let mut all = std::env::args().skip_while(|a| a != name);
    all.nth(1)
}

/// The medium of a material's fibers.
fn volume_of(material: &str) -> (&'static dyn MediumModel, Parameters) {
    let file = root().join(format!("fabrics/params/{material}.json"));
    let mut object: Value = serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap();
    object["albedo"] = json!(albedo(&object));
    let model = media::model("khungurn-volume").unwrap();
    (model, Parameters::from_json(model, &object).unwrap())
}

fn albedo(object: &Value) -> Vec<f64> {
    let of = |key: &str, c: usize| object[key][c].as_f64().unwrap();
    (0..3)
        .map(|c| of("c_r", c) + of("c_tt", c) * (1.0 - of("c_r", c)))
        .collect()
}

fn flakes_of(material: &str) -> (&'static dyn MediumModel, Parameters) {
    let (_, fibers) = volume_of(material);
    let object = json!({"albedo": fibers.channels("albedo"), "gamma": 0.1});
    let model = media::model("microflake").unwrap();
    (model, Parameters::from_json(model, &object).unwrap())
}

struct Bench {
    tile: VoxelTile,
    plan: Plan,
    error: f64,
}

impl Bench {
    fn scene(&self, model: &'static dyn MediumModel, integrator: Integrator) -> VolumeScene {
        let options = FiberSceneOptions {
            integrator,
            ..FiberSceneOptions::default()
        };
        VolumeScene::new(self.tile.clone(), DEFAULT_DENSITY, model, options).unwrap()
    }

    fn row(&self, name: &str, tracker: &str, medium: &(&'static dyn MediumModel, Parameters)) {
        let (integrator, effort) = match tracker {
            "fast" => (Integrator::Fast, Effort::Accuracy(self.error)),
            _ => (Integrator::Basic, Effort::Paths(4096)),
        };
        let request = Request {
            configurations: &self.plan.configurations,
            parameters: &medium.1,
            effort,
            seed: 1,
            stream: 0,
        };
        let scene = self.scene(medium.0, integrator);
        let found = scene.estimate(&request, &Unwatched).unwrap();
        let (cpu_s, error) = (found.cpu_s, found.weighted_rms_error());
        println!(
            "{}",
            json!({
                "material": name, "model": medium.0.name(), "tracker": tracker, "voxels": self.tile.shape(),
                "cpu_s": cpu_s, "error": error, "cpu_s_for_1pct": cpu_s * (error / 0.01).powi(2),
                "us_per_path": 1e6 * cpu_s / paths(&found), "mean_of_all": mean(&found),
            })
        );
    }
}

fn paths(e: &Estimates) -> f64 {
    e.configurations.iter().map(|c| c.paths as f64).sum()
}

fn mean(e: &Estimates) -> f64 {
    let all = e.configurations.iter().flat_map(|c| c.mean);
    all.sum::<f64>() / (3 * e.configurations.len()) as f64
}

fn main() {
    let quick = std::env::args().any(|a| a == "--quick");
    let side = argument("--side").map_or(20.0, |s| s.parse::<f64>().unwrap());
    let default = if quick { 0.1 } else { 0.03 };
    let error = argument("--error").map_or(default, |e| e.parse().unwrap());
    let only = argument("--only");
    let fibers = fabric::load(&root().join("fabrics/bench_twill22.toml")).unwrap();
    let bench = Bench {
        tile: volumes::voxelized(&fibers.tile, 1e-3 * side),
        plan: Plan::read(Path::new(&root().join("rig_configs/plans/khungurn16.toml"))).unwrap(),
        error,
    };
    if let Some(path) = argument("--write") {
        bench.tile.write(Path::new(&path)).unwrap();
    }
    let speed = bench.scene(media::model("khungurn-volume").unwrap(), Integrator::Fast);
    let (_, medium) = volume_of("gabardine");
    println!(
        "{}",
        json!({"flights": speed.flight_speed(&medium, 100_000, 1).unwrap().lines()})
    );
    for material in MATERIALS {
        if only.as_ref().is_some_and(|o| o != material) {
            continue;
        }
        bench.row(material, "fast", &volume_of(material));
        bench.row(material, "fast", &flakes_of(material));
        if !quick {
            bench.row(material, "basic", &volume_of(material));
        }
    }
}
