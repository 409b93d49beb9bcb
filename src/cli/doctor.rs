//! `goniofit doctor`.
use super::Outcome;
use crate::base::Result;
/// x
#[derive(clap::Args)]
pub(crate) struct Arguments {}
pub(crate) fn run(_arguments: Arguments) -> Result<Outcome> {
    Ok(Outcome::Done)
}
