//! What the controller says: banners, status reports, listings.

use super::{Flavor, GrblModel, Hold};

impl GrblModel {
    /// Sends one line after the usual latency.
    pub(super) fn say(&mut self, line: &str) {
        self.say_later(0.0, line);
    }

    pub(super) fn say_later(&mut self, delay: f64, line: &str) {
        self.send_later(delay, format!("{line}\r\n").into_bytes());
    }

    pub(super) fn send_later(&mut self, delay: f64, bytes: Vec<u8>) {
        let t = self.now + delay + self.options.latency;
        // A wire keeps the order of its bytes.
        let t = self.output.back().map_or(t, |(last, _)| last.max(t));
        self.output.push_back((t, bytes));
    }

    pub(super) fn ok(&mut self) {
        if !self.muted {
            self.say("ok");
        }
    }

    /// The text of a cold start, at the end of `booting_until`.
    pub(super) fn power_up_text(&mut self) {
        let delay = self.options.boot;
        if self.options.blank_eeprom {
            self.say_later(delay, "error:7");
            if self.options.flavor == Flavor::Grbl {
                for line in self.settings.lines() {
                    self.say_later(delay, &line);
                }
            }
        }
        if self.options.flavor == Flavor::Grbl && self.settings.get(22) > 0.0 {
            self.alarm = Some(0);
        }
        self.banner(delay);
    }

    /// The banner and what follows it.
    pub(super) fn banner(&mut self, delay: f64) {
        self.say_later(delay, "");
        match self.options.flavor {
            Flavor::Grbl => self.say_later(delay, "Grbl 1.1h ['$' for help]"),
            Flavor::GrblHal => {
                self.say_later(delay, "GrblHAL 1.1f ['$' or '$HELP' for help]");
            }
        }
        if self.init_locked() {
            self.alarm = Some(11);
            self.say_later(delay, "ALARM:11");
            self.say_later(delay, "[MSG:Homing cycle required]");
        } else if self.alarm.is_some() {
            self.say_later(delay, "[MSG:'$H'|'$X' to unlock]");
        }
    }

    /// grblHAL with bit 2 of `$22`: locked at start until homed.
    pub(super) fn init_locked(&self) -> bool {
        let lock = self.settings.get(22) as u32 & 4 != 0;
        self.options.flavor == Flavor::GrblHal && lock && !self.homed
    }

    fn state_name(&self) -> &'static str {
        let moving = self.motion.is_some();
        let jog = self.motion.as_ref().is_some_and(|m| m.block.jog);
        if self.alarm.is_some() {
            return "Alarm";
        }
        if self.homing_until.is_some() {
            return "Home";
        }
        match self.hold {
            Some(Hold::Feed) if moving => "Hold:1",
            Some(Hold::Feed) => "Hold:0",
            Some(Hold::Door) if moving => "Door:2",
            Some(Hold::Door) => "Door:0",
            _ if jog => "Jog",
            _ if moving || !self.queue.is_empty() => "Run",
            _ => "Idle",
        }
    }

    fn coordinates(&self, values: &[f64]) -> String {
        let shown: Vec<String> = values.iter().map(|v| format!("{:.3}", v + 0.0)).collect();
        shown.join(",")
    }

    /// The answer to `?`.
    pub(super) fn status_report(&mut self) {
        self.report(false);
    }

    /// grblHAL's answer to 0x87: every field, among them whether it is homed.
    pub(super) fn full_status_report(&mut self) {
        self.report(true);
    }

    fn report(&mut self, full: bool) {
        let position = self.quantized(self.position());
        let feed = self.motion.as_ref().map_or(0.0, |m| m.feed(self.now));
        let spindle = if self.spindle_on() {
            self.modal.spindle_speed
        } else {
            0.0
        };
        let mut fields = vec![
            self.state_name().to_owned(),
            format!("MPos:{}", self.coordinates(&position)),
        ];
        if self.options.flavor == Flavor::GrblHal {
            let busy = self.queue.len() + usize::from(self.motion.is_some());
            fields.push(format!("Bf:{},1023", self.capacity() - busy.min(100)));
        }
        fields.push(format!("FS:{feed:.0},{spindle:.0}"));
        if !self.options.pins.is_empty() {
            fields.push(format!("Pn:{}", self.options.pins));
        }
        if full {
            fields.push(format!(
                "WCO:{}",
                self.coordinates(&vec![0.0; position.len()])
            ));
            fields.push(format!("Ov:{},100,100", self.feed_override));
            fields.push(format!("H:{}", u8::from(self.homed)));
            fields.push("FW:grblHAL".to_owned());
        } else {
            self.intermittent_fields(&mut fields);
        }
        self.say(&format!("<{}>", fields.join("|")));
    }

    /// Offsets and overrides come only now and then, in an order of their own for each kind.
    fn intermittent_fields(&mut self, fields: &mut Vec<String>) {
        let zeros = vec![0.0; self.position.len()];
        let offsets = format!("WCO:{}", self.coordinates(&zeros));
        let accessory = match self.modal.spindle {
            3 => "S",
            4 => "C",
            _ => "",
        };
        let grbl = self.options.flavor == Flavor::Grbl;
        let mut overrides = format!("Ov:{},100,100", self.feed_override);
        if !accessory.is_empty() || !grbl {
            overrides.push_str(&format!("|A:{accessory}"));
        }
        if !grbl && self.reports_since_overrides == u32::MAX {
            overrides.push_str("|TLR:0");
        }
        let offsets_due = self.reports_since_offsets >= 10;
        let overrides_due = self.reports_since_overrides >= 10;
        self.reports_since_offsets = self.reports_since_offsets.saturating_add(1);
        self.reports_since_overrides = self.reports_since_overrides.saturating_add(1);
        if offsets_due && (grbl || !overrides_due) {
            self.reports_since_offsets = 0;
            fields.push(offsets);
        } else if overrides_due {
            self.reports_since_overrides = 0;
            fields.push(overrides);
        }
    }

    /// `$I`.
    pub(super) fn build_info(&mut self) {
        let lines: &[&str] = match self.options.flavor {
            Flavor::Grbl => &["[VER:1.1h.20190830:]", "[OPT:V,15,128]"],
            Flavor::GrblHal => &[
                "[VER:1.1f.20260817:]",
                "[OPT:VNML+,100,1024,5,0]",
                "[AXS:5:XYZAB]",
                "[NEWOPT:ENUMS,RT+,TC,SED]",
                "[FIRMWARE:grblHAL]",
                "[SIGNALS:D]",
                "[NVS STORAGE:*EEPROM]",
                "[DRIVER:Simulator]",
                "[DRIVER VERSION:260324]",
            ],
        };
        for line in lines {
            self.say(line);
        }
    }

    /// `$G`.
    pub(super) fn parser_state(&mut self) {
        let m = &self.modal;
        let common = format!(
            "G{} G54 G17 G{} G{} G94",
            m.motion,
            if m.inches { 20 } else { 21 },
            if m.relative { 91 } else { 90 }
        );
        let end = format!(
            "M{} M9 T0 F{:.0} S{:.0}",
            m.spindle, m.feed, m.spindle_speed
        );
        let line = match self.options.flavor {
            Flavor::Grbl => format!("[GC:{common} {end}]"),
            Flavor::GrblHal => format!("[GC:{common} G40 G49 G98 G50 {end}.]"),
        };
        self.say(&line);
    }

    /// `$#`.
    pub(super) fn offsets(&mut self) {
        let hal = self.options.flavor == Flavor::GrblHal;
        let zeros = self.coordinates(&vec![0.0; self.position.len()]);
        let mut names: Vec<&str> = vec!["G54", "G55", "G56", "G57", "G58", "G59"];
        if hal {
            names.extend(["G59.1", "G59.2", "G59.3"]);
        }
        names.extend(["G28", "G30", "G92"]);
        for name in names {
            self.say(&format!("[{name}:{zeros}]"));
        }
        let tool = if hal { &zeros } else { "0.000" };
        self.say(&format!("[TLO:{tool}]"));
        self.say(&format!("[PRB:{zeros}:0]"));
    }
}
