//! What is still to come in a capture and how long it will take: from the plan, then from the capture's own timings.

use super::description::RigDescription;
use super::devices::Shot;
use super::kinematics::AxisAngles;
use super::shots::{CapturePlan, History, PlannedShot};
use crate::session::FrameKind;
use std::cell::RefCell;
use std::collections::BTreeMap;

/// From where to where, bit by bit.
type Way = ([u64; 5], [u64; 5]);

/// Seconds a frame takes beyond its exposure, before one was taken.
const OVERHEAD: f64 = 0.0;

/// The rest of a capture.
#[derive(Debug, Clone)]
pub struct Outlook {
    description: RigDescription,
    shots: Vec<PlannedShot>,
    /// Ways looked up before: finding one may take a search.
    ways: RefCell<BTreeMap<Way, f64>>,
    /// Seconds moves were expected to take, and took.
    expected_travel: f64,
    travel: f64,
    /// Frames taken, and seconds they took beyond their exposures.
    frames: f64,
    overhead: f64,
}

impl Outlook {
    /// Before the first move.
    pub fn new(description: &RigDescription, plan: &CapturePlan, history: &History) -> Self {
        Self {
            description: description.clone(),
            shots: plan.outlook(history),
            ways: RefCell::default(),
            expected_travel: 0.0,
            travel: 0.0,
            frames: 0.0,
            overhead: 0.0,
        }
    }

    /// Looks again after a frame was taken; the list is only made anew where it may have changed.
    pub(super) fn renew(&mut self, plan: &CapturePlan, history: &History) {
        let next = plan.next(history);
        if self.shots.get(1) == next.as_ref() && next.is_some() {
            self.shots.remove(0);
        } else if self.shots.first() != next.as_ref() {
            self.shots = plan.outlook(history);
        }
    }

    pub(super) fn moved(&mut self, expected: f64, took: f64) {
        self.expected_travel += expected;
        self.travel += took;
    }

    pub(super) fn taken(&mut self, shot: &Shot, took: f64) {
        self.frames += 1.0;
        self.overhead += (took - shot.exposure_ms / 1000.0).max(0.0);
    }

    /// Frames still to take, as far as is known.
    pub fn frames_left(&self) -> usize {
        self.shots.len()
    }

    /// The shots still to come.
    pub fn shots(&self) -> &[PlannedShot] {
        &self.shots
    }

    /// Seconds of the way to a shot, settling included.
    pub(super) fn travel_to(&self, from: Option<&AxisAngles>, to: &PlannedShot) -> f64 {
        from.map_or(0.0, |from| self.way(from, &to.angles))
    }

    /// Seconds from one place to the other, settling included; a place that cannot be reached fails when it is gone to.
    fn way(&self, from: &AxisAngles, to: &AxisAngles) -> f64 {
        let key = (from.0.map(f64::to_bits), to.0.map(f64::to_bits));
        let known = self.ways.borrow().get(&key).copied();
        known.unwrap_or_else(|| {
            let seconds = self.description.path(from, to).map_or(0.0, |legs| {
                self.description.legs_seconds(from, &legs, None)
                    + self.description.settle_ms_after(from, &legs) / 1000.0
            });
            self.ways.borrow_mut().insert(key, seconds);
            seconds
        })
    }

    /// Seconds to the end; before the first frame by the rig file alone.
    pub fn seconds_left(&self) -> f64 {
        let slower = if self.expected_travel > 1.0 {
            self.travel / self.expected_travel
        } else {
            1.0
        };
        let overhead = if self.frames > 0.0 {
            self.overhead / self.frames
        } else {
            OVERHEAD
        };
        let (mut seconds, mut lamp, mut at) = (0.0, self.frames > 0.0, None::<&PlannedShot>);
        for planned in &self.shots {
            if let Some(at) = at
                && at.angles != planned.angles
            {
                seconds += slower * self.way(&at.angles, &planned.angles);
            }
            if planned.shot.kind != FrameKind::Dark && !lamp {
                seconds += self.description.lamp.warm_up_s;
                lamp = true;
            }
            seconds += planned.shot.exposure_ms / 1000.0 + overhead;
            at = Some(planned);
        }
        seconds
    }
}
