//! A byte-level model of a Zaber motion controller that speaks the ASCII protocol.
//!
//! A pure state machine: bytes and the time go in, bytes come out. Axes move with trapezoid speed, have limits and warning
//! flags, lose their reference at a restart and find it by homing. A command with a wrong checksum, for another device or
//! of no known form is not heard, as with a real one; a command without checksum is obeyed.
//!
//! Not modeled: other devices of the chain, streams, lockstep, triggers, parking, cyclic axes, replies in several packets.

mod axis;
mod commands;
mod options;

pub use options::{ZaberAxis, ZaberFault, ZaberFaultKind, ZaberOptions};

use super::simulator::ByteModel;
use axis::Axis;
use std::collections::VecDeque;

/// Characters a command may have.
const LONGEST: usize = 80;
/// Warning flags, the gravest first.
const RANKS: [&str; 6] = ["FD", "FS", "WR", "WH", "NC", "NI"];

/// The controller.
#[derive(Debug)]
pub struct ZaberModel {
    options: ZaberOptions,
    now: f64,
    /// When it was switched on last.
    since: f64,
    gone: bool,
    muted: bool,
    checksum: bool,
    alert: bool,
    axes: Vec<Axis>,
    partial: Vec<u8>,
    output: VecDeque<(f64, Vec<u8>)>,
    moves_seen: u32,
    fault_at: Option<(f64, usize, ZaberFaultKind)>,
}

impl ZaberModel {
    /// A controller that is switched on at time 0.
    pub fn new(options: ZaberOptions) -> Self {
        Self {
            now: 0.0,
            since: 0.0,
            gone: false,
            muted: false,
            checksum: options.checksum,
            alert: options.alert,
            axes: options.axes.iter().cloned().map(Axis::new).collect(),
            partial: Vec::new(),
            output: VecDeque::new(),
            moves_seen: 0,
            fault_at: None,
            options,
        }
    }

    /// Switches it off and on at the time last heard of.
    pub fn restart(&mut self) {
        self.since = self.now;
        self.partial.clear();
        self.output.clear();
        for axis in &mut self.axes {
            axis.power_up(self.now);
        }
    }

    /// True while an axis moves.
    pub fn is_moving(&self) -> bool {
        self.axes.iter().any(|a| a.is_moving(self.now))
    }

    /// True once every axis found its home sensor, until the reference is lost.
    pub fn is_homed(&self) -> bool {
        self.axes.iter().all(|a| !a.flags.contains("WR"))
    }

    /// Where the axes really stand, microsteps from their home sensors, at the time last heard of.
    pub fn truth(&self) -> Vec<f64> {
        self.axes.iter().map(|a| a.truth(self.now)).collect()
    }

    // -- time -------------------------------------------------------------------------------------------------------

    fn next_internal(&self) -> Option<f64> {
        if self.gone {
            return None;
        }
        let ends = self.axes.iter().filter_map(Axis::next_event);
        ends.chain(self.fault_at.map(|f| f.0)).reduce(f64::min)
    }

    fn advance(&mut self, now: f64) {
        while let Some(t) = self.next_internal().filter(|t| *t <= now) {
            self.now = self.now.max(t);
            if let Some((_, axis, kind)) = self.fault_at.take_if(|f| f.0 <= t) {
                self.suffer(axis, kind);
            }
            for i in 0..self.axes.len() {
                if self.axes[i].settle(self.now) && self.alert {
                    self.send_alert(i);
                }
            }
        }
        self.now = self.now.max(now);
    }

    /// Halfway through a move.
    fn suffer(&mut self, axis: usize, kind: ZaberFaultKind) {
        let now = self.now;
        let a = &mut self.axes[axis];
        match kind {
            ZaberFaultKind::Vanish => self.gone = true,
            ZaberFaultKind::Restart => self.restart(),
            ZaberFaultKind::Stall => {
                a.halt(now);
                a.flags.insert("FS");
            }
            ZaberFaultKind::Overheat => {
                a.halt(now);
                a.flags.insert("FD");
            }
            ZaberFaultKind::Interrupt => a.stop(now, a.options.acceleration),
            ZaberFaultKind::Knob(way) => {
                let to = a.position(now) + way;
                a.halt(now);
                a.start(to as f64, a.max_speed, now, now);
                a.flags.insert("NC");
            }
            _ => {}
        }
    }

    // -- what it says -----------------------------------------------------------------------------------------------

    fn flag_of(&self, axis: usize) -> &'static str {
        let axes = match axis {
            0 => &self.axes[..],
            n => &self.axes[n - 1..n],
        };
        let raised = RANKS
            .iter()
            .find(|f| axes.iter().any(|a| a.flags.contains(*f)));
        raised.copied().unwrap_or("--")
    }

    fn status_of(&self, axis: usize) -> &'static str {
        let busy = match axis {
            0 => self.axes.iter().any(|a| a.is_busy(self.now)),
            n => self.axes[n - 1].is_busy(self.now),
        };
        if busy { "BUSY" } else { "IDLE" }
    }

    fn send_alert(&mut self, axis: usize) {
        let (status, flag) = (self.status_of(axis + 1), self.flag_of(axis + 1));
        let address = self.options.address;
        self.send(&format!("!{address:02} {} {status} {flag}", axis + 1));
    }

    /// Sends a line, its kind first, with a checksum when that is switched on.
    fn send(&mut self, line: &str) {
        let sum = line.bytes().skip(1).fold(0_u8, u8::wrapping_add);
        let mut bytes = line.as_bytes().to_vec();
        if self.checksum {
            bytes.extend(format!(":{:02X}", sum.wrapping_neg()).bytes());
        }
        bytes.extend(b"\r\n");
        if !self.muted {
            let at = self.now + self.options.latency;
            self.output.push_back((at, bytes));
        }
    }
}

impl ByteModel for ZaberModel {
    fn receive(&mut self, bytes: &[u8], now: f64) {
        self.advance(now);
        if self.gone || self.now < self.since + self.options.boot {
            return;
        }
        for &byte in bytes {
            match byte {
                b'\n' | b'\r' => {
                    let line = std::mem::take(&mut self.partial);
                    self.hear(&line);
                }
                // A slash begins a command, whatever came before.
                b'/' => self.partial = vec![byte],
                _ if self.partial.len() < LONGEST => self.partial.push(byte),
                _ => self.partial = vec![0],
            }
        }
    }

    fn take_output(&mut self, now: f64) -> Vec<u8> {
        self.advance(now);
        let mut bytes = Vec::new();
        while self.output.front().is_some_and(|(t, _)| *t <= now) {
            bytes.extend(
                self.output
                    .pop_front()
                    .into_iter()
                    .flat_map(|(_, piece)| piece),
            );
        }
        bytes
    }

    fn next_event(&self) -> Option<f64> {
        let output = self.output.front().map(|(t, _)| *t);
        let times = [output, self.next_internal()];
        times.into_iter().flatten().reduce(f64::min)
    }

    fn is_gone(&self) -> bool {
        self.gone
    }
}
