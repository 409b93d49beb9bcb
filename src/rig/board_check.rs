//! What a board says of itself against what the rig file expects of it.

use super::description::{Board, Homing, RigDescription};
use super::grbl::Grbl;
use crate::base::{Error, Result};

/// Compares what a board says of itself with what the description expects of it.
pub(super) fn check_settings(
    description: &RigDescription,
    board: &Board,
    grbl: &Grbl,
) -> Result<()> {
    let name = &board.name;
    let setting = |n: u16| {
        grbl.settings().get(&n).copied().ok_or_else(|| {
            Error::new(format!("board '{name}' does not report ${n}"))
                .with_hint("the firmware must be Grbl 1.1 or grblHAL, and the cable free of noise")
        })
    };
    if setting(13)? != 0.0 {
        return Err(Error::new(format!(
            "board '{name}' reports inches ($13={})",
            setting(13)?
        ))
        .with_hint("send $13=0"));
    }
    if description.lamp.board == *name {
        grbl.check_lamp_settings(description.lamp.power_s)?;
    }
    if board.homing == Homing::Cycle && setting(22)? <= 0.0 {
        return Err(Error::new(format!(
            "board '{name}' shall be homed with $H but has homing switched off ($22=0)"
        ))
        .with_hint("send $22=1, or set homing = \"by_hand\" in the rig file"));
    }
    if setting(20)? > 0.0 {
        for (axis, motor) in description.motors_of(name) {
            let index = "XYZABC".find(motor.letter).unwrap_or(0);
            let travel = setting(130 + index as u16)?;
            let ends = [motor.units(motor.min_deg), motor.units(motor.max_deg)];
            // Stock Grbl (no Z among its build options) has its machine space below zero; grblHAL may put it elsewhere.
            let stock = !grbl.firmware().contains("HAL")
                && !grbl.options().split(',').next().unwrap_or("").contains('Z');
            let fits = if stock {
                ends.iter().all(|e| (-travel..=0.0).contains(e))
            } else {
                (ends[0] - ends[1]).abs() <= travel
            };
            if !fits {
                return Err(Error::new(format!(
                    "axis {}: limits {} to {} degrees are machine positions {} to {} of board '{name}', whose soft limits allow {} to 0",
                    axis.name(), motor.min_deg, motor.max_deg, ends[0], ends[1], -travel
                ))
                .with_hint(format!(
                    "correct offset_deg, sign or the limits in the rig file, or the travel ${} on the board",
                    130 + index
                )));
            }
        }
    }
    Ok(())
}
