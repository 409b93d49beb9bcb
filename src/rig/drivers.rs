//! From a rig file's names to drivers: the only place that knows which protocol is which module.

use super::description::{Board, LampOutput, Port, Protocol};
use super::devices::{Light, Motion, Wiring};
use super::grbl::Grbl;
use super::scpi_led::ScpiLed;
use super::zaber::Zaber;
use crate::base::Result;

/// Connects to the controller of a board. Moves nothing; a motion that is under way is stopped.
///
/// # Errors
/// Nothing answers, or something else than the protocol promises.
pub(super) fn motion<'a>(board: &Board, wiring: Wiring<'a>) -> Result<Box<dyn Motion + 'a>> {
    match board.protocol {
        Protocol::Grbl => Ok(Box::new(Grbl::connect(
            &wiring.name,
            wiring.transport,
            wiring.clock,
            wiring.watch,
        )?)),
        Protocol::Zaber => Ok(Box::new(Zaber::connect(board.address, wiring)?)),
    }
}

/// Connects to a lamp's own current source and leaves it switched off; none when a board's output is the lamp.
///
/// # Errors
/// As [`motion`].
pub(super) fn light<'a>(
    output: &LampOutput,
    mut wiring: impl FnMut(&Port) -> Result<Wiring<'a>>,
) -> Result<Option<Box<dyn Light + 'a>>> {
    match output {
        LampOutput::Board { .. } => Ok(None),
        LampOutput::Scpi { port, channel, .. } => {
            let led = ScpiLed::connect(*channel, wiring(port)?)?;
            Ok(Some(Box::new(led)))
        }
    }
}
