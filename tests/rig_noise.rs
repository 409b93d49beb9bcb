//! Promise: noise on the wire is asked about again where that does no harm, a bounded number of times and with its
//! reason; nothing it does makes a move claim success without the axes standing there.
//!
//! Strict transcripts for each kind of question, and one named test for each fault of the controller model.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use goniofit::base::{Result, Unwatched};
use goniofit::rig::{
    Clock, Fault, FaultKind, Flavor, Grbl, GrblModel, Light, ModelOptions, ModelTransport, Motion,
    Replay, SharedModel, Target, Transport, VirtualClock, Way, WireEntry, parse_wire_log,
};
use std::io;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};

fn x(units: f64) -> [Target; 1] {
    [Target {
        letter: 'X',
        units,
        tolerance: 0.02,
        speed: 10.0,
    }]
}

// -- strict transcripts -------------------------------------------------------------------------------------------------

fn recorded(name: &str) -> Vec<WireEntry> {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let path = root.join(format!("tests/data/wire/{name}.jsonl"));
    parse_wire_log(&std::fs::read_to_string(path).unwrap()).unwrap()
}

/// A recorded connection, then these bytes 0.02 s apart (`>` to the board, `<` from it, `~` a pause of 5 s).
fn dialogue(pieces: &[&str]) -> Vec<WireEntry> {
    let mut entries = recorded("grbl_connect");
    let mut t = entries.last().unwrap().t;
    for piece in pieces {
        let (way, text) = piece.split_at(1);
        t += 0.02;
        let way = match way {
            ">" => Way::ToBoard,
            "<" => Way::FromBoard,
            _ => {
                t += 5.0;
                continue;
            }
        };
        let bytes = text.chars().map(|c| c as u8).collect();
        let board = "main".to_owned();
        entries.push(WireEntry {
            t,
            board,
            way,
            bytes,
        });
    }
    entries
}

const MOVE: &str = ">G21G90G94G53G1X10.0000F600.0\n";
const IDLE: &str = "<<Idle|MPos:0.000,0.000,0.000|FS:0,0>\r\n";
const THERE: &str = "<<Idle|MPos:10.000,0.000,0.000|FS:0,0>\r\n";

/// Connects and takes the position as known, over the dialogue that goes on with `pieces`.
fn trusted(pieces: &[&str]) -> (Replay, Grbl<'static>) {
    let mut all = vec![">?", IDLE, ">?", IDLE, ">M5\n", "<ok\r\n"];
    all.extend(pieces);
    let replay = Replay::new(dialogue(&all));
    let wire = Box::new(replay.transport("main"));
    let mut grbl = Grbl::connect("main", wire, replay.clock(), &Unwatched).unwrap();
    grbl.trust_position().unwrap();
    (replay, grbl)
}

fn notes(grbl: &mut Grbl) -> String {
    let notes = grbl.take_notes().join("\n");
    assert!(grbl.take_notes().is_empty(), "taken once");
    notes
}

#[test]
fn a_garbled_ok_of_a_move_is_cleared_up_by_the_position() {
    // At the start: sent again. On the way: waited for. Elsewhere: a fault.
    let begin = [">?", IDLE, MOVE, "<o\u{fe}k\r\n", ">\n", "<ok\r\n", ">?"];
    let run = |rest: &[&str]| {
        let (replay, mut grbl) = trusted(&[&begin[..], rest].concat());
        let result = grbl.start_move(&x(10.0)).map_err(|e| e.report());
        replay.finish().unwrap();
        (result, notes(&mut grbl))
    };
    let (result, note) = run(&[IDLE, MOVE, "<ok\r\n"]);
    assert!(result.is_ok());
    assert_eq!(
        note,
        "board 'main': garbled reply 'o\\xfek' during 'G21G90G94G53G1X10.0000F600.0': state Idle, sent again (1 of 2)"
    );
    let (result, note) = run(&["<<Run|MPos:2.000,0.000,0.000|FS:600,0>\r\n"]);
    assert!(result.is_ok() && note.contains("state Run, the board has taken the line"));
    let (result, _) = run(&["<<Run|MPos:0.000,-2.000,0.000|FS:600,0>\r\n"]);
    let error = result.unwrap_err();
    assert!(
        error.contains("axis Y stands at -2.0000, off its way"),
        "{error}"
    );
    let (result, _) = run(&["<<Idle|MPos:4.000,0.000,0.000|FS:0,0>\r\n"]);
    let error = result.unwrap_err();
    assert!(error.contains("stands still on its way"), "{error}");
}

#[test]
fn a_line_is_sent_again_twice_and_no_more() {
    let again = [MOVE, "<o\u{fe}k\r\n", ">\n", "<ok\r\n", ">?", IDLE];
    let pieces = [&[">?", IDLE][..], &again, &again, &again[..2]].concat();
    let (replay, mut grbl) = trusted(&pieces);
    let error = grbl.start_move(&x(10.0)).unwrap_err().report();
    assert!(error.contains("garbled reply 'o\\xfek'"), "{error}");
    assert!(notes(&mut grbl).contains("(2 of 2)"));
    replay.finish().unwrap();
}

#[test]
fn a_missing_ok_is_cleared_up_by_the_position() {
    let (replay, mut grbl) = trusted(&[
        ">?", IDLE, MOVE, "~", ">\n", "<ok\r\n", ">?", IDLE, MOVE, "<ok\r\n",
    ]);
    grbl.start_move(&x(10.0)).unwrap();
    assert!(notes(&mut grbl).contains("no answer within 3 s"));
    replay.finish().unwrap();
}

#[test]
fn the_answers_to_the_lamp_are_asked_for_again() {
    let state = "<[GC:G0 G54 G17 G21 G90 G94 M3 M9 T0 F0 S500]\r\n";
    let (replay, mut grbl) = trusted(&[
        ">M3S500\n",
        "<okok\r\n",
        ">\n",
        "<ok\r\n",
        ">?",
        IDLE,
        ">M3S500\n",
        "<ok\r\n",
        // The listing comes damaged, then not at all, then whole.
        ">$G\n",
        "<[GC:G0 G5\u{fe}\r\n",
        ">\n",
        "<ok\r\nok\r\n",
        ">?",
        IDLE,
        ">$G\n",
        "<ok\r\n",
        ">\n",
        "<ok\r\n",
        ">?",
        IDLE,
        ">$G\n",
        state,
        "<ok\r\n",
    ]);
    grbl.switch_on(500.0).unwrap();
    let notes = notes(&mut grbl);
    assert!(
        notes.contains("garbled reply 'okok' during 'M3S500'")
            && notes.contains("garbled reply '[GC:G0 G5\\xfe' during '$G'")
            && notes.contains("the answer to '$G' lacks a part"),
        "{notes}"
    );
    replay.finish().unwrap();
}

#[test]
fn a_lamp_line_is_not_sent_again_when_an_axis_has_moved() {
    let moved = "<<Idle|MPos:0.000,3.000,0.000|FS:0,0>\r\n";
    let (replay, mut grbl) = trusted(&[">M3S500\n", "<o\r\n", ">\n", "<ok\r\n", ">?", moved]);
    let error = grbl.switch_on(500.0).unwrap_err().report();
    assert!(
        error.contains("axis Y stands at 3.0000 though it was left at 0.0000"),
        "{error}"
    );
    replay.finish().unwrap();
}

#[test]
fn a_lost_ok_of_the_barrier_is_asked_for_again_at_the_target() {
    let mut pieces = vec![">?", IDLE, MOVE, "<ok\r\n", ">G4P0.01\n", "<o\u{fe}k\r\n"];
    // Idle reports for 2 s, each 0.1 s.
    let polled = 21;
    for _ in 0..polled {
        pieces.extend([">?", THERE]);
    }
    pieces.extend([">?", THERE, ">\n", "<ok\r\n", ">G4P0.01\n", "<ok\r\n"]);
    for _ in 0..3 {
        pieces.extend([">?", THERE]);
    }
    let (replay, mut grbl) = trusted(&pieces);
    grbl.start_move(&x(10.0)).unwrap();
    let found = grbl.finish_move(&x(10.0), 60.0);
    assert_eq!(found.map_err(|e| e.report()), Ok(vec![10.0]));
    let notes = notes(&mut grbl);
    assert!(
        notes.contains("passed over (1 of 2 in a row)") && notes.contains("asked again (1 of 2)"),
        "{notes}"
    );
    replay.finish().unwrap();
}

#[test]
fn garbled_reports_are_asked_for_again_twice() {
    let half = "<<Idle|MPos:0.000,0.0\r\n";
    let (replay, mut grbl) = trusted(&[">?", half, ">?", half, ">?", IDLE]);
    grbl.status().unwrap();
    assert!(notes(&mut grbl).contains("passed over (2 of 2 in a row)"));
    replay.finish().unwrap();
    let (replay, mut grbl) = trusted(&[">?", half, ">?", half, ">?", half]);
    let error = grbl.status().unwrap_err().report();
    assert!(
        error.contains("garbled reply '<Idle|MPos:0.000,0.0'"),
        "{error}"
    );
    replay.finish().unwrap();
}

#[test]
fn a_doubled_ok_is_dropped_and_a_third_is_a_fault() {
    let (replay, mut grbl) = trusted(&[">G90\n", "<ok\r\n", "<ok\r\n", ">?", IDLE]);
    grbl.command("G90").unwrap();
    grbl.status().unwrap();
    assert!(notes(&mut grbl).contains("an 'ok' too many"));
    replay.finish().unwrap();
    let (_replay, mut grbl) = trusted(&[">G90\n", "<ok\r\n", "<ok\r\nok\r\nok\r\n"]);
    grbl.command("G90").unwrap();
    let error = grbl.status().unwrap_err().report();
    assert!(error.contains("a reply nobody waited for"), "{error}");
}

#[test]
fn homing_is_repeated_once_after_a_garbled_answer_and_not_after_an_alarm() {
    let (replay, mut grbl) = trusted(&[
        ">$H\n",
        "<o\u{fe}\r\n",
        ">?",
        IDLE,
        ">\n",
        "<ok\r\n",
        ">$H\n",
        "<ok\r\n",
        ">?",
        IDLE,
        ">M5\n",
        "<ok\r\n",
    ]);
    grbl.home().unwrap();
    assert!(grbl.is_homed() && notes(&mut grbl).contains("homed once more"));
    replay.finish().unwrap();
    let (replay, mut grbl) = trusted(&[">$H\n", "<o\u{fe}\r\n", ">?", "<ALARM:9\r\n", IDLE]);
    let error = grbl.home().unwrap_err().report();
    assert!(
        error.contains("garbled reply") && !grbl.is_homed(),
        "{error}"
    );
    replay.finish().unwrap();
}

#[test]
fn a_damaged_banner_or_alarm_is_never_taken_for_noise() {
    for line in ["<Gr\u{fe}l 1.1h ['$' for help]\r\n", "<ALA\u{fe}M:1\r\n"] {
        let (replay, mut grbl) = trusted(&[">?", IDLE, MOVE, line]);
        let error = grbl.start_move(&x(10.0)).unwrap_err().report();
        assert!(error.contains("garbled reply"), "{error}");
        assert!(grbl.take_notes().is_empty());
        replay.finish().unwrap();
    }
}

#[test]
fn a_grblhal_that_says_it_is_not_homed_any_more_is_believed() {
    let lost = "<<Idle|MPos:0.000,0.000,0.000|FS:0,0|H:0>\r\n";
    let home = [">$H\n", "<ok\r\n", ">?", IDLE, ">M5\n", "<ok\r\n"];
    let (replay, mut grbl) = trusted(&[&home[..], &[">?", lost]].concat());
    grbl.home().unwrap();
    let error = grbl.verify_at(&x(0.0)).unwrap_err().report();
    assert!(error.contains("not homed any more (H:0)"), "{error}");
    replay.finish().unwrap();
    // Homed by the operator's word it never was by its own.
    let (_replay, mut grbl) = trusted(&[">?", lost]);
    grbl.verify_at(&x(0.0)).unwrap();
}

#[test]
fn a_move_that_stops_on_its_way_with_the_state_idle_is_a_fault() {
    let replay = Replay::new(recorded("grbl_starved"));
    let wire = Box::new(replay.transport("main"));
    let mut grbl = Grbl::connect("main", wire, replay.clock(), &Unwatched).unwrap();
    grbl.trust_position().unwrap();
    grbl.positions(&['X', 'Y']).unwrap();
    let targets = [('X', 10.0), ('Y', 0.0)].map(|(letter, units)| Target {
        letter,
        units,
        tolerance: 0.02,
        speed: 8.0,
    });
    grbl.start_move(&targets).unwrap();
    let error = grbl.finish_move(&targets, 60.0).unwrap_err().report();
    assert!(
        error.contains("stands still on its way at [9.276, 0.0, 0.0]"),
        "{error}"
    );
    replay.finish().unwrap();
    assert!(grbl.may_be_moving(), "it is to be made safe");
}

// -- the model's faults, by name ----------------------------------------------------------------------------------------

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
        let notes = notes(&mut self.grbl);
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
