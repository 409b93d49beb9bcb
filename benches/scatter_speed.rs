//! Time of one evaluation and one sample of the Khungurn BCSDF, beside the error against 30-digit values.
//!
//! `cargo bench --bench scatter_speed`

#![allow(
    clippy::unwrap_used,
    clippy::needless_range_loop,
    clippy::print_stdout,
    missing_docs
)]

use glam::DVec3;
use goniofit::math::Random;
use goniofit::scatter::{Khungurn, Model, Parameters, fiber_direction};
use serde_json::Value;
use std::hint::black_box;
use std::time::Instant;

fn main() {
    let golden: Value =
        serde_json::from_str(include_str!("../tests/data/khungurn_bcsdf.json")).unwrap();
    let rows = golden["rows"].as_array().unwrap();
    println!(
        "largest |error| / max(|S|, |dS|) over {} rows: {:.1e}",
        rows.len(),
        worst(rows)
    );

    let defaults = Parameters::defaults(&Khungurn);
    println!(
        "{:>18} {:>12} {:>12} {:>12}",
        "beta_r, gamma_tt", "prepare us", "evaluate ns", "sample ns"
    );
    for (beta_r, gamma) in [(5.0, 10.0), (1.0, 38.0), (1.0, 1.0), (10.0, 45.0_f64)] {
        let mut values = defaults.values().to_vec();
        values[6] = f64::to_radians(beta_r);
        values[8] = gamma.to_radians();
        let parameters = defaults.with_values(values);
        let prepare = best_of(5, 20, || {
            black_box(Khungurn.prepare(black_box(&parameters)).unwrap());
        });
        let scattering = Khungurn.prepare(&parameters).unwrap();
        let mut random = Random::keyed(&[1]);
        let pairs: Vec<(DVec3, DVec3)> = (0..4096)
            .map(|_| {
                let mut w = || {
                    let sin: f64 = 2.0 * random.uniform() - 1.0;
                    fiber_direction(sin.asin(), std::f64::consts::TAU * random.uniform())
                };
                (w(), w())
            })
            .collect();
        let mut next = 0;
        let evaluate = best_of(7, 400_000, || {
            next = (next + 1) % pairs.len();
            let (wi, wo) = pairs[next];
            black_box(scattering.evaluate(black_box(wi), black_box(wo), 0.0));
        });
        let sample = best_of(7, 200_000, || {
            next = (next + 1) % pairs.len();
            black_box(scattering.sample(black_box(pairs[next].1), 0.0, [1.0; 3], &mut random));
        });
        println!(
            "{:>18} {:>12.0} {:>12.1} {:>12.1}",
            format!("{beta_r}, {gamma} deg"),
            prepare / 1e3,
            evaluate,
            sample
        );
    }
}

/// Nanoseconds per call, the best of `rounds` rounds.
fn best_of(rounds: usize, calls: usize, mut f: impl FnMut()) -> f64 {
    (0..rounds)
        .map(|_| {
            let start = Instant::now();
            for _ in 0..calls {
                f();
            }
            start.elapsed().as_secs_f64() * 1e9 / calls as f64
        })
        .fold(f64::INFINITY, f64::min)
}

fn worst(rows: &[Value]) -> f64 {
    let number = |v: &Value| v.as_f64().unwrap();
    let three = |v: &Value| -> [f64; 3] { std::array::from_fn(|c| number(&v[c])) };
    let mut worst = 0.0_f64;
    for row in rows {
        let mut values = three(&row[5]).to_vec();
        values.extend(three(&row[6]));
        values.extend((7..10).map(|k| number(&row[k]).to_radians()));
        let parameters = Parameters::defaults(&Khungurn).with_values(values);
        let scattering = Khungurn.prepare(&parameters).unwrap();
        let angle = |k: usize| number(&row[k]).to_radians();
        let e = scattering.evaluate(
            fiber_direction(angle(1), angle(2)),
            fiber_direction(angle(3), angle(4)),
            0.0,
        );
        let s = three(&row[10]);
        for c in 0..3 {
            let check = |found: f64, expected: f64| {
                (found - expected).abs() / (s[c].abs().max(expected.abs()) + 1e-30)
            };
            worst = worst.max(check(e.value[c], s[c]));
            for k in 0..5 {
                worst = worst.max(check(e.derivative[k][c], three(&row[11 + k])[c]));
            }
        }
    }
    worst
}
