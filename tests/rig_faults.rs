//! Promise: whatever is wrong with a controller, no move claims success without the axes standing there.
//!
//! One named test for each fault of the controller model, in process on a virtual clock; and controllers that lie.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use goniofit::base::{Result, Unwatched};
use goniofit::rig::{
    Clock, Fault, FaultKind, Flavor, Grbl, GrblModel, ModelOptions, ModelTransport, Motion,
    SharedModel, Target, Transport, VirtualClock,
};
use std::io;
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
