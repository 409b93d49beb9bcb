//! Promise: the driver understands what real controllers said, and the controller model says the same.
//!
//! `tests/data/wire` holds excerpts of dialogues recorded with two controllers; every replay is strict and used up.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use goniofit::base::Unwatched;
use goniofit::rig::{
    Flavor, Grbl, GrblModel, Homing, Light, ModelOptions, Motion, Replay, Way, WireEntry,
    parse_wire_log, show_bytes,
};
use std::path::PathBuf;

fn recorded(name: &str) -> Vec<WireEntry> {
    let path =
        PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(format!("tests/data/wire/{name}.jsonl"));
    parse_wire_log(&std::fs::read_to_string(path).unwrap()).unwrap()
}

fn connected(name: &str) -> (Replay, Grbl<'static>) {
    let replay = Replay::new(recorded(name));
    let grbl = Grbl::connect(
        "main",
        Box::new(replay.transport("main")),
        replay.clock(),
        &Unwatched,
    )
    .unwrap();
    (replay, grbl)
}

#[test]
fn start_up_text_is_not_a_reply_and_settings_are_read_back() {
    let (replay, grbl) = connected("grbl_connect");
    replay.finish().unwrap();
    assert_eq!(grbl.firmware(), "Grbl 1.1h.20190830: options V,15,128");
    assert_eq!(grbl.settings()[&30], 1000.0);
    assert_eq!(grbl.settings()[&132], 200.0);
    assert!(!grbl.is_homed());

    let (replay, mut grbl) = connected("grblhal_connect");
    replay.finish().unwrap();
    assert!(
        grbl.firmware().starts_with("grblHAL 1.1f"),
        "{}",
        grbl.firmware()
    );
    assert_eq!(grbl.settings()[&134], 200.0);
    Light::check(&mut grbl, 1000.0).unwrap();
    assert!(Light::check(&mut grbl, 1001.0).is_err());
    assert!(Light::check(&mut grbl, f64::NAN).is_err());
}

#[test]
fn a_controlled_stop_waits_for_hold_0_and_keeps_the_position() {
    let (replay, mut grbl) = connected("grblhal_controlled_stop");
    let report = grbl.controlled_stop().unwrap();
    assert!(report.position_kept, "{report}");
    assert_eq!(report.state.as_deref(), Some("Idle"));
    replay.finish().unwrap();
}

#[test]
fn a_sticky_error_is_told_and_cleared_with_an_empty_line() {
    let (replay, mut grbl) = connected("grblhal_refused");
    let error = grbl.command("G90").unwrap_err().report();
    assert!(
        error.contains("refused 'G90' with error:2") && error.contains("hint:"),
        "{error}"
    );
    grbl.command("G21").unwrap();
    replay.finish().unwrap();
}

#[test]
fn silence_after_a_critical_alarm_is_ended_by_a_reset_and_the_late_ok_is_void() {
    let (replay, mut grbl) = connected("grbl_silent_alarm");
    let error = grbl.command("G0X-500").unwrap_err().report();
    assert!(
        error.contains("ALARM:2") && error.contains("outside the controller's travel"),
        "{error}"
    );
    let report = grbl.controlled_stop().unwrap();
    assert!(!report.position_kept);
    assert_eq!(report.state.as_deref(), Some("Alarm"));
    replay.finish().unwrap();
}

#[test]
fn an_ok_after_failed_homing_is_no_success() {
    let (replay, mut grbl) = connected("grbl_failed_homing");
    let error = grbl.home().unwrap_err().report();
    assert!(
        error.contains("ALARM:8") && error.contains("limit switch"),
        "{error}"
    );
    assert!(!grbl.is_homed());
    assert!(!grbl.controlled_stop().unwrap().position_kept);
    replay.finish().unwrap();
}

#[test]
fn a_hold_that_never_completes_is_reset_and_the_position_is_not_trusted() {
    let (replay, mut grbl) = connected("grblhal_stuck_hold");
    let report = grbl.controlled_stop().unwrap();
    assert!(!report.position_kept, "{report}");
    assert_eq!(report.state.as_deref(), Some("Idle"));
    replay.finish().unwrap();
}

#[test]
fn homing_that_finds_no_switch_is_told_and_no_ok_is_needed_for_it() {
    let (replay, mut grbl) = connected("grblhal_no_switch");
    Motion::check(&grbl, Homing::Cycle).unwrap();
    assert_eq!(grbl.state().unwrap(), "Idle");
    let error = grbl.home().unwrap_err().report();
    assert!(
        error.contains("ALARM:9") && error.contains("found no limit switch"),
        "{error}"
    );
    let done = grbl.make_safe(false).unwrap();
    assert!(done.contains("home before moving"), "{done}");
    assert_eq!(grbl.state().unwrap(), "Alarm");
    grbl.trust_position().unwrap();
    // The full report says H:0, which is no news for a position taken on the operator's word.
    grbl.verify_at(&[]).unwrap();
    assert!(grbl.take_notes().is_empty());
    replay.finish().unwrap();
}

#[test]
fn a_replay_shows_where_the_dialogue_diverges_and_what_was_not_used() {
    let (replay, mut grbl) = connected("grblhal_refused");
    let error = grbl.command("G91").unwrap_err().report();
    assert!(
        error.contains("byte 3: expected to board 'main'")
            && error.contains("'G90\\n', board 'main' was sent 'G91\\n'"),
        "{error}"
    );
    assert!(
        replay
            .finish()
            .unwrap_err()
            .report()
            .contains("replay diverged at entry")
    );

    let (replay, grbl) = connected("grblhal_refused");
    drop(grbl);
    let error = replay.finish().unwrap_err().report();
    assert!(
        error.contains("replay ended early: entry") && error.contains("'G90\\n'"),
        "{error}"
    );
}

/// Plays the host's bytes of a recording into a model and compares what it says with what the controller said.
fn model_says_the_same(name: &str, options: ModelOptions) {
    let entries = recorded(name);
    let mut model = GrblModel::new(options);
    let (mut expected, mut found) = (Vec::new(), Vec::new());
    for (i, entry) in entries.iter().enumerate() {
        match entry.way {
            Way::FromBoard => expected.extend(&entry.bytes),
            Way::ToBoard => {
                found.extend(model.take_output(entry.t));
                assert_eq!(
                    show_bytes(&found),
                    show_bytes(&expected),
                    "{name}: before entry {}, {}",
                    i + 1,
                    show_bytes(&entry.bytes)
                );
                found.clear();
                expected.clear();
                model.receive(&entry.bytes, entry.t);
            }
        }
    }
    found.extend(model.take_output(entries.last().unwrap().t + 1.0));
    assert_eq!(show_bytes(&found), show_bytes(&expected), "{name}: end");
}

fn as_recorded(flavor: Flavor) -> ModelOptions {
    let pins = if flavor == Flavor::Grbl {
        "PXYZRHS"
    } else {
        ""
    };
    ModelOptions {
        pins: pins.to_owned(),
        ..ModelOptions::factory(flavor)
    }
}

#[test]
fn the_model_answers_as_the_recorded_grbl_did() {
    model_says_the_same("grbl_tour", as_recorded(Flavor::Grbl));
    let locked = ModelOptions {
        blank_eeprom: false,
        settings: vec![(22, 1.0), (20, 1.0)],
        ..as_recorded(Flavor::Grbl)
    };
    model_says_the_same("grbl_lock", locked);
}

#[test]
fn the_model_answers_as_the_recorded_grblhal_did() {
    model_says_the_same("grblhal_tour", as_recorded(Flavor::GrblHal));
    model_says_the_same("grblhal_sticky", as_recorded(Flavor::GrblHal));
}

#[test]
fn a_wrong_model_is_told_apart_from_the_recording() {
    // The negative control of the two tests above.
    let wrong = std::panic::catch_unwind(|| {
        model_says_the_same("grbl_lock", as_recorded(Flavor::Grbl));
    });
    assert!(wrong.is_err());
}
