//! `goniofit rig`: the rig by hand.

mod motion;

use super::Outcome;
use super::output::data;
use super::ports::{override_ports, serial_connection};
use super::terminal::{Terminal, nobody_there};
use crate::base::{Error, Result, Unwatched, Watch};
use crate::rig::{AxisName, BoardState, EmergencyLine, Halt, Rig, RigDescription, Step, stop_all};
use serde_json::{Value, json};
use std::io::{BufRead, IsTerminal};
use std::path::PathBuf;

/// Look at the rig, home it, move it, stop it
///
/// Every motion is checked whole against the limits of the rig file before its first byte is sent, and verified by the
/// positions read back. Ctrl-C stops motion at once with its position kept, switches the lamp off and exits with 3.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  goniofit rig status --rig R.toml
      what every board says; moves nothing, works in an alarm
  goniofit rig move --rig R.toml light_elevation=45 turntable=90
      homes first unless the boards say they are homed
  goniofit rig stop --rig R.toml
      stop whatever moves, lamp off; works in any state
  goniofit rig status --rig R.toml --port /dev/pts/3
      the same on the board that `goniofit sim` simulates")]
pub(crate) struct Arguments {
    #[command(flatten)]
    common: Common,
    #[command(subcommand)]
    command: Command,
}

#[derive(clap::Args)]
struct Common {
    /// Rig description
    #[arg(long, value_name = "R.toml", global = true)]
    rig: Option<PathBuf>,
    /// Port of a board instead of the rig file's: PATH, or BOARD=PATH for each board
    #[arg(long, value_name = "[BOARD=]PATH", global = true)]
    port: Vec<String>,
    /// Say what would be done and open no port
    #[arg(long, global = true)]
    dry_run: bool,
    /// Answer every question with yes
    #[arg(long, global = true)]
    yes: bool,
    /// Print the result as JSON
    #[arg(long, global = true)]
    json: bool,
}

#[derive(clap::Subcommand)]
enum Command {
    /// What every board says: state, homed or not, angles, lamp; moves nothing
    #[command(after_help = "Examples:
  goniofit rig status --rig R.toml
  goniofit rig status --rig R.toml --json | jq .boards[0].state

Opening a port resets many boards; what they forgot by it (homing) is shown as they say it afterwards.")]
    Status,
    /// Make the position of every axis known
    #[command(after_help = "Examples:
  goniofit rig home --rig R.toml
      homing = \"cycle\": to the limit switches, one board after the other; keep hands away
  goniofit rig home --rig R.toml --yes
      homing = \"by_hand\": answers the question about the zero marks with yes")]
    Home,
    /// Move to a pose
    Move(motion::MoveArguments),
    /// Move one axis a little
    Jog(motion::JogArguments),
    /// Move to the parking place of the rig file
    #[command(after_help = "Examples:
  goniofit rig park --rig R.toml
      homes first unless the boards say they are homed; axes without a parking place stay")]
    Park,
    /// Stop whatever moves and switch the lamp off
    #[command(after_help = "Examples:
  goniofit rig stop --rig R.toml
      every board is told to brake before anything else is asked; the position is kept where that is possible

A port that another program holds cannot be opened: stop that program instead (Ctrl-C twice). For people and fingers
there must be a switch that cuts the motors' power.")]
    Stop,
    /// Switch the lamp on for a while, or off
    Lamp(LampArguments),
}

#[derive(clap::Args)]
#[command(after_help = "Examples:
  goniofit rig lamp on --rig R.toml
      on until Enter; it is off afterwards whatever happens
  goniofit rig lamp on --rig R.toml --for 600
      on for ten minutes, e.g. to watch its drift
  goniofit rig lamp off --rig R.toml
      off, whoever left it on")]
struct LampArguments {
    /// on or off
    switch: Switch,
    /// Seconds to stay on; until Enter when absent
    #[arg(long = "for", value_name = "SECONDS")]
    seconds: Option<f64>,
}

#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Switch {
    On,
    Off,
}

/// A rig file and how the command was asked to behave.
struct Desk {
    description: RigDescription,
    dry_run: bool,
    yes: bool,
    json: bool,
}

/// What a command tells on stdout.
struct Answer {
    text: String,
    json: Value,
}

impl Answer {
    fn print(&self, json: bool) {
        if json {
            data!("{}", self.json);
        } else {
            data!("{}", self.text);
        }
    }
}

pub(crate) fn run(arguments: Arguments) -> Result<Outcome> {
    let common = arguments.common;
    let path = common.rig.ok_or_else(|| {
        Error::new("--rig is missing").with_hint("name the rig file: --rig rig_configs/R.toml")
    })?;
    let mut description = RigDescription::read(&path)?;
    override_ports(&mut description, &common.port)?;
    let desk = Desk {
        description,
        dry_run: common.dry_run,
        yes: common.yes,
        json: common.json,
    };
    match arguments.command {
        Command::Status => status(&desk),
        Command::Home => motion::home(&desk),
        Command::Move(a) => motion::move_to(&desk, &a),
        Command::Jog(a) => motion::jog(&desk, &a),
        Command::Park => motion::park(&desk),
        Command::Stop => stop(&desk),
        Command::Lamp(a) => lamp(desk, &a),
    }
}

impl Desk {
    /// Says what would be done.
    fn rehearse(&self, what: &str) -> Result<Outcome> {
        let answer = Answer {
            text: format!("dry run: {what}"),
            json: json!({"dry_run": true, "would": what}),
        };
        answer.print(self.json);
        Ok(Outcome::Done)
    }

    /// Connects, does `work`, and prints its answer; whatever goes wrong leaves the rig at rest with its lamp off.
    fn drive(&self, work: impl FnOnce(&mut Rig<'_>, &Terminal) -> Step<Answer>) -> Result<Outcome> {
        let terminal = Terminal::stopping_at_once()?;
        let line = EmergencyLine::new();
        let mut connection = serial_connection(&self.description, &line);
        let connected = Rig::connect(&self.description, &mut connection, &terminal);
        let mut rig = match connected {
            Err(_) if terminal.cancelled() => {
                terminal.say("stopped by the operator before anything moved");
                return Ok(Outcome::Aborted);
            }
            other => other?,
        };
        let halt = match work(&mut rig, &terminal) {
            Ok(answer) => {
                answer.print(self.json);
                return Ok(Outcome::Done);
            }
            Err(halt) => halt,
        };
        terminal.finish_stage();
        for line in rig.make_safe(false) {
            terminal.say(line);
        }
        match halt {
            _ if terminal.cancelled() => {
                terminal.say("stopped by the operator");
                Ok(Outcome::Aborted)
            }
            Halt::Failed(error) => Err(error),
            Halt::Cancelled => Err(Error::new("stopped by the operator")),
        }
    }
}

fn status(desk: &Desk) -> Result<Outcome> {
    if desk.dry_run {
        return desk.rehearse("ask every board for its state");
    }
    desk.drive(|rig, _| {
        let boards = rig.states()?;
        // A lamp that does not tell is no reason to hide the rest.
        let lamp = rig.lamp_state().unwrap_or(None);
        Ok(state_answer(&desk.description, &boards, lamp))
    })
}

fn state_answer(rig: &RigDescription, boards: &[BoardState], lamp: Option<bool>) -> Answer {
    let mut lines = Vec::new();
    let mut json_boards = Vec::new();
    for board in boards {
        let homed = if board.homed { "homed" } else { "not homed" };
        lines.push(format!("board {}: {}, {homed}", board.board, board.state));
        lines.push(format!("  firmware {}", board.firmware));
        lines.push(format!(
            "  {:<18}{:>10}{:>12}{:>9}{:>9}",
            "axis", "degrees", "units", "min", "max"
        ));
        let mut axes = Vec::new();
        for (name, motor) in rig.motors_of(&board.board) {
            let deg = board.axes_deg.iter().find(|a| a.0 == name).map(|a| a.1);
            let deg = deg.unwrap_or(f64::NAN);
            let (units, inside) = (
                motor.units(deg) + 0.0,
                (motor.min_deg..=motor.max_deg).contains(&deg),
            );
            let note = if inside { "" } else { "  outside limits" };
            lines.push(format!(
                "  {:<18}{deg:>10.3}{units:>12.3}{:>9}{:>9}{note}",
                name.name(),
                motor.min_deg,
                motor.max_deg
            ));
            axes.push(json!({
                "axis": name.name(), "letter": motor.letter.to_string(), "deg": deg, "units": units,
                "min_deg": motor.min_deg, "max_deg": motor.max_deg, "inside_limits": inside,
            }));
        }
        json_boards.push(json!({
            "board": board.board, "firmware": board.firmware, "state": board.state, "homed": board.homed,
            "axes": axes,
        }));
    }
    lines.push(match lamp {
        Some(true) => "lamp on".to_owned(),
        Some(false) => "lamp off".to_owned(),
        None => "lamp: the device does not tell".to_owned(),
    });
    Answer {
        text: lines.join("\n"),
        json: json!({"rig": rig.name, "boards": json_boards, "lamp": {"on": lamp}}),
    }
}

fn stop(desk: &Desk) -> Result<Outcome> {
    if desk.dry_run {
        return desk.rehearse("tell every board to brake, reset it at standstill, lamp off");
    }
    let line = EmergencyLine::new();
    let mut connection = serial_connection(&desk.description, &line);
    let done = stop_all(&desk.description, &mut connection, &Unwatched);
    let mut failed = Vec::new();
    let mut rows = Vec::new();
    for device in done {
        let (ok, what) = match device.outcome {
            Ok(what) => (true, what),
            Err(error) => {
                failed.push(error.report());
                (false, error.report())
            }
        };
        rows.push((device.device, ok, what));
    }
    let answer = Answer {
        text: rows
            .iter()
            .filter(|r| r.1)
            .map(|(device, _, what)| format!("{device}: {what}"))
            .collect::<Vec<_>>()
            .join("\n"),
        json: json!({"devices": rows
            .iter()
            .map(|(device, ok, what)| json!({"device": device, "stopped": ok, "what": what}))
            .collect::<Vec<_>>()}),
    };
    answer.print(desk.json);
    if failed.is_empty() {
        return Ok(Outcome::Done);
    }
    Err(Error::new(format!("not stopped: {}", failed.join("; ")))
        .with_hint("cut the motors' power if anything still moves"))
}

fn lamp(mut desk: Desk, arguments: &LampArguments) -> Result<Outcome> {
    if let Some(seconds) = arguments.seconds
        && !(0.1..=86_400.0).contains(&seconds)
    {
        return Err(Error::new(format!(
            "--for is {seconds}, expected 0.1 to 86400 seconds"
        )));
    }
    if arguments.switch == Switch::Off {
        if desk.dry_run {
            return desk.rehearse("switch the lamp off");
        }
        return desk.drive(|rig, terminal| {
            if let Err(error) = rig.force_lamp_off() {
                // A locked board refuses the line; a reset switches its output off all the same.
                terminal.say(format!("the lamp refused: {}", error.report()));
                for line in rig.make_safe(true) {
                    terminal.say(line);
                }
            }
            Ok(lamp_answer("lamp off"))
        });
    }
    if desk.dry_run {
        let power = desk.description.lamp.power();
        return desk.rehearse(&format!("switch the lamp on with power {power}, then off"));
    }
    let person = std::io::stdin().is_terminal();
    if arguments.seconds.is_none() && !person {
        return Err(nobody_there("switch the lamp off again?")
            .with_hint("run in a terminal, or give the time: --for SECONDS"));
    }
    // Whoever looks at a lamp does not wait for its warm-up.
    desk.description.lamp.warm_up_s = 0.0;
    let seconds = arguments.seconds.unwrap_or(f64::INFINITY);
    desk.drive(|rig, terminal| {
        rig.lamp_on()?;
        if person {
            terminal.say("lamp on; Enter switches it off");
            if terminal.line_within(seconds)? {
                // The line itself says nothing.
                let _ = std::io::stdin().lock().read_line(&mut String::new());
            }
        } else {
            terminal.say(format!("lamp on for {seconds} s"));
            rig.wait(seconds)?;
        }
        rig.obey()?;
        rig.lamp_off()?;
        Ok(lamp_answer("lamp off again"))
    })
}

fn lamp_answer(text: &str) -> Answer {
    Answer {
        text: text.to_owned(),
        json: json!({"lamp": {"on": false}}),
    }
}

/// The axis of this name.
fn axis_named(text: &str) -> Result<AxisName> {
    AxisName::ALL
        .into_iter()
        .find(|a| a.name() == text)
        .ok_or_else(|| {
            let names: Vec<&str> = AxisName::ALL.iter().map(|a| a.name()).collect();
            Error::new(format!("unknown axis '{text}'"))
                .with_hint(format!("the axes are {}", names.join(", ")))
        })
}
