//! Stops that do not wait for the main loop: second handles to the open ports, to be written from another thread.
//!
//! A line keeps a port only as long as its transport lives; a port that was closed is passed over. Says nothing of what
//! the device makes of the bytes: the driver finds a board that holds, and must be told why.

use serialport::{SerialPort, TTYPort};
use std::fmt;
use std::io::Write;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

/// How long a port that takes no bytes may delay the ports after it.
const PATIENCE: Duration = Duration::from_millis(50);

/// A second handle to an open port, and the bytes that stop its device.
#[derive(Debug, Clone)]
pub struct StopHandle {
    name: String,
    port: Weak<Mutex<TTYPort>>,
    bytes: Vec<u8>,
}

impl StopHandle {
    pub(super) fn new(name: String, port: &Arc<Mutex<TTYPort>>, bytes: &[u8]) -> Self {
        Self {
            name,
            port: Arc::downgrade(port),
            bytes: bytes.to_vec(),
        }
    }

    /// Writes the bytes now; none when the port is closed.
    fn fire(&self) -> Option<std::io::Result<()>> {
        let port = self.port.upgrade()?;
        // Held for this write only, by whoever fires.
        let mut port = port.lock().unwrap_or_else(PoisonError::into_inner);
        let _ = port.set_timeout(PATIENCE);
        Some(port.write_all(&self.bytes))
    }
}

/// The emergency line of a rig: every device's stop, in the order in which they were added. Clones are the same line.
#[derive(Clone, Default)]
pub struct EmergencyLine {
    handles: Arc<Mutex<Vec<StopHandle>>>,
}

impl fmt::Debug for EmergencyLine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("EmergencyLine").finish_non_exhaustive()
    }
}

impl EmergencyLine {
    /// A line to no device.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a device. Handles of ports that were closed meanwhile are let go.
    pub fn add(&self, handle: StopHandle) {
        let mut handles = self.handles.lock().unwrap_or_else(PoisonError::into_inner);
        handles.retain(|h| h.port.strong_count() > 0);
        handles.push(handle);
    }

    /// Writes every device's stop at once; returns the names of those that took no bytes, with the reason. May be called
    /// from any thread, while others read and write the same ports, but not inside a signal handler.
    pub fn fire(&self) -> Vec<String> {
        let handles = self.handles.lock().unwrap_or_else(PoisonError::into_inner);
        handles
            .iter()
            .filter_map(|h| match h.fire() {
                Some(Err(e)) => Some(format!("{}: {e}", h.name)),
                _ => None,
            })
            .collect()
    }
}
