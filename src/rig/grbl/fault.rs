//! What can go wrong in a dialogue with a controller, and how it is told.

use super::codes::{alarm_meaning, error_meaning};
use super::replies::may_hide_a_stop;
use crate::base::Error;
use crate::rig::wire_log::show_bytes;
use std::io;

#[derive(Debug)]
pub(super) enum Fault {
    /// The operator asked for it.
    Stopped,
    /// The device is gone, or a replay diverged.
    Disconnected(io::Error),
    /// No answer in time.
    Silent { during: String, seconds: f64 },
    /// `ALARM:n`.
    Alarm { number: u8, during: String },
    /// A banner nobody asked for.
    Restarted { during: String },
    /// `error:n`.
    Refused { number: u8, line: String },
    /// Bytes that are no reply.
    Garbled { bytes: Vec<u8>, during: String },
    /// An acknowledged line whose listing lacks what it must have.
    Incomplete { line: String },
    /// A well-formed reply or state that has no place here.
    Unexpected { what: String, hint: String },
}

/// The error of a wait that the operator ended.
pub(in crate::rig) fn stopped_at_once() -> Error {
    Error::new("stopped at once by the operator")
}

impl Fault {
    pub(super) fn unexpected(what: impl Into<String>, hint: impl Into<String>) -> Self {
        Self::Unexpected {
            what: what.into(),
            hint: hint.into(),
        }
    }

    /// Why, in a few words, when noise on the wire explains it and asking again may cure it.
    pub(super) fn noise(&self) -> Option<String> {
        match self {
            Self::Silent { during, seconds } => {
                Some(format!("no answer within {seconds:.0} s to {during}"))
            }
            Self::Garbled { bytes, during } if !may_hide_a_stop(bytes) => Some(format!(
                "garbled reply {} during {during}",
                show_bytes(bytes)
            )),
            Self::Incomplete { line } => Some(format!("the answer to '{line}' lacks a part")),
            _ => None,
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
                .with_hint("its lamp may still be on: check it, then the cable and the power; the device name may have changed, and the rig must be homed again"),
            Self::Silent { during, seconds } => Error::new(format!(
                "board '{board}': no answer within {seconds:.0} s to {during}"
            ))
            .with_hint("a controller in a critical alarm is silent until it is reset; check its power and the emergency stop, then start again"),
            Self::Alarm { number, during } => {
                let (meaning, action) = alarm_meaning(number);
                Error::new(format!("board '{board}': ALARM:{number} during {during}: {meaning}"))
                    .with_hint(action)
            }
            Self::Restarted { during } => Error::new(format!(
                "board '{board}' restarted by itself during {during}; its position is lost"
            ))
            .with_hint("check its power supply and for noise on the cable, then home again"),
            Self::Refused { number, line } => {
                let (meaning, action) = error_meaning(number);
                Error::new(format!(
                    "board '{board}' refused {line} with error:{number}: {meaning}"
                ))
                .with_hint(action)
            }
            Self::Garbled { bytes, during } => Error::new(format!(
                "board '{board}': garbled reply {} during {during}",
                show_bytes(&bytes)
            ))
            .with_hint("what the board did is unknown; check baud rate, cable and grounding, then start again"),
            Self::Incomplete { line } => Error::new(format!(
                "board '{board}': the answer to '{line}' lacks a part"
            ))
            .with_hint("the firmware must be Grbl 1.1 or grblHAL, and the cable free of noise"),
            Self::Unexpected { what, hint } => {
                Error::new(format!("board '{board}': {what}")).with_hint(hint)
            }
        }
    }
}
