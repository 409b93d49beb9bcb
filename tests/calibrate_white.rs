//! Promise: `calibrate white` and `calibrate drift` find responsivity, slope and flicker, and state their errors rightly;
//! the command writes dated files.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

mod recorded;
mod virtual_session;

use goniofit::base::{Result, Unwatched};
use goniofit::math::Random;
use goniofit::measure::calibrate::{self, Calibrated, Factor, WhiteOptions, drift};
use goniofit::measure::calibration::{Calibrations, LampDrift, WhiteStandard};
use goniofit::session::{FrameKind, SessionFolder};
use rayon::prelude::*;
use recorded::{Sensor, Shot, folder, manifest, record, record_as, shots, timed};
use virtual_session::pulls::{seed, verdict};

fn sensor() -> Sensor {
    Sensor {
        curve: [0.0; 2],
        pattern: 0.0,
        ..Sensor::default()
    }
}

fn whites() -> Vec<Shot> {
    [
        shots(FrameKind::Dark, &[10.0, 30.0, 60.0], 4),
        shots(FrameKind::White, &[10.0, 30.0, 60.0], 4),
    ]
    .concat()
}

fn options(factor: Factor) -> WhiteOptions {
    WhiteOptions {
        panel: "test panel".to_owned(),
        factor,
    }
}

fn of_session(session: &SessionFolder, factor: Factor) -> Result<Calibrated<WhiteStandard>> {
    calibrate::white(
        session,
        &Calibrations::default(),
        &options(factor),
        &Unwatched,
    )
}

/// Pulls of the responsivity; the stated factor is drawn around the true one, so its error counts too.
fn pulls(sensor: &Sensor, factor_se: f64, n: u64, seed: u64) -> Vec<Vec<f64>> {
    (0..n)
        .into_par_iter()
        .map(|i| {
            let folder = folder();
            let list = timed(whites());
            let session = record(&folder.path().join("s"), sensor, &list, seed + i);
            let truth = [1.02, 0.99, 0.96];
            let mut random = Random::keyed(&[seed, i]);
            let stated = truth.map(|f| f + factor_se * random.normal());
            let factor = Factor::Stated(stated, [factor_se; 3]);
            let value = of_session(&session, factor).unwrap().dated.value;
            let cosine = 32.0_f64.to_radians().cos();
            let pull = |c: usize| {
                let responsivity = sensor.rate[c] / (truth[c] * cosine);
                (value.responsivity[c] - responsivity) / value.responsivity_se[c]
            };
            [0, 1, 2].map(pull).to_vec()
        })
        .collect()
}

#[test]
fn responsivity_is_found_within_its_stated_error() {
    // 120 sessions of 3 pulls see standard errors that are off by 20 %, and a bias of 0.3 standard errors.
    let seed = seed(20_260_531);
    let noise_only = verdict(&pulls(&sensor(), 0.0, 120, seed));
    println!("{noise_only:?}");
    assert!(noise_only.is_ok(), "{noise_only:?}");
    let with_factor = verdict(&pulls(&sensor(), 0.003, 120, seed));
    println!("{with_factor:?}");
    assert!(with_factor.is_ok(), "{with_factor:?}");
    // Negative control: a sensor that is not linear, its curve not known.
    let bent = Sensor {
        curve: [0.04, -0.03],
        ..sensor()
    };
    let bad = verdict(&pulls(&bent, 0.0, 20, seed));
    assert!(bad.is_err(), "{bad:?}");
}

#[test]
fn whites_that_disagree_or_are_clipped_are_out_of_tolerance() {
    let folder = folder();
    let mut list = whites();
    for shot in list.iter_mut().skip(20) {
        shot.lamp = 1.03;
    }
    let session = record(&folder.path().join("a"), &sensor(), &timed(list), 1);
    let faults = of_session(&session, Factor::Session).unwrap().faults;
    assert!(
        faults[0].contains("disagree: 60 ms is off by"),
        "{faults:?}"
    );
    let other = |name: &str, whites: Vec<Shot>| {
        let darks = shots(FrameKind::Dark, &[10.0, 30.0, 100.0, 500.0], 2);
        let list = timed([darks, whites].concat());
        let session = record(&folder.path().join(name), &sensor(), &list, 1);
        of_session(&session, Factor::Session)
    };
    let white = |exposure_ms: f64, n: usize| shots(FrameKind::White, &[exposure_ms], n);
    let one_left = other("b", [white(10.0, 1), white(100.0, 2)].concat());
    let faults = one_left.unwrap().faults;
    assert!(faults[0].contains("clipped in 2 of 3 frames"), "{faults:?}");
    let report = |name: &str, whites: Vec<Shot>| other(name, whites).unwrap_err().report();
    let single = report("c", [white(10.0, 1), white(30.0, 1)].concat());
    assert!(
        single.contains("noise of the frames is not known") && single.contains("hint:"),
        "{single}"
    );
    let green = report("d", white(100.0, 2));
    assert!(
        green.contains("green of the white standard is clipped"),
        "{green}"
    );
    let all = report("e", white(500.0, 2));
    assert!(
        all.contains("all exposures are clipped: even in frame 0008_white_500ms.dng")
            && all.contains("columns 9 to 38, rows 5 to 34"),
        "{all}"
    );
}

#[test]
fn the_panels_factor_comes_from_where_it_is_asked_for() {
    let folder = folder();
    let session = record(&folder.path().join("s"), &sensor(), &timed(whites()), 1);
    let table = folder.path().join("panel.csv");
    let text = "light,camera,rel_azimuth,BRF450,BRF550,BRF620\n32,0,0,1.01,1.02,1.03\n32,32,90,1.05,1.05,1.05\n";
    std::fs::write(&table, text).unwrap();
    let of = |f: Factor| of_session(&session, f).unwrap().dated.value;
    let listed = of(Factor::Table(table.clone(), None));
    assert_eq!(listed.reflectance_factor, [1.03, 1.02, 1.01]);
    assert_eq!(listed.reflectance_factor_se, [0.003; 3]);
    let stated = of(Factor::Session);
    assert_eq!(stated.reflectance_factor, [1.02, 0.99, 0.96]);
    let ratio = stated.responsivity[0] * 1.02 / (listed.responsivity[0] * 1.03);
    assert!((ratio - 1.0).abs() < 1e-12, "{ratio}");
    std::fs::write(&table, text.replace("32,0,0", "45,0,0")).unwrap();
    let refused = of_session(&session, Factor::Table(table, None))
        .unwrap_err()
        .report();
    assert!(
        refused.contains("light 32, camera 0")
            && refused.contains("the nearest is light 45, camera 0"),
        "{refused}"
    );
    let sheet = std::path::Path::new(concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../shared/data/spectralon_brf.csv"
    ));
    if !sheet.exists() {
        println!("skipped: {} is not there", sheet.display());
        return;
    }
    let mut manifest = manifest(&sensor());
    manifest.white.configuration.camera = goniofit::math::PolarDirection::from_degrees(32.0, 90.0);
    let list = timed(whites());
    let session = record_as(&folder.path().join("t"), &manifest, &sensor(), &list, 1);
    let panel = of_session(&session, Factor::Table(sheet.to_owned(), Some([0.004; 3])));
    let panel = panel.unwrap().dated.value;
    assert_eq!(panel.reflectance_factor, [1.03067, 1.03092, 1.03030]);
}

/// A lamp with this slope per hour and flicker, visited every 100 s.
fn visits(seed: u64, n: u32, course: impl Fn(f64) -> f64, flicker: f64) -> Vec<Shot> {
    let mut random = Random::keyed(&[seed, 9]);
    let mut list = shots(FrameKind::Dark, &[40.0], 4);
    for visit in 0..n {
        let elapsed_s = 100.0 * f64::from(visit);
        list.push(Shot {
            visit,
            elapsed_s,
            lamp: course(elapsed_s) * (1.0 + flicker * random.normal()),
            ..shots(FrameKind::Reference, &[40.0], 1)[0]
        });
    }
    list
}

fn drift_of(list: &[Shot], seed: u64) -> Result<Calibrated<LampDrift>> {
    let folder = folder();
    let session = record(&folder.path().join("s"), &sensor(), list, seed);
    drift(&session, &Calibrations::default(), &Unwatched)
}

#[test]
fn slope_and_flicker_of_the_lamp_are_found_within_their_stated_errors() {
    // 100 sessions of 2 pulls (the channels share the flicker): sees errors that are off by 25 %.
    let seed = seed(20_260_541);
    let (slope, flicker) = (-0.02, 0.002);
    let pulls = |course: fn(f64) -> f64, n: u64| -> Vec<Vec<f64>> {
        let one = |i: u64| {
            let list = visits(seed + i, 40, course, flicker);
            let value = drift_of(&list, seed + i).unwrap().dated.value;
            // Levels are over their mean; half the course (55 minutes) is 0.011 below the start.
            let mean = course(1950.0);
            let off = value.per_hour[1] - slope / mean;
            vec![
                off / value.per_hour_se[1],
                (value.flicker - flicker) / value.flicker_se,
            ]
        };
        (0..n).into_par_iter().map(one).collect()
    };
    let good = verdict(&pulls(|t| 1.0 - 0.02 * t / 3600.0, 100));
    println!("{good:?}");
    assert!(good.is_ok(), "{good:?}");
    // Negative control: it falls faster.
    let bad = verdict(&pulls(|t| 1.0 - 0.03 * t / 3600.0, 20));
    assert!(bad.is_err(), "{bad:?}");
}

#[test]
fn a_lamp_that_warms_up_settles_and_one_that_flickers_is_out_of_tolerance() {
    let warming = visits(1, 40, |t| 1.0 - 0.08 * (-t / 300.0).exp(), 0.0);
    let made = drift_of(&warming, 1).unwrap();
    let value = &made.dated.value;
    // 0.08 exp(-t/300) = 0.005 at 832 s: the visit after that.
    assert!(
        (800.0..=1000.0).contains(&value.settled_after_s),
        "{value:?}"
    );
    assert!(
        made.warnings
            .iter()
            .any(|w| w.contains("not a straight line")),
        "{made:?}"
    );
    let steady = drift_of(&visits(1, 40, |_| 1.0, 0.0), 1).unwrap();
    assert_eq!(steady.dated.value.settled_after_s, 0.0);
    assert!(
        steady.faults.is_empty() && steady.dated.value.flicker < 5e-4,
        "{steady:?}"
    );
    let flickers = drift_of(&visits(1, 40, |_| 1.0, 0.02), 1).unwrap();
    assert!(
        flickers.faults.iter().any(|f| f.contains("flickers by")),
        "{flickers:?}"
    );
    let few = drift_of(&visits(1, 2, |_| 1.0, 0.0), 1)
        .unwrap_err()
        .report();
    assert!(
        few.contains("too few visits of the reference pose: 2") && few.contains("hint:"),
        "{few}"
    );
}

#[test]
fn the_command_writes_dated_files_prints_tables_and_tells_what_is_out_of_tolerance() {
    let folder = folder();
    let session = folder.path().join("s");
    let mut list = timed(whites());
    record(&session, &sensor(), &list, 1);
    let run = |arguments: &[&str]| {
        let mut command = assert_cmd::Command::cargo_bin("goniofit").unwrap();
        let done = command
            .current_dir(folder.path())
            .arg("calibrate")
            .args(arguments)
            .output()
            .unwrap();
        let text = |b: &[u8]| String::from_utf8(b.to_vec()).unwrap();
        (
            done.status.code().unwrap(),
            text(&done.stdout),
            text(&done.stderr),
        )
    };
    let (code, out, err) = run(&["dark", "s"]);
    assert_eq!(code, 0, "{err}");
    assert!(
        out.contains("read noise 2.0")
            && err.contains("wrote calibration/bench/2024-02-29_dark.json"),
        "{out}{err}"
    );
    let (code, out, err) = run(&[
        "white",
        "s",
        "--panel",
        "P1",
        "--factor",
        "1.01,1.0,0.99",
        "--factor-se",
        "0.004",
        "--json",
    ]);
    assert_eq!(code, 0, "{err}");
    assert!(
        out.contains("\"panel\": \"P1\"") && err.contains("2024-02-29_white.json"),
        "{out}{err}"
    );
    for shot in list.iter_mut().skip(20) {
        shot.lamp = 1.03;
    }
    record(&folder.path().join("uneasy"), &sensor(), &list, 1);
    let (code, _, err) = run(&["white", "uneasy"]);
    assert_eq!(code, 1, "{err}");
    assert!(
        err.contains("warning: the exposures of the white standard disagree")
            && err.contains("2024-02-29b_white.json"),
        "{err}"
    );
    let (code, _, err) = run(&["drift", "s"]);
    assert_eq!(code, 2);
    assert!(
        err.contains("has no reference frames") && err.contains("hint:"),
        "{err}"
    );
    for name in ["dark", "linearity", "flat", "white", "drift"] {
        let (code, out, _) = run(&[name, "--help"]);
        assert!(code == 0 && out.contains("Examples:"), "{out}");
    }
}
