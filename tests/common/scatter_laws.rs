//! What the tests of every scattering model share: parameter values from degrees, finite differences of any model, and
//! the chi-square comparison of a sampler with its density.

#![allow(dead_code)]

use glam::DVec3;
use goniofit::math::{GaussLegendre, Random};
use goniofit::scatter::{
    Evaluation, Model, Parameters, Scattering, fiber_direction, longitudinal_angle,
};
use statrs::distribution::{ChiSquared, ContinuousCDF};
use std::f64::consts::{FRAC_PI_2, PI};

/// The seed of all statistical tests; the variable `SEED` overrides it.
pub(crate) fn seed() -> u64 {
    std::env::var("SEED").map_or(2015, |s| s.parse().expect("SEED is a number"))
}

/// Khungurn parameters: colors, then beta_r, beta_tt, gamma_tt in degrees.
pub(crate) fn khungurn(c_r: [f64; 3], c_tt: [f64; 3], widths_deg: [f64; 3]) -> Parameters {
    let values = c_r
        .into_iter()
        .chain(c_tt)
        .chain(widths_deg.map(f64::to_radians));
    Parameters::defaults(&goniofit::scatter::Khungurn).with_values(values.collect())
}

/// Chiang parameters.
pub(crate) fn chiang(color: [f64; 3], beta_m: f64, beta_n: f64) -> Parameters {
    let [r, g, b] = color;
    Parameters::defaults(&goniofit::scatter::Chiang).with_values(vec![r, g, b, beta_m, beta_n])
}

/// A direction from its longitudinal angle and azimuth in degrees.
pub(crate) fn direction_deg(theta: f64, phi: f64) -> DVec3 {
    fiber_direction(theta.to_radians(), phi.to_radians())
}

/// The unit-area Gaussian `g(t; 0, sigma)`.
pub(crate) fn gaussian(t: f64, sigma: f64) -> f64 {
    (-0.5 * (t / sigma).powi(2)).exp() / (sigma * (2.0 * PI).sqrt())
}

// ---- derivatives ---------------------------------------------------------------------------------------------------

/// Largest difference between `derivative` and finite differences of the value, over all parameters and channels,
/// relative to max(|S|/scale, |dS|) with scale the parameter's published range.
///
/// `derivative` is what is on trial; values come from `model`. Five-point differences with a step of 1e-3 of the
/// parameter (or of its range), central where the model accepts both sides, one-sided at the edge of its domain. Noise and
/// truncation of the differences stay below 1e-7 for lobes that change by less than a factor of 10 per width.
pub(crate) fn derivative_error(
    model: &dyn Model,
    parameters: &Parameters,
    (wi, wo, h): (DVec3, DVec3, f64),
    derivative: impl Fn(&dyn Scattering) -> Evaluation,
) -> f64 {
    let scattering = model.prepare(parameters).expect("parameters have meaning");
    let found = derivative(scattering.as_ref());
    let mut worst = 0.0_f64;
    for (slot, (row, _)) in parameters.places().into_iter().enumerate() {
        let info = &parameters.infos()[row];
        let range = info.upper - info.lower;
        let x = parameters.values()[slot];
        let step = 1e-3 * if x > 0.0 { x.min(range) } else { range };
        let value = |k: f64| {
            let mut values = parameters.values().to_vec();
            values[slot] = x + k * step;
            let moved = model.prepare(&parameters.with_values(values)).ok()?;
            Some(moved.evaluate(wi, wo, h).value)
        };
        let slope = five_points(&value, step);
        for (c, slope) in slope.into_iter().enumerate() {
            if parameters.slot(row, c) != slot {
                continue;
            }
            let scale = (found.value[c].abs() / range).max(slope.abs()) + 1e-30;
            let error = (found.derivative[row][c] - slope).abs() / scale;
            assert!(
                error.is_finite(),
                "{} at {wi}, {wo}, h {h}: {found:?}",
                info.name
            );
            worst = worst.max(error);
        }
    }
    worst
}

/// Slopes of three functions by five-point differences: central where both sides have values, else one-sided.
pub(crate) fn five_points(value: &dyn Fn(f64) -> Option<[f64; 3]>, h: f64) -> [f64; 3] {
    const CENTRAL: [f64; 5] = [1.0 / 12.0, -2.0 / 3.0, 0.0, 2.0 / 3.0, -1.0 / 12.0];
    const FORWARD: [f64; 5] = [-25.0 / 12.0, 4.0, -3.0, 4.0 / 3.0, -0.25];
    let stencils = [
        (CENTRAL, [-2.0, -1.0, 0.0, 1.0, 2.0]),
        (FORWARD, [0.0, 1.0, 2.0, 3.0, 4.0]),
        (FORWARD.map(|w| -w), [0.0, -1.0, -2.0, -3.0, -4.0]),
    ];
    for (weights, places) in stencils {
        let values: Option<Vec<_>> = places.iter().map(|&k| value(k)).collect();
        if let Some(values) = values {
            return std::array::from_fn(|c| {
                weights
                    .iter()
                    .zip(&values)
                    .map(|(w, v)| w * v[c])
                    .sum::<f64>()
                    / h
            });
        }
    }
    panic!("no side of the parameter is in the model's domain");
}

// ---- sampler against density ---------------------------------------------------------------------------------------

/// Cells in (theta, phi) whose edges crowd where lobes of the given widths around the mirrored direction of `wo` lie.
pub(crate) struct Cells {
    theta: Vec<f64>,
    phi: Vec<f64>,
}

impl Cells {
    pub(crate) fn around(wo: DVec3, theta_widths: &[f64], phi_width: f64) -> Self {
        Self::around_azimuths(wo, theta_widths, &[PI], phi_width)
    }

    /// The same for lobes whose azimuths, counted from that of `wo`, are `turns`.
    pub(crate) fn around_azimuths(
        wo: DVec3,
        theta_widths: &[f64],
        turns: &[f64],
        phi_width: f64,
    ) -> Self {
        let theta_center = -longitudinal_angle(wo);
        let phi_o = wo.z.atan2(wo.y);
        let mut theta: Vec<f64> = (0..=18)
            .map(|k| -FRAC_PI_2 + PI * k as f64 / 18.0)
            .collect();
        let mut phi: Vec<f64> = (0..=12).map(|k| -PI + PI * k as f64 / 6.0).collect();
        for step in [
            -7.0, -4.5, -3.0, -2.0, -1.2, -0.5, 0.0, 0.5, 1.2, 2.0, 3.0, 4.5, 7.0,
        ] {
            theta.extend(theta_widths.iter().map(|w| theta_center + step * w));
            phi.extend(turns.iter().map(|turn| {
                let edge = phi_o + turn + step * phi_width;
                edge - 2.0 * PI * ((edge + PI) / (2.0 * PI)).floor()
            }));
        }
        theta.retain(|t| t.abs() <= FRAC_PI_2);
        phi.retain(|p| p.abs() <= PI);
        for edges in [&mut theta, &mut phi] {
            edges.sort_by(f64::total_cmp);
            edges.dedup_by(|a, b| (*a - *b).abs() < 1e-9);
        }
        Self { theta, phi }
    }

    fn count(&self) -> usize {
        (self.theta.len() - 1) * (self.phi.len() - 1)
    }

    fn find(&self, w: DVec3) -> usize {
        let place = |edges: &[f64], x: f64| {
            (edges.partition_point(|&e| e <= x).max(1) - 1).min(edges.len() - 2)
        };
        place(&self.theta, longitudinal_angle(w)) * (self.phi.len() - 1)
            + place(&self.phi, w.z.atan2(w.y))
    }

    /// Integrals over the cells of a density per solid angle.
    pub(crate) fn integrate(&self, pdf: impl Fn(DVec3) -> f64) -> Vec<f64> {
        let rule = GaussLegendre::new(14);
        let mut cells = Vec::with_capacity(self.count());
        for theta in self.theta.windows(2) {
            for phi in self.phi.windows(2) {
                cells.push(rule.integrate(theta[0], theta[1], |t| {
                    t.cos() * rule.integrate(phi[0], phi[1], |p| pdf(fiber_direction(t, p)))
                }));
            }
        }
        cells
    }
}

/// Chi-square p-value of directions from `draw` against the cell probabilities; cells with fewer than 10 expected are
/// pooled. Returns the p-value and what an assertion should print.
pub(crate) fn chi_square(
    cells: &Cells,
    probabilities: &[f64],
    n: u64,
    mut draw: impl FnMut() -> DVec3,
) -> (f64, String) {
    let mut counts = vec![0_u64; cells.count()];
    for _ in 0..n {
        counts[cells.find(draw())] += 1;
    }
    let (mut statistic, mut used) = (0.0, 0_u32);
    let (mut pooled_count, mut pooled_expected) = (0, 0.0);
    let mut add = |count: u64, expected: f64| {
        statistic += (count as f64 - expected).powi(2) / expected;
        used += 1;
    };
    for (&count, &probability) in counts.iter().zip(probabilities) {
        let expected = probability * n as f64;
        assert!(expected.is_finite(), "cell probability {probability}");
        if expected < 10.0 {
            pooled_count += count;
            pooled_expected += expected;
        } else {
            add(count, expected);
        }
    }
    if pooled_expected >= 5.0 {
        add(pooled_count, pooled_expected);
    }
    assert!(used > 10, "only {used} cells hold enough");
    let p = ChiSquared::new(f64::from(used - 1)).unwrap().sf(statistic);
    (
        p,
        format!("chi-square {statistic:.1} over {used} cells, n = {n}, p = {p:.2e}"),
    )
}

/// A stream for one named purpose of a statistical test.
pub(crate) fn stream(purpose: u64, case: usize) -> Random {
    Random::keyed(&[seed(), purpose, case as u64])
}
