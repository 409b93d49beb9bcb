//! Promise: a watched folder gives exactly one new, whole RAW file per shot, never an old one and never one twice, leaves
//! it where it is, and ends its wait in a bounded time.
#![allow(clippy::unwrap_used, missing_docs)]

#[path = "common/cameras.rs"]
mod cameras;

use cameras::{FastClock, StopAt, rig, shot};
use goniofit::base::{Error, Result, Unwatched, Watch};
use goniofit::rig::{Camera, CameraWiring, CapturedFrame, Clock, FolderCamera};
use std::cell::RefCell;
use std::fs;
use std::path::Path;
use std::sync::{Arc, Mutex};

const WHOLE: &[u8] = b"RAW pixels END";

/// What happens in the folder, and when (seconds after the camera was opened).
type Event<'a> = (f64, Box<dyn Fn(&Path) + Send + 'a>);

/// A clock that lets a tethering program work while time passes.
struct Tethering<'a> {
    clock: FastClock,
    events: Mutex<Vec<Event<'a>>>,
    folder: &'a Path,
}

impl Clock for Tethering<'_> {
    fn now(&self) -> f64 {
        self.clock.now()
    }
    fn sleep(&self, seconds: f64) {
        self.clock.sleep(seconds);
        let mut events = self.events.lock().unwrap();
        while events.first().is_some_and(|e| e.0 <= self.now()) {
            (events.remove(0).1)(self.folder);
        }
    }
}

fn write(name: &'static str, bytes: &'static [u8]) -> Box<dyn Fn(&Path) + Send> {
    Box::new(move |folder| fs::write(folder.join(name), bytes).unwrap())
}

fn is_whole(bytes: &[u8]) -> Result<()> {
    if bytes.starts_with(b"RAW") && bytes.ends_with(b"END") {
        Ok(())
    } else {
        Err(Error::new("it is torn"))
    }
}

/// One shot of 20 ms after another while `events` happen; the results until the first error, and what was said.
fn shots(
    folder: &'static Path,
    n: usize,
    events: Vec<Event<'static>>,
) -> (Vec<Result<CapturedFrame>>, Vec<String>) {
    let said = RefCell::new(Vec::new());
    let say = |text: &str| said.borrow_mut().push(text.to_owned());
    let clock = Tethering {
        clock: FastClock::default(),
        events: Mutex::new(events),
        folder,
    };
    let wiring = CameraWiring {
        clock: Arc::new(clock),
        watch: &Unwatched,
        whole: &is_whole,
        say: &say,
    };
    let mut camera = FolderCamera::open(folder, &rig("[20]"), wiring).unwrap();
    let mut results = Vec::new();
    for _ in 0..n {
        results.push(camera.expose(&shot(20.0)));
        if results.last().is_some_and(Result::is_err) {
            break;
        }
    }
    (results, said.into_inner())
}

/// A folder that lives as long as the test program.
fn folder() -> &'static Path {
    let folder = tempfile::tempdir().unwrap().keep();
    Box::leak(folder.into_boxed_path())
}

fn error_of(results: Vec<Result<CapturedFrame>>) -> String {
    results
        .into_iter()
        .next_back()
        .unwrap()
        .unwrap_err()
        .report()
}

#[test]
fn each_shot_takes_the_one_new_file_and_leaves_it_there() {
    let folder = folder();
    fs::write(folder.join("old.CR2"), WHOLE).unwrap();
    let events: Vec<Event<'_>> = vec![
        (1.0, write("a.CR2.part", b"RAW")),
        (1.5, write(".a.CR2", b"RAW")),
        (2.0, write("a.CR2", b"RAW pix")),
        (2.0, write("a.JPG", b"a picture")),
        (2.5, write("a.CR2", WHOLE)),
        (9.0, write("b.nef", b"RAW second END")),
    ];
    let (results, said) = shots(folder, 2, events);
    let frames: Vec<_> = results
        .into_iter()
        .map(|r| r.map_err(|e| e.report()).unwrap())
        .collect();
    assert_eq!(
        (frames[0].bytes.as_slice(), frames[0].extension.as_str()),
        (WHOLE, "cr2")
    );
    assert_eq!(
        (frames[1].bytes.as_slice(), frames[1].extension.as_str()),
        (&b"RAW second END"[..], "nef")
    );
    assert!((frames[0].exposure_ms - 20.0).abs() < 1e-12);
    assert!(
        said[0].starts_with("take one RAW picture of sample at 20 ms"),
        "{said:?}"
    );
    assert_eq!(fs::read(folder.join("a.CR2")).unwrap(), WHOLE);
    assert_eq!(fs::read_dir(folder).unwrap().count(), 6);
    fs::remove_dir_all(folder).unwrap();
}

#[test]
fn old_files_even_when_touched_are_never_taken() {
    let folder = folder();
    fs::write(folder.join("old.cr2"), WHOLE).unwrap();
    let error = error_of(shots(folder, 1, vec![(5.0, write("old.cr2", b"RAW touched END"))]).0);
    assert!(error.contains("no new RAW file in"), "{error}");
    assert!(
        error.contains("within 300 s\nhint: 1 RAW files were there before"),
        "{error}"
    );
    fs::remove_dir_all(folder).unwrap();
}

#[test]
fn two_new_files_are_refused() {
    let folder = folder();
    let error = error_of(
        shots(
            folder,
            1,
            vec![(1.0, write("a.cr2", WHOLE)), (1.2, write("b.cr2", WHOLE))],
        )
        .0,
    );
    assert!(
        error.contains("2 new RAW files in")
            && error.contains(": a.cr2, b.cr2\nhint: take one picture"),
        "{error}"
    );
    fs::remove_dir_all(folder).unwrap();
}

#[test]
fn a_file_that_pauses_half_way_is_not_taken_before_it_is_whole() {
    let folder = folder();
    let half = vec![
        (1.0, write("a.cr2", b"RAW pix")),
        (20.0, write("a.cr2", WHOLE)),
    ];
    let (results, _) = shots(folder, 1, half);
    assert_eq!(results[0].as_ref().unwrap().bytes, WHOLE);
    fs::remove_dir_all(folder).unwrap();

    for (bytes, told) in [
        (
            &b"RAW pix"[..],
            "7 bytes, did not become a whole RAW file within 300 s: it is torn",
        ),
        (b"", "0 bytes, did not become"),
    ] {
        let folder = self::folder();
        let error = error_of(shots(folder, 1, vec![(1.0, write("a.cr2", bytes))]).0);
        assert!(error.contains(told), "{error}");
        fs::remove_dir_all(folder).unwrap();
    }
}

#[test]
fn a_sidecar_corrects_the_exposure_or_contradicts_it() {
    let with_sidecar = |xmp: &'static [u8]| {
        let folder = folder();
        let events = vec![(1.0, write("a.xmp", xmp)), (1.0, write("a.cr2", WHOLE))];
        let result = shots(folder, 1, events).0.remove(0);
        fs::remove_dir_all(folder).unwrap();
        result
    };
    let frame = with_sidecar(b"<x exif:ExposureTime=\"1/48\"/>").unwrap();
    assert!((frame.exposure_ms - 1000.0 / 48.0).abs() < 1e-9);
    let error = with_sidecar(b"<x exif:ExposureTime=\"1/25\"/>")
        .unwrap_err()
        .report();
    assert!(
        error.contains("a.cr2 was exposed for 40 ms by its sidecar, expected 20 ms"),
        "{error}"
    );
}

#[test]
fn an_urgent_stop_ends_the_wait_and_a_first_request_does_not() {
    struct First;
    impl Watch for First {
        fn progress(&self, _: &str, _: u64, _: u64) {}
        fn cancelled(&self) -> bool {
            true
        }
    }
    let folder = folder();
    let clock = Arc::new(FastClock::default());
    let stop = StopAt::new(clock.clone());
    let watches: [(&dyn Watch, &str); 2] = [
        (&stop, "stopped by the operator"),
        (&First, "no new RAW file"),
    ];
    for (watch, told) in watches {
        stop.in_seconds(3.0);
        let wiring = CameraWiring {
            clock: clock.clone(),
            watch,
            whole: &is_whole,
            say: &|_| {},
        };
        let mut camera = FolderCamera::open(folder, &rig("[20]"), wiring).unwrap();
        let before = clock.now();
        let error = camera.expose(&shot(20.0)).unwrap_err().report();
        assert!(error.starts_with(told), "{error}");
        let took = clock.now() - before;
        assert!(
            took < if told.starts_with("stopped") {
                3.2
            } else {
                301.0
            },
            "{took} s"
        );
    }
    fs::remove_dir_all(folder).unwrap();
}

#[test]
fn what_the_rig_file_must_say_is_asked_for() {
    let mut no_size = rig("[20]");
    no_size.camera.size_px = None;
    let wiring = || CameraWiring {
        clock: Arc::new(FastClock::default()),
        watch: &Unwatched,
        whole: &is_whole,
        say: &|_| {},
    };
    let folder = tempfile::tempdir().unwrap();
    let error = FolderCamera::open(folder.path(), &no_size, wiring())
        .map(drop)
        .unwrap_err()
        .report();
    assert!(
        error.contains("camera.size_px is missing, and a folder camera cannot tell it\nhint: "),
        "{error}"
    );
    let error = FolderCamera::open(&folder.path().join("none"), &rig("[20]"), wiring())
        .map(drop)
        .unwrap_err()
        .report();
    assert!(error.contains("is no folder"), "{error}");
    for text in ["leica", "folder", "folder:", "gphoto2:", "uvc:x", "replay"] {
        let opened = goniofit::rig::open_camera(text, &rig("[20]"), wiring()).map(drop);
        let error = opened.unwrap_err().report();
        assert!(
            error.starts_with(&format!(
                "unknown camera '{text}'\nhint: cameras are gphoto2"
            )),
            "{error}"
        );
    }
}
