//! Promise: whatever bytes come from the wire, the Zaber driver ends with an error or a true success: no panic, no hang.
//!
//! Deterministic: `SEED` overrides the seed. Times are those of a virtual clock.
#![allow(clippy::unwrap_used, missing_docs)]

#[path = "common/noise.rs"]
mod noise;

use goniofit::base::{Result, Unwatched};
use goniofit::rig::{
    ByteModel, Clock, ModelTransport, Motion, Target, Transport, VirtualClock, Wiring, Zaber,
    ZaberModel, ZaberOptions,
};
use noise::{Dice, Noisy};
use std::io;
use std::sync::{Arc, Mutex};

/// Seconds any one request may take: homing two axes has the longest limit.
const LIMIT: f64 = 400.0;

const SEED: u64 = 0x5eed_0009;

fn framed(line: &str) -> Vec<u8> {
    let sum = line.bytes().skip(1).fold(0_u8, u8::wrapping_add);
    format!("{line}:{:02X}\r\n", sum.wrapping_neg()).into_bytes()
}

/// Lines of the language, with and without a true checksum, so that nonsense gets past the first checks.
const PIECES: &[&str] = &[
    "@01 0 OK IDLE -- 0",
    "@01 1 OK IDLE WR 0",
    "@01 0 RJ IDLE -- BADDATA",
    "@01 0 OK BUSY -- 1 2",
    "@01 0 OK IDLE FS 5 5",
    "@01 0 OK IDLE -- NA NA",
    "@01 0 OK IDLE -- 99999999999999999999",
    "@01 0 OK IDLE -- -1 1e3",
    "@01 0 OK IDLE ZZ",
    "@01 0 OK",
    "@99 9 OK IDLE -- 0",
    "!01 1 IDLE --",
    "!01 1 IDLE FD",
    "!01 1",
    "#01 0 what",
    "@",
    ":",
    "@01 0 OK IDLE -- 0:00",
    "",
];

/// A device that behaves up to a time, then says anything; each byte takes its time at 115200 baud.
struct Babble {
    sane: ModelTransport,
    until: f64,
    dice: Dice,
    clock: Arc<VirtualClock>,
    /// The head of the last command: its axis and number.
    asked: String,
}

impl Babble {
    fn said(&mut self) -> Vec<u8> {
        match self.dice.below(8) {
            0 => (0..self.dice.below(60))
                .map(|_| self.dice.next() as u8)
                .collect(),
            1 => vec![b'@'; self.dice.below(700)],
            2 => PIECES[self.dice.below(PIECES.len())].as_bytes().to_vec(),
            3 => framed(PIECES[1 + self.dice.below(14)]),
            // The right head, and anything after it.
            _ => {
                let piece = PIECES[self.dice.below(9)];
                let tail = piece.splitn(3, ' ').nth(2).unwrap_or("");
                framed(&format!("@01 {} {tail}", self.asked))
            }
        }
    }
}

impl Transport for Babble {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        if self.clock.now() < self.until {
            return self.sane.write(bytes);
        }
        let text = String::from_utf8_lossy(bytes).into_owned();
        let fields: Vec<&str> = text.split(' ').collect();
        self.asked = fields[1..3].join(" ");
        if self.dice.one_in(500) {
            return Err(io::ErrorKind::BrokenPipe.into());
        }
        Ok(())
    }

    fn read(&mut self, buffer: &mut [u8], timeout: f64) -> io::Result<usize> {
        if self.clock.now() < self.until {
            return self.sane.read(buffer, timeout);
        }
        let said = if self.dice.one_in(3) {
            Vec::new()
        } else {
            self.said()
        };
        if said.is_empty() {
            self.clock.sleep(timeout);
            return Err(io::ErrorKind::TimedOut.into());
        }
        let n = said.len().min(buffer.len());
        buffer[..n].copy_from_slice(&said[..n]);
        self.clock.sleep(n as f64 * 10.0 / 115_200.0);
        Ok(n)
    }
}

fn to(units: f64) -> [Target; 2] {
    ['1', '2'].map(|letter| Target {
        letter,
        units,
        tolerance: 20.0,
        speed: 60_000.0,
    })
}

/// One request; panics when it takes too long.
fn bounded<T>(what: &str, clock: &VirtualClock, request: impl FnOnce() -> T) -> T {
    let start = clock.now();
    let answer = request();
    let took = clock.now() - start;
    assert!(took < LIMIT, "{what} took {took} s");
    answer
}

fn is_told(result: Result<impl Sized>) -> bool {
    match result {
        Ok(_) => true,
        Err(error) => {
            let text = error.report();
            assert!(text.contains("board 'arms'"), "{text}");
            false
        }
    }
}

fn connect(transport: Box<dyn Transport>, clock: &Arc<VirtualClock>) -> Result<Zaber<'static>> {
    let wiring = Wiring {
        name: "arms".into(),
        transport,
        clock: clock.clone(),
        watch: &Unwatched,
    };
    bounded("connect", clock, || Zaber::connect(1, wiring))
}

fn room(options: ZaberOptions) -> (Arc<Mutex<ZaberModel>>, Arc<VirtualClock>, ModelTransport) {
    let clock = Arc::new(VirtualClock::new());
    clock.advance_to(1.0);
    let model = Arc::new(Mutex::new(ZaberModel::new(options)));
    let cable = ModelTransport::new(model.clone(), clock.clone());
    (model, clock, cable)
}

#[test]
fn random_replies_end_in_an_error_or_a_success() {
    let (mut connected, mut homed, mut moved) = (0, 0, 0);
    for case in 0..3000_u64 {
        let (_, clock, sane) = room(ZaberOptions::rotary(2));
        let mut dice = Dice::of(SEED, case);
        let until = if dice.one_in(3) {
            0.0
        } else {
            1.0 + 14.0 * dice.below(1000) as f64 / 1000.0
        };
        let babble = Babble {
            sane,
            until,
            dice,
            clock: clock.clone(),
            asked: "0 01".into(),
        };
        let Ok(mut zaber) = connect(Box::new(babble), &clock) else {
            continue;
        };
        connected += 1;
        let c = clock.as_ref();
        homed += u32::from(is_told(bounded("home", c, || zaber.home())));
        let done = bounded("move", c, || {
            zaber.start_move(&to(100_000.0))?;
            zaber.finish_move(&to(100_000.0), 60.0)
        });
        moved += u32::from(is_told(done));
        is_told(bounded("verify", c, || zaber.verify_at(&to(100_000.0))));
        is_told(bounded("state", c, || zaber.state()));
        bounded("brake", c, || zaber.brake());
        is_told(bounded("safe", c, || zaber.make_safe(case % 2 == 0)));
        bounded("drop", c, || drop(zaber));
    }
    println!("connected {connected}, homed {homed}, moved {moved}");
    // The babble must get past the door, or the rest is not tried.
    assert!(
        connected > 500 && homed > 100 && moved > 20,
        "{connected} {homed} {moved}"
    );
}

/// Connects over a clean cable; then noise. Returns moves that claimed success, all moves, and commands sent again.
fn over_a_noisy_cable(case: u64, to_board: bool) -> (u32, u32, usize) {
    let (model, clock, inner) = room(ZaberOptions::rotary(2));
    let mut dice = Dice::of(SEED, case);
    let noisy = Noisy {
        live: b"\n/:0 ",
        inner,
        clock: clock.clone(),
        from: 2.0 + 8.0 * dice.below(1000) as f64 / 1000.0,
        to_board,
        one_in: [60, 300, 2000][dice.below(3)],
        dice,
    };
    let Ok(mut zaber) = connect(Box::new(noisy), &clock) else {
        return (0, 0, 0);
    };
    let (mut claimed, mut all) = (0, 0);
    let c = clock.as_ref();
    if is_told(bounded("home", c, || zaber.home())) {
        for target in [50_000.0, 3000.0, 90_000.0] {
            all += 1;
            let done = bounded("move", c, || {
                zaber.start_move(&to(target))?;
                zaber.finish_move(&to(target), 60.0)?;
                zaber.verify_at(&to(target))
            });
            let Ok(found) = done else { break };
            claimed += 1;
            let mut model = model.lock().unwrap();
            model.take_output(c.now());
            let truth = model.truth();
            assert!(
                truth.iter().all(|t| (t - target).abs() < 21.0) && !model.is_moving(),
                "case {case}: the driver read {found:?}, the axes stand at {truth:?}, wanted {target}"
            );
        }
    }
    let safe = is_told(bounded("safe", c, || zaber.make_safe(false)));
    let retries = zaber.retries().len();
    bounded("drop", c, || drop(zaber));
    if safe && !to_board {
        // Bytes from the device are damaged, those to it arrive: what was made safe is safe.
        let mut model = model.lock().unwrap();
        model.take_output(c.now() + 10.0);
        assert!(!model.is_moving(), "case {case}");
    }
    (claimed, all, retries)
}

#[test]
fn a_move_that_claims_success_over_a_noisy_cable_has_succeeded() {
    for to_board in [false, true] {
        let (mut claimed, mut all, mut retries) = (0, 0, 0);
        for case in 0..1500 {
            let (c, a, r) = over_a_noisy_cable(case, to_board);
            claimed += c;
            all += a;
            retries += r;
        }
        println!(
            "noise to the board {to_board}: {claimed} of {all} moves claimed success, {retries} commands sent again"
        );
        // Both outcomes must occur, or nothing was tried; and repeating must have helped.
        assert!(claimed > 300 && all - claimed > 100, "{claimed} of {all}");
        assert!(retries > 1000, "{retries}");
    }
}
