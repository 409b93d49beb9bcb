//! A byte-level model of a current source for LEDs that speaks SCPI.
//!
//! A pure state machine: bytes and the time go in, bytes come out. Short headers only, one output; unknown headers and
//! values out of range go to the error queue, as the standard says.

use super::simulator::ByteModel;
use std::collections::VecDeque;

/// What can go wrong with a current source.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ScpiFault {
    /// From the first `OUTP ON` on it answers nothing.
    Silent,
    /// It disappears at the first `OUTP ON`.
    Vanish,
    /// It refuses every current with an entry in its error queue.
    RefusesCurrent,
    /// It sets half the current it was asked for.
    WrongCurrent,
    /// `OUTP ON` does nothing and is no error (open interlock).
    StaysOff,
    /// So many `OUTP OFF` do nothing.
    StaysOn(u32),
    /// The n-th reply is lost (1 = first).
    LoseReply(u32),
    /// The n-th reply comes this late, seconds.
    LateReply(u32, f64),
    /// The n-th reply is damaged.
    GarbleReply(u32),
}

/// The current source.
#[derive(Debug)]
pub struct ScpiModel {
    limit_a: f64,
    channel: u8,
    faults: Vec<ScpiFault>,
    now: f64,
    gone: bool,
    muted: bool,
    on: bool,
    current_a: f64,
    mode: String,
    errors: VecDeque<&'static str>,
    partial: Vec<u8>,
    output: VecDeque<(f64, Vec<u8>)>,
    replies: u32,
    ignored_offs: u32,
}

/// Seconds from question to reply.
const LATENCY: f64 = 0.01;
const UNDEFINED: &str = "-113,\"Undefined header\"";
const OUT_OF_RANGE: &str = "-222,\"Data out of range\"";

impl ScpiModel {
    /// A current source with this limit, switched on at its panel (the light burns) and in another mode.
    pub fn new(limit_a: f64, faults: Vec<ScpiFault>) -> Self {
        Self {
            limit_a,
            channel: 1,
            faults,
            now: 0.0,
            gone: false,
            muted: false,
            on: true,
            current_a: 0.1,
            mode: "CB".to_owned(),
            errors: VecDeque::new(),
            partial: Vec::new(),
            output: VecDeque::new(),
            replies: 0,
            ignored_offs: 0,
        }
    }

    /// The same with this number on its output.
    pub fn on_channel(mut self, channel: u8) -> Self {
        self.channel = channel;
        self
    }

    /// True while current flows.
    pub fn is_on(&self) -> bool {
        self.on
    }

    /// The current that is set, amperes.
    pub fn current_a(&self) -> f64 {
        self.current_a
    }

    fn has(&self, fault: ScpiFault) -> bool {
        self.faults.contains(&fault)
    }

    fn say(&mut self, text: &str) {
        self.replies += 1;
        let n = self.replies;
        if self.muted || self.has(ScpiFault::LoseReply(n)) {
            return;
        }
        let mut bytes = format!("{text}\n").into_bytes();
        if self.has(ScpiFault::GarbleReply(n)) {
            bytes[0] ^= 0x40;
        }
        let late = self.faults.iter().find_map(|f| match f {
            ScpiFault::LateReply(which, seconds) if *which == n => Some(*seconds),
            _ => None,
        });
        // What is late holds up what follows.
        let before = self.output.back().map_or(self.now, |(t, _)| *t);
        let at = before.max(self.now + LATENCY + late.unwrap_or(0.0));
        self.output.push_back((at, bytes));
    }

    fn hear(&mut self, line: &str) {
        let (header, value) = line.split_once(' ').unwrap_or((line, ""));
        let header = self.numbered(header);
        match (header.as_str(), value) {
            ("", "") => {}
            ("*IDN?", "") => self.say("Thorlabs,DC2200,M00000001,1.3.0"),
            ("*CLS", "") => self.errors.clear(),
            ("SYST:ERR?", "") => {
                let entry = self.errors.pop_front().unwrap_or("+0,\"No error\"");
                self.say(entry);
            }
            ("SOUR:MODE", "CC" | "CB") => value.clone_into(&mut self.mode),
            ("SOUR:MODE?", "") => self.say(&self.mode.clone()),
            ("SOUR:CCUR:CURR", value) => self.set_current(value),
            ("SOUR:CCUR:CURR?", "") => self.say(&format!("{:.4E}", self.current_a)),
            ("SOUR:CURR:LIM?", "") => self.say(&format!("{:.4E}", self.limit_a)),
            ("OUTP:STAT", "ON") => self.switch_on(),
            ("OUTP:STAT", "OFF") => self.switch_off(),
            ("OUTP:STAT?", "") => self.say(if self.on { "1" } else { "0" }),
            _ => self.errors.push_back(UNDEFINED),
        }
    }

    /// A header with the output's own number left out; of another output, one that is not known.
    fn numbered(&self, header: &str) -> String {
        for tree in ["SOUR", "OUTP"] {
            if let Some(rest) = header.strip_prefix(tree) {
                let own = rest.strip_prefix(&self.channel.to_string());
                return own.map_or_else(|| "?".to_owned(), |rest| format!("{tree}{rest}"));
            }
        }
        header.to_owned()
    }

    fn set_current(&mut self, value: &str) {
        let refused = self.has(ScpiFault::RefusesCurrent);
        let value = value.parse().ok();
        match value.filter(|a| (0.0..=self.limit_a).contains(a) && !refused) {
            None => self.errors.push_back(OUT_OF_RANGE),
            Some(a) if self.has(ScpiFault::WrongCurrent) => self.current_a = 0.5 * a,
            Some(a) => self.current_a = a,
        }
    }

    fn switch_on(&mut self) {
        self.on = !self.has(ScpiFault::StaysOff);
        self.muted |= self.has(ScpiFault::Silent);
        self.gone |= self.has(ScpiFault::Vanish);
    }

    fn switch_off(&mut self) {
        let deaf = self.faults.iter().find_map(|f| match f {
            ScpiFault::StaysOn(n) => Some(*n),
            _ => None,
        });
        if self.ignored_offs < deaf.unwrap_or(0) {
            self.ignored_offs += 1;
        } else {
            self.on = false;
        }
    }
}

impl ByteModel for ScpiModel {
    fn receive(&mut self, bytes: &[u8], now: f64) {
        self.now = self.now.max(now);
        for &byte in bytes {
            if self.gone {
                return;
            }
            if byte == b'\n' {
                let line = std::mem::take(&mut self.partial);
                let line = String::from_utf8_lossy(&line).trim().to_uppercase();
                self.hear(&line);
            } else if self.partial.len() < 256 {
                self.partial.push(byte);
            }
        }
    }

    fn take_output(&mut self, now: f64) -> Vec<u8> {
        self.now = self.now.max(now);
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
        self.output.front().map(|(t, _)| *t)
    }

    fn is_gone(&self) -> bool {
        self.gone
    }
}
