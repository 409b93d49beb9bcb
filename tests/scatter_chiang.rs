//! Promise: the hair BSDF of Chiang 2016 equals values computed with 30 digits, keeps its laws (all light comes back, R is
//! a mirror), and its sampler draws from the density it states.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

#[path = "common/scatter_laws.rs"]
mod scatter_laws;

use glam::DVec3;
use goniofit::math::GaussLegendre;
use goniofit::math::statistics::{Running, sidak_level};
use goniofit::scatter::{Chiang, Model, Outgoing, Scattering, fiber_direction};
use scatter_laws::{Cells, chi_square, chiang, direction_deg, stream};
use serde_json::Value;
use statrs::distribution::{ContinuousCDF, Normal};
use std::f64::consts::{FRAC_PI_2, PI, TAU};

fn prepared(color: [f64; 3], beta_m: f64, beta_n: f64) -> Box<dyn Scattering> {
    Chiang.prepare(&chiang(color, beta_m, beta_n)).unwrap()
}

// ---- 30-digit values -----------------------------------------------------------------------------------------------

/// The golden rows: theta_i, theta_o, phi, h, beta_m, beta_n, color, and S.
fn rows() -> Vec<([f64; 7], f64)> {
    let file: Value = serde_json::from_str(include_str!("data/chiang.json")).unwrap();
    let number = |v: &Value| v.as_f64().unwrap();
    file["rows"]
        .as_array()
        .unwrap()
        .iter()
        .map(|r| (std::array::from_fn(|k| number(&r[k])), number(&r[11])))
        .collect()
}

fn relative_error(row: &([f64; 7], f64), change: impl Fn(&mut [f64; 7])) -> f64 {
    let (mut x, expected) = *row;
    change(&mut x);
    let [theta_i, theta_o, phi, h, beta_m, beta_n, color] = x;
    // The middle channel: the others must not matter.
    let s = prepared([0.3, color, 0.9], beta_m, beta_n);
    // An azimuth of both, so that only their difference can count.
    let wi = fiber_direction(theta_i, phi + 2.1);
    let wo = fiber_direction(theta_o, 2.1);
    (s.evaluate(wi, wo, h).value[1] / expected - 1.0).abs()
}

#[test]
fn values_match_120_rows() {
    let rows = rows();
    assert_eq!(rows.len(), 120);
    let worst = rows
        .iter()
        .map(|r| relative_error(r, |_| ()))
        .fold(0.0, f64::max);
    println!("worst relative error: {worst:.1e}");
    // Measured 1.1e-14.
    assert!(worst <= 1e-13, "{worst}");
}

#[test]
fn control_wrong_conventions_fail_the_same_comparison() {
    let rows = rows();
    let failures = |change: &dyn Fn(&mut [f64; 7])| {
        rows.iter()
            .filter(|r| relative_error(r, change) > 1e-13)
            .count()
    };
    let mirrored = failures(&|x| x[3] = -x[3]);
    let swapped = failures(&|x| x.swap(0, 1));
    let turned = failures(&|x| x[2] = -x[2]);
    println!("rows that fail: h mirrored {mirrored}, swapped {swapped}, azimuth turned {turned}");
    assert!(mirrored > 110 && swapped > 110 && turned > 110);
}

// ---- laws ----------------------------------------------------------------------------------------------------------

/// `int S(wi, wo) cos(theta_i) dwi`, panels crowding at the mirrored angle.
fn returned(s: &dyn Scattering, wo: DVec3, h: f64) -> [f64; 3] {
    let fine = s.narrowest() < 0.1;
    let (panels, azimuths) = if fine { (100, 600_u32) } else { (40, 200) };
    let rule = GaussLegendre::new(12);
    let mut sum = [0.0; 3];
    let step = TAU / f64::from(azimuths);
    for k in 0..azimuths {
        for panel in 0..panels {
            let edge = |p: usize| -FRAC_PI_2 + PI * p as f64 / panels as f64;
            for (theta, weight) in rule.on(edge(panel), edge(panel + 1)) {
                let wi = fiber_direction(theta, step * (f64::from(k) + 0.5));
                let cos2 = theta.cos().powi(2);
                let (value, _) = s.importance(wi, &s.outgoing(wo, h, [1.0; 3]));
                for c in 0..3 {
                    sum[c] += weight * step * cos2 * value[c];
                }
            }
        }
    }
    sum
}

#[test]
fn a_clear_fiber_returns_all_light_and_a_black_one_its_fresnel_reflection() {
    for (beta_m, beta_n) in [(0.3, 0.3), (0.15, 0.4), (1.0, 1.0)] {
        let s = prepared([1.0, 0.0, 0.5], beta_m, beta_n);
        for (theta, h) in [(0.0, 0.0), (0.0, 0.999), (50.0, -0.5), (85.0, 0.9)] {
            let wo = direction_deg(theta, 40.0);
            let [clear, black, between] = returned(s.as_ref(), wo, h);
            let context = format!("{beta_m} {beta_n} {theta} {h}: {clear} {black} {between}");
            // The azimuthal lobe's cut leaves kinks that the trapezoid rule sees at 2e-6.
            assert!((clear - 1.0).abs() < 5e-6, "{context}");
            let cos = theta.to_radians().cos() * (1.0 - h * h).sqrt();
            assert!((black - reflectance(cos)).abs() < 5e-6, "{context}");
            assert!(black < between && between < clear, "{context}");
        }
    }
    // Control: without 1/cos(theta_i) in S it is not.
    let s = prepared([1.0; 3], 0.3, 0.3);
    let rule = GaussLegendre::new(12);
    let without: f64 = rule.integrate_panels(-FRAC_PI_2, FRAC_PI_2, 60, |t| {
        let ring: f64 = (0..600)
            .map(|k| {
                let wi = fiber_direction(t, TAU * f64::from(k) / 600.0);
                s.importance(wi, &s.outgoing(direction_deg(50.0, 0.0), 0.2, [1.0; 3]))
                    .0[0]
            })
            .sum();
        t.cos().powi(3) * ring * TAU / 600.0
    });
    assert!((without - 1.0).abs() > 0.05, "{without}");
}

/// Unpolarized reflectance of a surface of index 1.55, in another form than the model's: by the angles.
fn reflectance(cos: f64) -> f64 {
    let i = cos.acos();
    let t = (i.sin() / 1.55).asin();
    if i < 1e-6 {
        return (0.55_f64 / 2.55).powi(2);
    }
    let s = ((i - t).sin() / (i + t).sin()).powi(2);
    let p = ((i - t).tan() / (i + t).tan()).powi(2);
    0.5 * (s + p)
}

/// The direction of the largest S over the whole sphere for a black, smooth fiber: only R is left.
fn brightest(wo: DVec3, h: f64) -> DVec3 {
    let s = prepared([0.0; 3], 0.08, 0.08);
    let mut best = (0.0, DVec3::X);
    for theta in -89..90 {
        for phi in 0..720 {
            let wi = direction_deg(f64::from(theta), 0.5 * f64::from(phi));
            let value = s.importance(wi, &s.outgoing(wo, h, [1.0; 3])).0[0] * wi.y.hypot(wi.z);
            if value > best.0 {
                best = (value, wi);
            }
        }
    }
    best.1
}

#[test]
fn r_is_the_mirror_image_in_the_surface_normal() {
    // The camera meets the fiber where its outward normal has azimuth `normal`; h is the sine from there to wo.
    let mut wrong_side = 0;
    for (theta, phi_o, normal) in [
        (20.0, 0.0, 35.0),
        (-40.0, 100.0, 60.0),
        (0.0, -120.0, -80.0),
    ] {
        let wo = direction_deg(theta, phi_o);
        let n = direction_deg(0.0, normal);
        let h = f64::sin(f64::to_radians(phi_o - normal));
        let mirrored = n * (2.0 * n.dot(wo)) - wo;
        let found = brightest(wo, h);
        // A grid of 1 by half a degree, and M's peak is not exactly at -theta_o.
        assert!(
            found.dot(mirrored) > 2.5_f64.to_radians().cos(),
            "{found} {mirrored}"
        );
        // Control: with the other sign of h it is elsewhere.
        wrong_side += i32::from(brightest(wo, -h).dot(mirrored) < 0.9);
    }
    assert_eq!(wrong_side, 3);
}

#[test]
fn meaningless_parameters_are_refused() {
    for (color, beta_m, beta_n, key) in [
        (-0.1, 0.3, 0.3, "'color' is -0.1, expected 0 to 1"),
        (1.1, 0.3, 0.3, "'color' is 1.1"),
        (0.5, 0.0, 0.3, "'beta_m' is 0, expected 0.01 to 1"),
        (0.5, 0.3, 1.01, "'beta_n' is 1.01"),
        (f64::NAN, 0.3, 0.3, "'color' is NaN"),
        (0.5, f64::INFINITY, 0.3, "'beta_m' is inf"),
    ] {
        let Err(error) = Chiang.prepare(&chiang([color; 3], beta_m, beta_n)) else {
            panic!("{key} was accepted");
        };
        let report = error.report();
        assert!(
            report.contains(key) && report.contains("\nhint: a fit searches"),
            "{report}"
        );
    }
}

// ---- sampling ------------------------------------------------------------------------------------------------------

const N: u64 = 100_000;

struct Case {
    name: String,
    scattering: Box<dyn Scattering>,
    beta_m: f64,
    beta_n: f64,
    wo: DVec3,
    h: f64,
}

/// Smooth, default, rough and uneven, each met in the middle, aside, at the rim, and seen from across to along the fiber.
fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for (color, beta_m, beta_n) in [
        (0.8, 0.3, 0.3),
        (0.05, 0.1, 0.6),
        (0.999, 0.6, 0.1),
        (0.4, 1.0, 1.0),
    ] {
        for (theta, phi, h) in [
            (0.0, 0.0, 0.0),
            (-40.0, 77.0, 0.7),
            (80.0, -120.0, -0.4),
            (89.0, 10.0, 0.95),
            (-90.0, 0.0, 0.5),
            (10.0, 200.0, -0.9999),
        ] {
            cases.push(Case {
                name: format!("{color}, {beta_m}, {beta_n}, theta_o {theta}, h {h}"),
                scattering: prepared([color, 0.5 * color, 0.9 * color], beta_m, beta_n),
                beta_m,
                beta_n,
                wo: direction_deg(theta, phi),
                h,
            });
        }
    }
    cases
}

impl Case {
    fn cells(&self) -> Cells {
        let deviation = 0.726 * self.beta_m + 0.812 * self.beta_m.powi(2);
        let s = 0.6267 * (0.265 * self.beta_n + 1.194 * self.beta_n.powi(2));
        let (gamma_o, cos) = (self.h.asin(), self.wo.y.hypot(self.wo.z));
        let gamma_t = (self.h * cos / (1.55_f64.powi(2) - self.wo.x.powi(2)).sqrt()).asin();
        let turns = [0.0, 1.0, 2.0].map(|p| p * (2.0 * gamma_t + PI) - 2.0 * gamma_o);
        Cells::around_azimuths(
            self.wo,
            &[0.5 * deviation, deviation],
            &turns,
            1.5 * s.min(0.5),
        )
    }

    fn outgoing(&self) -> Outgoing {
        self.scattering.outgoing(self.wo, self.h, [1.0; 3])
    }

    fn draw<'a>(&'a self, random: &'a mut goniofit::math::Random) -> impl FnMut() -> DVec3 + 'a {
        let outgoing = self.outgoing();
        move || self.scattering.sample(&outgoing, random).unwrap().wi
    }
}

#[test]
fn wider_lobes_are_rougher_and_stay_in_the_domain() {
    let parameters = chiang([0.8, 0.4, 0.7], 0.3, 0.9);
    let wide = Chiang.widened(&parameters, 1.5);
    assert_eq!(wide.channels("color"), parameters.channels("color"));
    assert!((wide.scalar("beta_m") - 0.45).abs() < 1e-15);
    assert!(Chiang.prepare(&wide).is_ok() && wide.scalar("beta_n") > 0.99);
}

#[test]
fn samples_follow_the_density() {
    // With n = 1e5 and about 600 cells an error of the density of 8 % (rms over the cells, weighted by probability) is seen.
    let cases = cases();
    let level = sidak_level(1e-3, cases.len());
    for (k, case) in cases.iter().enumerate() {
        let cells = case.cells();
        let pdf = |w: DVec3| case.scattering.importance(w, &case.outgoing()).1;
        let probabilities = cells.integrate(pdf);
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
    let probabilities = cells.integrate(|w| case.scattering.importance(w, &case.outgoing()).1);
    let color = [0.8, 0.4, 0.72];
    let others = [
        ("beta_m + 5 %", prepared(color, 0.315, 0.3), case.h),
        ("beta_n + 5 %", prepared(color, 0.3, 0.315), case.h),
        (
            "color a tenth",
            prepared(color.map(|c| 0.1 * c), 0.3, 0.3),
            case.h,
        ),
        ("h + 0.01", prepared(color, 0.3, 0.3), case.h + 0.01),
    ];
    for (k, (what, other, h)) in others.into_iter().enumerate() {
        let mut random = stream(2, k);
        let (p, text) = chi_square(&cells, &probabilities, N, || {
            other
                .sample(&other.outgoing(case.wo, h, [1.0; 3]), &mut random)
                .unwrap()
                .wi
        });
        println!("{what}: {text}");
        assert!(p < 1e-5, "{what}: {text}");
    }
}

#[test]
fn weights_average_to_the_light_returned() {
    // The sum over channels of A_p is known in closed form through the furnace integral; standard errors are 0.1 to 0.3 % of the
    // mean, so an error of 1.5 % is seen in every case.
    let cases = cases();
    let level = sidak_level(1e-3, 3 * cases.len());
    let limit = Normal::standard().inverse_cdf(1.0 - 0.5 * level);
    for (k, case) in cases.iter().enumerate() {
        let expected = returned(case.scattering.as_ref(), case.wo, case.h);
        let mut random = stream(3, k);
        let mut weights = [Running::default(); 3];
        for _ in 0..N {
            let sampled = case
                .scattering
                .sample(&case.outgoing(), &mut random)
                .unwrap();
            for c in 0..3 {
                weights[c].push(sampled.weight[c]);
            }
        }
        for c in 0..3 {
            let (mean, se) = (weights[c].mean(), weights[c].standard_error());
            let difference = (mean - expected[c]).abs();
            // Where the channels are equally bright all weights are, and the standard error vanishes.
            assert!(
                difference < limit * se + 5e-6,
                "{} channel {c}: mean {mean}, se {se:.1e}, n {N}, expected {}",
                case.name,
                expected[c]
            );
        }
        // Control: of another color the mean differs.
        let other = prepared([0.7, 0.7, 0.7], case.beta_m, case.beta_n);
        let wrong = returned(other.as_ref(), case.wo, case.h)[1];
        let (mean, se) = (weights[1].mean(), weights[1].standard_error());
        assert!((mean - wrong).abs() > 4.0 * se, "{}", case.name);
    }
}

#[test]
fn the_reported_evaluation_and_weight_belong_to_the_reported_direction() {
    for (k, case) in cases().iter().enumerate() {
        let mut random = stream(4, k);
        for _ in 0..2000 {
            let sampled = case
                .scattering
                .sample(&case.outgoing(), &mut random)
                .unwrap();
            let again = case.scattering.evaluate(sampled.wi, case.wo, case.h);
            let cos = sampled.wi.y.hypot(sampled.wi.z);
            let close = |a: f64, b: f64, scale: f64| (a - b).abs() <= 1e-9 * scale.abs();
            let context = format!("{}: {sampled:?} {again:?}", case.name);
            let (value, pdf) = (case.scattering).importance(sampled.wi, &case.outgoing());
            assert!((sampled.wi.length() - 1.0).abs() < 1e-14, "{context}");
            assert!(close(sampled.pdf, pdf, pdf), "{context}");
            for c in 0..3 {
                assert!(close(value[c], again.value[c], value[c]), "{context}");
                let weight = value[c] * cos / pdf;
                assert!(close(sampled.weight[c], weight, weight), "{context}");
            }
        }
    }
}
