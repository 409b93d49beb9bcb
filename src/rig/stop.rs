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
use std::io;
use std::sync::Arc;

/// Seconds to wait for the state a board was found in.
const FIRST_ANSWER: f64 = 0.4;
/// Seconds to listen to one of them at a time.
const TURN: f64 = 0.02;

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
    let mut opened: Vec<(&Board, Result<Braked>)> = Vec::new();
    for board in &description.boards {
        let braked =
            (connection.open)(&board.connection()).and_then(|transport| brake(board, transport));
        opened.push((board, braked));
    }
    hear_first_states(&mut opened, clock.as_ref());
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
        outcome: braked.and_then(|braked| {
            let found = braked.found;
            let rest = settle(board, braked.transport, &clock, watch, found.is_none())?;
            let found = found.unwrap_or_else(|| "silent".to_owned());
            Ok(format!("was {found}; {rest}"))
        }),
    }));
    done
}

/// A board that was told to brake.
struct Braked {
    transport: Box<dyn Transport>,
    heard: Vec<u8>,
    /// The state it was in, if it said so.
    found: Option<String>,
    /// All that can be done at once is done.
    done: bool,
}

/// Sends the brake before anything else.
fn brake(board: &Board, mut transport: Box<dyn Transport>) -> Result<Braked> {
    let is_zaber = board.protocol == Protocol::Zaber;
    let bytes: &[u8] = if is_zaber { b"/stop\n" } else { b"?!" };
    transport.write(bytes).map_err(|e| cannot_stop(board, e))?;
    Ok(Braked {
        transport,
        heard: Vec::new(),
        found: is_zaber.then(|| "told to stop".to_owned()),
        done: is_zaber,
    })
}

fn cannot_stop(board: &Board, e: io::Error) -> Error {
    Error::new(format!("board '{}' cannot be told to stop", board.name))
        .with_hint("cut the motors' power")
        .with_source(e)
}

/// Listens to all boards in turns for the state each was in when it was told to brake. One that is homing obeys no hold,
/// and one in a critical alarm answers nothing: only a reset is left for them.
fn hear_first_states(boards: &mut [(&Board, Result<Braked>)], clock: &dyn Clock) {
    let deadline = clock.now() + FIRST_ANSWER;
    loop {
        let late = clock.now() >= deadline;
        let mut waiting = false;
        for (board, result) in boards.iter_mut() {
            let Ok(braked) = result else { continue };
            if braked.done {
                continue;
            }
            match braked.listen(late) {
                Ok(()) => waiting |= !braked.done,
                Err(e) => *result = Err(cannot_stop(board, e)),
            }
        }
        if late || !waiting {
            return;
        }
    }
}

impl Braked {
    /// Reads what has come; resets a board that needs it, a silent one when it is `late`.
    fn listen(&mut self, late: bool) -> io::Result<()> {
        let mut buffer = [0; 512];
        match self.transport.read(&mut buffer, TURN) {
            Ok(0) => return Err(io::ErrorKind::BrokenPipe.into()),
            Ok(n) => self.heard.extend_from_slice(&buffer[..n]),
            Err(e)
                if matches!(
                    e.kind(),
                    io::ErrorKind::TimedOut | io::ErrorKind::Interrupted
                ) => {}
            Err(e) => {
                // What cannot be heard may still hear.
                let _ = self.transport.write(b"\x18");
                return Err(e);
            }
        }
        self.found = state_in(&self.heard);
        self.done = late || self.found.is_some();
        let homing = self.found.as_ref().is_some_and(|s| s.starts_with("Home"));
        if homing || (late && self.found.is_none()) {
            self.transport.write(b"\x18")?;
        }
        Ok(())
    }
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
