//! `goniofit render`.

use super::Outcome;
use crate::base::{Error, Result};

/// Estimate the mean intensities of a fabric at given parameters
#[derive(clap::Args)]
pub(crate) struct Arguments {}

pub(crate) fn run(_arguments: Arguments) -> Result<Outcome> {
    Err(Error::new("not built yet"))
}
