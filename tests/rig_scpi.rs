//! Promise: a lamp on a current source of its own is on only when it says so at the right current, and whatever goes wrong
//! it is switched off or the operator is told that it may still burn.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

#[path = "common/noise.rs"]
mod noise;

use goniofit::base::{Result, Unwatched, Watch};
use goniofit::rig::{
    Clock, Light, ModelTransport, PtySimulator, Replay, ScpiFault, ScpiLed, ScpiModel,
    SerialTransport, SystemClock, Transport, VirtualClock, Way, WireEntry, Wiring,
};
use noise::Dice;
use std::io;
use std::sync::{Arc, Mutex};

struct Bench {
    clock: Arc<VirtualClock>,
    model: Arc<Mutex<ScpiModel>>,
}

impl Bench {
    fn new(faults: Vec<ScpiFault>) -> Self {
        Self {
            clock: Arc::new(VirtualClock::new()),
            model: Arc::new(Mutex::new(ScpiModel::new(1.0, faults))),
        }
    }

    fn connect(&self) -> Result<ScpiLed<'static>> {
        let cable = ModelTransport::new(self.model.clone(), self.clock.clone());
        connect_over(Box::new(cable), self.clock.clone(), &Unwatched)
    }

    fn is_on(&self) -> bool {
        self.model.lock().unwrap().is_on()
    }
}

fn connect_over<'a>(
    transport: Box<dyn Transport>,
    clock: Arc<dyn Clock>,
    watch: &'a dyn Watch,
) -> Result<ScpiLed<'a>> {
    let wiring = Wiring {
        name: "lamp".into(),
        transport,
        clock,
        watch,
    };
    ScpiLed::connect(1, wiring)
}

fn told(result: Result<impl Sized>) -> String {
    match result {
        Ok(_) => panic!("it succeeded"),
        Err(error) => error.report(),
    }
}

#[test]
fn it_is_off_after_connecting_and_on_at_the_current_asked_for() {
    let bench = Bench::new(vec![]);
    assert!(bench.is_on(), "somebody left it on");
    let mut led = bench.connect().unwrap();
    assert!(!bench.is_on());
    assert!(led.identity().contains("DC2200"));
    led.check(1.0).unwrap();
    led.switch_on(0.35).unwrap();
    assert!(bench.is_on());
    assert!((bench.model.lock().unwrap().current_a() - 0.35).abs() < 1e-9);
    led.switch_off().unwrap();
    assert!(!bench.is_on());
    led.switch_on(0.35).unwrap();
    drop(led);
    assert!(!bench.is_on(), "a dropped driver leaves it off");
}

#[test]
fn a_current_beyond_the_limit_set_at_the_device_is_refused_before_anything_is_set() {
    let bench = Bench::new(vec![]);
    let mut led = bench.connect().unwrap();
    for current in [1.001, 0.0, -0.1, f64::NAN, f64::INFINITY] {
        let error = told(led.check(current));
        assert!(
            error.contains("outside 0 to 1 A") && error.contains("lamp.current_a"),
            "{error}"
        );
        assert!(led.switch_on(current).is_err());
        assert!(!bench.is_on());
    }
}

#[test]
fn every_fault_is_told_and_leaves_it_dark() {
    use ScpiFault as F;
    for (fault, reason) in [
        (F::RefusesCurrent, "error '-222"),
        (
            F::WrongCurrent,
            "the current is 0.2 A after it was set to 0.4 A",
        ),
        (F::StaysOff, "the output is off after it was switched on"),
    ] {
        let bench = Bench::new(vec![fault]);
        let mut led = bench.connect().unwrap();
        let error = told(led.switch_on(0.4));
        assert!(error.contains(reason) && error.contains("hint:"), "{error}");
        assert!(!bench.is_on(), "{fault:?}");
        led.switch_off().unwrap();
    }
}

#[test]
fn a_device_that_falls_silent_or_vanishes_is_told_and_the_off_command_still_goes_out() {
    let bench = Bench::new(vec![ScpiFault::Silent]);
    let mut led = bench.connect().unwrap();
    let error = told(led.switch_on(0.4));
    assert!(error.contains("no answer to SYST:ERR?"), "{error}");
    assert!(bench.is_on());
    // It hears but does not answer: off is not verified, and yet off.
    let start = bench.clock.now();
    assert!(told(led.switch_off()).contains("no answer"));
    assert!(!bench.is_on() && bench.clock.now() - start < 20.0);

    let bench = Bench::new(vec![ScpiFault::Vanish]);
    let mut led = bench.connect().unwrap();
    let error = told(led.switch_on(0.4));
    assert!(
        error.contains("'lamp' is disconnected") && error.contains("check by eye"),
        "{error}"
    );
    assert!(told(led.switch_off()).contains("disconnected"));
}

#[test]
fn switching_off_is_repeated_and_the_operator_is_told_when_it_does_not_help() {
    let bench = Bench::new(vec![ScpiFault::StaysOn(2)]);
    let mut led = bench.connect().unwrap();
    led.switch_on(0.4).unwrap();
    led.switch_off().unwrap();
    assert!(!bench.is_on());
    let bench = Bench::new(vec![ScpiFault::StaysOn(99)]);
    let error = told(bench.connect());
    assert!(
        error.contains("still on after it was switched off") && error.contains("at the device"),
        "{error}"
    );
}

#[test]
fn lost_and_late_replies_are_never_taken_for_another_answer() {
    // Replies: 1 identity, 2 state, then of switching on 3 limit, 4 error, 5 error, 6 current, 7 error, 8 state.
    for n in 1..=8 {
        for fault in [
            ScpiFault::LoseReply(n),
            ScpiFault::LateReply(n, 1.1),
            ScpiFault::LateReply(n, 1.5),
        ] {
            let bench = Bench::new(vec![fault]);
            let mut led = bench.connect().unwrap();
            led.switch_on(0.4).unwrap();
            assert!(bench.is_on(), "{fault:?}");
            led.switch_off().unwrap();
            assert!(!bench.is_on(), "{fault:?}");
        }
    }
    // A damaged reply is an error, or of no consequence; the lamp goes off after it in any case.
    let mut refused = 0;
    for n in 1..=8 {
        let bench = Bench::new(vec![ScpiFault::GarbleReply(n)]);
        let Ok(mut led) = bench.connect() else {
            refused += 1;
            continue;
        };
        refused += u32::from(led.switch_on(0.4).is_err());
        led.switch_off().unwrap();
        assert!(!bench.is_on(), "{n}");
    }
    assert!(refused >= 6, "{refused}");
}

#[test]
fn a_request_to_stop_at_once_ends_switching_on_but_not_switching_off() {
    struct Urgent;
    impl Watch for Urgent {
        fn progress(&self, _: &str, _: u64, _: u64) {}
        fn cancelled(&self) -> bool {
            true
        }
        fn urgent(&self) -> bool {
            true
        }
    }
    let bench = Bench::new(vec![]);
    drop(bench.connect().unwrap());
    let cable = ModelTransport::new(bench.model.clone(), bench.clock.clone());
    assert!(told(connect_over(Box::new(cable), bench.clock.clone(), &Urgent)).contains("stopped"));
    assert!(!bench.is_on());
}

#[test]
fn the_dialogue_is_as_written_down() {
    let lines = [
        ">*IDN?",
        "<Thorlabs,DC2200,M00123456,1.3.0",
        ">*CLS",
        ">OUTP1:STAT OFF",
        ">OUTP1:STAT?",
        "<0",
        ">SOUR1:CURR:LIM?",
        "<1.0000E+00",
        ">SOUR1:MODE CC",
        ">SYST:ERR?",
        "<+0,\"No error\"",
        ">SOUR1:CCUR:CURR 0.350000",
        ">SYST:ERR?",
        "<+0,\"No error\"",
        ">SOUR1:CCUR:CURR?",
        "<3.5000E-01",
        ">OUTP1:STAT ON",
        ">SYST:ERR?",
        "<-221,\"Settings conflict\"",
        ">SYST:ERR?",
        "<+0,\"No error\"",
        ">OUTP1:STAT OFF",
        ">OUTP1:STAT?",
        "<0",
    ];
    let entry = |(i, line): (usize, &&str)| WireEntry {
        t: 0.5 + 0.02 * i as f64,
        board: "lamp".into(),
        way: if line.starts_with('>') {
            Way::ToBoard
        } else {
            Way::FromBoard
        },
        bytes: format!("{}\n", &line[1..]).into_bytes(),
    };
    let replay = Replay::new(lines.iter().enumerate().map(entry).collect());
    let transport = Box::new(replay.transport("lamp"));
    let mut led = connect_over(transport, replay.clock(), &Unwatched).unwrap();
    let error = told(led.switch_on(0.35));
    assert!(
        error.contains("OUTP1:STAT ON was answered with error '-221,\\\"Settings conflict\\\"'"),
        "{error}"
    );
    led.switch_off().unwrap();
    drop(led);
    replay.finish().unwrap();
}

#[test]
fn it_works_over_a_real_port() {
    let simulator = PtySimulator::spawn(ScpiModel::new(1.0, vec![]), 1.0, None).unwrap();
    let port = SerialTransport::open(simulator.path(), 115_200, None).unwrap();
    let clock = Arc::new(SystemClock::new());
    let mut led = connect_over(Box::new(port), clock, &Unwatched).unwrap();
    led.switch_on(0.4).unwrap();
    assert!(simulator.model().lock().unwrap().is_on());
    led.switch_off().unwrap();
    assert!(!simulator.model().lock().unwrap().is_on());
}

#[test]
fn another_channel_is_addressed_by_its_number() {
    let model = ScpiModel::new(1.0, vec![]).on_channel(2);
    let bench = Bench {
        clock: Arc::new(VirtualClock::new()),
        model: Arc::new(Mutex::new(model)),
    };
    assert!(bench.connect().is_err(), "channel 1 is not there");
    let cable = ModelTransport::new(bench.model.clone(), bench.clock.clone());
    let wiring = Wiring {
        name: "lamp".into(),
        transport: Box::new(cable),
        clock: bench.clock.clone(),
        watch: &Unwatched,
    };
    let mut led = ScpiLed::connect(2, wiring).unwrap();
    led.switch_on(0.4).unwrap();
    assert!(bench.is_on());
}

// -- noise --------------------------------------------------------------------------------------------------------------

/// A cable that damages what comes from the device.
struct Noisy(ModelTransport, Dice, usize);

impl Transport for Noisy {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.0.write(bytes)
    }
    fn read(&mut self, buffer: &mut [u8], timeout: f64) -> io::Result<usize> {
        let n = self.0.read(buffer, timeout)?;
        let mut kept = 0;
        for i in 0..n {
            let byte = buffer[i];
            match self.1.below(self.2) {
                0 => continue,
                1 => buffer[kept] = byte ^ (1 << self.1.below(8)),
                _ => buffer[kept] = byte,
            }
            kept += 1;
        }
        if kept == 0 && n > 0 {
            return Err(io::ErrorKind::TimedOut.into());
        }
        Ok(kept)
    }
}

#[test]
fn damaged_replies_never_hang_it_and_off_always_arrives() {
    let (mut lit, mut refused) = (0, 0);
    for case in 0..2000 {
        let bench = Bench::new(vec![]);
        let mut dice = Dice::of(0x5eed_0008, case);
        let one_in = [20, 60, 200][dice.below(3)];
        let cable = ModelTransport::new(bench.model.clone(), bench.clock.clone());
        let noisy = Box::new(Noisy(cable, dice, one_in));
        let Ok(mut led) = connect_over(noisy, bench.clock.clone(), &Unwatched) else {
            assert!(!bench.is_on() || bench.clock.now() < 10.0, "case {case}");
            continue;
        };
        let start = bench.clock.now();
        if led.switch_on(0.4).is_ok() {
            lit += 1;
            assert!(bench.is_on(), "case {case}");
        } else {
            refused += 1;
        }
        let _ = led.switch_off();
        // Its replies are damaged, not what it hears.
        assert!(!bench.is_on(), "case {case}");
        assert!(bench.clock.now() - start < 60.0, "case {case}");
    }
    println!("lit {lit}, refused {refused}");
    assert!(lit > 300 && refused > 300, "{lit} {refused}");
}
