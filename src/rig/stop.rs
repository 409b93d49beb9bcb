//! Stopping every device of a rig from outside, whatever state it is in and whoever set it in motion.
//!
//! Needs neither homing nor fitting settings, and goes on with the other devices when one fails. It cannot stop a rig
//! whose port another program holds: that program must be told to stop.

use super::description::{Board, Port, Protocol, RigDescription};
use super::devices::Wiring;
use super::drivers;
use super::machine::Connection;
use super::transport::{Clock, Transport};
use crate::base::{Error, Result, Watch};
use std::sync::Arc;

/// Seconds to wait for the state a board was found in.
const FIRST_ANSWER: f64 = 0.4;

/// What became of one device.
#[derive(Debug)]
pub struct Stopped {
    /// Its name in the rig file; `lamp` for a lamp with its own driver.
    pub device: String,
    /// What was done, or why it could not be reached.
    pub outcome: Result<String>,
}

/// Stops motion on every board and switches the lamp off. Every board is told to brake before any is waited for; the
/// position stays known to the controller where that is possible.
pub fn stop_all(
    description: &RigDescription,
    connection: &mut Connection,
    watch: &dyn Watch,
) -> Vec<Stopped> {
    let clock = connection.clock.clone();
    let mut opened = Vec::new();
    for board in &description.boards {
        let braked = (connection.open)(&board.connection())
            .and_then(|transport| brake(board, transport, clock.as_ref()));
        opened.push((board, braked));
    }
    let light = drivers::light(&description.lamp.output, |port: &Port| {
        Ok(Wiring {
            name: port.name.clone(),
            transport: (connection.open)(port)?,
            clock: clock.clone(),
            watch,
        })
    });
    let mut done = Vec::new();
    // Connecting to a lamp of its own leaves it switched off.
    let light = light.and_then(|lamp| match lamp {
        Some(mut lamp) => lamp.switch_off().map(|()| Some("lamp off".to_owned())),
        None => Ok(None),
    });
    if let Some(outcome) = light.transpose() {
        done.push(Stopped {
            device: "lamp".to_owned(),
            outcome,
        });
    }
    done.extend(opened.into_iter().map(|(board, braked)| Stopped {
        device: board.name.clone(),
        outcome: braked.and_then(|(transport, found)| {
            let rest = settle(board, transport, &clock, watch, found.is_none())?;
            let found = found.unwrap_or_else(|| "silent".to_owned());
            Ok(format!("was {found}; {rest}"))
        }),
    }));
    done
}

/// Sends the brake before anything else, and reads the state the board was in, if it says so.
fn brake(
    board: &Board,
    mut transport: Box<dyn Transport>,
    clock: &dyn Clock,
) -> Result<(Box<dyn Transport>, Option<String>)> {
    let failed = |e: std::io::Error| {
        Error::new(format!("board '{}' cannot be told to stop", board.name))
            .with_hint("cut the motors' power")
            .with_source(e)
    };
    match board.protocol {
        Protocol::Grbl => transport.write(b"?!").map_err(failed)?,
        Protocol::Zaber => {
            transport.write(b"/stop\n").map_err(failed)?;
            return Ok((transport, Some("told to stop".to_owned())));
        }
    }
    let deadline = clock.now() + FIRST_ANSWER;
    let mut heard = Vec::new();
    while clock.now() < deadline {
        let mut buffer = [0; 512];
        if let Ok(n) = transport.read(&mut buffer, deadline - clock.now())
            && n > 0
        {
            heard.extend_from_slice(&buffer[..n]);
        }
        if let Some(state) = state_in(&heard) {
            if state.starts_with("Home") {
                break;
            }
            return Ok((transport, Some(state)));
        }
    }
    // Homing obeys no hold, and a critical alarm answers nothing: only a reset is left.
    transport.write(b"\x18").map_err(failed)?;
    Ok((transport, state_in(&heard)))
}

/// The state in the first status report among what was heard.
fn state_in(heard: &[u8]) -> Option<String> {
    let text = String::from_utf8_lossy(heard);
    let report = text.split_once('<')?.1.split_once('>')?.0;
    Some(report.split('|').next().unwrap_or(report).to_owned())
}

/// Waits for standstill and leaves the board at rest with its lamp off.
fn settle(
    board: &Board,
    transport: Box<dyn Transport>,
    clock: &Arc<dyn Clock>,
    watch: &dyn Watch,
    was_silent: bool,
) -> Result<String> {
    let wiring = Wiring {
        name: board.name.clone(),
        transport,
        clock: clock.clone(),
        watch,
    };
    let mut motion = drivers::motion(board, wiring)?;
    let off = motion.lamp().map(|lamp| lamp.switch_off());
    let lamp = match off {
        None => "",
        Some(Ok(())) => ", lamp off",
        // A locked board refuses the line; its reset has switched the lamp off.
        Some(Err(_)) => {
            motion.brake();
            motion.make_safe(false)?;
            ", lamp off by a reset"
        }
    };
    let state = motion.state()?;
    let reset = if was_silent { " after a reset" } else { "" };
    Ok(format!("now {state}{reset}{lamp}"))
}
