//! Serial ports: which there are, who may open them, who answers.

use super::{Finding, Findings, Level};
use crate::base::Unwatched;
use crate::rig::{LampOutput, Protocol, RigDescription, SerialPortInfo, probe, serial_ports};
use rustix::fs::{Access, access};
use std::path::Path;

const GROUP_HINT: &str =
    "add yourself to the port's group and log in again: sudo usermod -aG dialout $USER";

/// Looks at the ports of this machine and at those the rig file names.
pub(super) fn look(rig: Option<&RigDescription>, may_open: bool) -> Vec<Finding> {
    let mut findings = Findings::new("port");
    let found = serial_ports().unwrap_or_else(|e| {
        findings.fail(&e);
        Vec::new()
    });
    if found.is_empty() && rig.is_none() {
        findings.add(
            Level::Warn,
            "no serial port on this machine",
            "plug the boards in and power them; `goniofit sim` stands in for one",
        );
    }
    for port in &found {
        describe(port, &mut findings);
    }
    match rig {
        Some(rig) => {
            for device in named(rig) {
                of_rig(&device, &found, may_open, &mut findings);
            }
        }
        None if may_open => {
            for port in found.iter().filter(|p| may_use(&p.path)) {
                anybody(&port.path, &mut findings);
            }
        }
        None => {}
    }
    findings.all
}

fn may_use(path: &str) -> bool {
    access(path, Access::READ_OK | Access::WRITE_OK).is_ok()
}

fn describe(port: &SerialPortInfo, findings: &mut Findings) {
    let stable = port
        .stable_path
        .as_ref()
        .map_or(String::new(), |p| format!(", {p}"));
    let what = format!("{} ({}{stable})", port.path, port.what);
    if may_use(&port.path) {
        findings.ok(what);
    } else {
        findings.add(Level::Warn, format!("{what}: no permission"), GROUP_HINT);
    }
}

/// A device of the rig file.
struct Device<'a> {
    name: String,
    path: &'a str,
    /// Of a board: protocol and speed.
    speaks: Option<(Protocol, u32)>,
}

fn named(rig: &RigDescription) -> Vec<Device<'_>> {
    let boards = rig.boards.iter().map(|b| Device {
        name: format!("board '{}'", b.name),
        path: &b.port,
        speaks: Some((b.protocol, b.baud)),
    });
    let mut all: Vec<_> = boards.collect();
    if let LampOutput::Scpi { port, .. } = &rig.lamp.output {
        all.push(Device {
            name: "lamp".to_owned(),
            path: &port.path,
            speaks: None,
        });
    }
    all
}

fn of_rig(device: &Device<'_>, found: &[SerialPortInfo], may_open: bool, findings: &mut Findings) {
    let (path, speaks) = (device.path, device.speaks);
    let device = &device.name;
    if !Path::new(path).exists() {
        let names: Vec<&str> = found.iter().map(|p| p.path.as_str()).collect();
        let todo = if names.is_empty() {
            "no serial port is plugged in; check cable and power, or the port in the rig file"
                .to_owned()
        } else {
            format!("ports on this machine: {}", names.join(", "))
        };
        findings.add(Level::Fail, format!("{device}: there is no {path}"), todo);
        return;
    }
    if !may_use(path) {
        let what = format!("{device}: no permission for {path}");
        findings.add(Level::Fail, what, GROUP_HINT);
        return;
    }
    let stable = found
        .iter()
        .find(|p| p.path == path)
        .and_then(|p| p.stable_path.as_ref());
    match stable {
        Some(stable) => findings.add(
            Level::Warn,
            format!("{device}: {path} may be called otherwise when it is plugged in again"),
            format!("write port = \"{stable}\" in the rig file"),
        ),
        None => findings.ok(format!("{device}: {path} is there and may be opened")),
    }
    if let (true, Some((protocol, baud))) = (may_open, speaks) {
        match probe(path, baud, protocol, &Unwatched) {
            Ok(firmware) => findings.ok(format!("{device}: {firmware} answers")),
            Err(error) => findings.fail(&error),
        }
    }
}

/// Asks for one controller after the other on a port nobody said anything about.
fn anybody(path: &str, findings: &mut Findings) {
    const BAUD: u32 = 115_200;
    let mut reasons = Vec::new();
    for protocol in [Protocol::Grbl, Protocol::Zaber] {
        match probe(path, BAUD, protocol, &Unwatched) {
            Ok(firmware) => {
                findings.ok(format!("{path}: {firmware} answers"));
                return;
            }
            Err(error) => reasons.push(error.report().replace("\nhint: ", "; ")),
        }
    }
    findings.add(
        Level::Warn,
        format!("{path}: no controller answers at {BAUD} baud"),
        reasons.join("; "),
    );
}
