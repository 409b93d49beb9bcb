//! Promise: yarn segments scatter what independent quadrature says, keep their laws, and return exact derivatives, at the edges of
//! their domains too.
#![allow(
    clippy::unwrap_used,
    clippy::float_cmp,
    clippy::print_stdout,
    missing_docs
)]

#[path = "common/woven.rs"]
mod woven;

use glam::DVec3;
use goniofit::scatter::surface::woven::{Quality, SHAPE_ROWS, Segment, Shape, Spine};
use serde_json::Value;
use woven::{above, quantile, rows, shape, stream};

// ---- published values ----------------------------------------------------------------------------------------------

#[test]
fn spines_match_858_rows_of_30_digit_conics() {
    let file: Value = serde_json::from_str(include_str!("data/irawan_spine.json")).unwrap();
    let rows = file["rows"].as_array().unwrap();
    assert_eq!(rows.len(), 858);
    let (mut worst, mut circles) = (0.0_f64, 0);
    for row in rows {
        let number = |key: &str| row[key].as_f64().unwrap();
        let um = number("u_max_deg").to_radians();
        let straight = 0.5 * (number("l") - number("w") * um.sin());
        let u = um * number("u_over_umax");
        let found = straight * Spine::new(um, number("kappa")).radius(u.sin());
        worst = worst.max((found / number("R") - 1.0).abs());
        // Control: a circle whatever the curvature.
        let circle = straight * Spine::new(um, 0.0).radius(u.sin());
        circles += usize::from((circle / number("R") - 1.0).abs() < 1e-6);
    }
    println!("largest relative error {worst:.1e}; {circles} rows are circles");
    assert!(worst < 1e-10 && circles < 200);
}

#[test]
fn integrals_match_168_rows() {
    let rows = rows();
    assert_eq!(rows.len(), 168);
    let mut errors: Vec<(String, Vec<[f64; 3]>)> = Vec::new();
    for row in &rows {
        let segment = Segment::new(row.shape).unwrap();
        let report = segment.estimate(row.wi, row.wr, 1e-10);
        let tolerance = 1e-8 * row.value + 1e-15;
        assert!(
            (report.value - row.value).abs() <= tolerance,
            "{}: {report:?}, expected {}",
            row.set,
            row.value
        );
        assert!((report.value - row.value).abs() <= report.error + 1e-9 * row.value + 1e-15);
        let trapezoid = segment.value(row.wi, row.wr, Quality::Published(11));
        // One row of the file has a sample on the edge of what is seen.
        assert!(
            (trapezoid - row.trapezoid).abs() <= 1e-9 * row.trapezoid + 1e-15,
            "{}: {trapezoid}, expected {}",
            row.set,
            row.trapezoid
        );
        let relative = |x: f64| (x - row.value).abs() / row.value.max(1e-12);
        let cell = [
            relative(segment.value(row.wi, row.wr, Quality::Fit)),
            relative(segment.value(row.wi, row.wr, Quality::Report)),
            relative(trapezoid),
        ];
        match errors.last_mut().filter(|(set, _)| *set == row.set) {
            Some((_, list)) => list.push(cell),
            None => errors.push((row.set.clone(), vec![cell])),
        }
    }
    println!("relative error, median / largest: fit, report, trapezoid of 11");
    for (set, list) in &errors {
        let text: Vec<String> = (0..3)
            .map(|k| {
                let mut column: Vec<f64> = list.iter().map(|e| e[k]).collect();
                format!(
                    "{:.1e} / {:.1e}",
                    quantile(&mut column, 0.5),
                    quantile(&mut column, 1.0)
                )
            })
            .collect();
        println!("{set:>18}  {}", text.join("   "));
    }
    for (set, list) in &errors {
        let worst = |k: usize| list.iter().map(|e| e[k]).fold(0.0, f64::max);
        assert!(worst(0) < 2e-2 && worst(1) < 2e-6, "{set}: {list:?}");
        // Control: the published rule is not that good.
        assert!(worst(2) > 2e-2, "{set}");
    }
}

// ---- laws ----------------------------------------------------------------------------------------------------------

#[test]
fn integrals_are_reciprocal_symmetric_and_not_negative() {
    let mut random = stream(1);
    let mut worst = [0.0_f64; 3];
    let mut moved = 0.0_f64;
    let n = 4000;
    for _ in 0..n {
        let segment = Segment::new(shape(&mut random)).unwrap();
        let (wi, wr) = (above(&mut random), above(&mut random));
        let value = |wi: DVec3, wr: DVec3| segment.value(wi, wr, Quality::Fit);
        let f = value(wi, wr);
        assert!(f >= 0.0 && f.is_finite(), "{f}, {:?}", segment.shape());
        // Turned by 180 degrees about the normal, and mirrored in the yarn's cross-section with the light and the camera.
        let half_turn = |w: DVec3| DVec3::new(-w.x, -w.y, w.z);
        let mirror = |w: DVec3| DVec3::new(-w.x, w.y, w.z);
        let opposite = Segment::new(Shape {
            twist: -segment.shape().twist,
            ..*segment.shape()
        })
        .unwrap();
        for (k, other) in [
            value(wr, wi),
            value(half_turn(wi), half_turn(wr)),
            opposite.value(mirror(wi), mirror(wr), Quality::Fit),
        ]
        .into_iter()
        .enumerate()
        {
            worst[k] = worst[k].max((other - f).abs() / f.max(1e-6));
        }
        // Control: the mirror image of a twisted yarn is another yarn.
        let mirrored = value(mirror(wi), mirror(wr));
        moved += (mirrored - f).abs() / f.max(1e-6) / f64::from(n);
    }
    println!(
        "exchanged {:.1e}, turned {:.1e}, mirrored {:.1e}; control {moved:.2}",
        worst[0], worst[1], worst[2]
    );
    assert_eq!(worst[0], 0.0);
    // A fit's rule finds the ends of what is seen to 1e-4, from other sides after a turn.
    assert!(worst[1] < 1e-3 && worst[2] < 1e-12 && moved > 0.1);
}

#[test]
fn reported_errors_bound_the_true_ones() {
    let mut random = stream(2);
    let (mut over, mut fit, mut report) = (0, Vec::new(), Vec::new());
    let n = 1500;
    for _ in 0..n {
        let shape = shape(&mut random);
        let segment = Segment::new(shape).unwrap();
        let (wi, wr) = (above(&mut random), above(&mut random));
        let exact = segment.estimate(wi, wr, 1e-11);
        let loose = segment.estimate(wi, wr, 1e-6);
        let scale = exact.value.max(1e-7);
        if (loose.value - exact.value).abs() > loose.error + exact.error + 1e-9 * scale {
            over += 1;
            println!("{shape:?} {wi} {wr}: {loose:?} {exact:?}");
        }
        report.push((loose.value - exact.value).abs() / scale);
        fit.push((segment.value(wi, wr, Quality::Fit) - exact.value).abs() / scale);
    }
    for (name, list) in [("fit", &mut fit), ("report", &mut report)] {
        println!(
            "{name}: median {:.1e}, 90 % {:.1e}, 99 % {:.1e}, largest {:.1e}",
            quantile(list, 0.5),
            quantile(list, 0.9),
            quantile(list, 0.99),
            quantile(list, 1.0)
        );
    }
    assert!(over <= n / 500, "{over} of {n}");
    assert!(quantile(&mut fit, 0.5) < 1e-3 && quantile(&mut report, 0.9) < 1e-6);
}

// ---- derivatives ---------------------------------------------------------------------------------------------------

/// Largest difference between derivatives and five-point differences of converged values, relative to the larger of
/// value over range and derivative. `slopes` is on trial.
fn slope_error(
    shape: &Shape,
    (wi, wr): (DVec3, DVec3),
    slopes: &[f64; SHAPE_ROWS],
) -> [f64; SHAPE_ROWS] {
    let value = |numbers: [f64; SHAPE_ROWS]| {
        let segment = Segment::new(Shape::from_numbers(numbers)).unwrap();
        segment.estimate(wi, wr, 1e-12).value
    };
    let numbers = shape.numbers();
    let f = value(numbers);
    std::array::from_fn(|k| {
        let step = 1e-4 * numbers[k].abs().max(0.05);
        let at = |n: f64| {
            let mut moved = numbers;
            moved[k] += n * step;
            value(moved)
        };
        // Where a number is on the edge of its domain, forward only.
        let edge = numbers[k] == 0.0 && k >= 3;
        let expected = if edge {
            (-25.0 * f + 48.0 * at(1.0) - 36.0 * at(2.0) + 16.0 * at(3.0) - 3.0 * at(4.0))
                / (12.0 * step)
        } else {
            (8.0 * (at(1.0) - at(-1.0)) - (at(2.0) - at(-2.0))) / (12.0 * step)
        };
        (slopes[k] - expected).abs() / expected.abs().max(f).max(1e-9)
    })
}

#[test]
fn derivatives_are_exact_for_every_number_of_a_shape() {
    let mut random = stream(3);
    let mut errors: Vec<Vec<f64>> = vec![Vec::new(); SHAPE_ROWS];
    let mut control = 0;
    let n = 300;
    for _ in 0..n {
        let mut shape = shape(&mut random);
        shape.smoothing = shape.smoothing.min(0.99);
        let segment = Segment::new(shape).unwrap();
        let pair = (above(&mut random), above(&mut random));
        let (value, slopes) = segment.slopes(pair.0, pair.1, Quality::Report);
        let same = segment.value(pair.0, pair.1, Quality::Report);
        assert!((value - same).abs() <= 1e-12 * same, "{value} {same}");
        let found = slope_error(&shape, pair, &slopes);
        for k in 0..SHAPE_ROWS {
            errors[k].push(found[k]);
        }
        if found.iter().any(|e| *e > 1e-3) {
            println!("{shape:?} {pair:?}\n  {slopes:?}\n  {found:?}");
        }
        // Control: one part in a thousand on the derivatives.
        let wrong = slope_error(&shape, pair, &slopes.map(|s| 1.001 * s));
        control += usize::from(wrong.iter().any(|e| *e > 2e-4));
    }
    for (k, list) in errors.iter_mut().enumerate() {
        println!(
            "{k}: median {:.1e}, 90 % {:.1e}, largest {:.1e}",
            quantile(list, 0.5),
            quantile(list, 0.9),
            quantile(list, 1.0)
        );
    }
    assert!(control > n / 2, "{control}");
    for list in &mut errors {
        assert!(quantile(list, 0.9) < 2e-5 && quantile(list, 0.99) < 1e-2);
    }
}
