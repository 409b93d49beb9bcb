//! What the tests of media share: parameters, cases at the ends of every range, and integrals that follow a ridge of flakes.

#![allow(dead_code)]

use glam::DVec3;
use goniofit::math::{Frame, GaussLegendre};
use goniofit::scatter::Parameters;
use goniofit::scatter::media::{KhungurnVolume, Medium, MediumModel, Microflake};
use std::f64::consts::{FRAC_PI_2, TAU};

/// Microflake parameters.
pub(crate) fn microflake(albedo: [f64; 3], gamma: f64) -> Parameters {
    let [r, g, b] = albedo;
    Parameters::defaults(&Microflake).with_values(vec![r, g, b, gamma])
}

/// Volume BCSDF parameters: colors, then beta_r, beta_tt, gamma_tt in degrees, then the albedo.
pub(crate) fn volume(
    c_r: [f64; 3],
    c_tt: [f64; 3],
    widths_deg: [f64; 3],
    albedo: [f64; 3],
) -> Parameters {
    let widths = widths_deg.map(f64::to_radians);
    let values = [c_r, c_tt, widths, albedo].concat();
    Parameters::defaults(&KhungurnVolume).with_values(values)
}

/// Media at and beyond the ends of their published ranges.
pub(crate) fn media() -> Vec<(String, Box<dyn Medium>)> {
    let mut media: Vec<(String, Box<dyn Medium>)> = Vec::new();
    for gamma in [0.001, 0.005, 0.013, 0.1, 1.5, 100.0] {
        let parameters = microflake([0.0, 0.85, 1.0], gamma);
        let medium = Microflake.prepare(&parameters).unwrap();
        media.push((format!("microflake {gamma}"), medium));
    }
    for widths in [
        [5.0, 10.0, 10.0],
        [1.0, 10.0, 1.0],
        [10.0, 45.0, 45.0],
        [0.05, 0.05, 0.05],
        [360.0, 360.0, 360.0],
    ] {
        let parameters = volume([0.001, 0.0, 1.0], [0.0, 1.0, 0.0], widths, [0.0, 0.5, 1.0]);
        let medium = KhungurnVolume.prepare(&parameters).unwrap();
        media.push((format!("volume {widths:?}"), medium));
    }
    media
}

/// Directions at which formulas break.
pub(crate) fn hostile() -> [DVec3; 11] {
    [
        DVec3::X,
        -DVec3::X,
        DVec3::new(1.0, -0.0, 0.0),
        DVec3::new(-1.0, 1e-17, -1e-17),
        DVec3::new(1.0, 1e-160, 1e-160),
        DVec3::new(1.0 + f64::EPSILON, 1e-8, 0.0),
        DVec3::Y,
        DVec3::new(0.0, -1.0, -0.0),
        DVec3::Z,
        DVec3::new(0.6, -0.8, 0.0),
        DVec3::new(-0.6, 0.8, 0.0),
    ]
}

/// The direction toward the light that a flake turned by `a` from `wo`, at the azimuth `b` about it, mirrors into `wo`.
pub(crate) fn mirrored(frame: &Frame, a: f64, b: f64) -> DVec3 {
    let h = frame.to_world(DVec3::new(a.cos(), a.sin() * b.cos(), a.sin() * b.sin()));
    (2.0 * a.cos() * h - frame.x).normalize()
}

/// `int f dwi` over the sphere for a function of microflakes of width `gamma` as seen from `wo`: over the half vector, where flakes
/// on the plane across the fiber are a smooth ridge. `dwi = 4 cos a sin a da db`.
pub(crate) fn flake_integral(wo: DVec3, gamma: f64, f: impl Fn(DVec3) -> [f64; 3]) -> [f64; 3] {
    let frame = Frame::from_tangent(wo);
    let rule = GaussLegendre::new(8);
    let panels = ((FRAC_PI_2 / gamma).ceil() as usize).max(12);
    let azimuths = ((4.0 * TAU / gamma).ceil() as usize).max(96);
    let mut sum = [0.0; 3];
    for panel in 0..panels {
        let edge = |k: usize| FRAC_PI_2 * k as f64 / panels as f64;
        for (a, weight) in rule.on(edge(panel), edge(panel + 1)) {
            let weight = weight * 4.0 * a.cos() * a.sin() * TAU / azimuths as f64;
            for k in 0..azimuths {
                let b = TAU * (k as f64 + 0.5) / azimuths as f64;
                let value = f(mirrored(&frame, a, b));
                for c in 0..3 {
                    sum[c] += weight * value[c];
                }
            }
        }
    }
    sum
}
