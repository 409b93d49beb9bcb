//! Promise: the plans of published protocols hold exactly the directions the protocols name, and `plan check` lists the poses
//! a rig cannot reach.
#![allow(clippy::unwrap_used, missing_docs)]

use assert_cmd::Command;
use goniofit::session::protocols::{
    Grid, IRAWAN_EXITANT_DEG, concentric_map, grid, irawan, khungurn16,
};
use goniofit::session::{Configuration, Plan};
use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::{FRAC_PI_4, PI};

fn goniofit(arguments: &[&str]) -> std::process::Output {
    Command::cargo_bin("goniofit")
        .unwrap()
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .args(arguments)
        .output()
        .unwrap()
}

/// Sample-frame directions to a thousandth of a degree: light, camera; azimuth 0 at the normal.
fn directions(c: &Configuration) -> [(i64, i64); 2] {
    [c.light_in_sample(), c.camera_in_sample()].map(|d| {
        let whole = |a: f64| (1e3 * a.to_degrees()).round() as i64;
        let theta = whole(d.theta);
        let phi = if theta == 0 { 0 } else { whole(d.phi) };
        (theta, phi.rem_euclid(360_000))
    })
}

/// The inverse of the concentric map, written from its geometry: the square's ring of half side r, an eighth of a turn at a
/// time.
fn square([r, phi]: [f64; 2]) -> [f64; 2] {
    let eighth = phi / FRAC_PI_4;
    match eighth {
        e if !(1.0..7.0).contains(&e) => {
            let e = if e >= 7.0 { e - 8.0 } else { e };
            [r, r * e]
        }
        e if e < 3.0 => [r * (2.0 - e), r],
        e if e < 5.0 => [-r, r * (4.0 - e)],
        e => [r * (e - 6.0), -r],
    }
}

#[test]
fn the_concentric_map_is_one_to_one_and_shrinks_every_area_by_pi_over_four() {
    let n = 61;
    for i in 0..n {
        for j in 0..n {
            let at = |k: usize| (2 * k + 1) as f64 / n as f64 - 1.0;
            let [p, q] = [at(i), at(j)];
            let [r, phi] = concentric_map([p, q]);
            assert!((0.0..1.0).contains(&r) && (0.0..2.0 * PI).contains(&phi));
            assert!((r - p.abs().max(q.abs())).abs() < 1e-15);
            let back = square([r, phi]);
            assert!(
                (back[0] - p).hypot(back[1] - q) < 1e-12,
                "{p} {q}: {back:?}"
            );
            // Area of a small square around it, by its mapped corners; on the diagonals the map has a kink.
            let h = 1e-5;
            if (p.abs() - q.abs()).abs() < 3.0 * h || r < 0.05 {
                continue;
            }
            let corner = |dp: f64, dq: f64| {
                let [r, phi] = concentric_map([p + dp, q + dq]);
                [r * phi.cos(), r * phi.sin()]
            };
            let corners = [corner(-h, -h), corner(h, -h), corner(h, h), corner(-h, h)];
            let twice: f64 = (0..4)
                .map(|k| {
                    let ([x, y], [u, v]) = (corners[k], corners[(k + 1) % 4]);
                    x * v - u * y
                })
                .sum();
            let ratio = 0.5 * twice / (4.0 * h * h);
            assert!((ratio - FRAC_PI_4).abs() < 1e-6, "{p} {q}: {ratio}");
        }
    }
    assert!((concentric_map([-1.0, 1.0])[0] - 1.0).abs() < 1e-15);
    assert!(concentric_map([0.0, 0.0])[0].abs() < 1e-15);
}

#[test]
fn irawans_plan_has_each_of_225_directions_once_for_each_of_7() {
    let plan = irawan(75.0).unwrap();
    let ids: Vec<u32> = plan.configurations.iter().map(|c| c.id).collect();
    assert_eq!(ids, (1..=1575).collect::<Vec<u32>>());
    let mut lights: BTreeMap<(i64, i64), BTreeSet<(i64, i64)>> = BTreeMap::new();
    for c in &plan.configurations {
        assert!(c.camera.phi.abs() < 1e-12, "the camera stays at azimuth 0");
        let [light, camera] = directions(c);
        assert!(
            lights.entry(camera).or_default().insert(light),
            "{c:?} twice"
        );
    }
    let expected: BTreeSet<(i64, i64)> = IRAWAN_EXITANT_DEG
        .iter()
        .map(|[t, p]| ((1e3 * t) as i64, (1e3 * p) as i64))
        .collect();
    assert_eq!(lights.keys().copied().collect::<BTreeSet<_>>(), expected);
    let first = lights.values().next().unwrap();
    for set in lights.values() {
        assert_eq!(set, first, "the same directions for every camera");
    }
    // Rings of the square become rings of the disk: 1, 8, 16, ... 56 directions at 0, 10, ..., 70 degrees.
    let mut rings: BTreeMap<i64, usize> = BTreeMap::new();
    for (theta, _) in first {
        *rings.entry(*theta).or_default() += 1;
    }
    let expected: BTreeMap<i64, usize> = (0..8)
        .map(|k| (10_000 * k, if k == 0 { 1 } else { 8 * k as usize }))
        .collect();
    assert_eq!(rings, expected);
    // Half a turn about the normal takes the directions onto themselves.
    for (theta, phi) in first {
        let turned = if *theta == 0 {
            0
        } else {
            (phi + 180_000) % 360_000
        };
        assert!(first.contains(&(*theta, turned)), "{theta} {phi}");
    }
}

#[test]
fn plans_survive_their_file_and_bad_ones_are_refused() {
    for plan in [irawan(60.0).unwrap(), khungurn16().unwrap()] {
        let back = Plan::from_toml(&plan.to_toml().unwrap()).unwrap();
        assert_eq!(back.configurations.len(), plan.configurations.len());
        for (a, b) in plan.configurations.iter().zip(&back.configurations) {
            assert_eq!(a.id, b.id);
            assert_eq!(directions(a), directions(b));
        }
    }
    for bad in [0.0, -3.0, 91.0, f64::NAN] {
        let error = irawan(bad).unwrap_err().report();
        assert!(error.contains("expected 0 < angle <= 90"), "{error}");
    }
}

#[test]
fn a_grid_is_every_light_with_every_camera() {
    let wanted = Grid {
        light_theta_deg: vec![0.0, 30.0, 60.0],
        light_phi_deg: vec![0.0, 90.0, -90.0],
        camera_theta_deg: vec![45.0],
        camera_phi_deg: vec![0.0, 20.0],
    };
    let plan = grid(&wanted).unwrap();
    let found: BTreeSet<_> = plan.configurations.iter().map(directions).collect();
    let mut expected = BTreeSet::new();
    for camera_phi in [0, 20_000] {
        expected.insert([(0, 0), (45_000, camera_phi)]);
        for theta in [30_000, 60_000] {
            for phi in [0, 90_000, 270_000] {
                expected.insert([(theta, phi), (45_000, camera_phi)]);
            }
        }
    }
    assert_eq!((plan.configurations.len(), found), (14, expected));
    let error = |g: Grid| grid(&g).unwrap_err().report();
    let bad = Grid {
        light_theta_deg: vec![90.0],
        ..wanted.clone()
    };
    assert!(error(bad).contains("light polar angle 90"));
    let bad = Grid {
        camera_phi_deg: vec![f64::NAN],
        ..wanted.clone()
    };
    assert!(error(bad).contains("camera azimuth NaN"));
    let bad = Grid {
        camera_theta_deg: vec![],
        ..wanted
    };
    assert!(error(bad).contains("no camera directions"));
}

#[test]
fn the_command_prints_and_writes_plans() {
    let out = goniofit(&["plan", "khungurn"]);
    let printed = Plan::from_toml(&String::from_utf8(out.stdout).unwrap()).unwrap();
    let kept = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
    let kept = Plan::read(&kept.join("rig_configs/plans/khungurn16.toml")).unwrap();
    assert_eq!(printed, kept);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("p.toml");
    let name = path.to_str().unwrap();
    let out = goniofit(&["plan", "irawan", "--out", name]);
    assert!(out.status.success(), "{out:?}");
    assert_eq!(Plan::read(&path).unwrap().configurations.len(), 1575);
    let out = goniofit(&["plan", "irawan", "--out", name]);
    assert_eq!(out.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&out.stderr).contains("--force"));
}

#[test]
fn the_check_lists_what_a_rig_cannot_reach() {
    let rig = "rig_configs/five_axis_grblhal.toml";
    let out = goniofit(&[
        "plan",
        "check",
        "rig_configs/plans/khungurn16.toml",
        "--rig",
        rig,
    ]);
    let text = String::from_utf8(out.stdout).unwrap();
    assert_eq!(out.status.code(), Some(0), "{text}");
    assert!(text.contains("reaches 16 of the 16 poses"), "{text}");

    let folder = tempfile::tempdir().unwrap();
    let [plan, kept] = ["p.toml", "kept.toml"].map(|n| folder.path().join(n));
    // One pose with the light beyond its arm's limit, and one that is free.
    let wanted = Grid {
        light_theta_deg: vec![88.0, 60.0],
        light_phi_deg: vec![0.0],
        camera_theta_deg: vec![30.0],
        camera_phi_deg: vec![0.0],
    };
    let both = grid(&wanted).unwrap();
    std::fs::write(&plan, both.to_toml().unwrap()).unwrap();
    let [plan, kept] = [&plan, &kept].map(|p| p.to_str().unwrap());
    let out = goniofit(&["plan", "check", plan, "--rig", rig, "--json", "--out", kept]);
    assert_eq!(out.status.code(), Some(1));
    let told: serde_json::Value = serde_json::from_slice(&out.stdout).unwrap();
    assert_eq!(told["refused"][0]["config"], 1, "{told}");
    assert_eq!(told["reachable"], 1, "{told}");
    assert_eq!(Plan::read(kept.as_ref()).unwrap().configurations.len(), 1);
    // The dry run, which checks the ways too, agrees.
    let dry = |plan: &str| goniofit(&["capture", "--rig", rig, "--plan", plan, "--dry-run"]);
    assert_eq!(dry(plan).status.code(), Some(2));
    assert_eq!(dry(kept).status.code(), Some(0));
}

#[test]
fn turning_all_axes_together_keeps_what_the_sample_sees() {
    let rig = "rig_configs/five_axis_grblhal.toml";
    let folder = tempfile::tempdir().unwrap();
    let [plan, kept] = ["p.toml", "kept.toml"].map(|n| folder.path().join(n));
    let all = irawan(75.0).unwrap();
    std::fs::write(&plan, all.to_toml().unwrap()).unwrap();
    let reached = |more: &[&str]| {
        let mut arguments = vec![
            "plan",
            "check",
            plan.to_str().unwrap(),
            "--rig",
            rig,
            "--json",
        ];
        arguments.extend(more);
        let out = goniofit(&arguments);
        let told: serde_json::Value = serde_json::from_slice(&out.stdout).unwrap();
        told["reachable"].as_u64().unwrap()
    };
    let plain = reached(&[]);
    let turned = reached(&["--turn", "--out", kept.to_str().unwrap()]);
    assert!(plain < 600 && turned > 1200, "{plain} {turned}");
    let kept = Plan::read(&kept).unwrap();
    assert_eq!(kept.configurations.len() as u64, turned);
    for c in &kept.configurations {
        assert_eq!(directions(c), directions(all.configuration(c.id).unwrap()));
    }
}
