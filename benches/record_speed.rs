//! Time per recorded path, means alone and with derivatives, beside the floor of the machine and the error against tracing.
//!
//! `cargo bench --bench record_speed [-- --quick]`: Khungurn's 16 configurations on `fabrics/bench_twill22.toml`, Gabardine.
//! One thread. The floor is the larger of reading the record once from memory and its arithmetic at the speed of a loop
//! of fused multiply-adds in the widest vectors, both measured here. Absolute times depend on the machine and its load:
//! compare within one run.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

use goniofit::base::Unwatched;
use goniofit::render::{
    Effort, Estimates, FiberScene, FiberSceneOptions, RecordOptions, Recording, Request, Scene,
};
use goniofit::scatter::{self, Parameters};
use goniofit::session::Plan;
use std::path::Path;
use std::time::Instant;

/// Single-precision operations per event, counted in the source: table, lobes, exponentials, tree; with slopes and sums.
const OPERATIONS: [(&str, f64); 2] = [("means", 120.0), ("with derivatives", 220.0)];

fn main() {
    let quick = std::env::args().any(|a| a == "--quick");
    let one = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .unwrap();
    one.install(|| measure(if quick { 8192 } else { 65_536 }));
}

fn measure(paths: u64) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let plan = Plan::read(&root.join("rig_configs/plans/khungurn16.toml")).unwrap();
    let fabric = goniofit::fabric::load(&root.join("fabrics/bench_twill22.toml")).unwrap();
    let model = scatter::model("khungurn").unwrap();
    let scene = FiberScene::new(&fabric.tile, model, FiberSceneOptions::default()).unwrap();
    let text = std::fs::read_to_string(root.join("fabrics/params/gabardine.json")).unwrap();
    let parameters = Parameters::from_json(model, &serde_json::from_str(&text).unwrap()).unwrap();
    let trace = |at: &Parameters, seed| {
        let request = request(&plan, at, paths, seed);
        scene.estimate(&request, &Unwatched).unwrap()
    };
    let traced = trace(&parameters, 1);
    let n = 7.0 * paths as f64;
    let traced_us = 1e6 * traced.cpu_s / n;
    println!("tracing: {traced_us:.1} us per path with derivatives");
    let moves: Vec<_> = moves(&parameters)
        .into_iter()
        .map(|(name, moved)| (name, trace(&moved, 2), moved))
        .collect();
    for defensive in [0.0, 0.1] {
        let options = RecordOptions {
            defensive,
            ..RecordOptions::default()
        };
        let asked = request(&plan, &parameters, paths, 1);
        let recording = scene.record(&asked, &options, &Unwatched).unwrap();
        let events = recording.events() as f64 / n;
        let bytes = recording.bytes() as f64 / n;
        println!(
            "\ndefensive share {defensive}: {:.0} paths, {events:.2} events and {bytes:.0} bytes per path ({:.1} bytes per event)",
            n,
            bytes / events
        );
        let memory = bytes / read_speed() * 1e6;
        let flops = multiply_add_speed();
        for (what, operations) in OPERATIONS {
            let arithmetic = events * operations / flops * 1e6;
            let floor = memory.max(arithmetic);
            let us = time(&recording, &parameters, what == "means") / n * 1e6;
            println!(
                "{what:<17} {us:.4} us per path: floor {floor:.4} (memory {memory:.4}, arithmetic {arithmetic:.4}), ratio {:.1}; tracing takes {:.0} times as long",
                us / floor,
                traced_us / us
            );
        }
        println!(
            "move               least ratio  largest share  rms z  worst z  rms error %  (se %)"
        );
        for (name, fresh, moved) in &moves {
            let recalled = recording.estimate(moved).unwrap();
            let largest = recalled
                .trust
                .configurations
                .iter()
                .map(|c| c.largest_share);
            let (rms, worst, error) = compare(&recalled.estimates, fresh);
            println!(
                "{name:<20} {:9.2} {:14.2} {rms:6.2} {worst:8.1} {:12.1} {:7.1}",
                recalled.trust.least_ratio(),
                largest.fold(0.0, f64::max),
                100.0 * error,
                100.0 * recalled.estimates.weighted_rms_error()
            );
        }
    }
}

fn request<'a>(plan: &'a Plan, at: &'a Parameters, paths: u64, seed: u64) -> Request<'a> {
    Request {
        configurations: &plan.configurations,
        parameters: at,
        effort: Effort::Paths(paths),
        seed,
        stream: 0,
    }
}

fn moves(at: &Parameters) -> Vec<(&'static str, Parameters)> {
    let scaled = |widths: f64, logit: f64| {
        let values = at.values().iter().enumerate().map(|(slot, &v)| {
            if slot < 6 {
                1.0 / (1.0 + (-((v / (1.0 - v)).ln() + logit)).exp())
            } else {
                v * widths
            }
        });
        at.with_values(values.collect())
    };
    vec![
        ("none", at.clone()),
        ("widths + 10 %", scaled(1.1, 0.0)),
        ("widths + 25 %", scaled(1.25, 0.0)),
        ("widths + 60 %", scaled(1.6, 0.0)),
        ("widths - 20 %", scaled(0.8, 0.0)),
        ("logit of colors + 1", scaled(1.0, 1.0)),
        ("logit of colors - 1", scaled(1.0, -1.0)),
    ]
}

/// Rms and largest difference in standard errors, and rms relative difference.
fn compare(a: &Estimates, b: &Estimates) -> (f64, f64, f64) {
    let (mut square, mut worst, mut relative, mut n) = (0.0, 0.0_f64, 0.0, 0.0);
    for (a, b) in a.configurations.iter().zip(&b.configurations) {
        for c in 0..3 {
            let z = (a.mean[c] - b.mean[c]) / a.standard_error[c].hypot(b.standard_error[c]);
            square += z * z;
            worst = worst.max(z.abs());
            relative += (a.mean[c] / b.mean[c] - 1.0).powi(2);
            n += 1.0;
        }
    }
    ((square / n).sqrt(), worst, (relative / n).sqrt())
}

/// CPU seconds of one evaluation: the least of several, as other work disturbs.
fn time(recording: &Recording, at: &Parameters, means: bool) -> f64 {
    let once = || {
        let recalled = if means {
            recording.means(at)
        } else {
            recording.estimate(at)
        };
        recalled.unwrap().estimates.cpu_s
    };
    (0..7).map(|_| once()).fold(f64::INFINITY, f64::min)
}

/// Bytes per second of summing an array much larger than the caches.
fn read_speed() -> f64 {
    let array = vec![1_u64; 32 << 20];
    let best = (0..5).map(|_| {
        let start = Instant::now();
        std::hint::black_box(array.iter().fold(0_u64, |a, b| a.wrapping_add(*b)));
        start.elapsed().as_secs_f64()
    });
    8.0 * array.len() as f64 / best.fold(f64::INFINITY, f64::min)
}

/// Operations per second of independent multiplications and additions, in the widest instructions the kernel uses.
fn multiply_add_speed() -> f64 {
    let rounds = 1 << 22;
    let best = (0..5).map(|_| {
        let start = Instant::now();
        let mut sums = std::hint::black_box([1.0_f32; 256]);
        multiply_add(&mut sums, rounds);
        std::hint::black_box(sums);
        start.elapsed().as_secs_f64()
    });
    2.0 * 256.0 * f64::from(rounds) / best.fold(f64::INFINITY, f64::min)
}

fn multiply_add(sums: &mut [f32; 256], rounds: u32) {
    #[cfg(target_arch = "x86_64")]
    {
        // Only to measure what instructions just detected can do.
        #[allow(unsafe_code)]
        if is_x86_feature_detected!("avx512f") {
            return unsafe { multiply_add_avx512(sums, rounds) };
        }
        #[allow(unsafe_code)]
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            return unsafe { multiply_add_avx2(sums, rounds) };
        }
    }
    for _ in 0..rounds {
        sums.iter_mut().for_each(|s| *s = *s * 0.999 + 0.001);
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,fma")]
fn multiply_add_avx512(sums: &mut [f32; 256], rounds: u32) {
    for _ in 0..rounds {
        sums.iter_mut().for_each(|s| *s = s.mul_add(0.999, 0.001));
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn multiply_add_avx2(sums: &mut [f32; 256], rounds: u32) {
    for _ in 0..rounds {
        sums.iter_mut().for_each(|s| *s = s.mul_add(0.999, 0.001));
    }
}
