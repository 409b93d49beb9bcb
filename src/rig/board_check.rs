//! What a controller says of itself against what the rig file expects of it.

use super::description::{Board, RigDescription};
use super::devices::{Motion, Travel};
use crate::base::{Error, Result};

/// Compares what a controller says of itself with what the description expects of it.
pub(super) fn check_settings(
    description: &RigDescription,
    board: &Board,
    motion: &mut dyn Motion,
) -> Result<()> {
    let name = &board.name;
    motion.check(board.homing)?;
    if description.lamp.board() == Some(name) {
        let lamp = motion.lamp().ok_or_else(|| {
            Error::new(format!("board '{name}' has no lamp output"))
                .with_hint("name another board in [lamp], or a current source with scpi_port")
        })?;
        lamp.check(description.lamp.power())?;
    }
    for (axis, motor) in description.motors_of(name) {
        let limits = motion.axis_limits(motor.letter)?;
        let ends = [motor.units(motor.min_deg), motor.units(motor.max_deg)];
        let (fits, allowed) = match limits.travel {
            None => (true, String::new()),
            Some(Travel::Between([low, high])) => (
                ends.iter().all(|e| (low..=high).contains(e)),
                format!("{low} to {high}"),
            ),
            Some(Travel::Length(length)) => (
                (ends[0] - ends[1]).abs() <= length,
                format!("a travel of {length}"),
            ),
        };
        if !fits {
            return Err(Error::new(format!(
                "axis {}: limits {} to {} degrees are machine positions {} to {} of board '{name}', whose soft limits allow {allowed}",
                axis.name(), motor.min_deg, motor.max_deg, ends[0], ends[1]
            ))
            .with_hint("correct offset_deg, sign or the limits in the rig file, or the travel on the board"));
        }
    }
    Ok(())
}
