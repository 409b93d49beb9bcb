//! Random electron counts.

use crate::math::Random;

/// A Poisson number, exact for every mean: multiplication of uniforms below 10 (Knuth 1969), transformed rejection with
/// squeeze above (Hormann 1993, PTRS).
pub(super) fn poisson(mean: f64, random: &mut Random) -> f64 {
    if mean < 10.0 {
        let limit = (-mean).exp();
        let mut product = random.uniform_open();
        let mut count = 0.0;
        while product > limit {
            product *= random.uniform_open();
            count += 1.0;
        }
        return count;
    }
    let log_mean = mean.ln();
    let b = 0.931 + 2.53 * mean.sqrt();
    let a = -0.059 + 0.02483 * b;
    let inverse_alpha = 1.1239 + 1.1328 / (b - 3.4);
    let v_r = 0.9277 - 3.6224 / (b - 2.0);
    loop {
        let u = random.uniform() - 0.5;
        let v = random.uniform_open();
        let us = 0.5 - u.abs();
        let k = ((2.0 * a / us + b) * u + mean + 0.43).floor();
        if us >= 0.07 && v <= v_r {
            return k;
        }
        if k < 0.0 || (us < 0.013 && v > us) {
            continue;
        }
        let accept = (v * inverse_alpha / (a / (us * us) + b)).ln();
        if accept <= k * log_mean - mean - libm::lgamma(k + 1.0) {
            return k;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::statistics::sidak_level;
    use crate::rig::virtual_camera::tests::seed;
    use statrs::distribution::{ContinuousCDF, DiscreteCDF, Normal, Poisson};

    /// Chi-square statistic of Poisson draws over cells of about equal probability, as a standard normal number
    /// (Wilson and Hilferty 1931).
    fn poisson_chi_square(mean: f64, drawn_at: f64, n: usize, seed: u64) -> f64 {
        let law = Poisson::new(mean).unwrap();
        let quantile = |p: f64| (0..).find(|&k| law.cdf(k) >= p).unwrap();
        let mut edges: Vec<u64> = (1..20).map(|i| quantile(f64::from(i) / 20.0)).collect();
        edges.dedup();
        let mut counts = vec![0.0; edges.len() + 1];
        let mut random = Random::keyed(&[seed, mean.to_bits()]);
        for _ in 0..n {
            let k = poisson(drawn_at, &mut random) as u64;
            counts[edges.partition_point(|&e| e < k)] += 1.0;
        }
        let mut below = 0.0;
        let mut chi_square = 0.0;
        for (i, count) in counts.iter().enumerate() {
            let cdf = edges.get(i).map_or(1.0, |&e| law.cdf(e));
            let expected = (cdf - below) * n as f64;
            chi_square += (count - expected) * (count - expected) / expected;
            below = cdf;
        }
        let dof = edges.len() as f64;
        let spread = 2.0 / (9.0 * dof);
        ((chi_square / dof).cbrt() - 1.0 + spread) / spread.sqrt()
    }

    #[test]
    fn electrons_follow_poisson_law() {
        // 200,000 draws see a mean that is off by 0.013 standard deviations.
        let (n, seed) = (200_000, seed(20_260_101));
        let means = [0.05, 1.0, 9.9, 10.1, 37.0, 1000.0];
        let level = sidak_level(1e-3, means.len());
        let limit = Normal::standard().inverse_cdf(1.0 - level);
        for mean in means {
            let z = poisson_chi_square(mean, mean, n, seed);
            assert!(z < limit, "mean {mean}: z = {z} (limit {limit}, n = {n})");
        }
        // Negative control: a mean off by 3 % of its standard deviation is caught.
        for mean in [9.9, 37.0, 1000.0] {
            let z = poisson_chi_square(mean, mean + 0.03 * mean.sqrt(), n, seed);
            assert!(z > limit, "mean {mean}: a shifted law passed, z = {z}");
        }
    }
}
