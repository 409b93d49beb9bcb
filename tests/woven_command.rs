//! Promise: `goniofit woven` lists, pictures and fits, and says what is wrong with its input.
#![allow(clippy::unwrap_used, missing_docs)]

use assert_cmd::Command;
use serde_json::Value;

fn goniofit(arguments: &[&str]) -> std::process::Output {
    let mut command = Command::cargo_bin("goniofit").unwrap();
    command.args(arguments).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

#[test]
fn models_and_fabrics_are_listed() {
    let out = text(&goniofit(&["woven", "list"]).stdout);
    for expected in [
        "woven-19 (19 numbers)",
        "warp_twist_deg",
        "-90 .. 90, default -30",
        "charmeuse",
    ] {
        assert!(out.contains(expected), "{out}");
    }
    let json: Value =
        serde_json::from_slice(&goniofit(&["woven", "list", "--json"]).stdout).unwrap();
    assert_eq!(json["models"].as_array().unwrap().len(), 5);
    assert_eq!(json["fabrics"].as_array().unwrap().len(), 6);
}

#[test]
fn pictures_come_in_several_magnifications_and_are_a_function_of_the_seed() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("p.png");
    let run = |extra: &[&str]| {
        let fixed = [
            "woven",
            "picture",
            "--width",
            "64",
            "--out",
            out.to_str().unwrap(),
        ];
        goniofit(&[&fixed, extra].concat())
    };
    let made = run(&["--fabric", "lining", "--repeats", "2,8"]);
    assert!(made.status.success(), "{}", text(&made.stderr));
    let read = |name: &str| image::open(folder.path().join(name)).unwrap().to_rgb8();
    let (near, far) = (read("p_2.png"), read("p_8.png"));
    assert_eq!(near.dimensions(), (64, 64));
    assert_ne!(near, far);
    let refused = run(&["--fabric", "lining", "--repeats", "2,8"]);
    assert!(text(&refused.stderr).contains("exists already"));
    let noisy = |seed: &str| {
        let made = run(&[
            "--weave",
            "2/2 twill",
            "--noise",
            "3",
            "--seed",
            seed,
            "--force",
        ]);
        assert!(made.status.success(), "{}", text(&made.stderr));
        read("p.png")
    };
    let first = noisy("1");
    assert_eq!(first, noisy("1"));
    assert_ne!(first, noisy("2"));
    let wif = folder.path().join("d.wif");
    std::fs::write(&wif, "[THREADING]\n1=1\n2=2\n[LIFTPLAN]\n1=1\n2=2\n").unwrap();
    let plain = run(&["--weave", "plain", "--force"]);
    assert!(plain.status.success());
    let named = read("p.png");
    let drafted = run(&["--wif", wif.to_str().unwrap(), "--force"]);
    assert!(drafted.status.success(), "{}", text(&drafted.stderr));
    assert_eq!(read("p.png"), named);
}

#[test]
fn measurements_are_fitted_and_the_exit_code_says_how_well() {
    let data = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/tests/data/khungurn16_gabardine_measurements.csv"
    );
    let out = goniofit(&["woven", "fit", data, "--fabric", "gabardine", "--json"]);
    let json: Value = serde_json::from_slice(&out.stdout).unwrap();
    let models = json["models"].as_array().unwrap();
    let residual = |k: usize| models[k]["residual"].as_f64().unwrap();
    assert_eq!(models.len(), 5, "{}", text(&out.stderr));
    assert!(residual(4) < residual(2) && residual(2) < residual(0));
    let best = models.iter().find(|m| m["model"] == json["best"]).unwrap();
    let code = i32::from(!best["adequate"].as_bool().unwrap());
    assert_eq!(out.status.code(), Some(code));
    let held = goniofit(&[
        "woven",
        "fit",
        data,
        "--weave",
        "2/1 twill",
        "--model",
        "woven-9",
        "--hold",
        "twist_deg=-30",
    ]);
    let table = text(&held.stdout);
    assert!(
        table.contains("woven-9") && table.contains("-30.0000 deg"),
        "{table}"
    );
}

#[test]
fn wrong_input_is_refused_with_a_hint() {
    let data = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/tests/data/khungurn16_gabardine_measurements.csv"
    );
    for (arguments, expected) in [
        (
            vec!["woven", "picture", "--out", "x.png"],
            "no cloth: expected --fabric, --weave or --wif",
        ),
        (
            vec!["woven", "picture", "--fabric", "jersey", "--out", "x.png"],
            "known fabrics: denim",
        ),
        (
            vec![
                "woven", "picture", "--fabric", "denim", "--light", "95,0", "--out", "x.png",
            ],
            "below 90",
        ),
        (
            vec![
                "woven", "fit", data, "--weave", "plain", "--model", "woven-8",
            ],
            "known models: lambert",
        ),
        (
            vec![
                "woven", "fit", data, "--weave", "plain", "--model", "woven-9", "--hold", "twist",
            ],
            "expected NAME=VALUE",
        ),
        (
            vec![
                "woven", "fit", data, "--weave", "plain", "--model", "woven-9", "--hold", "kappa=1",
            ],
            "no parameter 'kappa' to hold",
        ),
    ] {
        let out = goniofit(&arguments);
        let error = text(&out.stderr);
        assert!(
            out.status.code() == Some(2) && error.contains(expected),
            "{error}"
        );
    }
}

#[test]
fn a_draft_of_a_weaving_program_makes_the_same_fibers_as_the_weave_by_name() {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/fabrics/gabardine.toml");
    let named = std::fs::read_to_string(file).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let describe = |draft: &str, expected: i32| {
        std::fs::write(folder.path().join("d.wif"), draft).unwrap();
        let own = folder.path().join("own.toml");
        let text = named.replace("pattern = \"2/1 twill\"", "wif = \"d.wif\"");
        assert_ne!(text, named);
        std::fs::write(&own, text).unwrap();
        let out = goniofit(&["fabric", "describe", own.to_str().unwrap(), "--json"]);
        assert_eq!(out.status.code(), Some(expected), "{}", text_of(&out));
        out
    };
    fn text_of(out: &std::process::Output) -> String {
        text(&out.stdout) + &text(&out.stderr)
    }
    let twill = "[WEAVING]\nRising Shed=true\n[THREADING]\n1=1\n2=2\n3=3\n[TIEUP]\n1=1,2\n2=2,3\n3=1,3\n[TREADLING]\n1=1\n2=2\n3=3\n";
    let by_name = goniofit(&["fabric", "describe", file, "--json"]);
    assert_eq!(text(&describe(twill, 0).stdout), text(&by_name.stdout));
    // Control: another draft makes other fibers.
    let other = twill.replace("2=2,3\n3=1,3", "2=1,3\n3=2,3");
    assert_ne!(text(&describe(&other, 0).stdout), text(&by_name.stdout));
    let broken = describe("[WARP]\nThreads=3\n", 2);
    assert!(text(&broken.stderr).contains("section [THREADING] is missing"));
}
