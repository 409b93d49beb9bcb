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

pub use super::shots::{
    CaptureOptions, CapturePlan, Order, PlannedShot, Stop, plan_capture, white_id,
};

use super::description::RigDescription;
use super::devices::{Camera, CapturedFrame, Judge, Shot};
use super::exposures::Verdict;
use super::kinematics::AxisAngles;
use super::machine::{Connection, Halt, Opener, Rig, Step};
use super::operator::{Operator, Request, Seen, Taken};
use super::outlook::Outlook;
use super::shots::History;
use super::transport::Clock;
use super::utc::utc_now;
use super::wire_log::{RecordingTransport, WireLog};
use crate::base::{Context, Error, Result};
use crate::session::{
    Event, Exposedness, FrameKind, FrameRecord, Journal, Manifest, Plan, Provenance, SessionFolder,
    WhiteReference,
};
use std::path::Path;
use std::sync::Arc;

/// How often a frame that cannot be decoded is shot again.
const TORN_FRAMES: u32 = 2;

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
        if *recorded != config_sha256(self.description, self.plan)? {
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
        let white = &self.description.white;
        Ok(Manifest {
            format: Manifest::FORMAT.to_owned(),
            program: format!("goniofit {}", env!("CARGO_PKG_VERSION")),
            started_utc: self.options.started_utc.clone().unwrap_or_else(utc_now),
            note: self.options.note.clone(),
            synthetic: self.options.synthetic,
            rig: self.description.name.clone(),
            camera: self.camera.facts(),
            white: WhiteReference {
                configuration: white.configuration(white_id(self.plan)),
                reflectance_factor: white.reflectance_factor,
                reflectance_factor_se: white.reflectance_factor_se,
            },
            sample_square_mm: self.description.camera.sample_square_mm,
            exposures_ms: self.description.camera.exposures_ms.clone(),
            provenance: Provenance {
                config_sha256: config_sha256(self.description, self.plan)?,
                program_sha256: self.options.program_sha256.clone(),
                firmware: rig.dump(),
                camera_serial: self.camera.serial(),
                host: self.options.host.clone(),
            },
        })
    }
}

/// What makes two captures the same work: the texts of rig and plan.
fn config_sha256(description: &RigDescription, plan: &Plan) -> Result<String> {
    let mut text = description.text.clone();
    text.push('\0');
    text.push_str(&plan.to_toml()?);
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

struct Loop<'a, 'w> {
    plan: CapturePlan,
    outlook: Outlook,
    rig: &'a mut Rig<'w>,
    camera: &'a mut dyn Camera,
    judge: Option<Box<dyn Judge + 'a>>,
    operator: &'a dyn Operator,
    session: SessionFolder,
    journal: Journal,
    history: History,
    log: &'a WireLog,
    clock: &'a dyn Clock,
    /// The rig's clock when this run began.
    begun: f64,
    /// Seconds the session had lasted before.
    earlier: f64,
    /// What lies under the camera, as far as the operator was asked.
    in_place: Option<FrameKind>,
    at: Option<AxisAngles>,
}

impl Loop<'_, '_> {
    fn elapsed(&self) -> f64 {
        self.earlier + self.clock.now() - self.begun
    }

    /// Works until all shots are taken or somebody or something ends it.
    fn finish(mut self) -> Result<Summary> {
        let frames_before = self.history.len();
        loop {
            let error = match self.stretch() {
                Ok(()) => return Ok(self.summary(End::Finished, Vec::new())),
                Err(Halt::Cancelled) => None,
                Err(Halt::Failed(error)) => Some(error),
            };
            let mut done = Vec::new();
            let mut end = match (asked_end(self.operator.request()), error) {
                (Some(end), _) => self.stop_as_asked(end, &mut done),
                (None, Some(error)) => return Err(self.give_up(error, frames_before)),
                (None, None) => End::Paused,
            };
            if end == End::Paused {
                if self.operator.paused() {
                    self.take_up();
                    continue;
                }
                // The pause itself may have ended in something more urgent, and the boards have heard of it already.
                if let Some(more) = asked_end(self.operator.request()) {
                    end = self.stop_as_asked(more, &mut done);
                }
            }
            if let Err(error) = self.rig.lamp_off() {
                done.push(error.report());
                done.extend(self.stop(End::Aborted));
            }
            let reason = match end {
                End::Aborted => "stopped by the operator",
                End::Halted => "stopped at once by the operator",
                End::Paused | End::Finished => "paused by the operator",
            };
            self.journal_stop(reason)?;
            return Ok(self.summary(end, done));
        }
    }

    /// Stops; a halt that is asked for meanwhile is obeyed too. Returns what it came to.
    fn stop_as_asked(&mut self, end: End, done: &mut Vec<String>) -> End {
        done.extend(self.stop(end));
        if end != End::Halted && self.operator.request() == Request::Halt {
            done.extend(self.stop(End::Halted));
            return End::Halted;
        }
        end
    }

    fn stop(&mut self, end: End) -> Vec<String> {
        self.at = None;
        self.rig.make_safe(end == End::Halted)
    }

    /// After a pause: whatever was pressed in it may have reached the boards; unless they stand where they stood they are
    /// stopped in order, and the next stretch begins from there.
    fn take_up(&mut self) {
        if self.rig.lamp_is_on() && self.rig.verify().is_err() {
            for line in self.stop(End::Paused) {
                self.operator.seen(&Seen::Note(&line));
            }
        }
    }

    fn summary(self, end: End, stopped: Vec<String>) -> Summary {
        let badly_exposed = match end {
            End::Finished => self.plan.badly_exposed(&self.history),
            _ => Vec::new(),
        };
        Summary {
            frames: self.history.len(),
            frames_planned: self.history.len() + self.outlook.frames_left(),
            elapsed: self.clock.now() - self.begun,
            session: self.session,
            end,
            stopped,
            badly_exposed,
        }
    }

    /// Homes if need be and takes shots until none is missing.
    fn stretch(&mut self) -> Step {
        if self.plan.next(&self.history).is_none() {
            // Only the last line was missing: nothing needs to move.
            self.journal.append(self.elapsed(), Event::Finished)?;
            return Ok(());
        }
        if !self.rig.is_homed() || !self.rig.lamp_is_on() {
            if !self.rig.is_homed() {
                let operator = self.operator;
                self.at = None;
                self.rig.home(&mut |question| operator.confirm(question))?;
            }
            let event = Event::Ready {
                firmware: self.rig.firmware(),
                utc: Some(utc_now()),
            };
            self.journal.append(self.elapsed(), event)?;
            self.history.begin_stretch();
        }
        self.outlook.renew(&self.plan, &self.history);
        self.operator.seen(&Seen::Begins {
            frames: self.history.len() + self.outlook.frames_left(),
            seconds: self.outlook.seconds_left(),
        });
        while let Some(planned) = self.plan.next(&self.history) {
            let taken = self.history.len() as u64;
            let all = taken + self.outlook.frames_left() as u64;
            self.operator.progress("capture", taken, all);
            self.rig.obey()?;
            self.put_in_place(planned.shot.kind)?;
            self.go_to(&planned)?;
            match planned.shot.kind {
                FrameKind::Dark => self.rig.lamp_off()?,
                _ => self.light()?,
            }
            self.take(&planned.shot)?;
        }
        let all = self.history.len() as u64;
        self.operator.progress("capture", all, all);
        self.rig.lamp_off()?;
        match self.rig.park() {
            // All shots are on disk: where the axes stay does not matter.
            Ok(()) | Err(Halt::Cancelled) => {}
            Err(failed) => return Err(failed),
        }
        self.journal.append(self.elapsed(), Event::Finished)?;
        Ok(())
    }

    fn put_in_place(&mut self, kind: FrameKind) -> Step {
        let (kind, question) = match kind {
            FrameKind::White => (kind, "put the white standard in place"),
            FrameKind::Dark => return Ok(()),
            _ => (FrameKind::Sample, "put the sample in place"),
        };
        if self.in_place != Some(kind) {
            let operator = self.operator;
            self.rig.ask(&mut |q| operator.confirm(q), question)?;
            self.in_place = Some(kind);
        }
        Ok(())
    }

    fn go_to(&mut self, planned: &PlannedShot) -> Step {
        if self.at == Some(planned.angles) {
            return Ok(());
        }
        let begun = self.clock.now();
        let expected = self.outlook.travel_to(self.at.as_ref(), planned);
        self.operator.seen(&Seen::Moving(&planned.shot, expected));
        self.at = None;
        self.rig.move_to(&planned.angles)?;
        self.hand_on_notes();
        self.at = Some(planned.angles);
        self.outlook.moved(expected, self.clock.now() - begun);
        Ok(())
    }

    fn light(&mut self) -> Step {
        if !self.rig.lamp_is_on() {
            self.operator
                .seen(&Seen::WarmingUp(self.rig.warm_up_seconds()));
        }
        self.rig.lamp_on()
    }

    /// Tells what the boards had to be asked twice for.
    fn hand_on_notes(&mut self) {
        for note in self.rig.take_notes() {
            self.operator.seen(&Seen::Note(&note));
        }
    }

    fn take(&mut self, shot: &Shot) -> Result<()> {
        let read_back = self.rig.verify()?;
        let begun = self.clock.now();
        self.operator.seen(&Seen::Exposing(shot));
        let (frame, exposed) = match self.expose(shot) {
            Ok(taken) => taken,
            Err(error)
                if !self.operator.urgent() && self.plan.refuse(shot.exposure_ms, &self.history) =>
            {
                let reason = error.report().replace('\n', "; ");
                self.operator.seen(&Seen::Note(&format!(
                    "shot {} left out: {reason}",
                    describe(shot)
                )));
                self.outlook.renew(&self.plan, &self.history);
                return Ok(());
            }
            Err(error) => {
                return Err(Error::new(format!("shot {}", describe(shot))).with_source(error));
            }
        };
        // The shot counts only if nothing moved while the shutter was open.
        self.rig.verify()?;
        let record = FrameRecord {
            file: FrameRecord::standard_name(
                self.history.len() + 1,
                shot.kind,
                shot.config,
                shot.exposure_ms,
                &frame.extension,
            ),
            kind: shot.kind,
            config: shot.config,
            exposure_ms: frame.exposure_ms,
            requested_ms: Some(shot.exposure_ms),
            repeat: shot.repeat,
            visit: shot.visit,
            exposed,
            utc: Some(utc_now()),
            axes_deg: read_back.by_name(),
            sha256: String::new(),
        };
        let elapsed = self.elapsed();
        let record = self
            .session
            .add_frame(&mut self.journal, elapsed, record, &frame.bytes)?;
        self.history.add(record.clone());
        self.outlook.taken(shot, self.clock.now() - begun);
        self.outlook.renew(&self.plan, &self.history);
        self.hand_on_notes();
        self.operator.seen(&Seen::Taken(&Taken {
            shot,
            record: &record,
            frame: &frame,
            frames: self.history.len(),
            frames_planned: self.history.len() + self.outlook.frames_left(),
            remaining_s: self.outlook.seconds_left(),
        }));
        self.log.check()
    }

    /// A whole frame and how well it is exposed; one that cannot be read is shot again, a bounded number of times.
    fn expose(&mut self, shot: &Shot) -> Result<(CapturedFrame, Option<Exposedness>)> {
        let mut torn = 0;
        loop {
            let frame = self.camera.expose(shot)?;
            if frame.bytes.is_empty() || !(frame.exposure_ms > 0.0 && frame.exposure_ms.is_finite())
            {
                return Err(Error::new(format!(
                    "the camera returned {} bytes and exposure {} ms",
                    frame.bytes.len(),
                    frame.exposure_ms
                ))
                .with_hint("check the camera's connection and memory"));
            }
            let Some(judge) = &mut self.judge else {
                return Ok((frame, None));
            };
            match judge.judge(shot, &frame) {
                Ok(exposed) => return Ok((frame, exposed)),
                Err(error) if torn < TORN_FRAMES => {
                    torn += 1;
                    let reason = error.report().replace('\n', "; ");
                    self.operator.seen(&Seen::Note(&format!(
                        "shot {} again: {reason}",
                        describe(shot)
                    )));
                }
                Err(error) => return Err(error),
            }
        }
    }

    fn journal_stop(&mut self, reason: &str) -> Result<()> {
        let reason = reason.to_owned();
        self.journal
            .append(self.elapsed(), Event::Stopped { reason })
    }

    /// Makes the rig safe and tells what happened and what is kept.
    fn give_up(&mut self, error: Error, frames_before: usize) -> Error {
        let done = self.rig.make_safe(false);
        self.hand_on_notes();
        let reason = error
            .report()
            .lines()
            .next()
            .unwrap_or("unknown")
            .to_owned();
        let journaled = self.journal_stop(&reason);
        let mut hint = format!("{}; ", done.join("; ").replace("\nhint: ", ", "));
        if journaled.is_err() {
            hint.push_str("the journal could not be closed; ");
        }
        let frames = self.history.len();
        hint.push_str(&format!(
            "the {frames} frames taken so far are safe in {folder}; go on with `goniofit capture --resume {folder}`",
            folder = self.session.root().display()
        ));
        Error::new(format!(
            "capture stopped after {} of {} frames",
            frames - frames_before,
            frames - frames_before + self.outlook.frames_left()
        ))
        .with_hint(hint)
        .with_source(error)
    }
}

/// How a capture ends on this request; none when nothing needs to stop.
fn asked_end(request: Request) -> Option<End> {
    match request {
        Request::Go | Request::Pause => None,
        Request::PauseNow => Some(End::Paused),
        Request::Abort => Some(End::Aborted),
        Request::Halt => Some(End::Halted),
    }
}

fn describe(shot: &Shot) -> String {
    let what = match shot.config {
        Some(c) => format!("{}, configuration {c}", shot.kind.name()),
        None => shot.kind.name().to_owned(),
    };
    format!("{what}, {} ms, repeat {}", shot.exposure_ms, shot.repeat)
}
