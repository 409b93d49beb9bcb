//! Promise: noise on the wire is asked about again where that does no harm, a bounded number of times and with its
//! reason; anything else is a fault.
//!
//! Strict transcripts, one for each kind of question.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use goniofit::base::Unwatched;
use goniofit::rig::{Grbl, Light, Motion, Replay, Target, Way, WireEntry, parse_wire_log};
use std::path::PathBuf;

fn x(units: f64) -> [Target; 1] {
    [Target {
        letter: 'X',
        units,
        tolerance: 0.02,
        speed: 10.0,
    }]
}

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
const HOME: &str = "<<Idle|MPos:-1.000,-1.000,-1.000|FS:0,0>\r\n";
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
        HOME,
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
    let home = [">$H\n", "<ok\r\n", ">?", HOME, ">M5\n", "<ok\r\n"];
    let (replay, mut grbl) = trusted(&[&home[..], &[">?", lost]].concat());
    grbl.home().unwrap();
    let error = grbl.verify_at(&x(-1.0)).unwrap_err().report();
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
