//! Promise: a camera driven by the `gphoto2` program gives the RAW file and the exposure that were asked for, or says why
//! not; a busy or lost one is tried again a bounded number of times, and nothing hangs.
//!
//! The program is a stand-in that plays strict transcripts. `nikon.txt` and its like were recorded with the real gphoto2
//! 2.5.28 and the virtual camera of libgphoto2 2.5.34; the other failures are as users reported them.
#![allow(clippy::unwrap_used, missing_docs)]

#[path = "common/cameras.rs"]
mod cameras;

use cameras::{FastClock, StopAt, rig, shot};
use goniofit::base::{Error, Result, Unwatched, Watch};
use goniofit::rig::{Camera, CameraWiring, Clock, Gphoto2Camera};
use std::cell::RefCell;
use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::sync::Arc;

const DATA: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/gphoto2");
const PORT: &str = "usb:001,006";
const CLAIMED: &str = "!
! *** Error ***
! An error occurred in the io-library ('Could not claim the USB device'): Could not claim interface 0 (Device or resource busy). Make sure no other program (gvfs-gphoto2-volume-monitor) or kernel module (such as sdc2xx, stv680, spca50x) is using the device and you have read/write access to the device.
! *** Error (-53: 'Could not claim the USB device') ***
exit 1
";
const BUSY: &str = "!
! *** Error ***
! Canon EOS Full-Press failed (0x2019: PTP Device Busy)
! ERROR: Could not capture image.
! ERROR: Could not capture.
! *** Error (-110: 'I/O in progress') ***
exit 1
";
const GONE: &str = "!
! *** Error ***
! Could not detect any camera
! *** Error (-105: 'Unknown model') ***
exit 1
";
const SAVED: &str = "< New file is in location /capt0000.cr2 on the camera
< Saving file as shot.cr2
< Deleting file /capt0000.cr2 on the camera
";

fn data(name: &str) -> String {
    fs::read_to_string(Path::new(DATA).join(name)).unwrap()
}

/// The program's answer to `--auto-detect`.
fn found(cameras: &[(&str, &str)]) -> String {
    let mut text =
        "> --auto-detect\n< Model                          Port            \n".to_owned();
    text += "< ----------------------------------------------------------\n";
    for (model, port) in cameras {
        text += &format!("< {model:<30} {port:<16}\n");
    }
    text
}

/// What the camera is asked after it was found.
fn identified(port: &str, settings: &str) -> String {
    let list = data("canon_list.txt");
    let names = [
        "eosserialnumber",
        "serialnumber",
        "capturetarget",
        "shutterspeed",
        "imageformat",
        "autoexposuremode",
        "iso",
    ];
    let questions: Vec<String> = names.iter().map(|n| format!("--get-config {n}")).collect();
    format!(
        "> --port {port} --list-config\n{list}> --port {port} {}\n{settings}",
        questions.join(" ")
    )
}

fn opened(port: &str) -> String {
    found(&[("Canon EOS 80D", port)]) + &identified(port, &data("canon_settings.txt"))
}

fn asked(port: &str, speed: &str) -> String {
    format!(
        "> --port {port} --force-overwrite --filename shot.%C --set-config-value shutterspeed={speed} \
         --capture-image-and-download --get-config shutterspeed\n"
    )
}

fn read_back(speed: &str) -> String {
    format!(
        "< Label: Shutter Speed\n< Readonly: 0\n< Type: RADIO\n< Current: {speed}\n< Choice: 0 {speed}\n< END\n"
    )
}

fn taken(port: &str, speed: &str) -> String {
    asked(port, speed) + SAVED + "+ shot.cr2 whole\n" + &read_back(speed)
}

/// A stand-in program with its transcript, and all that is said to the operator.
struct Program {
    folder: tempfile::TempDir,
    clock: Arc<FastClock>,
    said: RefCell<Vec<String>>,
}

impl Program {
    fn new(transcript: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let program = Self {
            folder,
            clock: Arc::new(FastClock::default()),
            said: RefCell::default(),
        };
        // A link, not a copy: what this process has just written cannot be run while another thread is starting a program.
        symlink(Path::new(DATA).join("gphoto2"), program.path("gphoto2")).unwrap();
        fs::write(program.path("transcript"), transcript).unwrap();
        fs::write(program.path("whole"), "RAW pixels END").unwrap();
        fs::write(program.path("torn"), "RAW pix").unwrap();
        fs::write(program.path("empty"), "").unwrap();
        program
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Uses the camera for what the transcript holds; the transcript must be used up.
    fn play<T>(
        &self,
        port: Option<&str>,
        watch: &dyn Watch,
        exposures_ms: &str,
        work: impl FnOnce(&mut Gphoto2Camera<'_>) -> Result<T>,
    ) -> Result<T> {
        let say = |text: &str| self.said.borrow_mut().push(text.to_owned());
        let whole = |bytes: &[u8]| {
            let whole = bytes.starts_with(b"RAW") && bytes.ends_with(b"END");
            if whole {
                Ok(())
            } else {
                Err(Error::new("torn"))
            }
        };
        let wiring = CameraWiring {
            clock: self.clock.clone(),
            watch,
            whole: &whole,
            say: &say,
        };
        let camera = Gphoto2Camera::open(self.path("gphoto2"), port, &rig(exposures_ms), wiring);
        let result = camera.and_then(|mut camera| work(&mut camera));
        assert!(
            !self.path("mismatch").exists(),
            "{}",
            fs::read_to_string(self.path("mismatch")).unwrap()
        );
        let exchanges = fs::read_to_string(self.path("transcript")).unwrap();
        let planned = exchanges.lines().filter(|l| l.starts_with("> ")).count();
        let turns: usize = fs::read_to_string(self.path("turn"))
            .unwrap()
            .trim()
            .parse()
            .unwrap();
        assert_eq!(
            turns,
            planned,
            "the transcript is not used up: {:?}",
            result.as_ref().err().map(Error::report)
        );
        assert_eq!(fs::read_to_string(self.path("locale")).unwrap(), "C C\n");
        result
    }
}

fn play<T>(transcript: &str, work: impl FnOnce(&mut Gphoto2Camera<'_>) -> Result<T>) -> Result<T> {
    Program::new(transcript).play(None, &Unwatched, "[16.667]", work)
}

/// The error of opening, or of one shot at 1/60 s, with its hints.
fn error_of(transcript: &str) -> String {
    play(transcript, |c| c.expose(&shot(16.667)))
        .unwrap_err()
        .report()
}

#[test]
fn a_recorded_dialogue_with_the_real_program_gives_the_frame_and_the_exposure() {
    let program = Program::new(&data("nikon.txt"));
    let (frame, serial) = program
        .play(Some("usb:001,001"), &Unwatched, "[20, 52]", |c| {
            Ok((c.expose(&shot(52.0))?, c.serial()))
        })
        .unwrap();
    assert_eq!(frame.bytes, b"RAW pixels END");
    assert_eq!(frame.extension, "dng");
    assert!(
        (frame.exposure_ms - 50.0).abs() < 1e-9,
        "{}",
        frame.exposure_ms
    );
    assert_eq!(serial, "0.1");
}

#[test]
fn the_real_program_ends_well_even_when_it_could_not_download_and_that_is_noticed() {
    // Exit status 0, `Could not get image` on standard error, no file.
    let recorded = data("nikon.txt");
    let shot_at = recorded
        .find("> --port usb:001,001 --force-overwrite")
        .unwrap();
    let dialogue = recorded[..shot_at].to_owned() + &data("nikon_no_download.txt").repeat(6);
    let error = Program::new(&dialogue)
        .play(None, &Unwatched, "[50]", |c| c.expose(&shot(50.0)))
        .unwrap_err()
        .report();
    assert!(error.contains("tried 6 times"), "{error}");
    assert!(
        error.contains(
            "the camera (capturetarget 'Internal RAM') gave no file: ERROR: Could not get image."
        ),
        "{error}"
    );
}

#[test]
fn each_shot_sets_the_nearest_speed_and_keeps_the_raw_of_a_pair() {
    let pair = asked(PORT, "0.5")
        + SAVED
        + "+ shot.cr2 whole\n< Saving file as shot.jpg\n+ shot.jpg torn\n"
        + &read_back("0.5");
    let dialogue = opened(PORT) + &taken(PORT, "1/60") + &pair;
    let frames = Program::new(&dialogue)
        .play(None, &Unwatched, "[16.667, 500]", |c| {
            assert_eq!(c.facts().width, 6000);
            assert_eq!(c.serial(), "052031001234");
            Ok([c.expose(&shot(16.0))?, c.expose(&shot(510.0))?])
        })
        .unwrap();
    assert!((frames[0].exposure_ms - 1000.0 / 60.0).abs() < 1e-9);
    assert!((frames[1].exposure_ms - 500.0).abs() < 1e-9);
    assert_eq!(frames[1].bytes, b"RAW pixels END");
    assert_eq!(frames[1].extension, "cr2");
}

#[test]
fn a_camera_that_is_busy_on_the_second_shot_is_tried_again() {
    let dialogue = opened(PORT)
        + &taken(PORT, "1/60")
        + &asked(PORT, "1/60")
        + BUSY
        + &asked(PORT, "1/60")
        + BUSY
        + &taken(PORT, "1/60");
    let program = Program::new(&dialogue);
    let shots = |c: &mut Gphoto2Camera<'_>| {
        c.expose(&shot(16.667))?;
        c.expose(&shot(16.667))
    };
    program.play(None, &Unwatched, "[16.667]", shots).unwrap();
    let said = program.said.borrow();
    assert_eq!(said.len(), 2, "{said:?}");
    assert!(said[0].contains("0x2019: PTP Device Busy"), "{}", said[0]);
    assert!(said[1].ends_with("trying again in 1 s"), "{}", said[1]);
}

#[test]
fn a_camera_that_stays_busy_is_given_up_with_every_reason() {
    let mut dialogue = opened(PORT);
    for _ in 0..6 {
        dialogue += &(asked(PORT, "1/60") + BUSY);
    }
    let program = Program::new(&dialogue);
    let before = program.clock.now();
    let error = program
        .play(None, &Unwatched, "[16.667]", |c| c.expose(&shot(16.667)))
        .unwrap_err()
        .report();
    assert!(
        program.clock.now() - before >= 15.5,
        "the waits grow: 0.5 + 1 + 2 + 4 + 8 s"
    );
    assert!(
        error.starts_with("the camera took no picture, tried 6 times: attempts 1 to 5: the camera"),
        "{error}"
    );
    assert_eq!(error.matches("PTP Device Busy").count(), 2, "{error}");
    assert!(
        error.contains("\nhint: the camera is busy: switch off long exposure noise"),
        "{error}"
    );
}

#[test]
fn a_camera_that_another_program_holds_is_waited_for_and_the_hint_names_it() {
    let claimed = |n: usize| {
        let mut dialogue = found(&[("Canon EOS 80D", PORT)]);
        for _ in 0..n {
            dialogue += &format!("> --port {PORT} --list-config\n{CLAIMED}");
            dialogue += &found(&[("Canon EOS 80D", PORT)]);
        }
        dialogue
    };
    play(
        &(claimed(2) + &identified(PORT, &data("canon_settings.txt"))),
        |_| Ok(()),
    )
    .unwrap();
    let six = claimed(5) + &format!("> --port {PORT} --list-config\n{CLAIMED}");
    let error = error_of(&six);
    assert!(error.contains("tried 6 times"), "{error}");
    assert!(
        error.contains("pkill gvfs-gphoto2-volume-monitor"),
        "{error}"
    );
}

#[test]
fn a_camera_that_comes_back_at_another_port_is_found_again() {
    let dialogue = opened(PORT)
        + &taken(PORT, "1/60")
        + &asked(PORT, "1/60")
        + GONE
        + &found(&[])
        + &opened("usb:001,009")
        + &taken("usb:001,009", "1/60");
    let shots = |c: &mut Gphoto2Camera<'_>| {
        c.expose(&shot(16.667))?;
        c.expose(&shot(16.667))
    };
    // Also when it was first named by its port.
    for port in [None, Some(PORT)] {
        Program::new(&dialogue)
            .play(port, &Unwatched, "[16.667]", shots)
            .unwrap();
    }
}

#[test]
fn another_camera_is_never_taken_for_the_one_that_is_gone() {
    let other = data("canon_settings.txt").replace("052031001234", "052031009999");
    assert_ne!(other, data("canon_settings.txt"));
    let dialogue = opened(PORT)
        + &asked(PORT, "1/60")
        + GONE
        + &found(&[("Canon EOS 80D", PORT)])
        + &identified(PORT, &other);
    let error = error_of(&dialogue);
    assert!(
        error.contains("another camera answers: Canon EOS 80D with serial number '052031009999'"),
        "{error}"
    );
}

#[test]
fn a_program_that_hangs_is_ended_with_its_children_and_the_shot_taken_again() {
    let dialogue =
        opened(PORT) + &asked(PORT, "1/60") + "hang\n" + &opened(PORT) + &taken(PORT, "1/60");
    let program = Program::new(&dialogue);
    program
        .play(None, &Unwatched, "[16.667]", |c| c.expose(&shot(16.667)))
        .unwrap();
    let said = program.said.borrow();
    assert!(
        said[0].contains("did not end within 60 s and was stopped"),
        "{said:?}"
    );
    let pid = fs::read_to_string(program.path("hanging")).unwrap();
    assert!(
        !Path::new("/proc").join(pid.trim()).exists(),
        "process {pid} is still there"
    );
}

#[test]
fn an_urgent_stop_ends_a_shot_at_once() {
    let dialogue = opened(PORT) + &asked(PORT, "1/60") + "hang\n";
    let program = Program::new(&dialogue);
    let stop = StopAt::new(program.clock.clone());
    let error = program
        .play(None, &stop, "[16.667]", |c| {
            stop.in_seconds(20.0);
            c.expose(&shot(16.667))
        })
        .unwrap_err();
    assert_eq!(error.report(), "stopped by the operator");
    // 20 s until the request, 2 s of grace.
    let took = program.clock.now() - stop.set_at();
    assert!(
        (20.0..23.0).contains(&took),
        "{took} s; without the stop it would take 62 s"
    );
}

#[test]
fn garbage_is_an_error_that_shows_it() {
    let noise = "< \u{fffd}\u{1}PK garbage\n< Current\n< :::\n";
    let mut dialogue = found(&[("Canon EOS 80D", PORT)]);
    dialogue += &identified(PORT, noise);
    for _ in 0..5 {
        dialogue += &found(&[("Canon EOS 80D", PORT)]);
        dialogue += &identified(PORT, noise);
    }
    let error = error_of(&dialogue);
    assert!(
        error.contains("did not name the settings asked for but said"),
        "{error}"
    );
    assert!(error.contains("PK garbage"), "{error}");
}

#[test]
fn a_camera_set_to_jpeg_is_refused_before_anything_moves() {
    let jpeg = data("canon_settings.txt").replace("Current: RAW", "Current: Large Fine JPEG");
    let error = error_of(&(found(&[("Canon EOS 80D", PORT)]) + &identified(PORT, &jpeg)));
    assert!(
        error.contains("the camera's imageformat is 'Large Fine JPEG', expected RAW"),
        "{error}"
    );
    assert!(error.contains("\nhint: set the camera to RAW"), "{error}");
}

#[test]
fn a_jpeg_alone_is_refused() {
    let dialogue = opened(PORT)
        + &asked(PORT, "1/60")
        + "< Saving file as shot.JPG\n+ shot.JPG whole\n"
        + &read_back("1/60");
    let error = error_of(&dialogue);
    assert!(
        error.contains("the camera gave no RAW file but JPG\nhint: set the camera to RAW"),
        "{error}"
    );
}

#[test]
fn empty_and_torn_files_are_taken_again_and_never_handed_out() {
    let bad =
        |file: &str| asked(PORT, "1/60") + SAVED + "+ shot.cr2 " + file + "\n" + &read_back("1/60");
    let dialogue = opened(PORT) + &bad("empty") + &bad("torn") + &taken(PORT, "1/60");
    let frame = play(&dialogue, |c| c.expose(&shot(16.667))).unwrap();
    assert_eq!(frame.bytes, b"RAW pixels END");

    let error = error_of(&(opened(PORT) + &bad("torn").repeat(6)));
    assert!(
        error.contains("the camera's file of 7 bytes is not whole: torn"),
        "{error}"
    );
}

#[test]
fn a_file_of_the_last_attempt_is_not_taken_for_this_one() {
    // The first attempt leaves a file but reports a failure at reading back; the second leaves none.
    let dialogue = opened(PORT)
        + &asked(PORT, "1/60")
        + SAVED
        + "+ shot.cr2 whole\n"
        + &read_back("1/50")
        + &(asked(PORT, "1/60") + BUSY).repeat(5);
    let error = error_of(&dialogue);
    assert!(
        error.contains("attempt 1: the shutter speed was set to '1/60' and reads back '1/50'"),
        "{error}"
    );
    assert!(
        error.contains("attempt 6: the camera (capturetarget 'Internal RAM') gave no file"),
        "{error}"
    );
}

#[test]
fn a_speed_the_camera_does_not_have_is_refused_with_those_it_has() {
    let program = Program::new(&opened(PORT));
    let error = program
        .play(None, &Unwatched, "[16.667, 1500]", |_| Ok(()))
        .unwrap_err()
        .report();
    assert_eq!(
        error,
        "camera.exposures_ms: Canon EOS 80D has no shutter speed within 15 % of 1500 ms\n\
         hint: it offers 30 8 2 1 0.5 0.3 1/4 1/60 1/125 1/8000"
    );
}

#[test]
fn exposure_mode_and_sensitivity_must_not_be_left_to_the_camera() {
    for (from, to, told) in [
        (
            "Current: Manual",
            "Current: AV",
            "autoexposuremode is 'AV', expected manual\nhint: set the camera to mode M",
        ),
        (
            "Current: 100",
            "Current: Auto",
            "iso is 'Auto', expected a number",
        ),
        (
            "Choice: ",
            "Unused: ",
            "the shutter speed of Canon EOS 80D cannot be set, it is '1/60'\nhint: set the camera to mode M",
        ),
    ] {
        let settings = data("canon_settings.txt").replace(from, to);
        assert_ne!(settings, data("canon_settings.txt"), "{from}");
        let error = error_of(&(found(&[("Canon EOS 80D", PORT)]) + &identified(PORT, &settings)));
        assert!(error.contains(told), "{error}");
    }
}

#[test]
fn of_several_cameras_one_must_be_named() {
    let two = found(&[("Canon EOS 80D", PORT), ("Nikon DSC D750", "usb:001,007")]);
    let error = error_of(&two);
    assert!(
        error.contains(
            "several cameras: Canon EOS 80D at usb:001,006, Nikon DSC D750 at usb:001,007"
        ),
        "{error}"
    );
    let dialogue = two.clone() + &identified(PORT, &data("canon_settings.txt"));
    Program::new(&dialogue)
        .play(Some(PORT), &Unwatched, "[16.667]", |_| Ok(()))
        .unwrap();
    let error = Program::new(&two)
        .play(Some("usb:009,001"), &Unwatched, "[16.667]", |_| Ok(()))
        .unwrap_err()
        .report();
    assert!(
        error.starts_with("no camera at port usb:009,001; there is Canon EOS 80D at"),
        "{error}"
    );
}

#[test]
fn no_camera_no_focus_and_no_program_say_what_to_do() {
    let error = error_of(&found(&[]).repeat(6));
    assert!(
        error.contains("gphoto2 finds no camera") && error.contains("hint: switch it on"),
        "{error}"
    );
    let focus = "!\n! *** Error ***\n! Canon EOS Half-Press failed: Perhaps no focus?\n! ERROR: Could not capture image.\nexit 1\n";
    let error = error_of(&(opened(PORT) + &asked(PORT, "1/60") + focus));
    assert!(
        error.contains("hint: switch the lens to manual focus"),
        "{error}"
    );

    let wiring = CameraWiring {
        clock: Arc::new(FastClock::default()),
        watch: &Unwatched,
        whole: &|_| Ok(()),
        say: &|_| {},
    };
    let opened = Gphoto2Camera::open("/nowhere/gphoto2", None, &rig("[1]"), wiring);
    let error = opened.map(drop).unwrap_err().report();
    assert!(
        error.starts_with("/nowhere/gphoto2 cannot be run: "),
        "{error}"
    );
    assert!(
        error.contains("hint: install it: `apt-get install gphoto2`"),
        "{error}"
    );
}

/// With a camera connected (or libgphoto2's virtual one): `cargo test --test camera_gphoto2 -- --ignored --nocapture`.
/// `GPHOTO2=PATH` names another program.
#[test]
#[ignore = "needs a camera"]
fn a_connected_camera_takes_two_shots() {
    let program = std::env::var("GPHOTO2").unwrap_or_else(|_| "gphoto2".into());
    let wiring = CameraWiring {
        clock: Arc::new(goniofit::rig::SystemClock::new()),
        watch: &Unwatched,
        whole: &|bytes| goniofit::measure::decode(bytes).map(drop),
        say: &|text| println!("{text}"),
    };
    let opened = Gphoto2Camera::open(program, None, &rig("[20, 52]"), wiring);
    let mut camera = opened.map_err(|e| e.report()).unwrap();
    println!("serial number '{}'", camera.serial());
    for exposure_ms in [52.0, 20.0] {
        let frame = camera
            .expose(&shot(exposure_ms))
            .map_err(|e| e.report())
            .unwrap();
        println!(
            "{} bytes of {}, {} ms",
            frame.bytes.len(),
            frame.extension,
            frame.exposure_ms
        );
        assert!((frame.exposure_ms / exposure_ms - 1.0).abs() < 0.15);
    }
}
