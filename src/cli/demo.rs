//! `goniofit demo`.

use super::Outcome;
use crate::base::{Error, Result};

/// The whole main job on the recorded session: replay, measure, fit, report
#[derive(clap::Args)]
pub(crate) struct Arguments {}

pub(crate) fn run(_arguments: Arguments) -> Result<Outcome> {
    Err(Error::new("not built yet"))
}
