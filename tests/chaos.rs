//! Whole captures with faults on the cable and in the board: whatever happens, nothing moves where it must not, no shot
//! is lost, doubled or given to the wrong pose, nothing hangs, and every end says why.
//!
//! A few hundred seeded captures here; the long run is `cargo test --release --test chaos -- --ignored --nocapture`.
//! `SEED=n` replays one capture of the mixed runs with its story printed.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

use goniofit::base::{Error, Result, Watch};
use goniofit::math::Random;
use goniofit::rig::capture::{Capture, CaptureOptions, Order, Summary, plan_capture};
use goniofit::rig::simulated::model_options;
use goniofit::rig::{
    AxisAngles, AxisName, Camera, CapturedFrame, Clock, Connection, Fault, FaultKind, GrblModel,
    ModelTransport, Operator, Request, RigDescription, Seen, SharedModel, Shot, Transport,
    VirtualClock,
};
use goniofit::session::{CameraFacts, FrameKind, Plan, SessionFolder};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

/// Virtual seconds one run of a capture may take; an undisturbed one takes about 75.
const PATIENCE: f64 = 3000.0;
/// Reads of one run: many times what an undisturbed one needs.
const MOST_READS: u64 = 400_000;
/// Seconds between two looks at the axes.
const LOOK: f64 = 0.01;
/// An axis may pass a limit, or come nearer than its margin, by what it covers between a damaged command and the stop:
/// 30 degrees/s for two polls of 0.1 s, and braking at 500 degrees/s^2.
const STOPPING_DEG: f64 = 7.0;
/// Runs of a capture that are disturbed; later ones are not.
const DISTURBED: u32 = 4;

/// What goes wrong on a cable.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Cable {
    Drop,
    Duplicate,
    Corrupt,
    Delay,
    Split,
    Join,
    Unplug,
}

const CABLE: [Cable; 7] = [
    Cable::Drop,
    Cable::Duplicate,
    Cable::Corrupt,
    Cable::Delay,
    Cable::Split,
    Cable::Join,
    Cable::Unplug,
];

const BOARD: [FaultKind; 7] = [
    FaultKind::Reset,
    FaultKind::Alarm(1),
    FaultKind::Garble,
    FaultKind::NeverOk,
    FaultKind::Vanish,
    FaultKind::FallShort(1.0),
    FaultKind::Hold,
];

/// A disturbance of the cable for a while.
#[derive(Debug, Clone, Copy)]
struct Burst {
    kind: Cable,
    begin: f64,
    end: f64,
    /// Chance per byte.
    chance: f64,
}

/// What is wrong with one run of a capture.
#[derive(Debug, Clone, Default)]
struct Trouble {
    bursts: Vec<Burst>,
    board: Vec<Fault>,
    /// The operator asks for this at this time, and goes on after a pause.
    wish: Option<(f64, Request)>,
}

impl Trouble {
    /// A burst of this kind somewhere in a capture.
    fn cable(kind: Cable, random: &mut Random) -> Self {
        let begin = 90.0 * random.uniform();
        // Short bursts with many damaged bytes, long ones with few.
        let length = 10f64.powf(-1.0 + 2.0 * random.uniform());
        Self {
            bursts: vec![Burst {
                kind,
                begin,
                end: begin + length,
                chance: (0.3 / length).min(0.5) * random.uniform(),
            }],
            ..Self::default()
        }
    }

    fn operator(random: &mut Random) -> Self {
        let wishes = [
            Request::Pause,
            Request::PauseNow,
            Request::Abort,
            Request::Halt,
        ];
        let wish = wishes[(4.0 * random.uniform()) as usize];
        Self {
            wish: Some((90.0 * random.uniform(), wish)),
            ..Self::default()
        }
    }

    fn board(kind: FaultKind, random: &mut Random) -> Self {
        let on_move = 1 + (20.0 * random.uniform()) as u32;
        Self {
            board: vec![Fault { on_move, kind }],
            ..Self::default()
        }
    }

    /// One to three of anything.
    fn mixed(random: &mut Random) -> Self {
        let mut trouble = if random.uniform() < 0.3 {
            Self::operator(random)
        } else {
            Self::default()
        };
        for _ in 0..=(3.0 * random.uniform()) as usize {
            let n = ((CABLE.len() + BOARD.len()) as f64 * random.uniform()) as usize;
            let one = match CABLE.get(n) {
                Some(kind) => Self::cable(*kind, random),
                None => Self::board(BOARD[n - CABLE.len()], random),
            };
            trouble.bursts.extend(one.bursts);
            trouble.board.extend(one.board);
        }
        trouble
    }
}

/// Looks at the axes all the time.
struct Guard {
    rig: RigDescription,
    model: SharedModel,
    /// The first thing that must not be.
    violation: Mutex<Option<String>>,
    nearest_mm: Mutex<f64>,
    reads: AtomicU64,
}

impl Guard {
    fn angles(&self) -> (AxisAngles, bool, bool) {
        let model = self.model.lock().unwrap();
        let position = model.position();
        let mut angles = AxisAngles([0.0; 5]);
        for (name, motor) in self.rig.motors_of("main") {
            let axis = "XYZAB".find(motor.letter).unwrap();
            angles.0[name as usize] = motor.angle_deg(position[axis]);
        }
        (angles, model.is_homed(), model.is_moving())
    }

    fn look(&self) {
        let (angles, homed, moving) = self.angles();
        if !homed && moving && !self.model.lock().unwrap().is_homing() {
            self.report("it moves although it is not homed".to_owned());
        }
        // While homing the controller is on its own.
        if !homed || !moving {
            return;
        }
        if let Some(contact) = self.rig.nearest(&angles) {
            let mut nearest = self.nearest_mm.lock().unwrap();
            *nearest = nearest.min(contact.distance_mm);
            if contact.distance_mm <= 0.0 {
                self.report(format!("{} touches {}", contact.a, contact.b));
            }
        }
        for (name, motor) in self.rig.motors_of("main") {
            // The switches lie beyond the limits; the first move comes from there.
            let home = motor.angle_deg(-1.0);
            let low = motor.min_deg.min(home) - STOPPING_DEG;
            let high = motor.max_deg.max(home) + STOPPING_DEG;
            let angle = angles.get(name);
            if !(low..=high).contains(&angle) {
                self.report(format!("{} stands at {angle:.2} degrees", name.name()));
            }
        }
    }

    fn report(&self, what: String) {
        self.violation.lock().unwrap().get_or_insert(what);
    }
}

/// A cable with faults.
struct BadCable {
    inner: ModelTransport,
    clock: Arc<VirtualClock>,
    guard: Arc<Guard>,
    begun: f64,
    bursts: Vec<Burst>,
    random: Random,
    /// Bytes on their way to the host, each with its time of arrival.
    late: Vec<(f64, u8)>,
}

impl BadCable {
    fn burst(&self) -> Option<Burst> {
        let t = self.clock.now() - self.begun;
        let here = |b: &&Burst| (b.begin..b.end).contains(&t);
        self.bursts.iter().find(here).copied()
    }

    /// What becomes of bytes on the way.
    fn damaged(&mut self, bytes: &[u8]) -> Vec<u8> {
        let Some(burst) = self.burst() else {
            return bytes.to_vec();
        };
        let mut out = Vec::new();
        for &byte in bytes {
            let hit = self.random.uniform() < burst.chance;
            match burst.kind {
                Cable::Drop if hit => {}
                Cable::Duplicate if hit => out.extend([byte, byte]),
                Cable::Corrupt if hit => {
                    out.push(byte ^ (1 << (8.0 * self.random.uniform()) as u8))
                }
                _ => out.push(byte),
            }
        }
        out
    }

    fn unplugged(&self) -> bool {
        let t = self.clock.now() - self.begun;
        self.bursts
            .iter()
            .any(|b| b.kind == Cable::Unplug && t >= b.begin)
    }
}

impl Transport for BadCable {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.guard.look();
        if self.unplugged() {
            return Err(io::ErrorKind::BrokenPipe.into());
        }
        let bytes = self.damaged(bytes);
        if bytes.is_empty() {
            return Ok(());
        }
        self.inner.write(&bytes)
    }

    fn read(&mut self, buffer: &mut [u8], timeout: f64) -> io::Result<usize> {
        let deadline = self.clock.now() + timeout;
        let mut tried = false;
        loop {
            self.guard.look();
            if self.guard.reads.fetch_add(1, Ordering::Relaxed) > MOST_READS {
                panic!("the run hangs");
            }
            if self.unplugged() {
                return Ok(0);
            }
            let now = self.clock.now();
            let arrived = self.late.iter().filter(|(t, _)| *t <= now).count();
            if arrived > 0 {
                let most = match self.burst().map(|b| b.kind) {
                    Some(Cable::Split) => 1,
                    _ => buffer.len(),
                };
                let n = arrived.min(most);
                for (place, (_, byte)) in buffer.iter_mut().zip(self.late.drain(..n)) {
                    *place = byte;
                }
                return Ok(n);
            }
            if tried && now >= deadline {
                return Err(io::ErrorKind::TimedOut.into());
            }
            tried = true;
            let slice = (deadline - now).min(LOOK);
            let mut raw = [0; 256];
            match self.inner.read(&mut raw, slice) {
                Ok(0) => return Ok(0),
                Ok(n) => {
                    let bytes = self.damaged(&raw[..n]);
                    let now = self.clock.now();
                    let wait = match self.burst() {
                        Some(b) if b.kind == Cable::Delay => 3.0 * self.random.uniform(),
                        // Held back until more comes.
                        Some(b) if b.kind == Cable::Join => 0.5 * self.random.uniform(),
                        _ => 0.0,
                    };
                    // Bytes overtake none.
                    let last = self.late.last().map_or(0.0, |l| l.0);
                    let t = (now + wait).max(last);
                    self.late.extend(bytes.into_iter().map(|b| (t, b)));
                }
                Err(e) if e.kind() == io::ErrorKind::TimedOut => {}
                Err(e) => return Err(e),
            }
        }
    }
}

/// A camera that photographs where the axes really stand.
struct Witness {
    clock: Arc<VirtualClock>,
    guard: Arc<Guard>,
}

impl Camera for Witness {
    fn facts(&self) -> CameraFacts {
        CameraFacts {
            name: "witness".to_owned(),
            width: 10,
            height: 10,
            pixel_mm: 1.0,
            center_px: [5.0, 5.0],
            lens: Default::default(),
        }
    }

    fn expose(&mut self, shot: &Shot) -> Result<CapturedFrame> {
        let seen = || {
            let (angles, _, moving) = self.guard.angles();
            let lamp = self.guard.model.lock().unwrap().spindle_on();
            (angles, moving, lamp)
        };
        let before = seen();
        self.clock.sleep(shot.exposure_ms / 1000.0);
        let after = seen();
        if before.1 || after.1 || before.0 != after.0 {
            return Err(Error::new("blurred").with_hint("it moved"));
        }
        let text = serde_json::json!({"angles": before.0.0, "lamp": [before.2, after.2]});
        Ok(CapturedFrame {
            bytes: text.to_string().into_bytes(),
            extension: "json".to_owned(),
            exposure_ms: shot.exposure_ms,
        })
    }
}

/// Everything is in place, and nobody waits for ever.
struct Patient {
    clock: Arc<VirtualClock>,
    end: f64,
    notes: Mutex<Vec<String>>,
    wish: Mutex<Option<(f64, Request)>>,
}

impl Watch for Patient {
    fn progress(&self, _: &str, _: u64, _: u64) {}
    fn cancelled(&self) -> bool {
        assert!(self.clock.now() < self.end, "the run hangs");
        self.request() >= Request::Pause
    }
    fn urgent(&self) -> bool {
        self.request() >= Request::PauseNow
    }
}

impl Operator for Patient {
    fn request(&self) -> Request {
        match *self.wish.lock().unwrap() {
            Some((t, wish)) if self.clock.now() >= t => wish,
            _ => Request::Go,
        }
    }
    fn confirm(&self, _: &str) -> Result<()> {
        Ok(())
    }
    fn paused(&self) -> bool {
        *self.wish.lock().unwrap() = None;
        true
    }
    fn seen(&self, what: &Seen<'_>) {
        if let Seen::Note(note) = what {
            self.notes.lock().unwrap().push((*note).to_owned());
        }
    }
}

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn rig() -> RigDescription {
    let text = std::fs::read_to_string(root().join("rig_configs/five_axis_grblhal.toml")).unwrap();
    let text = text
        .replace("[50.0, 400.0]", "[50.0]")
        .replace("warm_up_s = 60.0", "warm_up_s = 5.0");
    RigDescription::from_toml(&text).unwrap()
}

fn plan() -> Plan {
    Plan::read(&root().join("rig_configs/plans/khungurn16.toml")).unwrap()
}

fn scratch() -> tempfile::TempDir {
    let memory = Path::new("/dev/shm");
    if memory.is_dir() {
        tempfile::tempdir_in(memory).unwrap()
    } else {
        tempfile::tempdir().unwrap()
    }
}

/// What one capture with its interruptions came to.
#[derive(Debug, Default, Clone)]
struct Story {
    interruptions: u32,
    notes: u32,
    /// The first words of every message, for the count of kinds.
    messages: Vec<String>,
    nearest_mm: f64,
}

/// One run of a capture; what it ended with, and what it was asked twice for.
fn run(
    rig: &RigDescription,
    plan: &Plan,
    out: &Path,
    trouble: &Trouble,
    random: Random,
    story: &mut Story,
) -> Result<Summary> {
    let mut options = model_options(rig, &rig.boards[0]);
    options.faults.clone_from(&trouble.board);
    let model: SharedModel = Arc::new(Mutex::new(GrblModel::new(options)));
    let clock = Arc::new(VirtualClock::new());
    let guard = Arc::new(Guard {
        rig: rig.clone(),
        model: model.clone(),
        violation: Mutex::new(None),
        nearest_mm: Mutex::new(f64::INFINITY),
        reads: AtomicU64::new(0),
    });
    let cable = Mutex::new(Some(BadCable {
        inner: ModelTransport::new(model.clone(), clock.clone()),
        clock: clock.clone(),
        guard: guard.clone(),
        begun: clock.now(),
        bursts: trouble.bursts.clone(),
        random,
        late: Vec::new(),
    }));
    let operator = Patient {
        clock: clock.clone(),
        end: PATIENCE,
        notes: Mutex::default(),
        wish: Mutex::new(trouble.wish),
    };
    let capture = Capture {
        description: rig,
        plan,
        connection: Connection {
            open: Box::new(|_| {
                let cable = cable.lock().unwrap().take();
                Ok(Box::new(cable.unwrap()) as Box<dyn Transport>)
            }),
            clock: clock.clone(),
            wait_scale: 1.0,
        },
        camera: &mut Witness {
            clock: clock.clone(),
            guard: guard.clone(),
        },
        judge: None,
        operator: &operator,
        options: CaptureOptions::default(),
    };
    let result = if out.join("session.json").exists() {
        capture.resume(out)
    } else {
        capture.start(out)
    };
    // A cut cable cannot stop a motion that is under way; it ends where it was sent.
    let model = model.lock().unwrap();
    let reachable = !model.is_gone() && !trouble.bursts.iter().any(|b| b.kind == Cable::Unplug);
    if let Some(violation) = guard.violation.lock().unwrap().clone() {
        panic!("{violation}: {trouble:?}");
    }
    story.nearest_mm = story.nearest_mm.min(*guard.nearest_mm.lock().unwrap());
    story.notes += operator.notes.lock().unwrap().len() as u32;
    match &result {
        Ok(summary) => {
            let told = summary.stopped.iter().any(|l| l.contains("hint:"));
            let safe = !model.spindle_on() && !model.is_moving();
            assert!(safe || (told && !summary.finished()), "{summary:?}");
        }
        Err(error) => {
            let report = error.report();
            // The operator needs no hint for what the operator asked for while connecting.
            let asked = trouble.wish.is_some() && report.contains("by the operator");
            assert!(asked || report.contains("hint:"), "{report}");
            let safe = !model.spindle_on() && !model.is_moving();
            let told = report.contains("may still be on") || report.contains("check by eye");
            assert!(
                safe || told || !reachable,
                "left on or moving without a word: {report}\n{trouble:?}"
            );
        }
    }
    result
}

/// A capture that is resumed until it is whole; `trouble` makes what is wrong with each disturbed run.
fn whole_capture(
    rig: &RigDescription,
    plan: &Plan,
    seed: u64,
    trouble: &dyn Fn(&mut Random) -> Trouble,
) -> Story {
    let folder = scratch();
    let out = folder.path().join("s");
    let mut story = Story {
        nearest_mm: f64::INFINITY,
        ..Story::default()
    };
    for attempt in 0.. {
        let mut random = Random::keyed(&[seed, u64::from(attempt)]);
        let wrong = if attempt < DISTURBED {
            trouble(&mut random)
        } else {
            Trouble::default()
        };
        let result = run(rig, plan, &out, &wrong, random, &mut story);
        if std::env::var("SEED").is_ok() {
            let ended = result
                .as_ref()
                .map_or_else(Error::report, |s| format!("{:?}", s.end));
            println!("{wrong:?}\n  -> {ended}");
        }
        match result {
            Ok(summary) if summary.finished() => break,
            Ok(_) => story.interruptions += 1,
            Err(error) => {
                assert!(
                    attempt < DISTURBED,
                    "an undisturbed run fails: {}",
                    error.report()
                );
                story.interruptions += 1;
                story.messages.push(error.report());
            }
        }
    }
    assert_every_shot_once_and_of_its_pose(rig, plan, &out);
    story
}

fn assert_every_shot_once_and_of_its_pose(rig: &RigDescription, plan: &Plan, out: &Path) {
    let session = SessionFolder::open(out).unwrap();
    let work = plan_capture(rig, plan, Order::Short).unwrap();
    let mut missing: BTreeMap<(FrameKind, Option<u32>), AxisAngles> = work
        .stops()
        .map(|stop| ((stop.kind, stop.config), stop.angles))
        .collect();
    for record in session.frames().unwrap() {
        let angles = missing
            .remove(&(record.kind, record.config))
            .unwrap_or_else(|| panic!("{record:?} is doubled"));
        let bytes = std::fs::read(session.frame_path(&record.file)).unwrap();
        assert_eq!(goniofit::session::sha256(&bytes), record.sha256);
        let seen: serde_json::Value = serde_json::from_slice(&bytes).unwrap();
        for name in AxisName::ALL {
            let stood = seen["angles"][name as usize].as_f64().unwrap();
            assert!(
                (stood - angles.get(name)).abs() < 0.06,
                "{record:?}: {} stood at {stood}",
                name.name()
            );
        }
        let lit = record.kind != FrameKind::Dark;
        assert_eq!(seen["lamp"], serde_json::json!([lit, lit]), "{record:?}");
    }
    assert!(missing.is_empty(), "lost: {missing:?}");
}

/// Captures under `trouble`, one per seed; what they came to.
fn captures(
    seeds: std::ops::Range<u64>,
    trouble: impl Fn(&mut Random) -> Trouble + Sync + std::panic::RefUnwindSafe,
) -> Vec<Story> {
    let (rig, plan) = (rig(), plan());
    seeds
        .into_par_iter()
        .map(|seed| {
            std::panic::catch_unwind(|| whole_capture(&rig, &plan, seed, &trouble))
                .unwrap_or_else(|_| panic!("seed {seed}"))
        })
        .collect()
}

fn tell(what: &str, stories: &[Story]) {
    let interruptions: u32 = stories.iter().map(|s| s.interruptions).sum();
    let notes: u32 = stories.iter().map(|s| s.notes).sum();
    let nearest = stories
        .iter()
        .map(|s| s.nearest_mm)
        .fold(f64::INFINITY, f64::min);
    println!(
        "{what:<14} {:>6} captures {interruptions:>6} interruptions {notes:>6} recovered in place, bodies never nearer than {nearest:.0} mm",
        stories.len()
    );
}

/// Captures of each kind of fault alone in the normal run.
const EACH: u64 = 12;

macro_rules! cable_fault {
    ($name:ident, $kind:expr) => {
        #[test]
        fn $name() {
            let stories = captures(0..EACH, |random| Trouble::cable($kind, random));
            tell(stringify!($name), &stories);
            // What only shifts bytes in time needs no mending.
            let struck = stories.iter().any(|s| s.interruptions + s.notes > 0);
            assert!(struck || matches!($kind, Cable::Delay | Cable::Split | Cable::Join));
        }
    };
}

macro_rules! board_fault {
    ($name:ident, $kind:expr) => {
        #[test]
        fn $name() {
            let stories = captures(0..EACH, |random| Trouble::board($kind, random));
            tell(stringify!($name), &stories);
            assert!(stories.iter().any(|s| s.interruptions + s.notes > 0));
        }
    };
}

cable_fault!(dropped_bytes, Cable::Drop);
cable_fault!(doubled_bytes, Cable::Duplicate);
cable_fault!(flipped_bits, Cable::Corrupt);
cable_fault!(delayed_bytes, Cable::Delay);
cable_fault!(split_lines, Cable::Split);
cable_fault!(joined_lines, Cable::Join);
cable_fault!(an_unplugged_cable, Cable::Unplug);
board_fault!(a_board_that_restarts, FaultKind::Reset);
board_fault!(an_alarm, FaultKind::Alarm(1));
board_fault!(a_garbled_ok, FaultKind::Garble);
board_fault!(a_board_that_never_answers, FaultKind::NeverOk);
board_fault!(a_board_that_vanishes, FaultKind::Vanish);
board_fault!(a_wrong_position, FaultKind::FallShort(1.0));
board_fault!(a_pressed_hold_button, FaultKind::Hold);

#[test]
fn an_undisturbed_capture_is_not_interrupted() {
    let stories = captures(0..1, |_| Trouble::default());
    assert_eq!((stories[0].interruptions, stories[0].notes), (0, 0));
}

#[test]
fn an_operator_who_pauses_aborts_and_halts() {
    let stories = captures(0..4 * EACH, Trouble::operator);
    tell("operator", &stories);
    assert!(stories.iter().any(|s| s.interruptions > 0));
}

#[test]
fn everything_at_once() {
    let seeds = match std::env::var("SEED") {
        Ok(seed) => seed.parse().map(|n| n..n + 1).unwrap(),
        Err(_) => 0..100,
    };
    let stories = captures(seeds, Trouble::mixed);
    tell("mixed", &stories);
}

#[test]
#[ignore = "slow: about 20 min"]
fn ten_thousand_captures() {
    for kind in CABLE {
        let stories = captures(1000..1400, |random| Trouble::cable(kind, random));
        tell(&format!("{kind:?}"), &stories);
    }
    for kind in BOARD {
        let stories = captures(1000..1100, |random| Trouble::board(kind, random));
        tell(&format!("{kind:?}"), &stories);
    }
    tell("operator", &captures(1000..1200, Trouble::operator));
    tell("mixed", &captures(10_000..16_600, Trouble::mixed));
}
