//! Directions and fibers found in virtual scans: how far off, and how long it takes.
//!
//! `cargo bench --bench ct_speed [-- directions|fibers|large] [slow] [VOXEL_UM]` on one repeat of
//! `fabrics/bench_twill22.toml` (packed) and on the same cloth with
//! every fourth fiber (quarter) or every 16th alone (sparse); voxels of 5, 2.667 and 1.6 um are 1.6, 3 and 5 to the fiber radius. Seconds are
//! processor seconds of the whole process per million voxels that are not air.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

use goniofit::base::Unwatched;
use goniofit::fabric::ct::{
    Gray, Method, Orienting, Simulated, Simulating, Tracing, compare, orient, simulate, trace,
};
use goniofit::fabric::{self, FiberTile, VoxelTile};
use std::path::Path;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let asked = |word: &str| arguments.iter().any(|a| a == word);
    let voxel = arguments.iter().find_map(|a| a.parse::<f64>().ok());
    let packed = one_repeat();
    let cloths = [
        ("packed", packed.clone()),
        ("quarter", every(&packed, 4)),
        ("sparse", every(&packed, 16)),
    ];
    let voxels = voxel.map_or(vec![5.0, 8.0 / 3.0, 1.6], |v| vec![v]);
    if asked("large") {
        return large(&packed);
    }
    if !asked("fibers") {
        println!(
            "cloth    voxel um  blur  noise  method         million  CPU s/million  median deg  90 % deg  kept %"
        );
        for (name, tile) in &cloths {
            for (blur, noise) in [(0.0, 0.0), (0.7, 0.1)] {
                directions(name, tile, voxels[0], blur, noise, asked("slow"));
            }
        }
    }
    if !asked("directions") {
        println!(
            "cloth    voxel um  blur  noise  recall  steep  precision  median deg  90 % deg  position um  switches/mm  pieces  length um  auto um  CPU s"
        );
        for (name, tile) in &cloths {
            for voxel in &voxels {
                for (blur, noise) in [(0.0, 0.0), (0.7, 0.1)] {
                    fibers(name, tile, *voxel, blur, noise);
                }
            }
        }
    }
}

/// Time and memory for a scan of 500 x 540 x 586 voxels, made of copies of the packed cloth.
fn large(tile: &FiberTile) {
    let made = scan(tile, 5.0, 0.7, 0.1).gray;
    let shape = [500, 540, 586];
    let place = |i: usize, j: usize, k: usize| {
        let [nx, ny, nz] = made.shape;
        made.values[i % nx + nx * (j % ny + ny * (k % nz))]
    };
    let rows = (0..shape[2]).flat_map(|k| (0..shape[1]).map(move |j| (j, k)));
    let values = rows.flat_map(|(j, k)| (0..shape[0]).map(move |i| (i, j, k)));
    let gray = Gray {
        shape,
        values: values.map(|(i, j, k)| place(i, j, k)).collect(),
        periodic: false,
        ..made.clone()
    };
    let (begun, cpu) = (std::time::Instant::now(), processor_seconds());
    let (_, report) = orient(gray, &Orienting::new(Method::Tensor), &Unwatched).unwrap();
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let peak = status.lines().find(|l| l.starts_with("VmHWM")).unwrap();
    println!(
        "{shape:?}: {:.0} s elapsed, {:.0} CPU s, {:.1} million voxels not air, {peak}",
        begun.elapsed().as_secs_f64(),
        processor_seconds() - cpu,
        report.solid as f64 / 1e6
    );
}

/// Every n-th fiber.
fn every(tile: &FiberTile, n: usize) -> FiberTile {
    let curves = fabric::curves(tile);
    let kept: Vec<_> = curves.into_iter().step_by(n).collect();
    fabric::from_curves(tile.size, &kept)
}

/// One repeat of the bench twill: a quarter of its tile, one twist turn.
fn one_repeat() -> FiberTile {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let text = std::fs::read_to_string(root.join("fabrics/bench_twill22.toml")).unwrap();
    let text = text
        .replace("repeats = [2, 2]", "repeats = [1, 1]")
        .replace("twist_per_tile = 2", "twist_per_tile = 1");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("twill.toml");
    std::fs::write(&path, text).unwrap();
    fabric::load(&path).unwrap().tile
}

fn scan(tile: &FiberTile, voxel_um: f64, blur: f64, noise: f64) -> Simulated {
    let options = Simulating {
        voxel: 1e-3 * voxel_um,
        margin: 0.04,
        blur: 1e-3 * blur * voxel_um,
        noise,
        seed: 1,
    };
    simulate(tile, &options, &Unwatched).unwrap()
}

fn directions(name: &str, tile: &FiberTile, voxel_um: f64, blur: f64, noise: f64, slow: bool) {
    let made = cropped(&scan(tile, voxel_um, blur, noise), 100);
    for (label, method, exact) in [
        ("tensor", Method::Tensor, false),
        ("line", Method::Line, false),
        ("filter, fast", Method::Filter, false),
        ("filter, exact", Method::Filter, true),
    ] {
        if method == Method::Filter && !slow {
            continue;
        }
        let options = Orienting {
            exact,
            fiber_radius: Some(0.008),
            ..Orienting::new(method)
        };
        let begun = processor_seconds();
        let (found, report) = orient(made.gray.clone(), &options, &Unwatched).unwrap();
        let seconds = processor_seconds() - begun;
        let [median, most] = angles(&made.truth, &found);
        let million = report.solid as f64 / 1e6;
        println!(
            "{name:8} {voxel_um:8.2} {blur:5.1} {noise:6.2}  {label:14} {million:6.2} {:14.1} {median:11.1} {most:9.1} {:7.1}",
            seconds / million,
            100.0 * report.kept as f64 / report.solid as f64
        );
    }
}

/// The corner of a scan: `side` voxels along x and y.
fn cropped(made: &Simulated, side: usize) -> Simulated {
    let [nx, _, nz] = made.gray.shape;
    let shape = [side.min(nx), side.min(nx), nz];
    let mut truth = VoxelTile::empty(shape, made.gray.side, made.gray.bottom).unwrap();
    let mut values = Vec::new();
    for place in 0..truth.density().len() {
        let [i, j, k] = [place % side, place / side % side, place / (side * side)];
        let from = made.truth.place([i, j, k]);
        let density = made.truth.density()[from];
        truth
            .set(place, density, made.truth.direction(from))
            .unwrap();
        values.push(made.gray.values[from]);
    }
    let gray = Gray {
        shape,
        values,
        periodic: false,
        ..made.gray.clone()
    };
    Simulated {
        gray,
        truth,
        stretch: made.stretch,
    }
}

/// Median and 90 % of the angles between directions found and true, where there is fiber.
fn angles(truth: &VoxelTile, found: &VoxelTile) -> [f64; 2] {
    let places = 0..truth.density().len();
    let both = places.filter(|p| truth.density()[*p] > 0.0 && found.density()[*p] > 0.0);
    let cos = |p: usize| truth.direction(p).dot(found.direction(p)).abs().min(1.0);
    let mut list: Vec<f64> = both.map(|p| cos(p).acos().to_degrees()).collect();
    list.sort_by(f64::total_cmp);
    [0.5, 0.9].map(|share| list[(share * list.len() as f64) as usize])
}

fn fibers(name: &str, tile: &FiberTile, voxel_um: f64, blur: f64, noise: f64) {
    let made = scan(tile, voxel_um, blur, noise);
    let options = Orienting {
        fiber_radius: Some(0.008),
        ..Orienting::new(Method::Tensor)
    };
    let (oriented, _) = orient(made.gray, &options, &Unwatched).unwrap();
    let options = Tracing {
        radius: Some(0.008),
        gate: option("GATE", 0.75),
        least_response: option("LEAST", 0.12),
        join: option("JOIN", 1.0) > 0.0,
        ..Tracing::default()
    };
    let begun = processor_seconds();
    let (found, _) = trace(&oriented, &options, &Unwatched).unwrap();
    let seconds = processor_seconds() - begun;
    let s = compare(tile, &found);
    let auto = Tracing {
        radius: None,
        ..options
    };
    let (_, report) = trace(&oriented, &auto, &Unwatched).unwrap();
    println!(
        "{name:8} {voxel_um:8.2} {blur:5.1} {noise:6.2} {:7.3} {:6.3} {:10.3} {:11.1} {:9.1} {:12.2} {:12.2} {:7.1} {:10.0} {:10.2} {seconds:5.0}",
        s.recall,
        s.recall_steep,
        s.precision,
        s.direction_median,
        s.direction_90,
        1e3 * s.position_rms,
        s.switches_per_mm,
        s.pieces,
        1e3 * s.length_median,
        1e3 * report.radius_mm[0],
    );
}

fn option(name: &str, usual: f64) -> f64 {
    std::env::var(name).map_or(usual, |v| v.parse().unwrap())
}

fn processor_seconds() -> f64 {
    let spent = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    spent.tv_sec as f64 + 1e-9 * spent.tv_nsec as f64
}
