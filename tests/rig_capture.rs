//! Promise: a capture moves only where the rig file allows, loses no frame, and ends dark and still whatever happens.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use goniofit::base::{Error, Result, Unwatched, Watch};
use goniofit::math::PolarDirection;
use goniofit::rig::capture::{Capture, CaptureOptions, Order, Summary, plan_capture};
use goniofit::rig::simulated::{
    capture_from_replay, capture_in_process, in_process_connection, model_options,
};
use goniofit::rig::{
    AxisAngles, AxisName, Camera, CapturedFrame, Clock, Connection, Fault, FaultKind, GrblModel,
    History, ModelTransport, Operator, ReplayCamera, Request, RigDescription, Seen, SharedModel,
    Shot, Transport, Unattended, VirtualClock, read_wire_log,
};
use goniofit::session::{
    CameraFacts, Event, FrameKind, FrameRecord, Plan, SessionFolder, read_journal,
};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

fn file(path: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn rig(name: &str) -> RigDescription {
    RigDescription::read(&file(&format!("rig_configs/{name}.toml"))).unwrap()
}

fn plan16() -> Plan {
    Plan::read(&file("rig_configs/plans/khungurn16.toml")).unwrap()
}

/// Writes what it was asked for into the frame.
#[derive(Default)]
struct TextCamera {
    shots: usize,
    fail_at: Option<usize>,
    watched: Option<(SharedModel, Vec<bool>)>,
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
        self.shots += 1;
        if let Some((model, lamp)) = &mut self.watched {
            lamp.push(model.lock().unwrap().spindle_on());
        }
        if Some(self.shots) == self.fail_at {
            return Err(Error::new("the camera's battery is empty"));
        }
        Ok(CapturedFrame {
            bytes: format!("{shot:?}").into_bytes(),
            extension: "txt".into(),
            exposure_ms: shot.exposure_ms,
        })
    }
}

fn events(out: &Path) -> Vec<Event> {
    let entries = read_journal(&out.join("journal.jsonl")).unwrap();
    entries.into_iter().map(|e| e.event).collect()
}

/// One board's model with faults, a connection to it, and its clock.
fn one_board(
    rig: &RigDescription,
    faults: Vec<Fault>,
) -> (SharedModel, Arc<VirtualClock>, Connection<'static>) {
    let mut options = model_options(rig, &rig.boards[0]);
    options.faults = faults;
    let clock = Arc::new(VirtualClock::new());
    let model = Arc::new(Mutex::new(GrblModel::new(options)));
    let (m, c) = (model.clone(), clock.clone());
    let connection = Connection {
        open: Box::new(move |_| {
            Ok(Box::new(ModelTransport::new(m.clone(), c.clone())) as Box<dyn Transport>)
        }),
        clock: clock.clone(),
        wait_scale: 1.0,
    };
    (model, clock, connection)
}

fn run_one_board(
    rig: &RigDescription,
    faults: Vec<Fault>,
    camera: &mut TextCamera,
    out: &Path,
) -> (SharedModel, Result<Summary>) {
    let (model, _, connection) = one_board(rig, faults);
    let result = Capture {
        description: rig,
        plan: &plan16(),
        connection,
        camera,
        judge: None,
        operator: &Unattended(&Unwatched),
        options: CaptureOptions::default(),
    }
    .start(out);
    (model, result)
}

#[test]
fn sixteen_poses_on_one_board_and_on_two_leave_a_whole_session() {
    for name in ["five_axis_grblhal", "two_board_grbl"] {
        let rig = rig(name);
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("s");
        let options = CaptureOptions::default();
        let mut camera = TextCamera::default();
        let summary =
            capture_in_process(&rig, &plan16(), &mut camera, &out, &options, &Unwatched).unwrap();
        assert!(summary.finished());
        // 16 poses x 2 exposures, 2 whites, 2 darks.
        assert_eq!((summary.frames, summary.frames_planned), (36, 36), "{name}");
        let session = SessionFolder::open(&out).unwrap();
        let frames = session.frames().unwrap();
        let count = |kind| frames.iter().filter(|f| f.kind == kind).count();
        assert_eq!(
            [
                count(FrameKind::White),
                count(FrameKind::Sample),
                count(FrameKind::Dark)
            ],
            [2, 32, 2]
        );
        let tenth = frames.iter().find(|f| f.config == Some(10)).unwrap();
        assert!(tenth.file.ends_with("_sample_c10_50ms.txt"), "{tenth:?}");
        for (axis, angle) in [
            ("light_azimuth", 270.0),
            ("light_elevation", 64.0),
            ("camera_elevation", 48.0),
            ("camera_azimuth", 0.0),
            ("turntable", 0.0),
        ] {
            assert!(
                (tenth.axes_deg[axis] - angle).abs() < 0.01,
                "{name}: {tenth:?}"
            );
        }
        let manifest = session.manifest().unwrap();
        assert_eq!(manifest.white.configuration.id, 0);
        assert_eq!(session.plan().unwrap(), plan16());
        let events = events(&out);
        assert!(matches!(&events[0], Event::Ready { firmware, .. } if firmware.contains("1.1")));
        assert_eq!(events.last(), Some(&Event::Finished));
        assert_eq!(
            std::fs::read_to_string(out.join("rig.toml")).unwrap(),
            rig.text
        );
    }
}

#[test]
fn a_recorded_capture_replays_byte_for_byte_with_the_same_frames() {
    for name in ["five_axis_grblhal", "two_board_grbl"] {
        let rig = rig(name);
        let folder = tempfile::tempdir().unwrap();
        let (first, second) = (folder.path().join("a"), folder.path().join("b"));
        let options = CaptureOptions::default();
        let mut camera = TextCamera::default();
        capture_in_process(&rig, &plan16(), &mut camera, &first, &options, &Unwatched).unwrap();
        let entries = read_wire_log(&first.join("wire.jsonl")).unwrap();
        let mut replayed: Box<dyn Camera> = Box::new(ReplayCamera::open(&first).unwrap());
        let again = capture_from_replay(
            &rig,
            &plan16(),
            entries.clone(),
            replayed.as_mut(),
            None,
            &second,
            &options,
            &Unattended(&Unwatched),
        )
        .unwrap();
        assert!(again.finished());
        let hashes = |out: &Path| -> Vec<(String, String)> {
            let frames = SessionFolder::open(out).unwrap().frames().unwrap();
            frames.into_iter().map(|f| (f.file, f.sha256)).collect()
        };
        assert_eq!(hashes(&first), hashes(&second));
        assert_eq!(read_wire_log(&second.join("wire.jsonl")).unwrap(), entries);

        // Another plan diverges, and the message shows where.
        let mut shorter = plan16();
        shorter.configurations.remove(3);
        let error = capture_from_replay(
            &rig,
            &shorter,
            entries,
            &mut TextCamera::default(),
            None,
            &folder.path().join("c"),
            &options,
            &Unattended(&Unwatched),
        )
        .unwrap_err()
        .report();
        assert!(
            error.contains("replay diverged at entry") && error.contains("expected to board"),
            "{error}"
        );
    }
}

#[test]
fn the_recorded_mock_session_replays_byte_for_byte() {
    let mock = file("mocks/khungurn16_gabardine");
    let session = SessionFolder::open(&mock).unwrap();
    let entries = read_wire_log(&mock.join("wire.jsonl")).unwrap();
    let mut camera = ReplayCamera::open(&mock).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let again = capture_from_replay(
        &RigDescription::read(&mock.join("rig.toml")).unwrap(),
        &session.plan().unwrap(),
        entries,
        &mut camera,
        None,
        &folder.path().join("s"),
        &CaptureOptions::default(),
        &Unattended(&Unwatched),
    )
    .unwrap();
    assert!(again.finished() && camera.unused().is_empty());
}

#[test]
fn a_plan_outside_the_limits_is_refused_before_a_byte_is_sent() {
    let rig = rig("five_axis_grblhal");
    let mut text = plan16().to_toml().unwrap();
    text = text.replacen("light_theta_deg = 64.0", "light_theta_deg = 88.0", 1);
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("s");
    let connection = Connection {
        open: Box::new(|_| panic!("the port must not be opened")),
        clock: Arc::new(VirtualClock::new()),
        wait_scale: 1.0,
    };
    let error = Capture {
        description: &rig,
        plan: &Plan::from_toml(&text).unwrap(),
        connection,
        camera: &mut TextCamera::default(),
        judge: None,
        operator: &Unattended(&Unwatched),
        options: CaptureOptions::default(),
    }
    .start(&out)
    .unwrap_err()
    .report();
    assert!(
        error.contains(
            "pose outside limits: configuration 2, axis light_elevation: 88 degrees, limits 0 to 85"
        ),
        "{error}"
    );
    assert!(!out.exists());
}

#[test]
fn every_fault_ends_dark_and_still_with_the_frames_kept_and_the_reason_journaled() {
    let rig = rig("five_axis_grblhal");
    for (kind, reason) in [
        (FaultKind::Reset, "restarted by itself"),
        (FaultKind::Alarm(1), "limit switch was hit"),
        (FaultKind::CorruptDigit('9'), "off its way"),
        (FaultKind::NeverOk, "no answer within"),
        (FaultKind::FallShort(1.0), "stands at"),
        (FaultKind::Hold, "state Hold"),
        (FaultKind::Vanish, "is disconnected"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("s");
        // Move 1 goes to the white reference, moves 2 to 16 to the poses.
        let fault = Fault { on_move: 6, kind };
        let (model, result) = run_one_board(&rig, vec![fault], &mut TextCamera::default(), &out);
        let error = result.unwrap_err().report();
        assert!(
            error.contains("capture stopped after 10 of 36 frames"),
            "{kind:?}: {error}"
        );
        assert!(error.contains(reason), "{kind:?}: {error}");
        assert!(
            error.contains("the 10 frames taken so far are safe in"),
            "{error}"
        );
        let model = model.lock().unwrap();
        if kind != FaultKind::Vanish {
            assert!(!model.is_moving() && !model.spindle_on(), "{kind:?}");
        } else {
            assert!(error.contains("check by eye"), "{error}");
        }
        let events = events(&out);
        assert_eq!(events.len(), 12, "{kind:?}: ready, 10 frames, stopped");
        assert!(
            matches!(events.last(), Some(Event::Stopped { reason: r }) if r.contains("board 'main'"))
        );
    }
}

#[test]
fn a_failing_camera_stops_the_capture_with_the_lamp_off() {
    let rig = rig("five_axis_grblhal");
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("s");
    let mut camera = TextCamera {
        fail_at: Some(5),
        ..TextCamera::default()
    };
    let (model, result) = run_one_board(&rig, vec![], &mut camera, &out);
    let error = result.unwrap_err().report();
    assert!(
        error.contains("shot sample, configuration ")
            && error.contains(", 50 ms, repeat 0: the camera's battery is empty"),
        "{error}"
    );
    assert!(error.contains("lamp off"), "{error}");
    assert!(!model.lock().unwrap().spindle_on());
    assert_eq!(
        SessionFolder::open(&out).unwrap().frames().unwrap().len(),
        4
    );
}

#[test]
fn the_lamp_burns_for_whites_and_samples_and_is_dark_for_darks() {
    let rig = rig("five_axis_grblhal");
    let folder = tempfile::tempdir().unwrap();
    let (model, clock, connection) = one_board(&rig, vec![]);
    let mut camera = TextCamera {
        watched: Some((model.clone(), Vec::new())),
        ..TextCamera::default()
    };
    Capture {
        description: &rig,
        plan: &plan16(),
        connection,
        camera: &mut camera,
        judge: None,
        operator: &Unattended(&Unwatched),
        options: CaptureOptions::default(),
    }
    .start(&folder.path().join("s"))
    .unwrap();
    let lamp = camera.watched.unwrap().1;
    assert_eq!(lamp, [vec![true; 34], vec![false; 2]].concat());
    let model = model.lock().unwrap();
    assert!(!model.spindle_on() && !model.is_moving());
    // Parked: camera at 0, light at 45 degrees.
    assert!((model.position()[0] + 5.0).abs() < 0.01 && (model.position()[2] + 50.0).abs() < 0.01);
    // Warm-up and settle times passed on the virtual clock only.
    assert!(clock.now() > 60.0 + 16.0 * 0.3, "{}", clock.now());
}

#[test]
fn a_request_to_stop_is_obeyed_after_the_shot_and_journaled() {
    struct StopAfter(AtomicU64);
    impl Watch for StopAfter {
        fn progress(&self, stage: &str, done: u64, total: u64) {
            assert_eq!((stage, total), ("capture", 36));
            self.0.store(done, Ordering::SeqCst);
        }
        fn cancelled(&self) -> bool {
            self.0.load(Ordering::SeqCst) >= 7
        }
    }
    let rig = rig("five_axis_grblhal");
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("s");
    let options = CaptureOptions::default();
    let watch = StopAfter(AtomicU64::new(0));
    let summary = capture_in_process(
        &rig,
        &plan16(),
        &mut TextCamera::default(),
        &out,
        &options,
        &watch,
    )
    .unwrap();
    assert!(!summary.finished() && summary.frames == 7);
    assert!(
        matches!(events(&out).last(), Some(Event::Stopped { reason }) if reason.contains("operator"))
    );
}

#[test]
fn an_existing_session_is_never_touched() {
    let rig = rig("five_axis_grblhal");
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("s");
    let options = CaptureOptions::default();
    let mut camera = TextCamera::default();
    capture_in_process(&rig, &plan16(), &mut camera, &out, &options, &Unwatched).unwrap();
    let before = std::fs::read(out.join("journal.jsonl")).unwrap();
    let error = capture_in_process(&rig, &plan16(), &mut camera, &out, &options, &Unwatched)
        .unwrap_err()
        .report();
    assert!(error.contains("already holds a session"), "{error}");
    assert_eq!(std::fs::read(out.join("journal.jsonl")).unwrap(), before);
}

#[test]
fn boards_that_contradict_the_rig_file_are_refused() {
    let rig = rig("five_axis_grblhal");
    for (setting, value, reason) in [
        (32, 1.0, "laser mode"),
        (30, 500.0, "lamp power S1000 is outside the range"),
        (22, 0.0, "homing switched off"),
        (13, 1.0, "reports inches"),
        (133, 100.0, "axis light_azimuth"),
    ] {
        let mut options = model_options(&rig, &rig.boards[0]);
        options.settings.push((setting, value));
        let (_, connection) = in_process_connection(vec![("main".into(), options)]);
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("s");
        let error = Capture {
            description: &rig,
            plan: &plan16(),
            connection,
            camera: &mut TextCamera::default(),
            judge: None,
            operator: &Unattended(&Unwatched),
            options: CaptureOptions::default(),
        }
        .start(&out)
        .unwrap_err()
        .report();
        assert!(
            error.contains(reason) && error.contains("hint:"),
            "${setting}: {error}"
        );
        assert!(!out.exists());
    }
}

#[test]
fn a_replayed_frame_that_is_missing_or_damaged_is_named() {
    let rig = rig("five_axis_grblhal");
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("s");
    let options = CaptureOptions::default();
    capture_in_process(
        &rig,
        &plan16(),
        &mut TextCamera::default(),
        &out,
        &options,
        &Unwatched,
    )
    .unwrap();
    let mut camera = ReplayCamera::open(&out).unwrap();
    let work = plan_capture(&rig, &plan16(), Order::Plan).unwrap();
    let shots = work.outlook(&History::default());
    assert_eq!(camera.unused().len(), 36);
    camera.expose(&shots[0].shot).unwrap();
    let error = camera.expose(&shots[0].shot).unwrap_err().report();
    assert!(
        error.contains("no (further) white frame") && error.contains("50 ms"),
        "{error}"
    );
    let frames = SessionFolder::open(&out).unwrap().frames().unwrap();
    let first = |f: &&FrameRecord| f.config == Some(1) && f.repeat == 0;
    let file = &frames.iter().find(first).unwrap().file;
    std::fs::write(out.join("frames").join(file), "x").unwrap();
    let error = camera.expose(&shots[2].shot).unwrap_err().report();
    assert!(error.contains(&format!("{file} is damaged")), "{error}");
}

// -- rig files and kinematics ----------------------------------------------------------------------------------------

#[test]
fn poses_become_axis_angles_and_back_over_the_hemisphere() {
    let rig = rig("five_axis_grblhal");
    for light_theta in [0.0, 1.0, 45.0, 85.0] {
        for light_phi in [-10.0, 0.0, 90.0, 180.0, 279.0, -90.0, 360.0] {
            for camera_phi in [-90.0, 0.0, 45.0, 360.0, 330.0] {
                let text = format!(
                    "name = 'p'\n[[configurations]]\nconfig = 1\nlight_theta_deg = {light_theta}\nlight_phi_deg = {light_phi}\n\
                     camera_theta_deg = 30\ncamera_phi_deg = {camera_phi}\nrotation_deg = -270\n"
                );
                let c = Plan::from_toml(&text).unwrap().configurations[0];
                let angles = rig.angles(&c).unwrap();
                rig.check_angles(&angles).unwrap();
                let back = angles.configuration(1);
                for (a, b) in [(c.light, back.light), (c.camera, back.camera)] {
                    assert!((a.vector() - b.vector()).length() < 1e-9, "{c:?} {back:?}");
                }
                assert!((angles.get(AxisName::Turntable) - 90.0).abs() < 1e-9);
            }
        }
    }
}

#[test]
fn the_pole_and_the_horizon_come_back_as_they_went() {
    let text = rig("five_axis_grblhal").text;
    let text = text.replace("max_deg = 85.0", "max_deg = 89.9");
    let rig = RigDescription::from_toml(&text).unwrap();
    for theta in [0.0, 1e-9, 1e-5, 89.9] {
        for phi in [-10.0, 0.0, 280.0, 359.999_999, 360.0, -360.0, 719.0, 315.0] {
            let mut c = plan16().configurations[0];
            c.light = PolarDirection::from_degrees(theta, phi);
            // Between 280 and 350 degrees the light's azimuth cannot stand; at the pole it need not.
            let blocked = theta > 1e-6 && phi == 315.0;
            let angles = match rig.angles(&c) {
                Ok(angles) => angles,
                Err(error) => {
                    assert!(blocked, "{theta} {phi}: {}", error.report());
                    continue;
                }
            };
            assert!(!blocked, "{theta} {phi}");
            rig.check_angles(&angles).unwrap();
            let back = angles.configuration(1).light.vector();
            assert!(
                (back - c.light.vector()).length() < 1e-9,
                "{theta} {phi}: {angles:?}"
            );
        }
    }
}

#[test]
fn an_elevation_axis_through_the_normal_reaches_the_far_side() {
    let text = rig("five_axis_grblhal").text.replacen(
        "min_deg = 0.0\nmax_deg = 85.0",
        "min_deg = -80.0\nmax_deg = 85.0",
        1,
    );
    let rig = RigDescription::from_toml(&text).unwrap();
    let mut plan = plan16();
    plan.configurations[0].camera.phi = std::f64::consts::PI;
    let angles = rig.angles(&plan.configurations[0]).unwrap();
    assert_eq!(angles.get(AxisName::CameraElevation), -80.0);
    assert!(angles.get(AxisName::CameraAzimuth).abs() < 1e-9);
    let back = angles.configuration(1).camera.vector();
    assert!((back - plan.configurations[0].camera.vector()).length() < 1e-9);
}

#[test]
fn only_numbers_inside_the_limits_can_be_sent() {
    let rig = rig("five_axis_grblhal");
    let good = rig.angles(&plan16().configurations[0]).unwrap();
    for bad in [f64::NAN, f64::INFINITY, -1.0, 1000.0] {
        let mut angles = good;
        angles.0[AxisName::LightElevation as usize] = bad;
        assert!(rig.check_angles(&angles).is_err(), "{bad}");
    }
    rig.check_angles(&AxisAngles(good.0)).unwrap();
}

/// An operator who does what is asked, and remembers it.
#[derive(Default)]
struct Listener(Mutex<Vec<String>>);

impl Watch for Listener {
    fn progress(&self, _: &str, _: u64, _: u64) {}
    fn cancelled(&self) -> bool {
        false
    }
}

impl Operator for Listener {
    fn request(&self) -> Request {
        Request::Go
    }
    fn confirm(&self, question: &str) -> Result<()> {
        self.0.lock().unwrap().push(question.to_owned());
        Ok(())
    }
    fn paused(&self) -> bool {
        false
    }
    fn seen(&self, _: &Seen<'_>) {}
}

#[test]
fn a_fixed_axis_takes_only_its_own_pose() {
    let rig = rig("turntable_only");
    let error = rig.plan_angles(&plan16()).unwrap_err().report();
    assert!(
        error.contains("configuration 1, axis camera_elevation: 80 degrees, fixed at 0"),
        "{error}"
    );
    let text = "name = 'p'\n[[configurations]]\nconfig = 1\nlight_theta_deg = 45\nlight_phi_deg = -180\n\
                camera_theta_deg = 0\ncamera_phi_deg = 77\nrotation_deg = 300\n";
    let plan = Plan::from_toml(text).unwrap();
    // At the normal the azimuth means nothing; 300 degrees is -60.
    assert_eq!(
        rig.plan_angles(&plan).unwrap()[0].0,
        [0.0, 0.0, 45.0, 180.0, -60.0]
    );
    let folder = tempfile::tempdir().unwrap();
    let listener = Listener::default();
    let (_, _, connection) = one_board(&rig, vec![]);
    let summary = Capture {
        description: &rig,
        plan: &plan,
        connection,
        camera: &mut TextCamera::default(),
        judge: None,
        operator: &listener,
        options: CaptureOptions::default(),
    }
    .start(&folder.path().join("s"))
    .unwrap();
    assert!(summary.finished());
    let asked = listener.0.lock().unwrap();
    assert!(asked[0].contains("no limit switches"), "{asked:?}");
    assert_eq!(
        &asked[1..],
        ["put the white standard in place", "put the sample in place"]
    );
}

#[test]
fn damaged_rig_files_are_refused_with_the_place() {
    let text = rig("five_axis_grblhal").text;
    let error = |from: &str, to: &str| {
        assert!(text.contains(from), "{from}");
        RigDescription::from_toml(&text.replacen(from, to, 1))
            .unwrap_err()
            .report()
    };
    for (from, to, reason) in [
        (
            "max_deg = 85.0",
            "max_deg = -1.0",
            "axis camera_elevation: min_deg 0 is not below max_deg -1",
        ),
        ("max_deg = 85.0", "max_deg = nan", "max_deg is NaN"),
        ("sign = -1", "sign = 2", "sign is 2"),
        ("sign = -1", "sign = nan", "sign is NaN"),
        (
            "letter = \"Y\"",
            "letter = \"X\"",
            "letter X of board 'main' is used twice",
        ),
        ("board = \"main\"", "board = \"x\"", "unknown board 'x'"),
        ("[axes.turntable]", "[axes.table]", "unknown axis 'table'"),
        (
            "degrees_per_unit = 1.0",
            "degrees_per_unit = 0.0",
            "degrees_per_unit is 0",
        ),
        (
            "feed_deg_per_min = 1800.0",
            "feed_deg_per_min = nan",
            "feed_deg_per_min is NaN",
        ),
        ("[50.0, 400.0]", "[400.0, 50.0]", "ascending"),
        (
            "light_elevation = 45.0",
            "light_elevation = 86.0",
            "park.light_elevation is 86",
        ),
        (
            "light_phi_deg = 180.0",
            "light_phi_deg = 300.0",
            "white reference geometry",
        ),
        ("settle_ms = 300", "settle_sm = 300", "settle_sm"),
    ] {
        let told = error(from, to);
        assert!(told.contains(reason), "{from} -> {to}: {told}");
    }
}
