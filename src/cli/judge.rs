//! Lets the capture loop look at frames: the rig asks, the measuring room answers.

use crate::base::Result;
use crate::measure::FrameJudge;
use crate::rig::{CapturedFrame, Judge, Shot};
use crate::session::Exposedness;

/// A [`FrameJudge`] in the rig's terms.
pub(crate) struct CropJudge(pub(crate) FrameJudge);

impl Judge for CropJudge {
    fn judge(&mut self, shot: &Shot, frame: &CapturedFrame) -> Result<Option<Exposedness>> {
        self.0
            .look(shot.kind, &shot.pose, &frame.bytes, &frame.extension)
    }
}
