//! `goniofit fabric`.

use super::output::data;
use super::{Outcome, inputs};
use crate::base::{Context, Result};
use crate::fabric::{self, Fabric, FabricReport, Format};
use crate::report::swatch::{self, Line};
use crate::session::files;
use clap::{Parser, Subcommand, ValueEnum};
use std::path::PathBuf;

const EXAMPLES: &str = "Examples:
  goniofit fabric describe fabrics/gabardine.toml
  goniofit fabric describe fabrics/gabardine.toml --json
  goniofit fabric export fabrics/gabardine.toml --format csv --out gabardine.csv
  goniofit fabric export fabrics/gabardine.toml --format mitsuba --out gabardine.txt
  goniofit fabric import fibers.hair --tile 2.0,1.5 --out fibers.csv
  goniofit fabric picture fabrics/gabardine.toml --out gabardine.png

docs/fabric.md describes the fabric files and the fiber formats.";

/// Make, describe, export and import fibers
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Describe(Describe),
    Export(Export),
    Import(Import),
    Picture(Picture),
}

/// Say what a fabric is made of: counts, thickness, fill, overlap
#[derive(Parser)]
#[command(after_help = "Example:\n  goniofit fabric describe fabrics/bench_twill22.toml --json")]
struct Describe {
    /// Fabric description (.toml) or segments (.csv)
    fabric: PathBuf,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Write a fabric's fibers to a file other programs read
#[derive(Parser)]
#[command(
    after_help = "Examples:\n  goniofit fabric export fabrics/gabardine.toml --format csv --out gabardine.csv\n  \
                  goniofit fabric export fabrics/gabardine.toml --format hair --out gabardine.hair"
)]
struct Export {
    /// Fabric description (.toml) or segments (.csv)
    fabric: PathBuf,
    /// File format
    #[arg(long)]
    format: FormatName,
    /// File to write
    #[arg(long)]
    out: PathBuf,
    /// Replace the file if it exists
    #[arg(long)]
    force: bool,
}

/// Turn a file of fibers into segments as CSV, with the tile size in it
#[derive(Parser)]
#[command(
    after_help = "Examples:\n  goniofit fabric import scan.txt --tile 2.0,1.5 --out scan.csv\n  \
                  goniofit fabric import scan.hair --format hair --tile 2.0,1.5 --out scan.csv\n\n\
                  Lengths are millimeters. The CSV can be used wherever a fabric is asked for."
)]
struct Import {
    /// File of fibers
    file: PathBuf,
    /// File format; without it, by extension (.csv, .txt, .hair)
    #[arg(long)]
    format: Option<FormatName>,
    /// Tile size in millimeters, X,Y (the CSV holds its own)
    #[arg(long, value_parser = tile_size)]
    tile: Option<[f64; 2]>,
    /// CSV file to write
    #[arg(long)]
    out: PathBuf,
    /// Replace the file if it exists
    #[arg(long)]
    force: bool,
}

/// Draw a fabric from above and cut across, as PNG
#[derive(Parser)]
#[command(
    after_help = "Example:\n  goniofit fabric picture fabrics/gabardine.toml --out gabardine.png\n\n\
                  Plain shading for the eye, warp blue and weft orange; no scattering model."
)]
struct Picture {
    /// Fabric description (.toml) or segments (.csv)
    fabric: PathBuf,
    /// PNG file to write
    #[arg(long)]
    out: PathBuf,
    /// Width in pixels
    #[arg(long, default_value_t = 900)]
    width: u32,
    /// Replace the file if it exists
    #[arg(long)]
    force: bool,
}

#[derive(Clone, Copy, ValueEnum)]
enum FormatName {
    /// Segments as comma-separated text
    Csv,
    /// Curve text of Mitsuba 3
    Mitsuba,
    /// Cem Yuksel's binary hair file
    Hair,
}

impl From<FormatName> for Format {
    fn from(name: FormatName) -> Self {
        match name {
            FormatName::Csv => Self::Csv,
            FormatName::Mitsuba => Self::Mitsuba,
            FormatName::Hair => Self::Hair,
        }
    }
}

fn tile_size(text: &str) -> Result<[f64; 2], String> {
    let number = |t: &str| t.trim().parse::<f64>().map_err(|e| format!("'{t}': {e}"));
    let (x, y) = text
        .split_once(',')
        .ok_or("expected two numbers: X,Y in millimeters")?;
    Ok([number(x)?, number(y)?])
}

pub(crate) fn run(arguments: Arguments) -> Result<Outcome> {
    match arguments.command {
        Command::Describe(a) => describe(&a),
        Command::Export(a) => export(&a),
        Command::Import(a) => import(&a),
        Command::Picture(a) => picture(&a),
    }?;
    Ok(Outcome::Done)
}

fn describe(arguments: &Describe) -> Result<()> {
    let fabric = fabric::load(&arguments.fabric)?;
    let text = if arguments.json {
        let value = serde_json::json!({
            "name": fabric.name,
            "description": fabric.description,
            "sources": fabric.sources,
            "report": fabric.report,
        });
        let text = serde_json::to_string_pretty(&value);
        text.context(|| "the report cannot be written as JSON")?
    } else {
        in_words(&fabric)
    };
    data!("{text}");
    Ok(())
}

fn export(arguments: &Export) -> Result<()> {
    inputs::refuse_overwriting(&arguments.out, arguments.force)?;
    let fabric = fabric::load(&arguments.fabric)?;
    let bytes = fabric::export(&fabric.tile, arguments.format.into())?;
    files::write_atomic(&arguments.out, &bytes)?;
    eprintln!(
        "{}: {} fibers, {} segments, tile {} x {} mm",
        arguments.out.display(),
        fabric.report.fibers,
        fabric.report.segments,
        fabric.tile.size[0],
        fabric.tile.size[1]
    );
    if !matches!(arguments.format, FormatName::Csv) {
        eprintln!(
            "note: this format stores neither the tile size (for reading) nor the yarn system; lengths are millimeters"
        );
    }
    Ok(())
}

fn import(arguments: &Import) -> Result<()> {
    inputs::refuse_overwriting(&arguments.out, arguments.force)?;
    let format = match arguments.format {
        Some(name) => name.into(),
        None => Format::choose(None, &arguments.file)?,
    };
    let tile = fabric::import(&arguments.file, format, arguments.tile)?;
    let bytes = fabric::export(&tile, Format::Csv)?;
    files::write_atomic(&arguments.out, &bytes)?;
    eprintln!(
        "{}: {} segments, tile {} x {} mm",
        arguments.out.display(),
        tile.segments.len(),
        tile.size[0],
        tile.size[1]
    );
    Ok(())
}

fn picture(arguments: &Picture) -> Result<()> {
    inputs::refuse_overwriting(&arguments.out, arguments.force)?;
    let fabric = fabric::load(&arguments.fabric)?;
    let lines: Vec<Line> = fabric::curves(&fabric.tile)
        .into_iter()
        .map(|curve| Line {
            radius: curve.radii.iter().sum::<f64>() / curve.radii.len() as f64,
            group: curve.yarn_system.into(),
            points: curve.points,
        })
        .collect();
    let png = swatch::picture(&lines, fabric.tile.size, arguments.width)?;
    files::write_atomic(&arguments.out, &png)
}

fn in_words(fabric: &Fabric) -> String {
    let mut lines = vec![fabric.name.clone()];
    if !fabric.description.is_empty() {
        lines.push(fabric.description.clone());
    }
    lines.extend(report_lines(&fabric.report));
    lines.extend(fabric.sources.iter().map(|s| format!("source: {s}")));
    lines.extend(fabric.report.notes.iter().map(|n| format!("note: {n}")));
    lines.join("\n")
}

fn report_lines(r: &FabricReport) -> Vec<String> {
    let mut lines = Vec::new();
    let mut line = |key: &str, value: String| lines.push(format!("{key:<24}{value}"));
    line(
        "tile",
        format!("{:.4} x {:.4} mm", r.tile_mm[0], r.tile_mm[1]),
    );
    line(
        "fibers",
        format!("{} ({} without ends)", r.fibers, r.closed_fibers),
    );
    line("segments", r.segments.to_string());
    line(
        "fiber radius",
        format!(
            "{:.2} to {:.2} um",
            r.fiber_radius_um[0], r.fiber_radius_um[1]
        ),
    );
    line(
        "thickness",
        format!(
            "{:.4} mm (z {:.4} to {:.4})",
            r.thickness_mm, r.z_range_mm[0], r.z_range_mm[1]
        ),
    );
    line(
        "fiber volume fraction",
        format!("{:.3}", r.fiber_volume_fraction),
    );
    line(
        "fiber length",
        format!("{:.1} mm per mm^2", r.fiber_length_per_mm2),
    );
    line(
        "mass",
        r.mass_g_per_m2.map_or_else(
            || "unknown (no density)".to_owned(),
            |m| format!("{m:.0} g/m^2"),
        ),
    );
    line("sharpest joint", format!("{:.2} deg", r.largest_joint_deg));
    if let Some(error) = r.chord_error_um {
        line("chord error", format!("{error:.3} um"));
    }
    line(
        "fiber overlap",
        format!(
            "{:.0} % of fiber length runs into another fiber, {:.0} % has its axis inside one",
            100.0 * r.fiber_overlap,
            100.0 * r.fiber_axis_inside
        ),
    );
    if let Some(overlap) = r.yarn_overlap {
        line(
            "yarn overlap",
            format!(
                "{:.1} % of yarn volume lies inside the other system",
                100.0 * overlap
            ),
        );
    }
    for s in &r.systems {
        line(
            s.system,
            format!(
                "{} yarns x {} fibers x {} segments, pitch {} mm, twist {} and migration {} per tile",
                s.yarns,
                s.fibers_per_yarn,
                s.segments_per_fiber,
                s.pitch_mm,
                s.twist_per_tile,
                s.migration_per_tile
            ),
        );
        line(
            "",
            format!(
                "packing {:.2}, crimp {:.1} %, sharpest bend {:.3} mm ({:.1} x half thickness), side overlap {:.1} %",
                s.packing,
                100.0 * s.crimp,
                s.min_bend_radius_mm,
                s.bend_ratio,
                100.0 * s.side_overlap
            ),
        );
    }
    lines
}
