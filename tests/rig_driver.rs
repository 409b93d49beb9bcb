//! Promise: the driver survives what motion controllers do, and never takes `ok` for done.
//!
//! In process, against the byte-level controller model on a virtual clock; each test is named by the trap it springs.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use goniofit::base::Unwatched;
use goniofit::rig::{
    Clock, Fault, FaultKind, Flavor, Grbl, GrblModel, Light, ModelOptions, ModelTransport, Motion,
    SharedModel, Target, Transport, VirtualClock,
};
use std::io;
use std::sync::{Arc, Mutex};

struct Bench {
    clock: Arc<VirtualClock>,
    model: SharedModel,
    sent: Arc<Mutex<Vec<u8>>>,
}

/// Keeps what the driver sent.
struct Tapped(ModelTransport, Arc<Mutex<Vec<u8>>>);

impl Transport for Tapped {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.1.lock().unwrap().extend_from_slice(bytes);
        self.0.write(bytes)
    }
    fn read(&mut self, buffer: &mut [u8], timeout: f64) -> io::Result<usize> {
        self.0.read(buffer, timeout)
    }
}

impl Bench {
    fn new(options: ModelOptions) -> Self {
        Self {
            clock: Arc::new(VirtualClock::new()),
            model: Arc::new(Mutex::new(GrblModel::new(options))),
            sent: Arc::default(),
        }
    }

    fn connect(&self) -> goniofit::base::Result<Grbl<'static>> {
        let cable = ModelTransport::new(self.model.clone(), self.clock.clone());
        let tapped = Tapped(cable, self.sent.clone());
        Grbl::connect("main", Box::new(tapped), self.clock.clone(), &Unwatched)
    }

    fn homed(options: ModelOptions) -> (Self, Grbl<'static>) {
        let bench = Self::new(options);
        let mut grbl = bench.connect().unwrap();
        grbl.home().unwrap();
        (bench, grbl)
    }

    fn sent(&self) -> String {
        String::from_utf8_lossy(&self.sent.lock().unwrap()).into_owned()
    }

    fn lamp(&self) -> bool {
        self.model.lock().unwrap().spindle_on()
    }
}

fn faulty(flavor: Flavor, kind: FaultKind) -> ModelOptions {
    ModelOptions {
        faults: vec![Fault { on_move: 1, kind }],
        ..ModelOptions::rig(flavor)
    }
}

fn x(units: f64) -> [Target; 1] {
    [Target {
        letter: 'X',
        units,
        tolerance: 0.02,
        speed: 10.0,
    }]
}

fn go(grbl: &mut Grbl, units: f64) -> goniofit::base::Result<Vec<f64>> {
    grbl.start_move(&x(units))?;
    grbl.finish_move(&x(units), 60.0)
}

#[test]
fn both_kinds_connect_home_move_and_read_back() {
    for flavor in [Flavor::Grbl, Flavor::GrblHal] {
        for blank_eeprom in [false, true] {
            let (bench, mut grbl) = Bench::homed(ModelOptions {
                blank_eeprom,
                ..ModelOptions::rig(flavor)
            });
            let start = bench.clock.now();
            let found = go(&mut grbl, -50.0).unwrap();
            assert!((found[0] + 50.0).abs() < 0.004, "{found:?}");
            // 49 units at 10 units/s: the barrier really waited.
            assert!(
                bench.clock.now() - start > 4.9,
                "{}",
                bench.clock.now() - start
            );
            assert!(!bench.sent().contains('\r'), "lines end with LF alone");
        }
    }
}

#[test]
fn a_lost_banner_does_not_matter() {
    // The board has started long before anybody listens, and what it said is gone.
    let bench = Bench::new(ModelOptions::rig(Flavor::Grbl));
    bench.clock.advance_to(30.0);
    bench.model.lock().unwrap().take_output(30.0);
    assert!(bench.connect().unwrap().firmware().contains("1.1h"));
}

#[test]
fn a_slow_boot_is_waited_for() {
    let bench = Bench::new(ModelOptions {
        boot: 4.5,
        ..ModelOptions::factory(Flavor::Grbl)
    });
    bench.connect().unwrap();
}

#[test]
fn silence_at_connect_is_not_an_unplug() {
    // A controller left deaf by a soft-limit alarm answers only after 0x18.
    let bench = Bench::new(ModelOptions::rig(Flavor::Grbl));
    {
        let mut model = bench.model.lock().unwrap();
        model.receive(b"$X\n", 2.0);
        model.receive(b"G0X50\n", 2.1);
        model.take_output(5.0);
        model.receive(b"?", 5.0);
        assert!(model.take_output(6.0).is_empty(), "deaf after ALARM:2");
    }
    bench.clock.advance_to(6.0);
    let mut grbl = bench.connect().unwrap();
    assert!(bench.sent().contains('\x18'));
    grbl.home().unwrap();
    go(&mut grbl, -5.0).unwrap();
}

#[test]
fn a_motion_found_at_connect_is_stopped() {
    let bench = Bench::new(ModelOptions::factory(Flavor::GrblHal));
    bench.model.lock().unwrap().receive(b"G1X100F300\n", 2.0);
    bench.clock.advance_to(3.0);
    bench.connect().unwrap();
    assert!(!bench.model.lock().unwrap().is_moving());
    let position = bench.model.lock().unwrap().position()[0];
    assert!((0.0..20.0).contains(&position), "{position}");
}

#[test]
fn nothing_that_is_no_controller_is_connected_to() {
    struct Mute(Arc<VirtualClock>, &'static [u8]);
    impl Transport for Mute {
        fn write(&mut self, _: &[u8]) -> io::Result<()> {
            Ok(())
        }
        fn read(&mut self, buffer: &mut [u8], timeout: f64) -> io::Result<usize> {
            self.0.sleep(timeout.max(0.01));
            buffer[..self.1.len()].copy_from_slice(self.1);
            if self.1.is_empty() {
                return Err(io::ErrorKind::TimedOut.into());
            }
            Ok(self.1.len())
        }
    }
    for (noise, reason) in [
        (&b""[..], "no answer within"),
        (b"\xf0\x0f\x80", "talks without end"),
        (b"hello\r\n", "talks without end"),
    ] {
        let clock = Arc::new(VirtualClock::new());
        let mute = Box::new(Mute(clock.clone(), noise));
        let error = Grbl::connect("main", mute, clock.clone(), &Unwatched)
            .map(|_| ())
            .unwrap_err()
            .report();
        assert!(error.contains(reason) && error.contains("hint:"), "{error}");
        assert!(
            clock.now() < 60.0,
            "every wait has a limit: {}",
            clock.now()
        );
    }
}

#[test]
fn a_move_before_homing_is_refused_without_a_byte() {
    let bench = Bench::new(ModelOptions::rig(Flavor::Grbl));
    let mut grbl = bench.connect().unwrap();
    let before = bench.sent().len();
    let error = grbl.start_move(&x(-5.0)).unwrap_err().report();
    assert!(error.contains("position is not known"), "{error}");
    assert_eq!(bench.sent().len(), before);
}

#[test]
fn not_a_number_is_never_sent() {
    let (bench, mut grbl) = Bench::homed(ModelOptions::rig(Flavor::Grbl));
    let before = bench.sent().len();
    for (units, speed) in [
        (f64::NAN, 10.0),
        (f64::INFINITY, 10.0),
        (-5.0, f64::NAN),
        (-5.0, 0.0),
        (-5.0, f64::INFINITY),
    ] {
        let [target] = x(units);
        let target = Target { speed, ..target };
        assert!(grbl.start_move(&[target]).is_err());
    }
    assert_eq!(bench.sent().len(), before);
}

#[test]
fn an_alarm_in_the_middle_of_a_move_voids_the_ok_and_the_position() {
    for flavor in [Flavor::Grbl, Flavor::GrblHal] {
        let (bench, mut grbl) = Bench::homed(faulty(flavor, FaultKind::Alarm(1)));
        grbl.switch_on(500.0).unwrap();
        let error = go(&mut grbl, -50.0).unwrap_err().report();
        assert!(
            error.contains("ALARM:1") && error.contains("limit switch was hit"),
            "{error}"
        );
        assert!(!grbl.is_homed());
        let done = grbl.make_safe(false).unwrap();
        assert!(done.contains("home before moving"), "{done}");
        assert!(!bench.lamp());
        assert!(grbl.start_move(&x(-1.0)).is_err());
        // And the way back: home again, move again.
        grbl.home().unwrap();
        go(&mut grbl, -3.0).unwrap();
    }
}

#[test]
fn a_spontaneous_restart_in_the_middle_of_a_move_is_told_and_unhomes() {
    for flavor in [Flavor::Grbl, Flavor::GrblHal] {
        let (bench, mut grbl) = Bench::homed(faulty(flavor, FaultKind::Reset));
        grbl.switch_on(500.0).unwrap();
        let error = go(&mut grbl, -50.0).unwrap_err().report();
        let told = error.contains("restarted by itself") || error.contains("ALARM:11");
        assert!(told, "{error}");
        assert!(!grbl.is_homed());
        grbl.make_safe(false).unwrap();
        assert!(!bench.lamp());
    }
}

#[test]
fn a_vanished_board_is_a_disconnect_and_not_a_hang() {
    let (_bench, mut grbl) = Bench::homed(faulty(Flavor::Grbl, FaultKind::Vanish));
    let error = go(&mut grbl, -50.0).unwrap_err().report();
    assert!(error.contains("board 'main' is disconnected"), "{error}");
    assert!(
        error.contains("hint:") && error.contains("homed again"),
        "{error}"
    );
    assert!(!grbl.is_homed());
    assert!(
        grbl.make_safe(false)
            .unwrap_err()
            .report()
            .contains("check by eye")
    );
}

#[test]
fn a_hold_pressed_by_somebody_is_noticed_while_waiting() {
    let (_bench, mut grbl) = Bench::homed(faulty(Flavor::Grbl, FaultKind::Hold));
    let error = go(&mut grbl, -50.0).unwrap_err().report();
    assert!(error.contains("state Hold:"), "{error}");
    let done = grbl.make_safe(false).unwrap();
    assert!(done.contains("position kept"), "{done}");
}

#[test]
fn a_controlled_stop_loses_no_steps_and_a_bare_reset_does() {
    for flavor in [Flavor::Grbl, Flavor::GrblHal] {
        let (bench, mut grbl) = Bench::homed(ModelOptions::rig(flavor));
        grbl.start_move(&x(-100.0)).unwrap();
        bench.clock.sleep(3.0);
        let report = grbl.controlled_stop().unwrap();
        assert!(report.position_kept && grbl.is_homed(), "{report}");
        let sent = bench.sent();
        let (hold, reset) = (sent.rfind('!').unwrap(), sent.rfind('\x18').unwrap());
        assert!(
            hold < reset && sent[hold..reset].contains('?'),
            "waited between"
        );
        go(&mut grbl, -5.0).unwrap();

        // The negative control: 0x18 alone while moving.
        grbl.start_move(&x(-100.0)).unwrap();
        bench.clock.sleep(1.0);
        bench
            .model
            .lock()
            .unwrap()
            .receive(b"\x18", bench.clock.now());
        bench.clock.sleep(2.0);
        assert!(grbl.status().unwrap_err().report().contains("ALARM:3"));
        assert!(!grbl.is_homed());
    }
}

#[test]
fn a_target_outside_the_controllers_travel_raises_its_alarm_and_is_recovered() {
    let (_bench, mut grbl) = Bench::homed(ModelOptions::rig(Flavor::Grbl));
    let error = go(&mut grbl, 5.0).unwrap_err().report();
    assert!(
        error.contains("ALARM:2") && error.contains("compare the limits"),
        "{error}"
    );
    let done = grbl.make_safe(false).unwrap();
    assert!(done.contains("home before moving"), "{done}");
    grbl.home().unwrap();
}

#[test]
fn noise_that_changes_an_override_is_noticed_before_a_shot() {
    let (bench, mut grbl) = Bench::homed(ModelOptions::rig(Flavor::GrblHal));
    go(&mut grbl, -5.0).unwrap();
    grbl.verify_at(&x(-5.0)).unwrap();
    bench
        .model
        .lock()
        .unwrap()
        .receive(&[0x91], bench.clock.now());
    let error = grbl.verify_at(&x(-5.0)).unwrap_err().report();
    assert!(
        error.contains("overrides are [110.0, 100.0, 100.0]"),
        "{error}"
    );
}

#[test]
fn an_override_reported_only_during_the_move_is_not_forgotten() {
    // Most reports leave the overrides out: the one report that had them came while the barrier was waited for.
    for flavor in [Flavor::Grbl, Flavor::GrblHal] {
        let (bench, mut grbl) = Bench::homed(ModelOptions::rig(flavor));
        grbl.start_move(&x(-10.0)).unwrap();
        bench
            .model
            .lock()
            .unwrap()
            .receive(&[0x91], bench.clock.now());
        let error = grbl.finish_move(&x(-10.0), 60.0).unwrap_err().report();
        assert!(error.contains("overrides are [110.0"), "{error}");
        // The reset of the stop puts them back.
        grbl.make_safe(false).unwrap();
        go(&mut grbl, -3.0).unwrap();
    }
}

#[test]
fn command_bytes_out_of_the_noise_are_noticed_before_a_shot() {
    for (byte, reason) in [
        (b'!', "state Hold:0"),
        (0x84, "state Door:0"),
        (0x18, "restarted by itself"),
    ] {
        let (bench, mut grbl) = Bench::homed(ModelOptions::rig(Flavor::Grbl));
        go(&mut grbl, -5.0).unwrap();
        bench
            .model
            .lock()
            .unwrap()
            .receive(&[byte], bench.clock.now());
        bench.clock.sleep(1.0);
        let error = grbl.verify_at(&x(-5.0)).unwrap_err().report();
        assert!(error.contains(reason), "{byte:#x}: {error}");
    }
}

#[test]
fn a_board_that_talks_without_end_is_no_hang() {
    // Well-formed lines that are no answer to anything, with no pause between them.
    struct Flood(Arc<VirtualClock>, ModelTransport);
    impl Transport for Flood {
        fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
            self.1.write(bytes)
        }
        fn read(&mut self, buffer: &mut [u8], timeout: f64) -> io::Result<usize> {
            if self.0.now() < 7.0 {
                return self.1.read(buffer, timeout);
            }
            let line = b"[MSG:on and on]\r\n";
            self.0.sleep(line.len() as f64 * 10.0 / 115_200.0);
            buffer[..line.len()].copy_from_slice(line);
            Ok(line.len())
        }
    }
    let bench = Bench::new(ModelOptions::rig(Flavor::Grbl));
    let cable = ModelTransport::new(bench.model.clone(), bench.clock.clone());
    let flood = Flood(bench.clock.clone(), cable);
    let clock = bench.clock.clone();
    let mut grbl = Grbl::connect("main", Box::new(flood), clock.clone(), &Unwatched).unwrap();
    grbl.home().unwrap();
    clock.advance_to(7.0);
    assert!(grbl.status().is_err());
    assert!(grbl.command("$G").is_err());
    let _ = grbl.make_safe(false);
    assert!(grbl.controlled_stop().is_err());
    assert!(clock.now() < 60.0, "{}", clock.now());
}

#[test]
fn the_lamp_is_read_back_and_laser_mode_is_refused() {
    let (bench, mut grbl) = Bench::homed(ModelOptions::rig(Flavor::GrblHal));
    Light::check(&mut grbl, 800.0).unwrap();
    grbl.switch_on(800.0).unwrap();
    assert!(bench.lamp());
    grbl.switch_off().unwrap();
    assert!(!bench.lamp());
    let mut options = ModelOptions::rig(Flavor::Grbl);
    options.settings.push((32, 1.0));
    let mut grbl = Bench::new(options).connect().unwrap();
    let error = Light::check(&mut grbl, 800.0).unwrap_err().report();
    assert!(
        error.contains("laser mode ($32=1)") && error.contains("$32=0"),
        "{error}"
    );
}

#[test]
fn a_dropped_driver_leaves_no_lamp_on_and_nothing_moving() {
    let (bench, mut grbl) = Bench::homed(ModelOptions::rig(Flavor::Grbl));
    grbl.switch_on(500.0).unwrap();
    drop(grbl);
    bench
        .model
        .lock()
        .unwrap()
        .take_output(bench.clock.now() + 1.0);
    assert!(!bench.lamp());

    let (bench, mut grbl) = Bench::homed(ModelOptions::rig(Flavor::Grbl));
    grbl.switch_on(500.0).unwrap();
    grbl.start_move(&x(-100.0)).unwrap();
    drop(grbl);
    let model = bench.model.lock().unwrap();
    assert!(!model.is_moving() && !model.spindle_on());
}

#[test]
fn homing_switched_off_is_told_with_the_setting() {
    let bench = Bench::new(ModelOptions::factory(Flavor::Grbl));
    let error = bench.connect().unwrap().home().unwrap_err().report();
    assert!(
        error.contains("error:5") && error.contains("$22=1"),
        "{error}"
    );
}

#[test]
fn lines_with_live_command_bytes_are_not_sent() {
    let (bench, mut grbl) = Bench::homed(ModelOptions::rig(Flavor::Grbl));
    let before = bench.sent().len();
    for line in ["G0X1!", "?", "G0\u{18}", "G0X1\nG0X2", &"X".repeat(80)] {
        assert!(grbl.command(line).is_err(), "{line:?}");
    }
    assert_eq!(bench.sent().len(), before);
}
