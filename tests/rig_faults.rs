//! Promise: whatever is wrong with a controller, no move claims success without the axes standing there.
//!
//! One named test for each fault of the controller model, in process on a virtual clock; and controllers that lie.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use goniofit::base::{Result, Unwatched, Watch};
use goniofit::rig::{
    AxisAngles, Clock, Connection, Fault, FaultKind, Flavor, Grbl, GrblModel, Halt, ModelOptions,
    ModelTransport, Motion, Rig, RigDescription, SharedModel, Target, Transport, VirtualClock,
    stop_all,
};
use std::collections::BTreeMap;
use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

fn x(units: f64) -> [Target; 1] {
    [Target {
        letter: 'X',
        units,
        tolerance: 0.02,
        speed: 10.0,
    }]
}

struct Bench {
    clock: Arc<VirtualClock>,
    model: SharedModel,
    grbl: Grbl<'static>,
}

/// Homed; the first move strikes the fault.
fn faulty(flavor: Flavor, kind: FaultKind) -> Bench {
    let clock = Arc::new(VirtualClock::new());
    let model = Arc::new(Mutex::new(GrblModel::new(ModelOptions {
        faults: vec![Fault { on_move: 1, kind }],
        ..ModelOptions::rig(flavor)
    })));
    let cable = Box::new(ModelTransport::new(model.clone(), clock.clone()));
    let mut grbl = Grbl::connect("main", cable, clock.clone(), &Unwatched).unwrap();
    grbl.home().unwrap();
    Bench { clock, model, grbl }
}

impl Bench {
    fn go(&mut self, units: f64) -> Result<Vec<f64>> {
        self.grbl.start_move(&x(units))?;
        self.grbl.finish_move(&x(units), 60.0)
    }

    fn place(&self) -> f64 {
        let mut model = self.model.lock().unwrap();
        model.take_output(self.clock.now());
        model.position()[0]
    }

    /// The move fails with this reason; then the rig is made safe and still.
    fn fails(&mut self, reason: &str) {
        let error = self.go(-50.0).unwrap_err().report();
        assert!(error.contains(reason), "{error}");
        self.grbl.make_safe(false).unwrap();
        assert!(!self.model.lock().unwrap().is_moving());
    }

    fn arrives(&mut self, note: &str) {
        self.go(-50.0).unwrap();
        assert!((self.place() + 50.0).abs() < 0.004);
        let notes = self.grbl.take_notes().join("\n");
        assert!(notes.contains(note), "{notes}");
        self.go(-3.0).unwrap();
        assert!((self.place() + 3.0).abs() < 0.004);
    }
}

fn each(kind: FaultKind, test: impl Fn(&mut Bench)) {
    for flavor in [Flavor::Grbl, Flavor::GrblHal] {
        test(&mut faulty(flavor, kind));
    }
}

#[test]
fn fault_reset_is_told() {
    each(FaultKind::Reset, |b| {
        b.fails("restarted by itself");
        assert!(!b.grbl.is_homed());
    });
}

#[test]
fn fault_alarm_is_told() {
    each(FaultKind::Alarm(1), |b| b.fails("ALARM:1"));
}

#[test]
fn fault_garble_is_recovered() {
    each(FaultKind::Garble, |b| b.arrives("garbled reply 'o\\xfek'"));
}

#[test]
fn fault_never_ok_ends() {
    each(FaultKind::NeverOk, |b| {
        b.fails("no answer within 3 s to 'G21G90G94G53G1X-50.0000F600.0'");
    });
}

#[test]
fn fault_vanish_is_a_disconnect() {
    each(FaultKind::Vanish, |b| {
        let error = b.go(-50.0).unwrap_err().report();
        assert!(error.contains("is disconnected"), "{error}");
        assert!(b.grbl.make_safe(true).is_err());
    });
}

#[test]
fn fault_fall_short_is_seen_in_the_position() {
    each(FaultKind::FallShort(-0.5), |b| b.fails("stands at -49.5"));
    // Beyond the target it is seen before the end.
    each(FaultKind::FallShort(0.5), |b| b.fails("off its way"));
}

#[test]
fn fault_hold_is_noticed() {
    each(FaultKind::Hold, |b| b.fails("state Hold:"));
}

#[test]
fn fault_double_ok_is_dropped() {
    each(FaultKind::DoubleOk, |b| b.arrives("an 'ok' too many"));
}

#[test]
fn fault_drop_byte_never_ends_in_a_false_success() {
    // Every byte of 'G21G90G94G53G1X-50.0000F600.0' once; the last is the line's end.
    let mut recovered = 0;
    for flavor in [Flavor::Grbl, Flavor::GrblHal] {
        for place in 0..=29 {
            let mut b = faulty(flavor, FaultKind::DropByte(place));
            match b.go(-50.0) {
                Ok(_) => {
                    assert!(
                        (b.place() + 50.0).abs() < 0.021,
                        "byte {place}: {}",
                        b.place()
                    );
                    recovered += 1;
                }
                Err(e) => {
                    let error = e.report();
                    assert!(error.contains("board 'main'"), "{error}");
                    b.grbl.make_safe(false).unwrap();
                }
            }
            assert!(!b.model.lock().unwrap().is_moving());
        }
    }
    assert!((4..60).contains(&recovered), "{recovered} of 60 arrived");
}

#[test]
fn fault_drop_byte_of_the_line_end_is_recovered() {
    each(FaultKind::DropByte(99), |b| {
        b.arrives("no answer within 3 s")
    });
}

#[test]
fn fault_corrupt_digit_is_caught_on_the_way() {
    // To -90 instead of -50: a fault as soon as it is beyond the target, not when the motion ends.
    each(FaultKind::CorruptDigit('9'), |b| {
        b.fails("off its way from -1.0000 to -50.0000");
        let place = b.place();
        assert!((-55.0..-50.0).contains(&place), "{place}");
    });
    // To -10: at the end.
    each(FaultKind::CorruptDigit('1'), |b| b.fails("stands at -10.0"));
}

#[test]
fn fault_stuck_busy_ends() {
    each(FaultKind::StuckBusy, |b| {
        let start = b.clock.now();
        b.fails("says that it runs, but stood still for 5 s");
        assert!(b.clock.now() - start < 15.0);
    });
}

// -- what else must not pass for a move ---------------------------------------------------------------------------------

/// Says `ok` to the barrier at once and reports what it is told to, one report after the other.
struct Liar {
    clock: Arc<VirtualClock>,
    inner: ModelTransport,
    from: f64,
    reports: Vec<&'static str>,
    said: Vec<u8>,
}

impl Transport for Liar {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        if self.clock.now() < self.from {
            return self.inner.write(bytes);
        }
        if bytes == b"?" {
            let report = self.reports.remove(0);
            self.said.extend(report.as_bytes());
        } else {
            self.said.extend(b"ok\r\n");
        }
        Ok(())
    }
    fn read(&mut self, buffer: &mut [u8], timeout: f64) -> io::Result<usize> {
        if self.clock.now() < self.from {
            return self.inner.read(buffer, timeout);
        }
        if self.said.is_empty() {
            self.clock.sleep(timeout);
            return Err(io::ErrorKind::TimedOut.into());
        }
        let n = self.said.len().min(buffer.len());
        buffer[..n].copy_from_slice(&self.said[..n]);
        self.said.drain(..n);
        Ok(n)
    }
}

fn lie(reports: &[&'static str]) -> Result<Vec<f64>> {
    let clock = Arc::new(VirtualClock::new());
    let model = Arc::new(Mutex::new(GrblModel::new(ModelOptions::rig(Flavor::Grbl))));
    let liar = Liar {
        clock: clock.clone(),
        inner: ModelTransport::new(model, clock.clone()),
        from: 30.0,
        reports: reports.to_vec(),
        said: Vec::new(),
    };
    let mut grbl = Grbl::connect("main", Box::new(liar), clock.clone(), &Unwatched).unwrap();
    grbl.home().unwrap();
    clock.advance_to(31.0);
    grbl.start_move(&x(-50.0))?;
    grbl.finish_move(&x(-50.0), 60.0)
}

#[test]
fn a_controller_that_is_not_busy_and_then_moves_is_caught() {
    let at_home = "<Idle|MPos:-1.000,-1.000,-1.000|FS:0,0>\r\n";
    let there = "<Idle|MPos:-50.000,-1.000,-1.000|FS:0,0>\r\n";
    let leaves = "<Idle|MPos:-49.900,-1.000,-1.000|FS:0,0>\r\n";
    let told = |reports: &[&'static str]| lie(reports).unwrap_err().report();
    // Idle before it began.
    assert!(told(&[at_home, at_home]).contains("stands at -1.0000, expected -50.0000"));
    // There for a moment.
    for n in 1..=2 {
        let mut reports = vec![at_home];
        reports.extend(std::iter::repeat_n(there, n));
        reports.push(leaves);
        let error = told(&reports);
        assert!(error.contains("axis X stands at -49.9000"), "{n}: {error}");
    }
    // The control: there to stay.
    lie(&[at_home, there, there, there]).unwrap();
}

#[test]
fn an_axis_that_moved_before_the_move_was_sent_is_a_fault() {
    let elsewhere = "<Idle|MPos:-1.000,-2.000,-1.000|FS:0,0>\r\n";
    let error = lie(&[elsewhere]).unwrap_err().report();
    assert!(
        error.contains("axis Y stands at -2.0000 though it was left at -1.0000"),
        "{error}"
    );
}

#[test]
fn at_once_means_a_reset_without_waiting_and_the_position_void() {
    for flavor in [Flavor::Grbl, Flavor::GrblHal] {
        let mut b = faulty(flavor, FaultKind::DoubleOk);
        b.grbl.start_move(&x(-100.0)).unwrap();
        b.clock.sleep(2.0);
        let start = b.clock.now();
        let done = b.grbl.make_safe(true).unwrap();
        assert!(done.contains("reset at once"), "{done}");
        assert!(b.clock.now() - start < 1.0, "no Hold:0 was waited for");
        assert!(!b.grbl.is_homed() && !b.model.lock().unwrap().is_moving());
        assert!(b.grbl.start_move(&x(-1.0)).is_err());
        b.grbl.home().unwrap();
        b.go(-3.0).unwrap();
    }
}

#[test]
fn the_dump_is_what_the_board_said_line_by_line() {
    let b = faulty(Flavor::GrblHal, FaultKind::DoubleOk);
    let dump = b.grbl.dump();
    for line in [
        "[FIRMWARE:grblHAL]",
        "$30=1000.000",
        "$22=5",
        "[TLO:0.000,0.000,0.000,0.000,0.000]",
    ] {
        assert!(dump.iter().any(|l| l == line), "{line}");
    }
    assert!(dump.iter().any(|l| l.starts_with("[GC:G0 G54")));
}

// -- damaged on its way to the board ------------------------------------------------------------------------------------

/// A cable that changes what is written, once in a while.
struct Mangle<F> {
    inner: ModelTransport,
    change: F,
}

impl<F: FnMut(&[u8]) -> Vec<u8> + Send> Transport for Mangle<F> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        let bytes = (self.change)(bytes);
        self.inner.write(&bytes)
    }
    fn read(&mut self, buffer: &mut [u8], timeout: f64) -> io::Result<usize> {
        self.inner.read(buffer, timeout)
    }
}

/// A board at rest behind a cable; `change` sees all that is written.
fn behind(
    flavor: Flavor,
    watch: &'static dyn Watch,
    change: impl FnMut(&[u8]) -> Vec<u8> + Send + 'static,
) -> (Arc<VirtualClock>, SharedModel, Grbl<'static>) {
    let clock = Arc::new(VirtualClock::new());
    let model: SharedModel = Arc::new(Mutex::new(GrblModel::new(ModelOptions::rig(flavor))));
    let inner = ModelTransport::new(model.clone(), clock.clone());
    let cable = Box::new(Mangle { inner, change });
    let grbl = Grbl::connect("main", cable, clock.clone(), watch).unwrap();
    (clock, model, grbl)
}

/// Replaces the first `$H`.
fn homed_by(flavor: Flavor, replacement: Vec<u8>) -> (SharedModel, Result<()>, Grbl<'static>) {
    let mut done = false;
    let (_, model, mut grbl) = behind(flavor, &Unwatched, move |bytes| {
        if bytes == b"$H\n" && !std::mem::replace(&mut done, true) {
            replacement.clone()
        } else {
            bytes.to_vec()
        }
    });
    let result = grbl.home();
    (model, result, grbl)
}

#[test]
fn no_flipped_bit_of_a_homing_command_passes_for_homing() {
    for flavor in [Flavor::Grbl, Flavor::GrblHal] {
        let mut homed = 0;
        for bit in 0..24 {
            let mut line = b"$H\n".to_vec();
            line[bit / 8] ^= 1 << (bit % 8);
            let (model, result, mut grbl) = homed_by(flavor, line.clone());
            let ran = model.lock().unwrap().is_homed();
            assert_eq!(result.is_ok(), grbl.is_homed());
            assert!(ran || result.is_err(), "{flavor:?} {line:?}");
            homed += u32::from(ran);
            if result.is_err() {
                assert!(grbl.start_move(&x(-5.0)).is_err(), "{flavor:?} {line:?}");
                // It recovers.
                grbl.make_safe(false).unwrap();
                grbl.home().unwrap();
            }
        }
        // The control: 'h' is 'H' to the board.
        assert!((1..4).contains(&homed), "{homed} of 24 homed");
    }
}

#[test]
fn an_ok_without_a_homing_cycle_is_told() {
    for (flavor, other, reason) in [
        (
            Flavor::Grbl,
            "$X\n",
            "it answered '[MSG:Caution: Unlocked]' to '$H'",
        ),
        (
            Flavor::Grbl,
            "$I\n",
            "it answered '[VER:1.1h.20190830:]' to '$H'",
        ),
        (Flavor::Grbl, "\n", "state Alarm where Idle was expected"),
        (Flavor::GrblHal, "$X\n", "refused '$H' with error:46"),
        (Flavor::GrblHal, "$G\n", "it answered '[GC:"),
        (Flavor::GrblHal, "\n", "state Alarm where Idle was expected"),
    ] {
        let (_, result, _) = homed_by(flavor, other.into());
        let error = result.unwrap_err().report();
        assert!(error.contains(reason), "{other}: {error}");
    }
    // Unlocked, it stands where it was switched on.
    let (_, _, mut grbl) = behind(Flavor::Grbl, &Unwatched, |bytes| {
        let homes = bytes == b"$H\n";
        if homes {
            b"\n".to_vec()
        } else {
            bytes.to_vec()
        }
    });
    grbl.trust_position().unwrap();
    let error = grbl.home().unwrap_err().report();
    assert!(
        error.contains("axis X stands at 0.0000, not 1 ($27) from an end"),
        "{error}"
    );
}

#[test]
fn an_ok_at_once_from_a_grbl_that_stands_where_it_homed_earlier_is_told() {
    let mut count = 0;
    let (_, _, mut grbl) = behind(Flavor::Grbl, &Unwatched, move |bytes| {
        count += u32::from(bytes == b"$H\n");
        if bytes == b"$H\n" && count == 2 {
            b"$X\n".to_vec()
        } else {
            bytes.to_vec()
        }
    });
    grbl.home().unwrap();
    let error = grbl.home().unwrap_err().report();
    assert!(error.contains("no homing cycle has run"), "{error}");
    assert!(!grbl.is_homed());
    // The control: the third is whole.
    grbl.make_safe(false).unwrap();
    grbl.home().unwrap();
    assert!(grbl.is_homed());
}

/// Where the X axis is now.
fn place(model: &SharedModel, clock: &VirtualClock) -> f64 {
    let mut model = model.lock().unwrap();
    model.receive(b"", clock.now());
    model.position()[0]
}

#[test]
fn a_lost_hold_is_sent_again() {
    for flavor in [Flavor::Grbl, Flavor::GrblHal] {
        let mut lost = false;
        let (clock, model, mut grbl) = behind(flavor, &Unwatched, move |bytes| {
            if bytes == b"!" && !std::mem::replace(&mut lost, true) {
                Vec::new()
            } else {
                bytes.to_vec()
            }
        });
        grbl.home().unwrap();
        grbl.start_move(&x(-300.0)).unwrap();
        clock.sleep(1.0);
        let (start, from) = (clock.now(), place(&model, &clock));
        grbl.brake();
        let done = grbl.make_safe(false).unwrap();
        assert!(done.contains("position kept"), "{done}");
        let way = from - place(&model, &clock);
        assert!((0.0..2.0).contains(&way), "{flavor:?}: it went on by {way}");
        // Half a second, and the reset after it.
        assert!(clock.now() - start < 0.8, "{}", clock.now() - start);
    }
}

/// A request to stop at once.
struct Now(AtomicBool);

impl Watch for Now {
    fn progress(&self, _: &str, _: u64, _: u64) {}
    fn cancelled(&self) -> bool {
        self.urgent()
    }
    fn urgent(&self) -> bool {
        self.0.load(Ordering::SeqCst)
    }
}

#[test]
fn a_stop_in_the_first_move_after_a_stop_brakes_too() {
    for flavor in [Flavor::Grbl, Flavor::GrblHal] {
        let now: &'static Now = Box::leak(Box::new(Now(AtomicBool::new(false))));
        let mut moves = 0;
        let (clock, model, mut grbl) = behind(flavor, now, move |bytes| {
            moves += u32::from(bytes.starts_with(b"G21"));
            // While the second move line is on its way.
            now.0.fetch_or(moves == 2, Ordering::SeqCst);
            bytes.to_vec()
        });
        grbl.home().unwrap();
        grbl.start_move(&x(-300.0)).unwrap();
        clock.sleep(1.0);
        grbl.make_safe(false).unwrap();
        assert!(grbl.start_move(&x(-300.0)).is_err());
        let (start, from) = (clock.now(), place(&model, &clock));
        grbl.brake();
        grbl.make_safe(false).unwrap();
        let way = from - place(&model, &clock);
        assert!((0.0..2.0).contains(&way), "{flavor:?}: it went on by {way}");
        assert!(clock.now() - start < 0.8, "{}", clock.now() - start);
    }
}

#[test]
fn a_lamp_left_on_is_off_after_connecting() {
    for flavor in [Flavor::Grbl, Flavor::GrblHal] {
        for lit in [true, false] {
            let clock = Arc::new(VirtualClock::new());
            let mut options = ModelOptions::rig(flavor);
            options.settings.extend([(22, 0.0), (20, 0.0)]);
            let model: SharedModel = Arc::new(Mutex::new(GrblModel::new(options)));
            clock.advance_to(6.0);
            {
                let mut model = model.lock().unwrap();
                model.take_output(5.0);
                model.receive(if lit { b"M4S900\n" } else { b"M5S900\n" }, 5.0);
                model.take_output(6.0);
                assert_eq!(model.spindle_on(), lit);
            }
            let cable = Box::new(ModelTransport::new(model.clone(), clock.clone()));
            let mut grbl = Grbl::connect("main", cable, clock, &Unwatched).unwrap();
            assert!(!model.lock().unwrap().spindle_on());
            let notes = grbl.take_notes().join("\n");
            assert_eq!(notes.contains("its lamp was on: switched off"), lit);
        }
    }
}

// -- two boards ---------------------------------------------------------------------------------------------------------

type Boards = (Arc<VirtualClock>, BTreeMap<String, SharedModel>);

fn two_boards(fault: Option<Fault>) -> (RigDescription, Boards) {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let rig = RigDescription::read(&root.join("rig_configs/two_board_grbl.toml")).unwrap();
    let models = rig.boards.iter().map(|b| {
        let mut options = goniofit::rig::simulated::model_options(&rig, b);
        if b.name == "light" {
            options.faults.extend(fault);
        }
        let model = Arc::new(Mutex::new(GrblModel::new(options)));
        (b.name.clone(), model as SharedModel)
    });
    let models = models.collect();
    (rig, (Arc::new(VirtualClock::new()), models))
}

fn connection((clock, models): &Boards) -> Connection<'static> {
    let (models, clock) = (models.clone(), clock.clone());
    let time = clock.clone();
    Connection {
        open: Box::new(move |port| {
            let model = models[&port.name].clone();
            Ok(Box::new(ModelTransport::new(model, time.clone())) as Box<dyn Transport>)
        }),
        clock,
        wait_scale: 1.0,
    }
}

#[test]
fn a_fault_of_one_board_is_noticed_while_another_is_on_its_way() {
    // The second move of the light's board: its digit arrives wrong, or its alarm comes halfway of a short way.
    for (kind, reason) in [
        (
            FaultKind::CorruptDigit('2'),
            "board 'light': axis X stands at",
        ),
        (FaultKind::Alarm(1), "board 'light': ALARM:1"),
    ] {
        let (description, boards) = two_boards(Some(Fault { on_move: 2, kind }));
        let mut connection = connection(&boards);
        let mut rig = Rig::connect(&description, &mut connection, &Unwatched).unwrap();
        rig.home(&mut |_| Ok(())).unwrap();
        rig.move_to(&AxisAngles([0.0, -90.0, 5.0, 0.0, 0.0]))
            .unwrap();
        let start = boards.0.now();
        let halt = rig
            .move_to(&AxisAngles([0.0, 90.0, 5.0, 1.0, 0.0]))
            .unwrap_err();
        let Halt::Failed(error) = halt else {
            panic!("{halt:?}")
        };
        assert!(error.report().contains(reason), "{}", error.report());
        let seconds = boards.0.now() - start;
        assert!(seconds < 0.5, "{reason}: noticed after {seconds}");
        for line in rig.make_safe(false) {
            assert!(!line.is_empty());
        }
        assert!(boards.1.values().all(|m| !m.lock().unwrap().is_moving()));
    }
    // The control.
    let (description, boards) = two_boards(None);
    let mut connection = connection(&boards);
    let mut rig = Rig::connect(&description, &mut connection, &Unwatched).unwrap();
    rig.home(&mut |_| Ok(())).unwrap();
    rig.move_to(&AxisAngles([0.0, -90.0, 5.0, 0.0, 0.0]))
        .unwrap();
    let start = boards.0.now();
    rig.move_to(&AxisAngles([0.0, 90.0, 5.0, 1.0, 0.0]))
        .unwrap();
    assert!(boards.0.now() - start > 2.0);
}

/// What was sent: when, to which board, which bytes.
type Wire = Arc<Mutex<Vec<(f64, String, Vec<u8>)>>>;

/// Keeps what is sent, with its time; a deaf one lets nothing through.
struct Tapped {
    inner: ModelTransport,
    clock: Arc<VirtualClock>,
    board: String,
    wire: Wire,
    deaf: bool,
}

impl Transport for Tapped {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        let entry = (self.clock.now(), self.board.clone(), bytes.to_vec());
        self.wire.lock().unwrap().push(entry);
        if self.deaf {
            return Ok(());
        }
        self.inner.write(bytes)
    }
    fn read(&mut self, buffer: &mut [u8], timeout: f64) -> io::Result<usize> {
        self.inner.read(buffer, timeout)
    }
}

#[test]
fn a_stop_from_outside_reaches_every_board_before_any_is_listened_to() {
    for deaf in [true, false] {
        let (description, (clock, models)) = two_boards(None);
        for model in models.values() {
            let mut model = model.lock().unwrap();
            model.take_output(2.0);
            model.receive(b"$X\nM3S500\nG1X-300F3000\n", 2.0);
            model.take_output(3.0);
            assert!(model.is_moving());
        }
        clock.advance_to(3.0);
        let wire = Wire::default();
        let (time, sent, boards) = (clock.clone(), wire.clone(), models.clone());
        let mut connection = Connection {
            open: Box::new(move |port| {
                Ok(Box::new(Tapped {
                    inner: ModelTransport::new(boards[&port.name].clone(), time.clone()),
                    clock: time.clone(),
                    board: port.name.clone(),
                    wire: sent.clone(),
                    deaf: deaf && port.name == "camera",
                }) as Box<dyn Transport>)
            }),
            clock: clock.clone(),
            wait_scale: 1.0,
        };
        let done = stop_all(&description, &mut connection, &Unwatched);
        let first = |name: &str, n: usize| {
            let wire = wire.lock().unwrap();
            let mut of = wire.iter().filter(|(_, board, _)| board == name);
            of.nth(n).cloned().unwrap()
        };
        for name in ["camera", "light"] {
            assert_eq!(first(name, 0), (3.0, name.to_owned(), b"?!".to_vec()));
            let outcome = &done.iter().find(|s| s.device == name).unwrap().outcome;
            assert_eq!(outcome.is_ok(), !(deaf && name == "camera"), "{outcome:?}");
        }
        assert!(!models["light"].lock().unwrap().is_moving());
        assert!(!models["light"].lock().unwrap().spindle_on());
        if deaf {
            // The silent one is reset after a moment.
            let (t, _, bytes) = first("camera", 1);
            assert_eq!(bytes, b"\x18");
            assert!((0.3..0.5).contains(&(t - 3.0)), "{t}");
        }
    }
}
