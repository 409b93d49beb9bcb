//! Promise: the sampler of the Khungurn BCSDF draws from the density it states, and its weights average to the reverse
//! albedo.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

#[path = "common/scatter_laws.rs"]
mod scatter_laws;

use glam::DVec3;
use goniofit::math::Random;
use goniofit::math::statistics::{Running, sidak_level};
use goniofit::scatter::albedo::{SphereRule, directional_albedo, reverse_albedo};
use goniofit::scatter::normalizer::lobe_normalizer;
use goniofit::scatter::{Khungurn, Model, Outgoing, Scattering, longitudinal_angle};
use scatter_laws::{Cells, chi_square, direction_deg, khungurn, stream};
use statrs::distribution::{ContinuousCDF, Normal};

const N: u64 = 100_000;

/// What the channels of a path carry: unequal, so that a density that forgot them would be found out.
const CARRIED: [f64; 3] = [1.0, 0.3, 0.05];

struct Case {
    name: String,
    scattering: Box<dyn Scattering>,
    widths_deg: [f64; 3],
    wo: DVec3,
}

fn prepared(c_r: f64, c_tt: f64, widths_deg: [f64; 3]) -> Box<dyn Scattering> {
    let colors = |c: f64| [c, 0.5 * c, 0.9 * c];
    Khungurn
        .prepare(&khungurn(colors(c_r), colors(c_tt), widths_deg))
        .unwrap()
}

/// Narrow, default, wide and beyond the published box, each seen from across, aslant, grazing and along the fiber.
fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for (c_r, c_tt, widths_deg) in [
        (0.1, 0.85, [5.0, 10.0, 10.0]),
        (0.75, 0.6, [1.0, 10.0, 20.0]),
        (0.001, 0.99, [1.4, 24.0, 1.0]),
        (0.999, 0.999, [10.0, 45.0, 45.0]),
        (0.3, 0.5, [70.0, 120.0, 100.0]),
    ] {
        for (theta, phi) in [
            (0.0, 0.0),
            (-40.0, 77.0),
            (80.0, -120.0),
            (89.0, 10.0),
            (-90.0, 0.0),
        ] {
            cases.push(Case {
                name: format!("c_r {c_r}, c_tt {c_tt}, widths {widths_deg:?}, theta_o {theta}"),
                scattering: prepared(c_r, c_tt, widths_deg),
                widths_deg,
                wo: direction_deg(theta, phi),
            });
        }
    }
    cases
}

impl Case {
    fn cells(&self) -> Cells {
        let [r, tt, gamma] = self.widths_deg.map(f64::to_radians);
        Cells::around(self.wo, &[r, tt], gamma.min(0.8))
    }

    fn pdf(&self, wi: DVec3) -> f64 {
        self.scattering.importance(wi, &self.outgoing()).1
    }

    fn rule(&self) -> SphereRule {
        let narrowest = self.widths_deg.into_iter().fold(10.0, f64::min);
        SphereRule::new(narrowest.to_radians())
    }

    fn outgoing(&self) -> Outgoing {
        self.scattering.outgoing(self.wo, 0.0, CARRIED)
    }

    fn draw<'a>(&'a self, random: &'a mut Random) -> impl FnMut() -> DVec3 + 'a {
        let outgoing = self.outgoing();
        move || self.scattering.sample(&outgoing, random).unwrap().wi
    }
}

#[test]
fn samples_follow_the_density() {
    // With n = 1e5 and about 300 cells an error of the density of 6 % (rms over the cells, weighted by probability) is seen.
    let cases = cases();
    let level = sidak_level(1e-3, cases.len());
    for (k, case) in cases.iter().enumerate() {
        let cells = case.cells();
        let probabilities = cells.integrate(|w| case.pdf(w));
        let total: f64 = probabilities.iter().sum();
        assert!(
            (total - 1.0).abs() < 1e-6,
            "{}: the density integrates to {total}",
            case.name
        );
        let mut random = stream(1, k);
        let (p, text) = chi_square(&cells, &probabilities, N, case.draw(&mut random));
        assert!(p > level, "{}: {text}, level {level:.1e}", case.name);
    }
}

#[test]
fn control_samples_of_slightly_other_lobes_fail() {
    let case = &cases()[1];
    let cells = case.cells();
    let probabilities = cells.integrate(|w| case.pdf(w));
    let others = [
        (
            "beta_r + 25 %",
            prepared(0.1, 0.85, [6.25, 10.0, 10.0]),
            case.wo,
        ),
        (
            "gamma_tt + 5 %",
            prepared(0.1, 0.85, [5.0, 10.0, 10.5]),
            case.wo,
        ),
        (
            "c_r + 20 %",
            prepared(0.12, 0.85, [5.0, 10.0, 10.0]),
            case.wo,
        ),
        (
            "wo off by half a degree",
            prepared(0.1, 0.85, [5.0, 10.0, 10.0]),
            direction_deg(-40.5, 77.0),
        ),
    ];
    for (k, (what, other, wo)) in others.into_iter().enumerate() {
        let mut random = stream(2, k);
        let (p, text) = chi_square(&cells, &probabilities, N, || {
            other
                .sample(&other.outgoing(wo, 0.0, CARRIED), &mut random)
                .unwrap()
                .wi
        });
        println!("{what}: {text}");
        assert!(p < 1e-6, "{what}: {text}");
    }
}

#[test]
fn control_the_density_without_truncation_does_not_integrate_to_one() {
    let case = cases()
        .into_iter()
        .find(|c| c.name.contains("10.0, 10.0], theta_o 89"))
        .unwrap();
    let theta_o = longitudinal_angle(case.wo);
    let mass = lobe_normalizer(-theta_o, 10.0_f64.to_radians()).mass;
    let total: f64 = case.cells().integrate(|w| mass * case.pdf(w)).iter().sum();
    assert!(total < 0.6, "{total}");
}

#[test]
fn the_reported_evaluation_and_weight_belong_to_the_reported_direction() {
    for (k, case) in cases().iter().enumerate() {
        let mut random = stream(3, k);
        for _ in 0..2000 {
            let sampled = case
                .scattering
                .sample(&case.outgoing(), &mut random)
                .unwrap();
            let (value, pdf) = case.scattering.importance(sampled.wi, &case.outgoing());
            let cos = sampled.wi.y.hypot(sampled.wi.z);
            let close = |a: f64, b: f64| (a - b).abs() <= 1e-9 * b.abs();
            let context = format!("{}: {sampled:?} {value:?} {pdf}", case.name);
            assert!((sampled.wi.length() - 1.0).abs() < 1e-14, "{context}");
            assert!(close(sampled.pdf, pdf), "{context}");
            for c in 0..3 {
                assert!(close(sampled.weight[c], value[c] * cos / pdf), "{context}");
            }
        }
    }
}

/// z-score of the mean weight of channel `c` against `expected`, with what an assertion should print.
fn z_score(case: &Case, purpose: u64, k: usize, c: usize, expected: f64) -> (f64, String) {
    let mut random = stream(purpose, k);
    let mut weights = Running::default();
    for _ in 0..N {
        let sampled = (case.scattering)
            .sample(&case.outgoing(), &mut random)
            .unwrap();
        // The weight itself follows paths: it is more where a color is nearly zero.
        let value = case.scattering.evaluate(sampled.wi, case.wo, 0.0).value[c];
        weights.push(value * sampled.wi.y.hypot(sampled.wi.z) / sampled.pdf);
    }
    let (mean, se) = (weights.mean(), weights.standard_error());
    let z = (mean - expected) / se;
    (
        z,
        format!("mean {mean:.6}, se {se:.1e}, n = {N}, expected {expected:.6}, z = {z:.2}"),
    )
}

#[test]
fn weights_average_to_the_reverse_albedo() {
    // Standard errors are 0.1 to 0.4 % of the mean: an error of 2 % is seen in every case.
    let cases = cases();
    let level = sidak_level(1e-3, cases.len());
    let limit = Normal::standard().inverse_cdf(1.0 - 0.5 * level);
    for (k, case) in cases.iter().enumerate() {
        let c = k % 3;
        let theta_o = longitudinal_angle(case.wo);
        let expected = reverse_albedo(case.scattering.as_ref(), theta_o, &case.rule())[c];
        let (z, text) = z_score(case, 4, k, c, expected);
        assert!(z.abs() < limit, "{}: {text}, limit {limit:.2}", case.name);
    }
}

#[test]
fn control_the_directional_albedo_is_not_the_mean_weight() {
    let cases = cases();
    let case = &cases[2];
    let theta = longitudinal_angle(case.wo);
    let forward = directional_albedo(case.scattering.as_ref(), theta, &case.rule())[0];
    let (z, text) = z_score(case, 5, 2, 0, forward);
    assert!(z.abs() > 8.0, "{text}");
}
