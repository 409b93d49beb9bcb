//! Axes, light, camera over real protocols, or a replay; the one loop that moves anything.
//!
//! Knows neither models nor renders: a virtual camera gets its picture from outside, as a trait object.
//!
//! ```text
//! capture (the loop) -> machine (angles, all devices) -> grbl, zaber, scpi_led (one device) -> Transport + Clock
//!                                                    serial port | model in process | replay of a wire log
//! ```

mod board_check;
mod bodies;
mod cameras;
pub mod capture;
mod clearance;
mod description;
mod devices;
mod drivers;
mod emergency;
pub mod exposures;
mod grbl;
mod kinematics;
mod machine;
mod model;
mod obey;
mod operator;
mod outlook;
mod path;
mod port_owner;
mod ports;
mod replay;
mod rig_file;
mod scpi_led;
mod scpi_model;
mod serial;
mod shots;
pub mod simulated;
mod simulator;
mod stop;
mod tour;
mod transport;
mod travel;
mod utc;
mod wire_log;
mod zaber;
mod zaber_model;

pub use bodies::{Body, Carrier, Clearance};
#[cfg(feature = "aravis")]
pub use cameras::AravisCamera;
#[cfg(feature = "uvc")]
pub use cameras::UvcCamera;
pub use cameras::{CameraWiring, FolderCamera, Gphoto2Camera, ReplayCamera, open_camera};
pub use clearance::Contact;
pub use description::{
    Axis, AxisName, Board, CameraDescription, Homing, Lamp, LampOutput, LightSource, Metering,
    MotorAxis, Port, Protocol, RigDescription, White,
};
pub use devices::{
    AxisLimits, Camera, CapturedFrame, Judge, Light, Motion, Shot, Target, Travel, Wiring,
};
pub use emergency::{EmergencyLine, StopHandle};
pub use grbl::{Grbl, Status, StopReport};
pub use kinematics::AxisAngles;
pub use machine::{BoardState, Connection, Halt, Opener, Prompt, Rig, Step};
pub use model::{Fault, FaultKind, Flavor, GrblModel, ModelOptions};
pub use operator::{Operator, Request, Seen, Taken, Unattended};
pub use outlook::Outlook;
pub use path::Leg;
pub use ports::{SerialPortInfo, probe, serial_ports};
pub use replay::{Replay, ReplayTransport};
pub use scpi_led::ScpiLed;
pub use scpi_model::{ScpiFault, ScpiModel};
pub use serial::SerialTransport;
pub use shots::{History, PlannedShot};
pub use simulator::{ByteModel, ModelTransport, PtySimulator, SharedDevice, SharedModel};
pub use stop::{Stopped, stop_all};
pub use tour::{EXACT_UP_TO, Tour, tour};
pub use transport::{Clock, SystemClock, Transport, VirtualClock};
pub use travel::ControllerLimits;
pub use utc::utc_now;
pub use wire_log::{
    RecordingTransport, Way, WireEntry, WireLog, parse_wire_log, read_wire_log, show_bytes,
};

pub use zaber::Zaber;
pub use zaber_model::{ZaberAxis, ZaberFault, ZaberFaultKind, ZaberModel, ZaberOptions};

pub mod virtual_camera;

pub use virtual_camera::{Appearance, LampLaw, SensorModel, VirtualCamera, white_radiance};
