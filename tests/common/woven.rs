//! What the tests of woven surfaces share: published rows, shapes and directions.

#![allow(dead_code)]

use glam::DVec3;
use goniofit::math::Random;
use goniofit::scatter::surface::woven::Shape;
use serde_json::Value;

/// A row of `irawan_brdf.json`.
pub(crate) struct Row {
    pub(crate) set: String,
    pub(crate) shape: Shape,
    pub(crate) wi: DVec3,
    pub(crate) wr: DVec3,
    pub(crate) value: f64,
    pub(crate) trapezoid: f64,
}

pub(crate) fn rows() -> Vec<Row> {
    let file: Value = serde_json::from_str(include_str!("../data/irawan_brdf.json")).unwrap();
    let rows = file["rows"].as_array().unwrap();
    rows.iter()
        .map(|r| {
            let number = |key: &str| r[key].as_f64().unwrap();
            let vector = |key: &str| {
                let v: Vec<f64> = serde_json::from_value(r[key].clone()).unwrap();
                DVec3::from_slice(&v)
            };
            Row {
                set: r["set"].as_str().unwrap().to_owned(),
                shape: Shape {
                    twist: number("psi_deg").to_radians(),
                    inclination: number("u_max_deg").to_radians(),
                    curvature: number("kappa"),
                    uniform: number("alpha"),
                    forward: number("beta"),
                    smoothing: number("delta"),
                    width: number("w"),
                    length: number("l"),
                },
                wi: vector("omega_i"),
                wr: vector("omega_r"),
                value: number("f_rs"),
                trapezoid: number("trap11"),
            }
        })
        .collect()
}

/// The seed of all tests with random inputs; the variable `SEED` overrides it.
pub(crate) fn stream(key: u64) -> Random {
    let seed = std::env::var("SEED").map_or(2008, |s| s.parse().expect("SEED is a number"));
    Random::keyed(&[seed, key])
}

/// A direction above the surface, uniform in the projected hemisphere.
pub(crate) fn above(random: &mut Random) -> DVec3 {
    let (sin, azimuth) = (
        random.uniform().sqrt(),
        std::f64::consts::TAU * random.uniform(),
    );
    let (sp, cp) = azimuth.sin_cos();
    DVec3::new(sin * cp, sin * sp, (1.0 - sin * sin).sqrt())
}

/// A shape of a fit's range: one in four a filament, one in four nearly one.
pub(crate) fn shape(random: &mut Random) -> Shape {
    let mut between = |low: f64, high: f64| low + (high - low) * random.uniform();
    let kind = between(0.0, 4.0) as u32;
    let twist = match kind {
        0 => 0.0,
        1 => between(-0.05, 0.05),
        _ => between(-1.5, 1.5),
    };
    Shape {
        twist,
        inclination: between(0.1, 1.4),
        curvature: between(-0.9, 3.0),
        uniform: between(0.0, 0.2),
        forward: between(0.0, 12.0),
        smoothing: if kind < 2 { between(0.3, 1.0) } else { 0.0 },
        width: 0.4,
        length: between(0.45, 3.0),
    }
}

/// The value at a share of a list, which gets sorted.
pub(crate) fn quantile(list: &mut [f64], share: f64) -> f64 {
    list.sort_by(f64::total_cmp);
    list[((list.len() - 1) as f64 * share).round() as usize]
}
