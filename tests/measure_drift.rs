//! Promise: a lamp that drifts is followed by the frames of the reference pose, within the stated errors, and what those
//! frames cannot tell is said; frames that only chose exposures never change a number.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

mod virtual_session;

use goniofit::base::Unwatched;
use goniofit::measure::{MeasureOptions, MeasureReport, measure_session};
use goniofit::session::{Measurements, SessionFolder};
use virtual_session::pulls::{pulls, seed, verdict};
use virtual_session::{Setup, folder, record};

fn measure(session: &SessionFolder) -> (Measurements, MeasureReport) {
    measure_session(session, &MeasureOptions::default(), &Unwatched).unwrap()
}

fn measured(setup: &Setup) -> (Measurements, MeasureReport) {
    let folder = folder();
    measure(&record(folder.path(), setup))
}

/// Sixteen sample shots of four configurations, the reference after every second one. No error of the standard, which
/// would hide the lamp's, and no grain finer than the pixels, whose error is only estimated.
fn visited(seed: u64) -> Setup {
    Setup {
        exposures_ms: vec![16.0, 64.0],
        dark_exposures_ms: vec![16.0, 64.0],
        sample_repeats: 2,
        reference_every: 2,
        white_se: 0.0,
        grain: 0.0,
        ..Setup::new(seed)
    }
}

/// Warms up and fades: 8 % in all, steepest at the end, each color in its own way.
fn smooth(x: f64, _: usize) -> [f64; 3] {
    [0.08, 0.07, 0.09].map(|d| 1.0 - d * x * x + 0.01 * (3.0 * x).sin())
}

fn straight(x: f64, _: usize) -> [f64; 3] {
    [0.08, 0.07, 0.09].map(|d| 1.0 - d * x)
}

/// Comes back 10 % fainter after the interruption.
fn step(x: f64, stretch: usize) -> [f64; 3] {
    [[1.0, 0.9], [1.0, 0.91], [1.0, 0.89]].map(|b| b[stretch] * (1.0 - 0.01 * x))
}

/// Largest relative deviation from the truth.
fn worst(setup: &Setup, measured: &Measurements) -> f64 {
    let pairs = measured.intensities.iter().zip(&setup.poses);
    pairs
        .flat_map(|(m, &(_, _, truth))| (0..3).map(move |c| (m.mean[c] / truth[c] - 1.0).abs()))
        .fold(0.0, f64::max)
}

#[test]
fn a_smoothly_drifting_lamp_is_followed_within_stated_errors() {
    // 40 sessions of 12 pulls see standard errors off by 30 % and a bias of 0.3 standard errors.
    let seed = seed(20_261_101);
    let good = verdict(&pulls(40, |i| Setup {
        lamp: Some(smooth),
        reference_every: 1,
        ..visited(seed + i)
    }));
    println!("{good:?}");
    assert!(good.is_ok(), "{good:?}");
    // Negative control: without the reference the drift is in the numbers.
    let bad = verdict(&pulls(10, |i| Setup {
        lamp: Some(smooth),
        reference_every: 0,
        ..visited(seed + 1000 + i)
    }));
    println!("{bad:?}");
    assert!(bad.is_err(), "a drifting lamp passed: {bad:?}");
}

#[test]
fn what_the_reference_frames_add_to_the_error_is_right() {
    // Faint reference frames make their noise the largest part of the budget. It also bends the line through the visits,
    // so the stated error is some 10 % too large here; 40 sessions see it off by 30 %.
    let seed = seed(20_261_102);
    let faint = |i| Setup {
        lamp: Some(straight),
        reference_exposures_ms: vec![16.0],
        reference_mean: [0.03, 0.03, 0.03],
        poses: vec![(0.0, 0.0, [0.9, 1.1, 0.7]), (48.0, 90.0, [0.3, 0.25, 0.2])],
        ..visited(seed + i)
    };
    let (_, report) = measured(&faint(0));
    for c in &report.configurations {
        for b in c.budget {
            assert!(b.drift > 2.0 * b.shot, "{b:?}");
        }
    }
    let good = verdict(&pulls(40, faint));
    println!("{good:?}");
    assert!(good.is_ok(), "{good:?}");
}

#[test]
fn a_lamp_that_comes_back_fainter_is_seen() {
    let seed = seed(20_261_103);
    let setup = |i| Setup {
        lamp: Some(step),
        breaks: vec![7],
        poses: vec![
            (0.0, 0.0, [0.9, 1.1, 0.7]),
            (48.0, 90.0, [0.3, 0.25, 0.2]),
            (80.0, 90.0, [0.5, 0.4, 0.45]),
        ],
        ..visited(seed + i)
    };
    let good = verdict(&pulls(20, setup));
    println!("{good:?}");
    assert!(good.is_ok(), "{good:?}");
    let (_, report) = measured(&setup(0));
    let first_of_second = report.lamp.visits.iter().find(|v| v.stretch == 1).unwrap();
    for (c, level) in [0.9, 0.91, 0.89].into_iter().enumerate() {
        let x = first_of_second.level[c] / level;
        assert!(
            (x - 0.995).abs() < 6.0 * first_of_second.standard_error[c] + 0.003,
            "{x}"
        );
    }
    // A step between stretches is no reason to visit more often, but the lamp did change.
    let about = |text: &str| report.warnings.iter().any(|w| w.contains(text));
    assert!(
        about("over the session") && !about("between reference visits"),
        "{:?}",
        report.warnings
    );
    // Negative control: the same journal without its second beginning takes the step for a slope.
    let folder = folder();
    let session = record(folder.path(), &setup(0));
    let (right, _) = measure(&session);
    let journal = std::fs::read_to_string(session.journal_path()).unwrap();
    let mut begun = 0;
    let one_stretch: String = journal
        .lines()
        .map(|line| {
            begun += usize::from(line.contains("\"ready\""));
            let finished = "\"event\":\"finished\"";
            match begun {
                2 if line.contains("\"ready\"") => {
                    let (head, _) = line.split_once("\"event\"").unwrap();
                    format!("{head}{finished}}}\n")
                }
                _ => format!("{line}\n"),
            }
        })
        .collect();
    std::fs::write(session.journal_path(), one_stretch).unwrap();
    let (wrong, report) = measure(&session);
    assert!(
        worst(&setup(0), &right) < 0.01,
        "{}",
        worst(&setup(0), &right)
    );
    assert!(
        worst(&setup(0), &wrong) > 0.015,
        "{}",
        worst(&setup(0), &wrong)
    );
    assert!(
        report
            .warnings
            .iter()
            .any(|w| w.contains("visit the reference more often"))
    );
}

#[test]
fn the_visits_are_reported_with_time_level_and_error() {
    let setup = Setup {
        lamp: Some(smooth),
        ..visited(4)
    };
    let (measured, report) = measured(&setup);
    let visits = &report.lamp.visits;
    // At the beginning, after every second of 16 shots, and once more at the end.
    assert_eq!(visits.len(), 10);
    assert_eq!(visits[0].level, [1.0; 3]);
    assert_eq!(visits[0].standard_error, [0.0; 3]);
    let (start, end) = (visits[0].elapsed_s, visits[9].elapsed_s);
    for visit in &visits[1..] {
        let x = (visit.elapsed_s - start) / (end - start);
        for (c, truth) in smooth(x, 0).into_iter().enumerate() {
            let z = (visit.level[c] - truth) / visit.standard_error[c];
            assert!(
                z.abs() < 5.0 && visit.standard_error[c] < 0.005,
                "{visit:?} {truth}"
            );
        }
    }
    assert!(
        report
            .warnings
            .iter()
            .any(|w| w.contains("over the session")),
        "{:?}",
        report.warnings
    );
    assert!(report.lamp.before_first_visit.unwrap()[0].abs() < 0.05);
    for (m, c) in measured.intensities.iter().zip(&report.configurations) {
        for channel in 0..3 {
            assert!(c.budget[channel].drift > 0.0);
            assert_eq!(c.budget[channel].total(), m.standard_error[channel]);
        }
    }
    let json = serde_json::to_value(&report).unwrap();
    assert!(json["lamp"]["visits"][1]["level"][0].is_number());
    // Without reference frames nothing is corrected and nothing is claimed.
    let (_, report) = self::measured(&Setup {
        reference_every: 0,
        ..visited(4)
    });
    let of_lamp = |w: &&String| w.contains("lamp") || w.contains("reference");
    assert!(report.lamp.visits.is_empty());
    assert_eq!(report.warnings.iter().find(of_lamp), None);
    assert!(
        report
            .configurations
            .iter()
            .all(|c| c.budget[0].drift == 0.0)
    );
}

#[test]
fn a_saturated_reference_exposure_is_left_out() {
    // At 64 ms the texture's crests of a mean of 0.8 pass the usable range.
    let setup = Setup {
        lamp: Some(smooth),
        reference_exposures_ms: vec![16.0, 64.0],
        reference_mean: [0.8; 3],
        ..visited(6)
    };
    let (measured, report) = measured(&setup);
    assert!(report.lamp.visits.iter().all(|v| v.exposures_ms == [16.0]));
    assert!(worst(&setup, &measured) < 0.015);
    // A visit with nothing usable is left out and told: the lamp becomes too bright for 64 ms half way.
    fn brighter(x: f64, _: usize) -> [f64; 3] {
        [1.0 + 0.5 * x; 3]
    }
    let (_, report) = self::measured(&Setup {
        lamp: Some(brighter),
        reference_exposures_ms: vec![64.0],
        reference_mean: [0.5; 3],
        ..visited(6)
    });
    let told = report
        .warnings
        .iter()
        .any(|w| w.contains("saturated in every exposure"));
    assert!(
        told && report.lamp.visits.len() < 10,
        "{:?}",
        report.warnings
    );
}

#[test]
fn a_stretch_without_a_visit_is_told_and_widens_the_error() {
    let setup = Setup {
        lamp: Some(step),
        breaks: vec![8],
        unvisited: vec![1],
        ..visited(7)
    };
    let (measured, report) = measured(&setup);
    let told = report
        .warnings
        .iter()
        .any(|w| w.contains("no reference frame in stretch 1"));
    assert!(told, "{:?}", report.warnings);
    for (i, c) in report.configurations.iter().enumerate() {
        for channel in 0..3 {
            let relative = c.budget[channel].drift / measured.intensities[i].mean[channel];
            // Two configurations were shot before the interruption, two after it.
            if i < 2 {
                assert!(relative < 0.005, "{relative}");
            } else {
                assert!((0.02..0.03).contains(&relative), "{relative}");
            }
        }
    }
}

#[test]
fn a_dark_reference_is_refused() {
    let folder = folder();
    let mut setup = visited(9);
    setup.reference_mean = [0.0; 3];
    for black in &mut setup.dark_sensor.black {
        *black += 4.0;
    }
    let session = record(folder.path(), &setup);
    let error = measure_session(&session, &MeasureOptions::default(), &Unwatched).unwrap_err();
    let text = error.report();
    assert!(
        text.contains("reference visit 0: red is not brighter than the dark")
            && text.contains("_reference_16ms.dng")
            && text.contains("hint:"),
        "{text}"
    );
}

#[test]
fn the_command_lists_the_visits() {
    let folder = folder();
    let session = record(
        folder.path(),
        &Setup {
            lamp: Some(smooth),
            ..visited(10)
        },
    );
    let root = session.root().to_str().unwrap();
    let mut command = assert_cmd::Command::cargo_bin("goniofit").unwrap();
    let output = command.args(["measure", "session", root]).output().unwrap();
    let table = String::from_utf8(output.stdout).unwrap();
    let visits = table.lines().skip_while(|l| !l.starts_with("# visit"));
    let visits: Vec<&str> = visits
        .skip(1)
        .take_while(|l| !l.contains("white"))
        .collect();
    assert_eq!(visits.len(), 10, "{table}");
    assert!(visits[0].contains("1.00000 +- 0.00000"), "{table}");
    assert!(table.contains("# white frames are taken as shot at the first visit's level"));
    let told = String::from_utf8(output.stderr).unwrap();
    assert!(told.contains("warning: the lamp changed by"), "{told}");
    assert!(Measurements::read(&session.root().join("measurements.csv")).is_ok());
}
