//! What warning flags and rejections mean, and what to do.

/// What a flag does to what is known of an axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Effect {
    /// Nothing that matters here.
    Harmless,
    /// A move was cut short; harmless unless one is under way.
    Interrupted,
    /// The axis is in trouble; its position still counts.
    Trouble,
    /// The position no longer counts.
    PositionLost,
    /// Not homed since it was switched on.
    NotHomed,
}

/// A flag's effect, its meaning, and the action it calls for.
pub(super) fn meaning(flag: &str) -> (Effect, &'static str, &'static str) {
    use Effect::{Harmless, Interrupted, NotHomed, PositionLost, Trouble};
    match flag {
        "FF" => (
            PositionLost,
            "critical system error",
            "power-cycle it; when it stays so, ask its maker",
        ),
        "FN" => (
            PositionLost,
            "the stage plugged in is not supported",
            "plug in a stage the controller knows",
        ),
        "FZ" => (
            PositionLost,
            "the stage plugged in is inactive",
            "send it 'activate' with the maker's program",
        ),
        "FH" => (
            PositionLost,
            "the emergency stop is pressed, drivers off",
            "release it when it is safe, send 'driver enable', then home again",
        ),
        "FV" => (
            PositionLost,
            "supply voltage out of range, driver off",
            "check the power supply, then home again",
        ),
        "FO" => (
            PositionLost,
            "the driver is switched off",
            "send 'driver enable' with the maker's program, then home again",
        ),
        "FC" => (
            PositionLost,
            "current inrush error, driver off",
            "check motor cable and supply, then home again",
        ),
        "FM" => (
            PositionLost,
            "the motor is too hot, driver off",
            "let it cool, lower the load, then home again",
        ),
        "FD" => (
            PositionLost,
            "the driver disabled itself, mostly from heat or voltage",
            "let it cool, check the supply, then home again",
        ),
        "FQ" => (
            PositionLost,
            "encoder error",
            "check the stage's cable; its position cannot be trusted",
        ),
        "FI" => (
            PositionLost,
            "index error of the encoder",
            "home again; when it stays so, ask its maker",
        ),
        "FA" => (
            PositionLost,
            "the analog encoder lost its signal",
            "check the stage's cable, then home again",
        ),
        "FR" => (
            PositionLost,
            "the motor was overloaded for too long",
            "look what holds the axis, then home again",
        ),
        "FS" => (
            PositionLost,
            "the axis stalled and stopped",
            "look what it touched, free it by hand, then home again",
        ),
        "FB" => (
            Trouble,
            "a stream left its bounds",
            "is another program using the controller?",
        ),
        "FP" => (
            PositionLost,
            "the axis left its path",
            "look what holds it, then home again",
        ),
        "FE" => (
            PositionLost,
            "a limit sensor stopped the axis",
            "compare the limits in the rig file with limit.min and limit.max, then home again",
        ),
        "FT" => (
            PositionLost,
            "the axes of a lockstep group twisted",
            "free them by hand, then home again",
        ),
        "WL" => (
            PositionLost,
            "a limit sensor triggered where none was expected",
            "look what the axis touched, then home again",
        ),
        "WV" => (
            Trouble,
            "supply voltage out of range",
            "check the power supply",
        ),
        "WT" => (
            Trouble,
            "the controller is hot",
            "let it cool, give it air, then start again",
        ),
        "WM" => (
            PositionLost,
            "the axis was displaced while it stood",
            "find out what moved it, then home again",
        ),
        "WS" => (
            PositionLost,
            "the axis stalled and went on",
            "look what holds it back, then home again",
        ),
        "WP" => (
            Trouble,
            "the calibration does not fit the stage",
            "remove the calibration, or install the stage's own",
        ),
        "WR" => (
            NotHomed,
            "no reference position",
            "home the rig before moving it",
        ),
        "WH" => (
            NotHomed,
            "not homed since it was switched on",
            "home the rig before moving it",
        ),
        "NC" => (
            Trouble,
            "somebody turns its knob",
            "hands off the knobs: disable them with knob.enable 0",
        ),
        "NI" => (
            Interrupted,
            "its move was interrupted",
            "is a key, a joystick or another program stopping it?",
        ),
        "NJ" => (
            Trouble,
            "a joystick is being calibrated",
            "finish the calibration first",
        ),
        "NB" => (PositionLost, "firmware update mode", "power-cycle it"),
        _ if flag.starts_with('N') => (Harmless, "a note", ""),
        _ => (
            PositionLost,
            "a flag this program does not know",
            "look it up in the maker's protocol manual, then home again",
        ),
    }
}

/// What a rejection's reason means, and the action it calls for.
pub(super) fn rejection(reason: &str) -> (&'static str, &'static str) {
    match reason {
        "AGAIN" => ("it cannot do this right now", "start again"),
        "BADAXIS" => (
            "it has no such axis",
            "correct the axis numbers (letter) in the rig file",
        ),
        "BADCOMMAND" => (
            "it does not know the command",
            "is its firmware 6.06 or newer?",
        ),
        "BADDATA" => (
            "a value is out of its range",
            "compare limit.min, limit.max and maxspeed with the rig file",
        ),
        "DRIVERDISABLED" => (
            "its motor driver is disabled",
            "find out why, send 'driver enable', then home again",
        ),
        "FULL" => ("its memory is full", "power-cycle it"),
        "LOCKSTEP" => (
            "the axis is locked to another",
            "dissolve the lockstep group with the maker's program",
        ),
        "NOACCESS" => (
            "it allows this to advanced users only",
            "send 'set system.access 1'",
        ),
        "PARKED" => ("the axis is parked", "send 'tools parking unpark'"),
        "STATUSBUSY" => ("it is moving", "wait until nothing moves, then start again"),
        _ => (
            "see the maker's protocol manual",
            "look the reason up there",
        ),
    }
}
