//! Promise: the Khungurn BCSDF keeps its laws (normalization, energy, the published asymmetry) over the whole box of
//! Table II, checked by quadrature.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

#[path = "common/scatter_laws.rs"]
mod scatter_laws;

use goniofit::math::GaussLegendre;
use goniofit::scatter::albedo::{SphereRule, directional_albedo, reverse_albedo};
use goniofit::scatter::normalizer::lobe_normalizer;
use goniofit::scatter::{Khungurn, Model, Scattering};
use scatter_laws::{direction_deg, gaussian, khungurn};
use std::f64::consts::{FRAC_PI_2, TAU};

fn prepared(c_r: [f64; 3], c_tt: [f64; 3], widths_deg: [f64; 3]) -> Box<dyn Scattering> {
    Khungurn.prepare(&khungurn(c_r, c_tt, widths_deg)).unwrap()
}

/// `int gbar(th_o; -th_i, beta) cos^2 th_o dth_o`: at most 1.
fn kept(beta: f64, theta_i: f64) -> f64 {
    let g = lobe_normalizer(-theta_i, beta).value;
    GaussLegendre::new(16).integrate_panels(-FRAC_PI_2, FRAC_PI_2, 120, |t| {
        gaussian(t + theta_i, beta) * t.cos() * t.cos()
    }) / g
}

#[test]
fn the_azimuthal_lobe_integrates_to_one() {
    for gamma_deg in [1.0, 2.0, 10.0, 30.0, 45.0_f64] {
        // At theta_i = 0 with C_R = 0 and C_TT = 1 only the TT lobe is left.
        let s = prepared([0.0; 3], [1.0; 3], [5.0, 10.0, gamma_deg]);
        let wi = direction_deg(0.0, 33.0);
        let n = 2000;
        let azimuthal = |phi: f64| s.evaluate(wi, direction_deg(4.0, phi), 0.0).value[0];
        let sum: f64 = (0..n)
            .map(|k| azimuthal(360.0 * f64::from(k) / f64::from(n)))
            .sum();
        let beta = 10.0_f64.to_radians();
        let gbar = gaussian(4.0_f64.to_radians(), beta) / lobe_normalizer(0.0, beta).value;
        let integral = sum * TAU / f64::from(n) / gbar;
        assert!((integral - 1.0).abs() < 1e-12, "{gamma_deg}: {integral}");
    }
}

#[test]
fn control_eq_5_as_printed_does_not_integrate_to_one() {
    // gamma^-2 exp(cos) / (2 pi I_0(gamma^-2)), with I_0 from its own integral.
    let rule = GaussLegendre::new(32);
    for (gamma_deg, expected) in [(10.0_f64, 3e-12), (30.0, 0.55)] {
        let k = gamma_deg.to_radians().powi(-2);
        let whole = |f: &dyn Fn(f64) -> f64| rule.integrate_panels(0.0, TAU, 8, f);
        let integral = k * whole(&|p: f64| p.cos().exp()) / whole(&|p: f64| (k * p.cos()).exp());
        assert!(
            (integral / expected - 1.0).abs() < 0.2,
            "{gamma_deg}: {integral:e}"
        );
    }
}

#[test]
fn no_lobe_gains_energy_anywhere() {
    let mut least = 1.0_f64;
    for beta_deg in [1.0, 1.3, 2.0, 3.5, 5.0, 10.0, 17.0, 30.0, 45.0_f64] {
        for theta_deg in (0..=90).map(f64::from).chain([89.5, 89.9, 89.99]) {
            let l = kept(beta_deg.to_radians(), theta_deg.to_radians());
            assert!(
                (0.0..=1.0).contains(&l),
                "beta {beta_deg}, theta {theta_deg}: {l}"
            );
            least = least.min(l);
        }
    }
    // The published polynomial costs a narrow lobe much of its energy at grazing incidence.
    assert!((0.7..0.81).contains(&least), "{least}");
}

#[test]
fn the_sphere_integral_equals_the_one_dimensional_formula_and_its_bound_at_every_corner() {
    let colors = [
        ([0.001, 0.999, 0.001], [0.001, 0.001, 0.999]),
        ([0.999, 0.1, 0.5], [0.999, 0.85, 0.5]),
    ];
    for corner in 0..8 {
        let pick =
            |bit: usize, low: f64, high: f64| if corner >> bit & 1 == 0 { low } else { high };
        let widths = [pick(0, 1.0, 10.0), pick(1, 10.0, 45.0), pick(2, 1.0, 45.0)];
        let narrowest = widths
            .iter()
            .fold(10.0, |a, &b| f64::min(a, b))
            .to_radians();
        let rule = SphereRule::new(narrowest);
        for (c_r, c_tt) in colors {
            let s = prepared(c_r, c_tt, widths);
            for theta_deg in [0.0, 75.0, 89.0_f64] {
                let theta = theta_deg.to_radians();
                let albedo = directional_albedo(s.as_ref(), theta, &rule);
                let (l_r, l_tt) = (
                    kept(widths[0].to_radians(), theta),
                    kept(widths[1].to_radians(), theta),
                );
                for c in 0..3 {
                    let f = c_r[c] + (1.0 - c_r[c]) * (1.0 - theta.cos()).powi(5);
                    let expected = f * l_r + c_tt[c] * (1.0 - f) * l_tt;
                    let bound = f + c_tt[c] * (1.0 - f);
                    let context = format!("{widths:?} {theta_deg}: {} {expected}", albedo[c]);
                    assert!((albedo[c] - expected).abs() < 1e-9, "{context}");
                    assert!(albedo[c] <= bound && bound <= 1.0, "{context} {bound}");
                }
            }
        }
    }
}

#[test]
fn the_asymmetry_is_the_measured_one() {
    let s = prepared([0.1; 3], [0.85; 3], [5.0, 10.0, 10.0]);
    let table = [
        (0.0, 5.0, 0.992),
        (20.0, -25.0, 0.931),
        (45.0, -40.0, 1.18),
        (60.0, -50.0, 1.88),
        (75.0, -65.0, 4.27),
        (80.0, -70.0, 6.38),
    ];
    for (theta_i, theta_o, expected) in table {
        let (wi, wo) = (
            direction_deg(theta_i, 0.0),
            direction_deg(theta_o, 2.5_f64.to_degrees()),
        );
        let ratio = s.evaluate(wi, wo, 0.0).value[0] / s.evaluate(wo, wi, 0.0).value[0];
        assert!(
            (ratio / expected - 1.0).abs() < 4e-3,
            "{theta_i} {theta_o}: {ratio}"
        );
    }
}

#[test]
fn the_reverse_albedo_is_not_the_albedo() {
    let wide = prepared([0.0; 3], [1.0; 3], [5.0, 45.0, 45.0]);
    let rule = SphereRule::new(5.0_f64.to_radians());
    let narrow = prepared([1.0; 3], [0.5; 3], [1.0, 10.0, 45.0]);
    let fine = SphereRule::new(1.0_f64.to_radians());
    let at = |s: &dyn Scattering, theta_deg: f64, rule| {
        reverse_albedo(s, theta_deg.to_radians(), rule)[0]
    };
    let found = [
        (at(wide.as_ref(), 0.0, &rule), 1.13),
        (at(wide.as_ref(), 88.0, &rule), 0.53),
        (at(narrow.as_ref(), 88.0, &fine), 0.69),
    ];
    for (value, expected) in found {
        assert!((value - expected).abs() < 0.006, "{value} {expected}");
    }
    // Control: the forward albedo is elsewhere.
    let forward = directional_albedo(wide.as_ref(), 88.0_f64.to_radians(), &rule)[0];
    assert!((forward - 0.53).abs() > 0.4, "{forward}");
}

#[test]
fn meaningless_parameters_are_refused_and_unusual_ones_accepted() {
    let prepare = |c_r: f64, beta_r: f64, gamma: f64| {
        Khungurn.prepare(&khungurn([c_r; 3], [0.5; 3], [beta_r, 10.0, gamma]))
    };
    for (c_r, beta_r, gamma) in [(0.0, 32.0, 57.0), (1.0, 0.01, 0.01), (0.5, 360.0, 360.0)] {
        let s = prepare(c_r, beta_r, gamma).unwrap();
        let e = s.evaluate(direction_deg(30.0, 0.0), direction_deg(-30.0, 180.0), 0.0);
        assert!(e.value.iter().all(|v| v.is_finite() && *v > 0.0), "{e:?}");
    }
    for (c_r, beta_r, gamma, key) in [
        (-0.1, 5.0, 10.0, "'c_r' is -0.1, expected 0 to 1"),
        (1.1, 5.0, 10.0, "'c_r' is 1.1"),
        (0.5, 0.0, 10.0, "'beta_r_deg' is 0, expected 0.01 to 360"),
        (0.5, 5.0, -1.0, "'gamma_tt_deg' is -1"),
        (f64::NAN, 5.0, 10.0, "'c_r' is NaN"),
        (0.5, f64::NAN, 10.0, "'beta_r_deg' is NaN"),
        (0.5, f64::INFINITY, 10.0, "'beta_r_deg' is inf"),
    ] {
        let Err(error) = prepare(c_r, beta_r, gamma) else {
            panic!("{key} was accepted");
        };
        let report = error.report();
        assert!(
            report.contains(key) && report.contains("\nhint: the published range"),
            "{report}"
        );
    }
}
