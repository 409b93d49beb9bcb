//! Driver of one Zaber controller, ASCII protocol version 2, firmware 6.06 or newer.
//!
//! Every command and every reply carries a checksum and a message ID: a late or damaged reply is never taken for the answer
//! to something else. One command is in flight. A command without an intact reply is sent again, at most twice and with the
//! reason kept, when sending it twice does what sending it once does; all moves are absolute. Homing is not repeated.
//! Positions are microsteps. Axes are homed one after another and move each its own way. Every wait has a time limit and,
//! but for those of a stop, ends within 0.1 s when [`Watch::urgent`] says so; connecting ends on [`Watch::cancelled`] too.
//!
//! Does not: share a port between several devices of a chain, use streams, lockstep groups, parking or cyclic positions,
//! reconnect, or look after collisions. A controller obeys commands without a checksum: damage that cuts one off in the
//! right place may move an axis elsewhere, which the watch over its way and the position read back then find.

mod device;
mod fault;
mod flags;
mod frame;
mod link;
mod motion;

use super::devices::{AxisLimits, Travel, Wiring};
use super::obey::Obey;
use crate::base::{Context, Error, Result};
use fault::Fault;
use flags::Effect;
use frame::Reply;
use link::Link;

/// Times a harmless command is sent before giving up.
const TRIES: u32 = 3;
/// Settings count microsteps per second times this.
const SPEED_SCALE: f64 = 1.6384;
/// Settings count microsteps per second squared times this.
const ACCELERATION_SCALE: f64 = 1.6384e-4;

/// What the controller says of one axis; none for an axis without a stage.
#[derive(Debug, Clone, Copy, PartialEq)]
struct AxisFacts {
    limits: AxisLimits,
    /// `maxspeed` as it is set now.
    max_speed_setting: i64,
}

/// A connected controller.
///
/// Dropping it while an axis may move sends a stop, as well as that can be done blindly.
pub struct Zaber<'a> {
    name: String,
    link: Link<'a>,
    /// What it says of itself, line by line.
    dump: Vec<String>,
    firmware: String,
    /// `move abs` takes a speed.
    moves_with_speed: bool,
    axes: Vec<Option<AxisFacts>>,
    /// The last `system.uptime`, when the firmware has it.
    uptime: Option<f64>,
    /// The position is known: homed here, and nothing happened since that loses it.
    homed: bool,
    /// A motion was started and its end was not verified.
    moving: bool,
    homing: bool,
    /// A fault happened, or a stop was sent, that [`super::Motion::make_safe`] must follow up.
    faulted: bool,
    /// The device is gone.
    lost: bool,
    /// Between which positions each axis may be, while a move is under way.
    ways: Vec<[f64; 2]>,
}

impl<'a> Zaber<'a> {
    /// Connects to the controller with this number in its chain: switches checksums on, reads version, limits and speeds,
    /// and acknowledges old warnings. Moves nothing; a motion that is under way is stopped.
    ///
    /// # Errors
    /// Nothing answers, what answers is no Zaber device, or [`crate::base::Watch`] asks to stop.
    pub fn connect(address: u8, wiring: Wiring<'a>) -> Result<Self> {
        let name = wiring.name;
        let mut board = Self {
            link: Link::new(wiring.transport, wiring.clock, wiring.watch, address),
            name,
            dump: Vec::new(),
            firmware: String::new(),
            moves_with_speed: false,
            axes: Vec::new(),
            uptime: None,
            homed: false,
            moving: false,
            homing: false,
            faulted: false,
            lost: false,
            ways: Vec::new(),
        };
        let met = board.meet(address);
        let met = board.checked(met);
        met.context(|| format!("cannot connect to board '{}'", board.name))?;
        board.link.obey = Obey::Urgent;
        Ok(board)
    }

    fn meet(&mut self, address: u8) -> Result<(), Fault> {
        self.link.read_until_quiet(0.1)?;
        let greeted = self.link.ask(0, "get version", 6).map_err(|fault| match fault {
            Fault::Unanswered { reason, .. } => Fault::unexpected(
                format!("no Zaber device answers as number {address} ({reason})"),
                "is this the right port, baud rate (115200) and address, is it powered, and does it speak the ASCII protocol?",
            ),
            other => other,
        })?;
        self.link.accepted(0, "set comm.checksum 1", TRIES)?;
        self.link.plain = false;
        if self.get("comm.checksum")? != "1" {
            return Err(Fault::unexpected(
                "it does not switch checksums on",
                "send 'set comm.checksum 1' with the maker's program",
            ));
        }
        if self.link.ask(0, "get pos", TRIES)?.busy {
            self.moving = true;
            self.stop_and_wait("stop")?;
        }
        self.read_identity(&greeted.data)?;
        self.read_axes()?;
        let raised = self.link.accepted(0, "warnings clear", TRIES)?.data;
        self.dump.push(format!("warnings {raised}"));
        self.uptime = self.read_uptime()?;
        Ok(())
    }

    fn read_identity(&mut self, version: &str) -> Result<(), Fault> {
        let numbers: Option<Vec<u32>> = version.split('.').map(|n| n.parse().ok()).collect();
        let Some([major, minor]) = numbers.as_deref().and_then(|n| n.get(..2)) else {
            return Err(Fault::unexpected(
                format!("'{version}' is no firmware version"),
                "the device must be a Zaber controller with firmware 6.06 or newer",
            ));
        };
        self.moves_with_speed = (*major, *minor) >= (7, 25);
        let id = if *major >= 7 { "device.id" } else { "deviceid" };
        let device = self.get(id)?;
        let serial = self.get("system.serial")?;
        self.firmware = format!("Zaber device {device} serial {serial} firmware {version}");
        self.dump.push(self.firmware.clone());
        let count = self.get("system.axiscount")?;
        let axes = count.parse().ok().filter(|n| (1..=9).contains(n));
        let axes = axes.ok_or_else(|| {
            Fault::unexpected(
                format!("it has {count} axes, expected 1 to 9"),
                "name the controller itself in the rig file, not an accessory",
            )
        })?;
        self.axes = vec![None; axes];
        Ok(())
    }

    fn read_axes(&mut self) -> Result<(), Fault> {
        let names = ["limit.min", "limit.max", "maxspeed", "accel", "resolution"];
        let mut values = Vec::new();
        for name in names {
            let text = self.get(name)?;
            self.dump.push(format!("{name} {text}"));
            values.push(self.listed(name, &text)?);
        }
        for (axis, facts) in self.axes.iter_mut().enumerate() {
            let [Some(low), Some(high), Some(speed), Some(acceleration)] =
                [0, 1, 2, 3].map(|i: usize| values[i][axis])
            else {
                continue;
            };
            if !(low < high && speed > 0 && acceleration > 0) {
                return Err(Fault::unexpected(
                    format!(
                        "axis {} has limits {low} to {high}, maxspeed {speed}, accel {acceleration}",
                        axis + 1
                    ),
                    "set limit.min below limit.max, and maxspeed and accel above 0",
                ));
            }
            *facts = Some(AxisFacts {
                limits: AxisLimits {
                    travel: Some(Travel::Between([low as f64, high as f64])),
                    max_speed: speed as f64 / SPEED_SCALE,
                    acceleration: acceleration as f64 / ACCELERATION_SCALE,
                },
                max_speed_setting: speed,
            });
        }
        Ok(())
    }

    /// The value of a setting, as text.
    fn get(&mut self, name: &str) -> Result<String, Fault> {
        let reply = self.link.accepted(0, &format!("get {name}"), TRIES)?;
        Ok(reply.data)
    }

    /// One whole number per axis; none for `NA`.
    fn listed(&self, name: &str, text: &str) -> Result<Vec<Option<i64>>, Fault> {
        let fields = text.split(' ').map(|field| match field {
            "NA" => Some(None),
            number => number.parse().ok().map(Some),
        });
        let numbers: Option<Vec<Option<i64>>> = fields.collect();
        numbers
            .filter(|n| n.len() == self.axes.len())
            .ok_or_else(|| {
                Fault::unexpected(
                    format!(
                        "'get {name}' gave '{text}', expected {} whole numbers",
                        self.axes.len()
                    ),
                    "is the board's protocol in the rig file right?",
                )
            })
    }

    /// `system.uptime`, in the controller's own unit; none before firmware 7.34.
    fn read_uptime(&mut self) -> Result<Option<f64>, Fault> {
        let reply = self.link.ask(0, "get system.uptime", TRIES)?;
        let uptime = reply.data.parse().ok().filter(|t: &f64| t.is_finite());
        Ok(uptime.filter(|_| reply.accepted))
    }

    /// Fails when the controller was switched on anew since the last look.
    fn check_uptime(&mut self, during: &str) -> Result<(), Fault> {
        let Some(before) = self.uptime else {
            return Ok(());
        };
        let now = self.read_uptime()?;
        if now.is_none_or(|now| now < before) {
            return Err(Fault::Restarted {
                during: during.to_owned(),
            });
        }
        self.uptime = now;
        Ok(())
    }

    /// Sorts out a reply's warning flag. `moving`: a move is under way and may not be interrupted.
    fn judged(&self, reply: Reply, during: &str, moving: bool) -> Result<Reply, Fault> {
        let Some(flag) = &reply.flag else {
            return Ok(reply);
        };
        let (effect, during, flag) = (flags::meaning(flag).0, during.to_owned(), flag.clone());
        match effect {
            Effect::NotHomed if self.homed => Err(Fault::Restarted { during }),
            Effect::Trouble | Effect::PositionLost => Err(Fault::Flagged { during, flag }),
            Effect::Interrupted if moving => Err(Fault::Flagged { during, flag }),
            _ => Ok(reply),
        }
    }

    /// Turns a fault into an error and remembers what it means for this board.
    fn checked<T>(&mut self, result: Result<T, Fault>) -> Result<T> {
        result.map_err(|fault| {
            match &fault {
                Fault::Disconnected(_) => {
                    self.lost = true;
                    self.homed = false;
                }
                Fault::Restarted { .. } => self.homed = false,
                Fault::Flagged { flag, .. } if flags::meaning(flag).0 != Effect::Interrupted => {
                    self.homed &= flags::meaning(flag).0 == Effect::Trouble;
                }
                _ => {}
            }
            self.faulted |= !matches!(fault, Fault::Disconnected(_));
            fault.told(&self.name)
        })
    }

    /// Index and facts of the axis with this number.
    fn axis(&self, letter: char) -> Result<(usize, AxisFacts), Fault> {
        let index = letter.to_digit(10).and_then(|n| n.checked_sub(1));
        let index = index.map_or(usize::MAX, |i| i as usize);
        let facts = self.axes.get(index).copied().flatten();
        facts.map(|f| (index, f)).ok_or_else(|| {
            Fault::unexpected(
                format!("it has no axis {letter} with a stage"),
                "correct the axis numbers (letter) in the rig file, and look at the stage's plug",
            )
        })
    }

    /// What was sent again, and why.
    pub fn retries(&self) -> &[String] {
        &self.link.retries
    }

    /// An error that concerns this board.
    fn error(&self, what: impl Into<String>, hint: &str) -> Error {
        Fault::unexpected(what, hint).told(&self.name)
    }
}

impl Drop for Zaber<'_> {
    fn drop(&mut self) {
        if !self.lost && self.moving {
            // Errors have nobody to go to.
            let _ = self.link.send(0, "stop");
        }
    }
}
