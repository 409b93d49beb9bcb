//! `goniofit calibrate geometry`: scale, pointing and lens, from a checkerboard.

use super::Outcome;
use super::calibrate::{Common, Work};
use super::output::data;
use crate::base::Result;
use crate::measure::calibrate::{GeometryOptions, GeometryReport, LensPart, geometry};
use crate::measure::calibration::{Geometry, PoseErrors};
use clap::{Args, ValueEnum};

/// Scale, pointing and lens of the camera, from a checkerboard in the sample's place
#[derive(Args)]
#[command(
    after_help = "Lay a flat checkerboard in the sample's place, its surface at the sample's height, its middle within half a square of
the sample center, its edges along the sample's x and y at turntable angle 0. Capture board frames at five or more camera
angles from 0 to the most grazing one in use, each at turntable angles 0 and 90. The session's pixel_mm must be right to 5 %,
its center_px to a square.

Examples:
  goniofit calibrate geometry sessions/board --corners 9x9 --square-mm 1
  goniofit calibrate geometry sessions/board --corners 7x5 --square-mm 1.25 --camera-theta-error-deg 0.05 --height-error-mm 0.1
  goniofit calibrate geometry sessions/board --corners 9x9 --square-mm 1 --hold distortion --json"
)]
pub(super) struct GeometryArguments {
    #[command(flatten)]
    common: Common,
    /// Inner corners along the board's x and y: where four squares meet
    #[arg(long, value_name = "NxM", value_parser = parse_corners)]
    corners: Corners,
    /// Side of a square, millimeters
    #[arg(long, value_name = "MM")]
    square_mm: f64,
    /// A part of the lens that stays 0; may be given several times
    #[arg(long, value_name = "PART", value_enum)]
    hold: Vec<HeldPart>,
    /// Standard uncertainty of the camera's polar angle, degrees
    #[arg(long, value_name = "DEG", default_value_t = 0.0)]
    camera_theta_error_deg: f64,
    /// Standard uncertainty of the light's polar angle, degrees
    #[arg(long, value_name = "DEG", default_value_t = 0.0)]
    light_theta_error_deg: f64,
    /// Standard uncertainty of the turntable's angle, degrees
    #[arg(long, value_name = "DEG", default_value_t = 0.0)]
    rotation_error_deg: f64,
    /// Standard uncertainty of the sample surface's height over the center of rotation, millimeters
    #[arg(long, value_name = "MM", default_value_t = 0.0)]
    height_error_mm: f64,
}

#[derive(Clone, Copy, ValueEnum)]
enum HeldPart {
    Roll,
    Perspective,
    Distortion,
    Sag,
}

impl From<HeldPart> for LensPart {
    fn from(part: HeldPart) -> Self {
        match part {
            HeldPart::Roll => Self::Roll,
            HeldPart::Perspective => Self::Perspective,
            HeldPart::Distortion => Self::Distortion,
            HeldPart::Sag => Self::Sag,
        }
    }
}

/// Two counts.
type Corners = [usize; 2];

fn parse_corners(text: &str) -> Result<Corners, String> {
    let counts: Vec<Option<usize>> = text.split('x').map(|n| n.trim().parse().ok()).collect();
    match counts[..] {
        [Some(n), Some(m)] => Ok([n, m]),
        _ => Err("expected two counts, as in 9x9".to_owned()),
    }
}

pub(super) fn run(arguments: &GeometryArguments) -> Result<Outcome> {
    let work = Work::begin(&arguments.common)?;
    let options = GeometryOptions {
        corners: arguments.corners,
        square_mm: arguments.square_mm,
        pose: PoseErrors {
            camera_theta_deg: arguments.camera_theta_error_deg,
            light_theta_deg: arguments.light_theta_error_deg,
            rotation_deg: arguments.rotation_error_deg,
            height_mm: arguments.height_error_mm,
        },
        hold: arguments.hold.iter().map(|&p| p.into()).collect(),
    };
    let (made, report) = geometry(&work.session, &work.known, &options, &work.terminal)?;
    work.end(made, |g: &Geometry| print(g, &report))
}

fn print(g: &Geometry, report: &GeometryReport) {
    let (lens, se) = (&g.lens, &report.lens_se);
    let line = |name: &str, value: f64, se: f64, unit: &str| {
        data!("{name:<14} {value:>12.6} +- {se:.6} {unit}");
    };
    line("pixel_mm", g.pixel_mm, g.pixel_mm_se, "mm");
    line("center x", g.center_px[0], g.center_px_se[0], "px");
    line("center y", g.center_px[1], g.center_px_se[1], "px");
    line("roll", lens.roll.to_degrees(), se.roll.to_degrees(), "deg");
    line("perspective", lens.perspective, se.perspective, "1/mm");
    line("distortion", lens.distortion, se.distortion, "");
    for (k, name) in ["sag sin", "sag 1-cos"].iter().enumerate() {
        for (a, axis) in ["x", "y"].iter().enumerate() {
            let name = format!("{name} {axis}");
            line(&name, lens.sag_px[k][a], se.sag_px[k][a], "px");
        }
    }
    let [x, y] = g.pointing_sd_px;
    let [x_se, y_se] = report.pointing_sd_se_px;
    data!("pointing from pose to pose: x {x:.3} +- {x_se:.3}, y {y:.3} +- {y_se:.3} px");
    data!(
        "{} corners, root mean square residual {:.4} px; board {:+.3}, {:+.3} mm off, turned by {:+.3} deg",
        g.corners,
        g.residual_px,
        report.board_mm[0],
        report.board_mm[1],
        report.board_angle.to_degrees()
    );
    data!("config  camera deg  turntable deg  square px  corners   offset x   offset y px");
    for p in &report.poses {
        data!(
            "{:>6}  {:>10.2}  {:>13.2}  {:>9.1}  {:>7}  {:>+9.3}  {:>+9.3}{}",
            p.config,
            p.camera_theta_deg,
            p.rotation_deg,
            p.square_px,
            p.corners,
            p.offset_px[0],
            p.offset_px[1],
            if p.left_out.is_some() {
                "  left out"
            } else {
                ""
            }
        );
    }
}
