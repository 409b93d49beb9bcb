//! A scattering function sampled from a mixture with a wider one (Hesterberg 1995), so that its paths can be used again at
//! parameters with wider lobes.

use super::{BatchEvaluate, CHANNELS, Evaluation, Outgoing, Passage, Sampled, Scattering};
use crate::math::Random;
use glam::DVec3;

/// Values of `at`; directions drawn from `wide` with probability `share`, else from `at`. The density is the mixture's, so
/// estimates are unbiased for any `wide`, and `S cos(theta_i) / pdf` never exceeds `1 / (1 - share)` times that of `at` alone.
/// The importance is mixed too: else roulette would take away again what `wide` found.
pub struct Defensive<'a> {
    /// What is evaluated.
    pub at: &'a dyn Scattering,
    /// What is drawn from now and then.
    pub wide: &'a dyn Scattering,
    /// How often, in [0, 1).
    pub share: f64,
}

impl Scattering for Defensive<'_> {
    fn evaluate(&self, wi: DVec3, wo: DVec3, h: f64) -> Evaluation {
        self.at.evaluate(wi, wo, h)
    }

    fn importance(&self, wi: DVec3, o: &Outgoing) -> ([f64; CHANNELS], f64) {
        let (at, at_pdf) = self.at.importance(wi, o);
        let (wide, wide_pdf) = self.wide.importance(wi, o);
        let mixed = |at: f64, wide: f64| (1.0 - self.share) * at + self.share * wide;
        let value = std::array::from_fn(|c| mixed(at[c], wide[c]));
        (value, mixed(at_pdf, wide_pdf))
    }

    fn sample(&self, o: &Outgoing, random: &mut Random) -> Option<Sampled> {
        let from_wide = random.uniform() < self.share;
        let drawn = if from_wide { self.wide } else { self.at };
        let wi = drawn.sample(o, random)?.wi;
        let (value, pdf) = self.importance(wi, o);
        let factor = wi.y.hypot(wi.z) / pdf;
        Some(Sampled {
            wi,
            weight: value.map(|s| s * factor),
            pdf,
        })
    }

    fn light_points(&self, wi: DVec3, o: &Outgoing, half_angle: f64) -> usize {
        self.at.light_points(wi, o, half_angle)
    }

    fn passage(&self) -> Passage {
        self.at.passage()
    }

    fn batch(&self) -> Option<Box<dyn BatchEvaluate>> {
        self.at.batch()
    }
}
