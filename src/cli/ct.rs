//! `goniofit ct`.

mod fibers;
mod info;
mod orient;
mod prepare;
mod simulate;
mod tile;
mod view;

use super::Outcome;
use super::terminal::Terminal;
use crate::base::{Context, Error, Result, Watch};
use crate::fabric::ct::{Axes, Endian, Reading, Unit, Volume};
use clap::{Subcommand, ValueEnum};
use std::path::{Path, PathBuf};

const EXAMPLES: &str = "Examples:
  goniofit ct info scan/ --voxel-um 5
  goniofit ct view scan/ --voxel-um 5 --out pictures
  goniofit ct prepare scan.mhd --unit um --axes x,-z,y --out cloth
  goniofit ct prepare scan.nrrd --out cloth --weft-deg 1.5 --warp-deg 1.5 --repeat-mm 1.2,0.9
  goniofit ct orient cloth --radius-um 8 --out cloth
  goniofit ct fibers cloth --radius-um 8 --out cloth.csv
  goniofit ct tile cloth --repeat-mm 1.2,0.9 --copies 4,4 --out big.nrrd
  goniofit ct simulate fabrics/gabardine.toml --voxel-um 5 --out virtual

Volumes are folders of TIFF slices, TIFF files of several pages, NRRD, MetaImage and NPY files; docs/ct.md has the details.";

/// Look at micro-CT volumes, prepare them, and find directions and fibers in them
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
    Orient(orient::Arguments),
    Fibers(fibers::Arguments),
    Tile(tile::Arguments),
    Simulate(simulate::Arguments),
}

pub(crate) fn run(arguments: Arguments) -> Result<Outcome> {
    let terminal = Terminal::new()?;
    let result = match arguments.command {
        Command::Info(a) => info::run(&a, &terminal),
        Command::View(a) => view::run(&a, &terminal),
        Command::Prepare(a) => prepare::run(&a, &terminal),
        Command::Orient(a) => orient::run(&a, &terminal),
        Command::Fibers(a) => fibers::run(&a, &terminal),
        Command::Tile(a) => tile::run(&a, &terminal),
        Command::Simulate(a) => simulate::run(&a, &terminal),
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
        self.open_file(&self.volume, scratch, terminal)
    }

    /// The same for a file found beside what was named.
    fn open_file(&self, path: &Path, scratch: &Path, terminal: &Terminal) -> Result<Volume> {
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
        let volume = Volume::open(path, &reading, terminal)?;
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

/// A number above 0, in micrometers.
fn micrometers(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(um) if um > 0.0 && um < 1e6 => Ok(um),
        _ => Err("expected micrometers above 0".to_owned()),
    }
}

/// The file a folder of results holds under this name, or the path itself.
fn inside(path: &Path, name: &str) -> PathBuf {
    let file = path.join(name);
    if file.is_file() {
        file
    } else {
        path.to_owned()
    }
}

/// A report as JSON with its format's name and the program's version in front.
fn report_json(format: &str, report: &impl serde::Serialize) -> Result<serde_json::Value> {
    let mut json = serde_json::json!({
        "format": format,
        "goniofit": env!("CARGO_PKG_VERSION"),
    });
    let done = serde_json::to_value(report).context(|| "the report cannot be written as JSON")?;
    if let (Some(all), Some(done)) = (json.as_object_mut(), done.as_object()) {
        all.extend(done.clone());
    }
    Ok(json)
}

/// Turns a fault of an argument into an error.
fn argument<T>(name: &str, value: Result<T, String>) -> Result<T> {
    value.map_err(|e| Error::new(format!("{name}: {e}")))
}
