//! Promise: the same driver works over a real serial device, here a pseudo-terminal with the controller model behind it.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use goniofit::base::{Error, Result, Unwatched};
use goniofit::rig::capture::CaptureOptions;
use goniofit::rig::simulated::{capture_from_replay, capture_over_pty};
use goniofit::rig::{
    Camera, CapturedFrame, Fault, FaultKind, Flavor, Grbl, GrblModel, Light, ModelOptions, Motion,
    PtySimulator, ReplayCamera, RigDescription, SerialTransport, Shot, SystemClock, Target,
    Unattended, read_wire_log,
};
use goniofit::session::{CameraFacts, Plan, SessionFolder};
use std::io::{BufRead, BufReader, Read};
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::Arc;

const SPEED: f64 = 50.0;

fn simulator(faults: Vec<Fault>) -> PtySimulator {
    let options = ModelOptions {
        faults,
        ..ModelOptions::rig(Flavor::GrblHal)
    };
    PtySimulator::spawn(GrblModel::new(options), SPEED, None).unwrap()
}

fn connect(simulator: &PtySimulator) -> Result<Grbl<'static>> {
    let port = SerialTransport::open(simulator.path(), 115_200, Some(true))?;
    Grbl::connect(
        "main",
        Box::new(port),
        Arc::new(SystemClock::new()),
        &Unwatched,
    )
}

fn go(grbl: &mut Grbl, units: f64) -> Result<Vec<f64>> {
    let target = [Target {
        letter: 'B',
        units,
        tolerance: 0.02,
        speed: 50.0,
    }];
    grbl.start_move(&target)?;
    grbl.finish_move(&target, 20.0)
}

#[test]
fn connect_home_move_and_lamp_over_a_real_port() {
    let simulator = simulator(vec![]);
    let mut grbl = connect(&simulator).unwrap();
    assert!(grbl.firmware().contains("grblHAL 1.1f"));
    grbl.home().unwrap();
    assert!((go(&mut grbl, -90.0).unwrap()[0] + 90.0).abs() < 0.01);
    grbl.switch_on(700.0).unwrap();
    assert!(simulator.model().lock().unwrap().spindle_on());
    grbl.switch_off().unwrap();
    assert!(!simulator.model().lock().unwrap().spindle_on());
    // The next client finds the device still there.
    drop(grbl);
    connect(&simulator).unwrap();
}

#[test]
fn an_alarm_over_a_real_port_is_told_and_made_safe() {
    let simulator = simulator(vec![Fault {
        on_move: 1,
        kind: FaultKind::Alarm(1),
    }]);
    let mut grbl = connect(&simulator).unwrap();
    grbl.home().unwrap();
    let error = go(&mut grbl, -200.0).unwrap_err().report();
    assert!(error.contains("ALARM:1"), "{error}");
    assert!(
        grbl.make_safe(false)
            .unwrap()
            .contains("home before moving")
    );
}

#[test]
fn a_device_that_disappears_is_a_disconnect_error() {
    let simulator = simulator(vec![Fault {
        on_move: 1,
        kind: FaultKind::Vanish,
    }]);
    let mut grbl = connect(&simulator).unwrap();
    grbl.home().unwrap();
    let error = go(&mut grbl, -200.0).unwrap_err().report();
    assert!(
        error.contains("board 'main' is disconnected") && error.contains("hint:"),
        "{error}"
    );
}

#[test]
fn a_port_that_cannot_be_opened_says_why_and_what_to_do() {
    let told = |path: &str| {
        SerialTransport::open(path, 115_200, None)
            .unwrap_err()
            .report()
    };
    let error = told("/dev/ttyNOSUCH");
    assert!(
        error.contains("no such device") && error.contains("hint:"),
        "{error}"
    );

    let simulator = simulator(vec![]);
    let _held = SerialTransport::open(simulator.path(), 115_200, None).unwrap();
    let error = told(simulator.path());
    assert!(
        error.contains("held by another process") && error.contains("fuser"),
        "{error}"
    );

    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("plain");
    std::fs::write(&path, "").unwrap();
    let error = told(path.to_str().unwrap());
    assert!(error.contains("the system refused"), "{error}");
}

/// The other process of the test below; does nothing when run by hand.
#[test]
#[ignore = "run by another test in a process of its own"]
fn a_holder_of_a_port() {
    let Ok(path) = std::env::var("PORT_TO_HOLD") else {
        return;
    };
    let _held = SerialTransport::open(&path, 115_200, None).unwrap();
    eprintln!("held");
    // Until the other side of the pipe is closed.
    let _ = std::io::stdin().read_to_end(&mut Vec::new());
}

#[test]
fn the_second_owner_of_a_port_is_told_who_the_first_is() {
    let simulator = simulator(vec![]);
    let mut holder = Command::new(std::env::current_exe().unwrap())
        .args(["--ignored", "--exact", "a_holder_of_a_port", "--nocapture"])
        .env("PORT_TO_HOLD", simulator.path())
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(holder.stderr.take().unwrap()).lines();
    assert!(lines.any(|l| l.unwrap() == "held"));
    let open = || SerialTransport::open(simulator.path(), 115_200, None);
    let error = open().unwrap_err().report();
    let pid = format!("held by pid {} (", holder.id());
    assert!(
        error.contains(&pid) && error.contains("--exact a_holder_of_a_port"),
        "{error}"
    );
    assert!(error.contains("hint: close that program"), "{error}");
    drop(holder.stdin.take());
    holder.wait().unwrap();
    open().unwrap();
}

struct NumberCamera(u32);

impl Camera for NumberCamera {
    fn facts(&self) -> CameraFacts {
        CameraFacts {
            name: "number".into(),
            width: 1,
            height: 1,
            pixel_mm: 1.0,
            center_px: [0.5, 0.5],
            lens: Default::default(),
        }
    }
    fn expose(&mut self, shot: &Shot) -> Result<CapturedFrame> {
        self.0 += 1;
        if self.0 > 100 {
            return Err(Error::new("too many shots"));
        }
        Ok(CapturedFrame {
            bytes: self.0.to_string().into_bytes(),
            extension: "txt".into(),
            exposure_ms: shot.exposure_ms,
        })
    }
}

#[test]
fn sixteen_poses_over_two_real_ports_are_captured_and_their_wire_log_replays() {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let rig = RigDescription::read(&root.join("rig_configs/two_board_grbl.toml")).unwrap();
    let plan = Plan::read(&root.join("rig_configs/plans/khungurn16.toml")).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (folder.path().join("a"), folder.path().join("b"));
    let options = CaptureOptions::default();
    let summary = capture_over_pty(
        &rig,
        &plan,
        &mut NumberCamera(0),
        &first,
        &options,
        500.0,
        &Unwatched,
    )
    .unwrap();
    assert!(summary.finished() && summary.frames == 36);
    let entries = read_wire_log(&first.join("wire.jsonl")).unwrap();
    let mut camera = ReplayCamera::open(&first).unwrap();
    let again = capture_from_replay(
        &rig,
        &plan,
        entries,
        &mut camera,
        None,
        &second,
        &options,
        &Unattended(&Unwatched),
    )
    .unwrap();
    assert!(again.finished() && camera.unused().is_empty());
    let names = |out: &PathBuf| -> Vec<String> {
        let frames = SessionFolder::open(out).unwrap().frames().unwrap();
        frames.into_iter().map(|f| f.file).collect()
    };
    assert_eq!(names(&first), names(&second));
}
