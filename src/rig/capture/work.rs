//! The loop itself: stretches of work, each from a homed rig with its lamp off to its end, a pause or a stop.

use super::{CapturePlan, End, PlannedShot, Summary};
use crate::base::{Error, Result};
use crate::rig::devices::{Camera, CapturedFrame, Judge, Shot};
use crate::rig::kinematics::AxisAngles;
use crate::rig::machine::{Halt, Rig, Step};
use crate::rig::operator::{Operator, Request, Seen, Taken};
use crate::rig::outlook::Outlook;
use crate::rig::shots::History;
use crate::rig::transport::Clock;
use crate::rig::utc::utc_now;
use crate::rig::wire_log::WireLog;
use crate::session::{Event, Exposedness, FrameKind, FrameRecord, Journal, SessionFolder};

/// How often a frame that cannot be decoded is shot again.
const TORN_FRAMES: u32 = 2;

pub(super) struct Loop<'a, 'w> {
    pub(super) plan: CapturePlan,
    pub(super) outlook: Outlook,
    pub(super) rig: &'a mut Rig<'w>,
    pub(super) camera: &'a mut dyn Camera,
    pub(super) judge: Option<Box<dyn Judge + 'a>>,
    pub(super) operator: &'a dyn Operator,
    pub(super) session: SessionFolder,
    pub(super) journal: Journal,
    pub(super) history: History,
    pub(super) log: &'a WireLog,
    pub(super) clock: &'a dyn Clock,
    /// The rig's clock when this run began.
    pub(super) begun: f64,
    /// Seconds the session had lasted before.
    pub(super) earlier: f64,
    /// What lies under the camera, as far as the operator was asked.
    pub(super) in_place: Option<FrameKind>,
    pub(super) at: Option<AxisAngles>,
}

impl Loop<'_, '_> {
    fn elapsed(&self) -> f64 {
        self.earlier + self.clock.now() - self.begun
    }

    /// Works until all shots are taken or somebody or something ends it.
    pub(super) fn finish(mut self) -> Result<Summary> {
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

    /// After a pause: whatever was pressed in it may have reached the boards. Unless the lamp stayed on and they say that
    /// they stand where they stood, all are stopped in order, and the next stretch begins from there.
    fn take_up(&mut self) {
        if self.rig.lamp_is_on() && self.rig.verify().is_ok() {
            return;
        }
        self.rig.brake();
        for line in self.stop(End::Paused) {
            self.operator.seen(&Seen::Note(&line));
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
        let kind = match kind {
            FrameKind::Dark => return Ok(()),
            FrameKind::White => kind,
            _ => self.plan.shows,
        };
        if self.in_place != Some(kind) {
            let operator = self.operator;
            let question = format!("put {} in place", called(kind));
            self.rig.ask(&mut |q| operator.confirm(q), &question)?;
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
            Err(error) => return self.leave_out(shot, error),
        };
        // The shot counts only if nothing moved while the shutter was open.
        self.rig.verify()?;
        let record = FrameRecord {
            filter: None,
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

    /// A shot that could not be taken. One beyond the list of exposures is not needed: the camera's range ends there, and
    /// the capture goes on without it.
    fn leave_out(&mut self, shot: &Shot, error: Error) -> Result<()> {
        let needed = self.operator.urgent() || !self.plan.refuse(shot.exposure_ms, &self.history);
        if needed {
            return Err(Error::new(format!("shot {}", describe(shot))).with_source(error));
        }
        let reason = error.report().replace('\n', "; ");
        self.operator.seen(&Seen::Note(&format!(
            "shot {} left out: {reason}",
            describe(shot)
        )));
        self.outlook.renew(&self.plan, &self.history);
        Ok(())
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

/// What the operator knows it as.
fn called(kind: FrameKind) -> &'static str {
    match kind {
        FrameKind::White => "the white standard",
        FrameKind::Flat => "the evenly bright panel or diffuser",
        FrameKind::Chart => "the color chart",
        FrameKind::Board => "the checkerboard",
        FrameKind::Sample | FrameKind::Dark | FrameKind::Reference => "the sample",
    }
}

fn describe(shot: &Shot) -> String {
    let what = match shot.config {
        Some(c) => format!("{}, configuration {c}", shot.kind.name()),
        None => shot.kind.name().to_owned(),
    };
    format!("{what}, {} ms, repeat {}", shot.exposure_ms, shot.repeat)
}
