//! `goniofit sim`.

use super::Outcome;
use super::output::data;
use super::terminal::Terminal;
use crate::base::{Context, Error, Result, Watch};
use crate::rig::simulated::model_options;
use crate::rig::{Flavor, GrblModel, ModelOptions, PtySimulator, RigDescription, WireLog};
use std::io::Write;
use std::path::PathBuf;
use std::time::Duration;

/// Start a simulated GRBL controller on a pseudo-terminal and print its path
///
/// The device behaves like the serial port of a real board, byte by byte: banner, status reports, motion that takes its
/// time, alarms, soft limits, lamp output. It runs until Ctrl-C.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  goniofit sim
      one 5-axis grblHAL board, set up for degrees, homing and soft limits on; prints e.g. /dev/pts/3
  goniofit sim --rig rig_configs/two_board_grbl.toml --speed 20
      one simulator for each board of a rig file, 20 times as fast as real; prints a line 'board path' for each
  goniofit capture --rig rig_configs/five_axis_grblhal.toml --port /dev/pts/3 ...
      drive it from another terminal")]
pub(crate) struct Arguments {
    /// Firmware to simulate
    #[arg(long, value_enum, default_value_t = FlavorName::Grblhal, conflicts_with = "rig")]
    flavor: FlavorName,
    /// Simulate every board of this rig file
    #[arg(long, value_name = "R.toml")]
    rig: Option<PathBuf>,
    /// How many times faster than real time the simulated boards live
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

fn boards(arguments: &Arguments) -> Result<Vec<(String, ModelOptions)>> {
    if let Some(path) = &arguments.rig {
        let rig = RigDescription::read(path)?;
        let boards = rig.boards.iter();
        return Ok(boards
            .map(|b| (b.name.clone(), model_options(&rig, b)))
            .collect());
    }
    let flavor = match arguments.flavor {
        FlavorName::Grbl => Flavor::Grbl,
        FlavorName::Grblhal => Flavor::GrblHal,
    };
    Ok(vec![("main".to_owned(), ModelOptions::rig(flavor))])
}

pub(crate) fn run(arguments: Arguments) -> Result<Outcome> {
    let log = WireLog::new();
    if let Some(path) = &arguments.log {
        log.write_to(path)?;
    }
    let mut running = Vec::new();
    for (name, options) in boards(&arguments)? {
        let flavor = options.flavor;
        let record = arguments.log.is_some().then(|| (log.clone(), name.clone()));
        let simulator = PtySimulator::spawn(GrblModel::new(options), arguments.speed, record)?;
        running.push((name, flavor, simulator));
    }
    let terminal = Terminal::new()?;
    print_paths(&running, arguments.json, arguments.rig.is_some())?;
    terminal.say("simulating; Ctrl-C ends it");
    while !terminal.cancelled() {
        if let Some((name, ..)) = running.iter().find(|r| !r.2.is_running()) {
            return Err(Error::new(format!("the simulator of board '{name}' ended")));
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    Ok(Outcome::Done)
}

fn print_paths(
    running: &[(String, Flavor, PtySimulator)],
    json: bool,
    with_names: bool,
) -> Result<()> {
    if json {
        let boards: Vec<serde_json::Value> = running
            .iter()
            .map(|(name, flavor, simulator)| {
                let flavor = match flavor {
                    Flavor::Grbl => "grbl",
                    Flavor::GrblHal => "grblhal",
                };
                serde_json::json!({"board": name, "flavor": flavor, "path": simulator.path()})
            })
            .collect();
        data!("{}", serde_json::json!({ "boards": boards }));
    } else {
        for (name, _, simulator) in running {
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
