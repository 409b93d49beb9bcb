//! Promise: `goniofit rig` does by hand what a person needs at a rig, on a real (pseudo-)terminal, and refuses the rest
//! before anything moves.
#![allow(clippy::unwrap_used, missing_docs)]

use goniofit::rig::{RigDescription, Way};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(30);

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn goniofit() -> Command {
    let mut command = Command::new(assert_cmd::cargo::cargo_bin("goniofit"));
    command.current_dir(root()).env("NO_COLOR", "1");
    command.stdin(Stdio::null());
    command
}

/// The boards of a rig file, simulated; a rig file with short waits beside them.
struct Bench {
    folder: tempfile::TempDir,
    sim: Child,
    ports: Vec<String>,
}

impl Drop for Bench {
    fn drop(&mut self) {
        let _ = self.sim.kill();
        let _ = self.sim.wait();
    }
}

impl Bench {
    fn new(rig: &str, speed: &str, changes: &[(&str, &str)]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let mut text = std::fs::read_to_string(root().join("rig_configs").join(rig)).unwrap();
        for (old, new) in changes {
            assert!(text.contains(old), "{old}");
            text = text.replace(old, new);
        }
        let path = folder.path().join("rig.toml");
        std::fs::write(&path, text).unwrap();
        let mut sim = goniofit()
            .args(["sim", "--json", "--speed", speed, "--rig"])
            .arg(&path)
            .arg("--log")
            .arg(folder.path().join("sim.jsonl"))
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(sim.stdout.take().unwrap())
            .read_line(&mut line)
            .unwrap();
        let json: Value = serde_json::from_str(&line).unwrap();
        let boards = json["boards"].as_array().unwrap();
        let ports = boards.iter().map(|b| {
            format!(
                "--port={}={}",
                b["board"].as_str().unwrap(),
                b["path"].as_str().unwrap()
            )
        });
        let ports = ports.collect();
        Self { folder, sim, ports }
    }

    fn five_axis() -> Self {
        Self::new(
            "five_axis_grblhal.toml",
            "50",
            &[("settle_ms = 300", "settle_ms = 1")],
        )
    }

    fn rig(&self) -> PathBuf {
        self.folder.path().join("rig.toml")
    }

    fn command(&self, words: &[&str]) -> Command {
        let mut command = goniofit();
        command.arg("rig").arg(words[0]).args(&self.ports);
        command.args(&words[1..]);
        command.arg("--rig").arg(self.rig());
        command
    }

    fn run(&self, words: &[&str]) -> Answer {
        Answer::of(self.command(words).output().unwrap())
    }

    fn json(&self, words: &[&str]) -> Value {
        let mut words = words.to_vec();
        words.push("--json");
        let answer = self.run(&words);
        assert_eq!(answer.code, 0, "{words:?}: {}", answer.err);
        serde_json::from_str(&answer.out).unwrap()
    }

    /// What the boards heard so far.
    fn heard(&self) -> String {
        let text =
            std::fs::read_to_string(self.folder.path().join("sim.jsonl")).unwrap_or_default();
        let whole = &text[..text.rfind('\n').map_or(0, |at| at + 1)];
        let entries = goniofit::rig::parse_wire_log(whole).unwrap();
        let bytes = entries.into_iter().filter(|e| e.way == Way::ToBoard);
        let bytes: Vec<u8> = bytes.flat_map(|e| e.bytes).collect();
        String::from_utf8_lossy(&bytes).into_owned()
    }

    /// No line that moves an axis was heard.
    fn nothing_moved(&self) -> bool {
        let heard = self.heard();
        !["G1", "G0", "$H", "$J"]
            .iter()
            .any(|word| heard.contains(word))
    }

    fn wait_until_heard(&self, text: &str) {
        let start = Instant::now();
        while !self.heard().contains(text) {
            assert!(start.elapsed() < PATIENCE, "never heard: {text}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// The angle of an axis as `status` tells it.
    fn angle(&self, axis: &str) -> f64 {
        let status = self.json(&["status"]);
        let boards = status["boards"].as_array().unwrap();
        let mut axes = boards.iter().flat_map(|b| b["axes"].as_array().unwrap());
        let found = axes.find(|a| a["axis"] == axis).unwrap();
        found["deg"].as_f64().unwrap()
    }
}

struct Answer {
    code: i32,
    out: String,
    err: String,
}

impl Answer {
    fn of(output: Output) -> Self {
        Self {
            code: output.status.code().expect("it ended by itself"),
            out: String::from_utf8(output.stdout).unwrap(),
            err: String::from_utf8(output.stderr).unwrap(),
        }
    }
}

fn close(found: &Value, expected: f64) {
    let found = found.as_f64().unwrap();
    assert!(
        (found - expected).abs() < 0.06,
        "{found}, expected {expected}"
    );
}

#[test]
fn status_works_in_an_alarm_and_moves_nothing() {
    let bench = Bench::five_axis();
    let status = bench.json(&["status"]);
    let board = &status["boards"][0];
    assert_eq!(board["state"], "Alarm", "{status}");
    assert_eq!(board["homed"], false);
    assert_eq!(status["lamp"]["on"], false);
    let axes = board["axes"].as_array().unwrap();
    assert_eq!(axes.len(), 5);
    for axis in axes {
        let (deg, units) = (
            axis["deg"].as_f64().unwrap(),
            axis["units"].as_f64().unwrap(),
        );
        assert!(deg.is_finite() && units.is_finite());
        assert!(axis["min_deg"].as_f64() < axis["max_deg"].as_f64());
    }
    let text = bench.run(&["status"]);
    assert!(
        text.out.contains("not homed") && text.out.contains("lamp off"),
        "{}",
        text.out
    );
    assert!(
        text.out.contains("outside limits"),
        "at machine zero: {}",
        text.out
    );
    assert!(bench.nothing_moved());
}

#[test]
fn an_axis_is_homed_moved_jogged_and_parked() {
    let bench = Bench::five_axis();
    let home = bench.json(&["home"]);
    assert_eq!(home["homed"], true);
    assert_eq!(bench.json(&["status"])["boards"][0]["homed"], true);
    let moved = bench.json(&["move", "light_elevation=30", "turntable=90"]);
    close(&moved["now_deg"]["light_elevation"], 30.0);
    close(&moved["now_deg"]["turntable"], 90.0);
    assert_eq!(moved["dry_run"], false);
    // The board's own word was enough: homed once only.
    assert_eq!(bench.heard().matches("$H\n").count(), 1);
    let jogged = bench.json(&["jog", "turntable", "-2.5"]);
    close(&jogged["now_deg"]["turntable"], 87.5);
    close(&jogged["now_deg"]["light_elevation"], 30.0);
    let posed = bench.json(&["move", "--pose", "45,180,10,0,20"]);
    close(&posed["now_deg"]["light_azimuth"], 180.0);
    close(&posed["now_deg"]["camera_elevation"], 10.0);
    let parked = bench.json(&["park"]);
    close(&parked["now_deg"]["camera_elevation"], 0.0);
    close(&parked["now_deg"]["light_azimuth"], 180.0);
    let configured = bench.json(&[
        "move",
        "--plan",
        "rig_configs/plans/khungurn16.toml",
        "--config",
        "10",
    ]);
    close(&configured["now_deg"]["light_azimuth"], 270.0);
    close(&configured["now_deg"]["camera_elevation"], 48.0);
}

#[test]
fn a_move_homes_first_when_the_board_does_not_say_that_it_is_homed() {
    let bench = Bench::five_axis();
    let answer = bench.run(&["move", "turntable=45"]);
    assert_eq!(answer.code, 0, "{}", answer.err);
    assert!(answer.err.contains("homing"), "{}", answer.err);
    let heard = bench.heard();
    let (homed, moved) = (heard.find("$H\n").unwrap(), heard.find("G53G1").unwrap());
    assert!(homed < moved);
    assert!(
        answer.out.contains("leg 1") && answer.out.contains("now"),
        "{}",
        answer.out
    );
}

#[test]
fn refusals_have_a_hint_exit_with_2_and_move_nothing() {
    let bench = Bench::five_axis();
    for (words, reason) in [
        (
            &["move", "turntable=200"][..],
            "outside its limits, 0 to 180",
        ),
        (&["move", "turntable=NaN"], "outside its limits"),
        (&["move", "wrist=3"], "unknown axis 'wrist'"),
        (&["move", "turntable"], "is not AXIS=DEG"),
        (&["move", "turntable=1", "turntable=2"], "named twice"),
        (&["move", "--pose", "45,180,0,0"], "expected five angles"),
        (&["move", "--pose", "45,180,0,0,300"], "pose outside limits"),
        (
            &[
                "move",
                "--config",
                "99",
                "--plan",
                "rig_configs/plans/khungurn16.toml",
            ],
            "no configuration 99",
        ),
        (&["jog", "turntable", "6"], "expected at most 5"),
        (&["jog", "turntable", "0"], "expected at most 5"),
        (
            &["jog", "turntable", "2.5", "--unhomed"],
            "expected at most 2",
        ),
        (&["jog", "turntable", "1"], "do not say that they are homed"),
        (
            &["jog", "turntable", "1", "--unhomed"],
            "nobody is there to answer",
        ),
        (&["lamp", "on"], "nobody is there to answer"),
        (&["lamp", "on", "--for", "0"], "expected 0.1 to 86400"),
        (&["status", "--port", "x=/dev/null"], "unknown board 'x'"),
    ] {
        let answer = bench.run(words);
        assert_eq!(
            (answer.code, answer.out.as_str()),
            (2, ""),
            "{words:?}: {}",
            answer.err
        );
        assert!(answer.err.contains(reason), "{words:?}: {}", answer.err);
        let told = answer.err.contains("hint:")
            || answer.err.contains("expected")
            || answer.err.contains("twice");
        assert!(told, "{words:?}: {}", answer.err);
    }
    let answer = Answer::of(goniofit().args(["rig", "status"]).output().unwrap());
    assert!(answer.code == 2 && answer.err.contains("--rig is missing"));
    assert!(bench.nothing_moved());
}

#[test]
fn a_jog_that_would_leave_the_limits_is_refused() {
    let bench = Bench::five_axis();
    bench.json(&["move", "turntable=178"]);
    let answer = bench.run(&["jog", "turntable", "3"]);
    assert_eq!(answer.code, 2, "{}", answer.out);
    assert!(
        answer.err.contains("181 degrees is outside its limits"),
        "{}",
        answer.err
    );
    assert!((bench.angle("turntable") - 178.0).abs() < 0.06);
}

#[test]
fn an_axis_is_freed_although_nothing_is_homed() {
    let bench = Bench::new("two_board_grbl.toml", "50", &[]);
    let jogged = bench.json(&["jog", "turntable", "1.5", "--unhomed", "--yes"]);
    assert!(
        (jogged["moved_deg"].as_f64().unwrap() - 1.5).abs() < 0.02,
        "{jogged}"
    );
    assert_eq!(jogged["homed"], false);
    // 2 degrees per unit, counted downwards, at 1 degree per second.
    assert!(
        bench.heard().contains("$J=G91G21Z-0.7500F30.0\n"),
        "{}",
        bench.heard()
    );
    assert_eq!(bench.json(&["status"])["boards"][0]["homed"], false);
    // The other way leaves the board's own travel: refused by the board, told by us.
    let answer = bench.run(&["jog", "light_elevation", "-2", "--unhomed", "--yes"]);
    assert_eq!(answer.code, 2);
    assert!(answer.err.contains("error:15"), "{}", answer.err);
}

#[test]
fn dry_runs_open_no_port() {
    let rig = "rig_configs/five_axis_grblhal.toml";
    let dry = |words: &[&str]| {
        let mut command = goniofit();
        command.arg("rig").args(words);
        command.args(["--dry-run", "--rig", rig, "--port", "/dev/ttyNOSUCH"]);
        Answer::of(command.output().unwrap())
    };
    for words in [
        &["status"][..],
        &["home"],
        &["park"],
        &["stop"],
        &["lamp", "on"],
        &["jog", "turntable", "1"],
    ] {
        let answer = dry(words);
        assert_eq!(answer.code, 0, "{words:?}: {}", answer.err);
        assert!(answer.out.starts_with("dry run: "), "{}", answer.out);
    }
    let answer = dry(&["move", "turntable=90"]);
    assert_eq!(answer.code, 2);
    assert!(
        answer.err.contains("--from camera_azimuth=DEG"),
        "{}",
        answer.err
    );
    let from = [
        "--from",
        "camera_azimuth=0",
        "light_azimuth=10",
        "turntable=0",
    ];
    let mut words = vec!["move", "turntable=90", "--json"];
    words.extend(from);
    let answer = dry(&words);
    assert_eq!(answer.code, 0, "{}", answer.err);
    let json: Value = serde_json::from_str(&answer.out).unwrap();
    close(
        &json["legs_deg"].as_array().unwrap().last().unwrap()["turntable"],
        90.0,
    );
    close(&json["from_deg"]["light_elevation"], 45.0);
    // 90 degrees at 30 degrees per second.
    assert!(
        (json["expected_s"].as_f64().unwrap() - 3.06).abs() < 0.01,
        "{json}"
    );
}

#[test]
fn the_lamp_goes_on_for_a_time_and_off_afterwards() {
    let bench = Bench::new("two_board_grbl.toml", "50", &[]);
    bench.json(&["home"]);
    let started = Instant::now();
    let answer = bench.json(&["lamp", "on", "--for", "0.5"]);
    assert!(started.elapsed() >= Duration::from_millis(500));
    assert_eq!(answer["lamp"]["on"], false);
    let heard = bench.heard();
    let on = heard.find("M3S1000\n").unwrap();
    assert!(heard[on..].contains("M5\n"));
    assert_eq!(bench.json(&["status"])["lamp"]["on"], false);
}

#[test]
fn a_lamp_that_was_left_on_is_switched_off_by_the_next_command() {
    let bench = Bench::five_axis();
    bench.json(&["home"]);
    let mut lamp = bench
        .command(&["lamp", "on", "--for", "600"])
        .spawn()
        .unwrap();
    bench.wait_until_heard("M3S1000");
    std::thread::sleep(Duration::from_millis(300));
    lamp.kill().unwrap();
    lamp.wait().unwrap();
    let before = bench.heard().len();
    assert_eq!(bench.json(&["status"])["lamp"]["on"], false);
    assert!(bench.heard()[before..].contains("M5\n"));
    // Nothing is left to switch off.
    let before = bench.heard().len();
    assert_eq!(bench.json(&["status"])["lamp"]["on"], false);
    assert!(!bench.heard()[before..].contains("M5\n"));
}

#[test]
fn an_interrupt_stops_the_motion_with_the_position_kept_and_exits_with_3() {
    // 10 degrees per minute: the way takes 9 minutes, simulated in 11 s.
    let slow = [("feed_deg_per_min = 1800.0", "feed_deg_per_min = 10.0")];
    let bench = Bench::new("five_axis_grblhal.toml", "50", &slow);
    let mut command = bench.command(&["move", "turntable=90"]);
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped());
    let child = child.spawn().unwrap();
    bench.wait_until_heard("G4P0.01");
    std::thread::sleep(Duration::from_millis(500));
    kill_process(Pid::from_child(&child), Signal::INT).unwrap();
    let start = Instant::now();
    let answer = Answer::of(child.wait_with_output().unwrap());
    assert!(start.elapsed() < Duration::from_secs(4));
    assert_eq!(
        (answer.code, answer.out.as_str()),
        (3, ""),
        "{}",
        answer.err
    );
    assert!(answer.err.contains("position kept"), "{}", answer.err);
    let heard = bench.heard();
    let stop = heard.find('!').unwrap();
    assert!(heard[stop..].contains('\x18'));
    // Nothing was lost: the board still says that it is homed, and where it stands.
    assert_eq!(bench.json(&["status"])["boards"][0]["homed"], true);
    let turned = bench.angle("turntable");
    assert!((-8.9..80.0).contains(&turned), "{turned}");
}

#[test]
fn stop_ends_a_motion_whose_program_has_died() {
    let slow = [("feed_deg_per_min = 1800.0", "feed_deg_per_min = 10.0")];
    let bench = Bench::new("five_axis_grblhal.toml", "50", &slow);
    let mut mover = bench.command(&["move", "turntable=90"]).spawn().unwrap();
    bench.wait_until_heard("G4P0.01");
    std::thread::sleep(Duration::from_millis(300));
    mover.kill().unwrap();
    mover.wait().unwrap();
    let stopped = bench.json(&["stop"]);
    let device = &stopped["devices"][0];
    assert_eq!(device["stopped"], true);
    let what = device["what"].as_str().unwrap();
    assert!(
        what.starts_with("was Run; now Idle") && what.contains("lamp off"),
        "{what}"
    );
    let turned = bench.angle("turntable");
    std::thread::sleep(Duration::from_millis(300));
    assert!(
        (bench.angle("turntable") - turned).abs() < 0.001,
        "it still moves"
    );
    assert!((-9.0..80.0).contains(&turned), "{turned}");
    assert_eq!(bench.json(&["status"])["boards"][0]["homed"], true);
}

#[test]
fn stop_works_in_an_alarm_and_names_the_board_it_cannot_reach() {
    let bench = Bench::new("two_board_grbl.toml", "50", &[]);
    // The boards have started when they have answered.
    bench.json(&["status"]);
    let stopped = bench.json(&["stop"]);
    assert_eq!(stopped["devices"].as_array().unwrap().len(), 2);
    for device in stopped["devices"].as_array().unwrap() {
        assert_eq!(device["stopped"], true, "{device}");
        assert!(
            device["what"].as_str().unwrap().starts_with("was Alarm"),
            "{device}"
        );
    }
    let answer = bench.run(&["stop", "--port", "light=/dev/ttyNOSUCH", "--json"]);
    assert_eq!(answer.code, 2);
    assert!(
        answer.err.contains("/dev/ttyNOSUCH") && answer.err.contains("power"),
        "{}",
        answer.err
    );
    let json: Value = serde_json::from_str(&answer.out).unwrap();
    assert_eq!(json["devices"][0]["stopped"], true);
    assert_eq!(json["devices"][1]["stopped"], false);
}

#[test]
fn stop_resets_a_homing_that_obeys_no_hold() {
    let bench = Bench::new("five_axis_grblhal.toml", "1", &[]);
    let mut homer = bench.command(&["home"]).spawn().unwrap();
    bench.wait_until_heard("$H\n");
    homer.kill().unwrap();
    homer.wait().unwrap();
    let stopped = bench.json(&["stop"]);
    let what = stopped["devices"][0]["what"].as_str().unwrap().to_owned();
    assert!(what.starts_with("was Home; now Alarm"), "{what}");
    assert_eq!(bench.json(&["status"])["boards"][0]["homed"], false);
}

#[test]
fn the_rig_files_of_the_tests_are_the_ones_shipped() {
    for name in ["five_axis_grblhal.toml", "two_board_grbl.toml"] {
        RigDescription::read(&Path::new("rig_configs").join(name)).unwrap();
    }
}
