//! Choices of the measurement, and what it says beside the intensities.

use super::Crop;
use super::calibration::{Calibrations, Header, PoseErrors};
use super::checks::CropChecks;
use super::lamp::LampReport;
use super::noise::NoiseReport;
use super::white::WhiteReport;
use crate::session::CameraFacts;
use serde::Serialize;

/// Where the mean is taken.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum CropRule {
    /// Over the projection of the sample square into each view.
    #[default]
    Square,
    /// Over the same box of the image in every view, as classical protocols do (Irawan 2008 chapter 7): foreshortened views then
    /// see more of the sample.
    Rectangle(Crop),
}

/// Choices of the measurement.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasureOptions {
    /// A pixel counts in an exposure only below this fraction of the white level.
    pub usable_fraction: f64,
    /// A channel whose noise is a larger fraction of its mean than this is reported as under-exposed.
    pub underexposed: f64,
    /// A pixel whose dark stands this many standard deviations off is hot and left out.
    pub hot_sigma: f64,
    /// Where the mean is taken.
    pub crop: CropRule,
    /// What is known of the rig beforehand.
    pub calibrations: Calibrations,
    /// How well poses are known; none: as the geometry calibration says.
    pub pose: Option<PoseErrors>,
    /// Convert to the color space of the color calibration; false: the camera's red, green, blue are kept.
    pub color: bool,
}

impl Default for MeasureOptions {
    fn default() -> Self {
        Self {
            usable_fraction: 0.92,
            underexposed: 0.05,
            hot_sigma: 8.0,
            crop: CropRule::Square,
            calibrations: Calibrations::default(),
            pose: None,
            color: false,
        }
    }
}

impl MeasureOptions {
    /// The session's camera with the scale, pointing and lens a calibration found.
    pub fn camera(&self, camera: &CameraFacts) -> CameraFacts {
        let mut camera = camera.clone();
        if let Some(geometry) = self.calibrations.geometry.as_ref().map(|g| &g.value) {
            camera.pixel_mm = geometry.pixel_mm;
            camera.center_px = geometry.center_px;
            camera.lens = geometry.lens;
        }
        camera
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
    /// Left out: converted to the color space of the color calibration, a channel is not positive.
    OutsideColorSpace,
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
    /// Texture seen through the color filters' gaps, and cut by the square's edge.
    pub sampling: f64,
    /// Errors of the response curve (largely common to all configurations).
    pub linearity: f64,
    /// Unequal pixels: errors of the flat field, or what is left of them without one.
    pub flat: f64,
    /// Noise of the white frames.
    pub white: f64,
    /// Uncertainty of the standard's reflectance factor (common to all configurations).
    pub reference: f64,
    /// Noise of the reference frames that follow the lamp (largely common to neighboring configurations), and what is
    /// not known of the lamp in a stretch of work without such frames.
    pub drift: f64,
    /// Pose, pointing, scale and height.
    pub geometry: f64,
    /// Lamp and shutter from frame to frame.
    pub repeatability: f64,
    /// Errors of the color matrix.
    pub color: f64,
}

impl Budget {
    /// The parts by name, in the order of the fields.
    pub fn parts(&self) -> [(&'static str, f64); 12] {
        [
            ("shot", self.shot),
            ("read", self.read),
            ("dark", self.dark),
            ("sampling", self.sampling),
            ("linearity", self.linearity),
            ("flat", self.flat),
            ("white", self.white),
            ("reference", self.reference),
            ("drift", self.drift),
            ("geometry", self.geometry),
            ("repeatability", self.repeatability),
            ("color", self.color),
        ]
    }

    /// The standard error: root of the sum of squares.
    pub fn total(&self) -> f64 {
        let squares = self.parts().into_iter().map(|(_, part)| part * part);
        squares.sum::<f64>().sqrt()
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
    /// Why it came out so, in words; none when it is good.
    pub message: Option<String>,
    /// What else the operator should know: which pixels, and what to do.
    pub notes: Vec<String>,
    /// What a careful eye sees in the crop; none when it was not measured.
    pub checks: Option<CropChecks>,
    /// Pixels of the crop left out of some exposure because they are too bright there: exposure, milliseconds, and how many.
    pub masked: Vec<(f64, usize)>,
    /// The box around the crop: left, top, right, bottom (one past the end), pixels of the visible area.
    pub bounds: [usize; 4],
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
    /// `camera`, or the color space the numbers are in.
    pub rgb: String,
    /// The calibrations that were used.
    pub calibrations: Vec<Header>,
    /// One entry per configuration of the plan, in its order.
    pub configurations: Vec<ConfigurationReport>,
    /// The white frames.
    pub white: WhiteReport,
    /// The noise.
    pub noise: NoiseReport,
    /// The lamp's brightness over the session.
    pub lamp: LampReport,
    /// Relative standard deviation of a frame's brightness beyond the noise of its pixels; none when there were too few
    /// repeats to tell and no calibration says.
    pub between_frames: Option<f64>,
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
