//! `goniofit render means` prints what scripts rely on, reproducibly, and refuses bad input with a hint and exit code 2.
#![allow(clippy::unwrap_used, missing_docs)]

use assert_cmd::Command;
use serde_json::Value;
use std::path::Path;

const PLAN: &str = "rig_configs/plans/khungurn16.toml";
const FABRIC: &str = "fabrics/bench_twill22.toml";

fn goniofit(arguments: &[&str]) -> Command {
    let mut command = Command::cargo_bin("goniofit").unwrap();
    command
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .args(arguments);
    command
}

fn means(extra: &[&str]) -> Value {
    let base = [
        "render", "means", "--fabric", FABRIC, "--plan", PLAN, "--json",
    ];
    let output = goniofit(&[&base, extra].concat()).output().unwrap();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    serde_json::from_slice(&output.stdout).unwrap()
}

fn fails(arguments: &[&str], expected: &str) {
    let output = goniofit(arguments).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(text.contains(expected) && text.contains("hint:"), "{text}");
    assert!(output.stdout.is_empty());
}

#[test]
fn json_has_every_configuration_and_derivatives_by_name() {
    let result = means(&["--paths", "64", "--seed", "7", "--derivatives"]);
    let configs = result["configs"].as_array().unwrap();
    assert_eq!(configs.len(), 16);
    for (i, config) in configs.iter().enumerate() {
        assert_eq!(config["config"], i + 1);
        assert_eq!(config["paths"], 64);
        for key in ["mean", "se"] {
            assert_eq!(config[key].as_array().unwrap().len(), 3);
        }
        for name in ["c_r", "c_tt", "beta_r", "beta_tt", "gamma_tt"] {
            assert_eq!(
                config["derivatives"][name].as_array().unwrap().len(),
                3,
                "{name}"
            );
        }
    }
    assert_eq!(result["seed"], 7);
    assert!(result["cpu_s"].as_f64().unwrap() > 0.0 && result["wall_s"].as_f64().unwrap() > 0.0);
    assert_eq!(
        result["configs"],
        means(&["--paths", "64", "--seed", "7", "--derivatives"])["configs"]
    );
}

#[test]
fn either_integrator_may_be_asked() {
    let few = |integrator| means(&["--paths", "64", "--integrator", integrator]);
    assert_eq!(few("fast")["configs"], means(&["--paths", "64"])["configs"]);
    let basic = few("basic");
    assert_ne!(few("fast")["configs"], basic["configs"]);
    assert_eq!(basic["configs"], few("basic")["configs"]);
    assert_eq!(basic["configs"].as_array().unwrap().len(), 16);
}

#[test]
fn an_asked_accuracy_is_reached_by_honest_standard_errors() {
    // At 20 % the error of two independent runs must be explained by their stated errors: chi-square over the 16 green
    // values (channels of one path are correlated, so one channel), mean 1, seen between 0.2 and 4.
    let (a, b) = (
        means(&["--accuracy", "20%", "--seed", "1"]),
        means(&["--accuracy", "20%", "--seed", "2"]),
    );
    let stated = a["weighted_rms_se"].as_f64().unwrap();
    assert!((0.08..0.4).contains(&stated), "{stated}");
    let mut sum = 0.0;
    for (x, y) in a["configs"]
        .as_array()
        .unwrap()
        .iter()
        .zip(b["configs"].as_array().unwrap())
    {
        let get = |v: &Value, key: &str| v[key][1].as_f64().unwrap();
        sum += (get(x, "mean") - get(y, "mean")).powi(2)
            / (get(x, "se").powi(2) + get(y, "se").powi(2));
    }
    assert!((0.2..4.0).contains(&(sum / 16.0)), "{}", sum / 16.0);
}

#[test]
fn bad_input_is_refused_with_a_hint() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let run = |fabric: &str, plan: &str, extra: &[&str], expected: &str| {
        fails(
            &[
                &["render", "means", "--fabric", fabric, "--plan", plan],
                extra,
            ]
            .concat(),
            expected,
        );
    };
    run(
        FABRIC,
        PLAN,
        &["--model", "lambert"],
        "unknown model 'lambert'",
    );
    let wrong = write(
        "p.json",
        r#"{"c_r":[0.1,0.1],"c_tt":[0.5,0.5,0.5],"beta_r_deg":5,"beta_tt_deg":10,"gamma_tt_deg":10}"#,
    );
    let output = goniofit(&[
        "render", "means", "--fabric", FABRIC, "--plan", PLAN, "--params", &wrong,
    ])
    .output()
    .unwrap();
    assert!(String::from_utf8_lossy(&output.stderr).contains("expected a list of 3 numbers"));
    let extra_key = write("q.json", r#"{"c_r":[0.1,0.1,0.1],"color":1}"#);
    run(
        FABRIC,
        PLAN,
        &["--params", &extra_key],
        "unknown key 'color'",
    );
    let steep = write(
        "plan.toml",
        &std::fs::read_to_string(Path::new(PLAN))
            .unwrap()
            .replacen("80.0", "95.0", 1),
    );
    run(FABRIC, &steep, &[], "light_theta_deg is 95");
    run(FABRIC, PLAN, &["--paths", "10"], "too few");
    let empty = write(
        "empty.csv",
        "# tile_mm = [1, 1]\nx0,y0,z0,x1,y1,z1,radius_mm,yarn_system\n",
    );
    let fabric = write(
        "empty.toml",
        &format!("name = 'empty'\nfibers = '{empty}'\n"),
    );
    run(&fabric, PLAN, &[], "no segments");
}
