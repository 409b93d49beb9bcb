//! Promise: `goniofit ct` looks at volumes, draws them, prepares them, and never replaces a file unasked.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

#[path = "common/command.rs"]
mod command;
#[path = "common/ct_files.rs"]
mod ct_files;

use command::{done, goniofit, text};
use ct_files::{Page, nrrd_f32, tiff, write};
use serde_json::Value;
use std::path::Path;

/// A plain weave of 16-bit slices: yarns 8 voxels apart.
fn scan(folder: &Path) {
    std::fs::create_dir(folder).unwrap();
    let wave = |k: u32| f64::from(k) * std::f64::consts::TAU / 16.0;
    for z in 0..24u32 {
        let value = |x: u32, y: u32| {
            let warp = 12.0 + 3.0 * wave(y).cos() * wave(x).cos().signum();
            let weft = 12.0 - 3.0 * wave(x).cos() * wave(y).cos().signum();
            let near = (f64::from(z) - warp).abs().min((f64::from(z) - weft).abs());
            1000 + (20_000.0 * (3.0 - near).clamp(0.0, 1.0)) as u16
        };
        let data = (0..64 * 48)
            .flat_map(|i| value(i % 64, i / 64).to_be_bytes())
            .collect();
        let page = Page::new([64, 48], 16, 1, data);
        write(folder, &format!("s{z}.tif"), &[&tiff(&[page], true)]);
    }
}

#[test]
fn info_speaks_words_and_json() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scan");
    scan(&path);
    let (out, _) = done(&["ct", "info", text(&path), "--voxel-um", "5,5,10", "--json"]);
    let json: Value = serde_json::from_str(&out).unwrap();
    assert_eq!(json["dims"], serde_json::json!([64, 48, 24]));
    assert_eq!(json["type"], "u16");
    assert_eq!(json["voxel_um"], serde_json::json!([5.0, 5.0, 10.0]));
    assert_eq!(json["size_mm"], serde_json::json!([0.32, 0.24, 0.24]));
    assert_eq!(
        (json["min"].as_f64(), json["max"].as_f64()),
        (Some(1000.0), Some(21000.0))
    );
    let otsu = json["otsu"].as_f64().unwrap();
    assert!((5000.0..17000.0).contains(&otsu), "{otsu}");
    assert!(json["notes"][0].as_str().unwrap().contains("anisotropic"));
    let (out, _) = done(&["ct", "info", text(&path), "--voxel-um", "5"]);
    for part in [
        "64 x 48 x 24",
        "u16",
        "5 x 5 x 5 um",
        "otsu threshold",
        "not empty",
    ] {
        assert!(out.contains(part), "{part}: {out}");
    }
    let (code, out, err) = goniofit(&["ct", "info", text(&path)]);
    assert_eq!((code, out.as_str()), (2, ""));
    assert!(
        err.contains("the file states no voxel size\nhint: give it in micrometers: --voxel-um 5"),
        "{err}"
    );
}

#[test]
fn view_draws_all_three_axes() {
    let folder = tempfile::tempdir().unwrap();
    let (path, out) = (folder.path().join("scan"), folder.path().join("pictures"));
    scan(&path);
    let arguments = [
        "ct",
        "view",
        text(&path),
        "--voxel-um",
        "5,5,10",
        "--out",
        text(&out),
        "--every",
        "12",
    ];
    let (list, _) = done(&arguments);
    let names: Vec<&str> = list
        .lines()
        .map(|l| l.rsplit('/').next().unwrap())
        .collect();
    let expected = [
        "xy_z0006.png",
        "xy_z0018.png",
        "xz_y0006.png",
        "xz_y0018.png",
        "xz_y0030.png",
        "xz_y0042.png",
        "yz_x0006.png",
        "yz_x0018.png",
        "yz_x0030.png",
        "yz_x0042.png",
        "yz_x0054.png",
    ];
    assert_eq!(names, expected);
    // 64 voxels are drawn four times as large; voxels twice as high as wide are drawn so.
    let size = |name: &str| image::open(out.join(name)).unwrap().to_rgb8().dimensions();
    assert_eq!(size("xy_z0006.png"), (256, 4 * 48 + 26));
    assert_eq!(size("xz_y0006.png"), (256, 4 * 48 + 26));
    let (code, _, err) = goniofit(&arguments);
    assert_eq!(code, 2);
    assert!(err.contains("exists already"), "{err}");
    let more = [arguments.as_slice(), &["--force", "--range", "21000,1000"]].concat();
    let (code, _, err) = goniofit(&more);
    assert!(code == 2 && err.contains("the lower value first"), "{err}");
    let more = [arguments.as_slice(), &["--force", "--range", "1000,21000"]].concat();
    let (_, said) = done(&more);
    assert!(said.contains("11 pictures, black 1000"), "{said}");
}

#[test]
fn prepare_makes_a_volume_that_is_read_back() {
    let folder = tempfile::tempdir().unwrap();
    let (path, out) = (folder.path().join("scan"), folder.path().join("cloth"));
    scan(&path);
    let arguments = [
        "ct",
        "prepare",
        text(&path),
        "--voxel-um",
        "5,5,10",
        "--out",
        text(&out),
        "--repeat-mm",
        "0.08,0.08",
        "--memory-mib",
        "1",
    ];
    let (printed, said) = done(&arguments);
    assert_eq!(printed.trim(), text(&out.join("volume.nrrd")));
    assert!(said.contains("4 x 3 repeats"), "{said}");
    let json: Value =
        serde_json::from_slice(&std::fs::read(out.join("prepare.json")).unwrap()).unwrap();
    assert_eq!(json["format"], "goniofit-ct-prepared-1");
    assert_eq!(json["repeats"], serde_json::json!([4, 3]));
    assert_eq!(
        json["levels"]["air"]["coefficients"]
            .as_array()
            .unwrap()
            .len(),
        6
    );
    let (info, _) = done(&["ct", "info", text(&out.join("volume.nrrd")), "--json"]);
    let info: Value = serde_json::from_str(&info).unwrap();
    assert_eq!(info["dims"], json["dims"]);
    assert_eq!(info["dims"][0], 64);
    assert_eq!(info["voxel_um"], serde_json::json!([5.0, 5.0, 5.0]));
    assert_eq!(info["notes"], serde_json::json!([]));
    // Air is 0 and fiber 1.
    let quantile = |k: usize| info["quantiles"][k]["value"].as_f64().unwrap();
    assert!(
        quantile(3).abs() < 0.1 && (quantile(7) - 1.0).abs() < 0.15,
        "{info}"
    );
    let files: Vec<_> = std::fs::read_dir(&out).unwrap().collect();
    assert_eq!(files.len(), 2);
    let (code, _, err) = goniofit(&arguments);
    assert!(code == 2 && err.contains("exists already"), "{err}");
}

#[test]
fn bad_arguments_and_files_are_answered() {
    let folder = tempfile::tempdir().unwrap();
    let file = write(
        folder.path(),
        "a.nrrd",
        &[&nrrd_f32([8, 8, 8], [5.0; 3], |x, y, z| (x + y + z) as f32)],
    );
    let out = folder.path().join("out");
    let prepare = |more: &[&str]| {
        let arguments = [&["ct", "prepare", text(&file), "--out", text(&out)], more].concat();
        let (code, _, err) = goniofit(&arguments);
        assert_eq!(code, 2, "{more:?}");
        err
    };
    assert!(prepare(&["--crop", "1,2,3"]).contains("--crop: expected X0,X1,Y0,Y1"));
    assert!(prepare(&["--repeat-mm", "1"]).contains("expected WX,WY in millimeters"));
    assert!(prepare(&["--repeat-mm", "0,1"]).contains("above 0"));
    assert!(prepare(&["--axes", "x,y,y"]).contains("once each"));
    assert!(prepare(&["--voxel-um", "5,5"]).contains("one number or three"));
    assert!(prepare(&["--unit", "ell"]).contains("expected nm, um, mm, cm or m"));
    let cut = write(
        folder.path(),
        "b.nrrd",
        &[&std::fs::read(&file).unwrap()[..900]],
    );
    let (code, _, err) = goniofit(&["ct", "info", text(&cut)]);
    assert!(
        code == 2 && err.contains("b.nrrd is cut off") && err.contains("hint: copy it again"),
        "{err}"
    );
    let mirrored = ["ct", "info", text(&file), "--axes", "x,y,-z"];
    assert!(
        done(&mirrored)
            .1
            .contains("note: axes x,y,-z make a mirror image")
    );
}

#[test]
fn help_has_examples() {
    for command in [
        &["ct"][..],
        &["ct", "info"],
        &["ct", "view"],
        &["ct", "prepare"],
    ] {
        let (out, _) = done(&[command, &["--help"]].concat());
        assert!(out.contains("Example"), "{command:?}");
    }
}

#[test]
fn an_interrupt_ends_with_its_code_and_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let file = write(
        folder.path(),
        "a.nrrd",
        &[&nrrd_f32([256, 256, 192], [5.0; 3], |x, y, z| {
            ((x * y + z) % 97) as f32
        })],
    );
    let out = folder.path().join("out");
    let mut child = std::process::Command::new(env!("CARGO_BIN_EXE_goniofit"))
        .args([
            "ct",
            "prepare",
            text(&file),
            "--out",
            text(&out),
            "--memory-mib",
            "1",
        ])
        .stdout(std::process::Stdio::null())
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    // The folder is made once Ctrl-C is handled and before anything is read.
    while !out.is_dir() {
        std::thread::yield_now();
    }
    let pid = rustix::process::Pid::from_child(&child);
    rustix::process::kill_process(pid, rustix::process::Signal::INT).unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(130));
    assert_eq!(std::fs::read_dir(&out).unwrap().count(), 0);
}
