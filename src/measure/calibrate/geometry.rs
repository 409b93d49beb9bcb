//! Scale, pointing and lens of the camera, from a checkerboard in the sample's place.

use super::Calibrated;
use super::board::{self, Camera, Fitted, NAMES, PARAMETERS, Pose};
use super::corners::{self, Expected, Sighting, View};
use super::recording::{Reader, Recording};
use crate::base::{Error, Result, Watch};
use crate::measure::calibration::{Calibrations, Dated, Geometry, Kind, PoseErrors};
use crate::measure::frames::{Taken, same_exposure};
use crate::session::{CameraFacts, Configuration, FrameKind, Lens, SessionFolder};
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
    fn parameters(self) -> &'static [usize] {
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

/// Squares seen narrower than this are not used, pixels.
const SMALLEST_SQUARE_PX: f64 = 5.0;
/// A board is there when it agrees this well with a checkerboard (noise reaches 0.2, a sharp board 0.8 and more).
const AGREEMENT: f64 = 0.4;
/// A part of the pixels around the board that may be clipped.
const CLIPPED: f64 = 0.01;
/// Values from this fraction of the white level on are not used.
const USABLE: f64 = 0.95;
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

/// Going from pose to pose.
struct Tour<'a> {
    reader: &'a Reader<'a>,
    options: &'a GeometryOptions,
    stated: Camera,
    /// As the poses seen so far say.
    camera: Camera,
    hot: Vec<[usize; 2]>,
    sign: Option<f64>,
    poses: Vec<Pose>,
    views: Vec<View>,
    left_out: Vec<PoseReport>,
}

impl<'a> Tour<'a> {
    fn new(
        reader: &'a Reader<'a>,
        options: &'a GeometryOptions,
        facts: &CameraFacts,
        hot: Vec<[usize; 2]>,
    ) -> Self {
        let stated = Camera::new(facts, options.square_mm);
        Self {
            reader,
            options,
            camera: stated.clone(),
            stated,
            hot,
            sign: None,
            poses: Vec::new(),
            views: Vec::new(),
            left_out: Vec::new(),
        }
    }

    /// Finds the board in a pose, and learns from it.
    fn visit(&mut self, pose: &Configuration, frames: &[Taken]) -> Result<()> {
        let to_pixel = self.camera.view(pose);
        let expected = self.expected(&to_pixel);
        let square_px = expected.smallest_square();
        if square_px.is_nan() || square_px < SMALLEST_SQUARE_PX {
            self.leave_out(pose, square_px, format!("its squares are {square_px:.1} pixels wide, expected {SMALLEST_SQUARE_PX} or more"));
            return Ok(());
        }
        let Some(bounds) = bounds(&expected, self.reader.size) else {
            self.leave_out(
                pose,
                square_px,
                "the board lies outside the image".to_owned(),
            );
            return Ok(());
        };
        let Some(view) = read_view(self.reader, frames, bounds, &self.hot)? else {
            let reason = "every exposure is clipped".to_owned();
            self.leave_out(pose, square_px, reason);
            return Ok(());
        };
        let sighting = corners::search(&view, &expected, self.sign);
        if sighting.agreement < AGREEMENT {
            self.leave_out(pose, square_px, format!(
                "no board is seen: the image agrees with a checkerboard to {:.2}, expected {AGREEMENT} or more",
                sighting.agreement
            ));
            return Ok(());
        }
        let found = find_shifted(&view, &expected, sighting);
        let wanted = self.options.corners[0] * self.options.corners[1];
        if 2 * found.len() < wanted || found.len() < 4 {
            self.leave_out(
                pose,
                square_px,
                format!("only {} of {wanted} corners are clear", found.len()),
            );
            return Ok(());
        }
        self.sign = Some(sighting.sign);
        self.poses.push(Pose {
            configuration: *pose,
            corners: found,
        });
        self.views.push(view);
        board::follow(&mut self.camera, &self.stated, &self.poses);
        Ok(())
    }

    fn expected<'b>(&self, to_pixel: &'b dyn Fn([f64; 2]) -> [f64; 2]) -> Expected<'b> {
        Expected {
            corners: self.options.corners,
            to_pixel,
        }
    }

    fn leave_out(&mut self, pose: &Configuration, square_px: f64, reason: String) {
        self.left_out.push(PoseReport {
            left_out: Some(reason),
            ..pose_report(pose, square_px)
        });
    }

    /// The camera that all poses agree on; corners are found once more where it puts them.
    fn fit(&mut self) -> Result<Fitted> {
        let hold: Vec<usize> = self
            .options
            .hold
            .iter()
            .flat_map(|p| p.parameters())
            .copied()
            .collect();
        let sign = self.sign.unwrap_or(1.0);
        for (pose, view) in self.poses.iter_mut().zip(&self.views) {
            let to_pixel = self.camera.view(&pose.configuration);
            let expected = Expected {
                corners: self.options.corners,
                to_pixel: &to_pixel,
            };
            let again = corners::find(view, &expected, sign);
            if again.len() >= pose.corners.len() {
                pose.corners = again;
            }
        }
        let fitted = match self.poses.is_empty() {
            true => None,
            false => board::fit(&self.camera, &self.poses, &hold),
        };
        fitted.ok_or_else(|| self.not_found())
    }

    fn not_found(&self) -> Error {
        let reasons: Vec<String> = self
            .left_out
            .iter()
            .filter_map(|p| {
                Some(format!(
                    "configuration {}: {}",
                    p.config,
                    p.left_out.as_ref()?
                ))
            })
            .collect();
        Error::new(format!(
            "the board's corners were not found in enough poses: {}",
            reasons.join("; ")
        ))
        .with_hint("check the inner corners and the square's side, camera.pixel_mm (to 5 %) and camera.center_px (to a square) of the session, and that the board's edges lie along the sample's axes")
    }

    fn result(&self, fitted: &Fitted) -> (Geometry, GeometryReport) {
        let (facts, se) = (fitted.camera.facts(), &fitted.standard_error);
        let poses = self.poses.iter().zip(&fitted.offsets).zip(&fitted.counted);
        let mut reports: Vec<PoseReport> = poses
            .map(|((pose, offset), &corners)| {
                let to_pixel = fitted.camera.view(&pose.configuration);
                PoseReport {
                    corners,
                    offset_px: *offset,
                    ..pose_report(
                        &pose.configuration,
                        self.expected(&to_pixel).smallest_square(),
                    )
                }
            })
            .collect();
        reports.extend(self.left_out.iter().cloned());
        reports.sort_by_key(|p| p.config);
        let values = &fitted.camera.values;
        let freedom = (self.poses.len() as f64 - 3.0).max(1.0);
        let held = (0..PARAMETERS).filter(|&k| fitted.held[k]);
        let geometry = Geometry {
            pixel_mm: facts.pixel_mm,
            pixel_mm_se: se[0],
            center_px: facts.center_px,
            center_px_se: [se[1], se[2]],
            lens: facts.lens,
            pointing_sd_px: fitted.pointing_sd,
            pose: self.options.pose,
            residual_px: fitted.residual,
            corners: fitted.counted.iter().sum(),
        };
        let report = GeometryReport {
            poses: reports,
            lens_se: Lens {
                roll: se[3],
                perspective: se[10],
                distortion: se[11],
                sag_px: [[se[6], se[7]], [se[8], se[9]]],
            },
            pointing_sd_se_px: fitted.pointing_sd.map(|s| s / (2.0 * freedom).sqrt()),
            board_mm: [values[4], values[5]],
            board_angle: values[12],
            held: held.map(|k| NAMES[k]).collect(),
        };
        (geometry, report)
    }
}

fn pose_report(pose: &Configuration, square_px: f64) -> PoseReport {
    PoseReport {
        config: pose.id,
        camera_theta_deg: pose.camera.theta.to_degrees(),
        rotation_deg: pose.rotation.to_degrees(),
        square_px,
        corners: 0,
        offset_px: [0.0; 2],
        left_out: None,
    }
}

/// The corners of a board that was seen away from where it was expected.
fn find_shifted(view: &View, expected: &Expected<'_>, sighting: Sighting) -> Vec<corners::Corner> {
    let [a, b] = sighting.shift;
    let shifted = |[x, y]: [f64; 2]| (expected.to_pixel)([x + a, y + b]);
    let moved = Expected {
        corners: expected.corners,
        to_pixel: &shifted,
    };
    corners::find(view, &moved, sighting.sign)
}

/// The box around the board, its outer squares and what the search needs around it; none when little of it is inside.
fn bounds(expected: &Expected<'_>, [width, height]: [usize; 2]) -> Option<[usize; 4]> {
    let [a, b] = expected.corners.map(|n| 0.5 * n as f64 + 1.8);
    let corners = [[-a, -b], [a, -b], [a, b], [-a, b]].map(expected.to_pixel);
    let low = |k: usize| {
        corners
            .iter()
            .map(|c| c[k])
            .fold(f64::MAX, f64::min)
            .max(0.0)
    };
    let high = |k: usize| {
        corners
            .iter()
            .map(|c| c[k])
            .fold(f64::MIN, f64::max)
            .max(0.0)
    };
    let (left, top) = (low(0) as usize, low(1) as usize);
    let right = (high(0).ceil() as usize).min(width);
    let bottom = (high(1).ceil() as usize).min(height);
    (right > left + 8 && bottom > top + 8).then_some([left, top, right, bottom])
}

/// The frames of the longest exposure that is not clipped around the board (green, behind filters), averaged.
fn read_view(
    reader: &Reader<'_>,
    frames: &[Taken],
    bounds: [usize; 4],
    hot: &[[usize; 2]],
) -> Result<Option<View>> {
    let limit = USABLE * reader.white;
    let filter = frames
        .iter()
        .filter_map(|f| f.record.filter)
        .find(|f| f.channel() == 1);
    let filter = filter.or_else(|| frames.first().and_then(|f| f.record.filter));
    let frames: Vec<&Taken> = frames
        .iter()
        .filter(|f| f.record.filter == filter)
        .collect();
    let same = |a: &&Taken, b: &&Taken| same_exposure(a.record.exposure_ms, b.record.exposure_ms);
    let groups: Vec<&[&Taken]> = frames.chunk_by(same).collect();
    for group in groups.into_iter().rev() {
        let mut view = View::new(&reader.load(group[0])?, bounds, limit, hot);
        if view.clipped() > CLIPPED {
            continue;
        }
        for repeat in &group[1..] {
            view.add(&reader.load(repeat)?, limit);
        }
        return Ok(Some(view));
    }
    Ok(None)
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
