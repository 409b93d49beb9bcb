//! The connected rig: all boards together, in angles.

use super::description::{Board, Homing, RigDescription};
use super::grbl::{Grbl, Target};
use super::kinematics::AxisAngles;
use super::transport::{Clock, Transport};
use crate::base::{Context, Error, Result};
use std::sync::Arc;

/// How a rig is reached: a byte stream per board, and time.
pub struct Connection<'a> {
    /// Opens the stream to a board.
    pub open: Box<dyn FnMut(&Board) -> Result<Box<dyn Transport>> + 'a>,
    /// The time the boards live in.
    pub clock: Arc<dyn Clock>,
    /// Factor on settle and warm-up times: 1 for real hardware, less when the simulated time runs faster.
    pub wait_scale: f64,
}

/// Asks the operator something; an error when the answer is no or nobody is there.
pub type Prompt<'a> = dyn FnMut(&str) -> Result<()> + 'a;

/// A connected rig.
pub struct Rig {
    description: RigDescription,
    boards: Vec<Grbl>,
    clock: Arc<dyn Clock>,
    wait_scale: f64,
    at: Option<AxisAngles>,
    lamp_on: bool,
}

impl Rig {
    /// Opens and greets every board and compares its settings with the description. Moves nothing.
    ///
    /// # Errors
    /// A board cannot be reached, or its settings contradict the description.
    pub fn connect(description: &RigDescription, connection: &mut Connection) -> Result<Self> {
        let mut boards = Vec::new();
        for board in &description.boards {
            let transport = (connection.open)(board)?;
            let grbl = Grbl::connect(&board.name, transport, connection.clock.clone())?;
            check_settings(description, board, &grbl)?;
            boards.push(grbl);
        }
        Ok(Self {
            description: description.clone(),
            boards,
            clock: connection.clock.clone(),
            wait_scale: connection.wait_scale,
            at: None,
            lamp_on: false,
        })
    }

    /// Firmware of all boards, for the record.
    pub fn firmware(&self) -> String {
        let all: Vec<String> = self
            .boards
            .iter()
            .map(|b| format!("{}: {}", b.name(), b.firmware()))
            .collect();
        all.join("; ")
    }

    /// Makes the position of every board known: `$H`, or the operator's word.
    ///
    /// # Errors
    /// Homing fails, or the operator declines.
    pub fn home(&mut self, prompt: &mut Prompt) -> Result<()> {
        for (board, grbl) in self.description.boards.iter().zip(&mut self.boards) {
            match board.homing {
                Homing::Cycle => grbl.home()?,
                Homing::ByHand => {
                    prompt(&format!(
                        "board '{}' has no limit switches: do its axes stand where the controller reads 0?",
                        board.name
                    ))?;
                    grbl.trust_position()?;
                }
            }
        }
        Ok(())
    }

    fn targets(&self, board: &str, angles: &AxisAngles) -> Vec<Target> {
        self.description
            .motors_of(board)
            .map(|(name, m)| Target {
                letter: m.letter,
                units: m.units(angles.get(name)),
                tolerance: m.tolerance_deg / m.degrees_per_unit,
            })
            .collect()
    }

    /// Moves all axes to `angles`, verifies every board's position, lets the axes settle; returns the angles read back
    /// (fixed axes: their angle).
    ///
    /// # Errors
    /// An angle is outside its limits (nothing is sent then), or a board fails; call [`Rig::make_safe`].
    pub fn move_to(&mut self, angles: &AxisAngles) -> Result<AxisAngles> {
        self.description.check_angles(angles)?;
        let mut timeouts = Vec::new();
        for i in 0..self.boards.len() {
            let targets = self.targets(self.boards[i].name(), angles);
            if targets.is_empty() {
                timeouts.push(None);
                continue;
            }
            let (feed, seconds) = self.feed_and_time(i, &targets)?;
            self.boards[i].start_move(&targets, feed)?;
            timeouts.push(Some(3.0 * seconds + 15.0));
        }
        for (i, timeout) in timeouts.iter().enumerate() {
            if let Some(timeout) = timeout {
                let targets = self.targets(self.boards[i].name(), angles);
                self.boards[i].finish_move(&targets, *timeout)?;
            }
        }
        let settle_ms = self.settle_ms(angles);
        self.at = Some(*angles);
        self.clock.sleep(settle_ms / 1000.0 * self.wait_scale);
        self.verify()
    }

    /// The longest settle time of the axes that moved.
    fn settle_ms(&self, angles: &AxisAngles) -> f64 {
        let mut longest = 0.0_f64;
        for board in &self.description.boards {
            for (name, motor) in self.description.motors_of(&board.name) {
                let moved = self
                    .at
                    .is_none_or(|at| (at.get(name) - angles.get(name)).abs() > 1e-9);
                if moved {
                    longest = longest.max(motor.settle_ms);
                }
            }
        }
        longest
    }

    /// Feed for one board's move, units per minute along its path, and an upper bound of its time in seconds.
    fn feed_and_time(&mut self, i: usize, targets: &[Target]) -> Result<(f64, f64)> {
        let position = self.boards[i].position()?;
        let name = self.boards[i].name().to_owned();
        let settings = self.boards[i].settings();
        let mut seconds = 0.0_f64;
        let mut squared = 0.0;
        let mut slowest = 0.0_f64;
        for ((_, motor), target) in self.description.motors_of(&name).zip(targets) {
            let axis = "XYZABC".find(target.letter).unwrap_or(0);
            let from = position.get(axis).copied().ok_or_else(|| {
                Error::new(format!("board '{name}' has no axis {}", target.letter))
                    .with_hint("correct the axis letters in the rig file")
            })?;
            let units = (target.units - from).abs();
            squared += units * units;
            let wanted = self.description.feed_deg_per_min / motor.degrees_per_unit / 60.0;
            seconds = seconds.max(units / wanted);
            let setting = |base: u16, unit: f64| {
                let value = settings.get(&(base + axis as u16)).copied();
                value
                    .filter(|v| *v > 0.0)
                    .map_or(f64::INFINITY, |v| v / unit)
            };
            let speed = wanted.min(setting(110, 60.0));
            slowest = slowest.max(units / speed + 2.0 * speed / setting(120, 1.0));
        }
        let feed = if seconds > 0.0 {
            (60.0 * squared.sqrt() / seconds).max(1.0)
        } else {
            self.description.feed_deg_per_min
        };
        Ok((feed, slowest))
    }

    /// Checks that every board stands idle where it was last sent; returns the angles read back.
    ///
    /// # Errors
    /// It does not, or nothing was moved yet.
    pub fn verify(&mut self) -> Result<AxisAngles> {
        let at = self
            .at
            .ok_or_else(|| Error::new("the rig was not moved to a pose yet"))?;
        let mut read_back = at;
        for i in 0..self.boards.len() {
            let name = self.boards[i].name().to_owned();
            let targets = self.targets(&name, &at);
            let found = self.boards[i].verify_at(&targets)?;
            for ((axis, motor), units) in self.description.motors_of(&name).zip(found) {
                read_back.0[axis as usize] = motor.angle_deg(units);
            }
        }
        Ok(read_back)
    }

    fn lamp_board(&mut self) -> Result<&mut Grbl> {
        let name = &self.description.lamp.board;
        self.boards
            .iter_mut()
            .find(|b| b.name() == name)
            .ok_or_else(|| Error::new(format!("lamp: unknown board '{name}'")))
    }

    /// Switches the lamp on and waits for its warm-up, unless it is on.
    ///
    /// # Errors
    /// The board fails.
    pub fn lamp_on(&mut self) -> Result<()> {
        if self.lamp_on {
            return Ok(());
        }
        let (power, warm_up) = (
            self.description.lamp.power_s,
            self.description.lamp.warm_up_s,
        );
        self.lamp_board()?.lamp_on(power)?;
        self.lamp_on = true;
        self.clock.sleep(warm_up * self.wait_scale);
        Ok(())
    }

    /// Switches the lamp off, unless it is off.
    ///
    /// # Errors
    /// The board fails.
    pub fn lamp_off(&mut self) -> Result<()> {
        if !self.lamp_on {
            return Ok(());
        }
        self.lamp_board()?.lamp_off()?;
        self.lamp_on = false;
        Ok(())
    }

    /// Moves the axes that have a parking place there.
    ///
    /// # Errors
    /// As [`Rig::move_to`].
    pub fn park(&mut self) -> Result<()> {
        let Some(mut angles) = self.at else {
            return Ok(());
        };
        if self.description.park_deg.is_empty() {
            return Ok(());
        }
        for (name, angle) in &self.description.park_deg {
            angles.0[*name as usize] = *angle;
        }
        self.move_to(&angles).context(|| "cannot park")?;
        Ok(())
    }

    /// Stops everything and switches the lamp off, board by board; one line per board says what happened.
    pub fn make_safe(&mut self) -> Vec<String> {
        self.lamp_on = false;
        self.boards
            .iter_mut()
            .map(|b| b.make_safe().unwrap_or_else(|e| e.report()))
            .collect()
    }
}

/// Compares what a board says of itself with what the description expects of it.
fn check_settings(description: &RigDescription, board: &Board, grbl: &Grbl) -> Result<()> {
    let setting = |n: u16| grbl.settings().get(&n).copied().unwrap_or(0.0);
    let name = &board.name;
    if setting(13) != 0.0 {
        return Err(Error::new(format!(
            "board '{name}' reports inches ($13={})",
            setting(13)
        ))
        .with_hint("send $13=0"));
    }
    if description.lamp.board == *name {
        grbl.check_lamp_settings(description.lamp.power_s)?;
    }
    if board.homing == Homing::Cycle && setting(22) <= 0.0 {
        return Err(Error::new(format!(
            "board '{name}' shall be homed with $H but has homing switched off ($22=0)"
        ))
        .with_hint("send $22=1, or set homing = \"by_hand\" in the rig file"));
    }
    if setting(20) > 0.0 {
        for (axis, motor) in description.motors_of(name) {
            let index = "XYZABC".find(motor.letter).unwrap_or(0);
            let travel = setting(130 + index as u16);
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
