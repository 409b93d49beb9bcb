//! Between the sample plane and the image.
//!
//! A camera at polar angle `theta`, azimuth `phi` (laboratory frame, z the sample normal) sees a point `p` of the
//! laboratory frame at
//!
//! ```text
//! image x (right) = e_phi   = (-sin phi, cos phi, 0)
//! image y (down)  = e_theta = (cos theta cos phi, cos theta sin phi, -sin theta)      (+z of the sample points up)
//! n               = (sin theta cos phi, sin theta sin phi, cos theta)                 (toward the camera)
//! q    = (p . e_phi, p . e_theta) / (1 - perspective p . n) / pixel_mm
//! seen = distort(c + turn(roll) q),  c such that the sample center is seen at center_px + sag(theta)
//! ```
//!
//! with the [`Lens`](super::Lens) of the camera ([`CameraFacts`]). With an ideal lens, `seen = center_px + q`: a plane
//! perpendicular to the view through the sample center maps to the image at `pixel_mm` per pixel. The perspective is that
//! of a pinhole (the entrance pupil) at distance `1 / perspective` from the sample center, the image scaled so that the
//! same plane keeps `pixel_mm` per pixel. Distortion acts last, about the middle of the image, where it changes no scale.
//!
//! A point of the sample plane is given in the sample frame, which is turned by `rotation` about +z. It does not model
//! tangential distortion, a tilted sensor, or relief of the sample; a sample that is too high as a whole is a
//! [`Perturbation`].

mod coverage;
mod lens;
#[cfg(test)]
mod tests;

pub use coverage::{Coverage, RowSpan};

use super::{CameraFacts, Configuration};
use crate::base::{Error, Result};
use lens::Distortion;

/// The map between the sample plane (millimeters, sample frame) and the image (pixels; integer = pixel corner) in one
/// configuration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projection {
    configuration: u32,
    width: usize,
    height: usize,
    /// Image point of the sample center before distortion.
    center: [f64; 2],
    /// Sample frame to pixels before perspective: rows x, y of the 2x2 matrix, and what the sample's height adds.
    forward: [[f64; 2]; 2],
    raised: [f64; 2],
    /// `perspective p . n` by the point's coordinates, and what the sample's height adds.
    nearer: [f64; 2],
    raised_nearer: f64,
    distortion: Distortion,
}

/// How a camera and its pose differ from what is stated: for the propagation of their uncertainties.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Perturbation {
    /// The image as a whole lies this much further right and down, pixels.
    pub shift_px: [f64; 2],
    /// A pixel is larger on the sample by this fraction: `pixel_mm (1 + scale)`.
    pub scale: f64,
    /// The camera stands at a polar angle larger by this, radians.
    pub camera_theta: f64,
    /// The turntable stands at an angle larger by this, radians.
    pub rotation: f64,
    /// The sample plane lies this much above the center of rotation (which the camera looks at), millimeters.
    pub height_mm: f64,
}

/// How far an outline's straight pieces may lie off the bent edge, pixels.
const CHORD_PX: f64 = 1e-4;

impl Projection {
    /// The projection of the sample plane into this camera in this configuration.
    pub fn new(camera: &CameraFacts, configuration: &Configuration) -> Self {
        Self::perturbed(camera, configuration, &Perturbation::default())
    }

    /// The projection when camera and pose differ from what is stated.
    pub fn perturbed(
        camera: &CameraFacts,
        configuration: &Configuration,
        errors: &Perturbation,
    ) -> Self {
        let lens = &camera.lens;
        let (sin_phi, cos_phi) = configuration.camera.phi.sin_cos();
        let theta = configuration.camera.theta + errors.camera_theta;
        let (sin_theta, cos_theta) = theta.sin_cos();
        let (s, c) = (configuration.rotation + errors.rotation).sin_cos();
        // Sample frame to laboratory: (x, y) -> (c x - s y, s x + c y).
        let right = [-sin_phi * c + cos_phi * s, sin_phi * s + cos_phi * c];
        let away = [cos_phi * c + sin_phi * s, -cos_phi * s + sin_phi * c];
        let scale = 1.0 / (camera.pixel_mm * (1.0 + errors.scale));
        let (sin_roll, cos_roll) = lens.roll.sin_cos();
        let rolled = |[x, y]: [f64; 2]| [cos_roll * x - sin_roll * y, sin_roll * x + cos_roll * y];
        let columns = [0, 1].map(|i| rolled([right[i] * scale, away[i] * scale * cos_theta]));
        let sag =
            [0, 1].map(|i| lens.sag_px[0][i] * sin_theta + lens.sag_px[1][i] * (1.0 - cos_theta));
        let seen = [0, 1].map(|i| camera.center_px[i] + sag[i] + errors.shift_px[i]);
        let distortion = Distortion::new(lens.distortion, camera.width, camera.height);
        Self {
            configuration: configuration.id,
            width: camera.width,
            height: camera.height,
            center: distortion.undistort(seen),
            forward: [0, 1].map(|row| [columns[0][row], columns[1][row]]),
            raised: rolled([0.0, -errors.height_mm * sin_theta * scale]),
            nearer: away.map(|a| lens.perspective * sin_theta * a),
            raised_nearer: lens.perspective * errors.height_mm * cos_theta,
            distortion,
        }
    }

    /// The image point of a point of the sample plane (millimeters, sample frame).
    pub fn to_pixel(&self, point_mm: [f64; 2]) -> [f64; 2] {
        let nearness = dot(self.nearer, point_mm) + self.raised_nearer;
        let ideal = [0, 1].map(|i| {
            let offset = dot(self.forward[i], point_mm) + self.raised[i];
            self.center[i] + offset / (1.0 - nearness)
        });
        self.distortion.distort(ideal)
    }

    /// The point of the sample plane (millimeters, sample frame) seen at an image point; the inverse of
    /// [`Self::to_pixel`] to rounding. NaN at points the lens puts nothing (see [`Lens`](super::Lens)).
    pub fn to_sample(&self, pixel: [f64; 2]) -> [f64; 2] {
        let ideal = self.distortion.undistort(pixel);
        // q (1 - nearness(p)) = forward p + raised is linear in p.
        let q = [0, 1].map(|i| ideal[i] - self.center[i]);
        let m = [0, 1].map(|i| [0, 1].map(|j| self.forward[i][j] + q[i] * self.nearer[j]));
        let b = [0, 1].map(|i| q[i] * (1.0 - self.raised_nearer) - self.raised[i]);
        let determinant = m[0][0] * m[1][1] - m[0][1] * m[1][0];
        [
            (m[1][1] * b[0] - m[0][1] * b[1]) / determinant,
            (m[0][0] * b[1] - m[1][0] * b[0]) / determinant,
        ]
    }

    /// The image of the corners (-,-), (+,-), (+,+), (-,+) of a centered square of this side, turned with the sample.
    pub fn quadrilateral(&self, side_mm: f64) -> [[f64; 2]; 4] {
        square(side_mm).map(|p| self.to_pixel(p))
    }

    /// The image of that square's edge: its corners, and points between them where distortion bends the edges.
    pub fn outline(&self, side_mm: f64) -> Vec<[f64; 2]> {
        self.outline_of(&square(side_mm))
    }

    /// The image of a polygon of the sample plane (millimeters, sample frame): its corners in order, and points between
    /// them where distortion bends the edges, so that straight pieces are right to 1e-4 pixels.
    pub fn outline_of(&self, corners_mm: &[[f64; 2]]) -> Vec<[f64; 2]> {
        let mut outline = Vec::with_capacity(corners_mm.len());
        for (i, &p) in corners_mm.iter().enumerate() {
            let q = corners_mm[(i + 1) % corners_mm.len()];
            let at = |t: f64| [0, 1].map(|a| p[a] + t * (q[a] - p[a]));
            let pieces = self.pieces(p, q);
            outline.extend((0..pieces).map(|k| self.to_pixel(at(k as f64 / pieces as f64))));
        }
        outline
    }

    /// How many straight pieces an edge needs: the deviation from a chord falls with their square.
    fn pieces(&self, p: [f64; 2], q: [f64; 2]) -> usize {
        if self.distortion.is_none() {
            return 1;
        }
        let (start, end) = (self.to_pixel(p), self.to_pixel(q));
        let chord = [end[0] - start[0], end[1] - start[1]];
        let length = chord[0].hypot(chord[1]);
        let bend = [0.25, 0.5, 0.75].map(|t| {
            let [x, y] = self.to_pixel([0, 1].map(|a| p[a] + t * (q[a] - p[a])));
            ((x - start[0]) * chord[1] - (y - start[1]) * chord[0]).abs() / length
        });
        // The quarters see an edge that is bent like an S, at 3/4 of its largest deviation at least.
        let bend = bend.into_iter().fold(0.0, f64::max) / 0.75;
        (bend / CHORD_PX).sqrt().ceil().clamp(1.0, 1000.0) as usize
    }

    /// The exact fraction of each pixel the image of the sample square covers.
    ///
    /// # Errors
    /// When its outline leaves the image or covers less than one pixel.
    pub fn coverage(&self, side_mm: f64) -> Result<Coverage> {
        let coverage = self.coverage_of(&square(side_mm))?;
        let covered = coverage.area();
        if covered.is_nan() || covered < 1.0 {
            return Err(Error::new(format!(
                "configuration {}: the sample square covers {covered:.3} pixels of the image",
                self.configuration
            ))
            .with_hint("check camera.pixel_mm and sample_square_mm"));
        }
        Ok(coverage)
    }

    /// The exact fraction of each pixel the image of a simple polygon of the sample plane (millimeters, sample frame)
    /// covers.
    ///
    /// # Errors
    /// When its outline leaves the image.
    pub fn coverage_of(&self, corners_mm: &[[f64; 2]]) -> Result<Coverage> {
        let mut outline = self.outline_of(corners_mm);
        self.check_inside(&outline)?;
        for [x, y] in &mut outline {
            // The check leaves room for rounding.
            (*x, *y) = (
                x.clamp(0.0, self.width as f64),
                y.clamp(0.0, self.height as f64),
            );
        }
        Ok(Coverage::of_polygon(&outline, [self.width, self.height]))
    }

    fn check_inside(&self, corners: &[[f64; 2]]) -> Result<()> {
        let (width, height) = (self.width as f64, self.height as f64);
        let excess = |[x, y]: [f64; 2]| (-x).max(x - width).max(-y).max(y - height);
        // A NaN is not inside; `max` alone would not see one of two.
        let inside = |c: [f64; 2]| !c[0].is_nan() && !c[1].is_nan() && excess(c) <= 1e-9;
        if corners.iter().all(|&c| inside(c)) {
            return Ok(());
        }
        let worst = corners.iter().map(|&c| excess(c)).fold(0.0, f64::max);
        Err(Error::new(format!(
            "configuration {}: the crop leaves the image by {:.1} pixels ({} x {} pixels)",
            self.configuration, worst, self.width, self.height
        ))
        .with_hint("check camera.center_px and camera.pixel_mm, or make sample_square_mm smaller"))
    }
}

/// The corners of a centered square.
fn square(side_mm: f64) -> [[f64; 2]; 4] {
    let h = 0.5 * side_mm;
    [[-h, -h], [h, -h], [h, h], [-h, h]]
}

fn dot(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[0] + a[1] * b[1]
}
