//! Promise: a GenICam camera gives a 16-bit DNG file with the exposure that was set and read back; lost packets and a lost
//! connection are tried again a bounded number of times.
//!
//! The camera is Aravis' own fake GigE Vision camera on the loopback interface (`arv-fake-gv-camera-0.8`, Debian package
//! aravis-tools); without it these tests say so and check nothing.
#![cfg(feature = "aravis")]
#![allow(clippy::unwrap_used, missing_docs)]

#[path = "common/cameras.rs"]
mod cameras;

use cameras::{rig, shot};
use goniofit::base::{Result, Unwatched};
use goniofit::rig::{AravisCamera, Camera, CameraWiring, SystemClock};
use std::cell::RefCell;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, MutexGuard};

/// There is one loopback interface, and one camera can have it.
static LOOPBACK: Mutex<()> = Mutex::new(());

struct FakeCamera {
    process: Child,
}

impl FakeCamera {
    /// Starts it; of a thousand packets `lost` are not sent.
    fn start(lost: u32) -> Option<Self> {
        let process = Command::new("arv-fake-gv-camera-0.8")
            .args(["-i", "127.0.0.1", "-s", "GF7", "-r", &lost.to_string()])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn();
        let fake = Self {
            process: process.ok()?,
        };
        // Small frames: a large one overruns the socket's buffer when the machine is busy.
        let sized = (0..30).any(|_| {
            let tool = Command::new("arv-tool-0.8")
                .args(["-n", "Aravis-GF7", "control", "Width=128", "Height=128"])
                .output();
            tool.is_ok_and(|t| String::from_utf8_lossy(&t.stdout).contains("Height = 128"))
        });
        sized.then_some(fake)
    }
}

impl Drop for FakeCamera {
    fn drop(&mut self) {
        self.process.kill().unwrap();
        self.process.wait().unwrap();
    }
}

fn alone() -> MutexGuard<'static, ()> {
    LOOPBACK.lock().unwrap_or_else(|e| e.into_inner())
}

fn with_camera<T>(
    exposures_ms: &str,
    say: &dyn Fn(&str),
    work: impl FnOnce(&mut AravisCamera<'_>) -> Result<T>,
) -> Result<T> {
    let wiring = CameraWiring {
        clock: Arc::new(SystemClock::new()),
        watch: &Unwatched,
        whole: &|_| Ok(()),
        say,
    };
    let mut camera = AravisCamera::open(Some("Aravis-GF7"), &rig(exposures_ms), wiring)?;
    work(&mut camera)
}

macro_rules! fake_camera {
    ($lost:expr) => {
        match FakeCamera::start($lost) {
            Some(fake) => fake,
            None => {
                println!("skipped: arv-fake-gv-camera-0.8 or arv-tool-0.8 is not installed (Debian: aravis-tools, aravis-tools-cli)");
                return;
            }
        }
    };
}

#[test]
fn frames_have_the_exposure_that_was_set_and_all_sixteen_bits() {
    let _alone = alone();
    let _fake = fake_camera!(0);
    let frames = with_camera("[10, 40]", &|_| {}, |c| {
        let facts = c.facts();
        assert_eq!(
            (facts.name.as_str(), facts.width, facts.height),
            ("Aravis Fake", 128, 128)
        );
        assert_eq!(c.serial(), "GF7");
        assert!(
            c.warning().unwrap().contains("monochrome"),
            "it offers Mono16, and Bayer in 8 bits only"
        );
        Ok([c.expose(&shot(10.0))?, c.expose(&shot(40.0))?])
    })
    .map_err(|e| e.report())
    .unwrap();
    let means = frames.map(|frame| {
        let decoded = goniofit::measure::decode(&frame.bytes).unwrap();
        assert_eq!((decoded.width, decoded.height), (128, 128));
        assert_eq!(frame.extension, "dng");
        let sum: f64 = decoded.data.iter().map(|v| f64::from(*v)).sum();
        (frame.exposure_ms, sum / decoded.data.len() as f64)
    });
    assert!(
        (means[0].0 - 10.0).abs() < 1e-9 && (means[1].0 - 40.0).abs() < 1e-9,
        "{means:?}"
    );
    // The fake's pattern is a ramp times the exposure, modulo 16 bits: no frame of another exposure has its mean.
    assert!((means[1].1 / means[0].1 - 1.0).abs() > 0.1, "{means:?}");
}

#[test]
fn lost_packets_and_a_restarted_camera_are_survived() {
    let _alone = alone();
    let fake = RefCell::new(Some(fake_camera!(500)));
    let said = RefCell::new(Vec::new());
    // At the first complaint the camera is unplugged, and a sound one takes its place.
    let say = |text: &str| {
        if said.borrow().is_empty() {
            fake.replace(None);
            fake.replace(FakeCamera::start(0));
        }
        said.borrow_mut().push(text.to_owned());
    };
    let frame = with_camera("[10]", &say, |c| c.expose(&shot(10.0))).map_err(|e| e.report());
    assert!((frame.unwrap().exposure_ms - 10.0).abs() < 1e-9);
    let said = said.borrow();
    assert!(
        said[0].contains("the camera's frame is not whole"),
        "{said:?}"
    );
    // The connection to the first one is dead, which shows as silence or as a refusal.
    assert!(
        said[1..].iter().all(|s| s.contains("does not obey")
            || s.contains("gave no frame within")
            || s.contains("no GenICam camera")),
        "{said:?}"
    );
}

#[test]
fn packets_lost_every_time_end_in_an_error() {
    let _alone = alone();
    let _fake = fake_camera!(500);
    let error = with_camera("[10]", &|_| {}, |c| c.expose(&shot(10.0)))
        .unwrap_err()
        .report();
    assert!(
        error.contains("tried 6 times: attempts 1 to 5: the camera's frame is not whole"),
        "{error}"
    );
    assert!(error.contains("hint: check the network"), "{error}");
}

#[test]
fn what_the_camera_cannot_do_is_refused_before_anything_moves() {
    let _alone = alone();
    let _fake = fake_camera!(0);
    let error = with_camera("[10, 600000]", &|_| {}, |_| Ok(()))
        .unwrap_err()
        .report();
    assert!(
        error.contains("Aravis Fake cannot expose for 600000 ms\nhint: it takes "),
        "{error}"
    );
}
