//! Promise: `goniofit scatter` gives the numbers of the model with round-trip precision, and says what is wrong with its
//! input.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use assert_cmd::Command;
use serde_json::{Value, json};
use std::path::PathBuf;

const DEFAULTS: &str = r#"{"c_r": [0.1, 0.1, 0.1], "c_tt": [0.85, 0.85, 0.85], "beta_r_deg": 5, "beta_tt_deg": 10,
    "gamma_tt_deg": 10}"#;
const HEADER: &str = "theta_i_deg,phi_i_deg,theta_o_deg,phi_o_deg";

struct Folder(tempfile::TempDir);

struct Ran {
    code: i32,
    out: String,
    err: String,
}

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn file(&self, name: &str, text: &str) -> PathBuf {
        let path = self.0.path().join(name);
        std::fs::write(&path, text).unwrap();
        path
    }

    fn eval(&self, params: &str, directions: &str, more: &[&str]) -> Ran {
        let params = self.file("P.json", params);
        let directions = self.file("D.csv", directions);
        run(|c| {
            c.args(["eval", "--model", "khungurn", "--params"])
                .arg(&params);
            c.arg("--directions").arg(&directions).args(more);
        })
    }
}

fn run(build: impl FnOnce(&mut Command)) -> Ran {
    let mut command = Command::cargo_bin("goniofit").unwrap();
    command.arg("scatter");
    build(&mut command);
    let output = command.output().unwrap();
    Ran {
        code: output.status.code().unwrap(),
        out: String::from_utf8(output.stdout).unwrap(),
        err: String::from_utf8(output.stderr).unwrap(),
    }
}

fn golden() -> Vec<Value> {
    let file: Value = serde_json::from_str(include_str!("data/khungurn_bcsdf.json")).unwrap();
    file["rows"].as_array().unwrap().clone()
}

/// The worst error over the rows through the command, in units of `1e-9 max(|S|, |dS|) + 1e-30`.
fn worst_error(rows: &[Value], directions: impl Fn(&Value) -> String) -> f64 {
    let folder = Folder::new();
    let mut worst = 0.0_f64;
    for row in rows {
        let params = json!({"c_r": row[5], "c_tt": row[6], "beta_r_deg": row[7],
            "beta_tt_deg": row[8], "gamma_tt_deg": row[9]});
        let ran = folder.eval(&params.to_string(), &directions(row), &["--derivatives"]);
        assert_eq!(ran.code, 0, "{}", ran.err);
        let mut lines = ran.out.lines();
        let names: Vec<&str> = lines.next().unwrap().split(',').collect();
        let cells: Vec<f64> = lines
            .next()
            .unwrap()
            .split(',')
            .map(|c| c.parse().unwrap())
            .collect();
        assert_eq!(lines.next(), None);
        for (k, prefix) in [
            "s",
            "d_c_r",
            "d_c_tt",
            "d_beta_r",
            "d_beta_tt",
            "d_gamma_tt",
        ]
        .iter()
        .enumerate()
        {
            for (c, channel) in ["r", "g", "b"].iter().enumerate() {
                let name = format!("{prefix}_{channel}");
                let found = cells[names.iter().position(|n| *n == name).unwrap()];
                let (s, expected) = (
                    row[10][c].as_f64().unwrap(),
                    row[10 + k][c].as_f64().unwrap(),
                );
                let tolerance = 1e-9 * s.abs().max(expected.abs()) + 1e-30;
                worst = worst.max((found - expected).abs() / tolerance);
            }
        }
    }
    worst
}

#[test]
fn the_command_gives_the_30_digit_values() {
    let rows = golden();
    let plain = |r: &Value| format!("{HEADER}\n{},{},{},{}\n", r[1], r[2], r[3], r[4]);
    let worst = worst_error(&rows, plain);
    println!(
        "{} rows, worst error {worst:.1e} of the tolerance",
        rows.len()
    );
    assert!(worst <= 1.0, "{worst}");
    // Columns by name, in another order and among others.
    let shuffled = |r: &Value| {
        format!(
            "# note\nphi_o_deg, theta_o_deg, name, theta_i_deg, phi_i_deg\n{},{}, x ,{},{}\n",
            r[4], r[3], r[1], r[2]
        )
    };
    assert!(worst_error(&rows[..5], shuffled) <= 1.0);
    // Control: light and camera exchanged.
    let exchanged = |r: &Value| format!("{HEADER}\n{},{},{},{}\n", r[3], r[4], r[1], r[2]);
    assert!(worst_error(&rows[..5], exchanged) > 1e3);
}

#[test]
fn without_derivatives_there_are_three_columns_and_tiny_values_survive() {
    let ran = Folder::new().eval(DEFAULTS, &format!("{HEADER}\n80,0,70,0\n0,0,0,180\n"), &[]);
    let lines: Vec<&str> = ran.out.lines().collect();
    assert_eq!(lines.len(), 3);
    assert_eq!(lines[0], "s_r,s_g,s_b");
    let first: f64 = lines[1].split(',').next().unwrap().parse().unwrap();
    assert!(first > 0.0 && first < 1e-20, "{first:e}");
    assert_eq!(ran.err, "");
}

#[test]
fn bad_input_is_named_and_nothing_is_printed() {
    let folder = Folder::new();
    let row = |cells: &str| format!("{HEADER}\n0,0,0,180\n{cells}\n");
    let good = row("1,2,3,4");
    let without_gamma = r#"{"c_r": [0.1, 0.1, 0.1], "c_tt": [0.85, 0.85, 0.85], "beta_r_deg": 5, "beta_tt_deg": 10}"#;
    let cases = [
        (
            DEFAULTS,
            row("NaN,0,0,0"),
            "row 2: theta_i_deg is 'NaN', expected a longitudinal angle from -90 to 90",
        ),
        (
            DEFAULTS,
            row("0,0,90.001,0"),
            "row 2: theta_o_deg is '90.001'",
        ),
        (
            DEFAULTS,
            row("0,inf,0,0"),
            "row 2: phi_i_deg is 'inf', expected a finite number",
        ),
        (DEFAULTS, row("0,,0,0"), "row 2: phi_i_deg is ''"),
        (DEFAULTS, row("0,0,0"), "row 2 cannot be read"),
        (
            DEFAULTS,
            "theta_i_deg,phi_i_deg,theta_o_deg\n0,0,0\n".into(),
            "column 'phi_o_deg' is missing",
        ),
        (DEFAULTS, String::new(), "column 'theta_i_deg' is missing"),
        (without_gamma, good.clone(), "'gamma_tt_deg' is missing"),
        ("{\"c_r\": ", good.clone(), "P.json: EOF"),
        (
            &DEFAULTS.replace("\"beta_r_deg\": 5", "\"beta_r_deg\": 0"),
            good.clone(),
            "'beta_r_deg' is 0, expected 0.01 to 360",
        ),
        (
            &DEFAULTS.replace("[0.1, 0.1, 0.1]", "[0.1, 0.1, -0.1]"),
            good,
            "'c_r' is -0.1",
        ),
    ];
    for (params, directions, message) in cases {
        let ran = folder.eval(params, &directions, &[]);
        assert_eq!(
            (ran.code, ran.out.as_str()),
            (2, ""),
            "{message}: {}",
            ran.err
        );
        assert!(
            ran.err.starts_with("error: ") && ran.err.contains(message),
            "{message}: {}",
            ran.err
        );
    }
    let ran = run(|c| {
        c.args([
            "eval",
            "--model",
            "khungurm",
            "--params",
            "P.json",
            "--directions",
            "D.csv",
        ]);
    });
    assert_eq!(ran.code, 2);
    assert!(
        ran.err
            .contains("unknown model 'khungurm'\nhint: known models: khungurn, chiang"),
        "{}",
        ran.err
    );
}

#[test]
fn the_list_is_json_whose_defaults_are_a_parameter_file() {
    let ran = run(|c| {
        c.args(["list", "--json"]);
    });
    let list: Value = serde_json::from_str(&ran.out).unwrap();
    let model = &list["models"][0];
    assert_eq!(model["name"], "khungurn");
    let beta = model["parameters"]
        .as_array()
        .unwrap()
        .iter()
        .find(|p| p["key"] == "beta_tt_deg")
        .unwrap();
    assert_eq!(
        (&beta["lower"], &beta["upper"], &beta["default"]),
        (&json!(10.0), &json!(45.0), &json!(10.0))
    );
    let ran = Folder::new().eval(
        &model["defaults"].to_string(),
        &format!("{HEADER}\n0,0,0,180\n"),
        &[],
    );
    assert_eq!(ran.code, 0, "{}", ran.err);
}

#[test]
fn the_column_h_reaches_the_near_field_model_alone() {
    let folder = Folder::new();
    let params = folder.file(
        "P.json",
        r#"{"color": [0.1, 0.9, 0.5], "beta_m": 0.3, "beta_n": 0.2}"#,
    );
    let chiang = |name: &str, text: &str| {
        let directions = folder.file(name, text);
        run(|c| {
            c.args(["eval", "--model", "chiang", "--derivatives", "--params"])
                .arg(&params)
                .arg("--directions")
                .arg(&directions);
        })
    };
    let (row, with) = ("20,10,-15,170", format!("h,{HEADER}"));
    let ran = chiang(
        "D.csv",
        &format!("{with}\n0.6,{row}\n-0.6,{row}\n0,{row}\n"),
    );
    let lines: Vec<&str> = ran.out.lines().collect();
    assert_eq!(lines.len(), 4, "{}", ran.err);
    assert!(lines[0].ends_with("d_beta_n_r,d_beta_n_g,d_beta_n_b"));
    assert!(lines[1] != lines[2] && lines[2] != lines[3]);
    let without = chiang("E.csv", &format!("{HEADER}\n{row}\n"));
    assert_eq!(without.out.lines().nth(1), Some(lines[3]));
    let ran = chiang("F.csv", &format!("{with}\n1.01,{row}\n"));
    assert_eq!((ran.code, ran.out.as_str()), (2, ""));
    assert!(
        ran.err
            .contains("row 1: h is '1.01', expected a number from -1 to 1"),
        "{}",
        ran.err
    );
    let far = |h: f64| {
        let text = format!("{HEADER},h\n{row},{h}\n");
        folder.eval(DEFAULTS, &text, &[]).out
    };
    assert_eq!(far(0.7), far(-0.2));
}

#[test]
fn a_clear_hair_returns_all_light_in_the_albedo_table() {
    let folder = Folder::new();
    let params = folder.file(
        "P.json",
        r#"{"color": [1, 0.5, 0], "beta_m": 0.4, "beta_n": 0.4}"#,
    );
    let ran = run(|c| {
        c.args([
            "albedo",
            "--model",
            "chiang",
            "--step-deg",
            "45",
            "--params",
        ])
        .arg(&params);
    });
    let line = ran
        .out
        .lines()
        .nth(2)
        .unwrap_or_else(|| panic!("{}", ran.err));
    let cells: Vec<f64> = line.split(',').map(|c| c.parse().unwrap()).collect();
    assert_eq!(cells[0], 45.0);
    assert!((cells[4] - 1.0).abs() < 1e-6, "{line}");
    assert!(
        cells[6] < 0.2 && cells[6] < cells[5] && cells[5] < cells[4],
        "{line}"
    );
}

#[test]
fn the_albedo_table_shows_the_asymmetry() {
    let folder = Folder::new();
    let wide = r#"{"c_r": [0, 0, 0], "c_tt": [1, 1, 0.5], "beta_r_deg": 5, "beta_tt_deg": 45, "gamma_tt_deg": 45}"#;
    let params = folder.file("P.json", wide);
    let ran = run(|c| {
        c.args([
            "albedo",
            "--model",
            "khungurn",
            "--step-deg",
            "45",
            "--json",
            "--params",
        ])
        .arg(&params);
    });
    let table: Value = serde_json::from_str(&ran.out).unwrap_or_else(|_| panic!("{}", ran.err));
    let first = &table["rows"][0];
    let near = |v: &Value, x: f64| (v.as_f64().unwrap() - x).abs() < 0.005;
    assert!(
        near(&first["albedo"][0], 0.99986) && near(&first["albedo"][2], 0.49993),
        "{first}"
    );
    assert!(near(&first["reverse"][0], 1.13), "{first}");
    assert_eq!(table["rows"].as_array().unwrap().len(), 3);
}
