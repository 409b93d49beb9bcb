//! Between the sample plane and the image.
//!
//! The camera is orthographic ([`CameraFacts`]): a plane perpendicular to the view through the sample center maps to the
//! image at `pixel_mm` per pixel. With the camera at polar angle `theta`, azimuth `phi` (laboratory frame, z the sample
//! normal),
//!
//! ```text
//! image x (right) = e_phi   = (-sin phi, cos phi, 0)
//! image y (down)  = e_theta = (cos theta cos phi, cos theta sin phi, -sin theta)      (+z of the sample points up)
//! pixel = center_px + (p . e_phi, p . e_theta) / pixel_mm
//! ```
//!
//! A point of the sample plane is given in the sample frame, which is turned by `rotation` about +z. It does not model
//! perspective, lens distortion, or heights above the plane.

use super::{CameraFacts, Configuration};
use crate::base::{Error, Result};

/// The map between the sample plane (millimeters, sample frame) and the image (pixels; integer = pixel corner) in one
/// configuration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projection {
    configuration: u32,
    width: usize,
    height: usize,
    center_px: [f64; 2],
    /// Sample frame to pixels: rows x, y of the 2x2 matrix.
    forward: [[f64; 2]; 2],
    /// Its inverse.
    backward: [[f64; 2]; 2],
}

/// The pixels of one image row that a quadrilateral covers.
#[derive(Debug, Clone, PartialEq)]
pub struct RowSpan {
    /// Row.
    pub y: usize,
    /// First column.
    pub x: usize,
    /// Covered fraction of the pixels `x, x + 1, ...`, each in 0..=1.
    pub weights: Vec<f64>,
}

/// Which fraction of each pixel a quadrilateral covers, exactly.
#[derive(Debug, Clone, PartialEq)]
pub struct Coverage {
    /// The rows it touches, from top to bottom.
    pub rows: Vec<RowSpan>,
}

impl Coverage {
    /// Column, row and weight of every covered pixel, row by row.
    pub fn pixels(&self) -> impl Iterator<Item = (usize, usize, f64)> + '_ {
        self.rows.iter().flat_map(|row| {
            let weighted = row.weights.iter().enumerate();
            weighted.map(move |(i, &w)| (row.x + i, row.y, w))
        })
    }

    /// The covered area in pixels.
    pub fn area(&self) -> f64 {
        self.pixels().map(|(_, _, w)| w).sum()
    }

    /// The smallest box of whole pixels around it: left, top, right, bottom (right and bottom are one past the end).
    pub fn bounds(&self) -> [usize; 4] {
        let left = self.rows.iter().map(|r| r.x).min().unwrap_or(0);
        let right = self.rows.iter().map(|r| r.x + r.weights.len()).max();
        let top = self.rows.first().map_or(0, |r| r.y);
        let bottom = self.rows.last().map_or(0, |r| r.y + 1);
        [left, top, right.unwrap_or(0), bottom]
    }
}

impl Projection {
    /// The projection of the sample plane into this camera in this configuration.
    pub fn new(camera: &CameraFacts, configuration: &Configuration) -> Self {
        let (sin_phi, cos_phi) = configuration.camera.phi.sin_cos();
        let cos_theta = configuration.camera.theta.cos();
        let (s, c) = configuration.rotation.sin_cos();
        // Sample frame to laboratory: (x, y) -> (c x - s y, s x + c y).
        let right = [-sin_phi * c + cos_phi * s, sin_phi * s + cos_phi * c];
        let away = [cos_phi * c + sin_phi * s, -cos_phi * s + sin_phi * c];
        let scale = 1.0 / camera.pixel_mm;
        Self {
            configuration: configuration.id,
            width: camera.width,
            height: camera.height,
            center_px: camera.center_px,
            forward: [
                right.map(|r| r * scale),
                away.map(|a| a * scale * cos_theta),
            ],
            // `right` and `away` are orthonormal, so the inverse is the transpose over the scales.
            backward: [
                [right[0] / scale, away[0] / (scale * cos_theta)],
                [right[1] / scale, away[1] / (scale * cos_theta)],
            ],
        }
    }

    /// The image point of a point of the sample plane (millimeters, sample frame).
    pub fn to_pixel(&self, point_mm: [f64; 2]) -> [f64; 2] {
        let offset = apply(&self.forward, point_mm);
        [self.center_px[0] + offset[0], self.center_px[1] + offset[1]]
    }

    /// The point of the sample plane (millimeters, sample frame) seen at an image point.
    pub fn to_sample(&self, pixel: [f64; 2]) -> [f64; 2] {
        let offset = [pixel[0] - self.center_px[0], pixel[1] - self.center_px[1]];
        apply(&self.backward, offset)
    }

    /// The image of the sample square: the corners (-,-), (+,-), (+,+), (-,+) of a centered square of this side, turned
    /// with the sample.
    pub fn quadrilateral(&self, side_mm: f64) -> [[f64; 2]; 4] {
        let h = 0.5 * side_mm;
        [[-h, -h], [h, -h], [h, h], [-h, h]].map(|p| self.to_pixel(p))
    }

    /// The exact fraction of each pixel the image of the sample square covers (polygon clipping).
    ///
    /// # Errors
    /// When the quadrilateral leaves the image or covers less than one pixel.
    pub fn coverage(&self, side_mm: f64) -> Result<Coverage> {
        let corners = self.quadrilateral(side_mm);
        self.check_inside(&corners)?;
        let polygon = corners.to_vec();
        let top = smallest(&polygon, 1).floor() as usize;
        let bottom = (largest(&polygon, 1).ceil() as usize).min(self.height);
        let mut rows = Vec::with_capacity(bottom - top);
        for y in top..bottom {
            let strip = clip(&polygon, 1, y as f64);
            if strip.len() < 3 {
                continue;
            }
            let first = smallest(&strip, 0).floor() as usize;
            let last = (largest(&strip, 0).ceil() as usize).min(self.width);
            let weights: Vec<f64> = (first..last)
                .map(|x| area(&clip(&strip, 0, x as f64)).clamp(0.0, 1.0))
                .collect();
            rows.push(RowSpan {
                y,
                x: first,
                weights,
            });
        }
        let coverage = Coverage { rows };
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

    fn check_inside(&self, corners: &[[f64; 2]; 4]) -> Result<()> {
        let (width, height) = (self.width as f64, self.height as f64);
        let excess = |[x, y]: [f64; 2]| (-x).max(x - width).max(-y).max(y - height);
        let all_inside = corners.iter().all(|&c| excess(c) <= 1e-9);
        if all_inside {
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

fn apply(matrix: &[[f64; 2]; 2], [x, y]: [f64; 2]) -> [f64; 2] {
    matrix.map(|row| row[0] * x + row[1] * y)
}

fn smallest(polygon: &[[f64; 2]], axis: usize) -> f64 {
    let lowest = polygon.iter().map(|p| p[axis]).fold(f64::MAX, f64::min);
    lowest.max(0.0)
}

fn largest(polygon: &[[f64; 2]], axis: usize) -> f64 {
    polygon.iter().map(|p| p[axis]).fold(f64::MIN, f64::max)
}

/// The part of a convex polygon with `low <= p[axis] <= low + 1` (Sutherland and Hodgman 1974).
fn clip(polygon: &[[f64; 2]], axis: usize, low: f64) -> Vec<[f64; 2]> {
    let above = half_plane(polygon, |p| p[axis] - low);
    half_plane(&above, |p| low + 1.0 - p[axis])
}

/// The part of a convex polygon where `distance >= 0`.
fn half_plane(polygon: &[[f64; 2]], distance: impl Fn([f64; 2]) -> f64) -> Vec<[f64; 2]> {
    let mut kept = Vec::with_capacity(polygon.len() + 2);
    for (i, &p) in polygon.iter().enumerate() {
        let q = polygon[(i + 1) % polygon.len()];
        let (dp, dq) = (distance(p), distance(q));
        if dp >= 0.0 {
            kept.push(p);
        }
        if (dp > 0.0 && dq < 0.0) || (dp < 0.0 && dq > 0.0) {
            let t = dp / (dp - dq);
            kept.push([p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])]);
        }
    }
    kept
}

/// Area of a polygon of either orientation (shoelace formula, relative to its first corner).
fn area(polygon: &[[f64; 2]]) -> f64 {
    let Some(&origin) = polygon.first() else {
        return 0.0;
    };
    let rel = |p: [f64; 2]| [p[0] - origin[0], p[1] - origin[1]];
    let twice: f64 = polygon
        .windows(2)
        .map(|w| {
            let (p, q) = (rel(w[0]), rel(w[1]));
            p[0] * q[1] - p[1] * q[0]
        })
        .sum();
    0.5 * twice.abs()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::PolarDirection;

    fn camera() -> CameraFacts {
        CameraFacts {
            name: "test".to_owned(),
            width: 240,
            height: 180,
            pixel_mm: 1.0 / 14.0,
            center_px: [120.3, 89.6],
            lens: Default::default(),
        }
    }

    fn pose(theta_deg: f64, phi_deg: f64, rotation_deg: f64) -> Configuration {
        Configuration {
            id: 7,
            light: PolarDirection::from_degrees(30.0, 180.0),
            camera: PolarDirection::from_degrees(theta_deg, phi_deg),
            rotation: rotation_deg.to_radians(),
        }
    }

    #[test]
    fn image_axes_follow_the_convention() {
        let p = Projection::new(&camera(), &pose(60.0, 0.0, 0.0));
        let close = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]) < 1e-9;
        // Seen from +x, +y of the sample is to the right; the near edge (+x) is below, foreshortened by cos 60.
        assert!(close(p.to_pixel([0.0, 1.0]), [134.3, 89.6]));
        assert!(close(p.to_pixel([1.0, 0.0]), [120.3, 96.6]));
        // Turned by 90 degrees, the sample's x axis points along the laboratory's +y.
        let p = Projection::new(&camera(), &pose(60.0, 0.0, 90.0));
        assert!(close(p.to_pixel([1.0, 0.0]), [134.3, 89.6]));
        // Camera and sample turned together: nothing changes.
        let a = Projection::new(&camera(), &pose(40.0, 25.0, 25.0));
        let b = Projection::new(&camera(), &pose(40.0, 0.0, 0.0));
        assert!(close(a.to_pixel([0.7, -1.1]), b.to_pixel([0.7, -1.1])));
    }

    #[test]
    fn the_projection_is_the_dot_product_with_the_image_axes() {
        for (theta, phi, rotation) in [(0.0, 10.0, 20.0), (48.0, 200.0, -70.0), (80.0, -33.0, 90.0)]
        {
            let c = pose(theta, phi, rotation);
            let p = Projection::new(&camera(), &c);
            let (sr, cr) = c.rotation.sin_cos();
            let [x, y] = [1.3, -2.1];
            let lab = glam::DVec3::new(cr * x - sr * y, sr * x + cr * y, 0.0);
            let (st, ct) = c.camera.theta.sin_cos();
            let (sp, cp) = c.camera.phi.sin_cos();
            let right = glam::DVec3::new(-sp, cp, 0.0);
            let down = glam::DVec3::new(ct * cp, ct * sp, -st);
            let pixel = p.to_pixel([x, y]);
            assert!((pixel[0] - 120.3 - 14.0 * lab.dot(right)).abs() < 1e-9);
            assert!((pixel[1] - 89.6 - 14.0 * lab.dot(down)).abs() < 1e-9);
            let back = p.to_sample(pixel);
            assert!((back[0] - x).hypot(back[1] - y) < 1e-9, "{back:?}");
        }
    }

    #[test]
    fn weights_sum_to_the_area_of_the_quadrilateral() {
        for (theta, phi, rotation, side) in [
            (0.0, 0.0, 0.0, 10.0),
            (32.0, 12.0, 77.0, 6.5),
            (80.0, 0.0, 0.0, 10.0),
            (80.0, 3.0, 40.0, 6.0),
            (64.0, 0.0, 90.0, 0.3),
        ] {
            let p = Projection::new(&camera(), &pose(theta, phi, rotation));
            let coverage = p.coverage(side).unwrap();
            let full = (side * 14.0).powi(2);
            let expected = full * theta.to_radians().cos();
            assert!(
                (coverage.area() - expected).abs() < 1e-9 * full,
                "{theta} {rotation}: {} against {expected}",
                coverage.area()
            );
            assert!(coverage.pixels().all(|(_, _, w)| (0.0..=1.0).contains(&w)));
        }
    }

    #[test]
    fn grazing_views_are_foreshortened() {
        let area = |theta| {
            let p = Projection::new(&camera(), &pose(theta, 0.0, 0.0));
            p.coverage(10.0).unwrap().area()
        };
        assert!((area(80.0) / area(0.0) - 0.173_648_177_666_930_3).abs() < 1e-9);
    }

    #[test]
    fn one_pixel_weights_are_exact() {
        // A square of one pixel, offset by (0.3, 0.6) from the grid: the four overlaps are products of its overhangs.
        let p = Projection::new(&camera(), &pose(0.0, 90.0, 90.0));
        let coverage = p.coverage(1.0 / 14.0).unwrap();
        let weights: Vec<_> = coverage.pixels().collect();
        let expected = [
            (119, 89, 0.2 * 0.9),
            (120, 89, 0.8 * 0.9),
            (119, 90, 0.2 * 0.1),
            (120, 90, 0.8 * 0.1),
        ];
        for (found, wanted) in weights.iter().zip(expected) {
            assert_eq!((found.0, found.1), (wanted.0, wanted.1));
            assert!((found.2 - wanted.2).abs() < 1e-9, "{found:?} {wanted:?}");
        }
        assert_eq!(coverage.bounds(), [119, 89, 121, 91]);
    }

    #[test]
    fn a_crop_outside_the_image_is_refused() {
        let p = Projection::new(&camera(), &pose(0.0, 0.0, 45.0));
        let message = p.coverage(10.0).unwrap_err().report();
        assert!(
            message.contains("configuration 7: the crop leaves the image by 9.4 pixels")
                && message.contains("hint:"),
            "{message}"
        );
        let mut nan = camera();
        nan.center_px[0] = f64::NAN;
        assert!(
            Projection::new(&nan, &pose(0.0, 0.0, 0.0))
                .coverage(5.0)
                .is_err()
        );
    }
}
