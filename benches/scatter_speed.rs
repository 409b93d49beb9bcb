//! Time of one evaluation and one sample of every model of fibers and of media, beside the error against 25- and 30-digit
//! values.
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
use goniofit::scatter::media::{KhungurnVolume, MediumModel, Microflake};
use goniofit::scatter::{Chiang, Khungurn, Model, Parameters, fiber_direction};
use serde_json::Value;
use std::hint::black_box;
use std::time::Instant;

fn main() {
    let khungurn = rows(include_str!("../tests/data/khungurn_bcsdf.json"));
    println!(
        "khungurn: largest |error| / max(|S|, |dS|) over {} rows: {:.1e}",
        khungurn.len(),
        worst_khungurn(&khungurn)
    );
    let chiang = rows(include_str!("../tests/data/chiang.json"));
    println!(
        "chiang: largest |error| / |S| over {} rows: {:.1e}",
        chiang.len(),
        worst_chiang(&chiang)
    );
    println!(
        "{:>32} {:>12} {:>12} {:>12} {:>12}",
        "", "prepare us", "evaluate ns", "importance ns", "sample ns"
    );
    for (beta_r, gamma) in [(5.0, 10.0), (1.0, 38.0), (1.0, 1.0), (10.0, 45.0_f64)] {
        let mut values = Parameters::defaults(&Khungurn).values().to_vec();
        values[6] = f64::to_radians(beta_r);
        values[8] = gamma.to_radians();
        let name = format!("beta_r {beta_r}, gamma_tt {gamma} deg");
        report(&Khungurn, &name, values);
    }
    for (beta_m, beta_n) in [(0.3, 0.3), (0.05, 0.05), (1.0, 1.0)] {
        let name = format!("chiang beta_m {beta_m}, beta_n {beta_n}");
        report(&Chiang, &name, vec![0.8, 0.5, 0.2, beta_m, beta_n]);
    }
    media();
}

/// Prints the times of media, beside the error of flakes against 25-digit values.
fn media() {
    let golden: Value =
        serde_json::from_str(include_str!("../tests/data/microflake.json")).unwrap();
    let areas = golden["projected_area"].as_array().unwrap();
    println!(
        "\nmicroflake: largest |error| / s over {} rows: {:.1e}",
        areas.len(),
        worst_area(areas)
    );
    println!(
        "{:>32} {:>12} {:>12} {:>12} {:>12} {:>12}",
        "", "prepare us", "extinct. ns", "evaluate ns", "importance ns", "sample ns"
    );
    for gamma in [0.005, 0.013, 0.1, 1.5] {
        let values = vec![0.9, 0.4, 0.1, gamma];
        report_medium(&Microflake, &format!("microflake gamma {gamma}"), values);
    }
    // Fits of Khungurn 2015, Table IV 4b, and the defaults.
    for (name, colors, widths_deg, albedo) in [
        (
            "defaults",
            [[0.1; 3], [0.85; 3]],
            [5.0, 10.0, 10.0],
            [0.85; 3],
        ),
        (
            "gabardine",
            [[0.11, 0.035, 0.048], [0.868, 0.633, 0.592]],
            [5.034, 10.0, 23.902],
            [0.993, 0.651, 0.698],
        ),
        (
            "silk",
            [[0.992, 0.001, 0.034], [0.002, 0.69, 0.57]],
            [1.0, 10.0, 13.9],
            [0.94, 0.746, 0.773],
        ),
    ] {
        let widths = widths_deg.map(f64::to_radians);
        let values = [colors[0], colors[1], widths, albedo].concat();
        report_medium(&KhungurnVolume, &format!("volume {name}"), values);
    }
}

/// Prints one row of times of a medium.
fn report_medium(model: &dyn MediumModel, name: &str, values: Vec<f64>) {
    let parameters = Parameters::defaults(model).with_values(values);
    let prepare = best_of(3, 5, || {
        black_box(model.prepare(black_box(&parameters)).unwrap());
    });
    let medium = model.prepare(&parameters).unwrap();
    let mut random = Random::keyed(&[1]);
    let pairs = pairs(&mut random);
    let mut next = 0;
    let mut pair = || {
        next = (next + 1) % pairs.len();
        black_box(pairs[next])
    };
    let carried = [1.0, 0.7, 0.4];
    let extinction = best_of(7, 400_000, || {
        black_box(medium.extinction(pair().0));
    });
    let evaluate = best_of(7, 400_000, || {
        let (wi, wo, _) = pair();
        black_box(medium.evaluate(wi, wo));
    });
    let value = best_of(7, 400_000, || {
        let (wi, wo, _) = pair();
        black_box(medium.importance(wi, &medium.outgoing(wo, carried)));
    });
    let sample = best_of(7, 200_000, || {
        let (_, wo, _) = pair();
        black_box(medium.sample(&medium.outgoing(wo, carried), &mut random));
    });
    println!(
        "{name:>32} {:>12.0} {extinction:>12.1} {evaluate:>12.1} {value:>12.1} {sample:>12.1}",
        prepare / 1e3
    );
}

fn worst_area(rows: &[Value]) -> f64 {
    rows.iter()
        .map(|row| {
            let number = |k: usize| row[k].as_f64().unwrap();
            let values = vec![1.0, 1.0, 1.0, number(0)];
            let medium = Microflake.prepare(&Parameters::defaults(&Microflake).with_values(values));
            let theta = std::f64::consts::FRAC_PI_2 - number(1).to_radians();
            let w = fiber_direction(theta, 0.0);
            (medium.unwrap().extinction(w) / number(2) - 1.0).abs()
        })
        .fold(0.0, f64::max)
}

/// Pairs of directions and places across the fiber.
fn pairs(random: &mut Random) -> Vec<(DVec3, DVec3, f64)> {
    (0..4096)
        .map(|_| {
            let mut w = || {
                let sin: f64 = 2.0 * random.uniform() - 1.0;
                fiber_direction(sin.asin(), std::f64::consts::TAU * random.uniform())
            };
            let (wi, wo) = (w(), w());
            (wi, wo, 2.0 * random.uniform() - 1.0)
        })
        .collect()
}

fn rows(text: &str) -> Vec<Value> {
    let golden: Value = serde_json::from_str(text).unwrap();
    golden["rows"].as_array().unwrap().clone()
}

/// Prints one row of times.
fn report(model: &dyn Model, name: &str, values: Vec<f64>) {
    let parameters = Parameters::defaults(model).with_values(values);
    let prepare = best_of(5, 20, || {
        black_box(model.prepare(black_box(&parameters)).unwrap());
    });
    let scattering = model.prepare(&parameters).unwrap();
    let mut random = Random::keyed(&[1]);
    let pairs = pairs(&mut random);
    let mut next = 0;
    let mut pair = || {
        next = (next + 1) % pairs.len();
        black_box(pairs[next])
    };
    let evaluate = best_of(7, 400_000, || {
        let (wi, wo, h) = pair();
        black_box(scattering.evaluate(wi, wo, h));
    });
    let value = best_of(7, 400_000, || {
        let (wi, wo, h) = pair();
        black_box(scattering.importance(wi, &scattering.outgoing(wo, h, [1.0; 3])));
    });
    let sample = best_of(7, 200_000, || {
        let (_, wo, h) = pair();
        black_box(scattering.sample(&scattering.outgoing(wo, h, [1.0; 3]), &mut random));
    });
    println!(
        "{name:>32} {:>12.0} {evaluate:>12.1} {value:>12.1} {sample:>12.1}",
        prepare / 1e3
    );
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

fn worst_khungurn(rows: &[Value]) -> f64 {
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

fn worst_chiang(rows: &[Value]) -> f64 {
    rows.iter()
        .map(|row| {
            let number = |k: usize| row[k].as_f64().unwrap();
            let values = vec![number(6), number(6), number(6), number(4), number(5)];
            let parameters = Parameters::defaults(&Chiang).with_values(values);
            let scattering = Chiang.prepare(&parameters).unwrap();
            let wi = fiber_direction(number(0), number(2));
            let wo = fiber_direction(number(1), 0.0);
            let found = scattering.evaluate(wi, wo, number(3)).value[0];
            (found / number(11) - 1.0).abs()
        })
        .fold(0.0, f64::max)
}
