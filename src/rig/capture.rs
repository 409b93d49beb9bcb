//! The capture loop: the only code that moves a rig.
//!
//! Checks the whole plan before a byte is sent, then connects, homes, and works through a list of shots that is plain
//! data. Every frame is on disk and journaled before the next one is asked for. Whatever fails: motion stops, the lamp
//! goes off, the journal says why, and what is on disk stays.
//!
//! [`Watch::cancelled`] ends it before the next motion or shot, or within 0.1 s while something settles or warms up; a
//! motion under way ends where it was going. [`Watch::urgent`] stops motion within 0.1 s, whatever is going on, but for an
//! exposure: the stop comes when the camera returns, and that frame is not kept.
//!
//! Does not choose exposures, judge frames, follow lamp drift, or continue an interrupted session.

pub use super::shots::{CaptureOptions, PlannedShot, planned_shots, white_id};

use super::description::RigDescription;
use super::kinematics::AxisAngles;
use super::machine::{Connection, Halt, Opener, Prompt, Rig, Step};
use super::transport::Clock;
use super::utc::utc_now;
use super::wire_log::{RecordingTransport, WireLog};
use super::{Camera, Shot};
use crate::base::{Context, Error, Result, Watch};
use crate::session::{
    Event, FrameKind, FrameRecord, Journal, Manifest, Plan, Provenance, SessionFolder,
    WhiteReference,
};
use std::path::Path;
use std::sync::Arc;

/// How a capture ended.
#[derive(Debug, Clone)]
pub struct Summary {
    /// The session.
    pub session: SessionFolder,
    /// Frames on disk.
    pub frames: usize,
    /// Frames the plan asks for.
    pub frames_planned: usize,
    /// Seconds on the rig's clock.
    pub elapsed: f64,
    /// False when it was asked to stop early.
    pub finished: bool,
}

/// Runs a capture into the new session folder `out`; the wire log goes to `wire.jsonl` in it.
///
/// `prompt` is asked before the whites, before the sample, and for boards homed by hand.
///
/// # Errors
/// The plan or the folder is refused (nothing was sent then), or a device or the disk fails: motion is stopped, the
/// lamp off, the journal has `stopped`, and the message says what is safe on disk.
#[allow(clippy::too_many_arguments)]
pub fn run(
    description: &RigDescription,
    plan: &Plan,
    mut connection: Connection,
    camera: &mut dyn Camera,
    out: &Path,
    options: &CaptureOptions,
    prompt: &mut Prompt,
    watch: &dyn Watch,
) -> Result<Summary> {
    let shots = planned_shots(description, plan, options)?;
    if out.join("session.json").exists() || out.join("journal.jsonl").exists() {
        return Err(
            Error::new(format!("{} already holds a session", out.display()))
                .with_hint("a session is never overwritten; choose another folder"),
        );
    }
    let clock = connection.clock.clone();
    let start = clock.now();
    let log = WireLog::new();
    let wait_scale = connection.wait_scale;
    let mut recorded = Connection {
        open: record(&mut connection, &log),
        clock: clock.clone(),
        wait_scale,
    };
    let mut rig = Rig::connect(description, &mut recorded, watch)
        .context(|| "the capture did not begin, nothing was moved")?;
    drop(recorded);
    let manifest = manifest(description, plan, camera, options);
    let (session, journal) = SessionFolder::create(out, &manifest, plan, &description.text)?;
    log.write_to(&out.join("wire.jsonl"))?;
    let mut capture = Loop {
        rig: &mut rig,
        camera,
        session: &session,
        journal,
        log: &log,
        clock: clock.as_ref(),
        start,
        frames: 0,
        watch,
    };
    let worked = match capture.work(&shots, prompt) {
        Err(Halt::Cancelled) => capture.stop_early().map(|()| false),
        Err(Halt::Failed(error)) => Err(error),
        Ok(()) => Ok(true),
    };
    match worked {
        Ok(finished) => Ok(Summary {
            frames: capture.frames,
            frames_planned: shots.len(),
            elapsed: clock.now() - start,
            finished,
            session,
        }),
        Err(error) => Err(capture.give_up(error, shots.len())),
    }
}

/// The connection's opener with every stream recorded.
fn record<'a>(connection: &'a mut Connection, log: &WireLog) -> Opener<'a> {
    let log = log.clone();
    let clock = connection.clock.clone();
    let open = &mut connection.open;
    Box::new(move |board| {
        let inner = open(board)?;
        Ok(Box::new(RecordingTransport::new(
            inner,
            &board.name,
            Arc::clone(&clock),
            log.clone(),
        )))
    })
}

fn manifest(
    description: &RigDescription,
    plan: &Plan,
    camera: &dyn Camera,
    options: &CaptureOptions,
) -> Manifest {
    let white = &description.white;
    Manifest {
        format: Manifest::FORMAT.to_owned(),
        program: format!("goniofit {}", env!("CARGO_PKG_VERSION")),
        started_utc: options.started_utc.clone().unwrap_or_else(utc_now),
        note: options.note.clone(),
        synthetic: options.synthetic,
        rig: description.name.clone(),
        camera: camera.facts(),
        white: WhiteReference {
            configuration: white.configuration(white_id(plan)),
            reflectance_factor: white.reflectance_factor,
            reflectance_factor_se: white.reflectance_factor_se,
        },
        sample_square_mm: description.camera.sample_square_mm,
        exposures_ms: options.exposures_ms.clone(),
        provenance: Provenance::default(),
    }
}

struct Loop<'a, 'w> {
    rig: &'a mut Rig<'w>,
    camera: &'a mut dyn Camera,
    session: &'a SessionFolder,
    journal: Journal,
    log: &'a WireLog,
    clock: &'a dyn Clock,
    start: f64,
    frames: usize,
    watch: &'a dyn Watch,
}

impl Loop<'_, '_> {
    fn elapsed(&self) -> f64 {
        self.clock.now() - self.start
    }

    fn work(&mut self, shots: &[PlannedShot], prompt: &mut Prompt) -> Step {
        self.rig.home(prompt)?;
        let firmware = self.rig.firmware();
        self.journal.append(
            self.elapsed(),
            Event::Ready {
                firmware,
                utc: Some(utc_now()),
            },
        )?;
        let mut in_place = None;
        let mut at: Option<AxisAngles> = None;
        for (i, planned) in shots.iter().enumerate() {
            self.watch.progress("capture", i as u64, shots.len() as u64);
            self.rig.obey()?;
            let kind = planned.shot.kind;
            if in_place != Some(kind) {
                match kind {
                    FrameKind::White => self.rig.ask(prompt, "put the white standard in place")?,
                    FrameKind::Sample | FrameKind::Reference | FrameKind::Meter => {
                        self.rig.ask(prompt, "put the sample in place")?;
                    }
                    FrameKind::Dark => {}
                }
                in_place = Some(kind);
            }
            if at != Some(planned.angles) {
                self.rig.move_to(&planned.angles)?;
                at = Some(planned.angles);
            }
            match kind {
                FrameKind::Dark => self.rig.lamp_off()?,
                _ => self.rig.lamp_on()?,
            }
            self.take(&planned.shot)?;
        }
        self.watch
            .progress("capture", shots.len() as u64, shots.len() as u64);
        self.rig.lamp_off()?;
        match self.rig.park() {
            // All shots are on disk: where the axes stay does not matter.
            Ok(()) | Err(Halt::Cancelled) => {}
            Err(failed) => return Err(failed),
        }
        self.journal.append(self.elapsed(), Event::Finished)?;
        Ok(())
    }

    fn take(&mut self, shot: &Shot) -> Result<()> {
        let read_back = self.rig.verify()?;
        let frame = self
            .camera
            .expose(shot)
            .context(|| format!("shot {}", describe(shot)))?;
        if frame.bytes.is_empty() || !(frame.exposure_ms > 0.0 && frame.exposure_ms.is_finite()) {
            return Err(Error::new(format!(
                "shot {}: the camera returned {} bytes and exposure {} ms",
                describe(shot),
                frame.bytes.len(),
                frame.exposure_ms
            ))
            .with_hint("check the camera's connection and memory"));
        }
        // The shot counts only if nothing moved while the shutter was open.
        self.rig.verify()?;
        let record = FrameRecord {
            file: FrameRecord::standard_name(
                self.frames + 1,
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
            exposed: None,
            utc: Some(utc_now()),
            axes_deg: read_back.by_name(),
            sha256: String::new(),
        };
        let elapsed = self.elapsed();
        self.session
            .add_frame(&mut self.journal, elapsed, record, &frame.bytes)?;
        self.frames += 1;
        self.log.check()
    }

    fn stop_early(&mut self) -> Result<()> {
        self.rig.lamp_off()?;
        let reason = "stopped by the operator".to_owned();
        self.journal
            .append(self.elapsed(), Event::Stopped { reason })
    }

    /// Makes the rig safe and tells what happened and what is kept.
    fn give_up(&mut self, error: Error, planned: usize) -> Error {
        let done = self.rig.make_safe(false);
        let reason = error
            .report()
            .lines()
            .next()
            .unwrap_or("unknown")
            .to_owned();
        let elapsed = self.elapsed();
        let journaled = self.journal.append(elapsed, Event::Stopped { reason });
        let mut hint = format!("{}; ", done.join("; ").replace("\nhint: ", ", "));
        if journaled.is_err() {
            hint.push_str("the journal could not be closed; ");
        }
        hint.push_str(&format!(
            "the {} frames taken so far are safe in {}",
            self.frames,
            self.session.root().display()
        ));
        Error::new(format!(
            "capture stopped after {} of {planned} frames",
            self.frames
        ))
        .with_hint(hint)
        .with_source(error)
    }
}

fn describe(shot: &Shot) -> String {
    let what = match shot.config {
        Some(c) => format!("{}, configuration {c}", shot.kind.name()),
        None => shot.kind.name().to_owned(),
    };
    format!("{what}, {} ms, repeat {}", shot.exposure_ms, shot.repeat)
}
