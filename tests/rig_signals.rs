//! Promise: the real program obeys real signals while it drives a real (pseudo-)terminal.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

use goniofit::base::{Result, Unwatched};
use goniofit::rig::capture::CaptureOptions;
use goniofit::rig::simulated::{capture_in_process, model_options};
use goniofit::rig::{
    Camera, CapturedFrame, GrblModel, PtySimulator, RigDescription, Shot, Way, WireLog,
    read_wire_log,
};
use goniofit::session::{CameraFacts, Event, Plan, read_journal};
use rustix::process::{Pid, Signal, kill_process};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

/// Longest time to wait for anything; a machine under load is slow.
const PATIENCE: Duration = Duration::from_secs(30);
/// From the signal to the end of the process.
const PROMPT: Duration = Duration::from_secs(4);
/// How much faster than real time the simulated board lives.
const SPEED: &str = "50";

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

/// A process that does not outlive its test.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Running {
    fn spawn(command: &mut Command) -> Self {
        let piped = command.stdin(Stdio::null()).stdout(Stdio::piped());
        Self(piped.stderr(Stdio::piped()).spawn().unwrap())
    }

    fn signal(&self, signal: Signal) {
        let id = Pid::from_child(&self.0);
        kill_process(id, signal).unwrap();
    }

    /// Exit code, once the process has ended by itself.
    fn code_within(&mut self, limit: Duration) -> i32 {
        let start = Instant::now();
        while start.elapsed() < limit {
            if let Some(status) = self.0.try_wait().unwrap() {
                return status.code().expect("it ended by itself, not by a signal");
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        panic!("still running {limit:?} after the signal");
    }

    /// The lines of stderr as they come.
    fn talk(&mut self) -> Receiver<String> {
        let (sender, receiver) = channel();
        let stderr = BufReader::new(self.0.stderr.take().unwrap());
        std::thread::spawn(move || {
            for line in stderr.lines().map_while(|l| l.ok()) {
                if sender.send(line).is_err() {
                    return;
                }
            }
        });
        receiver
    }
}

fn wait_for(what: &str, mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < PATIENCE, "waiting for {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn goniofit() -> Command {
    let mut command = Command::new(assert_cmd::cargo::cargo_bin("goniofit"));
    command.env("NO_COLOR", "1");
    command
}

/// A simulated board, and a capture on it with these values in the rig file.
struct Scene {
    folder: tempfile::TempDir,
    _sim: Running,
    capture: Running,
    talk: Receiver<String>,
}

/// A rig file with these values, a plan of two, and a recorded session to take frames from.
fn files(values: &[(&str, &str)]) -> tempfile::TempDir {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let text = std::fs::read_to_string(root.join("rig_configs/five_axis_grblhal.toml"));
    let changed: Vec<String> = text
        .unwrap()
        .lines()
        .map(|line| {
            let key = line.split(" =").next().unwrap();
            let value = values.iter().find(|(k, _)| *k == key);
            value.map_or(line.to_owned(), |(k, v)| format!("{k} = {v}"))
        })
        .collect();
    std::fs::write(path("rig.toml"), changed.join("\n")).unwrap();
    let plan_path = root.join("rig_configs/plans/khungurn16.toml");
    let mut plan = Plan::read(&plan_path).unwrap();
    plan.configurations.truncate(2);
    std::fs::write(path("plan.toml"), plan.to_toml().unwrap()).unwrap();
    let rig = RigDescription::read(&path("rig.toml")).unwrap();
    let options = CaptureOptions {
        synthetic: true,
        ..CaptureOptions::default()
    };
    capture_in_process(&rig, &plan, &mut Blank, &path("old"), &options, &Unwatched).unwrap();
    folder
}

/// The capture of that, on the board behind this port.
fn capture(folder: &Path, port: &str) -> Running {
    let path = |name: &str| folder.join(name);
    let mut command = goniofit();
    command.arg("capture").arg("--rig").arg(path("rig.toml"));
    command.arg("--plan").arg(path("plan.toml"));
    command.arg("--out").arg(path("new")).arg("--yes");
    command.args(["--port", port]);
    command
        .arg("--camera")
        .arg(format!("replay:{}", path("old").display()));
    Running::spawn(&mut command)
}

impl Scene {
    fn new(values: &[(&str, &str)]) -> Self {
        let folder = files(values);
        let path = |name: &str| folder.path().join(name);
        let mut command = goniofit();
        command.args(["sim", "--json", "--speed", SPEED, "--log"]);
        let mut sim = Running::spawn(command.arg(path("sim.jsonl")));
        let mut line = String::new();
        let mut stdout = BufReader::new(sim.0.stdout.take().unwrap());
        stdout.read_line(&mut line).unwrap();
        let json: serde_json::Value = serde_json::from_str(&line).unwrap();

        let port = json["boards"][0]["path"].as_str().unwrap();
        let mut capture = capture(folder.path(), port);
        let talk = capture.talk();
        Self {
            folder,
            _sim: sim,
            capture,
            talk,
        }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// What the board heard so far.
    fn heard(&self) -> String {
        let text = std::fs::read_to_string(self.path("sim.jsonl")).unwrap_or_default();
        let whole = &text[..text.rfind('\n').map_or(0, |at| at + 1)];
        let entries = goniofit::rig::parse_wire_log(whole).unwrap();
        let bytes = entries.into_iter().filter(|e| e.way == Way::ToBoard);
        let bytes: Vec<u8> = bytes.flat_map(|e| e.bytes).collect();
        String::from_utf8_lossy(&bytes).into_owned()
    }

    fn wait_until_heard(&self, text: &str) {
        wait_for(text, || self.heard().contains(text));
    }

    fn wait_until_said(&self, text: &str) {
        while let Ok(line) = self.talk.recv_timeout(PATIENCE) {
            if line.contains(text) {
                return;
            }
        }
        panic!("it never said: {text}");
    }

    fn last_event(&self) -> Event {
        let entries = read_journal(&self.path("new/journal.jsonl")).unwrap();
        entries.into_iter().next_back().unwrap().event
    }
}

/// True when the lamp is off after these bytes: M5 or a reset came last.
fn dark(heard: &str) -> bool {
    let after = heard.rfind("M3").map_or(heard, |at| &heard[at..]);
    after.contains("M5\n") || after.contains('\x18')
}

#[test]
fn one_interrupt_or_terminate_ends_a_warm_up_with_the_lamp_off() {
    for signal in [Signal::INT, Signal::TERM] {
        let mut scene = Scene::new(&[("warm_up_s", "600.0"), ("settle_ms", "1")]);
        scene.wait_until_heard("M3S1000");
        // The lamp is read back before its warm-up begins.
        wait_for("the read-back", || {
            scene
                .heard()
                .split("M3S1000")
                .nth(1)
                .unwrap()
                .contains("$G\n")
        });
        scene.capture.signal(signal);
        assert_eq!(scene.capture.code_within(PROMPT), 1);
        scene.wait_until_said("paused: 0 of 8 frames");
        let heard = scene.heard();
        assert!(dark(&heard) && !heard.contains('!'), "{heard:?}");
        assert!(
            matches!(scene.last_event(), Event::Stopped { reason } if reason.contains("operator"))
        );
    }
}

#[test]
fn a_second_interrupt_stops_the_motion_and_the_position_is_kept() {
    // 20 degrees per minute: the way to the white standard takes 10 minutes, simulated in 12 s.
    let mut scene = Scene::new(&[("feed_deg_per_min", "20.0"), ("settle_ms", "1")]);
    scene.wait_until_heard("G4P0.01");
    scene.capture.signal(Signal::INT);
    scene.wait_until_said("press Ctrl-C again to stop the rig now");
    // The first lets the motion go on.
    std::thread::sleep(Duration::from_millis(300));
    assert!(scene.capture.0.try_wait().unwrap().is_none());
    assert!(!scene.heard().contains('!'));
    scene.capture.signal(Signal::INT);
    assert_eq!(scene.capture.code_within(PROMPT), 3);
    scene.wait_until_said("position kept");
    scene.wait_until_said("aborted: 0 of 8 frames");
    let heard = scene.heard();
    let stop = heard.find('!').unwrap();
    assert!(heard[stop..].contains('\x18') && dark(&heard), "{heard:?}");
    assert!(
        matches!(scene.last_event(), Event::Stopped { reason } if reason.contains("by the operator"))
    );
    let log = read_wire_log(Path::new(&scene.path("sim.jsonl"))).unwrap();
    let said = log.iter().filter(|e| e.way == Way::FromBoard);
    let said: Vec<u8> = said.flat_map(|e| e.bytes.clone()).collect();
    let said = String::from_utf8(said).unwrap();
    assert!(
        said.contains("<Hold:0") && !said.contains("ALARM:3"),
        "{said}"
    );
}

#[test]
fn a_third_interrupt_halts_without_waiting_for_standstill() {
    let mut scene = Scene::new(&[("feed_deg_per_min", "20.0"), ("settle_ms", "1")]);
    scene.wait_until_heard("G4P0.01");
    scene.capture.signal(Signal::INT);
    scene.wait_until_said("press Ctrl-C again to stop the rig now");
    scene.capture.signal(Signal::INT);
    scene.wait_until_said("a third Ctrl-C halts it");
    scene.capture.signal(Signal::INT);
    assert_eq!(scene.capture.code_within(PROMPT), 4);
    let heard = scene.heard();
    assert!(heard.contains('\x18') && dark(&heard), "{heard:?}");
}

/// From the signal to the far end of the pseudo-terminal, by way of a process that waits for a motion to end.
#[test]
fn the_second_interrupt_is_on_the_wire_in_time() {
    const LIMIT: f64 = 0.25;
    let mut times = Vec::new();
    for _ in 0..5 {
        let folder = files(&[("feed_deg_per_min", "20.0"), ("settle_ms", "1")]);
        let rig = RigDescription::read(&folder.path().join("rig.toml")).unwrap();
        let model = GrblModel::new(model_options(&rig, &rig.boards[0]));
        let log = WireLog::new();
        let wire = folder.path().join("wire.jsonl");
        log.write_to(&wire).unwrap();
        let start = Instant::now();
        let board = PtySimulator::spawn(model, 1.0, Some((log, "main".to_owned()))).unwrap();
        let mut capture = capture(folder.path(), board.path());
        let heard = |text: &str| {
            let entries = read_wire_log(&wire).unwrap_or_default();
            let to_board = entries.into_iter().filter(|e| e.way == Way::ToBoard);
            to_board
                .filter(|e| String::from_utf8_lossy(&e.bytes).contains(text))
                .map(|e| e.t)
                .next()
        };
        wait_for("the motion", || heard("G4P0.01").is_some());
        capture.signal(Signal::INT);
        std::thread::sleep(Duration::from_millis(300));
        assert!(heard("!").is_none(), "the first lets the motion go on");
        let sent = start.elapsed().as_secs_f64();
        capture.signal(Signal::INT);
        wait_for("the hold", || heard("!").is_some());
        times.push(heard("!").unwrap() - sent);
        assert_eq!(capture.code_within(PROMPT), 3);
    }
    times.sort_by(f64::total_cmp);
    println!(
        "SIGINT to the wire: median {:.1} ms, longest {:.1} ms",
        1e3 * times[2],
        1e3 * times[4]
    );
    assert!(times[4] < LIMIT, "{times:?}");
}
