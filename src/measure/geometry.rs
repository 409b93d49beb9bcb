//! What errors of pointing, scale, pose and height do to a configuration's mean.
//!
//! The crop is moved as each error would move it, on the configuration's own picture, so texture and foreshortening are
//! what they are. Errors of the polar angles also change the radiance itself. How fast cannot be seen in one picture: it
//! is taken from the law of Lommel and Seeliger, `M = albedo cos(theta_l) / (cos(theta_l) + cos(theta_c))`, the limit of
//! single scattering in a thick layer, which is steep at grazing angles as cloth is:
//!
//! ```text
//! d ln M / d theta_l = -tan(theta_l) + sin(theta_l) / (cos(theta_l) + cos(theta_c))
//! d ln M / d theta_c =                 sin(theta_c) / (cos(theta_l) + cos(theta_c))
//! ```
//!
//! It does not know how steep a highlight is, nor how radiance changes with azimuth or with the turntable's angle.

use super::CropRule;
use super::calibration::{Geometry, PoseErrors};
use super::field::{Around, Weights, Window};
use super::radiance::Radiance;
use crate::base::{Context, Result};
use crate::session::{CameraFacts, Configuration, Coverage, Perturbation, Projection};

/// Standard uncertainties of pose and pointing.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct GeometryErrors {
    /// Of the image's place, pixels.
    shift_px: [f64; 2],
    /// Of the scale, relative.
    scale: f64,
    pose: PoseErrors,
}

impl GeometryErrors {
    /// From a calibration and what the operator states of the pose, which goes before the calibration's.
    pub(super) fn new(known: Option<&Geometry>, stated: Option<PoseErrors>) -> Self {
        let mut errors = Self::default();
        if let Some(g) = known {
            errors.shift_px = [0, 1].map(|axis| g.center_px_se[axis].hypot(g.pointing_sd_px[axis]));
            errors.scale = g.pixel_mm_se / g.pixel_mm;
            errors.pose = g.pose;
        }
        if let Some(pose) = stated {
            errors.pose = pose;
        }
        errors
    }

    /// How far the crop may move, pixels: that much margin is needed around it.
    pub(super) fn margin(&self, camera: &CameraFacts, side_mm: f64) -> usize {
        let size = side_mm / camera.pixel_mm;
        let pose = &self.pose;
        let angles = pose.camera_theta_deg.to_radians() + pose.rotation_deg.to_radians();
        let moved = 1.5 * self.shift_px[0].max(self.shift_px[1])
            + size * (self.scale + angles)
            + pose.height_mm / camera.pixel_mm;
        // More than an image is refused when the crop is moved.
        moved.ceil().clamp(0.0, 1e4) as usize
    }

    /// Relative standard uncertainty of the white standard's radiance from the light's polar angle there.
    pub(super) fn of_white(&self, reference: &Configuration) -> f64 {
        self.pose.light_theta_deg.to_radians() * reference.light.theta.tan()
    }
}

/// One configuration's crop, to be moved.
pub(super) struct Movable<'a> {
    pub(super) camera: &'a CameraFacts,
    pub(super) configuration: &'a Configuration,
    pub(super) rule: CropRule,
    pub(super) side_mm: f64,
    pub(super) coverage: &'a Coverage,
    pub(super) window: &'a Window,
    pub(super) weights: &'a Weights,
    pub(super) hot: &'a [bool],
    pub(super) radiance: &'a Radiance,
}

impl Movable<'_> {
    /// The variance of each channel's mean from all errors, white standard aside.
    ///
    /// # Errors
    /// The moved crop leaves the image.
    pub(super) fn variance(&self, errors: &GeometryErrors) -> Result<[f64; 3]> {
        let mean = [0, 1, 2].map(|c| self.radiance.mean(self.weights, c));
        let mut variance = [0.0; 3];
        let mut add = |changes: &[[f64; 3]]| {
            for change in changes {
                for c in 0..3 {
                    variance[c] += change[c] * change[c] / changes.len() as f64;
                }
            }
        };
        let (light, camera) = slopes(self.configuration);
        let [x, y] = errors.shift_px;
        if x > 0.0 || y > 0.0 {
            // Eight places around: their mean square is that of a normal law with these standard deviations.
            let around = (0..8).map(|i| {
                let angle = f64::from(i) * std::f64::consts::FRAC_PI_4;
                let (sin, cos) = angle.sin_cos();
                let root2 = std::f64::consts::SQRT_2;
                self.change(
                    mean,
                    &Perturbation {
                        shift_px: [root2 * x * cos, root2 * y * sin],
                        ..Perturbation::default()
                    },
                )
            });
            add(&around.collect::<Result<Vec<_>>>()?);
        }
        let none = Perturbation::default;
        if errors.scale > 0.0 {
            let scaled = |scale| Perturbation { scale, ..none() };
            add(&self.both_ways(mean, errors.scale, scaled)?);
        }
        let pose = &errors.pose;
        if pose.rotation_deg > 0.0 {
            let turned = |rotation| Perturbation { rotation, ..none() };
            add(&self.both_ways(mean, pose.rotation_deg.to_radians(), turned)?);
        }
        if pose.height_mm > 0.0 {
            let raised = |height_mm| Perturbation {
                height_mm,
                ..none()
            };
            add(&self.both_ways(mean, pose.height_mm, raised)?);
        }
        if pose.camera_theta_deg > 0.0 {
            let by = pose.camera_theta_deg.to_radians();
            let theta = self.configuration.camera.theta;
            // Toward the horizon there may be no room.
            let by = by.min(0.5 * (std::f64::consts::FRAC_PI_2 - theta));
            let tilted = |camera_theta| Perturbation {
                camera_theta,
                ..none()
            };
            let moved = self.both_ways(mean, by, tilted)?;
            let [up, down] = moved;
            let slope = mean.map(|m| m * camera * by);
            // The crop is laid for the stated angle; at the true one it shows the brighter (or fainter) cloth.
            let with = |moved: [f64; 3], sign: f64| [0, 1, 2].map(|c| sign * slope[c] - moved[c]);
            add(&[with(up, 1.0), with(down, -1.0)]);
        }
        let by = pose.light_theta_deg.to_radians() * light;
        add(&[mean.map(|m| m * by)]);
        Ok(variance)
    }

    fn both_ways(
        &self,
        mean: [f64; 3],
        by: f64,
        errors: impl Fn(f64) -> Perturbation,
    ) -> Result<[[f64; 3]; 2]> {
        Ok([
            self.change(mean, &errors(by))?,
            self.change(mean, &errors(-by))?,
        ])
    }

    /// How much the mean over the moved crop differs from the mean over the crop.
    fn change(&self, mean: [f64; 3], errors: &Perturbation) -> Result<[f64; 3]> {
        if self.rule != CropRule::Square {
            // A box of the image stays where it is.
            return Ok([0.0; 3]);
        }
        let moved = Projection::perturbed(self.camera, self.configuration, errors)
            .coverage(self.side_mm)
            .context(|| "when moved by the uncertainty of pose and pointing")?;
        let (mut change, mut gained) = ([0.0; 3], 0.0);
        for (x, y, weight) in differences(self.coverage, &moved) {
            gained += weight;
            for c in 0..3 {
                change[c] += weight * (self.interpolated(x, y, c, mean[c]) - mean[c]);
            }
        }
        let area = self.coverage.area() + gained;
        Ok(change.map(|sum| sum / area))
    }

    /// A channel at a pixel, interpolated from its values around it.
    fn interpolated(&self, x: usize, y: usize, channel: usize, mean: f64) -> f64 {
        let around = Around::of(self.window, self.hot, channel, x, y);
        let values = &self.radiance.plane(channel).value;
        let found = around.values();
        if found.is_empty() {
            return mean;
        }
        let sum: f64 = found.iter().map(|&i| f64::from(values[i])).sum();
        sum / found.len() as f64
    }
}

/// The pixels in which two coverages differ: column, row, second less first.
fn differences<'a>(
    first: &'a Coverage,
    second: &'a Coverage,
) -> impl Iterator<Item = (usize, usize, f64)> + 'a {
    let (a, b) = (first.bounds(), second.bounds());
    (a[1].min(b[1])..a[3].max(b[3])).flat_map(move |y| {
        let row = |coverage: &'a Coverage| {
            let top = coverage.rows.first().map_or(0, |r| r.y);
            let at = y.checked_sub(top)?;
            coverage.rows.get(at).filter(|r| r.y == y)
        };
        let (one, two) = (row(first), row(second));
        let ends = [one, two].into_iter().flatten();
        let start = ends.clone().map(|r| r.x).min().unwrap_or(0);
        let end = ends.map(|r| r.x + r.weights.len()).max().unwrap_or(0);
        let weight = |row: Option<&'a crate::session::RowSpan>, x: usize| {
            row.and_then(|r| r.weights.get(x.checked_sub(r.x)?).copied())
                .unwrap_or(0.0)
        };
        (start..end).filter_map(move |x| {
            let change = weight(two, x) - weight(one, x);
            (change.abs() > 1e-12).then_some((x, y, change))
        })
    })
}

/// Relative change of the radiance with the polar angle of the light and of the camera, per radian (Lommel and Seeliger).
fn slopes(configuration: &Configuration) -> (f64, f64) {
    let (sin_l, cos_l) = configuration.light.theta.sin_cos();
    let (sin_c, cos_c) = configuration.camera.theta.sin_cos();
    let sum = cos_l + cos_c;
    (-sin_l / cos_l + sin_l / sum, sin_c / sum)
}
