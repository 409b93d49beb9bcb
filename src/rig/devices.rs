//! What the rig's devices can do, whatever protocol they speak.

use super::description::Homing;
use super::transport::{Clock, Transport};
use crate::base::{Error, Result, Watch};
use crate::session::{CameraFacts, Configuration, Exposedness, FrameKind};
use std::sync::Arc;

/// Where one axis of a controller shall go, in controller units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Target {
    /// Axis letter (GRBL) or axis number (Zaber) on its board.
    pub letter: char,
    /// Machine position.
    pub units: f64,
    /// How far the position read back may be off.
    pub tolerance: f64,
    /// The fastest this axis shall go, units per second.
    pub speed: f64,
}

/// What a controller says of one of its axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AxisLimits {
    /// The travel the controller itself allows; none when it enforces none.
    pub travel: Option<Travel>,
    /// Units per second.
    pub max_speed: f64,
    /// Units per second squared.
    pub acceleration: f64,
}

/// The travel a controller allows an axis, units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Travel {
    /// Between these machine positions, ascending.
    Between([f64; 2]),
    /// This far, from an end it does not tell.
    Length(f64),
}

/// One motion controller with its axes. Position is trusted only while [`Motion::is_homed`]; a restart, an alarm or a
/// disconnect voids it. Every wait is bounded, and ends within 0.1 s on [`Watch::urgent`].
pub trait Motion {
    /// The board's name in the rig file.
    fn name(&self) -> &str;

    /// Firmware version in one line, as the controller says itself.
    fn firmware(&self) -> String;

    /// All the controller said of its version and settings, line by line, for the session's record.
    fn dump(&self) -> Vec<String>;

    /// Checks the settings that positions and homing rely on.
    ///
    /// # Errors
    /// With the setting to change.
    fn check(&self, homing: Homing) -> Result<()>;

    /// What the controller says of the axis with this letter.
    ///
    /// # Errors
    /// It has no such axis, or does not say.
    fn axis_limits(&self, letter: char) -> Result<AxisLimits>;

    /// True when all axes of one [`Motion::start_move`] move on one straight line; false when each goes its own way.
    fn moves_in_line(&self) -> bool;

    /// True while the position is known.
    fn is_homed(&self) -> bool;

    /// Finds the reference switches and takes the position as known.
    ///
    /// # Errors
    /// Homing is off, fails, or takes too long; call [`Motion::make_safe`].
    fn home(&mut self) -> Result<()>;

    /// Takes the position as known on the operator's word.
    ///
    /// # Errors
    /// The controller is neither idle nor merely locked, or allows no such thing.
    fn trust_position(&mut self) -> Result<()>;

    /// State in the controller's own words, e.g. `Idle`.
    ///
    /// # Errors
    /// It does not answer.
    fn state(&mut self) -> Result<String>;

    /// Machine positions of these axes now.
    ///
    /// # Errors
    /// As [`Motion::state`], or there is no such axis.
    fn positions(&mut self, letters: &[char]) -> Result<Vec<f64>>;

    /// Starts a move to `targets`; returns when the controller accepted it.
    ///
    /// # Errors
    /// The position is not known, a number makes no sense (nothing is sent then), or the controller refuses.
    fn start_move(&mut self, targets: &[Target]) -> Result<()>;

    /// Waits until the move has ended and verifies it: at rest, and read back within tolerance more than once. Watches
    /// all the while that no axis leaves the way it was sent. Returns the positions read back, in the order of `targets`.
    ///
    /// # Errors
    /// It takes longer than `timeout` seconds, leaves its way, or ends elsewhere; call [`Motion::make_safe`].
    fn finish_move(&mut self, targets: &[Target], timeout: f64) -> Result<Vec<f64>>;

    /// Looks once at a started move, in a fraction of a second, and returns true when nothing moves any more. For whoever
    /// has several controllers to watch; [`Motion::finish_move`] must follow.
    ///
    /// # Errors
    /// An axis has left its way, or the controller is in a state in which the move will not end; call
    /// [`Motion::make_safe`].
    fn look_on_the_way(&mut self) -> Result<bool>;

    /// Checks that the controller is at rest at `targets`; returns the positions read back.
    ///
    /// # Errors
    /// It is not.
    fn verify_at(&mut self, targets: &[Target]) -> Result<Vec<f64>>;

    /// True while axes may be moving, as far as is known here.
    fn may_be_moving(&self) -> bool;

    /// True while a homing cycle may be running.
    fn may_be_homing(&self) -> bool;

    /// Begins a controlled stop and does not wait; [`Motion::make_safe`] must follow.
    fn brake(&mut self);

    /// Stops what moves, keeping the position known where that is possible, and switches the board's lamp output off.
    /// With `at_once` it stops the fastest way there is, whatever becomes of the position. Says what was done.
    ///
    /// # Errors
    /// The controller cannot be reached; its lamp may still be on, and its axes may still move.
    fn make_safe(&mut self, at_once: bool) -> Result<String>;

    /// What was not as expected since the last call and was dealt with: why, and how, one line each.
    fn take_notes(&mut self) -> Vec<String> {
        Vec::new()
    }

    /// True when the controller itself says that its axes were homed and have not lost their place since. Unlike
    /// [`Motion::is_homed`] it may be the homing of an earlier connection.
    ///
    /// # Errors
    /// It does not answer.
    fn says_homed(&mut self) -> Result<bool> {
        Ok(self.is_homed())
    }

    /// Moves one axis by so many units at this speed (units per second) although the position is not known, to free an
    /// axis that stands on a switch. Returns by how much the controller says it moved; the position stays unknown.
    ///
    /// # Errors
    /// The controller cannot, refuses, or does not come to rest; call [`Motion::make_safe`].
    fn nudge(&mut self, letter: char, _units: f64, _speed: f64) -> Result<f64> {
        Err(Error::new(format!(
            "board '{}' cannot move axis {letter} before it is homed",
            self.name()
        ))
        .with_hint("home it, or move the axis by hand with the motors' power off"))
    }

    /// The board's lamp output, if it has one.
    fn lamp(&mut self) -> Option<&mut dyn Light>;
}

/// A light that can be switched.
pub trait Light {
    /// Checks that the device can give this power, without switching anything.
    ///
    /// # Errors
    /// With the setting to change.
    fn check(&mut self, power: f64) -> Result<()>;

    /// Switches on at this power (spindle speed of a board, amperes of a current source) and reads the state back.
    ///
    /// # Errors
    /// It refuses, does not answer, or is not in the state that was set.
    fn switch_on(&mut self, power: f64) -> Result<()>;

    /// Switches off and reads the state back.
    ///
    /// # Errors
    /// As [`Light::switch_on`].
    fn switch_off(&mut self) -> Result<()>;

    /// Whether it is on, by the device's own word; none when it does not tell.
    ///
    /// # Errors
    /// It does not answer.
    fn is_on(&mut self) -> Result<Option<bool>> {
        Ok(None)
    }

    /// Who it is, in its own words, for the session's record.
    fn identity(&self) -> String;
}

/// What every driver is made with.
pub struct Wiring<'a> {
    /// Name of the device in messages.
    pub name: String,
    /// Bytes to and from it.
    pub transport: Box<dyn Transport>,
    /// Time.
    pub clock: Arc<dyn Clock>,
    /// Who may ask to stop.
    pub watch: &'a dyn Watch,
}

/// One shot the capture loop asks a camera for.
#[derive(Debug, Clone, PartialEq)]
pub struct Shot {
    /// What is in front of the camera.
    pub kind: FrameKind,
    /// The plan's configuration for a sample shot; none for the others.
    pub config: Option<u32>,
    /// Where light, camera and turntable stand.
    pub pose: Configuration,
    /// Requested exposure time, milliseconds.
    pub exposure_ms: f64,
    /// 0 for the first shot of this kind, configuration, visit and exposure.
    pub repeat: u32,
    /// Which visit of the reference pose; 0 for every other kind.
    pub visit: u32,
}

/// What a camera hands back: a file, exactly as it would lie on its card.
#[derive(Debug, Clone, PartialEq)]
pub struct CapturedFrame {
    /// The file's bytes.
    pub bytes: Vec<u8>,
    /// Its extension, e.g. `dng`.
    pub extension: String,
    /// Exposure time the camera reports, milliseconds.
    pub exposure_ms: f64,
}

/// A camera.
pub trait Camera {
    /// What must be known to read its frames.
    fn facts(&self) -> CameraFacts;

    /// The camera's serial number, as it says itself; empty when it has none.
    fn serial(&self) -> String {
        String::new()
    }

    /// What must be said of all its frames, on screen and in the session; none for a measuring camera.
    fn warning(&self) -> Option<String> {
        None
    }

    /// Takes one shot. A camera that is busy or lost its connection is tried again inside, a bounded number of times.
    ///
    /// # Errors
    /// When the camera is gone, refuses the exposure, or returns no whole frame.
    fn expose(&mut self, shot: &Shot) -> Result<CapturedFrame>;
}

/// Looks at a frame right after it was taken. Decoding frames is not the rig's business: who composes the rooms passes one.
pub trait Judge {
    /// How well the frame is exposed over the crop of its pose; none for kinds that need no judgement (darks).
    ///
    /// # Errors
    /// The frame cannot be decoded or is not of the camera the session expects.
    fn judge(&mut self, shot: &Shot, frame: &CapturedFrame) -> Result<Option<Exposedness>>;
}
