//! Rows of Mitsuba 3 and the fast renderer side by side, from the script that holds their means against each other.

use super::{Row, root};
use serde_json::Value;
use std::process::Command;

/// Rows for model `chiang`, one total per renderer; none, with the reason on stderr, when Mitsuba cannot be run. The quick
/// form takes one pose of the script's own small cloth.
pub(super) fn rows(quick: bool) -> Vec<Row> {
    let Ok(python) = std::env::var("GONIOFIT_MITSUBA") else {
        eprintln!("no mitsuba rows: GONIOFIT_MITSUBA names no Python that has mitsuba");
        return Vec::new();
    };
    let script = root().join("tests/peer/mitsuba/compare.py");
    if !script.exists() {
        eprintln!("no mitsuba rows: {} is missing", script.display());
        return Vec::new();
    }
    let mut command = Command::new(python);
    command.arg(script).args(["--json", "--goniofit"]);
    command.arg(env!("CARGO_BIN_EXE_goniofit"));
    if quick {
        command.args(["--seconds", "5", "--configs", "1"]);
    } else {
        command.arg("--fabric");
        command.arg(root().join("fabrics/bench_twill22.toml"));
        command.arg("--plan");
        command.arg(root().join("rig_configs/plans/khungurn16.toml"));
        command.args(["--seconds", "6"]);
    }
    match command.output() {
        Err(error) => {
            eprintln!("no mitsuba rows: {error}");
            Vec::new()
        }
        Ok(done) if !done.status.success() => {
            let why = String::from_utf8_lossy(&done.stderr);
            eprintln!("no mitsuba rows: {}", why.lines().last().unwrap_or(""));
            Vec::new()
        }
        Ok(done) => {
            let text = String::from_utf8_lossy(&done.stdout);
            let objects = text.lines().filter_map(|l| serde_json::from_str(l).ok());
            objects.filter_map(|v| total(&v, quick)).collect()
        }
    }
}

/// A total over the script's configurations as a row; its error is what its CPU seconds to 1 % say.
fn total(v: &Value, quick: bool) -> Option<Row> {
    let (cpu_s, to_one) = (v["cpu_s"].as_f64()?, v["cpu_s_for_1pct"].as_f64()?);
    let renderer = match (v["config"].as_str()?, v["renderer"].as_str()?) {
        ("total", "goniofit") => "fast, apart",
        ("total", "goniofit together") => "fast",
        ("total", other) => other,
        _ => return None,
    };
    Some(Row {
        fabric: "chiang".to_owned(),
        renderer: renderer.to_owned(),
        model: "chiang".to_owned(),
        effort: if quick { "one pose" } else { "all poses" }.to_owned(),
        seed: 1,
        runs: 1,
        cpu_s,
        error_stated: 0.01 * (to_one / cpu_s).sqrt(),
        error_actual: None,
        cpu_s_for_1pct: to_one,
        prototype_ratio: None,
        paths_per_s_core: None,
        mrays_closest: None,
        mrays_any: None,
        derivatives: renderer != "mitsuba",
        configurations: Vec::new(),
    })
}
