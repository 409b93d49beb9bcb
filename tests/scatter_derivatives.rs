//! Promise: every derivative of every scattering model equals finite differences of its value, at the edges of the domain
//! too, and stays finite where directions or widths degenerate.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

#[path = "common/scatter_laws.rs"]
mod scatter_laws;

use glam::DVec3;
use goniofit::scatter::{CHANNELS, Chiang, Khungurn, Model, Parameters, models};
use scatter_laws::{chiang, derivative_error, direction_deg, khungurn};

/// What the five-point differences allow.
const TOLERANCE: f64 = 1e-6;

fn pairs() -> Vec<(DVec3, DVec3)> {
    [
        (0.0, 0.0, 0.0, 180.0),
        (0.0, 0.0, 1.0, 179.5),
        (30.0, 10.0, -31.0, 189.0),
        (-70.0, 0.0, 68.5, 181.0),
        (89.5, 20.0, -89.0, 199.5),
        (-90.0, 0.0, 89.9, 180.0),
        (45.0, 0.0, -44.0, 0.0),
    ]
    .map(|(ti, pi, to, po)| (direction_deg(ti, pi), direction_deg(to, po)))
    .into()
}

fn worst(model: &dyn Model, parameters: &Parameters) -> f64 {
    let mut worst = 0.0_f64;
    for (wi, wo) in pairs() {
        for h in [0.0, -0.002, 0.6, 1.0] {
            let at = (wi, wo, h);
            let error = derivative_error(model, parameters, at, |s| s.evaluate(wi, wo, h));
            assert!(
                error < TOLERANCE,
                "{error:.1e} at {wi}, {wo}, h {h}: {parameters:?}"
            );
            worst = worst.max(error);
        }
    }
    worst
}

#[test]
fn all_models_at_their_defaults_and_at_every_bound() {
    for model in models() {
        let defaults = Parameters::defaults(*model);
        let mut largest = worst(*model, &defaults);
        for (slot, (row, _)) in defaults.places().into_iter().enumerate() {
            let info = &defaults.infos()[row];
            for bound in [info.lower, info.upper] {
                let mut values = defaults.values().to_vec();
                values[slot] = bound;
                largest = largest.max(worst(*model, &defaults.with_values(values)));
            }
        }
        println!("{}: largest error {largest:.1e}", model.name());
    }
}

#[test]
fn khungurn_at_the_corners_and_at_colors_zero_and_one() {
    for widths in [[1.0, 10.0, 1.0], [10.0, 45.0, 45.0], [1.0, 45.0, 20.0]] {
        worst(
            &Khungurn,
            &khungurn([0.0, 0.5, 1.0], [1.0, 0.0, 0.5], widths),
        );
        worst(
            &Khungurn,
            &khungurn([0.001, 0.999, 0.3], [0.999, 0.001, 0.9], widths),
        );
    }
}

#[test]
fn chiang_at_the_corners_and_at_color_one() {
    // Color zero is reached with all derivatives zero, but between there and 0.001 the value rises to a tenth: no finite difference
    // sees that.
    let black = Chiang.prepare(&chiang([0.0; 3], 0.3, 0.3)).unwrap();
    let nearly = Chiang.prepare(&chiang([1e-30; 3], 0.3, 0.3)).unwrap();
    let (wi, wo) = pairs()[2];
    let (a, b) = (black.evaluate(wi, wo, 0.3), nearly.evaluate(wi, wo, 0.3));
    assert!((a.value[0] / b.value[0] - 1.0).abs() < 1e-12, "{a:?} {b:?}");
    assert_eq!(a.derivative[0], [0.0; 3]);
    assert!(a.derivative[1][0] != 0.0);
    for (beta_m, beta_n) in [(0.05, 1.0), (1.0, 0.05), (0.05, 0.3), (0.8, 0.8)] {
        worst(&Chiang, &chiang([0.02, 0.5, 1.0], beta_m, beta_n));
        worst(&Chiang, &chiang([0.001, 0.999, 0.3], beta_m, beta_n));
    }
}

#[test]
fn control_a_derivative_off_by_a_thousandth_fails() {
    let (wi, wo) = pairs()[2];
    for model in models() {
        let parameters = Parameters::defaults(*model);
        for row in 0..model.parameters().len() {
            let error = derivative_error(*model, &parameters, (wi, wo, 0.3), |s| {
                let mut e = s.evaluate(wi, wo, 0.3);
                for c in 0..CHANNELS {
                    e.derivative[row][c] *= 1.001;
                }
                e
            });
            assert!(
                error > 10.0 * TOLERANCE,
                "{} row {row}: {error:.1e}",
                model.name()
            );
        }
    }
    // And per degree instead of per radian.
    let parameters = Parameters::defaults(&Khungurn);
    let error = derivative_error(&Khungurn, &parameters, (wi, wo, 0.0), |s| {
        let mut e = s.evaluate(wi, wo, 0.0);
        e.derivative[4] = e.derivative[4].map(f64::to_radians);
        e
    });
    assert!(error > 0.5, "{error:.1e}");
}

#[test]
fn everything_stays_finite_along_the_axis_and_far_from_the_lobes() {
    let hostile = [
        DVec3::X,
        -DVec3::X,
        DVec3::new(1.0, -0.0, 0.0),
        DVec3::new(-1.0, 1e-17, -1e-17),
        DVec3::new(1.0, 1e-160, 1e-160),
        DVec3::new(1.0 + 2.0 * f64::EPSILON, 1e-8, 0.0),
        DVec3::Y,
        DVec3::new(0.0, -1.0, -0.0),
        DVec3::Z,
        direction_deg(90.0, 0.0),
        direction_deg(-89.999_999, 77.0),
    ];
    let mut functions = Vec::new();
    for widths in [[1.0, 10.0, 1.0], [10.0, 45.0, 45.0], [0.01, 0.01, 0.01]] {
        let parameters = khungurn([0.001, 0.0, 1.0], [0.999, 1.0, 0.0], widths);
        functions.push((
            format!("khungurn {widths:?}"),
            Khungurn.prepare(&parameters).unwrap(),
        ));
    }
    for (beta_m, beta_n) in [(0.01, 0.01), (0.3, 0.3), (1.0, 1.0)] {
        let parameters = chiang([0.0, 1e-300, 1.0], beta_m, beta_n);
        functions.push((
            format!("chiang {beta_m} {beta_n}"),
            Chiang.prepare(&parameters).unwrap(),
        ));
    }
    for (name, s) in functions {
        for (wi, wo) in hostile.into_iter().flat_map(|i| hostile.map(|o| (i, o))) {
            for h in [-1.0, -0.0, 1.0 - f64::EPSILON, 1.0] {
                let e = s.evaluate(wi, wo, h);
                let (value, pdf) = s.importance(wi, &s.outgoing(wo, h, [1.0; 3]));
                let all = e
                    .value
                    .iter()
                    .chain(e.derivative.iter().flatten())
                    .chain([&pdf]);
                for x in all {
                    assert!(x.is_finite(), "{name}, wi {wi:?}, wo {wo:?}, {h}: {e:?}");
                }
                assert!(e.value.iter().all(|&v| v >= 0.0) && pdf >= 0.0);
                assert!(value.iter().all(|v| v.is_finite() && *v >= 0.0));
            }
        }
    }
}

#[test]
fn a_direction_that_is_not_a_number_is_not_hidden() {
    for model in models() {
        let s = model.prepare(&Parameters::defaults(*model)).unwrap();
        let e = s.evaluate(DVec3::NAN, DVec3::Y, 0.0);
        assert!(e.value[0].is_nan() && e.derivative[2][1].is_nan());
        let pdf = |wi, wo| s.importance(wi, &s.outgoing(wo, 0.0, [1.0; 3])).1;
        assert!(pdf(DVec3::NAN, DVec3::Y).is_nan());
        let e = s.evaluate(DVec3::Y, DVec3::NAN, 0.0);
        assert!(e.value[0].is_nan());
        assert!(pdf(DVec3::Y, DVec3::NAN).is_nan());
        let sampled = s
            .sample(
                &s.outgoing(DVec3::NAN, 0.0, [1.0; 3]),
                &mut scatter_laws::stream(1, 0),
            )
            .unwrap();
        assert!(sampled.wi.is_nan() && sampled.weight[0].is_nan());
    }
    let s = Chiang.prepare(&Parameters::defaults(&Chiang)).unwrap();
    assert!(s.evaluate(DVec3::Y, DVec3::Z, f64::NAN).value[0].is_nan());
    assert!(s.evaluate(DVec3::Y, DVec3::Z, 1.1).value[0].is_nan());
}
