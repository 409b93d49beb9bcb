//! `goniofit ct prepare`.

use super::{Source, argument, numbers, report_json};
use crate::base::{Context, Error, Result};
use crate::cli::inputs;
use crate::cli::output::data;
use crate::cli::terminal::Terminal;
use crate::fabric::ct::{Crop, PrepareReport, Preparing, prepare};
use crate::session::files;
use clap::Parser;
use std::path::PathBuf;

/// Make a volume ready for finding fibers: even, flat, aligned, cropped, cubic voxels
#[derive(Parser)]
#[command(
    after_help = "Examples:\n  goniofit ct prepare scan/ --voxel-um 5 --out cloth\n  \
                  goniofit ct prepare scan.mhd --unit um --axes x,-z,y --out cloth --crop 0.5,4.5,0.5,4.5\n  \
                  goniofit ct prepare scan.nrrd --out cloth --weft-deg 1.5 --warp-deg -0.5 --repeat-mm 1.2,0.9\n\n\
                  Writes volume.nrrd (single precision, air 0 and fiber 1, z = 0 the middle of the cloth) and prepare.json (what was done).\n\
                  Angles are read off the xy pictures of `goniofit ct view`."
)]
pub(super) struct Arguments {
    #[command(flatten)]
    source: Source,
    /// Folder for the result; unpacked voxels too are kept there while it works
    #[arg(long)]
    out: PathBuf,
    /// Leave values as they are, uneven levels too
    #[arg(long)]
    no_equalize: bool,
    /// Leave the cloth curved and tilted as it lies
    #[arg(long)]
    no_flatten: bool,
    /// Turn the cloth level as a rigid body before flattening: for tilts of more than a few degrees
    #[arg(long)]
    level: bool,
    /// How far the weft lies off x, degrees counter-clockwise
    #[arg(long, default_value_t = 0.0, allow_hyphen_values = true)]
    weft_deg: f64,
    /// How far the warp lies off y, degrees counter-clockwise
    #[arg(long, default_value_t = 0.0, allow_hyphen_values = true)]
    warp_deg: f64,
    /// Keep x from X0 to X1 and y from Y0 to Y1, millimeters from the lower corner: X0,X1,Y0,Y1; and z from Z0 to Z1,
    /// millimeters from the cloth's middle: X0,X1,Y0,Y1,Z0,Z1
    #[arg(long, allow_hyphen_values = true)]
    crop: Option<String>,
    /// Keep whole repeats of the weave, WX,WY millimeters
    #[arg(long)]
    repeat_mm: Option<String>,
    /// Replace results that exist
    #[arg(long)]
    force: bool,
}

pub(super) fn run(arguments: &Arguments, terminal: &Terminal) -> Result<()> {
    let crop = arguments.kept()?;
    let [volume_file, json_file] = ["volume.nrrd", "prepare.json"].map(|n| arguments.out.join(n));
    for file in [&volume_file, &json_file] {
        inputs::refuse_overwriting(file, arguments.force)?;
    }
    inputs::prepare_folder(&arguments.out)?;
    let volume = arguments.source.open(&arguments.out, terminal)?;
    let options = Preparing {
        equalize: !arguments.no_equalize,
        flatten: !arguments.no_flatten,
        level: arguments.level,
        weft: arguments.weft_deg.to_radians(),
        warp: arguments.warp_deg.to_radians(),
        crop,
        memory: arguments.source.memory(),
        scratch: arguments.out.clone(),
    };
    let report = prepare(volume, &options, &volume_file, terminal).context(|| {
        format!(
            "volume {} cannot be prepared",
            arguments.source.volume.display()
        )
    })?;
    let mut json = report_json("goniofit-ct-prepared-1", &report)?;
    json["scan"] = serde_json::json!(arguments.source.volume);
    files::write_atomic(&json_file, format!("{json:#}\n").as_bytes())?;
    terminal.say(in_words(&report));
    data!("{}", volume_file.display());
    Ok(())
}

impl Arguments {
    fn kept(&self) -> Result<Crop> {
        let mut crop = Crop::default();
        if let Some(text) = &self.crop {
            let what = "X0,X1,Y0,Y1 or X0,X1,Y0,Y1,Z0,Z1 in millimeters";
            let [x0, x1, y0, y1] = if text.split(',').count() == 6 {
                let [x0, x1, y0, y1, z0, z1] = argument("--crop", numbers(text, what))?;
                crop.z_mm = Some([z0, z1]);
                [x0, x1, y0, y1]
            } else {
                argument("--crop", numbers(text, what))?
            };
            crop.x_mm = Some([x0, x1]);
            crop.y_mm = Some([y0, y1]);
        }
        if let Some(text) = &self.repeat_mm {
            let repeat: [f64; 2] = argument("--repeat-mm", numbers(text, "WX,WY in millimeters"))?;
            if repeat.iter().any(|w| *w <= 0.0) {
                return Err(Error::new(format!(
                    "--repeat-mm {text}: expected lengths above 0"
                )));
            }
            crop.repeat_mm = Some(repeat);
        }
        Ok(crop)
    }
}

fn in_words(r: &PrepareReport) -> String {
    let [nx, ny, nz] = r.dims;
    let [x, y, z] = r.size_mm;
    let mut lines = vec![format!(
        "{nx} x {ny} x {nz} voxels of {:.4} um: {x:.4} x {y:.4} x {z:.4} mm",
        r.voxel_um
    )];
    if let Some([a, b]) = r.repeats {
        lines.push(format!("{a} x {b} repeats of the weave"));
    }
    if r.surface.is_some() {
        lines.push(format!(
            "flattened by {:.1} um, turned level by {:.2} degrees",
            r.surface_range_um, r.tilt_deg
        ));
    }
    lines.push(format!(
        "fiber {:.2} % of the volume, cloth {:.4} mm thick; {:.2} % lies outside the scan and was filled with air",
        100.0 * r.fiber_share,
        r.thickness_mm,
        100.0 * r.outside_share
    ));
    lines.join("\n")
}
