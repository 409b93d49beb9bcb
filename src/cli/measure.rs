//! `goniofit measure`: statistics of one frame, or the intensities of a session.

use super::measured::{self, Export, Outputs};
use super::output::data;
use super::terminal::Terminal;
use super::{Outcome, inputs};
use crate::base::{Context, Error, Result};
use crate::measure::calibration::{Calibrations, Kind, PoseErrors};
use crate::measure::{
    self, Crop, CropRule, FrameStatistics, MeasureOptions, MeasureReport, RawFrame,
};
use crate::session::{FrameKind, Measurements, Quantity, SessionFolder};
use clap::{Args, Subcommand};
use serde_json::json;
use std::path::{Path, PathBuf};

/// Turn a session's frames into mean intensities with standard errors
#[derive(Args)]
#[command(after_help = "Examples:
  goniofit measure session goniofit-demo
  goniofit measure frame IMG_0001.CR2 --crop 1056,760,200,200 --json")]
pub(crate) struct Arguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    Frame(FrameArguments),
    Session(SessionArguments),
}

/// Raw values of one frame, per channel (black not subtracted)
#[derive(Args)]
#[command(
    after_help = "Coordinates count from the top left pixel of the visible area (masked margins removed).
Channels of a mosaic: R, G1 (greens of even rows), G2 (greens of odd rows), B; without filters: Y; else R, G, B.

Examples:
  goniofit measure frame IMG_0001.CR2 --crop 1056,760,200,200
  goniofit measure frame shot.fits --json       the whole visible area"
)]
struct FrameArguments {
    /// Camera RAW, DNG, or linear 16-bit TIFF, PNG or FITS (docs/cameras.md)
    file: PathBuf,
    /// Box of the visible area; default: all of it
    #[arg(long, value_name = "X,Y,W,H", value_parser = parse_crop)]
    crop: Option<Crop>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Mean normalized radiance of the sample square in every configuration of a session
#[derive(Args)]
#[command(
    after_help = "Writes measurements.csv, measurements.json and the page measurement.html into the session folder and prints a table.
Exit code 1 when some configuration was saturated, under-exposed or not captured.

Examples:
  goniofit measure session goniofit-demo
  goniofit measure session night2 --calibration calibration/lab --pose-errors 0.05,0.05,0.1,0.1
  goniofit measure session goniofit-demo --out again --json      again.csv, again.json, again.html
  goniofit measure session goniofit-demo --force                 replace existing files
  goniofit measure session goniofit-demo --export astm,alta,exr  also tables for other programs, and linear crops
  goniofit measure session irawan --export brdf-csv --symmetry 180"
)]
struct SessionArguments {
    /// Session folder (holds session.json)
    folder: PathBuf,
    /// Beginning of the files' names: STEM.csv, STEM.json, ... [default: the usual names in the session folder]
    #[arg(long, value_name = "STEM")]
    out: Option<PathBuf>,
    /// What else to write
    #[arg(long, value_name = "WHAT,..", value_enum, value_delimiter = ',')]
    export: Vec<Export>,
    /// Quantity of the CSV file and the printed table
    #[arg(long = "as", value_name = "QUANTITY", value_enum, default_value_t = QuantityName::NormalizedRadiance)]
    quantity: QuantityName,
    /// In BRDF tables, add a marked copy of every point turned by this angle about the normal
    #[arg(long, value_name = "DEG", value_parser = parse_symmetry)]
    symmetry: Option<u32>,
    /// Folder of the rig's calibration files; the newest of each kind is applied
    #[arg(long, value_name = "DIR")]
    calibration: Option<PathBuf>,
    /// Standard uncertainties of the pose: camera angle, light angle, turntable (degrees), height of the surface (mm)
    /// [default: as the geometry calibration says]
    #[arg(long, value_name = "CAMERA,LIGHT,TABLE,HEIGHT", value_parser = parse_pose)]
    pose_errors: Option<PoseErrors>,
    /// Average over this box of every image instead of the projection of the sample square
    #[arg(long, value_name = "X,Y,W,H", value_parser = parse_crop)]
    crop: Option<Crop>,
    /// Convert to the color space of the color calibration instead of keeping the camera's red, green, blue
    #[arg(long, requires = "calibration")]
    color: bool,
    /// Print JSON with the error budget instead of the table
    #[arg(long)]
    json: bool,
    /// Replace existing files
    #[arg(long)]
    force: bool,
}

/// [`Quantity`] on the command line.
#[derive(Clone, Copy, clap::ValueEnum)]
enum QuantityName {
    /// pi L / E_normal
    NormalizedRadiance,
    /// Over that of a perfect white diffuser
    RadianceFactor,
    /// 1/sr
    Brdf,
}

impl From<QuantityName> for Quantity {
    fn from(name: QuantityName) -> Self {
        match name {
            QuantityName::NormalizedRadiance => Self::NormalizedRadiance,
            QuantityName::RadianceFactor => Self::RadianceFactor,
            QuantityName::Brdf => Self::Brdf,
        }
    }
}

fn parse_symmetry(text: &str) -> std::result::Result<u32, String> {
    match text {
        "180" => Ok(180),
        _ => Err("only half a turn (180) is known".to_owned()),
    }
}

pub(crate) fn run(arguments: Arguments) -> Result<Outcome> {
    quiet_decoder_panics();
    match arguments.what {
        What::Frame(a) => frame(&a),
        What::Session(a) => session(&a),
    }
}

/// Keeps the decoder's panics on damaged files off stderr: they are caught and come back as errors. Other panics are
/// told as ever.
pub(super) fn quiet_decoder_panics() {
    let tell = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        let decoder = |l: &std::panic::Location<'_>| l.file().contains("rawloader");
        if !info.location().is_some_and(decoder) {
            tell(info);
        }
    }));
}

fn parse_pose(text: &str) -> std::result::Result<PoseErrors, String> {
    let numbers: Vec<f64> = text
        .split(',')
        .map(|n| n.trim().parse())
        .collect::<std::result::Result<_, _>>()
        .map_err(|_| "expected four numbers CAMERA,LIGHT,TABLE,HEIGHT".to_owned())?;
    match numbers[..] {
        [camera, light, table, height] if numbers.iter().all(|n| (0.0..=10.0).contains(n)) => {
            Ok(PoseErrors {
                camera_theta_deg: camera,
                light_theta_deg: light,
                rotation_deg: table,
                height_mm: height,
            })
        }
        _ => Err(
            "expected four numbers from 0 to 10: degrees, degrees, degrees, millimeters".to_owned(),
        ),
    }
}

fn parse_crop(text: &str) -> std::result::Result<Crop, String> {
    let numbers: Vec<usize> = text
        .split(',')
        .map(|n| n.trim().parse())
        .collect::<std::result::Result<_, _>>()
        .map_err(|_| "expected four whole numbers X,Y,W,H".to_owned())?;
    match numbers[..] {
        [x, y, width, height] => Ok(Crop {
            x,
            y,
            width,
            height,
        }),
        _ => Err(format!(
            "expected four whole numbers X,Y,W,H, found {}",
            numbers.len()
        )),
    }
}

fn frame(arguments: &FrameArguments) -> Result<Outcome> {
    let frame = measure::decode_file(&arguments.file)?;
    let whole = Crop {
        x: 0,
        y: 0,
        width: frame.width,
        height: frame.height,
    };
    let statistics = measure::frame_statistics(&frame, arguments.crop.unwrap_or(whole))
        .context(|| arguments.file.display().to_string())?;
    if arguments.json {
        let value = frame_json(&arguments.file, &frame, &statistics);
        data!("{}", pretty(&value)?);
    } else {
        print_frame(&frame, &statistics);
    }
    Ok(Outcome::Done)
}

fn pretty(value: &serde_json::Value) -> Result<String> {
    serde_json::to_string_pretty(value).context(|| "JSON cannot be written")
}

fn frame_json(file: &Path, frame: &RawFrame, statistics: &FrameStatistics) -> serde_json::Value {
    let [top, right, bottom, left] = frame.margins;
    let channels = &statistics.channels;
    json!({
        "file": file.display().to_string(),
        "make": frame.make,
        "model": frame.model,
        "visible": {"width": frame.width, "height": frame.height},
        "full": {
            "width": frame.width + left + right,
            "height": frame.height + top + bottom,
        },
        "margins": {"top": top, "right": right, "bottom": bottom, "left": left},
        "cfa": frame.layout.to_string(),
        "black": frame.black,
        "white": frame.white,
        "exposure_ms": frame.exposure_ms,
        "aperture": frame.aperture,
        "iso": frame.iso,
        "date_time": frame.date_time,
        "crop": statistics.crop,
        "channels": channels,
        "min": channels.iter().map(|c| c.min).min(),
        "max": channels.iter().map(|c| c.max).max(),
        "clipped": channels.iter().map(|c| c.clipped).sum::<usize>(),
    })
}

fn print_frame(frame: &RawFrame, statistics: &FrameStatistics) {
    let [top, right, bottom, left] = frame.margins;
    data!(
        "{} {}: {} x {} visible pixels (margins top {top}, right {right}, bottom {bottom}, left {left}), {}, white {}",
        frame.make,
        frame.model,
        frame.width,
        frame.height,
        frame.layout,
        frame.white
    );
    if let Some(ms) = frame.exposure_ms {
        data!("exposure {ms} ms");
    }
    let crop = statistics.crop;
    data!(
        "crop {},{},{},{}; raw values, black not subtracted:",
        crop.x,
        crop.y,
        crop.width,
        crop.height
    );
    data!("channel         mean    min    max  clipped   pixels    black");
    for c in &statistics.channels {
        data!(
            "{:<7} {:>12.4} {:>6} {:>6} {:>8} {:>8} {:>8}",
            c.channel,
            c.mean,
            c.min,
            c.max,
            c.clipped,
            c.pixels,
            c.black
        );
    }
}

fn session(arguments: &SessionArguments) -> Result<Outcome> {
    let session = inputs::session(&arguments.folder)?;
    let quantity = Quantity::from(arguments.quantity);
    let outputs = Outputs::new(
        &arguments.folder,
        arguments.out.as_deref(),
        &arguments.export,
        quantity,
        arguments.symmetry.is_some(),
    );
    outputs.refuse_overwriting(arguments.force)?;
    let (calibrations, used) = match &arguments.calibration {
        Some(folder) => {
            let calibrations = Calibrations::read(folder)?;
            if calibrations == Calibrations::default() {
                return Err(no_calibration(folder));
            }
            let mut used = measured::calibrations_used(folder, &calibrations)?;
            used.retain(|u| arguments.color || u.kind != Kind::Color.name());
            (calibrations, used)
        }
        None => Default::default(),
    };
    if arguments.color && calibrations.color.is_none() {
        return Err(
            Error::new("the calibration folder has no color calibration")
                .with_hint("make one with `goniofit calibrate color`, or leave out --color"),
        );
    }
    let options = MeasureOptions {
        calibrations,
        pose: arguments.pose_errors,
        crop: arguments.crop.map_or(CropRule::Square, CropRule::Rectangle),
        color: arguments.color,
        ..MeasureOptions::default()
    };
    let gallery = outputs.gallery(&session, &options)?;
    let terminal = Terminal::new()?;
    let (measurements, report) = measure::measure_viewed(&session, &options, &gallery, &terminal)?;
    let record = measured::record(&session, &options, used, &measurements, &report)?;
    let mut looks = gallery.looks(measured::gains(&record))?;
    measured::add_calibrations(&mut looks, &options.calibrations)?;
    let written = outputs.write(&measurements, &record, &looks)?;
    tell(&terminal, &session, &report)?;
    for path in written {
        terminal.say(format!("wrote {}", path.display()));
    }
    if arguments.json {
        data!("{}", pretty(&session_json(&measurements, &report))?);
    } else {
        print_table(&measurements, &report, quantity);
    }
    Ok(if report.outside_tolerance() {
        Outcome::OutsideTolerance
    } else {
        Outcome::Done
    })
}

/// Told with the subfolder that was meant, if there is one.
fn no_calibration(folder: &Path) -> Error {
    let inside = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let meant = inside.map(|e| e.path()).find(|p| p.is_dir());
    let hint = meant.map_or("make one with `goniofit calibrate`".to_owned(), |p| {
        format!("did you mean {}?", p.display())
    });
    Error::new(format!("no calibration file in {}", folder.display())).with_hint(hint)
}

/// What is not data: where the numbers come from, and what the operator should know.
fn tell(terminal: &Terminal, session: &SessionFolder, report: &MeasureReport) -> Result<()> {
    if report.synthetic {
        terminal.say("synthetic session: no camera saw any cloth");
    }
    let darks = session.frames()?;
    let darks = darks.iter().filter(|f| f.kind == FrameKind::Dark).count();
    terminal.say(format!(
        "{} frames ({darks} dark), {} hot pixels left out; noise from {}: {:.3} +- {:.3} (raw value)^2 per raw value",
        report.frames,
        report.hot_pixels,
        report.noise.source,
        report.noise.variance_per_signal[1],
        report.noise.variance_per_signal_se[1]
    ));
    if !report.calibrations.is_empty() {
        let named = report.calibrations.iter().map(|h| {
            let synthetic = if h.synthetic { " (synthetic)" } else { "" };
            format!("{} of {}{synthetic}", h.kind.name(), h.date_utc)
        });
        terminal.say(format!(
            "applied calibrations: {}",
            named.collect::<Vec<_>>().join(", ")
        ));
    }
    let messages = report
        .configurations
        .iter()
        .flat_map(|c| c.message.iter().chain(&c.notes));
    for message in report.warnings.iter().chain(messages) {
        terminal.say(format!("warning: {message}"));
    }
    Ok(())
}

fn session_json(measurements: &Measurements, report: &MeasureReport) -> serde_json::Value {
    let intensities: Vec<_> = measurements
        .intensities
        .iter()
        .map(|i| {
            json!({
                "config": i.configuration.id,
                "mean": i.mean,
                "se": i.standard_error,
            })
        })
        .collect();
    json!({
        "synthetic": report.synthetic,
        "intensities": intensities,
        "report": report,
    })
}

fn print_table(measurements: &Measurements, report: &MeasureReport, quantity: Quantity) {
    if report.synthetic {
        data!("# synthetic");
    }
    print_lamp(report);
    match quantity {
        Quantity::NormalizedRadiance => {
            data!("# normalized radiance pi L / E_normal, +- standard error");
        }
        other => data!(
            "# {}, unit {}, +- standard error",
            other.definition(),
            other.unit()
        ),
    }
    data!("config           r                   g                   b            exposures ms");
    for c in &report.configurations {
        let found = measurements
            .intensities
            .iter()
            .find(|i| i.configuration.id == c.config);
        let Some(i) = found else {
            data!("{:>6}   not measured: {:?}", c.config, c.condition);
            continue;
        };
        let (mean, standard_error) = quantity.of(i);
        let cells: Vec<String> = mean
            .iter()
            .zip(standard_error)
            .map(|(m, s)| format!("{m:.5} +- {s:.5}"))
            .collect();
        let times: Vec<String> = c.exposures_ms.iter().map(f64::to_string).collect();
        data!("{:>6}  {}  {}", c.config, cells.join("  "), times.join(" "));
    }
}

/// The visits of the reference pose, if there were any.
fn print_lamp(report: &MeasureReport) {
    if report.lamp.visits.is_empty() {
        return;
    }
    data!("# lamp relative to the first reference visit, +- standard error");
    data!("# visit  stretch   time s           r                   g                   b");
    for v in &report.lamp.visits {
        let cells: Vec<String> = v
            .level
            .iter()
            .zip(v.standard_error)
            .map(|(l, s)| format!("{l:.5} +- {s:.5}"))
            .collect();
        data!(
            "# {:>5}  {:>7}  {:>7.0}  {}",
            v.visit,
            v.stretch,
            v.elapsed_s,
            cells.join("  ")
        );
    }
    if let Some(change) = report.lamp.before_first_visit {
        let largest = change.into_iter().fold(0.0_f64, |l, c| l.max(c.abs()));
        data!(
            "# white frames are taken as shot at the first visit's level; at its rate then that may be off by {:.2} %",
            100.0 * largest
        );
    }
}
