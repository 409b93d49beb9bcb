//! Whole captures on the controller model: in process, over a pseudo-terminal, or from a recorded dialogue.

use super::capture::{Capture, CaptureOptions, Summary};
use super::description::{Board, Homing, RigDescription};
use super::machine::Connection;
use super::model::{Flavor, GrblModel, ModelOptions};
use super::operator::{Operator, Unattended};
use super::replay::Replay;
use super::serial::SerialTransport;
use super::simulator::{ModelTransport, PtySimulator};
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

/// A virtual clock and a connection to one model per board, in the order of the rig file.
pub fn in_process_connection(
    models: Vec<(String, ModelOptions)>,
) -> (Arc<VirtualClock>, Connection<'static>) {
    let clock = Arc::new(VirtualClock::new());
    let models: BTreeMap<String, Arc<Mutex<GrblModel>>> = models
        .into_iter()
        .map(|(name, options)| (name, Arc::new(Mutex::new(GrblModel::new(options)))))
        .collect();
    let shared = clock.clone();
    let connection = Connection {
        open: Box::new(move |board| {
            let model = models.get(&board.name).ok_or_else(|| {
                Error::new(format!("no simulated board is named '{}'", board.name))
            })?;
            Ok(Box::new(ModelTransport::new(model.clone(), shared.clone())) as Box<dyn Transport>)
        }),
        clock: clock.clone(),
        wait_scale: 1.0,
    };
    (clock, connection)
}

/// Runs a whole capture in process: one controller model per board on a virtual clock. No real time passes but the
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
    let models = description
        .boards
        .iter()
        .map(|b| (b.name.clone(), model_options(description, b)))
        .collect();
    let (_, connection) = in_process_connection(models);
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

/// Runs a whole capture over pseudo-terminals and the real serial code; the simulated controllers and the settle and
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
    for board in &description.boards {
        let model = GrblModel::new(model_options(description, board));
        simulators.insert(board.name.clone(), PtySimulator::spawn(model, speed, None)?);
    }
    let connection = Connection {
        open: Box::new(|board| {
            let path = simulators
                .get(&board.name)
                .map_or(board.path.as_str(), PtySimulator::path);
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
