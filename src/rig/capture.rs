//! The capture loop: the only code that moves a rig.
//!
//! Checks the whole plan before a byte is sent, then connects, homes, and works through a list of shots that is plain
//! data. Every frame is on disk and journaled before the next one is asked for. Whatever fails: motion stops, the lamp
//! goes off, the journal says why, and what is on disk stays.
//!
//! Does not choose exposures, judge frames, follow lamp drift, or continue an interrupted session.

use super::description::RigDescription;
use super::kinematics::AxisAngles;
use super::machine::{Connection, Prompt, Rig};
use super::transport::Clock;
use super::wire_log::{RecordingTransport, WireLog};
use super::{Camera, Shot};
use crate::base::{Context, Error, Result, Watch};
use crate::session::{
    Event, FrameKind, FrameRecord, Journal, Manifest, Plan, SessionFolder, WhiteReference,
};
use std::path::Path;
use std::sync::Arc;

/// What the rig file does not say about a capture.
#[derive(Debug, Clone, PartialEq)]
pub struct CaptureOptions {
    /// Exposure bracket, milliseconds, ascending.
    pub exposures_ms: Vec<f64>,
    /// Frames per configuration and exposure.
    pub repeats: u32,
    /// Dark frames per exposure.
    pub dark_repeats: u32,
    /// White frames per exposure; 0 = none.
    pub white_repeats: u32,
    /// Operator's note.
    pub note: String,
    /// True when no camera sees any cloth.
    pub synthetic: bool,
    /// UTC start, RFC 3339; the machine's clock when absent.
    pub started_utc: Option<String>,
}

impl CaptureOptions {
    /// The exposures and repeats of the rig file; as many white frames as sample frames.
    pub fn of(rig: &RigDescription) -> Self {
        Self {
            exposures_ms: rig.camera.exposures_ms.clone(),
            repeats: rig.camera.repeats,
            dark_repeats: rig.camera.dark_repeats,
            white_repeats: rig.camera.repeats,
            note: String::new(),
            synthetic: false,
            started_utc: None,
        }
    }
}

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

/// One shot with the axis angles it is taken at.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedShot {
    /// What to ask the camera for.
    pub shot: Shot,
    /// Where the axes stand.
    pub angles: AxisAngles,
}

/// The whole capture as data: whites at the reference geometry, the configurations in plan order, then darks.
///
/// # Errors
/// A pose is outside the limits.
pub fn planned_shots(
    rig: &RigDescription,
    plan: &Plan,
    options: &CaptureOptions,
) -> Result<Vec<PlannedShot>> {
    let mut shots = Vec::new();
    let mut add = |kind, config, pose, angles, exposure_ms, repeats| {
        for repeat in 0..repeats {
            shots.push(PlannedShot {
                shot: Shot {
                    kind,
                    config,
                    pose,
                    exposure_ms,
                    repeat,
                },
                angles,
            });
        }
    };
    let reference = rig.white.configuration(white_id(plan));
    let reference_angles = rig
        .angles(&reference)
        .context(|| "white reference geometry")?;
    for &exposure in &options.exposures_ms {
        add(
            FrameKind::White,
            None,
            reference,
            reference_angles,
            exposure,
            options.white_repeats,
        );
    }
    let angles = rig.plan_angles(plan)?;
    for (c, angles) in plan.configurations.iter().zip(&angles) {
        for &exposure in &options.exposures_ms {
            add(
                FrameKind::Sample,
                Some(c.id),
                *c,
                *angles,
                exposure,
                options.repeats,
            );
        }
    }
    if let (Some(c), Some(angles)) = (plan.configurations.last(), angles.last()) {
        for &exposure in &options.exposures_ms {
            add(
                FrameKind::Dark,
                None,
                *c,
                *angles,
                exposure,
                options.dark_repeats,
            );
        }
    }
    Ok(shots)
}

/// An id for the white geometry that the plan does not use.
fn white_id(plan: &Plan) -> u32 {
    (0..)
        .find(|id| plan.configuration(*id).is_none())
        .unwrap_or(0)
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
    let mut rig = Rig::connect(description, &mut recorded)?;
    drop(recorded);
    let manifest = manifest(description, plan, camera, options);
    let (session, journal) = SessionFolder::create(out, &manifest, plan, &description.text)?;
    log.write_to(&out.join("wire.jsonl"))?;
    let mut capture = Loop {
        rig: &mut rig,
        camera,
        session: &session,
        journal,
        clock: clock.as_ref(),
        start,
        frames: 0,
        watch,
    };
    match capture.work(&shots, prompt) {
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

type Opener<'a> = Box<dyn FnMut(&super::Board) -> Result<Box<dyn super::Transport>> + 'a>;

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
    }
}

struct Loop<'a> {
    rig: &'a mut Rig,
    camera: &'a mut dyn Camera,
    session: &'a SessionFolder,
    journal: Journal,
    clock: &'a dyn Clock,
    start: f64,
    frames: usize,
    watch: &'a dyn Watch,
}

impl Loop<'_> {
    fn elapsed(&self) -> f64 {
        self.clock.now() - self.start
    }

    /// True when all shots were taken, false when asked to stop.
    fn work(&mut self, shots: &[PlannedShot], prompt: &mut Prompt) -> Result<bool> {
        self.rig.home(prompt)?;
        let firmware = self.rig.firmware();
        self.journal
            .append(self.elapsed(), Event::Ready { firmware })?;
        let mut in_place = None;
        let mut at: Option<AxisAngles> = None;
        for (i, planned) in shots.iter().enumerate() {
            self.watch.progress("capture", i as u64, shots.len() as u64);
            if self.watch.cancelled() {
                return self.stop_early();
            }
            let kind = planned.shot.kind;
            if in_place != Some(kind) {
                match kind {
                    FrameKind::White => prompt("put the white standard in place")?,
                    FrameKind::Sample => prompt("put the sample in place")?,
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
                FrameKind::White | FrameKind::Sample => self.rig.lamp_on()?,
            }
            self.take(&planned.shot)?;
        }
        self.watch
            .progress("capture", shots.len() as u64, shots.len() as u64);
        self.rig.lamp_off()?;
        self.rig.park()?;
        self.journal.append(self.elapsed(), Event::Finished)?;
        Ok(true)
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
            repeat: shot.repeat,
            axes_deg: read_back.by_name(),
            sha256: String::new(),
        };
        let elapsed = self.elapsed();
        self.session
            .add_frame(&mut self.journal, elapsed, record, &frame.bytes)?;
        self.frames += 1;
        Ok(())
    }

    fn stop_early(&mut self) -> Result<bool> {
        self.rig.lamp_off()?;
        let reason = "stopped by the operator".to_owned();
        self.journal
            .append(self.elapsed(), Event::Stopped { reason })?;
        Ok(false)
    }

    /// Makes the rig safe and tells what happened and what is kept.
    fn give_up(&mut self, error: Error, planned: usize) -> Error {
        let done = self.rig.make_safe();
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
    let what = match (shot.kind, shot.config) {
        (FrameKind::Dark, _) => "dark".to_owned(),
        (FrameKind::White, _) => "white".to_owned(),
        (FrameKind::Sample, Some(c)) => format!("sample, configuration {c}"),
        (FrameKind::Sample, None) => "sample".to_owned(),
    };
    format!("{what}, {} ms, repeat {}", shot.exposure_ms, shot.repeat)
}

/// UTC now, RFC 3339 with seconds.
fn utc_now() -> String {
    let seconds = std::time::SystemTime::now()
        .duration_since(std::time::UNIX_EPOCH)
        .map_or(0, |d| d.as_secs());
    utc_text(seconds)
}

/// Civil date of a Unix time (Hinnant, "chrono-compatible low-level date algorithms").
fn utc_text(unix_seconds: u64) -> String {
    let (days, second) = (unix_seconds / 86_400, unix_seconds % 86_400);
    let z = days + 719_468;
    let (era, doe) = (z / 146_097, z % 146_097);
    let yoe = (doe - doe / 1460 + doe / 36_524 - doe / 146_096) / 365;
    let doy = doe - (365 * yoe + yoe / 4 - yoe / 100);
    let mp = (5 * doy + 2) / 153;
    let day = doy - (153 * mp + 2) / 5 + 1;
    let month = if mp < 10 { mp + 3 } else { mp - 9 };
    let year = yoe + era * 400 + u64::from(month <= 2);
    format!(
        "{year:04}-{month:02}-{day:02}T{:02}:{:02}:{:02}Z",
        second / 3600,
        second / 60 % 60,
        second % 60
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn utc_times_are_civil_dates() {
        assert_eq!(utc_text(0), "1970-01-01T00:00:00Z");
        assert_eq!(utc_text(951_827_696), "2000-02-29T12:34:56Z");
        assert_eq!(utc_text(1_795_305_600), "2026-11-22T00:00:00Z");
    }
}
