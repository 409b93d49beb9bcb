//! Promise: `goniofit doctor` says what a capture lacks and what to do, on a bare machine too, and touches nothing.
#![allow(clippy::unwrap_used, missing_docs)]

use serde_json::Value;
use std::io::{BufRead, BufReader};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// Programs in `path` are all the machine has.
fn doctor(path: &Path, words: &[&str]) -> (i32, String) {
    let mut command = Command::new(assert_cmd::cargo::cargo_bin("goniofit"));
    command.current_dir(root()).env("PATH", path);
    let output = command.arg("doctor").args(words).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    let errors = String::from_utf8(output.stderr).unwrap();
    assert_eq!(errors, "");
    (output.status.code().unwrap(), text)
}

fn findings(path: &Path, words: &[&str]) -> (i32, Vec<Value>) {
    let mut words = words.to_vec();
    words.push("--json");
    let (code, text) = doctor(path, &words);
    let json: Value = serde_json::from_str(&text).unwrap();
    let all = json["findings"].as_array().unwrap().clone();
    let failed = all.iter().any(|f| f["level"] == "fail");
    assert_eq!((code == 1, json["ok"] == false), (failed, failed), "{text}");
    for finding in &all {
        let todo = finding["todo"].as_str().unwrap();
        assert_eq!(todo.is_empty(), finding["level"] == "ok", "{finding}");
    }
    (code, all)
}

/// The only finding of this area with these words.
fn one<'a>(all: &'a [Value], area: &str, words: &str) -> &'a Value {
    let mut fitting = all
        .iter()
        .filter(|f| f["area"] == area && f["what"].as_str().unwrap().contains(words));
    let found = fitting.next();
    assert!(
        found.is_some() && fitting.next().is_none(),
        "{words}: {all:#?}"
    );
    found.unwrap()
}

fn program(folder: &Path, name: &str, script: &str) {
    let path = folder.join(name);
    std::fs::write(&path, format!("#!/bin/sh\n{script}\n")).unwrap();
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
}

#[test]
fn a_bare_machine_gets_warnings_and_no_failure() {
    let empty = tempfile::tempdir().unwrap();
    let (code, all) = findings(empty.path(), &["--out", "/tmp"]);
    assert_eq!(code, 0, "{all:#?}");
    assert_eq!(one(&all, "camera", "no gphoto2")["level"], "warn");
    assert_eq!(one(&all, "camera", "no arv-tool")["level"], "warn");
    assert_eq!(one(&all, "clock", "the clock says 20")["level"], "ok");
    one(&all, "disk", "free");
    let (_, text) = doctor(empty.path(), &["--out", "/tmp"]);
    assert!(
        text.contains("warn  camera  no gphoto2") && text.contains("-> "),
        "{text}"
    );
}

#[test]
fn camera_programs_are_asked_and_one_that_hangs_is_given_up() {
    let folder = tempfile::tempdir().unwrap();
    program(
        folder.path(),
        "gphoto2",
        "if [ \"$1\" = --version ]; then echo 'gphoto2 2.5.28'; exit; fi
echo 'Model                          Port'
echo '----------------------------------------------------------'
echo 'Canon EOS R5                   usb:001,004'",
    );
    program(folder.path(), "arv-tool-0.8", "exit 0");
    let (_, all) = findings(folder.path(), &[]);
    assert_eq!(one(&all, "camera", "gphoto2 2.5.28")["level"], "ok");
    assert_eq!(
        one(&all, "camera", "Canon EOS R5 usb:001,004")["level"],
        "ok"
    );
    assert_eq!(one(&all, "camera", "arv-tool-0.8")["level"], "ok");
    program(
        folder.path(),
        "gphoto2",
        "if [ \"$1\" = --version ]; then echo 'gphoto2 2.5.28'; exit; fi
/bin/sleep 60",
    );
    let begun = Instant::now();
    let (_, all) = findings(folder.path(), &[]);
    assert!(begun.elapsed() < Duration::from_secs(20));
    assert_eq!(one(&all, "camera", "does not answer")["level"], "warn");
}

#[test]
fn a_rig_is_checked_without_opening_a_port() {
    let folder = tempfile::tempdir().unwrap();
    let rig = |old: &str, new: &str| {
        let text = std::fs::read_to_string(root().join("rig_configs/five_axis_grblhal.toml"));
        let text = text.unwrap().replace("/dev/ttyACM0", "/dev/ttyNOSUCH");
        assert!(old.is_empty() || text.contains(old));
        let path = folder.path().join("rig.toml");
        std::fs::write(&path, text.replace(old, new)).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let plan = "rig_configs/plans/khungurn16.toml";
    let path = rig("/dev/ttyNOSUCH", "/dev/null");
    let words = ["--rig", &path, "--plan", plan, "--out", "/tmp"];
    let (code, all) = findings(folder.path(), &words);
    assert_eq!(code, 0, "{all:#?}");
    one(&all, "port", "board 'main': /dev/null is there");
    one(&all, "rig", "driven axes: 5, boards: 1");
    one(&all, "rig", "all 16 configurations");
    one(&all, "disk", "a capture may need 4.2 GB");

    let path = rig("", "");
    let (code, all) = findings(folder.path(), &["--rig", &path]);
    assert_eq!(code, 1);
    assert_eq!(
        one(&all, "port", "there is no /dev/ttyNOSUCH")["level"],
        "fail"
    );

    let path = rig(
        "min_deg = 0.0\nmax_deg = 85.0",
        "min_deg = 0.0\nmax_deg = 50.0",
    );
    let (_, all) = findings(folder.path(), &["--rig", &path, "--plan", plan]);
    let failed = one(&all, "rig", "pose outside limits");
    assert!(
        failed["todo"].as_str().unwrap().contains("change the plan"),
        "{failed}"
    );

    let path = rig("min_deg = 0.0", "min_deg = 900.0");
    let (_, all) = findings(folder.path(), &["--rig", &path]);
    assert_eq!(one(&all, "rig", "is not below max_deg")["level"], "fail");
}

/// Ends with its test.
struct Sim(Child);

impl Drop for Sim {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn a_probe_names_the_controller_that_answers() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = Command::new(assert_cmd::cargo::cargo_bin("goniofit"));
    command.args(["sim", "--speed", "20"]);
    command.stdout(Stdio::piped()).stderr(Stdio::null());
    let mut sim = Sim(command.spawn().unwrap());
    let mut port = String::new();
    BufReader::new(sim.0.stdout.take().unwrap())
        .read_line(&mut port)
        .unwrap();
    let text = std::fs::read_to_string(root().join("rig_configs/five_axis_grblhal.toml")).unwrap();
    let path = folder.path().join("rig.toml");
    std::fs::write(&path, text.replace("/dev/ttyACM0", port.trim())).unwrap();
    let path = path.to_str().unwrap();
    let (_, all) = findings(folder.path(), &["--rig", path]);
    assert!(
        !all.iter()
            .any(|f| f["what"].as_str().unwrap().contains("answers"))
    );
    let (_, all) = findings(folder.path(), &["--rig", path, "--probe"]);
    assert_eq!(one(&all, "port", "grblHAL 1.1f")["level"], "ok");
}
