//! Promise: `calibrate flat` finds each pixel's response with its error, whatever the lamp does meanwhile.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

mod recorded;
mod virtual_session;

use goniofit::base::Unwatched;
use goniofit::measure::calibrate::{Calibrated, flat};
use goniofit::measure::calibration::{
    Calibrations, Dated, FlatField, Header, Kind, Linearity, PhotonTransfer,
};
use goniofit::session::FrameKind;
use rayon::prelude::*;
use recorded::{Sensor, Shot, folder, record, shots, timed};
use virtual_session::pulls::{seed, verdict};

fn sensor() -> Sensor {
    Sensor {
        vignetting: 0.3,
        ..Sensor::default()
    }
}

/// The true curve of the sensor, as if calibrated before.
fn known(sensor: &Sensor) -> Calibrations {
    let value = Linearity {
        coefficients: sensor.curve.to_vec(),
        covariance: vec![vec![0.0; 2]; 2],
        full_scale: sensor.full_scale(),
        bias: sensor.bias,
        usable: [0.0, 0.92],
        points: Vec::new(),
        transfer: PhotonTransfer {
            variance_per_signal: [1.0 / sensor.gain; 3],
            variance_per_signal_se: [0.0; 3],
            read_noise: (sensor.read.powi(2) + 1.0 / 12.0).sqrt(),
            read_noise_se: 0.0,
            points: Vec::new(),
        },
    };
    let header = Header {
        format: Header::FORMAT.to_owned(),
        kind: Kind::Linearity,
        rig: "bench".to_owned(),
        camera: "Test camera".to_owned(),
        size_px: [sensor.width, sensor.height],
        date_utc: "2024-02-28T12:00:00Z".to_owned(),
        sessions: Vec::new(),
        synthetic: true,
        program: "test".to_owned(),
    };
    Calibrations {
        linearity: Some(Dated { header, value }),
        ..Calibrations::default()
    }
}

fn list(repeats: usize) -> Vec<Shot> {
    let mut list = shots(FrameKind::Dark, &[20.0, 40.0], 8);
    list.extend(shots(FrameKind::Flat, &[20.0, 40.0], repeats));
    // The lamp goes as it likes.
    for (i, shot) in list.iter_mut().enumerate() {
        shot.lamp = 1.0 - 0.02 * (i % 7) as f64;
    }
    list
}

fn found(
    sensor: &Sensor,
    list: Vec<Shot>,
    known: &Calibrations,
    seed: u64,
) -> Calibrated<FlatField> {
    let folder = folder();
    let session = record(&folder.path().join("s"), sensor, &timed(list), seed);
    flat(&session, known, 0.004, &Unwatched).unwrap()
}

/// True responses over the channel's mean in the central quarter of width and height.
fn truth(sensor: &Sensor, seed: u64) -> Vec<f64> {
    let places = || (0..sensor.height).flat_map(|y| (0..sensor.width).map(move |x| (x, y)));
    let response = |x: usize, y: usize| sensor.response(seed, 0, x, y);
    let middle = |v: usize, size: usize| 8 * v >= 3 * size && 8 * v < 5 * size;
    let mean = [0, 1, 2].map(|c| {
        let inside = places().filter(|&(x, y)| {
            middle(x, sensor.width) && middle(y, sensor.height) && sensor.cfa.channel(y, x) == c
        });
        let all: Vec<f64> = inside.map(|(x, y)| response(x, y)).collect();
        all.iter().sum::<f64>() / all.len() as f64
    });
    places()
        .map(|(x, y)| response(x, y) / mean[sensor.cfa.channel(y, x)])
        .collect()
}

/// Pulls of four pixels far from the middle (the middle's own noise is part of the others' and is not stated).
fn pulls(sensor: &Sensor, known: &Calibrations, n: u64, seed: u64) -> Vec<Vec<f64>> {
    (0..n)
        .into_par_iter()
        .map(|i| {
            let value = found(sensor, list(4), known, seed + i).dated.value;
            let truth = truth(sensor, seed + i);
            let pull = |p: usize| {
                (f64::from(value.response[p]) - truth[p]) / f64::from(value.response_se[p])
            };
            [0, 1, 2, 3, 4, 5, 50, 51, 700, 1500, 1700, 1919]
                .map(pull)
                .to_vec()
        })
        .collect()
}

#[test]
fn every_pixels_response_is_found_within_its_stated_error() {
    // 100 sessions of 12 pulls see standard errors that are off by 10 %, and a bias of 0.15 standard errors.
    let seed = seed(20_260_521);
    let good = verdict(&pulls(&sensor(), &known(&sensor()), 100, seed));
    println!("{good:?}");
    assert!(good.is_ok(), "{good:?}");
    // Negative control: a curve that is not known; the corners are 30 % darker, so 4 % too bright or dark.
    let bent = Sensor {
        curve: [0.3, -0.1],
        ..sensor()
    };
    let bad = verdict(&pulls(&bent, &Calibrations::default(), 20, seed));
    assert!(bad.is_err(), "{bad:?}");
}

#[test]
fn unequal_pixels_falloff_hot_and_dead_ones_are_told() {
    let sensor = Sensor {
        width: 96,
        height: 80,
        pattern: 0.01,
        hot: vec![(50, 40, 5.0)],
        ..sensor()
    };
    let made = found(&sensor, list(8), &known(&sensor), 3);
    let value = &made.dated.value;
    for c in 0..3 {
        // 1900 pixels or more: known to 2 %, one standard error.
        assert!(
            (value.scatter[c] - 0.01).abs() < 0.0008,
            "{:?}",
            value.scatter
        );
        assert!(
            (0.24..0.32).contains(&value.falloff[c]),
            "{:?}",
            value.falloff
        );
    }
    let hot = 40 * 96 + 50;
    assert_eq!((value.response[hot], value.response_se[hot]), (1.0, 1.0));
    assert!(
        made.faults.is_empty() && made.warnings.is_empty(),
        "{made:?}"
    );
    let smooth = Sensor {
        pattern: 0.0,
        ..sensor
    };
    let found = found(&smooth, list(8), &known(&smooth), 3).dated.value;
    assert!(
        found.scatter.iter().all(|s| *s < 0.002),
        "{:?}",
        found.scatter
    );
}

#[test]
fn the_map_is_written_beside_the_file_and_read_back() {
    let folder = folder();
    let mut made = found(&sensor(), list(2), &known(&sensor()), 3);
    let names: Vec<String> = (0..2)
        .map(|_| {
            made.dated.write(folder.path()).unwrap();
            made.dated.value.file.clone()
        })
        .collect();
    assert_eq!(names, ["2024-02-29_flat.exr", "2024-02-29b_flat.exr"]);
    let read = Calibrations::read(folder.path()).unwrap().flat.unwrap();
    assert_eq!(read, made.dated);
}

#[test]
fn flats_that_are_clipped_everywhere_or_missing_are_refused() {
    let run = |list: Vec<Shot>| {
        let folder = folder();
        let session = record(&folder.path().join("s"), &sensor(), &timed(list), 1);
        let found = flat(&session, &known(&sensor()), 0.004, &Unwatched);
        found.unwrap_err().report()
    };
    let (dark, flat_kind) = (FrameKind::Dark, FrameKind::Flat);
    let clipped = run([shots(dark, &[400.0], 2), shots(flat_kind, &[400.0], 2)].concat());
    assert!(
        clipped.contains("all exposures are clipped") && clipped.contains("hint:"),
        "{clipped}"
    );
    let none = run(shots(dark, &[400.0], 2));
    assert!(
        none.contains("has no flat frames\nhint: shoot a diffuser"),
        "{none}"
    );
    let green = run([shots(dark, &[75.0], 2), shots(flat_kind, &[75.0], 2)].concat());
    assert!(green.contains("green is clipped in every flat"), "{green}");
}
