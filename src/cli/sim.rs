//! `goniofit sim`.

use super::Outcome;
use super::output::data;
use super::terminal::Terminal;
use crate::base::{Context, Error, Result, Watch};
use crate::rig::simulated::{SimulatedDevice, device_models};
use crate::rig::{ByteModel, Flavor, ModelOptions, PtySimulator, RigDescription, WireLog};
use std::io::Write;
use std::path::PathBuf;
use std::time::Duration;

/// Start simulated controllers on pseudo-terminals and print their paths
///
/// Each device behaves like the serial port of a real one, byte by byte: start-up text, reports, motion that takes its
/// time, alarms, limits, lamp output. They run until Ctrl-C.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  goniofit sim
      one 5-axis grblHAL board, set up for degrees, homing and soft limits on; prints e.g. /dev/pts/3
  goniofit sim --rig rig_configs/two_board_grbl.toml --speed 20
      one simulator for each device of a rig file, 20 times as fast as real; prints a line 'name path' for each
  goniofit capture --rig rig_configs/five_axis_grblhal.toml --port /dev/pts/3 ...
      drive it from another terminal")]
pub(crate) struct Arguments {
    /// Firmware to simulate
    #[arg(long, value_enum, default_value_t = FlavorName::Grblhal, conflicts_with = "rig")]
    flavor: FlavorName,
    /// Simulate every device of this rig file
    #[arg(long, value_name = "R.toml")]
    rig: Option<PathBuf>,
    /// How many times faster than real time the simulated devices live
    #[arg(long, default_value_t = 1.0)]
    speed: f64,
    /// Write all traffic to this new file, one JSON object per line
    #[arg(long, value_name = "WIRE.jsonl")]
    log: Option<PathBuf>,
    /// Print the paths as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum FlavorName {
    /// Grbl 1.1, axes X Y Z
    Grbl,
    /// grblHAL, axes X Y Z A B
    Grblhal,
}

fn devices(arguments: &Arguments) -> Result<Vec<SimulatedDevice>> {
    if let Some(path) = &arguments.rig {
        return Ok(device_models(&RigDescription::read(path)?));
    }
    let flavor = match arguments.flavor {
        FlavorName::Grbl => Flavor::Grbl,
        FlavorName::Grblhal => Flavor::GrblHal,
    };
    let options = ModelOptions::rig(flavor);
    Ok(vec![SimulatedDevice::grbl("main", options)])
}

/// A device on its pseudo-terminal.
struct Running {
    name: String,
    kind: &'static str,
    simulator: PtySimulator<Box<dyn ByteModel>>,
}

pub(crate) fn run(arguments: Arguments) -> Result<Outcome> {
    let log = WireLog::new();
    if let Some(path) = &arguments.log {
        log.write_to(path)?;
    }
    let mut running = Vec::new();
    for device in devices(&arguments)? {
        let record = (log.clone(), device.name.clone());
        let record = arguments.log.is_some().then_some(record);
        running.push(Running {
            simulator: PtySimulator::spawn(device.model, arguments.speed, record)?,
            name: device.name,
            kind: device.kind,
        });
    }
    let terminal = Terminal::new()?;
    print_paths(&running, arguments.json, arguments.rig.is_some())?;
    terminal.say("simulating; Ctrl-C ends it");
    while !terminal.cancelled() {
        if let Some(ended) = running.iter().find(|r| !r.simulator.is_running()) {
            return Err(Error::new(format!(
                "the simulator of '{}' ended",
                ended.name
            )));
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    Ok(Outcome::Done)
}

fn print_paths(running: &[Running], json: bool, with_names: bool) -> Result<()> {
    if json {
        let boards: Vec<serde_json::Value> = running
            .iter()
            .map(|r| serde_json::json!({"board": r.name, "flavor": r.kind, "path": r.simulator.path()}))
            .collect();
        data!("{}", serde_json::json!({ "boards": boards }));
    } else {
        for Running {
            name, simulator, ..
        } in running
        {
            if with_names {
                data!("{name} {}", simulator.path());
            } else {
                data!("{}", simulator.path());
            }
        }
    }
    // A program that reads the path through a pipe waits for it now.
    std::io::stdout()
        .flush()
        .context(|| "stdout cannot be written")
}
