//! Promise: calibrations of rigs with every fault, made by the chain from the rigs' own sessions, are right within their
//! stated errors.
#![allow(clippy::unwrap_used, missing_docs)]

mod virtual_session;

use goniofit::math::statistics::Running;
use goniofit::measure::calibration::{Calibrations, Linearity};
use goniofit::rig::{Camera, SensorModel, Shot};
use goniofit::session::{BitDepth, FrameKind};
use rayon::prelude::*;
use virtual_session::chain::calibrate;
use virtual_session::pulls::{seed, verdict};
use virtual_session::{Purpose, Setup};

/// The linear signal of a raw value `s` less bias, and the derivatives by the coefficients, by hand.
fn linear(curve: &Linearity, s: f64) -> (f64, Vec<f64>) {
    let u = s / curve.full_scale;
    let powers: Vec<f64> = (1..=curve.coefficients.len() as i32)
        .map(|k| s * u.powi(k))
        .collect();
    let sum: f64 = powers
        .iter()
        .zip(&curve.coefficients)
        .map(|(p, c)| p * c)
        .sum();
    (s + sum, powers)
}

/// Pull of the ratio of the linear signals of two charges, which must be that of the charges.
fn curve_pull(setup: &Setup, curve: &Linearity, low: f64, high: f64) -> f64 {
    let full = f64::from(setup.sensor.white) - setup.sensor.black[0];
    let at = |fraction: f64| {
        let charge = fraction * full;
        let (value, by) = linear(curve, setup.sensor.faults.raw(charge, full));
        (
            value / charge,
            by.into_iter().map(|d| d / charge).collect::<Vec<f64>>(),
        )
    };
    let ((a, da), (b, db)) = (at(low), at(high));
    let slope: Vec<f64> = da
        .iter()
        .zip(&db)
        .map(|(x, y)| y / a - x * b / (a * a))
        .collect();
    let variance: f64 = (0..slope.len())
        .flat_map(|i| (0..slope.len()).map(move |j| (i, j)))
        .map(|(i, j)| slope[i] * curve.covariance[i][j] * slope[j])
        .sum();
    (b / a - 1.0) / variance.sqrt()
}

/// What flats would read without noise, by index: the sensor's response over the mean in the middle.
fn true_response(setup: &Setup) -> Vec<f64> {
    let mut sensor = SensorModel {
        bits: BitDepth::Sixteen,
        black: [0.0; 4],
        white: u16::MAX,
        responsivity: [1000.0; 3],
        gain: 1e9,
        read_noise: 0.0,
        flicker: 0.0,
        ..setup.sensor.clone()
    };
    sensor.faults.nonlinearity = [0.0; 2];
    sensor.faults.hot_fraction = 0.0;
    let (width, height) = (sensor.width, sensor.height);
    let cfa = sensor.layout.cfa().unwrap();
    let mut camera = setup.camera(Purpose::Flat, &sensor);
    let shot = Shot {
        kind: FrameKind::Flat,
        config: Some(1),
        pose: setup.configurations()[0],
        exposure_ms: 50.0,
        repeat: 0,
        visit: 0,
    };
    let bytes = camera.expose(&shot).unwrap().bytes;
    let words = bytes[bytes.len() - 2 * width * height..].chunks(2);
    let raw: Vec<f64> = words
        .map(|w| f64::from(u16::from_le_bytes([w[0], w[1]])))
        .collect();
    let channel = |i: usize| cfa.channel(i / width, i % width);
    let middle = |i: usize| {
        let (x, y) = (i % width, i / width);
        (3 * width / 8..5 * width / 8).contains(&x) && (3 * height / 8..5 * height / 8).contains(&y)
    };
    let mut means = [Running::default(); 3];
    for (i, &v) in raw.iter().enumerate().filter(|(i, _)| middle(*i)) {
        means[channel(i)].push(v);
    }
    (0..raw.len())
        .map(|i| raw[i] / means[channel(i)].mean())
        .collect()
}

/// Mean and mean square over the pixels of (response - truth) / stated error.
fn flat_pulls(setup: &Setup, known: &Calibrations) -> [f64; 2] {
    let flat = &known.flat.as_ref().unwrap().value;
    let truth = true_response(setup);
    let hot = &known.dark.as_ref().unwrap().value.hot;
    let width = setup.sensor.width;
    let (mut pulls, mut squares) = (Running::default(), Running::default());
    for (i, truth) in truth.iter().enumerate() {
        if hot.iter().any(|h| h.y * width + h.x == i) {
            continue;
        }
        let z = (f64::from(flat.response[i]) - truth) / f64::from(flat.response_se[i]);
        pulls.push(z);
        squares.push(z * z);
    }
    [pulls.mean(), squares.mean()]
}

fn gain_pulls(setup: &Setup, known: &Calibrations) -> Vec<f64> {
    let sensor = &setup.sensor;
    let transfer = &known.linearity.as_ref().unwrap().value.transfer;
    (0..3)
        .map(|c| {
            let gain = 1.0 / (sensor.gain * sensor.faults.gains[c]);
            (transfer.variance_per_signal[c] - gain) / transfer.variance_per_signal_se[c]
        })
        .collect()
}

fn pulls_of(setup: &Setup) -> (Vec<f64>, [f64; 2]) {
    let known = calibrate(setup);
    let dark = &known.dark.as_ref().unwrap().value;
    let curve = &known.linearity.as_ref().unwrap().value;
    let sensor = &setup.sensor;
    let mut pulls = vec![
        (dark.bias[0] - sensor.black[0]) / dark.bias_se[0],
        (dark.bias[2] - sensor.black[2]) / dark.bias_se[2],
        (dark.read_noise - (sensor.read_noise.powi(2) + 1.0 / 12.0).sqrt()) / dark.read_noise_se,
        curve_pull(setup, curve, 0.1, 0.5),
        curve_pull(setup, curve, 0.2, 0.95 * curve.usable[1]),
    ];
    pulls.extend(gain_pulls(setup, &known));
    (pulls, flat_pulls(setup, &known))
}

#[test]
fn calibrations_of_faulty_rigs_are_right_within_their_errors() {
    // 40 rigs of 8 pulls see standard errors off by 15 %, and a bias of 0.3 standard errors.
    let seed = seed(20_260_811);
    let all: Vec<(Vec<f64>, [f64; 2])> = (0..40_u64)
        .into_par_iter()
        .map(|i| pulls_of(&Setup::faulty(seed + i)))
        .collect();
    let pulls: Vec<Vec<f64>> = all.iter().map(|(p, _)| p.clone()).collect();
    let good = verdict(&pulls);
    println!("{good:?}");
    assert!(good.is_ok(), "{good:?}");
    // Every pixel of a flat shares the error of the mean in the middle with the others, so rigs are the unit.
    let mut flats = [Running::default(); 2];
    for (_, [mean, square]) in &all {
        flats[0].push(*mean);
        flats[1].push(*square);
    }
    for cell in 0..pulls[0].len() {
        let mut square = Running::default();
        pulls.iter().for_each(|p| square.push(p[cell] * p[cell]));
        println!(
            "cell {cell}: mean square pull {:.2} +- {:.2}",
            square.mean(),
            square.standard_error()
        );
    }
    assert!(
        flats[0].mean().abs() < 4.0 * flats[0].standard_error(),
        "{flats:?}"
    );
    assert!((flats[1].mean() - 1.0).abs() < 0.15, "{flats:?}");
}

#[test]
fn a_gain_that_is_off_by_five_percent_is_caught() {
    // Negative control: the true gain is not the one compared with.
    let seed = seed(20_260_812);
    let pulls: Vec<Vec<f64>> = (0..20_u64)
        .into_par_iter()
        .map(|i| {
            let mut setup = Setup::faulty(seed + i);
            let known = calibrate(&setup);
            setup.sensor.gain *= 1.05;
            gain_pulls(&setup, &known)
        })
        .collect();
    let bad = verdict(&pulls);
    assert!(bad.is_err(), "{bad:?}");
}
