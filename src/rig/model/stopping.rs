//! What stops the modeled controller: injected faults, alarms, holds, resets.

use super::{FaultKind, Flavor, GrblModel, Hold, Motion, POWER_UP};

impl GrblModel {
    // -- faults -----------------------------------------------------------------------------------------------------

    /// Counts a motion line and arms its fault; returns the fault that strikes at once.
    pub(super) fn count_move(&mut self, target: &mut [f64]) -> Option<FaultKind> {
        self.moves_seen += 1;
        let kind = self
            .options
            .faults
            .iter()
            .find(|f| f.on_move == self.moves_seen)?
            .kind;
        match kind {
            FaultKind::FallShort(units) => {
                target[0] -= units;
                None
            }
            FaultKind::Garble | FaultKind::NeverOk | FaultKind::DoubleOk => Some(kind),
            FaultKind::DropByte(_) | FaultKind::CorruptDigit(_) => None,
            _ => {
                // "Halfway" is known once the line runs; see `arm`.
                self.fault_at = Some((f64::INFINITY, kind));
                None
            }
        }
    }

    /// Sets the time of an armed fault to the middle of the motion that was just planned.
    pub(super) fn arm(&mut self) {
        let Some((f64::INFINITY, kind)) = self.fault_at else {
            return;
        };
        let end = self.motion.as_ref().map_or(self.now, Motion::end);
        self.fault_at = Some(((self.now + end) / 2.0, kind));
    }

    pub(super) fn suffer(&mut self, kind: FaultKind) {
        match kind {
            FaultKind::Reset => {
                self.freeze();
                self.modal = POWER_UP;
                self.forget_everything_queued();
                self.position.fill(0.0);
                self.planned.fill(0.0);
                self.homed = false;
                self.alarm = None;
                self.booting_until = Some(self.now + self.options.boot);
                self.power_up_text();
            }
            FaultKind::Alarm(number) => self.raise_alarm(number),
            FaultKind::Vanish => self.gone = true,
            FaultKind::Hold => self.begin_hold(Hold::Feed),
            FaultKind::StuckBusy => {
                self.freeze();
                self.queue.clear();
                self.stuck = true;
            }
            FaultKind::Garble
            | FaultKind::NeverOk
            | FaultKind::FallShort(_)
            | FaultKind::DoubleOk
            | FaultKind::DropByte(_)
            | FaultKind::CorruptDigit(_) => {}
        }
    }

    /// A line as it arrives after the damage done to it on the way, without its end; none when the end was lost.
    pub(super) fn damaged_on_the_way(&mut self, mut line: Vec<u8>) -> Option<Vec<u8>> {
        let letters = self.options.flavor.letters();
        let is_axis = |b: &u8| letters.contains(&(*b as char));
        let word = line.iter().position(is_axis).filter(|_| line[0] != b'$');
        let Some(word) = word else { return Some(line) };
        self.move_lines += 1;
        let fault = |f: &&super::Fault| f.on_move == self.move_lines;
        match self.options.faults.iter().find(fault).map(|f| f.kind) {
            Some(FaultKind::DropByte(place)) if place < line.len() => {
                line.remove(place);
            }
            Some(FaultKind::DropByte(_)) => {
                self.partial = line;
                return None;
            }
            Some(FaultKind::CorruptDigit(digit)) => {
                let rest = line.iter_mut().skip(word);
                if let Some(byte) = rest.into_iter().find(|b| b.is_ascii_digit()) {
                    *byte = digit as u8;
                }
            }
            _ => {}
        }
        Some(line)
    }

    // -- stopping ---------------------------------------------------------------------------------------------------

    /// Stops dead where it is.
    pub(super) fn freeze(&mut self) {
        let position = self.position();
        self.position = self.quantized(position);
        self.motion = None;
        self.planned.clone_from(&self.position);
    }

    pub(super) fn forget_everything_queued(&mut self) {
        self.queue.clear();
        self.lines.clear();
        self.partial.clear();
        self.overlong = false;
        self.waiting = None;
        self.hold = None;
        self.homing_until = None;
        self.report_due = false;
        self.sticky_error = None;
        self.stuck = false;
        self.feed_override = 100;
        self.reports_since_offsets = u32::MAX;
        self.reports_since_overrides = u32::MAX;
    }

    /// An alarm outside a reset: everything stops; 1 and 2 leave Grbl deaf.
    pub(super) fn raise_alarm(&mut self, number: u8) {
        self.freeze();
        self.alarm = Some(number);
        self.modal.spindle = 5;
        self.queue.clear();
        self.homed = false;
        self.say(&format!("ALARM:{number}"));
        if matches!(number, 1 | 2) {
            self.say_later(0.5, "[MSG:Reset to continue]");
            self.critical = self.options.flavor == Flavor::Grbl;
        }
    }

    pub(super) fn begin_hold(&mut self, hold: Hold) {
        if self.alarm.is_some() || self.homing_until.is_some() {
            return;
        }
        if let Some(motion) = &mut self.motion
            && !motion.braking
        {
            motion.brake(self.now);
        }
        self.hold = Some(hold);
    }

    pub(super) fn resume(&mut self) {
        if !matches!(self.hold, Some(Hold::Feed | Hold::Door)) {
            return;
        }
        self.hold = None;
        if let Some(motion) = &mut self.motion {
            motion.resume(self.now);
        }
        self.start_next_block();
    }

    /// 0x19 of grblHAL: stops dead and forgets what was queued, without an alarm.
    pub(super) fn stop_motion(&mut self) {
        self.freeze();
        self.queue.clear();
        self.waiting = None;
        self.hold = None;
        self.modal.spindle = 5;
        self.say("[MSG:Stop]");
    }

    /// 0x18.
    pub(super) fn soft_reset(&mut self) {
        let flavor = self.options.flavor;
        // The line that was being worked on is acknowledged although it was aborted.
        let held_up = self.hold.is_some() && !self.lines.is_empty();
        let aborted =
            self.waiting.is_some() || self.homing_until.is_some() || self.critical || held_up;
        let mut delay = 0.04;
        if self.motion.is_some() || self.homing_until.is_some() {
            let number = if self.homing_until.is_some() { 6 } else { 3 };
            self.freeze();
            self.alarm = Some(number);
            self.homed = false;
            self.say(&format!("ALARM:{number}"));
            delay = if flavor == Flavor::Grbl { 0.55 } else { 0.1 };
        }
        self.forget_everything_queued();
        self.planned.clone_from(&self.position);
        self.modal = POWER_UP;
        self.critical = false;
        if aborted {
            self.say("ok");
        }
        self.booting_until = Some(self.now + delay);
        self.banner(delay);
    }
}
