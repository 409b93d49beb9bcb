//! Scale, pointing and lens of the camera, from a checkerboard in the sample's place.

use super::Calibrated;
use super::board::Fitted;
use super::recording::Recording;
use super::tour::Tour;
use crate::base::{Error, Result, Watch};
use crate::measure::calibration::{Calibrations, Dated, Geometry, Kind, PoseErrors};
use crate::measure::frames::Taken;
use crate::session::{CameraFacts, FrameKind, Lens, SessionFolder};
use serde::Serialize;

/// The board, and what the operator knows.
#[derive(Debug, Clone, PartialEq)]
pub struct GeometryOptions {
    /// Inner corners along the board's x and y.
    pub corners: [usize; 2],
    /// Side of a square, millimeters.
    pub square_mm: f64,
    /// How well poses are known; handed on as it is.
    pub pose: PoseErrors,
    /// Parts of the lens that are held at 0 whatever the poses say.
    pub hold: Vec<LensPart>,
}

/// A part of [`Lens`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LensPart {
    /// `roll`.
    Roll,
    /// `perspective`.
    Perspective,
    /// `distortion`.
    Distortion,
    /// `sag_px`.
    Sag,
}

impl LensPart {
    pub(super) fn parameters(self) -> &'static [usize] {
        match self {
            Self::Roll => &[3],
            Self::Perspective => &[10],
            Self::Distortion => &[11],
            Self::Sag => &[6, 7, 8, 9],
        }
    }
}

/// How the fit went.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct GeometryReport {
    /// Every configuration with board frames.
    pub poses: Vec<PoseReport>,
    /// Standard errors of the lens.
    pub lens_se: Lens,
    /// Standard error of `pointing_sd_px`, as far as the number of poses tells.
    pub pointing_sd_se_px: [f64; 2],
    /// Where the middle of the inner corners lies on the sample plane at rotation 0, millimeters.
    pub board_mm: [f64; 2],
    /// By how much the board is turned against the sample's axes, radians.
    pub board_angle: f64,
    /// What the poses do not determine and is held at 0.
    pub held: Vec<&'static str>,
}

/// One configuration.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PoseReport {
    /// Its id.
    pub config: u32,
    /// Camera polar angle, degrees.
    pub camera_theta_deg: f64,
    /// Turntable angle, degrees.
    pub rotation_deg: f64,
    /// Smallest distance between opposite edges of a square, pixels.
    pub square_px: f64,
    /// Corners used; 0 when the pose is left out.
    pub corners: usize,
    /// Where the image lies from where the fitted camera puts it, pixels.
    pub offset_px: [f64; 2],
    /// Why it is left out.
    pub left_out: Option<String>,
}

/// The session's rough scale is taken to be right to this.
const ROUGH_SCALE: f64 = 0.05;

/// Fits scale, pointing and lens to the corners of a checkerboard seen in several poses. docs/calibration.md says how to
/// shoot it.
///
/// # Errors
/// The session has no board frames, no pose shows the board where the session's camera facts expect it (to about a
/// square), too few corners are found, the scale comes out more than 5 % off the session's (a wrong `square_mm`); a frame
/// is missing, changed or of another camera; interrupted.
pub fn geometry(
    session: &SessionFolder,
    known: &Calibrations,
    options: &GeometryOptions,
    watch: &dyn Watch,
) -> Result<(Calibrated<Geometry>, GeometryReport)> {
    check_options(options)?;
    let recording = Recording::open(session)?;
    let frames = recording.need(FrameKind::Board, SHOOT)?;
    let plan = session.plan()?;
    let mut configurations = Vec::new();
    for configuration in &plan.configurations {
        let own = |f: &&Taken| f.record.config == Some(configuration.id);
        let own: Vec<Taken> = frames.iter().filter(own).cloned().collect();
        if !own.is_empty() {
            configurations.push((*configuration, own));
        }
    }
    // From the top down: every pose helps to find the board in the next one.
    configurations.sort_by(|(a, _), (b, _)| a.camera.theta.total_cmp(&b.camera.theta));
    let (reader, _) = recording.reader(&frames, watch)?;
    let hot: Vec<[usize; 2]> = match &known.dark {
        Some(dark) => dark.value.hot.iter().map(|h| [h.x, h.y]).collect(),
        None => Vec::new(),
    };
    let mut tour = Tour::new(&reader, options, &recording.manifest.camera, hot);
    for (configuration, frames) in &configurations {
        tour.visit(configuration, frames)?;
    }
    let fitted = tour.fit()?;
    check_scale(&fitted, &recording.manifest.camera, options)?;
    let (value, report) = tour.result(&fitted);
    let (warnings, faults) = remarks(&value, &report);
    let header = recording.header(Kind::Geometry);
    let dated = Dated { header, value };
    Ok((
        Calibrated {
            dated,
            warnings,
            faults,
        },
        report,
    ))
}

const SHOOT: &str = "put a checkerboard flat in the sample's place, its middle within half a square of the sample center and its edges along the sample's x and y, and capture board frames at several camera angles and two turntable angles";

fn check_options(options: &GeometryOptions) -> Result<()> {
    let [columns, rows] = options.corners;
    if !(2..=200).contains(&columns) || !(2..=200).contains(&rows) {
        return Err(Error::new(format!(
            "a board of {columns} x {rows} inner corners, expected 2 to 200 each way"
        ))
        .with_hint("count the corners where four squares meet, not the squares"));
    }
    if !(options.square_mm > 0.0 && options.square_mm.is_finite()) {
        return Err(Error::new(format!(
            "a square of {} mm, expected a positive length",
            options.square_mm
        )));
    }
    Ok(())
}

/// Fails when the scale is far from what the session says: the square's side would be wrong, which nothing else tells.
fn check_scale(fitted: &Fitted, stated: &CameraFacts, options: &GeometryOptions) -> Result<()> {
    let ratio = fitted.camera.values[0] / stated.pixel_mm;
    if (ratio - 1.0).abs() <= ROUGH_SCALE {
        return Ok(());
    }
    Err(Error::new(format!(
        "squares of {} mm make a pixel {:.5} mm, the session says {:.5} mm ({:+.1} %)",
        options.square_mm,
        fitted.camera.values[0],
        stated.pixel_mm,
        100.0 * (ratio - 1.0)
    ))
    .with_hint(format!(
        "measure the squares: {:.4} mm would agree; if they are right, mend camera.pixel_mm of the rig file and shoot again",
        options.square_mm / ratio
    )))
}

fn remarks(value: &Geometry, report: &GeometryReport) -> (Vec<String>, Vec<String>) {
    let mut warnings = Vec::new();
    for pose in &report.poses {
        if let Some(reason) = &pose.left_out {
            warnings.push(format!(
                "configuration {} is left out: {reason}",
                pose.config
            ));
        }
    }
    if !report.held.is_empty() {
        warnings.push(format!(
            "held at 0, as these poses do not tell: {}",
            report.held.join(", ")
        ));
    }
    let mut faults = Vec::new();
    let worst = value.pointing_sd_px[0].max(value.pointing_sd_px[1]);
    if worst > POINTING_FAULT_PX {
        faults.push(format!(
            "the image moves by {worst:.2} pixels from pose to pose in a way the lens does not explain"
        ));
    }
    (warnings, faults)
}

/// Pointing that scatters more than this is out of tolerance, pixels.
const POINTING_FAULT_PX: f64 = 1.0;
