//! Promise: media equal values computed with 25 digits.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

#[path = "common/scatter_laws.rs"]
mod scatter_laws;

#[path = "common/media.rs"]
mod media_cases;

use glam::DVec3;
use goniofit::math::special::{erf_inv, normal_probability};
use goniofit::scatter::media::{FlakeDistribution, KhungurnVolume, MediumModel, Microflake};
use goniofit::scatter::{Khungurn, Model};
use media_cases::{microflake, volume};
use scatter_laws::{direction_deg, khungurn};
use serde_json::Value;

fn golden(list: &str) -> Vec<Value> {
    let file: Value = serde_json::from_str(include_str!("data/microflake.json")).unwrap();
    file[list].as_array().unwrap().clone()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap()
}

/// A vector of the golden file, whose fibers lie along z.
fn vector(value: &Value) -> DVec3 {
    DVec3::new(number(&value[2]), number(&value[0]), number(&value[1]))
}

#[test]
fn projected_areas_match_100_rows_by_quadrature_and_from_the_table() {
    let rows = golden("projected_area");
    assert_eq!(rows.len(), 100);
    let mut worst = [0.0_f64; 3];
    for row in &rows {
        let (gamma, theta) = (number(&row[0]), number(&row[1]).to_radians());
        let flakes = FlakeDistribution::new(gamma);
        let found = [
            flakes.integrate(theta.sin()),
            flakes.projected_area(theta.sin()),
        ];
        for (k, found) in found.into_iter().enumerate() {
            worst[k] = worst[k].max((found[0] / number(&row[2]) - 1.0).abs());
        }
        // Control: an ellipse through the two axes is up to 4 % off.
        let axes = [0.0, 1.0].map(|sine| flakes.integrate(sine)[0]);
        let ellipse = (axes[0] * theta.cos()).hypot(axes[1] * theta.sin());
        worst[2] = worst[2].max((ellipse / number(&row[2]) - 1.0).abs());
    }
    println!("largest relative error: quadrature, table, ellipse: {worst:?}");
    assert!(worst[0] <= 1e-13 && worst[1] <= 1e-12 && worst[2] > 0.03);
}

#[test]
fn microflake_phase_functions_match_120_rows() {
    let rows = golden("phase");
    assert_eq!(rows.len(), 120);
    let (mut exact, mut by_vectors, mut failures) = (0.0_f64, 0.0_f64, 0);
    for row in &rows {
        let (gamma, expected) = (number(&row[0]), number(&row[5]));
        let (wo, wi) = (vector(&row[1]), -vector(&row[2]));
        let flakes = FlakeDistribution::new(gamma);
        let s = flakes.projected_area(wo.y.hypot(wo.z))[0];
        let found = 0.5 * flakes.density(number(&row[3])).0 / s;
        exact = exact.max((found / expected - 1.0).abs());
        let medium = Microflake.prepare(&microflake([1.0; 3], gamma)).unwrap();
        let value = |wi: DVec3| medium.evaluate(wi, wo).value[0] / expected - 1.0;
        by_vectors = by_vectors.max(value(wi).abs());
        // Control: the arriving light's direction of flight in place of the direction toward it.
        failures += usize::from(value(-wi).abs() > 1e-6);
    }
    println!("worst: {exact:.1e} at the file's h, {by_vectors:.1e} at its rounded vectors");
    // Vectors of 12 digits move h by 2e-11, and a distribution of width 0.005 by 1e-8.
    assert!(
        exact < 1e-10 && by_vectors < 1e-7 && failures > 110,
        "{failures}"
    );
}

#[test]
fn the_inverse_of_the_flakes_distribution_matches_45_rows_and_knows_its_ends() {
    let rows = golden("inverse");
    assert_eq!(rows.len(), 45);
    for row in &rows {
        let (found, expected) = (
            FlakeDistribution::new(number(&row[0])).cosine(number(&row[1])),
            number(&row[2]),
        );
        assert!(
            (found - expected).abs() <= 1e-13 * expected.abs(),
            "{row}: {found}"
        );
    }
    // Above 0.12 the error function of 1/(sqrt2 gamma) still differs from 1 in f64, below it does not, and its inverse is infinite.
    for gamma in [0.005, 0.1, 0.12, 0.13, 0.5, 1.5, 100.0] {
        let flakes = FlakeDistribution::new(gamma);
        let ends = [flakes.cosine(0.0), -flakes.cosine(1.0)];
        assert!(
            ends.iter().all(|end| (end - 1.0).abs() < 1e-13),
            "{gamma}: {ends:?}"
        );
        assert_eq!(flakes.cosine(0.5), 0.0);
        let mut before = 1.0;
        for xi in [
            1e-300,
            2.0_f64.powi(-53),
            1e-9,
            0.3,
            0.7,
            1.0 - 2.0_f64.powi(-53),
        ] {
            let mu = flakes.cosine(xi);
            assert!((-1.0..=before).contains(&mu), "{gamma} {xi}: {mu}");
            before = mu;
        }
        // Control: by the error function alone, the end is elsewhere where it is nearly 1.
        let alone = 2.0_f64.sqrt() * gamma * erf_inv(error_function(gamma));
        assert_eq!(
            (alone - 1.0).abs() > 1e-4,
            gamma < 0.125,
            "{gamma}: {alone}"
        );
    }
}

/// `erf(1/(sqrt2 gamma))`.
fn error_function(gamma: f64) -> f64 {
    2.0 * normal_probability(0.0, 1.0 / gamma)
}

#[test]
fn the_volume_normalizer_is_the_known_one() {
    // C_R .1, C_TT .85; (beta_R, beta_TT, theta_o, Z).
    let table = [
        (5.0, 10.0, 0.0, 0.901),
        (5.0, 10.0, 45.0, 1.257),
        (5.0, 10.0, 60.0, 1.658),
        (5.0, 10.0, 80.0, 3.280),
        (5.0, 10.0, 89.0, 2.54),
        (1.0, 10.0, 80.0, 3.678),
        (1.0, 10.0, 88.0, 18.4),
        (1.0, 10.0, 89.0, 17.8),
    ];
    for (beta_r, beta_tt, theta_o, expected) in table {
        let widths = [beta_r, beta_tt, 10.0];
        let fiber = Khungurn
            .prepare(&khungurn([0.1; 3], [0.85; 3], widths))
            .unwrap();
        let medium = KhungurnVolume
            .prepare(&volume([0.1; 3], [0.85; 3], widths, [0.4; 3]))
            .unwrap();
        let (wi, wo) = (direction_deg(-70.0, 160.0), direction_deg(theta_o, 0.0));
        let s = fiber.evaluate(wi, wo, 0.0).value[1];
        let z = 0.4 * s / medium.evaluate(wi, wo).value[1];
        // The printed digits allow 3 in 1000.
        assert!((z / expected - 1.0).abs() < 3e-3, "{beta_r} {theta_o}: {z}");
    }
}
