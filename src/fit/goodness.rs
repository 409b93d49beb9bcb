//! Are the residuals as large as errors explain?
//!
//! A right model leaves `e = (I - P) a + J H^-1 b + c` of its measurements: a the measurements' errors, P the part of them
//! that the fit absorbs (`J H^-1 J'W` over the parameters that are not held by a bound), b the Monte Carlo error of the
//! fit's gradient, c that of the fresh renders that judge. With D the variances of a and c the statistic is
//! `Q = sum e^2 / D`; its mean and variance follow from the covariance of e, and `Q / scale` is compared with the
//! chi-square distribution of the same two moments (Satterthwaite 1946), so the degrees of freedom are estimated, not
//! counted. First order in the errors, which are taken as normal and, but for the renders', as independent.

use super::linear::{Matrix, dot, inverse};
use super::objective::{Objective, RenderPair, channel_correlation};
use super::result::Goodness;
use super::search::Found;
use super::space::SearchSpace;
use crate::math::special::normal_probability;
use crate::scatter::CHANNELS;
use glam::DVec3;

/// Residuals whose goodness is below this probability are called unexplained, in its sentence and in the fit's reason.
pub(super) const SURPRISE: f64 = 1e-3;

/// Residuals of the final check, and how far they may be from zero when the model is right.
pub(super) struct Residuals {
    /// Rendered minus measured; zero where nothing was measured.
    pub(super) residual: Vec<f64>,
    pub(super) present: Vec<bool>,
    measured_variance: Vec<f64>,
    render_se: Vec<f64>,
    /// Numbers whose renders share camera paths: index of their camera direction.
    camera: Vec<usize>,
    /// Correlation of render errors between channels of a configuration, and between configurations of one camera.
    shared: [f64; 2],
    /// Columns of the Jacobian by free parameters.
    jacobian: Matrix,
    /// `H^-1 J'W` transposed.
    absorbing: Matrix,
    /// Covariance of the free parameters from Monte Carlo noise.
    monte_carlo: Matrix,
}

impl Residuals {
    /// Those of a fresh pair at the result.
    pub(super) fn of(
        space: &SearchSpace,
        objective: &Objective,
        found: &Found,
        pair: &RenderPair,
    ) -> Self {
        let inside = |j: &usize| {
            let u = found.u[*j];
            u > space.lower()[*j] && u < space.upper()[*j]
        };
        let free: Vec<usize> = (0..space.len()).filter(inside).collect();
        let jacobian = found.model.jacobian.columns(&free);
        // Without an inverse nothing is taken as absorbed, which expects more than it should.
        let back = inverse(&found.curvature.sub(&free))
            .unwrap_or_else(|| Matrix::zeros(free.len(), free.len()));
        let mut absorbing = jacobian.times_matrix(&back);
        absorbing.scale_rows(&found.model.weights);
        let monte_carlo = back
            .times_matrix(&found.model.monte_carlo.sub(&free))
            .times_matrix(&back);
        let (mut residual, mut measured_variance, mut render_se) = (vec![], vec![], vec![]);
        let mut present = Vec::new();
        for (i, [a, b]) in objective.intensities().iter().zip(pair.estimates()) {
            for c in 0..CHANNELS {
                let difference = 0.5 * (a.mean[c] + b.mean[c]) - i.mean[c];
                residual.push(if i.present[c] { difference } else { 0.0 });
                present.push(i.present[c]);
                measured_variance.push(i.standard_error[c].powi(2));
                render_se.push(0.5 * a.standard_error[c].hypot(b.standard_error[c]));
            }
        }
        let camera = cameras(objective);
        Self {
            shared: shared(&camera, pair),
            residual,
            present,
            measured_variance,
            render_se,
            camera,
            jacobian,
            absorbing,
            monte_carlo,
        }
    }

    fn len(&self) -> usize {
        self.residual.len()
    }

    /// Covariance of measurement and render errors of numbers `m` and `k`.
    fn error(&self, m: usize, k: usize) -> f64 {
        if self.camera[m] != self.camera[k] {
            return 0.0;
        }
        let [channels, configurations] = self.shared;
        let (correlation, measured) = if m == k {
            (1.0, self.measured_variance[m])
        } else if m / CHANNELS == k / CHANNELS {
            (channels, 0.0)
        } else {
            (configurations, 0.0)
        };
        measured + correlation * self.render_se[m] * self.render_se[k]
    }

    /// Standard error of `sum a e` when the model is right.
    pub(super) fn standard_error(&self, a: &[f64]) -> f64 {
        let through = self.jacobian.transpose_times(a);
        let absorbed = self.absorbing.times(&through);
        let numbers: Vec<usize> = (0..self.len()).filter(|&m| a[m].abs() > 0.0).collect();
        let mut variance = self.monte_carlo.form(&through, &through);
        for &m in &numbers {
            for &k in &numbers {
                let own = if m == k {
                    self.measured_variance[m]
                } else {
                    0.0
                };
                variance += a[m] * a[k] * (self.error(m, k) - own);
            }
        }
        for (m, s) in self.measured_variance.iter().enumerate() {
            variance += s * (a[m] - absorbed[m]).powi(2);
        }
        variance.max(0.0).sqrt()
    }

    /// The statistic and what a right model would give; `None` where a number has no error at all, or nothing is left
    /// to compare.
    pub(super) fn goodness(&self) -> Option<Goodness> {
        let n = self.len();
        // A number that was not measured has no part in the sums.
        let scale = |m: usize| match self.present[m] {
            true => self.error(m, m),
            false => f64::INFINITY,
        };
        let scale: Vec<f64> = (0..n).map(scale).collect();
        if scale.iter().any(|d| *d <= 0.0) {
            return None;
        }
        let statistic: f64 = (self.residual.iter().zip(&scale))
            .map(|(e, d)| e * e / d)
            .sum();
        let (expected, variance) = self.moments(&scale);
        if !(expected > 0.0 && variance > 0.0) {
            return None;
        }
        let freedom = 2.0 * expected * expected / variance;
        let probability = chi_square_above(statistic * freedom / expected, freedom);
        Some(Goodness {
            statistic,
            expected,
            degrees_of_freedom: freedom,
            probability,
            sentence: sentence(probability),
        })
    }

    /// Mean and variance of `sum e^2 / scale`. The covariance of e is `B + J K J' - J G' - G J'`, B that of the errors,
    /// `G = S A`, `K = A' S A` and the Monte Carlo part, A the absorbing matrix: everything but B has low rank.
    fn moments(&self, scale: &[f64]) -> (f64, f64) {
        let (n, p) = (self.len(), self.jacobian.n_columns());
        let mut factors = Matrix::zeros(n, 2 * p);
        for m in 0..n {
            for j in 0..p {
                factors[(m, j)] = self.jacobian[(m, j)];
                factors[(m, p + j)] = self.measured_variance[m] * self.absorbing[(m, j)];
            }
        }
        let mut middle = Matrix::zeros(2 * p, 2 * p);
        let absorbed = self
            .absorbing
            .weighted_gram(&self.measured_variance, &self.absorbing);
        for i in 0..p {
            for j in 0..p {
                middle[(i, j)] = absorbed[(i, j)] + self.monte_carlo[(i, j)];
            }
            middle[(i, p + i)] = -1.0;
            middle[(p + i, i)] = -1.0;
        }
        let inverse: Vec<f64> = scale.iter().map(|d| d.recip()).collect();
        let low = middle.times_matrix(&factors.weighted_gram(&inverse, &factors));
        // B D^-1 F, row by row; numbers of different cameras have nothing in common.
        let mut spread = Matrix::zeros(n, 2 * p);
        let mut squares = 0.0;
        for m in 0..n {
            for k in (0..n).filter(|&k| self.camera[k] == self.camera[m]) {
                let b = self.error(m, k);
                squares += b * b * inverse[m] * inverse[k];
                for j in 0..2 * p {
                    spread[(m, j)] += b * inverse[k] * factors[(k, j)];
                }
            }
        }
        let cross = middle.times_matrix(&factors.weighted_gram(&inverse, &spread));
        let trace = |a: &Matrix| (0..2 * p).map(|i| a[(i, i)]).sum::<f64>();
        let square = trace(&low.times_matrix(&low));
        let measured = self.present.iter().filter(|p| **p).count();
        let expected = measured as f64 + trace(&low);
        (expected, 2.0 * (squares + 2.0 * trace(&cross) + square))
    }
}

/// The camera direction of each number, counted.
fn cameras(objective: &Objective) -> Vec<usize> {
    let mut seen: Vec<DVec3> = Vec::new();
    let mut index = |direction: DVec3| {
        let same = |s: &DVec3| (*s - direction).length() < 1e-12;
        seen.iter().position(same).unwrap_or_else(|| {
            seen.push(direction);
            seen.len() - 1
        })
    };
    (objective.intensities().iter())
        .flat_map(|i| [index(i.configuration.camera_in_sample().vector()); CHANNELS])
        .collect()
}

/// Correlation of render errors between channels, and between configurations of one camera, pooled over the pair's
/// standardized differences; between 0 and 1, the second not above the first.
fn shared(camera: &[usize], pair: &RenderPair) -> [f64; 2] {
    let z: Vec<[f64; CHANNELS]> = pair.standardized_differences().collect();
    let rho = channel_correlation(z.iter().copied());
    let channels = ((rho[0][1] + rho[0][2] + rho[1][2]) / 3.0).clamp(0.0, 1.0);
    let (mut products, mut squares) = (0.0, 0.0);
    for (i, a) in z.iter().enumerate() {
        for (k, b) in z.iter().enumerate().skip(i + 1) {
            if camera[CHANNELS * i] == camera[CHANNELS * k] {
                products += dot(a, b);
                squares += 0.5 * (dot(a, a) + dot(b, b));
            }
        }
    }
    let configurations = if squares > 0.0 {
        products / squares
    } else {
        0.0
    };
    [channels, configurations.clamp(0.0, channels)]
}

/// Probability that a chi-square number of so many degrees of freedom exceeds `x`, by the cube root's nearly normal
/// distribution (Wilson and Hilferty 1931): off by less than 0.0135 over the degrees of freedom, from five on.
pub(super) fn chi_square_above(x: f64, freedom: f64) -> f64 {
    let variance = 2.0 / (9.0 * freedom);
    normal_above(((x / freedom).cbrt() - 1.0 + variance) / variance.sqrt())
}

/// Probability that a standard normal number exceeds `z`.
pub(super) fn normal_above(z: f64) -> f64 {
    normal_probability(z, f64::INFINITY)
}

/// The probability in words.
fn sentence(probability: f64) -> String {
    let (word, p) = if probability > 0.99 {
        ("small", 1.0 - probability)
    } else {
        ("large", probability)
    };
    let often = if p < 1e-4 {
        "fewer than 1 of 10000".to_owned()
    } else if p < 0.0995 {
        format!("{:.0} of 1000", (1000.0 * p).max(1.0))
    } else {
        format!("{:.0} of 100", 100.0 * p)
    };
    let remark = match probability {
        p if p < SURPRISE => ": more than the stated errors and the noise of the renders explain",
        p if p > 0.999 => ": the stated errors are too large",
        _ => "",
    };
    format!("residuals this {word} would come in {often} fits of a right model{remark}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use statrs::distribution::{ChiSquared, ContinuousCDF};

    #[test]
    fn the_chi_square_tail_is_that_of_the_distribution() {
        // The approximation's own error times the degrees of freedom is 0.0131 at five and less from there on.
        for freedom in [5.0, 12.5, 38.0, 200.0] {
            let exact = ChiSquared::new(freedom).unwrap();
            for i in 1..60 {
                let x = freedom * f64::from(i) / 20.0;
                let error = chi_square_above(x, freedom) - exact.sf(x);
                assert!(error.abs() < 0.0135 / freedom, "{freedom} {x}: {error}");
            }
        }
        // Negative control: the plain normal approximation is seen.
        let (x, n): (f64, f64) = (10.0, 5.0);
        let normal = normal_above((x - n) / (2.0 * n).sqrt());
        assert!((normal - ChiSquared::new(n).unwrap().sf(x)).abs() > 0.0135 / n);
    }

    #[test]
    fn probabilities_are_put_into_words() {
        assert!(sentence(0.003).contains("this large would come in 3 of 1000 fits"));
        assert!(sentence(0.4).contains("this large would come in 40 of 100 fits"));
        assert!(
            sentence(1e-9).contains("fewer than 1 of 10000")
                && sentence(1e-9).contains("more than the stated errors")
        );
        assert!(sentence(0.998).contains("this small would come in 2 of 1000 fits"));
    }
}
