//! Going through the poses of a board session: the board is found in one after another, each helping to expect the next.

use super::board::{self, Camera, Fitted, NAMES, PARAMETERS, Pose};
use super::corners::{self, Expected, Sighting};
use super::geometry::{GeometryOptions, GeometryReport, PoseReport};
use super::recording::Reader;
use super::view::View;
use crate::base::{Error, Result};
use crate::measure::calibration::Geometry;
use crate::measure::frames::{Taken, same_exposure};
use crate::session::{CameraFacts, Configuration, Lens};

/// Squares seen narrower than this are not used, pixels.
const SMALLEST_SQUARE_PX: f64 = 5.0;
/// A board is there when it agrees this well with a checkerboard (noise reaches 0.2, a sharp board 0.8 and more).
const AGREEMENT: f64 = 0.4;
/// A part of the pixels around the board that may be clipped.
const CLIPPED: f64 = 0.01;
/// Values from this fraction of the white level on are not used.
const USABLE: f64 = 0.95;
/// Going from pose to pose.
pub(super) struct Tour<'a> {
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
    pub(super) fn new(
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
    pub(super) fn visit(&mut self, pose: &Configuration, frames: &[Taken]) -> Result<()> {
        let to_pixel = self.camera.view(pose, [0.0; 2]);
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
    pub(super) fn fit(&mut self) -> Result<Fitted> {
        let hold: Vec<usize> = self
            .options
            .hold
            .iter()
            .flat_map(|p| p.parameters())
            .copied()
            .collect();
        let sign = self.sign.unwrap_or(1.0);
        for (pose, view) in self.poses.iter_mut().zip(&self.views) {
            let to_pixel = self.camera.view(&pose.configuration, [0.0; 2]);
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

    pub(super) fn result(&self, fitted: &Fitted) -> (Geometry, GeometryReport) {
        let (facts, se) = (fitted.camera.facts(), &fitted.standard_error);
        let poses = self.poses.iter().zip(&fitted.offsets).zip(&fitted.counted);
        let mut reports: Vec<PoseReport> = poses
            .map(|((pose, offset), &corners)| {
                let to_pixel = fitted.camera.view(&pose.configuration, [0.0; 2]);
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
