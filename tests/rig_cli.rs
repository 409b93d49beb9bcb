//! Promise: `goniofit sim` and `goniofit capture` work together as a person would use them, and refuse what they should.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use assert_cmd::Command;
use goniofit::base::{Result, Unwatched};
use goniofit::rig::capture::CaptureOptions;
use goniofit::rig::simulated::capture_in_process;
use goniofit::rig::{Camera, CapturedFrame, RigDescription, Shot};
use goniofit::session::{CameraFacts, Plan, SessionFolder};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::Stdio;

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn goniofit() -> Command {
    let mut command = Command::cargo_bin("goniofit").unwrap();
    command.current_dir(root()).env("NO_COLOR", "1");
    command
}

const RIG: [&str; 4] = [
    "--rig",
    "rig_configs/five_axis_grblhal.toml",
    "--plan",
    "rig_configs/plans/khungurn16.toml",
];

/// The answer of a command: exit code, stdout, stderr.
fn answer(command: &mut Command) -> (i32, String, String) {
    let output = command.output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (
        output.status.code().unwrap(),
        text(output.stdout),
        text(output.stderr),
    )
}

struct Blank;

impl Camera for Blank {
    fn facts(&self) -> CameraFacts {
        CameraFacts {
            name: "blank".into(),
            width: 1,
            height: 1,
            pixel_mm: 1.0,
            center_px: [0.5, 0.5],
            lens: Default::default(),
        }
    }
    fn expose(&mut self, shot: &Shot) -> Result<CapturedFrame> {
        Ok(CapturedFrame {
            bytes: format!("{:?} {:?}", shot.kind, shot.config).into_bytes(),
            extension: "txt".into(),
            exposure_ms: shot.exposure_ms,
        })
    }
}

/// A finished synthetic session, recorded in process. `rig` with short waits when it shall be driven in real time.
fn recorded(out: &Path, rig: &Path) {
    let rig = RigDescription::read(rig).unwrap();
    let plan = Plan::read(&root().join(RIG[3])).unwrap();
    let options = CaptureOptions {
        synthetic: true,
        ..CaptureOptions::default()
    };
    capture_in_process(&rig, &plan, &mut Blank, out, &options, &Unwatched).unwrap();
}

#[test]
fn a_dry_run_prints_every_axis_target_and_opens_no_port() {
    // A port that does not exist: opening it would fail, as it does without --dry-run.
    let port = ["--port", "/dev/ttyNOSUCH"];
    let (code, out, err) = answer(
        goniofit()
            .arg("capture")
            .args(RIG)
            .args(port)
            .arg("--dry-run"),
    );
    assert_eq!(code, 0, "{err}");
    assert!(out.contains("36 frames"), "{out}");
    let line = out
        .lines()
        .find(|l| l.starts_with("sample         10 "))
        .unwrap();
    let numbers: Vec<&str> = line.split_whitespace().skip(3).collect();
    assert_eq!(numbers, ["48.000", "0.000", "64.000", "270.000", "0.000"]);
    let (code, out, _) = answer(
        goniofit()
            .arg("capture")
            .args(RIG)
            .args(["--dry-run", "--json"]),
    );
    let json: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!(code, 0);
    assert_eq!(json["stops"].as_array().unwrap().len(), 18);
    let stops = json["stops"].as_array().unwrap();
    let tenth = stops.iter().find(|s| s["config"] == 10).unwrap();
    assert_eq!(tenth["axes_deg"]["light_azimuth"], 270.0);
    assert!(json["seconds"].as_f64().unwrap() > 60.0);
}

#[test]
fn refusals_have_a_hint_exit_with_2_and_overwrite_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let session = folder.path().join("s");
    recorded(&session, &root().join(RIG[1]));
    let before = std::fs::read(session.join("journal.jsonl")).unwrap();
    let session = session.to_str().unwrap();
    let new = folder.path().join("new");
    let new = new.to_str().unwrap();
    let replay = format!("replay:{session}");
    for (arguments, reason) in [
        (
            vec!["--out", session, "--camera", &replay],
            "already holds a session",
        ),
        (
            vec!["--out", new, "--camera", "leica"],
            "unknown camera 'leica'",
        ),
        (
            vec!["--out", new, "--camera", "replay:/nowhere"],
            "holds no session",
        ),
        (
            vec![
                "--out",
                new,
                "--camera",
                &replay,
                "--port",
                "/dev/ttyNOSUCH",
            ],
            "no such device",
        ),
        (
            vec!["--out", new, "--camera", &replay, "--port", "x=/dev/null"],
            "unknown board 'x'",
        ),
    ] {
        let (code, out, err) = answer(goniofit().arg("capture").args(RIG).args(&arguments));
        assert_eq!((code, out.as_str()), (2, ""), "{err}");
        assert!(err.contains(reason) && err.contains("hint:"), "{err}");
        assert!(!Path::new(new).exists());
    }
    assert_eq!(
        std::fs::read(Path::new(session).join("journal.jsonl")).unwrap(),
        before
    );
    let fixed = [
        "--rig",
        "rig_configs/turntable_only.toml",
        RIG[2],
        RIG[3],
        "--dry-run",
    ];
    let (code, _, err) = answer(goniofit().arg("capture").args(fixed));
    assert_eq!(code, 2);
    assert!(
        err.contains("pose outside limits: configuration 1"),
        "{err}"
    );
}

#[test]
fn a_recorded_session_is_replayed_from_the_command_line() {
    let folder = tempfile::tempdir().unwrap();
    let (old, new) = (folder.path().join("old"), folder.path().join("new"));
    recorded(&old, &root().join(RIG[1]));
    let mut command = goniofit();
    command.arg("capture").args(RIG).arg("--out").arg(&new);
    command
        .arg("--camera")
        .arg(format!("replay:{}", old.display()))
        .arg("--blind");
    command
        .arg("--replay")
        .arg(old.join("wire.jsonl"))
        .arg("--json");
    let (code, out, err) = answer(&mut command);
    assert_eq!(code, 0, "{err}");
    let json: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!(
        (&json["frames"], &json["finished"]),
        (&36.into(), &true.into())
    );
    let session = SessionFolder::open(&new).unwrap();
    assert!(
        session.manifest().unwrap().synthetic,
        "synthetic frames stay synthetic"
    );
    assert_eq!(session.frames().unwrap().len(), 36);
}

#[test]
fn capture_drives_the_simulator_that_sim_started() {
    let folder = tempfile::tempdir().unwrap();
    // The rig file with waits cut short and fast motors, as the simulator's speed does not shorten the driver's waits.
    let text = std::fs::read_to_string(root().join(RIG[1])).unwrap();
    let text = text
        .replace("settle_ms = 300", "settle_ms = 1")
        .replace("settle_ms = 200", "settle_ms = 1")
        .replace("warm_up_s = 60.0", "warm_up_s = 0.1");
    let rig = folder.path().join("rig.toml");
    std::fs::write(&rig, text).unwrap();
    let (old, new) = (folder.path().join("old"), folder.path().join("new"));
    recorded(&old, &rig);

    let mut sim = std::process::Command::new(assert_cmd::cargo::cargo_bin("goniofit"))
        .args(["sim", "--speed", "500", "--json"])
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut line = String::new();
    BufReader::new(sim.stdout.take().unwrap())
        .read_line(&mut line)
        .unwrap();
    let json: serde_json::Value = serde_json::from_str(&line).unwrap();
    let port = json["boards"][0]["path"].as_str().unwrap();

    let mut command = goniofit();
    command
        .args(["capture", "--plan", RIG[3], "--rig"])
        .arg(&rig);
    command.arg("--out").arg(&new).args(["--port", port]);
    command
        .arg("--camera")
        .arg(format!("replay:{}", old.display()))
        .arg("--blind");
    let (code, _, err) = answer(&mut command);
    // Without --yes and without a person the question about the white standard stops it.
    assert_eq!(code, 2);
    assert!(
        err.contains("nobody is there to answer") && err.contains("--yes"),
        "{err}"
    );
    let again = folder.path().join("again");
    command = goniofit();
    command
        .args(["capture", "--plan", RIG[3], "--rig"])
        .arg(&rig);
    command
        .arg("--out")
        .arg(&again)
        .args(["--port", port, "--yes"]);
    command
        .arg("--camera")
        .arg(format!("replay:{}", old.display()))
        .arg("--blind");
    let (code, out, err) = answer(&mut command);
    sim.kill().unwrap();
    sim.wait().unwrap();
    assert_eq!(code, 0, "{err}");
    assert_eq!(out.trim(), again.to_str().unwrap());
    assert_eq!(
        SessionFolder::open(&again).unwrap().frames().unwrap().len(),
        36
    );
    assert!(again.join("wire.jsonl").exists());
}
