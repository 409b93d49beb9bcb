//! `goniofit capture`.

use super::Outcome;
use crate::base::{Error, Result};

/// Move the rig through a plan and record a session
#[derive(clap::Args)]
pub(crate) struct Arguments {}

pub(crate) fn run(_arguments: Arguments) -> Result<Outcome> {
    Err(Error::new("not built yet"))
}
