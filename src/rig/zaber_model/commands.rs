//! Lines to actions.

use super::{ZaberFaultKind, ZaberModel};

/// Speeds in settings and commands are microsteps per second times this.
const SPEED: f64 = 1.6384;
/// The same for accelerations, microsteps per second squared.
const ACCELERATION: f64 = 1.6384e-4;

/// Why a command is rejected.
type Reason = &'static str;

/// The first field as a small number, and the rest.
fn number(text: &str) -> Option<(u8, &str)> {
    let (field, rest) = text.split_once(' ').unwrap_or((text, ""));
    field.parse().ok().map(|n| (n, rest))
}

/// A line's text without its checksum; none when the checksum is wrong.
fn verified(line: &str) -> Option<&str> {
    let Some((text, sum)) = line.rsplit_once(':') else {
        return Some(line);
    };
    let expected = text.bytes().fold(0_u8, u8::wrapping_add).wrapping_neg();
    let given = (sum.len() == 2).then(|| u8::from_str_radix(sum, 16).ok())?;
    (given == Some(expected)).then_some(text)
}

fn integer(text: &str) -> Result<i64, Reason> {
    text.parse().map_err(|_| "BADDATA")
}

impl ZaberModel {
    /// A line, without its end.
    pub(super) fn hear(&mut self, line: &[u8]) {
        let Some(text) = std::str::from_utf8(line)
            .ok()
            .and_then(|l| l.strip_prefix('/'))
            .and_then(verified)
        else {
            return;
        };
        let (address, text) = number(text).unwrap_or((0, text));
        if address != 0 && address != self.options.address {
            return;
        }
        let (axis, text) = number(text).unwrap_or((0, text));
        let (id, text) = number(text).map_or((None, text), |(id, rest)| (Some(id), rest));
        self.execute(usize::from(axis), id, text.trim());
    }

    fn execute(&mut self, axis: usize, id: Option<u8>, text: &str) {
        let moves = self.moves_seen;
        let answer = if axis > self.axes.len() {
            Err("BADAXIS")
        } else {
            self.act(axis, text)
        };
        let (verdict, data) = match &answer {
            Ok(data) => ("OK", data.as_str()),
            Err(reason) => ("RJ", *reason),
        };
        let known = if axis > self.axes.len() { 0 } else { axis };
        let id = id.map_or(String::new(), |id| format!(" {id:02}"));
        let line = format!(
            "@{:02} {axis}{id} {verdict} {} {} {data}",
            self.options.address,
            self.status_of(known),
            self.flag_of(known)
        );
        self.send(&line);
        let fault = self.options.faults.iter().find(|f| f.on_move == moves + 1);
        if let Some(fault) = fault.filter(|_| self.moves_seen > moves) {
            self.spoil_reply(fault.kind);
        }
    }

    fn spoil_reply(&mut self, kind: ZaberFaultKind) {
        match kind {
            ZaberFaultKind::LoseReply => drop(self.output.pop_back()),
            ZaberFaultKind::GarbleReply => {
                if let Some((_, bytes)) = self.output.back_mut() {
                    bytes[6] ^= 0x10;
                }
            }
            ZaberFaultKind::Mute => {
                self.output.clear();
                self.muted = true;
            }
            _ => {}
        }
    }

    fn act(&mut self, axis: usize, text: &str) -> Result<String, Reason> {
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        match words.as_slice() {
            [] => {}
            ["get", name] => return self.get(axis, name),
            ["set", name, value] => self.set(axis, name, integer(value)?)?,
            ["home"] => {
                let now = self.now;
                self.each(axis, |a| a.home(now));
            }
            ["move", "abs", position, rest @ ..] => self.start_move(axis, position, rest)?,
            ["stop"] => {
                let now = self.now;
                self.each(axis, |a| a.stop(now, a.options.acceleration));
            }
            ["estop"] => {
                let now = self.now;
                self.each(axis, |a| a.stop(now, 5.0 * a.options.acceleration));
            }
            ["warnings"] => return Ok(self.warnings(axis)),
            ["warnings", "clear"] => {
                let raised = self.warnings(axis);
                self.each(axis, |a| a.flags.retain(|f| ["WR", "FD"].contains(f)));
                return Ok(raised);
            }
            ["system", "reset"] => self.restart(),
            _ => return Err("BADCOMMAND"),
        }
        Ok("0".to_owned())
    }

    fn each(&mut self, axis: usize, act: impl Fn(&mut super::Axis)) {
        match axis {
            0 => self.axes.iter_mut().for_each(act),
            n => act(&mut self.axes[n - 1]),
        }
    }

    fn warnings(&self, axis: usize) -> String {
        let first = if axis == 0 { 0 } else { axis - 1 };
        let last = if axis == 0 { self.axes.len() } else { axis };
        let raised: Vec<&str> = super::RANKS
            .into_iter()
            .filter(|f| self.axes[first..last].iter().any(|a| a.flags.contains(f)))
            .collect();
        let all = raised.iter().map(|f| format!(" {f}")).collect::<String>();
        format!("{:02}{all}", raised.len())
    }

    fn minor(&self) -> f64 {
        self.options.firmware.parse().unwrap_or(7.0)
    }

    fn get(&self, axis: usize, name: &str) -> Result<String, Reason> {
        let device = |value: String| {
            if axis == 0 {
                Ok(value)
            } else {
                Err("DEVICEONLY")
            }
        };
        let listed = |value: &dyn Fn(&super::Axis) -> i64| {
            let axes = match axis {
                0 => &self.axes[..],
                n => &self.axes[n - 1..n],
            };
            let values: Vec<String> = axes.iter().map(|a| value(a).to_string()).collect();
            Ok(values.join(" "))
        };
        match name {
            "version" => device(self.options.firmware.clone()),
            "device.id" if self.minor() >= 7.0 => device("30222".to_owned()),
            "deviceid" if self.minor() < 7.0 => device("30222".to_owned()),
            "system.serial" => device("104512".to_owned()),
            "system.axiscount" => device(self.axes.len().to_string()),
            "system.uptime" if self.minor() >= 7.34 => {
                device(format!("{:.0}", 1000.0 * (self.now - self.since)))
            }
            "comm.checksum" => device(u8::from(self.checksum).to_string()),
            "comm.alert" => device(u8::from(self.alert).to_string()),
            "pos" => listed(&|a| a.position(self.now)),
            "limit.min" => listed(&|a| a.options.limit_min),
            "limit.max" => listed(&|a| a.options.limit_max),
            "maxspeed" => listed(&|a| (a.max_speed * SPEED).round() as i64),
            "accel" => listed(&|a| (a.options.acceleration * ACCELERATION).round() as i64),
            "resolution" => listed(&|_| 64),
            _ => Err("BADCOMMAND"),
        }
    }

    fn set(&mut self, axis: usize, name: &str, value: i64) -> Result<(), Reason> {
        match name {
            "comm.checksum" if (0..=1).contains(&value) => self.checksum = value == 1,
            "comm.alert" if (0..=1).contains(&value) => self.alert = value == 1,
            "maxspeed" if value > 0 => self.each(axis, |a| a.max_speed = value as f64 / SPEED),
            "comm.checksum" | "comm.alert" | "maxspeed" => return Err("BADDATA"),
            _ => return Err("BADCOMMAND"),
        }
        Ok(())
    }

    fn start_move(&mut self, axis: usize, position: &str, rest: &[&str]) -> Result<(), Reason> {
        let Some(index) = axis.checked_sub(1) else {
            return Err("BADAXIS");
        };
        let target = integer(position)?;
        let o = &self.axes[index].options;
        if !(o.limit_min..=o.limit_max).contains(&target) {
            return Err("BADDATA");
        }
        let speed = match rest {
            [] => self.axes[index].max_speed,
            [speed] if self.minor() >= 7.25 => integer(speed)? as f64 / SPEED,
            _ => return Err("BADDATA"),
        };
        if speed <= 0.0 {
            return Err("BADDATA");
        }
        if self.axes[index].flags.contains("FD") {
            return Err("DRIVERDISABLED");
        }
        self.moves_seen += 1;
        let faults = &self.options.faults;
        let kind = faults
            .iter()
            .find(|f| f.on_move == self.moves_seen)
            .map(|f| f.kind);
        let now = self.now;
        let a = &mut self.axes[index];
        let at = a.position(now);
        let (target, start) = match kind {
            Some(ZaberFaultKind::FallShort(by)) => (target - by * (target - at).signum(), now),
            Some(ZaberFaultKind::WrongWay) => (at - (target - at), now),
            Some(ZaberFaultKind::LateStart(by)) => (target, now + by),
            _ => (target, now),
        };
        a.stuck = kind == Some(ZaberFaultKind::StuckBusy);
        let half = a.start(target as f64, speed, now, start);
        if let Some(kind) = kind {
            self.fault_at = Some((half, index, kind));
        }
        Ok(())
    }
}
