//! Promise: a whole session is measured within its stated errors whatever the camera: a mosaic, three values per pixel,
//! monochrome through filters, monochrome without; over a fixed box, too, and in another color space.
#![allow(
    clippy::print_stdout,
    clippy::unwrap_used,
    clippy::float_cmp,
    missing_docs
)]

mod virtual_session;

use goniofit::base::Unwatched;
use goniofit::math::Random;
use goniofit::measure::calibration::{Calibrations, ColorMatrix, Dated, Header, Kind};
use goniofit::measure::{Crop, CropRule, MeasureOptions, MeasureReport, measure_session};
use goniofit::session::{CfaPattern, FrameKind, Layout, Measurements};
use rayon::prelude::*;
use virtual_session::pulls::{pulls, seed, verdict};
use virtual_session::{Purpose, Setup, folder, record};

/// Fades by 8 % in all.
fn colored(x: f64, _: usize) -> [f64; 3] {
    [0.08, 0.07, 0.09].map(|d| 1.0 - d * x)
}

/// By 3 %, hardly at first: nothing tells what the lamp did between the white frames and the last color of the first visit.
fn late(x: f64, _: usize) -> [f64; 3] {
    [0.03, 0.025, 0.035].map(|d| 1.0 - d * x * x)
}

fn colorless(x: f64, _: usize) -> [f64; 3] {
    [1.0 - 0.08 * x; 3]
}

/// A session of this camera under a fading lamp, the reference after every second sample shot.
fn session_of(layout: Layout, seed: u64) -> Setup {
    let mut setup = Setup {
        exposures_ms: vec![16.0, 64.0],
        dark_exposures_ms: vec![16.0, 64.0],
        poses: vec![
            (0.0, 0.0, [0.9, 1.1, 0.7]),
            (48.0, 90.0, [0.3, 0.25, 0.2]),
            (80.0, 90.0, [0.5, 0.4, 0.45]),
        ],
        reference_every: 2,
        white_se: 0.0,
        lamp: Some(colored),
        ..Setup::new(seed)
    };
    setup.sensor.layout = layout;
    setup.dark_sensor.layout = layout;
    setup
}

/// Frame-sequential color.
fn filtered(seed: u64) -> Setup {
    Setup {
        filters: true,
        lamp: Some(late),
        reference_every: 1,
        ..session_of(Layout::Mono, seed)
    }
}

/// Everything gray, as a camera without colors sees it.
fn gray(seed: u64) -> Setup {
    Setup {
        poses: vec![
            (0.0, 0.0, [0.9; 3]),
            (48.0, 90.0, [0.25; 3]),
            (80.0, 90.0, [0.4; 3]),
        ],
        reference_mean: [0.5; 3],
        white_factor: [0.98; 3],
        lamp: Some(colorless),
        ..session_of(Layout::Mono, seed)
    }
}

/// `n` sessions are within their errors; without reference frames, some are not.
fn recovered(n: u64, setup: impl Fn(u64) -> Setup + Sync) {
    let good = verdict(&pulls(n, &setup));
    println!("{good:?}");
    assert!(good.is_ok(), "{good:?}");
    // Negative control: the lamp's fading stays in the numbers.
    let bad = verdict(&pulls(8, |i| Setup {
        reference_every: 0,
        ..setup(1000 + i)
    }));
    println!("{bad:?}");
    assert!(bad.is_err(), "a fading lamp passed: {bad:?}");
}

// 24 sessions of 9 pulls see standard errors that are off by 30 %, and a bias of 0.4 standard errors.

#[test]
fn a_mosaic_is_measured_within_stated_errors() {
    let seed = seed(20_261_201);
    let bayer = Layout::Bayer(CfaPattern::Gbrg);
    recovered(24, |i| session_of(bayer, seed + i));
}

#[test]
fn three_values_per_pixel_are_measured_within_stated_errors() {
    let seed = seed(20_261_202);
    recovered(24, |i| session_of(Layout::Rgb, seed + i));
}

#[test]
fn monochrome_frames_through_filters_are_measured_within_stated_errors() {
    let seed = seed(20_261_203);
    recovered(24, |i| filtered(seed + i));
}

#[test]
fn monochrome_frames_without_a_filter_are_measured_within_stated_errors() {
    let seed = seed(20_261_204);
    recovered(24, |i| gray(seed + i));
}

fn measured(setup: &Setup, options: &MeasureOptions) -> (Measurements, MeasureReport) {
    let folder = folder();
    let session = record(folder.path(), setup);
    measure_session(&session, options, &Unwatched).unwrap()
}

#[test]
fn without_a_filter_there_is_one_number_and_the_standards_colors_are_an_error() {
    let mut setup = gray(7);
    let (_, even) = measured(&setup, &MeasureOptions::default());
    setup.white_factor = [1.02, 0.99, 0.96];
    let (colored, report) = measured(&setup, &MeasureOptions::default());
    for i in &colored.intensities {
        assert!(i.mean == [i.mean[0]; 3], "{i:?}");
        assert_eq!(i.standard_error, [i.standard_error[0]; 3]);
    }
    // The range of 0.06 over the root of 12, of 0.99.
    for (i, c) in colored.intensities.iter().zip(&report.configurations) {
        let relative = c.budget[0].reference / i.mean[0];
        assert!((relative - 0.0175).abs() < 1e-4, "{relative}");
    }
    assert_eq!(even.configurations[0].budget[0].reference, 0.0);
    // There is nothing to convert.
    let folder = folder();
    let session = record(folder.path(), &setup);
    let options = MeasureOptions {
        color: true,
        ..MeasureOptions::default()
    };
    let error = measure_session(&session, &options, &Unwatched).unwrap_err();
    let error = error.report();
    assert!(
        error.contains("monochrome") && error.contains("hint: leave out --color"),
        "{error}"
    );
}

#[test]
fn pixels_of_a_monochrome_camera_are_counted_once() {
    let mut setup = Setup {
        lamp: None,
        poses: vec![(0.0, 0.0, [1.3; 3]), (32.0, 0.0, [30.0; 3])],
        ..gray(8)
    };
    let (_, report) = measured(&setup, &MeasureOptions::default());
    let [(exposure_ms, masked)] = report.configurations[0].masked[..] else {
        panic!("{report:?}");
    };
    assert!(
        exposure_ms == 64.0 && (100..5000).contains(&masked),
        "{masked}"
    );
    let message = report.configurations[1].message.as_ref().unwrap();
    // A square of 64 x 54 pixels and those on its edge.
    let pixels = message.split(" pixels of frame").next().unwrap();
    let pixels: usize = pixels.rsplit(' ').next().unwrap().parse().unwrap();
    assert!((3400..3800).contains(&pixels), "{message}");
    // Through filters, the one that saturates is named.
    setup.filters = true;
    setup.poses[1].2 = [0.3, 0.3, 30.0];
    let (_, report) = measured(&setup, &MeasureOptions::default());
    let message = report.configurations[1].message.as_ref().unwrap();
    assert!(
        message.contains("filter b, 16 ms") && message.contains("below 16 ms"),
        "{message}"
    );
}

/// Mean of the noise-free picture over a box of the image.
fn true_box_mean(setup: &Setup, crop: Crop, pose: usize) -> [f64; 3] {
    let camera = setup.camera(Purpose::Measurement, &setup.sensor);
    let pose = setup.configurations()[pose];
    let image = camera.noise_free_image(FrameKind::Sample, &pose).unwrap();
    let mut sum = [0.0; 3];
    for y in crop.y..crop.y + crop.height {
        for x in crop.x..crop.x + crop.width {
            for (sum, value) in sum.iter_mut().zip(image.pixels[y * image.width + x]) {
                *sum += value;
            }
        }
    }
    sum.map(|s| s / (crop.width * crop.height) as f64)
}

#[test]
fn a_fixed_box_gives_the_mean_over_that_box() {
    let crop = Crop {
        x: 40,
        y: 38,
        width: 20,
        height: 8,
    };
    let options = MeasureOptions {
        crop: CropRule::Rectangle(crop),
        ..MeasureOptions::default()
    };
    let seed = seed(20_261_205);
    let (mut worst, mut control) = (0.0_f64, 0.0_f64);
    for i in 0..4 {
        let setup = Setup {
            lamp: None,
            reference_every: 0,
            ..session_of(Layout::Rgb, seed + i)
        };
        let (boxed, report) = measured(&setup, &options);
        let (square, _) = measured(&setup, &MeasureOptions::default());
        for (pose, c) in report.configurations.iter().enumerate() {
            assert_eq!(c.bounds, [40, 38, 60, 46]);
            let truth = true_box_mean(&setup, crop, pose);
            for channel in 0..3 {
                let off = |m: &Measurements| {
                    let m = &m.intensities[pose];
                    ((m.mean[channel] - truth[channel]) / m.standard_error[channel]).abs()
                };
                worst = worst.max(off(&boxed));
                // Negative control: at 80 degrees the sample square is not what the box sees.
                if pose == 2 {
                    control = control.max(off(&square));
                }
            }
        }
    }
    println!("box: {worst:.2} standard errors; square instead: {control:.1}");
    // 36 pulls at a family-wise level of 1e-3.
    assert!(worst < 4.2, "{worst}");
    assert!(control > 8.0, "{control}");
}

const SPACE: [[f64; 3]; 3] = [[1.6, -0.4, -0.1], [-0.3, 1.5, -0.2], [0.05, -0.5, 1.4]];

/// A stated matrix, off by errors of this standard deviation.
fn matrix(setup: &Setup, sd: f64, stated_sd: f64) -> Dated<ColorMatrix> {
    let facts = setup.sensor.facts();
    let mut random = Random::keyed(&[setup.seed, 4711]);
    // Errors of one row are correlated, 0.5.
    let row = |row: [f64; 3], random: &mut Random| {
        let common = 0.5_f64.sqrt() * random.normal();
        row.map(|m| m + sd * (common + 0.5_f64.sqrt() * random.normal()))
    };
    let variance = stated_sd * stated_sd;
    let covariance =
        [0, 1, 2].map(|i| [0, 1, 2].map(|j| if i == j { variance } else { 0.5 * variance }));
    Dated {
        header: Header {
            format: Header::FORMAT.to_owned(),
            kind: Kind::Color,
            rig: "virtual".to_owned(),
            camera: facts.name,
            size_px: [facts.width, facts.height],
            date_utc: "2024-02-29T12:00:00Z".to_owned(),
            sessions: Vec::new(),
            synthetic: true,
            program: "test".to_owned(),
        },
        value: ColorMatrix {
            space: "test space".to_owned(),
            matrix: SPACE.map(|r| row(r, &mut random)),
            covariance: [covariance; 3],
            residual: [0.0; 3],
            patches: 24,
        },
    }
}

fn color_pulls(
    n: u64,
    sd: f64,
    stated_sd: f64,
    setup: impl Fn(u64) -> Setup + Sync,
) -> Vec<Vec<f64>> {
    let one = |i: u64| -> Vec<f64> {
        let setup = setup(i);
        let options = MeasureOptions {
            calibrations: Calibrations {
                color: Some(matrix(&setup, sd, stated_sd)),
                ..Calibrations::default()
            },
            color: true,
            ..MeasureOptions::default()
        };
        let (measured, report) = measured(&setup, &options);
        assert_eq!(report.rgb, "test space");
        let pairs = measured.intensities.iter().zip(&setup.poses);
        let pulls = pairs.flat_map(|(m, (_, _, camera))| {
            (0..3).map(move |c| {
                let truth: f64 = (0..3).map(|j| SPACE[c][j] * camera[j]).sum();
                (m.mean[c] - truth) / m.standard_error[c]
            })
        });
        pulls.collect()
    };
    (0..n).into_par_iter().map(one).collect()
}

#[test]
fn another_color_space_is_reached_within_stated_errors() {
    let seed = seed(20_261_206);
    let setup = |i| Setup {
        lamp: None,
        reference_every: 0,
        ..session_of(Layout::Bayer(CfaPattern::Rggb), seed + i)
    };
    // The frames' own errors alone, then with those of the matrix on top.
    for sd in [0.0, 0.003] {
        let good = verdict(&color_pulls(24, sd, sd, setup));
        println!("{good:?}");
        assert!(good.is_ok(), "{good:?}");
    }
    // Negative control: the matrix is worse than it says.
    let bad = verdict(&color_pulls(24, 0.006, 0.0, setup));
    println!("{bad:?}");
    assert!(bad.is_err(), "{bad:?}");
}

#[test]
fn the_command_converts_colors() {
    let setup = Setup {
        lamp: None,
        reference_every: 0,
        ..filtered(9)
    };
    let folder = folder();
    let session = record(&folder.path().join("session"), &setup);
    let known = folder.path().join("calibration");
    let mut color = matrix(&setup, 0.0, 0.003);
    color.write(&known).unwrap();
    let run = |more: &[&str]| -> serde_json::Value {
        let mut command = assert_cmd::Command::cargo_bin("goniofit").unwrap();
        command.args(["measure", "session"]).arg(session.root());
        command.arg("--calibration").arg(&known);
        let output = command.args(["--json", "--force"]).args(more).output();
        let output = output.unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(0), "{said}");
        serde_json::from_slice(&output.stdout).unwrap()
    };
    let (camera, converted) = (run(&[]), run(&["--color"]));
    assert_eq!(camera["report"]["rgb"], "camera");
    assert_eq!(converted["report"]["rgb"], "test space");
    for pose in 0..3 {
        let mean =
            |v: &serde_json::Value, c: usize| v["intensities"][pose]["mean"][c].as_f64().unwrap();
        for (c, row) in SPACE.iter().enumerate() {
            let expected: f64 = (0..3).map(|j| row[j] * mean(&camera, j)).sum();
            assert!((mean(&converted, c) / expected - 1.0).abs() < 1e-12);
            let budget = &converted["report"]["configurations"][pose]["budget"][c];
            let m = [0, 1, 2].map(|j| mean(&camera, j));
            let sum = m.iter().sum::<f64>();
            let squares = m.iter().map(|m| m * m).sum::<f64>();
            let error = 0.003 * (0.5 * squares + 0.5 * sum * sum).sqrt();
            assert!((budget["color"].as_f64().unwrap() / error - 1.0).abs() < 1e-9);
        }
    }
}
