//! `goniofit ct fibers`.

use super::{inside, micrometers, report_json};
use crate::base::{Context, Error, Result};
use crate::cli::inputs;
use crate::cli::output::data;
use crate::cli::terminal::Terminal;
use crate::fabric::ct::{FiberScore, TraceReport, Tracing, compare, trace, transfer};
use crate::fabric::{self, Format, VoxelTile, export};
use crate::session::files;
use clap::Parser;
use std::path::PathBuf;

/// Trace fibers through oriented voxels, for renders and fits
#[derive(Parser)]
#[command(
    after_help = "Examples:\n  goniofit ct fibers cloth --radius-um 8 --out cloth.csv\n  \
                  goniofit ct fibers cloth/oriented.nrrd --radius-um auto --per-system --out cloth.hair --json\n  \
                  goniofit ct fibers virtual --radius-um 8 --truth fabrics/gabardine.toml --out found.csv\n\n\
                  The CSV can be used wherever a fabric is asked for: goniofit render means, goniofit fit.\n\
                  A measured radius (--radius-um) is worth more than a found one, which mostly follows the threshold on density."
)]
pub(super) struct Arguments {
    /// Oriented voxels, or the folder with oriented.nrrd in it
    oriented: PathBuf,
    /// Fiber radius in micrometers, or auto: the one whose cylinders cover the voxels best
    #[arg(long)]
    radius_um: String,
    /// With auto: a radius for warp and one for weft
    #[arg(long)]
    per_system: bool,
    /// Largest distance of a center from where its fiber was foretold, radii
    #[arg(long, default_value_t = Tracing::default().gate)]
    gate: f64,
    /// Least response of a center, as a share of the mean density of fiber
    #[arg(long, default_value_t = Tracing::default().least_response)]
    least_response: f64,
    /// Leave lines in the pieces they are found in
    #[arg(long)]
    no_join: bool,
    /// Drop lines with fewer vertices, about a voxel apart
    #[arg(long, default_value_t = Tracing::default().least_vertices)]
    least_vertices: usize,
    /// Weight of places found against smoothness
    #[arg(long, default_value_t = Tracing::default().alpha)]
    alpha: f64,
    /// File for the fibers (.csv, .txt as Mitsuba's curves, .hair)
    #[arg(long)]
    out: PathBuf,
    /// Format of that file, instead of by its name: csv, mitsuba, hair
    #[arg(long)]
    format: Option<String>,
    /// Also write voxels that have the direction of a fiber within two radii (.nrrd)
    #[arg(long)]
    transfer: Option<PathBuf>,
    /// Compare with the fibers of this fabric (of a virtual scan)
    #[arg(long)]
    truth: Option<PathBuf>,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
    /// Replace files that exist
    #[arg(long)]
    force: bool,
}

pub(super) fn run(arguments: &Arguments, terminal: &Terminal) -> Result<()> {
    let radius = match arguments.radius_um.as_str() {
        "auto" => None,
        text => Some(
            1e-3 * micrometers(text)
                .map_err(|e| Error::new(format!("--radius-um {text}: {e}, or auto")))?,
        ),
    };
    let format = Format::choose(arguments.format.as_deref(), &arguments.out)?;
    for file in [Some(&arguments.out), arguments.transfer.as_ref()] {
        file.map_or(Ok(()), |f| inputs::refuse_overwriting(f, arguments.force))?;
    }
    let truth = arguments.truth.as_deref().map(fabric::load).transpose()?;
    let path = inside(&arguments.oriented, "oriented.nrrd");
    let tile = VoxelTile::read(&path)?;
    let options = Tracing {
        radius,
        per_system: arguments.per_system,
        gate: arguments.gate,
        least_response: arguments.least_response,
        join: !arguments.no_join,
        least_vertices: arguments.least_vertices,
        alpha: arguments.alpha,
    };
    let (fibers, report) = trace(&tile, &options, terminal)
        .context(|| format!("fibers in {} cannot be traced", path.display()))?;
    files::write_atomic(&arguments.out, &export(&fibers, format)?)?;
    terminal.say(in_words(&report));
    let mut json = report_json("goniofit-ct-fibers-1", &report)?;
    if let Some(out) = &arguments.transfer {
        let reach = 2.0 * report.radius_mm[0].max(report.radius_mm[1]);
        let (moved, share) = transfer(&tile, &fibers, reach)?;
        moved.write(out)?;
        json["transferred_share"] = serde_json::json!(share);
        terminal.say(format!(
            "{}: {:.1} % of the voxels have the direction of a fiber",
            out.display(),
            100.0 * share
        ));
    }
    if let Some(truth) = truth {
        let score = compare(&truth.tile, &fibers);
        json["score"] =
            serde_json::to_value(&score).context(|| "the score cannot be written as JSON")?;
        terminal.say(score_in_words(&score));
    }
    if arguments.json {
        data!("{json:#}");
    } else {
        data!("{}", arguments.out.display());
    }
    Ok(())
}

fn in_words(r: &TraceReport) -> String {
    let mut lines = vec![format!(
        "{} fibers, {:.2} mm in all, half of them with {} vertices or more; {} joints",
        r.fibers, r.length_mm, r.vertices_median, r.joints
    )];
    for found in &r.found_radius {
        let [low, high] = found.range.map(|v| 1e3 * v);
        lines.push(format!(
            "radius {:.2} um, perhaps {low:.2} to {high:.2}: {:.2} by covering, {:.2} by volume; a measured one is worth more",
            1e3 * found.radius,
            1e3 * found.by_covering,
            1e3 * found.by_volume
        ));
    }
    lines.extend(r.notes.iter().map(|n| format!("note: {n}")));
    lines.join("\n")
}

fn score_in_words(s: &FiberScore) -> String {
    format!(
        "against the truth: recall {:.3} (steep {:.3}), precision {:.3}, direction {:.1} degrees at the median and {:.1} at 90 %, \
         {:.2} um off the axes, {:.2} changes of fiber per mm, {:.1} pieces a fiber",
        s.recall,
        s.recall_steep,
        s.precision,
        s.direction_median,
        s.direction_90,
        1e3 * s.position_rms,
        s.switches_per_mm,
        s.pieces
    )
}
