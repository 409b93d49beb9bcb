use super::*;
use crate::math::PolarDirection;
use crate::session::Lens;

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
    for (theta, phi, rotation) in [(0.0, 10.0, 20.0), (48.0, 200.0, -70.0), (80.0, -33.0, 90.0)] {
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

fn bent() -> CameraFacts {
    CameraFacts {
        lens: Lens {
            roll: 0.03,
            perspective: 1.0 / 250.0,
            distortion: -0.08,
            sag_px: [[1.5, -2.5], [-0.7, 1.9]],
        },
        ..camera()
    }
}

fn poses() -> impl Iterator<Item = Configuration> {
    let thetas = [0.0, 16.0, 48.0, 64.0, 80.0];
    thetas
        .into_iter()
        .flat_map(|t| [(0.0, 0.0), (0.0, 90.0), (25.0, -40.0)].map(|(p, r)| pose(t, p, r)))
}

#[test]
fn the_way_back_is_exact_for_a_strong_lens() {
    for distortion in [-0.25, -0.08, 0.0, 0.12] {
        let mut camera = bent();
        camera.lens.distortion = distortion;
        let errors = Perturbation {
            height_mm: 0.7,
            ..Default::default()
        };
        for pose in poses() {
            let p = Projection::perturbed(&camera, &pose, &errors);
            for point in [[0.0, 0.0], [5.0, 5.0], [-5.0, 3.0], [2.0, -5.0]] {
                let pixel = p.to_pixel(point);
                let again = p.to_pixel(p.to_sample(pixel));
                let back = p.to_sample(pixel);
                assert!(
                    (again[0] - pixel[0]).hypot(again[1] - pixel[1]) < 1e-9,
                    "{pose:?}"
                );
                assert!(
                    (back[0] - point[0]).hypot(back[1] - point[1]) < 1e-10,
                    "{pose:?} {back:?}"
                );
            }
        }
    }
}

/// The model again, step by step in three dimensions.
#[test]
fn the_lens_is_a_pinhole_turned_sagging_and_distorted() {
    let camera = bent();
    let lens = camera.lens;
    let height = 0.4;
    let errors = Perturbation {
        height_mm: height,
        ..Default::default()
    };
    let half_diagonal = 0.5 * 240.0_f64.hypot(180.0);
    let distort = |[x, y]: [f64; 2]| {
        let d = [x - 120.0, y - 90.0];
        let factor = 1.0 + lens.distortion * (d[0].hypot(d[1]) / half_diagonal).powi(2);
        [120.0 + d[0] * factor, 90.0 + d[1] * factor]
    };
    for pose in poses() {
        let p = Projection::perturbed(&camera, &pose, &errors);
        let (sr, cr) = pose.rotation.sin_cos();
        let (st, ct) = pose.camera.theta.sin_cos();
        let (sp, cp) = pose.camera.phi.sin_cos();
        let toward = glam::DVec3::new(st * cp, st * sp, ct);
        let right = glam::DVec3::new(-sp, cp, 0.0);
        let down = glam::DVec3::new(ct * cp, ct * sp, -st);
        let pupil = toward / lens.perspective;
        let image = |[x, y]: [f64; 2], z: f64| {
            let point = glam::DVec3::new(cr * x - sr * y, sr * x + cr * y, z);
            let ray = point - pupil;
            // Where the ray meets the plane through the center, perpendicular to the view.
            let t = -pupil.dot(toward) / ray.dot(toward);
            let hit = (pupil + ray * t) * 14.0;
            let (s, c) = lens.roll.sin_cos();
            let (x, y) = (hit.dot(right), hit.dot(down));
            [c * x - s * y, s * x + c * y]
        };
        // The sample center of a sample that is not raised is seen at center_px plus the sag.
        let seen = Projection::new(&camera, &pose).to_pixel([0.0, 0.0]);
        for i in 0..2 {
            let sag = lens.sag_px[0][i] * st + lens.sag_px[1][i] * (1.0 - ct);
            assert!((seen[i] - camera.center_px[i] - sag).abs() < 1e-9);
        }
        let ideal = p.distortion.undistort(seen);
        for point in [[0.0, 0.0], [4.0, -1.0], [-3.0, 5.0]] {
            let offset = image(point, height);
            let wanted = distort([ideal[0] + offset[0], ideal[1] + offset[1]]);
            let found = p.to_pixel(point);
            assert!(
                (found[0] - wanted[0]).hypot(found[1] - wanted[1]) < 1e-9,
                "{pose:?}: {found:?} {wanted:?}"
            );
        }
    }
}

#[test]
fn perturbations_act_as_said() {
    let (camera, pose) = (camera(), pose(60.0, 0.0, 30.0));
    let seen =
        |errors: Perturbation| Projection::perturbed(&camera, &pose, &errors).to_pixel([2.0, 1.0]);
    let plain = Projection::new(&camera, &pose).to_pixel([2.0, 1.0]);
    let moved = |errors, by: [f64; 2]| {
        let found = seen(errors);
        let off = [found[0] - plain[0] - by[0], found[1] - plain[1] - by[1]];
        assert!(
            off[0].hypot(off[1]) < 1e-9,
            "{errors:?}: {found:?} from {plain:?}"
        );
    };
    let none = Perturbation::default();
    moved(none, [0.0; 2]);
    moved(
        Perturbation {
            shift_px: [0.3, -0.2],
            ..none
        },
        [0.3, -0.2],
    );
    // A camera at theta sees what is raised by h higher by h sin(theta).
    let up = -0.5 * 60f64.to_radians().sin() * 14.0;
    moved(
        Perturbation {
            height_mm: 0.5,
            ..none
        },
        [0.0, up],
    );
    let offset = [plain[0] - 120.3, plain[1] - 89.6];
    moved(
        Perturbation {
            scale: 0.01,
            ..none
        },
        offset.map(|o| o * (1.0 / 1.01 - 1.0)),
    );
    let steeper = 62f64.to_radians().cos() / 60f64.to_radians().cos() - 1.0;
    moved(
        Perturbation {
            camera_theta: 2f64.to_radians(),
            ..none
        },
        [0.0, offset[1] * steeper],
    );
    let mut turned = pose;
    turned.rotation += 0.01;
    let turned = Projection::new(&camera, &turned).to_pixel([2.0, 1.0]);
    moved(
        Perturbation {
            rotation: 0.01,
            ..none
        },
        [turned[0] - plain[0], turned[1] - plain[1]],
    );
}

/// Fraction of each pixel's 64 x 64 points that lie in a polygon (even-odd rule).
fn supersampled(polygon: &[[f64; 2]], x: usize, y: usize) -> f64 {
    let mut inside = 0;
    for k in 0..64 * 64 {
        let p = [
            x as f64 + ((k % 64) as f64 + 0.5) / 64.0,
            y as f64 + ((k / 64) as f64 + 0.5) / 64.0,
        ];
        let crossings = (0..polygon.len()).filter(|&i| {
            let (a, b) = (polygon[i], polygon[(i + 1) % polygon.len()]);
            (a[1] > p[1]) != (b[1] > p[1])
                && p[0] < a[0] + (p[1] - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
        });
        inside += crossings.count() % 2;
    }
    inside as f64 / 4096.0
}

fn check_coverage(polygon: &[[f64; 2]]) {
    let coverage = Coverage::of_polygon(polygon, [30, 25]);
    let wanted = clipping::area(polygon);
    assert!((coverage.area() - wanted).abs() < 1e-9, "{polygon:?}");
    let mut found = vec![0.0; 30 * 25];
    for (x, y, w) in coverage.pixels() {
        assert!((0.0..=1.0).contains(&w));
        found[y * 30 + x] = w;
    }
    for (i, w) in found.into_iter().enumerate() {
        // An edge through a pixel misplaces at most one row of points on each side.
        let expected = supersampled(polygon, i % 30, i / 30);
        assert!(
            (w - expected).abs() < 2.0 / 64.0,
            "{polygon:?} pixel {i}: {w} against {expected}"
        );
    }
}

#[test]
fn coverage_agrees_with_counting_points() {
    // Nonconvex: an arrow head and a comb, in both orientations; edges along and across the grid.
    let arrow = [[2.3, 3.1], [25.7, 12.2], [3.4, 22.9], [9.8, 12.7]];
    let comb = [
        [1.0, 1.0],
        [20.5, 1.0],
        [20.5, 18.0],
        [16.25, 18.0],
        [16.25, 4.0],
        [9.0, 4.5],
        [7.0, 24.0],
        [1.0, 24.0],
    ];
    check_coverage(&arrow);
    check_coverage(&comb);
    let mut turned = arrow;
    turned.reverse();
    check_coverage(&turned);
    let mut turned = comb;
    turned.reverse();
    check_coverage(&turned);
    // Thinner than a pixel, and a corner inside one pixel.
    check_coverage(&[[4.2, 4.3], [24.1, 9.8], [24.1, 9.9]]);
    check_coverage(&[[6.2, 6.1], [6.7, 6.3], [6.4, 6.8]]);
    // The whole image.
    check_coverage(&[[0.0, 0.0], [30.0, 0.0], [30.0, 25.0], [0.0, 25.0]]);
}

#[test]
fn coverage_agrees_with_clipping_pixel_by_pixel() {
    for pose in poses() {
        for side in [0.3, 4.0, 9.5] {
            let p = Projection::new(&camera(), &pose);
            let Ok(found) = p.coverage(side) else {
                continue;
            };
            let wanted = clipping::coverage(&p.quadrilateral(side));
            let found: Vec<_> = found.pixels().collect();
            assert_eq!(found.len(), wanted.len(), "{pose:?} {side}");
            for (f, w) in found.iter().zip(&wanted) {
                assert_eq!((f.0, f.1), (w.0, w.1));
                assert!((f.2 - w.2).abs() < 1e-12, "{pose:?} {side}: {f:?} {w:?}");
            }
        }
    }
}

#[test]
fn bent_edges_get_points_and_straight_ones_none() {
    let p = Projection::new(&bent(), &pose(30.0, 0.0, 20.0));
    let outline = p.outline(8.0);
    assert!(outline.len() > 40, "{}", outline.len());
    // The area of the true outline, from one far finer.
    let fine: Vec<_> = (0..4000)
        .map(|i| {
            let (edge, t) = (i / 1000, (i % 1000) as f64 / 1000.0);
            let corners = square(8.0);
            let (a, b) = (corners[edge], corners[(edge + 1) % 4]);
            p.to_pixel([0, 1].map(|k| a[k] + t * (b[k] - a[k])))
        })
        .collect();
    let exact = clipping::area(&fine);
    let area = p.coverage(8.0).unwrap().area();
    // 450 pixels of edge, right to 1e-4 pixels.
    assert!((area - exact).abs() < 0.045, "{area} {exact}");
    let corners_only = clipping::area(&p.quadrilateral(8.0));
    assert!(
        (corners_only - exact).abs() > 10.0,
        "{corners_only} {exact}"
    );
    let mut straight = bent();
    straight.lens.distortion = 0.0;
    let p = Projection::new(&straight, &pose(30.0, 0.0, 20.0));
    assert_eq!(p.outline(8.0), p.quadrilateral(8.0));
}

/// An independent way to the covered area: cutting the polygon to each pixel.
mod clipping {
    /// Column, row and area of the pixels a convex polygon touches.
    pub(super) fn coverage(polygon: &[[f64; 2]]) -> Vec<(usize, usize, f64)> {
        let mut pixels = Vec::new();
        let (top, bottom) = extent(polygon, 1);
        for y in top..bottom {
            let strip = clip(polygon, 1, y as f64);
            let (left, right) = extent(&strip, 0);
            pixels.extend((left..right).map(|x| (x, y, area(&clip(&strip, 0, x as f64)))));
        }
        pixels
    }

    fn extent(polygon: &[[f64; 2]], axis: usize) -> (usize, usize) {
        let low = polygon.iter().map(|p| p[axis]).fold(f64::MAX, f64::min);
        let high = polygon.iter().map(|p| p[axis]).fold(0.0, f64::max);
        (low.floor() as usize, high.ceil() as usize)
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
    pub(super) fn area(polygon: &[[f64; 2]]) -> f64 {
        let rel = |p: [f64; 2]| [p[0] - polygon[0][0], p[1] - polygon[0][1]];
        let twice = |w: &[[f64; 2]]| {
            let (p, q) = (rel(w[0]), rel(w[1]));
            p[0] * q[1] - p[1] * q[0]
        };
        0.5 * polygon.windows(2).map(twice).sum::<f64>().abs()
    }
}
