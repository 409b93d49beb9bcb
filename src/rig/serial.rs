//! A serial port as a [`Transport`].
//!
//! Never touches DTR or RTS after the port is open (a pseudo-terminal has none), and never flushes what the device has
//! already said. On Linux the system itself raises DTR on open, which resets Arduino-class boards.

use super::emergency::StopHandle;
use super::port_owner::owners;
use super::transport::{Transport, duration};
use crate::base::{Context, Error, Result};
use serialport::{ErrorKind, SerialPort, TTYPort};
use std::io::{self, Read, Write};
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// An open serial port, held exclusively.
#[derive(Debug)]
pub struct SerialTransport {
    port: TTYPort,
    /// A handle of its own for [`StopHandle`]s, closed with this transport.
    second: Arc<Mutex<TTYPort>>,
    path: String,
}

impl SerialTransport {
    /// Opens `path` at `baud`, 8N1, no flow control; `dtr` sets the line once while opening.
    ///
    /// # Errors
    /// With a hint: no such device, no permission, held by another program, or the system's reason.
    pub fn open(path: &str, baud: u32, dtr: Option<bool>) -> Result<Self> {
        let mut builder = serialport::new(path, baud).timeout(Duration::from_millis(100));
        if let Some(dtr) = dtr {
            builder = builder.dtr_on_open(dtr);
        }
        let port = TTYPort::open(&builder).map_err(|e| explain(path, baud, e))?;
        let second = port
            .try_clone_native()
            .context(|| format!("port {path} gives no second handle"))?;
        Ok(Self {
            port,
            second: Arc::new(Mutex::new(second)),
            path: path.to_owned(),
        })
    }

    /// A handle that writes `bytes` (a feed hold, say) from another thread, whatever this one waits for. It does not keep
    /// the port open.
    pub fn stop_handle(&self, bytes: &[u8]) -> StopHandle {
        StopHandle::new(format!("port {}", self.path), &self.second, bytes)
    }
}

fn explain(path: &str, baud: u32, error: serialport::Error) -> Error {
    let exists = Path::new(path).exists();
    let (what, hint) = match error.kind {
        ErrorKind::Io(io::ErrorKind::PermissionDenied) => (
            "no permission",
            "add yourself to the port's group and log in again: sudo usermod -aG dialout $USER"
                .to_owned(),
        ),
        ErrorKind::NoDevice if exists => return held(path).with_source(error),
        _ if !exists => ("no such device", known_ports()),
        _ => (
            "the system refused",
            format!("is {path} a serial port, and {baud} a speed it supports?"),
        ),
    };
    Error::new(format!("port {path} cannot be opened: {what}"))
        .with_hint(hint)
        .with_source(error)
}

/// One owner per port: the error names the other.
fn held(path: &str) -> Error {
    let owners = owners(path);
    if owners.is_empty() {
        return Error::new(format!(
            "port {path} cannot be opened: held by another process"
        ))
        .with_hint(format!(
            "close the other program, perhaps another user's: `sudo fuser -v {path}` names it"
        ));
    }
    Error::new(format!(
        "port {path} cannot be opened: held by {}",
        owners.join(" and ")
    ))
    .with_hint("close that program, or wait until it has ended")
}

fn known_ports() -> String {
    let names: Vec<String> = serialport::available_ports()
        .unwrap_or_default()
        .into_iter()
        .map(|p| p.port_name)
        .collect();
    if names.is_empty() {
        "no serial port is plugged in; check the cable and the board's power".to_owned()
    } else {
        format!("ports on this machine: {}", names.join(", "))
    }
}

impl Transport for SerialTransport {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        let _ = self.port.set_timeout(Duration::from_secs(2));
        self.port.write_all(bytes)
    }

    fn read(&mut self, buffer: &mut [u8], timeout: f64) -> io::Result<usize> {
        // On POSIX this only stores the number.
        let _ = self.port.set_timeout(duration(timeout));
        match self.port.read(buffer) {
            // A signal (Ctrl-C) is not a fault of the port.
            Err(e) if e.kind() == io::ErrorKind::Interrupted => Err(super::transport::timed_out()),
            other => other,
        }
    }
}
