//! `goniofit render image`: pictures of the cloth and of its derivatives.

use super::image_files::{Derivative, Exposure, Output, Pictures};
use super::scene;
use super::subject::{Subject, find, length, numbers};
use crate::base::{Error, Result};
use crate::cli::output::data;
use crate::cli::{Outcome, inputs, terminal::Terminal};
use crate::render::{Integrator, PictureEffort, PictureRequest, Pictured, Region};
use crate::scatter::Parameters;
use crate::session::{Configuration, files};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// What the camera sees of the sample in one configuration or several, and by how much each parameter changes it
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  goniofit render image --fabric fabrics/gabardine.toml --params fabrics/params/gabardine.json \\
      --plan rig_configs/plans/khungurn16.toml --config 5 --out gabardine
  goniofit render image --fabric fabrics/gabardine.toml --params fabrics/params/gabardine.json \\
      --plan rig_configs/plans/khungurn16.toml --all --derivative c_tt,beta_tt --out sheet
  goniofit render image --fabric fabrics/bench_twill22.toml --pose \"light=80,180 camera=32,0\" \\
      --crop 2 --size 256 --accuracy 10% --exposure 0.8 --plate white --out twill

Writes STEM.exr (normalized radiance pi L / E_normal as R, G, B, standard errors as se.R, se.G, se.B) and STEM.png (sRGB);
with --derivative also STEM.d_NAME.exr and STEM.d_NAME.png (blue below zero, white at zero, red above). Of several
configurations the EXR files are STEM.config_05.exr, ... and each PNG is a contact sheet, in the plan's order.

A pixel is a rectangle of the sample plane, x (weft) to the right and y (warp) up as seen from above, so foreshortening is
taken out: the cloth stands still from picture to picture, and the mean of a picture of the sample square is that of
`goniofit render means`. Derivatives are by the model's own parameters, per radian for angles; where a parameter has a
value per channel, each channel's is by its own value.")]
pub(super) struct ImageArguments {
    #[command(flatten)]
    subject: Subject,
    /// Configurations to picture, as 5 or 1,5,9; can be left out when there is only one
    #[arg(long, value_name = "ID", value_delimiter = ',', conflicts_with = "all")]
    config: Vec<u32>,
    /// Picture all configurations
    #[arg(long)]
    all: bool,
    /// Beginning of the names of the files
    #[arg(long, value_name = "STEM")]
    out: PathBuf,
    /// Pixels, WxH, or along the longer side so that pixels are square
    #[arg(long, value_name = "N", default_value = "64", value_parser = size)]
    size: Size,
    /// Picture this part of the sample only: its side, or WxH, millimeters [default: the sample square]
    #[arg(long, value_name = "MM", value_parser = crop)]
    crop: Option<Sides>,
    /// Middle of the crop in the sample frame, millimeters [default: 0,0]
    #[arg(long, value_name = "X,Y", requires = "crop", value_parser = center, allow_hyphen_values = true)]
    center: Option<Sides>,
    /// Picture one tile of the fabric, from the origin on
    #[arg(long, conflicts_with = "crop")]
    tile: bool,
    /// Camera paths per pixel [default: 64]
    #[arg(long, value_name = "N", conflicts_with = "accuracy")]
    paths: Option<u64>,
    /// Rms standard error of a pixel to reach, relative to the picture's mean, e.g. 10% or 0.1
    #[arg(long, value_name = "A", value_parser = inputs::fraction)]
    accuracy: Option<f64>,
    /// Also picture the derivatives by these parameters: c_tt, one channel as c_tt.g, or all
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    derivative: Vec<String>,
    /// What the PNG multiplies normalized radiance by: a number, auto (the brightest hundredth of all pictures is white), or
    /// each (of each picture)
    #[arg(long, default_value = "auto", value_parser = exposure)]
    exposure: Exposure,
    /// Replace files that exist
    #[arg(long)]
    force: bool,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
}

/// Two lengths or coordinates along x and y, millimeters.
type Sides = [f64; 2];

/// Pixels of a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Size {
    Longer(usize),
    Exact([usize; 2]),
}

impl Size {
    fn resolution(self, region: &Region) -> [usize; 2] {
        match self {
            Self::Exact(size) => size,
            Self::Longer(n) => {
                let longer = region.size[0].max(region.size[1]);
                region
                    .size
                    .map(|s| ((n as f64 * s / longer).round() as usize).max(1))
            }
        }
    }
}

pub(super) fn run(a: &ImageArguments) -> Result<Outcome> {
    let begun = Instant::now();
    let ready = a.subject.read(Integrator::Fast, scene)?;
    let configurations = chosen(a, &ready.configurations)?;
    let (rows, derivatives) = wanted_derivatives(&a.derivative, &ready.parameters)?;
    let region = region(a, &*ready.scene);
    let outputs = Output::all(&a.out, &configurations, &derivatives);
    check_paths(&a.out, &outputs, a.force)?;

    let terminal = Terminal::new()?;
    let effort = match a.accuracy {
        Some(accuracy) => PictureEffort::Accuracy(accuracy),
        None => PictureEffort::PathsPerPixel(a.paths.unwrap_or(64)),
    };
    let request = PictureRequest {
        configurations: &configurations,
        parameters: &ready.parameters,
        region,
        resolution: a.size.resolution(&region),
        effort,
        derivatives: &rows,
        seed: a.subject.seed,
    };
    let pictures = ready.scene.pictures(&request, &terminal)?;
    terminal.finish_stage();
    let pictures = Pictures::new(
        &configurations,
        &pictures,
        &derivatives,
        a.exposure,
        a.subject.attributes(&ready.parameters),
    );
    let contents: Vec<Vec<u8>> = outputs
        .iter()
        .map(|o| pictures.encode(o))
        .collect::<Result<_>>()?;
    for (output, content) in outputs.iter().zip(&contents) {
        files::write_atomic(&output.path, content)?;
    }
    if a.json {
        let mut summary = pictures.as_json(&outputs);
        summary["seed"] = a.subject.seed.into();
        summary["parameters"] = ready.parameters.to_json();
        summary["wall_s"] = begun.elapsed().as_secs_f64().into();
        data!("{summary}");
    } else {
        pictures.print();
    }
    terminal.say(format!(
        "{} files, from {} on, in {:.1} s",
        outputs.len(),
        outputs[0].path.display(),
        begun.elapsed().as_secs_f64()
    ));
    Ok(Outcome::Done)
}

/// The configurations that are asked for.
fn chosen(a: &ImageArguments, all: &[Configuration]) -> Result<Vec<Configuration>> {
    if a.all || (a.config.is_empty() && all.len() == 1) {
        return Ok(all.to_vec());
    }
    if a.config.is_empty() {
        let ids: Vec<_> = all.iter().map(|c| c.id.to_string()).collect();
        return Err(
            Error::new(format!("which of the {} configurations?", all.len())).with_hint(format!(
                "--all, or --config with some of {}",
                ids.join(", ")
            )),
        );
    }
    let once = |i: &usize| !a.config[..*i].contains(&a.config[*i]);
    let ids = (0..a.config.len()).filter(once).map(|i| a.config[i]);
    ids.map(|id| find(all, id)).collect()
}

fn region(a: &ImageArguments, scene: &dyn Pictured) -> Region {
    match a.crop {
        Some(size) => Region {
            center: a.center.unwrap_or_default(),
            size,
        },
        None if a.tile => scene.tile(),
        None => scene.sample_square(),
    }
}

/// Fails before any work when a file exists already or the folder cannot be written.
fn check_paths(stem: &Path, outputs: &[Output], force: bool) -> Result<()> {
    if stem.file_name().is_none() || stem.is_dir() {
        return Err(Error::new(format!(
            "--out {}: expected the beginning of file names",
            stem.display()
        ))
        .with_hint("for example --out pictures/gabardine"));
    }
    for output in outputs {
        inputs::refuse_overwriting(&output.path, force)?;
    }
    let folder = stem.parent().filter(|p| !p.as_os_str().is_empty());
    inputs::prepare_folder(folder.unwrap_or(Path::new(".")))
}

/// The rows to render, and each derivative asked for with its place among them.
fn wanted_derivatives(
    names: &[String],
    parameters: &Parameters,
) -> Result<(Vec<usize>, Vec<Derivative>)> {
    let infos = parameters.infos();
    let known: Vec<&str> = infos.iter().map(|p| p.name).collect();
    let all = names.iter().any(|n| n == "all");
    let mut names: Vec<&str> = names
        .iter()
        .map(|n| n.trim())
        .filter(|n| *n != "all")
        .collect();
    if all {
        names.extend(&known);
    }
    let (mut rows, mut wanted) = (Vec::new(), Vec::<Derivative>::new());
    for name in names {
        let (base, channel) = match name.rsplit_once('.') {
            _ if known.contains(&name) => (name, None),
            Some((base, channel)) => (base, ["r", "g", "b"].iter().position(|c| *c == channel)),
            None => (name, None),
        };
        let row = known.iter().position(|k| *k == base);
        let (Some(row), true) = (row, channel.is_some() != (name == base)) else {
            return Err(
                Error::new(format!("unknown parameter '{name}'")).with_hint(format!(
                    "known: {}, one channel of them as {}.g, or all",
                    known.join(", "),
                    known[0]
                )),
            );
        };
        if wanted.iter().any(|d| d.name == name) {
            continue;
        }
        let layer = rows.iter().position(|r| *r == row).unwrap_or_else(|| {
            rows.push(row);
            rows.len() - 1
        });
        wanted.push(Derivative {
            name: name.to_owned(),
            info: infos[row],
            layer,
            channel,
        });
    }
    Ok((rows, wanted))
}

fn size(text: &str) -> Result<Size, String> {
    let pixels = |t: &str| t.trim().parse::<usize>().ok().filter(|n| *n > 0);
    let size = match text.split_once('x') {
        Some((w, h)) => pixels(w).zip(pixels(h)).map(|(w, h)| Size::Exact([w, h])),
        None => pixels(text).map(Size::Longer),
    };
    size.ok_or_else(|| format!("'{text}' is not a number of pixels, N or WxH, of at least 1"))
}

fn crop(text: &str) -> Result<Sides, String> {
    match text.split_once('x') {
        Some((w, h)) => Ok([length(w)?, length(h)?]),
        None => length(text).map(|s| [s; 2]),
    }
}

fn center(text: &str) -> Result<Sides, String> {
    numbers(text).ok_or_else(|| format!("'{text}' is not a point X,Y in millimeters"))
}

fn exposure(text: &str) -> Result<Exposure, String> {
    match text {
        "auto" => Ok(Exposure::Common),
        "each" => Ok(Exposure::Each),
        _ => length(text)
            .map(Exposure::Factor)
            .map_err(|_| format!("'{text}' is not auto, each, or a positive number")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scatter;

    #[test]
    fn sizes_keep_pixels_square_or_are_exact() {
        let region = Region {
            center: [0.0; 2],
            size: [2.0, 1.0],
        };
        assert_eq!(size("64").unwrap().resolution(&region), [64, 32]);
        assert_eq!(size("10x20").unwrap().resolution(&region), [10, 20]);
        for bad in ["0", "x3", "3x0", "-1", "", "1.5"] {
            assert!(size(bad).is_err(), "{bad}");
        }
        assert_eq!(crop("2x0.5"), Ok([2.0, 0.5]));
        assert!(crop("0").is_err() && crop("2x").is_err() && center("1").is_err());
        assert!(exposure("0").is_err() && exposure("bright").is_err());
    }

    #[test]
    fn derivatives_are_named_by_parameter_and_channel() {
        let parameters = Parameters::defaults(scatter::model("khungurn").unwrap());
        let read = |names: &[&str]| {
            let names: Vec<String> = names.iter().map(|n| (*n).to_owned()).collect();
            wanted_derivatives(&names, &parameters)
        };
        let (rows, wanted) = read(&["beta_tt", "c_tt.g", "c_tt", "c_tt"]).unwrap();
        assert_eq!(rows, [3, 1]);
        let list: Vec<_> = wanted.iter().map(|d| (d.layer, d.channel)).collect();
        assert_eq!(list, [(0, None), (1, Some(1)), (1, None)]);
        assert_eq!(read(&["all", "c_r"]).unwrap().1.len(), 5);
        let systems = Parameters::defaults(scatter::model("khungurn-per-system").unwrap());
        let names = ["weft.c_r", "weft.c_r.b"].map(str::to_owned);
        let (rows, wanted) = wanted_derivatives(&names, &systems).unwrap();
        assert_eq!((rows, wanted[1].channel), (vec![5], Some(2)));
        for bad in ["c_t", "c_tt.x", "c_tt.", ".r", ""] {
            let error = read(&[bad]).unwrap_err().report();
            assert!(error.contains("known: c_r, c_tt, beta_r"), "{bad}: {error}");
        }
    }
}
