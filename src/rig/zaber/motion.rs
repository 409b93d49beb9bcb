//! Homing, moving with the way watched and the position verified, and stopping.

use super::fault::Fault;
use super::flags::{self, Effect};
use super::{SPEED_SCALE, TRIES, Zaber};
use crate::rig::devices::{Target, Travel};
use crate::rig::obey::Obey;

/// Seconds between two looks at a moving axis.
const POLL: f64 = 0.05;
/// Looks in a row, at rest and in place, that make an arrival.
const STILL: u32 = 3;
/// Seconds an axis may stand short of its target: a controller may say IDLE before it begins to move.
const GRACE: f64 = 1.0;
/// Seconds one axis may take to home.
const HOMING_TIMEOUT: f64 = 180.0;
/// Seconds a stop may take.
const STOP_TIMEOUT: f64 = 15.0;
/// Times a stop is sent.
const STOP_TRIES: u32 = 6;

/// How a stop ended.
struct Stopped {
    at_rest: bool,
    /// No flag says that the position is lost.
    reference_kept: bool,
}

impl Zaber<'_> {
    /// True while something moves, and where all axes are; flags are sorted out.
    fn look(&mut self, during: &str, moving: bool) -> Result<(bool, Vec<Option<i64>>), Fault> {
        let reply = self.link.accepted(0, "get pos", TRIES)?;
        let reply = self.judged(reply, during, moving)?;
        let positions = self.listed("pos", &reply.data)?;
        Ok((reply.busy, positions))
    }

    // -- homing -----------------------------------------------------------------------------------------------------

    pub(super) fn home_all(&mut self) -> Result<(), Fault> {
        for axis in 1..=self.axes.len() as u8 {
            if self.axes[usize::from(axis) - 1].is_some() {
                self.home_axis(axis)?;
            }
        }
        // What happened while it homed is in the past; where it began does not count.
        self.uptime = self.read_uptime()?;
        Ok(())
    }

    fn home_axis(&mut self, axis: u8) -> Result<(), Fault> {
        let during = format!("homing axis {axis}");
        let reply = self.link.accepted(axis, "home", 1)?;
        self.judged(reply, &during, false)?;
        let deadline = self.link.clock.now() + HOMING_TIMEOUT;
        let (mut still, mut unhomed_since) = (0, None);
        loop {
            let reply = self.link.accepted(axis, "get pos", TRIES)?;
            let reply = self.judged(reply, &during, true)?;
            let now = self.link.clock.now();
            still = if reply.busy { 0 } else { still + 1 };
            if reply.busy {
                unhomed_since = None;
            } else if reply.flag.is_some() {
                still = 0;
                let since = *unhomed_since.get_or_insert(now);
                if now - since > GRACE {
                    return Err(Fault::unexpected(
                        format!("axis {axis} came to rest without finding its home sensor"),
                        "look what holds it and whether its sensor is plugged in",
                    ));
                }
            }
            if still >= STILL {
                return self.check_uptime(&during);
            }
            if now > deadline {
                return Err(Fault::unexpected(
                    format!("axis {axis} was still homing after {HOMING_TIMEOUT} s"),
                    "look what holds it and whether its home sensor works",
                ));
            }
            self.link.pause(POLL)?;
        }
    }

    // -- moving -----------------------------------------------------------------------------------------------------

    pub(super) fn start(&mut self, targets: &[Target]) -> Result<(), Fault> {
        let mut lines = Vec::new();
        for target in targets {
            lines.push(self.move_line(target)?);
        }
        let (busy, from) = self.look("the start of a move", false)?;
        if busy {
            return Err(Fault::unexpected(
                "it moves although nothing was sent",
                "is a knob, a joystick or another program moving it?",
            ));
        }
        self.ways = from
            .iter()
            .map(|p| p.map_or([f64::NEG_INFINITY, f64::INFINITY], |p| [p as f64; 2]))
            .collect();
        for (target, (index, ..)) in targets.iter().zip(&lines) {
            let [low, high] = self.ways[*index];
            let slack = target.tolerance.max(1.0);
            self.ways[*index] = [
                low.min(target.units) - slack,
                high.max(target.units) + slack,
            ];
        }
        for (index, text, speed) in lines {
            let axis = index as u8 + 1;
            if !self.moves_with_speed {
                self.set_max_speed(index, speed)?;
            }
            // From here on it may be moving, whatever it answers.
            self.moving = true;
            let reply = self.link.accepted(axis, &text, TRIES)?;
            self.judged(reply, &format!("'{text}'"), false)?;
        }
        Ok(())
    }

    /// Axis, command and speed setting of a move.
    fn move_line(&self, target: &Target) -> Result<(usize, String, i64), Fault> {
        let (index, facts) = self.axis(target.letter)?;
        let units = target.units.round();
        let speed = (target.speed * SPEED_SCALE).floor();
        let speed = speed.min((facts.limits.max_speed * SPEED_SCALE).round());
        if !(units.abs() < 1e15 && (1.0..1e15).contains(&speed)) {
            return Err(Fault::unexpected(
                format!("a move to {target:?} makes no sense"),
                "correct degrees_per_unit, offset_deg and the speed in the rig file",
            ));
        }
        if (units - target.units).abs() > target.tolerance {
            return Err(Fault::unexpected(
                format!(
                    "{:.3} microsteps lie more than the tolerance of {:.3} from a whole number",
                    target.units, target.tolerance
                ),
                "raise tolerance_deg above half a microstep, or correct degrees_per_unit",
            ));
        }
        if let Some(Travel::Between([low, high])) = facts.limits.travel
            && !(low..=high).contains(&units)
        {
            return Err(Fault::unexpected(
                format!(
                    "axis {}: {units} is outside limit.min {low} to limit.max {high}",
                    target.letter
                ),
                "correct the limits in the rig file, or those of the controller",
            ));
        }
        let text = if self.moves_with_speed {
            format!("move abs {units:.0} {speed:.0}")
        } else {
            format!("move abs {units:.0}")
        };
        Ok((index, text, speed as i64))
    }

    /// Sets an axis' `maxspeed` and reads it back, unless it is so; for firmware whose moves take no speed.
    fn set_max_speed(&mut self, index: usize, speed: i64) -> Result<(), Fault> {
        let axis = index as u8 + 1;
        let Some(facts) = self.axes[index].filter(|f| f.max_speed_setting != speed) else {
            return Ok(());
        };
        self.link
            .accepted(axis, &format!("set maxspeed {speed}"), TRIES)?;
        let found = self.link.accepted(axis, "get maxspeed", TRIES)?.data;
        if found.parse() != Ok(speed) {
            return Err(Fault::unexpected(
                format!("axis {axis}: maxspeed is '{found}' after it was set to {speed}"),
                "lower the speed in the rig file",
            ));
        }
        self.axes[index] = Some(super::AxisFacts {
            max_speed_setting: speed,
            ..facts
        });
        Ok(())
    }

    pub(super) fn finish(&mut self, targets: &[Target], timeout: f64) -> Result<Vec<f64>, Fault> {
        let deadline = self.link.clock.now() + timeout;
        let (mut still, mut short_since) = (0, None);
        loop {
            let (busy, positions) = self.look_at_ways()?;
            let now = self.link.clock.now();
            let arrived = self.in_place(targets, &positions);
            match &arrived {
                _ if busy => (still, short_since) = (0, None),
                Ok(_) => still += 1,
                Err(_) => still = 0,
            }
            if still >= STILL {
                self.check_uptime("a move")?;
                return arrived;
            }
            if !busy && arrived.is_err() {
                let since = *short_since.get_or_insert(now);
                if now - since > GRACE {
                    return arrived;
                }
            }
            if now > deadline {
                return Err(Fault::unexpected(
                    format!("the move did not end within {timeout:.0} s"),
                    "look what holds the axis; compare maxspeed and accel with the rig file",
                ));
            }
            self.link.pause(POLL)?;
        }
    }

    /// One look at a move; true when nothing moves.
    pub(super) fn glance(&mut self) -> Result<bool, Fault> {
        Ok(!self.look_at_ways()?.0)
    }

    fn look_at_ways(&mut self) -> Result<(bool, Vec<Option<i64>>), Fault> {
        let (busy, positions) = self.look("a move", true)?;
        self.check_ways(&positions)?;
        Ok((busy, positions))
    }

    /// Fails when an axis is not between where it was and where it was sent.
    fn check_ways(&self, positions: &[Option<i64>]) -> Result<(), Fault> {
        for (i, (position, [low, high])) in positions.iter().zip(&self.ways).enumerate() {
            if let Some(at) = position.map(|p| p as f64)
                && !(low - 1.0..=high + 1.0).contains(&at)
            {
                return Err(Fault::unexpected(
                    format!(
                        "axis {} is at {at}, off its way between {low:.0} and {high:.0}",
                        i + 1
                    ),
                    "is a knob or another program moving it? check for noise on the cable, then home again",
                ));
            }
        }
        Ok(())
    }

    /// The positions of these axes, when they are where they were sent.
    fn in_place(&self, targets: &[Target], positions: &[Option<i64>]) -> Result<Vec<f64>, Fault> {
        targets
            .iter()
            .map(|t| {
                let found = positions[self.axis(t.letter)?.0].map_or(f64::NAN, |p| p as f64);
                if (found - t.units).abs() <= t.tolerance {
                    return Ok(found);
                }
                Err(Fault::unexpected(
                    format!(
                        "axis {} stands at {found}, expected {:.1} within {:.1}",
                        t.letter, t.units, t.tolerance
                    ),
                    "the move was not executed as sent; look what holds the axis, then home again",
                ))
            })
            .collect()
    }

    pub(super) fn verified(&mut self, targets: &[Target]) -> Result<Vec<f64>, Fault> {
        let (busy, positions) = self.look("a look at its position", false)?;
        if busy {
            return Err(Fault::unexpected(
                "it moves although nothing was sent",
                "is a knob, a joystick or another program moving it?",
            ));
        }
        self.check_uptime("a look at its position")?;
        self.in_place(targets, &positions)
    }

    // -- stopping ---------------------------------------------------------------------------------------------------

    /// Sends a stop to all axes, waits until they rest, and acknowledges the warnings.
    pub(super) fn stop_and_wait(&mut self, text: &str) -> Result<(), Fault> {
        let obey = std::mem::replace(&mut self.link.obey, Obey::Nothing);
        let stopped = self.stop_in_order(text);
        self.link.obey = obey;
        let stopped = stopped?;
        if !stopped.at_rest {
            return Err(Fault::unexpected(
                format!("it is still BUSY {STOP_TIMEOUT} s after '{text}'"),
                "cut the motors' power",
            ));
        }
        let kept = stopped.reference_kept && !self.homing && !(self.moving && text == "estop");
        self.homed &= kept;
        self.moving = false;
        self.homing = false;
        self.faulted = false;
        Ok(())
    }

    fn stop_in_order(&mut self, text: &str) -> Result<Stopped, Fault> {
        self.link.clear_alert();
        self.link.ask(0, text, STOP_TRIES)?;
        let deadline = self.link.clock.now() + STOP_TIMEOUT;
        let mut last = None;
        let mut stopped = Stopped {
            at_rest: false,
            reference_kept: true,
        };
        while !stopped.at_rest && self.link.clock.now() < deadline {
            let reply = self.link.ask(0, "get pos", STOP_TRIES)?;
            let effect = reply.flag.as_deref().map(|f| flags::meaning(f).0);
            stopped.reference_kept &=
                !matches!(effect, Some(Effect::PositionLost | Effect::NotHomed));
            stopped.at_rest = !reply.busy && last.as_ref() == Some(&reply.data);
            last = Some(reply.data);
            self.link.pause(POLL)?;
        }
        if let Some(before) = self.uptime {
            self.uptime = self.read_uptime()?;
            stopped.reference_kept &= self.uptime.is_some_and(|now| now >= before);
        }
        self.link.ask(0, "warnings clear", STOP_TRIES)?;
        self.link.clear_alert();
        Ok(stopped)
    }
}
