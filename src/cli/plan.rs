//! `goniofit plan`: make plans, check which poses a rig can reach, suggest the next.

mod suggest;

use super::output::data;
use super::terminal::Terminal;
use super::{Outcome, inputs};
use crate::base::{Error, Result};
use crate::math::PolarDirection;
use crate::rig::RigDescription;
use crate::session::{Configuration, Plan, files, protocols};
use clap::{Args, Subcommand};
use std::path::{Path, PathBuf};

/// Make the plan of a published measurement or a grid, check a plan against a rig, or suggest the next poses
#[derive(Args)]
#[command(after_help = "Examples:
  goniofit plan irawan --out irawan.toml
  goniofit plan grid --light-theta 0,30,60 --light-phi 0,90 --camera-theta 0,45 --out grid.toml
  goniofit plan check irawan.toml --rig rig_configs/five_axis_grblhal.toml --turn --out reachable.toml
  goniofit plan suggest --fit trial/fit --rig rig_configs/five_axis_grblhal.toml --out next.toml")]
pub(crate) struct Arguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    Irawan(IrawanArguments),
    Khungurn(KhungurnArguments),
    Grid(GridArguments),
    Check(CheckArguments),
    Suggest(Box<suggest::SuggestArguments>),
}

/// Where a plan goes.
#[derive(Args)]
struct Target {
    /// Plan file to write; standard output when left out
    #[arg(long, value_name = "P.toml")]
    out: Option<PathBuf>,
    /// Replace an existing file
    #[arg(long)]
    force: bool,
}

/// 225 incident x 7 exitant directions of Irawan 2008: 1575 configurations
///
/// Incident directions are the cell centers of a 15 x 15 grid under the concentric map of Shirley and Chiu, polar angle
/// proportional to the radius on the disk; the rim of the disk is at --max-theta-deg, the outermost centers at 14/15 of it.
#[derive(Args)]
struct IrawanArguments {
    /// Polar angle of the map's rim, degrees
    #[arg(long, value_name = "DEG", default_value_t = 75.0)]
    max_theta_deg: f64,
    #[command(flatten)]
    target: Target,
}

/// The 16 configurations of Khungurn 2015
#[derive(Args)]
struct KhungurnArguments {
    #[command(flatten)]
    target: Target,
}

/// Every light direction of a list with every camera direction of a list
#[derive(Args)]
#[command(after_help = "Angles are in degrees, directions in the sample frame.

Example:
  goniofit plan grid --light-theta 0,20,40,60 --light-phi 0,90,180,270 --camera-theta 0,45 --camera-phi 0,90")]
struct GridArguments {
    /// Polar angles of the light
    #[arg(long, value_name = "DEG,..", value_delimiter = ',', required = true)]
    light_theta: Vec<f64>,
    /// Azimuths of the light
    #[arg(
        long,
        value_name = "DEG,..",
        value_delimiter = ',',
        default_value = "0",
        allow_negative_numbers = true
    )]
    light_phi: Vec<f64>,
    /// Polar angles of the camera
    #[arg(
        long,
        value_name = "DEG,..",
        value_delimiter = ',',
        default_value = "0"
    )]
    camera_theta: Vec<f64>,
    /// Azimuths of the camera
    #[arg(
        long,
        value_name = "DEG,..",
        value_delimiter = ',',
        default_value = "0",
        allow_negative_numbers = true
    )]
    camera_phi: Vec<f64>,
    #[command(flatten)]
    target: Target,
}

/// Which poses of a plan a rig can reach: limits and clearance of every pose
///
/// The ways between the poses are checked by `goniofit capture --dry-run`. Exit code 1 when some pose is out of reach.
#[derive(Args)]
struct CheckArguments {
    /// Plan to check
    plan: PathBuf,
    /// Rig description
    #[arg(long, value_name = "R.toml")]
    rig: PathBuf,
    /// Turn light, camera and turntable of a pose together where that brings it within reach; the sample sees the same
    #[arg(long)]
    turn: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Write the poses within reach as a plan
    #[arg(long, value_name = "P.toml")]
    out: Option<PathBuf>,
    /// Replace an existing file
    #[arg(long)]
    force: bool,
}

pub(crate) fn run(arguments: Arguments) -> Result<Outcome> {
    match arguments.what {
        What::Irawan(a) => write(&protocols::irawan(a.max_theta_deg)?, &a.target),
        What::Khungurn(a) => write(&protocols::khungurn16()?, &a.target),
        What::Grid(a) => {
            let plan = protocols::grid(&protocols::Grid {
                light_theta_deg: a.light_theta,
                light_phi_deg: a.light_phi,
                camera_theta_deg: a.camera_theta,
                camera_phi_deg: a.camera_phi,
            })?;
            write(&plan, &a.target)
        }
        What::Check(a) => check(&a),
        What::Suggest(a) => suggest::run(&a),
    }
}

fn write(plan: &Plan, target: &Target) -> Result<Outcome> {
    let Some(out) = &target.out else {
        data!("{}", plan.to_toml()?.trim_end());
        return Ok(Outcome::Done);
    };
    save(plan, out, target.force, &Terminal::new()?)?;
    Ok(Outcome::Done)
}

fn save(plan: &Plan, out: &Path, force: bool, terminal: &Terminal) -> Result<()> {
    inputs::refuse_overwriting(out, force)?;
    files::write_atomic(out, plan.to_toml()?.as_bytes())?;
    let n = plan.configurations.len();
    terminal.say(format!("wrote {} ({n} configurations)", out.display()));
    Ok(())
}

fn check(a: &CheckArguments) -> Result<Outcome> {
    let rig = RigDescription::read(&a.rig)?;
    let plan = Plan::read(&a.plan)?;
    let mut reachable = plan.clone();
    reachable.configurations.clear();
    let mut refused: Vec<(u32, String)> = Vec::new();
    for c in &plan.configurations {
        match within_reach(&rig, c, a.turn) {
            Ok(c) => reachable.configurations.push(c),
            Err(error) => refused.push((c.id, error.to_string())),
        }
    }
    tell(a, &rig, &plan, &refused)?;
    if let Some(out) = &a.out {
        if reachable.configurations.is_empty() {
            return Err(Error::new(format!(
                "rig {} reaches no pose of plan {}",
                rig.name, plan.name
            ))
            .with_hint("compare the plan's angles with the axes' limits in the rig file"));
        }
        if reachable != plan {
            reachable.name += "-reachable";
            reachable.description += &format!("; the poses rig {} can reach", rig.name);
        }
        save(&reachable, out, a.force, &Terminal::new()?)?;
    }
    Ok(if refused.is_empty() {
        Outcome::Done
    } else {
        Outcome::OutsideTolerance
    })
}

/// Steps in which light, camera and turntable are turned together, degrees.
const STEP_DEG: u32 = 5;

/// The pose if the rig reaches it; with `turn`, or else the first that differs only by a common turn of light, camera and
/// turntable about the normal: the directions are the same as seen from the sample.
fn within_reach(rig: &RigDescription, c: &Configuration, turn: bool) -> Result<Configuration> {
    let check = |c: &Configuration| -> Result<()> { rig.check_pose_clearance(&rig.angles(c)?) };
    let Err(error) = check(c) else {
        return Ok(*c);
    };
    let by_deg = (1..360 / STEP_DEG).filter(|_| turn);
    let mut turned = by_deg.map(|k| {
        let by = f64::from(k * STEP_DEG).to_radians();
        let half = std::f64::consts::PI;
        let wrap = |a: f64| (a + by + half).rem_euclid(2.0 * half) - half;
        Configuration {
            light: PolarDirection::new(c.light.theta, wrap(c.light.phi)),
            camera: PolarDirection::new(c.camera.theta, wrap(c.camera.phi)),
            rotation: wrap(c.rotation),
            ..*c
        }
    });
    turned.find(|c| check(c).is_ok()).ok_or(error)
}

fn tell(
    a: &CheckArguments,
    rig: &RigDescription,
    plan: &Plan,
    refused: &[(u32, String)],
) -> Result<()> {
    let n = plan.configurations.len();
    if a.json {
        let refused: Vec<_> = refused
            .iter()
            .map(|(config, why)| serde_json::json!({"config": config, "reason": why}))
            .collect();
        data!(
            "{}",
            serde_json::json!({
                "rig": rig.name, "plan": plan.name, "configurations": n,
                "reachable": n - refused.len(), "refused": refused,
                "clearance_checked": rig.clearance_is_checked(),
            })
        );
        return Ok(());
    }
    for (config, why) in refused {
        data!("{config:>6}  {why}");
    }
    data!(
        "# rig {} reaches {} of the {n} poses of plan {}; limits {}",
        rig.name,
        n - refused.len(),
        plan.name,
        if rig.clearance_is_checked() {
            "and clearance checked, pose by pose"
        } else {
            "checked; clearance not: the rig file names no bodies"
        }
    );
    Ok(())
}
