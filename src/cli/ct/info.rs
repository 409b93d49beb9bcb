//! `goniofit ct info`.

use super::Source;
use crate::base::{Context, Result};
use crate::cli::output::data;
use crate::cli::terminal::Terminal;
use crate::fabric::ct::{Statistics, Volume, statistics};
use clap::Parser;
use std::path::PathBuf;

/// Say what a volume is: size, type, voxels, range, quantiles, threshold
#[derive(Parser)]
#[command(
    after_help = "Examples:\n  goniofit ct info scan/ --voxel-um 5\n  goniofit ct info scan.mhd --unit um --json\n\n\
                  Reads the volume twice. The threshold is Otsu's: a suggestion, good where air and fiber make two hills in the histogram."
)]
pub(super) struct Arguments {
    #[command(flatten)]
    source: Source,
    /// Folder for unpacked voxels of packed files (nameless files that vanish at the end)
    #[arg(long, default_value_os_t = std::env::temp_dir())]
    scratch: PathBuf,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub(super) fn run(arguments: &Arguments, terminal: &Terminal) -> Result<()> {
    let volume = arguments.source.open(&arguments.scratch, terminal)?;
    let found = statistics(&volume, arguments.source.memory(), terminal).context(|| {
        format!(
            "volume {} cannot be used",
            arguments.source.volume.display()
        )
    })?;
    let mut notes = volume.notes().to_vec();
    notes.extend(volume.byte_order_warning()?);
    if let Err(anisotropic) = volume.cubic_voxel_mm() {
        notes.push(anisotropic.report().replace("\nhint:", ";"));
    }
    terminal.finish_stage();
    if arguments.json {
        data!("{:#}", json(&volume, &found, &notes));
    } else {
        data!("{}", in_words(&volume, &found, &notes));
    }
    Ok(())
}

fn voxel_um(volume: &Volume) -> [f64; 3] {
    volume.voxel_mm().map(|v| (v * 1e9).round() / 1e6)
}

fn size_mm(volume: &Volume) -> [f64; 3] {
    let (dims, voxel) = (volume.dims(), volume.voxel_mm());
    [0, 1, 2].map(|k| (dims[k] as f64 * voxel[k] * 1e9).round() / 1e9)
}

fn json(volume: &Volume, found: &Statistics, notes: &[String]) -> serde_json::Value {
    serde_json::json!({
        "format": volume.format(),
        "dims": volume.dims(),
        "axes": volume.axes().to_string(),
        "type": volume.sample(),
        "voxel_um": voxel_um(volume),
        "size_mm": size_mm(volume),
        "origin_mm": volume.origin_mm(),
        "voxels": found.voxels,
        "min": found.min,
        "max": found.max,
        "mean": found.mean,
        "quantiles": found.quantiles.iter().map(|(share, value)| serde_json::json!({"share": share, "value": value})).collect::<Vec<_>>(),
        "otsu": found.otsu,
        "nonempty_share": found.nonempty,
        "notes": notes,
    })
}

fn in_words(volume: &Volume, found: &Statistics, notes: &[String]) -> String {
    let mut lines = Vec::new();
    let mut line = |key: &str, value: String| lines.push(format!("{key:<16}{value}"));
    let times = |n: [f64; 3]| format!("{} x {} x {}", n[0], n[1], n[2]);
    let [nx, ny, nz] = volume.dims();
    line("format", volume.format().to_owned());
    line(
        "voxels",
        format!(
            "{nx} x {ny} x {nz} ({} million)",
            (found.voxels as f64 / 1e4).round() / 1e2
        ),
    );
    line("file axes", volume.axes().to_string());
    line("type", volume.sample().to_string());
    line("voxel size", format!("{} um", times(voxel_um(volume))));
    line("size", format!("{} mm", times(size_mm(volume))));
    line(
        "range",
        format!("{} to {}, mean {:.6}", found.min, found.max, found.mean),
    );
    for (share, value) in &found.quantiles {
        line(
            &format!("{:>5} % below", 100.0 * share),
            format!("{value:.6}"),
        );
    }
    line("otsu threshold", format!("{:.6}", found.otsu));
    line(
        "not empty",
        format!(
            "{:.2} % of voxels from the threshold on",
            100.0 * found.nonempty
        ),
    );
    lines.extend(notes.iter().map(|n| format!("note: {n}")));
    lines.join("\n")
}
