//! `goniofit render image` writes what it prints, whole or not at all, and refuses bad input before any work.
#![allow(clippy::unwrap_used, missing_docs)]

use assert_cmd::Command;
use exr::prelude::{ReadChannels, ReadLayers};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

const PLAN: &str = "rig_configs/plans/khungurn16.toml";
const FABRIC: &str = "fabrics/bench_twill22.toml";

fn goniofit(arguments: &[&str]) -> Command {
    let mut command = Command::cargo_bin("goniofit").unwrap();
    command
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .args(arguments);
    command
}

fn json(command: &mut Command) -> Value {
    let output = command.output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{text}");
    serde_json::from_slice(&output.stdout).unwrap()
}

fn image(fabric: &str, stem: &Path, extra: &[&str]) -> Command {
    let stem = stem.to_str().unwrap();
    let base = [
        "render", "image", "--fabric", fabric, "--out", stem, "--json",
    ];
    goniofit(&[&base, extra].concat())
}

/// What an EXR file holds: columns and rows, channels, text attributes.
struct Exr {
    size: [usize; 2],
    channels: BTreeMap<String, Vec<f32>>,
    texts: BTreeMap<String, String>,
}

fn read_exr(path: &Value) -> Exr {
    let path = path.as_str().unwrap();
    let image = exr::prelude::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        .from_file(path)
        .unwrap();
    let layer = &image.layer_data;
    let channels = layer.channel_data.list.iter();
    let channels = channels.map(|c| (c.name.to_string(), c.sample_data.values_as_f32().collect()));
    let texts = layer
        .attributes
        .other
        .iter()
        .filter_map(|(name, value)| match value {
            exr::meta::attribute::AttributeValue::Text(t) => {
                Some((name.to_string(), t.to_string()))
            }
            _ => None,
        });
    Exr {
        size: [layer.size.0, layer.size.1],
        channels: channels.collect(),
        texts: texts.collect(),
    }
}

fn mean(values: &[f32]) -> f64 {
    values.iter().map(|v| f64::from(*v)).sum::<f64>() / values.len() as f64
}

#[test]
fn files_hold_the_printed_numbers_on_any_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let run = |name: &str, threads: &str| {
        let extra = [
            "--plan",
            PLAN,
            "--config",
            "5",
            "--size",
            "12x7",
            "--paths",
            "20",
            "--derivative",
            "c_tt,beta_tt.g",
            "--seed",
            "3",
        ];
        json(image(FABRIC, &folder.path().join(name), &extra).env("RAYON_NUM_THREADS", threads))
    };
    let summary = run("one", "1");
    let other = run("three", "3");
    let row = &summary["configs"][0];
    assert_eq!(row["config"], 5);
    assert_eq!(row["paths_per_pixel"], 20);
    let radiance = read_exr(&row["exr"]);
    let channels = &radiance.channels;
    assert_eq!(radiance.size, [12, 7]);
    assert_eq!(
        channels.keys().collect::<Vec<_>>(),
        ["B", "G", "R", "se.B", "se.G", "se.R"]
    );
    assert_eq!(radiance.texts["config"], "5");
    assert_eq!(
        radiance.texts["region_mm"],
        "x -5 to 5, y -5 to 5, sample frame"
    );
    for (c, name) in ["R", "G", "B"].into_iter().enumerate() {
        let se = &channels[&format!("se.{name}")];
        let square: f64 = se.iter().map(|e| f64::from(*e).powi(2)).sum();
        let [stated, error] = ["mean", "se"].map(|k| row[k][c].as_f64().unwrap());
        assert!((mean(&channels[name]) / stated - 1.0).abs() < 1e-9);
        assert!((square.sqrt() / 84.0 / error - 1.0).abs() < 1e-9);
    }
    let c_tt = read_exr(&row["derivatives"]["c_tt"]["exr"]);
    assert_eq!(c_tt.channels.len(), 6);
    assert_eq!(c_tt.texts["unit"], "1");
    let stated = row["derivatives"]["c_tt"]["mean"][2].as_f64().unwrap();
    assert!((mean(&c_tt.channels["B"]) / stated - 1.0).abs() < 1e-9);
    let beta = read_exr(&row["derivatives"]["beta_tt.g"]["exr"]);
    assert_eq!(beta.channels.keys().collect::<Vec<_>>(), ["G", "se.G"]);
    assert_eq!(beta.texts["unit"], "1/rad");
    assert_eq!(
        row["derivatives"]["beta_tt.g"]["mean"]
            .as_array()
            .unwrap()
            .len(),
        1
    );

    let read = |v: &Value| std::fs::read(v.as_str().unwrap()).unwrap();
    for place in [
        "/png",
        "/derivatives/c_tt/png",
        "/derivatives/beta_tt.g/png",
    ] {
        let [one, three] = [&summary, &other].map(|s| read(s.pointer(place).unwrap()));
        assert_eq!(one, three, "{place}");
        let picture = image::load_from_memory(&one).unwrap();
        assert_eq!([picture.width(), picture.height()], [12, 7]);
    }
    assert_eq!(*channels, read_exr(&other["configs"][0]["exr"]).channels);
    let png = read(&summary["png"]);
    assert!(png.windows(8).any(|w| w == b"exposure"));
    assert!(summary["derivatives"]["c_tt"]["scale"].as_f64().unwrap() > 0.0);
    // Nothing is replaced unasked, and everything when asked.
    let again = image(
        FABRIC,
        &folder.path().join("one"),
        &["--plan", PLAN, "--config", "5"],
    )
    .output()
    .unwrap();
    assert_eq!(again.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&again.stderr).contains("exists already"));
    assert_eq!(png, read(&summary["png"]));
    let replace = ["--plan", PLAN, "--config", "5", "--size", "3", "--force"];
    json(&mut image(FABRIC, &folder.path().join("one"), &replace));
    assert_ne!(png, read(&summary["png"]));
}

#[test]
fn all_configurations_make_one_sheet_and_a_file_each() {
    let folder = tempfile::tempdir().unwrap();
    let extra = [
        "--plan",
        PLAN,
        "--all",
        "--size",
        "8",
        "--paths",
        "2",
        "--derivative",
        "gamma_tt",
        "--exposure",
        "each",
    ];
    let summary = json(&mut image(FABRIC, &folder.path().join("s"), &extra));
    let sheet = image::open(summary["png"].as_str().unwrap()).unwrap();
    assert_eq!([sheet.width(), sheet.height()], [4 * 8 + 3 * 4; 2]);
    let configs = summary["configs"].as_array().unwrap();
    assert_eq!(configs.len(), 16);
    for row in configs {
        assert_eq!(read_exr(&row["exr"]).size, [8, 8]);
        assert!(row["exposure"].as_f64().unwrap() > 0.0);
    }
    let mut names: Vec<_> = std::fs::read_dir(folder.path())
        .unwrap()
        .map(|f| f.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    assert_eq!(names.len(), 34);
    for expected in [
        "s.png",
        "s.d_gamma_tt.png",
        "s.config_01.exr",
        "s.config_16.d_gamma_tt.exr",
    ] {
        assert!(
            names.iter().any(|n| n == expected),
            "{expected} in {names:?}"
        );
    }
}

/// A fabric of one straight fiber along x at y = 0.75 of a tile of 1 mm.
fn one_fiber(folder: &Path) -> String {
    let csv =
        "# tile_mm = [1, 1]\nx0,y0,z0,x1,y1,z1,radius_mm,yarn_system\n0,0.75,0,1,0.75,0,0.05,0\n";
    std::fs::write(folder.join("one.csv"), csv).unwrap();
    let path = folder.join("one.toml");
    std::fs::write(&path, "name = 'one'\nfibers = 'one.csv'\n").unwrap();
    path.to_str().unwrap().to_owned()
}

#[test]
fn pictures_are_upright_and_rectified() {
    let folder = tempfile::tempdir().unwrap();
    let fabric = one_fiber(folder.path());
    let run = |name: &str, extra: &[&str]| {
        let base = ["--size", "5x8", "--paths", "64"];
        let summary = json(&mut image(
            &fabric,
            &folder.path().join(name),
            &[&base, extra].concat(),
        ));
        read_exr(&summary["configs"][0]["exr"]).channels["G"].clone()
    };
    // Rows are 0.125 mm high, the topmost first: the fiber covers 0.7 to 0.8, in rows 1 and 2, from every direction along x.
    for (name, pose) in [
        ("above", "light=10,0 camera=0,0"),
        ("aslant", "light=60,180 camera=60,0"),
        ("turned", "light=60,270 camera=60,90 rotation=90"),
    ] {
        let green = run(name, &["--tile", "--pose", pose]);
        for (i, value) in green.iter().enumerate() {
            assert_eq!(
                *value > 0.0,
                (1..3).contains(&(i / 5)),
                "{name}, pixel {i}: {green:?}"
            );
        }
    }
    let pose = ["--pose", "light=20,0 camera=0,0"];
    let tile = run("tile", &[&pose[..], &["--tile"]].concat());
    let crop = run(
        "crop",
        &[&pose[..], &["--crop", "1", "--center", "0.5,0.5"]].concat(),
    );
    assert_eq!(tile, crop);
    let below = run(
        "below",
        &[&pose[..], &["--crop", "1x0.5", "--center", "0.5,-0.75"]].concat(),
    );
    assert!(below.iter().all(|v| *v == 0.0));
}

#[test]
fn poses_and_surroundings_can_be_given_instead_of_files() {
    let folder = tempfile::tempdir().unwrap();
    let plan = folder.path().join("plan.toml");
    let text = "name = 'p'\n[[configurations]]\nconfig = 1\nlight_theta_deg = 40\nlight_phi_deg = 90\n\
                camera_theta_deg = 32\ncamera_phi_deg = 0\nrotation_deg = 45\n";
    std::fs::write(&plan, text).unwrap();
    let means = |extra: &[&str]| {
        let base = [
            "render", "means", "--fabric", FABRIC, "--json", "--paths", "2000",
        ];
        let result = json(&mut goniofit(&[&base, extra].concat()));
        let green = result["configs"][0]["mean"][1].as_f64().unwrap();
        (green, result["configs"].clone())
    };
    let pose = "light=40,90 camera=32,0 rotation=45";
    let plain = means(&["--plan", plan.to_str().unwrap()]);
    assert_eq!(plain, means(&["--pose", pose]));
    let said = [
        "--pose",
        pose,
        "--light-size",
        "100",
        "--light-distance",
        "610",
    ];
    let said = [
        &said[..],
        &[
            "--sample-square",
            "10",
            "--plate",
            "black",
            "--view",
            "ortho",
        ],
    ]
    .concat();
    assert_eq!(plain, means(&said));
    assert_eq!(
        plain,
        means(&["--pose", pose, "--rig", "rig_configs/virtual.toml"])
    );
    let two = means(&["--pose", pose, "--pose", "light=1,0 camera=2,0"]).1;
    assert_eq!(two[1]["config"], 2);
    // Each of the others is another scene.
    let others = [
        ["--plate", "white"],
        ["--plate", "open"],
        ["--plate", "0.2,0.9,0.4"],
        ["--light-size", "300"],
        ["--light-distance", "200"],
        ["--sample-square", "0.4"],
        ["--view", "pinhole:30"],
    ];
    for other in others {
        let changed = means(&[&["--pose", pose], &other[..]].concat());
        // A black plate and none differ only in light from below.
        assert_eq!(changed.1 == plain.1, other[1] == "open", "{other:?}");
    }
    // A diffuse surface far from the fiber has its albedo times the light's cosine; the light's size changes less than 1 %.
    let fabric = one_fiber(folder.path());
    let extra = ["--tile", "--pose", pose, "--size", "16", "--plate", "0.5"];
    let summary = json(&mut image(&fabric, &folder.path().join("plate"), &extra));
    let green = &read_exr(&summary["configs"][0]["exr"]).channels["G"];
    let bottom = mean(&green[15 * 16..]);
    assert!(
        (bottom / (0.5 * 40_f64.to_radians().cos()) - 1.0).abs() < 0.02,
        "{bottom}"
    );
}

#[test]
fn an_interrupt_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let stem = folder.path().join("never");
    let arguments = [
        "render",
        "image",
        "--fabric",
        FABRIC,
        "--plan",
        PLAN,
        "--all",
        "--size",
        "2",
        "--paths",
        "100000000",
        "--derivative",
        "all",
        "--out",
    ];
    let child = std::process::Command::new(assert_cmd::cargo::cargo_bin("goniofit"))
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .args(arguments)
        .arg(&stem)
        .stderr(std::process::Stdio::piped())
        .stdout(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    let id = Pid::from_raw(child.id().cast_signed()).unwrap();
    // Well into the first pixels: a pixel would take hours.
    std::thread::sleep(Duration::from_secs(4));
    kill_process(id, Signal::INT).unwrap();
    let output = child.wait_with_output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(text.contains("interrupted"), "{text}");
    assert!(output.stdout.is_empty());
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn bad_input_is_refused_before_any_work() {
    let folder = tempfile::tempdir().unwrap();
    let fabric = one_fiber(folder.path());
    let stem = folder.path().join("out");
    let refused = |out: &Path, extra: &[&str], expected: &[&str]| {
        let output = image(&fabric, out, extra).output().unwrap();
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{extra:?}: {text}");
        for e in expected {
            assert!(text.contains(e), "{extra:?}: {text}");
        }
        assert!(output.stdout.is_empty());
    };
    let one = ["--pose", "light=20,0 camera=0,0"];
    let with = |extra: &[&str], expected: &[&str]| {
        refused(&stem, &[&one, extra].concat(), expected);
    };
    with(
        &["--derivative", "c_t"],
        &["unknown parameter 'c_t'", "hint: known: c_r, c_tt, beta_r"],
    );
    with(
        &["--config", "3"],
        &["no configuration 3", "those that exist: 1"],
    );
    with(&["--size", "0"], &["'0' is not a number of pixels"]);
    with(&["--size", "100000x100000"], &["at most"]);
    with(
        &["--paths", "1"],
        &["1 paths per pixel are too few", "hint:"],
    );
    with(&["--crop=-1"], &["'-1' is not a positive number"]);
    with(&["--crop", "1", "--tile"], &["cannot be used with"]);
    with(&["--center", "1,1"], &["--crop"]);
    with(&["--exposure", "0"], &["'0' is not auto"]);
    with(&["--plate", "gray"], &["'gray' is not black"]);
    with(&["--view", "pinhole:0"], &["'0' is not a positive number"]);
    with(
        &["--light-size", "nan"],
        &["'nan' is not a positive number"],
    );
    with(&["--plan", PLAN], &["cannot be used with"]);
    refused(&stem, &["--plan", PLAN], &["which of the 16", "1, 2, 3"]);
    refused(
        &stem,
        &["--plan", PLAN, "--config", "17"],
        &["no configuration 17", "14, 15, 16"],
    );
    refused(&stem, &[], &["--plan", "--pose"]);
    refused(
        &stem,
        &["--pose", "light=95,0 camera=0,0"],
        &["light_theta_deg is 95"],
    );
    refused(&stem, &["--pose", "light=5,0"], &["camera is missing"]);
    refused(
        folder.path(),
        &one,
        &["expected the beginning of file names"],
    );
    refused(
        &folder.path().join("one.csv").join("x"),
        &one,
        &["one.csv", "cannot be written"],
    );
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2);
}
