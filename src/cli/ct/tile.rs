//! `goniofit ct tile`.

use super::{argument, inside, numbers, report_json};
use crate::base::{Context, Error, Result};
use crate::cli::inputs;
use crate::cli::output::data;
use crate::cli::terminal::Terminal;
use crate::fabric::VoxelTile;
use crate::fabric::ct::{Patch, tiled};
use clap::Parser;
use std::path::PathBuf;

/// Make a larger tile of oriented voxels from a scanned patch
#[derive(Parser)]
#[command(
    after_help = "Examples:\n  goniofit ct tile cloth --repeat-mm 1.2,0.9 --copies 4,4 --out big.nrrd\n  \
                  goniofit ct tile felt --turn --copies 3,3 --seed 7 --out big.nrrd --json\n\n\
                  Woven cloth: each cell is a whole repeat of the weave from anywhere in the patch. Pile and felt (--turn): each cell is the\n\
                  patch's central square, turned by a random multiple of 90 degrees. Fibers are cut at seams; the report says how much\n\
                  worse a seam is than the inside of the patch."
)]
pub(super) struct Arguments {
    /// Oriented voxels, or the folder with oriented.nrrd in it
    oriented: PathBuf,
    /// Size of one repeat of the weave, WX,WY millimeters
    #[arg(long, required_unless_present = "turn", conflicts_with = "turn")]
    repeat_mm: Option<String>,
    /// Turn the central square instead
    #[arg(long)]
    turn: bool,
    /// Cells along x and y, NX,NY
    #[arg(long)]
    copies: String,
    /// Of the choice
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// File to write (.nrrd)
    #[arg(long)]
    out: PathBuf,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
    /// Replace the file if it exists
    #[arg(long)]
    force: bool,
}

pub(super) fn run(arguments: &Arguments, terminal: &Terminal) -> Result<()> {
    let cells = match &arguments.repeat_mm {
        Some(text) => {
            let repeat = argument("--repeat-mm", numbers(text, "WX,WY in millimeters"))?;
            Patch::Repeats(repeat)
        }
        None => Patch::Turns,
    };
    let copies: [f64; 2] = argument("--copies", numbers(&arguments.copies, "NX,NY"))?;
    if !copies
        .iter()
        .all(|n| (1.0..=1e5).contains(n) && n.fract().abs() < 1e-12)
    {
        return Err(Error::new(format!(
            "--copies {}: expected two whole numbers of at least 1",
            arguments.copies
        )));
    }
    inputs::refuse_overwriting(&arguments.out, arguments.force)?;
    let path = inside(&arguments.oriented, "oriented.nrrd");
    let patch = VoxelTile::read(&path)?;
    let copies = copies.map(|n| n as usize);
    let (tile, report) = tiled(&patch, cells, copies, arguments.seed, terminal)
        .context(|| format!("{} cannot be tiled", path.display()))?;
    tile.write(&arguments.out)?;
    let [nx, ny, nz] = tile.shape();
    terminal.say(format!(
        "{nx} x {ny} x {nz} voxels, {:.4} x {:.4} mm, of {} choices; across seams (within the patch): density differs by {:.3} ({:.3}), \
         fibers by {:.1} ({:.1}) degrees, {:.1} ({:.1}) % of fiber voxels end in air",
        tile.size()[0],
        tile.size()[1],
        report.choices,
        report.density_at_seams,
        report.density_within,
        report.degrees_at_seams,
        report.degrees_within,
        100.0 * report.ends_at_seams,
        100.0 * report.ends_within
    ));
    if report.choices == 1 {
        terminal.say("note: the patch holds one repeat: the tile repeats it");
    }
    if arguments.json {
        data!("{:#}", report_json("goniofit-ct-tiled-1", &report)?);
    } else {
        data!("{}", arguments.out.display());
    }
    Ok(())
}
