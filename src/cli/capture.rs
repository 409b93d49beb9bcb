//! `goniofit capture`.

use super::Outcome;
use super::judge::CropJudge;
use super::output::data;
use super::ports::{override_ports, serial_connection};
use super::screen::{Screen, Setup};
use crate::base::{Error, Result};
use crate::measure::FrameJudge;
use crate::rig::capture::{
    Capture, CaptureOptions, CapturePlan, End, Order, Summary, plan_capture,
};
use crate::rig::exposures::Verdict;
use crate::rig::simulated::capture_from_replay;
use crate::rig::{
    self, AxisName, Camera, CameraWiring, EmergencyLine, Judge, Outlook, PlannedShot,
    RigDescription, SystemClock, read_wire_log,
};
use crate::session::{FrameKind, Plan, SessionFolder, sha256};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Move the rig through a plan and record a session
///
/// Checks the whole plan against the rig's limits and bodies before a byte is sent; then homes, shoots the white standard,
/// every configuration and darks, and parks. A plan may say that it shows a flat, chart or board for a calibration. Each frame is on disk and journaled before the next is taken; it is looked at,
/// and shot again at another exposure when it is clipped or too dark. Ctrl-C pauses after the current shot, twice stops the
/// rig; any fault stops motion and switches the lamp off. An interrupted capture, whatever interrupted it, goes on with
/// --resume.
///
/// Cameras: gphoto2 (tethered RAW), folder:PATH (any tethering program), replay:SESSION (recorded frames); with the
/// `aravis` feature GenICam cameras; with the `uvc` feature a webcam for preview and alignment, not radiometric.
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
  goniofit capture --rig R.toml --plan rig_configs/plans/linearity.toml --out linearity --camera gphoto2 \\
      --exposures-ms 1,2,4,8,16,32,64,128,256,512 --repeats 2
      a calibration: many exposures of one evenly bright thing, two frames each, and darks of each
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
    /// gphoto2[:PORT], folder:PATH, aravis[:ID], uvc[:N] or replay:SESSION
    #[arg(long, required_unless_present = "dry_run")]
    camera: Option<String>,
    /// Play this recorded dialogue instead of opening ports
    #[arg(long, value_name = "WIRE.jsonl", conflicts_with = "port")]
    replay: Option<PathBuf>,
    /// Visit configurations in this order
    #[arg(long, value_enum, default_value_t = OrderName::Short)]
    order: OrderName,
    /// Take all of these exposures, milliseconds, ascending, of everything, instead of the rig file's list and metering
    #[arg(
        long,
        value_name = "MS,MS,...",
        value_delimiter = ',',
        conflicts_with = "resume"
    )]
    exposures_ms: Option<Vec<f64>>,
    /// Take this many frames of each exposure, darks included, instead of what the rig file says
    #[arg(long, value_name = "N", conflicts_with = "resume")]
    repeats: Option<u32>,
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
    let options = CaptureOptions {
        note: arguments.note.clone(),
        program_sha256: own_sha256(),
        host: host_name(),
        order,
        ..CaptureOptions::default()
    };
    let folder = arguments.resume.as_ref().or(arguments.out.as_ref());
    let folder = folder.ok_or_else(|| Error::new("--out is needed"))?;
    super::measure::quiet_decoder_panics();
    let screen = Screen::new(&Setup {
        rig: &rig,
        plan: &plan,
        session: folder,
        yes: arguments.yes || arguments.replay.is_some(),
    })?;
    let summary = capture(&arguments, &rig, &plan, folder, &screen, options);
    drop(screen);
    let summary = summary?;
    print_summary(&summary, arguments.json);
    Ok(match summary.end {
        End::Finished if summary.badly_exposed.is_empty() => Outcome::Done,
        End::Finished | End::Paused => Outcome::OutsideTolerance,
        End::Aborted => Outcome::Aborted,
        End::Halted => Outcome::Halted,
    })
}

fn capture(
    arguments: &Arguments,
    rig: &RigDescription,
    plan: &Plan,
    folder: &Path,
    screen: &Screen,
    mut options: CaptureOptions,
) -> Result<Summary> {
    let camera = arguments.camera.as_ref();
    let camera = camera.ok_or_else(|| Error::new("--camera is needed"))?;
    let wiring = CameraWiring {
        clock: Arc::new(SystemClock::new()),
        watch: screen,
        whole: &|bytes| crate::measure::decode(bytes).map(drop),
        say: &|text| screen.say(text),
    };
    let mut camera = open_camera(camera, rig, &mut options, wiring)?;
    let warning = camera.warning();
    if let Some(warning) = &warning {
        screen.say(format!("warning: {warning}"));
    }
    // Frames that are not radiometric cannot be judged.
    let blind = arguments.blind || warning.is_some();
    let judge = CropJudge(FrameJudge::new(camera.facts(), rig.camera.sample_square_mm));
    let judge = (!blind).then(|| Box::new(judge) as Box<dyn Judge>);
    if let Some(wire) = &arguments.replay {
        screen.say("replaying a recorded dialogue; nothing moves");
        let entries = read_wire_log(wire)?;
        let camera = camera.as_mut();
        return capture_from_replay(rig, plan, entries, camera, judge, folder, &options, screen);
    }
    let line = EmergencyLine::new();
    let stops = line.clone();
    screen.on_stop(Box::new(move |_| {
        // Whoever takes no bytes is told by the stop that follows in the loop.
        let _ = stops.fire();
    }));
    let capture = Capture {
        description: rig,
        plan,
        connection: serial_connection(rig, &line),
        camera: camera.as_mut(),
        judge,
        operator: screen,
        options,
    };
    if arguments.resume.is_some() {
        capture.resume(folder)
    } else {
        capture.start(folder)
    }
}

fn rig_and_plan(arguments: &Arguments) -> Result<(RigDescription, Plan)> {
    if let Some(folder) = &arguments.resume {
        let session = SessionFolder::open(folder)?;
        let rig = RigDescription::read(&folder.join("rig.toml"))?;
        return Ok((rig, session.plan()?));
    }
    match (&arguments.rig, &arguments.plan) {
        (Some(rig), Some(plan)) => {
            let mut rig = RigDescription::read(rig)?;
            if arguments.exposures_ms.is_some() || arguments.repeats.is_some() {
                rig = rig.with_exposures(arguments.exposures_ms.as_deref(), arguments.repeats)?;
            }
            Ok((rig, Plan::read(plan)?))
        }
        _ => Err(Error::new("--rig and --plan are needed")),
    }
}

/// What program this is, exactly; empty when its file cannot be read.
pub(super) fn own_sha256() -> String {
    std::env::current_exe()
        .and_then(std::fs::read)
        .map_or(String::new(), |bytes| sha256(&bytes))
}

/// Name of the computer.
pub(super) fn host_name() -> String {
    rustix::system::uname()
        .nodename()
        .to_string_lossy()
        .into_owned()
}

/// As [`rig::open_camera`]; a recorded session must fit what the rig takes.
fn open_camera<'a>(
    name: &str,
    rig: &RigDescription,
    options: &mut CaptureOptions,
    wiring: CameraWiring<'a>,
) -> Result<Box<dyn Camera + 'a>> {
    if let Some(folder) = name.strip_prefix("replay:") {
        let recorded = SessionFolder::open(Path::new(folder))?.manifest()?;
        if recorded.exposures_ms != rig.camera.exposures_ms {
            return Err(Error::new(format!(
                "{folder} was recorded at exposures {:?} ms, the rig takes {:?} ms",
                recorded.exposures_ms, rig.camera.exposures_ms
            ))
            .with_hint(format!(
                "use the rig of the recording: --rig {folder}/rig.toml"
            )));
        }
        options.synthetic = recorded.synthetic;
    }
    let camera = rig::open_camera(name, rig, wiring)?;
    if let Some(warning) = camera.warning() {
        options.note.push_str(&format!(" [{warning}]"));
    }
    Ok(camera)
}

fn print_summary(summary: &Summary, json: bool) {
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
        eprintln!("{line}");
    }
    eprintln!(
        "{end}: {} of {} frames, {:.0} s of the rig's time",
        summary.frames, summary.frames_planned, summary.elapsed
    );
    if !summary.finished() {
        eprintln!("go on with `goniofit capture --resume {folder}`");
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
                "rig": rig.name, "plan": plan.name, "shows": plan.shows.name(), "frames": shots.len(), "stops": stops,
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
    if plan.shows != FrameKind::Sample {
        data!("# in the sample's place: {}", plan.shows.name());
    }
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
            // A single stop needs no travel at all.
            if excess.is_nan() || excess < 0.05 {
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
