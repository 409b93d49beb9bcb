//! Promise: a Zaber controller is driven as safely as a GRBL board: no reply is mistaken, no arrival is believed that did
//! not happen, and whatever goes wrong ends at rest and told.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use goniofit::base::{Result, Unwatched, Watch};
use goniofit::rig::{
    ByteModel, Clock, Homing, ModelTransport, Motion, PtySimulator, Replay, SerialTransport,
    SystemClock, Target, Transport, Travel, VirtualClock, Way, WireEntry, Wiring, Zaber,
    ZaberFault, ZaberFaultKind, ZaberModel, ZaberOptions,
};
use std::io;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

const FAST: f64 = 40_000.0;

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
