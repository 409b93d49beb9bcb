//! Axes, light, camera over real protocols, or a replay; the one loop that moves anything.
//!
//! Knows neither models nor renders: a virtual camera gets its picture from outside, as a trait object.
//!
//! ```text
//! capture (the loop) -> machine (angles, all boards) -> grbl (one board) -> Transport + Clock
//!                                                           serial port | model in process | replay of a wire log
//! ```

mod board_check;
mod cameras;
pub mod capture;
mod description;
mod devices;
mod drivers;
mod grbl;
mod kinematics;
mod machine;
mod model;
mod operator;
mod path;
mod replay;
mod rig_file;
mod serial;
mod shots;
pub mod simulated;
mod simulator;
mod transport;
mod utc;
mod wire_log;

#[cfg(feature = "aravis")]
pub use cameras::AravisCamera;
#[cfg(feature = "uvc")]
pub use cameras::UvcCamera;
pub use cameras::{CameraWiring, FolderCamera, Gphoto2Camera, ReplayCamera, open_camera};
pub use description::{
    Axis, AxisName, Board, CameraDescription, Homing, Lamp, LampOutput, LightSource, Metering,
    MotorAxis, Port, Protocol, RigDescription, White,
};
pub use devices::{
    AxisLimits, Camera, CapturedFrame, Judge, Light, Motion, Shot, Target, Travel, Wiring,
};
pub use grbl::{Grbl, Status, StopReport};
pub use kinematics::AxisAngles;
pub use machine::{BoardState, Connection, Halt, Opener, Prompt, Rig, Step};
pub use model::{Fault, FaultKind, Flavor, GrblModel, ModelOptions};
pub use operator::{Absent, Operator, Request, Seen, Taken};
pub use path::Leg;
pub use replay::{Replay, ReplayTransport};
pub use serial::SerialTransport;
pub use simulator::{ModelTransport, PtySimulator, SharedModel};
pub use transport::{Clock, SystemClock, Transport, VirtualClock};
pub use wire_log::{
    RecordingTransport, Way, WireEntry, WireLog, parse_wire_log, read_wire_log, show_bytes,
};

pub mod virtual_camera;

pub use virtual_camera::{Appearance, SensorModel, VirtualCamera, white_radiance};
