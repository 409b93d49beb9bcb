//! `goniofit fit`.

use super::Outcome;
use crate::base::{Error, Result};

/// Find the model parameters that reproduce measured intensities
#[derive(clap::Args)]
pub(crate) struct Arguments {}

pub(crate) fn run(_arguments: Arguments) -> Result<Outcome> {
    Err(Error::new("not built yet"))
}
