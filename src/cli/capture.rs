//! `goniofit capture`.

use super::Outcome;
use super::judge::CropJudge;
use super::output::data;
use super::terminal::Terminal;
use crate::base::{Error, Result, Watch};
use crate::measure::FrameJudge;
use crate::rig::capture::{
    Capture, CaptureOptions, CapturePlan, End, Order, Summary, plan_capture,
};
use crate::rig::exposures::Verdict;
use crate::rig::simulated::capture_from_replay;
use crate::rig::{
    AxisName, Camera, Connection, Judge, LampOutput, Operator, Outlook, PlannedShot, ReplayCamera,
    Request, RigDescription, Seen, SerialTransport, SystemClock, Transport, read_wire_log,
};
use crate::session::{Plan, SessionFolder, sha256};
use std::io::{BufRead, IsTerminal};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Move the rig through a plan and record a session
///
/// Checks the whole plan against the rig's limits and bodies before a byte is sent; then homes, shoots the white standard,
/// every configuration and darks, and parks. Each frame is on disk and journaled before the next is taken; it is looked at,
/// and shot again at another exposure when it is clipped or too dark. Ctrl-C pauses after the current shot, twice stops the
/// rig; any fault stops motion and switches the lamp off. An interrupted capture, whatever interrupted it, goes on with
/// --resume.
///
/// Exit codes: 0 all shots are on disk; 1 paused (resumable), or finished with badly exposed configurations; 2 error; 3
/// aborted by the operator; 4 halted by the operator.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  goniofit capture --rig rig_configs/five_axis_grblhal.toml --plan rig_configs/plans/khungurn16.toml --dry-run
      print the checked plan with every axis target and the estimated time; opens no port
  goniofit capture --rig R.toml --plan P.toml --out session --camera gphoto2
      capture with a tethered RAW camera
  goniofit capture --resume session --camera gphoto2
      go on after a pause, a crash, an unplugged cable, a full disk
  goniofit capture --rig R.toml --plan P.toml --out session --camera replay:OLD --replay OLD/wire.jsonl
      play a recorded session back byte for byte; nothing moves
  goniofit capture --rig rig_configs/virtual.toml --plan rig_configs/plans/khungurn16.toml --out trial \\
      --camera replay:mocks/khungurn16_gabardine --port /dev/pts/3 --yes
      drive the board on that port (real, or from `goniofit sim --rig rig_configs/virtual.toml` in another terminal),
      taking frames from a recorded session
  goniofit capture --rig two_board_grbl.toml ... --port camera=/dev/ttyUSB0 --port light=/dev/ttyUSB1")]
pub(crate) struct Arguments {
    /// Rig description
    #[arg(long, value_name = "R.toml", required_unless_present = "resume")]
    rig: Option<PathBuf>,
    /// Plan: which configurations to visit
    #[arg(long, value_name = "P.toml", required_unless_present = "resume")]
    plan: Option<PathBuf>,
    /// New session folder
    #[arg(long, value_name = "DIR", required_unless_present_any = ["dry_run", "resume"])]
    out: Option<PathBuf>,
    /// Go on with the interrupted session in this folder, with its own rig and plan
    #[arg(long, value_name = "DIR", conflicts_with_all = ["rig", "plan", "out", "replay"])]
    resume: Option<PathBuf>,
    /// Port of a device instead of the rig file's: PATH, or BOARD=PATH (or lamp=PATH) for each
    #[arg(long, value_name = "[BOARD=]PATH")]
    port: Vec<String>,
    /// gphoto2, folder:PATH, aravis, uvc, or replay:SESSION
    #[arg(long, required_unless_present = "dry_run")]
    camera: Option<String>,
    /// Play this recorded dialogue instead of opening ports
    #[arg(long, value_name = "WIRE.jsonl", conflicts_with = "port")]
    replay: Option<PathBuf>,
    /// Visit configurations in this order
    #[arg(long, value_enum, default_value_t = OrderName::Short)]
    order: OrderName,
    /// Do not look at frames while capturing: no metering, no re-shooting
    #[arg(long)]
    blind: bool,
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

#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum OrderName {
    /// For short travel
    Short,
    /// As the plan lists them
    Plan,
}

pub(crate) fn run(arguments: Arguments) -> Result<Outcome> {
    let (mut rig, plan) = rig_and_plan(&arguments)?;
    override_ports(&mut rig, &arguments.port)?;
    let order = match arguments.order {
        OrderName::Short => Order::Short,
        OrderName::Plan => Order::Plan,
    };
    let work = plan_capture(&rig, &plan, order)?;
    if let Some(out) = &arguments.out {
        SessionFolder::refuse_existing(out)?;
    }
    if arguments.dry_run {
        let outlook = Outlook::new(&rig, &work, &Default::default());
        print_plan(&rig, &plan, &work, &outlook, arguments.json);
        return Ok(Outcome::Done);
    }
    let camera_name = arguments
        .camera
        .as_ref()
        .ok_or_else(|| Error::new("--camera is needed"))?;
    let mut options = CaptureOptions {
        note: arguments.note.clone(),
        program_sha256: own_sha256(),
        host: host_name(),
        order,
        ..CaptureOptions::default()
    };
    let mut camera = open_camera(camera_name, &rig, &mut options)?;
    let judge = CropJudge(FrameJudge::new(camera.facts(), rig.camera.sample_square_mm));
    let judge = (!arguments.blind).then(|| Box::new(judge) as Box<dyn Judge>);
    let terminal = Terminal::for_hardware()?;
    let person = Person {
        terminal: &terminal,
        yes: arguments.yes || arguments.replay.is_some(),
    };
    let summary = if let (Some(wire), Some(out)) = (&arguments.replay, &arguments.out) {
        terminal.say("replaying a recorded dialogue; nothing moves");
        let entries = read_wire_log(wire)?;
        let camera = camera.as_mut();
        capture_from_replay(&rig, &plan, entries, camera, judge, out, &options, &person)
    } else {
        let capture = Capture {
            description: &rig,
            plan: &plan,
            connection: serial_connection(),
            camera: camera.as_mut(),
            judge,
            operator: &person,
            options,
        };
        match (&arguments.resume, &arguments.out) {
            (Some(folder), _) => capture.resume(folder),
            (None, Some(out)) => capture.start(out),
            (None, None) => Err(Error::new("--out is needed")),
        }
    };
    terminal.finish_stage();
    let summary = summary?;
    print_summary(&terminal, &summary, arguments.json);
    Ok(match summary.end {
        End::Finished if summary.badly_exposed.is_empty() => Outcome::Done,
        End::Finished | End::Paused => Outcome::OutsideTolerance,
        End::Aborted => Outcome::Aborted,
        End::Halted => Outcome::Halted,
    })
}

fn rig_and_plan(arguments: &Arguments) -> Result<(RigDescription, Plan)> {
    if let Some(folder) = &arguments.resume {
        let session = SessionFolder::open(folder)?;
        let rig = RigDescription::read(&folder.join("rig.toml"))?;
        return Ok((rig, session.plan()?));
    }
    match (&arguments.rig, &arguments.plan) {
        (Some(rig), Some(plan)) => Ok((RigDescription::read(rig)?, Plan::read(plan)?)),
        _ => Err(Error::new("--rig and --plan are needed")),
    }
}

/// What program this is, exactly; empty when its file cannot be read.
fn own_sha256() -> String {
    std::env::current_exe()
        .and_then(std::fs::read)
        .map_or(String::new(), |bytes| sha256(&bytes))
}

fn host_name() -> String {
    rustix::system::uname()
        .nodename()
        .to_string_lossy()
        .into_owned()
}

/// The operator at a terminal.
struct Person<'a> {
    terminal: &'a Terminal,
    yes: bool,
}

impl Watch for Person<'_> {
    fn progress(&self, stage: &str, done: u64, total: u64) {
        self.terminal.progress(stage, done, total);
    }
    fn cancelled(&self) -> bool {
        self.terminal.cancelled()
    }
    fn urgent(&self) -> bool {
        self.terminal.urgent()
    }
}

impl Operator for Person<'_> {
    fn request(&self) -> Request {
        if self.urgent() {
            Request::Abort
        } else if self.cancelled() {
            Request::Pause
        } else {
            Request::Go
        }
    }
    fn confirm(&self, question: &str) -> Result<()> {
        ask(self.terminal, question, self.yes)
    }
    fn paused(&self) -> bool {
        false
    }
    fn seen(&self, what: &Seen<'_>) {
        match what {
            Seen::Note(note) => self.terminal.say(note),
            Seen::WarmingUp(seconds) => self
                .terminal
                .say(format!("the lamp warms up for {seconds:.0} s")),
            _ => {}
        }
    }
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
        if let LampOutput::Scpi { port, .. } = &mut rig.lamp.output
            && port.name == name
        {
            path.clone_into(&mut port.path);
            continue;
        }
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

fn open_camera(
    name: &str,
    rig: &RigDescription,
    options: &mut CaptureOptions,
) -> Result<Box<dyn Camera>> {
    if let Some(folder) = name.strip_prefix("replay:") {
        let camera = ReplayCamera::open(Path::new(folder))?;
        let recorded = SessionFolder::open(Path::new(folder))?
            .manifest()?
            .exposures_ms;
        if recorded != rig.camera.exposures_ms {
            return Err(Error::new(format!(
                "{folder} was recorded at exposures {recorded:?} ms, the rig takes {:?} ms",
                rig.camera.exposures_ms
            ))
            .with_hint(format!(
                "use the rig of the recording: --rig {folder}/rig.toml"
            )));
        }
        options.synthetic = camera.is_synthetic();
        return Ok(Box::new(camera));
    }
    if name == "uvc" {
        return open_uvc(rig, options);
    }
    Err(Error::new(format!("unknown camera '{name}'"))
        .with_hint("cameras are replay:SESSION and uvc; tethered RAW cameras are not driven yet"))
}

#[cfg(feature = "uvc")]
fn open_uvc(rig: &RigDescription, options: &mut CaptureOptions) -> Result<Box<dyn Camera>> {
    options
        .note
        .push_str(" [UVC preview frames: 8 bits, automatic exposure, not radiometric]");
    let camera = crate::rig::UvcCamera::open(0, rig.camera.pixel_mm)?;
    Ok(Box::new(camera))
}

#[cfg(not(feature = "uvc"))]
fn open_uvc(_rig: &RigDescription, _options: &mut CaptureOptions) -> Result<Box<dyn Camera>> {
    Err(Error::new("this program was built without UVC cameras")
        .with_hint("install libclang-dev and build with `cargo build --release --features uvc`"))
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
    let end = match summary.end {
        End::Finished => "finished",
        End::Paused => "paused",
        End::Aborted => "aborted",
        End::Halted => "halted",
    };
    let bad: Vec<String> = summary
        .badly_exposed
        .iter()
        .map(|(stop, verdict)| {
            let what = match stop.config {
                Some(c) => format!("configuration {c}"),
                None => stop.kind.name().to_owned(),
            };
            match verdict {
                Verdict::Clipped => format!("{what}: every exposure is clipped"),
                _ => format!("{what}: every exposure is too dark"),
            }
        })
        .collect();
    if json {
        data!(
            "{}",
            serde_json::json!({
                "session": folder.to_string(),
                "frames": summary.frames,
                "frames_planned": summary.frames_planned,
                "end": end,
                "finished": summary.finished(),
                "elapsed_s": summary.elapsed,
                "badly_exposed": bad,
            })
        );
    } else {
        data!("{folder}");
    }
    for line in summary.stopped.iter().chain(&bad) {
        terminal.say(line);
    }
    terminal.say(format!(
        "{end}: {} of {} frames, {:.0} s of the rig's time",
        summary.frames, summary.frames_planned, summary.elapsed
    ));
    if !summary.finished() {
        terminal.say(format!("go on with `goniofit capture --resume {folder}`"));
    }
}

/// The stops of a list of shots, each with its number of frames.
fn stops(shots: &[PlannedShot]) -> Vec<(&PlannedShot, usize)> {
    let mut stops: Vec<(&PlannedShot, usize)> = Vec::new();
    for planned in shots {
        let key = |p: &PlannedShot| (p.shot.kind, p.shot.config, p.shot.visit);
        match stops.last_mut() {
            Some((first, frames)) if key(first) == key(planned) => *frames += 1,
            _ => stops.push((planned, 1)),
        }
    }
    stops
}

fn print_plan(
    rig: &RigDescription,
    plan: &Plan,
    work: &CapturePlan,
    outlook: &Outlook,
    json: bool,
) {
    let shots = outlook.shots();
    let stops = stops(shots);
    if json {
        let stops: Vec<serde_json::Value> = stops
            .iter()
            .map(|(s, frames)| {
                serde_json::json!({
                    "kind": s.shot.kind.name(),
                    "config": s.shot.config,
                    "frames": frames,
                    "axes_deg": s.angles.by_name(),
                })
            })
            .collect();
        data!(
            "{}",
            serde_json::json!({
                "rig": rig.name, "plan": plan.name, "frames": shots.len(), "stops": stops,
                "seconds": outlook.seconds_left(),
                "travel_seconds": work.tour.as_ref().map(|t| t.seconds),
                "shortest_travel_seconds": work.tour.as_ref().map(|t| t.lower_bound),
                "clearance_checked": rig.clearance_is_checked(),
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
    data!("kind       config  frames  {}", heads.join("  "));
    for (stop, frames) in stops {
        let config = stop.shot.config.map_or("-".to_owned(), |c| c.to_string());
        let angles: Vec<String> = AxisName::ALL
            .iter()
            .map(|a| format!("{:>w$.3}", stop.angles.get(*a), w = a.name().len()))
            .collect();
        data!(
            "{:<9}  {config:>6}  {frames:>6}  {}",
            stop.shot.kind.name(),
            angles.join("  ")
        );
    }
    if let Some(tour) = &work.tour {
        let excess = 100.0 * (tour.seconds / tour.lower_bound - 1.0);
        data!(
            "# travel and settling {:.1} s, {}",
            tour.seconds,
            if excess < 0.05 {
                "the shortest there is".to_owned()
            } else {
                format!("at most {excess:.1} % above the shortest")
            }
        );
    }
    data!(
        "# {}",
        if rig.clearance_is_checked() {
            "limits and clearance checked on every way"
        } else {
            "limits checked; clearance not: the rig file names no bodies"
        }
    );
    data!(
        "# estimated time {:.0} s, homing and downloads not counted",
        outlook.seconds_left()
    );
}
