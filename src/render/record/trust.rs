//! How far a recording may be believed away from its parameters.

/// The least [`ConfigurationTrust::ratio`] to believe: what was measured above and below it is in
/// `docs/render.md`, "Recorded paths".
pub const TRUST_THRESHOLD: f64 = 0.5;

/// How many paths a configuration's estimate really comes from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConfigurationTrust {
    /// The configuration's id.
    pub config: u32,
    /// Effective number of paths, `(sum x)^2 / sum x^2` over what each path contributes, channels together (Kish 1965).
    pub effective: f64,
    /// The largest path's share of the mean.
    pub largest_share: f64,
    /// `exp(-D)`, with `D` the divergence (Kullback and Leibler 1951) of the paths' shares in the mean from their shares at
    /// the parameters of the recording: 1 there, and roughly the part of the recorded paths that still counts, as
    /// importance sampling needs `exp(D)` times as many (Chatterjee and Diaconis 2018). 0 where nothing was seen.
    pub ratio: f64,
}

/// Sums over paths of what they contribute, channels together.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Shares {
    sum: f64,
    square: f64,
    largest: f64,
    /// Sum of the same at the parameters of the recording.
    before: f64,
    /// `sum x ln(x / before)`.
    divergence: f64,
}

impl Shares {
    /// A path contributes `x`, and contributed `before`.
    pub(super) fn push(&mut self, x: f32, before: f32) {
        // Below the least normal number a contribution counts as that number: only its logarithm is used.
        let log = (x.max(f32::MIN_POSITIVE) / before.max(f32::MIN_POSITIVE)).ln();
        let x = f64::from(x);
        self.sum += x;
        self.square += x * x;
        self.largest = self.largest.max(x);
        self.before += f64::from(before);
        self.divergence += x * f64::from(log);
    }

    pub(super) fn merge(mut self, other: &Self) -> Self {
        self.sum += other.sum;
        self.square += other.square;
        self.largest = self.largest.max(other.largest);
        self.before += other.before;
        self.divergence += other.divergence;
        self
    }

    pub(super) fn trust(&self, config: u32) -> ConfigurationTrust {
        let seen = self.sum > 0.0 && self.before > 0.0;
        let divergence = self.divergence / self.sum - (self.sum / self.before).ln();
        let of = |x: f64| if seen { x } else { 0.0 };
        ConfigurationTrust {
            config,
            effective: of(self.sum * self.sum / self.square),
            largest_share: if seen { self.largest / self.sum } else { 1.0 },
            // Rounding may make the divergence of equal shares negative.
            ratio: of((-divergence).exp().min(1.0)),
        }
    }
}

/// How far estimates from a recording may be believed.
#[derive(Debug, Clone, PartialEq)]
pub struct Trust {
    /// One per configuration.
    pub configurations: Vec<ConfigurationTrust>,
}

impl Trust {
    /// The least ratio of all configurations.
    pub fn least_ratio(&self) -> f64 {
        let ratios = self.configurations.iter().map(|c| c.ratio);
        ratios.fold(f64::INFINITY, f64::min)
    }

    /// Are all configurations' ratios at least `threshold` (see [`TRUST_THRESHOLD`])?
    pub fn holds(&self, threshold: f64) -> bool {
        self.least_ratio() >= threshold
    }

    /// Per configuration the one of two recordings that is trusted less.
    pub(super) fn lesser(self, other: Self) -> Self {
        let pairs = self.configurations.into_iter().zip(other.configurations);
        let lesser = |(a, b): (ConfigurationTrust, ConfigurationTrust)| {
            if b.ratio < a.ratio { b } else { a }
        };
        Self {
            configurations: pairs.map(lesser).collect(),
        }
    }
}
