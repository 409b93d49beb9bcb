//! `goniofit fabric`.

use super::Outcome;
use crate::base::{Error, Result};

/// Make, describe, export and import fibers
#[derive(clap::Args)]
pub(crate) struct Arguments {}

pub(crate) fn run(_arguments: Arguments) -> Result<Outcome> {
    Err(Error::new("not built yet"))
}
