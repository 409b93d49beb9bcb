//! Promise: frames of another program become a session that measures as the original does; a list that cannot be right is
//! refused by row, and leaves nothing behind.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

#[path = "common/command.rs"]
mod command;
mod virtual_session;

use command::{goniofit, text};
use goniofit::session::{
    Entry, Event, Filter, FrameKind, Layout, SessionFolder, TiffImage, read_journal, sha256,
    write_tiff,
};
use std::fmt::Write;
use std::path::{Path, PathBuf};
use virtual_session::{Setup, folder, record};

fn import(list: &Path, plan: &Path, camera: &Path, out: &Path) -> (i32, String, String) {
    goniofit(&[
        "session",
        "import",
        text(list),
        "--plan",
        text(plan),
        "--camera",
        text(camera),
        "--out",
        text(out),
    ])
}

const PLAN: &str = "name = 'two'
[[configurations]]
config = 1
light_theta_deg = 30.0
light_phi_deg = 180.0
camera_theta_deg = 0.0
camera_phi_deg = 0.0
rotation_deg = 0.0
";

const CAMERA: &str = "name = 'old rig'
[camera]
name = 'maker mono'
pixel_mm = 0.5
sample_square_mm = 5.0
[white]
light_theta_deg = 45.0
light_phi_deg = 180.0
camera_theta_deg = 0.0
camera_phi_deg = 0.0
reflectance_factor = [1.0, 1.0, 1.0]
reflectance_factor_se = [0.005, 0.005, 0.005]
[light]
size_mm = [100.0, 100.0]
distance_mm = 610.0
";

/// A folder with a plan, a camera file and monochrome TIFF frames `0.tif`, `1.tif`, ... of 20 and 40 ms in turn.
struct Bench {
    folder: tempfile::TempDir,
}

impl Bench {
    fn new() -> Self {
        let bench = Self {
            folder: tempfile::tempdir().unwrap(),
        };
        bench.write("plan.toml", PLAN.as_bytes());
        bench.write("camera.toml", CAMERA.as_bytes());
        for i in 0..8 {
            bench.write(
                &format!("{i}.tif"),
                &frame(i, [24, 20], Some(20.0 * f64::from(1 + i % 2))),
            );
        }
        bench
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn write(&self, name: &str, content: &[u8]) {
        std::fs::write(self.path(name), content).unwrap();
    }

    fn import(&self, list: &str) -> (i32, String, String) {
        self.write("list.csv", list.as_bytes());
        let [list, plan, camera, out] =
            ["list.csv", "plan.toml", "camera.toml", "out"].map(|name| self.path(name));
        import(&list, &plan, &camera, &out)
    }

    /// Refused with all these parts, and nothing written.
    fn refuses(&self, list: &str, parts: &[&str]) {
        let (code, out, err) = self.import(list);
        assert_eq!((code, out.as_str()), (2, ""), "{err}");
        for part in parts.iter().chain(&["hint:"]) {
            assert!(err.contains(part), "'{part}' is not in: {err}");
        }
        let names = std::fs::read_dir(self.folder.path()).unwrap();
        let names: Vec<_> = names.map(|e| e.unwrap().file_name()).collect();
        let left = names
            .iter()
            .any(|n| n == "out" || n.to_string_lossy().contains("import"));
        assert!(!left, "{names:?}");
    }
}

fn frame(number: u32, [width, height]: [usize; 2], exposure_ms: Option<f64>) -> Vec<u8> {
    let data: Vec<u16> = (0..width * height)
        .map(|i| 100 + (i as u32 * 7 + number) as u16)
        .collect();
    write_tiff(&TiffImage {
        width,
        height,
        layout: Layout::Mono,
        data: &data,
        white: 65_535,
        make: "maker",
        model: "mono",
        exposure_ms,
        iso: None,
    })
    .unwrap()
}

#[test]
fn an_imported_session_measures_as_the_original_does() {
    let setup = Setup::new(5);
    let folder = folder();
    let original = record(folder.path(), &setup);
    let manifest = original.manifest().unwrap();
    let mut list = String::from("file,kind,config,exposure_ms,repeat,visit,elapsed_s\n");
    for entry in read_journal(&original.journal_path()).unwrap() {
        let Entry {
            elapsed_s,
            event: Event::Frame(f),
            ..
        } = entry
        else {
            continue;
        };
        let config = f.config.map_or(String::new(), |c| c.to_string());
        let path = original.frame_path(&f.file);
        let (kind, ms, repeat) = (f.kind.name(), f.exposure_ms, f.repeat);
        writeln!(
            list,
            "{},{kind},{config},{ms},{repeat},{},{elapsed_s}",
            text(&path),
            f.visit
        )
        .unwrap();
    }
    let bench = tempfile::tempdir().unwrap();
    let at = |name: &str| bench.path().join(name);
    std::fs::write(at("list.csv"), list).unwrap();
    let white = &manifest.white;
    let degrees = |radians: f64| (radians.to_degrees() * 1e9).round() / 1e9;
    let camera = format!(
        "name = 'lab'\n[camera]\nname = '{}'\npixel_mm = {:?}\nsample_square_mm = {:?}\ncenter_px = {:?}\n[white]\n\
         light_theta_deg = {:?}\nlight_phi_deg = {:?}\ncamera_theta_deg = {:?}\ncamera_phi_deg = {:?}\n\
         rotation_deg = {:?}\nreflectance_factor = {:?}\nreflectance_factor_se = {:?}\n",
        manifest.camera.name,
        manifest.camera.pixel_mm,
        manifest.sample_square_mm,
        manifest.camera.center_px,
        degrees(white.configuration.light.theta),
        degrees(white.configuration.light.phi),
        degrees(white.configuration.camera.theta),
        degrees(white.configuration.camera.phi),
        degrees(white.configuration.rotation),
        white.reflectance_factor,
        white.reflectance_factor_se,
    );
    std::fs::write(at("camera.toml"), camera).unwrap();
    let plan = original.root().join("plan.toml");
    let (code, out, err) = import(&at("list.csv"), &plan, &at("camera.toml"), &at("out"));
    assert_eq!(code, 0, "{err}");
    assert_eq!(out.trim(), text(&at("out")));
    let imported = SessionFolder::open(&at("out")).unwrap();
    let copy = imported.manifest().unwrap();
    assert_eq!(
        (copy.camera, copy.exposures_ms),
        (manifest.camera, manifest.exposures_ms)
    );
    assert_eq!(
        imported.frames().unwrap().len(),
        original.frames().unwrap().len()
    );
    let measured = [original.root(), imported.root()].map(|root| {
        let (code, _, err) = goniofit(&["measure", "session", text(root)]);
        assert!(code < 2, "{err}");
        let csv = std::fs::read_to_string(root.join("measurements.csv")).unwrap();
        // The original says that it is synthetic, the import was not told.
        let numbers = csv.lines().filter(|l| !l.starts_with('#'));
        numbers.map(str::to_owned).collect::<Vec<_>>()
    });
    assert!(measured[0].len() > 4);
    assert_eq!(measured[0], measured[1]);
    // The files are copies, and the originals are still there.
    for frame in imported.frames().unwrap() {
        let bytes = std::fs::read(imported.frame_path(&frame.file)).unwrap();
        assert_eq!(sha256(&bytes), frame.sha256);
    }
}

#[test]
fn frames_of_one_filter_at_a_time_are_journaled_with_filter_order_and_exposure() {
    let bench = Bench::new();
    // Killed before: copies that are no session.
    std::fs::create_dir(bench.path(".out.import")).unwrap();
    bench.write(".out.import/session.json", b"half");
    let list = "file,kind,config,exposure_ms,filter,elapsed_s,utc
0.tif,dark,,,,9,
1.tif,white,,,r,1,2024-02-29T12:34:56Z
2.tif,white,,,g,2,
3.tif,sample,1,41.5,r,3,
4.tif,sample,1,,g,4,
6.tif,sample,1,,g,5,
";
    let (code, _, err) = bench.import(list);
    assert_eq!(code, 0, "{err}");
    assert!(
        err.contains("6 frames of 24 x 20 pixels, monochrome"),
        "{err}"
    );
    let session = SessionFolder::open(&bench.path("out")).unwrap();
    assert!(!bench.path(".out.import").exists());
    let frames = session.frames().unwrap();
    let seen: Vec<_> = frames
        .iter()
        .map(|f| (f.kind, f.filter, f.exposure_ms, f.repeat))
        .collect();
    let (r, g) = (Some(Filter::R), Some(Filter::G));
    let wanted = [
        (FrameKind::White, r, 40.0, 0),
        (FrameKind::White, g, 20.0, 0),
        (FrameKind::Sample, r, 41.5, 0),
        (FrameKind::Sample, g, 20.0, 0),
        (FrameKind::Sample, g, 20.0, 1),
        (FrameKind::Dark, None, 20.0, 0),
    ];
    assert_eq!(seen, wanted);
    assert_eq!(frames[0].file, "0002_white_40ms.tif");
    let journal = read_journal(&session.journal_path()).unwrap();
    assert!(matches!(journal[0].event, Event::Ready { .. }) && journal[6].elapsed_s == 9.0);
    assert_eq!(journal.last().unwrap().event, Event::Finished);
    let manifest = session.manifest().unwrap();
    assert_eq!(
        (manifest.camera.center_px, manifest.synthetic),
        ([12.0, 10.0], false)
    );
    assert_eq!(manifest.exposures_ms, [20.0, 41.5]);
    assert_eq!(manifest.started_utc, "2024-02-29T12:34:56Z");
    // Never over what is there.
    let (code, _, err) = bench.import(list);
    assert_eq!(code, 2);
    assert!(err.contains("already holds a session"), "{err}");
}

#[test]
fn lists_that_cannot_be_right_are_refused_by_row() {
    let bench = Bench::new();
    bench.write("unknown.tif", &frame(1, [24, 20], None));
    bench.write("small.tif", &frame(1, [22, 20], Some(20.0)));
    bench.write("torn.tif", &frame(1, [24, 20], Some(20.0))[..700]);
    let head = "file,kind,config,exposure_ms,repeat,visit,filter,elapsed_s,utc\n";
    let refuses = |rows: &str, parts: &[&str]| bench.refuses(&format!("{head}{rows}"), parts);
    bench.refuses(
        "file,kind,pose\n0.tif,dark,1\n",
        &["row 1", "pose", "columns"],
    );
    bench.refuses("file,kind\n", &["has no frames"]);
    refuses("0.tif,drak,,,,,,,\n", &["row 1", "drak", "dark"]);
    refuses(
        "0.tif,dark,,,,,,,\n1.tif,sample,,,,,,,\n",
        &["row 2", "sample frame without config"],
    );
    refuses("0.tif,sample,7,,,,,,\n", &["no configuration 7"]);
    refuses("0.tif,white,1,,,,,,\n", &["white frame with config 1"]);
    refuses("0.tif,white,,,,2,,,\n", &["white frame with visit 2"]);
    refuses("0.tif,dark,,-3,,,,,\n", &["exposure_ms out of range"]);
    refuses("0.tif,dark,,NaN,,,,,\n", &["exposure_ms out of range"]);
    refuses(
        "0.tif,dark,,90,,,,,\n",
        &["exposure of 90 ms, the file 20 ms"],
    );
    refuses(
        "unknown.tif,dark,,,,,,,\n",
        &["neither the list nor the file states the exposure"],
    );
    refuses(
        "0.tif,dark,,,,,,1,\n1.tif,dark,,,,,,,\n",
        &["elapsed_s is stated in 1 of 2 rows"],
    );
    refuses(
        "0.tif,white,,,,,r,,\n1.tif,white,,,,,,,\n",
        &["row 2", "has no filter, others have"],
    );
    refuses(
        "0.tif,dark,,,,,,,\nsmall.tif,dark,,,,,,,\n",
        &["22 x 20 pixels", "24 x 20 pixels"],
    );
    refuses(
        "0.tif,dark,,,,,,,\ntorn.tif,dark,,,,,,,\n",
        &["row 2", "torn.tif", "cannot be decoded"],
    );
    let (code, _, err) = bench.import(&format!("{head}0.tif,dark,,,,,,,\n0.tif,dark,,,,,,,\n"));
    assert!(
        code == 2 && err.contains("rows 1 and 2 name the same file"),
        "{err}"
    );
    let (code, _, err) = bench.import(&format!("{head}nothing.tif,dark,,,,,,,\n"));
    assert!(
        code == 2 && err.contains("row 1") && err.contains("cannot be read"),
        "{err}"
    );
    bench.write(
        "camera.toml",
        CAMERA
            .replace("pixel_mm = 0.5", "pixel_mm = -1.0")
            .as_bytes(),
    );
    let (code, _, err) = bench.import(&format!("{head}0.tif,dark,,,,,,,\n"));
    assert!(
        code == 2 && err.contains("pixel_mm must be positive"),
        "{err}"
    );
    assert!(!bench.path("out").exists() && !bench.path(".out.import").exists());
}

#[test]
fn a_camera_that_saturates_below_the_stated_level_is_told() {
    let bench = Bench::new();
    let mut data = vec![700_u16; 24 * 20];
    data[..30].fill(4095);
    let saturated = |white: u16| {
        write_tiff(&TiffImage {
            width: 24,
            height: 20,
            layout: Layout::Mono,
            data: &data,
            white,
            make: "maker",
            model: "mono",
            exposure_ms: Some(20.0),
            iso: None,
        })
        .unwrap()
    };
    for (white, told) in [(65_535, true), (4095, false)] {
        bench.write("s.tif", &saturated(white));
        let (code, _, err) = bench.import("file,kind,config\ns.tif,sample,1\n");
        assert_eq!(code, 0, "{err}");
        assert_eq!(err.contains("no value is above 4095"), told, "{err}");
        std::fs::remove_dir_all(bench.path("out")).unwrap();
    }
}
