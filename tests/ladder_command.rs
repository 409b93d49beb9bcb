//! Promise: `goniofit fit --model auto` says which model the measurements need, in a table, JSON and a page; the exit code says whether it
//! is good enough; one model can be asked for by name.
#![allow(clippy::unwrap_used, missing_docs)]

use assert_cmd::Command;
use serde_json::Value;
use std::path::Path;

const DATA: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/tests/data/khungurn16_gabardine_measurements.csv"
);
const FABRIC: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/fabrics/gabardine.toml");

fn fit(measurements: &str, out: &Path, extra: &[&str]) -> std::process::Output {
    let fixed = [
        "fit",
        "--measurements",
        measurements,
        "--fabric",
        FABRIC,
        "--out",
        out.to_str().unwrap(),
    ];
    Command::cargo_bin("goniofit")
        .unwrap()
        .args([&fixed, extra].concat())
        .output()
        .unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

/// A perfect diffuser with errors of 1 %.
fn diffuser(folder: &Path) -> String {
    let csv = std::fs::read_to_string(DATA).unwrap();
    let mut lines = Vec::new();
    for line in csv.lines() {
        let cells: Vec<&str> = line.split(',').collect();
        let Ok(theta) = cells.get(1).unwrap_or(&"").parse::<f64>() else {
            lines.push(line.to_owned());
            continue;
        };
        let mean = 0.4 * theta.to_radians().cos();
        // Off by half the error, up and down in turn.
        let off = if lines.len() % 2 == 0 { 1.005 } else { 0.995 };
        let (m, se) = (mean * off, 0.01 * mean);
        let pose = cells[..6].join(",");
        lines.push(format!("{pose},{m},{m},{m},{se},{se},{se}"));
    }
    let path = folder.join("diffuser.csv");
    std::fs::write(&path, lines.join("\n") + "\n").unwrap();
    path.to_str().unwrap().to_owned()
}

#[test]
fn a_diffuser_needs_no_more_than_lambert() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let made = fit(&diffuser(folder.path()), &out, &["--model", "auto"]);
    let table = text(&made.stdout);
    assert_eq!(made.status.code(), Some(0), "{table}{}", text(&made.stderr));
    assert!(
        table.contains("chosen, good enough")
            && table.contains("not tried: lambert reaches the noise"),
        "{table}"
    );
    assert!(table.contains("Use lambert"), "{table}");
    let json: Value =
        serde_json::from_str(&std::fs::read_to_string(out.join("ladder.json")).unwrap()).unwrap();
    assert_eq!(json["choice"]["model"], "lambert");
    assert_eq!(json["steps"].as_array().unwrap().len(), 6);
    let page = std::fs::read_to_string(out.join("ladder.html")).unwrap();
    assert!(page.contains("Use lambert") && page.contains("khungurn"));
    // Nothing is replaced unasked.
    let again = fit(&diffuser(folder.path()), &out, &["--model", "auto"]);
    assert_eq!(again.status.code(), Some(2));
    assert!(text(&again.stderr).contains("exists already"));
}

/// Fibers are no surface: the path-traced rung is tried, with the paths given.
#[test]
fn fibers_are_fitted_by_following_paths_when_no_formula_is_good_enough() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let made = fit(
        DATA,
        &out,
        &["--model", "auto", "--paths", "60000", "--json"],
    );
    let json: Value =
        serde_json::from_slice(&made.stdout).unwrap_or_else(|_| panic!("{}", text(&made.stderr)));
    let steps = json["steps"].as_array().unwrap();
    let last = &steps[5];
    assert_eq!(last["model"], "khungurn");
    assert!(last["evidence"]["residual"].is_f64(), "{last}");
    assert!(out.join("khungurn/fit.json").exists() && out.join("khungurn/renders.jsonl").exists());
    let adequate = json["choice"]["adequate"].as_bool().unwrap();
    assert_eq!(made.status.code(), Some(i32::from(!adequate)));
}

#[test]
fn one_model_can_be_asked_for_and_wrong_options_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let one = fit(
        DATA,
        &folder.path().join("one"),
        &["--model", "woven-9", "--segments", "denim", "--json"],
    );
    let json: Value =
        serde_json::from_slice(&one.stdout).unwrap_or_else(|_| panic!("{}", text(&one.stderr)));
    assert_eq!(json["steps"].as_array().unwrap().len(), 1);
    assert_eq!(json["choice"]["model"], "woven-9");
    for (extra, expected) in [
        (
            vec!["--model", "auto", "--segments", "jersey"],
            "neither a published fabric",
        ),
        (
            vec!["--model", "auto", "--loss", "huber:2"],
            "--loss does not go with --model auto",
        ),
        (vec!["--all-rungs"], "belong to --model auto"),
        (vec!["--model", "woven-8"], "unknown model 'woven-8'"),
    ] {
        let made = fit(DATA, &folder.path().join("wrong"), &extra);
        let error = text(&made.stderr);
        assert!(
            made.status.code() == Some(2) && error.contains(expected),
            "{error}"
        );
    }
}
