//! A capture as data: where to stop, and which shot comes next given what the journal has.
//!
//! The next shot is a function of the plan and the journaled frames alone. That is all there is to resuming: a new run
//! reads the journal and asks for the next shot.

use super::description::{Metering, RigDescription};
use super::devices::Shot;
use super::exposures::{ExposureRule, Next, Verdict, next_exposure};
use super::kinematics::AxisAngles;
use super::tour::Tour;
use crate::base::{Context, Error, Result};
use crate::session::{Configuration, Entry, Event, Exposedness, FrameKind, FrameRecord, Plan};

/// What the rig file does not say about a capture.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CaptureOptions {
    /// Operator's note.
    pub note: String,
    /// True when no camera sees any cloth.
    pub synthetic: bool,
    /// UTC start, RFC 3339; the machine's clock when absent.
    pub started_utc: Option<String>,
    /// SHA-256 of the program file, hexadecimal; empty when nobody knows.
    pub program_sha256: String,
    /// Name of the computer; empty when nobody knows.
    pub host: String,
    /// In which order the configurations are visited.
    pub order: Order,
}

/// In which order the configurations are visited.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Order {
    /// For short travel.
    #[default]
    Short,
    /// As the plan lists them.
    Plan,
}

/// A place where shots are taken.
#[derive(Debug, Clone, PartialEq)]
pub struct Stop {
    /// What is shot there.
    pub kind: FrameKind,
    /// The plan's configuration for what the plan shows.
    pub config: Option<u32>,
    /// Where light, camera and turntable stand.
    pub pose: Configuration,
    /// The axis angles of that.
    pub angles: AxisAngles,
}

/// One shot with the axis angles it is taken at.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedShot {
    /// What to ask the camera for.
    pub shot: Shot,
    /// Where the axes stand.
    pub angles: AxisAngles,
}

/// The frames of a session as far as it got.
#[derive(Debug, Clone, Default)]
pub struct History {
    /// Frames in journal order, each with the stretch of work it belongs to (1, 2, ...).
    frames: Vec<(u32, FrameRecord)>,
    stretch: u32,
}

impl History {
    /// What a journal says.
    pub fn of(entries: &[Entry]) -> Self {
        let mut history = Self::default();
        for entry in entries {
            match &entry.event {
                Event::Ready { .. } => history.begin_stretch(),
                Event::Frame(record) => history.add(record.clone()),
                Event::Finished | Event::Stopped { .. } => {}
            }
        }
        history
    }

    /// The lamp was off and the axes were homed: what follows compares with what was only through reference shots.
    pub fn begin_stretch(&mut self) {
        self.stretch += 1;
    }

    /// One more frame.
    pub fn add(&mut self, record: FrameRecord) {
        self.frames.push((self.stretch, record));
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// True when there is no frame yet.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    fn at(&self, stop: &Stop, visit: u32) -> Vec<&FrameRecord> {
        let all = self.frames.iter().map(|(_, f)| f);
        all.filter(|f| f.kind == stop.kind && f.config == stop.config && f.visit == visit)
            .collect()
    }

    /// Frames of the present stretch, newest first.
    fn recent(&self) -> impl Iterator<Item = &FrameRecord> {
        let stretch = self.stretch;
        let newest = self.frames.iter().rev();
        newest
            .take_while(move |(s, _)| *s == stretch)
            .map(|(_, f)| f)
    }

    /// Exposures asked for outside darks, milliseconds, ascending.
    fn exposures(&self) -> Vec<f64> {
        let mut all: Vec<f64> = self
            .frames
            .iter()
            .filter(|(_, f)| f.kind != FrameKind::Dark)
            .map(|(_, f)| f.asked_ms())
            .collect();
        all.sort_by(f64::total_cmp);
        all.dedup();
        all
    }
}

/// A whole capture as data.
#[derive(Debug, Clone, PartialEq)]
pub struct CapturePlan {
    /// The white standard at the reference geometry.
    pub white: Stop,
    /// What lies in the sample's place.
    pub shows: FrameKind,
    /// The configurations, in the order they are visited.
    pub samples: Vec<Stop>,
    /// What the plan shows at the reference geometry; none when the lamp's drift is not followed.
    pub reference: Option<Stop>,
    /// Where darks are taken: the last configuration's place.
    pub dark: Stop,
    /// How short the travel from the white standard through the configurations is; none in the plan's own order.
    pub tour: Option<Tour>,
    rule: ExposureRule,
    dark_repeats: u32,
    reference_every: u32,
}

/// Checks a whole plan against the rig before anything is opened, and orders it.
///
/// # Errors
/// A pose is outside the limits, or there is no free way between two of them.
pub fn plan_capture(rig: &RigDescription, plan: &Plan, order: Order) -> Result<CapturePlan> {
    let reference = rig.white.configuration(white_id(plan));
    let reference_angles = rig
        .angles(&reference)
        .context(|| "white reference geometry")?;
    let stop = |kind, config, pose, angles| Stop {
        kind,
        config,
        pose,
        angles,
    };
    let angles = rig.plan_angles(plan)?;
    let mut samples: Vec<Stop> = plan
        .configurations
        .iter()
        .zip(&angles)
        .map(|(c, a)| stop(plan.shows, Some(c.id), *c, *a))
        .collect();
    for stop in &samples {
        rig.check_pose_clearance(&stop.angles)
            .context(|| format!("configuration {}", stop.config.unwrap_or_default()))?;
    }
    let mut tour = None;
    if order == Order::Short {
        let poses: Vec<AxisAngles> = samples.iter().map(|s| s.angles).collect();
        let best = rig.order(&poses, &reference_angles, None)?;
        samples = best.order.iter().map(|i| samples[*i].clone()).collect();
        tour = Some(best);
    }
    check_ways(rig, &samples, &reference_angles)?;
    let last = samples
        .last()
        .cloned()
        .ok_or_else(|| Error::new("the plan has no configurations"))?;
    Ok(CapturePlan {
        white: stop(FrameKind::White, None, reference, reference_angles),
        reference: (rig.lamp.reference_every > 0)
            .then(|| stop(FrameKind::Reference, None, reference, reference_angles)),
        dark: stop(FrameKind::Dark, None, last.pose, last.angles),
        shows: plan.shows,
        samples,
        tour,
        rule: ExposureRule::of(&rig.camera),
        dark_repeats: rig.camera.dark_repeats,
        reference_every: rig.lamp.reference_every,
    })
}

/// Every way of a capture exists: from stop to stop, to the reference pose and back, and to the parking place.
fn check_ways(rig: &RigDescription, samples: &[Stop], reference: &AxisAngles) -> Result<()> {
    let mut from = reference;
    for stop in samples {
        let ways = [
            (from, &stop.angles),
            (&stop.angles, reference),
            (reference, &stop.angles),
        ];
        for (from, to) in ways {
            rig.path(from, to)
                .context(|| format!("configuration {}", stop.config.unwrap_or_default()))?;
        }
        from = &stop.angles;
    }
    if !rig.park_deg.is_empty() {
        rig.path(from, &rig.parked(from))
            .context(|| "the way to the parking place")?;
    }
    Ok(())
}

impl CapturePlan {
    /// True when exposures are chosen by looking at frames.
    pub fn needs_judge(&self) -> bool {
        self.rule.metering == Metering::Metered
    }

    /// All stops once, in the order they are first made.
    pub fn stops(&self) -> impl Iterator<Item = &Stop> {
        std::iter::once(&self.white)
            .chain(&self.reference)
            .chain(&self.samples)
            .chain(std::iter::once(&self.dark))
    }

    /// The next shot of a session that has these frames; none when it is complete.
    pub fn next(&self, history: &History) -> Option<PlannedShot> {
        self.missing(&self.white, 0, history, &self.rule)
            .or_else(|| self.next_of_sample(history))
            .or_else(|| self.missing(&self.dark, 0, history, &self.dark_rule(history)))
    }

    /// The camera refused an exposure beyond the list: its range ends at what it has taken. False for an exposure of the
    /// list, which is needed.
    pub(super) fn refuse(&mut self, exposure_ms: f64, history: &History) -> bool {
        let ladder = &self.rule.ladder_ms;
        let (Some(&first), Some(&last)) = (ladder.first(), ladder.last()) else {
            return false;
        };
        let taken = history.exposures();
        if exposure_ms > last {
            let longest = taken.iter().copied().filter(|e| *e < exposure_ms);
            self.rule.range_ms[1] = longest.fold(last, f64::max);
        } else if exposure_ms < first {
            let shortest = taken.iter().copied().filter(|e| *e > exposure_ms);
            self.rule.range_ms[0] = shortest.fold(first, f64::min);
        }
        !(first..=last).contains(&exposure_ms)
    }

    fn dark_rule(&self, history: &History) -> ExposureRule {
        ExposureRule {
            repeats: self.dark_repeats,
            ..self.rule.given(history.exposures())
        }
    }

    fn next_of_sample(&self, history: &History) -> Option<PlannedShot> {
        let sample = self
            .samples
            .iter()
            .find_map(|s| self.missing(s, 0, history, &self.rule));
        self.due_reference(sample.as_ref(), history).or(sample)
    }

    /// The reference pose is visited when a stretch begins, every so many sample frames, and after the last of them; only
    /// between two configurations.
    fn due_reference(
        &self,
        sample: Option<&PlannedShot>,
        history: &History,
    ) -> Option<PlannedShot> {
        let stop = self.reference.as_ref()?;
        let latest = history.recent().find(|f| f.kind == FrameKind::Reference);
        let since = history
            .recent()
            .take_while(|f| f.kind != FrameKind::Reference)
            .filter(|f| f.kind == self.shows)
            .count();
        if let Some(latest) = latest
            && since == 0
        {
            // Perhaps unfinished.
            let rule = self.reference_rule(latest.visit, history);
            return self.missing(stop, latest.visit, history, &rule);
        }
        let due = match sample {
            None => since > 0,
            Some(next) => {
                let begun = history
                    .recent()
                    .any(|f| f.kind == self.shows && f.config == next.shot.config);
                !begun && (latest.is_none() || since >= self.reference_every as usize)
            }
        };
        if !due {
            return None;
        }
        let references = history
            .frames
            .iter()
            .filter(|(_, f)| f.kind == FrameKind::Reference);
        let visit = references
            .map(|(_, f)| f.visit.saturating_add(1))
            .max()
            .unwrap_or(0);
        self.missing(stop, visit, history, &self.reference_rule(visit, history))
    }

    /// Later visits repeat the exposures of the first, so that they can be compared.
    fn reference_rule(&self, visit: u32, history: &History) -> ExposureRule {
        let Some(stop) = &self.reference else {
            return self.rule.clone();
        };
        let usable = |f: &&&FrameRecord| {
            f.exposed
                .is_none_or(|e| e.peak.iter().all(|p| *p < super::exposures::CLIPPED))
        };
        let visits = history.frames.iter().map(|(_, f)| f);
        let visits = visits.filter(|f| f.kind == stop.kind && f.visit < visit);
        let visits: std::collections::BTreeSet<u32> = visits.map(|f| f.visit).collect();
        // A visit that was cut short before it had a usable frame is no model.
        let first = visits
            .into_iter()
            .map(|v| history.at(stop, v))
            .find(|frames| frames.iter().any(|f| usable(&f)));
        let Some(first) = first else {
            return self.rule.clone();
        };
        let mut exposures: Vec<f64> = first.iter().filter(usable).map(|f| f.asked_ms()).collect();
        exposures.sort_by(f64::total_cmp);
        exposures.dedup();
        self.rule.given(exposures)
    }

    fn missing(
        &self,
        stop: &Stop,
        visit: u32,
        history: &History,
        rule: &ExposureRule,
    ) -> Option<PlannedShot> {
        match next_exposure(rule, &history.at(stop, visit), self.first_look_ms()) {
            Next::Done(_) => None,
            Next::Shoot(exposure_ms, repeat) => Some(PlannedShot {
                shot: Shot {
                    kind: stop.kind,
                    config: stop.config,
                    pose: stop.pose,
                    exposure_ms,
                    repeat,
                    visit,
                },
                angles: stop.angles,
            }),
        }
    }

    /// Where metering begins: the middle of the list.
    fn first_look_ms(&self) -> f64 {
        let ladder = &self.rule.ladder_ms;
        ladder.get(ladder.len() / 2).copied().unwrap_or(1.0)
    }

    /// Stops whose frames are all clipped or all too dark, with what is wrong.
    pub fn badly_exposed(&self, history: &History) -> Vec<(Stop, Verdict)> {
        let stops = std::iter::once(&self.white).chain(&self.samples);
        stops
            .filter_map(|stop| {
                match next_exposure(&self.rule, &history.at(stop, 0), self.first_look_ms()) {
                    Next::Done(Verdict::Good) | Next::Shoot(..) => None,
                    Next::Done(verdict) => Some((stop.clone(), verdict)),
                }
            })
            .collect()
    }

    /// The shots still to come, as far as that can be known: metering is taken to find the middle of its list right.
    pub fn outlook(&self, history: &History) -> Vec<PlannedShot> {
        let mut future = history.clone();
        if future.stretch == 0 {
            future.begin_stretch();
        }
        let mut shots = Vec::new();
        while let Some(planned) = self.next(&future) {
            let looked = self.rule.metering == Metering::Metered;
            future.add(expected(
                &planned.shot,
                looked.then(|| self.first_look_ms()),
            ));
            shots.push(planned);
        }
        shots
    }
}

/// The record of a shot that turns out as expected; looked at, the middle exposure is half way up.
fn expected(shot: &Shot, middle_ms: Option<f64>) -> FrameRecord {
    let peak = |middle: f64| [(0.5 * shot.exposure_ms / middle).min(1.0); 3];
    FrameRecord {
        filter: None,
        file: String::new(),
        kind: shot.kind,
        config: shot.config,
        exposure_ms: shot.exposure_ms,
        requested_ms: None,
        repeat: shot.repeat,
        visit: shot.visit,
        exposed: middle_ms
            .filter(|_| shot.kind != FrameKind::Dark)
            .map(|m| Exposedness {
                peak: peak(m),
                mean: peak(m),
            }),
        utc: None,
        axes_deg: Default::default(),
        sha256: String::new(),
    }
}

/// An id for the white geometry that the plan does not use.
pub fn white_id(plan: &Plan) -> u32 {
    (0..)
        .find(|id| plan.configuration(*id).is_none())
        .unwrap_or(0)
}
