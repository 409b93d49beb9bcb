//! Keeps the promise of ARCHITECTURE.md: which room may import which, and which external crate lives where.
#![allow(clippy::unwrap_used, missing_docs)]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Room, the rooms it may import.
const ROOMS: &[(&str, &[&str])] = &[
    ("base", &[]),
    ("math", &["base"]),
    ("session", &["base", "math"]),
    ("fabric", &["base", "math"]),
    ("scatter", &["base", "math"]),
    ("rig", &["base", "math", "session"]),
    ("measure", &["base", "math", "session"]),
    ("render", &["base", "math", "session", "fabric", "scatter"]),
    (
        "fit",
        &["base", "math", "session", "fabric", "scatter", "render"],
    ),
    ("report", &["base", "math", "session", "fit"]),
    (
        "cli",
        &[
            "base", "math", "session", "fabric", "scatter", "rig", "measure", "render", "fit",
            "report",
        ],
    ),
];

/// External crate, the only rooms that may name it.
const CRATES: &[(&str, &[&str])] = &[
    ("serialport", &["rig"]),
    ("nokhwa", &["rig"]),
    ("aravis", &["rig"]),
    ("rawloader", &["measure"]),
    ("exif", &["measure"]),
    ("tiff", &["measure", "fabric"]),
    ("flate2", &["fabric"]),
    ("png", &["measure", "report"]),
    ("exr", &["measure", "report"]),
    ("clap", &["cli"]),
    ("indicatif", &["cli"]),
    ("ctrlc", &["cli"]),
    ("image", &["measure", "fabric", "report"]),
];

fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
}

/// Code without comments and string contents, so that prose cannot trip the check.
fn strip(code: &str) -> String {
    code.lines()
        .map(|l| l.split("//").next().unwrap_or(""))
        .collect::<Vec<_>>()
        .join("\n")
}

/// The rooms named after `crate::`, also inside one level of braces.
fn imported_rooms(code: &str) -> Vec<String> {
    let word = |s: &str| {
        s.chars()
            .take_while(|c| c.is_alphanumeric() || *c == '_')
            .collect::<String>()
    };
    let mut rooms = Vec::new();
    for (at, _) in code.match_indices("crate::") {
        if code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_') {
            continue;
        }
        let rest = code[at + "crate::".len()..].trim_start();
        if let Some(list) = rest.strip_prefix('{') {
            let mut depth = 0;
            let mut start = true;
            for (i, c) in list.char_indices() {
                match c {
                    '{' => depth += 1,
                    '}' if depth == 0 => break,
                    '}' => depth -= 1,
                    ',' if depth == 0 => start = true,
                    c if start && !c.is_whitespace() => {
                        rooms.push(word(&list[i..]));
                        start = false;
                    }
                    _ => {}
                }
            }
        } else {
            rooms.push(word(rest));
        }
    }
    rooms
}

fn names_crate(code: &str, name: &str) -> bool {
    let path = format!("{name}::");
    code.match_indices(&path).any(|(at, _)| {
        let before = code[..at].chars().next_back();
        let own = code[..at].ends_with("crate::")
            || code[..at].ends_with("super::")
            || code[..at].ends_with("self::");
        !own && !before.is_some_and(|c| c.is_alphanumeric() || c == '_' || c == ':')
    }) && !code.contains(&format!("mod {name};"))
        || code.contains(&format!("use {name};"))
}

fn faults(room: &str, code: &str) -> Vec<String> {
    let code = strip(code);
    let mut faults = Vec::new();
    let Some((_, allowed)) = ROOMS.iter().find(|(name, _)| *name == room) else {
        return vec![format!("room '{room}' is not in the table")];
    };
    for import in imported_rooms(&code) {
        if import != room && !allowed.contains(&import.as_str()) {
            faults.push(format!("{room} imports {import}"));
        }
    }
    for (name, rooms) in CRATES {
        if !rooms.contains(&room) && names_crate(&code, name) {
            faults.push(format!("{room} names the external crate {name}"));
        }
    }
    if code.contains("super::super::") {
        faults.push(format!("{room} climbs with super::super::"));
    }
    if room != "cli"
        && ["println!", "print!", "eprintln!", "eprint!"]
            .iter()
            .any(|p| code.contains(p))
    {
        let tests_at = code.find("#[cfg(test)]").unwrap_or(code.len());
        if ["println!", "print!", "eprintln!", "eprint!"]
            .iter()
            .any(|p| code[..tests_at].contains(p))
        {
            faults.push(format!("{room} prints"));
        }
    }
    faults
}

#[test]
fn every_room_keeps_to_its_floor() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    sources(&src, &mut files);
    let mut by_room: BTreeMap<String, usize> = BTreeMap::new();
    let mut all = Vec::new();
    for file in files {
        let inside = file.strip_prefix(&src).unwrap();
        let room = inside
            .components()
            .next()
            .unwrap()
            .as_os_str()
            .to_string_lossy()
            .into_owned();
        if room == "lib.rs" || room == "main.rs" {
            continue;
        }
        *by_room.entry(room.clone()).or_default() += 1;
        let code = std::fs::read_to_string(&file).unwrap();
        all.extend(
            faults(&room, &code)
                .into_iter()
                .map(|f| format!("{}: {f}", inside.display())),
        );
    }
    assert!(all.is_empty(), "{}", all.join("\n"));
    let rooms: Vec<&str> = by_room.keys().map(String::as_str).collect();
    let mut listed: Vec<&str> = ROOMS.iter().map(|r| r.0).collect();
    listed.sort_unstable();
    assert_eq!(rooms, listed, "the rooms on disk and in the table differ");
}

#[test]
fn the_checker_sees_a_broken_floor() {
    assert_eq!(
        faults("scatter", "use crate::session::Plan;"),
        ["scatter imports session"]
    );
    assert_eq!(
        faults(
            "report",
            "use crate::{base::Result, render::{Scene, Estimate}};"
        ),
        ["report imports render"]
    );
    assert_eq!(
        faults("fit", "fn f() { let x = rawloader::decode_file(p); }"),
        ["fit names the external crate rawloader"]
    );
    assert_eq!(
        faults("render", "use super::super::math;"),
        ["render climbs with super::super::"]
    );
    assert_eq!(faults("fit", "fn f() { println!(\"x\"); }"), ["fit prints"]);
    assert_eq!(faults("attic", ""), ["room 'attic' is not in the table"]);
    assert!(
        faults(
            "fit",
            "use crate::math::Random; // crate::rig:: is far away"
        )
        .is_empty()
    );
}
