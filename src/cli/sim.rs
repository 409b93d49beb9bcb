//! `goniofit sim`.

use super::Outcome;
use crate::base::{Error, Result};

/// Start a simulated GRBL controller on a pseudo-terminal and print its path
#[derive(clap::Args)]
pub(crate) struct Arguments {}

pub(crate) fn run(_arguments: Arguments) -> Result<Outcome> {
    Err(Error::new("not built yet"))
}
