//! `goniofit ct view`.

use super::{Source, argument, numbers};
use crate::base::{Context, Error, Result};
use crate::cli::inputs;
use crate::cli::output::data;
use crate::cli::terminal::Terminal;
use crate::fabric::VoxelTile;
use crate::fabric::ct::{Plane, Volume, slices, statistics};
use crate::report::cut::{Cut, png};
use crate::session::files;
use clap::Parser;
use std::path::PathBuf;

/// Pictures along an axis without --every.
const PICTURES: usize = 8;

/// Letters and colors of directions along the axes.
const LEGEND: [(char, [u8; 3]); 3] = [
    ('x', [255, 60, 60]),
    ('y', [60, 255, 60]),
    ('z', [90, 90, 255]),
];

/// Draw slices along all three axes, as PNG with a scale bar; of oriented voxels with their directions in color
#[derive(Parser)]
#[command(
    after_help = "Examples:\n  goniofit ct view scan/ --voxel-um 5 --out pictures\n  \
                  goniofit ct view cloth/volume.nrrd --out pictures --every 50 --range 0,1\n  \
                  goniofit ct view oriented/oriented.nrrd --out pictures\n\n\
                  xy_z0012.png is seen from above (x right, y up); xz_y0012.png and yz_x0012.png are cuts across with z up.\n\
                  Numbers are voxel indices from 0. Of oriented voxels red is along x, green along y and blue along z, bright where dense."
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
    if VoxelTile::is_in(&arguments.source.volume) {
        return directions(arguments, range, terminal);
    }
    let volume = arguments.source.open(&arguments.out, terminal)?;
    let wanted = volume.dims().map(|n| chosen(n, arguments.every));
    refuse_overwriting(arguments, &wanted)?;
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
    list(arguments, &wanted);
    Ok(())
}

fn refuse_overwriting(arguments: &Arguments, wanted: &[Vec<usize>; 3]) -> Result<()> {
    for (axis, list) in wanted.iter().enumerate() {
        for index in list {
            let path = arguments.out.join(file_name(axis, *index));
            inputs::refuse_overwriting(&path, arguments.force)?;
        }
    }
    Ok(())
}

/// Prints the names of the pictures.
fn list(arguments: &Arguments, wanted: &[Vec<usize>; 3]) {
    for (axis, list) in wanted.iter().enumerate().rev() {
        for index in list {
            data!("{}", arguments.out.join(file_name(axis, *index)).display());
        }
    }
}

/// Draws oriented voxels.
fn directions(arguments: &Arguments, range: Option<[f64; 2]>, terminal: &Terminal) -> Result<()> {
    let tile = VoxelTile::read(&arguments.source.volume)?;
    let wanted = tile.shape().map(|n| chosen(n, arguments.every));
    refuse_overwriting(arguments, &wanted)?;
    let densest = tile.density().iter().copied().fold(0.0, f32::max);
    let [low, high] = range.unwrap_or([0.0, f64::from(densest).max(1e-30)]);
    let mut drawn = 0;
    for (axis, list) in wanted.iter().enumerate() {
        for index in list {
            let bytes = colored(&tile, axis, *index, [low, high])?;
            files::write_atomic(&arguments.out.join(file_name(axis, *index)), &bytes)?;
            drawn += 1;
        }
    }
    terminal.say(format!(
        "{}: {drawn} pictures; red along x, green along y, blue along z; black {low:.6}, bright {high:.6}",
        arguments.out.display()
    ));
    self::list(arguments, &wanted);
    Ok(())
}

fn colored(tile: &VoxelTile, axis: usize, index: usize, range: [f64; 2]) -> Result<Vec<u8>> {
    let [across, up] = [[1, 2], [0, 2], [0, 1]][axis];
    let size = [tile.shape()[across], tile.shape()[up]];
    let mut color = Vec::with_capacity(size[0] * size[1]);
    for (v, u) in (0..size[1]).flat_map(|v| (0..size[0]).map(move |u| (v, u))) {
        let mut voxel = [0; 3];
        (voxel[axis], voxel[across], voxel[up]) = (index, u, v);
        let place = tile.place(voxel);
        let bright = shade(tile.density()[place].into(), range);
        let d = tile.direction(place).abs();
        color.push(d.to_array().map(|c| (255.0 * c * bright).round() as u8));
    }
    png(&Cut {
        size,
        color: &color,
        legend: &LEGEND,
        voxel_mm: [tile.side(); 2],
        notes: vec![("Title", file_name(axis, index))],
    })
}

/// A value's place between black and white.
fn shade(value: f64, [low, high]: [f64; 2]) -> f64 {
    ((value - low) / (high - low)).clamp(0.0, 1.0)
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

fn picture(volume: &Volume, plane: &Plane, range: [f64; 2]) -> Result<Vec<u8>> {
    let gray = |v: &f32| [(255.0 * shade(f64::from(*v), range)).round() as u8; 3];
    let voxel = volume.voxel_mm();
    let [across, up] = [[1, 2], [0, 2], [0, 1]][plane.axis];
    png(&Cut {
        size: plane.size,
        color: &plane.values.iter().map(gray).collect::<Vec<_>>(),
        legend: &[],
        voxel_mm: [voxel[across], voxel[up]],
        notes: vec![("Title", file_name(plane.axis, plane.index))],
    })
}
