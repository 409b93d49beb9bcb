//! `goniofit render`: what a fabric would look like to the rig.

mod image;
mod image_files;
mod subject;

use super::output::data;
use super::{Outcome, inputs, terminal::Terminal};
use crate::base::{Context, Error, Result};
use crate::render::{
    DEFAULT_DENSITY, Effort, Estimates, FiberScene, FiberSceneOptions, Integrator, LightShape,
    Pictured, Request, VolumeScene,
};
use crate::rig::{LightSource, RigDescription};
use crate::scatter::{AnyModel, Parameters};
use crate::session::{SessionFolder, files};
use crate::{fabric, scatter::Model};
use serde_json::{Value, json};
use std::path::Path;
use subject::{Ready, Subject};
pub(crate) use subject::{plate, plate_in_words};

/// Estimate the mean intensities of a fabric at given parameters, or picture it
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  goniofit render means --fabric fabrics/gabardine.toml --params fabrics/params/gabardine.json \\
      --plan rig_configs/plans/khungurn16.toml --accuracy 5% --derivatives
  goniofit render means --fabric fabrics/silk_satin.toml --plate white \\
      --pose \"light=80,90 camera=32,0 rotation=45\" --json
  goniofit render image --fabric fabrics/gabardine.toml --params fabrics/params/gabardine.json \\
      --plan rig_configs/plans/khungurn16.toml --config 5 --crop 2 --derivative c_tt --out gabardine")]
pub(crate) struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(clap::Subcommand)]
enum Command {
    Means(MeansArguments),
    Image(image::ImageArguments),
}

/// Mean normalized radiance of the sample square in every configuration, with standard errors
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  goniofit render means --fabric fabrics/gabardine.toml --params fabrics/params/gabardine.json \\
      --plan rig_configs/plans/khungurn16.toml --accuracy 5%
  goniofit render means --fabric fabrics/bench_twill22.toml --params P.json \\
      --plan rig_configs/plans/khungurn16.toml --paths 100000 --seed 7 --derivatives --json
  goniofit render means --fabric fabrics/silk_satin.toml --params fabrics/params/silk.json --plate white \\
      --light-size 50 --light-distance 400 --view pinhole:800 --pose \"light=80,90 camera=32,0 rotation=45\"

The same seed gives the same numbers on any number of threads. Intensities are normalized radiance, pi L / E_normal.
Derivatives are by the model's own parameters, per radian for angles.")]
struct MeansArguments {
    #[command(flatten)]
    subject: Subject,
    /// Camera paths per configuration
    #[arg(long, value_name = "N", conflicts_with = "accuracy")]
    paths: Option<u64>,
    /// Weighted rms standard error of all numbers to reach, e.g. 1% or 0.01 [default: 5%]
    #[arg(long, value_name = "A", value_parser = inputs::fraction)]
    accuracy: Option<f64>,
    /// How paths are followed: fast, or basic (slow, plain, to check the fast one)
    #[arg(long, default_value = "fast", hide_default_value = true)]
    integrator: Integrators,
    /// Also print the derivatives by every model parameter
    #[arg(long)]
    derivatives: bool,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Integrators {
    Fast,
    Basic,
}

pub(crate) fn run(arguments: Arguments) -> Result<Outcome> {
    match arguments.command {
        Command::Means(a) => means(&a),
        Command::Image(a) => image::run(&a),
    }
}

/// Reads a fabric and makes it a scene for `model`.
pub(crate) fn fiber_scene(
    fabric: &Path,
    model: &'static dyn Model,
    options: FiberSceneOptions,
) -> Result<FiberScene> {
    let fabric = fabric::load(fabric)?;
    FiberScene::new(&fabric.tile, model, options)
        .context(|| format!("fabric '{}' cannot be rendered", fabric.name))
}

/// Reads a fabric of either kind and makes it a scene for `model`.
pub(crate) fn scene(
    fabric: &Path,
    model: AnyModel,
    options: FiberSceneOptions,
) -> Result<Box<dyn Pictured>> {
    let model = match model {
        AnyModel::Fibers(model) => return Ok(Box::new(fiber_scene(fabric, model, options)?)),
        AnyModel::Medium(model) => model,
    };
    if fabric::voxel_file(fabric).is_none() && fabric::load(fabric).is_ok() {
        let name = model.name();
        return Err(Error::new(format!(
            "fabric {} describes fibers, model {name} is one of volumes",
            fabric.display()
        ))
        .with_hint("for fibers: --model khungurn; for voxels: a description with kind = \"voxels\" (docs/fabric.md)"));
    }
    let fabric = fabric::load_voxels(fabric)?;
    let density = fabric.density_per_mm.unwrap_or(DEFAULT_DENSITY);
    let scene = VolumeScene::new(fabric.tile, density, model, options)
        .context(|| format!("fabric '{}' cannot be rendered", fabric.name))?;
    Ok(Box::new(scene))
}

/// What a rig puts around the cloth.
pub(crate) fn surroundings(rig: &RigDescription) -> Result<FiberSceneOptions> {
    around(&rig.name, &rig.light, rig.camera.sample_square_mm)
}

fn around(rig: &str, light: &LightSource, sample_square: f64) -> Result<FiberSceneOptions> {
    let [width, height] = light.size_mm;
    if (width - height).abs() > 1e-9 * width {
        return Err(Error::new(format!(
            "rig '{rig}': a light of {width} x {height} mm cannot be rendered"
        ))
        .with_hint("the renderer knows square lights"));
    }
    let light = LightShape {
        side: width,
        distance: light.distance_mm,
    };
    Ok(FiberSceneOptions {
        light,
        sample_square,
        ..FiberSceneOptions::default()
    })
}

/// What the rig of a session puts around the cloth. The rig file of an imported session may describe the light and the
/// camera alone.
pub(crate) fn surroundings_of(session: &SessionFolder) -> Result<FiberSceneOptions> {
    #[derive(serde::Deserialize)]
    struct Light {
        light: LightSource,
    }
    let manifest = session.manifest()?;
    let path = session.root().join("rig.toml");
    let Light { light } = toml::from_str(&files::read_text(&path)?)
        .context(|| format!("{} does not describe the light", path.display()))?;
    around(&manifest.rig, &light, manifest.sample_square_mm)
}

fn means(a: &MeansArguments) -> Result<Outcome> {
    let Ready {
        scene,
        parameters,
        configurations,
    } = a.subject.read(
        match a.integrator {
            Integrators::Fast => Integrator::Fast,
            Integrators::Basic => Integrator::Basic,
        },
        scene,
    )?;
    let terminal = Terminal::new()?;
    let effort = match (a.paths, a.accuracy) {
        (Some(n), _) => Effort::Paths(n),
        (None, accuracy) => Effort::Accuracy(accuracy.unwrap_or(0.05)),
    };
    let request = Request {
        configurations: &configurations,
        parameters: &parameters,
        effort,
        seed: a.subject.seed,
        stream: 0,
    };
    let estimates = scene.estimate(&request, &terminal)?;
    terminal.finish_stage();
    if a.json {
        data!("{}", as_json(&estimates, &parameters, a));
    } else {
        print_table(&estimates, &parameters, a.derivatives);
    }
    terminal.say(format!(
        "weighted rms standard error {:.2} %, {:.1} s CPU, {:.1} s elapsed",
        100.0 * estimates.weighted_rms_error(),
        estimates.cpu_s,
        estimates.wall_s
    ));
    Ok(Outcome::Done)
}

fn as_json(estimates: &Estimates, parameters: &Parameters, a: &MeansArguments) -> Value {
    let by_name = |rows: &[[f64; 3]]| {
        Value::Object(
            parameters
                .infos()
                .iter()
                .zip(rows)
                .map(|(p, d)| (p.name.to_owned(), json!(d)))
                .collect(),
        )
    };
    let configs: Vec<Value> = estimates
        .configurations
        .iter()
        .map(|e| {
            let mut row = json!({"config": e.config, "mean": e.mean, "se": e.standard_error, "paths": e.paths});
            if a.derivatives {
                row["derivatives"] = by_name(&e.derivative);
                row["derivatives_se"] = by_name(&e.derivative_se);
            }
            row
        })
        .collect();
    json!({
        "configs": configs,
        "weighted_rms_se": estimates.weighted_rms_error(),
        "cpu_s": estimates.cpu_s,
        "wall_s": estimates.wall_s,
        "seed": a.subject.seed,
        "parameters": parameters.to_json(),
    })
}

/// Head of [`table_row`]'s columns.
const TABLE_HEAD: &str = "config        r        g        b     r_se     g_se     b_se    paths";

fn table_row(config: u32, [r, g, b]: [f64; 3], [sr, sg, sb]: [f64; 3], paths: u64) -> String {
    format!("{config:6} {r:8.5} {g:8.5} {b:8.5} {sr:8.5} {sg:8.5} {sb:8.5} {paths:8}")
}

/// The derivatives of a mean by one parameter, channel by channel.
fn derivative_row(name: &str, by_channel: &[f64]) -> String {
    let numbers = by_channel.iter().map(|d| format!(" {d:12.5e}"));
    format!("       d/d {name:<13}{}", numbers.collect::<String>())
}

fn print_table(estimates: &Estimates, parameters: &Parameters, derivatives: bool) {
    data!("{TABLE_HEAD}");
    for e in &estimates.configurations {
        data!("{}", table_row(e.config, e.mean, e.standard_error, e.paths));
        if derivatives {
            for (info, d) in parameters.infos().iter().zip(&e.derivative) {
                data!("{}", derivative_row(info.name, d));
            }
        }
    }
}
