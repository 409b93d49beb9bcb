//! Promise: the driver works with a controller the project did not write.
//!
//! Ignored unless a port is named; moves the axes X and Y some 20 units about where they stand. Keep the power switch at
//! hand with real hardware:
//!
//! ```sh
//! BOARD=/dev/ttyUSB0 WIRE=wire.jsonl cargo test --release --test rig_peer -- --ignored --nocapture
//! ```
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

use goniofit::base::Unwatched;
use goniofit::rig::{
    Clock, Grbl, Light, Motion, RecordingTransport, SerialTransport, SystemClock, Target, WireLog,
};
use std::path::Path;
use std::sync::Arc;

fn to(grbl: &mut Grbl, x: f64, y: f64) -> goniofit::base::Result<Vec<f64>> {
    let target = |letter, units| Target {
        letter,
        units,
        tolerance: 0.02,
        speed: 8.0,
    };
    let targets = [target('X', x), target('Y', y)];
    grbl.start_move(&targets)?;
    grbl.finish_move(&targets, 60.0)
}

#[test]
#[ignore = "needs a controller: BOARD=/dev/..."]
fn a_controller_on_a_port_does_as_the_model_does() {
    let path = std::env::var("BOARD").expect("BOARD names the port");
    let clock: Arc<dyn Clock> = Arc::new(SystemClock::new());
    let log = WireLog::new();
    if let Ok(file) = std::env::var("WIRE") {
        log.write_to(Path::new(&file)).unwrap();
    }
    let port = SerialTransport::open(&path, 115_200, None).unwrap();
    let wire = RecordingTransport::new(Box::new(port), "main", clock.clone(), log);
    let mut grbl = Grbl::connect("main", Box::new(wire), clock.clone(), &Unwatched).unwrap();
    println!("{}", grbl.firmware());
    println!("{} lines of dump", grbl.dump().len());
    println!("limits of X: {:?}", grbl.axis_limits('X').unwrap());

    grbl.trust_position().unwrap();
    let start = grbl.positions(&['X', 'Y']).unwrap();
    println!("stands at {start:?}");
    for (dx, dy) in [(10.0, 0.0), (10.0, 7.5), (-3.0, 2.5), (0.0, 0.0)] {
        let begun = clock.now();
        let found = to(&mut grbl, start[0] + dx, start[1] + dy).unwrap();
        println!("moved to {found:?} in {:.2} s", clock.now() - begun);
    }

    Light::check(&mut grbl, 500.0).unwrap();
    grbl.switch_on(500.0).unwrap();
    grbl.switch_off().unwrap();
    println!("lamp on and off");

    let target = [Target {
        letter: 'X',
        units: start[0] + 20.0,
        tolerance: 0.02,
        speed: 8.0,
    }];
    grbl.start_move(&target).unwrap();
    clock.sleep(0.7);
    let report = grbl.controlled_stop().unwrap();
    println!("{report}, state {:?}", report.state);
    assert!(report.position_kept && grbl.is_homed());
    to(&mut grbl, start[0], start[1]).unwrap();

    grbl.start_move(&target).unwrap();
    clock.sleep(0.7);
    println!("{}", grbl.make_safe(true).unwrap());
    assert!(!grbl.is_homed() && grbl.start_move(&target).is_err());
    grbl.trust_position().unwrap();
    to(&mut grbl, start[0], start[1]).unwrap();
    println!("{}", grbl.make_safe(false).unwrap());
    println!("notes: {:?}", grbl.take_notes());
}
