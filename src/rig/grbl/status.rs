//! The status report, `<State|Key:values|...>`: fields come and go, unknown ones are left alone.

/// A parsed status report.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Status {
    /// `Idle`, `Run`, `Hold`, `Jog`, `Alarm`, `Door`, `Check`, `Home`, `Sleep`, or what the firmware says.
    pub state: String,
    /// The number after the state, e.g. 1 of `Hold:1`.
    pub substate: Option<u8>,
    /// `MPos`: machine position, controller units.
    pub machine_position: Option<Vec<f64>>,
    /// `WPos`: work position, controller units.
    pub work_position: Option<Vec<f64>>,
    /// `WCO`: machine position minus work position.
    pub work_offset: Option<Vec<f64>>,
    /// `Ov`: feed, rapid and spindle override, percent.
    pub overrides: Option<[f64; 3]>,
    /// `FS`: feed and spindle speed.
    pub feed_and_speed: Option<(f64, f64)>,
    /// `Pn`: triggered pins.
    pub pins: Option<String>,
    /// `H` of grblHAL: all axes that can be homed are.
    pub homed: Option<bool>,
}

impl Status {
    /// Parses what stands between `<` and `>`; none when a known field is damaged.
    pub(super) fn parse(text: &str) -> Option<Self> {
        let mut fields = text.split('|');
        let state = fields.next()?;
        let (name, substate) = match state.split_once(':') {
            Some((name, sub)) => (name, Some(sub.parse().ok()?)),
            None => (state, None),
        };
        if name.is_empty() || !name.chars().all(|c| c.is_ascii_alphabetic()) {
            return None;
        }
        let mut status = Self {
            state: name.to_owned(),
            substate,
            ..Self::default()
        };
        for field in fields {
            let (key, value) = field.split_once(':').unwrap_or((field, ""));
            match key {
                "MPos" => status.machine_position = Some(numbers(value)?),
                "WPos" => status.work_position = Some(numbers(value)?),
                "WCO" => status.work_offset = Some(numbers(value)?),
                "Ov" => status.overrides = Some(numbers(value)?.try_into().ok()?),
                "FS" => {
                    // A third number is the speed measured by a spindle encoder.
                    let [feed, speed, ..] = numbers(value)?[..] else {
                        return None;
                    };
                    status.feed_and_speed = Some((feed, speed));
                }
                "Pn" => status.pins = Some(value.to_owned()),
                // A second number names the homed axes.
                "H" => match value.split(',').next()? {
                    "0" => status.homed = Some(false),
                    "1" => status.homed = Some(true),
                    _ => return None,
                },
                _ => {}
            }
        }
        Some(status)
    }

    /// True in the state of this name, whatever the substate.
    pub fn is(&self, state: &str) -> bool {
        self.state == state
    }

    /// True when the controller stands still with nothing lost: idle, or a completed hold.
    pub(super) fn is_standstill(&self) -> bool {
        self.is("Idle")
            || (matches!(self.state.as_str(), "Hold" | "Door") && self.substate == Some(0))
    }

    /// The state as the controller writes it.
    pub fn state_text(&self) -> String {
        match self.substate {
            Some(n) => format!("{}:{n}", self.state),
            None => self.state.clone(),
        }
    }
}

fn numbers(text: &str) -> Option<Vec<f64>> {
    text.split(',')
        .map(|n| n.parse::<f64>().ok().filter(|v| v.is_finite()))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_fields_are_read_and_unknown_ones_ignored() {
        let s = Status::parse(
            "Hold:1|MPos:1.000,-2.500,0.000,4.000,5.000|Bf:99,1023|FS:900,0|New:x|A:|H:0|TLR:0|Ov:130,100,100",
        )
        .unwrap();
        assert_eq!((s.state.as_str(), s.substate), ("Hold", Some(1)));
        assert_eq!(s.machine_position.unwrap(), [1.0, -2.5, 0.0, 4.0, 5.0]);
        assert_eq!(s.overrides, Some([130.0, 100.0, 100.0]));
        assert_eq!(s.feed_and_speed, Some((900.0, 0.0)));
        assert_eq!((s.work_offset, s.homed), (None, Some(false)));
        let s = Status::parse("Idle|MPos:0,0,0|H:1,31").unwrap();
        assert_eq!(s.homed, Some(true));
        let s = Status::parse("Idle|MPos:0,0,0|FS:900,1000,987").unwrap();
        assert_eq!(s.feed_and_speed, Some((900.0, 1000.0)));
    }

    #[test]
    fn a_damaged_known_field_spoils_the_report() {
        for text in [
            "",
            "Idle|MPos:0.000,0.0x0",
            "Idle|MPos:nan,0,0",
            "Ho1d:x|MPos:0,0,0",
            "Idle|Ov:100",
            "Idle|H:",
            "Idle|H:x",
        ] {
            assert_eq!(Status::parse(text), None, "{text}");
        }
    }
}
