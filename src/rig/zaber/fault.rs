//! What can go wrong in a dialogue with a Zaber controller, and how it is told.

use super::flags;
use crate::base::Error;
use crate::rig::grbl::stopped_at_once;
use std::io;

#[derive(Debug)]
pub(super) enum Fault {
    /// The operator asked for it.
    Stopped,
    /// The device is gone, or a replay diverged.
    Disconnected(io::Error),
    /// No intact reply, after so many tries; the last one's reason.
    Unanswered {
        during: String,
        tries: u32,
        reason: String,
    },
    /// `RJ`.
    Rejected { during: String, reason: String },
    /// A warning flag with which nothing may go on.
    Flagged { during: String, flag: String },
    /// It lost its reference, or its uptime began anew.
    Restarted { during: String },
    /// Something well-formed that has no place here.
    Unexpected { what: String, hint: String },
}

impl Fault {
    pub(super) fn unexpected(what: impl Into<String>, hint: impl Into<String>) -> Self {
        Self::Unexpected {
            what: what.into(),
            hint: hint.into(),
        }
    }

    /// The fault told to a person, for the board of this name.
    pub(super) fn told(self, board: &str) -> Error {
        match self {
            Self::Stopped => stopped_at_once(),
            Self::Disconnected(e) if e.kind() == io::ErrorKind::InvalidData => {
                let error = Error::new(format!("board '{board}': the replay failed"));
                match e.into_inner() {
                    Some(inner) => error.with_source(inner),
                    None => error,
                }
            }
            Self::Disconnected(e) => Error::new(format!("board '{board}' is disconnected"))
                .with_source(e)
                .with_hint("its axes may still move: check them, then the cable and the power; the device name may have changed, and the rig must be homed again"),
            Self::Unanswered {
                during,
                tries,
                reason,
            } => Error::new(format!(
                "board '{board}': no intact reply to {during} in {tries} {}: {reason}",
                if tries == 1 { "try" } else { "tries" }
            ))
            .with_hint("what the board did is unknown; check power, cable, grounding, baud rate and address, then start again"),
            Self::Rejected { during, reason } => {
                let (meaning, action) = flags::rejection(&reason);
                Error::new(format!(
                    "board '{board}' rejected {during} with {reason}: {meaning}"
                ))
                .with_hint(action)
            }
            Self::Flagged { during, flag } => {
                let (_, meaning, action) = flags::meaning(&flag);
                Error::new(format!(
                    "board '{board}': warning {flag} during {during}: {meaning}"
                ))
                .with_hint(action)
            }
            Self::Restarted { during } => Error::new(format!(
                "board '{board}' restarted by itself during {during}; its position is lost"
            ))
            .with_hint("check its power supply and for noise on the cable, then home again"),
            Self::Unexpected { what, hint } => {
                Error::new(format!("board '{board}': {what}")).with_hint(hint)
            }
        }
    }
}
