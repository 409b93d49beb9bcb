//! Promise: a rig of Zaber stages is driven as safely as one of GRBL boards: no reply is mistaken, no arrival is believed
//! that did not happen, and whatever goes wrong ends at rest, dark, and told.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use goniofit::base::{Result, Unwatched, Watch};
use goniofit::rig::capture::{self, CaptureOptions};
use goniofit::rig::simulated::{
    capture_from_replay, capture_in_process, capture_over_pty, connection_to, zaber_options,
};
use goniofit::rig::{
    ByteModel, Camera, CapturedFrame, Clock, Homing, ModelTransport, Motion, PtySimulator, Replay,
    RigDescription, ScpiModel, SerialTransport, SharedDevice, Shot, SystemClock, Target, Transport,
    Travel, VirtualClock, Way, WireEntry, Wiring, Zaber, ZaberFault, ZaberFaultKind, ZaberModel,
    ZaberOptions, read_wire_log,
};
use goniofit::session::{CameraFacts, Event, Plan, SessionFolder, read_journal};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

const FAST: f64 = 40_000.0;

fn file(path: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn rig() -> RigDescription {
    RigDescription::read(&file("rig_configs/zaber_rotary.toml")).unwrap()
}

fn plan16() -> Plan {
    Plan::read(&file("rig_configs/plans/khungurn16.toml")).unwrap()
}

fn target(letter: char, units: f64) -> Target {
    Target {
        letter,
        units,
        tolerance: 40.0,
        speed: FAST,
    }
}

/// Keeps what the driver sent, and when.
struct Tapped(ModelTransport, Arc<VirtualClock>, Arc<Mutex<Vec<Sent>>>);

type Sent = (f64, String);

impl Transport for Tapped {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        let text = String::from_utf8_lossy(bytes).into_owned();
        self.2.lock().unwrap().push((self.1.now(), text));
        self.0.write(bytes)
    }
    fn read(&mut self, buffer: &mut [u8], timeout: f64) -> io::Result<usize> {
        self.0.read(buffer, timeout)
    }
}

struct Bench {
    clock: Arc<VirtualClock>,
    model: Arc<Mutex<ZaberModel>>,
    sent: Arc<Mutex<Vec<Sent>>>,
}

impl Bench {
    fn new(options: ZaberOptions) -> Self {
        let clock = Arc::new(VirtualClock::new());
        clock.advance_to(1.0);
        Self {
            clock,
            model: Arc::new(Mutex::new(ZaberModel::new(options))),
            sent: Arc::default(),
        }
    }

    fn connect<'a>(&self, watch: &'a dyn Watch) -> Result<Zaber<'a>> {
        let cable = ModelTransport::new(self.model.clone(), self.clock.clone());
        let tapped = Tapped(cable, self.clock.clone(), self.sent.clone());
        let wiring = Wiring {
            name: "arms".into(),
            transport: Box::new(tapped),
            clock: self.clock.clone(),
            watch,
        };
        Zaber::connect(1, wiring)
    }

    fn homed(options: ZaberOptions) -> (Self, Zaber<'static>) {
        let bench = Self::new(options);
        let mut zaber = bench.connect(&Unwatched).unwrap();
        zaber.home().unwrap();
        (bench, zaber)
    }

    fn sent(&self) -> String {
        let sent = self.sent.lock().unwrap();
        sent.iter().map(|(_, text)| text.as_str()).collect()
    }

    /// Where the axes are and whether one moves, a second on.
    fn later(&self) -> (Vec<f64>, bool) {
        self.clock.sleep(1.0);
        let mut model = self.model.lock().unwrap();
        model.take_output(self.clock.now());
        (model.truth(), model.is_moving())
    }
}

fn with_fault(kind: ZaberFaultKind) -> ZaberOptions {
    ZaberOptions {
        faults: vec![ZaberFault { on_move: 1, kind }],
        ..ZaberOptions::rotary(2)
    }
}

fn go(zaber: &mut Zaber, targets: &[Target]) -> Result<Vec<f64>> {
    zaber.start_move(targets)?;
    zaber.finish_move(targets, 60.0)
}

// -- one controller -----------------------------------------------------------------------------------------------------

#[test]
fn it_connects_homes_moves_and_reads_back() {
    let (bench, mut zaber) = Bench::homed(ZaberOptions::rotary(2));
    assert!(zaber.firmware().contains("serial 104512 firmware 7.38"));
    assert!(zaber.is_homed() && !zaber.moves_in_line());
    let limits = zaber.axis_limits('2').unwrap();
    assert_eq!(limits.travel, Some(Travel::Between([0.0, 1_536_000.0])));
    assert!((limits.max_speed - 102_400.0).abs() < 1.0);
    // Settings count in whole units of 6100 microsteps/s^2.
    assert!((limits.acceleration / 400_000.0 - 1.0).abs() < 0.02);

    let start = bench.clock.now();
    let targets = [target('1', 200_000.4), target('2', 100_000.0)];
    let found = go(&mut zaber, &targets).unwrap();
    assert_eq!(found, [200_000.0, 100_000.0]);
    // 200 000 microsteps at 40 000/s: it really waited.
    let took = bench.clock.now() - start;
    assert!((5.0..6.0).contains(&took), "{took}");
    assert_eq!(bench.later(), (vec![200_000.0, 100_000.0], false));
    assert!(bench.sent().contains("move abs 200000 65536:"));
    assert_eq!(
        zaber.positions(&['2', '1']).unwrap(),
        [100_000.0, 200_000.0]
    );
    assert_eq!(zaber.verify_at(&targets).unwrap(), found);
    assert_eq!(zaber.state().unwrap(), "IDLE");
    assert!(zaber.retries().is_empty(), "{:?}", zaber.retries());
    assert!(zaber.make_safe(false).unwrap().contains("at rest"));
    assert!(
        zaber
            .dump()
            .iter()
            .any(|l| l == "limit.max 1536000 1536000")
    );
}

#[test]
fn nothing_moves_before_it_is_homed_and_nothing_is_taken_on_trust() {
    let bench = Bench::new(ZaberOptions::rotary(1));
    let mut zaber = bench.connect(&Unwatched).unwrap();
    assert!(!bench.sent().contains("home") && !bench.sent().contains("move"));
    let error = zaber.start_move(&[target('1', 5.0)]).unwrap_err().report();
    assert!(
        error.contains("not known") && error.contains("home"),
        "{error}"
    );
    assert!(zaber.trust_position().is_err());
    let error = zaber.check(Homing::ByHand).unwrap_err().report();
    assert!(error.contains("homing = \"cycle\""), "{error}");
    zaber.check(Homing::Cycle).unwrap();
    assert!(zaber.state().unwrap().starts_with("IDLE WR"));
    assert!(!bench.sent().contains("move"));
}

#[test]
fn moves_that_make_no_sense_are_not_sent() {
    let (bench, mut zaber) = Bench::homed(ZaberOptions::rotary(1));
    let before = bench.sent().len();
    let fine = target('1', 1000.0);
    for (bad, reason) in [
        (
            Target {
                units: f64::NAN,
                ..fine
            },
            "makes no sense",
        ),
        (
            Target {
                units: -1.0,
                tolerance: 0.1,
                ..fine
            },
            "outside limit.min",
        ),
        (Target { units: 2e6, ..fine }, "outside limit.min"),
        (Target { speed: 0.0, ..fine }, "makes no sense"),
        (
            Target {
                letter: '2',
                ..fine
            },
            "no axis 2",
        ),
        (
            Target {
                letter: 'X',
                ..fine
            },
            "no axis X",
        ),
        (
            Target {
                units: 10.5,
                tolerance: 0.2,
                ..fine
            },
            "half a microstep",
        ),
    ] {
        let error = zaber.start_move(&[bad]).unwrap_err().report();
        assert!(error.contains(reason), "{error}");
    }
    assert_eq!(bench.sent().len(), before);
}

#[test]
fn a_motion_found_at_connect_is_stopped_and_old_warnings_are_recorded() {
    let bench = Bench::new(ZaberOptions::rotary(1));
    {
        let mut model = bench.model.lock().unwrap();
        model.receive(b"/1 1 move abs 900000\n", 1.0);
        model.take_output(2.0);
    }
    bench.clock.advance_to(2.0);
    let zaber = bench.connect(&Unwatched).unwrap();
    assert!(!bench.later().1);
    assert!(zaber.dump().iter().any(|l| l.starts_with("warnings ")));
}

#[test]
fn what_is_no_zaber_device_is_not_connected_to() {
    let mut options = ZaberOptions::rotary(1);
    options.address = 2;
    let error = match Bench::new(options).connect(&Unwatched) {
        Err(error) => error.report(),
        Ok(_) => panic!("connected to another address"),
    };
    assert!(
        error.contains("no Zaber device answers as number 1") && error.contains("ASCII protocol"),
        "{error}"
    );
}

#[test]
fn old_firmware_gets_its_speed_as_a_setting_that_is_read_back_and_none_faster_than_it_was() {
    for firmware in ["6.28", "7.24"] {
        let mut options = ZaberOptions::rotary(1);
        options.firmware = firmware.into();
        let (bench, mut zaber) = Bench::homed(options);
        go(&mut zaber, &[target('1', 100_000.0)]).unwrap();
        let sent = bench.sent();
        assert!(sent.contains("set maxspeed 65536:") && sent.contains("move abs 100000:"));
        let faster = Target {
            speed: 1e9,
            ..target('1', 0.0)
        };
        go(&mut zaber, &[faster]).unwrap();
        assert!(bench.sent().contains("set maxspeed 167772:"));
    }
}

#[test]
fn each_kind_of_trouble_is_told_stopped_and_forgets_the_position_where_it_must() {
    use ZaberFaultKind as K;
    for (kind, reason, kept) in [
        (K::Restart, "restarted by itself", false),
        (K::Stall, "warning FS", false),
        (K::Overheat, "warning FD", false),
        (K::StuckBusy, "did not end within", true),
        (K::FallShort(500), "stands at", true),
        (K::Interrupt, "warning NI", true),
        (K::Knob(-30_000), "warning NC", true),
        (K::WrongWay, "off its way", true),
    ] {
        let (bench, mut zaber) = Bench::homed(with_fault(kind));
        let error = go(
            &mut zaber,
            &[target('1', 400_000.0), target('2', 300_000.0)],
        )
        .unwrap_err()
        .report();
        assert!(
            error.contains(reason) && error.contains("hint:"),
            "{kind:?}: {error}"
        );
        assert!(zaber.may_be_moving(), "{kind:?}");
        let done = zaber.make_safe(false).unwrap();
        assert!(done.contains("stopped"), "{kind:?}: {done}");
        assert_eq!(done.contains("position kept"), kept, "{kind:?}: {done}");
        assert!(!bench.later().1 && zaber.is_homed() == kept, "{kind:?}");
        if kept {
            go(&mut zaber, &[target('1', 1000.0)]).unwrap();
        } else {
            assert!(zaber.start_move(&[target('1', 1000.0)]).is_err());
        }
    }
}

#[test]
fn an_axis_that_goes_the_wrong_way_is_caught_at_once() {
    let (bench, mut zaber) = Bench::homed(with_fault(ZaberFaultKind::WrongWay));
    let start = bench.clock.now();
    go(&mut zaber, &[target('1', 400_000.0)]).unwrap_err();
    assert!(bench.clock.now() - start < 0.3);
    zaber.make_safe(false).unwrap();
    // 10 seconds the right way would have been 400 000.
    assert!(bench.later().0[0] > -3000.0, "{:?}", bench.later().0);
}

#[test]
fn a_reply_of_not_busy_before_the_move_begins_is_no_arrival() {
    let (bench, mut zaber) = Bench::homed(with_fault(ZaberFaultKind::LateStart(0.4)));
    let found = go(&mut zaber, &[target('1', 90_000.0)]).unwrap();
    assert_eq!(found, [90_000.0]);
    assert_eq!(bench.later().0[0], 90_000.0);
    // And an axis that never begins is not waited for until the timeout.
    let (bench, mut zaber) = Bench::homed(with_fault(ZaberFaultKind::LateStart(1e6)));
    let start = bench.clock.now();
    let error = go(&mut zaber, &[target('1', 90_000.0)])
        .unwrap_err()
        .report();
    assert!(error.contains("stands at 0, expected 90000"), "{error}");
    assert!(bench.clock.now() - start < 2.0);
}

#[test]
fn a_lost_or_garbled_reply_is_asked_for_again_with_the_reason_kept() {
    for (kind, reason) in [
        (ZaberFaultKind::LoseReply, "nothing came"),
        (ZaberFaultKind::GarbleReply, "garbled reply '@01 1"),
    ] {
        let (bench, mut zaber) = Bench::homed(with_fault(kind));
        go(&mut zaber, &[target('1', 50_000.0)]).unwrap();
        let retries = zaber.retries();
        assert_eq!(retries.len(), 1, "{retries:?}");
        assert!(
            retries[0].contains("'move abs 50000 65536' sent again") && retries[0].contains(reason),
            "{retries:?}"
        );
        assert_eq!(bench.sent().matches("move abs").count(), 2);
        assert_eq!(zaber.dump().last(), Some(&retries[0]));
    }
}

#[test]
fn silence_is_told_after_three_tries_and_a_device_that_is_gone_at_once() {
    let (_, mut zaber) = Bench::homed(with_fault(ZaberFaultKind::Mute));
    let error = go(&mut zaber, &[target('1', 50_000.0)])
        .unwrap_err()
        .report();
    assert!(error.contains("in 3 tries: nothing came"), "{error}");
    assert!(
        zaber
            .make_safe(false)
            .unwrap_err()
            .report()
            .contains("no intact reply to 'stop'")
    );

    let (_, mut zaber) = Bench::homed(with_fault(ZaberFaultKind::Vanish));
    let error = go(&mut zaber, &[target('1', 50_000.0)])
        .unwrap_err()
        .report();
    assert!(error.contains("board 'arms' is disconnected"), "{error}");
    assert!(
        zaber
            .make_safe(true)
            .unwrap_err()
            .report()
            .contains("check by eye")
    );
    assert!(!zaber.is_homed());
}

#[test]
fn a_restart_between_two_shots_is_seen_even_when_an_encoder_keeps_the_reference() {
    for keeps_reference in [false, true] {
        let mut options = ZaberOptions::rotary(1);
        options.axes[0].keeps_reference = keeps_reference;
        let (bench, mut zaber) = Bench::homed(options);
        go(&mut zaber, &[target('1', 0.0)]).unwrap();
        bench.model.lock().unwrap().restart();
        bench.clock.sleep(0.5);
        let error = zaber.verify_at(&[target('1', 0.0)]).unwrap_err().report();
        assert!(error.contains("restarted by itself"), "{error}");
        assert!(!zaber.is_homed());
    }
}

struct UrgentAt(Arc<VirtualClock>, AtomicU64);

impl UrgentAt {
    fn set(&self, t: f64) {
        self.1.store(t.to_bits(), Ordering::SeqCst);
    }
}

impl Watch for UrgentAt {
    fn progress(&self, _: &str, _: u64, _: u64) {}
    fn cancelled(&self) -> bool {
        self.urgent()
    }
    fn urgent(&self) -> bool {
        self.0.now() >= f64::from_bits(self.1.load(Ordering::SeqCst))
    }
}

#[test]
fn a_request_to_stop_at_once_ends_every_wait_within_a_tenth_of_a_second() {
    for homing in [true, false] {
        let bench = Bench::new(ZaberOptions::rotary(2));
        let watch = UrgentAt(bench.clock.clone(), AtomicU64::new(f64::INFINITY.to_bits()));
        let mut zaber = bench.connect(&watch).unwrap();
        if !homing {
            zaber.home().unwrap();
        }
        let asked = bench.clock.now() + 0.537;
        watch.set(asked);
        let error = if homing {
            zaber.home().unwrap_err()
        } else {
            go(&mut zaber, &[target('1', 900_000.0)]).unwrap_err()
        };
        assert!(
            error.report().contains("stopped at once"),
            "{}",
            error.report()
        );
        zaber.brake();
        let sent = bench.sent.lock().unwrap().clone();
        let stop = sent.iter().find(|(_, text)| text.contains("stop")).unwrap();
        assert!((0.0..0.1).contains(&(stop.0 - asked)), "{} {asked}", stop.0);
        assert_eq!(zaber.may_be_homing(), homing);
        let done = zaber.make_safe(false).unwrap();
        assert_eq!(done.contains("position kept"), !homing, "{done}");
        assert!(!bench.later().1);
    }
}

#[test]
fn the_fastest_stop_is_estop_and_gives_the_position_up() {
    let (bench, mut zaber) = Bench::homed(ZaberOptions::rotary(1));
    zaber.start_move(&[target('1', 900_000.0)]).unwrap();
    bench.clock.sleep(2.0);
    let done = zaber.make_safe(true).unwrap();
    assert!(
        done.contains("position unknown") && !zaber.is_homed(),
        "{done}"
    );
    assert!(bench.sent().contains("estop") && !bench.later().1);
}

#[test]
fn a_dropped_driver_leaves_nothing_moving() {
    let (bench, mut zaber) = Bench::homed(ZaberOptions::rotary(2));
    zaber
        .start_move(&[target('1', 900_000.0), target('2', 900_000.0)])
        .unwrap();
    drop(zaber);
    assert!(!bench.later().1);
}

// -- transcripts --------------------------------------------------------------------------------------------------------

/// A line with its checksum.
fn framed(line: &str) -> String {
    let sum = line.bytes().skip(1).fold(0_u8, u8::wrapping_add);
    format!("{line}:{:02X}\r\n", sum.wrapping_neg())
}

/// A dialogue: what the driver says (`/..`), what the device says (`@..`, checksum added), or raw bytes after `=`.
fn transcript(lines: &[&str]) -> Replay {
    let entry = |(i, line): (usize, &&str)| {
        let (way, bytes) = match line.as_bytes()[0] {
            b'/' => (Way::ToBoard, framed(line).replace('\r', "")),
            b'=' => (Way::FromBoard, line[1..].to_owned()),
            _ => (Way::FromBoard, framed(line)),
        };
        WireEntry {
            t: 0.02 * (i + 1) as f64,
            board: "arms".into(),
            way,
            bytes: bytes.into_bytes(),
        }
    };
    Replay::new(lines.iter().enumerate().map(entry).collect())
}

fn over(replay: &Replay) -> Result<Zaber<'static>> {
    let wiring = Wiring {
        name: "arms".into(),
        transport: Box::new(replay.transport("arms")),
        clock: replay.clock(),
        watch: &Unwatched,
    };
    Zaber::connect(1, wiring)
}

const MEETING: [&str; 28] = [
    "/1 0 01 get version",
    "=@01 0 01 OK IDLE WR 7.38\r\n",
    "/1 0 02 set comm.checksum 1",
    "@01 0 02 OK IDLE WR 0",
    "/1 0 03 get comm.checksum",
    "@01 0 03 OK IDLE WR 1",
    "/1 0 04 get pos",
    "@01 0 04 OK IDLE WR 0 NA",
    "/1 0 05 get device.id",
    "@01 0 05 OK IDLE WR 30222",
    "/1 0 06 get system.serial",
    "@01 0 06 OK IDLE WR 55",
    "/1 0 07 get system.axiscount",
    "@01 0 07 OK IDLE WR 2",
    "/1 0 08 get limit.min",
    "@01 0 08 OK IDLE WR 0 NA",
    "/1 0 09 get limit.max",
    "@01 0 09 OK IDLE WR 1000 NA",
    "/1 0 10 get maxspeed",
    "@01 0 10 OK IDLE WR 16384 NA",
    "/1 0 11 get accel",
    "@01 0 11 OK IDLE WR 100 NA",
    "/1 0 12 get resolution",
    "@01 0 12 OK IDLE WR 64 NA",
    "/1 0 13 warnings clear",
    "@01 0 13 OK IDLE WR 02 WR FS",
    "/1 0 14 get system.uptime",
    "@01 0 14 RJ IDLE WR BADCOMMAND",
];

const HOMING: [&str; 14] = [
    "/1 1 15 home",
    "@01 1 15 OK BUSY WR 0",
    "/1 1 16 get pos",
    "@01 1 16 OK BUSY WR 40",
    "/1 1 17 get pos",
    "@01 1 17 OK IDLE -- 0",
    "/1 1 18 get pos",
    "@01 1 18 OK IDLE -- 0",
    "/1 1 19 get pos",
    "@01 1 19 OK IDLE -- 0",
    "/1 0 20 get system.uptime",
    "@01 0 20 RJ IDLE -- BADCOMMAND",
    "/1 0 21 get pos",
    "@01 0 21 OK IDLE -- 0 NA",
];

#[test]
fn the_whole_dialogue_of_connecting_homing_and_moving_is_as_written_down() {
    let lines = [
        &MEETING[..],
        &HOMING[..],
        &[
            "/1 1 22 move abs 400 1638",
            // A late reply to an earlier number, another device of the chain, and a note for people.
            "@01 1 20 OK IDLE -- 0",
            "@02 1 22 RJ IDLE FF BADDATA",
            "#01 0 this is for people",
            "@01 1 22 OK BUSY -- 0",
            "/1 0 23 get pos",
            "@01 0 23 OK BUSY -- 390 NA",
            "/1 0 24 get pos",
            // Damaged, then nothing: asked again under a new number.
            "=@01 0 24 OK IDLE -- 4O0 NA:00\r\n",
            "/1 0 25 get pos",
            "@01 0 25 OK IDLE -- 400 NA",
            "/1 0 26 get pos",
            // The reply to number 24 after all: not taken.
            "@01 0 24 OK IDLE -- 999 NA",
            "@01 0 26 OK IDLE -- 400 NA",
            "/1 0 27 get pos",
            "@01 0 27 OK IDLE -- 401 NA",
        ],
    ]
    .concat();
    let replay = transcript(&lines);
    let mut zaber = over(&replay).unwrap();
    assert!(zaber.dump().contains(&"warnings 02 WR FS".to_owned()));
    assert!(zaber.axis_limits('2').is_err(), "no stage on axis 2");
    zaber.home().unwrap();
    let targets = [Target {
        letter: '1',
        units: 400.0,
        tolerance: 2.0,
        speed: 1000.0,
    }];
    assert_eq!(go(&mut zaber, &targets).unwrap(), [401.0]);
    assert_eq!(zaber.retries().len(), 1);
    assert!(
        zaber.retries()[0].contains("garbled reply '@01 0 24"),
        "{:?}",
        zaber.retries()
    );
    drop(zaber);
    replay.finish().unwrap();
}

#[test]
fn homing_without_a_reply_is_not_repeated_and_a_rejection_is_told_with_its_meaning() {
    let replay = transcript(&[&MEETING[..], &["/1 1 15 home"]].concat());
    let mut zaber = over(&replay).unwrap();
    let error = zaber.home().unwrap_err().report();
    assert!(
        error.contains("no intact reply to 'home' in 1 try"),
        "{error}"
    );
    replay.finish().unwrap();
    std::mem::forget(zaber);

    let rejected = ["/1 1 15 home", "@01 1 15 RJ IDLE FD DRIVERDISABLED"];
    let replay = transcript(&[&MEETING[..], &rejected].concat());
    let mut zaber = over(&replay).unwrap();
    let error = zaber.home().unwrap_err().report();
    assert!(
        error.contains("rejected 'home' with DRIVERDISABLED: its motor driver is disabled"),
        "{error}"
    );
    std::mem::forget(zaber);
}

#[test]
fn an_alert_with_a_fault_flag_is_a_fault_and_one_without_is_not() {
    for (flag, fault) in [("--", false), ("FS", true), ("NC", true)] {
        let alert = format!("!01 1 IDLE {flag}");
        let lines = [
            &MEETING[..],
            &HOMING[..12],
            &[
                "/1 0 21 get pos",
                alert.as_str(),
                "@01 0 21 OK IDLE -- 0 NA",
            ],
        ]
        .concat();
        let replay = transcript(&lines);
        let mut zaber = over(&replay).unwrap();
        zaber.home().unwrap();
        let result = zaber.verify_at(&[Target {
            letter: '1',
            units: 0.0,
            tolerance: 1.0,
            speed: 1.0,
        }]);
        assert_eq!(result.is_err(), fault, "{flag}");
        if let Err(error) = result {
            let report = error.report();
            assert!(
                report.contains(flag) && report.contains("an alert of axis 1"),
                "{report}"
            );
        }
        replay.finish().unwrap();
    }
}

#[test]
fn a_homing_that_finds_nothing_is_told() {
    let mut lines = [&MEETING[..], &["/1 1 15 home", "@01 1 15 OK BUSY WR 0"]].concat();
    let stands: Vec<String> = (16..40)
        .flat_map(|id| {
            [
                format!("/1 1 {id} get pos"),
                format!("@01 1 {id} OK IDLE WR 0"),
            ]
        })
        .collect();
    lines.extend(stands.iter().map(String::as_str));
    let replay = transcript(&lines);
    let mut zaber = over(&replay).unwrap();
    let error = zaber.home().unwrap_err().report();
    assert!(error.contains("without finding its home sensor"), "{error}");
    std::mem::forget(zaber);
}

// -- whole captures -----------------------------------------------------------------------------------------------------

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
    let options = CaptureOptions::of(&rig);
    let summary = capture_in_process(
        &rig,
        &plan16(),
        &mut TextCamera::default(),
        &first,
        &options,
        &Unwatched,
    )
    .unwrap();
    assert!(summary.finished);
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
        &second,
        &options,
        &mut |_| Ok(()),
        &Unwatched,
    )
    .unwrap();
    assert!(again.finished);
}

struct Room {
    arms: Arc<Mutex<ZaberModel>>,
    table: Arc<Mutex<ZaberModel>>,
    lamp: Arc<Mutex<ScpiModel>>,
    clock: Arc<VirtualClock>,
}

fn captured(faults: Vec<ZaberFault>, out: &Path) -> (Room, Result<capture::Summary>, Vec<bool>) {
    captured_watching(faults, out, None)
}

/// A capture; with `urgent_at` the operator asks to stop at once at that time.
fn captured_watching(
    faults: Vec<ZaberFault>,
    out: &Path,
    urgent_at: Option<f64>,
) -> (Room, Result<capture::Summary>, Vec<bool>) {
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
    let watch = UrgentAt(clock.clone(), AtomicU64::new(asked.to_bits()));
    let mut camera = TextCamera {
        lamp: Some(lamp.clone()),
        lit: Vec::new(),
    };
    let result = capture::run(
        &rig,
        &plan16(),
        connection,
        &mut camera,
        out,
        &CaptureOptions::of(&rig),
        &mut |_| Ok(()),
        &watch,
    );
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
    assert!(result.unwrap().finished);
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
        assert!(result.unwrap().finished, "{kind:?}");
    }
}

#[test]
fn a_stop_at_once_at_any_time_of_a_capture_ends_dark_and_still_within_seconds() {
    let folder = tempfile::tempdir().unwrap();
    let (mut stopped, mut moving) = (0, 0);
    for i in 0..40 {
        // All devices are connected after 0.8 s.
        let asked = 1.1 + 5.7 * f64::from(i);
        let out = folder.path().join(i.to_string());
        let (room, result, _) = captured_watching(vec![], &out, Some(asked));
        let Err(error) = result else { continue };
        stopped += 1;
        let report = error.report();
        assert!(report.contains("stopped at once"), "{asked}: {report}");
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
    // The capture takes 229 s; most of it warming up and moving.
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
    let error = capture::run(
        &rig,
        &plan16(),
        connection,
        &mut TextCamera::default(),
        &folder.path().join("s"),
        &CaptureOptions::of(&rig),
        &mut |_| Ok(()),
        &Unwatched,
    )
    .unwrap_err()
    .report();
    assert!(
        error.contains("axis light_azimuth") && error.contains("0 to 1000000"),
        "{error}"
    );
}

// -- real pseudo-terminals ------------------------------------------------------------------------------------------------

fn over_pty(simulator: &PtySimulator<ZaberModel>) -> Result<Zaber<'static>> {
    let port = SerialTransport::open(simulator.path(), 115_200, None)?;
    let wiring = Wiring {
        name: "arms".into(),
        transport: Box::new(port),
        clock: Arc::new(SystemClock::new()),
        watch: &Unwatched,
    };
    Zaber::connect(1, wiring)
}

#[test]
fn connect_home_and_move_over_a_real_port() {
    let model = ZaberModel::new(ZaberOptions::rotary(2));
    let simulator = PtySimulator::spawn(model, 20.0, None).unwrap();
    std::thread::sleep(std::time::Duration::from_millis(20));
    let mut zaber = over_pty(&simulator).unwrap();
    zaber.home().unwrap();
    let targets = [target('1', 100_000.0), target('2', 40_000.0)];
    assert_eq!(go(&mut zaber, &targets).unwrap(), [100_000.0, 40_000.0]);
    drop(zaber);
    // The next client finds checksums on.
    over_pty(&simulator).unwrap();
}

#[test]
fn a_device_that_disappears_from_a_real_port_is_a_disconnect() {
    let model = ZaberModel::new(with_fault(ZaberFaultKind::Vanish));
    let simulator = PtySimulator::spawn(model, 20.0, None).unwrap();
    std::thread::sleep(std::time::Duration::from_millis(20));
    let mut zaber = over_pty(&simulator).unwrap();
    zaber.home().unwrap();
    let error = go(&mut zaber, &[target('1', 400_000.0)])
        .unwrap_err()
        .report();
    assert!(error.contains("board 'arms' is disconnected"), "{error}");
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
        &CaptureOptions::of(&rig),
        100.0,
        &Unwatched,
    )
    .unwrap();
    assert!(summary.finished && summary.frames == 36);
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
    let options = CaptureOptions::of(&rig);
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
        .arg(format!("replay:{}", old.display()));
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
