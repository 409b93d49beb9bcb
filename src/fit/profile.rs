//! Intervals from the profile of the objective, where the quadratic picture is not to be trusted.
//!
//! At fixed values of one coordinate the objective is minimized over all others. With f the objective, `F(u)` its profile
//! above the minimum, H the curvature of f/2 and C the sandwich covariance of [`super::uncertainty`], a linear model has
//! `F = (u - u0)^2 / (H^-1)_jj` while `(u - u0)^2 / C_jj` is a chi-square number of one degree of freedom. So
//! ```text
//! z(u) = sign(u - u0) sqrt(F(u) (H^-1)_jj / C_jj)
//! ```
//! makes `exp(-z^2 / 2)` the density that intervals are read from, between the bounds, also where the model is not linear:
//! relative least squares are no likelihood, and the factor scales them to one (Chandler and Bate 2007).
//!
//! The objective is evaluated without tracing, on paths recorded once at the fit, two independent sets a and b: with r the
//! residuals of the final check, `f(u) = sum w (r + Ra(u) - Ra(u0)) (r + Rb(u) - Rb(u0))`, which has no noise at the fit
//! and little near it. A linear term gives it the gradient of the whole fit. How noisy f is away from the fit is read from how
//! far the two recordings differ there: what few paths leave open looks like curvature as often as not. Where the recording
//! is not to be trusted, or too noisy, nothing is said, and the interval stays quadratic.

use super::linear::{Matrix, box_quadratic};
use super::space::SearchSpace;
use crate::base::{Result, Watch};
use crate::math::special::normal_density;
use crate::render::{Recall, Recalled, Request, Scene, TRUST_THRESHOLD};
use crate::scatter::CHANNELS;

/// The profile is followed to this many standard deviations, or to the bound.
const FARTHEST: f64 = 2.9;
/// One step of `z` along the profile.
const STRIDE: f64 = 0.5;
/// Most steps to a side, and the longest of them as a share of the range.
const MOST_STEPS: usize = 40;
const LONGEST: f64 = 0.06;
/// Gauss-Newton steps over the other coordinates at each point.
const INNER: usize = 3;
/// Most a coordinate may move in one of them.
const REACH: f64 = 0.4;
/// Most a point's `z^2` may be in doubt by noise, one standard error, over the larger of z and 1: z is then known to a quarter.
const DOUBT: f64 = 0.5;
/// Quantiles that stand for the distribution, and parts of each stride in its integral.
const QUANTILES: usize = 2001;
const PARTS: u32 = 40;

/// Two recordings at the fit that share no random number, and the seconds they took: elapsed, and of all threads.
pub(super) struct Recorded {
    recordings: [Box<dyn Recall>; 2],
    pub(super) wall_s: f64,
    pub(super) cpu_s: f64,
}

impl Recorded {
    /// Records twice at the request's parameters, on streams `2 index` and `2 index + 1`; `None` where the scene cannot.
    ///
    /// # Errors
    /// When the scene fails.
    pub(super) fn new(
        scene: &dyn Scene,
        request: &Request<'_>,
        index: u64,
        watch: &dyn Watch,
    ) -> Result<Option<Self>> {
        let one = |stream| {
            let request = Request {
                stream,
                ..request.clone()
            };
            scene.recall(&request, watch)
        };
        let Some(a) = one(2 * index)? else {
            return Ok(None);
        };
        Ok(one(2 * index + 1)?.map(|b| Self {
            wall_s: a.wall_s + b.wall_s,
            cpu_s: a.cpu_s + b.cpu_s,
            recordings: [a.paths, b.paths],
        }))
    }
}

/// Profiles of one fit.
pub(super) struct Profiler<'a> {
    space: &'a SearchSpace,
    recorded: &'a Recorded,
    /// Weight of each number.
    weights: &'a [f64],
    /// The fit.
    u: &'a [f64],
    /// What is added to each recording's means to get residuals.
    offsets: [Vec<f64>; 2],
    /// What the recorded gradient at the fit lacks to the one of all renders.
    tilt: Vec<f64>,
}

/// A point of the recorded objective.
struct Point {
    /// The objective, linear term included.
    value: f64,
    /// Gradient of half of it.
    gradient: Vec<f64>,
    curvature: Matrix,
    /// Variance of the value by the recordings' noise, from how far the two differ.
    noise: f64,
    trusted: bool,
}

impl<'a> Profiler<'a> {
    /// Profiles around the fit `u` with these residuals there and this gradient of half the objective.
    ///
    /// # Errors
    /// When a number is not finite.
    pub(super) fn new(
        space: &'a SearchSpace,
        recorded: &'a Recorded,
        weights: &'a [f64],
        u: &'a [f64],
        residual: &[f64],
        gradient: &[f64],
    ) -> Result<Self> {
        let mut profiler = Self {
            space,
            recorded,
            weights,
            u,
            offsets: [vec![0.0; residual.len()], vec![0.0; residual.len()]],
            tilt: vec![0.0; u.len()],
        };
        let parameters = space.to_parameters(u);
        for (recording, offset) in recorded.recordings.iter().zip(&mut profiler.offsets) {
            let here = recording.recall(&parameters)?;
            let lacks = residual.iter().zip(means(&here)).map(|(r, m)| r - m);
            *offset = lacks.collect();
        }
        let here = profiler.point(u)?;
        profiler.tilt = (gradient.iter().zip(&here.gradient))
            .map(|(whole, recorded)| whole - recorded)
            .collect();
        Ok(profiler)
    }

    /// Sorted coordinates that stand for the distribution of place `j`; `scale` is `(H^-1)_jj / C_jj`. `None` where the
    /// recording does not reach far enough or is too noisy.
    ///
    /// # Errors
    /// When a number is not finite.
    pub(super) fn quantiles(&self, j: usize, scale: f64) -> Result<Option<Vec<f64>>> {
        self.quantiles_within(j, scale, DOUBT)
    }

    fn quantiles_within(&self, j: usize, scale: f64, doubt: f64) -> Result<Option<Vec<f64>>> {
        let start = self.point(self.u)?;
        let mut curve = vec![(self.u[j], 0.0)];
        for side in [-1.0, 1.0] {
            match self.side(j, side, [scale, doubt], &start)? {
                Some(points) => curve.extend(points),
                None => return Ok(None),
            }
        }
        curve.sort_by(|a, b| a.0.total_cmp(&b.0));
        // Noise of the recording may bend the curve back a little; probabilities do not.
        for i in 1..curve.len() {
            curve[i].1 = f64::max(curve[i].1, curve[i - 1].1);
        }
        Ok((curve.len() > 1).then(|| spread(&curve)))
    }

    fn point(&self, u: &[f64]) -> Result<Point> {
        let parameters = self.space.to_parameters(u);
        let slopes = self.space.slopes(&parameters);
        let (n, p) = (self.weights.len(), u.len());
        let mut trusted = true;
        let mut residuals = Vec::new();
        let mut jacobians = Vec::new();
        for (recording, offset) in self.recorded.recordings.iter().zip(&self.offsets) {
            let recalled = recording.recall(&parameters)?;
            trusted &= recalled.trust.least_ratio() >= TRUST_THRESHOLD;
            let mut jacobian = Matrix::zeros(n, p);
            for (i, e) in recalled.estimates.configurations.iter().enumerate() {
                for row in 0..e.derivative.len() {
                    for c in 0..CHANNELS {
                        let j = parameters.slot(row, c);
                        jacobian[(CHANNELS * i + c, j)] = e.derivative[row][c] * slopes[j];
                    }
                }
            }
            let residual: Vec<f64> = means(&recalled).zip(offset).map(|(m, o)| m + o).collect();
            residuals.push(residual);
            jacobians.push(jacobian);
        }
        let noise = (self.weights.chunks(CHANNELS))
            .zip(
                residuals[0]
                    .chunks(CHANNELS)
                    .zip(residuals[1].chunks(CHANNELS)),
            )
            .map(|(w, (a, b))| noise_of_products(w, a, b))
            .sum();
        let products = residuals[0].iter().zip(&residuals[1]).zip(self.weights);
        let linear =
            (self.tilt.iter().zip(u.iter().zip(self.u))).map(|(t, (u, fit))| t * (u - fit));
        let value = products.map(|((a, b), w)| w * a * b).sum::<f64>() + 2.0 * linear.sum::<f64>();
        let mut gradient = self.tilt.clone();
        for (jacobian, residual) in jacobians.iter().zip(residuals.iter().rev()) {
            let part = jacobian.weighted_transpose_times(self.weights, residual);
            gradient
                .iter_mut()
                .zip(&part)
                .for_each(|(g, p)| *g += 0.5 * p);
        }
        let mut mean = jacobians[0].clone();
        mean.add_scaled(1.0, &jacobians[1]);
        mean.scale(0.5);
        let mut curvature = mean.weighted_gram(self.weights, &mean);
        (0..p).for_each(|j| curvature[(j, j)] = 1.02 * curvature[(j, j)] + 1e-12);
        Ok(Point {
            value,
            gradient,
            curvature,
            noise,
            trusted,
        })
    }

    /// Points `(u_j, z)` of the profile to one side; `None` where they cannot be known.
    fn side(
        &self,
        j: usize,
        side: f64,
        [scale, doubt]: [f64; 2],
        start: &Point,
    ) -> Result<Option<Vec<(f64, f64)>>> {
        let end = if side < 0.0 {
            self.space.lower()[j]
        } else {
            self.space.upper()[j]
        };
        let mut points = Vec::new();
        let mut u = self.u.to_vec();
        let longest = LONGEST * (self.space.upper()[j] - self.space.lower()[j]);
        // A first stride from the curvature along the axis, which is never smaller than the profile's.
        let steepness = scale * start.curvature[(j, j)];
        let mut step = (STRIDE / steepness.max(1e-12).sqrt()).min(longest);
        let mut last = 0.0;
        for _ in 0..MOST_STEPS {
            if side * (end - u[j]) <= 0.0 {
                return Ok(Some(points));
            }
            let before = u.clone();
            u[j] = if side > 0.0 {
                (u[j] + step).min(end)
            } else {
                (u[j] - step).max(end)
            };
            let there = self.minimize_others(j, &mut u)?;
            let z = ((there.value - start.value).max(0.0) * scale).sqrt();
            if z - last > 2.5 * STRIDE && step > 1e-2 * longest {
                // Too far at once to be straight.
                u = before;
                step *= 0.4;
                continue;
            }
            if !there.trusted || scale * there.noise.sqrt() > doubt * z.max(1.0) {
                return Ok(None);
            }
            points.push((u[j], side * z));
            if z >= FARTHEST {
                return Ok(Some(points));
            }
            // The next stride by how steep the last one was, at most three times as long.
            let factor = STRIDE / (z - last).max(STRIDE / 3.0);
            step = (step * factor).min(longest);
            last = z;
        }
        Ok(None)
    }

    /// Moves all coordinates but `j` to the least objective; returns that point.
    fn minimize_others(&self, j: usize, u: &mut [f64]) -> Result<Point> {
        let mut here = self.point(u)?;
        for _ in 0..INNER {
            let room = |bounds: &[f64], toward: f64| -> Vec<f64> {
                (0..u.len())
                    .map(|i| {
                        let free = (toward * (bounds[i] - u[i])).clamp(0.0, REACH);
                        if i == j { 0.0 } else { toward * free }
                    })
                    .collect()
            };
            let (lower, upper) = (
                room(self.space.lower(), -1.0),
                room(self.space.upper(), 1.0),
            );
            let step = box_quadratic(&here.curvature, &here.gradient, &lower, &upper);
            let next: Vec<f64> = u.iter().zip(&step).map(|(u, s)| u + s).collect();
            let next = self.space.clamped(&next);
            let there = self.point(&next)?;
            if there.value >= here.value {
                break;
            }
            let gain = here.value - there.value;
            u.copy_from_slice(&next);
            here = there;
            if gain < 1e-3 * here.value.abs() {
                break;
            }
        }
        Ok(here)
    }
}

/// Variance of `sum w a b` over the channels of one configuration, with a and b independent and equally noisy, from their
/// difference d: to first order `sum w (a + b) d / 2` is as noisy as the sum, channels being noisy together; to second
/// order a product of two errors has the variance `E(d^4) / 12`.
fn noise_of_products(w: &[f64], a: &[f64], b: &[f64]) -> f64 {
    let (mut first, mut second) = (0.0, 0.0);
    for ((w, a), b) in w.iter().zip(a).zip(b) {
        first += 0.5 * w * (a + b) * (a - b);
        second += w * w * (a - b).powi(4) / 12.0;
    }
    first * first + second
}

fn means(recalled: &Recalled) -> impl Iterator<Item = f64> + '_ {
    recalled
        .estimates
        .configurations
        .iter()
        .flat_map(|e| e.mean)
}

/// Evenly spaced quantiles of the density `exp(-z^2 / 2)` between the curve's ends, z linear between its points.
fn spread(curve: &[(f64, f64)]) -> Vec<f64> {
    let parts = f64::from(PARTS);
    let mut places = vec![curve[0].0];
    let mut below = vec![0.0];
    for ends in curve.windows(2) {
        let (from, to) = (ends[0], ends[1]);
        let width = (to.0 - from.0) / parts;
        for k in 0..PARTS {
            let z = from.1 + (to.1 - from.1) * (f64::from(k) + 0.5) / parts;
            places.push(from.0 + width * f64::from(k + 1));
            below.push(below[below.len() - 1] + width * normal_density(z));
        }
    }
    let all = below[below.len() - 1];
    let mut at = 0;
    (0..QUANTILES)
        .map(|q| {
            let t = all * q as f64 / (QUANTILES - 1) as f64;
            while at + 2 < below.len() && below[at + 1] < t {
                at += 1;
            }
            let width = below[at + 1] - below[at];
            let part = if width > 0.0 {
                ((t - below[at]) / width).clamp(0.0, 1.0)
            } else {
                0.0
            };
            places[at] + part * (places[at + 1] - places[at])
        })
        .collect()
}

#[cfg(test)]
mod tests;
