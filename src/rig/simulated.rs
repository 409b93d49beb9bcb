//! Whole captures on device models: in process, over a pseudo-terminal, or from a recorded dialogue.

use super::capture::{Capture, CaptureOptions, Summary};
use super::description::{Board, Homing, RigDescription};
use super::machine::Connection;
use super::model::{Flavor, GrblModel, ModelOptions};
use super::operator::{Operator, Unattended};
use super::replay::Replay;
use super::serial::SerialTransport;
use super::simulator::{ByteModel, ModelTransport, PtySimulator, SharedDevice};
use super::transport::{SystemClock, VirtualClock};
use super::wire_log::WireEntry;
use super::{Camera, Judge, Transport};
use crate::base::{Error, Result, Watch};
use crate::session::Plan;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex};

/// A model that fits a board of a rig file: grblHAL when it drives more than three axes or one beyond Z.
pub fn model_options(description: &RigDescription, board: &Board) -> ModelOptions {
    let beyond_z = description
        .motors_of(&board.name)
        .any(|(_, m)| !"XYZ".contains(m.letter));
    let flavor = if beyond_z {
        Flavor::GrblHal
    } else {
        Flavor::Grbl
    };
    let mut options = ModelOptions::rig(flavor);
    if board.homing == Homing::ByHand {
        options.settings.extend([(22, 0.0), (20, 0.0)]);
    }
    options
}

/// A device of a rig, simulated.
pub struct SimulatedDevice {
    /// Name of its port in the rig file: a board's, or `lamp`.
    pub name: String,
    /// What it is: `grbl`, `grblhal`.
    pub kind: &'static str,
    /// The device.
    pub model: Box<dyn ByteModel>,
}

impl SimulatedDevice {
    /// A GRBL board.
    pub fn grbl(name: &str, options: ModelOptions) -> Self {
        Self {
            name: name.to_owned(),
            kind: match options.flavor {
                Flavor::Grbl => "grbl",
                Flavor::GrblHal => "grblhal",
            },
            model: Box::new(GrblModel::new(options)),
        }
    }
}

/// A model of every device of a rig file.
pub fn device_models(description: &RigDescription) -> Vec<SimulatedDevice> {
    let boards = description.boards.iter();
    boards
        .map(|board| SimulatedDevice::grbl(&board.name, model_options(description, board)))
        .collect()
}

/// A virtual clock and a connection to one GRBL model per board, in the order of the rig file.
pub fn in_process_connection(
    models: Vec<(String, ModelOptions)>,
) -> (Arc<VirtualClock>, Connection<'static>) {
    let models = models.into_iter().map(|(name, options)| {
        let model: SharedDevice = Arc::new(Mutex::new(GrblModel::new(options)));
        (name, model)
    });
    connection_to(models)
}

/// A virtual clock and a connection to these devices, by the names of their ports.
pub fn connection_to(
    devices: impl IntoIterator<Item = (String, SharedDevice)>,
) -> (Arc<VirtualClock>, Connection<'static>) {
    let clock = Arc::new(VirtualClock::new());
    let devices: BTreeMap<String, SharedDevice> = devices.into_iter().collect();
    let shared = clock.clone();
    let connection = Connection {
        open: Box::new(move |port| {
            let device = devices.get(&port.name).ok_or_else(|| {
                Error::new(format!("no simulated device is named '{}'", port.name))
            })?;
            Ok(Box::new(ModelTransport::new(device.clone(), shared.clone())) as Box<dyn Transport>)
        }),
        clock: clock.clone(),
        wait_scale: 1.0,
    };
    (clock, connection)
}

/// Runs a whole capture in process: a model of every device on a virtual clock. No real time passes but the
/// camera's.
///
/// # Errors
/// As [`Capture::start`].
pub fn capture_in_process(
    description: &RigDescription,
    plan: &Plan,
    camera: &mut dyn Camera,
    out: &Path,
    options: &CaptureOptions,
    watch: &dyn Watch,
) -> Result<Summary> {
    let devices = device_models(description).into_iter().map(|simulated| {
        let device: SharedDevice = Arc::new(Mutex::new(simulated.model));
        (simulated.name, device)
    });
    let (_, connection) = connection_to(devices);
    Capture {
        description,
        plan,
        connection,
        camera,
        judge: None,
        operator: &Unattended(watch),
        options: options.clone(),
    }
    .start(out)
}

/// Runs a whole capture over pseudo-terminals and the real serial code; the simulated devices and the settle and
/// warm-up times run `speed` times as fast as real time.
///
/// # Errors
/// As [`Capture::start`], or when no pseudo-terminal can be had.
pub fn capture_over_pty(
    description: &RigDescription,
    plan: &Plan,
    camera: &mut dyn Camera,
    out: &Path,
    options: &CaptureOptions,
    speed: f64,
    watch: &dyn Watch,
) -> Result<Summary> {
    let mut simulators = BTreeMap::new();
    for device in device_models(description) {
        let simulator = PtySimulator::spawn(device.model, speed, None)?;
        simulators.insert(device.name, simulator);
    }
    let connection = Connection {
        open: Box::new(|board| {
            let simulator = simulators.get(&board.name);
            let path = simulator.map_or(board.path.as_str(), |s| s.path());
            Ok(Box::new(SerialTransport::open(path, board.baud, board.dtr)?) as Box<dyn Transport>)
        }),
        clock: Arc::new(SystemClock::new()),
        wait_scale: 1.0 / speed,
    };
    Capture {
        description,
        plan,
        connection,
        camera,
        judge: None,
        operator: &Unattended(watch),
        options: options.clone(),
    }
    .start(out)
}

/// Runs a capture against a recorded dialogue (a session's `wire.jsonl`), byte for byte; the dialogue must be used up.
///
/// # Errors
/// As [`Capture::start`], and when the dialogue diverges or is not used up.
#[allow(clippy::too_many_arguments)]
pub fn capture_from_replay(
    description: &RigDescription,
    plan: &Plan,
    entries: Vec<WireEntry>,
    camera: &mut dyn Camera,
    judge: Option<Box<dyn Judge>>,
    out: &Path,
    options: &CaptureOptions,
    operator: &dyn Operator,
) -> Result<Summary> {
    let replay = Replay::new(entries);
    let connection = Connection {
        open: Box::new(|board| Ok(Box::new(replay.transport(&board.name)) as Box<dyn Transport>)),
        clock: replay.clock(),
        wait_scale: 1.0,
    };
    let summary = Capture {
        description,
        plan,
        connection,
        camera,
        judge,
        operator,
        options: options.clone(),
    }
    .start(out)?;
    if summary.finished() {
        replay.finish()?;
    }
    Ok(summary)
}
