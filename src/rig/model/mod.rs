//! A byte-level model of a motion controller: Grbl 1.1 (3 axes) or grblHAL (5 axes).
//!
//! A pure state machine: bytes and the time go in, bytes come out. It serves tests in process on a virtual clock and,
//! over a pseudo-terminal, the real serial code. Texts, error numbers and the order of replies follow recorded dialogues
//! with both controllers (`tests/data/wire`).
//!
//! Not modeled: look-ahead between blocks (each line starts and ends at rest), arcs, probing, work offsets other than
//! zero, check mode, sleep, start-up blocks, rapid and spindle overrides, grblHAL's 0x80-0x86. Homing always finds its
//! switches.

mod gcode;
mod lines;
mod motion;
mod options;
mod report;
mod settings;
mod stopping;

pub use options::{Fault, FaultKind, Flavor, ModelOptions};

use motion::{Block, Motion};
use settings::Settings;
use std::collections::VecDeque;

#[derive(Debug, Clone, Copy, PartialEq)]
enum Hold {
    Feed,
    Door,
    /// A jog cancel: what is planned is thrown away at standstill.
    JogCancel,
}

/// A line that is accepted but acknowledged later.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Waiting {
    /// For the motion to end, then to dwell this long.
    Dwell(f64),
    /// For the motion to end, then to switch the spindle (3, 4, 5) to this speed.
    Spindle(u8, f64),
    /// For the dwell to end.
    DwellUntil(f64),
}

#[derive(Debug, Clone)]
struct Modal {
    motion: u8,
    relative: bool,
    inches: bool,
    feed: f64,
    spindle: u8,
    spindle_speed: f64,
}

const POWER_UP: Modal = Modal {
    motion: 0,
    relative: false,
    inches: false,
    feed: 0.0,
    spindle: 5,
    spindle_speed: 0.0,
};

/// The controller.
#[derive(Debug)]
pub struct GrblModel {
    options: ModelOptions,
    settings: Settings,
    now: f64,
    /// Until then it is starting up and hears nothing.
    booting_until: Option<f64>,
    gone: bool,
    output: VecDeque<(f64, Vec<u8>)>,
    partial: Vec<u8>,
    overlong: bool,
    lines: VecDeque<Vec<u8>>,
    waiting: Option<Waiting>,
    queue: VecDeque<Block>,
    motion: Option<Motion>,
    position: Vec<f64>,
    /// Where the last planned line ends.
    planned: Vec<f64>,
    modal: Modal,
    hold: Option<Hold>,
    homing_until: Option<f64>,
    /// Grbl was asked for its state while homing, and answers afterwards.
    report_due: bool,
    homed: bool,
    alarm: Option<u8>,
    /// Deaf until 0x18.
    critical: bool,
    sticky_error: Option<u8>,
    feed_override: u32,
    reports_since_offsets: u32,
    reports_since_overrides: u32,
    moves_seen: u32,
    /// Lines with an axis word that arrived.
    move_lines: u32,
    /// Says `Run` and does nothing.
    stuck: bool,
    fault_at: Option<(f64, FaultKind)>,
    muted: bool,
}

impl GrblModel {
    /// A controller that is switched on at time 0.
    pub fn new(options: ModelOptions) -> Self {
        let n = options.flavor.letters().len();
        let mut settings = Settings::factory(options.flavor, n);
        for &(number, value) in &options.settings {
            settings.set(number, value);
        }
        let mut model = Self {
            settings,
            now: 0.0,
            booting_until: Some(options.boot),
            gone: false,
            output: VecDeque::new(),
            partial: Vec::new(),
            overlong: false,
            lines: VecDeque::new(),
            waiting: None,
            queue: VecDeque::new(),
            motion: None,
            position: vec![0.0; n],
            planned: vec![0.0; n],
            modal: POWER_UP,
            hold: None,
            homing_until: None,
            report_due: false,
            homed: false,
            alarm: None,
            critical: false,
            sticky_error: None,
            feed_override: 100,
            reports_since_offsets: u32::MAX,
            reports_since_overrides: u32::MAX,
            moves_seen: 0,
            move_lines: 0,
            stuck: false,
            fault_at: None,
            muted: false,
            options,
        };
        model.power_up_text();
        model
    }

    /// Takes bytes that arrive at time `now` (seconds; times never go backwards).
    pub fn receive(&mut self, bytes: &[u8], now: f64) {
        self.advance(now);
        for &byte in bytes {
            self.receive_byte(byte);
        }
        self.process_lines();
    }

    /// What has been sent by time `now`.
    pub fn take_output(&mut self, now: f64) -> Vec<u8> {
        self.advance(now);
        let mut bytes = Vec::new();
        while self.output.front().is_some_and(|(t, _)| *t <= now) {
            if let Some((_, piece)) = self.output.pop_front() {
                bytes.extend(piece);
            }
        }
        bytes
    }

    /// The next time at which something happens by itself, if anything will.
    pub fn next_event(&self) -> Option<f64> {
        let output = self.output.front().map(|(t, _)| *t);
        [output, self.next_internal()]
            .into_iter()
            .flatten()
            .reduce(f64::min)
    }

    /// True when the device has disappeared.
    pub fn is_gone(&self) -> bool {
        self.gone
    }

    /// True while the spindle output (the lamp) is on.
    pub fn spindle_on(&self) -> bool {
        self.modal.spindle != 5
    }

    /// True once homed, until the position is lost.
    pub fn is_homed(&self) -> bool {
        self.homed
    }

    /// True while it looks for its switches.
    pub fn is_homing(&self) -> bool {
        self.homing_until.is_some()
    }

    /// True while an axis moves.
    pub fn is_moving(&self) -> bool {
        self.motion.is_some() || self.homing_until.is_some()
    }

    /// Axis positions in machine units, at the time last heard of.
    pub fn position(&self) -> Vec<f64> {
        self.motion
            .as_ref()
            .map_or_else(|| self.position.clone(), |m| m.position(self.now))
    }

    // -- time -------------------------------------------------------------------------------------------------------

    fn next_internal(&self) -> Option<f64> {
        if self.gone {
            return None;
        }
        let dwell = match self.waiting {
            Some(Waiting::DwellUntil(t)) => Some(t),
            _ => None,
        };
        [
            self.booting_until,
            self.homing_until,
            self.motion.as_ref().map(Motion::end),
            self.fault_at.map(|f| f.0),
            dwell,
        ]
        .into_iter()
        .flatten()
        .reduce(f64::min)
    }

    fn advance(&mut self, now: f64) {
        while let Some(t) = self.next_internal().filter(|t| *t <= now) {
            self.now = self.now.max(t);
            self.happen();
        }
        self.now = self.now.max(now);
    }

    /// Does what is due at `self.now`.
    fn happen(&mut self) {
        let due = |t: Option<f64>| t.is_some_and(|t| t <= self.now);
        if due(self.booting_until) {
            self.booting_until = None;
        } else if due(self.fault_at.map(|f| f.0)) {
            if let Some((_, kind)) = self.fault_at.take() {
                self.suffer(kind);
            }
        } else if due(self.homing_until) {
            self.finish_homing();
        } else if due(self.motion.as_ref().map(Motion::end)) {
            self.finish_motion();
        }
        self.continue_waiting();
        self.process_lines();
    }

    fn finish_homing(&mut self) {
        self.homing_until = None;
        let pull_off = self.settings.get(27);
        self.position.fill(-pull_off);
        self.planned.clone_from(&self.position);
        self.homed = true;
        self.alarm = None;
        if std::mem::take(&mut self.report_due) {
            self.status_report();
        }
        self.ok();
    }

    fn finish_motion(&mut self) {
        let Some(motion) = self.motion.take() else {
            return;
        };
        self.position = self.quantized(motion.position(self.now));
        if self.hold == Some(Hold::JogCancel) {
            self.hold = None;
            self.queue.clear();
            self.planned.clone_from(&self.position);
        } else if !motion.at_target(self.now) {
            // Standstill in a hold: the rest of the line waits.
            self.queue.push_front(motion.block);
        }
        if self.hold.is_none() {
            self.start_next_block();
        }
    }

    fn start_next_block(&mut self) {
        if self.motion.is_some() || self.hold.is_some() || self.alarm.is_some() {
            return;
        }
        let Some(block) = self.queue.pop_front() else {
            return;
        };
        let n = self.position.len();
        let rates = self.settings.per_axis(110, n);
        let accelerations = self.settings.per_axis(120, n);
        self.motion = Some(Motion::start(
            &self.position,
            block,
            &rates,
            &accelerations,
            self.now,
        ));
    }

    /// Positions are whole motor steps.
    fn quantized(&self, position: Vec<f64>) -> Vec<f64> {
        let steps = self.settings.per_axis(100, position.len());
        position
            .iter()
            .zip(&steps)
            .map(|(p, s)| (p * s).round() / s)
            .collect()
    }

    fn continue_waiting(&mut self) {
        let still = self.motion.is_none() && self.queue.is_empty() && !self.stuck;
        match self.waiting {
            Some(Waiting::Dwell(seconds)) if still => {
                self.waiting = Some(Waiting::DwellUntil(self.now + seconds));
            }
            Some(Waiting::Spindle(code, speed)) if still => {
                self.modal.spindle = code;
                self.modal.spindle_speed = speed;
                self.waiting = None;
                self.ok();
            }
            Some(Waiting::DwellUntil(t)) if t <= self.now => {
                self.waiting = None;
                self.ok();
            }
            _ => {}
        }
    }
}
