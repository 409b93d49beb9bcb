//! `goniofit measure`.

use super::Outcome;
use crate::base::{Error, Result};

/// Turn a session's frames into mean intensities with standard errors
#[derive(clap::Args)]
pub(crate) struct Arguments {}

pub(crate) fn run(_arguments: Arguments) -> Result<Outcome> {
    Err(Error::new("not built yet"))
}
