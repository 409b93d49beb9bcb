//! `goniofit plan suggest`.

use super::{save, within_reach};
use crate::base::{Error, Result};
use crate::cli::output::{data, pose_degrees};
use crate::cli::{Outcome, fit, inputs, render, terminal::Terminal};
use crate::fit::{
    Aim, Bounds, Knowledge, MeasuredPose, SuggestOptions, Suggestion, TAU, suggest, three_digits,
};
use crate::render::FiberSceneOptions;
use crate::rig::RigDescription;
use crate::scatter::{self, Model, Parameters};
use crate::session::{Configuration, FrameKind, Plan, protocols};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Directions nearer than this are the same.
const SAME: f64 = 1e-6;

/// Which poses to measure next: those that shrink what a fit leaves least known
///
/// Candidates are all pairs of a grid of light and camera directions in the sample frame, less those measured already.
/// With --rig only poses within its limits and clearance are suggested, turned as a whole where that brings them within
/// reach. What the poses buy is told from renders that had no part in choosing them.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  goniofit plan suggest --fit trial/fit --rig rig_configs/five_axis_grblhal.toml --out next.toml
  goniofit plan suggest --fit fit.json --fabric fabrics/gabardine.toml --aim beta_r --shots 2 --json
  goniofit plan suggest --params P.json --plan rig_configs/plans/khungurn16.toml --fabric F.toml --error 1%

The plan in --out holds the poses measured so far and the suggested ones; `goniofit capture` visits all of them.
share: standard deviation as a share of that of a parameter of which only the bounds are known; 100 % = nothing known.")]
#[command(group(clap::ArgGroup::new("known").required(true).args(["fit", "params"])))]
pub(super) struct SuggestArguments {
    /// An earlier fit: its parameters, poses and measurement errors (fit.json, or the folder that holds it)
    #[arg(long, value_name = "FIT")]
    fit: Option<PathBuf>,
    /// Model parameters instead of a fit (JSON)
    #[arg(long, value_name = "P.json", requires = "fabric")]
    params: Option<PathBuf>,
    /// With --params: the poses measured already; none when left out
    #[arg(long, value_name = "P.toml", conflicts_with = "fit")]
    plan: Option<PathBuf>,
    /// With --params: the scattering model
    #[arg(long, default_value = "khungurn", conflicts_with = "fit")]
    model: String,
    /// Fabric description (TOML) [default: the fit's]
    #[arg(long, value_name = "F.toml")]
    fabric: Option<PathBuf>,
    /// Only poses this rig reaches; its light and sample square are rendered
    #[arg(long, value_name = "R.toml")]
    rig: Option<PathBuf>,
    /// How many poses to suggest
    #[arg(long, value_name = "N", default_value_t = 4)]
    shots: usize,
    /// What to make known: weakest (at each shot the parameter known worst of those some pose informs about), all (D-optimal), or a parameter's name
    #[arg(long, value_name = "AIM", default_value = "weakest")]
    aim: String,
    /// Standard error of a new measurement relative to its brightness [default: the rms of the fit's measurements]
    #[arg(long, value_name = "A", value_parser = inputs::fraction)]
    error: Option<f64>,
    /// Candidates: polar angles of the light
    #[arg(
        long,
        help_heading = "Candidates",
        value_name = "DEG,..",
        value_delimiter = ',',
        default_value = "0,20,40,60,80"
    )]
    light_theta: Vec<f64>,
    /// Azimuths of the light, sample frame
    #[arg(
        long,
        help_heading = "Candidates",
        value_name = "DEG,..",
        value_delimiter = ',',
        default_value = "0,45,90,135,180,225,270,315",
        allow_negative_numbers = true
    )]
    light_phi: Vec<f64>,
    /// Polar angles of the camera
    #[arg(
        long,
        help_heading = "Candidates",
        value_name = "DEG,..",
        value_delimiter = ',',
        default_value = "0,20,40,60,80"
    )]
    camera_theta: Vec<f64>,
    /// Azimuths of the camera, sample frame; half a circle suffices for a weave that looks the same turned by 180 degrees
    #[arg(
        long,
        help_heading = "Candidates",
        value_name = "DEG,..",
        value_delimiter = ',',
        default_value = "0,45,90,135",
        allow_negative_numbers = true
    )]
    camera_phi: Vec<f64>,
    /// Smallest angle between light and camera
    #[arg(
        long,
        help_heading = "Candidates",
        value_name = "DEG",
        default_value_t = 10.0
    )]
    apart_deg: f64,
    /// Camera paths per camera direction and render of the candidates; the measured and the chosen poses get eight times as
    /// many
    #[arg(long, value_name = "N", default_value_t = 10_000)]
    paths: u64,
    /// Selects the random streams
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
    /// Write the poses so far and the suggested ones as a plan
    #[arg(long, value_name = "P.toml")]
    out: Option<PathBuf>,
    /// Replace an existing file
    #[arg(long)]
    force: bool,
}

/// What is known before the next shot.
struct Known {
    model: &'static dyn Model,
    parameters: Parameters,
    measured: Vec<MeasuredPose>,
    fabric: Option<PathBuf>,
    relative_error: Option<f64>,
    model_error: f64,
    tau: f64,
    bounds: Bounds,
    surroundings: FiberSceneOptions,
}

impl Known {
    /// From an earlier fit; the light and the sample square are those of the session its measurements lie in.
    fn of_fit(path: &Path) -> Result<Self> {
        let result = inputs::fit_result(path)?;
        let model = scatter::model(&result.model)?;
        let measured = result.configs.iter();
        let plate = fit::plate_of(&result)?;
        let rms = 0.01 * result.objective.measurement_rms_percent;
        Ok(Self {
            model,
            parameters: Parameters::from_json(model, &result.parameters)?,
            measured: measured
                .map(|c| (c.configuration, Some(c.measured_se)))
                .collect(),
            relative_error: (rms > 0.0).then_some(rms),
            model_error: 0.01 * result.objective.misfit_percent,
            surroundings: fit::surroundings_of(Path::new(&result.measurements), plate)?.0,
            tau: result.tau,
            bounds: result.bounds,
            fabric: Some(PathBuf::from(result.fabric)),
        })
    }

    fn of_parameters(path: &Path, a: &SuggestArguments) -> Result<Self> {
        let model = scatter::model(&a.model)?;
        let plan = a.plan.as_deref().map(Plan::read).transpose()?;
        let poses = plan.map_or(Vec::new(), |p| p.configurations);
        Ok(Self {
            model,
            parameters: inputs::parameters(path, model)?,
            measured: poses.into_iter().map(|c| (c, None)).collect(),
            fabric: None,
            relative_error: None,
            model_error: 0.0,
            tau: TAU,
            bounds: Bounds::default(),
            surroundings: FiberSceneOptions::default(),
        })
    }
}

pub(super) fn run(a: &SuggestArguments) -> Result<Outcome> {
    if let Some(out) = &a.out {
        inputs::refuse_overwriting(out, a.force)?;
    }
    let known = match (&a.fit, &a.params) {
        (Some(fit), _) => Known::of_fit(fit)?,
        (None, Some(params)) => Known::of_parameters(params, a)?,
        (None, None) => return Err(Error::new("neither --fit nor --params was given")),
    };
    let rig = a.rig.as_deref().map(RigDescription::read).transpose()?;
    let options = options(a, &known)?;
    let (grid, candidates) = candidates(a, &known.measured, rig.as_ref())?;
    let plate = known.surroundings.plate;
    let surroundings = rig
        .as_ref()
        .map_or(Ok(known.surroundings), render::surroundings)?;
    let surroundings = FiberSceneOptions {
        plate,
        ..surroundings
    };
    let fabric = a.fabric.as_ref().or(known.fabric.as_ref());
    let fabric = fabric.ok_or_else(|| Error::new("--fabric was not given"))?;
    let scene = render::fiber_scene(fabric, known.model, surroundings)?;
    let terminal = Terminal::new()?;
    let suggestion = suggest(
        &scene,
        &known.parameters,
        &known.measured,
        &candidates,
        &options,
        &terminal,
    )?;
    terminal.finish_stage();
    let plan = whole_plan(&known.measured, &suggestion);
    if a.json {
        data!("{}", as_json(&suggestion, &options, grid, rig.as_ref()));
    } else {
        print_table(&suggestion, &options, grid, rig.as_ref());
    }
    if let Some(out) = &a.out {
        save(&plan, out, a.force, &terminal)?;
    }
    Ok(Outcome::Done)
}

fn options(a: &SuggestArguments, known: &Known) -> Result<SuggestOptions> {
    let relative_error = a.error.or(known.relative_error).ok_or_else(|| {
        Error::new("the error of a new measurement is not known")
            .with_hint("state it relative to the brightness: --error 1%")
    })?;
    Ok(SuggestOptions {
        shots: a.shots,
        aim: match a.aim.as_str() {
            "weakest" => Aim::Weakest,
            "all" => Aim::All,
            name => Aim::Parameter(name.to_owned()),
        },
        relative_error,
        tau: known.tau,
        bounds: known.bounds.clone(),
        model_error: known.model_error,
        paths: a.paths,
        seed: a.seed,
    })
}

/// The size of the grid, and those of its poses that may be suggested, numbered on from the measured ones.
fn candidates(
    a: &SuggestArguments,
    measured: &[MeasuredPose],
    rig: Option<&RigDescription>,
) -> Result<(usize, Vec<Configuration>)> {
    let grid = protocols::grid(&protocols::Grid {
        light_theta_deg: a.light_theta.clone(),
        light_phi_deg: a.light_phi.clone(),
        camera_theta_deg: a.camera_theta.clone(),
        camera_phi_deg: a.camera_phi.clone(),
    })?
    .configurations;
    let apart = a.apart_deg.to_radians().cos();
    let [light, camera] = [
        |c: &Configuration| c.light_in_sample().vector(),
        |c: &Configuration| c.camera_in_sample().vector(),
    ];
    let same = |a: &Configuration, b: &Configuration| {
        light(a).distance(light(b)) < SAME && camera(a).distance(camera(b)) < SAME
    };
    let mut poses: Vec<Configuration> = Vec::new();
    let mut last = measured.iter().map(|(c, _)| c.id).max().unwrap_or(0);
    for c in &grid {
        let seen = measured.iter().map(|(m, _)| m).chain(&poses);
        if light(c).dot(camera(c)) > apart || seen.into_iter().any(|m| same(m, c)) {
            continue;
        }
        let reached = rig.map_or(Ok(*c), |rig| within_reach(rig, c, true));
        if let Ok(c) = reached {
            last += 1;
            poses.push(Configuration { id: last, ..c });
        }
    }
    if let (Some(rig), true) = (rig, poses.is_empty()) {
        return Err(
            Error::new(format!("rig {} reaches no pose of the grid", rig.name))
                .with_hint("give polar angles and azimuths within the limits of its axes"),
        );
    }
    Ok((grid.len(), poses))
}

/// The measured poses and the suggested ones, which get the numbers after theirs.
fn whole_plan(measured: &[MeasuredPose], suggestion: &Suggestion) -> Plan {
    let old = measured.iter().map(|(c, _)| *c);
    Plan {
        name: "suggested".to_owned(),
        description: format!(
            "{} poses measured before and {} suggested to make the parameters better known",
            measured.len(),
            suggestion.shots.len()
        ),
        shows: FrameKind::Sample,
        configurations: old
            .chain(suggestion.shots.iter().map(|s| s.configuration))
            .collect(),
    }
}

fn as_json(
    suggestion: &Suggestion,
    options: &SuggestOptions,
    grid: usize,
    rig: Option<&RigDescription>,
) -> Value {
    let shots: Vec<Value> = suggestion
        .shots
        .iter()
        .map(|s| {
            let [light_theta, light_phi, camera_theta, camera_phi, rotation] =
                pose_degrees(&s.configuration);
            json!({
                "config": s.configuration.id,
                "light_theta_deg": light_theta, "light_phi_deg": light_phi,
                "camera_theta_deg": camera_theta, "camera_phi_deg": camera_phi,
                "rotation_deg": rotation,
                "mean": s.mean, "mean_se": s.mean_se,
                "chosen_for": s.chosen_for, "better_than_median": s.better_than_median,
                "parameters_after": s.after,
            })
        })
        .collect();
    json!({
        "grid": grid,
        "candidates": suggestion.candidates,
        "rig": rig.map(|r| &r.name),
        "clearance_checked": rig.is_some_and(RigDescription::clearance_is_checked),
        "measurement_error": options.relative_error,
        "model_error": options.model_error,
        "paths": suggestion.paths,
        "seed": options.seed,
        "parameters_now": suggestion.now,
        "shots": shots,
    })
}

fn print_table(
    suggestion: &Suggestion,
    options: &SuggestOptions,
    grid: usize,
    rig: Option<&RigDescription>,
) {
    data!(
        "config  light theta,phi  camera theta,phi  turn    expected r g b         chosen for  vs median"
    );
    for s in &suggestion.shots {
        let [lt, lp, ct, cp, turn] = pose_degrees(&s.configuration);
        let [r, g, b] = s.mean;
        data!(
            "{:>6}  {lt:>6.1} {lp:>8.1}  {ct:>7.1} {cp:>8.1}  {turn:>6.1}  {r:>7.4} {g:>7.4} {b:>7.4}  {:<10}  x {:.2}",
            s.configuration.id,
            s.chosen_for.as_deref().unwrap_or("all"),
            s.better_than_median
        );
    }
    data!("");
    data!("parameter        value      95 % interval now     share     with these shots     share");
    let after = suggestion
        .shots
        .last()
        .map_or(&suggestion.now, |s| &s.after);
    for (now, after) in suggestion.now.iter().zip(after) {
        data!(
            "{:<10} {:>11}  {:>19} {:>9}  {:>19} {:>9}  {}",
            now.name,
            three_digits(now.value),
            interval(now),
            share(now),
            interval(after),
            share(after),
            if now.unit == "1" { "" } else { "deg" }
        );
    }
    data!(
        "# share: standard deviation as a share of that of a parameter of which only the bounds are known"
    );
    data!(
        "# {} candidates of a grid of {grid} poses{}; measurements to {:.2} %, model to {:.2} % of the brightness",
        suggestion.candidates,
        rig.map_or(String::new(), |r| format!(
            ", within reach of rig {}",
            r.name
        )),
        100.0 * options.relative_error,
        100.0 * options.model_error
    );
    if suggestion.shots.len() < options.shots {
        data!(
            "# {} shots were asked for; of the other candidates these renders see none that helps",
            options.shots
        );
    }
    let unknown = after.iter().filter(|k| k.share_unknown > 0.5);
    let unknown: Vec<&str> = unknown.map(|k| k.name.as_str()).collect();
    if !unknown.is_empty() {
        data!(
            "# still unknown: {}; more --paths may show poses that tell",
            unknown.join(", ")
        );
    }
    data!("# ?: known to no better than half of itself from these renders; more --paths tell");
}

fn interval(k: &Knowledge) -> String {
    let [low, high] = k.interval_95.map(three_digits);
    format!("{low} to {high}")
}

fn share(k: &Knowledge) -> String {
    let doubt = if k.share_unknown_noise > 0.5 {
        " ?"
    } else {
        ""
    };
    format!("{:.1} %{doubt}", 100.0 * k.share_unknown)
}
