//! The connected rig: all boards together, in angles.

use super::board_check::check_settings;
use super::description::{Board, Homing, RigDescription};
use super::grbl::{Grbl, Target, stopped_at_once};
use super::kinematics::AxisAngles;
use super::transport::{Clock, Transport};
use crate::base::{Error, Result, Watch};
use std::sync::Arc;

/// Opens the byte stream to a board.
pub type Opener<'a> = Box<dyn FnMut(&Board) -> Result<Box<dyn Transport>> + 'a>;

/// How a rig is reached: a byte stream per board, and time.
pub struct Connection<'a> {
    /// Opens the stream to a board.
    pub open: Opener<'a>,
    /// The time the boards live in.
    pub clock: Arc<dyn Clock>,
    /// Factor on settle and warm-up times: 1 for real hardware, less when the simulated time runs faster.
    pub wait_scale: f64,
}

/// Asks the operator something; an error when the answer is no or nobody is there.
pub type Prompt<'a> = dyn FnMut(&str) -> Result<()> + 'a;

/// Why a rig did not do what it was asked for.
#[derive(Debug)]
pub enum Halt {
    /// [`Watch::cancelled`], and the rig is at rest: before a motion, or while something settled or warmed up.
    Cancelled,
    /// A fault, or [`Watch::urgent`]; call [`Rig::make_safe`].
    Failed(Error),
}

impl From<Error> for Halt {
    fn from(error: Error) -> Self {
        Self::Failed(error)
    }
}

/// What becomes of a request to a rig.
pub type Step<T = ()> = Result<T, Halt>;

/// Seconds after which a wait looks at its [`Watch`] again.
const LOOK: f64 = 0.05;

/// The longest a move may take, seconds, judged by the board's own settings.
const LONGEST_MOVE: f64 = 1800.0;

/// A connected rig. Motion goes on when its [`Watch`] is cancelled, and stops when it is urgent; every other wait ends
/// on both.
pub struct Rig<'a> {
    description: RigDescription,
    boards: Vec<Grbl<'a>>,
    watch: &'a dyn Watch,
    clock: Arc<dyn Clock>,
    wait_scale: f64,
    at: Option<AxisAngles>,
    lamp_on: bool,
}

impl<'a> Rig<'a> {
    /// Opens and greets every board and compares its settings with the description. Moves nothing.
    ///
    /// # Errors
    /// A board cannot be reached, its settings contradict the description, or `watch` asks to stop.
    pub fn connect(
        description: &RigDescription,
        connection: &mut Connection,
        watch: &'a dyn Watch,
    ) -> Result<Self> {
        let mut boards = Vec::new();
        for board in &description.boards {
            let transport = (connection.open)(board)?;
            let grbl = Grbl::connect(&board.name, transport, connection.clock.clone(), watch)?;
            check_settings(description, board, &grbl)?;
            boards.push(grbl);
        }
        Ok(Self {
            description: description.clone(),
            boards,
            watch,
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

    /// Passes unless the operator asked to end.
    ///
    /// # Errors
    /// The operator did.
    pub fn obey(&self) -> Step {
        if self.watch.urgent() {
            return Err(Halt::Failed(stopped_at_once()));
        }
        if self.watch.cancelled() {
            return Err(Halt::Cancelled);
        }
        Ok(())
    }

    /// Lets time pass.
    fn wait(&self, seconds: f64) -> Step {
        let end = self.clock.now() + seconds * self.wait_scale;
        loop {
            self.obey()?;
            let rest = end - self.clock.now();
            if rest <= 0.0 {
                return Ok(());
            }
            self.clock.sleep(rest.min(LOOK));
        }
    }

    /// Asks the operator; a request to end counts more than the answer.
    ///
    /// # Errors
    /// The answer is no, or the operator asked to end.
    pub fn ask(&self, prompt: &mut Prompt, question: &str) -> Step {
        self.obey()?;
        let answer = prompt(question);
        self.obey()?;
        Ok(answer?)
    }

    /// Makes the position of every board known: `$H`, or the operator's word.
    ///
    /// # Errors
    /// Homing fails, or the operator declines or asks to end.
    pub fn home(&mut self, prompt: &mut Prompt) -> Step {
        for i in 0..self.boards.len() {
            let board = &self.description.boards[i];
            match board.homing {
                Homing::Cycle => {
                    self.obey()?;
                    self.boards[i].home()?;
                }
                Homing::ByHand => {
                    let question = format!(
                        "board '{}' has no limit switches: do its axes stand where the controller reads 0?",
                        board.name
                    );
                    self.ask(prompt, &question)?;
                    self.boards[i].trust_position()?;
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
    /// An angle is outside its limits (nothing is sent then), or a board fails; call [`Rig::make_safe`]. The operator
    /// asked to end before the move or while it settled.
    pub fn move_to(&mut self, angles: &AxisAngles) -> Step<AxisAngles> {
        self.description.check_angles(angles)?;
        self.obey()?;
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
        self.wait(settle_ms / 1000.0)?;
        Ok(self.verify()?)
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
        if !(0.0..=LONGEST_MOVE).contains(&slowest) {
            return Err(Error::new(format!(
                "board '{name}': a move would take {slowest:.0} s, expected at most {LONGEST_MOVE}"
            ))
            .with_hint(
                "compare $110.. and $120.. of the board and feed_deg_per_min of the rig file",
            ));
        }
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

    fn lamp_board(&mut self) -> Result<&mut Grbl<'a>> {
        let name = &self.description.lamp.board;
        self.boards
            .iter_mut()
            .find(|b| b.name() == name)
            .ok_or_else(|| Error::new(format!("lamp: unknown board '{name}'")))
    }

    /// Switches the lamp on and waits for its warm-up, unless it is on.
    ///
    /// # Errors
    /// The board fails, or the operator asked to end while the lamp warmed up; it is on then.
    pub fn lamp_on(&mut self) -> Step {
        if self.lamp_on {
            return Ok(());
        }
        let (power, warm_up) = (
            self.description.lamp.power_s,
            self.description.lamp.warm_up_s,
        );
        self.lamp_board()?.lamp_on(power)?;
        self.lamp_on = true;
        self.wait(warm_up)
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
    pub fn park(&mut self) -> Step {
        let Some(mut angles) = self.at else {
            return Ok(());
        };
        if self.description.park_deg.is_empty() {
            return Ok(());
        }
        for (name, angle) in &self.description.park_deg {
            angles.0[*name as usize] = *angle;
        }
        match self.move_to(&angles) {
            Ok(_) => Ok(()),
            Err(Halt::Failed(error)) => Err(Error::new("cannot park").with_source(error).into()),
            Err(Halt::Cancelled) => Err(Halt::Cancelled),
        }
    }

    /// Stops everything and switches the lamp off; one line per board says what happened. Every board that may be moving,
    /// and after [`Watch::urgent`] every board, gets its hold before any is waited for.
    pub fn make_safe(&mut self) -> Vec<String> {
        self.lamp_on = false;
        let urgent = self.watch.urgent();
        for board in &mut self.boards {
            if urgent || board.may_be_moving() {
                board.hold();
            }
        }
        // A homing board does not obey the hold: its reset comes first.
        let (homing, others): (Vec<_>, Vec<_>) =
            self.boards.iter_mut().partition(|b| b.may_be_homing());
        homing
            .into_iter()
            .chain(others)
            .map(|b| b.make_safe().unwrap_or_else(|e| e.report()))
            .collect()
    }
}
