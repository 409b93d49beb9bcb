//! Promise: the stated standard errors are right. Over many sessions of the virtual camera, (measured - truth) / stated
//! standard error has mean 0 and standard deviation 1.
#![allow(
    clippy::print_stdout,
    clippy::unwrap_used,
    clippy::float_cmp,
    missing_docs
)]

mod virtual_session;

use goniofit::math::statistics::Running;
use goniofit::measure::MeasureOptions;
use goniofit::measure::calibration::PoseErrors;
use rayon::prelude::*;
use std::collections::BTreeMap;
use virtual_session::Setup;
use virtual_session::chain::calibrate;
use virtual_session::pulls::{Cell, cells, pulls, seed, verdict};

#[test]
fn stated_errors_are_right_and_a_wrong_black_level_is_caught() {
    // 60 sessions of 12 pulls see standard errors that are off by 15 %, and a bias of 0.3 standard errors.
    let seed = seed(20_260_401);
    let good = verdict(&pulls(60, |i| Setup::new(seed + i)));
    println!("{good:?}");
    assert!(good.is_ok(), "{good:?}");
    // Negative control: darks whose black level is wrong by two raw values of 4095.
    let bad = verdict(&pulls(20, |i| {
        let mut setup = Setup::new(seed + 1000 + i);
        for black in &mut setup.dark_sensor.black {
            *black += 2.0;
        }
        setup
    }));
    println!("{bad:?}");
    assert!(bad.is_err(), "a wrong black level passed: {bad:?}");
}

#[test]
fn stated_errors_are_right_without_texture_and_with_repeats() {
    let seed = seed(20_260_402);
    let good = verdict(&pulls(40, |i| Setup {
        grain: 0.0,
        exposures_ms: vec![16.0],
        sample_repeats: 2,
        white_se: 0.0,
        dark_repeats: 2,
        ..Setup::new(seed + i)
    }));
    println!("{good:?}");
    assert!(good.is_ok(), "{good:?}");
}

/// How far poses are off, and are said to be.
const POSE: PoseErrors = PoseErrors {
    camera_theta_deg: 0.1,
    light_theta_deg: 0.1,
    rotation_deg: 0.1,
    height_mm: 0.05,
};

/// Steady while the white is exchanged for the sample; then it warms up and fades.
fn lamp(x: f64, _: usize) -> [f64; 3] {
    [0.03, 0.025, 0.035].map(|d| 1.0 - d * x + 0.01 * (1.0 - (-3.0 * x).exp()))
}

/// A rig with every fault, whose longest exposures clip. Its lens blurs as much as its
/// pixels are wide, and its certificate is good, so that texture between the pixels and the standard do not hide the
/// other errors.
fn rig(seed: u64) -> Setup {
    let mut setup = Setup {
        exposures_ms: vec![2.0, 16.0, 128.0],
        dark_exposures_ms: vec![2.0, 3.0, 6.0, 16.0, 128.0],
        reference_exposures_ms: vec![3.0],
        lamp: Some(lamp),
        grain: 0.2,
        // A glint smaller than the raster of the filters is seen or missed by red and blue as a whole, and their stated
        // errors go with it: with two of them mean pulls are -0.3 at 75 degrees, though the means have no such bias.
        glints: 0,
        white_se: 0.001,
        pose_sd: POSE,
        pointing_sd_px: [0.2, 0.2],
        ..Setup::faulty(seed)
    };
    setup.sensor.optics.blur_px = 0.8;
    setup
}

/// The cells of every session, each of a rig with calibrations of its own; `spoil` is what the operator does wrong.
fn through_the_chain(
    n_sessions: u64,
    seed: u64,
    spoil: impl Fn(&mut Setup, &mut MeasureOptions) + Sync,
) -> Vec<Vec<Cell>> {
    (0..n_sessions)
        .into_par_iter()
        .map(|i| {
            let mut setup = rig(seed + i);
            let mut options = MeasureOptions {
                calibrations: calibrate(&setup),
                ..MeasureOptions::default()
            };
            spoil(&mut setup, &mut options);
            cells(&setup, &options)
        })
        .collect()
}

fn pulls_of(sessions: &[Vec<Cell>]) -> Vec<Vec<f64>> {
    let of = |cells: &Vec<Cell>| cells.iter().map(Cell::pull).collect();
    sessions.iter().map(of).collect()
}

/// Prints pulls by cell and by the part of the budget that is largest.
fn print_pulls(sessions: &[Vec<Cell>]) {
    let mut by: BTreeMap<String, [Running; 3]> = BTreeMap::new();
    for cells in sessions {
        for (i, cell) in cells.iter().enumerate() {
            let pull = cell.pull();
            for name in [format!("cell {i:2}"), cell.dominated_by().to_owned()] {
                let [mean, square, error] = by.entry(name).or_default();
                mean.push(pull);
                square.push(pull * pull);
                error.push(100.0 * cell.budget.total() / cell.truth);
            }
        }
    }
    for (name, [mean, square, error]) in by {
        println!(
            "{name}: n = {}, mean pull {:.2} +- {:.2}, mean square {:.2} +- {:.2}, stated error {:.3} %",
            mean.count(),
            mean.mean(),
            mean.standard_error(),
            square.mean(),
            square.standard_error(),
            error.mean()
        );
    }
}

/// Mean relative error of the well lit cells over sessions, the certificate's error taken off, with its standard error.
fn bias(sessions: &[Vec<Cell>]) -> Running {
    let mut bias = Running::default();
    for cells in sessions {
        let lit = cells.iter().filter(|c| c.is_well_lit());
        let errors: Vec<f64> = lit.map(|c| c.own_error).collect();
        if !errors.is_empty() {
            bias.push(errors.iter().sum::<f64>() / errors.len() as f64);
        }
    }
    bias
}

#[test]
fn stated_errors_are_right_through_the_whole_chain_with_every_fault() {
    // 200 sessions of 12 pulls see standard errors that are off by 8 %, and a bias of 0.15 standard errors.
    let n: u64 = std::env::var("SESSIONS").map_or(200, |s| s.parse().unwrap());
    let sessions = through_the_chain(n, seed(20_260_901), |_, _| ());
    print_pulls(&sessions);
    let good = verdict(&pulls_of(&sessions));
    println!("{good:?}");
    let bias = bias(&sessions);
    println!(
        "bias where light is plentiful: {:.4} +- {:.4} %, n = {} sessions",
        100.0 * bias.mean(),
        100.0 * bias.standard_error(),
        bias.count()
    );
    assert!(good.is_ok(), "{good:?}");
    assert!(
        bias.mean().abs() + 3.0 * bias.standard_error() < 1e-3,
        "{bias:?}"
    );
}

/// Negative control: sessions in which something is done wrong must not pass.
fn assert_caught(
    name: &str,
    n: u64,
    seed: u64,
    spoil: impl Fn(&mut Setup, &mut MeasureOptions) + Sync,
) {
    let bad = verdict(&pulls_of(&through_the_chain(n, seed, spoil)));
    println!("{name}: {bad:?}");
    assert!(bad.is_err(), "{name} passed: {bad:?}");
}

#[test]
fn what_is_done_wrong_is_caught_by_the_same_verdict() {
    let seed = seed(20_260_902);
    assert_caught("darks two raw values too high", 24, seed, |setup, _| {
        for black in &mut setup.dark_sensor.black {
            *black += 2.0;
        }
    });
    assert_caught("no saturation mask", 24, seed + 100, |_, options| {
        options.usable_fraction = 2.0;
        let linearity = options.calibrations.linearity.as_mut().unwrap();
        linearity.value.usable[1] = 2.0;
    });
    assert_caught(
        "a white that is 1 at all angles",
        24,
        seed + 200,
        |_, options| {
            let white = options.calibrations.white.as_mut().unwrap();
            white.value.reflectance_factor = [1.0; 3];
        },
    );
    // A bend of 4 % at full scale; those of the rigs above are of either sign and may be next to nothing.
    assert_caught("linearity ignored", 24, seed + 300, |setup, options| {
        setup.sensor.faults.nonlinearity = [0.04, 0.0];
        setup.dark_sensor.faults.nonlinearity = [0.04, 0.0];
        options.calibrations.linearity = None;
    });
    // Errors three times those of the rig above, whose own are a part of its budget too small to be missed in 40 sessions.
    assert_caught(
        "geometry errors not stated",
        40,
        seed + 400,
        |setup, options| {
            setup.pose_sd = PoseErrors {
                camera_theta_deg: 0.3,
                light_theta_deg: 0.3,
                rotation_deg: 0.3,
                height_mm: 0.15,
            };
            let geometry = &mut options.calibrations.geometry.as_mut().unwrap().value;
            geometry.pose = PoseErrors::default();
            geometry.pointing_sd_px = [0.0; 2];
            geometry.center_px_se = [0.0; 2];
            geometry.pixel_mm_se = 0.0;
        },
    );
}
