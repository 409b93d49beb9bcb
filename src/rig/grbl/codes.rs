//! What `error:n` and `ALARM:n` mean, and what to do.

/// Meaning of an error number and the action it calls for.
pub(super) fn error_meaning(number: u8) -> (&'static str, &'static str) {
    match number {
        1 | 2 | 3 => (
            "the controller did not understand the line",
            "is the firmware Grbl 1.1 or grblHAL, and the cable free of noise?",
        ),
        5 => (
            "homing is not enabled",
            "fit limit switches and set $22=1, or set the board's homing = \"by_hand\" in the rig file",
        ),
        7 => (
            "the controller's settings memory was blank or damaged",
            "restore its settings ($100.. $132, $22, $30), then power-cycle it",
        ),
        8 => (
            "the command needs an idle controller",
            "wait until nothing moves; press the board's reset when it stays so",
        ),
        9 => (
            "the controller is locked by an alarm",
            "home the rig before moving it",
        ),
        10 => ("soft limits need homing", "set $22=1 before $20=1"),
        11 => (
            "the line was too long",
            "report this as a fault of the program",
        ),
        15 => (
            "the jog target is outside the controller's travel",
            "compare $130.. with the limits in the rig file",
        ),
        17 => (
            "laser mode needs a PWM output",
            "set $32=0: with laser mode on, a standing lamp goes dark",
        ),
        20 => (
            "the controller does not know this command or axis",
            "does the board have the axis letters the rig file gives it?",
        ),
        22 => ("no feed rate", "set feed_deg_per_min in the rig file"),
        46 => (
            "homing is required before unlocking",
            "home the rig ($H); unlocking is not enough",
        ),
        _ => (
            "see the firmware's list of errors",
            "look the number up in the firmware's documentation",
        ),
    }
}

/// Meaning of an alarm number and the action it calls for.
pub(super) fn alarm_meaning(number: u8) -> (&'static str, &'static str) {
    match number {
        1 => (
            "a limit switch was hit; the position is lost",
            "look what the axis touched, free it by hand, then home again",
        ),
        2 => (
            "the target was outside the controller's travel",
            "compare the limits in the rig file with $130.. and the homing position, then home again",
        ),
        3 => (
            "the controller was reset while moving; steps are lost",
            "home again before moving",
        ),
        4 | 5 => (
            "probing failed",
            "this program never probes: is another program using the board?",
        ),
        6 => ("homing was interrupted by a reset", "home again"),
        7 => (
            "homing was interrupted by the safety door",
            "close the door and home again",
        ),
        8 => (
            "homing could not leave a limit switch",
            "is a switch stuck or miswired? raise the pull-off $27",
        ),
        9 => (
            "homing found no limit switch",
            "are the switches wired, the directions ($23) right and the travel ($130..) large enough?",
        ),
        10 => (
            "the emergency stop is pressed",
            "release it when it is safe, then home again",
        ),
        11 => ("homing is required", "home the rig ($H)"),
        _ => (
            "see the firmware's list of alarms",
            "look the number up in the firmware's documentation, then home again",
        ),
    }
}
