//! The person in front of the rig, as the capture loop sees them.

use super::Shot;
use super::devices::CapturedFrame;
use crate::base::{Result, Watch};
use crate::session::FrameRecord;

/// What the operator asks for, in order of urgency.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Request {
    /// To go on.
    Go,
    /// To pause before the next motion or shot.
    Pause,
    /// To pause now: motion brakes with its position kept, and is planned anew from there afterwards.
    PauseNow,
    /// To end now: motion brakes with its position kept, the lamp goes off, the session stays resumable.
    Abort,
    /// To end the fastest way there is, whatever becomes of the position.
    Halt,
}

/// What the loop is doing, for whoever shows it.
#[derive(Debug)]
pub enum Seen<'a> {
    /// Work begins, the first time or after an interruption: frames there will be, those on disk included, and seconds to
    /// the end, as far as is known.
    Begins {
        /// Frames.
        frames: usize,
        /// Seconds.
        seconds: f64,
    },
    /// The way to the pose of this shot begins; it will take about this many seconds.
    Moving(&'a Shot, f64),
    /// The lamp warms up for this many seconds.
    WarmingUp(f64),
    /// The shutter opens.
    Exposing(&'a Shot),
    /// A frame is on disk and journaled.
    Taken(&'a Taken<'a>),
    /// Something was not as expected and is dealt with: why, and what is done.
    Note(&'a str),
}

/// A frame that is on disk.
#[derive(Debug)]
pub struct Taken<'a> {
    /// What was asked for.
    pub shot: &'a Shot,
    /// As journaled.
    pub record: &'a FrameRecord,
    /// The file.
    pub frame: &'a CapturedFrame,
    /// Frames on disk, this one included.
    pub frames: usize,
    /// Frames there will be, as far as is known now.
    pub frames_planned: usize,
    /// Seconds to the end, learned from this capture's own timings.
    pub remaining_s: f64,
}

/// The person in front of the rig. [`Watch::cancelled`] is a request of at least [`Request::Pause`], [`Watch::urgent`]
/// one of at least [`Request::PauseNow`].
pub trait Operator: Watch {
    /// What is asked for now.
    fn request(&self) -> Request;

    /// Asks for something to be done or looked at by hand.
    ///
    /// # Errors
    /// The answer is no, or nobody is there.
    fn confirm(&self, question: &str) -> Result<()>;

    /// The capture is paused and the rig at rest; the lamp is on, unless motion had to be stopped. Returns when the operator decided: true to go on, with
    /// [`Operator::request`] at [`Request::Go`] again, false to end here, resumable.
    fn paused(&self) -> bool;

    /// Something happened.
    fn seen(&self, what: &Seen<'_>);
}

/// An operator who has everything in place and is not looking; may ask to pause and to abort through a [`Watch`].
#[derive(Clone, Copy)]
pub struct Unattended<'a>(pub &'a dyn Watch);

impl Watch for Unattended<'_> {
    fn progress(&self, stage: &str, done: u64, total: u64) {
        self.0.progress(stage, done, total);
    }
    fn cancelled(&self) -> bool {
        self.0.cancelled()
    }
    fn urgent(&self) -> bool {
        self.0.urgent()
    }
}

impl Operator for Unattended<'_> {
    fn request(&self) -> Request {
        if self.0.urgent() {
            Request::Abort
        } else if self.0.cancelled() {
            Request::Pause
        } else {
            Request::Go
        }
    }
    fn confirm(&self, _question: &str) -> Result<()> {
        Ok(())
    }
    fn paused(&self) -> bool {
        false
    }
    fn seen(&self, _what: &Seen<'_>) {}
}
