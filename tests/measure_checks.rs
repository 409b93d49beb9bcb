//! What is looked at in every crop: each fault is found, and plain cloth gives no message.
#![allow(clippy::unwrap_used, missing_docs)]

use goniofit::math::{PolarDirection, Random};
use goniofit::measure::Picture;
use goniofit::measure::checks::{CheckOptions, CropChecks, blunt_poses, check_crop};
use goniofit::session::{CfaPattern, Configuration, Layout};
use std::f64::consts::TAU;

/// A synthetic crop: plain weave, noise, and what is done to it.
struct Cloth {
    layout: Layout,
    /// Side of the square along x, pixels; along y foreshortened by `tilt`.
    side: f64,
    tilt: f64,
    /// The square is turned by this, radians.
    turn: f64,
    margin: f64,
    /// Pixels per yarn.
    yarn: f64,
    /// Contrast of the weave.
    contrast: f64,
    /// Relative noise at the mean.
    noise: f64,
    seed: u64,
}

const BAYER: Layout = Layout::Bayer(CfaPattern::Rggb);

impl Cloth {
    fn new(layout: Layout, seed: u64) -> Self {
        Self {
            layout,
            side: 200.0,
            tilt: 1.0,
            turn: 0.0,
            margin: 12.0,
            yarn: 9.0,
            contrast: 0.25,
            noise: 0.03,
            seed,
        }
    }

    fn corners(&self) -> [[f64; 2]; 4] {
        let (sin, cos) = self.turn.sin_cos();
        let half = 0.5 * self.side;
        [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]].map(|[u, v]| {
            let (x, y) = (
                half * (cos * u - sin * v),
                self.tilt * half * (sin * u + cos * v),
            );
            [x, y]
        })
    }

    /// Plain weave: over and under by turns, yarns round, each yarn a little brighter or darker.
    fn weave(&self, x: f64, y: f64) -> f64 {
        let (u, v) = (x / self.yarn, y / (self.tilt * self.yarn));
        let over = (u.floor() + v.floor()).rem_euclid(2.0) < 0.5;
        let across = if over {
            u.rem_euclid(1.0)
        } else {
            v.rem_euclid(1.0)
        };
        let number = if over { u.floor() } else { 1e4 + v.floor() };
        let own = hashed(number, 77.0 + self.seed as f64) - 0.5;
        1.0 + self.contrast * (0.3 * own - (TAU * across).cos())
    }

    /// Structure of two pixels' size.
    fn fibers(&self, x: f64, y: f64) -> f64 {
        0.3 * (hashed(
            (x / 2.0).floor() + 7919.0 * (y / 2.0).floor(),
            self.seed as f64,
        ) - 0.5)
    }

    /// The crop; `change` maps brightness at (x, y), pixels from the square's middle.
    fn picture(&self, change: impl Fn(f64, f64, f64) -> f64) -> Picture {
        let corners = self.corners();
        let reach = |k: usize| corners.iter().map(|c| c[k]).fold(0.0, f64::max) + self.margin;
        let middle = [0, 1].map(|k| reach(k).ceil());
        let size = middle.map(|m| 2 * m as usize);
        let origin = [340, 512];
        let per_pixel = self.layout.values_per_pixel();
        let mut random = Random::keyed(&[self.seed, 5]);
        let color = [0.5, 0.8, 0.3];
        let (mut values, mut noise, mut covered) = (Vec::new(), Vec::new(), Vec::new());
        for y in 0..size[1] {
            for x in 0..size[0] {
                let at = [x as f64 - middle[0] + 0.5, y as f64 - middle[1] + 0.5];
                let bright = change(at[0], at[1], self.weave(at[0], at[1]));
                for k in 0..per_pixel {
                    let channel = match self.layout {
                        Layout::Bayer(cfa) => cfa.channel(y, x),
                        Layout::Mono => 1,
                        Layout::Rgb => k,
                    };
                    let value = color[channel] * bright;
                    let sigma = color[channel] * self.noise * bright.abs().sqrt().max(0.2);
                    values.push((value + sigma * random.normal()) as f32);
                    noise.push(sigma as f32);
                }
                covered.push(coverage(&corners, at) as f32);
            }
        }
        Picture {
            origin,
            size,
            layout: self.layout,
            kept: vec![true; values.len()],
            values,
            noise,
            covered,
            corners: corners
                .iter()
                .map(|c| [0, 1].map(|k| c[k] + middle[k] + origin[k] as f64))
                .collect(),
        }
    }

    fn checked(&self, change: impl Fn(f64, f64, f64) -> f64) -> CropChecks {
        check_crop(&self.picture(change), &CheckOptions::default())
    }
}

/// A number in 0..1 that looks random.
fn hashed(number: f64, key: f64) -> f64 {
    (43758.5453 * (12.9898 * number + 78.233 * key).sin()).rem_euclid(1.0)
}

/// Of a pixel with this middle, on a 4 x 4 grid.
fn coverage(corners: &[[f64; 2]; 4], at: [f64; 2]) -> f64 {
    let inside = |p: [f64; 2]| {
        (0..4).all(|k| {
            let (a, b) = (corners[k], corners[(k + 1) % 4]);
            (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]) >= 0.0
        })
    };
    let grid = (0..16).map(|i| [i % 4, i / 4].map(|j| (f64::from(j) - 1.5) / 4.0));
    grid.filter(|d| inside([at[0] + d[0], at[1] + d[1]]))
        .count() as f64
        / 16.0
}

fn same(_: f64, _: f64, cloth: f64) -> f64 {
    cloth
}

/// Faults multiply brightness; the lamp's own slope is under each.
fn lamp(x: f64) -> f64 {
    1.0 + 0.05 * x / 200.0
}

const LAYOUTS: [Layout; 3] = [BAYER, Layout::Mono, Layout::Rgb];

/// False alarms: none in 200 crops of four kinds each, so that with 95 % confidence fewer than 0.4 % of such crops give
/// one.
#[test]
fn plain_cloth_gives_no_message() {
    let base: u64 = std::env::var("SEED").map_or(1, |s| s.parse().unwrap());
    let mut alarms = Vec::new();
    for seed in base..base + 200 {
        let mut kinds: Vec<(&str, Cloth)> = Vec::new();
        let layout = LAYOUTS[seed as usize % 3];
        kinds.push(("weave", Cloth::new(layout, seed)));
        kinds.push((
            "turned and tilted",
            Cloth {
                turn: 0.3 + 0.01 * seed as f64,
                tilt: 0.35,
                ..Cloth::new(layout, seed)
            },
        ));
        kinds.push((
            "noise alone",
            Cloth {
                contrast: 0.0,
                noise: 0.5,
                side: 100.0,
                ..Cloth::new(layout, seed)
            },
        ));
        kinds.push((
            "coarse, strong weave",
            Cloth {
                yarn: 23.0 + 0.1 * (seed % 50) as f64,
                contrast: 0.6,
                noise: 0.01,
                side: 160.0,
                ..Cloth::new(layout, seed)
            },
        ));
        for (name, cloth) in kinds {
            let messages = cloth
                .checked(|x, _, c| c * lamp(x))
                .messages("configuration 3");
            if !messages.is_empty() {
                alarms.push(format!("{name}, seed {seed}, {layout}: {messages:?}"));
            }
        }
    }
    assert!(
        alarms.is_empty(),
        "{} alarms:\n{}",
        alarms.len(),
        alarms.join("\n")
    );
}

fn one(messages: &[String], words: &[&str]) {
    let found = messages
        .iter()
        .filter(|m| words.iter().all(|w| m.contains(w)))
        .count();
    assert!(
        found == 1 && messages.len() == 1,
        "{words:?} in {messages:?}"
    );
}

#[test]
fn a_glint_is_found_where_it_is() {
    for layout in LAYOUTS {
        for seed in 0..10 {
            let glint = |x: f64, y: f64, c: f64| {
                let near = (x - 30.0).hypot(y + 50.0) < 2.5;
                lamp(x) * if near { 6.0 } else { c }
            };
            let checks = Cloth::new(layout, seed).checked(glint);
            assert_eq!(checks.bright.spots, 1, "{layout} {seed}: {checks:?}");
            let region = checks.bright.largest.unwrap();
            // The middle of the square lies at pixel (340, 512) + 112 of the visible area.
            let (x, y) = (
                region.x as f64 + 0.5 * region.width as f64,
                region.y as f64 + 0.5 * region.height as f64,
            );
            assert!(
                (x - 482.0).abs() < 2.0 && (y - 574.0).abs() < 2.0,
                "{region:?}"
            );
            assert!((4..=7).contains(&region.width), "{region:?}");
            // 20 pixels of 40 000, five times too bright.
            assert!(
                (0.001..0.004).contains(&checks.bright.share[1]),
                "{:?}",
                checks.bright.share
            );
            one(
                &checks.messages("configuration 3"),
                &["configuration 3", "a spot brighter", "pixels x"],
            );
        }
    }
}

#[test]
fn dust_is_found_on_a_weave_with_dark_gaps() {
    for layout in LAYOUTS {
        for seed in 0..10 {
            let dust = |x: f64, y: f64, c: f64| {
                if (x + 61.0).hypot(y - 20.0) < 14.0 {
                    0.25
                } else {
                    c
                }
            };
            let cloth = Cloth {
                contrast: 0.6,
                ..Cloth::new(layout, seed)
            };
            let checks = cloth.checked(dust);
            assert!(checks.dark.pixels > 150, "{layout} {seed}: {checks:?}");
            assert!(checks.dark.share[0] < -0.003, "{:?}", checks.dark.share);
            let region = checks.dark.largest.unwrap();
            assert!(
                region.x < 391 && region.x + region.width > 391,
                "{region:?}"
            );
            assert!(
                region.y < 644 && region.y + region.height > 644,
                "{region:?}"
            );
            let messages = checks.messages("configuration 3");
            assert!(messages.iter().any(|m| m.contains("dust")), "{messages:?}");
        }
    }
}

/// A shadow of 10 % over the outer quarter, its edge soft over 10 pixels, at three angles.
#[test]
fn a_shadow_is_found_at_any_angle() {
    for (angle, part) in [(0.0, "right"), (0.8, "bottom right"), (2.2, "bottom left")] {
        for layout in LAYOUTS {
            for seed in 0..10 {
                let (sin, cos) = f64::sin_cos(angle);
                let shadow = |x: f64, y: f64, c: f64| {
                    let along = cos * x + sin * y;
                    let dark = ((along - 45.0) / 10.0).clamp(0.0, 1.0);
                    c * lamp(x) * (1.0 - 0.1 * dark)
                };
                let cloth = Cloth {
                    yarn: 5.0,
                    ..Cloth::new(layout, seed)
                };
                let checks = cloth.checked(shadow);
                let Some(step) = checks.evenness.step.clone() else {
                    panic!("{angle} {layout} {seed}: {checks:?}");
                };
                assert_eq!(step.part, part, "{layout} {seed}: {step:?}");
                assert!((-0.13..-0.07).contains(&step.depth), "{step:?}");
                assert!((0.1..0.4).contains(&step.fraction), "{step:?}");
                // Dark yarns in the shadow may pass for dust.
                let messages = checks.messages("frame 12");
                let words = ["frame 12", part, "darker", "shadow"];
                assert!(
                    messages.iter().any(|m| words.iter().all(|w| m.contains(w))),
                    "{messages:?}"
                );
            }
        }
    }
}

#[test]
fn a_bright_patch_in_the_middle_and_a_steep_slope_are_told() {
    for seed in 0..10 {
        let patch = |x: f64, y: f64, c: f64| c * if x.hypot(y + 10.0) < 45.0 { 1.12 } else { 1.0 };
        let fine = Cloth {
            yarn: 5.0,
            ..Cloth::new(BAYER, seed)
        };
        let checks = fine.checked(patch);
        let step = checks.evenness.step.unwrap();
        assert!(
            step.part == "middle" && (0.06..0.14).contains(&step.depth),
            "{step:?}"
        );
        let slope = fine.checked(|x, _, c| c * (1.0 + 0.15 * x / 200.0));
        one(
            &slope.messages("configuration 3"),
            &["varies by 1", "soft shadow"],
        );
    }
}

#[test]
fn the_samples_edge_is_found_in_the_ring_and_too_small_a_margin_is_said() {
    for layout in LAYOUTS {
        for (seed, turn) in [(1, 0.0), (2, 0.4), (3, 0.0), (4, 1.0)] {
            let cloth = Cloth {
                turn,
                ..Cloth::new(layout, seed)
            };
            let reach = cloth.corners().iter().map(|c| c[0]).fold(0.0, f64::max);
            // Ends 2 pixels beyond the square's rightmost point and runs along its side where it is not turned.
            let edge = if turn > 0.0 { reach - 6.0 } else { reach + 2.0 };
            let ended = cloth.checked(|x, _, c| if x > edge { 0.1 } else { c });
            assert!(!ended.border.too_small, "{:?}", ended.border);
            let whole = cloth.checked(same);
            assert!(whole.border.ends.is_empty(), "{:?}", whole.border);
            if turn > 0.0 {
                continue;
            }
            assert_eq!(ended.border.ends.len(), 4, "{:?}", ended.border);
            assert!(
                ended
                    .border
                    .ends
                    .iter()
                    .all(|e| e.change < -0.5 && e.region.x >= 552)
            );
            one(
                &ended.messages("configuration 3"),
                &["darker than inside", "center the sample"],
            );
        }
    }
    let narrow = Cloth {
        margin: 1.0,
        ..Cloth::new(BAYER, 1)
    };
    let checks = narrow.checked(same);
    assert!(checks.border.too_small && checks.border.ends.is_empty());
}

/// Blurred by a box that reaches this many pixels, which may depend on y.
fn blurred(cloth: &Cloth, reach: impl Fn(f64) -> i32) -> CropChecks {
    cloth.checked(|x, y, _| {
        let r = reach(y);
        let mut sum = 0.0;
        for i in -r..=r {
            for j in -r..=r {
                let (x, y) = (x + f64::from(i), y + f64::from(j));
                sum += cloth.weave(x, y) + cloth.fibers(x, y);
            }
        }
        sum / f64::from((2 * r + 1) * (2 * r + 1))
    })
}

#[test]
fn a_defocused_far_third_is_told_and_noise_is_not_taken_for_sharpness() {
    for layout in LAYOUTS {
        for seed in 0..4 {
            let cloth = Cloth {
                yarn: 16.0,
                ..Cloth::new(layout, seed)
            };
            let far = blurred(&cloth, |y| if y < -33.0 { 2 } else { 0 });
            assert_eq!(far.focus.blunt, Some(0), "{layout} {seed}: {:?}", far.focus);
            one(&far.messages("configuration 3"), &["far third", "focus"]);
            // Sharpness needs structure of the pixels' size: fibers.
            let fine = Cloth {
                contrast: 0.0,
                noise: 0.005,
                ..cloth
            };
            let (sharp, blunt) = (blurred(&fine, |_| 0), blurred(&fine, |_| 4));
            let ratio = blunt.focus.sharpness.unwrap() / sharp.focus.sharpness.unwrap();
            assert!(ratio < 0.4, "{layout}: {ratio}");
            assert_eq!(blunt.focus.blunt, None);
        }
    }
    let noise = Cloth {
        contrast: 0.0,
        noise: 0.5,
        ..Cloth::new(Layout::Mono, 1)
    };
    assert_eq!(noise.checked(same).focus.sharpness, None);
}

#[test]
fn a_blunt_pose_is_told_among_its_neighbors_only() {
    let pose = |id, theta: f64| Configuration {
        id,
        light: PolarDirection::from_degrees(30.0, 180.0),
        camera: PolarDirection::from_degrees(theta, 0.0),
        rotation: 0.0,
    };
    let mut poses: Vec<(Configuration, Option<f64>)> = [0.30, 0.31, 0.09, 0.28]
        .iter()
        .enumerate()
        .map(|(i, s)| (pose(i as u32, 48.0), Some(*s)))
        .collect();
    poses.push((pose(9, 80.0), Some(0.05)));
    poses.push((pose(10, 80.0), None));
    let told = blunt_poses(&poses, 0.4);
    assert!(
        told.len() == 1 && told[0].starts_with("configuration 2: "),
        "{told:?}"
    );
}

#[test]
fn vignetting_is_told_beyond_its_limit() {
    let picture = Cloth::new(BAYER, 1).picture(same);
    let with = |v| CheckOptions {
        vignetting: Some(v),
        ..CheckOptions::default()
    };
    assert!(check_crop(&picture, &with(1.1)).messages("c").is_empty());
    one(
        &check_crop(&picture, &with(1.4)).messages("c"),
        &["vignetting", "1.40"],
    );
}

/// Nothing to look at is no fault, and no panic.
#[test]
fn empty_tiny_and_dark_crops_are_survived() {
    for layout in LAYOUTS {
        let empty = Picture {
            origin: [0, 0],
            size: [0, 0],
            layout,
            values: Vec::new(),
            noise: Vec::new(),
            kept: Vec::new(),
            covered: Vec::new(),
            corners: Vec::new(),
        };
        assert!(
            check_crop(&empty, &CheckOptions::default())
                .messages("c")
                .is_empty()
        );
        for side in [1.0, 2.0, 5.0, 13.0, 40.0] {
            let cloth = Cloth {
                side,
                margin: 2.0,
                ..Cloth::new(layout, 3)
            };
            assert_eq!(
                cloth.checked(same).messages("c"),
                Vec::<String>::new(),
                "{side}"
            );
            let _ = cloth.checked(|_, _, _| 0.0).messages("c");
            let mut lost = cloth.picture(same);
            lost.kept.fill(false);
            let _ = check_crop(&lost, &CheckOptions::default()).messages("c");
        }
    }
}

/// Processor time of this thread, whatever else the machine does.
fn processor_ms() -> f64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    1e3 * now.tv_sec as f64 + 1e-6 * now.tv_nsec as f64
}

#[test]
#[ignore = "slow: a timing, 1 min; prints milliseconds"]
fn how_long_a_large_crop_takes() {
    for layout in LAYOUTS {
        let cloth = Cloth {
            side: 1000.0,
            ..Cloth::new(layout, 1)
        };
        let picture = cloth.picture(same);
        let times: Vec<f64> = (0..9)
            .map(|_| {
                let begun = processor_ms();
                std::hint::black_box(check_crop(&picture, &CheckOptions::default()));
                processor_ms() - begun
            })
            .collect();
        eprintln!("{layout}: {times:.1?} ms");
    }
}
