//! What happens in a session, and how it is recorded.

use goniofit::rig::{CapturedFrame, Shot};
use goniofit::session::{
    Configuration, Event, Filter, FrameKind, FrameRecord, Manifest, Plan, SessionFolder,
};
use std::path::Path;

/// What happens in a session.
pub enum Step {
    /// A stretch begins.
    Ready,
    Shot(Shot),
    /// Through a filter in front of the lens.
    Through(Shot, Filter),
    /// Nothing, for so many seconds.
    Wait(f64),
}

/// The steps of a session.
#[derive(Default)]
pub struct Script {
    pub steps: Vec<Step>,
    pub visits: u32,
}

impl Script {
    /// A session that begins.
    pub fn new() -> Self {
        Self {
            steps: vec![Step::Ready],
            visits: 0,
        }
    }

    /// The same shot at each exposure, so many times each.
    pub fn shots(
        &mut self,
        kind: FrameKind,
        pose: &Configuration,
        exposures_ms: &[f64],
        repeats: u32,
    ) {
        let planned = !matches!(
            kind,
            FrameKind::Dark | FrameKind::White | FrameKind::Reference
        );
        for &exposure_ms in exposures_ms {
            for repeat in 0..repeats {
                let visit = match kind {
                    FrameKind::Reference => self.visits,
                    _ => 0,
                };
                self.steps.push(Step::Shot(Shot {
                    kind,
                    config: planned.then_some(pose.id),
                    pose: *pose,
                    exposure_ms,
                    repeat,
                    visit,
                }));
            }
        }
    }

    /// Visits the reference pose.
    pub fn visit(&mut self, pose: &Configuration, exposures_ms: &[f64]) {
        self.shots(FrameKind::Reference, pose, exposures_ms, 1);
        self.visits += 1;
    }

    /// Seconds at the beginning of each step, and after the last: a second for each shot.
    pub fn times(&self) -> Vec<f64> {
        let mut times = vec![0.0];
        for step in &self.steps {
            let last = times[times.len() - 1];
            times.push(match step {
                Step::Ready => last,
                Step::Shot(_) | Step::Through(..) => last + 1.0,
                Step::Wait(seconds) => last + seconds,
            });
        }
        times
    }

    /// Every shot but darks three times, through one filter after another.
    pub fn through_filters(self) -> Self {
        let split = |step: Step| match step {
            Step::Shot(shot) if shot.kind != FrameKind::Dark => [Filter::R, Filter::G, Filter::B]
                .map(|f| Step::Through(shot.clone(), f))
                .into(),
            other => vec![other],
        };
        Self {
            steps: self.steps.into_iter().flat_map(split).collect(),
            visits: self.visits,
        }
    }

    /// Records the session into `root`; `expose` is told the shot, the filter, the time and the stretch.
    pub fn record(
        &self,
        root: &Path,
        manifest: &Manifest,
        plan: &Plan,
        mut expose: impl FnMut(&Shot, Option<Filter>, f64, usize) -> CapturedFrame,
    ) -> SessionFolder {
        let (session, mut journal) = SessionFolder::create(root, manifest, plan, "").unwrap();
        let (mut number, mut stretches) = (0, 0_usize);
        for (step, elapsed_s) in self.steps.iter().zip(self.times()) {
            let (shot, filter) = match step {
                Step::Wait(_) => continue,
                Step::Ready => {
                    let firmware = String::new();
                    let ready = Event::Ready {
                        firmware,
                        utc: None,
                    };
                    journal.append(elapsed_s, ready).unwrap();
                    stretches += 1;
                    continue;
                }
                Step::Shot(shot) => (shot, None),
                Step::Through(shot, filter) => (shot, Some(*filter)),
            };
            let frame = expose(shot, filter, elapsed_s, stretches.saturating_sub(1));
            let record = FrameRecord {
                file: FrameRecord::standard_name(
                    number,
                    shot.kind,
                    shot.config,
                    shot.exposure_ms,
                    &frame.extension,
                ),
                kind: shot.kind,
                config: shot.config,
                exposure_ms: frame.exposure_ms,
                repeat: shot.repeat,
                requested_ms: None,
                visit: shot.visit,
                filter,
                exposed: None,
                utc: None,
                axes_deg: Default::default(),
                sha256: String::new(),
            };
            session
                .add_frame(&mut journal, elapsed_s, record, &frame.bytes)
                .unwrap();
            number += 1;
        }
        session
    }
}
