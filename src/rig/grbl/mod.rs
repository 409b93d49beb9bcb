//! Driver of one controller board with Grbl 1.1 or grblHAL.
//!
//! One line is in flight at a time, ended by LF. `ok` means queued: a move counts as done only after the barrier
//! (`G4P0.01`) and three reports in a row of Idle within tolerance. While it runs, every report must lie on the straight
//! line it was sent on: the protocol has no checksum. An alarm or a banner voids every outstanding `ok` and the position.
//! Every wait has a time limit; what noise explains is asked again where that can do no harm (`retry`), whatever else is
//! unexpected becomes an error, after which [`Motion::make_safe`] stops motion and switches the lamp off. Every wait but
//! those of a stop ends within 0.1 s when [`Watch::urgent`] says so; connecting ends on [`Watch::cancelled`] too.
//!
//! Does not: stream lines ahead, reconnect, or look after collisions.
//!
//! [`Motion::make_safe`]: super::devices::Motion::make_safe

mod by_hand;
mod codes;
mod device;
mod exchange;
mod fault;
mod homed;
mod lamp;
mod link;
mod motion;
mod replies;
mod retry;
mod route;
mod status;
mod stopping;

pub(super) use fault::stopped_at_once;
pub use status::Status;
pub use stopping::StopReport;

use super::obey::Obey;
use super::transport::{Clock, Transport};
use crate::base::{Context, Result, Watch};
use fault::Fault;
use link::Link;
use replies::{listed, setting};
use route::Route;
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
    /// What it answered to `$I`, `$$`, `$#` and `$G` when it was connected, line by line.
    said: Vec<String>,
    /// Where the axes were last verified to rest, while the position is known.
    rest: Option<Vec<f64>>,
    /// The way of the move that was started and not finished.
    route: Option<Route>,
    /// Homed with `$H`, not by the operator's word.
    homed_by_switches: bool,
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
            said: Vec::new(),
            rest: None,
            route: None,
            homed_by_switches: false,
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
        self.introduce()
    }

    /// Asks who the controller is and how it is set up.
    fn introduce(&mut self) -> Result<(), Fault> {
        let info = self.ask("$I", |l| listed(l, "VER:").is_some())?;
        let version = listed(&info, "VER:").unwrap_or_default();
        let kind = listed(&info, "FIRMWARE:").unwrap_or("Grbl");
        self.options = listed(&info, "OPT:").unwrap_or_default().to_owned();
        self.firmware = format!("{kind} {version} options {}", self.options);
        self.link.gives_full_reports = kind.contains("HAL");
        self.said.extend(info);
        let settings = self.ask("$$", |l| l.iter().any(|s| s.starts_with("$110=")))?;
        self.settings = settings.iter().filter_map(|l| setting(l)).collect();
        self.said.extend(settings);
        let offsets = self.ask("$#", |l| listed(l, "G54:").is_some())?;
        self.said.extend(offsets);
        let modes = self.ask("$G", |l| listed(l, "GC:").is_some())?;
        let lit = Self::says_lit(&modes) == Some(true);
        self.said.extend(modes);
        if lit { self.put_out() } else { Ok(()) }
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
            self.rest = None;
        }
        result.map_err(|fault| {
            match fault {
                Fault::Disconnected(_) => {
                    self.lost = true;
                    self.homed = false;
                    self.rest = None;
                }
                Fault::Refused { .. } => {}
                _ => self.faulted = true,
            }
            fault.told(&self.name)
        })
    }

    fn is_grblhal(&self) -> bool {
        self.firmware.contains("HAL")
    }

    /// The controller's `$` settings, read when connecting.
    pub fn settings(&self) -> &BTreeMap<u16, f64> {
        &self.settings
    }

    /// Sends one line and waits for its `ok`; returns the lines that came before it.
    ///
    /// # Errors
    /// The line is refused, or an alarm, a restart, a garbled reply, silence or a disconnect happens instead.
    pub fn command(&mut self, line: &str) -> Result<Vec<String>> {
        let result = self.link.exchange(line, REPLY_TIMEOUT);
        self.checked(result)
    }

    /// Asks for the state.
    ///
    /// # Errors
    /// As [`Grbl::command`].
    pub fn status(&mut self) -> Result<Status> {
        let result = self.link.status();
        self.checked(result)
    }
}

impl Drop for Grbl<'_> {
    fn drop(&mut self) {
        if !self.lost && (self.moving || self.lamp_on) {
            self.link.last_words(self.moving, self.homing);
        }
    }
}
