//! The main job end to end through the commands: simulate a small session, measure it, fit it, look at the files; and
//! the recorded session in `mocks/` against its truth. Bad input anywhere gives exit code 2, a hint, and no file.
#![allow(clippy::unwrap_used, missing_docs)]

#[path = "common/command.rs"]
mod command;

use command::{goniofit, text};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// A coarse open weave, four poses, four numbers each: seconds instead of minutes.
fn small_inputs(folder: &Path) -> [PathBuf; 3] {
    let fabric = folder.join("net.csv");
    // A pitch that has no common measure with the camera's pixels (14 per millimeter): what falls exactly on the raster of the
    // color filters cannot be told from the mean.
    let mut csv =
        String::from("# tile_mm = [0.97, 0.97]\nx0,y0,z0,x1,y1,z1,radius_mm,yarn_system\n");
    for i in 0..10 {
        let at = 0.097 * (f64::from(i) + 0.5);
        csv += &format!("0,{at},0.05,0.97,{at},0.05,0.04,1\n{at},0,-0.05,{at},0.97,-0.05,0.04,0\n");
    }
    std::fs::write(&fabric, csv).unwrap();
    let plan = folder.join("plan.toml");
    let mut toml = String::from("name = 'four'\n");
    for (id, tl, pl, tc, rotation) in [
        (1, 32, 180, 32, 0),
        (2, 50, 90, 30, 0),
        (3, 40, 180, 50, 90),
        (4, 20, 0, 10, 0),
    ] {
        toml += &format!(
            "[[configurations]]\nconfig = {id}\nlight_theta_deg = {tl}.0\nlight_phi_deg = {pl}.0\ncamera_theta_deg = {tc}.0\n\
             camera_phi_deg = 0.0\nrotation_deg = {rotation}.0\n"
        );
    }
    std::fs::write(&plan, toml).unwrap();
    let parameters = folder.join("p.json");
    let p = r#"{"c_r":[0.2,0.1,0.05],"c_tt":[0.7,0.5,0.3],"beta_r_deg":8,"beta_tt_deg":25,"gamma_tt_deg":30}"#;
    std::fs::write(&parameters, p).unwrap();
    [fabric, plan, parameters]
}

fn simulate(folder: &Path) -> PathBuf {
    let [fabric, plan, parameters] = small_inputs(folder);
    let session = folder.join("session");
    let (code, out, err) = goniofit(&[
        "simulate",
        "--fabric",
        text(&fabric),
        "--plan",
        text(&plan),
        "--params",
        text(&parameters),
        "--accuracy",
        "4%",
        "--texels",
        "12",
        "--texel-paths",
        "8",
        "--out",
        text(&session),
        "--json",
    ]);
    assert_eq!(code, 0, "{err}");
    let summary: Value = serde_json::from_str(&out).unwrap();
    assert_eq!(summary["synthetic"], true);
    session
}

#[test]
fn simulate_measure_fit_report_work_together() {
    let folder = tempfile::tempdir().unwrap();
    let session = simulate(folder.path());
    let (code, out, err) = goniofit(&["measure", "session", text(&session), "--json"]);
    assert_eq!(code, 0, "{err}");
    assert!(serde_json::from_str::<Value>(&out).is_ok(), "{out}");

    // The measured means are the true ones within five stated errors (12 numbers; the weave's texture included).
    let truth: Value =
        serde_json::from_str(&std::fs::read_to_string(session.join("truth.json")).unwrap())
            .unwrap();
    let csv = session.join("measurements.csv");
    let measured = goniofit::session::Measurements::read(&csv).unwrap();
    for (row, truth) in measured
        .intensities
        .iter()
        .zip(truth["configs"].as_array().unwrap())
    {
        for c in 0..3 {
            let expected = truth["mean"][c].as_f64().unwrap();
            let z = (row.mean[c] - expected) / row.standard_error[c];
            assert!(
                z.abs() < 5.0,
                "{} +- {} against {expected}",
                row.mean[c],
                row.standard_error[c]
            );
        }
    }

    let fabric = folder.path().join("net.csv");
    let out = folder.path().join("fit");
    let arguments = [
        "fit",
        "--measurements",
        text(&csv),
        "--fabric",
        text(&fabric),
        "--paths",
        "60000",
        "--seed",
        "3",
        "--out",
        text(&out),
        "--json",
    ];
    let (code, stdout, err) = goniofit(&arguments);
    assert!(code == 0 || code == 1, "{err}");
    let fit: Value = serde_json::from_str(&stdout).unwrap();
    assert_eq!(fit["configs"].as_array().unwrap().len(), 4);
    assert_eq!(fit["synthetic"], true);
    for key in [
        "parameters",
        "objective",
        "uncertainty",
        "not_determined",
        "converged",
        "seed",
        "versions",
        "time",
    ] {
        assert!(!fit[key].is_null(), "{key} is missing");
    }
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(page.contains("SYNTHETIC") || page.contains("synthetic"));

    // The same command again touches nothing; with --force it gives the same numbers.
    let (code, _, err) = goniofit(&arguments);
    assert!(
        code == 2 && err.contains("exists already") && err.contains("hint:"),
        "{err}"
    );
    let forced = goniofit(&[&arguments[..], &["--force"]].concat());
    let again: Value = serde_json::from_str(&forced.1).unwrap();
    assert_eq!(again["parameters"], fit["parameters"]);
    let remade = folder.path().join("again.html");
    assert_eq!(
        goniofit(&["report", text(&out), "--out", text(&remade)]).0,
        0
    );
    assert!(remade.exists());
}

#[test]
fn damaged_sessions_are_refused_and_nothing_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let session = simulate(folder.path());
    let refused = |expected: &str| {
        let (code, out, err) = goniofit(&["measure", "session", text(&session)]);
        assert_eq!(code, 2, "{err}");
        assert!(
            err.contains(expected) && err.contains("hint:") && out.is_empty(),
            "{err}"
        );
        assert!(!session.join("measurements.csv").exists());
    };
    let frames: Vec<PathBuf> = {
        let mut all: Vec<PathBuf> = std::fs::read_dir(session.join("frames"))
            .unwrap()
            .map(|e| e.unwrap().path())
            .collect();
        all.sort();
        all
    };
    let sample = frames
        .iter()
        .find(|f| text(f).contains("sample_c02"))
        .unwrap();
    let whole = std::fs::read(sample).unwrap();

    std::fs::remove_file(sample).unwrap();
    refused(sample.file_name().unwrap().to_str().unwrap());
    std::fs::write(sample, &whole[..whole.len() / 2]).unwrap();
    refused(sample.file_name().unwrap().to_str().unwrap());
    std::fs::write(sample, &whole).unwrap();

    let journal = session.join("journal.jsonl");
    let text_before = std::fs::read_to_string(&journal).unwrap();
    std::fs::write(
        &journal,
        text_before.replacen("\"sequence\":3", "\"sequence\":x", 1),
    )
    .unwrap();
    refused("line 4 is damaged");
    std::fs::write(&journal, &text_before).unwrap();

    let manifest = session.join("session.json");
    let manifest_before = std::fs::read_to_string(&manifest).unwrap();
    std::fs::write(
        &manifest,
        manifest_before.replacen("\"width\": 240", "\"width\": 250", 1),
    )
    .unwrap();
    refused("240");
    std::fs::write(&manifest, &manifest_before).unwrap();

    // A torn last journal line is what a crash leaves: the shots before it still count.
    std::fs::write(&journal, &text_before[..text_before.len() - 10]).unwrap();
    assert_eq!(goniofit(&["measure", "session", text(&session)]).0, 0);
}

#[test]
fn bad_measurements_and_folders_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let [fabric, ..] = small_inputs(folder.path());
    let csv = folder.path().join("m.csv");
    let head = "config,light_theta_deg,light_phi_deg,camera_theta_deg,camera_phi_deg,rotation_deg,r,g,b,r_se,g_se,b_se\n";
    let out = folder.path().join("fit");
    let refused = |body: &str, extra: &[&str], expected: &str| {
        std::fs::write(&csv, format!("{head}{body}")).unwrap();
        let base = [
            "fit",
            "--measurements",
            text(&csv),
            "--fabric",
            text(&fabric),
            "--out",
            text(&out),
        ];
        let (code, _, err) = goniofit(&[&base[..], extra].concat());
        assert!(
            code == 2 && err.contains(expected) && err.contains("hint:"),
            "{code} {err}"
        );
        assert!(!out.join("fit.json").exists());
    };
    let good = "1,32,180,32,0,0,0.1,0.1,0.1,0.01,0.01,0.01\n";
    refused(
        "1,32,180,32,0,0,NaN,0.1,0.1,0.01,0.01,0.01\n",
        &[],
        "r is NaN",
    );
    refused(
        "1,32,180,32,0,0,0.1,-0.1,0.1,0.01,0.01,0.01\n",
        &[],
        "g is -0.1",
    );
    refused(
        "1,95,180,32,0,0,0.1,0.1,0.1,0.01,0.01,0.01\n",
        &[],
        "light_theta_deg is 95",
    );
    refused(good, &["--model", "marschner"], "unknown model 'marschner'");

    let (code, _, err) = goniofit(&["measure", "session", text(folder.path())]);
    assert!(
        code == 2 && err.contains("holds no session") && err.contains("hint:"),
        "{err}"
    );
    std::fs::create_dir_all(&out).unwrap();
    std::fs::write(out.join("mine.txt"), "precious").unwrap();
    let (code, _, err) = goniofit(&["demo", "--out", text(&out)]);
    assert!(
        code == 2 && err.contains("was not made by the demo"),
        "{err}"
    );
    assert!(out.join("mine.txt").exists());
}

#[test]
fn the_recorded_session_measures_to_its_truth() {
    let recorded = Path::new(env!("CARGO_MANIFEST_DIR")).join("mocks/khungurn16_gabardine");
    let folder = tempfile::tempdir().unwrap();
    let csv = folder.path().join("m.csv");
    let (code, _, err) = goniofit(&["measure", "session", text(&recorded), "--out", text(&csv)]);
    assert_eq!(code, 0, "{err}");
    let measured = goniofit::session::Measurements::read(&csv).unwrap();
    let truth: Value =
        serde_json::from_str(&std::fs::read_to_string(recorded.join("truth.json")).unwrap())
            .unwrap();
    assert!(
        truth["weighted_rms_se"].as_f64().unwrap() <= 0.003,
        "the truth is known to 0.3 %"
    );
    let (mut sum, mut wrong) = (0.0, 0.0);
    for (row, truth) in measured
        .intensities
        .iter()
        .zip(truth["configs"].as_array().unwrap())
    {
        for c in 0..3 {
            let pull = |m: f64| (m - truth["mean"][c].as_f64().unwrap()) / row.standard_error[c];
            sum += pull(row.mean[c]).powi(2);
            // Negative control: everything 5 % too bright.
            wrong += pull(1.05 * row.mean[c]).powi(2);
        }
    }
    // Mean square pull of 48 numbers that share the white standard's and the frames' errors: 1 expected.
    assert!(sum / 48.0 < 3.0, "mean square pull {}", sum / 48.0);
    assert!(
        wrong / 48.0 > 3.0,
        "the comparison cannot see 5 %: {}",
        wrong / 48.0
    );
}
