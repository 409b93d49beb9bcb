//! `goniofit scatter`.

use super::Outcome;
use crate::base::{Error, Result};

/// Evaluate a scattering model
#[derive(clap::Args)]
pub(crate) struct Arguments {}

pub(crate) fn run(_arguments: Arguments) -> Result<Outcome> {
    Err(Error::new("not built yet"))
}
