//! `goniofit ct view`.

use super::{Source, argument, numbers};
use crate::base::{Context, Error, Result};
use crate::cli::inputs;
use crate::cli::output::data;
use crate::cli::terminal::Terminal;
use crate::fabric::ct::{Plane, Volume, slices, statistics};
use crate::report::cut::{Cut, png};
use crate::session::files;
use clap::Parser;
use std::path::PathBuf;

/// Pictures along an axis without --every.
const PICTURES: usize = 8;

/// Draw slices along all three axes, as PNG with a scale bar
#[derive(Parser)]
#[command(
    after_help = "Examples:\n  goniofit ct view scan/ --voxel-um 5 --out pictures\n  \
                  goniofit ct view cloth/volume.nrrd --out pictures --every 50 --range 0,1\n\n\
                  xy_z0012.png is seen from above (x right, y up); xz_y0012.png and yz_x0012.png are cuts across with z up.\n\
                  Numbers are voxel indices from 0."
)]
pub(super) struct Arguments {
    #[command(flatten)]
    source: Source,
    /// Folder for the pictures
    #[arg(long)]
    out: PathBuf,
    /// Voxels from slice to slice; without it about eight slices along each axis
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..))]
    every: Option<u32>,
    /// Values drawn black and white, LOW,HIGH; without it those of 0.1 % and 99.9 % of the voxels
    #[arg(long, allow_hyphen_values = true)]
    range: Option<String>,
    /// Replace pictures that exist
    #[arg(long)]
    force: bool,
}

pub(super) fn run(arguments: &Arguments, terminal: &Terminal) -> Result<()> {
    let range = arguments.range.as_deref().map(range).transpose()?;
    inputs::prepare_folder(&arguments.out)?;
    let volume = arguments.source.open(&arguments.out, terminal)?;
    let wanted = volume.dims().map(|n| chosen(n, arguments.every));
    for (axis, list) in wanted.iter().enumerate() {
        for index in list {
            inputs::refuse_overwriting(
                &arguments.out.join(file_name(axis, *index)),
                arguments.force,
            )?;
        }
    }
    let memory = arguments.source.memory();
    let [low, high] = match range {
        Some(range) => range,
        None => contrast(&volume, arguments, terminal)?,
    };
    let mut drawn = 0;
    slices(&volume, &wanted, memory, terminal, |plane| {
        let bytes = picture(&volume, &plane, [low, high])?;
        drawn += 1;
        files::write_atomic(
            &arguments.out.join(file_name(plane.axis, plane.index)),
            &bytes,
        )
    })?;
    terminal.say(format!(
        "{}: {drawn} pictures, black {low:.6}, white {high:.6}",
        arguments.out.display()
    ));
    for (axis, list) in wanted.iter().enumerate().rev() {
        for index in list {
            data!("{}", arguments.out.join(file_name(axis, *index)).display());
        }
    }
    Ok(())
}

fn range(text: &str) -> Result<[f64; 2]> {
    let [low, high] = argument("--range", numbers(text, "two values: LOW,HIGH"))?;
    if low < high {
        return Ok([low, high]);
    }
    Err(Error::new(format!(
        "--range {text}: expected the lower value first"
    )))
}

/// The values of 0.1 % and 99.9 %, or the ends where they coincide.
fn contrast(volume: &Volume, arguments: &Arguments, terminal: &Terminal) -> Result<[f64; 2]> {
    let found = statistics(volume, arguments.source.memory(), terminal).context(|| {
        format!(
            "volume {} cannot be used",
            arguments.source.volume.display()
        )
    })?;
    match (found.quantile(0.001), found.quantile(0.999)) {
        (Some(low), Some(high)) if low < high => Ok([low, high]),
        _ => Ok([found.min.into(), found.max.into()]),
    }
}

/// Indices in the middle of equal steps.
fn chosen(n: usize, every: Option<u32>) -> Vec<usize> {
    let step = every.map_or(n.div_ceil(PICTURES), |e| e as usize);
    ((step / 2).min(n / 2)..n).step_by(step).collect()
}

fn file_name(axis: usize, index: usize) -> String {
    let (plane, along) = [("yz", "x"), ("xz", "y"), ("xy", "z")][axis];
    format!("{plane}_{along}{index:04}.png")
}

fn picture(volume: &Volume, plane: &Plane, [low, high]: [f64; 2]) -> Result<Vec<u8>> {
    let gray =
        |v: &f32| (255.0 * ((f64::from(*v) - low) / (high - low)).clamp(0.0, 1.0)).round() as u8;
    let voxel = volume.voxel_mm();
    let [across, up] = [[1, 2], [0, 2], [0, 1]][plane.axis];
    png(&Cut {
        size: plane.size,
        gray: &plane.values.iter().map(gray).collect::<Vec<_>>(),
        voxel_mm: [voxel[across], voxel[up]],
        notes: vec![("Title", file_name(plane.axis, plane.index))],
    })
}
