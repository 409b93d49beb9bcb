//! Promise: directions drawn in media follow the density that is stated, weights average to the albedo, and channels that agree
//! have weights that do not vary at all.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

#[path = "common/scatter_laws.rs"]
mod scatter_laws;

#[path = "common/media.rs"]
mod media_cases;

use glam::DVec3;
use goniofit::math::Random;
use goniofit::math::statistics::{Running, sidak_level};
use goniofit::scatter::longitudinal_angle;
use goniofit::scatter::media::{
    FlakeDistribution, KhungurnVolume, Medium, MediumModel, Microflake, Outgoing, Scattered,
};
use media_cases::{microflake, volume};
use scatter_laws::{Cells, chi_square, direction_deg, stream};
use statrs::distribution::{ContinuousCDF, Normal};

const N: u64 = 100_000;

/// What the channels of a path carry: unequal, so that a density that forgot them would be found out.
const CARRIED: [f64; 3] = [1.0, 0.3, 0.05];

const ALBEDO: [f64; 3] = [0.9, 0.3, 0.6];

/// Seen from across, aslant, grazing and along the fiber.
const CAMERAS: [(f64, f64); 5] = [
    (0.0, 0.0),
    (-40.0, 77.0),
    (80.0, -120.0),
    (89.0, 10.0),
    (-90.0, 0.0),
];

struct Case {
    name: String,
    medium: Box<dyn Medium>,
    wo: DVec3,
    cells: Cells,
    /// Cells hold the half vector, in whose angles flakes are smooth, in place of the direction toward the light.
    by_half: bool,
}

fn flakes(gamma: f64, (theta, phi): (f64, f64)) -> Case {
    Case {
        name: format!("microflake {gamma}, theta_o {theta}"),
        medium: Microflake.prepare(&microflake(ALBEDO, gamma)).unwrap(),
        wo: direction_deg(theta, phi),
        cells: Cells::around(DVec3::Y, &[gamma.min(0.2)], 0.5),
        by_half: true,
    }
}

fn lobes(c_r: f64, c_tt: f64, widths_deg: [f64; 3], (theta, phi): (f64, f64)) -> Case {
    let colors = |c: f64| [c, 0.5 * c, 0.9 * c];
    let parameters = volume(colors(c_r), colors(c_tt), widths_deg, ALBEDO);
    let [r, tt, gamma] = widths_deg.map(f64::to_radians);
    let wo = direction_deg(theta, phi);
    Case {
        name: format!("volume {c_r} {c_tt} {widths_deg:?}, theta_o {theta}"),
        medium: KhungurnVolume.prepare(&parameters).unwrap(),
        wo,
        cells: Cells::around(wo, &[r, tt], gamma.min(0.8)),
        by_half: false,
    }
}

/// Narrow, default, wide and beyond the published range.
fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for camera in CAMERAS {
        for gamma in [0.005, 0.013, 0.1, 0.6, 1.5, 20.0] {
            cases.push(flakes(gamma, camera));
        }
        for (c_r, c_tt, widths_deg) in [
            (0.1, 0.85, [5.0, 10.0, 10.0]),
            (0.75, 0.6, [1.0, 10.0, 20.0]),
            (0.001, 0.99, [1.4, 24.0, 1.0]),
            (0.999, 0.001, [10.0, 45.0, 45.0]),
            (0.3, 0.5, [70.0, 120.0, 100.0]),
        ] {
            cases.push(lobes(c_r, c_tt, widths_deg, camera));
        }
    }
    cases
}

impl Case {
    fn outgoing(&self) -> Outgoing {
        self.medium.outgoing(self.wo, CARRIED)
    }

    /// Density per solid angle of what the cells hold.
    fn density(&self, o: &Outgoing, place: DVec3) -> f64 {
        if !self.by_half {
            return self.medium.importance(place, o).1;
        }
        let cos = place.dot(self.wo);
        if cos <= 0.0 {
            return 0.0;
        }
        let wi = 2.0 * cos * place - self.wo;
        4.0 * cos * self.medium.importance(wi, o).1
    }

    fn probabilities(&self) -> Vec<f64> {
        let o = self.outgoing();
        self.cells.integrate(|place| self.density(&o, place))
    }

    fn place(&self, sampled: &Scattered) -> DVec3 {
        match self.by_half {
            true => (sampled.wi + self.wo).normalize(),
            false => sampled.wi,
        }
    }

    /// Chi-square of `n` directions that `medium` draws for `o`.
    fn compare(
        &self,
        probabilities: &[f64],
        medium: &dyn Medium,
        o: &Outgoing,
        mut random: Random,
    ) -> (f64, String) {
        chi_square(&self.cells, probabilities, N, || {
            self.place(&medium.sample(o, &mut random))
        })
    }
}

#[test]
fn samples_follow_the_density() {
    // With n = 1e5 and about 300 cells an error of the density of 6 % (rms over the cells, weighted by probability) is seen.
    let cases = cases();
    let level = sidak_level(1e-3, cases.len());
    for (k, case) in cases.iter().enumerate() {
        let probabilities = case.probabilities();
        let total: f64 = probabilities.iter().sum();
        // The edge of the flakes that are seen runs through cells.
        let tolerance = if case.by_half { 1e-3 } else { 1e-6 };
        assert!((total - 1.0).abs() < tolerance, "{}: {total}", case.name);
        let o = case.outgoing();
        let (p, text) = case.compare(&probabilities, case.medium.as_ref(), &o, stream(41, k));
        assert!(p > level, "{}: {text}, level {level:.1e}", case.name);
    }
}

#[test]
fn control_samples_of_slightly_other_media_fail() {
    let camera = CAMERAS[1];
    let volume_case = lobes(0.1, 0.85, [5.0, 10.0, 10.0], camera);
    let flake_case = flakes(0.1, camera);
    let others = [
        ("gamma + 3 %", &flake_case, flakes(0.103, camera), CARRIED),
        (
            "flakes from half a degree off",
            &flake_case,
            flakes(0.1, (-40.5, 77.0)),
            CARRIED,
        ),
        (
            "beta_r + 25 %",
            &volume_case,
            lobes(0.1, 0.85, [6.25, 10.0, 10.0], camera),
            CARRIED,
        ),
        (
            "gamma_tt + 5 %",
            &volume_case,
            lobes(0.1, 0.85, [5.0, 10.0, 10.5], camera),
            CARRIED,
        ),
        (
            "c_r + 20 %",
            &volume_case,
            lobes(0.12, 0.85, [5.0, 10.0, 10.0], camera),
            CARRIED,
        ),
        (
            "wo off by half a degree",
            &volume_case,
            lobes(0.1, 0.85, [5.0, 10.0, 10.0], (-40.5, 77.0)),
            CARRIED,
        ),
    ];
    for (k, (what, case, other, carried)) in others.iter().enumerate() {
        let o = other.medium.outgoing(other.wo, *carried);
        let random = stream(42, k);
        let (p, text) = case.compare(&case.probabilities(), other.medium.as_ref(), &o, random);
        println!("{what}: {text}");
        assert!(p < 1e-6, "{what}: {text}");
    }
}

#[test]
fn control_a_density_for_other_channels_fails() {
    // Red is reflected, green is transmitted.
    let parameters = volume(
        [0.9, 0.01, 0.1],
        [0.01, 0.9, 0.1],
        [5.0, 10.0, 10.0],
        [0.8; 3],
    );
    let wo = direction_deg(-40.0, 77.0);
    let case = Case {
        medium: KhungurnVolume.prepare(&parameters).unwrap(),
        ..lobes(0.1, 0.85, [5.0, 10.0, 10.0], CAMERAS[1])
    };
    let green = case.medium.outgoing(wo, [0.1, 1.0, 0.1]);
    let random = stream(43, 0);
    let (p, text) = case.compare(&case.probabilities(), case.medium.as_ref(), &green, random);
    assert!(p < 1e-6, "{text}");
}

#[test]
fn control_flakes_that_are_not_weighted_by_what_is_seen_of_them_fail() {
    let case = flakes(0.6, CAMERAS[1]);
    let distribution = FlakeDistribution::new(0.6);
    let mut random = stream(44, 0);
    let (p, text) = chi_square(&case.cells, &case.probabilities(), N, || {
        let mu = distribution.cosine(random.uniform());
        let (sin, cos) = (std::f64::consts::TAU * random.uniform()).sin_cos();
        let m = DVec3::new(
            mu,
            cos * (1.0 - mu * mu).sqrt(),
            sin * (1.0 - mu * mu).sqrt(),
        );
        m * m.dot(case.wo).signum()
    });
    assert!(p < 1e-6, "{text}");
}

#[test]
fn the_reported_density_and_weight_belong_to_the_reported_direction() {
    for (k, case) in cases().iter().enumerate() {
        let (o, mut random) = (case.outgoing(), stream(45, k));
        for _ in 0..2000 {
            let sampled = case.medium.sample(&o, &mut random);
            let (value, pdf) = case.medium.importance(sampled.wi, &o);
            let context = format!("{}: {sampled:?} {value:?} {pdf}", case.name);
            // The half vector is known to 1e-16 over its length before normalizing.
            let slack = match case.by_half {
                true => 1e-9 + 1e-11 / (sampled.wi + case.wo).length(),
                false => 1e-9,
            };
            let close = |a: f64, b: f64| (a - b).abs() <= slack * b.abs();
            assert!((sampled.wi.length() - 1.0).abs() < 1e-14, "{context}");
            assert!(close(sampled.pdf, pdf), "{context}");
            for c in 0..3 {
                assert!(close(sampled.weight[c], value[c] / pdf), "{context}");
            }
        }
    }
}

#[test]
fn what_the_channels_carry_in_sum_never_varies_and_equal_channels_weigh_their_albedo() {
    let expected: f64 = (0..3).map(|c| CARRIED[c] * ALBEDO[c]).sum();
    for (k, case) in cases().iter().enumerate() {
        let (o, mut random) = (case.outgoing(), stream(46, k));
        for _ in 0..500 {
            let weight = case.medium.sample(&o, &mut random).weight;
            let sum: f64 = (0..3).map(|c| CARRIED[c] * weight[c]).sum();
            assert!(
                (sum / expected - 1.0).abs() < 1e-10,
                "{}: {weight:?}",
                case.name
            );
        }
    }
    let equal = volume([0.2; 3], [0.7; 3], [1.0, 10.0, 20.0], ALBEDO);
    let equal = KhungurnVolume.prepare(&equal).unwrap();
    for (k, (theta, phi)) in CAMERAS.into_iter().enumerate() {
        let (o, mut random) = (
            equal.outgoing(direction_deg(theta, phi), CARRIED),
            stream(47, k),
        );
        for _ in 0..500 {
            let weight = equal.sample(&o, &mut random).weight;
            for c in 0..3 {
                assert!(
                    (weight[c] / ALBEDO[c] - 1.0).abs() < 1e-10,
                    "{theta}: {weight:?}"
                );
            }
        }
    }
}

/// z-score of the mean of `alpha p / pdf` in channel `c` against `expected`.
fn z_score(case: &Case, k: usize, c: usize, expected: f64) -> (f64, String) {
    let (o, mut random) = (case.outgoing(), stream(48, k));
    let mut weights = Running::default();
    for _ in 0..N {
        let sampled = case.medium.sample(&o, &mut random);
        // The weight itself follows paths: it is more where a color is nearly zero.
        weights.push(case.medium.evaluate(sampled.wi, case.wo).value[c] / sampled.pdf);
    }
    let (mean, se) = (weights.mean(), weights.standard_error());
    // Flakes have weights that hardly vary: the rounding of their half vectors is all there is.
    let z = (mean - expected) / se.max(1e-9);
    let text = format!("mean {mean:.9}, se {se:.1e}, n = {N}, expected {expected}, z = {z:.2}");
    (z, text)
}

#[test]
fn weights_average_to_the_albedo_in_every_channel() {
    // Standard errors are at most 0.3 % of the mean: an error of 2 % is seen in every case.
    let cases = cases();
    let level = sidak_level(1e-3, 3 * cases.len());
    let limit = Normal::standard().inverse_cdf(1.0 - 0.5 * level);
    for (k, case) in cases.iter().enumerate() {
        for (c, albedo) in ALBEDO.into_iter().enumerate() {
            let (z, text) = z_score(case, k, c, albedo);
            assert!(z.abs() < limit, "{}: {text}, limit {limit:.2}", case.name);
        }
    }
    // Control: off by 2 %.
    let (z, text) = z_score(
        &lobes(0.75, 0.6, [1.0, 10.0, 20.0], CAMERAS[2]),
        0,
        1,
        0.3 * 1.02,
    );
    assert!(z.abs() > 2.0 * limit, "{text}");
}

#[test]
fn flakes_that_are_seen_lie_toward_the_viewer_s_mirror_angle() {
    // A flake mirrors the longitudinal angle: narrow distributions scatter into the cone about -theta_o.
    let case = flakes(0.005, CAMERAS[1]);
    let (o, mut random) = (case.outgoing(), stream(49, 0));
    for _ in 0..1000 {
        let wi = case.medium.sample(&o, &mut random).wi;
        let off = longitudinal_angle(wi) + longitudinal_angle(case.wo);
        assert!(off.abs() < 0.07, "{wi}: {off}");
    }
}
