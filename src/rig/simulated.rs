//! Whole captures on device models: in process, over a pseudo-terminal, or from a recorded dialogue.

use super::capture::{Capture, CaptureOptions, Summary};
use super::description::{Board, Homing, LampOutput, Protocol, RigDescription};
use super::machine::Connection;
use super::model::{Flavor, GrblModel, ModelOptions};
use super::operator::{Operator, Unattended};
use super::replay::Replay;
use super::scpi_model::ScpiModel;
use super::serial::SerialTransport;
use super::simulator::{ByteModel, ModelTransport, PtySimulator, SharedDevice};
use super::transport::{SystemClock, VirtualClock};
use super::wire_log::WireEntry;
use super::zaber_model::{ZaberAxis, ZaberModel, ZaberOptions};
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
    /// What it is: `grbl`, `grblhal`, `zaber` or `scpi`.
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

/// A Zaber model that fits a board of a rig file: its axes have the limits and speeds the rig asks for, with room.
pub fn zaber_options(description: &RigDescription, board: &Board) -> ZaberOptions {
    let mut options = ZaberOptions::rotary(1);
    options.address = board.address;
    for (_, motor) in description.motors_of(&board.name) {
        let number = motor.letter.to_digit(10).unwrap_or(1) as usize;
        let axes = options.axes.len().max(number);
        options.axes.resize_with(axes, ZaberAxis::rotary);
        let ends = [motor.units(motor.min_deg), motor.units(motor.max_deg)];
        let [low, high] = [ends[0].min(ends[1]), ends[0].max(ends[1])];
        let axis = &mut options.axes[number - 1];
        axis.limit_min = axis.limit_min.min(low.floor() as i64);
        axis.limit_max = axis.limit_max.max(high.ceil() as i64);
    }
    options
}

fn board_model(description: &RigDescription, board: &Board) -> SimulatedDevice {
    match board.protocol {
        Protocol::Grbl => SimulatedDevice::grbl(&board.name, model_options(description, board)),
        Protocol::Zaber => SimulatedDevice {
            name: board.name.clone(),
            kind: "zaber",
            model: Box::new(ZaberModel::new(zaber_options(description, board))),
        },
    }
}

/// A model of every device of a rig file.
pub fn device_models(description: &RigDescription) -> Vec<SimulatedDevice> {
    let boards = description.boards.iter();
    let mut devices: Vec<_> = boards
        .map(|board| board_model(description, board))
        .collect();
    if let LampOutput::Scpi {
        port,
        channel,
        current_a,
    } = &description.lamp.output
    {
        let model = ScpiModel::new(1.5 * current_a, Vec::new());
        devices.push(SimulatedDevice {
            name: port.name.clone(),
            kind: "scpi",
            model: Box::new(model.on_channel(*channel)),
        });
    }
    devices
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
