//! A scattering function sampled from a mixture with a wider one (Hesterberg 1995), so that its paths can be used again at
//! parameters with wider lobes.

use super::{CHANNELS, Evaluation, Passage, Sampled, Scattering};
use crate::math::Random;
use glam::DVec3;

/// Values of `at`; directions drawn from `wide` with probability `share`, else from `at`. The density is the mixture's, so
/// estimates are unbiased for any `wide`, and no weight exceeds `1 / (1 - share)` times that of `at` alone.
pub struct Defensive<'a> {
    /// What is evaluated.
    pub at: &'a dyn Scattering,
    /// What is drawn from now and then.
    pub wide: &'a dyn Scattering,
    /// How often, in [0, 1).
    pub share: f64,
}

impl Defensive<'_> {
    fn mixed(&self, at: f64, wide: f64) -> f64 {
        (1.0 - self.share) * at + self.share * wide
    }
}

impl Scattering for Defensive<'_> {
    fn evaluate(&self, wi: DVec3, wo: DVec3, h: f64) -> Evaluation {
        let at = self.at.evaluate(wi, wo, h);
        let wide = self.wide.value(wi, wo, h).1;
        Evaluation {
            pdf: self.mixed(at.pdf, wide),
            ..at
        }
    }

    fn value(&self, wi: DVec3, wo: DVec3, h: f64) -> ([f64; CHANNELS], f64) {
        let (value, pdf) = self.at.value(wi, wo, h);
        (value, self.mixed(pdf, self.wide.value(wi, wo, h).1))
    }

    fn sample(&self, wo: DVec3, h: f64, random: &mut Random) -> Option<Sampled> {
        let from_wide = random.uniform() < self.share;
        let drawn = if from_wide { self.wide } else { self.at }.sample(wo, h, random)?;
        let evaluation = self.evaluate(drawn.wi, wo, h);
        let factor = drawn.wi.y.hypot(drawn.wi.z) / evaluation.pdf;
        Some(Sampled {
            wi: drawn.wi,
            weight: evaluation.value.map(|s| s * factor),
            evaluation,
        })
    }

    fn passage(&self) -> Passage {
        self.at.passage()
    }
}
