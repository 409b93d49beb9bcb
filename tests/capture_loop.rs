//! What the capture loop does beyond the list of poses: metering, re-shooting, following the lamp, pausing, stopping, and
//! what it writes down.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use goniofit::base::{Error, Result, Unwatched, Watch};
use goniofit::measure::{FrameJudge, MeasureOptions, measure_session};
use goniofit::rig::capture::{Capture, CaptureOptions, End, Summary};
use goniofit::rig::exposures::Verdict;
use goniofit::rig::simulated::model_options;
use goniofit::rig::{
    Appearance, Camera, CapturedFrame, Clock, Connection, GrblModel, Judge, ModelTransport,
    Operator, Request, RigDescription, Seen, SensorModel, SharedModel, Shot, Transport, Unattended,
    VirtualCamera, VirtualClock, read_wire_log,
};
use goniofit::session::{
    BitDepth, CameraFacts, Configuration, Event, Exposedness, FrameKind, FrameRecord, Plan,
    SessionFolder, read_journal, sha256,
};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// The five-axis rig with a small camera; `camera` replaces its exposures, `lamp` its warm-up.
fn rig(camera: &str, lamp: &str) -> RigDescription {
    let text = std::fs::read_to_string(root().join("rig_configs/five_axis_grblhal.toml")).unwrap();
    let text = text
        .replace("pixel_mm = 0.05", "pixel_mm = 0.25")
        .replace("exposures_ms = [50.0, 400.0]", camera)
        .replace("warm_up_s = 60.0", lamp);
    RigDescription::from_toml(&text).unwrap()
}

fn plan(n: usize) -> Plan {
    let mut plan = Plan::read(&root().join("rig_configs/plans/khungurn16.toml")).unwrap();
    plan.configurations.truncate(n);
    plan
}

/// Cloth that is this bright, and a white panel.
struct Flat(fn(u32) -> f64);

impl Appearance for Flat {
    fn radiance(&self, kind: FrameKind, pose: &Configuration, point: [f64; 2]) -> [f64; 3] {
        match kind {
            FrameKind::White => [0.733; 3],
            _ => [1.0, 0.8, 0.6].map(|c| c * self.0(pose.id) * (1.0 + 0.02 * point[0].sin())),
        }
    }
}

fn camera(brightness: fn(u32) -> f64) -> VirtualCamera {
    let sensor = SensorModel {
        width: 64,
        height: 64,
        pixel_mm: 0.25,
        center_px: [32.0, 32.0],
        bits: BitDepth::Sixteen,
        ..SensorModel::default()
    };
    VirtualCamera::new(sensor, Box::new(Flat(brightness)), 3).unwrap()
}

struct Look(FrameJudge);

impl Judge for Look {
    fn judge(&mut self, shot: &Shot, frame: &CapturedFrame) -> Result<Option<Exposedness>> {
        self.0
            .look(shot.kind, &shot.pose, &frame.bytes, &frame.extension)
    }
}

/// A simulated board and its clock.
struct Room {
    model: SharedModel,
    clock: Arc<VirtualClock>,
}

impl Room {
    fn of(rig: &RigDescription) -> Self {
        let options = model_options(rig, &rig.boards[0]);
        Self {
            model: Arc::new(Mutex::new(GrblModel::new(options))),
            clock: Arc::new(VirtualClock::new()),
        }
    }

    fn connection(&self) -> Connection<'_> {
        Connection {
            open: Box::new(|_| {
                let transport = ModelTransport::new(self.model.clone(), self.clock.clone());
                Ok(Box::new(transport) as Box<dyn Transport>)
            }),
            clock: self.clock.clone(),
            wait_scale: 1.0,
        }
    }

    fn capture(
        &self,
        rig: &RigDescription,
        plan: &Plan,
        camera: &mut dyn Camera,
        operator: &dyn Operator,
        out: &Path,
    ) -> Result<Summary> {
        let judge = FrameJudge::new(camera.facts(), rig.camera.sample_square_mm);
        let capture = Capture {
            description: rig,
            plan,
            connection: self.connection(),
            camera,
            judge: Some(Box::new(Look(judge))),
            operator,
            options: CaptureOptions {
                note: "a note".to_owned(),
                host: "lab".to_owned(),
                ..CaptureOptions::default()
            },
        };
        if out.join("session.json").exists() {
            capture.resume(out)
        } else {
            capture.start(out)
        }
    }

    fn is_dark_and_still(&self) -> bool {
        let mut model = self.model.lock().unwrap();
        model.take_output(self.clock.now() + 1.0);
        !model.spindle_on() && !model.is_moving()
    }
}

fn frames(out: &Path) -> Vec<FrameRecord> {
    SessionFolder::open(out).unwrap().frames().unwrap()
}

fn events(out: &Path) -> Vec<Event> {
    let entries = read_journal(&out.join("journal.jsonl")).unwrap();
    entries.into_iter().map(|e| e.event).collect()
}

// -- exposures -------------------------------------------------------------------------------------------------------

#[test]
fn metering_brackets_each_pose_by_its_own_brightness_and_darks_follow() {
    let rig = rig(
        "exposures_ms = [2.0, 8.0, 32.0, 128.0, 512.0, 2048.0]\nmetering = \"metered\"",
        "warm_up_s = 1.0",
    );
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("s");
    // Three poses, a decade apart.
    let mut camera = camera(|id| 10f64.powi(1 - id as i32));
    let summary = Room::of(&rig)
        .capture(&rig, &plan(3), &mut camera, &Unattended(&Unwatched), &out)
        .unwrap();
    assert!(summary.finished() && summary.badly_exposed.is_empty());
    let frames = frames(&out);
    let longest = |config| {
        let of_pose = frames.iter().filter(|f| f.config == Some(config));
        let usable = of_pose.filter(|f| f.exposed.unwrap().peak.iter().all(|p| *p < 0.92));
        usable.map(|f| f.exposure_ms).fold(0.0, f64::max)
    };
    // Each pose's best exposure suits its brightness: a decade needs one or two steps of four.
    assert!(longest(1) < longest(2) && longest(2) < longest(3));
    for config in 1..=3 {
        let best = frames
            .iter()
            .filter(|f| f.config == Some(config))
            .map(|f| f.exposed.unwrap().peak[0])
            .filter(|p| *p < 0.92)
            .fold(0.0, f64::max);
        assert!(best > 0.15, "configuration {config}: {best}");
    }
    let mut lit: Vec<u64> = frames
        .iter()
        .filter(|f| f.kind != FrameKind::Dark)
        .map(|f| f.exposure_ms.to_bits())
        .collect();
    lit.sort_unstable();
    lit.dedup();
    let mut dark: Vec<u64> = frames
        .iter()
        .filter(|f| f.kind == FrameKind::Dark)
        .map(|f| f.exposure_ms.to_bits())
        .collect();
    dark.sort_unstable();
    assert_eq!(lit, dark, "a dark for each exposure used, and no other");
    let session = SessionFolder::open(&out).unwrap();
    measure_session(&session, &MeasureOptions::default(), &Unwatched).unwrap();
}

#[test]
fn a_clipped_pose_is_shot_again_shorter_and_a_hopeless_one_is_reported() {
    let folder = tempfile::tempdir().unwrap();
    // 512 ms clips; the camera can go down to 0.5 ms, or to 400 ms.
    for (shortest, good) in [(0.5, true), (400.0, false)] {
        let rig = rig(
            &format!("exposures_ms = [512.0, 2048.0]\nmin_exposure_ms = {shortest}"),
            "warm_up_s = 1.0",
        );
        let out = folder.path().join(shortest.to_string());
        let mut camera = camera(|_| 0.8);
        let summary = Room::of(&rig)
            .capture(&rig, &plan(1), &mut camera, &Unattended(&Unwatched), &out)
            .unwrap();
        let frames = frames(&out);
        let of_pose: Vec<f64> = frames
            .iter()
            .filter(|f| f.config == Some(1))
            .map(|f| f.exposure_ms)
            .collect();
        assert_eq!(of_pose[..2], [512.0, 2048.0]);
        if good {
            assert_eq!(of_pose[2..], [128.0, 32.0], "a quarter each time");
            assert!(summary.badly_exposed.is_empty());
        } else {
            assert_eq!(of_pose[2..], [400.0]);
            let bad: Vec<Verdict> = summary.badly_exposed.iter().map(|b| b.1).collect();
            assert_eq!(
                bad,
                [Verdict::Clipped; 2],
                "the white standard and the pose"
            );
        }
    }
}

/// A camera whose first file of each shot is torn.
struct Torn(VirtualCamera, u32);

impl Camera for Torn {
    fn facts(&self) -> CameraFacts {
        Camera::facts(&self.0)
    }
    fn expose(&mut self, shot: &Shot) -> Result<CapturedFrame> {
        self.1 += 1;
        let mut frame = self.0.expose(shot)?;
        if self.1 % 2 == 1 {
            frame.bytes.truncate(200);
        }
        Ok(frame)
    }
}

#[test]
fn a_torn_file_is_shot_again_and_never_journaled() {
    let rig = rig("exposures_ms = [32.0]", "warm_up_s = 1.0");
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("s");
    let mut camera = Torn(camera(|_| 0.5), 0);
    let operator = Person::default();
    Room::of(&rig)
        .capture(&rig, &plan(1), &mut camera, &operator, &out)
        .unwrap();
    assert_eq!(frames(&out).len(), 3);
    assert!(frames(&out).iter().all(|f| {
        let bytes = std::fs::read(out.join("frames").join(&f.file)).unwrap();
        f.kind == FrameKind::Dark || (bytes.len() > 1000 && sha256(&bytes) == f.sha256)
    }));
    let notes = operator.notes.lock().unwrap();
    assert!(
        notes.len() == 2 && notes[0].contains("again: ") && notes[0].contains("decoded"),
        "{notes:?}"
    );
}

// -- the lamp --------------------------------------------------------------------------------------------------------

/// Relative lamp brightness after this many frames with light.
fn fading(lit: &mut f64) -> [f64; 3] {
    *lit += 1.0;
    [1.0 - 0.1 * (1.0 - (-*lit / 12.0).exp()); 3]
}

fn with_lamp(brightness: fn(u32) -> f64) -> VirtualCamera {
    let mut lit = 0.0;
    camera(brightness).with_lamp(Box::new(move |_| fading(&mut lit)))
}

#[test]
fn a_fading_lamp_is_followed_by_the_reference_pose_and_corrected() {
    let folder = tempfile::tempdir().unwrap();
    let measured = |every: u32, steady: bool| -> Vec<f64> {
        let rig = rig(
            "exposures_ms = [32.0]",
            &format!("warm_up_s = 1.0\nreference_every = {every}"),
        );
        let out = folder.path().join(format!("{every}{steady}"));
        let mut camera = if steady {
            camera(|_| 0.5)
        } else {
            with_lamp(|_| 0.5)
        };
        Room::of(&rig)
            .capture(&rig, &plan(8), &mut camera, &Unattended(&Unwatched), &out)
            .unwrap();
        if every > 0 {
            let kinds: Vec<FrameKind> = frames(&out).iter().map(|f| f.kind).collect();
            use FrameKind::{Dark as D, Reference as R, Sample as S, White as W};
            assert_eq!(kinds, [W, R, S, S, R, S, S, R, S, S, R, S, S, R, D]);
            let visits: Vec<u32> = frames(&out)
                .iter()
                .filter(|f| f.kind == R)
                .map(|f| f.visit)
                .collect();
            assert_eq!(visits, [0, 1, 2, 3, 4]);
        }
        let session = SessionFolder::open(&out).unwrap();
        let (m, _) = measure_session(&session, &MeasureOptions::default(), &Unwatched).unwrap();
        m.intensities.iter().map(|i| i.mean[1]).collect()
    };
    let worst = |a: &[f64], b: &[f64]| {
        let ratios = a.iter().zip(b).map(|(a, b)| (a / b - 1.0).abs());
        ratios.fold(0.0, f64::max)
    };
    let truth = measured(0, true);
    let followed = worst(&measured(2, false), &truth);
    let left_alone = worst(&measured(0, false), &truth);
    // Noise of these small frames is below 0.5 %.
    assert!(followed < 0.015, "{followed}");
    assert!(left_alone > 0.04, "{left_alone}");
}

#[test]
fn after_an_interruption_the_reference_pose_comes_first() {
    let rig = rig(
        "exposures_ms = [32.0]",
        "warm_up_s = 1.0\nreference_every = 100",
    );
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("s");
    let operator = Person::asking(4, Request::Pause, false);
    let summary = Room::of(&rig)
        .capture(&rig, &plan(4), &mut camera(|_| 0.5), &operator, &out)
        .unwrap();
    assert_eq!((summary.end, summary.frames), (End::Paused, 4));
    Room::of(&rig)
        .capture(
            &rig,
            &plan(4),
            &mut camera(|_| 0.5),
            &Unattended(&Unwatched),
            &out,
        )
        .unwrap();
    use FrameKind::{Dark as D, Reference as R, Sample as S, White as W};
    let kinds: Vec<FrameKind> = frames(&out).iter().map(|f| f.kind).collect();
    assert_eq!(kinds, [W, R, S, S, R, S, S, R, D]);
}

// -- the operator ----------------------------------------------------------------------------------------------------

/// An operator who asks for something once, after this many frames or at this time, and goes on or not.
#[derive(Default)]
struct Person {
    after: Option<u32>,
    wish: Option<Request>,
    go_on: bool,
    frames: AtomicU32,
    asking: Mutex<Option<Request>>,
    /// Asks at this time of the clock.
    at: Option<(Arc<VirtualClock>, f64)>,
    pauses: AtomicU32,
    /// In a pause somebody presses this, and the emergency line fires.
    in_pause: Option<(SharedModel, Arc<VirtualClock>, Request)>,
    notes: Mutex<Vec<String>>,
    questions: Mutex<Vec<String>>,
}

impl Person {
    fn asking(after: u32, wish: Request, go_on: bool) -> Self {
        Self {
            after: Some(after),
            wish: Some(wish),
            go_on,
            ..Self::default()
        }
    }

    fn asking_at(clock: &Arc<VirtualClock>, t: f64, wish: Request, go_on: bool) -> Self {
        Self {
            at: Some((clock.clone(), t)),
            wish: Some(wish),
            go_on,
            ..Self::default()
        }
    }
}

impl Watch for Person {
    fn progress(&self, _: &str, _: u64, _: u64) {}
    fn cancelled(&self) -> bool {
        self.request() >= Request::Pause
    }
    fn urgent(&self) -> bool {
        self.request() >= Request::PauseNow
    }
}

impl Operator for Person {
    fn request(&self) -> Request {
        if let Some((clock, t)) = &self.at
            && self.pauses.load(Ordering::SeqCst) == 0
            && clock.now() >= *t
        {
            return self.wish.unwrap();
        }
        self.asking.lock().unwrap().unwrap_or(Request::Go)
    }
    fn confirm(&self, question: &str) -> Result<()> {
        self.questions.lock().unwrap().push(question.to_owned());
        Ok(())
    }
    fn paused(&self) -> bool {
        self.pauses.fetch_add(1, Ordering::SeqCst);
        *self.asking.lock().unwrap() = None;
        if let Some((model, clock, wish)) = &self.in_pause {
            clock.sleep(5.0);
            model.lock().unwrap().receive(b"!", clock.now());
            if !self.go_on {
                *self.asking.lock().unwrap() = Some(*wish);
            }
        }
        self.go_on
    }
    fn seen(&self, what: &Seen<'_>) {
        match what {
            Seen::Taken(taken) => {
                assert!(taken.remaining_s.is_finite() && taken.frames <= taken.frames_planned);
                let n = self.frames.fetch_add(1, Ordering::SeqCst) + 1;
                if self.after == Some(n) {
                    *self.asking.lock().unwrap() = self.wish;
                }
            }
            Seen::Note(note) => self.notes.lock().unwrap().push((*note).to_owned()),
            _ => {}
        }
    }
}

fn plain_rig() -> RigDescription {
    rig("exposures_ms = [32.0]", "warm_up_s = 20.0")
}

#[test]
fn a_pause_between_shots_goes_on_with_the_lamp_on_and_nothing_is_homed_again() {
    let rig = plain_rig();
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("s");
    let operator = Person::asking(2, Request::Pause, true);
    let room = Room::of(&rig);
    let summary = room
        .capture(&rig, &plan(3), &mut camera(|_| 0.5), &operator, &out)
        .unwrap();
    assert!(summary.finished() && summary.frames == 5);
    assert_eq!(operator.pauses.load(Ordering::SeqCst), 1);
    let ready = |e: &&Event| matches!(e, Event::Ready { .. });
    assert_eq!(events(&out).iter().filter(ready).count(), 1);
    let sent = sent(&out);
    assert_eq!(sent.matches("$H\n").count(), 1);
    assert_eq!(sent.matches("M3S").count(), 1);
}

/// All that was sent to the board.
fn sent(out: &Path) -> String {
    let entries = read_wire_log(&out.join("wire.jsonl")).unwrap();
    let sent = entries
        .iter()
        .filter(|e| e.way == goniofit::rig::Way::ToBoard);
    sent.map(|e| String::from_utf8_lossy(&e.bytes).into_owned())
        .collect()
}

#[test]
fn a_pause_in_the_middle_of_a_move_keeps_the_position_and_goes_on_from_there() {
    let rig = plain_rig();
    let folder = tempfile::tempdir().unwrap();
    let whole = folder.path().join("whole");
    let room = Room::of(&rig);
    let nobody = Unattended(&Unwatched);
    room.capture(&rig, &plan(3), &mut camera(|_| 0.5), &nobody, &whole)
        .unwrap();
    // The first move's start, in the wire log of the undisturbed capture.
    let entries = read_wire_log(&whole.join("wire.jsonl")).unwrap();
    let moves: Vec<f64> = entries
        .iter()
        .filter(|e| String::from_utf8_lossy(&e.bytes).contains("G53G1"))
        .map(|e| e.t)
        .collect();
    let reference: Vec<(Option<u32>, String)> = frames(&whole)
        .into_iter()
        .map(|f| (f.config, f.sha256))
        .collect();
    for (n, start) in moves.iter().take(3).enumerate() {
        let room = Room::of(&rig);
        let out = folder.path().join(n.to_string());
        let operator = Person::asking_at(&room.clock, start + 0.6, Request::PauseNow, true);
        let summary = room
            .capture(&rig, &plan(3), &mut camera(|_| 0.5), &operator, &out)
            .unwrap();
        assert!(summary.finished());
        assert_eq!(operator.pauses.load(Ordering::SeqCst), 1, "move {n}");
        let sent = sent(&out);
        assert!(sent.contains('!') && sent.contains('\x18'), "it braked");
        assert_eq!(sent.matches("$H\n").count(), 1, "the position was kept");
        let got: Vec<(Option<u32>, String)> = frames(&out)
            .into_iter()
            .map(|f| (f.config, f.sha256))
            .collect();
        assert_eq!(got, reference, "move {n}");
    }
}

#[test]
fn abort_and_halt_end_dark_and_differ_in_what_becomes_of_the_position() {
    let rig = plain_rig();
    let folder = tempfile::tempdir().unwrap();
    for (wish, end) in [(Request::Abort, End::Aborted), (Request::Halt, End::Halted)] {
        let room = Room::of(&rig);
        let out = folder.path().join(format!("{end:?}"));
        // In the middle of the first move.
        let operator = Person::asking_at(&room.clock, 12.0, wish, false);
        let summary = room
            .capture(&rig, &plan(3), &mut camera(|_| 0.5), &operator, &out)
            .unwrap();
        assert_eq!(summary.end, end);
        assert!(room.is_dark_and_still(), "{end:?}");
        let told = summary.stopped.join("; ");
        assert_eq!(
            told.contains("position kept"),
            end == End::Aborted,
            "{end:?}: {told}"
        );
        assert!(
            matches!(events(&out).last(), Some(Event::Stopped { reason }) if reason.contains("operator"))
        );
        // Both can be resumed.
        let room = Room::of(&rig);
        let nobody = Unattended(&Unwatched);
        assert!(
            room.capture(&rig, &plan(3), &mut camera(|_| 0.5), &nobody, &out)
                .unwrap()
                .finished()
        );
    }
}

#[test]
fn an_abort_or_a_halt_in_a_pause_ends_dark_although_the_board_was_told_to_hold() {
    let rig = plain_rig();
    let folder = tempfile::tempdir().unwrap();
    for (wish, end) in [
        (Request::PauseNow, End::Paused),
        (Request::Abort, End::Aborted),
        (Request::Halt, End::Halted),
    ] {
        let room = Room::of(&rig);
        let out = folder.path().join(format!("{end:?}"));
        let mut operator = Person::asking(2, Request::Pause, false);
        operator.in_pause = Some((room.model.clone(), room.clock.clone(), wish));
        let summary = room
            .capture(&rig, &plan(3), &mut camera(|_| 0.5), &operator, &out)
            .unwrap();
        assert_eq!((summary.end, summary.frames), (end, 2));
        assert!(room.is_dark_and_still(), "{end:?}");
        assert!(matches!(events(&out).last(), Some(Event::Stopped { .. })));
    }
    // Pressed and taken back: it goes on from where it stands.
    let room = Room::of(&rig);
    let mut operator = Person::asking(2, Request::Pause, true);
    operator.in_pause = Some((room.model.clone(), room.clock.clone(), Request::PauseNow));
    let out = folder.path().join("on");
    let summary = room
        .capture(&rig, &plan(3), &mut camera(|_| 0.5), &operator, &out)
        .unwrap();
    assert!(summary.finished() && summary.frames == 5);
    assert_eq!(
        sent(&out).matches("$H\n").count(),
        1,
        "the position was kept"
    );
}

#[test]
fn what_is_pressed_in_a_pause_with_the_lamp_off_is_taken_up_too() {
    let rig = plain_rig();
    let folder = tempfile::tempdir().unwrap();
    // In the first move, before the lamp was ever on: space, space again in the pause, then on.
    for wish in [Request::Pause, Request::PauseNow] {
        let room = Room::of(&rig);
        let out = folder.path().join(format!("{wish:?}"));
        let mut operator = Person::asking_at(&room.clock, 12.0, wish, true);
        operator.in_pause = Some((room.model.clone(), room.clock.clone(), Request::PauseNow));
        let summary = room
            .capture(&rig, &plan(2), &mut camera(|_| 0.5), &operator, &out)
            .unwrap();
        assert!(summary.finished() && summary.frames == 4, "{wish:?}");
        assert_eq!(operator.pauses.load(Ordering::SeqCst), 1, "{wish:?}");
        assert_eq!(sent(&out).matches("$H\n").count(), 1, "{wish:?}");
    }
}

#[test]
fn a_pause_in_the_warm_up_or_while_settling_cuts_neither_short() {
    let rig = rig("exposures_ms = [32.0]", "warm_up_s = 100.0");
    let folder = tempfile::tempdir().unwrap();
    // When the lamp goes on in an undisturbed capture.
    let room = Room::of(&rig);
    let out = folder.path().join("whole");
    let nobody = Unattended(&Unwatched);
    room.capture(&rig, &plan(1), &mut camera(|_| 0.5), &nobody, &out)
        .unwrap();
    let lamp = read_wire_log(&out.join("wire.jsonl"))
        .unwrap()
        .into_iter()
        .find(|e| String::from_utf8_lossy(&e.bytes).contains("M3S"))
        .unwrap()
        .t;
    let first = |out: &Path| read_journal(&out.join("journal.jsonl")).unwrap()[1].elapsed_s;
    assert!(first(&out) > lamp + 100.0);
    let room = Room::of(&rig);
    let out = folder.path().join("paused");
    let operator = Person::asking_at(&room.clock, lamp + 30.0, Request::Pause, true);
    room.capture(&rig, &plan(1), &mut camera(|_| 0.5), &operator, &out)
        .unwrap();
    assert_eq!(operator.pauses.load(Ordering::SeqCst), 1);
    assert!(first(&out) > lamp + 100.0, "{} {lamp}", first(&out));
}

/// A camera with a longest exposure.
struct Limited(VirtualCamera, f64);

impl Camera for Limited {
    fn facts(&self) -> CameraFacts {
        Camera::facts(&self.0)
    }
    fn expose(&mut self, shot: &Shot) -> Result<CapturedFrame> {
        if shot.exposure_ms > self.1 {
            return Err(Error::new("no such exposure").with_hint("the longest is shorter"));
        }
        self.0.expose(shot)
    }
}

#[test]
fn an_exposure_the_camera_refuses_ends_re_shooting_and_not_the_capture() {
    let rig = rig("exposures_ms = [1.0, 2.0]", "warm_up_s = 1.0");
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("s");
    let operator = Person::default();
    let mut camera = Limited(camera(|_| 0.02), 10.0);
    let summary = Room::of(&rig)
        .capture(&rig, &plan(2), &mut camera, &operator, &out)
        .unwrap();
    assert!(summary.finished());
    assert!(summary.badly_exposed.iter().any(|b| b.1 == Verdict::Dim));
    let notes = operator.notes.lock().unwrap();
    assert!(
        notes
            .iter()
            .any(|n| n.contains("left out: no such exposure")),
        "{notes:?}"
    );
    assert!(frames(&out).iter().all(|f| f.exposure_ms <= 10.0));
}

#[test]
fn a_reference_visit_that_was_cut_short_is_no_model_for_the_later_ones() {
    let rig = rig(
        "exposures_ms = [2.0, 8.0, 32.0, 128.0, 512.0, 2048.0]\nmetering = \"metered\"",
        "warm_up_s = 1.0\nreference_every = 100",
    );
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("s");
    let whites = {
        let all = folder.path().join("whole");
        Room::of(&rig)
            .capture(
                &rig,
                &plan(2),
                &mut camera(|_| 3.0),
                &Unattended(&Unwatched),
                &all,
            )
            .unwrap();
        let of_white = frames(&all)
            .iter()
            .filter(|f| f.kind == FrameKind::White)
            .count();
        of_white as u32
    };
    // Ends after the first look of the first visit, which is clipped.
    let operator = Person::asking(whites + 1, Request::Pause, false);
    Room::of(&rig)
        .capture(&rig, &plan(2), &mut camera(|_| 3.0), &operator, &out)
        .unwrap();
    let last = frames(&out).last().unwrap().clone();
    assert!(last.kind == FrameKind::Reference && last.exposed.unwrap().peak[0] >= 0.9);
    Room::of(&rig)
        .capture(
            &rig,
            &plan(2),
            &mut camera(|_| 3.0),
            &Unattended(&Unwatched),
            &out,
        )
        .unwrap();
    for visit in 1..=2 {
        let usable = frames(&out)
            .iter()
            .filter(|f| f.kind == FrameKind::Reference && f.visit == visit)
            .filter(|f| f.exposed.unwrap().peak.iter().all(|p| *p < 0.9))
            .count();
        assert!(usable >= 1, "visit {visit}");
    }
}

#[test]
fn a_session_goes_on_with_its_own_camera_only() {
    let rig = plain_rig();
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("s");
    let operator = Person::asking(2, Request::Pause, false);
    Room::of(&rig)
        .capture(&rig, &plan(2), &mut camera(|_| 0.5), &operator, &out)
        .unwrap();
    let sensor = SensorModel {
        width: 80,
        ..camera(|_| 0.5).sensor().clone()
    };
    let mut other = VirtualCamera::new(sensor, Box::new(Flat(|_| 0.5)), 3).unwrap();
    let nobody = Unattended(&Unwatched);
    let error = Room::of(&rig)
        .capture(&rig, &plan(2), &mut other, &nobody, &out)
        .unwrap_err()
        .report();
    assert!(
        error.contains("begun with camera") && error.contains("80 x 64"),
        "{error}"
    );
}

// -- the board between the shots, and the record ---------------------------------------------------------------------

/// A camera that resets the board while it exposes.
struct Mischief(VirtualCamera, SharedModel, Arc<VirtualClock>);

impl Camera for Mischief {
    fn facts(&self) -> CameraFacts {
        Camera::facts(&self.0)
    }
    fn expose(&mut self, shot: &Shot) -> Result<CapturedFrame> {
        if shot.kind == FrameKind::Sample {
            let now = self.2.now();
            self.1.lock().unwrap().receive(b"\x18", now);
        }
        self.0.expose(shot)
    }
}

#[test]
fn a_board_that_restarts_during_an_exposure_spoils_the_frame() {
    let rig = plain_rig();
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("s");
    let room = Room::of(&rig);
    let mut camera = Mischief(camera(|_| 0.5), room.model.clone(), room.clock.clone());
    let error = room
        .capture(&rig, &plan(2), &mut camera, &Unattended(&Unwatched), &out)
        .unwrap_err()
        .report();
    assert!(error.contains("restarted by itself"), "{error}");
    assert_eq!(frames(&out).len(), 1, "only the white frame counts");
}

/// Somebody presses the board's reset button during the warm-up.
struct Elbow(SharedModel, Arc<VirtualClock>, AtomicU32);

impl Watch for Elbow {
    fn progress(&self, _: &str, _: u64, _: u64) {}
    fn cancelled(&self) -> bool {
        let now = self.1.now();
        let mut model = self.0.lock().unwrap();
        if model.spindle_on() && self.2.fetch_add(1, Ordering::SeqCst) == 100 {
            model.receive(b"\x18", now);
        }
        false
    }
}

#[test]
fn a_board_that_restarts_during_the_warm_up_is_noticed_then_and_not_after_it() {
    let rig = rig("exposures_ms = [32.0]", "warm_up_s = 600.0");
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("s");
    let room = Room::of(&rig);
    let elbow = Elbow(room.model.clone(), room.clock.clone(), AtomicU32::new(0));
    let error = room
        .capture(
            &rig,
            &plan(2),
            &mut camera(|_| 0.5),
            &Unattended(&elbow),
            &out,
        )
        .unwrap_err()
        .report();
    assert!(error.contains("restarted by itself"), "{error}");
    assert!(room.clock.now() < 60.0, "{}", room.clock.now());
    assert!(room.is_dark_and_still());
}

#[test]
fn the_manifest_says_with_what_and_by_whom_it_was_recorded() {
    let rig = plain_rig();
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("s");
    Room::of(&rig)
        .capture(
            &rig,
            &plan(1),
            &mut camera(|_| 0.5),
            &Unattended(&Unwatched),
            &out,
        )
        .unwrap();
    let manifest = SessionFolder::open(&out).unwrap().manifest().unwrap();
    let from = &manifest.provenance;
    assert_eq!(
        (manifest.note.as_str(), from.host.as_str()),
        ("a note", "lab")
    );
    assert_eq!(from.config_sha256.len(), 64);
    let dump = &from.firmware["main"];
    for said in ["[VER:1.1f", "$22=", "$130=", "[GC:", "[G54:"] {
        assert!(dump.iter().any(|l| l.starts_with(said)), "{said}: {dump:?}");
    }
    let utc = |text: &Option<String>| text.as_ref().is_some_and(|t| t.ends_with('Z'));
    assert!(frames(&out).iter().all(|f| utc(&f.utc)));
    let entries = read_journal(&out.join("journal.jsonl")).unwrap();
    assert!(entries.windows(2).all(|w| w[0].elapsed_s <= w[1].elapsed_s));
    assert!(matches!(&entries[0].event, Event::Ready { utc: u, .. } if utc(u)));
}

#[test]
fn metering_without_anybody_who_looks_is_refused_before_anything_is_opened() {
    let rig = rig(
        "exposures_ms = [2.0, 8.0]\nmetering = \"metered\"",
        "warm_up_s = 1.0",
    );
    let folder = tempfile::tempdir().unwrap();
    let error = Capture {
        description: &rig,
        plan: &plan(1),
        connection: Connection {
            open: Box::new(|_| Err(Error::new("the port must not be opened"))),
            clock: Arc::new(VirtualClock::new()),
            wait_scale: 1.0,
        },
        camera: &mut camera(|_| 0.5),
        judge: None,
        operator: &Unattended(&Unwatched),
        options: CaptureOptions::default(),
    }
    .start(&folder.path().join("s"))
    .unwrap_err()
    .report();
    assert!(error.contains("metering needs somebody"), "{error}");
}

// -- calibration targets ---------------------------------------------------------------------------------------------

/// Each target is put in place once per run, its frames are of its kind, and a run that is killed while it writes the
/// journal goes on where it was.
#[test]
fn a_board_in_the_samples_place_is_captured_killed_and_resumed() {
    let rig = rig(
        "exposures_ms = [32.0]",
        "warm_up_s = 1.0\nreference_every = 2",
    );
    let mut plan = plan(4);
    plan.shows = FrameKind::Board;
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("s");
    let operator = Person::asking(4, Request::Abort, false);
    let mut camera = camera(|_| 0.5);
    let summary = Room::of(&rig)
        .capture(&rig, &plan, &mut camera, &operator, &out)
        .unwrap();
    assert_eq!((summary.end, summary.frames), (End::Aborted, 4));
    let board = "put the checkerboard in place";
    assert_eq!(
        *operator.questions.lock().unwrap(),
        ["put the white standard in place", board]
    );
    // As a kill in the middle of the fourth frame's line leaves it.
    let journal = std::fs::read_to_string(out.join("journal.jsonl")).unwrap();
    let fourth = journal.rfind("\"event\":\"frame\"").unwrap();
    std::fs::write(out.join("journal.jsonl"), &journal[..fourth + 40]).unwrap();

    let mut other = plan.clone();
    other.shows = FrameKind::Sample;
    let wrong = Room::of(&rig).capture(&rig, &other, &mut camera, &Person::default(), &out);
    let message = wrong.unwrap_err().report();
    assert!(message.contains("another rig file or plan"), "{message}");

    let operator = Person::default();
    let summary = Room::of(&rig)
        .capture(&rig, &plan, &mut camera, &operator, &out)
        .unwrap();
    assert!(summary.finished() && summary.badly_exposed.is_empty());
    assert_eq!(*operator.questions.lock().unwrap(), [board]);
    use FrameKind::{Board as B, Dark as D, Reference as R, White as W};
    let frames = frames(&out);
    let kinds: Vec<FrameKind> = frames.iter().map(|f| f.kind).collect();
    assert_eq!(kinds, [W, R, B, R, B, B, R, B, R, D]);
    let boards = || frames.iter().filter(|f| f.kind == B);
    let mut ids: Vec<Option<u32>> = boards().map(|f| f.config).collect();
    ids.sort_unstable();
    assert_eq!(ids, [1, 2, 3, 4].map(Some));
    assert!(boards().all(|f| f.exposed.is_some() && f.file.contains("_board_c0")));
    assert_eq!(SessionFolder::open(&out).unwrap().plan().unwrap(), plan);
}

/// Linearity: a list of exposures and repeats that the rig file does not have, in the session's own rig file afterwards.
#[test]
fn exposures_and_repeats_can_be_given_for_one_session() {
    let metered = rig(
        "exposures_ms = [32.0, 64.0]\nmetering = \"metered\"\nmax_exposure_ms = 100.0",
        "warm_up_s = 1.0",
    );
    let exposures = [1.0, 4.0, 16.0, 128.0];
    let rig = metered.with_exposures(Some(&exposures), Some(2)).unwrap();
    let mut plan = plan(1);
    plan.shows = FrameKind::Flat;
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("s");
    let summary = Room::of(&rig)
        .capture(
            &rig,
            &plan,
            &mut camera(|_| 0.5),
            &Unattended(&Unwatched),
            &out,
        )
        .unwrap();
    assert!(summary.finished());
    let frames = frames(&out);
    for kind in [FrameKind::Flat, FrameKind::White, FrameKind::Dark] {
        let mut taken: Vec<f64> = frames
            .iter()
            .filter(|f| f.kind == kind)
            .map(|f| f.asked_ms())
            .collect();
        taken.sort_by(f64::total_cmp);
        assert_eq!(
            taken,
            exposures.iter().flat_map(|e| [*e, *e]).collect::<Vec<_>>()
        );
    }
    let kept = RigDescription::read(&out.join("rig.toml")).unwrap();
    assert_eq!(kept, rig);
    assert_eq!(kept.axes, metered.axes);
    let message = |list: &[f64]| {
        metered
            .with_exposures(Some(list), None)
            .unwrap_err()
            .report()
    };
    assert!(message(&[4.0, 1.0]).contains("ascending"));
    assert!(message(&[]).contains("at least one"));
    assert!(message(&[f64::NAN]).contains("exposure"));
}

#[test]
fn the_plans_of_calibrations_fit_the_rigs_and_say_what_they_show() {
    for (plan, shows, more) in [
        ("board", "board", &[][..]),
        ("flat", "flat", &["--exposures-ms", "20", "--repeats", "16"]),
        (
            "linearity",
            "flat",
            &["--exposures-ms", "1,2,4,8,16,32", "--repeats", "2"],
        ),
    ] {
        let output = assert_cmd::Command::cargo_bin("goniofit")
            .unwrap()
            .current_dir(root())
            .args(["capture", "--rig", "rig_configs/five_axis_grblhal.toml"])
            .args(["--plan", &format!("rig_configs/plans/{plan}.toml")])
            .args(["--dry-run"])
            .args(more)
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success(), "{output:?}");
        assert!(
            text.contains(&format!("# in the sample's place: {shows}")),
            "{text}"
        );
        let line = text.lines().find(|l| l.starts_with(shows)).unwrap();
        let frames: Vec<&str> = line.split_whitespace().collect();
        let expected = match plan {
            "flat" => "16",
            "linearity" => "12",
            _ => "2",
        };
        assert_eq!(frames[2], expected, "{text}");
    }
}
