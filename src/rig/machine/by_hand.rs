//! What a person does with the rig outside a capture.

use super::{Axis, AxisName, Error, Halt, Result, Rig, Step};

/// The fastest an axis goes whose position is not known, degrees per second.
const UNHOMED_SPEED: f64 = 1.0;

impl Rig<'_> {
    /// Takes the position of every board as known that says itself, now, that it is homed and at rest. True when every
    /// board's position is known then. Switches the lamp of such a board off.
    ///
    /// # Errors
    /// A board does not answer.
    pub fn take_homing_as_said(&mut self) -> Result<bool> {
        for board in &mut self.boards {
            if !board.is_homed() && board.says_homed()? {
                board.trust_position()?;
            }
        }
        Ok(self.is_homed())
    }

    /// Whether the lamp is on, by the device's own word; none when it does not tell.
    ///
    /// # Errors
    /// It does not answer.
    pub fn lamp_state(&mut self) -> Result<Option<bool>> {
        self.lamp()?.is_on()
    }

    /// Switches the lamp off, whoever switched it on.
    ///
    /// # Errors
    /// The device fails.
    pub fn force_lamp_off(&mut self) -> Result<()> {
        self.lamp()?.switch_off()?;
        self.lamp_on = false;
        Ok(())
    }

    /// Moves one axis slowly by `degrees` although its position is not known, to free it. No limit is checked, as none
    /// can be. Returns by how many degrees the board says that it moved.
    ///
    /// # Errors
    /// The axis has no motor, or as [`crate::rig::Motion::nudge`]; call [`Rig::make_safe`].
    pub fn nudge(&mut self, name: AxisName, degrees: f64) -> Step<f64> {
        self.obey()?;
        let Axis::Motor(motor) = self.description.axis(name).clone() else {
            return Err(Error::new(format!("axis {} has no motor", name.name())).into());
        };
        let per_unit = motor.sign * motor.degrees_per_unit;
        let speed = motor.speed_deg_per_s.min(UNHOMED_SPEED) / motor.degrees_per_unit;
        self.at = None;
        let board = self.boards.iter_mut().find(|b| b.name() == motor.board);
        let board = board.ok_or_else(|| {
            Halt::Failed(Error::new(format!("there is no board '{}'", motor.board)))
        })?;
        Ok(per_unit * board.nudge(motor.letter, degrees / per_unit, speed)?)
    }
}
