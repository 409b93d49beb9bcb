//! What the tests of cameras share: a rig, shots, a clock that runs fast, an operator who stops.

#![allow(dead_code)]

use goniofit::base::Watch;
use goniofit::math::PolarDirection;
use goniofit::rig::{Clock, RigDescription, Shot, VirtualClock};
use goniofit::session::{Configuration, FrameKind};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Real seconds per second of [`FastClock`].
const REAL: f64 = 0.04;

/// A clock for tests with real processes and files: time passes by waiting alone, 25 times as fast as it does, so that
/// a busy machine makes no wait run out.
#[derive(Default)]
pub(crate) struct FastClock(VirtualClock);

impl Clock for FastClock {
    fn now(&self) -> f64 {
        self.0.now()
    }
    fn sleep(&self, seconds: f64) {
        std::thread::sleep(Duration::from_secs_f64(REAL * seconds));
        self.0.sleep(seconds);
    }
}

/// An operator who asks to stop now at a time on the clock.
pub(crate) struct StopAt {
    clock: Arc<dyn Clock>,
    set_and_due: Mutex<[f64; 2]>,
}

impl StopAt {
    pub(crate) fn new(clock: Arc<dyn Clock>) -> Self {
        let set_and_due = Mutex::new([f64::INFINITY; 2]);
        Self { clock, set_and_due }
    }

    pub(crate) fn in_seconds(&self, seconds: f64) {
        let now = self.clock.now();
        *self.set_and_due.lock().unwrap() = [now, now + seconds];
    }

    pub(crate) fn set_at(&self) -> f64 {
        self.set_and_due.lock().unwrap()[0]
    }
}

impl Watch for StopAt {
    fn progress(&self, _stage: &str, _done: u64, _total: u64) {}
    fn cancelled(&self) -> bool {
        self.urgent()
    }
    fn urgent(&self) -> bool {
        self.clock.now() >= self.set_and_due.lock().unwrap()[1]
    }
}

/// The example rig with these exposures, and a camera that cannot tell its image's size.
pub(crate) fn rig(exposures_ms: &str) -> RigDescription {
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/rig_configs/five_axis_grblhal.toml"
    );
    let text: String = std::fs::read_to_string(path)
        .unwrap()
        .lines()
        .map(|line| match line.split('=').next().map(str::trim) {
            Some("exposures_ms") => format!("exposures_ms = {exposures_ms}\n"),
            Some("pixel_mm") => format!("{line}\nsize_px = [6000, 4000]\n"),
            Some("size_px" | "center_px" | "min_exposure_ms" | "max_exposure_ms") => String::new(),
            _ => format!("{line}\n"),
        })
        .collect();
    RigDescription::from_toml(&text).unwrap()
}

/// A shot of the sample.
pub(crate) fn shot(exposure_ms: f64) -> Shot {
    Shot {
        kind: FrameKind::Sample,
        config: Some(1),
        pose: Configuration {
            id: 1,
            light: PolarDirection::from_degrees(30.0, 180.0),
            camera: PolarDirection::from_degrees(0.0, 0.0),
            rotation: 0.0,
        },
        exposure_ms,
        repeat: 0,
        visit: 0,
    }
}
