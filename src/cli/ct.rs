//! `goniofit ct`.

mod info;
mod prepare;
mod view;

use super::Outcome;
use super::terminal::Terminal;
use crate::base::{Error, Result, Watch};
use crate::fabric::ct::{Axes, Endian, Reading, Unit, Volume};
use clap::{Subcommand, ValueEnum};
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "Examples:
  goniofit ct info scan/ --voxel-um 5
  goniofit ct view scan/ --voxel-um 5 --out pictures
  goniofit ct prepare scan.mhd --unit um --axes x,-z,y --out cloth
  goniofit ct prepare scan.nrrd --out cloth --weft-deg 1.5 --warp-deg 1.5 --repeat-mm 1.2,0.9

Volumes are folders of TIFF slices, TIFF files of several pages, NRRD, MetaImage and NPY files; docs/ct.md has the details.";

/// Look at micro-CT volumes and prepare them: even, flat, aligned, cubic voxels
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Info(info::Arguments),
    View(view::Arguments),
    Prepare(prepare::Arguments),
}

pub(crate) fn run(arguments: Arguments) -> Result<Outcome> {
    let terminal = Terminal::new()?;
    let result = match arguments.command {
        Command::Info(a) => info::run(&a, &terminal),
        Command::View(a) => view::run(&a, &terminal),
        Command::Prepare(a) => prepare::run(&a, &terminal),
    };
    terminal.finish_stage();
    match result {
        Err(_) if terminal.cancelled() => Ok(Outcome::Interrupted),
        other => other.map(|()| Outcome::Done),
    }
}

/// How to read a volume.
#[derive(clap::Args)]
struct Source {
    /// Volume: folder of TIFF slices, .tif, .nrrd, .nhdr, .mhd, .mha or .npy
    volume: PathBuf,
    /// Voxel size in micrometers, one number or one for each axis of the file, fastest first; instead of the file's
    #[arg(long, value_name = "SIZE", value_parser = voxel_size)]
    voxel_um: Option<[f64; 3]>,
    /// Unit of the file's voxel size where the file does not state it: nm, um, mm, cm or m
    #[arg(long)]
    unit: Option<Unit>,
    /// Scene axes of the file's axes, fastest first, such as x,y,-z; x is along the weft, y along the warp, z up out of
    /// the cloth
    #[arg(long, allow_hyphen_values = true)]
    axes: Option<Axes>,
    /// Byte order of raw voxels, instead of the file's
    #[arg(long)]
    endian: Option<ByteOrder>,
    /// Memory for voxels, MiB
    #[arg(long, default_value_t = 512, value_parser = clap::value_parser!(u32).range(1..))]
    memory_mib: u32,
}

#[derive(Clone, Copy, ValueEnum)]
enum ByteOrder {
    Little,
    Big,
}

impl Source {
    /// Opens the volume, unpacking in `scratch` what must be, and says what a person should know of it.
    fn open(&self, scratch: &Path, terminal: &Terminal) -> Result<Volume> {
        let reading = Reading {
            voxel_um: self.voxel_um,
            unit: self.unit,
            axes: self.axes,
            endian: self.endian.map(|e| match e {
                ByteOrder::Little => Endian::Little,
                ByteOrder::Big => Endian::Big,
            }),
            scratch: scratch.to_owned(),
        };
        let volume = Volume::open(&self.volume, &reading, terminal)?;
        for note in volume.notes() {
            terminal.say(format!("note: {note}"));
        }
        if let Some(warning) = volume.byte_order_warning()? {
            terminal.say(format!("warning: {warning}"));
        }
        Ok(volume)
    }

    fn memory(&self) -> usize {
        self.memory_mib as usize * (1 << 20)
    }
}

/// `count` finite numbers separated by commas.
fn numbers<const N: usize>(text: &str, expected: &str) -> Result<[f64; N], String> {
    let list = text
        .split(',')
        .map(|t| t.trim().parse::<f64>().ok().filter(|v| v.is_finite()))
        .collect::<Option<Vec<_>>>();
    list.and_then(|l| l.try_into().ok())
        .ok_or_else(|| format!("expected {expected}"))
}

fn voxel_size(text: &str) -> Result<[f64; 3], String> {
    let size = numbers::<1>(text, "")
        .map(|[side]| [side; 3])
        .or_else(|_| numbers(text, "one number or three, in micrometers: 5 or 5,5,10"))?;
    if size.iter().all(|s| *s > 0.0) {
        return Ok(size);
    }
    Err("a voxel size must be above 0".to_owned())
}

/// Turns a fault of an argument into an error.
fn argument<T>(name: &str, value: Result<T, String>) -> Result<T> {
    value.map_err(|e| Error::new(format!("{name}: {e}")))
}
