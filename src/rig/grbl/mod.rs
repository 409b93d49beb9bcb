//! Driver of one controller board with Grbl 1.1 or grblHAL.
//!
//! One line is in flight at a time, ended by LF. `ok` means queued: a move counts as done only after the barrier
//! (`G4P0.01`, then Idle and the position read back within tolerance, twice). An alarm or a banner voids every
//! outstanding `ok` and the position. Every wait has a time limit; whatever is unexpected becomes an error, after which
//! [`Grbl::make_safe`] stops motion and switches the lamp off. Every wait but those of a stop ends within 0.1 s when
//! [`Watch::urgent`] says so; connecting ends on [`Watch::cancelled`] too.
//!
//! Does not: stream lines ahead, recover from a garbled reply by guessing, reconnect, or look after collisions.

mod by_hand;
mod codes;
mod device;
mod fault;
mod link;
mod motion;
mod replies;
mod status;

pub(super) use fault::stopped_at_once;
pub use motion::StopReport;
pub use status::Status;

use super::transport::{Clock, Transport};
use crate::base::{Context, Error, Result, Watch};
use fault::Fault;
use link::{Link, Obey};
use replies::Reply;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Seconds a line may take that neither moves nor waits.
const REPLY_TIMEOUT: f64 = 3.0;

/// A connected controller.
///
/// Dropping it while the lamp is on or an axis moves switches off and stops as well as that can be done blindly.
pub struct Grbl<'a> {
    name: String,
    link: Link<'a>,
    firmware: String,
    options: String,
    settings: BTreeMap<u16, f64>,
    /// The position is known: homed, and neither alarm nor banner since.
    homed: bool,
    /// A motion line was sent and its end was not verified.
    moving: bool,
    /// `$H` was sent and neither acknowledged nor answered with an alarm.
    homing: bool,
    /// The hold of a stop was sent, its reset not yet.
    held: bool,
    /// The lamp was switched on here and not verifiably off since.
    lamp_on: bool,
    /// A fault happened that only a reset clears up.
    faulted: bool,
    /// The device is gone.
    lost: bool,
}

impl<'a> Grbl<'a> {
    /// Connects to the controller behind `transport`: waits out its start-up text, gets it to answer, and reads
    /// version and settings. Moves nothing; a motion or hold that is under way is stopped.
    ///
    /// # Errors
    /// Nothing answers, what answers is not Grbl or grblHAL, or `watch` asks to stop.
    pub fn connect(
        name: &str,
        transport: Box<dyn Transport>,
        clock: Arc<dyn Clock>,
        watch: &'a dyn Watch,
    ) -> Result<Self> {
        let mut board = Self {
            name: name.to_owned(),
            link: Link::new(transport, clock, watch),
            firmware: String::new(),
            options: String::new(),
            settings: BTreeMap::new(),
            homed: false,
            moving: false,
            homing: false,
            held: false,
            lamp_on: false,
            faulted: false,
            lost: false,
        };
        let met = board.meet();
        board
            .checked(met)
            .context(|| format!("cannot connect to board '{name}'"))?;
        board.link.obey = Obey::Urgent;
        Ok(board)
    }

    fn meet(&mut self) -> Result<(), Fault> {
        self.link.read_until_quiet(0.3)?;
        let status = self.first_answer()?;
        match status.state.as_str() {
            "Idle" | "Alarm" => {}
            _ => {
                self.moving = true;
                self.stop_in_order()?;
                self.moving = false;
            }
        }
        let info = self.link.exchange("$I", REPLY_TIMEOUT)?;
        let listed = |key: &str| {
            info.iter().find_map(|r| match r {
                Reply::Message(m) => {
                    let inside = m.strip_prefix('[')?.strip_suffix(']')?;
                    inside.strip_prefix(key).map(str::to_owned)
                }
                _ => None,
            })
        };
        let version = listed("VER:").ok_or_else(|| {
            Fault::unexpected(
                "'$I' gave no version",
                "the firmware must be Grbl 1.1 or grblHAL",
            )
        })?;
        self.options = listed("OPT:").unwrap_or_default();
        let kind = listed("FIRMWARE:").unwrap_or_else(|| "Grbl".to_owned());
        self.firmware = format!("{kind} {version} options {}", self.options);
        for reply in self.link.exchange("$$", REPLY_TIMEOUT)? {
            if let Reply::Setting(number, value) = reply {
                self.settings.insert(number, value);
            }
        }
        Ok(())
    }

    /// Gets the controller to acknowledge an empty line and to report its state.
    fn first_answer(&mut self) -> Result<Status, Fault> {
        let mut deaf = 0;
        for _ in 0..8 {
            let acknowledged = self.link.probe(1.0)?;
            match self.link.status_tolerant(1.0, 1)? {
                Some(status) if acknowledged => return Ok(status),
                // It holds lines back: a hold, an open door, a sleeping controller.
                Some(status) if status.is_standstill() || status.is("Sleep") => {
                    self.link.reset()?;
                }
                // Busy, or a restart ate the line: ask again.
                Some(_) => {}
                None => {
                    deaf += 1;
                    if deaf == 3 {
                        // Silent to everything is what a critical alarm looks like.
                        self.link.reset()?;
                    }
                }
            }
        }
        Err(Fault::unexpected(
            "no Grbl or grblHAL controller answers",
            "is this the right port and baud rate, is the board powered, and is its firmware Grbl 1.1 or grblHAL?",
        ))
    }

    /// Turns a fault into an error and remembers what it means for this board.
    fn checked<T>(&mut self, result: Result<T, Fault>) -> Result<T> {
        if self.link.take_position_lost() {
            self.homed = false;
        }
        result.map_err(|fault| {
            match fault {
                Fault::Disconnected(_) => {
                    self.lost = true;
                    self.homed = false;
                }
                Fault::Refused { .. } => {}
                _ => self.faulted = true,
            }
            fault.told(&self.name)
        })
    }

    /// The board's name in the rig file.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Firmware version and build options, as it says itself.
    pub fn firmware(&self) -> &str {
        &self.firmware
    }

    /// The build options field of `$I`, e.g. `V,15,128`.
    pub fn options(&self) -> &str {
        &self.options
    }

    /// The controller's `$` settings, read when connecting.
    pub fn settings(&self) -> &BTreeMap<u16, f64> {
        &self.settings
    }

    /// True while the position is known.
    pub fn is_homed(&self) -> bool {
        self.homed
    }

    /// Sends one line and waits for its `ok`; returns the lines that came before it.
    ///
    /// # Errors
    /// The line is refused, or an alarm, a restart, a garbled reply, silence or a disconnect happens instead.
    pub fn command(&mut self, line: &str) -> Result<Vec<String>> {
        let result = self.link.exchange(line, REPLY_TIMEOUT);
        let replies = self.checked(result)?;
        Ok(replies
            .into_iter()
            .map(|r| match r {
                Reply::Message(m) => m,
                Reply::Setting(n, v) => format!("${n}={v}"),
                other => format!("{other:?}"),
            })
            .collect())
    }

    /// Asks for the state.
    ///
    /// # Errors
    /// As [`Grbl::command`].
    pub fn status(&mut self) -> Result<Status> {
        let result = self.link.status();
        self.checked(result)
    }

    /// Checks what the lamp needs: laser mode off (`$32=0`, else a standing lamp goes dark) and `power_s` inside the
    /// spindle range `$31..$30`.
    ///
    /// # Errors
    /// With the setting to change.
    pub fn check_lamp_settings(&self, power_s: f64) -> Result<()> {
        let setting = |n: u16| {
            self.settings.get(&n).copied().ok_or_else(|| {
                Error::new(format!("board '{}' does not report ${n}", self.name))
                    .with_hint("the firmware must be Grbl 1.1 or grblHAL")
            })
        };
        if setting(32)? != 0.0 {
            return Err(Error::new(format!(
                "board '{}' is in laser mode ($32={})",
                self.name,
                setting(32)?
            ))
            .with_hint(
                "send $32=0: in laser mode the lamp goes dark whenever the axes stand still",
            ));
        }
        let (low, high) = (setting(31)?, setting(30)?);
        if !(low..=high).contains(&power_s) || power_s <= 0.0 {
            return Err(Error::new(format!(
                "lamp power S{power_s} is outside the range of board '{}', {low} to {high}",
                self.name
            ))
            .with_hint("change lamp.power_s in the rig file, or $30 and $31 on the board"));
        }
        Ok(())
    }

    /// Switches the lamp on with `M3` and this power, and reads the modal state back.
    ///
    /// # Errors
    /// As [`Grbl::command`], or when the state read back differs.
    pub fn lamp_on(&mut self, power_s: f64) -> Result<()> {
        self.lamp_on = true;
        let result = self.switch_lamp(&format!("M3S{power_s}"), Some(power_s));
        self.checked(result)
    }

    /// Switches the lamp off with `M5` and reads the modal state back.
    ///
    /// # Errors
    /// As [`Grbl::lamp_on`].
    pub fn lamp_off(&mut self) -> Result<()> {
        let result = self.switch_lamp("M5", None);
        self.checked(result)?;
        self.lamp_on = false;
        Ok(())
    }

    fn switch_lamp(&mut self, line: &str, power: Option<f64>) -> Result<(), Fault> {
        self.link.exchange(line, REPLY_TIMEOUT)?;
        let replies = self.link.exchange("$G", REPLY_TIMEOUT)?;
        let state = replies.iter().find_map(|r| match r {
            Reply::Message(m) => m.strip_prefix("[GC:")?.strip_suffix(']'),
            _ => None,
        });
        let words: Vec<&str> = state.unwrap_or_default().split(' ').collect();
        let speed = words
            .iter()
            .find_map(|w| w.strip_prefix('S')?.parse::<f64>().ok());
        let as_wanted = match power {
            Some(p) => words.contains(&"M3") && speed.is_some_and(|s| (s - p).abs() <= 0.5),
            None => words.contains(&"M5"),
        };
        if as_wanted {
            return Ok(());
        }
        Err(Fault::unexpected(
            format!(
                "the lamp is not in the state set with {line}: '{}'",
                words.join(" ")
            ),
            "is another program or a button changing the board's state?",
        ))
    }

    /// Stops what moves and switches the lamp off, whatever happened before; says what was done.
    ///
    /// # Errors
    /// When the board cannot be reached; the lamp may then still be on.
    pub fn make_safe(&mut self) -> Result<String> {
        if self.lost {
            return Err(Error::new(format!("board '{}' is disconnected", self.name))
                .with_hint("check by eye that its lamp is off and nothing moves"));
        }
        if self.moving || self.faulted {
            let report = self.controlled_stop()?;
            return Ok(format!("board '{}': {report}", self.name));
        }
        if self.lamp_on {
            let obey = std::mem::replace(&mut self.link.obey, Obey::Nothing);
            let off = self.lamp_off();
            self.link.obey = obey;
            if off.is_ok() {
                return Ok(format!("board '{}': lamp off", self.name));
            }
            let report = self.controlled_stop()?;
            return Ok(format!("board '{}': {report}", self.name));
        }
        Ok(format!("board '{}': at rest, lamp off", self.name))
    }
}

impl Drop for Grbl<'_> {
    fn drop(&mut self) {
        if !self.lost && (self.moving || self.lamp_on) {
            self.link.last_words(self.moving, self.homing);
        }
    }
}
