//! Promise: whatever bytes come from the wire, the driver ends with an error or a true success: no panic, no hang.
//!
//! Deterministic: `SEED` overrides the seed. Times are those of a virtual clock.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

#[path = "common/noise.rs"]
mod noise;

use goniofit::base::{Result, Unwatched};
use goniofit::rig::{
    Clock, Flavor, Grbl, GrblModel, Light, ModelOptions, ModelTransport, Motion, SharedModel,
    Target, Transport, VirtualClock,
};
use noise::{Dice, Noisy};
use std::io;
use std::sync::{Arc, Mutex};

/// Seconds any one request may take: homing has the longest limit, 180 s.
const LIMIT: f64 = 200.0;

const SEED: u64 = 0x5eed_0007;

/// Pieces of the language, so that nonsense gets past the first check.
const PIECES: &[&str] = &[
    "ok\r\n",
    "ok",
    "error:9\r\n",
    "error:",
    "error:999\r\n",
    "error:-1\n",
    "ALARM:1\r\n",
    "ALARM:\r\n",
    "ALARM:300\n",
    "Grbl 1.1h ['$' for help]\r\n",
    "GrblHAL",
    "\r\n",
    "\n",
    "<",
    ">",
    "<Idle|MPos:0.000,0.000,0.000|FS:0,0>\r\n",
    "<Idle>\r\n",
    "<Idle|MPos:>\r\n",
    "<Idle|MPos:1e999>\r\n",
    "<Idle|WPos:1,2,3>\r\n",
    "<Idle|WPos:1,2|WCO:1,2,3>\r\n",
    "<Hold:0|MPos:0,0,0>\r\n",
    "<Hold:300>\r\n",
    "<Run|MPos:0,0,0|Ov:>\r\n",
    "<|>\r\n",
    "<:|:>\r\n",
    "<Idle|FS:1,2,3,4>\r\n",
    "<Idle|Ov:1,2,3,4>\r\n",
    "[",
    "]",
    "[]\r\n",
    "[VER:1.1h:]\r\n",
    "[VER:",
    "[OPT:V,15,128]\r\n",
    "[GC:G0 M3 S1000]\r\n",
    "[GC:]\r\n",
    "[MSG:]\r\n",
    "$",
    "$=\r\n",
    "$30=1000\r\n",
    "$30=\r\n",
    "$99999999=1\r\n",
    "$13=nan\r\n",
    "$22=inf\r\n",
    ">\n",
    "\u{e9}\n",
    "\0\0\n",
];

/// A board that behaves up to a time, then says anything; each byte takes its time at 115200 baud.
struct Babble {
    sane: ModelTransport,
    until: f64,
    dice: Dice,
    clock: Arc<VirtualClock>,
    /// Whether it speaks only when spoken to.
    polite: bool,
    due: usize,
}

impl Transport for Babble {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        if self.clock.now() < self.until {
            return self.sane.write(bytes);
        }
        self.due += bytes.len().min(3);
        if self.dice.one_in(500) {
            return Err(io::ErrorKind::BrokenPipe.into());
        }
        Ok(())
    }

    fn read(&mut self, buffer: &mut [u8], timeout: f64) -> io::Result<usize> {
        if self.clock.now() < self.until {
            return self.sane.read(buffer, timeout);
        }
        if (self.polite && self.due == 0) || self.dice.one_in(3) {
            self.clock.sleep(timeout);
            return Err(io::ErrorKind::TimedOut.into());
        }
        self.due = self.due.saturating_sub(1);
        let mut said = Vec::new();
        for _ in 0..=self.dice.below(4) {
            match self.dice.below(8) {
                0 => said.extend((0..self.dice.below(40)).map(|_| self.dice.next() as u8)),
                1 => said.extend(std::iter::repeat_n(b'x', self.dice.below(400))),
                _ => said.extend(PIECES[self.dice.below(PIECES.len())].as_bytes()),
            }
        }
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

fn x(units: f64) -> [Target; 1] {
    [Target {
        letter: 'X',
        units,
        tolerance: 0.02,
        speed: 10.0,
    }]
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
            assert!(
                text.contains("board 'main'") || text.contains("connect"),
                "{text}"
            );
            false
        }
    }
}

#[test]
fn random_replies_end_in_an_error_or_a_success() {
    let (mut connected, mut homed, mut moved) = (0, 0, 0);
    for case in 0..4000_u64 {
        let clock = Arc::new(VirtualClock::new());
        let mut dice = Dice::of(SEED, case);
        let model = GrblModel::new(ModelOptions::rig(Flavor::Grbl));
        let babble = Babble {
            sane: ModelTransport::new(Arc::new(Mutex::new(model)), clock.clone()),
            until: if dice.one_in(3) {
                0.0
            } else {
                10.0 * dice.below(1000) as f64 / 1000.0
            },
            dice,
            clock: clock.clone(),
            polite: case % 2 == 0,
            due: 0,
        };
        let met = bounded("connect", &clock, || {
            Grbl::connect("main", Box::new(babble), clock.clone(), &Unwatched)
        });
        let Ok(mut grbl) = met else { continue };
        connected += 1;
        let c = clock.as_ref();
        if is_told(bounded("home", c, || grbl.home())) {
            homed += 1;
        }
        let _ = Light::check(&mut grbl, 1000.0);
        is_told(bounded("lamp", c, || grbl.switch_on(1000.0)));
        let done = bounded("move", c, || {
            grbl.start_move(&x(-5.0))?;
            grbl.finish_move(&x(-5.0), 60.0)
        });
        moved += u32::from(is_told(done));
        is_told(bounded("command", c, || grbl.command("$#")));
        is_told(bounded("safe", c, || grbl.make_safe(false)));
        is_told(bounded("stop", c, || grbl.controlled_stop()));
        bounded("drop", c, || drop(grbl));
    }
    println!("connected {connected}, homed {homed}, moved {moved}");
    // The babble must get past the door, or the rest is not tried.
    assert!(
        connected > 1000 && homed > 200 && moved > 20,
        "{connected} {homed} {moved}"
    );
}

/// Connects over a clean cable; then noise. Returns moves that claimed success, and all moves.
fn over_a_noisy_cable(case: u64, to_board: bool) -> (u32, u32) {
    let flavor = [Flavor::Grbl, Flavor::GrblHal][(case % 2) as usize];
    let clock = Arc::new(VirtualClock::new());
    let model: SharedModel = Arc::new(Mutex::new(GrblModel::new(ModelOptions::rig(flavor))));
    let mut dice = Dice::of(SEED, case);
    let noisy = Noisy {
        // Commands of their own.
        live: &[0x18, 0x84, 0x85, 0x91, 0x9a, b'!'],
        inner: ModelTransport::new(model.clone(), clock.clone()),
        clock: clock.clone(),
        from: 3.0 + 12.0 * dice.below(1000) as f64 / 1000.0,
        to_board,
        one_in: [30, 100, 300][dice.below(3)],
        dice,
    };
    let met = bounded("connect", &clock, || {
        Grbl::connect("main", Box::new(noisy), clock.clone(), &Unwatched)
    });
    let Ok(mut grbl) = met else { return (0, 0) };
    let (mut claimed, mut all) = (0, 0);
    let c = clock.as_ref();
    if is_told(bounded("home", c, || grbl.home())) {
        for target in [-20.0, -3.0, -31.5] {
            all += 1;
            let done = bounded("move", c, || {
                grbl.start_move(&x(target))?;
                grbl.finish_move(&x(target), 60.0)?;
                grbl.verify_at(&x(target))
            });
            let Ok(found) = done else { break };
            claimed += 1;
            let mut model = model.lock().unwrap();
            model.take_output(c.now());
            let truth = model.position()[0];
            assert!(
                (truth - target).abs() < 0.021 && !model.is_moving(),
                "case {case}: the driver read {found:?}, the axis stands at {truth}, wanted {target}"
            );
        }
    }
    let safe = is_told(bounded("safe", c, || grbl.make_safe(false)));
    bounded("drop", c, || drop(grbl));
    if safe && !to_board {
        // Bytes from the board are damaged, those to it arrive: what was made safe is safe.
        let mut model = model.lock().unwrap();
        model.take_output(c.now() + 10.0);
        assert!(!model.is_moving() && !model.spindle_on(), "case {case}");
    }
    (claimed, all)
}

#[test]
fn a_move_that_claims_success_over_a_noisy_cable_has_succeeded() {
    for to_board in [false, true] {
        let (mut claimed, mut all) = (0, 0);
        for case in 0..1500 {
            let (c, a) = over_a_noisy_cable(case, to_board);
            claimed += c;
            all += a;
        }
        println!("noise to the board {to_board}: {claimed} of {all} moves claimed success");
        // Both outcomes must occur, or nothing was tried.
        assert!(claimed > 300 && all - claimed > 300, "{claimed} of {all}");
    }
}
