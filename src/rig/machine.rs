//! The connected rig: all boards and the lamp together, in angles.

mod by_hand;
mod together;

use super::board_check::check_settings;
use super::description::{Axis, AxisName, Homing, Port, RigDescription};
use super::devices::{AxisLimits, Light, Motion, Target, Wiring};
use super::drivers;
use super::grbl::stopped_at_once;
use super::kinematics::AxisAngles;
use super::transport::{Clock, Transport};
use crate::base::{Error, Result, Watch};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Opens the byte stream to a device.
pub type Opener<'a> = Box<dyn FnMut(&Port) -> Result<Box<dyn Transport>> + 'a>;

/// How a rig is reached: a byte stream per device, and time.
pub struct Connection<'a> {
    /// Opens the stream to a device.
    pub open: Opener<'a>,
    /// The time the devices live in.
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

/// Seconds after which a long wait listens to the boards.
const LISTEN: f64 = 1.0;

/// The longest a move may take, seconds, judged by the boards' own settings.
const LONGEST_MOVE: f64 = 1800.0;

/// A connected rig. Motion goes on when its [`Watch`] is cancelled, and stops when it is urgent; every other wait ends
/// on both.
pub struct Rig<'a> {
    description: RigDescription,
    boards: Vec<Box<dyn Motion + 'a>>,
    /// A lamp with its own driver; none when a board's output is the lamp.
    light: Option<Box<dyn Light + 'a>>,
    limits: BTreeMap<AxisName, AxisLimits>,
    watch: &'a dyn Watch,
    clock: Arc<dyn Clock>,
    wait_scale: f64,
    /// Where the axes were last verified to stand, and every board's position has been trusted since.
    at: Option<AxisAngles>,
    lamp_on: bool,
    /// When the lamp's warm-up ends.
    warm_at: f64,
    /// When the axes will have settled after the last move.
    settled_at: f64,
}

impl<'a> Rig<'a> {
    /// Opens and greets every device and compares the boards' settings with the description. Moves nothing; the lamp is
    /// left off.
    ///
    /// # Errors
    /// A device cannot be reached, a board's settings contradict the description, or `watch` asks to stop.
    pub fn connect(
        description: &RigDescription,
        connection: &mut Connection,
        watch: &'a dyn Watch,
    ) -> Result<Self> {
        let clock = connection.clock.clone();
        let mut wiring = |port: &Port| -> Result<Wiring<'a>> {
            Ok(Wiring {
                name: port.name.clone(),
                transport: (connection.open)(port)?,
                clock: clock.clone(),
                watch,
            })
        };
        let mut boards = Vec::new();
        let mut limits = BTreeMap::new();
        for board in &description.boards {
            let mut motion = drivers::motion(board, wiring(&board.connection())?)?;
            check_settings(description, board, motion.as_mut())?;
            for (name, motor) in description.motors_of(&board.name) {
                limits.insert(name, motion.axis_limits(motor.letter)?);
            }
            boards.push(motion);
        }
        let light = drivers::light(&description.lamp.output, wiring)?;
        let mut rig = Self {
            description: description.clone(),
            boards,
            light,
            limits,
            watch,
            clock: connection.clock.clone(),
            wait_scale: connection.wait_scale,
            at: None,
            lamp_on: false,
            warm_at: 0.0,
            settled_at: 0.0,
        };
        if let Some(light) = &mut rig.light {
            light.check(description.lamp.power())?;
        }
        Ok(rig)
    }

    /// Firmware of all boards in one line, for the record.
    pub fn firmware(&self) -> String {
        let all: Vec<String> = self
            .boards
            .iter()
            .map(|b| format!("{}: {}", b.name(), b.firmware()))
            .collect();
        all.join("; ")
    }

    /// All that every device said of itself, by name.
    pub fn dump(&self) -> BTreeMap<String, Vec<String>> {
        let boards = self.boards.iter().map(|b| (b.name().to_owned(), b.dump()));
        let light = self
            .light
            .iter()
            .map(|l| ("lamp".to_owned(), vec![l.identity()]));
        boards.chain(light).collect()
    }

    /// Every board's name, state in its own words, whether its position is known, and the positions of its axes in
    /// degrees.
    ///
    /// # Errors
    /// A board does not answer.
    pub fn states(&mut self) -> Result<Vec<BoardState>> {
        let description = &self.description;
        self.boards
            .iter_mut()
            .map(|board| {
                let motors: Vec<_> = description
                    .motors_of(board.name())
                    .map(|(n, m)| (n, m.clone()))
                    .collect();
                let letters: Vec<char> = motors.iter().map(|(_, m)| m.letter).collect();
                let state = board.state()?;
                let units = board.positions(&letters)?;
                Ok(BoardState {
                    board: board.name().to_owned(),
                    firmware: board.firmware(),
                    state,
                    homed: board.is_homed() || board.says_homed()?,
                    axes_deg: motors
                        .iter()
                        .zip(&units)
                        .map(|((name, m), u)| (*name, m.angle_deg(*u)))
                        .collect(),
                })
            })
            .collect()
    }

    /// True while the lamp is on, as far as is known here.
    pub fn lamp_is_on(&self) -> bool {
        self.lamp_on
    }

    /// Seconds [`Rig::lamp_on`] waits after switching on.
    pub fn warm_up_seconds(&self) -> f64 {
        self.description.lamp.warm_up_s * self.wait_scale
    }

    /// True while every board's position is known.
    pub fn is_homed(&self) -> bool {
        self.boards.iter().all(|b| b.is_homed())
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

    /// Lets time pass; in a long wait every board is asked each second whether it still stands where it was sent.
    ///
    /// # Errors
    /// The operator asked to end, or a board is not as it was.
    pub fn wait(&mut self, seconds: f64) -> Step {
        let mut rest = seconds;
        while rest > 0.0 {
            let piece = rest.min(LISTEN);
            rest -= piece;
            self.pause(piece)?;
            if rest > 0.0 && self.at.is_some() {
                self.verify()?;
            }
        }
        self.obey()
    }

    fn wait_until(&mut self, end: f64) -> Step {
        self.wait((end - self.clock.now()).max(0.0) / self.wait_scale)
    }

    fn pause(&self, seconds: f64) -> Step {
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

    /// Makes the position of every board known: its reference switches, or the operator's word. Boards are homed one
    /// after the other, in the order of the rig file.
    ///
    /// # Errors
    /// Homing fails, or the operator declines or asks to end.
    pub fn home(&mut self, prompt: &mut Prompt) -> Step {
        self.at = None;
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
            .map(|(name, m)| {
                let own = self
                    .limits
                    .get(&name)
                    .map_or(f64::INFINITY, |l| l.max_speed);
                Target {
                    letter: m.letter,
                    units: m.units(angles.get(name)),
                    tolerance: m.tolerance_deg / m.degrees_per_unit,
                    speed: (m.speed_deg_per_s / m.degrees_per_unit).min(own),
                }
            })
            .collect()
    }

    /// Where all axes stand by the boards' own word (fixed axes: their angle).
    ///
    /// # Errors
    /// A board does not answer.
    pub fn angles(&mut self) -> Result<AxisAngles> {
        let mut angles = AxisAngles([0.0; 5]);
        for name in AxisName::ALL {
            if let Axis::Fixed { angle_deg, .. } = self.description.axis(name) {
                angles.0[name as usize] = *angle_deg;
            }
        }
        for state in self.states()? {
            for (name, angle) in state.axes_deg {
                angles.0[name as usize] = angle;
            }
        }
        Ok(angles)
    }

    /// Moves all axes to `angles` on a way that was checked whole before its first byte is sent, verifies every board's
    /// position, lets the axes settle; returns the angles read back (fixed axes: their angle).
    ///
    /// # Errors
    /// An angle is outside its limits or there is no free way (nothing is sent then), or a board fails; call
    /// [`Rig::make_safe`]. The operator asked to end before a leg of the way or while it settled.
    pub fn move_to(&mut self, angles: &AxisAngles) -> Step<AxisAngles> {
        self.description.check_angles(angles)?;
        self.obey()?;
        let (from, legs) = match self.at {
            Some(at) => (at, self.description.path(&at, angles)?),
            None => {
                let from = self.angles()?;
                (from, self.description.path_with_slack(&from, angles)?)
            }
        };
        let mut last = from;
        for leg in &legs {
            self.obey()?;
            self.go(&last, &leg.to)?;
            last = leg.to;
        }
        let settle = self.description.settle_ms_after(&from, &legs) / 1000.0;
        let settled_at = self.clock.now() + settle * self.wait_scale;
        if settled_at >= self.settled_at {
            self.settled_at = settled_at;
            self.wait(settle)?;
        } else {
            // A pause may have cut the settling of the last move short.
            self.wait_until(self.settled_at)?;
        }
        Ok(self.verify()?)
    }

    /// One leg: all boards start, all are watched in turns until none moves, then each verifies where it stands.
    fn go(&mut self, from: &AxisAngles, to: &AxisAngles) -> Result<()> {
        self.description.check_angles(to)?;
        // Until the end is verified nobody knows where the axes stand.
        self.at = None;
        let seconds = self.longest_seconds(from, to)?;
        let timeout = 3.0 * seconds + 15.0;
        let mut started = Vec::new();
        for i in 0..self.boards.len() {
            let name = self.boards[i].name().to_owned();
            let targets = self.targets(&name, to);
            // Of several boards those stay quiet that have nothing to move; they are verified at the end of the way.
            let mut axes = self.description.motors_of(&name);
            let moves = axes.any(|(axis, _)| (from.get(axis) - to.get(axis)).abs() > 1e-9);
            if !targets.is_empty() && (moves || self.boards.len() == 1) {
                self.boards[i].start_move(&targets)?;
                started.push((i, targets));
            }
        }
        let moving: Vec<usize> = started.iter().map(|(i, _)| *i).collect();
        self.watch_together(&moving, timeout)?;
        for (i, targets) in started {
            self.boards[i].finish_move(&targets, timeout)?;
        }
        self.at = Some(*to);
        Ok(())
    }

    /// An upper bound of a leg's time in seconds, by the boards' own speeds and accelerations.
    fn longest_seconds(&self, from: &AxisAngles, to: &AxisAngles) -> Result<f64> {
        let mut slowest = 0.0_f64;
        for (name, limits) in &self.limits {
            let Axis::Motor(motor) = self.description.axis(*name) else {
                continue;
            };
            let way = (from.get(*name) - to.get(*name)).abs() / motor.degrees_per_unit;
            let speed = limits
                .max_speed
                .min(motor.speed_deg_per_s / motor.degrees_per_unit);
            slowest = slowest.max(way / speed + 2.0 * speed / limits.acceleration);
        }
        if !(0.0..=LONGEST_MOVE).contains(&slowest) {
            return Err(Error::new(format!(
                "a move would take {slowest:.0} s, expected at most {LONGEST_MOVE}"
            ))
            .with_hint(
                "compare the boards' speeds and accelerations ($110.. and $120..) with the speeds of the rig file",
            ));
        }
        Ok(slowest)
    }

    /// Checks that every board is at rest where it was last sent; returns the angles read back.
    ///
    /// # Errors
    /// It is not, or nothing was moved yet.
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

    /// What was not as expected since the last call and was dealt with, one line each.
    pub fn take_notes(&mut self) -> Vec<String> {
        self.boards
            .iter_mut()
            .flat_map(|b| b.take_notes())
            .collect()
    }

    fn lamp(&mut self) -> Result<&mut dyn Light> {
        if let Some(light) = &mut self.light {
            return Ok(light.as_mut());
        }
        let name = self.description.lamp.board();
        self.boards
            .iter_mut()
            .find(|b| Some(b.name()) == name)
            .and_then(|b| b.lamp())
            .ok_or_else(|| Error::new("the rig has no lamp output"))
    }

    /// Switches the lamp on, unless it is on, and waits for the end of its warm-up.
    ///
    /// # Errors
    /// The device fails, or the operator asked to end while the lamp warmed up; it is on then.
    pub fn lamp_on(&mut self) -> Step {
        if self.lamp_on {
            // A pause may have cut the warm-up short.
            return self.wait_until(self.warm_at);
        }
        let power = self.description.lamp.power();
        // From here on it may be on, whatever the device answers.
        self.lamp_on = true;
        self.lamp()?.switch_on(power)?;
        let warm_up = self.description.lamp.warm_up_s;
        self.warm_at = self.clock.now() + warm_up * self.wait_scale;
        self.wait(warm_up)
    }

    /// Switches the lamp off, unless it is off.
    ///
    /// # Errors
    /// The device fails.
    pub fn lamp_off(&mut self) -> Result<()> {
        if !self.lamp_on {
            return Ok(());
        }
        self.lamp()?.switch_off()?;
        self.lamp_on = false;
        Ok(())
    }

    /// Moves the axes that have a parking place there; the others stay, inside their limits.
    ///
    /// # Errors
    /// As [`Rig::move_to`].
    pub fn park(&mut self) -> Step {
        if self.description.park_deg.is_empty() {
            return Ok(());
        }
        let at = match self.at {
            Some(at) => at,
            None => self.angles()?,
        };
        match self.move_to(&self.description.parked(&at)) {
            Ok(_) => Ok(()),
            Err(Halt::Failed(error)) => Err(Error::new("cannot park").with_source(error).into()),
            Err(Halt::Cancelled) => Err(Halt::Cancelled),
        }
    }

    /// Begins a controlled stop of every board, moving or not; [`Rig::make_safe`] must follow.
    pub fn brake(&mut self) {
        for board in &mut self.boards {
            board.brake();
        }
    }

    /// Stops everything and switches the lamp off; one line per device says what happened. Every board that may be
    /// moving, and after [`Watch::urgent`] every board, begins to brake before any is waited for. With `at_once` motion
    /// ends the fastest way there is, whatever becomes of the position.
    pub fn make_safe(&mut self, at_once: bool) -> Vec<String> {
        let urgent = self.watch.urgent() || at_once;
        for board in &mut self.boards {
            if urgent || board.may_be_moving() {
                board.brake();
            }
        }
        let mut done = Vec::new();
        if let Some(light) = &mut self.light
            && self.lamp_on
        {
            done.push(match light.switch_off() {
                Ok(()) => "lamp off".to_owned(),
                Err(e) => format!("the lamp may still be on: {}", e.report()),
            });
        }
        self.lamp_on = false;
        self.at = None;
        // A homing board does not obey the brake: its reset comes first.
        let (homing, others): (Vec<_>, Vec<_>) =
            self.boards.iter_mut().partition(|b| b.may_be_homing());
        done.extend(homing.into_iter().chain(others).map(|b| {
            b.make_safe(at_once).unwrap_or_else(|e| {
                let reason = e.report();
                format!("{reason}; its lamp may still be on and its axes may still move")
            })
        }));
        done
    }
}

/// What a board says of itself.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardState {
    /// Its name in the rig file.
    pub board: String,
    /// Firmware in one line.
    pub firmware: String,
    /// State in its own words.
    pub state: String,
    /// Its position is known: to this program, or by the board's own word.
    pub homed: bool,
    /// Positions of its axes, degrees.
    pub axes_deg: Vec<(AxisName, f64)>,
}
