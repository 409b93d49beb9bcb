//! Promise: a request to stop is obeyed in every phase of a capture, the urgent one on the wire within 0.2 s.
//!
//! On a virtual clock, with the request at times spread over a whole capture.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use goniofit::base::{Result, Watch};
use goniofit::rig::capture::{Capture, CaptureOptions, End, Summary};
use goniofit::rig::simulated::model_options;
use goniofit::rig::{
    Camera, CapturedFrame, Clock, Connection, Fault, FaultKind, GrblModel, ModelTransport,
    RigDescription, SharedModel, Shot, Transport, Unattended, VirtualClock,
};
use goniofit::session::{CameraFacts, Event, Plan, read_journal};
use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

/// Seconds from the request to the byte that stops motion.
const LATENCY: f64 = 0.2;

/// Asks to end, or to stop at once, from a time on.
struct At {
    clock: Arc<VirtualClock>,
    cancelled: f64,
    urgent: f64,
}

impl Watch for At {
    fn progress(&self, _: &str, _: u64, _: u64) {}
    fn cancelled(&self) -> bool {
        self.clock.now() >= self.cancelled
    }
    fn urgent(&self) -> bool {
        self.clock.now() >= self.urgent
    }
}

/// What was sent, with board and time.
type Wire = Arc<Mutex<Vec<(f64, String, String)>>>;

struct Tapped {
    inner: ModelTransport,
    clock: Arc<VirtualClock>,
    board: String,
    wire: Wire,
}

impl Transport for Tapped {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        let text = String::from_utf8_lossy(bytes).into_owned();
        let entry = (self.clock.now(), self.board.clone(), text);
        self.wire.lock().unwrap().push(entry);
        self.inner.write(bytes)
    }
    fn read(&mut self, buffer: &mut [u8], timeout: f64) -> io::Result<usize> {
        self.inner.read(buffer, timeout)
    }
}

/// A camera that takes its time.
struct Slow(Arc<VirtualClock>, f64);

impl Camera for Slow {
    fn facts(&self) -> CameraFacts {
        CameraFacts {
            name: "slow".into(),
            width: 1,
            height: 1,
            pixel_mm: 1.0,
            center_px: [0.5, 0.5],
            lens: Default::default(),
        }
    }
    fn expose(&mut self, shot: &Shot) -> Result<CapturedFrame> {
        self.0.sleep(self.1);
        Ok(CapturedFrame {
            bytes: format!("{shot:?}").into_bytes(),
            extension: "txt".into(),
            exposure_ms: shot.exposure_ms,
        })
    }
}

struct Ran {
    result: Result<Summary>,
    models: BTreeMap<String, SharedModel>,
    wire: Vec<(f64, String, String)>,
    ended: f64,
    events: Vec<Event>,
}

impl Ran {
    fn sent(&self, text: &str) -> impl Iterator<Item = f64> {
        self.wire
            .iter()
            .filter(move |(_, _, t)| t.contains(text))
            .map(|(t, ..)| *t)
    }

    fn first(&self, text: &str) -> f64 {
        self.sent(text).next().unwrap()
    }

    fn assert_dark_and_still(&self, what: &str) {
        for (name, model) in &self.models {
            let mut model = model.lock().unwrap();
            model.take_output(self.ended + 60.0);
            assert!(!model.is_moving(), "{what}: board {name} moves");
            assert!(!model.spindle_on(), "{what}: the lamp of {name} is on");
        }
    }
}

/// A capture of two configurations that is asked to end at `cancelled` and to stop at once at `urgent`.
fn run(rig: &RigDescription, cancelled: f64, urgent: f64, exposure: f64) -> Ran {
    run_with(rig, cancelled, urgent, exposure, &[])
}

/// As [`run`], with faults of the first board.
fn run_with(
    rig: &RigDescription,
    cancelled: f64,
    urgent: f64,
    exposure: f64,
    faults: &[Fault],
) -> Ran {
    let clock = Arc::new(VirtualClock::new());
    let wire = Wire::default();
    let models: BTreeMap<String, SharedModel> = rig
        .boards
        .iter()
        .map(|b| {
            let mut options = model_options(rig, b);
            if b.name == rig.boards[0].name {
                options.faults = faults.to_vec();
            }
            let model = GrblModel::new(options);
            (b.name.clone(), Arc::new(Mutex::new(model)))
        })
        .collect();
    let connection = Connection {
        open: Box::new(|board| {
            Ok(Box::new(Tapped {
                inner: ModelTransport::new(models[&board.name].clone(), clock.clone()),
                clock: clock.clone(),
                board: board.name.clone(),
                wire: wire.clone(),
            }))
        }),
        clock: clock.clone(),
        wait_scale: 1.0,
    };
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let mut plan = Plan::read(&root.join("rig_configs/plans/khungurn16.toml")).unwrap();
    plan.configurations.truncate(2);
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("s");
    let watch = At {
        clock: clock.clone(),
        cancelled,
        urgent,
    };
    let result = Capture {
        description: rig,
        plan: &plan,
        connection,
        camera: &mut Slow(clock.clone(), exposure),
        judge: None,
        operator: &Unattended(&watch),
        options: CaptureOptions::default(),
    }
    .start(&out);
    let events = events(&out);
    let wire = wire.lock().unwrap().clone();
    Ran {
        result,
        models,
        wire,
        ended: clock.now(),
        events,
    }
}

fn events(out: &Path) -> Vec<Event> {
    let Ok(entries) = read_journal(&out.join("journal.jsonl")) else {
        return Vec::new();
    };
    entries.into_iter().map(|e| e.event).collect()
}

/// The rigs with long waits: 5 s to settle, 20 s to warm up, slow axes.
fn rigs() -> Vec<RigDescription> {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    ["five_axis_grblhal", "two_board_grbl"]
        .iter()
        .map(|name| {
            let path = root.join(format!("rig_configs/{name}.toml"));
            let text = std::fs::read_to_string(path).unwrap();
            let slow: Vec<String> = text
                .lines()
                .map(|l| match l.split(" =").next() {
                    Some("settle_ms") => "settle_ms = 5000".to_owned(),
                    Some("warm_up_s") => "warm_up_s = 20.0".to_owned(),
                    Some("feed_deg_per_min") => "feed_deg_per_min = 900.0".to_owned(),
                    _ => l.to_owned(),
                })
                .collect();
            RigDescription::from_toml(&slow.join("\n")).unwrap()
        })
        .collect()
}

/// Times every 1.31 s from a moment after the start of homing to the end.
fn moments(whole: &Ran) -> Vec<f64> {
    let start = whole.first("$H") + 0.01;
    let n = ((whole.ended - start) / 1.31) as usize;
    assert!(n > 50, "{n}");
    (0..n).map(|i| start + 1.31 * i as f64).collect()
}

#[test]
fn an_urgent_stop_reaches_every_board_within_its_time_limit_in_every_phase() {
    for rig in rigs() {
        let whole = run(&rig, f64::INFINITY, f64::INFINITY, 0.0);
        assert!(whole.result.as_ref().unwrap().finished());
        assert!(whole.sent("!").next().is_none());
        let mut in_motion = 0;
        for t in moments(&whole) {
            let ran = run(&rig, t, t, 0.0);
            let what = format!("{}: stop at {t:.2} s", rig.name);
            for board in &rig.boards {
                let hold = ran
                    .wire
                    .iter()
                    .find(|(_, b, text)| *b == board.name && text == "!");
                let (at, ..) = hold.unwrap_or_else(|| panic!("{what}: no ! to {}", board.name));
                assert!(
                    (0.0..=LATENCY).contains(&(at - t)),
                    "{what}: ! to {} at {at}",
                    board.name
                );
                let after = ran
                    .wire
                    .iter()
                    .filter(|(at, b, _)| *at >= t && *b == board.name);
                let reset = after.clone().any(|(_, _, text)| text == "\x18");
                assert!(reset, "{what}: no reset of {}", board.name);
            }
            ran.assert_dark_and_still(&what);
            assert!(ran.ended - t < 4.0, "{what}: took {} s", ran.ended - t);
            assert!(ran.sent("G53").all(|at| at <= t + 0.06), "{what}: moved on");
            let summary = ran.result.unwrap();
            assert_eq!(summary.end, End::Aborted, "{what}");
            let stopped = summary.stopped.join("; ");
            let homed = t > whole.first("G53");
            if homed {
                assert!(!stopped.contains("position unknown"), "{what}: {stopped}");
                in_motion += 1;
            }
            assert!(
                matches!(ran.events.last(), Some(Event::Stopped { reason }) if reason.contains("operator")),
                "{what}: {:?}",
                ran.events
            );
        }
        assert!(in_motion > 20);
    }
}

#[test]
fn homing_which_obeys_no_hold_is_reset_at_once() {
    for rig in rigs() {
        let whole = run(&rig, f64::INFINITY, f64::INFINITY, 0.0);
        let t = whole.first("$H") + 1.0;
        let ran = run(&rig, t, t, 0.0);
        assert!(
            ran.first("\x18") - t <= LATENCY,
            "{}",
            ran.first("\x18") - t
        );
        ran.assert_dark_and_still(&rig.name);
        let stopped = ran.result.unwrap().stopped.join("; ");
        assert!(
            stopped.contains("position unknown, home before moving"),
            "{stopped}"
        );
    }
}

#[test]
fn a_request_to_end_is_obeyed_in_every_phase_without_breaking_a_motion_off() {
    for rig in rigs() {
        let whole = run(&rig, f64::INFINITY, f64::INFINITY, 0.0);
        let lamp = whole.first("M3");
        let (mut warming, mut settling) = (0, 0);
        for t in moments(&whole) {
            let ran = run(&rig, t, f64::INFINITY, 0.0);
            let what = format!("{}: end at {t:.2} s", rig.name);
            ran.assert_dark_and_still(&what);
            let summary = ran.result.as_ref().unwrap();
            let [before, after] = [&whole, &ran].map(|r| {
                let frames = r.events.iter();
                frames.filter(|e| matches!(e, Event::Frame(_))).count()
            });
            assert_eq!(summary.frames, after);
            if summary.finished() {
                // Only the way to the parking place was left.
                assert_eq!(after, before, "{what}");
                continue;
            }
            assert!(ran.sent("!").next().is_none() && ran.sent("\x18").next().is_none());
            assert!(ran.sent("G53").all(|at| at <= t + 0.06), "{what}: moved on");
            assert!(
                matches!(ran.events.last(), Some(Event::Stopped { reason }) if reason.contains("operator")),
                "{what}"
            );
            // During the warm-up nothing has to end first; a settle time is cut short too.
            if (lamp + 0.1..lamp + 19.0).contains(&t) {
                assert!(ran.ended - t < LATENCY, "{what}: took {}", ran.ended - t);
                assert_eq!(summary.frames, 0);
                warming += 1;
            } else if ran.ended - t < LATENCY {
                settling += 1;
            }
        }
        assert!(warming > 10 && settling > 3, "{warming} {settling}");
    }
}

#[test]
fn a_fault_of_one_board_brakes_the_other_before_either_is_waited_for() {
    let rig = &rigs()[1];
    let fault = Fault {
        on_move: 2,
        kind: FaultKind::Hold,
    };
    let ran = run_with(rig, f64::INFINITY, f64::INFINITY, 0.0, &[fault]);
    let error = ran.result.as_ref().unwrap_err().report();
    assert!(error.contains("state Hold"), "{error}");
    let holds: Vec<(f64, &str)> = ran
        .wire
        .iter()
        .filter(|(_, _, text)| text == "!")
        .map(|(t, board, _)| (*t, board.as_str()))
        .collect();
    assert_eq!(holds.len(), 2, "{holds:?}");
    assert!(
        holds[0].1 != holds[1].1 && holds[1].0 - holds[0].0 < 0.01,
        "{holds:?}"
    );
    ran.assert_dark_and_still("fault");
}

#[test]
fn connecting_ends_on_either_request_and_nothing_was_moved() {
    let rig = &rigs()[0];
    let whole = run(rig, f64::INFINITY, f64::INFINITY, 0.0);
    let until = whole.first("$H") - 0.05;
    for i in 0..10 {
        let t = until * f64::from(i) / 10.0;
        for urgent in [t, f64::INFINITY] {
            let ran = run(rig, t, urgent, 0.0);
            assert!(ran.ended - t <= LATENCY, "{t}: {}", ran.ended);
            let error = ran.result.unwrap_err().report();
            assert!(
                error.contains("the capture did not begin, nothing was moved")
                    && error.contains("by the operator"),
                "{error}"
            );
            assert!(ran.events.is_empty());
        }
    }
}

#[test]
fn an_exposure_is_not_interrupted_and_its_frame_is_not_kept_on_an_urgent_stop() {
    let rig = &rigs()[0];
    let exposure = 30.0;
    let whole = run(rig, f64::INFINITY, f64::INFINITY, exposure);
    let start = whole.first("M3") + 20.1;
    for into in [1.0, 29.0] {
        let t = start + into;
        let ran = run(rig, t, t, exposure);
        let late = ran.first("!") - (start + exposure);
        assert!(late.abs() <= LATENCY, "{late}");
        ran.assert_dark_and_still("exposure");
        let summary = ran.result.unwrap();
        assert_eq!((summary.end, summary.frames), (End::Aborted, 0));
        // The first request keeps the frame.
        let ran = run(rig, t, f64::INFINITY, exposure);
        assert_eq!(ran.result.unwrap().frames, 1);
    }
}
