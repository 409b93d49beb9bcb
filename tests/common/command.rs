//! Runs the program as a person would, in the project's folder.

#![allow(dead_code)]

use std::path::Path;

/// Exit code, stdout and stderr.
pub(crate) fn goniofit(arguments: &[&str]) -> (i32, String, String) {
    let output = assert_cmd::Command::cargo_bin("goniofit")
        .unwrap()
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .args(arguments)
        .output()
        .unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (
        output.status.code().unwrap(),
        text(&output.stdout),
        text(&output.stderr),
    )
}

/// Stdout and stderr of a run that must succeed.
pub(crate) fn done(arguments: &[&str]) -> (String, String) {
    let (code, out, err) = goniofit(arguments);
    assert_eq!(code, 0, "{arguments:?}: {err}");
    (out, err)
}

/// A path as an argument.
pub(crate) fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}
