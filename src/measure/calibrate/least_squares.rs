//! Weighted least squares of a few parameters, what is left unexplained, and robust middle and spread.

/// The normal equations of a linear model, summed up observation by observation.
#[derive(Debug, Clone)]
pub(super) struct Normal {
    n: usize,
    matrix: Vec<Vec<f64>>,
    right: Vec<f64>,
    square: f64,
    observations: usize,
}

/// What a fit says.
#[derive(Debug, Clone, Default)]
pub(super) struct Solution {
    pub(super) values: Vec<f64>,
    pub(super) covariance: Vec<Vec<f64>>,
    /// Weighted sum of squared residuals.
    pub(super) chi_square: f64,
    /// Observations less parameters.
    pub(super) freedom: usize,
}

impl Normal {
    pub(super) fn new(n: usize) -> Self {
        Self {
            n,
            matrix: vec![vec![0.0; n]; n],
            right: vec![0.0; n],
            square: 0.0,
            observations: 0,
        }
    }

    /// Adds `y = row . parameters`, known to this variance.
    pub(super) fn add(&mut self, row: &[f64], y: f64, variance: f64) {
        let weight = 1.0 / variance;
        for i in 0..self.n {
            for j in 0..self.n {
                self.matrix[i][j] += weight * row[i] * row[j];
            }
            self.right[i] += weight * row[i] * y;
        }
        self.square += weight * y * y;
        self.observations += 1;
    }

    /// The parameters and their covariance; none when the observations do not determine them.
    pub(super) fn solve(&self) -> Option<Solution> {
        let scale: Vec<f64> = (0..self.n).map(|i| self.matrix[i][i].sqrt()).collect();
        let unit: Vec<Vec<f64>> = (0..self.n)
            .map(|i| {
                let row = (0..self.n).map(|j| self.matrix[i][j] / (scale[i] * scale[j]));
                row.collect()
            })
            .collect();
        let lower = cholesky(&unit)?;
        let mut covariance = vec![vec![0.0; self.n]; self.n];
        for j in 0..self.n {
            let mut column = vec![0.0; self.n];
            column[j] = 1.0;
            forward(&lower, &mut column);
            backward(&lower, &mut column);
            for i in 0..self.n {
                covariance[i][j] = column[i] / (scale[i] * scale[j]);
            }
        }
        let values: Vec<f64> = covariance.iter().map(|r| dot(r, &self.right)).collect();
        Some(Solution {
            chi_square: (self.square - dot(&values, &self.right)).max(0.0),
            values,
            covariance,
            freedom: self.observations.saturating_sub(self.n),
        })
    }
}

impl Solution {
    /// Standard error of a parameter.
    pub(super) fn se(&self, i: usize) -> f64 {
        self.covariance[i][i].sqrt()
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// The lower triangle L of `a = L L'`; none when a pivot is not positive.
pub(super) fn cholesky(a: &[Vec<f64>]) -> Option<Vec<Vec<f64>>> {
    let n = a.len();
    let mut l = vec![vec![0.0; n]; n];
    for i in 0..n {
        for j in 0..=i {
            let rest = a[i][j] - dot(&l[i][..j], &l[j][..j]);
            if i != j {
                l[i][j] = rest / l[j][j];
            } else if (1e-13..f64::MAX).contains(&(rest / a[i][i])) {
                l[i][i] = rest.sqrt();
            } else {
                return None;
            }
        }
    }
    Some(l)
}

/// `x := L^-1 x`.
pub(super) fn forward(l: &[Vec<f64>], x: &mut [f64]) {
    for i in 0..x.len() {
        x[i] = (x[i] - dot(&l[i][..i], &x[..i])) / l[i][i];
    }
}

/// `x := L'^-1 x`.
fn backward(l: &[Vec<f64>], x: &mut [f64]) {
    for i in (0..x.len()).rev() {
        let above: f64 = (i + 1..x.len()).map(|k| l[k][i] * x[k]).sum();
        x[i] = (x[i] - above) / l[i][i];
    }
}

/// What chi-square with so many degrees of freedom exceeds once in 10,000 times (Wilson and Hilferty 1931).
pub(super) fn chi_square_limit(freedom: usize) -> f64 {
    const Z: f64 = 3.719;
    let n = freedom as f64;
    let a = 2.0 / (9.0 * n);
    n * (1.0 - a + Z * a.sqrt()).powi(3)
}

/// The variance between observations beyond their stated noise: where `chi_square`, which falls with it, meets its
/// expectation `freedom` (Paule and Mandel 1982); 0 when noise explains all. `largest`: where the search ends.
pub(super) fn excess_variance(
    freedom: usize,
    largest: f64,
    chi_square: impl Fn(f64) -> f64,
) -> f64 {
    let expected = freedom as f64;
    if freedom == 0 || chi_square(0.0) <= expected {
        return 0.0;
    }
    let (mut low, mut high) = (0.0, largest);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if chi_square(middle) > expected {
            low = middle;
        } else {
            high = middle;
        }
    }
    high
}

/// Median and robust standard deviation (1.4826 median distances from it) of some values, which it reorders.
pub(super) fn middle_and_spread(values: &mut [f32]) -> (f64, f64) {
    let median = |v: &mut [f32]| {
        let middle = v.len() / 2;
        f64::from(*v.select_nth_unstable_by(middle, f32::total_cmp).1)
    };
    if values.is_empty() {
        return (0.0, 0.0);
    }
    let middle = median(values);
    for value in values.iter_mut() {
        *value = (f64::from(*value) - middle).abs() as f32;
    }
    (middle, 1.4826 * median(values))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_found_with_its_covariance() {
        // y = 3 + 2 x at x = 0, 1, 2 with unit variance: covariance [5/6, -1/2; -1/2, 1/2].
        let mut normal = Normal::new(2);
        for x in [0.0, 1.0, 2.0] {
            normal.add(&[1.0, x], 3.0 + 2.0 * x, 1.0);
        }
        let found = normal.solve().unwrap();
        let expected = [3.0, 2.0, 5.0 / 6.0, -0.5, -0.5, 0.5];
        let values = found.values.iter().chain(found.covariance.iter().flatten());
        for (a, b) in values.zip(expected) {
            assert!((a - b).abs() < 1e-12, "{a} {b}");
        }
        assert!(found.chi_square < 1e-10 && found.freedom == 1);
        let mut flat = Normal::new(2);
        flat.add(&[1.0, 1.0], 1.0, 1.0);
        assert!(flat.solve().is_none());
    }

    #[test]
    fn the_chi_square_limit_is_near_the_quantile() {
        use statrs::distribution::{ChiSquared, ContinuousCDF};
        // The approximation is worst for one degree of freedom: 7 % too large.
        for (freedom, tolerance) in [(1, 0.08), (2, 0.055), (5, 0.03), (30, 0.006)] {
            let law = ChiSquared::new(freedom as f64).unwrap();
            let exact = law.inverse_cdf(1.0 - 1e-4);
            let found = chi_square_limit(freedom);
            assert!(
                (found / exact - 1.0).abs() < tolerance,
                "{freedom}: {found}, exact {exact}"
            );
        }
    }

    #[test]
    fn excess_variance_is_found_where_chi_square_meets_its_expectation() {
        let found = excess_variance(4, 100.0, |v| 36.0 / (1.0 + v));
        assert!((found - 8.0).abs() < 1e-9, "{found}");
        assert!(excess_variance(4, 100.0, |_| 3.0).abs() < 1e-300);
    }
}
