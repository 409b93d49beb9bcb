//! Which serial ports this machine has, and what answers there.

use super::description::{Board, Homing, Protocol};
use super::devices::Wiring;
use super::drivers;
use super::serial::SerialTransport;
use super::transport::SystemClock;
use crate::base::{Error, Result, Watch};
use serialport::SerialPortType;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A serial port of this machine.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SerialPortInfo {
    /// Device path.
    pub path: String,
    /// A path that stays the same when the device is plugged in again, if the system keeps one.
    pub stable_path: Option<String>,
    /// What the system knows of the device, e.g. its USB name.
    pub what: String,
}

/// The serial ports of this machine; none is opened.
///
/// # Errors
/// The system does not tell.
pub fn serial_ports() -> Result<Vec<SerialPortInfo>> {
    let found = serialport::available_ports()
        .map_err(|e| Error::new("the serial ports cannot be listed").with_source(e))?;
    let links = stable_paths(Path::new("/dev/serial/by-id"));
    let mut ports: Vec<SerialPortInfo> = found
        .into_iter()
        .map(|port| {
            let device = std::fs::canonicalize(&port.port_name).ok();
            let link = links.iter().find(|(_, to)| Some(to) == device.as_ref());
            SerialPortInfo {
                stable_path: link.map(|(from, _)| from.display().to_string()),
                what: describe(&port.port_type),
                path: port.port_name,
            }
        })
        .collect();
    ports.sort_by(|a, b| a.path.cmp(&b.path));
    Ok(ports)
}

/// Links in `folder` with what they point at.
fn stable_paths(folder: &Path) -> Vec<(PathBuf, PathBuf)> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries
        .filter_map(|e| Some((e.path(), std::fs::canonicalize(e.path()).ok()?)))
        .collect()
}

fn describe(kind: &SerialPortType) -> String {
    match kind {
        SerialPortType::UsbPort(usb) => {
            let name = [usb.manufacturer.as_deref(), usb.product.as_deref()];
            let name: Vec<&str> = name.into_iter().flatten().collect();
            format!("USB {:04x}:{:04x} {}", usb.vid, usb.pid, name.join(" "))
                .trim()
                .to_owned()
        }
        SerialPortType::PciPort => "on board".to_owned(),
        SerialPortType::BluetoothPort => "Bluetooth".to_owned(),
        SerialPortType::Unknown => "unknown kind".to_owned(),
    }
}

/// Opens a port and asks who is there: the controller's own words. Opening resets many boards, and a motion under way is
/// stopped. What does not answer takes up to a minute.
///
/// # Errors
/// The port cannot be opened, or no controller of this protocol answers.
pub fn probe(path: &str, baud: u32, protocol: Protocol, watch: &dyn Watch) -> Result<String> {
    let board = Board {
        name: path.to_owned(),
        port: path.to_owned(),
        baud,
        dtr: None,
        homing: Homing::Cycle,
        protocol,
        address: 1,
    };
    let wiring = Wiring {
        name: board.name.clone(),
        transport: Box::new(SerialTransport::open(path, baud, None)?),
        clock: Arc::new(SystemClock::new()),
        watch,
    };
    Ok(drivers::motion(&board, wiring)?.firmware())
}
