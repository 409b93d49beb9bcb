//! Promises: Li 2024's center line and fibers are computed right; woven tiles are smooth, seamless, and what their
//! descriptions say.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use glam::DVec3;
use goniofit::fabric::{
    CenterLine, Fabric, FiberTile, base_angle, base_radius, curves, float_profile, load,
    migrated_radius, offset,
};
use serde_json::Value;
use std::path::{Path, PathBuf};

fn golden() -> Value {
    let text = std::fs::read_to_string("tests/data/yarn_centerline.json").unwrap();
    serde_json::from_str(&text).unwrap()
}

fn fabrics() -> Vec<PathBuf> {
    let mut list: Vec<PathBuf> = std::fs::read_dir("fabrics")
        .unwrap()
        .map(|e| e.unwrap().path())
        .filter(|p| p.extension().is_some_and(|e| e == "toml"))
        .collect();
    list.sort();
    list
}

fn described(text: &str) -> Result<Fabric, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("f.toml");
    std::fs::write(&path, text).unwrap();
    load(&path).map_err(|e| e.report())
}

/// A small woven description with the named lines replaced.
fn small(changes: &[(&str, &str)]) -> String {
    let system = "pitch_mm = 0.3\nfibers = 5\nfiber_radius_um = 10.0\nyarn_radius_mm = 0.06\ncrown_mm = 0.06\n\
                  twist_per_tile = 2\nmigration_depth = 0.5\nmigration_per_tile = 1\njitter = 0.1\n";
    let mut text = format!(
        "name = \"small\"\nseed = 3\n[weave]\npattern = \"2/1 twill\"\nrepeats = [1, 1]\n[warp]\n{system}[weft]\n{system}\
         [segments]\nlength_mm = 0.01\n"
    );
    for (from, to) in changes {
        assert!(text.contains(from), "{from}");
        text = text.replace(from, to);
    }
    text
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
                for change in line.changes() {
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
                for (middle, side) in line.crowns() {
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

// ---- tiles ----

/// Checks links and seams; returns the largest turn between neighboring segments times segment count per fiber.
fn check_links(tile: &FiberTile) {
    let s = &tile.segments;
    for (k, segment) in s.iter().enumerate() {
        let (next, previous) = (segment.next as usize, segment.previous as usize);
        assert_eq!(s[next].previous as usize, k);
        assert_eq!(s[previous].next as usize, k);
        assert_eq!(s[next].yarn_system, segment.yarn_system);
        let d = segment.end - s[next].start;
        let (tx, ty) = (d.x / tile.size[0], d.y / tile.size[1]);
        let whole = |t: f64| (t - t.round()).abs() < 1e-12;
        assert!(
            whole(tx) && whole(ty) && d.z.abs() < 1e-12,
            "segment {k}: {d}"
        );
        assert!(segment.start.distance(segment.end) > 0.0);
    }
}

#[test]
fn every_fabric_is_seamless_and_linked() {
    for path in fabrics() {
        let fabric = load(&path).unwrap();
        let report = &fabric.report;
        check_links(&fabric.tile);
        assert_eq!(report.fibers, report.closed_fibers, "{}", path.display());
        assert!(!fabric.sources.is_empty() && !fabric.description.is_empty());
        let counted: usize = report
            .systems
            .iter()
            .map(|s| s.yarns * s.fibers_per_yarn as usize * s.segments_per_fiber)
            .sum();
        assert_eq!(counted, fabric.tile.segments.len());
        assert!(
            report.systems.iter().all(|s| s.bend_ratio > 1.0),
            "folds: {report:?}"
        );
        // The curve cannot turn more at the seam than inside: every joint is a joint of a smooth curve.
        assert!(
            report.largest_joint_deg < 30.0,
            "{}: {report:?}",
            path.display()
        );
    }
}

/// Largest turn at the seam and elsewhere over all fibers, radians.
fn turns(tile: &FiberTile) -> (f64, f64) {
    let (mut seam, mut inside) = (0.0_f64, 0.0_f64);
    for (k, s) in tile.segments.iter().enumerate() {
        let next = &tile.segments[s.next as usize];
        let (a, b) = (
            (s.end - s.start).normalize(),
            (next.end - next.start).normalize(),
        );
        let turn = a.cross(b).length().atan2(a.dot(b));
        if (s.next as usize) < k {
            seam = seam.max(turn);
        } else {
            inside = inside.max(turn);
        }
    }
    (seam, inside)
}

#[test]
fn turns_shrink_with_the_segments_at_the_seam_too() {
    // A C1 curve turns by an angle proportional to the segment length; a kink keeps its angle.
    let coarse = described(&small(&[])).unwrap().tile;
    let fine = described(&small(&[("length_mm = 0.01", "length_mm = 0.001")]))
        .unwrap()
        .tile;
    let ((seam_1, inside_1), (seam_10, inside_10)) = (turns(&coarse), turns(&fine));
    assert!(seam_10 < 0.2 * seam_1, "{seam_1} {seam_10}");
    assert!(inside_10 < 0.2 * inside_1, "{inside_1} {inside_10}");
    // Negative control: a fiber bent by 0.05 rad at the seam is seen.
    let mut kinked = fine.clone();
    let last = kinked.segments[0].previous as usize;
    let s = &mut kinked.segments[last];
    s.start += DVec3::Z * 0.05 * s.start.distance(s.end);
    assert!(turns(&kinked).0 > 0.2 * seam_1);
}

#[test]
fn the_bench_scene_is_as_stated() {
    let fabric = load(Path::new("fabrics/bench_twill22.toml")).unwrap();
    let r = &fabric.report;
    assert_eq!(r.tile_mm, [2.0, 2.0]);
    assert_eq!(r.fibers, 16 * 80);
    assert_eq!(r.fiber_radius_um, [8.0, 8.0]);
    assert!(
        (r.thickness_mm / 0.31 - 1.0).abs() < 0.02,
        "{}",
        r.thickness_mm
    );
    assert!(
        (r.segments as f64 / 130e3 - 1.0).abs() < 0.05,
        "{}",
        r.segments
    );
    assert!(r.closings.is_empty());
    for s in &r.systems {
        assert_eq!((s.yarns, s.twist_per_tile), (8, 2));
    }
}

#[test]
fn crowns_and_sides_follow_the_draft() {
    // One straight fiber per yarn lies on the center line up to its own offset (0: no radius left after full migration).
    let draft = ["1100", "0111", "0011", "1001"];
    let text = small(&[
        (
            "pattern = \"2/1 twill\"",
            "draft = [\"1100\", \"0111\", \"0011\", \"1001\"]",
        ),
        ("fibers = 5", "fibers = 1"),
        ("yarn_radius_mm = 0.06", "yarn_radius_mm = 0.0001"),
        ("crown_mm = 0.06", "crown_mm = 0.05"),
    ]);
    let fabric = described(&text).unwrap();
    let list = curves(&fabric.tile);
    assert_eq!(list.len(), 8);
    for (k, curve) in list.iter().enumerate() {
        let (warp, number) = (k < 4, k % 4);
        for cell in 0..4 {
            let at = (cell as f64 + 0.5) * 0.3;
            let along = |p: &DVec3| if warp { p.y } else { p.x };
            let point = curve
                .points
                .iter()
                .min_by(|a, b| (along(a) - at).abs().total_cmp(&(along(b) - at).abs()))
                .unwrap();
            let (row, column) = if warp { (cell, number) } else { (number, cell) };
            let warp_up = draft[row].as_bytes()[column] == b'1';
            assert_eq!(
                point.z > 0.0,
                warp_up == warp,
                "yarn {k} cell {cell}: {point}"
            );
        }
        let highest = curve.points.iter().map(|p| p.z).fold(f64::MIN, f64::max);
        assert!((highest - 0.05).abs() < 3e-4, "{highest}");
    }
}

#[test]
fn twist_is_a_right_handed_helix_and_the_seed_decides() {
    let straight = small(&[
        ("crown_mm = 0.06", "crown_mm = 0.0"),
        ("jitter = 0.1", "jitter = 0.0"),
    ]);
    let tile = described(&straight).unwrap().tile;
    for curve in curves(&tile) {
        // Signed angle swept around the mean axis.
        let n = curve.points.len() - 1;
        let axis = curve.points[n] - curve.points[0];
        let center = curve.points[..n].iter().sum::<DVec3>() / n as f64;
        let across = |p: DVec3| {
            let d = p - center;
            d - axis * (d.dot(axis) / axis.length_squared())
        };
        let swept: f64 = curve
            .points
            .windows(2)
            .map(|w| {
                let (a, b) = (across(w[0]), across(w[1]));
                a.cross(b).dot(axis.normalize()).atan2(a.dot(b))
            })
            .sum();
        assert!(
            (swept / std::f64::consts::TAU - 2.0).abs() < 1e-9,
            "{swept}"
        );
    }
    assert_eq!(described(&straight).unwrap().tile, tile);
    let other = described(&straight.replace("seed = 3", "seed = 4")).unwrap();
    assert_ne!(other.tile, tile);
}

#[test]
fn chord_errors_are_kept() {
    let text = small(&[("length_mm = 0.01", "chord_error_um = 0.05")]);
    let report = described(&text).unwrap().report;
    let error = report.chord_error_um.unwrap();
    assert!(error <= 0.05 && error > 0.02, "{error}");
}

#[test]
fn rates_that_do_not_close_are_rounded_and_reported() {
    let text = small(&[("twist_per_tile = 2", "twist_per_mm = 1.9")]);
    let report = described(&text).unwrap().report;
    assert_eq!(report.closings.len(), 2);
    assert!((report.closings[0].asked_per_tile - 1.71).abs() < 1e-12);
    assert_eq!(report.closings[0].used_per_tile, 2);
    assert!(report.notes.iter().any(|n| n.contains("rounded to 2")));
}

#[test]
fn amounts_agree_with_hand_calculation() {
    // Straight untwisted fibers: lengths, volumes and masses are products.
    let text = small(&[
        ("crown_mm = 0.06", "crown_mm = 0.0\ndensity_g_cm3 = 1.5"),
        ("twist_per_tile = 2", "twist_per_tile = 0"),
        ("migration_per_tile = 1", "migration_per_tile = 0"),
    ]);
    let r = described(&text).unwrap().report;
    let per_area = 2.0 * 5.0 / 0.3;
    assert!((r.fiber_length_per_mm2 - per_area).abs() < 1e-9);
    let volume = per_area * std::f64::consts::PI * 0.01 * 0.01;
    assert!((r.mass_g_per_m2.unwrap() - 1.5e3 * volume).abs() < 1e-9);
    assert!((r.fiber_volume_fraction - volume / r.thickness_mm).abs() < 1e-12);
    assert!(r.systems.iter().all(|s| s.crimp.abs() < 1e-12));
}

#[test]
fn interpenetration_is_reported_not_mended() {
    let apart = described(&small(&[])).unwrap().report;
    let pressed = described(&small(&[("crown_mm = 0.06", "crown_mm = 0.02")]))
        .unwrap()
        .report;
    let (a, b) = (apart.yarn_overlap.unwrap(), pressed.yarn_overlap.unwrap());
    assert!(a < 0.1 && b > 0.2 && b < 1.0, "{a} {b}");
    assert!(
        pressed
            .notes
            .iter()
            .any(|n| n.contains("run into each other"))
    );
    // Two straight crossing cylinders of equal radius r: the shared volume is 16 r^3 / 3 (Steinmetz).
    let crossed = described(&small(&[("crown_mm = 0.06", "crown_mm = 0.0")]))
        .unwrap()
        .report;
    let r: f64 = 0.06;
    let exact = 2.0 * 16.0 / 3.0 * r.powi(3) / (2.0 * std::f64::consts::PI * r * r * 0.3);
    let found = crossed.yarn_overlap.unwrap();
    assert!((found / exact - 1.0).abs() < 0.02, "{found} {exact}");
}

#[test]
fn senseless_descriptions_are_refused_with_place_and_hint() {
    let refused = |from: &str, to: &str, expected: &str| {
        let message = described(&small(&[(from, to)])).unwrap_err();
        assert!(message.contains(expected), "{to}: {message}");
    };
    refused("fibers = 5", "fibers = 0", "fabric would be empty");
    refused(
        "fibers = 5",
        "fibers = 4000000000",
        "fibers: expected at most",
    );
    refused("fibers = 5", "fibers = -1", "line 8");
    refused(
        "fiber_radius_um = 10.0",
        "fiber_radius_um = -1.0",
        "fiber_radius_um = -1",
    );
    refused(
        "fiber_radius_um = 10.0",
        "fiber_radius_um = nan",
        "fiber_radius_um = NaN",
    );
    refused("pitch_mm = 0.3", "pitch_mm = inf", "pitch_mm = inf");
    refused(
        "crown_mm = 0.06",
        "crown_mm = 0.06\ncrown_angle_deg = 91.0",
        "crown_angle_deg = 91",
    );
    refused("repeats = [1, 1]", "repeats = [0, 1]", "repeats");
    refused(
        "repeats = [1, 1]",
        "repeats = [100000000, 1]",
        "fibers: expected at most",
    );
    refused(
        "length_mm = 0.01",
        "length_mm = 0.00001",
        "segments: expected at most",
    );
    refused("length_mm = 0.01", "chord_error_um = 0.0", "chord_error_um");
    refused(
        "pattern = \"2/1 twill\"",
        "pattern = \"knit\"",
        "hint: known weaves",
    );
    refused(
        "pattern = \"2/1 twill\"",
        "draft = [\"11\", \"10\"]",
        "not woven in",
    );
    refused(
        "yarn_radius_mm = 0.06",
        "yarn_width_mm = 0.06",
        "yarn_thickness_mm",
    );
    refused("jitter = 0.1", "jiter = 0.1", "unknown field `jiter`");
    refused(
        "twist_per_tile = 2",
        "twist_per_tile = 2\ntwist_per_mm = 1.0",
        "at most one of",
    );
    let missing = load(Path::new("fabrics/none.toml")).unwrap_err().report();
    assert!(
        missing.starts_with("fabric fabrics/none.toml cannot be read"),
        "{missing}"
    );
}
