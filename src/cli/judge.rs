//! The capture loop's look at a frame: `measure` decodes for `rig`.

use crate::base::Result;
use crate::rig::{CapturedFrame, Judge, Shot};
use crate::session::{CameraFacts, Exposedness};

/// Judges frames of one camera.
pub(crate) struct FrameJudge {
    facts: CameraFacts,
    sample_square_mm: f64,
}

impl FrameJudge {
    pub(crate) fn new(facts: CameraFacts, sample_square_mm: f64) -> Self {
        Self {
            facts,
            sample_square_mm,
        }
    }
}

impl Judge for FrameJudge {
    fn judge(&mut self, _shot: &Shot, _frame: &CapturedFrame) -> Result<Option<Exposedness>> {
        let _ = (&self.facts, self.sample_square_mm);
        Ok(None)
    }
}
