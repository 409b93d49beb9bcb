//! Promise: `goniofit ct simulate`, `orient`, `fibers`, `tile` and `view` work one after the other, say what they did, and
//! never replace a file unasked.
#![allow(clippy::unwrap_used, missing_docs)]

use assert_cmd::Command;
use goniofit::fabric::VoxelTile;
use serde_json::Value;
use std::path::Path;

fn goniofit(arguments: &[&str]) -> (i32, String, String) {
    let output = Command::cargo_bin("goniofit")
        .unwrap()
        .args(arguments)
        .output()
        .unwrap();
    let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
    (
        output.status.code().unwrap(),
        text(&output.stdout),
        text(&output.stderr),
    )
}

fn done(arguments: &[&str]) -> (String, String) {
    let (code, out, err) = goniofit(arguments);
    assert_eq!(code, 0, "{arguments:?}: {err}");
    (out, err)
}

fn fails(arguments: &[&str]) -> String {
    let (code, _, err) = goniofit(arguments);
    assert_eq!(code, 2, "{arguments:?}: {err}");
    err
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Eight fibers along x and eight along y above them on 0.3 x 0.3 mm.
fn crossed(folder: &Path) -> std::path::PathBuf {
    let mut csv = "# tile_mm = [0.3, 0.3]\nx0,y0,z0,x1,y1,z1,radius_mm,yarn_system\n".to_owned();
    for k in 0..8 {
        let at = 0.0375 * (f64::from(k) + 0.5);
        csv.push_str(&format!("0,{at},0,0.3,{at},0,0.01,1\n"));
        csv.push_str(&format!("{at},0,0.025,{at},0.3,0.025,0.01,0\n"));
    }
    let path = folder.join("crossed.csv");
    std::fs::write(&path, csv).unwrap();
    path
}

#[test]
fn from_fibers_to_a_scan_and_back() {
    let folder = tempfile::tempdir().unwrap();
    let (cloth, out) = (crossed(folder.path()), folder.path().join("virtual"));
    let simulate = [
        "ct",
        "simulate",
        text(&cloth),
        "--voxel-um",
        "5",
        "--noise",
        "0.05",
        "--truth",
        "--out",
        text(&out),
    ];
    let (printed, said) = done(&simulate);
    assert_eq!(printed.trim(), text(&out.join("volume.nrrd")));
    assert!(said.contains("60 x 60 x"), "{said}");
    assert!(fails(&simulate).contains("exists already"));
    let orient = [
        "ct",
        "orient",
        text(&out),
        "--radius-um",
        "10",
        "--periodic",
        "--out",
        text(&out),
    ];
    let (printed, said) = done(&orient);
    assert_eq!(printed.trim(), text(&out.join("oriented.nrrd")));
    for part in [
        "reach eps_d",
        "would keep",
        "--min-confidence would drop",
        "along x most of all",
    ] {
        assert!(said.contains(part), "{part}: {said}");
    }
    assert!(fails(&orient).contains("exists already"));
    let json: Value =
        serde_json::from_slice(&std::fs::read(out.join("orient.json")).unwrap()).unwrap();
    assert_eq!(json["format"], "goniofit-ct-oriented-1");
    assert_eq!(json["method"], "tensor");
    let shares = |k: usize| json["axis_shares"][k].as_f64().unwrap();
    assert!(
        (0.45..0.55).contains(&shares(0)) && shares(2) < 0.01,
        "{json}"
    );
    let truth = VoxelTile::read(&out.join("truth.nrrd")).unwrap();
    let found = VoxelTile::read(&out.join("oriented.nrrd")).unwrap();
    assert_eq!(truth.shape(), found.shape());
    assert!((truth.bottom() - found.bottom()).abs() < 1e-9);

    let csv = folder.path().join("found.csv");
    let moved = folder.path().join("moved.nrrd");
    let (printed, _) = done(&[
        "ct",
        "fibers",
        text(&out),
        "--radius-um",
        "10",
        "--truth",
        text(&cloth),
        "--transfer",
        text(&moved),
        "--out",
        text(&csv),
        "--json",
    ]);
    let json: Value = serde_json::from_str(&printed).unwrap();
    assert_eq!(json["fibers"], 16);
    assert!(json["score"]["recall"].as_f64().unwrap() > 0.95, "{json}");
    assert!(
        json["score"]["position_rms"].as_f64().unwrap() < 0.001,
        "{json}"
    );
    assert!(VoxelTile::is_in(&moved));
    // What was found is a fabric.
    let (described, _) = done(&["fabric", "describe", text(&csv), "--json"]);
    assert!(described.contains("segments"));
}

#[test]
fn oriented_voxels_are_drawn_and_tiled() {
    let folder = tempfile::tempdir().unwrap();
    let mut tile = VoxelTile::empty([64, 64, 4], 0.005, 0.0).unwrap();
    for place in 0..64 * 64 * 4 {
        let direction = if place % 64 < 32 {
            glam::DVec3::X
        } else {
            glam::DVec3::Z
        };
        tile.set(place, 1.0, direction).unwrap();
    }
    let file = folder.path().join("oriented.nrrd");
    tile.write(&file).unwrap();
    let pictures = folder.path().join("pictures");
    let (list, said) = done(&["ct", "view", text(&file), "--out", text(&pictures)]);
    assert!(
        said.contains("red along x") && list.lines().count() == 20,
        "{list}"
    );
    let image = image::open(pictures.join("xy_z0000.png"))
        .unwrap()
        .to_rgb8();
    assert_eq!(image.get_pixel(5, 5).0, [255, 0, 0]);
    assert_eq!(image.get_pixel(200, 5).0, [0, 0, 255]);
    let big = folder.path().join("big.nrrd");
    let arguments = [
        "ct",
        "tile",
        text(folder.path()),
        "--repeat-mm",
        "0.16,0.16",
        "--copies",
        "3,2",
        "--out",
        text(&big),
        "--json",
    ];
    let (printed, said) = done(&arguments);
    let json: Value = serde_json::from_str(&printed).unwrap();
    assert_eq!(json["choices"], 4);
    assert!(json["degrees_at_seams"].as_f64().unwrap() > json["degrees_within"].as_f64().unwrap());
    assert!(said.contains("96 x 64 x 4 voxels"), "{said}");
    assert!(fails(&arguments).contains("exists already"));
    let turned = folder.path().join("turned.nrrd");
    done(&[
        "ct",
        "tile",
        text(&file),
        "--turn",
        "--copies",
        "2,2",
        "--out",
        text(&turned),
    ]);
    assert_eq!(VoxelTile::read(&turned).unwrap().shape(), [128, 128, 4]);
}

#[test]
fn bad_arguments_and_files_are_answered() {
    let folder = tempfile::tempdir().unwrap();
    let (cloth, out) = (crossed(folder.path()), folder.path().join("virtual"));
    let gone = text(&cloth);
    done(&[
        "ct",
        "simulate",
        gone,
        "--voxel-um",
        "5",
        "--out",
        text(&out),
    ]);
    let orient =
        |more: &[&str]| fails(&[&["ct", "orient", text(&out), "--out", text(&out)], more].concat());
    assert!(orient(&["--exact"]).contains("--method filter or line"));
    assert!(orient(&["--eps-d", "9"]).contains("hint: Otsu"));
    assert!(orient(&["--method", "line", "--eps-j", "0"]).contains("keeps 95 %"));
    assert!(orient(&["--filter", "1,2"]).contains("--filter: expected s,t,h"));
    assert!(orient(&["--method", "filter", "--filter", "2,1,9"]).contains("s < t"));
    assert!(orient(&["--widths", "1"]).contains("GRADIENT,WINDOW"));
    // A volume has no directions, a tile of voxels is no volume.
    let csv = folder.path().join("a.csv");
    let fibers = |path: &Path, radius: &str| {
        fails(&[
            "ct",
            "fibers",
            text(path),
            "--radius-um",
            radius,
            "--out",
            text(&csv),
        ])
    };
    assert!(fibers(&out.join("volume.nrrd"), "8").contains("expected float and 4 numbers"));
    assert!(fibers(&out, "thick").contains("or auto"));
    assert!(fibers(&folder.path().join("none.nrrd"), "8").contains("cannot be opened"));
    done(&["ct", "orient", text(&out), "--out", text(&out)]);
    assert!(fibers(&out, "0.1").contains("scan finer"));
    let oriented = out.join("oriented.nrrd");
    let error = fails(&[
        "ct",
        "orient",
        text(&oriented),
        "--out",
        text(folder.path()),
    ]);
    assert!(
        error.contains("dimension 4: expected 3") && error.contains("tiles of density"),
        "{error}"
    );
    assert!(
        fails(&[
            "ct",
            "tile",
            text(&out),
            "--copies",
            "0,1",
            "--turn",
            "--out",
            "x.nrrd"
        ])
        .contains("whole numbers")
    );
    for command in ["simulate", "orient", "fibers", "tile"] {
        let (help, _) = done(&["ct", command, "--help"]);
        assert!(help.contains("Examples:"), "{command}");
    }
}
