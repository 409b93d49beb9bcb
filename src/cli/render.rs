//! `goniofit render`: what a fabric would look like to the rig.

use super::output::data;
use super::{Outcome, inputs, terminal::Terminal};
use crate::base::{Context, Error, Result};
use crate::render::{
    Effort, Estimates, FiberScene, FiberSceneOptions, Integrator, LightShape, Request, Scene,
};
use crate::rig::{LightSource, RigDescription};
use crate::scatter::{self, Parameters};
use crate::session::{Plan, SessionFolder, files};
use crate::{fabric, scatter::Model};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Estimate the mean intensities of a fabric at given parameters
#[derive(clap::Args)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(clap::Subcommand)]
enum Command {
    Means(MeansArguments),
}

/// Mean normalized radiance of the sample square in every configuration of a plan, with standard errors
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  goniofit render means --fabric fabrics/gabardine.toml --params fabrics/params/gabardine.json \\
      --plan rig_configs/plans/khungurn16.toml --accuracy 5%
  goniofit render means --fabric fabrics/bench_twill22.toml --params P.json \\
      --plan rig_configs/plans/khungurn16.toml --paths 100000 --seed 7 --derivatives --json

The same seed gives the same numbers on any number of threads. Intensities are normalized radiance, pi L / E_normal.
Derivatives are by the model's own parameters, per radian for angles.")]
struct MeansArguments {
    /// Fabric description (TOML)
    #[arg(long, value_name = "F.toml")]
    fabric: PathBuf,
    /// Scattering model
    #[arg(long, default_value = "khungurn")]
    model: String,
    /// Model parameters (JSON); the published defaults when left out
    #[arg(long, value_name = "P.json")]
    params: Option<PathBuf>,
    /// Configurations to render (TOML)
    #[arg(long, value_name = "PLAN.toml")]
    plan: PathBuf,
    /// Rig whose light and sample square to render; 10 cm at 61 cm and 1 cm when left out
    #[arg(long, value_name = "RIG.toml")]
    rig: Option<PathBuf>,
    /// Camera paths per configuration
    #[arg(long, value_name = "N", conflicts_with = "accuracy")]
    paths: Option<u64>,
    /// Weighted rms standard error of all numbers to reach, e.g. 1% or 0.01 [default: 5%]
    #[arg(long, value_name = "A", value_parser = inputs::fraction)]
    accuracy: Option<f64>,
    /// How paths are followed: fast, or basic (slow, plain, to check the fast one)
    #[arg(long, default_value = "fast", hide_default_value = true)]
    integrator: Integrators,
    /// Selects the random streams
    #[arg(long, default_value_t = 1)]
    seed: u64,
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
    let model = scatter::model(&a.model)?;
    let plan = Plan::read(&a.plan)?;
    let parameters = match &a.params {
        Some(path) => inputs::parameters(path, model)?,
        None => Parameters::defaults(model),
    };
    let terminal = Terminal::new()?;
    let options = a.rig.as_deref().map(RigDescription::read).transpose()?;
    let options = options.map_or(Ok(FiberSceneOptions::default()), |rig| surroundings(&rig))?;
    let integrator = match a.integrator {
        Integrators::Fast => Integrator::Fast,
        Integrators::Basic => Integrator::Basic,
    };
    let options = FiberSceneOptions {
        integrator,
        ..options
    };
    let scene = fiber_scene(&a.fabric, model, options)?;
    let effort = match (a.paths, a.accuracy) {
        (Some(n), _) => Effort::Paths(n),
        (None, accuracy) => Effort::Accuracy(accuracy.unwrap_or(0.05)),
    };
    let request = Request {
        configurations: &plan.configurations,
        parameters: &parameters,
        effort,
        seed: a.seed,
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
        "seed": a.seed,
        "parameters": parameters.to_json(),
    })
}

fn print_table(estimates: &Estimates, parameters: &Parameters, derivatives: bool) {
    data!("config        r        g        b     r_se     g_se     b_se    paths");
    for e in &estimates.configurations {
        let ([r, g, b], [sr, sg, sb]) = (e.mean, e.standard_error);
        data!(
            "{:6} {r:8.5} {g:8.5} {b:8.5} {sr:8.5} {sg:8.5} {sb:8.5} {:8}",
            e.config,
            e.paths
        );
        if derivatives {
            for (info, d) in parameters.infos().iter().zip(&e.derivative) {
                data!(
                    "       d/d {:<9} {:12.5e} {:12.5e} {:12.5e}",
                    info.name,
                    d[0],
                    d[1],
                    d[2]
                );
            }
        }
    }
}
