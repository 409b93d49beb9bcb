//! Promise: `calibrate dark` finds bias, dark current, read noise and hot pixels, and states their errors rightly.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

mod recorded;
mod virtual_session;

use goniofit::base::{Result, Unwatched};
use goniofit::measure::calibrate::{Calibrated, DarkOptions, dark};
use goniofit::measure::calibration::{Calibrations, DarkCurrent};
use goniofit::session::FrameKind;
use rayon::prelude::*;
use recorded::{Sensor, Shot, folder, record, shots, timed};
use virtual_session::pulls::{seed, verdict};

const EXPOSURES_MS: [f64; 4] = [1.0, 50.0, 200.0, 400.0];

fn found(sensor: &Sensor, shots: Vec<Shot>, seed: u64) -> Result<Calibrated<DarkCurrent>> {
    let folder = folder();
    let session = record(&folder.path().join("s"), sensor, &timed(shots), seed);
    dark(
        &session,
        &Calibrations::default(),
        &DarkOptions::default(),
        &Unwatched,
    )
}

/// Pulls of bias and dark current by place, and of the read noise.
fn pulls(sensor: &Sensor, n: u64, seed: u64) -> Vec<Vec<f64>> {
    (0..n)
        .into_par_iter()
        .map(|i| {
            let shots = shots(FrameKind::Dark, &EXPOSURES_MS, 4);
            let value = found(sensor, shots, seed + i).unwrap().dated.value;
            let mut pulls = Vec::new();
            for p in 0..4 {
                pulls.push((value.bias[p] - sensor.bias[p]) / value.bias_se[p]);
                pulls.push((value.per_ms[p] - sensor.dark_per_ms) / value.per_ms_se[p]);
            }
            let read = (sensor.read.powi(2) + 1.0 / 12.0).sqrt();
            pulls.push((value.read_noise - read) / value.read_noise_se);
            pulls
        })
        .collect()
}

fn sensor() -> Sensor {
    Sensor {
        curve: [0.0; 2],
        ..Sensor::default()
    }
}

#[test]
fn stated_errors_are_right_and_a_wandering_black_level_is_part_of_them() {
    // 120 sessions of 9 pulls see standard errors that are off by 12 %, and a bias of 0.2 standard errors.
    let seed = seed(20_260_501);
    let good = verdict(&pulls(&sensor(), 120, seed));
    println!("{good:?}");
    assert!(good.is_ok(), "{good:?}");
    // The black level wanders: the errors must grow with it.
    let wanders = Sensor {
        wander: 0.5,
        ..sensor()
    };
    let shots = || shots(FrameKind::Dark, &EXPOSURES_MS, 8);
    let of = |s: &Sensor| found(s, shots(), seed).unwrap().dated.value.bias_se[0];
    let ratio = of(&wanders) / of(&sensor());
    assert!((3.0..12.0).contains(&ratio), "{ratio}");
    // Negative control: a black level so low that the camera cuts the noise off.
    let low = Sensor {
        bias: [3.0; 4],
        ..sensor()
    };
    assert!(verdict(&pulls(&low, 20, seed)).is_err());
}

#[test]
fn hot_pixels_are_found_and_do_not_move_the_means() {
    let sensor = Sensor {
        width: 80,
        height: 60,
        dark_scatter: 0.004,
        hot: vec![(3, 4, 0.2), (40, 41, 1.0), (79, 0, 30.0)],
        ..sensor()
    };
    let all = found(&sensor, shots(FrameKind::Dark, &EXPOSURES_MS, 6), 7).unwrap();
    let value = all.dated.value;
    let places: Vec<(usize, usize)> = value.hot.iter().map(|h| (h.x, h.y)).collect();
    assert_eq!(places, [(79, 0), (3, 4), (40, 41)]);
    // 1.0 on top of the common 0.02; 24 frames of noise 2 over 160 ms: 0.003.
    assert!((value.hot[2].per_ms - 1.02).abs() < 0.02, "{:?}", value.hot);
    // 4800 pixels: the scatter is known to 1 %, less the noise.
    assert!(
        (value.per_ms_scatter - 0.004).abs() < 0.0004,
        "{}",
        value.per_ms_scatter
    );
    // Pixels scatter by 0.004: their mean over 1200 of a place by 0.00012.
    for p in 0..4 {
        assert!(
            (value.per_ms[p] - 0.02).abs() < 0.0006,
            "{:?}",
            value.per_ms
        );
    }
    assert!(all.faults.is_empty(), "{:?}", all.faults);
}

#[test]
fn a_dark_that_is_no_straight_line_and_a_clipped_one_are_out_of_tolerance() {
    let sensor = sensor();
    let mut list = shots(FrameKind::Dark, &EXPOSURES_MS, 4);
    list.retain(|s| s.exposure_ms < 300.0);
    // Light leaks into the longest exposure.
    list.extend(
        shots(FrameKind::White, &[400.0], 4)
            .iter()
            .map(|s| Shot { lamp: 1e-4, ..*s }),
    );
    let leaks = Sensor {
        rate: [50.0; 3],
        ..sensor.clone()
    };
    let folder = folder();
    let session = record(&folder.path().join("s"), &leaks, &timed(list), 3);
    let journal = std::fs::read_to_string(session.journal_path()).unwrap();
    let journal = journal.replace("\"kind\":\"white\"", "\"kind\":\"dark\"");
    std::fs::write(session.journal_path(), journal).unwrap();
    let options = DarkOptions::default();
    let found_leak = dark(&session, &Calibrations::default(), &options, &Unwatched).unwrap();
    assert!(
        found_leak.faults[0].contains("not a straight line"),
        "{:?}",
        found_leak.faults
    );
    let low = Sensor {
        bias: [2.0; 4],
        ..sensor
    };
    let clipped = found(&low, shots(FrameKind::Dark, &EXPOSURES_MS, 2), 3).unwrap();
    assert!(
        clipped.faults.iter().any(|f| f.contains("are 0")),
        "{:?}",
        clipped.faults
    );
}

#[test]
fn what_is_missing_is_said_with_what_to_shoot() {
    let dark = FrameKind::Dark;
    let report = |list: Vec<Shot>| found(&sensor(), list, 1).unwrap_err().report();
    let one_exposure = report(shots(dark, &[10.0], 3));
    assert!(
        one_exposure
            .contains("too few exposures: all 3 dark frames have 10 ms\nhint: cap the lens"),
        "{one_exposure}"
    );
    let single = report([shots(dark, &[10.0], 3), shots(dark, &[80.0], 1)].concat());
    assert!(
        single.contains("too few repeats: one dark frame only of 80 ms\nhint:"),
        "{single}"
    );
    let none = report(shots(FrameKind::White, &[10.0], 2));
    assert!(none.contains("has no dark frames\nhint:"), "{none}");
    let mut list = shots(dark, &[10.0, 40.0], 2);
    list[2].iso = 400;
    let iso = report(list);
    assert!(
        iso.contains("0002_dark_40ms.dng") && iso.contains("ISO 400") && iso.contains("ISO 100"),
        "{iso}"
    );
}

#[test]
fn a_torn_frame_is_named() {
    let folder = folder();
    let list = timed(shots(FrameKind::Dark, &[10.0, 40.0], 2));
    let session = record(&folder.path().join("s"), &sensor(), &list, 1);
    let path = session.frame_path("0003_dark_40ms.dng");
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let run = || {
        let options = DarkOptions::default();
        let found = dark(&session, &Calibrations::default(), &options, &Unwatched);
        found.unwrap_err().report()
    };
    let changed = run();
    assert!(
        changed.contains("0003_dark_40ms.dng") && changed.contains("torn"),
        "{changed}"
    );
    // Torn before it was journaled: the hash is that of the torn file.
    let hash = goniofit::session::sha256(&bytes[..bytes.len() / 2]);
    let journal = std::fs::read_to_string(session.journal_path()).unwrap();
    let old = goniofit::session::sha256(&bytes);
    std::fs::write(session.journal_path(), journal.replace(&old, &hash)).unwrap();
    let torn = run();
    assert!(
        torn.contains("0003_dark_40ms.dng") && torn.contains("cannot be decoded"),
        "{torn}"
    );
}

#[test]
fn files_are_dated_never_overwritten_and_the_newest_is_read() {
    let folder = folder();
    let mut made = found(&sensor(), shots(FrameKind::Dark, &[1.0, 100.0], 2), 1).unwrap();
    let out = folder.path().join("calibration/bench");
    let names: Vec<String> = (0..3)
        .map(|i| {
            made.dated.value.read_noise = f64::from(i);
            let path = made.dated.write(&out).unwrap();
            path.file_name().unwrap().to_string_lossy().into_owned()
        })
        .collect();
    assert_eq!(
        names,
        [
            "2024-02-29_dark.json",
            "2024-02-29b_dark.json",
            "2024-02-29c_dark.json"
        ]
    );
    let read = Calibrations::read(&out).unwrap().dark.unwrap();
    assert_eq!(read, made.dated);
    made.dated.header.date_utc = "yesterday".to_owned();
    let text = made.dated.write(&out).unwrap_err().report();
    assert!(
        text.contains("'yesterday' is none") && text.contains("hint:"),
        "{text}"
    );
}
