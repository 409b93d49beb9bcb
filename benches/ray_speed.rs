//! Million bounce rays per CPU second of one core, with the work per ray beside them.
//!
//! `cargo bench --bench ray_speed [-- FABRIC.toml ...] [--scale] [--json]`; without a file `fabrics/bench_twill22.toml`.
//! `--scale` repeats that weave on larger and larger tiles at the same density, from 10 thousand to 5 million segments.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

use goniofit::fabric::{Fabric, load};
use goniofit::render::{FiberScene, FiberSceneOptions, RaySpeed};
use goniofit::scatter;
use std::path::Path;
use std::time::Instant;

const RAYS: usize = 200_000;

/// Repeats of the weave and segment length in mm: 10,880 segments (one repeat in segments three times as long), 32,640,
/// 130,560, 522,240, 1,175,040 and 5,091,840.
const SCALE: [([usize; 2], &str); 6] = [
    ([1, 1], "0.0588"),
    ([1, 1], "0.0196"),
    ([2, 2], "0.0196"),
    ([4, 4], "0.0196"),
    ([6, 6], "0.0196"),
    ([12, 13], "0.0196"),
];

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let has = |flag: &str| arguments.iter().any(|a| a == flag);
    let files: Vec<&String> = arguments.iter().filter(|a| !a.starts_with('-')).collect();
    let json = has("--json");
    if !json {
        println!(
            "                                  Mrays/s path order   Mrays/s shuffled  per ray                    mean                build"
        );
        println!(
            "fabric                  segments   closest      any    closest      any  boxes  tests  groups    um  bytes/segment      s"
        );
    }
    let bench = concat!(env!("CARGO_MANIFEST_DIR"), "/fabrics/bench_twill22.toml");
    if has("--scale") {
        let text = std::fs::read_to_string(bench).unwrap();
        for (repeats, length) in SCALE {
            report(&enlarged(&text, repeats, length), json);
        }
    } else if files.is_empty() {
        report(&load(Path::new(bench)).unwrap(), json);
    } else {
        for file in files {
            report(&load(Path::new(file)).unwrap(), json);
        }
    }
}

/// The bench twill with other repeats on the tile, at the same rates per millimeter, in segments of `length` mm.
fn enlarged(text: &str, repeats: [usize; 2], length: &str) -> Fabric {
    let text = text
        .replace("repeats = [2, 2]", &format!("repeats = {repeats:?}"))
        .replace("twist_per_tile = 2", "twist_per_mm = 1.0")
        .replace("migration_per_tile = 1", "migration_per_mm = 1.0")
        .replace("length_mm = 0.0196", &format!("length_mm = {length}"));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("enlarged.toml");
    std::fs::write(&path, text).unwrap();
    load(&path).unwrap()
}

fn report(fabric: &Fabric, json: bool) {
    let segments = fabric.tile.segments.len();
    let start = Instant::now();
    let model = scatter::model("khungurn").unwrap();
    let scene = FiberScene::new(&fabric.tile, model, FiberSceneOptions::default()).unwrap();
    let build_s = start.elapsed().as_secs_f64();
    let s = scene.ray_speed(RAYS, 1);
    if json {
        let mut row = serde_json::to_value(s).unwrap();
        row["fabric"] = fabric.name.clone().into();
        row["segments"] = segments.into();
        row["build_s"] = build_s.into();
        println!("{row}");
        return;
    }
    let RaySpeed {
        mrays_closest,
        mrays_any,
        mrays_closest_shuffled,
        mrays_any_shuffled,
        ..
    } = s;
    println!(
        "{:<20} {segments:>10} {mrays_closest:9.2} {mrays_any:8.2} {mrays_closest_shuffled:10.2} {mrays_any_shuffled:8.2} {:6.2} {:6.1} {:7.2} {:6.1} {:13.0} {build_s:7.2}",
        fabric.name,
        s.boxes_per_ray,
        s.tests_per_ray,
        s.groups_per_ray,
        1e3 * s.mean_distance,
        s.bytes_per_segment,
    );
}
