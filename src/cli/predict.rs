//! `goniofit predict`.

use super::output::{data, pose_degrees};
use super::{Outcome, fit, inputs, render, terminal::Terminal};
use crate::base::{Error, Result};
use crate::fit::{Compared, Comparison, FitResult, Prediction, compare, predict};
use crate::render::{Effort, FiberSceneOptions, Plate, Scene};
use crate::rig::RigDescription;
use crate::scatter::AnyModel;
use crate::session::{Configuration, Measurements, Plan};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Predict the means of any poses from a fit, with what is not known of them; compare them with measurements
///
/// Errors are listed apart: of the parameters (the fit's covariance through the derivatives), of the renders, and of the
/// model itself as the fit's residual shows it.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  goniofit predict --fit trial/fit --plan irawan.toml > predicted.csv
  goniofit predict --fit fit.json --fabric fabrics/gabardine.toml --measurements others.csv
  goniofit predict --fit fit.json --plan P.toml --accuracy 0.5% --json
  goniofit predict --fit fit.json --plan P.toml --plate white > on_white.csv

With --measurements the predictions are compared: residual (predicted minus measured) and z, the residual over all errors
together. A pose the fit has seen (in_fit) proves nothing. Intensities are normalized radiance, pi L / E_normal.")]
#[command(group(clap::ArgGroup::new("poses").required(true).multiple(true).args(["plan", "measurements"])))]
pub(crate) struct Arguments {
    /// The fit (fit.json, or the folder that holds it)
    #[arg(long, value_name = "FIT")]
    fit: PathBuf,
    /// Fabric: description (TOML), fibers (.csv) or voxels (.nrrd) [default: the fit's]
    #[arg(long, value_name = "F")]
    fabric: Option<PathBuf>,
    /// Poses to predict [default: the measured ones]
    #[arg(long, value_name = "P.toml")]
    plan: Option<PathBuf>,
    /// Measured intensities of these poses, to compare with
    #[arg(long, value_name = "M.csv|M.json")]
    measurements: Option<PathBuf>,
    /// Rig whose light and sample square to render [default: those of the session the fit's measurements lie in]
    #[arg(long, value_name = "R.toml")]
    rig: Option<PathBuf>,
    /// Under the cloth: black, open (nothing), white, or an albedo A or R,G,B [default: the fit's]
    #[arg(long, value_name = "P", value_parser = render::plate)]
    plate: Option<Plate>,
    /// Camera paths per configuration and render, of two
    #[arg(long, value_name = "N", conflicts_with = "accuracy")]
    paths: Option<u64>,
    /// Weighted rms standard error of one render to reach, e.g. 1% or 0.01; two are made [default: 1%]
    #[arg(long, value_name = "A", value_parser = inputs::fraction)]
    accuracy: Option<f64>,
    /// Selects the random streams
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print JSON instead of CSV
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(a: Arguments) -> Result<Outcome> {
    let result = inputs::fit_result(&a.fit)?;
    let measurements = a
        .measurements
        .as_deref()
        .map(Measurements::read)
        .transpose()?;
    let poses = match (&a.plan, &measurements) {
        (Some(plan), _) => Plan::read(plan)?.configurations,
        (None, Some(m)) => m.intensities.iter().map(|i| i.configuration).collect(),
        (None, None) => return Err(Error::new("neither --plan nor --measurements was given")),
    };
    let scene = scene_of(&result, a.fabric.as_deref(), a.rig.as_deref(), a.plate)?;
    let effort = match a.paths {
        Some(n) => Effort::Paths(n),
        None => Effort::Accuracy(a.accuracy.unwrap_or(0.01)),
    };
    let terminal = Terminal::new()?;
    let predictions = predict(&*scene, &result, &poses, &effort, a.seed, &terminal)?;
    terminal.finish_stage();
    let comparison = measurements
        .map(|m| compare(&predictions, &m, result.tau))
        .transpose()?;
    match (&comparison, a.json) {
        (Some(comparison), true) => data!("{}", comparison_json(comparison)),
        (None, true) => {
            let rows: Vec<Value> = predictions.iter().map(prediction_json).collect();
            data!("{}", json!({ "configs": rows }));
        }
        (Some(comparison), false) => {
            print_comparison(comparison);
            terminal.say(summary(comparison));
        }
        (None, false) => print_predictions(&predictions),
    }
    Ok(Outcome::Done)
}

/// The scene a fit's parameters belong to; `fabric`, `rig` and `plate` replace what the fit says.
pub(super) fn scene_of(
    result: &FitResult,
    fabric: Option<&Path>,
    rig: Option<&Path>,
    plate: Option<Plate>,
) -> Result<Box<dyn Scene>> {
    let plate = plate.map_or_else(|| fit::plate_of(result), Ok)?;
    let surroundings = match rig {
        Some(rig) => FiberSceneOptions {
            plate,
            ..render::surroundings(&RigDescription::read(rig)?)?
        },
        None => fit::surroundings_of(Path::new(&result.measurements), plate)?.0,
    };
    let fabric = fabric.unwrap_or(Path::new(&result.fabric));
    Ok(render::scene(
        fabric,
        AnyModel::named(&result.model)?,
        surroundings,
    )?)
}

/// The pose's columns of `measurements.csv`.
const POSE_COLUMNS: &str =
    "config,light_theta_deg,light_phi_deg,camera_theta_deg,camera_phi_deg,rotation_deg";

fn columns(name: &str) -> String {
    ["r", "g", "b"].map(|c| format!(",{c}{name}")).concat()
}

fn cells(numbers: [Option<f64>; 3]) -> String {
    let cell = |x: Option<f64>| x.map_or(",".to_owned(), |x| format!(",{x:.6}"));
    numbers.map(cell).concat()
}

fn pose_cells(c: &Configuration) -> String {
    let angles = pose_degrees(c).map(|a| format!(",{a}")).concat();
    format!("{}{angles}", c.id)
}

fn print_predictions(predictions: &[Prediction]) {
    let names = ["", "_parameter_se", "_monte_carlo_se", "_model_se"];
    data!("{POSE_COLUMNS}{}", names.map(columns).concat());
    for p in predictions {
        let numbers = [p.mean, p.parameter_se, p.monte_carlo_se, p.model_se];
        data!(
            "{}{}",
            pose_cells(&p.configuration),
            numbers.map(|n| cells(n.map(Some))).concat()
        );
    }
}

/// The table of predicted against measured means.
pub(super) fn print_comparison(comparison: &Comparison) {
    let names = [
        "_predicted",
        "_parameter_se",
        "_monte_carlo_se",
        "_model_se",
        "_measured",
        "_measured_se",
        "_residual",
        "_z",
    ];
    data!("{POSE_COLUMNS}{},in_fit", names.map(columns).concat());
    for row in &comparison.rows {
        let p = &row.prediction;
        let predicted = [p.mean, p.parameter_se, p.monte_carlo_se, p.model_se];
        let [mean, parameter_se, monte_carlo_se, model_se] = predicted.map(|n| n.map(Some));
        let m = &row.measured;
        let numbers = [
            mean,
            parameter_se,
            monte_carlo_se,
            model_se,
            m.where_present(m.mean),
            m.where_present(m.standard_error),
            row.residual,
            row.z,
        ];
        data!(
            "{}{},{}",
            pose_cells(&p.configuration),
            numbers.map(cells).concat(),
            p.in_fit
        );
    }
}

/// One line about a comparison.
pub(super) fn summary(comparison: &Comparison) -> String {
    let [rms, se] = comparison.weighted_rms_percent;
    let seen = comparison
        .rows
        .iter()
        .filter(|r| r.prediction.in_fit)
        .count();
    let note = match seen {
        0 => String::new(),
        n => format!("; {n} of the poses were in the fit"),
    };
    format!(
        "weighted rms residual {rms:.2} +- {se:.2} % over {} configurations; rms z {:.2} (1 = as large as the errors stated){note}",
        comparison.rows.len(),
        comparison.rms_z
    )
}

fn prediction_json(p: &Prediction) -> Value {
    let [light_theta, light_phi, camera_theta, camera_phi, rotation] =
        pose_degrees(&p.configuration);
    json!({
        "config": p.configuration.id,
        "light_theta_deg": light_theta, "light_phi_deg": light_phi,
        "camera_theta_deg": camera_theta, "camera_phi_deg": camera_phi,
        "rotation_deg": rotation,
        "predicted": p.mean, "parameter_se": p.parameter_se, "monte_carlo_se": p.monte_carlo_se,
        "model_se": p.model_se, "in_fit": p.in_fit, "paths": p.paths,
    })
}

fn compared_json(row: &Compared) -> Value {
    let mut object = prediction_json(&row.prediction);
    object["measured"] = json!(row.measured.where_present(row.measured.mean));
    let se = row.measured.standard_error;
    object["measured_se"] = json!(row.measured.where_present(se));
    object["residual"] = json!(row.residual);
    object["z"] = json!(row.z);
    object
}

/// A comparison as JSON.
pub(super) fn comparison_json(comparison: &Comparison) -> Value {
    let [rms, se] = comparison.weighted_rms_percent;
    json!({
        "configs": comparison.rows.iter().map(compared_json).collect::<Vec<_>>(),
        "weighted_rms_percent": rms,
        "weighted_rms_se_percent": se,
        "rms_z": comparison.rms_z,
    })
}
