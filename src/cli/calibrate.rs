//! `goniofit calibrate`: what is known of the rig's camera, lens, lamp and white standard, from recorded sessions.

use super::calibrate_color::ColorArguments;
use super::calibrate_geometry::GeometryArguments;
use super::output::data;
use super::terminal::Terminal;
use super::{Outcome, inputs, measure::quiet_decoder_panics};
use crate::base::{Context, Result};
use crate::measure::calibrate::{
    self, Calibrated, DarkOptions, Factor, LinearityOptions, WhiteOptions,
};
use crate::measure::calibration::{
    Calibrations, DarkCurrent, FlatField, LampDrift, Linearity, Value, WhiteStandard,
};
use crate::session::SessionFolder;
use clap::{Args, Subcommand};
use std::path::PathBuf;

/// Make calibrations from recorded sessions: dated files, each value with its uncertainty
#[derive(Args)]
#[command(
    after_help = "Each subcommand reads one session and writes one dated file into OUT/RIG; docs/calibration.md says how to
shoot each. In this order, as later ones use what earlier ones found: dark, linearity, flat, white, geometry,
color; drift at any time.
Exit code 1 when a result is out of tolerance: the file is written, with a warning.

Examples:
  goniofit calibrate dark sessions/darks
  goniofit calibrate linearity sessions/series
  goniofit calibrate flat sessions/flats --uniformity-se 0.2%
  goniofit calibrate white sessions/white --panel 'Spectralon 12345' --table panel.csv
  goniofit calibrate drift sessions/warm-up
  goniofit calibrate geometry sessions/board --corners 9x9 --square-mm 1
  goniofit calibrate color sessions/chart --chart chart.csv"
)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    Dark(DarkArguments),
    Linearity(LinearityArguments),
    Flat(FlatArguments),
    White(WhiteArguments),
    Drift(DriftArguments),
    Geometry(GeometryArguments),
    Color(ColorArguments),
}

/// What all calibrations are given.
#[derive(Args)]
pub(super) struct Common {
    /// Session folder (holds session.json)
    session: PathBuf,
    /// Folder of all rigs' calibrations; the file goes to its subfolder RIG
    #[arg(long, value_name = "DIR", default_value = "calibration")]
    out: PathBuf,
    /// Folder with the calibrations known beforehand [default: OUT/RIG, if it is there]
    #[arg(long, value_name = "DIR")]
    calibration: Option<PathBuf>,
    /// Print the file's content instead of a table
    #[arg(long)]
    json: bool,
}

/// Bias, dark current, read noise and hot pixels, from dark frames at several exposures
#[derive(Args)]
#[command(
    after_help = "Cap the lens; at least two exposures, the shortest and the longest that are used, 8 or more of each.

Examples:
  goniofit calibrate dark sessions/darks
  goniofit calibrate dark sessions/darks --hot-sigma 6 --json"
)]
struct DarkArguments {
    #[command(flatten)]
    common: Common,
    /// Robust standard deviations from which on a pixel is hot
    #[arg(long, value_name = "N", default_value_t = 8.0)]
    hot_sigma: f64,
}

/// The response curve and the photon transfer (gain, read noise), from steady light at many exposures
#[derive(Args)]
#[command(
    after_help = "Shoot the white panel at 8 or more exposures from nearly dark to nearly saturated, each twice, up and down again or
with visits of the reference pose in between, and darks of the same exposures.

Examples:
  goniofit calibrate linearity sessions/series
  goniofit calibrate linearity sessions/series --box 800,600,400,400 --max-order 2"
)]
struct LinearityArguments {
    #[command(flatten)]
    common: Common,
    /// Pixels to use [default: a square of a quarter of the image's shorter side around the sample center]
    #[arg(long = "box", value_name = "X,Y,W,H", value_parser = parse_box)]
    region: Option<[usize; 4]>,
    /// Highest power of the signal in the correction
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u8).range(0..=3))]
    max_order: u8,
}

/// Relative response of every pixel, from frames of something evenly bright
#[derive(Args)]
#[command(
    after_help = "Shoot a diffuser on the lens, or a panel that fills the image, 8 or more times at half the white level, and darks
of that exposure. The lamp need not be steady.

Examples:
  goniofit calibrate flat sessions/flats
  goniofit calibrate flat sessions/flats --uniformity-se 0.2%"
)]
struct FlatArguments {
    #[command(flatten)]
    common: Common,
    /// Relative standard uncertainty of the source's evenness over the sample square
    #[arg(long, value_name = "FRACTION", default_value = "0.5%", value_parser = inputs::fraction)]
    uniformity_se: f64,
}

/// Raw values per normalized radiance and millisecond, from the white standard
#[derive(Args)]
#[command(
    after_help = "Shoot the white standard at the session's reference geometry, twice at some exposures, and darks of them. A panel is
no constant white (0.88 to 1.06 over usual geometries): give its factor at this geometry, or a table of geometries.

Examples:
  goniofit calibrate white sessions/white --panel 'Spectralon 12345'
  goniofit calibrate white sessions/white --factor 1.012,1.015,1.013 --factor-se 0.004
  goniofit calibrate white sessions/white --table panel.csv --factor-se 0.004,0.004,0.005

The table is CSV with columns light, camera, rel_azimuth (degrees; 0 = same side) and three like BRF450,BRF550,BRF620."
)]
struct WhiteArguments {
    #[command(flatten)]
    common: Common,
    /// Which panel: maker, serial number
    #[arg(long, value_name = "TEXT", default_value = "")]
    panel: String,
    /// Reflectance factor at the session's reference geometry [default: the session's]
    #[arg(long, value_name = "R,G,B", value_parser = parse_three, requires = "factor_se", conflicts_with = "table")]
    factor: Option<Three>,
    /// Its standard uncertainty: one number or R,G,B
    #[arg(long, value_name = "R,G,B", value_parser = parse_three)]
    factor_se: Option<Three>,
    /// Table of reflectance factors by geometry
    #[arg(long, value_name = "FILE.csv")]
    table: Option<PathBuf>,
}

/// The lamp's drift and flicker, from visits of the reference pose
#[derive(Args)]
#[command(
    after_help = "Any session with three or more visits of the reference pose will do; to see the lamp warm up, begin right after
switching it on.

Examples:
  goniofit calibrate drift sessions/warm-up
  goniofit calibrate drift sessions/2026-11-22 --json"
)]
struct DriftArguments {
    #[command(flatten)]
    common: Common,
}

/// Three numbers, or one for all.
type Three = [f64; 3];

fn parse_three(text: &str) -> Result<Three, String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|n| n.trim().parse()).collect();
    match numbers.as_deref() {
        Ok(&[one]) => Ok([one; 3]),
        Ok(&[r, g, b]) => Ok([r, g, b]),
        _ => Err("expected one number or three, R,G,B".to_owned()),
    }
}

fn parse_box(text: &str) -> Result<[usize; 4], String> {
    let numbers: Result<Vec<usize>, _> = text.split(',').map(|n| n.trim().parse()).collect();
    numbers
        .ok()
        .and_then(|n| n.try_into().ok())
        .ok_or_else(|| "expected four whole numbers X,Y,W,H".to_owned())
}

pub(crate) fn run(arguments: Arguments) -> Result<Outcome> {
    quiet_decoder_panics();
    match arguments.what {
        What::Dark(a) => dark(&a),
        What::Linearity(a) => linearity(&a),
        What::Flat(a) => flat(&a),
        What::White(a) => white(&a),
        What::Drift(a) => drift(&a),
        What::Geometry(a) => super::calibrate_geometry::run(&a),
        What::Color(a) => super::calibrate_color::run(&a),
    }
}

/// One calibration under way.
pub(super) struct Work<'a> {
    common: &'a Common,
    pub(super) session: SessionFolder,
    folder: PathBuf,
    pub(super) known: Calibrations,
    pub(super) terminal: Terminal,
}

impl<'a> Work<'a> {
    pub(super) fn begin(common: &'a Common) -> Result<Self> {
        let session = inputs::session(&common.session)?;
        let folder = common.out.join(session.manifest()?.rig);
        let known = match &common.calibration {
            Some(known) => Calibrations::read(known)?,
            None if folder.is_dir() => Calibrations::read(&folder)?,
            None => Calibrations::default(),
        };
        inputs::prepare_folder(&folder)?;
        Ok(Self {
            common,
            session,
            folder,
            known,
            terminal: Terminal::new()?,
        })
    }

    /// Says what is to be said, writes the file, prints it or its table.
    pub(super) fn end<T: Value>(
        &self,
        mut made: Calibrated<T>,
        table: impl FnOnce(&T),
    ) -> Result<Outcome> {
        if made.dated.header.synthetic {
            self.terminal
                .say("synthetic session: no camera saw anything");
        }
        for warning in made.warnings.iter().chain(&made.faults) {
            self.terminal.say(format!("warning: {warning}"));
        }
        let path = made.dated.write(&self.folder)?;
        self.terminal.say(format!("wrote {}", path.display()));
        if self.common.json {
            let text =
                serde_json::to_string_pretty(&made.dated).context(|| "JSON cannot be written")?;
            data!("{text}");
        } else {
            let header = &made.dated.header;
            data!("# {}, {}, {}", header.rig, header.camera, header.date_utc);
            table(&made.dated.value);
        }
        if made.faults.is_empty() {
            return Ok(Outcome::Done);
        }
        self.terminal
            .say("out of tolerance: see the warnings above before using this calibration");
        Ok(Outcome::OutsideTolerance)
    }
}

fn dark(arguments: &DarkArguments) -> Result<Outcome> {
    let work = Work::begin(&arguments.common)?;
    let options = DarkOptions {
        hot_sigma: arguments.hot_sigma,
    };
    let made = calibrate::dark(&work.session, &work.known, &options, &work.terminal)?;
    work.end(made, |d: &DarkCurrent| {
        data!("place        bias DN          dark current DN/s");
        for p in (0..4).filter(|&p| d.bias_se[p] > 0.0) {
            data!(
                "{p:>5}  {:>9.3} +- {:.3}   {:>9.4} +- {:.4}",
                d.bias[p],
                d.bias_se[p],
                1000.0 * d.per_ms[p],
                1000.0 * d.per_ms_se[p]
            );
        }
        data!(
            "read noise {:.4} +- {:.4} DN",
            d.read_noise,
            d.read_noise_se
        );
        data!(
            "dark current from pixel to pixel {:.4} DN/s; {} hot pixels",
            1000.0 * d.per_ms_scatter,
            d.hot.len()
        );
    })
}

fn linearity(arguments: &LinearityArguments) -> Result<Outcome> {
    let work = Work::begin(&arguments.common)?;
    let options = LinearityOptions {
        region: arguments.region,
        max_order: usize::from(arguments.max_order),
        ..LinearityOptions::default()
    };
    let made = calibrate::linearity(&work.session, &work.known, &options, &work.terminal)?;
    work.end(made, |l: &Linearity| {
        data!("exposure ms  channel     signal DN            residual %");
        for p in &l.points {
            data!(
                "{:>11}  {:<7} {:>10.3} +- {:.3}   {:>+8.3}",
                p.exposure_ms,
                CHANNELS[p.channel],
                p.signal,
                p.signal_se,
                100.0 * p.residual
            );
        }
        for (k, (c, row)) in (1..).zip(l.coefficients.iter().zip(&l.covariance)) {
            data!("c{k} {c:+.6} +- {:.6}", row[k - 1].sqrt());
        }
        data!(
            "checked from {:.2} to {:.1} % of {:.0} DN",
            100.0 * l.usable[0],
            100.0 * l.usable[1],
            l.full_scale
        );
        let t = &l.transfer;
        for c in 0..3 {
            let (a, se) = (t.variance_per_signal[c], t.variance_per_signal_se[c]);
            data!(
                "{:<5} variance per signal {a:.5} +- {se:.5} DN, gain {:.4} +- {:.4} electrons/DN",
                CHANNELS[c],
                1.0 / a,
                se / (a * a)
            );
        }
        data!(
            "read noise {:.4} +- {:.4} DN",
            t.read_noise,
            t.read_noise_se
        );
    })
}

const CHANNELS: [&str; 3] = ["red", "green", "blue"];

fn flat(arguments: &FlatArguments) -> Result<Outcome> {
    let work = Work::begin(&arguments.common)?;
    let uniformity_se = arguments.uniformity_se;
    let made = calibrate::flat(&work.session, &work.known, uniformity_se, &work.terminal)?;
    work.end(made, |f: &FlatField| {
        data!("channel  falloff %  pixel scatter %");
        for c in 0..3 {
            let (falloff, scatter) = (100.0 * f.falloff[c], 100.0 * f.scatter[c]);
            data!("{:<7} {falloff:>10.2} {scatter:>16.3}", CHANNELS[c]);
        }
        let mut relative = f.response_se.clone();
        let middle = relative.len() / 2;
        let median = *relative.select_nth_unstable_by(middle, f32::total_cmp).1;
        data!(
            "one pixel +- {:.3} %, evenness of the source +- {:.3} %",
            100.0 * median,
            100.0 * f.uniformity_se
        );
    })
}

fn white(arguments: &WhiteArguments) -> Result<Outcome> {
    let work = Work::begin(&arguments.common)?;
    let white = work.session.manifest()?.white;
    let factor = match (&arguments.table, arguments.factor, arguments.factor_se) {
        (Some(table), _, se) => Factor::Table(table.clone(), se),
        (None, Some(factor), Some(se)) => Factor::Stated(factor, se),
        (None, None, Some(se)) => Factor::Stated(white.reflectance_factor, se),
        (None, _, None) => Factor::Session,
    };
    let options = WhiteOptions {
        panel: arguments.panel.clone(),
        factor,
    };
    let made = calibrate::white(&work.session, &work.known, &options, &work.terminal)?;
    work.end(made, |w: &WhiteStandard| {
        data!(
            "light at {:.1} deg, azimuth {:.1}; camera at {:.1} deg, azimuth {:.1}",
            w.light_theta_deg,
            w.light_phi_deg,
            w.camera_theta_deg,
            w.camera_phi_deg
        );
        data!("channel  reflectance factor      responsivity DN/ms");
        for c in 0..3 {
            data!(
                "{:<7}  {:.4} +- {:.4}   {:>12.5} +- {:.5}",
                CHANNELS[c],
                w.reflectance_factor[c],
                w.reflectance_factor_se[c],
                w.responsivity[c],
                w.responsivity_se[c]
            );
        }
    })
}

fn drift(arguments: &DriftArguments) -> Result<Outcome> {
    let work = Work::begin(&arguments.common)?;
    let made = calibrate::drift(&work.session, &work.known, &work.terminal)?;
    work.end(made, |d: &LampDrift| {
        data!("channel  change per hour %");
        for c in 0..3 {
            data!(
                "{:<7} {:>+9.4} +- {:.4}",
                CHANNELS[c],
                100.0 * d.per_hour[c],
                100.0 * d.per_hour_se[c]
            );
        }
        data!(
            "flicker {:.4} +- {:.4} %, settled after {:.0} s, {} visits",
            100.0 * d.flicker,
            100.0 * d.flicker_se,
            d.settled_after_s,
            d.visits
        );
    })
}
