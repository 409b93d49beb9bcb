//! A longitudinal lobe of Khungurn 2015 over the directions *toward the light*: its integrals, and directions drawn from it.
//!
//! The lobe `gbar(theta_o; -theta_i, beta)` is normalized over theta_o, with G a function of theta_i. Over theta_i, with the solid
//! angle's cosine and the two parts of Schlick's form (`w5 = (1 - cos theta_i)^5`), it has the integrals
//!
//! ```text
//! K_1(theta_o) = int g(theta_o + theta_i; beta) H_1(theta_i) dtheta_i,  H_1 = (1 - w5) cos(theta_i) / G(theta_i, beta)
//! K_5(theta_o)   the same with                                          H_5 =      w5  cos(theta_i) / G(theta_i, beta)
//! ```
//!
//! Both are even in theta_o and one-dimensional: a table of each for each set of parameters.

use crate::math::{GaussLegendre, Random};
use crate::scatter::khungurn::LongitudinalLobe;
use crate::scatter::piecewise::Piecewise;
use std::f64::consts::{FRAC_PI_2, PI};

/// Beyond this many widths the Gaussian is below 1e-16 of its peak.
const REACH: f64 = 8.6;

/// Where the near zone of proposals ends, in widths, and the share of a Gaussian beyond.
const NEAR: f64 = 3.0;
const FAR_MASS: f64 = 0.002_699_796_063_260_189;

/// How far bounds lie above the largest value found: values are looked up 16 times per width, and change on the scale of one.
const MARGIN: f64 = 1.02;

/// Which part of Schlick's form.
#[derive(Debug, Clone, Copy)]
pub(super) enum Part {
    /// `1 - w5`.
    One,
    /// `w5`.
    Five,
}

/// A lobe over the directions toward the light.
#[derive(Debug, Clone)]
pub(super) struct Incoming {
    /// K_1, K_5 and their derivatives by beta (per radian), over `tan(theta_o/2)`.
    table: Piecewise<4>,
    envelopes: [Envelope; 2],
}

impl Incoming {
    /// Precomputes tables and bounds: about 3 ms at 1 degree, growing as the inverse of the width.
    pub(super) fn new(lobe: &LongitudinalLobe) -> Self {
        let width = lobe.width;
        let nodes = Node::all(lobe);
        let n_pieces = ((2.1 / width) as usize).max(12);
        let at = |t: f64| integrals(&nodes, 2.0 * t.atan(), width);
        Self {
            table: Piecewise::new(n_pieces, at),
            envelopes: [Part::One, Part::Five].map(|part| Envelope::new(lobe, part)),
        }
    }

    /// `[K_1, K_5, dK_1/dbeta, dK_5/dbeta]` where `t` is the tangent of half of theta_o.
    #[inline]
    pub(super) fn integrals(&self, t: f64) -> [f64; 4] {
        self.table.at(t.abs())
    }

    /// A theta_i with density `g(theta_o + theta_i) H(theta_i) / K(theta_o)`: itself, its sine and cosine. A theta_o that is NaN
    /// gives NaN.
    ///
    /// By rejection from the Gaussian, with a bound on H within three widths and another beyond: K over the first bound is the
    /// share of proposals taken.
    pub(super) fn sample(
        &self,
        lobe: &LongitudinalLobe,
        part: Part,
        theta_o: f64,
        random: &mut Random,
    ) -> (f64, f64, f64) {
        let envelope = &self.envelopes[part as usize];
        let near = envelope.near(theta_o);
        let (near_mass, far_mass) = ((1.0 - FAR_MASS) * near, FAR_MASS * envelope.far);
        loop {
            let is_near = random.uniform() * (near_mass + far_mass) < near_mass;
            let (z, bound) = if is_near {
                (normal_within(random), near)
            } else {
                (normal_beyond(random), envelope.far)
            };
            let theta = lobe.width * z - theta_o;
            if theta.abs() > FRAC_PI_2 {
                continue;
            }
            let (sin, cos) = theta.sin_cos();
            let h = part_over_g(lobe, part, sin, cos);
            if h.is_nan() || random.uniform() * bound < h {
                return (theta, sin, cos);
            }
        }
    }
}

/// H at the angle of this sine and cosine.
#[inline]
fn part_over_g(lobe: &LongitudinalLobe, part: Part, sin: f64, cos: f64) -> f64 {
    let t = sin / (1.0 + cos);
    let w = sin * t;
    let w5 = (w * w) * (w * w) * w;
    let part = match part {
        Part::One => 1.0 - w5,
        Part::Five => w5,
    };
    part * cos / lobe.table.normalizer(t).0
}

/// A standard normal number within [`NEAR`] of zero.
fn normal_within(random: &mut Random) -> f64 {
    loop {
        let z = random.normal();
        if z.abs() <= NEAR {
            return z;
        }
    }
}

/// A standard normal number beyond [`NEAR`] (Marsaglia 1964).
fn normal_beyond(random: &mut Random) -> f64 {
    loop {
        let z = (NEAR * NEAR - 2.0 * random.uniform_open().ln()).sqrt();
        if random.uniform() * z < NEAR {
            return if random.bits() >> 63 == 0 { z } else { -z };
        }
    }
}

/// Bounds on H.
#[derive(Debug, Clone)]
struct Envelope {
    /// For theta_o in equal bins of |theta_o|: on H within [`NEAR`] widths of `-theta_o`.
    near: Vec<f64>,
    bins_per_radian: f64,
    /// On H anywhere.
    far: f64,
}

impl Envelope {
    fn new(lobe: &LongitudinalLobe, part: Part) -> Self {
        const PER_BIN: usize = 4;
        let spacing = lobe.width.min(0.5) / 16.0;
        let bins = (FRAC_PI_2 / (PER_BIN as f64 * spacing)).ceil() as usize;
        let window = (NEAR * lobe.width / spacing).ceil() as usize;
        let values: Vec<f64> = (0..=PER_BIN * bins)
            .map(|k| {
                let (sin, cos) = (spacing * k as f64).min(FRAC_PI_2).sin_cos();
                MARGIN * part_over_g(lobe, part, sin, cos)
            })
            .collect();
        let most = |values: &[f64]| values.iter().copied().fold(0.0, f64::max);
        let near = (0..bins).map(|k| {
            // H is even: a window over zero is folded.
            let first = (PER_BIN * k).saturating_sub(window);
            let last = (PER_BIN * (k + 1) + window).min(values.len() - 1);
            most(&values[first..=last])
        });
        Self {
            near: near.collect(),
            bins_per_radian: 1.0 / (PER_BIN as f64 * spacing),
            far: most(&values),
        }
    }

    fn near(&self, theta_o: f64) -> f64 {
        let bin = (theta_o.abs() * self.bins_per_radian) as usize;
        self.near[bin.min(self.near.len() - 1)]
    }
}

/// A node of the quadrature over theta_i.
struct Node {
    theta: f64,
    /// Weight times H_1, H_5.
    parts: [f64; 2],
    /// `d ln G / d beta`.
    log_g_by_sigma: f64,
}

impl Node {
    /// Panels of half a width: everything changes on the scale of a width.
    fn all(lobe: &LongitudinalLobe) -> Vec<Self> {
        let panels = ((2.0 * PI / lobe.width).ceil() as usize).max(24);
        let edge = |k: usize| -FRAC_PI_2 + PI * k as f64 / panels as f64;
        let rule = GaussLegendre::new(8);
        let panel = |k| rule.on(edge(k), edge(k + 1)).collect::<Vec<_>>();
        (0..panels)
            .flat_map(panel)
            .map(|(theta, weight)| {
                let (sin, cos) = theta.sin_cos();
                let (g, by_sigma) = lobe.table.normalizer(sin / (1.0 + cos));
                Self {
                    theta,
                    parts: [Part::One, Part::Five]
                        .map(|part| weight * part_over_g(lobe, part, sin, cos)),
                    log_g_by_sigma: by_sigma / g,
                }
            })
            .collect()
    }
}

/// `[K_1, K_5, dK_1/dbeta, dK_5/dbeta]` at theta_o.
fn integrals(nodes: &[Node], theta_o: f64, width: f64) -> [f64; 4] {
    let scale = 1.0 / (width * (2.0 * PI).sqrt());
    let first = nodes.partition_point(|n| n.theta < -theta_o - REACH * width);
    let mut sum = [0.0; 4];
    for node in &nodes[first..] {
        let z = (node.theta + theta_o) / width;
        if z > REACH {
            break;
        }
        let g = scale * (-0.5 * z * z).exp();
        let log_slope = (z * z - 1.0) / width - node.log_g_by_sigma;
        for (k, part) in node.parts.into_iter().enumerate() {
            sum[k] += g * part;
            sum[k + 2] += g * part * log_slope;
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scatter::normalizer::lobe_normalizer;
    use serde_json::Value;

    const WIDTHS_DEG: [f64; 8] = [0.05, 1.0, 2.2, 5.0, 10.0, 27.0, 45.0, 300.0];

    fn exact(beta: f64, theta_o: f64) -> [f64; 2] {
        let rule = GaussLegendre::new(20);
        [Part::One, Part::Five].map(|part| {
            let low = (-theta_o - 9.0 * beta).max(-FRAC_PI_2);
            let high = (9.0 * beta - theta_o).min(FRAC_PI_2);
            rule.integrate_adaptive(low, high, 1e-14, |theta| {
                let z = (theta + theta_o) / beta;
                let g = (-0.5 * z * z).exp() / (beta * (2.0 * PI).sqrt());
                let w5 = (2.0 * (0.5 * theta).sin().powi(2)).powi(5);
                let part = match part {
                    Part::One => 1.0 - w5,
                    Part::Five => w5,
                };
                g * part * theta.cos() / lobe_normalizer(theta, beta).value
            })
        })
    }

    #[test]
    fn the_integrals_match_all_golden_rows() {
        let text = include_str!("../../../tests/data/khungurn_energy.json");
        let file: Value = serde_json::from_str(text).unwrap();
        let rows = file["volume"].as_array().unwrap();
        assert_eq!(rows.len(), 20);
        let mut worst = 0.0_f64;
        for row in rows {
            let number = |k: usize| row[k].as_f64().unwrap();
            let incoming = Incoming::new(&LongitudinalLobe::new(number(0).to_radians()));
            let [k1, k5, ..] = incoming.integrals((0.5 * number(1).to_radians()).tan());
            worst = worst.max(((k1 + k5) / number(2) - 1.0).abs());
            worst = worst.max((k5 - number(3)).abs() / number(2));
        }
        println!("worst error over K_1 + K_5: {worst:.1e}");
        assert!(worst < 1e-11, "{worst}");
    }

    #[test]
    fn tables_follow_an_adaptive_quadrature_and_slopes_follow_differences() {
        for width_deg in WIDTHS_DEG {
            let beta = f64::to_radians(width_deg);
            let incoming = Incoming::new(&LongitudinalLobe::new(beta));
            let (mut worst, mut worst_slope) = (0.0_f64, 0.0_f64);
            for theta_deg in [0.0, -20.0, 47.3, 71.0, -80.0, 86.6, 89.0, 89.97, 90.0] {
                let theta = f64::to_radians(theta_deg);
                let found = incoming.integrals((0.5 * theta).tan());
                let k = exact(beta, theta);
                let step = 1e-3 * beta;
                let at = |n: f64| exact(beta + n * step, theta);
                let (a, b, c, d) = (at(-2.0), at(-1.0), at(1.0), at(2.0));
                let total = k[0] + k[1];
                for part in 0..2 {
                    worst = worst.max((found[part] - k[part]).abs() / total);
                    let slope = (a[part] - 8.0 * b[part] + 8.0 * c[part] - d[part]) / (12.0 * step);
                    worst_slope = worst_slope.max((found[part + 2] - slope).abs() * beta / total);
                }
            }
            println!("{width_deg} deg: K {worst:.1e}, dK {worst_slope:.1e}");
            assert!(worst < 1e-11 && worst_slope < 1e-9, "{width_deg}");
        }
    }

    #[test]
    fn no_bound_is_passed() {
        for width_deg in WIDTHS_DEG {
            let lobe = LongitudinalLobe::new(f64::to_radians(width_deg));
            for part in [Part::One, Part::Five] {
                let envelope = Envelope::new(&lobe, part);
                let mut closest = 0.0_f64;
                let mut random = Random::keyed(&[15, width_deg.to_bits()]);
                for _ in 0..40_000 {
                    let theta_o = PI * (random.uniform() - 0.5);
                    let z = NEAR * (2.0 * random.uniform() - 1.0);
                    let theta = lobe.width * z - theta_o;
                    if theta.abs() <= FRAC_PI_2 {
                        let (sin, cos) = theta.sin_cos();
                        let h = part_over_g(&lobe, part, sin, cos);
                        closest = closest
                            .max(h / envelope.near(theta_o))
                            .max(h / envelope.far);
                    }
                }
                println!("{width_deg} deg, {part:?}: {closest:.4} of the bound");
                assert!((0.9..0.985).contains(&closest), "{width_deg} {closest}");
            }
        }
    }
}
