//! Promise: `goniofit fabric` describes, exports, imports and draws, and never replaces a file unasked.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

#[path = "common/command.rs"]
mod command;

use command::goniofit;
use std::path::Path;

fn done(arguments: &[&str]) -> String {
    command::done(arguments).0
}

fn path(folder: &Path, name: &str) -> String {
    folder.join(name).to_str().unwrap().to_owned()
}

const COTTON: &str = "fabrics/plain_cotton.toml";

#[test]
fn describe_speaks_words_and_json() {
    let words = done(&["fabric", "describe", COTTON]);
    assert!(words.starts_with("plain cotton\n") && words.contains("thickness"));
    let json: serde_json::Value =
        serde_json::from_str(&done(&["fabric", "describe", COTTON, "--json"])).unwrap();
    assert_eq!(json["report"]["fibers"], 480);
    assert_eq!(json["report"]["tile_mm"], serde_json::json!([2.0, 2.2]));
    assert!(json["report"]["systems"][1]["twist_per_tile"].is_i64());
}

#[test]
fn exported_files_come_back_through_import() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| path(folder.path(), name);
    let csv = at("a.csv");
    done(&["fabric", "export", COTTON, "--format", "csv", "--out", &csv]);
    let count = |file: &str| std::fs::read_to_string(file).unwrap().lines().count();
    for (format, name) in [("mitsuba", "a.txt"), ("hair", "a.hair")] {
        let (file, back) = (at(name), at(&format!("{format}.csv")));
        done(&[
            "fabric", "export", COTTON, "--format", format, "--out", &file,
        ]);
        done(&[
            "fabric", "import", &file, "--tile", "2.0,2.2", "--out", &back,
        ]);
        assert_eq!(count(&back), count(&csv));
        let json = done(&["fabric", "describe", &back, "--json"]);
        let json: serde_json::Value = serde_json::from_str(&json).unwrap();
        assert_eq!(json["report"]["closed_fibers"], 480, "{format}");
    }
    let (code, _, err) = goniofit(&["fabric", "import", &at("a.hair"), "--out", &at("b.csv")]);
    assert!(code == 2 && err.contains("--tile X,Y"), "{err}");
    assert!(!folder.path().join("b.csv").exists());
}

#[test]
fn a_picture_is_a_png() {
    let folder = tempfile::tempdir().unwrap();
    let out = path(folder.path(), "a.png");
    done(&["fabric", "picture", COTTON, "--width", "200", "--out", &out]);
    assert!(std::fs::read(&out).unwrap().starts_with(b"\x89PNG"));
}

#[test]
fn existing_files_are_kept_unless_forced() {
    let folder = tempfile::tempdir().unwrap();
    let out = path(folder.path(), "precious.csv");
    std::fs::write(&out, "precious").unwrap();
    let export = ["fabric", "export", COTTON, "--format", "csv", "--out", &out];
    let (code, _, err) = goniofit(&export);
    assert!(
        code == 2 && err.contains("exists already") && err.contains("hint: --force"),
        "{err}"
    );
    assert_eq!(std::fs::read_to_string(&out).unwrap(), "precious");
    let mut forced = export.to_vec();
    forced.push("--force");
    done(&forced);
    assert!(
        std::fs::read_to_string(&out)
            .unwrap()
            .starts_with("# fibers")
    );
}

#[test]
fn bad_fabrics_end_with_code_2_and_a_hint() {
    let folder = tempfile::tempdir().unwrap();
    let file = path(folder.path(), "empty.csv");
    std::fs::write(
        &file,
        "# tile_mm = [1, 1]\nx0,y0,z0,x1,y1,z1,radius_mm,yarn_system\n",
    )
    .unwrap();
    let (code, out, err) = goniofit(&["fabric", "describe", &file]);
    assert_eq!((code, out.as_str()), (2, ""));
    assert!(
        err.contains("the fabric is empty") && err.contains("hint: "),
        "{err}"
    );
}
