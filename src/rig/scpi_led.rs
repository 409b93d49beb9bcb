//! A light on a current source of its own that speaks SCPI over a serial port, in the manner of a Thorlabs DC2200.
//!
//! Headers are the short forms `SOUR1:CCUR:CURR`, `SOUR1:CURR:LIM?`, `OUTP1:STAT`. After every command that sets something
//! the error queue is asked, and what was set is read back. SCPI numbers nothing: after a reply that did not come, what
//! arrives is dropped until the device has said its name again, so that no late reply is taken for another's.
//!
//! Does not: measure the light, set limits (they belong to the LED and are set at the device), or use modulated modes.

use super::devices::{Light, Wiring};
use super::grbl::stopped_at_once;
use super::transport::{Clock, Transport};
use super::wire_log::show_bytes;
use crate::base::{Context, Error, Result, Watch};
use std::io;
use std::sync::Arc;

/// Seconds a reply may take.
const REPLY_TIMEOUT: f64 = 1.0;
/// Seconds after which a wait looks at its [`Watch`] again.
const LOOK: f64 = 0.05;
/// Times a question is asked.
const ASKED: u32 = 2;
/// Times the output is switched off before giving up.
const OFF_TRIES: u32 = 3;
/// Errors a queue may hold.
const LONGEST_QUEUE: u32 = 32;
/// Bytes a line may have.
const LONGEST_LINE: usize = 512;
/// Lines that are dropped while waiting for the device's name.
const STALE_LINES: u32 = 32;

/// A connected current source.
///
/// Dropping it while it may be on sends the command to switch off, as well as that can be done blindly.
pub struct ScpiLed<'a> {
    name: String,
    channel: u8,
    transport: Box<dyn Transport>,
    clock: Arc<dyn Clock>,
    watch: &'a dyn Watch,
    /// The operator may end its waits: not while it is switched off.
    obedient: bool,
    input: Vec<u8>,
    /// Its answer to `*IDN?`.
    identity: String,
    /// A reply is missing and may still come.
    stale: bool,
    may_be_on: bool,
    lost: bool,
}

impl<'a> ScpiLed<'a> {
    /// Connects to a current source and switches this channel off.
    ///
    /// # Errors
    /// Nothing answers, the output cannot be switched off, or [`Watch`] asks to stop.
    pub fn connect(channel: u8, wiring: Wiring<'a>) -> Result<Self> {
        let mut led = Self {
            name: wiring.name,
            channel,
            transport: wiring.transport,
            clock: wiring.clock,
            watch: wiring.watch,
            obedient: true,
            input: Vec::new(),
            identity: String::new(),
            stale: false,
            may_be_on: true,
            lost: false,
        };
        led.meet()
            .context(|| format!("cannot connect to '{}'", led.name))?;
        Ok(led)
    }

    fn meet(&mut self) -> Result<()> {
        self.read_until_quiet()?;
        self.identity = self.query("*IDN?")?;
        if self.identity.split(',').count() < 2 {
            let found = show_bytes(self.identity.as_bytes());
            return Err(self.error(
                format!("{found} is no answer to *IDN?"),
                "is this the current source's port and baud rate?",
            ));
        }
        self.write("*CLS")?;
        self.switch_off()
    }

    fn error(&self, what: impl std::fmt::Display, hint: &str) -> Error {
        Error::new(format!("'{}': {what}", self.name)).with_hint(hint)
    }

    // -- lines ------------------------------------------------------------------------------------------------------

    fn gone(&mut self, e: io::Error) -> Error {
        self.lost = true;
        if e.kind() == io::ErrorKind::InvalidData {
            let error = Error::new(format!("'{}': the replay failed", self.name));
            return match e.into_inner() {
                Some(inner) => error.with_source(inner),
                None => error,
            };
        }
        Error::new(format!("'{}' is disconnected", self.name))
            .with_source(e)
            .with_hint("its light may still be on: check by eye, then the cable and the power")
    }

    fn write(&mut self, line: &str) -> Result<()> {
        let bytes = format!("{line}\n").into_bytes();
        self.transport.write(&bytes).map_err(|e| self.gone(e))
    }

    /// The next line without its end; none when `seconds` pass first.
    fn read(&mut self, seconds: f64) -> Result<Option<String>> {
        let deadline = self.clock.now() + seconds;
        loop {
            if self.obedient && self.watch.urgent() {
                return Err(stopped_at_once());
            }
            if let Some(end) = self.input.iter().position(|b| *b == b'\n') {
                let line: Vec<u8> = self.input.drain(..=end).collect();
                return Ok(Some(String::from_utf8_lossy(&line).trim().to_owned()));
            }
            if self.input.len() > LONGEST_LINE {
                let line = std::mem::take(&mut self.input);
                return Ok(Some(String::from_utf8_lossy(&line).into_owned()));
            }
            let rest = deadline - self.clock.now();
            if rest < 0.0 {
                return Ok(None);
            }
            let mut buffer = [0; 256];
            match self.transport.read(&mut buffer, rest.min(LOOK)) {
                Ok(0) => return Err(self.gone(io::ErrorKind::BrokenPipe.into())),
                Ok(n) => self.input.extend_from_slice(&buffer[..n]),
                Err(e) if e.kind() == io::ErrorKind::TimedOut => {
                    if self.clock.now() >= deadline {
                        return Ok(None);
                    }
                }
                Err(e) => return Err(self.gone(e)),
            }
        }
    }

    /// Drops what comes until nothing comes for 0.2 s.
    fn read_until_quiet(&mut self) -> Result<()> {
        for _ in 0..STALE_LINES {
            if self.read(0.2)?.is_none() {
                self.input.clear();
                return Ok(());
            }
        }
        Err(self.error(
            "the device talks without end",
            "is this the right port and baud rate?",
        ))
    }

    /// After a missing reply: drops what comes until the device has said its name; false when it does not.
    fn resync(&mut self) -> Result<bool> {
        if !self.stale {
            return Ok(true);
        }
        self.read_until_quiet()?;
        if !self.identity.is_empty() {
            self.write("*IDN?")?;
            let mut dropped = 0;
            loop {
                match self.read(REPLY_TIMEOUT)? {
                    Some(line) if line == self.identity => break,
                    Some(_) if dropped < STALE_LINES => dropped += 1,
                    _ => return Ok(false),
                }
            }
        }
        self.stale = false;
        Ok(true)
    }

    fn silent(&self, question: &str) -> Error {
        self.error(
            format!("no answer to {question} within {REPLY_TIMEOUT} s"),
            "check its power, the cable and the baud rate; is it in remote mode?",
        )
    }

    fn query(&mut self, question: &str) -> Result<String> {
        for _ in 0..ASKED {
            if !self.resync()? {
                break;
            }
            self.write(question)?;
            if let Some(line) = self.read(REPLY_TIMEOUT)? {
                return Ok(line);
            }
            self.stale = true;
        }
        Err(self.silent(question))
    }

    fn number(&mut self, question: &str) -> Result<f64> {
        let answer = self.query(question)?;
        let number = answer.parse().ok().filter(|n: &f64| n.is_finite());
        number.ok_or_else(|| {
            // Whose answer it was is not known.
            self.stale = true;
            let found = show_bytes(answer.as_bytes());
            self.error(
                format!("{question} gave {found}, expected a number"),
                "check the cable and its grounding; is another program using the port?",
            )
        })
    }

    // -- commands ---------------------------------------------------------------------------------------------------

    /// Sends a command that sets something, and asks whether it went wrong.
    fn set(&mut self, command: &str) -> Result<()> {
        if !self.resync()? {
            return Err(self.silent(command));
        }
        self.write(command)?;
        let mut first: Option<String> = None;
        for _ in 0..LONGEST_QUEUE {
            let entry = self.query("SYST:ERR?")?;
            let number = entry.split(',').next().and_then(|n| n.trim().parse().ok());
            match (number, &first) {
                (Some(0), None) => return Ok(()),
                (Some(0_i32), Some(_)) => break,
                (Some(_), None) => first = Some(entry),
                (Some(_), Some(_)) => {}
                (None, _) => {
                    self.stale = true;
                    first.get_or_insert(entry);
                    break;
                }
            }
        }
        let told = show_bytes(first.unwrap_or_default().as_bytes());
        Err(self.error(
            format!("{command} was answered with error {told}"),
            "look the number up in the device's manual; at the device, check its mode, limit, LED and interlock",
        ))
    }

    fn is_on(&mut self) -> Result<bool> {
        let question = format!("OUTP{}:STAT?", self.channel);
        let state = self.query(&question)?;
        match state.as_str() {
            "1" | "ON" => Ok(true),
            "0" | "OFF" => Ok(false),
            _ => {
                self.stale = true;
                let found = show_bytes(state.as_bytes());
                Err(self.error(
                    format!("{question} gave {found}, expected 0 or 1"),
                    "check the cable and its grounding; is another program using the port?",
                ))
            }
        }
    }

    fn off_command(&self) -> String {
        format!("OUTP{}:STAT OFF", self.channel)
    }

    fn try_off(&mut self) -> Result<()> {
        // The command goes out even when the device still owes an answer.
        self.write(&self.off_command())?;
        if self.is_on()? {
            return Err(self.error(
                "the output is still on after it was switched off",
                "switch it off at the device",
            ));
        }
        Ok(())
    }
}

impl Light for ScpiLed<'_> {
    fn check(&mut self, power: f64) -> Result<()> {
        let limit = self.number(&format!("SOUR{}:CURR:LIM?", self.channel))?;
        if power > 0.0 && power <= limit {
            return Ok(());
        }
        Err(self.error(
            format!("a current of {power} A is outside 0 to {limit} A, the limit set at the device"),
            "change lamp.current_a in the rig file, or the LED's limit at the device if the LED bears more",
        ))
    }

    fn switch_on(&mut self, power: f64) -> Result<()> {
        self.check(power)?;
        let n = self.channel;
        self.set(&format!("SOUR{n}:MODE CC"))?;
        self.set(&format!("SOUR{n}:CCUR:CURR {power:.6}"))?;
        let found = self.number(&format!("SOUR{n}:CCUR:CURR?"))?;
        // Devices round to their own steps.
        let off = (found - power).abs();
        if off > 1e-3 + 5e-3 * power {
            return Err(self.error(
                format!("the current is {found} A after it was set to {power} A"),
                "is another program or a knob changing it?",
            ));
        }
        // From here on it may be on, whatever it answers.
        self.may_be_on = true;
        self.set(&format!("OUTP{n}:STAT ON"))?;
        if self.is_on()? {
            return Ok(());
        }
        Err(self.error(
            "the output is off after it was switched on",
            "check the LED's plug, the interlock and the temperature shown at the device",
        ))
    }

    fn switch_off(&mut self) -> Result<()> {
        // What the operator asked for must not keep the light on.
        let obedient = std::mem::replace(&mut self.obedient, false);
        let mut result = self.try_off();
        for _ in 1..OFF_TRIES {
            if result.is_ok() || self.lost {
                break;
            }
            result = self.try_off();
        }
        self.obedient = obedient;
        if result.is_ok() {
            self.may_be_on = false;
        }
        result
    }

    fn identity(&self) -> String {
        self.identity.clone()
    }
}

impl Drop for ScpiLed<'_> {
    fn drop(&mut self) {
        if self.may_be_on && !self.lost {
            // Errors have nobody to go to.
            let off = self.off_command();
            let _ = self.write(&off);
        }
    }
}
