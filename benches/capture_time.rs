//! How long a capture takes on the simulated rigs, against what it cannot be shorter than: shortest travel at the
//! configured accelerations, settling, and exposures, from the first exposure on. Goal: within 10 %. What comes before
//! (connecting, homing, the way to the white standard, warm-up) is beside it.
//!
//! `cargo bench --bench capture_time`

#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

use goniofit::base::{Result, Unwatched};
use goniofit::rig::capture::{Capture, CaptureOptions, Order, plan_capture};
use goniofit::rig::simulated::{connection_to, device_models};
use goniofit::rig::{
    Camera, CapturedFrame, Clock, History, RigDescription, SharedDevice, Shot, Unattended,
    VirtualClock,
};
use goniofit::session::{CameraFacts, Event, Plan, read_journal};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

/// A camera whose exposures take their time and nothing else does.
struct Shutter(Arc<VirtualClock>);

impl Camera for Shutter {
    fn facts(&self) -> CameraFacts {
        CameraFacts {
            name: "shutter".to_owned(),
            width: 10,
            height: 10,
            pixel_mm: 1.0,
            center_px: [5.0, 5.0],
            lens: Default::default(),
        }
    }

    fn expose(&mut self, shot: &Shot) -> Result<CapturedFrame> {
        self.0.sleep(shot.exposure_ms / 1000.0);
        Ok(CapturedFrame {
            bytes: vec![0; 16],
            extension: "raw".to_owned(),
            exposure_ms: shot.exposure_ms,
        })
    }
}

fn main() {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("rig_configs");
    let plan = Plan::read(&root.join("plans/khungurn16.toml")).unwrap();
    println!(
        "{:<20} {:>8} {:>9} {:>10} {:>8} {:>8} {:>8} {:>7} {:>10}",
        "rig",
        "travel s",
        "warm-up s",
        "exposure s",
        "floor s",
        "took s",
        "ratio",
        "frames",
        "home s"
    );
    for name in [
        "five_axis_grblhal",
        "two_board_grbl",
        "zaber_rotary",
        "virtual",
    ] {
        let rig = RigDescription::read(&root.join(format!("{name}.toml"))).unwrap();
        report(name, &rig, &plan);
    }
}

fn report(name: &str, rig: &RigDescription, plan: &Plan) {
    let work = plan_capture(rig, plan, Order::Short).unwrap();
    let shots = work.outlook(&History::default());
    let exposures: f64 = shots.iter().map(|s| s.shot.exposure_ms / 1000.0).sum();
    let tour = work.tour.as_ref().unwrap();
    let devices = device_models(rig).into_iter().map(|simulated| {
        let device: SharedDevice = Arc::new(Mutex::new(simulated.model));
        (simulated.name, device)
    });
    let (clock, connection) = connection_to(devices);
    let folder = std::env::temp_dir().join(format!("goniofit-bench-{}-{name}", std::process::id()));
    let summary = Capture {
        description: rig,
        plan,
        connection,
        camera: &mut Shutter(clock.clone()),
        judge: None,
        operator: &Unattended(&Unwatched),
        options: CaptureOptions::default(),
    }
    .start(&folder)
    .unwrap();
    let (first, last) = span(&folder);
    std::fs::remove_dir_all(&folder).unwrap();
    // From the first exposure on; the way from the switches to the white standard belongs to homing.
    let before = first - shots[0].shot.exposure_ms / 1000.0;
    let took = last - before;
    let floor = tour.lower_bound + exposures;
    println!(
        "{name:<20} {:>8.1} {:>9.1} {exposures:>10.1} {floor:>8.1} {took:>8.1} {:>8.3} {:>7} {before:>10.1}",
        tour.lower_bound,
        rig.lamp.warm_up_s,
        took / floor,
        summary.frames
    );
}

/// Seconds at which the first and the last frame were on disk.
fn span(folder: &Path) -> (f64, f64) {
    let entries = read_journal(&folder.join("journal.jsonl")).unwrap();
    let frames: Vec<f64> = entries
        .iter()
        .filter(|e| matches!(e.event, Event::Frame(_)))
        .map(|e| e.elapsed_s)
        .collect();
    (frames[0], frames[frames.len() - 1])
}
