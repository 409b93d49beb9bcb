//! Means with standard errors.

/// Count, mean and variance of a stream of numbers (Welford 1962); mergeable.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Running {
    count: u64,
    mean: f64,
    sum_square: f64,
}

impl Running {
    /// Adds one number.
    pub fn push(&mut self, x: f64) {
        self.count += 1;
        let delta = x - self.mean;
        self.mean += delta / self.count as f64;
        self.sum_square += delta * (x - self.mean);
    }

    /// Adds all numbers another accumulator has seen (Chan et al. 1979).
    pub fn merge(&mut self, other: &Self) {
        if other.count == 0 {
            return;
        }
        let n = (self.count + other.count) as f64;
        let delta = other.mean - self.mean;
        self.sum_square +=
            other.sum_square + delta * delta * self.count as f64 * other.count as f64 / n;
        self.mean += delta * other.count as f64 / n;
        self.count += other.count;
    }

    /// How many numbers were added.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Their mean; NaN when there are none.
    pub fn mean(&self) -> f64 {
        if self.count == 0 { f64::NAN } else { self.mean }
    }

    /// Their unbiased variance; NaN below two numbers.
    pub fn variance(&self) -> f64 {
        if self.count < 2 {
            f64::NAN
        } else {
            self.sum_square / (self.count - 1) as f64
        }
    }

    /// Standard error of the mean; NaN below two numbers.
    pub fn standard_error(&self) -> f64 {
        (self.variance() / self.count as f64).sqrt()
    }
}

/// The per-test level when `n_tests` independent tests shall together have level `family_level` (Sidak 1967).
pub fn sidak_level(family_level: f64, n_tests: usize) -> f64 {
    -((-family_level).ln_1p() / n_tests as f64).exp_m1()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn running_moments_match_the_definitions_and_merge() {
        let xs = [1e9 + 4.0, 1e9 + 7.0, 1e9 + 13.0, 1e9 + 16.0];
        let mut all = Running::default();
        let (mut left, mut right) = (Running::default(), Running::default());
        for (i, &x) in xs.iter().enumerate() {
            all.push(x);
            if i < 1 { left.push(x) } else { right.push(x) }
        }
        left.merge(&right);
        for r in [all, left] {
            assert_eq!(r.count(), 4);
            assert!(
                (r.mean() - 1e9 - 10.0).abs() < 1e-6 && (r.variance() - 30.0).abs() < 1e-5,
                "{r:?}"
            );
        }
        assert!(Running::default().mean().is_nan());
    }

    #[test]
    fn sidak_composes_to_the_family_level() {
        let level = sidak_level(1e-3, 48);
        assert!((1.0 - (1.0 - level).powi(48) - 1e-3).abs() < 1e-13);
    }
}
