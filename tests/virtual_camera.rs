//! Promise: the virtual sessions that measuring and calibrating are tested with show what they state: the truth is the
//! mean over the sample, series reach from dark to clipped, boards, charts and panels read what they are.
#![allow(clippy::unwrap_used, missing_docs)]

mod virtual_session;

use goniofit::measure::{RawFrame, decode_file};
use goniofit::session::{FrameKind, FrameRecord, Projection, SessionFolder};
use std::collections::BTreeMap;
use virtual_session::calibration::{BOARD_POSES, exposure_for};
use virtual_session::pictures::{Board, Chart, Panel};
use virtual_session::{
    Purpose, SAMPLE_SQUARE_MM, Setup, TRUE_WHITE, calibration, folder, true_white,
};

const SEED: u64 = 20_260_801;

fn frames(session: &SessionFolder, kind: FrameKind) -> Vec<(FrameRecord, RawFrame)> {
    let records = session.frames().unwrap().into_iter();
    records
        .filter(|r| r.kind == kind)
        .map(|r| {
            let frame = decode_file(&session.frame_path(&r.file)).unwrap();
            (r, frame)
        })
        .collect()
}

/// Mean raw value less black of a channel over pixels within `reach` pixels of an image point.
fn mean_at(frame: &RawFrame, [x0, y0]: [f64; 2], reach: f64, channel: usize) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for (i, &v) in frame.data.iter().enumerate() {
        let (x, y) = (i % frame.width, i / frame.width);
        let near = (x as f64 + 0.5 - x0).abs().max((y as f64 + 0.5 - y0).abs()) < reach;
        if near && frame.values_at(x, y).any(|(c, _)| c == channel) {
            sum += f64::from(v) - frame.black[frame.layout.place(frame.width, i)];
            count += 1.0;
        }
    }
    assert!(count > 0.0);
    sum / count
}

/// A rig without faults but those a test adds.
fn plain() -> Setup {
    Setup::new(SEED)
}

#[test]
fn the_cloth_has_the_stated_mean_in_every_configuration() {
    for glints in [0, 6] {
        let setup = Setup {
            glints,
            ..Setup::faulty(SEED)
        };
        let camera = setup.camera(Purpose::Measurement, &setup.sensor);
        for (pose, truth) in setup.configurations().iter().zip(&setup.poses) {
            let mean = camera.true_mean(pose, SAMPLE_SQUARE_MM).unwrap();
            for c in 0..3 {
                assert!(
                    (mean[c] / truth.2[c] - 1.0).abs() < 1e-5,
                    "{mean:?} {truth:?}"
                );
            }
        }
    }
}

#[test]
fn the_panel_is_not_lambertian() {
    let reference = true_white().configuration;
    let panel = Panel {
        factor: TRUE_WHITE,
        reference,
    };
    let same = panel.reflectance_factor(&reference);
    assert!(
        (0..3).all(|c| (same[c] - TRUE_WHITE[c]).abs() < 1e-12),
        "{same:?}"
    );
    let at = |light: (f64, f64), camera: f64| {
        let mut pose = reference;
        pose.light = goniofit::math::PolarDirection::from_degrees(light.0, light.1);
        pose.camera = goniofit::math::PolarDirection::from_degrees(camera, 0.0);
        panel.reflectance_factor(&pose)[1] / TRUE_WHITE[1]
    };
    let (back, forward) = (at((64.0, 0.0), 48.0), at((32.0, 180.0), 32.0));
    assert!(
        (0.83..0.93).contains(&back) && (0.98..1.06).contains(&forward),
        "{back} {forward}"
    );
}

#[test]
fn a_linearity_series_reaches_from_one_percent_to_clipped() {
    let folder = folder();
    let session = calibration::linearity(folder.path(), &plain(), 2, true);
    let whites = frames(&session, FrameKind::White);
    let green = |frame: &RawFrame| mean_at(frame, [49.3, 42.2], 12.0, 1) / 3967.0;
    let levels: Vec<f64> = whites.iter().map(|(_, f)| green(f)).collect();
    let lowest = levels.iter().copied().fold(1.0, f64::min);
    assert!((0.01..0.03).contains(&lowest), "{levels:?}");
    assert!(levels.iter().any(|l| (0.8..0.95).contains(l)) && levels.iter().any(|&l| l > 0.999));
    // Pairs, darks of every exposure, and a visit after each.
    let mut exposures = BTreeMap::new();
    for (record, _) in &whites {
        *exposures.entry(record.exposure_ms.to_bits()).or_insert(0) += 1;
    }
    assert!(exposures.len() == 11 && exposures.values().all(|&n| n == 2));
    for (record, _) in frames(&session, FrameKind::Dark) {
        assert!(exposures.contains_key(&record.exposure_ms.to_bits()));
    }
    let visits = frames(&session, FrameKind::Reference);
    assert_eq!(visits.iter().map(|(r, _)| r.visit).max(), Some(10));
    // The curve shows: raw values per millisecond fall as they are told to.
    let mut bent = plain();
    bent.sensor.faults.nonlinearity = [0.05, 0.0];
    let other = virtual_session::folder();
    let session = calibration::linearity(other.path(), &bent, 2, false);
    for ((_, frame), (_, straight)) in frames(&session, FrameKind::White).iter().zip(&whites) {
        let (q, raw) = (green(straight), green(frame));
        let expected = q * (1.0 - 0.05 * q);
        assert!(
            q > 0.9 || (raw - expected).abs() < 2e-3 * q + 3e-4,
            "{raw} {expected}"
        );
    }
}

#[test]
fn flats_show_the_sensor_and_nothing_else() {
    let folder = folder();
    let setup = plain();
    let session = calibration::flats(folder.path(), &setup, 4, 2);
    let flats = frames(&session, FrameKind::Flat);
    let exposure_ms = exposure_for(&setup, [1.0; 3], 0.4);
    assert_eq!(
        (flats.len(), frames(&session, FrameKind::Dark).len()),
        (4, 2)
    );
    for (record, frame) in &flats {
        assert!((record.exposure_ms / exposure_ms - 1.0).abs() < 1e-12);
        for at in [[50.0, 42.0], [10.0, 10.0], [90.0, 70.0]] {
            let light = setup.sensor.vignette(at[0], at[1]);
            let expected = 60.0 * exposure_ms * light;
            let mean = mean_at(frame, at, 4.0, 1);
            assert!((mean / expected - 1.0).abs() < 0.01, "{mean} {expected}");
        }
    }
}

#[test]
fn boards_and_charts_lie_where_the_projection_says() {
    let folder = folder();
    let setup = plain();
    let session = calibration::board(folder.path(), &setup);
    let boards = frames(&session, FrameKind::Board);
    assert_eq!(boards.len(), 2 * BOARD_POSES.len());
    let board = Board {
        columns: 5,
        rows: 4,
        square_mm: 2.0,
    };
    for (record, frame) in boards.iter().filter(|(r, _)| r.repeat == 0) {
        let plan = session.plan().unwrap();
        let pose = plan.configuration(record.config.unwrap()).unwrap();
        let projection = Projection::new(&setup.sensor.facts(), pose);
        for i in 0..board.columns * board.rows {
            let (column, row) = (i % board.columns, i / board.columns);
            let middle = |k: usize, n: usize| (k as f64 + 0.5 - 0.5 * n as f64) * board.square_mm;
            let at = [middle(column, board.columns), middle(row, board.rows)];
            let mean = mean_at(frame, projection.to_pixel(at), 1.2, 1);
            let white = mean_at(frame, projection.to_pixel([0.0, 4.7]), 1.0, 1);
            let black = (column + row) % 2 == 0;
            assert!(
                (mean < 0.5 * white) == black,
                "{pose:?} square {i}: {mean} {white}"
            );
        }
    }
    let other = virtual_session::folder();
    let (session, patches) = calibration::chart(other.path(), &setup, 2);
    let (record, frame) = &frames(&session, FrameKind::Chart)[0];
    let plan = session.plan().unwrap();
    let pose = plan.configuration(record.config.unwrap()).unwrap();
    let projection = Projection::new(&setup.sensor.facts(), pose);
    let chart = Chart {
        patches: patches.clone(),
        patch_mm: 1.5,
        pitch_mm: 1.8,
    };
    let cosine = pose.light.theta.cos();
    for (i, patch) in patches.iter().enumerate() {
        let at = projection.to_pixel(chart.center_mm(i));
        for c in 0..3 {
            let rate = setup.sensor.responsivity[c] * patch.camera[c] * cosine;
            let expected = record.exposure_ms * rate * setup.sensor.vignette(at[0], at[1]);
            let mean = mean_at(frame, at, 3.5, c);
            assert!(
                (mean - expected).abs() < 0.02 * expected + 12.0,
                "patch {i}: {mean} {expected}"
            );
        }
    }
}

#[test]
fn the_charts_colors_follow_from_spectra() {
    let patches = virtual_session::colors::patches(SEED);
    // Grays are gray to the camera and in sRGB.
    for (patch, gray) in patches[18..]
        .iter()
        .zip([0.9, 0.59, 0.36, 0.19, 0.09, 0.033])
    {
        for c in 0..3 {
            assert!((patch.camera[c] - gray).abs() < 1e-12);
            assert!(
                (patch.srgb[c] - gray).abs() < 1e-3 * gray,
                "{patch:?} {gray}"
            );
        }
    }
    // A 3 x 3 matrix explains most of it, but not all: the camera is no standard observer.
    let saturated = patches[..18].iter().filter(|p| {
        let spread = |v: [f64; 3]| v.iter().fold(0.0, |a: f64, &b| a.max((b - v[1]).abs()));
        spread(p.camera) > 0.05
    });
    assert!(saturated.count() > 8, "{patches:?}");
}

#[test]
fn visits_of_an_hour_follow_the_lamp() {
    let folder = folder();
    let law = |t: f64| [1.0 - 0.1 * t / 3600.0; 3];
    let session = calibration::drift(folder.path(), &plain(), 12, law);
    let visits = frames(&session, FrameKind::Reference);
    assert_eq!(visits.len(), 12);
    let level = |i: usize| mean_at(&visits[i].1, [49.3, 42.2], 20.0, 1);
    for i in 0..12 {
        let t = (3.0 + 300.0 * i as f64) / 3600.0;
        let ratio = level(i) / level(0);
        let expected = (1.0 - 0.1 * t) / (1.0 - 0.1 * 3.0 / 3600.0);
        assert!(
            (ratio / expected - 1.0).abs() < 5e-3,
            "visit {i}: {ratio} {expected}"
        );
    }
}

#[test]
fn glints_clip_some_pixels_of_long_exposures_only() {
    let setup = Setup {
        glints: 6,
        poses: vec![(0.0, 0.0, [0.3; 3])],
        ..plain()
    };
    let folder = folder();
    let session = virtual_session::record(folder.path(), &setup);
    let clipped = |frame: &RawFrame| frame.data.iter().filter(|&&v| v == frame.white).count();
    for (record, frame) in frames(&session, FrameKind::Sample) {
        let n = clipped(&frame);
        if record.exposure_ms < 5.0 {
            assert_eq!(n, 0);
        } else if record.exposure_ms > 60.0 {
            assert!((20..2000).contains(&n), "{n}");
        }
    }
}

#[test]
fn two_sessions_of_a_rig_share_its_pattern_but_not_its_noise() {
    let setup = Setup::faulty(SEED);
    let (a, b) = (folder(), folder());
    let dark = |session: SessionFolder| frames(&session, FrameKind::Dark).remove(0).1.data;
    let first = dark(calibration::darks(a.path(), &setup, &[64.0], 1));
    let second = dark(virtual_session::record(
        b.path(),
        &Setup {
            dark_exposures_ms: vec![64.0],
            ..setup.clone()
        },
    ));
    let hot = |data: &[u16]| -> Vec<usize> { (0..data.len()).filter(|&i| data[i] > 200).collect() };
    let (here, there) = (hot(&first), hot(&second));
    let common = here.iter().filter(|i| there.contains(i)).count();
    assert!(
        common >= 1 && 10 * common >= 7 * here.len(),
        "{here:?} {there:?}"
    );
    let equal = first.iter().zip(&second).filter(|(a, b)| a == b).count();
    assert!(equal < first.len() / 2, "{equal}");
}
