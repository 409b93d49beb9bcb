//! Promise: a whole capture on Zaber stages and a current source leaves a whole session, or ends at rest, dark, and told.
#![allow(clippy::unwrap_used, missing_docs)]

use goniofit::base::{Result, Unwatched, Watch};
use goniofit::rig::capture::{Capture, CaptureOptions, End, Summary};
use goniofit::rig::simulated::{
    capture_from_replay, capture_in_process, capture_over_pty, connection_to, zaber_options,
};
use goniofit::rig::{
    ByteModel, Camera, CapturedFrame, Clock, RigDescription, ScpiModel, SharedDevice, Shot,
    Unattended, VirtualClock, ZaberFault, ZaberFaultKind, ZaberModel, read_wire_log,
};
use goniofit::session::{CameraFacts, Event, Plan, SessionFolder, read_journal};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

fn file(path: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn rig() -> RigDescription {
    RigDescription::read(&file("rig_configs/zaber_rotary.toml")).unwrap()
}

fn plan16() -> Plan {
    Plan::read(&file("rig_configs/plans/khungurn16.toml")).unwrap()
}

/// Asks to stop at once from a time on.
struct UrgentAt(Arc<VirtualClock>, f64);

impl Watch for UrgentAt {
    fn progress(&self, _: &str, _: u64, _: u64) {}
    fn cancelled(&self) -> bool {
        self.urgent()
    }
    fn urgent(&self) -> bool {
        self.0.now() >= self.1
    }
}

/// A frame is a line of text.
#[derive(Default)]
struct TextCamera {
    lamp: Option<Arc<Mutex<ScpiModel>>>,
    lit: Vec<bool>,
}

impl Camera for TextCamera {
    fn facts(&self) -> CameraFacts {
        CameraFacts {
            name: "text".into(),
            width: 8,
            height: 4,
            pixel_mm: 1.0,
            center_px: [4.0, 2.0],
            lens: Default::default(),
        }
    }
    fn expose(&mut self, shot: &Shot) -> Result<CapturedFrame> {
        if let Some(lamp) = &self.lamp {
            self.lit.push(lamp.lock().unwrap().is_on());
        }
        Ok(CapturedFrame {
            bytes: format!("{shot:?}").into_bytes(),
            extension: "txt".into(),
            exposure_ms: shot.exposure_ms,
        })
    }
}

#[test]
fn sixteen_poses_on_rotary_stages_leave_a_whole_session_that_replays() {
    let rig = rig();
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (folder.path().join("a"), folder.path().join("b"));
    let options = CaptureOptions::default();
    let summary = capture_in_process(
        &rig,
        &plan16(),
        &mut TextCamera::default(),
        &first,
        &options,
        &Unwatched,
    )
    .unwrap();
    assert!(summary.finished());
    assert_eq!((summary.frames, summary.frames_planned), (36, 36));
    let frames = SessionFolder::open(&first).unwrap().frames().unwrap();
    let tenth = frames.iter().find(|f| f.config == Some(10)).unwrap();
    for (axis, angle) in [
        ("light_azimuth", 270.0),
        ("light_elevation", 64.0),
        ("camera_elevation", 48.0),
        ("turntable", 0.0),
    ] {
        assert!((tenth.axes_deg[axis] - angle).abs() < 0.001, "{tenth:?}");
    }
    let entries = read_wire_log(&first.join("wire.jsonl")).unwrap();
    for device in ["arms", "table", "lamp"] {
        assert!(entries.iter().any(|e| e.board == device), "{device}");
    }
    let again = capture_from_replay(
        &rig,
        &plan16(),
        entries,
        &mut TextCamera::default(),
        None,
        &second,
        &options,
        &Unattended(&Unwatched),
    )
    .unwrap();
    assert!(again.finished());
}

struct Room {
    arms: Arc<Mutex<ZaberModel>>,
    table: Arc<Mutex<ZaberModel>>,
    lamp: Arc<Mutex<ScpiModel>>,
    clock: Arc<VirtualClock>,
}

fn captured(faults: Vec<ZaberFault>, out: &Path) -> (Room, Result<Summary>, Vec<bool>) {
    captured_watching(faults, out, None)
}

/// A capture; with `urgent_at` the operator asks to stop at once at that time.
fn captured_watching(
    faults: Vec<ZaberFault>,
    out: &Path,
    urgent_at: Option<f64>,
) -> (Room, Result<Summary>, Vec<bool>) {
    let rig = rig();
    let mut options = zaber_options(&rig, &rig.boards[0]);
    options.faults = faults;
    let arms = Arc::new(Mutex::new(ZaberModel::new(options)));
    let table = ZaberModel::new(zaber_options(&rig, &rig.boards[1]));
    let table = Arc::new(Mutex::new(table));
    let lamp = Arc::new(Mutex::new(ScpiModel::new(1.0, vec![])));
    let devices: Vec<(String, SharedDevice)> = vec![
        ("arms".into(), arms.clone()),
        ("table".into(), table.clone()),
        ("lamp".into(), lamp.clone()),
    ];
    let (clock, connection) = connection_to(devices);
    let asked = urgent_at.unwrap_or(f64::INFINITY);
    let watch = UrgentAt(clock.clone(), asked);
    let mut camera = TextCamera {
        lamp: Some(lamp.clone()),
        lit: Vec::new(),
    };
    let result = Capture {
        description: &rig,
        plan: &plan16(),
        connection,
        camera: &mut camera,
        judge: None,
        operator: &Unattended(&watch),
        options: CaptureOptions::default(),
    }
    .start(out);
    let room = Room {
        arms,
        table,
        lamp,
        clock,
    };
    (room, result, camera.lit)
}

#[test]
fn the_lamp_burns_for_whites_and_samples_only() {
    let folder = tempfile::tempdir().unwrap();
    let (room, result, lit) = captured(vec![], &folder.path().join("s"));
    assert!(result.unwrap().finished());
    assert_eq!(lit, [vec![true; 34], vec![false; 2]].concat());
    assert!(!room.lamp.lock().unwrap().is_on());
    assert!((room.lamp.lock().unwrap().current_a() - 0.7).abs() < 1e-9);
}

#[test]
fn every_fault_in_a_capture_ends_dark_and_still_with_the_frames_kept_and_the_reason_journaled() {
    use ZaberFaultKind as K;
    for (kind, reason) in [
        (K::Restart, "restarted by itself"),
        (K::Stall, "warning FS"),
        (K::Overheat, "warning FD"),
        (K::Mute, "no intact reply"),
        (K::StuckBusy, "did not end within"),
        (K::FallShort(500), "stands at"),
        (K::Interrupt, "warning NI"),
        (K::Knob(20_000), "warning NC"),
        (K::WrongWay, "off its way"),
        (K::Vanish, "is disconnected"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("s");
        // Each way sends four axes: this is the light's elevation on the way to the fourth pose.
        let fault = ZaberFault { on_move: 19, kind };
        let (room, result, _) = captured(vec![fault], &out);
        let error = result.unwrap_err().report();
        assert!(error.contains(reason), "{kind:?}: {error}");
        assert!(error.contains("frames taken so far are safe in"), "{error}");
        assert!(error.contains("lamp off"), "{kind:?}: {error}");
        assert!(!room.lamp.lock().unwrap().is_on(), "{kind:?}");
        let end = room.clock.now() + 1.0;
        let mut arms = room.arms.lock().unwrap();
        arms.take_output(end);
        // A mute or vanished controller cannot be told to stop twice; the brake still reached the mute one.
        assert!(kind == K::Vanish || !arms.is_moving(), "{kind:?}");
        let mut table = room.table.lock().unwrap();
        table.take_output(end);
        assert!(!table.is_moving(), "{kind:?}");
        let events = read_journal(&out.join("journal.jsonl")).unwrap();
        assert!(matches!(
            &events.last().unwrap().event,
            Event::Stopped { reason } if reason.contains("board 'arms'")
        ));
    }
}

#[test]
fn a_lost_or_late_reply_in_a_capture_costs_nothing() {
    for kind in [
        ZaberFaultKind::LoseReply,
        ZaberFaultKind::GarbleReply,
        ZaberFaultKind::LateStart(0.5),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let fault = ZaberFault { on_move: 9, kind };
        let (_, result, _) = captured(vec![fault], &folder.path().join("s"));
        assert!(result.unwrap().finished(), "{kind:?}");
    }
}

#[test]
fn a_stop_at_once_at_any_time_of_a_capture_ends_dark_and_still_within_seconds() {
    let folder = tempfile::tempdir().unwrap();
    let (mut stopped, mut moving) = (0, 0);
    for i in 0..40 {
        // All devices are connected after 0.8 s.
        let asked = 1.1 + 4.0 * f64::from(i);
        let out = folder.path().join(i.to_string());
        let (room, result, _) = captured_watching(vec![], &out, Some(asked));
        let summary = result.unwrap();
        if summary.end != End::Aborted {
            continue;
        }
        stopped += 1;
        let report = summary.stopped.join("; ");
        moving += u32::from(report.contains("stopped, position"));
        assert!(
            room.clock.now() - asked < 4.0,
            "{asked}: {}",
            room.clock.now()
        );
        assert!(!room.lamp.lock().unwrap().is_on(), "{asked}");
        for model in [&room.arms, &room.table] {
            let mut model = model.lock().unwrap();
            model.take_output(room.clock.now());
            assert!(!model.is_moving(), "{asked}: {report}");
        }
    }
    // The capture takes about 170 s, most of it warming up and moving.
    assert!(stopped >= 38 && moving >= 15, "{stopped} {moving}");
}

#[test]
fn limits_of_the_controller_that_do_not_hold_those_of_the_rig_file_are_refused() {
    let rig = rig();
    let folder = tempfile::tempdir().unwrap();
    let mut options = zaber_options(&rig, &rig.boards[0]);
    options.axes[3].limit_max = 1_000_000;
    let model: SharedDevice = Arc::new(Mutex::new(ZaberModel::new(options)));
    let (_, connection) = connection_to([("arms".to_owned(), model)]);
    let error = Capture {
        description: &rig,
        plan: &plan16(),
        connection,
        camera: &mut TextCamera::default(),
        judge: None,
        operator: &Unattended(&Unwatched),
        options: CaptureOptions::default(),
    }
    .start(&folder.path().join("s"))
    .unwrap_err()
    .report();
    assert!(
        error.contains("axis light_azimuth") && error.contains("0 to 1000000"),
        "{error}"
    );
}

#[test]
fn sixteen_poses_over_three_real_ports_are_captured() {
    let rig = rig();
    let folder = tempfile::tempdir().unwrap();
    let summary = capture_over_pty(
        &rig,
        &plan16(),
        &mut TextCamera::default(),
        &folder.path().join("s"),
        &CaptureOptions::default(),
        100.0,
        &Unwatched,
    )
    .unwrap();
    assert!(summary.finished() && summary.frames == 36);
}

#[test]
fn the_program_drives_the_simulated_devices_of_the_rig_file() {
    use std::io::BufRead;
    use std::process::{Command, Stdio};
    struct Simulator(std::process::Child);
    impl Drop for Simulator {
        fn drop(&mut self) {
            let _ = self.0.kill();
            let _ = self.0.wait();
        }
    }
    let folder = tempfile::tempdir().unwrap();
    let text = std::fs::read_to_string(file("rig_configs/zaber_rotary.toml")).unwrap();
    let quick = text
        .replace("warm_up_s = 60.0", "warm_up_s = 0.1")
        .replace("settle_ms = 300", "settle_ms = 1")
        .replace("settle_ms = 200", "settle_ms = 1");
    let rig_file = folder.path().join("rig.toml");
    std::fs::write(&rig_file, &quick).unwrap();
    let rig = RigDescription::from_toml(&quick).unwrap();
    let old = folder.path().join("old");
    let mut camera = TextCamera::default();
    let options = CaptureOptions::default();
    capture_in_process(&rig, &plan16(), &mut camera, &old, &options, &Unwatched).unwrap();

    let program = env!("CARGO_BIN_EXE_goniofit");
    let child = Command::new(program)
        .args(["sim", "--json", "--speed", "100", "--rig"])
        .arg(&rig_file)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut simulator = Simulator(child);
    let mut line = String::new();
    let stdout = simulator.0.stdout.take().unwrap();
    io::BufReader::new(stdout).read_line(&mut line).unwrap();
    let printed: serde_json::Value = serde_json::from_str(&line).unwrap();
    let devices = printed["boards"].as_array().unwrap();
    let kinds: Vec<_> = devices
        .iter()
        .map(|d| d["flavor"].as_str().unwrap())
        .collect();
    assert_eq!(kinds, ["zaber", "zaber", "scpi"]);

    let mut capture = Command::new(program);
    capture
        .arg("capture")
        .arg("--rig")
        .arg(&rig_file)
        .arg("--yes");
    capture
        .arg("--plan")
        .arg(file("rig_configs/plans/khungurn16.toml"));
    capture
        .arg("--camera")
        .arg(format!("replay:{}", old.display()))
        .arg("--blind");
    capture.arg("--out").arg(folder.path().join("new"));
    for device in devices {
        let (name, path) = (device["board"].as_str(), device["path"].as_str());
        capture
            .arg("--port")
            .arg(format!("{}={}", name.unwrap(), path.unwrap()));
    }
    let output = capture.output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{told}");
    assert!(told.contains("finished: 36 of 36 frames"), "{told}");
}
