//! Promise: whatever is wrong with a session, its calibrations or the disk, the message says which frame, which part of the
//! image where that applies, and what to do; nothing is half written.
//!
//! `measure_session.rs` has: a frame missing, or torn against its hash; another image size or exposure; a configuration
//! that is not the plan's; a crop that leaves the image; a dark missing or too bright; no darks, no whites; sample and white
//! saturated; existing files. `measure_drift.rs`: a reference that is not brighter than the dark, or saturated.
#![allow(clippy::print_stdout, clippy::unwrap_used, missing_docs)]

mod virtual_session;

use goniofit::base::{Result, Unwatched};
use goniofit::measure::calibration::{
    Calibrations, ColorMatrix, Dated, FlatField, Header, Kind, WhiteStandard,
};
use goniofit::measure::{Condition, MeasureOptions, MeasureReport, measure_session};
use goniofit::session::{Layout, Measurements, SessionFolder, files};
use std::path::Path;
use virtual_session::{Setup, folder, record};

const FRAME: &str = "0010_sample_c02_16ms.dng";

fn small() -> Setup {
    Setup {
        exposures_ms: vec![16.0, 64.0],
        dark_exposures_ms: vec![16.0, 64.0],
        poses: vec![(0.0, 0.0, [0.4, 0.5, 0.3]), (64.0, 90.0, [0.2, 0.1, 0.15])],
        dark_repeats: 2,
        ..Setup::new(6)
    }
}

/// The same through filters; frames 0 to 3 are darks, 4 to 15 whites, then come six for each configuration.
fn filtered() -> Setup {
    let mut setup = Setup {
        filters: true,
        ..small()
    };
    setup.sensor.layout = Layout::Mono;
    setup.dark_sensor.layout = Layout::Mono;
    setup
}

fn measure(session: &SessionFolder) -> Result<(Measurements, MeasureReport)> {
    measure_session(session, &MeasureOptions::default(), &Unwatched)
}

/// The message of measuring a session made of `setup` and then damaged.
fn refusal(setup: &Setup, damage: impl Fn(&SessionFolder)) -> String {
    let folder = folder();
    let session = record(folder.path(), setup);
    damage(&session);
    measure(&session).unwrap_err().report()
}

fn expect(message: &str, parts: &[&str]) {
    println!("{message}\n");
    for part in parts.iter().chain(&["hint:"]) {
        assert!(message.contains(part), "'{part}' is not in: {message}");
    }
}

/// Changes a frame's bytes, and its hash in the journal with them.
fn replace(session: &SessionFolder, frame: &str, change: impl Fn(&[u8]) -> Vec<u8>) {
    let path = session.frame_path(frame);
    let old = std::fs::read(&path).unwrap();
    let new = change(&old);
    assert_ne!(old, new);
    std::fs::write(&path, &new).unwrap();
    let journal = std::fs::read_to_string(session.journal_path()).unwrap();
    let journal = journal.replace(&files::sha256(&old), &files::sha256(&new));
    std::fs::write(session.journal_path(), journal).unwrap();
}

/// The bytes with the one place that reads `from` changed.
fn patched(bytes: &[u8], from: &[u8], to: &[u8]) -> Vec<u8> {
    let mut places = (0..bytes.len() - from.len()).filter(|&i| bytes[i..].starts_with(from));
    let at = places.next().unwrap();
    assert_eq!(places.next(), None);
    let mut bytes = bytes.to_vec();
    bytes[at..at + to.len()].copy_from_slice(to);
    bytes
}

/// Journal lines that hold `part`, changed.
fn journal_lines(session: &SessionFolder, part: &str, change: impl Fn(&str) -> String) {
    let journal = std::fs::read_to_string(session.journal_path()).unwrap();
    let mut found = false;
    let lines = journal.lines().map(|line| {
        if line.contains(part) {
            found = true;
            change(line) + "\n"
        } else {
            line.to_owned() + "\n"
        }
    });
    let journal: String = lines.collect();
    assert!(found, "{part} is not in the journal");
    std::fs::write(session.journal_path(), journal).unwrap();
}

#[test]
fn a_frame_that_was_torn_in_the_camera_is_named() {
    let message = refusal(&small(), |s| {
        replace(s, FRAME, |b| b[..b.len() * 2 / 3].to_vec());
    });
    expect(
        &message,
        &[
            FRAME,
            "configuration 2, 16 ms",
            "cannot be decoded",
            "take this frame again",
        ],
    );
}

/// The directory entries of EXIF's sensitivity (100) and exposure time, as the virtual camera writes them.
const ISO: [u8; 10] = [0x27, 0x88, 3, 0, 1, 0, 0, 0, 100, 0];
const EXPOSURE: [u8; 8] = [0x9a, 0x82, 5, 0, 1, 0, 0, 0];

#[test]
fn a_changed_sensitivity_or_aperture_is_told_with_both_frames() {
    let iso = refusal(&small(), |s| {
        let faster = [0x27, 0x88, 3, 0, 1, 0, 0, 0, 200, 0];
        replace(s, FRAME, |b| patched(b, &ISO, &faster));
    });
    expect(
        &iso,
        &[
            FRAME,
            "configuration 2",
            "ISO 200",
            "ISO 100",
            "take this frame again",
        ],
    );
    // The exposure time becomes the f-number.
    let aperture = refusal(&small(), |s| {
        let number = [0x9d, 0x82, 5, 0, 1, 0, 0, 0];
        replace(s, FRAME, |b| patched(b, &EXPOSURE, &number));
    });
    expect(
        &aperture,
        &[
            FRAME,
            "configuration 2",
            "aperture f/0.016",
            "one sensitivity and aperture",
        ],
    );
}

#[test]
fn frames_that_do_not_state_their_exposure_are_believed_with_a_warning() {
    let folder = folder();
    let session = record(folder.path(), &small());
    let (stated, _) = measure(&session).unwrap();
    for frame in session.frames().unwrap() {
        let unknown = [0x9b, 0x82, 5, 0, 1, 0, 0, 0];
        replace(&session, &frame.file, |b| patched(b, &EXPOSURE, &unknown));
    }
    let (believed, report) = measure(&session).unwrap();
    assert_eq!(believed, stated);
    let warning = |w: &&String| w.contains("do not say how long they were exposed");
    let warning = report.warnings.iter().find(warning).unwrap();
    assert!(warning.starts_with("12 frames"), "{warning}");
}

#[test]
fn a_missing_filter_is_named() {
    let setup = filtered();
    let no_frame = |s: &SessionFolder, kind: &str| {
        let journal = std::fs::read_to_string(s.journal_path()).unwrap();
        let missing = |l: &&str| !(l.contains(kind) && l.contains("\"filter\":\"g\""));
        // Sequence numbers have no gaps.
        let lines = journal
            .lines()
            .filter(missing)
            .enumerate()
            .map(|(n, line)| {
                let mut value: serde_json::Value = serde_json::from_str(line).unwrap();
                value["sequence"] = n.into();
                value.to_string() + "\n"
            });
        let journal: String = lines.collect();
        std::fs::write(s.journal_path(), journal).unwrap();
    };
    let session_folder = folder();
    let session = record(session_folder.path(), &setup);
    no_frame(&session, "\"config\":2");
    let (measured, report) = measure(&session).unwrap();
    assert_eq!(measured.intensities.len(), 1);
    let second = &report.configurations[1];
    assert_eq!(second.condition, Condition::NotCaptured);
    let message = second.message.as_ref().unwrap();
    assert!(
        message.contains("configuration 2: no frame through the green filter")
            && message.contains("shoot every configuration through all three"),
        "{message}"
    );
    let white = refusal(&setup, |s| no_frame(s, "\"kind\":\"white\""));
    expect(&white, &["no white frame through the green filter"]);
    // Whites without a filter are no measure of samples through one.
    let mixed = refusal(&setup, |s| {
        journal_lines(s, "\"kind\":\"white\"", |l| {
            let l = l
                .replace("\"filter\":\"r\",", "")
                .replace("\"filter\":\"g\",", "");
            l.replace("\"filter\":\"b\",", "")
        });
    });
    expect(
        &mixed,
        &["_white_", "without a filter", "_sample_c01_", "filter r"],
    );
    let color_camera = refusal(&small(), |s| {
        for kind in ["\"kind\":\"sample\"", "\"kind\":\"white\""] {
            journal_lines(s, kind, |l| {
                l.replace(kind, &format!("{kind},\"filter\":\"r\""))
            });
        }
    });
    expect(
        &color_camera,
        &["frame 00", "names a filter", "sees color itself"],
    );
}

#[test]
fn a_white_panel_in_the_dark_is_told_with_frame_and_region() {
    let mut setup = small();
    setup.white_factor = [0.0; 3];
    for black in &mut setup.dark_sensor.black {
        *black += 5.0;
    }
    let message = refusal(&setup, |s| {
        let path = s.root().join("session.json");
        let mut manifest: serde_json::Value =
            serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
        manifest["white"]["reflectance_factor"] = serde_json::json!([0.9, 0.9, 0.9]);
        std::fs::write(&path, manifest.to_string()).unwrap();
    });
    expect(
        &message,
        &[
            "not brighter than the dark",
            "_white_16ms.dng",
            "columns",
            "rows",
            "light on",
        ],
    );
}

fn header(setup: &Setup, kind: Kind) -> Header {
    let facts = setup.sensor.facts();
    Header {
        format: Header::FORMAT.to_owned(),
        kind,
        rig: "virtual".to_owned(),
        camera: facts.name,
        size_px: [facts.width, facts.height],
        date_utc: "2024-02-29T12:00:00Z".to_owned(),
        sessions: Vec::new(),
        synthetic: true,
        program: "test".to_owned(),
    }
}

fn color(header: Header) -> Dated<ColorMatrix> {
    let value = ColorMatrix {
        space: "srgb".to_owned(),
        matrix: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        covariance: [[[0.0; 3]; 3]; 3],
        residual: [0.0; 3],
        patches: 24,
    };
    Dated { header, value }
}

fn with(calibrations: Calibrations) -> String {
    let folder = folder();
    let session = record(folder.path(), &small());
    let options = MeasureOptions {
        calibrations,
        ..MeasureOptions::default()
    };
    let error = measure_session(&session, &options, &Unwatched).unwrap_err();
    error.report()
}

#[test]
fn calibrations_of_another_camera_or_geometry_are_refused() {
    let setup = small();
    let mut other = header(&setup, Kind::Color);
    other.camera = "another camera".to_owned();
    let camera = with(Calibrations {
        color: Some(color(other)),
        ..Calibrations::default()
    });
    let hint = "calibration folder of the rig";
    expect(
        &camera,
        &[
            "the color calibration",
            "'another camera'",
            "'goniofit virtual camera'",
            hint,
        ],
    );
    let mut other = header(&setup, Kind::Color);
    other.size_px = [200, 84];
    let size = with(Calibrations {
        color: Some(color(other)),
        ..Calibrations::default()
    });
    expect(&size, &["200 x 84 pixels", "100 x 84", hint]);
    let white = with(Calibrations {
        white: Some(Dated {
            header: header(&setup, Kind::White),
            value: WhiteStandard {
                panel: "99-010".to_owned(),
                light_theta_deg: 30.0,
                light_phi_deg: 180.0,
                camera_theta_deg: 0.0,
                camera_phi_deg: 0.0,
                reflectance_factor: [0.99; 3],
                reflectance_factor_se: [0.003; 3],
                responsivity: [40.0; 3],
                responsivity_se: [0.1; 3],
            },
        }),
        ..Calibrations::default()
    });
    expect(
        &white,
        &[
            "'99-010'",
            "light 30 and camera 0 degrees",
            "reference geometry",
        ],
    );
}

#[test]
fn damaged_calibration_files_are_named() {
    let setup = small();
    let read = |folder: &Path| Calibrations::read(folder).unwrap_err().report();
    let at = folder();
    let path = color(header(&setup, Kind::Color)).write(at.path()).unwrap();
    let text = std::fs::read_to_string(&path).unwrap();
    let name = "2024-02-29_color.json";
    std::fs::write(&path, &text[..text.len() / 2]).unwrap();
    expect(&read(at.path()), &[name, "is damaged", "calibrate again"]);
    std::fs::write(
        &path,
        text.replace(Header::FORMAT, "goniofit-calibration-9"),
    )
    .unwrap();
    expect(
        &read(at.path()),
        &[
            name,
            "goniofit-calibration-9",
            "expected",
            "calibrate again",
        ],
    );

    let at = folder();
    let values = 100 * 84;
    let mut flat = Dated {
        header: header(&setup, Kind::Flat),
        value: FlatField {
            file: String::new(),
            sha256: String::new(),
            uniformity_se: 0.0,
            scatter: [0.0; 3],
            falloff: [0.0; 3],
            response: vec![1.0; values],
            response_se: vec![0.001; values],
        },
    };
    flat.write(at.path()).unwrap();
    Calibrations::read(at.path()).unwrap();
    let map = at.path().join("2024-02-29_flat.exr");
    let mut bytes = std::fs::read(&map).unwrap();
    let last = bytes.len() - 1;
    bytes[last] ^= 1;
    std::fs::write(&map, &bytes).unwrap();
    let name = "2024-02-29_flat.exr";
    expect(
        &read(at.path()),
        &[name, "not the one", "calibrate the flat field again"],
    );
    std::fs::remove_file(&map).unwrap();
    expect(&read(at.path()), &[name, "cannot be read", "restore it"]);
}

/// Runs `measure session` in a shell that was prepared by `before`.
fn run(before: &str, session: &SessionFolder, more: &[&str]) -> (Option<i32>, String) {
    let script = format!("{before} exec \"$0\" measure session \"$@\"");
    let output = std::process::Command::new("sh")
        .args(["-c", &script, env!("CARGO_BIN_EXE_goniofit")])
        .arg(session.root())
        .args(more)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    (output.status.code(), said)
}

#[test]
fn outputs_that_cannot_be_written_are_named_and_nothing_is_left_behind() {
    let folder = folder();
    let session = record(&folder.path().join("s"), &small());
    let files = || {
        let names = std::fs::read_dir(session.root()).unwrap();
        let mut names: Vec<_> = names.map(|e| e.unwrap().file_name()).collect();
        names.sort();
        names
    };
    let before = files();
    // No file may grow: as on a full disk, every write fails.
    let (code, said) = run("trap '' XFSZ; ulimit -f 0;", &session, &[]);
    assert_eq!(code, Some(2), "{said}");
    expect(
        &said,
        &["measurements.csv cannot be written", "is the disk full"],
    );
    assert_eq!(files(), before);
    let nowhere = folder.path().join("nowhere/again");
    let (code, said) = run("", &session, &["--out", nowhere.to_str().unwrap()]);
    assert_eq!(code, Some(2), "{said}");
    expect(
        &said,
        &["nowhere/again.csv cannot be written", "not writable"],
    );
    // A folder where a file should be.
    std::fs::create_dir(session.root().join("measurements.csv")).unwrap();
    let (code, said) = run("", &session, &["--force"]);
    assert_eq!(code, Some(2), "{said}");
    expect(
        &said,
        &[
            "measurements.csv cannot be written",
            "folder in the file's place",
        ],
    );
    // Without the obstacle it goes through.
    std::fs::remove_dir(session.root().join("measurements.csv")).unwrap();
    let (code, said) = run("", &session, &[]);
    assert_eq!(code, Some(0), "{said}");
}
