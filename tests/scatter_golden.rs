//! Promise: the Khungurn BCSDF, its derivatives, its normalizer and its energy equal values computed with 30 digits.
#![allow(
    clippy::unwrap_used,
    clippy::float_cmp,
    clippy::needless_range_loop,
    missing_docs
)]

#[path = "common/scatter_laws.rs"]
mod scatter_laws;

use goniofit::math::GaussLegendre;
use goniofit::math::special::i0e;
use goniofit::scatter::normalizer::{NormalizerTable, lobe_normalizer};
use goniofit::scatter::{Evaluation, Khungurn, Model};
use scatter_laws::{direction_deg, gaussian, khungurn};
use serde_json::Value;
use std::f64::consts::FRAC_PI_2;

/// Value and the five derivative rows, each for three channels.
type Six = [[f64; 3]; 6];

struct Row {
    angles_deg: [f64; 4],
    c_r: [f64; 3],
    c_tt: [f64; 3],
    widths_deg: [f64; 3],
    expected: Six,
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap()
}

fn three(value: &Value) -> [f64; 3] {
    std::array::from_fn(|c| number(&value[c]))
}

fn file(text: &str, list: &str) -> Vec<Value> {
    let file: Value = serde_json::from_str(text).unwrap();
    file[list].as_array().unwrap().clone()
}

fn bcsdf_rows() -> Vec<Row> {
    file(include_str!("data/khungurn_bcsdf.json"), "rows")
        .iter()
        .map(|row| Row {
            angles_deg: std::array::from_fn(|k| number(&row[k + 1])),
            c_r: three(&row[5]),
            c_tt: three(&row[6]),
            widths_deg: std::array::from_fn(|k| number(&row[k + 7])),
            expected: std::array::from_fn(|k| three(&row[k + 10])),
        })
        .collect()
}

impl Row {
    fn evaluate(&self, swapped: bool) -> Evaluation {
        let [theta_i, phi_i, theta_o, phi_o] = self.angles_deg;
        let (wi, wo) = (direction_deg(theta_i, phi_i), direction_deg(theta_o, phi_o));
        let parameters = khungurn(self.c_r, self.c_tt, self.widths_deg);
        let scattering = Khungurn.prepare(&parameters).unwrap();
        if swapped {
            scattering.evaluate(wo, wi, 0.0)
        } else {
            scattering.evaluate(wi, wo, 0.0)
        }
    }

    /// Error in units of the tolerance `1e-9 max(|S|, |dS|) + 1e-30`: at most 1 passes.
    fn error(&self, found: &Six) -> f64 {
        let mut worst = 0.0_f64;
        for k in 0..6 {
            for c in 0..3 {
                let (x, y) = (found[k][c], self.expected[k][c]);
                let tolerance = 1e-9 * self.expected[0][c].abs().max(y.abs()) + 1e-30;
                let error = (x - y).abs() / tolerance;
                assert!(
                    error.is_finite(),
                    "{x} against {y} at {:?}",
                    self.angles_deg
                );
                worst = worst.max(error);
            }
        }
        worst
    }
}

fn six(e: &Evaluation) -> Six {
    let d = &e.derivative;
    [e.value, d[0], d[1], d[2], d[3], d[4]]
}

#[test]
fn values_and_derivatives_match_200_rows() {
    let rows = bcsdf_rows();
    assert_eq!(rows.len(), 200);
    let worst = rows
        .iter()
        .map(|r| r.error(&six(&r.evaluate(false))))
        .fold(0.0, f64::max);
    println!("worst error: {worst:.1e} of the tolerance");
    assert!(worst <= 1.0, "{worst}");
}

#[test]
fn control_wrong_bcsdfs_fail_the_same_comparison() {
    let rows = bcsdf_rows();
    let failures =
        |wrong: &dyn Fn(&Row) -> Six| rows.iter().filter(|r| r.error(&wrong(r)) > 1.0).count();
    // Eq. 5 as printed: gamma^-2 before the exponential instead of inside.
    let printed = failures(&|row| {
        let mut found = six(&row.evaluate(false));
        let k = row.widths_deg[2].to_radians().powi(-2);
        let cos = -(row.angles_deg[3] - row.angles_deg[1]).to_radians().cos();
        let ratio = k * (cos - k).exp() / (k * (cos - 1.0)).exp();
        for c in 0..3 {
            let tt = row.c_tt[c] * found[2][c];
            found[0][c] += tt * (ratio - 1.0);
        }
        found
    });
    let swapped = failures(&|row| six(&row.evaluate(true)));
    let per_degree = failures(&|row| {
        let mut found = six(&row.evaluate(false));
        found[5] = found[5].map(f64::to_radians);
        found
    });
    println!(
        "rows that fail: printed eq. 5 {printed}, directions swapped {swapped}, per degree {per_degree}"
    );
    assert!(printed > 150 && swapped > 150 && per_degree > 150);
}

fn normalizer_rows() -> Vec<(f64, f64, f64, Option<f64>)> {
    file(include_str!("data/khungurn_normalizer.json"), "rows")
        .iter()
        .map(|r| {
            (
                number(&r[0]).to_radians(),
                number(&r[1]).to_radians(),
                number(&r[2]),
                r[3].as_f64(),
            )
        })
        .collect()
}

#[test]
fn the_normalizer_matches_2506_rows_in_closed_form_and_from_the_table() {
    let rows = normalizer_rows();
    assert_eq!(
        (rows.len(), rows.iter().filter(|r| r.3.is_some()).count()),
        (2506, 560)
    );
    let mut table = (0.0, NormalizerTable::new(1.0));
    let mut worst = [0.0_f64; 4];
    for &(sigma, mu, g, by_sigma) in &rows {
        if table.0 != sigma {
            table = (sigma, NormalizerTable::new(sigma));
        }
        let closed = lobe_normalizer(mu, sigma);
        let (from_table, slope_from_table) = table.1.normalizer((0.5 * mu).tan());
        let mut see = |k: usize, found: f64, expected: f64| {
            let error = (found / expected - 1.0).abs();
            assert!(error.is_finite());
            worst[k] = worst[k].max(error);
        };
        see(0, closed.value, g);
        see(1, from_table, g);
        if let Some(expected) = by_sigma {
            see(2, closed.by_sigma, expected);
            see(3, slope_from_table, expected);
        }
    }
    println!("worst relative error, G closed, G table, dG closed, dG table: {worst:?}");
    assert!(worst[0] <= 1e-12 && worst[1] <= 1e-12 && worst[2] <= 1e-10 && worst[3] <= 1e-10);
}

#[test]
fn control_a_normalizer_with_cos_squared_fails() {
    let rule = GaussLegendre::new(20);
    for (sigma, mu, g, _) in normalizer_rows().into_iter().step_by(97) {
        let exact_cosine = rule.integrate_adaptive(-FRAC_PI_2, FRAC_PI_2, 1e-13, |t| {
            gaussian(t - mu, sigma) * t.cos() * t.cos()
        });
        let difference = g / exact_cosine - 1.0;
        assert!(difference > 1e-5, "{sigma} {mu}: {difference:e}");
    }
}

/// `int gbar(th_o; -th_i, beta) f(th_o) dth_o`.
fn lobe_integral(beta: f64, theta_i: f64, f: impl Fn(f64) -> f64) -> f64 {
    let g = lobe_normalizer(-theta_i, beta).value;
    GaussLegendre::new(20).integrate_adaptive(-FRAC_PI_2, FRAC_PI_2, 1e-13, |t| {
        gaussian(t + theta_i, beta) * f(t)
    }) / g
}

#[test]
fn the_energy_of_a_lobe_matches_all_rows() {
    let rows = file(include_str!("data/khungurn_energy.json"), "lossless");
    assert_eq!(rows.len(), 78);
    for row in &rows {
        let (beta, theta_i) = (number(&row[0]).to_radians(), number(&row[1]).to_radians());
        let expected = number(&row[2]);
        let found = lobe_integral(beta, theta_i, |t| t.cos() * t.cos());
        assert!((found / expected - 1.0).abs() <= 1e-9, "{row}: {found}");
        // Control: with one cosine instead of two the comparison fails.
        let wrong = lobe_integral(beta, theta_i, f64::cos);
        assert!((wrong / expected - 1.0).abs() > 1e-6, "{row}: {wrong}");
    }
}

#[test]
fn the_integrals_over_incoming_angles_match_all_rows() {
    let rows = file(include_str!("data/khungurn_energy.json"), "volume");
    assert_eq!(rows.len(), 20);
    for row in &rows {
        let (beta, theta_o) = (number(&row[0]).to_radians(), number(&row[1]).to_radians());
        let over_incoming = |f: &dyn Fn(f64) -> f64| {
            GaussLegendre::new(20).integrate_adaptive(-FRAC_PI_2, FRAC_PI_2, 1e-12, |t| {
                gaussian(t + theta_o, beta) / lobe_normalizer(-t, beta).value * f(t)
            })
        };
        let k0 = over_incoming(&f64::cos);
        let k5 = over_incoming(&|t| t.cos() * (2.0 * (0.5 * t).sin().powi(2)).powi(5));
        assert!((k0 / number(&row[2]) - 1.0).abs() <= 1e-9, "{row}: {k0}");
        assert!((k5 / number(&row[3]) - 1.0).abs() <= 1e-9, "{row}: {k5}");
    }
}

#[test]
fn control_the_scaled_bessel_function_is_needed() {
    // exp(k) and I_0(k) overflow at gamma = 1 degree; the scaled form does not.
    let k = 1.0_f64.to_radians().powi(-2);
    assert!(k.exp().is_infinite() && i0e(k).is_normal());
}
