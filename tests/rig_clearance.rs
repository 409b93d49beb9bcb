//! Promise: distances between bodies are those of geometry, in frames as docs/clearance.md draws them, and a leg is
//! called free only when it is.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

#[path = "common/small_rig.rs"]
mod small_rig;

use goniofit::rig::{AxisAngles, Carrier, RigDescription};
use goniofit::session::Plan;
use small_rig::{SmallRig, board, capsule, driven, fixed, margin, sphere};
use std::path::PathBuf;

fn file(path: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(path)
}

/// All axes driven by one board, elevations through the normal, these bodies.
fn with_bodies(bodies: String) -> SmallRig {
    let elevation = |letter| driven("b", letter, -85.0, 85.0);
    let azimuth = |letter| driven("b", letter, -360.0, 360.0);
    SmallRig {
        boards: board("b", "grbl"),
        axes: [
            elevation('X'),
            azimuth('Y'),
            elevation('Z'),
            azimuth('A'),
            azimuth('B'),
        ],
        white: [45.0, 180.0, 0.0, 0.0],
        bodies,
    }
}

fn read(name: &str) -> RigDescription {
    RigDescription::read(&file(name)).unwrap()
}

#[test]
fn rig_files_with_bodies_are_checked_and_without_are_not() {
    let plan = Plan::read(&file("rig_configs/plans/khungurn16.toml")).unwrap();
    for name in [
        "five_axis_grblhal",
        "two_board_grbl",
        "virtual",
        "turntable_only",
    ] {
        let rig = read(&format!("rig_configs/{name}.toml"));
        assert!(rig.clearance_is_checked(), "{name}");
        // The light's front face is where the file says, and no body is in front of it or inside the sample.
        let bodies = &rig.clearance.as_ref().unwrap().bodies;
        let light = bodies.iter().find(|b| b.name == "light").unwrap();
        assert_eq!(light.on, Carrier::Light);
        let front = light.from_mm[2] - light.radius_mm;
        assert!(
            (rig.light.distance_mm - 60.0..=rig.light.distance_mm).contains(&front),
            "{front}"
        );
        if name == "turntable_only" {
            continue;
        }
        // Home, as the model of the board leaves it, is clear; so is every pose of the plan with 10 mm to spare.
        let home = AxisAngles([-4.0, -99.0, -4.0, -19.0, -9.0]);
        for pose in rig.plan_angles(&plan).unwrap().iter().chain([&home]) {
            let nearest = rig.nearest(pose).unwrap();
            assert!(
                nearest.distance_mm > nearest.margin_mm + 10.0,
                "{name}: {nearest}"
            );
            rig.check_pose_clearance(pose).unwrap();
        }
    }
    let text = read("rig_configs/virtual.toml").text;
    let (before, _) = text.split_once("[clearance]").unwrap();
    let bare = RigDescription::from_toml(before).unwrap();
    assert!(!bare.clearance_is_checked());
    let pose = AxisAngles([0.0, 0.0, 0.0, 0.0, 0.0]);
    assert_eq!(bare.nearest(&pose), None);
    bare.check_pose_clearance(&pose).unwrap();
    bare.check_leg_clearance(&pose, &pose).unwrap();
}

#[test]
fn a_rig_file_with_senseless_bodies_is_refused_with_the_place() {
    let good = sphere("lens", "camera", [0.0, 0.0, 100.0], 20.0);
    let cases = [
        (good.clone(), "bodies without a margin"),
        (margin(5.0), "clearance without bodies"),
        (
            margin(0.0) + &good,
            "clearance.margin_mm is 0, expected above 0",
        ),
        (margin(-1.0) + &good, "clearance.margin_mm is -1"),
        (margin(f64::NAN) + &good, "clearance.margin_mm is NaN"),
        (
            margin(5.0) + &good + &good,
            "body 'lens': names must be unique",
        ),
        (
            margin(5.0) + &sphere("", "camera", [0.0; 3], 1.0),
            "body '': names must be unique and not empty",
        ),
        (
            margin(5.0) + &sphere("lens", "camera", [0.0; 3], 0.0),
            "body 'lens': radius_mm is 0, expected above 0",
        ),
        (
            margin(5.0) + &sphere("lens", "camera", [0.0; 3], f64::NAN),
            "body 'lens': radius_mm is NaN",
        ),
        (
            margin(5.0) + &sphere("lens", "camera", [0.0, f64::NAN, 0.0], 1.0),
            "body 'lens': a coordinate is NaN",
        ),
        (
            margin(5.0) + &sphere("lens", "lamp", [0.0; 3], 1.0),
            "unknown variant `lamp`",
        ),
        (
            margin(5.0) + &good + "may_touch = ['bulb']\n",
            "body 'lens': may_touch names 'bulb', expected another body",
        ),
        (
            margin(5.0) + &good + "may_touch = ['lens']\n",
            "body 'lens': may_touch names 'lens', expected another body",
        ),
        (
            margin(5.0)
                + &good
                + "capsule = { from_mm = [0, 0, 0], to_mm = [0, 0, 1], radius_mm = 1 }\n",
            "body 'lens': expected exactly one of sphere and capsule",
        ),
        (
            margin(5.0) + "[[bodies]]\nname = 'lens'\non = 'camera'\n",
            "body 'lens': expected exactly one of sphere and capsule",
        ),
        (
            margin(5.0) + &good + "colour = 'red'\n",
            "unknown field `colour`",
        ),
        (
            margin(5.0) + &good + &sphere("bulb", "light_azimuth", [0.0, 0.0, 110.0], 20.0),
            "white reference geometry: pose inside the clearance margin: 'lens' and 'bulb' overlap by 30.00 mm",
        ),
    ];
    for (bodies, expected) in cases {
        let text = with_bodies(bodies).text().replace("NaN", "nan");
        let error = RigDescription::from_toml(&text);
        let report = error.unwrap_err().report();
        assert!(
            report.contains(expected),
            "expected '{expected}' in: {report}"
        );
    }
    with_bodies(margin(5.0) + &good).rig();
}

#[test]
fn carrier_frames_are_those_of_the_drawing() {
    // A body at (10, 20, 30) of its frame, by hand in the laboratory; the other is a fixed point there.
    let body = [10.0, 20.0, 30.0];
    let probe = [1.0, -2.0, 300.0];
    let vectors = |theta: f64, phi: f64| {
        let (st, ct) = theta.to_radians().sin_cos();
        let (sp, cp) = phi.to_radians().sin_cos();
        // Along increasing theta, along increasing phi, from the sample outward.
        [
            [ct * cp, ct * sp, -st],
            [-sp, cp, 0.0],
            [st * cp, st * sp, ct],
        ]
    };
    let pose = AxisAngles([35.0, 20.0, -50.0, 110.0, 77.0]);
    let cases = [
        ("turntable", vectors(0.0, 77.0)),
        ("camera_azimuth", vectors(0.0, 20.0)),
        ("camera", vectors(35.0, 20.0)),
        ("light_azimuth", vectors(0.0, 110.0)),
        ("light", vectors(-50.0, 110.0)),
    ];
    for (on, [x, y, z]) in cases {
        let bodies =
            margin(1.0) + &sphere("part", on, body, 2.0) + &sphere("probe", "base", probe, 3.0);
        let rig = with_bodies(bodies).rig();
        let squares = (0..3).map(|k| {
            let at = body[0] * x[k] + body[1] * y[k] + body[2] * z[k];
            (at - probe[k]).powi(2)
        });
        let expected = squares.sum::<f64>().sqrt() - 5.0;
        let found = rig.nearest(&pose).unwrap().distance_mm;
        assert!((found - expected).abs() < 1e-9, "{on}: {found} {expected}");
    }
}

#[test]
fn parts_of_one_carrier_and_parts_that_may_touch_are_left_alone() {
    let inside = capsule("arm", "camera", [[0.0; 3], [0.0, 0.0, 100.0]], 20.0);
    let lens = sphere("lens", "camera", [0.0, 0.0, 100.0], 20.0);
    let post = sphere("post", "camera_azimuth", [0.0; 3], 20.0);
    let pose = AxisAngles([0.0; 5]);
    let rig = with_bodies(margin(5.0) + &inside + &lens).rig();
    assert_eq!(rig.nearest(&pose), None);
    let touching = "may_touch = ['post']\n";
    for bodies in [
        margin(5.0) + &inside + touching + &post,
        margin(5.0) + &post + &inside + touching,
    ] {
        assert_eq!(with_bodies(bodies).rig().nearest(&pose), None);
    }
    let text = with_bodies(margin(5.0) + &inside + &post).text();
    assert!(RigDescription::from_toml(&text).is_err());
}

/// Distance of the two spheres of a passage, camera at polar angle `theta`, light going by above at 60 degrees.
fn passage(rotation: f64) -> f64 {
    let angle = |a: f64, b: f64, phi: f64| {
        let (a, b, phi) = (a.to_radians(), b.to_radians(), phi.to_radians());
        (a.cos() * b.cos() + a.sin() * b.sin() * phi.cos()).acos()
    };
    2.0 * 100.0 * (angle(60.0, 40.0, rotation) / 2.0).sin() - 20.0
}

#[test]
fn a_leg_is_free_up_to_the_very_margin() {
    // The light turns past the camera: nearest in the middle, at the same azimuth.
    let least = passage(0.0);
    assert!((least - 14.7296).abs() < 1e-3, "{least}");
    let rig = |margin_mm: f64| {
        let bodies = margin(margin_mm)
            + &sphere("lens", "camera", [0.0, 0.0, 100.0], 10.0)
            + &sphere("bulb", "light", [0.0, 0.0, 100.0], 10.0);
        with_bodies(bodies).rig()
    };
    let (from, to) = (
        AxisAngles([40.0, 0.0, 60.0, -80.0, 0.0]),
        AxisAngles([40.0, 0.0, 60.0, 93.0, 0.0]),
    );
    rig(least - 1e-3).check_leg_clearance(&from, &to).unwrap();
    let error = rig(least + 1e-3)
        .check_leg_clearance(&from, &to)
        .unwrap_err();
    let report = error.report();
    assert!(
        report.contains("leg inside the clearance margin: 'lens' and 'bulb' are 14.7")
            && report.contains(
                "camera_elevation 40.00, camera_azimuth 0.00, light_elevation 60.00, light_azimuth"
            )
            && report.contains("hint: "),
        "{report}"
    );
    // A needle's eye that coarse sampling steps over: contact for less than a thousandth of the way.
    let narrow = passage(0.08);
    assert!(rig(narrow).check_leg_clearance(&from, &to).is_err());
    // Ending where bodies are just far enough is fine, ending a hundredth degree further is not.
    let near = AxisAngles([40.0, 0.0, 60.0, -20.0, 0.0]);
    let over = AxisAngles([40.0, 0.0, 60.0, -19.0, 0.0]);
    let edge = rig(passage(20.0) - 0.02);
    edge.check_leg_clearance(&from, &near).unwrap();
    assert!(edge.check_leg_clearance(&from, &over).is_err());
}

#[test]
fn what_progresses_alone_is_checked_in_every_combination() {
    // Both turn by 90 degrees and keep 60 degrees between them, if they keep step.
    let (from, to) = (
        AxisAngles([60.0, 0.0, 60.0, 60.0, 0.0]),
        AxisAngles([60.0, 90.0, 60.0, 150.0, 0.0]),
    );
    let together = SmallRig::carousel(board("b", "grbl"), "b", "b").rig();
    together.check_leg_clearance(&from, &to).unwrap();
    let two = board("l", "zaber") + &board("c", "zaber");
    let apart = SmallRig::carousel(two, "l", "c").rig();
    let error = apart.check_leg_clearance(&from, &to).unwrap_err().report();
    assert!(error.contains("'lens' and 'bulb' are"), "{error}");
    let mut one = SmallRig::carousel(board("z", "zaber"), "z", "z");
    one.axes[1] = driven("z", '1', -170.0, 170.0);
    one.axes[3] = driven("z", '2', -170.0, 170.0);
    assert!(one.rig().check_leg_clearance(&from, &to).is_err());
    // One at a time, the leading one first, is free.
    let middle = AxisAngles([60.0, 0.0, 60.0, 150.0, 0.0]);
    apart.check_leg_clearance(&from, &middle).unwrap();
    apart.check_leg_clearance(&middle, &to).unwrap();
}

#[test]
fn a_fixed_axis_stands_where_it_is_bolted() {
    let mut small = with_bodies(
        margin(5.0)
            + &sphere("lens", "camera", [0.0, 0.0, 100.0], 10.0)
            + &sphere("bulb", "light", [0.0, 0.0, 100.0], 10.0),
    );
    small.axes[0] = fixed(0.0);
    let at = |light| AxisAngles([0.0, 0.0, light, 0.0, 0.0]);
    let rig = small.rig();
    let found = rig.nearest(&at(60.0)).unwrap();
    assert!((found.distance_mm - 80.0).abs() < 1e-9, "{found}");
    assert!(rig.check_pose_clearance(&at(10.0)).is_err());
}
