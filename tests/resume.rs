//! An interrupted capture goes on: whatever cut it short, the finished session has every shot once and measures the same.
#![allow(clippy::unwrap_used, missing_docs)]

use goniofit::base::{Result, Unwatched};
use goniofit::measure::{MeasureOptions, measure_session};
use goniofit::rig::capture::{Capture, CaptureOptions, Summary};
use goniofit::rig::simulated::{in_process_connection, model_options};
use goniofit::rig::{
    Appearance, Camera, CapturedFrame, Fault, FaultKind, RigDescription, SensorModel, Shot,
    Unattended, VirtualCamera,
};
use goniofit::session::{
    BitDepth, CameraFacts, Configuration, Event, FrameKind, Plan, SessionFolder, read_journal,
};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// A folder where waiting for the disk costs nothing.
fn scratch() -> tempfile::TempDir {
    let memory = Path::new("/dev/shm");
    if memory.is_dir() {
        tempfile::tempdir_in(memory).unwrap()
    } else {
        tempfile::tempdir().unwrap()
    }
}

/// The five-axis rig with a small camera and two exposures.
fn rig_text() -> String {
    let text = std::fs::read_to_string(root().join("rig_configs/five_axis_grblhal.toml")).unwrap();
    text.replace("pixel_mm = 0.05", "pixel_mm = 0.25")
        .replace("[50.0, 400.0]", "[10.0, 40.0]")
        .replace("warm_up_s = 60.0", "warm_up_s = 2.0")
}

fn rig() -> RigDescription {
    RigDescription::from_toml(&rig_text()).unwrap()
}

fn plan() -> Plan {
    let mut plan = Plan::read(&root().join("rig_configs/plans/khungurn16.toml")).unwrap();
    plan.configurations.truncate(3);
    plan
}

struct Plain;

impl Appearance for Plain {
    fn radiance(&self, kind: FrameKind, pose: &Configuration, point_mm: [f64; 2]) -> [f64; 3] {
        match kind {
            FrameKind::White => [0.7; 3],
            _ => [0.2, 0.3, 0.4].map(|c| c + 0.02 * f64::from(pose.id) + 0.01 * point_mm[0].sin()),
        }
    }
}

fn camera() -> VirtualCamera {
    let sensor = SensorModel {
        width: 64,
        height: 64,
        pixel_mm: 0.25,
        center_px: [32.0, 32.0],
        bits: BitDepth::Sixteen,
        ..SensorModel::default()
    };
    VirtualCamera::new(sensor, Box::new(Plain), 5).unwrap()
}

/// Starts or resumes a capture in `out` on fresh simulated boards, with these faults.
fn capture(camera: &mut dyn Camera, out: &Path, faults: Vec<Fault>) -> Result<Summary> {
    let rig = rig();
    let mut options = model_options(&rig, &rig.boards[0]);
    options.faults = faults;
    let (_, connection) = in_process_connection(vec![("main".to_owned(), options)]);
    let capture = Capture {
        description: &rig,
        plan: &plan(),
        connection,
        camera,
        judge: None,
        operator: &Unattended(&Unwatched),
        options: CaptureOptions::default(),
    };
    if out.join("session.json").exists() {
        capture.resume(out)
    } else {
        capture.start(out)
    }
}

/// The session's intensities as written to a file.
fn measured(out: &Path) -> String {
    let session = SessionFolder::open(out).unwrap();
    let (measurements, _) =
        measure_session(&session, &MeasureOptions::default(), &Unwatched).unwrap();
    measurements.to_csv().unwrap()
}

/// How often each shot was taken: 1 for all of them.
fn assert_each_shot_once(out: &Path, what: &str) {
    let mut count: BTreeMap<_, u32> = BTreeMap::new();
    let frames = SessionFolder::open(out).unwrap().frames().unwrap();
    for f in &frames {
        let key = (f.kind, f.config, f.asked_ms().to_bits(), f.repeat, f.visit);
        *count.entry(key).or_default() += 1;
    }
    // 2 whites, 3 x 2 samples, 2 darks.
    assert_eq!(count.len(), 10, "{what}: {frames:?}");
    assert!(count.values().all(|n| *n == 1), "{what}: {frames:?}");
    let files: std::collections::BTreeSet<&str> = frames.iter().map(|f| f.file.as_str()).collect();
    assert_eq!(files.len(), 10, "{what}: one file per shot");
}

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to.join("frames")).unwrap();
    for name in [
        "session.json",
        "plan.toml",
        "rig.toml",
        "journal.jsonl",
        "wire.jsonl",
    ] {
        std::fs::copy(from.join(name), to.join(name)).unwrap();
    }
    for file in std::fs::read_dir(from.join("frames")).unwrap() {
        let file = file.unwrap();
        std::fs::copy(file.path(), to.join("frames").join(file.file_name())).unwrap();
    }
}

#[test]
fn a_journal_cut_at_any_byte_resumes_to_the_same_measurements() {
    let folder = scratch();
    let whole = folder.path().join("whole");
    assert!(capture(&mut camera(), &whole, vec![]).unwrap().finished());
    assert_each_shot_once(&whole, "uninterrupted");
    let expected = measured(&whole);
    let journal = std::fs::read(whole.join("journal.jsonl")).unwrap();
    let files: Vec<String> = SessionFolder::open(&whole)
        .unwrap()
        .frames()
        .unwrap()
        .into_iter()
        .map(|f| f.file)
        .collect();
    (0..journal.len()).into_par_iter().for_each(|cut| {
        let here = scratch();
        let out = here.path().join("s");
        copy(&whole, &out);
        std::fs::write(out.join("journal.jsonl"), &journal[..cut]).unwrap();
        // What a crash there leaves: the frames of the whole lines, and perhaps the one whose line was not finished.
        let known = SessionFolder::open(&out).unwrap().frames().unwrap().len();
        for (n, file) in files.iter().enumerate() {
            if n > known || (n == known && cut % 2 == 0) {
                std::fs::remove_file(out.join("frames").join(file)).unwrap();
            }
        }
        std::fs::write(out.join("frames/.0099_half.dng.1.part"), "half a frame").unwrap();
        let summary = capture(&mut camera(), &out, vec![]).unwrap();
        assert!(summary.finished(), "cut at {cut}");
        assert_each_shot_once(&out, &format!("cut at {cut}"));
        assert_eq!(measured(&out), expected, "cut at {cut}");
        assert!(!out.join("frames/.0099_half.dng.1.part").exists());
        let aside = std::fs::read_dir(out.join("frames/unjournaled")).map_or(0, Iterator::count);
        assert_eq!(
            aside,
            usize::from(known < files.len() && cut % 2 == 1),
            "cut at {cut}: a frame without its line is put aside, not lost"
        );
    });
}

#[test]
fn measurements_tell_frames_apart() {
    // The comparison above sees it when one frame is another: here two configurations are swapped.
    let folder = scratch();
    let (a, b) = (folder.path().join("a"), folder.path().join("b"));
    capture(&mut camera(), &a, vec![]).unwrap();
    struct Swapped(VirtualCamera);
    impl Camera for Swapped {
        fn facts(&self) -> CameraFacts {
            Camera::facts(&self.0)
        }
        fn expose(&mut self, shot: &Shot) -> Result<CapturedFrame> {
            let mut shot = shot.clone();
            if shot.config == Some(2) {
                shot.config = Some(3);
            }
            self.0.expose(&shot)
        }
    }
    capture(&mut Swapped(camera()), &b, vec![]).unwrap();
    assert_ne!(measured(&a), measured(&b));
}

#[test]
fn a_capture_goes_on_after_any_fault_of_the_board_on_any_move() {
    let folder = scratch();
    let whole = folder.path().join("whole");
    capture(&mut camera(), &whole, vec![]).unwrap();
    let expected = measured(&whole);
    let kinds = [
        FaultKind::Vanish,
        FaultKind::Reset,
        FaultKind::Alarm(1),
        FaultKind::NeverOk,
        FaultKind::FallShort(1.0),
        FaultKind::Hold,
    ];
    for (n, kind) in kinds.into_iter().enumerate() {
        for on_move in 1..=3 {
            let out = folder.path().join(format!("f{n}_{on_move}"));
            let what = format!("{kind:?} on move {on_move}");
            let error = capture(&mut camera(), &out, vec![Fault { on_move, kind }])
                .unwrap_err()
                .report();
            assert!(error.contains("capture --resume"), "{what}: {error}");
            let before = SessionFolder::open(&out).unwrap().frames().unwrap();
            assert!(capture(&mut camera(), &out, vec![]).unwrap().finished());
            let after = SessionFolder::open(&out).unwrap().frames().unwrap();
            assert_eq!(
                after[..before.len()],
                before[..],
                "{what}: kept as they were"
            );
            assert_each_shot_once(&out, &what);
            assert_eq!(measured(&out), expected, "{what}");
            assert!(out.join("wire-2.jsonl").exists() && out.join("wire.jsonl").exists());
        }
    }
}

#[test]
fn only_the_same_rig_and_plan_and_an_unfinished_session_are_resumed() {
    let folder = scratch();
    let out = folder.path().join("s");
    let error = |out: &Path| capture(&mut camera(), out, vec![]).unwrap_err().report();
    capture(&mut camera(), &out, vec![]).unwrap();
    assert!(error(&out).contains("is complete"), "{}", error(&out));
    // A missing frame.
    let journal = std::fs::read_to_string(out.join("journal.jsonl")).unwrap();
    let shorter: Vec<&str> = journal.lines().take(5).collect();
    std::fs::write(out.join("journal.jsonl"), shorter.join("\n") + "\n").unwrap();
    let first = SessionFolder::open(&out).unwrap().frames().unwrap()[0]
        .file
        .clone();
    std::fs::rename(out.join("frames").join(&first), out.join("kept")).unwrap();
    let told = error(&out);
    assert!(
        told.contains(&first) && told.contains("is missing"),
        "{told}"
    );
    std::fs::rename(out.join("kept"), out.join("frames").join(&first)).unwrap();
    // Another rig: the manifest says what it was begun with.
    let manifest = std::fs::read_to_string(out.join("session.json")).unwrap();
    let hash = SessionFolder::open(&out)
        .unwrap()
        .manifest()
        .unwrap()
        .provenance
        .config_sha256;
    std::fs::write(
        out.join("session.json"),
        manifest.replace(&hash, &"0".repeat(64)),
    )
    .unwrap();
    assert!(
        error(&out).contains("another rig file or plan"),
        "{}",
        error(&out)
    );
    std::fs::write(out.join("session.json"), manifest).unwrap();
    // Somebody else is at it.
    let (_, held, _) = SessionFolder::resume(&out).unwrap();
    assert!(error(&out).contains("another process"), "{}", error(&out));
    drop(held);
    assert!(capture(&mut camera(), &out, vec![]).unwrap().finished());
}

// -- real processes --------------------------------------------------------------------------------------------------

struct Running(std::process::Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Rig, plan and a recorded session to take frames from; a simulated board per capture.
struct Bench {
    folder: tempfile::TempDir,
}

impl Bench {
    fn new() -> Self {
        let folder = scratch();
        let path = |name: &str| folder.path().join(name);
        let text = rig_text()
            .replace("settle_ms = 300", "settle_ms = 1")
            .replace("settle_ms = 200", "settle_ms = 1")
            .replace("warm_up_s = 2.0", "warm_up_s = 0.0");
        std::fs::write(path("rig.toml"), &text).unwrap();
        std::fs::write(path("plan.toml"), plan().to_toml().unwrap()).unwrap();
        capture(&mut camera(), &path("recorded"), vec![]).unwrap();
        Self { folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// A board, and the program on it with these arguments; `limit` is put before it in the shell.
    fn capture(&self, arguments: &[&str], limit: &str) -> (Running, Running) {
        let mut sim = Command::new(assert_cmd::cargo::cargo_bin("goniofit"));
        sim.args(["sim", "--speed", "300"])
            .stdout(Stdio::piped())
            .stderr(Stdio::null());
        let mut sim = Running(sim.spawn().unwrap());
        let mut port = String::new();
        let stdout = sim.0.stdout.take().unwrap();
        std::io::BufRead::read_line(&mut std::io::BufReader::new(stdout), &mut port).unwrap();
        let mut command = Command::new("sh");
        command
            .arg("-c")
            .arg(format!("{limit} exec \"$0\" \"$@\""))
            .arg(assert_cmd::cargo::cargo_bin("goniofit"))
            .arg("capture")
            .args(arguments)
            .args(["--yes", "--blind", "--port", port.trim()])
            .arg("--camera")
            .arg(format!("replay:{}", self.path("recorded").display()))
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped());
        let capture = Running(command.spawn().unwrap());
        (sim, capture)
    }

    fn start(&self, out: &str, limit: &str) -> (Running, Running) {
        let [rig, plan, out] = ["rig.toml", "plan.toml", out].map(|n| self.path(n));
        let text = [&rig, &plan, &out].map(|p| p.to_str().unwrap());
        self.capture(
            &["--rig", text[0], "--plan", text[1], "--out", text[2]],
            limit,
        )
    }

    fn resume_to_the_end(&self, out: &str) {
        let out = self.path(out);
        let (_sim, mut capture) = self.capture(&["--resume", out.to_str().unwrap()], "");
        let (code, said) = ended(&mut capture);
        assert_eq!(code, Some(0), "{said}");
    }
}

fn ended(running: &mut Running) -> (Option<i32>, String) {
    let mut said = String::new();
    let mut stderr = running.0.stderr.take().unwrap();
    std::io::Read::read_to_string(&mut stderr, &mut said).unwrap();
    (running.0.wait().unwrap().code(), said)
}

#[test]
fn kill_9_at_every_journal_line_resumes_to_the_same_measurements() {
    let bench = Bench::new();
    let expected = measured(&bench.path("recorded"));
    let lines = std::fs::read_to_string(bench.path("recorded/journal.jsonl"))
        .unwrap()
        .lines()
        .count();
    for line in 1..=lines {
        let name = format!("killed_{line}");
        let out = bench.path(&name);
        let (sim, mut capture) = bench.start(&name, "");
        let begun = Instant::now();
        loop {
            let written = std::fs::read(out.join("journal.jsonl"))
                .map_or(0, |b| b.iter().filter(|c| **c == b'\n').count());
            let done = capture.0.try_wait().unwrap().is_some();
            if written >= line || done {
                break;
            }
            assert!(begun.elapsed() < Duration::from_secs(60), "line {line}");
            std::thread::sleep(Duration::from_micros(200));
        }
        // SIGKILL.
        capture.0.kill().unwrap();
        capture.0.wait().unwrap();
        drop(sim);
        let finished = read_journal(&out.join("journal.jsonl"))
            .unwrap()
            .iter()
            .any(|e| e.event == Event::Finished);
        if !finished {
            bench.resume_to_the_end(&name);
        }
        assert_each_shot_once(&out, &name);
        assert_eq!(measured(&out), expected, "{name}");
    }
}

#[test]
fn a_full_disk_stops_with_a_clear_message_and_the_session_goes_on_afterwards() {
    let bench = Bench::new();
    let expected = measured(&bench.path("recorded"));
    let frame = SessionFolder::open(&bench.path("recorded")).unwrap();
    let first = frame.frames().unwrap()[0].file.clone();
    let bytes = std::fs::metadata(frame.frame_path(&first)).unwrap().len();
    // Files may not grow beyond this (in units of 512 bytes): no frame, then no long wire log.
    for blocks in [bytes / 512 - 1, bytes / 512 + 4] {
        let name = format!("full_{blocks}");
        let limit = format!("trap '' XFSZ; ulimit -f {blocks};");
        let (_sim, mut capture) = bench.start(&name, &limit);
        let (code, said) = ended(&mut capture);
        assert_eq!(code, Some(2), "{said}");
        assert!(
            said.contains("cannot be written") && said.contains("--resume"),
            "{said}"
        );
        // Still full the next time.
        let out = bench.path(&name);
        if 512 * blocks < bytes {
            let (_sim, mut capture) = bench.capture(&["--resume", out.to_str().unwrap()], &limit);
            let (code, said) = ended(&mut capture);
            assert_eq!(code, Some(2), "{said}");
        }
        bench.resume_to_the_end(&name);
        assert_each_shot_once(&bench.path(&name), &name);
        assert_eq!(measured(&bench.path(&name)), expected, "{name}");
    }
}
