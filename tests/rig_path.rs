//! Promise: every way the planner hands out stays inside the limits and clear of everything, whatever is ahead of what,
//! and takes up the play of gears.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

#[path = "common/small_rig.rs"]
mod small_rig;

use goniofit::base::Unwatched;
use goniofit::math::Random;
use goniofit::rig::simulated::{in_process_connection, model_options};
use goniofit::rig::{
    Axis, AxisAngles, AxisLimits, AxisName, Body, Carrier, Clock, ControllerLimits, Leg, Protocol,
    Rig, RigDescription,
};
use small_rig::{SmallRig, board, capsule, driven, margin, sphere};
use std::path::PathBuf;
use std::time::Instant;

fn rig(name: &str) -> RigDescription {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    RigDescription::read(&root.join(format!("rig_configs/{name}.toml"))).unwrap()
}

fn seed() -> u64 {
    std::env::var("SEED").map_or(2015, |s| s.parse().unwrap())
}

// ---- an independent checker ----------------------------------------------------------------------------------------

type Point = [f64; 3];

fn rotated(p: Point, plane: [usize; 2], degrees: f64) -> Point {
    let (s, c) = degrees.to_radians().sin_cos();
    let mut q = p;
    q[plane[0]] = c * p[plane[0]] - s * p[plane[1]];
    q[plane[1]] = s * p[plane[0]] + c * p[plane[1]];
    q
}

/// A point of a body in the laboratory: tipped from z toward x, then turned from x toward y.
fn in_laboratory(p: Point, on: Carrier, at: &AxisAngles) -> Point {
    let (elevation, azimuth) = match on {
        Carrier::Base => (0.0, 0.0),
        Carrier::Turntable => (0.0, at.0[4]),
        Carrier::CameraAzimuth => (0.0, at.0[1]),
        Carrier::Camera => (at.0[0], at.0[1]),
        Carrier::LightAzimuth => (0.0, at.0[3]),
        Carrier::Light => (at.0[2], at.0[3]),
    };
    rotated(rotated(p, [2, 0], elevation), [0, 1], azimuth)
}

fn to_piece(p: Point, a: Point, b: Point) -> f64 {
    let way: Point = std::array::from_fn(|k| b[k] - a[k]);
    let length2: f64 = way.iter().map(|w| w * w).sum();
    let dot: f64 = (0..3).map(|k| (p[k] - a[k]) * way[k]).sum();
    let t = if length2 > 0.0 {
        (dot / length2).clamp(0.0, 1.0)
    } else {
        0.0
    };
    (0..3)
        .map(|k| (a[k] + t * way[k] - p[k]).powi(2))
        .sum::<f64>()
        .sqrt()
}

/// The distance from a point that runs along one piece to the other piece is convex: narrowed down in thirds.
fn naive_distance(one: &Body, other: &Body, at: &AxisAngles) -> f64 {
    let place = |p, body: &Body| in_laboratory(p, body.on, at);
    let (a, b) = (place(one.from_mm, one), place(one.to_mm, one));
    let (c, d) = (place(other.from_mm, other), place(other.to_mm, other));
    let f = |t: f64| to_piece(std::array::from_fn(|k| a[k] + t * (b[k] - a[k])), c, d);
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..50 {
        let third = (high - low) / 3.0;
        if f(low + third) < f(high - third) {
            high -= third;
        } else {
            low += third;
        }
    }
    f(0.5 * (low + high)).min(f(0.0)).min(f(1.0)) - one.radius_mm - other.radius_mm
}

fn naive_nearest(rig: &RigDescription, at: &AxisAngles) -> f64 {
    let bodies = &rig.clearance.as_ref().unwrap().bodies;
    let mut least = f64::INFINITY;
    for (i, one) in bodies.iter().enumerate() {
        for other in &bodies[..i] {
            let touching =
                one.may_touch.contains(&other.name) || other.may_touch.contains(&one.name);
            if one.on != other.on && !touching {
                least = least.min(naive_distance(one, other, at));
            }
        }
    }
    least
}

/// Which axes keep step with each other.
fn paces(rig: &RigDescription) -> [usize; 5] {
    AxisName::ALL.map(|name| match rig.axis(name) {
        Axis::Motor(m) => {
            let index = rig.boards.iter().position(|b| b.name == m.board).unwrap();
            match rig.boards[index].protocol {
                Protocol::Grbl => index,
                Protocol::Zaber => 100 + name as usize,
            }
        }
        Axis::Fixed { .. } => 99,
    })
}

/// What is wrong with a way, as far as dense looks at it tell.
fn fault(
    rig: &RigDescription,
    from: &AxisAngles,
    to: &AxisAngles,
    legs: &[Leg],
    looks: usize,
    random: &mut Random,
) -> Option<String> {
    let margin = rig.clearance.as_ref().unwrap().margin_mm;
    let paces = paces(rig);
    let mut last = *from;
    for (n, leg) in legs.iter().enumerate() {
        for look in 0..=looks {
            // In step first, then every group at its own progress, often at one of its ends.
            let common = look as f64 / looks as f64;
            let mut progress = [0.0; 200];
            for p in &mut progress {
                *p = match (look % 2, (4.0 * random.uniform()) as u32) {
                    (0, _) => common,
                    (_, 0) => 0.0,
                    (_, 1) => 1.0,
                    _ => random.uniform(),
                };
            }
            let at = AxisAngles(std::array::from_fn(|i| {
                last.0[i] + progress[paces[i]] * (leg.to.0[i] - last.0[i])
            }));
            let distance = naive_nearest(rig, &at);
            if distance < margin - 1e-6 {
                return Some(format!("leg {n}: {distance} mm at {at:?}"));
            }
        }
        last = leg.to;
        for name in AxisName::ALL {
            if let Axis::Motor(m) = rig.axis(name)
                && !(m.min_deg..=m.max_deg).contains(&last.get(name))
            {
                return Some(format!("leg {n} ends at {last:?}"));
            }
        }
    }
    for name in AxisName::ALL {
        let Axis::Motor(m) = rig.axis(name) else {
            continue;
        };
        if (last.get(name) - to.get(name)).abs() > m.tolerance_deg {
            return Some(format!("the way ends at {last:?}, not at {to:?}"));
        }
        // The motor pulls the load through a gap: how far it leads, from 0 to the whole gap.
        let gap = m.backlash_deg;
        let (mut lead, mut motor) = (gap, from.get(name));
        for leg in legs {
            let step = (leg.to.get(name) - motor) * m.approach;
            lead = (lead + step).clamp(0.0, gap);
            motor = leg.to.get(name);
        }
        if lead < gap - 1e-6 {
            return Some(format!(
                "{} ends with {lead} of {gap} degrees taken up",
                name.name()
            ));
        }
    }
    None
}

// ---- random rigs ---------------------------------------------------------------------------------------------------

fn between(random: &mut Random, low: f64, high: f64) -> f64 {
    low + (high - low) * random.uniform()
}

fn random_rig(random: &mut Random) -> RigDescription {
    loop {
        let protocol = |random: &mut Random| ["grbl", "zaber"][(2.0 * random.uniform()) as usize];
        let kinds = [protocol(random), protocol(random)];
        let boards = board("p", kinds[0]) + &board("q", kinds[1]);
        let axes: [String; 5] = std::array::from_fn(|i| {
            let on = if i == 0 {
                0
            } else if i == 2 {
                1
            } else {
                (2.0 * random.uniform()) as usize
            };
            let letter = if kinds[on] == "grbl" {
                "XYZAB"
            } else {
                "12345"
            }
            .chars()
            .nth(i)
            .unwrap();
            let (low, high) = if i % 2 == 0 && i < 4 {
                (between(random, -60.0, 0.0), between(random, 45.0, 85.0))
            } else {
                (between(random, -190.0, -60.0), between(random, 60.0, 190.0))
            };
            let mut keys = driven(["p", "q"][on], letter, low, high);
            if random.uniform() < 0.3 {
                let approach = if random.uniform() < 0.5 { 1 } else { -1 };
                keys += &format!(
                    "backlash_deg = {:?}\napproach = {approach}\n",
                    between(random, 0.1, 3.0)
                );
            }
            keys + &format!("speed_deg_per_s = {:?}\n", between(random, 3.0, 40.0))
        });
        let mut bodies = margin(between(random, 1.0, 10.0));
        let carriers = [
            "base",
            "turntable",
            "camera_azimuth",
            "camera",
            "light_azimuth",
            "light",
        ];
        for (i, on) in carriers.into_iter().enumerate() {
            for part in 0..(2.4 * random.uniform()) as usize + usize::from(i % 2 == 1 && i > 1) {
                let mut point = || -> Point {
                    // Off the vertical, so that turning matters; parts of the arms further out.
                    let out = if i % 2 == 1 && i > 1 { 80.0 } else { 0.0 };
                    [
                        between(random, -70.0, 70.0),
                        between(random, -70.0, 70.0),
                        out + between(random, -40.0, 60.0),
                    ]
                };
                let ends = [point(), point()];
                let (name, radius) = (format!("{on} {part}"), between(random, 2.0, 25.0));
                bodies += &if part == 0 {
                    capsule(&name, on, ends, radius)
                } else {
                    sphere(&name, on, ends[0], radius)
                };
            }
        }
        let small = SmallRig {
            boards,
            axes,
            white: [30.0, 40.0, 30.0, -40.0],
            bodies,
        };
        // Some have bodies that meet at the white geometry.
        if let Ok(rig) = RigDescription::from_toml(&small.text()) {
            return rig;
        }
    }
}

fn random_pose(rig: &RigDescription, random: &mut Random) -> AxisAngles {
    AxisAngles(AxisName::ALL.map(|name| match rig.axis(name) {
        Axis::Motor(m) => between(random, m.min_deg, m.max_deg),
        Axis::Fixed { angle_deg, .. } => *angle_deg,
    }))
}

#[test]
fn every_way_on_random_rigs_is_inside_the_limits_clear_and_free_of_play() {
    let mut random = Random::keyed(&[seed(), 81]);
    let (mut ways, mut detours, mut refused, mut none) = (0, 0, 0, 0);
    let (mut straight_faults, mut slowest) = (0, 0.0_f64);
    for case in 0..60 {
        let rig = random_rig(&mut random);
        let margin = rig.clearance.as_ref().unwrap().margin_mm;
        let mut at = rig.angles(&rig.white.configuration(0)).unwrap();
        for step in 0..50 {
            let mut to = random_pose(&rig, &mut random);
            for i in 0..5 {
                if random.uniform() < 0.3 {
                    to.0[i] = at.0[i];
                }
            }
            let start = Instant::now();
            let planned = rig.path(&at, &to);
            slowest = slowest.max(start.elapsed().as_secs_f64());
            let legs = match planned {
                Ok(legs) => legs,
                Err(error) => {
                    let report = error.report();
                    assert!(report.contains("hint: "), "{report}");
                    if report.starts_with("pose inside") {
                        assert!(naive_nearest(&rig, &to) < margin + 0.011, "{report}");
                        refused += 1;
                    } else if report.starts_with("no free way") {
                        none += 1;
                    } else {
                        assert!(report.starts_with("no room to take up"), "{report}");
                    }
                    continue;
                }
            };
            let found = fault(&rig, &at, &to, &legs, 60, &mut random);
            assert_eq!(
                found, None,
                "case {case}.{step}: {at:?} to {to:?} by {legs:?}\n{}",
                rig.text
            );
            ways += 1;
            detours += usize::from(legs.len() > 1);
            // The control: a straight line to the same place, seen by the same eyes.
            let straight = fault(&rig, &at, &to, &[Leg { to }], 60, &mut random);
            straight_faults += usize::from(straight.is_some_and(|s| s.starts_with("leg")));
            at = legs.last().unwrap().to;
        }
    }
    let counts = format!(
        "{ways} ways, {detours} of several legs, {refused} poses refused, {none} without a way, {straight_faults} straight lines at fault, slowest answer {slowest:.2} s"
    );
    println!("{counts}");
    assert!(ways > 1000 && detours > 200, "{counts}");
    assert!(
        straight_faults > 200,
        "the checker sees too little: {counts}"
    );
    assert!(none * 5 < ways, "{counts}");
}

// ---- by name -------------------------------------------------------------------------------------------------------

#[test]
fn a_detour_is_found_where_the_straight_line_collides() {
    let rig = rig("five_axis_grblhal");
    // The light's arm stands upright at azimuth 350; the low camera would sweep through it.
    let (from, to) = (
        AxisAngles([80.0, 40.0, 0.0, 260.0, 0.0]),
        AxisAngles([80.0, -60.0, 0.0, 260.0, 0.0]),
    );
    let straight = rig.check_leg_clearance(&from, &to).unwrap_err().report();
    assert!(
        straight.contains("'camera") && straight.contains("'light arm'"),
        "{straight}"
    );
    let legs = rig.path(&from, &to).unwrap();
    assert!(legs.len() > 1 && legs.len() < 8, "{legs:?}");
    assert_eq!(legs.last().unwrap().to, to);
    let mut random = Random::keyed(&[seed(), 82]);
    assert_eq!(fault(&rig, &from, &to, &legs, 2000, &mut random), None);
    assert!(fault(&rig, &from, &to, &[Leg { to }], 2000, &mut random).is_some());
    // The way costs more than the straight line would, and says so.
    let [seconds, line] = [&legs, &vec![Leg { to }]].map(|l| rig.legs_seconds(&from, l, None));
    assert!(seconds > line, "{seconds} {line}");
    assert_eq!(rig.path_seconds(&from, &to).unwrap(), seconds);
    assert_eq!(rig.settle_ms_of(&from, &to).unwrap(), 300.0);
}

#[test]
fn where_no_way_leads_past_both_bodies_are_named() {
    let rig = SmallRig::carousel(board("b", "grbl"), "b", "b").rig();
    let (from, to) = (
        AxisAngles([60.0, 90.0, 60.0, -150.0, 0.0]),
        AxisAngles([60.0, 90.0, 60.0, 150.0, 0.0]),
    );
    let error = rig.path(&from, &to).unwrap_err().report();
    for words in [
        "no free way found; on the straight way 'lens' and 'bulb' overlap by",
        "mm, at camera_elevation 60.00, camera_azimuth 90.00, light_elevation 60.00, light_azimuth",
        "hint: put a pose in between",
    ] {
        assert!(error.contains(words), "{error}");
    }
}

#[test]
fn boards_that_do_not_keep_step_go_one_after_the_other() {
    let (from, to) = (
        AxisAngles([60.0, 0.0, 60.0, 60.0, 0.0]),
        AxisAngles([60.0, 90.0, 60.0, 150.0, 0.0]),
    );
    let together = SmallRig::carousel(board("b", "grbl"), "b", "b").rig();
    assert_eq!(together.path(&from, &to).unwrap(), [Leg { to }]);
    let two = board("l", "zaber") + &board("c", "zaber");
    let apart = SmallRig::carousel(two, "l", "c").rig();
    let between = AxisAngles([60.0, 0.0, 60.0, 150.0, 0.0]);
    assert_eq!(
        apart.path(&from, &to).unwrap(),
        [Leg { to: between }, Leg { to }]
    );
}

#[test]
fn what_is_not_a_number_or_outside_or_too_near_is_refused() {
    let rig = SmallRig::carousel(board("b", "grbl"), "b", "b").rig();
    let good = AxisAngles([60.0, 90.0, 60.0, -90.0, 0.0]);
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 171.0, -1e9] {
        let mut pose = good;
        pose.0[1] = bad;
        let error = rig.path(&good, &pose).unwrap_err().report();
        assert!(error.contains("pose outside limits"), "{error}");
        if !bad.is_finite() {
            let error = rig.path(&pose, &good).unwrap_err().report();
            assert!(error.contains("cannot start at camera_azimuth"), "{error}");
        }
    }
    let mut near = good;
    near.0[3] = 80.0;
    let error = rig.path(&good, &near).unwrap_err().report();
    assert!(
        error.contains("pose inside the clearance margin: 'lens' and 'bulb' overlap by 24.9"),
        "{error}"
    );
    let mut upside_down = SmallRig::carousel(board("b", "grbl"), "b", "b");
    upside_down.axes[1] = driven("b", 'X', 10.0, -10.0);
    let error = RigDescription::from_toml(&upside_down.text())
        .unwrap_err()
        .report();
    assert!(
        error.contains("min_deg 10 is not below max_deg -10"),
        "{error}"
    );
}

#[test]
fn from_inside_the_margin_only_the_way_out_is_open() {
    let rig = SmallRig::carousel(board("b", "grbl"), "b", "b").rig();
    // 25 degrees apart the surfaces nearly touch; the margin begins at 30.
    let inside = AxisAngles([60.0, 0.0, 60.0, 25.0, 0.0]);
    assert!(rig.check_pose_clearance(&inside).is_err());
    let away = AxisAngles([60.0, 0.0, 60.0, 120.0, 0.0]);
    assert_eq!(rig.path(&inside, &away).unwrap(), [Leg { to: away }]);
    let through = AxisAngles([60.0, 0.0, 60.0, -120.0, 0.0]);
    let error = rig.path(&inside, &through).unwrap_err().report();
    assert!(error.contains("no free way found"), "{error}");
    // Shut in between the lens and a wall there is no way out by itself.
    let mut small = SmallRig::carousel(board("b", "grbl"), "b", "b");
    small.axes[1] = driven("b", 'X', -1.0, 100.0);
    let outward = 47.0_f64.to_radians();
    let at = 60.0_f64.to_radians().sin() * 100.0;
    small.bodies += &sphere(
        "wall",
        "base",
        [at * outward.cos(), at * outward.sin(), 50.0],
        20.0,
    );
    let shut = AxisAngles([60.0, 0.0, 60.0, 23.5, 0.0]);
    let error = small
        .rig()
        .path(&shut, &AxisAngles([60.0, 90.0, 60.0, -90.0, 0.0]));
    let report = error.unwrap_err().report();
    assert!(
        report.contains("no leg leads away") && report.contains("hint: jog the axes free by hand"),
        "{report}"
    );
}

/// One axis with play, and one without.
fn with_play(approach: i32) -> RigDescription {
    let mut small = SmallRig::carousel(board("b", "grbl"), "b", "b");
    small.axes[1] += &format!("backlash_deg = 2.0\napproach = {approach}\n");
    small.axes[1] += "tolerance_deg = 0.5\n";
    small.bodies = String::new();
    small.rig()
}

#[test]
fn an_axis_with_play_ends_its_way_in_its_direction_of_approach() {
    let rig = with_play(1);
    let pose = |camera, light| AxisAngles([60.0, camera, 60.0, light, 0.0]);
    let legs = |rig: &RigDescription, from, to| -> Vec<AxisAngles> {
        rig.path(&from, &to).unwrap().iter().map(|l| l.to).collect()
    };
    assert_eq!(
        legs(&rig, pose(0.0, 0.0), pose(50.0, 9.0)),
        [pose(50.0, 9.0)]
    );
    assert_eq!(
        legs(&rig, pose(50.0, 9.0), pose(10.0, 0.0)),
        [pose(8.0, 0.0), pose(10.0, 0.0)]
    );
    // The other axis may turn round as it likes; what is off by less than its tolerance stays.
    assert_eq!(
        legs(&rig, pose(50.0, 9.0), pose(50.0, 0.0)),
        [pose(50.0, 0.0)]
    );
    assert_eq!(
        legs(&rig, pose(50.0, 9.0), pose(49.7, 0.0)),
        [pose(50.0, 0.0)]
    );
    assert_eq!(
        legs(&rig, pose(50.0, 9.0), pose(49.7, 9.0)),
        [pose(50.0, 9.0)]
    );
    assert_eq!(
        legs(&rig, pose(50.0, 9.0), pose(49.4, 9.0)),
        [pose(47.4, 9.0), pose(49.4, 9.0)]
    );
    let down = with_play(-1);
    assert_eq!(
        legs(&down, pose(10.0, 0.0), pose(50.0, 0.0)),
        [pose(52.0, 0.0), pose(50.0, 0.0)]
    );
    let error = rig
        .path(&pose(0.0, 0.0), &pose(-169.0, 0.0))
        .unwrap_err()
        .report();
    assert!(
        error.contains("no room to take up the backlash of camera_azimuth")
            && error.contains("it must come from -171.0000, limits -170 to 170")
            && error.contains("hint: "),
        "{error}"
    );
    assert_eq!(
        legs(&down, pose(0.0, 0.0), pose(-170.0, 0.0)),
        [pose(-170.0, 0.0)]
    );
}

#[test]
fn after_a_stop_on_the_way_play_is_taken_up_again() {
    let text = std::fs::read_to_string(
        std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("rig_configs/five_axis_grblhal.toml"),
    )
    .unwrap();
    let text = text.replacen("settle_ms = 300", "settle_ms = 300\nbacklash_deg = 1.0", 1);
    let rig = RigDescription::from_toml(&text).unwrap();
    let to = AxisAngles([10.0, 0.0, 45.0, 180.0, 0.0]);
    // Stopped on the way down from 50, half a degree past the target: the straight way up would end in approach
    // direction with the play still open.
    let from = AxisAngles([9.5, 0.0, 45.0, 180.0, 0.0]);
    assert_eq!(rig.path(&from, &to).unwrap().len(), 1);
    let legs = rig.path_with_slack(&from, &to).unwrap();
    assert!(
        (legs[0].to.0[0] - 9.0).abs() < 1e-9 && legs.len() == 2,
        "{legs:?}"
    );
    // One that stands at its target too.
    let legs = rig.path_with_slack(&to, &to).unwrap();
    assert_eq!(legs.len(), 2, "{legs:?}");
    assert!((legs[0].to.0[0] - 9.0).abs() < 1e-9);
}

#[test]
fn from_the_switches_outside_the_limits_the_way_leads_inside() {
    for name in ["five_axis_grblhal", "two_board_grbl"] {
        let rig = rig(name);
        let home = AxisAngles([-4.0, -99.0, -4.0, -19.0, -9.0]);
        let white = rig.angles(&rig.white.configuration(0)).unwrap();
        assert_eq!(
            rig.path(&home, &white).unwrap(),
            [Leg { to: white }],
            "{name}"
        );
    }
}

// ---- time ----------------------------------------------------------------------------------------------------------

/// Slow controllers, each axis in its own way: what a leg is said to take is what their model takes, plus the driver's
/// own exchanges (some 0.1 s).
#[test]
fn legs_take_the_time_they_are_said_to_take() {
    for name in ["five_axis_grblhal", "two_board_grbl"] {
        let mut rig = rig(name);
        rig.clearance = None;
        let mut limits = ControllerLimits::new();
        let mut models = Vec::new();
        for board in &rig.boards {
            let mut options = model_options(&rig, board);
            for (name, motor) in rig.motors_of(&board.name) {
                let k = name as usize;
                let (speed, acceleration) =
                    ([4.0, 40.0, 3.0, 9.0, 5.0][k], [2.0, 0.9, 0.5, 3.0, 0.8][k]);
                let index = options
                    .flavor
                    .letters()
                    .iter()
                    .position(|l| *l == motor.letter)
                    .unwrap() as u16;
                options.settings.push((110 + index, 60.0 * speed));
                options.settings.push((120 + index, acceleration));
                let own = AxisLimits {
                    travel: None,
                    max_speed: speed,
                    acceleration,
                };
                limits.insert(name, own);
            }
            models.push((board.name.clone(), options));
        }
        for axis in &mut rig.axes {
            if let Axis::Motor(m) = axis {
                m.settle_ms = 0.0;
            }
        }
        let (clock, mut connection) = in_process_connection(models);
        let mut connected = Rig::connect(&rig, &mut connection, &Unwatched).unwrap();
        connected.home(&mut |_| Ok(())).unwrap();
        let mut random = Random::keyed(&[seed(), 83]);
        let mut at = random_pose(&rig, &mut random);
        connected.move_to(&at).unwrap();
        for _ in 0..12 {
            let mut to = random_pose(&rig, &mut random);
            for i in 0..5 {
                if random.uniform() < 0.4 {
                    to.0[i] = at.0[i];
                }
            }
            let said = rig.legs_seconds(&at, &rig.path(&at, &to).unwrap(), Some(&limits));
            let start = clock.now();
            connected.move_to(&to).unwrap();
            let took = clock.now() - start;
            let driver = 0.6;
            assert!(
                (said * 0.99..=said * 1.01 + driver).contains(&took),
                "{name}: said {said}, took {took}, {at:?} to {to:?}"
            );
            at = to;
        }
        // Without the controllers' word only the rig file counts, which is faster here.
        let far = random_pose(&rig, &mut random);
        let legs = rig.path(&at, &far).unwrap();
        assert!(
            rig.legs_seconds(&at, &legs, None) < 0.9 * rig.legs_seconds(&at, &legs, Some(&limits))
        );
    }
}

#[test]
fn an_axis_on_its_own_takes_a_trapezoid() {
    let mut small = SmallRig::carousel(board("b", "grbl"), "b", "b");
    small.axes[1] += "speed_deg_per_s = 8.0\nacceleration_deg_per_s2 = 4.0\n";
    small.axes[3] += "speed_deg_per_s = 5.0\nacceleration_deg_per_s2 = 100.0\n";
    small.bodies = String::new();
    let one = small.rig();
    let pose = |camera, light| AxisAngles([60.0, camera, 60.0, light, 0.0]);
    let seconds = |rig: &RigDescription, to| rig.path_seconds(&pose(0.0, 0.0), &to).unwrap();
    // 80 / 8 of travel and 8 / 4 for starting and stopping; 4 degrees are too short to get to speed.
    assert!((seconds(&one, pose(80.0, 0.0)) - 12.0).abs() < 1e-12);
    assert!((seconds(&one, pose(4.0, 0.0)) - 2.0).abs() < 1e-12);
    // On one line the light's speed and the camera's acceleration hold back both: progress 1/10 per s and 4/50 per s^2.
    assert!((seconds(&one, pose(50.0, 50.0)) - (10.0 + 0.1 / 0.08)).abs() < 1e-12);
    small.boards = board("b", "zaber");
    small.axes[1] = small.axes[1].replace("'X'", "'1'");
    small.axes[3] = small.axes[3].replace("'Y'", "'2'");
    // Each alone: the light takes 10.05 s, the camera 50 / 8 + 2.
    assert!((seconds(&small.rig(), pose(50.0, 50.0)) - 10.05).abs() < 1e-12);
}
