//! Bytes to lines, and lines to actions.

use super::gcode::{self, Request};
use super::{Block, FaultKind, Flavor, GrblModel, Hold, Waiting};

/// What a line leads to.
enum Answer {
    Ok,
    /// The `ok` comes later, or never.
    Silent,
}

impl GrblModel {
    /// Lines the planner can hold.
    pub(super) fn capacity(&self) -> usize {
        match self.options.flavor {
            Flavor::Grbl => 15,
            Flavor::GrblHal => 100,
        }
    }

    pub(super) fn receive_byte(&mut self, byte: u8) {
        if self.gone || self.booting_until.is_some() {
            return;
        }
        if byte == 0x18 {
            self.soft_reset();
            return;
        }
        if self.critical {
            return;
        }
        match byte {
            b'?' if self.homing_until.is_some() && self.options.flavor == Flavor::Grbl => {
                self.report_due = true;
            }
            b'?' => self.status_report(),
            0x87 if self.options.flavor == Flavor::GrblHal => self.full_status_report(),
            b'!' => self.begin_hold(Hold::Feed),
            b'~' => self.resume(),
            0x84 => {
                self.begin_hold(Hold::Door);
                self.say("[MSG:Check Door]");
            }
            0x85 if self.motion.as_ref().is_some_and(|m| m.block.jog) => {
                self.begin_hold(Hold::JogCancel);
            }
            0x90 => self.set_feed_override(100),
            0x91 => self.set_feed_override(self.feed_override + 10),
            0x92 => self.set_feed_override(self.feed_override - 10),
            0x93 => self.set_feed_override(self.feed_override + 1),
            0x94 => self.set_feed_override(self.feed_override - 1),
            0x80.. => {}
            b'\n' => self.end_line(),
            // Grbl ends a line at CR too, so CRLF is two lines; grblHAL takes CRLF as one and ignores a lone CR.
            b'\r' if self.options.flavor == Flavor::Grbl => self.end_line(),
            0..=b' ' => {}
            _ => self.keep(byte),
        }
    }

    fn set_feed_override(&mut self, percent: u32) {
        self.feed_override = percent.clamp(10, 200);
        self.reports_since_overrides = u32::MAX - 1;
    }

    fn keep(&mut self, byte: u8) {
        let (line, buffer) = match self.options.flavor {
            Flavor::Grbl => (80, 128),
            Flavor::GrblHal => (255, 1024),
        };
        let waiting: usize = self.lines.iter().map(|l| l.len() + 1).sum();
        if self.partial.len() >= line {
            self.overlong = true;
        } else if waiting + self.partial.len() < buffer {
            self.partial.push(byte.to_ascii_uppercase());
        }
    }

    fn end_line(&mut self) {
        let line = std::mem::take(&mut self.partial);
        if std::mem::take(&mut self.overlong) {
            self.lines.push_back(b"\0overlong".to_vec());
        } else {
            self.lines.push_back(line);
        }
    }

    /// Works off lines until one has to wait.
    pub(super) fn process_lines(&mut self) {
        while !self.critical
            && self.waiting.is_none()
            && self.hold.is_none()
            && self.homing_until.is_none()
        {
            let Some(line) = self.lines.front() else {
                return;
            };
            let is_gcode = !line.is_empty() && line[0] != b'$';
            if is_gcode && self.queue.len() >= self.capacity() {
                return;
            }
            let Some(line) = self.lines.pop_front() else {
                return;
            };
            let text = String::from_utf8_lossy(&line).into_owned();
            match self.execute(&text) {
                Ok(Answer::Ok) => self.ok(),
                Ok(Answer::Silent) => {}
                Err(number) => {
                    if self.options.flavor == Flavor::GrblHal {
                        self.sticky_error = Some(number);
                    }
                    self.say(&format!("error:{number}"));
                }
            }
        }
    }

    fn execute(&mut self, line: &str) -> Result<Answer, u8> {
        if line.is_empty() {
            self.sticky_error = None;
            return Ok(Answer::Ok);
        }
        if let Some(command) = line.strip_prefix('$') {
            let answer = self.dollar(command)?;
            self.sticky_error = None;
            return Ok(answer);
        }
        if let Some(number) = self.sticky_error {
            return Err(number);
        }
        if line.starts_with('\0') {
            return Err(11);
        }
        let request = gcode::request(line, self.options.flavor.letters())?;
        if self.alarm.is_some() {
            return Err(9);
        }
        self.act(request, false)
    }

    // -- $ commands -------------------------------------------------------------------------------------------------

    fn is_idle(&self) -> bool {
        self.motion.is_none() && self.queue.is_empty()
    }

    fn dollar(&mut self, command: &str) -> Result<Answer, u8> {
        if let Some(jog) = command.strip_prefix("J=") {
            return self.jog(jog);
        }
        match command {
            "" => self.help(),
            "G" => self.parser_state(),
            "#" => self.offsets(),
            "I" => self.build_info(),
            "X" => return self.unlock(),
            "N" | "$" | "H" if !self.is_idle() => return Err(8),
            "N" => {
                self.say("$N0=");
                self.say("$N1=");
            }
            "$" => {
                for line in self.settings.lines() {
                    self.say(&line);
                }
            }
            "H" => return self.home(),
            other => return self.setting(other),
        }
        Ok(Answer::Ok)
    }

    fn help(&mut self) {
        let extra = match self.options.flavor {
            Flavor::Grbl => "",
            Flavor::GrblHal => " $B",
        };
        self.say(&format!(
            "[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H{extra} ~ ! ? ctrl-x]"
        ));
    }

    fn unlock(&mut self) -> Result<Answer, u8> {
        if self.init_locked() {
            return Err(46);
        }
        if self.alarm.take().is_some() {
            self.say("[MSG:Caution: Unlocked]");
        }
        Ok(Answer::Ok)
    }

    fn home(&mut self) -> Result<Answer, u8> {
        if self.settings.get(22) <= 0.0 {
            return Err(5);
        }
        self.alarm = None;
        self.homing_until = Some(self.now + 4.0);
        Ok(Answer::Silent)
    }

    fn setting(&mut self, text: &str) -> Result<Answer, u8> {
        let hal = self.options.flavor == Flavor::GrblHal;
        let Some((number, value)) = text.split_once('=') else {
            let line = text.parse().ok().and_then(|n| self.settings.line(n));
            let line = line.filter(|_| hal).ok_or(3_u8)?;
            self.say(&line);
            return Ok(Answer::Ok);
        };
        let number: u16 = number.parse().map_err(|_| 3_u8)?;
        if !self.is_idle() {
            return Err(8);
        }
        let value: f64 = value.parse().map_err(|_| 2_u8)?;
        if number == 20 && value > 0.0 && self.settings.get(22) <= 0.0 {
            return Err(10);
        }
        if !self.settings.set(number, value) {
            return Err(if hal { 53 } else { 3 });
        }
        if number == 22 && value <= 0.0 {
            self.settings.set(20, 0.0);
        }
        Ok(Answer::Ok)
    }

    fn jog(&mut self, text: &str) -> Result<Answer, u8> {
        let jogging = self.motion.as_ref().is_some_and(|m| m.block.jog);
        if self.alarm.is_some() || !(self.is_idle() || jogging) {
            return Err(8);
        }
        let request = gcode::request(text, self.options.flavor.letters())?;
        if request.spindle.is_some() || request.motion.is_some() || request.dwell.is_some() {
            return Err(16);
        }
        if request.feed.is_none() {
            return Err(22);
        }
        let saved = self.modal.clone();
        let answer = self.act(request, true);
        self.modal = saved;
        answer
    }

    // -- g-code -----------------------------------------------------------------------------------------------------

    fn act(&mut self, r: Request, jog: bool) -> Result<Answer, u8> {
        let motion = r.motion.unwrap_or(self.modal.motion);
        let inches = r.inches.unwrap_or(self.modal.inches);
        let scale = if inches { 25.4 } else { 1.0 };
        let feed = r.feed.map_or(self.modal.feed, |f| f * scale);
        let moves = !r.axes.is_empty();
        if moves && (motion == 1 || jog) && feed <= 0.0 {
            return Err(22);
        }
        let relative = r.relative.unwrap_or(self.modal.relative);
        let mut target = self.planned.clone();
        for &(letter, value) in &r.axes {
            let letters = self.options.flavor.letters();
            let i = letters.iter().position(|l| *l == letter).ok_or(20_u8)?;
            let base = if relative && !r.machine_space {
                target[i]
            } else {
                0.0
            };
            target[i] = base + value * scale;
        }
        if moves && self.outside_soft_limits(&target) {
            if jog {
                return Err(15);
            }
            self.raise_alarm(2);
            return Ok(Answer::Silent);
        }
        self.modal.motion = motion;
        self.modal.inches = inches;
        self.modal.relative = relative;
        self.modal.feed = feed;
        let spindle_speed = r.spindle_speed.unwrap_or(self.modal.spindle_speed);
        if let Some(code) = r.spindle {
            self.waiting = Some(Waiting::Spindle(code, spindle_speed));
        } else {
            self.modal.spindle_speed = spindle_speed;
        }
        if let Some(seconds) = r.dwell {
            self.waiting = Some(Waiting::Dwell(seconds));
        }
        let strike = if moves {
            let speed = if motion == 0 && !jog {
                f64::INFINITY
            } else {
                feed / 60.0 * f64::from(self.feed_override) / 100.0
            };
            self.plan(target, speed, jog)
        } else {
            None
        };
        self.continue_waiting();
        match strike {
            Some(FaultKind::Garble) => {
                self.send_later(0.0, b"o\xfek\r\n".to_vec());
                Ok(Answer::Silent)
            }
            Some(FaultKind::NeverOk) => {
                self.muted = true;
                Ok(Answer::Silent)
            }
            // The spindle and the dwell acknowledge themselves.
            _ if r.spindle.is_some() || r.dwell.is_some() => Ok(Answer::Silent),
            _ => Ok(Answer::Ok),
        }
    }

    fn outside_soft_limits(&self, target: &[f64]) -> bool {
        let enforced =
            self.settings.get(20) > 0.0 && (self.homed || self.options.flavor == Flavor::Grbl);
        let travel = self.settings.per_axis(130, target.len());
        enforced
            && !target
                .iter()
                .zip(&travel)
                .all(|(t, span)| (-span..=0.0).contains(t))
    }

    fn plan(&mut self, mut target: Vec<f64>, speed: f64, jog: bool) -> Option<FaultKind> {
        let strike = self.count_move(&mut target);
        self.planned.clone_from(&target);
        let from = self.queue.back().map_or_else(
            || {
                let running = self.motion.as_ref().map(|m| m.block.to.clone());
                running.unwrap_or_else(|| self.position.clone())
            },
            |b| b.to.clone(),
        );
        let length: f64 = target.iter().zip(&from).map(|(a, b)| (a - b).abs()).sum();
        if length > 1e-9 {
            self.queue.push_back(Block {
                to: target,
                speed,
                jog,
            });
            self.start_next_block();
        }
        self.arm();
        strike
    }
}
