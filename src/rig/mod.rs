//! Axes, light, camera over real protocols, or a replay; the one loop that moves anything.
//!
//! Knows neither models nor renders: a virtual camera gets its picture from outside, as a trait object.
//!
//! ```text
//! capture (the loop) -> machine (angles, all boards) -> grbl (one board) -> Transport + Clock
//!                                                           serial port | model in process | replay of a wire log
//! ```

mod board_check;
pub mod capture;
mod description;
mod grbl;
mod kinematics;
mod machine;
mod model;
mod replay;
mod replay_camera;
mod rig_file;
mod serial;
mod shots;
pub mod simulated;
mod simulator;
mod transport;
mod utc;
#[cfg(feature = "uvc")]
mod uvc;
mod wire_log;

pub use description::{
    Axis, AxisName, Board, CameraDescription, Homing, Lamp, Light, MotorAxis, RigDescription, White,
};
pub use grbl::{Grbl, Status, StopReport, Target};
pub use kinematics::AxisAngles;
pub use machine::{Connection, Halt, Opener, Prompt, Rig, Step};
pub use model::{Fault, FaultKind, Flavor, GrblModel, ModelOptions};
pub use replay::{Replay, ReplayTransport};
pub use replay_camera::ReplayCamera;
pub use serial::SerialTransport;
pub use simulator::{ModelTransport, PtySimulator, SharedModel};
pub use transport::{Clock, SystemClock, Transport, VirtualClock};
#[cfg(feature = "uvc")]
pub use uvc::UvcCamera;
pub use wire_log::{
    RecordingTransport, Way, WireEntry, WireLog, parse_wire_log, read_wire_log, show_bytes,
};

pub mod virtual_camera;

pub use virtual_camera::{Appearance, SensorModel, VirtualCamera, white_radiance};

use crate::base::Result;
use crate::session::{CameraFacts, Configuration, FrameKind};

/// One shot the capture loop asks a camera for.
#[derive(Debug, Clone, PartialEq)]
pub struct Shot {
    /// What is in front of the camera.
    pub kind: FrameKind,
    /// The plan's configuration for a sample shot; none for darks and whites.
    pub config: Option<u32>,
    /// Where light, camera and turntable stand.
    pub pose: Configuration,
    /// Requested exposure time, milliseconds.
    pub exposure_ms: f64,
    /// 0 for the first shot of this kind, configuration and exposure.
    pub repeat: u32,
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

    /// Takes one shot.
    ///
    /// # Errors
    /// When the camera is gone, refuses the exposure, or returns no whole frame.
    fn expose(&mut self, shot: &Shot) -> Result<CapturedFrame>;
}
