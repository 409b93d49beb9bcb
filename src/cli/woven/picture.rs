//! `goniofit woven picture`.

use super::cloth::Cloth;
use crate::base::{Context, Result, Watch};
use crate::cli::terminal::Terminal;
use crate::cli::{Outcome, inputs};
use crate::math::PolarDirection;
use crate::report::preview;
use crate::scatter::surface::woven::{Noise, Texture, YarnLook};
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// Picture a flat swatch from its yarn segments, at one or several magnifications
#[derive(clap::Args)]
#[command(after_help = "\
Light and camera are far away, in directions of polar angle from the normal and azimuth from the weft, degrees. One file per
magnification: with several, the number of repeats is added to the name. All files of a run have the same exposure, at which the
brightest hundredth of the first is white.

Examples:
  goniofit woven picture --fabric twill --out twill.png
  goniofit woven picture --fabric denim --repeats 3,12,48 --noise 3 --out denim.png
  goniofit woven picture --weave '5-end satin' --smoothing 0.5 --light 30,90 --out satin.png")]
pub(super) struct Arguments {
    #[command(flatten)]
    cloth: Cloth,
    /// Toward the light: polar angle and azimuth, degrees
    #[arg(long, value_name = "THETA,PHI", value_parser = direction, default_value = "30,60", allow_hyphen_values = true)]
    light: PolarDirection,
    /// Toward the camera: polar angle and azimuth, degrees
    #[arg(long, value_name = "THETA,PHI", value_parser = direction, default_value = "20,240", allow_hyphen_values = true)]
    camera: PolarDirection,
    /// Repeats of the weave across the picture, one or several numbers
    #[arg(long, value_delimiter = ',', default_value = "6", value_parser = clap::value_parser!(u32).range(1..=1000))]
    repeats: Vec<u32>,
    /// Width of the picture in pixels
    #[arg(long, default_value_t = 480, value_parser = clap::value_parser!(u32).range(16..=4096))]
    width: u32,
    /// Diffuse color: r,g,b, 0 to 1
    #[arg(long, value_name = "R,G,B", value_parser = color, default_value = "0.06,0.06,0.08")]
    diffuse: [f64; 3],
    /// Specular coefficient of the warp: r,g,b; 10 returns about a tenth of the light
    #[arg(long, value_name = "R,G,B", value_parser = color, default_value = "20,18,14")]
    warp: [f64; 3],
    /// Specular coefficient of the weft: r,g,b
    #[arg(long, value_name = "R,G,B", value_parser = color, default_value = "10,12,18")]
    weft: [f64; 3],
    /// Width of highlights as a share of a segment
    #[arg(long, default_value_t = 0.5)]
    highlight: f64,
    /// Cells of irregular brightness along and across each segment; 0 for none
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=100))]
    noise: u32,
    /// Seed of the noise
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// PNG file to write
    #[arg(long, value_name = "P.png")]
    out: PathBuf,
    /// Replace existing files
    #[arg(long)]
    force: bool,
}

fn numbers<const N: usize>(text: &str) -> Option<[f64; N]> {
    let list: Option<Vec<f64>> = text.split(',').map(|p| p.trim().parse().ok()).collect();
    list?.try_into().ok()
}

fn direction(text: &str) -> Result<PolarDirection, String> {
    match numbers(text) {
        Some([theta, phi]) if (0.0..90.0).contains(&theta) && (-720.0..=720.0).contains(&phi) => {
            Ok(PolarDirection::from_degrees(theta, phi))
        }
        _ => Err(format!(
            "'{text}': expected a polar angle of 0 to below 90 and an azimuth, degrees, such as 30,90"
        )),
    }
}

fn color(text: &str) -> Result<[f64; 3], String> {
    match numbers(text) {
        Some(c) if c.iter().all(|v: &f64| (0.0..=1000.0).contains(v)) => Ok(c),
        _ => Err(format!(
            "'{text}': expected three numbers of 0 to 1000, such as 0.4,0.1,0.1"
        )),
    }
}

pub(super) fn run(a: &Arguments) -> Result<Outcome> {
    let files: Vec<PathBuf> = a.repeats.iter().map(|&n| file(a, n)).collect();
    for f in &files {
        inputs::refuse_overwriting(f, a.force)?;
    }
    let look =
        |system: usize, k_s: [f64; 3]| a.cloth.shape(system).map(|shape| YarnLook { shape, k_s });
    let looks = [look(0, a.warp)?, look(1, a.weft)?];
    let noise = (a.noise > 0).then_some(Noise {
        cells: a.noise,
        seed: a.seed,
    });
    let repeat = a.cloth.repeat()?;
    let size = repeat.size;
    let texture = Texture::new(repeat, a.diffuse, looks, a.highlight, noise)?;
    let terminal = Terminal::new()?;
    let mut exposure = None;
    for (&repeats, file) in a.repeats.iter().zip(&files) {
        let Some(picture) = render(a, &texture, size, repeats, &terminal) else {
            return Ok(Outcome::Interrupted);
        };
        terminal.finish_stage();
        let factor = *exposure.get_or_insert_with(|| preview::exposure(&picture));
        let shown: Vec<[f64; 3]> = picture.iter().map(|p| p.map(|v| v * factor)).collect();
        let height = shown.len() as u32 / a.width;
        let bytes = preview::png(a.width, height, &shown)?;
        std::fs::write(file, bytes).context(|| format!("{} cannot be written", file.display()))?;
    }
    Ok(Outcome::Done)
}

/// The file of a magnification.
fn file(a: &Arguments, repeats: u32) -> PathBuf {
    if a.repeats.len() == 1 {
        return a.out.clone();
    }
    let stem = a.out.file_stem().unwrap_or_default().to_string_lossy();
    let end = a
        .out
        .extension()
        .map_or("png".into(), |e| e.to_string_lossy());
    let folder = a.out.parent().unwrap_or(Path::new(""));
    folder.join(format!("{stem}_{repeats}.{end}"))
}

/// Mean radiance of square pixels under light of irradiance 1 at normal incidence, y up; as high as it is wide. None when
/// interrupted.
fn render(
    a: &Arguments,
    texture: &Texture,
    size: [f64; 2],
    repeats: u32,
    watch: &dyn Watch,
) -> Option<Vec<[f64; 3]>> {
    let (wi, wr) = (a.light.vector(), a.camera.vector());
    let pixel = f64::from(repeats) * size[0] / f64::from(a.width);
    // Enough points for a hundredth of a repeat.
    let points = (100.0 * pixel / size[0].min(size[1]))
        .ceil()
        .clamp(3.0, 32.0) as u32;
    let step = pixel / f64::from(points);
    let mean = |column: u32, row: u32| {
        let mut mean = [0.0; 3];
        for i in 0..points * points {
            let x = f64::from(column) * pixel + (f64::from(i % points) + 0.5) * step;
            let y = f64::from(row) * pixel + (f64::from(i / points) + 0.5) * step;
            let value = texture.value(wi, wr, (x, y));
            (0..3).for_each(|c| mean[c] += value[c] * wi.z / f64::from(points * points));
        }
        mean
    };
    let mut picture = Vec::new();
    for row in (0..a.width).rev() {
        let line: Vec<[f64; 3]> = (0..a.width).into_par_iter().map(|c| mean(c, row)).collect();
        picture.extend(line);
        if watch.cancelled() {
            return None;
        }
        let done = u64::from(a.width - row);
        watch.progress(&format!("{repeats} repeats"), done, u64::from(a.width));
    }
    Some(picture)
}
