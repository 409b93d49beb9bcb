//! `goniofit capture`.

use super::Outcome;
use super::output::data;
use super::terminal::Terminal;
use crate::base::{Error, Result, Watch};
use crate::rig::capture::{self, CaptureOptions, PlannedShot, Summary};
use crate::rig::simulated::capture_from_replay;
use crate::rig::{
    AxisName, Camera, CameraWiring, Connection, RigDescription, SerialTransport, SystemClock,
    Transport, read_wire_log,
};
use crate::session::{FrameKind, Plan, SessionFolder};
use std::io::{BufRead, IsTerminal};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Move the rig through a plan and record a session
///
/// Checks the whole plan against the rig's limits before a byte is sent; then homes, shoots the white standard, every
/// configuration and darks, and parks. Each frame is on disk before the next is taken. Ctrl-C stops after the current
/// shot; any fault stops motion and switches the lamp off.
///
/// Cameras: gphoto2 (tethered RAW), folder:PATH (any tethering program), replay:SESSION (recorded frames); with the
/// `aravis` feature GenICam cameras; with the `uvc` feature a webcam for preview and alignment, not radiometric.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  goniofit capture --rig rig_configs/five_axis_grblhal.toml --plan rig_configs/plans/khungurn16.toml --dry-run
      print the checked plan with every axis target; opens no port
  goniofit capture --rig R.toml --plan P.toml --out session --camera replay:OLD --replay OLD/wire.jsonl
      play a recorded session back byte for byte; nothing moves
  goniofit capture --rig rig_configs/virtual.toml --plan rig_configs/plans/khungurn16.toml --out trial \\
      --camera replay:mocks/khungurn16_gabardine --port /dev/pts/3 --yes
      drive the board on that port (real, or from `goniofit sim --rig rig_configs/virtual.toml` in another terminal),
      taking frames from a recorded session
  goniofit capture --rig two_board_grbl.toml ... --port camera=/dev/ttyUSB0 --port light=/dev/ttyUSB1")]
pub(crate) struct Arguments {
    /// Rig description
    #[arg(long, value_name = "R.toml")]
    rig: PathBuf,
    /// Plan: which configurations to visit
    #[arg(long, value_name = "P.toml")]
    plan: PathBuf,
    /// New session folder
    #[arg(long, value_name = "DIR", required_unless_present = "dry_run")]
    out: Option<PathBuf>,
    /// Port of a board instead of the rig file's: PATH, or BOARD=PATH for each board
    #[arg(long, value_name = "[BOARD=]PATH")]
    port: Vec<String>,
    /// gphoto2[:PORT], folder:PATH, aravis[:ID], uvc[:N] or replay:SESSION
    #[arg(long, required_unless_present = "dry_run")]
    camera: Option<String>,
    /// Play this recorded dialogue instead of opening ports
    #[arg(long, value_name = "WIRE.jsonl", conflicts_with = "port")]
    replay: Option<PathBuf>,
    /// Print the checked plan and stop
    #[arg(long)]
    dry_run: bool,
    /// Answer every question with yes
    #[arg(long)]
    yes: bool,
    /// Free text for the session's manifest
    #[arg(long, default_value = "")]
    note: String,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: Arguments) -> Result<Outcome> {
    let mut rig = RigDescription::read(&arguments.rig)?;
    let plan = Plan::read(&arguments.plan)?;
    override_ports(&mut rig, &arguments.port)?;
    let mut options = CaptureOptions::of(&rig);
    options.note.clone_from(&arguments.note);
    let shots = capture::planned_shots(&rig, &plan, &options)?;
    if let Some(out) = &arguments.out
        && out.join("session.json").exists()
    {
        return Err(
            Error::new(format!("{} already holds a session", out.display()))
                .with_hint("a session is never overwritten; choose another folder"),
        );
    }
    if arguments.dry_run {
        print_plan(&rig, &plan, &shots, arguments.json);
        return Ok(Outcome::Done);
    }
    let (Some(out), Some(camera_name)) = (&arguments.out, &arguments.camera) else {
        return Err(Error::new("--out and --camera are needed"));
    };
    let terminal = Terminal::for_hardware()?;
    let wiring = CameraWiring {
        clock: Arc::new(SystemClock::new()),
        watch: &terminal,
        whole: &|bytes| crate::measure::decode(bytes).map(drop),
        say: &|text| terminal.say(text),
    };
    let mut camera = open_camera(camera_name, &rig, &mut options, wiring)?;
    if let Some(warning) = camera.warning() {
        terminal.say(format!("warning: {warning}"));
    }
    let summary = if let Some(wire) = &arguments.replay {
        let entries = read_wire_log(wire)?;
        terminal.say("replaying a recorded dialogue; nothing moves");
        let mut nobody = |_: &str| Ok(());
        capture_from_replay(
            &rig,
            &plan,
            entries,
            camera.as_mut(),
            out,
            &options,
            &mut nobody,
            &terminal,
        )
    } else {
        let yes = arguments.yes;
        terminal.say(format!(
            "the lamp warms up for {} s each time it is switched on",
            rig.lamp.warm_up_s
        ));
        capture::run(
            &rig,
            &plan,
            serial_connection(),
            camera.as_mut(),
            out,
            &options,
            &mut |question| ask(&terminal, question, yes),
            &terminal,
        )
    };
    terminal.finish_stage();
    let summary = summary?;
    print_summary(&terminal, &summary, arguments.json);
    Ok(if summary.finished {
        Outcome::Done
    } else {
        Outcome::OutsideTolerance
    })
}

fn override_ports(rig: &mut RigDescription, ports: &[String]) -> Result<()> {
    for given in ports {
        let names: Vec<String> = rig.boards.iter().map(|b| b.name.clone()).collect();
        let (name, path) = match given.split_once('=') {
            Some((name, path)) => (name, path),
            None if names.len() == 1 => (names[0].as_str(), given.as_str()),
            None => {
                return Err(
                    Error::new(format!("--port {given}: the rig has several boards")).with_hint(
                        format!(
                            "write --port BOARD={given}; the boards are {}",
                            names.join(", ")
                        ),
                    ),
                );
            }
        };
        let board = rig.boards.iter_mut().find(|b| b.name == name);
        let board = board.ok_or_else(|| {
            Error::new(format!("--port {given}: unknown board '{name}'"))
                .with_hint(format!("the boards are {}", names.join(", ")))
        })?;
        path.clone_into(&mut board.port);
    }
    Ok(())
}

fn serial_connection() -> Connection<'static> {
    Connection {
        open: Box::new(|board| {
            let port = SerialTransport::open(&board.path, board.baud, board.dtr)?;
            Ok(Box::new(port) as Box<dyn Transport>)
        }),
        clock: Arc::new(SystemClock::new()),
        wait_scale: 1.0,
    }
}

/// Opens the camera; of a recorded session the exposures must be the rig's.
fn open_camera<'a>(
    name: &str,
    rig: &RigDescription,
    options: &mut CaptureOptions,
    wiring: CameraWiring<'a>,
) -> Result<Box<dyn Camera + 'a>> {
    if let Some(folder) = name.strip_prefix("replay:") {
        let recorded = SessionFolder::open(Path::new(folder))?.manifest()?;
        if recorded.exposures_ms != options.exposures_ms {
            return Err(Error::new(format!(
                "{folder} was recorded at exposures {:?} ms, the rig takes {:?} ms",
                recorded.exposures_ms, options.exposures_ms
            ))
            .with_hint(format!(
                "use the rig of the recording: --rig {folder}/rig.toml"
            )));
        }
        options.synthetic = recorded.synthetic;
    }
    let camera = crate::rig::open_camera(name, rig, wiring)?;
    if let Some(warning) = camera.warning() {
        options.note.push_str(&format!(" [{warning}]"));
    }
    Ok(camera)
}

/// Asks the operator; Enter or y goes on.
fn ask(terminal: &Terminal, question: &str, yes: bool) -> Result<()> {
    if yes {
        terminal.say(format!("{question}: yes (--yes)"));
        return Ok(());
    }
    if !std::io::stdin().is_terminal() {
        return Err(Error::new(format!("nobody is there to answer: {question}"))
            .with_hint("run in a terminal, or pass --yes when everything is in place"));
    }
    terminal.say(format!("{question} [Enter = done, n = stop]"));
    wait_for_stdin(terminal)?;
    let mut answer = String::new();
    let read = std::io::stdin().lock().read_line(&mut answer);
    match answer.trim().to_lowercase().as_str() {
        "" | "y" | "yes" if matches!(read, Ok(n) if n > 0) => Ok(()),
        _ => Err(Error::new(format!("the operator declined: {question}"))),
    }
}

/// Waits until there is a line to read, or Ctrl-C was pressed.
fn wait_for_stdin(terminal: &Terminal) -> Result<()> {
    use rustix::event::{PollFd, PollFlags, Timespec, poll};
    let stdin = std::io::stdin();
    let look = Timespec {
        tv_sec: 0,
        tv_nsec: 100_000_000,
    };
    loop {
        if terminal.cancelled() {
            return Err(Error::new("stopped by the operator"));
        }
        match poll(&mut [PollFd::new(&stdin, PollFlags::IN)], Some(&look)) {
            Ok(0) | Err(rustix::io::Errno::INTR) => {}
            Ok(_) => return Ok(()),
            Err(e) => return Err(Error::new("the terminal cannot be read").with_source(e)),
        }
    }
}

fn print_summary(terminal: &Terminal, summary: &Summary, json: bool) {
    let folder = summary.session.root().display();
    if json {
        data!(
            "{}",
            serde_json::json!({
                "session": folder.to_string(),
                "frames": summary.frames,
                "frames_planned": summary.frames_planned,
                "finished": summary.finished,
                "elapsed_s": summary.elapsed,
            })
        );
    } else {
        data!("{folder}");
    }
    let end = if summary.finished {
        "finished"
    } else {
        "stopped by the operator"
    };
    terminal.say(format!(
        "{end}: {} of {} frames in {:.0} s of the rig's time",
        summary.frames, summary.frames_planned, summary.elapsed
    ));
}

fn print_plan(rig: &RigDescription, plan: &Plan, shots: &[PlannedShot], json: bool) {
    // Each place is visited once, whatever the number of exposures there.
    let mut stops: Vec<&PlannedShot> = Vec::new();
    for shot in shots {
        let same =
            |s: &&PlannedShot| (s.shot.kind, s.shot.config) == (shot.shot.kind, shot.shot.config);
        if !stops.last().is_some_and(same) {
            stops.push(shot);
        }
    }
    let count = |stop: &PlannedShot| {
        let key = (stop.shot.kind, stop.shot.config);
        shots
            .iter()
            .filter(|s| (s.shot.kind, s.shot.config) == key)
            .count()
    };
    let name = FrameKind::name;
    if json {
        let stops: Vec<serde_json::Value> = stops
            .iter()
            .map(|s| {
                serde_json::json!({
                    "kind": name(s.shot.kind),
                    "config": s.shot.config,
                    "frames": count(s),
                    "axes_deg": s.angles.by_name(),
                })
            })
            .collect();
        data!(
            "{}",
            serde_json::json!({
                "rig": rig.name, "plan": plan.name, "frames": shots.len(), "stops": stops
            })
        );
        return;
    }
    data!(
        "# rig {}, plan {}, {} frames; degrees",
        rig.name,
        plan.name,
        shots.len()
    );
    let heads: Vec<&str> = AxisName::ALL.iter().map(|a| a.name()).collect();
    data!("kind    config  frames  {}", heads.join("  "));
    for stop in stops {
        let config = stop.shot.config.map_or("-".to_owned(), |c| c.to_string());
        let angles: Vec<String> = AxisName::ALL
            .iter()
            .map(|a| format!("{:>w$.3}", stop.angles.get(*a), w = a.name().len()))
            .collect();
        data!(
            "{:<6}  {config:>6}  {:>6}  {}",
            name(stop.shot.kind),
            count(stop),
            angles.join("  ")
        );
    }
}
