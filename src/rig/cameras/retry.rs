//! Trying again, a bounded number of times, with every reason kept.

use super::CameraWiring;
use crate::base::{Context, Error, Result};

/// What a failure asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Remedy {
    /// To try again in a while.
    Again,
    /// To look for the camera anew, then try again.
    Reconnect,
    /// The operator.
    GiveUp,
}

/// Why an attempt failed.
#[derive(Debug)]
pub(super) struct Fault {
    pub(super) remedy: Remedy,
    pub(super) error: Error,
}

impl Fault {
    pub(super) fn new(remedy: Remedy, message: impl Into<String>, hint: &str) -> Self {
        Self {
            remedy,
            error: Error::new(message).with_hint(hint),
        }
    }
}

/// What cannot be mended by trying again: disk, folders, the operator's stop.
impl From<Error> for Fault {
    fn from(error: Error) -> Self {
        Self {
            remedy: Remedy::GiveUp,
            error,
        }
    }
}

/// Waits between attempts, seconds; one attempt more than these.
const WAITS: [f64; 5] = [0.5, 1.0, 2.0, 4.0, 8.0];

/// Tries until it works or the operator is needed; the error keeps every reason.
pub(super) fn persist<T>(
    wiring: &CameraWiring<'_>,
    what: &str,
    mut act: impl FnMut() -> Result<T, Fault>,
) -> Result<T> {
    let mut reasons: Vec<String> = Vec::new();
    loop {
        let fault = match act() {
            Ok(done) => return Ok(done),
            Err(fault) => fault,
        };
        let wait = WAITS.get(reasons.len());
        let (Some(&wait), true) = (wait, fault.remedy != Remedy::GiveUp) else {
            if reasons.is_empty() {
                return Err(fault.error);
            }
            let n = reasons.len() + 1;
            return Err(fault.error).context(|| {
                format!(
                    "{what}, tried {n} times: {}; attempt {n}",
                    in_order(&reasons)
                )
            });
        };
        let why = fault.error.report().replace("\nhint: ", ", ");
        (wiring.say)(&format!("camera: {why}; trying again in {wait} s"));
        reasons.push(fault.error.to_string());
        wiring.pause(wait)?;
    }
}

/// The reasons of all attempts; those that repeat themselves are told once.
fn in_order(reasons: &[String]) -> String {
    let mut told: Vec<String> = Vec::new();
    let mut first = 1;
    for same in reasons.chunk_by(|a, b| a == b) {
        let last = first + same.len() - 1;
        told.push(if same.len() > 1 {
            format!("attempts {first} to {last}: {}", same[0])
        } else {
            format!("attempt {first}: {}", same[0])
        });
        first = last + 1;
    }
    told.join("; ")
}
