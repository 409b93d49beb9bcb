//! Promise: a session is measured as docs/measure.md says, and every broken one is refused with the frame or
//! configuration at fault and what to do; nothing is overwritten.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

mod virtual_session;

use goniofit::base::{Result, Unwatched};
use goniofit::measure::{Condition, MeasureOptions, MeasureReport, measure_session};
use goniofit::session::{Measurements, SessionFolder};
use virtual_session::{Setup, folder, record};

fn measure(session: &SessionFolder) -> Result<(Measurements, MeasureReport)> {
    measure_session(session, &MeasureOptions::default(), &Unwatched)
}

fn small() -> Setup {
    Setup {
        exposures_ms: vec![16.0, 64.0],
        dark_exposures_ms: vec![16.0, 64.0],
        poses: vec![(0.0, 0.0, [0.4, 0.5, 0.3]), (64.0, 90.0, [0.2, 0.1, 0.15])],
        dark_repeats: 2,
        ..Setup::new(5)
    }
}

/// The message of measuring a session made of `setup` and then damaged.
fn refusal(setup: &Setup, damage: impl Fn(&SessionFolder)) -> String {
    let folder = folder();
    let session = record(folder.path(), setup);
    damage(&session);
    measure(&session).unwrap_err().report()
}

fn edit(session: &SessionFolder, file: &str, from: &str, to: &str) {
    let path = session.root().join(file);
    let text = std::fs::read_to_string(&path).unwrap();
    assert!(text.contains(from), "{from} is not in {text}");
    std::fs::write(&path, text.replace(from, to)).unwrap();
}

fn expect(message: &str, parts: &[&str]) {
    for part in parts.iter().chain(&["hint:"]) {
        assert!(message.contains(part), "'{part}' is not in: {message}");
    }
}

#[test]
fn a_whole_session_is_measured_the_same_way_on_any_number_of_threads() {
    let folder = folder();
    let setup = small();
    let session = record(folder.path(), &setup);
    let (measured, report) = measure(&session).unwrap();
    assert!(!report.outside_tolerance() && report.synthetic);
    // Two configurations do not tell flicker from noise, and nothing is known of the poses.
    assert!(
        matches!(&report.warnings[..], [one, two] if one.contains("too few repeats")
            && two.contains("no geometry calibration")),
        "{report:?}"
    );
    assert_eq!((report.frames, report.hot_pixels), (4 + 4 + 4, 0));
    assert_eq!(report.noise.source, "frame pairs");
    // The sensor's gain is 2.5 electrons per raw value.
    let slope = report.noise.variance_per_signal[0];
    assert!(
        (slope - 0.4).abs() < 5.0 * report.noise.variance_per_signal_se[0],
        "{slope}"
    );
    assert!((report.noise.variance_per_signal_se[0] / slope) < 0.02);
    for (found, truth) in report
        .white
        .responsivity
        .iter()
        .zip(setup.sensor.responsivity)
    {
        assert!(
            (found / truth - 1.0).abs() < 0.01,
            "{found} against {truth}"
        );
    }
    // One thread and a changed journal order of kinds make no difference.
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .unwrap();
    assert_eq!(
        pool.install(|| measure(&session).unwrap()),
        (measured.clone(), report.clone())
    );
    // The budget adds up to the standard error, and the session survives its own file.
    for (i, c) in measured.intensities.iter().zip(&report.configurations) {
        for channel in 0..3 {
            assert_eq!(i.standard_error[channel], c.budget[channel].total());
        }
    }
    assert_eq!(
        Measurements::from_csv(&measured.to_csv().unwrap()).unwrap(),
        measured
    );
}

#[test]
fn broken_sessions_name_the_frame_at_fault() {
    let frame = "0008_sample_c01_16ms.dng";
    let missing = refusal(&small(), |s| {
        std::fs::remove_file(s.frame_path(frame)).unwrap()
    });
    expect(&missing, &[frame, "configuration 1, 16 ms", "is missing"]);
    let torn = refusal(&small(), |s| {
        let bytes = std::fs::read(s.frame_path(frame)).unwrap();
        std::fs::write(s.frame_path(frame), &bytes[..bytes.len() / 2]).unwrap();
    });
    expect(&torn, &[frame, "configuration 1", "SHA-256", "journal has"]);
    let size = refusal(&small(), |s| {
        edit(s, "session.json", "\"width\": 100", "\"width\": 102");
    });
    expect(
        &size,
        &["0000_dark_16ms.dng", "100 x 84 pixels", "102 x 84"],
    );
    let time = refusal(&small(), |s| {
        edit(
            s,
            "journal.jsonl",
            "\"exposure_ms\":64.0",
            "\"exposure_ms\":32.0",
        );
    });
    expect(&time, &["(dark, 32 ms)", "by EXIF", "exposed 64 ms"]);
    let foreign = refusal(&small(), |s| {
        edit(s, "journal.jsonl", "\"config\":2", "\"config\":9")
    });
    expect(
        &foreign,
        &["0010_sample_c02_16ms.dng", "no configuration of the plan"],
    );
    let crop = refusal(&small(), |s| {
        edit(
            s,
            "session.json",
            "\"sample_square_mm\": 10.0",
            "\"sample_square_mm\": 14.0",
        );
    });
    expect(&crop, &["configuration 1: the crop leaves the image by"]);
}

#[test]
fn darks_must_be_there_and_be_dark() {
    let no_dark = refusal(
        &Setup {
            dark_exposures_ms: vec![16.0],
            ..small()
        },
        |_| (),
    );
    expect(
        &no_dark,
        &["64 ms", "no dark frame of its exposure", "16 ms"],
    );
    let mut lit = small();
    for black in &mut lit.dark_sensor.black {
        *black += 200.0;
    }
    expect(
        &refusal(&lit, |_| ()),
        &[
            "0010_sample_c02_16ms.dng (configuration 2",
            "dark frame is brighter",
        ],
    );
    let none = Setup {
        dark_repeats: 0,
        ..small()
    };
    expect(&refusal(&none, |_| ()), &["no dark frames"]);
    let no_white = Setup {
        white_repeats: 0,
        ..small()
    };
    expect(&refusal(&no_white, |_| ()), &["no white frames"]);
}

#[test]
fn saturated_and_under_exposed_configurations_are_told_and_the_rest_is_measured() {
    let mut setup = small();
    setup.poses.push((32.0, 0.0, [30.0, 30.0, 30.0]));
    setup.poses.push((32.0, 0.0, [0.0004, 0.0004, 0.0004]));
    let session_folder = folder();
    let session = record(session_folder.path(), &setup);
    let (measured, report) = measure(&session).unwrap();
    let condition = |i: usize| report.configurations[i].condition;
    assert_eq!(
        (condition(0), condition(1)),
        (Condition::Good, Condition::Good)
    );
    assert_eq!(condition(2), Condition::Saturated);
    assert_eq!(condition(3), Condition::UnderExposed);
    assert!(report.outside_tolerance());
    let message = report.configurations[2].message.as_ref().unwrap();
    assert!(
        message.contains("configuration 3 is saturated") && message.contains("sample_c03_16ms.dng"),
        "{message}"
    );
    assert!(
        message.contains("columns") && message.contains("rows"),
        "{message}"
    );
    assert!(measured.intensities.iter().all(|i| i.configuration.id != 3));
    // The bright exposure of configuration 1 (64 ms x 0.5 x 60 = 1920) counts, and no clipped one does.
    assert_eq!(report.configurations[0].exposures_ms, [16.0, 64.0]);

    setup.poses = vec![(32.0, 0.0, [30.0, 30.0, 30.0])];
    let all = refusal(&setup, |_| ());
    expect(
        &all,
        &[
            "no configuration could be measured",
            "configuration 1 is saturated",
        ],
    );
    let mut white = small();
    white.sensor.responsivity = [400.0; 3];
    white.poses = vec![(0.0, 0.0, [0.02; 3])];
    expect(
        &refusal(&white, |_| ()),
        &["white standard is saturated", "white_16ms"],
    );
}

#[test]
fn an_exposure_with_a_few_bright_pixels_is_used_without_them() {
    // Mean signal of green at 64 ms is 1.04 of the usable range, so half of the texture passes it.
    let mut setup = small();
    setup.poses = vec![(0.0, 0.0, [0.9, 1.1, 0.9])];
    let folder = folder();
    let session = record(folder.path(), &setup);
    let (measured, report) = measure(&session).unwrap();
    let configuration = &report.configurations[0];
    assert_eq!(configuration.exposures_ms, [16.0, 64.0]);
    let [(exposure_ms, masked)] = configuration.masked[..] else {
        panic!("{configuration:?}");
    };
    assert!(
        exposure_ms == 64.0 && (1000..12000).contains(&masked),
        "{masked}"
    );
    let error = |measured: &Measurements| {
        let m = &measured.intensities[0];
        (m.mean[1] - 1.1).abs() / m.standard_error[1]
    };
    assert!(error(&measured) < 4.0, "{measured:?}");
    // Negative control: the crests counted as the sensor cut them off.
    let blind = MeasureOptions {
        usable_fraction: 2.0,
        ..MeasureOptions::default()
    };
    let (wrong, _) = measure_session(&session, &blind, &Unwatched).unwrap();
    assert!(error(&wrong) > 4.0, "{wrong:?}");
}

#[test]
fn one_exposure_without_repeats_still_has_a_noise_estimate() {
    let setup = Setup {
        exposures_ms: vec![16.0],
        dark_exposures_ms: vec![16.0],
        white_repeats: 1,
        dark_repeats: 1,
        ..small()
    };
    let folder = folder();
    let session = record(folder.path(), &setup);
    let (_, report) = measure(&session).unwrap();
    assert_eq!(report.noise.source, "white residuals");
    assert_eq!(report.warnings.len(), 4);
    let noise = &report.noise;
    assert!((noise.variance_per_signal[0] - 0.4).abs() < 5.0 * noise.variance_per_signal_se[0]);
    let sigma = noise.dark_sigma[0].1;
    assert!((sigma - 2.03).abs() < 0.1, "{sigma}");
}

#[test]
fn the_command_writes_once_and_tells_by_its_exit_code() {
    let folder = folder();
    let mut setup = small();
    let session = record(folder.path(), &setup);
    let goniofit = |args: &[&str]| {
        let mut command = assert_cmd::Command::cargo_bin("goniofit").unwrap();
        command.args(args).output().unwrap()
    };
    let root = session.root().to_str().unwrap();
    let first = goniofit(&["measure", "session", root]);
    let text = String::from_utf8(first.stdout).unwrap();
    assert_eq!(first.status.code(), Some(0), "{text}");
    assert!(
        text.starts_with("# synthetic") && text.contains("+-"),
        "{text}"
    );
    let csv = session.root().join("measurements.csv");
    let written = std::fs::read(&csv).unwrap();
    std::fs::write(&csv, "mine").unwrap();
    let second = goniofit(&["measure", "session", root]);
    assert_eq!(second.status.code(), Some(2));
    let error = String::from_utf8(second.stderr).unwrap();
    assert!(
        error.contains("exists already") && error.contains("--force"),
        "{error}"
    );
    assert_eq!(std::fs::read(&csv).unwrap(), b"mine");
    let json = goniofit(&["measure", "session", root, "--force", "--json"]);
    assert_eq!(std::fs::read(&csv).unwrap(), written);
    let value: serde_json::Value = serde_json::from_slice(&json.stdout).unwrap();
    assert_eq!(value["intensities"][1]["config"], 2);
    assert!(
        value["report"]["configurations"][0]["budget"][0]["shot"]
            .as_f64()
            .unwrap()
            > 0.0
    );

    let frame = session.frame_path("0008_sample_c01_16ms.dng");
    let frame = frame.to_str().unwrap();
    let json = goniofit(&["measure", "frame", frame, "--crop", "10,10,20,20", "--json"]);
    let value: serde_json::Value = serde_json::from_slice(&json.stdout).unwrap();
    assert_eq!(value["visible"]["width"], 100);
    assert_eq!(value["exposure_ms"], 16.0);
    assert_eq!(value["channels"][1]["channel"], "G1");
    assert_eq!(value["channels"][1]["pixels"], 100);
    let outside = goniofit(&["measure", "frame", frame, "--crop", "90,10,20,20"]);
    assert_eq!(outside.status.code(), Some(2));
    std::fs::write(
        folder.path().join("noise.dng"),
        b"II\x2a\0\x08\0\0\0\xff\xff",
    )
    .unwrap();
    let noise = folder.path().join("noise.dng");
    let torn = goniofit(&["measure", "frame", noise.to_str().unwrap()]);
    let error = String::from_utf8(torn.stderr).unwrap();
    assert!(
        torn.status.code() == Some(2) && !error.contains("panic"),
        "{error}"
    );

    setup.poses.push((32.0, 0.0, [30.0, 30.0, 30.0]));
    let partial = folder.path().join("partial");
    record(&partial, &setup);
    let partial = goniofit(&["measure", "session", partial.to_str().unwrap()]);
    assert_eq!(partial.status.code(), Some(1));
    let told = String::from_utf8(partial.stderr).unwrap();
    assert!(told.contains("configuration 3 is saturated"), "{told}");
}

#[test]
fn exposure_bracketing_in_linear_raw_recovers_a_known_radiance() {
    // Radiances over a range of 1 : 2000, which no single exposure covers.
    let setup = Setup {
        exposures_ms: vec![0.5, 8.0, 128.0, 1024.0],
        dark_exposures_ms: vec![0.5, 8.0, 128.0, 1024.0],
        poses: vec![
            (0.0, 0.0, [20.0, 16.0, 18.0]),
            (30.0, 0.0, [0.6, 0.5, 0.7]),
            (48.0, 90.0, [0.01, 0.012, 0.01]),
        ],
        white_se: 0.0,
        ..Setup::new(11)
    };
    let folder = folder();
    let session = record(folder.path(), &setup);
    let (measured, report) = measure(&session).unwrap();
    let used: Vec<&[f64]> = report
        .configurations
        .iter()
        .map(|c| &c.exposures_ms[..])
        .collect();
    // The darker half of the second one's texture can be seen in 128 ms.
    let brackets: [&[f64]; 3] = [&[0.5], &[0.5, 8.0, 128.0], &[0.5, 8.0, 128.0, 1024.0]];
    assert_eq!(used, brackets);
    let worst = |measured: &Measurements| {
        let pairs = measured.intensities.iter().zip(&setup.poses);
        let pulls = pairs.flat_map(|(m, &(_, _, truth))| {
            (0..3).map(move |c| ((m.mean[c] - truth[c]) / m.standard_error[c]).abs())
        });
        pulls.fold(0.0, f64::max)
    };
    for (m, &(_, _, truth)) in measured.intensities.iter().zip(&setup.poses) {
        for c in 0..3 {
            assert!(m.standard_error[c] < 0.015 * truth[c], "{m:?}");
        }
    }
    // Nine pulls at a family-wise level of 1e-3: 3.9 standard errors.
    assert!(worst(&measured) < 3.9, "{measured:?}");
    // Negative control: one exposure of the bracket 8 % longer than it says.
    edit(
        &session,
        "journal.jsonl",
        "\"exposure_ms\":1024.0",
        "\"exposure_ms\":948.0",
    );
    let (wrong, _) = measure(&session).unwrap();
    assert!(worst(&wrong) > 3.9, "{wrong:?}");
}

#[test]
fn darks_are_needed_only_for_exposures_that_are_used() {
    let setup = Setup {
        exposures_ms: vec![4.0, 16.0, 256.0],
        dark_exposures_ms: vec![4.0, 16.0],
        poses: vec![(0.0, 0.0, [0.9, 0.8, 0.7]), (64.0, 90.0, [0.6, 0.5, 0.4])],
        ..Setup::new(12)
    };
    let session_folder = folder();
    let session = record(session_folder.path(), &setup);
    let (measured, report) = measure(&session).unwrap();
    assert!(!report.outside_tolerance());
    assert_eq!(report.configurations[1].exposures_ms, [4.0, 16.0]);
    // A clipped exposure changes nothing, with or without its dark.
    let with = Setup {
        dark_exposures_ms: setup.exposures_ms.clone(),
        ..setup.clone()
    };
    let with_folder = folder();
    let session = record(with_folder.path(), &with);
    assert_eq!(measure(&session).unwrap().0, measured);
    // One that is used needs it.
    let dim = Setup {
        poses: vec![(0.0, 0.0, [0.05; 3])],
        ..setup
    };
    expect(
        &refusal(&dim, |_| ()),
        &["configuration 1, 256 ms", "no dark frame of its exposure"],
    );
}

/// The mock session's numbers, as they were first with brackets merged pixel by pixel; a tolerance for other mathematical libraries.
#[test]
fn a_session_without_reference_frames_gives_the_numbers_it_always_gave() {
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
    let session = SessionFolder::open(&root.join("mocks/khungurn16_gabardine")).unwrap();
    let (measured, report) = measure(&session).unwrap();
    let golden = root.join("tests/data/khungurn16_gabardine_measurements.csv");
    let golden = Measurements::read(&golden).unwrap();
    assert_eq!(measured.intensities.len(), golden.intensities.len());
    for (m, g) in measured.intensities.iter().zip(&golden.intensities) {
        for c in 0..3 {
            assert!((m.mean[c] / g.mean[c] - 1.0).abs() < 1e-12, "{m:?} {g:?}");
            let ratio = m.standard_error[c] / g.standard_error[c];
            assert!((ratio - 1.0).abs() < 1e-12, "{m:?} {g:?}");
        }
    }
    assert!(report.lamp.visits.is_empty());
}
