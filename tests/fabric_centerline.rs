//! Promise: Li 2024's center line and fibers are computed right, and floats join without a kink.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use goniofit::fabric::{
    CenterLine, base_angle, base_radius, float_profile, migrated_radius, offset,
};
use serde_json::Value;

fn golden() -> Value {
    let text = std::fs::read_to_string("tests/data/yarn_centerline.json").unwrap();
    serde_json::from_str(&text).unwrap()
}

// ---- Li 2024 ----

/// Largest error of `profile` over the 1080 golden heights.
fn centerline_error(profile: impl Fn(f64, f64, f64, f64) -> f64) -> f64 {
    let golden = golden();
    let rows = golden["centerline"].as_array().unwrap();
    assert_eq!(rows.len(), 1080);
    rows.iter()
        .map(|row| {
            let v: Vec<f64> = row
                .as_array()
                .unwrap()
                .iter()
                .map(|x| x.as_f64().unwrap())
                .collect();
            (profile(v[3], v[1], v[0], v[2]) - v[4]).abs()
        })
        .fold(0.0, f64::max)
}

#[test]
fn the_float_has_the_golden_heights() {
    let error = centerline_error(|y, l, u, beta| float_profile(y, l, u, beta).value);
    assert!(error < 1e-12, "{error}");
    // Negative control: without the flattening of long floats (w = 0) the same test fails.
    let arc = |y: f64, l: f64, u: f64, beta: f64| float_profile(y / l, 1.0, u, beta).value;
    assert!(centerline_error(arc) > 1e-3);
}

#[test]
fn the_float_peaks_at_beta_and_has_its_limits() {
    for l in [1.0, 2.0, 3.5, 7.0] {
        for u in [0.0, 1e-12, 0.5, 1.5, std::f64::consts::FRAC_PI_2] {
            let top = float_profile(l / 2.0, l, u, 0.4);
            assert!((top.value - 0.4).abs() < 1e-14 && top.slope.abs() < 1e-14);
            assert_eq!(float_profile(0.0, l, u, 0.4).value, 0.0);
        }
        let y = 0.3 * l;
        let parabola = 4.0 * 0.4 * y * (l - y) / (l * l);
        assert!((float_profile(y, l, 0.0, 0.4).value - parabola).abs() < 1e-15);
    }
    // Longer than l_max: as flat as l_max.
    let (at_4, at_7) = (
        float_profile(1.0, 4.0, 1.0, 0.4).value,
        float_profile(1.75, 7.0, 1.0, 0.4).value,
    );
    assert!((at_4 - at_7).abs() < 1e-15);
}

#[test]
fn fibers_have_the_golden_positions() {
    let golden = golden();
    let rows = golden["fibers"].as_array().unwrap();
    assert_eq!(rows.len(), 40);
    for row in rows {
        let v = |key: &str| row[key].as_f64().unwrap();
        let (i, m) = (v("i") as u32, v("m") as u32);
        let radius = base_radius(v("e_yarn"), i, m, v("J_xy"), v("S"));
        let phase = v("s") * v("theta") + v("theta0_i");
        let migrated = migrated_radius(radius, v("G"), phase);
        let [x, z] = offset(migrated, v("theta") + base_angle(i));
        for (found, key) in [(radius, "R_i"), (migrated, "R_i_y"), (x, "x_fib")] {
            assert!((found - v(key)).abs() < 1e-12, "{key}: {found} in {row}");
        }
        assert!((z + v("z_cen") - v("z_fib")).abs() < 1e-12, "{row}");
    }
    // A strongly negative S puts the fiber on the opposite side, at the same distance.
    let negative = base_radius(1.0, 1, 1000, 0.1, -4.0);
    assert!(negative < 0.0);
    let ([a, b], [c, d]) = (
        offset(negative, 0.7),
        offset(-negative, 0.7 + std::f64::consts::PI),
    );
    assert!((a - c).abs() < 1e-15 && (b - d).abs() < 1e-15);
}

// ---- joins ----

/// Largest jump of height, slope and curvature over the changes of side (and their blends' ends) and the seam.
fn largest_jump(at: impl Fn(f64) -> [f64; 3], places: &[f64]) -> [f64; 3] {
    let mut jump = [0.0_f64; 3];
    let e = 1e-9;
    for &place in places {
        let (before, after) = (at(place - e), at(place + e));
        for k in 0..3 {
            jump[k] = jump[k].max((after[k] - before[k]).abs());
        }
    }
    jump
}

/// Where the sides of a periodic row of cells change.
fn changes(cells: &[bool]) -> Vec<f64> {
    let n = cells.len();
    let changed = |k: &usize| cells[*k] != cells[(*k + n - 1) % n];
    (0..n).filter(changed).map(|k| k as f64).collect()
}

#[test]
fn floats_join_without_kink_and_across_the_seam() {
    let mut kinks_of_bare_floats = 0;
    for cells in [
        vec![true, false],
        vec![true, true, false],
        vec![true, true, true, false],
        vec![false, true, true, false],
        vec![true, true, true, true, true, true, true, false],
        vec![true, false, true, true, false, false, false],
    ] {
        for u in [0.0, 0.6, 1.5, std::f64::consts::FRAC_PI_2] {
            for join in [0.1, 0.25, 0.5] {
                let line = CenterLine::new(&cells, 0.08, u, join);
                let mut places = vec![0.0, cells.len() as f64];
                let changes = changes(&cells);
                for &change in &changes {
                    places.extend([change - join, change, change + join]);
                }
                let at = |y: f64| {
                    let jet = line.at(y);
                    [jet.value, jet.slope, jet.bend]
                };
                let jump = largest_jump(at, &places);
                // Over 2e-9 cells the slope moves by 2e-9 times the bend, which reaches 1e4 near u_max = 90 degrees.
                let bend = 1.0
                    + (0..2000)
                        .map(|k| line.at(k as f64 * 0.005).bend.abs())
                        .fold(0.0, f64::max);
                assert!(jump[0] < 1e-6, "{cells:?} u={u} join={join} {jump:?}");
                assert!(
                    jump[1] < 1e-8 * bend,
                    "{cells:?} u={u} join={join} {jump:?}"
                );
                assert!(
                    jump[2] < 1e-4 * bend,
                    "{cells:?} u={u} join={join} {jump:?}"
                );
                // The slope is the derivative of the height, and the bend that of the slope, in the blends too.
                for k in 0..500 {
                    let y = (k as f64 + 0.37) * cells.len() as f64 / 500.0;
                    let h = 1e-6;
                    let slope = (line.at(y + h).value - line.at(y - h).value) / (2.0 * h);
                    assert!((slope - line.at(y).slope).abs() < 1e-5 * bend, "y={y}");
                }
                for (k, from) in changes.iter().enumerate() {
                    let next = changes.get(k + 1);
                    let to = next.map_or(changes[0] + cells.len() as f64, |c| *c);
                    let middle = 0.5 * (from + to);
                    let side = if cells[*from as usize] { 1.0 } else { -1.0 };
                    assert!((line.at(middle).value - 0.08 * side).abs() < 1e-14);
                    assert!(line.at(middle).slope.abs() < 1e-12);
                }
            }
            // Negative control: floats of unequal length joined bare have a kink that this test sees.
            let bare = |y: f64| {
                if y < 0.0 {
                    let f = float_profile(2.0 + y, 2.0, u.min(1.4), 0.08);
                    [f.value, f.slope, f.bend]
                } else {
                    let f = float_profile(y, 1.0, u.min(1.4), 0.08);
                    [-f.value, -f.slope, -f.bend]
                }
            };
            kinks_of_bare_floats += usize::from(largest_jump(bare, &[0.0])[1] > 1e-2);
        }
    }
    assert_eq!(kinks_of_bare_floats, 24);
}
