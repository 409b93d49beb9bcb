//! Homing, and moving with the way watched and the position verified.

use super::fault::Fault;
use super::route::Route;
use super::{Grbl, Status};
use crate::rig::devices::Target;

/// Letters in the order of a status report's coordinates.
pub(super) const LETTERS: [char; 8] = ['X', 'Y', 'Z', 'A', 'B', 'C', 'U', 'V'];
/// Idle reports within tolerance, in a row, that make a position.
const IN_POSITION: u32 = 3;
/// Seconds between two of them.
const BETWEEN_REPORTS: f64 = 0.05;
/// Motor steps by which a report may be off a straight line.
const STEPS: f64 = 2.0;
/// Positions are reported with three decimals.
pub(super) const ROUNDING: f64 = 0.001;

impl Grbl<'_> {
    /// Homes; the controller must be idle afterwards.
    pub(super) fn home_and_prepare(&mut self) -> Result<(), Fault> {
        self.rest = None;
        let before = self.link.last_position().map(<[f64]>::to_vec);
        let seconds = self.run_homing()?;
        // What the board said before homing no longer counts.
        self.link.take_position_lost();
        self.link.forget_homed();
        let status = self.link.full_status()?;
        self.has_homed(&status, before.as_deref(), seconds)?;
        self.prepare(&status)
    }

    /// Unlocks a board without limit switches if need be.
    pub(super) fn unlock_and_prepare(&mut self) -> Result<(), Fault> {
        self.rest = None;
        if self.link.status()?.is("Alarm") {
            self.ask("$X", |_| true)?;
            self.link.take_position_lost();
        }
        let status = self.link.status()?;
        self.prepare(&status)
    }

    /// Lamp off; the controller must be idle. Where it stands is where it rests.
    fn prepare(&mut self, status: &Status) -> Result<(), Fault> {
        must_be_idle(status)?;
        self.ask("M5", |_| true)?;
        self.rest = Some(self.position_of(status)?);
        Ok(())
    }

    /// Sends a straight move in machine space; returns when it is queued.
    pub(super) fn begin_move(&mut self, targets: &[Target]) -> Result<(), Fault> {
        let rest = self.rest.clone().filter(|_| self.homed);
        let Some(rest) = rest else {
            return Err(Fault::unexpected(
                "its position is not known",
                "home the rig before moving it",
            ));
        };
        let feed = feed(&rest, targets).ok_or_else(|| {
            Fault::unexpected(
                format!("a move to {targets:?} makes no sense"),
                "correct the axis letters and speeds in the rig file",
            )
        })?;
        let status = self.link.status()?;
        must_be_idle(&status)?;
        let from = self.position_of(&status)?;
        self.compare_with_rest(&rest, &from)?;
        let mut route = self.route(from, targets)?;
        let words: String = targets
            .iter()
            .map(|t| format!("{}{:.4}", t.letter, t.units + 0.0))
            .collect();
        self.moving = true;
        // What an earlier alarm or reset said of outstanding answers and standstill ends here.
        self.link.halted = false;
        // G21 G90 G94: whatever modal state a reset or another program left behind.
        let line = format!("G21G90G94G53G1{words}F{feed:.1}");
        let sent = self.send_move(&line, &mut route);
        self.route = Some(route);
        sent
    }

    fn route(&self, from: Vec<f64>, targets: &[Target]) -> Result<Route, Fault> {
        let widest = targets.iter().map(|t| t.tolerance).fold(0.0, f64::max);
        let mut to = from.clone();
        let mut room: Vec<f64> = (0..from.len()).map(|i| widest + self.grain(i)).collect();
        for target in targets {
            let i = axis(target.letter).filter(|i| *i < to.len());
            let i = i.ok_or_else(|| no_axis(target.letter))?;
            to[i] = target.units;
            room[i] = target.tolerance + self.grain(i);
        }
        let letters = LETTERS[..from.len().min(LETTERS.len())].to_vec();
        Ok(Route::new(from, to, room, letters, self.link.clock.now()))
    }

    /// How fine a position of this axis can be said, units.
    fn grain(&self, axis: usize) -> f64 {
        STEPS * self.step(axis) + ROUNDING
    }

    /// One motor step of this axis, units; 0 when it is not known.
    pub(super) fn step(&self, axis: usize) -> f64 {
        let steps = self.settings.get(&(100 + axis as u16)).copied();
        steps.filter(|s| *s > 0.0).map_or(0.0, |s| 1.0 / s)
    }

    /// Fails when the axes are not where they were last verified to rest.
    pub(super) fn compare_with_rest(&self, rest: &[f64], now: &[f64]) -> Result<(), Fault> {
        if rest.len() != now.len() {
            return Err(Fault::unexpected(
                format!("it reports {} axes, expected {}", now.len(), rest.len()),
                "check for noise on the cable, then home again",
            ));
        }
        for (i, (before, p)) in rest.iter().zip(now).enumerate() {
            if !(0.0..=self.grain(i)).contains(&(p - before).abs()) {
                return Err(Fault::unexpected(
                    format!(
                        "axis {} stands at {p:.4} though it was left at {before:.4} and nothing was sent",
                        LETTERS.get(i).unwrap_or(&'?')
                    ),
                    "is another program or a pendant moving the board? home again",
                ));
            }
        }
        Ok(())
    }

    /// Asks once how the move gets on, without waiting long for an answer; true when the board is idle.
    pub(super) fn glance(&mut self) -> Result<bool, Fault> {
        let Some(mut route) = self.route.take() else {
            return Err(no_move());
        };
        let idle = self.link.glance(&mut route);
        self.route = Some(route);
        idle
    }

    /// Waits until the queued move has ended and verifies it; returns the positions read back, in the order of `targets`.
    pub(super) fn end_move(&mut self, targets: &[Target], timeout: f64) -> Result<Vec<f64>, Fault> {
        let Some(mut route) = self.route.take() else {
            return Err(no_move());
        };
        let deadline = self.link.clock.now() + timeout;
        self.pass_barrier(timeout, &mut route)?;
        let mut in_position = 0;
        loop {
            let status = self.link.status()?;
            self.link.on_way(&status, &mut route, "the end of a move")?;
            if status.is("Idle") {
                let found = self.verified(&status, targets)?;
                in_position += 1;
                if in_position >= IN_POSITION {
                    self.rest = Some(self.position_of(&status)?);
                    return Ok(found);
                }
            } else {
                in_position = 0;
            }
            if self.link.clock.now() > deadline {
                return Err(Fault::unexpected(
                    format!("state {} after the end of a move", status.state_text()),
                    "is another program moving the board?",
                ));
            }
            self.link.clock.sleep(BETWEEN_REPORTS);
        }
    }

    /// Checks that a report is of a board at rest at `targets` with no override active; returns the positions read back.
    pub(super) fn verified(&self, status: &Status, targets: &[Target]) -> Result<Vec<f64>, Fault> {
        must_be_idle(status)?;
        if let Some(percent) = self.link.overrides()
            && percent.iter().any(|p| (p - 100.0).abs() > 0.5)
        {
            return Err(Fault::unexpected(
                format!("overrides are {percent:?} percent, expected 100"),
                "noise on the cable or a pendant changed them; reset the board",
            ));
        }
        if self.homed_by_switches && self.link.homed() == Some(false) {
            return Err(Fault::unexpected(
                "it says that it is not homed any more (H:0)",
                "somebody changed its settings or reset it; home again",
            ));
        }
        let position = self.position_of(status)?;
        targets
            .iter()
            .map(|t| {
                let found = axis(t.letter).and_then(|i| position.get(i)).copied();
                let found = found.ok_or_else(|| no_axis(t.letter))?;
                if (found - t.units).abs() <= t.tolerance {
                    return Ok(found);
                }
                Err(Fault::unexpected(
                    format!(
                        "axis {} stands at {found:.4}, expected {:.4} within {:.4}",
                        t.letter, t.units, t.tolerance
                    ),
                    "the move was not executed as sent; check for noise on the cable, then home again",
                ))
            })
            .collect()
    }

    /// The machine position of a report, controller units by axis.
    pub(super) fn position_of(&self, status: &Status) -> Result<Vec<f64>, Fault> {
        self.link.machine_position(status).ok_or_else(|| {
            Fault::unexpected(
                "it does not report its position",
                "set $10=1 so that the status has MPos",
            )
        })
    }
}

pub(super) fn must_be_idle(status: &Status) -> Result<(), Fault> {
    if status.is("Idle") {
        return Ok(());
    }
    Err(Fault::unexpected(
        format!("state {} where Idle was expected", status.state_text()),
        "clear the cause at the board and start again",
    ))
}

fn no_move() -> Fault {
    Fault::unexpected(
        "no move was started",
        "report this as a fault of the program",
    )
}

fn axis(letter: char) -> Option<usize> {
    LETTERS.iter().position(|l| *l == letter)
}

fn no_axis(letter: char) -> Fault {
    Fault::unexpected(
        format!("it has no axis {letter}"),
        "correct the axis letters in the rig file",
    )
}

/// Feed along the straight line, units per minute, at which no axis exceeds its speed; none when a number makes no sense
/// or an axis is not there.
fn feed(from: &[f64], targets: &[Target]) -> Option<f64> {
    let (mut squared, mut seconds) = (0.0, 0.0_f64);
    let mut fastest = 0.0_f64;
    for target in targets {
        let way = (target.units - from.get(axis(target.letter)?)?).abs();
        if !(way.is_finite() && target.speed > 0.0 && target.tolerance >= 0.0) {
            return None;
        }
        squared += way * way;
        seconds = seconds.max(way / target.speed);
        fastest = fastest.max(60.0 * target.speed);
    }
    let feed = if seconds > 0.0 {
        (60.0 * f64::sqrt(squared) / seconds).max(1.0)
    } else {
        fastest
    };
    (1.0..1e6).contains(&feed).then_some(feed)
}
