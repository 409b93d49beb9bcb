//! How well each parameter is known: intervals from a normal distribution cut off at the bounds.
//!
//! Near the fit the estimator is linear in the errors, so in search coordinates its covariance is the sandwich
//! `H^-1 (J'W S W J + N) H^-1` with S the measurements' covariance and N that of the fit's Monte Carlo noise. Directions
//! that no render distinguished from noise get no information at all: within them every point of the box is equally
//! likely. The product of that normal density, centered where the fit's last step leads, and of the box is sampled
//! (Gibbs), and intervals are read off the samples. So a parameter on a bound gets a one-sided interval, and one the data
//! do not see gets its whole range. Errors of different numbers are taken as independent; a scale error common to all
//! measurements is included only where a gain is one of the coordinates, with its prior's precision.

use super::linear::{Matrix, dot, eigen, inverse};
use super::pool::{Direction, LinearModel};
use super::space::SearchSpace;
use crate::math::{Random, statistics::Running};

/// Gibbs sweeps kept, and dropped before them.
const SWEEPS: (usize, usize) = (20_000, 1_000);

/// How far outside the box the density's center may lie, in its standard deviations: a model that is wrong pulls farther, and
/// would make a bound look certain.
const FARTHEST_OUTSIDE: f64 = 2.0;

/// Points of the box, in search coordinates, distributed as the parameters' uncertainty.
#[derive(Debug, Clone)]
pub(super) struct Samples {
    /// One sorted list per flat place.
    sorted: Vec<Vec<f64>>,
    /// Correlation between flat places.
    pub(super) correlation: Matrix,
    /// Standard deviation of each flat place, in search coordinates.
    pub(super) sd: Vec<f64>,
}

/// An interval in search coordinates.
pub(super) type Interval = [f64; 2];

impl Samples {
    /// Puts another distribution, by sorted equally likely coordinates, in the place of flat place `j`'s.
    pub(super) fn replace(&mut self, j: usize, sorted: Vec<f64>) {
        self.sorted[j] = sorted;
    }

    /// Samples of the normal density of this precision around `center`, cut off at the bounds.
    pub(super) fn around(
        space: &SearchSpace,
        center: &[f64],
        precision: &Matrix,
        seed: u64,
    ) -> Self {
        let mut random = Random::keyed(&[seed, 0x0fff_17ce]);
        let p = space.len();
        let mut x = space.clamped(center);
        let directions = directions(space, precision);
        let mut samples = vec![Vec::with_capacity(SWEEPS.0); p];
        for sweep in 0..SWEEPS.0 + SWEEPS.1 {
            for e in &directions {
                move_along(e, space, precision, center, &mut x, &mut random);
            }
            if sweep >= SWEEPS.1 {
                samples.iter_mut().zip(&x).for_each(|(s, x)| s.push(*x));
            }
        }
        let correlation = correlation(&samples);
        let sd = samples.iter().map(|s| deviation(s)).collect();
        samples.iter_mut().for_each(|s| s.sort_by(f64::total_cmp));
        Self {
            sorted: samples,
            correlation,
            sd,
        }
    }

    /// The shortest of the central interval of this probability and the two that begin at a bound, widened to hold the
    /// fit's own `value`.
    pub(super) fn interval(
        &self,
        space: &SearchSpace,
        j: usize,
        level: f64,
        value: f64,
    ) -> Interval {
        let tail = 1.0 - level;
        let q = |t: f64| quantile(&self.sorted[j], t);
        let (low, high) = (space.lower()[j], space.upper()[j]);
        let candidates = [
            [q(0.5 * tail), q(1.0 - 0.5 * tail)],
            [low, q(level)],
            [q(tail), high],
        ];
        candidates
            .into_iter()
            .min_by(|a, b| (a[1] - a[0]).total_cmp(&(b[1] - b[0])))
            .map_or([low, high], |[a, b]| [a.min(value), b.max(value)])
    }

    /// The coordinate below which the parameter lies with probability `t`.
    pub(super) fn quantile(&self, j: usize, t: f64) -> f64 {
        quantile(&self.sorted[j], t)
    }

    /// The 16 % to 84 % half width, in search coordinates.
    pub(super) fn standard_error(&self, j: usize) -> f64 {
        0.5 * (quantile(&self.sorted[j], 0.8413) - quantile(&self.sorted[j], 0.1587))
    }
}

/// The axes, and the eigenvectors of the precision in units of the box: along these last the sampler crosses the long
/// narrow valleys of parameters that trade off, which moves along the axes would take forever to.
fn directions(space: &SearchSpace, precision: &Matrix) -> Vec<Vec<f64>> {
    let p = space.len();
    let widths: Vec<f64> = (0..p)
        .map(|j| space.upper()[j] - space.lower()[j])
        .collect();
    let mut scaled = Matrix::zeros(p, p);
    for i in 0..p {
        for j in 0..p {
            scaled[(i, j)] = widths[i] * precision[(i, j)] * widths[j];
        }
    }
    let axis = |j: usize| {
        (0..p)
            .map(|i| if i == j { widths[j] } else { 0.0 })
            .collect()
    };
    let valleys = eigen(&scaled)
        .into_iter()
        .map(|(_, v)| v.iter().zip(&widths).map(|(v, w)| v * w).collect());
    (0..p).map(axis).chain(valleys).collect()
}

/// Draws a new point on the line through `x` along `e`: the normal density of this precision around `center`, cut by the
/// box.
fn move_along(
    e: &[f64],
    space: &SearchSpace,
    precision: &Matrix,
    center: &[f64],
    x: &mut [f64],
    random: &mut Random,
) {
    let (mut low, mut high) = (f64::NEG_INFINITY, f64::INFINITY);
    for (j, &e) in e.iter().enumerate().filter(|(_, e)| e.abs() > 1e-12) {
        let (a, b) = ((space.lower()[j] - x[j]) / e, (space.upper()[j] - x[j]) / e);
        low = low.max(a.min(b));
        high = high.min(a.max(b));
    }
    if low >= high {
        return;
    }
    let curvature = precision.form(e, e);
    let t = if curvature * (high - low).powi(2) < 1e-6 {
        // Too little information to curve the box's density noticeably.
        low + (high - low) * random.uniform()
    } else {
        let away: Vec<f64> = x.iter().zip(center).map(|(x, c)| x - c).collect();
        let (mean, sd) = (
            -precision.form(e, &away) / curvature,
            curvature.sqrt().recip(),
        );
        mean + sd * truncated_normal((low - mean) / sd, (high - mean) / sd, random)
    };
    for (j, x) in x.iter_mut().enumerate() {
        *x = (*x + t * e[j]).clamp(space.lower()[j], space.upper()[j]);
    }
}

fn quantile(sorted: &[f64], t: f64) -> f64 {
    let position = t.clamp(0.0, 1.0) * (sorted.len() - 1) as f64;
    let below = position.floor() as usize;
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + (position - below as f64) * (sorted[above] - sorted[below])
}

/// The normal density around a fit, before the box cuts it.
///
/// A search ends before its Newton step is zero: the center is where the step that is left leads, and the step is added to
/// the errors as if it were one more of them. Where a bound holds the fit against a force, the center is where the fit would
/// lie without the bound: the data say how far outside.
pub(super) struct Density {
    pub(super) precision: Matrix,
    pub(super) center: Vec<f64>,
    /// Gradient of half the objective at the fit, that against bounds shortened as the center's distance is.
    pub(super) force: Vec<f64>,
    /// Per flat place: variance that the curvature alone would give over the variance of the errors.
    pub(super) scales: Vec<f64>,
}

impl Density {
    /// The density of the fit that ended at `u`; `noise` is the covariance of the gradient of half the objective.
    pub(super) fn new(space: &SearchSpace, u: &[f64], model: &LinearModel, noise: &Matrix) -> Self {
        let p = u.len();
        let seen = model.seen_directions();
        let mut left = model.gradient_at(u, &model.curvature);
        let mut force = vec![0.0; p];
        for j in 0..p {
            // At a bound a force toward the outside is the bound's, not a step left to make.
            let outward = (u[j] <= space.lower()[j] && left[j] > 0.0)
                || (u[j] >= space.upper()[j] && left[j] < 0.0);
            if outward {
                force[j] = std::mem::take(&mut left[j]);
            }
        }
        let covariance = covariance(&seen, &left, noise);
        let mut density = Self {
            precision: Matrix::zeros(p, p),
            center: u.to_vec(),
            scales: scales(&seen, &covariance, p),
            force,
        };
        let Some(inner) = inverse(&covariance) else {
            return density;
        };
        let mut steps = newton(&seen, &density.force);
        let distance = inner.form(&steps, &steps).max(0.0).sqrt();
        let shortened = (FARTHEST_OUTSIDE / distance.max(1e-300)).min(1.0);
        density.force.iter_mut().for_each(|f| *f *= shortened);
        steps.iter_mut().for_each(|s| *s *= shortened);
        steps
            .iter_mut()
            .zip(newton(&seen, &left))
            .for_each(|(s, l)| *s += l);
        density
            .force
            .iter_mut()
            .zip(&left)
            .for_each(|(f, l)| *f += l);
        for (a, of_a) in seen.iter().enumerate() {
            for (b, of_b) in seen.iter().enumerate() {
                for i in 0..p {
                    for j in 0..p {
                        density.precision[(i, j)] += inner[(a, b)] * of_a.form[i] * of_b.form[j];
                    }
                }
            }
            for (center, step) in density.center.iter_mut().zip(&of_a.step) {
                *center -= steps[a] * step;
            }
        }
        if let Some((place, sd)) = space.gain() {
            density.precision[(place, place)] += 1.0 / (sd * sd);
        }
        density
    }
}

/// Lengths of the Newton step against `gradient` along each direction, with its sign changed.
fn newton(seen: &[Direction], gradient: &[f64]) -> Vec<f64> {
    seen.iter()
        .map(|d| dot(&d.step, gradient) / d.curvature)
        .collect()
}

/// Covariance of the lengths along the directions seen.
fn covariance(seen: &[Direction], left: &[f64], noise: &Matrix) -> Matrix {
    let left = newton(seen, left);
    let mut covariance = Matrix::zeros(seen.len(), seen.len());
    for (a, of_a) in seen.iter().enumerate() {
        for (b, of_b) in seen.iter().enumerate() {
            covariance[(a, b)] = noise.form(&of_a.step, &of_b.step)
                / (of_a.curvature * of_b.curvature)
                + left[a] * left[b];
        }
        // Exact data and exact renders would make the covariance singular; 1e-8 is a step too small to matter.
        let tiny = 1e-16 / dot(&of_a.step, &of_a.step).max(1e-300);
        covariance[(a, a)] = covariance[(a, a)] * (1.0 + 1e-9) + tiny;
    }
    covariance
}

fn scales(seen: &[Direction], covariance: &Matrix, p: usize) -> Vec<f64> {
    (0..p)
        .map(|j| {
            let along: Vec<f64> = seen.iter().map(|d| d.step[j]).collect();
            let squares = seen.iter().map(|d| d.step[j].powi(2) / d.curvature);
            squares.sum::<f64>() / covariance.form(&along, &along).max(1e-300)
        })
        .collect()
}

fn deviation(samples: &[f64]) -> f64 {
    let mut running = Running::default();
    samples.iter().for_each(|x| running.push(*x));
    running.variance().sqrt()
}

fn correlation(samples: &[Vec<f64>]) -> Matrix {
    let p = samples.len();
    let n = samples.first().map_or(1, Vec::len) as f64;
    let means: Vec<f64> = samples.iter().map(|s| s.iter().sum::<f64>() / n).collect();
    let covariance = |i: usize, j: usize| -> f64 {
        samples[i]
            .iter()
            .zip(&samples[j])
            .map(|(x, y)| (x - means[i]) * (y - means[j]))
            .sum::<f64>()
    };
    let variances: Vec<f64> = (0..p).map(|j| covariance(j, j)).collect();
    let mut matrix = Matrix::zeros(p, p);
    for i in 0..p {
        for j in 0..p {
            let scale = (variances[i] * variances[j]).sqrt();
            matrix[(i, j)] = if i == j {
                1.0
            } else if scale > 0.0 {
                (covariance(i, j) / scale).clamp(-1.0, 1.0)
            } else {
                0.0
            };
        }
    }
    matrix
}

/// A standard normal number between `low` and `high` by rejection (Robert 1995).
fn truncated_normal(low: f64, high: f64, random: &mut Random) -> f64 {
    if low > 0.0 {
        return tail(low, high, random);
    }
    if high < 0.0 {
        return -tail(-high, -low, random);
    }
    if high - low > 2.5 {
        loop {
            let z = random.normal();
            if (low..=high).contains(&z) {
                return z;
            }
        }
    }
    loop {
        let z = low + (high - low) * random.uniform();
        if random.uniform() <= (-0.5 * z * z).exp() {
            return z;
        }
    }
}

/// As [`truncated_normal`] for `0 < low < high`.
fn tail(low: f64, high: f64, random: &mut Random) -> f64 {
    let rate = 0.5 * (low + low.hypot(2.0));
    if (high - low) * rate < 1.0 {
        loop {
            let z = low + (high - low) * random.uniform();
            if random.uniform() <= (0.5 * (low - z) * (low + z)).exp() {
                return z;
            }
        }
    }
    loop {
        let z = low - random.uniform_open().ln() / rate;
        if z <= high && random.uniform() <= (-0.5 * (z - rate).powi(2)).exp() {
            return z;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Mean of a standard normal between `a` and `b` by Simpson's rule.
    fn exact_mean(a: f64, b: f64) -> f64 {
        let (a, b) = (a.max(-12.0), b.min(a.max(-12.0) + 24.0));
        let n = 20_000;
        let (mut top, mut bottom) = (0.0, 0.0);
        for i in 0..=n {
            let z = a + (b - a) * f64::from(i) / f64::from(n);
            let weight = if i == 0 || i == n {
                1.0
            } else {
                2.0 + 2.0 * f64::from(i % 2)
            };
            // Relative to the density at the end nearest to zero: far tails stay representable.
            let nearest = 0.0_f64.clamp(a, b);
            let density = weight * (0.5 * (nearest * nearest - z * z)).exp();
            top += density * z;
            bottom += density;
        }
        top / bottom
    }

    #[test]
    fn truncated_normals_have_the_right_mean_in_every_branch() {
        let cases = [
            (-1.0, 2.0),
            (-0.3, 0.4),
            (0.5, 0.6),
            (1.0, 40.0),
            (9.0, 9.5),
            (30.0, 31.0),
            (-8.0, -7.0),
            (-100.0, 100.0),
        ];
        // Sees a shift of 4.5 standard errors: at most 2 % of the spread.
        let n = 60_000;
        for (i, (a, b)) in cases.into_iter().enumerate() {
            let mut random = Random::keyed(&[21, i as u64]);
            let mut running = Running::default();
            for _ in 0..n {
                let z = truncated_normal(a, b, &mut random);
                assert!((a..=b).contains(&z));
                running.push(z);
            }
            let error = running.mean() - exact_mean(a, b);
            assert!(
                error.abs() < 4.5 * running.standard_error(),
                "({a}, {b}): mean {} off by {error}, se {}, n {n}",
                running.mean(),
                running.standard_error()
            );
        }
    }
}
