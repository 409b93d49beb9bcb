//! Choices of the measurement, and what it says beside the intensities.

use super::lamp::LampReport;
use super::noise::NoiseReport;
use super::white::WhiteReport;
use serde::Serialize;

/// Choices of the measurement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasureOptions {
    /// An exposure counts only where no pixel of the crop reaches this fraction of the white level.
    pub usable_fraction: f64,
    /// A channel whose noise is a larger fraction of its mean than this is reported as under-exposed.
    pub underexposed: f64,
    /// A pixel whose dark stands this many standard deviations off is hot and left out.
    pub hot_sigma: f64,
}

impl Default for MeasureOptions {
    fn default() -> Self {
        Self {
            usable_fraction: 0.92,
            underexposed: 0.05,
            hot_sigma: 8.0,
        }
    }
}

/// How a configuration came out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Condition {
    /// Measured.
    Good,
    /// Measured, but noise is a large part of it; left out when a mean is not positive.
    UnderExposed,
    /// Left out: every exposure has saturated pixels in the crop.
    Saturated,
    /// Left out: the journal has no frame of it.
    NotCaptured,
}

/// Where one channel's standard error comes from: one standard deviation each, normalized radiance.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Budget {
    /// Photon shot noise of the sample frames.
    pub shot: f64,
    /// Read noise (with dark current and quantization) of the sample frames.
    pub read: f64,
    /// Noise of the dark frames subtracted.
    pub dark: f64,
    /// Texture seen through the color filters' gaps.
    pub sampling: f64,
    /// Noise of the white frames.
    pub white: f64,
    /// Uncertainty of the standard's reflectance factor (common to all configurations).
    pub reference: f64,
    /// Noise of the reference frames that follow the lamp (largely common to neighboring configurations), and what is
    /// not known of the lamp in a stretch of work without such frames.
    pub drift: f64,
}

impl Budget {
    /// The standard error: root of the sum of squares.
    pub fn total(&self) -> f64 {
        let other = self.sampling.powi(2) + self.white.powi(2) + self.reference.powi(2);
        (self.noise().powi(2) + other + self.drift.powi(2)).sqrt()
    }

    /// The part that more light or more frames would reduce.
    pub(super) fn noise(&self) -> f64 {
        (self.shot.powi(2) + self.read.powi(2) + self.dark.powi(2)).sqrt()
    }
}

/// How one configuration was measured.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ConfigurationReport {
    /// The plan's number.
    pub config: u32,
    /// How it came out.
    pub condition: Condition,
    /// True when it is in the measurements.
    pub measured: bool,
    /// What the operator should know, in words.
    pub message: Option<String>,
    /// Exposures used, milliseconds.
    pub exposures_ms: Vec<f64>,
    /// Pixels the sample square covers.
    pub area_px: f64,
    /// Error budget, r, g, b.
    pub budget: [Budget; 3],
}

/// What was found out beside the intensities.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MeasureReport {
    /// True when no camera saw any cloth.
    pub synthetic: bool,
    /// One entry per configuration of the plan, in its order.
    pub configurations: Vec<ConfigurationReport>,
    /// The white frames.
    pub white: WhiteReport,
    /// The noise.
    pub noise: NoiseReport,
    /// The lamp's brightness over the session.
    pub lamp: LampReport,
    /// Pixels left out because their dark stands out.
    pub hot_pixels: usize,
    /// Frames read.
    pub frames: usize,
    /// What the operator should know beside the configurations' messages.
    pub warnings: Vec<String>,
}

impl MeasureReport {
    /// True when some configuration is missing or noisier than asked for.
    pub fn outside_tolerance(&self) -> bool {
        let good = |c: &ConfigurationReport| c.condition == Condition::Good;
        !self.configurations.iter().all(good)
    }
}
