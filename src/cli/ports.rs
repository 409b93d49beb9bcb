//! Which ports a rig is reached through.

use crate::base::{Error, Result};
use crate::rig::{
    Connection, EmergencyLine, LampOutput, RigDescription, SerialTransport, SystemClock, Transport,
};
use std::sync::Arc;

/// Replaces ports of the rig file by those given as `PATH` (for a rig with one board) or `DEVICE=PATH`.
pub(crate) fn override_ports(rig: &mut RigDescription, ports: &[String]) -> Result<()> {
    for given in ports {
        let boards = rig.boards.len();
        let mut devices: Vec<(String, &mut String)> = rig
            .boards
            .iter_mut()
            .map(|b| (b.name.clone(), &mut b.port))
            .collect();
        if let LampOutput::Scpi { port, .. } = &mut rig.lamp.output {
            devices.push((port.name.clone(), &mut port.path));
        }
        let names: Vec<&str> = devices.iter().map(|d| d.0.as_str()).collect();
        let names = names.join(", ");
        let (name, path) = match given.split_once('=') {
            Some((name, path)) => (Some(name), path),
            None => (None, given.as_str()),
        };
        if name.is_none() && boards > 1 {
            return Err(
                Error::new(format!("--port {given}: the rig has several boards"))
                    .with_hint(format!("write --port NAME={given}; the names are {names}")),
            );
        }
        let device = devices
            .iter_mut()
            .find(|d| name.is_none_or(|name| d.0 == name));
        let device = device.ok_or_else(|| {
            let name = name.unwrap_or_default();
            Error::new(format!("--port {given}: unknown board '{name}'"))
                .with_hint(format!("the names are {names}"))
        })?;
        path.clone_into(device.1);
    }
    Ok(())
}

/// Real ports, real time; every board that is opened is put on the emergency line.
pub(crate) fn serial_connection<'a>(
    rig: &'a RigDescription,
    line: &'a EmergencyLine,
) -> Connection<'a> {
    Connection {
        open: Box::new(|device| {
            let port = SerialTransport::open(&device.path, device.baud, device.dtr)?;
            if let Some(board) = rig.boards.iter().find(|b| b.name == device.name) {
                line.add(port.stop_handle(board.protocol.stop_bytes()));
            }
            Ok(Box::new(port) as Box<dyn Transport>)
        }),
        clock: Arc::new(SystemClock::new()),
        wait_scale: 1.0,
    }
}
