//! `goniofit report`.

use super::Outcome;
use crate::base::{Error, Result};

/// Make the HTML page of a fit
#[derive(clap::Args)]
pub(crate) struct Arguments {}

pub(crate) fn run(_arguments: Arguments) -> Result<Outcome> {
    Err(Error::new("not built yet"))
}
