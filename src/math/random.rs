//! Keyed random streams: no random number without a key, so every result is a function of its seed alone.

use rand_core::{Rng, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;

/// A xoshiro256++ stream selected by a key.
///
/// Streams with different keys are independent for all statistical purposes; the same key always gives the same
/// numbers, on any number of threads.
#[derive(Debug, Clone)]
pub struct Random {
    generator: Xoshiro256PlusPlus,
}

impl Random {
    /// The stream named by `key`: first the user's seed, then what the stream is for (stage, configuration, batch).
    pub fn keyed(key: &[u64]) -> Self {
        let hash = key
            .iter()
            .fold(0x9e37_79b9_7f4a_7c15, |state, &word| mix(state ^ mix(word)));
        Self {
            generator: Xoshiro256PlusPlus::seed_from_u64(hash),
        }
    }

    /// A uniform number in [0, 1), 53 bits.
    pub fn uniform(&mut self) -> f64 {
        (self.generator.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// A uniform number in (0, 1): safe for logarithms and quantile functions.
    pub fn uniform_open(&mut self) -> f64 {
        ((self.generator.next_u64() >> 12) as f64 + 0.5) * (1.0 / (1u64 << 52) as f64)
    }

    /// 64 random bits.
    pub fn bits(&mut self) -> u64 {
        self.generator.next_u64()
    }

    /// A standard normal number (Box and Muller; the second number of the pair is dropped).
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * self.uniform_open().ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// The finalizer of splitmix64 after one step of its counter.
fn mix(word: u64) -> u64 {
    let mut z = word.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_key_selects_the_stream() {
        let draw = |key: &[u64]| Random::keyed(key).bits();
        assert_eq!(draw(&[1, 2]), draw(&[1, 2]));
        assert_ne!(draw(&[1, 2]), draw(&[2, 1]));
        assert_ne!(draw(&[1]), draw(&[1, 0]));
    }

    #[test]
    fn normals_have_zero_mean_and_unit_variance() {
        let mut random = Random::keyed(&[7]);
        let n = 200_000;
        let (mut sum, mut square) = (0.0, 0.0);
        for _ in 0..n {
            let x = random.normal();
            sum += x;
            square += x * x;
        }
        let (mean, variance) = (sum / n as f64, square / n as f64);
        // 4.5 standard errors: sees a shift of 0.010 and a variance off by 1.4 %.
        assert!(mean.abs() < 4.5 / (n as f64).sqrt(), "{mean}");
        assert!(
            (variance - 1.0).abs() < 4.5 * (2.0 / n as f64).sqrt(),
            "{variance}"
        );
    }
}
