//! `goniofit simulate`.

use super::Outcome;
use crate::base::{Error, Result};

/// Make a synthetic session: a virtual camera photographs a rendered fabric
#[derive(clap::Args)]
pub(crate) struct Arguments {}

pub(crate) fn run(_arguments: Arguments) -> Result<Outcome> {
    Err(Error::new("not built yet"))
}
