//! The capture loop: the only code that moves a rig through a plan.
//!
//! Checks the whole plan before a byte is sent, then connects, homes, and asks [`CapturePlan::next`] for one shot after
//! the other. Every frame is on disk and journaled before the next one is asked for; a session that was cut short, by
//! whatever, goes on from its journal with [`Capture::resume`]. Whatever fails: motion stops, the lamp goes off, the
//! journal says why, and what is on disk stays.
//!
//! A request to pause is obeyed before the next motion or shot, or within 0.1 s while something settles or warms up; a
//! motion under way ends where it was going. Every more urgent request stops motion within 0.1 s, whatever is going on,
//! but for an exposure: the stop comes when the camera returns, and that frame is not kept.
//!
//! Does not reconnect by itself: after a lost device the position is unknown, and somebody should look before it moves.

mod work;

pub use super::shots::{
    CaptureOptions, CapturePlan, Order, PlannedShot, Stop, plan_capture, white_id,
};

use super::description::RigDescription;
use super::devices::{Camera, Judge};
use super::exposures::Verdict;
use super::machine::{Connection, Opener, Rig};
use super::operator::Operator;
use super::outlook::Outlook;
use super::shots::History;
use super::utc::utc_now;
use super::wire_log::{RecordingTransport, WireLog};
use crate::base::{Context, Error, Result};
use crate::session::{Event, Journal, Manifest, Plan, Provenance, SessionFolder};
use std::path::Path;
use std::sync::Arc;
use work::Loop;

/// How a capture ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum End {
    /// All shots are on disk.
    Finished,
    /// The operator paused it and did not go on; the rig stands, its position was known.
    Paused,
    /// The operator ended it; motion was stopped with its position kept.
    Aborted,
    /// The operator stopped it the fastest way.
    Halted,
}

/// What a capture left.
#[derive(Debug, Clone)]
pub struct Summary {
    /// The session.
    pub session: SessionFolder,
    /// Frames on disk.
    pub frames: usize,
    /// Frames there would be at the end, as far as is known.
    pub frames_planned: usize,
    /// Seconds on the rig's clock.
    pub elapsed: f64,
    /// How it ended.
    pub end: End,
    /// What was done to stop, when it was stopped.
    pub stopped: Vec<String>,
    /// Stops without a well exposed frame.
    pub badly_exposed: Vec<(Stop, Verdict)>,
}

impl Summary {
    /// True when all shots are on disk.
    pub fn finished(&self) -> bool {
        self.end == End::Finished
    }
}

/// Everything a capture is made of.
pub struct Capture<'a> {
    /// The rig.
    pub description: &'a RigDescription,
    /// What to visit.
    pub plan: &'a Plan,
    /// How the rig is reached.
    pub connection: Connection<'a>,
    /// The camera.
    pub camera: &'a mut dyn Camera,
    /// Who looks at each frame; without one nothing is metered or shot again.
    pub judge: Option<Box<dyn Judge + 'a>>,
    /// The person in front of the rig.
    pub operator: &'a dyn Operator,
    /// The rest.
    pub options: CaptureOptions,
}

impl Capture<'_> {
    /// Captures into the new session folder `out`; the wire log goes to `wire.jsonl` in it.
    ///
    /// # Errors
    /// The plan or the folder is refused (nothing was sent then), or a device or the disk fails: motion is stopped, the
    /// lamp off, the journal has `stopped`, and the message says what is safe on disk.
    pub fn start(self, out: &Path) -> Result<Summary> {
        SessionFolder::refuse_existing(out)?;
        self.run(|capture, rig| {
            let manifest = capture.manifest(rig)?;
            let text = &capture.description.text;
            let (session, journal) = SessionFolder::create(out, &manifest, capture.plan, text)?;
            Ok((session, journal, History::default(), 0.0))
        })
    }

    /// Goes on with an interrupted session: finished shots are kept, the rig is homed again.
    ///
    /// # Errors
    /// It is no session of this rig and plan, it is complete, or as [`Capture::start`].
    pub fn resume(self, root: &Path) -> Result<Summary> {
        let manifest = SessionFolder::open(root)?.manifest()?;
        let recorded = &manifest.provenance.config_sha256;
        if *recorded != config_sha256(&self.description.text, self.plan)? {
            return Err(Error::new(format!(
                "{} was begun with another rig file or plan",
                root.display()
            ))
            .with_hint(
                "resume with the session's own rig.toml and plan.toml; only ports may differ",
            ));
        }
        self.same_camera(&manifest)
            .context(|| format!("{} cannot be continued", root.display()))?;
        let (session, journal, entries) = SessionFolder::resume(root)?;
        if entries.iter().any(|e| e.event == Event::Finished) {
            return Err(Error::new(format!("{} is complete", root.display()))
                .with_hint("measure it with `goniofit measure session`"));
        }
        let elapsed = entries.last().map_or(0.0, |e| e.elapsed_s);
        let history = History::of(&entries);
        self.run(|_, _| Ok((session, journal, history, elapsed)))
    }

    /// A session has one camera.
    fn same_camera(&self, manifest: &Manifest) -> Result<()> {
        let (was, is) = (&manifest.camera, self.camera.facts());
        let (old, new) = (&manifest.provenance.camera_serial, self.camera.serial());
        let other = !old.is_empty() && !new.is_empty() && *old != new;
        if *was == is && !other && manifest.synthetic == self.options.synthetic {
            return Ok(());
        }
        Err(Error::new(format!(
            "it was begun with camera {} {old} ({} x {}, synthetic: {}), this is {} {new} ({} x {}, synthetic: {})",
            was.name,
            was.width,
            was.height,
            manifest.synthetic,
            is.name,
            is.width,
            is.height,
            self.options.synthetic
        ))
        .with_hint("connect the session's camera, or capture into a new folder"))
    }

    fn run(
        mut self,
        open: impl FnOnce(&Self, &Rig) -> Result<(SessionFolder, Journal, History, f64)>,
    ) -> Result<Summary> {
        let plan = plan_capture(self.description, self.plan, self.options.order)?;
        if plan.needs_judge() && self.judge.is_none() {
            return Err(Error::new("metering needs somebody to look at the frames")
                .with_hint("set camera.metering = \"fixed\" in the rig file"));
        }
        let clock = self.connection.clock.clone();
        let begun = clock.now();
        let log = WireLog::new();
        let wait_scale = self.connection.wait_scale;
        let mut recorded = Connection {
            open: record(&mut self.connection, &log),
            clock: clock.clone(),
            wait_scale,
        };
        let operator = self.operator;
        let mut rig = Rig::connect(self.description, &mut recorded, operator)
            .context(|| "the capture did not begin, nothing was moved")?;
        drop(recorded);
        let (session, journal, history, earlier) = open(&self, &rig)?;
        log.write_to(&new_wire_log(&session))?;
        Loop {
            outlook: Outlook::new(self.description, &plan, &history),
            plan,
            rig: &mut rig,
            camera: self.camera,
            judge: self.judge,
            operator,
            session,
            journal,
            history,
            log: &log,
            clock: clock.as_ref(),
            begun,
            earlier,
            in_place: None,
            at: None,
        }
        .finish()
    }

    fn manifest(&self, rig: &Rig) -> Result<Manifest> {
        Ok(Manifest {
            format: Manifest::FORMAT.to_owned(),
            program: format!("goniofit {}", env!("CARGO_PKG_VERSION")),
            started_utc: self.options.started_utc.clone().unwrap_or_else(utc_now),
            note: self.options.note.clone(),
            synthetic: self.options.synthetic,
            rig: self.description.name.clone(),
            camera: self.camera.facts(),
            white: self.description.white.reference(self.plan),
            sample_square_mm: self.description.camera.sample_square_mm,
            exposures_ms: self.description.camera.exposures_ms.clone(),
            provenance: Provenance {
                config_sha256: config_sha256(&self.description.text, self.plan)?,
                program_sha256: self.options.program_sha256.clone(),
                firmware: rig.dump(),
                camera_serial: self.camera.serial(),
                host: self.options.host.clone(),
            },
        })
    }
}

/// What makes two captures the same work: the texts of rig and plan.
///
/// # Errors
/// As [`Plan::to_toml`].
pub fn config_sha256(rig_toml: &str, plan: &Plan) -> Result<String> {
    let text = format!("{rig_toml}\0{}", plan.to_toml()?);
    Ok(crate::session::sha256(text.as_bytes()))
}

/// `wire.jsonl`, or the first of `wire-2.jsonl`, ... that is not there: each run has its own.
fn new_wire_log(session: &SessionFolder) -> std::path::PathBuf {
    let name = |n: u32| match n {
        1 => "wire.jsonl".to_owned(),
        n => format!("wire-{n}.jsonl"),
    };
    (1..)
        .map(|n| session.root().join(name(n)))
        .find(|p| !p.exists())
        .unwrap_or_else(|| session.root().join("wire.jsonl"))
}

/// The connection's opener with every stream recorded.
fn record<'a>(connection: &'a mut Connection, log: &WireLog) -> Opener<'a> {
    let log = log.clone();
    let clock = connection.clock.clone();
    let open = &mut connection.open;
    Box::new(move |port| {
        let inner = open(port)?;
        Ok(Box::new(RecordingTransport::new(
            inner,
            &port.name,
            Arc::clone(&clock),
            log.clone(),
        )))
    })
}
