//! How far a recording may be believed away from its parameters.

use super::replay::LampSums;
use crate::scatter::CHANNELS;

/// The least [`ConfigurationTrust::ratio`] at which estimates have been found right within their standard errors.
pub const TRUST_THRESHOLD: f64 = 0.5;

/// How many paths a configuration's estimate really comes from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConfigurationTrust {
    /// The configuration's id.
    pub config: u32,
    /// Effective number of paths per channel, `(sum x)^2 / sum x^2` over what each path contributes (Kish 1965).
    pub effective: [f64; CHANNELS],
    /// That relative to the same number at the parameters of the recording; of the channels the least. Above 1 where
    /// contributions have become more equal; 0 where nothing was seen.
    pub ratio: f64,
    /// The largest path's share of the mean; of the channels the most.
    pub largest_share: f64,
}

impl ConfigurationTrust {
    /// From the sums of a configuration's batches, with ratio 1.
    pub(super) fn new<'a>(config: u32, batches: impl Iterator<Item = &'a LampSums>) -> Self {
        let (mut sum, mut square) = ([0.0; CHANNELS], [0.0; CHANNELS]);
        let mut largest = [0.0_f64; CHANNELS];
        for batch in batches {
            for c in 0..CHANNELS {
                sum[c] += batch.sums.value[c];
                square[c] += batch.square[c];
                largest[c] = largest[c].max(batch.largest[c]);
            }
        }
        let seen = |c: usize| square[c] > 0.0;
        let share = |c: usize| if seen(c) { largest[c] / sum[c] } else { 1.0 };
        Self {
            config,
            effective: std::array::from_fn(|c| {
                if seen(c) {
                    sum[c] * sum[c] / square[c]
                } else {
                    0.0
                }
            }),
            ratio: 1.0,
            largest_share: (0..CHANNELS).map(share).fold(0.0, f64::max),
        }
    }

    fn relative_to(self, reference: &Self) -> Self {
        let ratio = |c: usize| match reference.effective[c] {
            0.0 => 0.0,
            before => self.effective[c] / before,
        };
        Self {
            ratio: (0..CHANNELS).map(ratio).fold(f64::INFINITY, f64::min),
            ..self
        }
    }
}

/// How far estimates from a recording may be believed.
#[derive(Debug, Clone, PartialEq)]
pub struct Trust {
    /// One per configuration.
    pub configurations: Vec<ConfigurationTrust>,
    /// Events at which `S` was zero in all channels when they were recorded: what they would carry at other parameters
    /// is not known. Zero for models that scatter something everywhere.
    pub lost: u64,
}

impl Trust {
    pub(super) fn new(
        now: Vec<ConfigurationTrust>,
        reference: &[ConfigurationTrust],
        lost: u64,
    ) -> Self {
        let pairs = now.into_iter().zip(reference);
        Self {
            configurations: pairs.map(|(now, before)| now.relative_to(before)).collect(),
            lost,
        }
    }

    /// The least ratio of all configurations.
    pub fn least_ratio(&self) -> f64 {
        let ratios = self.configurations.iter().map(|c| c.ratio);
        ratios.fold(f64::INFINITY, f64::min)
    }

    /// Are all configurations' ratios at least `threshold` (see [`TRUST_THRESHOLD`]), and is nothing lost?
    pub fn holds(&self, threshold: f64) -> bool {
        self.lost == 0 && self.least_ratio() >= threshold
    }

    /// Per configuration the one of two recordings that is trusted less.
    pub(super) fn lesser(self, other: Self) -> Self {
        let pairs = self.configurations.into_iter().zip(other.configurations);
        Self {
            configurations: pairs
                .map(|(a, b)| if b.ratio < a.ratio { b } else { a })
                .collect(),
            lost: self.lost + other.lost,
        }
    }
}
