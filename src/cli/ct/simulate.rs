//! `goniofit ct simulate`.

use super::{micrometers, report_json};
use crate::base::{Context, Result};
use crate::cli::inputs;
use crate::cli::output::data;
use crate::cli::terminal::Terminal;
use crate::fabric;
use crate::fabric::ct::{Simulating, simulate};
use crate::session::files;
use clap::Parser;
use std::path::PathBuf;

/// Scan known fibers virtually: gray voxels with blur and noise, to see what would be found in a real scan
#[derive(Parser)]
#[command(
    after_help = "Examples:\n  goniofit ct simulate fabrics/gabardine.toml --voxel-um 5 --out virtual\n  \
                  goniofit ct simulate fabrics/bench_twill22.toml --voxel-um 5 --blur-um 3.5 --noise 0.1 --truth --out virtual\n\n\
                  Writes volume.nrrd (air 0, fiber 1, before noise), simulate.json, and with --truth truth.nrrd: share of fiber and its direction.\n\
                  No projections are made: there are no rings, streaks or beam hardening."
)]
pub(super) struct Arguments {
    /// Fabric description (.toml) or segments (.csv)
    fabric: PathBuf,
    /// Side of a voxel, micrometers; changed a little so that whole voxels make the tile
    #[arg(long, value_parser = micrometers)]
    voxel_um: f64,
    /// Air above and below the cloth, micrometers
    #[arg(long, default_value_t = 50.0)]
    margin_um: f64,
    /// Standard deviation of the Gaussian that blurs, micrometers
    #[arg(long, default_value_t = 0.0)]
    blur_um: f64,
    /// Standard deviation of white noise, as a share of the step from air to fiber
    #[arg(long, default_value_t = 0.0)]
    noise: f64,
    /// Of the noise
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Write the true density and directions too
    #[arg(long)]
    truth: bool,
    /// Folder for the result
    #[arg(long)]
    out: PathBuf,
    /// Replace results that exist
    #[arg(long)]
    force: bool,
}

pub(super) fn run(arguments: &Arguments, terminal: &Terminal) -> Result<()> {
    let [volume, truth, json_file] =
        ["volume.nrrd", "truth.nrrd", "simulate.json"].map(|n| arguments.out.join(n));
    for file in [&volume, &truth, &json_file] {
        inputs::refuse_overwriting(file, arguments.force)?;
    }
    inputs::prepare_folder(&arguments.out)?;
    let cloth = fabric::load(&arguments.fabric)?;
    let options = Simulating {
        voxel: 1e-3 * arguments.voxel_um,
        margin: 1e-3 * arguments.margin_um,
        blur: 1e-3 * arguments.blur_um,
        noise: arguments.noise,
        seed: arguments.seed,
    };
    let made = simulate(&cloth.tile, &options, terminal)
        .context(|| format!("{} cannot be scanned", arguments.fabric.display()))?;
    made.gray.write(&volume)?;
    if arguments.truth {
        made.truth.write(&truth)?;
    }
    let mut json = report_json("goniofit-ct-simulated-1", &options)?;
    json["fabric"] = serde_json::json!(arguments.fabric);
    json["dims"] = serde_json::json!(made.gray.shape);
    json["voxel_mm"] = serde_json::json!(made.gray.side);
    json["stretch_y"] = serde_json::json!(made.stretch);
    files::write_atomic(&json_file, format!("{json:#}\n").as_bytes())?;
    let [nx, ny, nz] = made.gray.shape;
    let n = (nx * ny * nz) as f64;
    let fiber: f64 = made.truth.density().iter().map(|d| f64::from(*d)).sum();
    terminal.say(format!(
        "{nx} x {ny} x {nz} voxels of {:.4} um, {:.2} % fiber; stretched along y by {:.4}",
        1e3 * made.gray.side,
        100.0 * fiber / n,
        made.stretch
    ));
    data!("{}", volume.display());
    Ok(())
}
