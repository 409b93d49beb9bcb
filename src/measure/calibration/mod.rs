//! What is known of a rig's camera, lens, lamp and white standard beforehand: dated files, each value with its uncertainty.
//!
//! `goniofit calibrate` makes them from recorded sessions; [`Calibrations::read`] finds the newest of each kind in a folder
//! such as `calibration/RIG`. A file is JSON; the flat field's map lies beside it as OpenEXR.

mod files;
mod flat;

pub use files::{Calibrations, Dated, Header, Kind, Source, Value};

use crate::session::Lens;
use serde::{Deserialize, Serialize};

/// What pixels read without light, by exposure time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DarkCurrent {
    /// Mean raw value at zero exposure, by place of the layout.
    pub bias: [f64; 4],
    /// Its standard error.
    pub bias_se: [f64; 4],
    /// Mean dark current by place, raw values per millisecond.
    pub per_ms: [f64; 4],
    /// Its standard error.
    pub per_ms_se: [f64; 4],
    /// Covariance of the errors of `bias` and `per_ms`, by place, squared raw values per millisecond.
    #[serde(default)]
    pub bias_per_ms_covariance: [f64; 4],
    /// Standard deviation of one raw value at zero exposure: read noise and rounding.
    pub read_noise: f64,
    /// Its standard error.
    pub read_noise_se: f64,
    /// Standard deviation over the pixels that are not hot of their dark current, raw values per millisecond.
    pub per_ms_scatter: f64,
    /// Pixels to leave out everywhere.
    pub hot: Vec<HotPixel>,
    /// The exposures it was made from.
    pub exposures: Vec<DarkExposure>,
}

impl DarkCurrent {
    /// Variance of one raw value without light at an exposure time, milliseconds: on straight lines between the exposures it
    /// was made from, and as at the nearest one beyond them.
    pub fn variance_at(&self, exposure_ms: f64) -> f64 {
        let after = self
            .exposures
            .iter()
            .position(|e| e.exposure_ms >= exposure_ms);
        let square = |i: usize| self.exposures[i].sigma.powi(2);
        match after {
            _ if self.exposures.is_empty() => self.read_noise.powi(2),
            None => square(self.exposures.len() - 1),
            Some(0) => square(0),
            Some(i) => {
                let [low, high] = [&self.exposures[i - 1], &self.exposures[i]];
                let along = (exposure_ms - low.exposure_ms) / (high.exposure_ms - low.exposure_ms);
                square(i - 1) + along * (square(i) - square(i - 1))
            }
        }
    }
}

/// A pixel whose dark current stands out.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HotPixel {
    /// Column of the visible area.
    pub x: usize,
    /// Row.
    pub y: usize,
    /// Its dark current, raw values per millisecond.
    pub per_ms: f64,
}

/// The darks of one exposure time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DarkExposure {
    /// Exposure time, milliseconds.
    pub exposure_ms: f64,
    /// Frames.
    pub frames: usize,
    /// Mean raw value by place.
    pub mean: [f64; 4],
    /// Standard deviation of one raw value.
    pub sigma: f64,
}

/// How raw values grow with light, and how they scatter:
/// `linear = s (1 + sum_k coefficients[k] (s / full_scale)^(k + 1))` with `s` the raw value less `bias`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Linearity {
    /// Coefficients of the powers 1, 2, ... of `s / full_scale`; none: linear.
    pub coefficients: Vec<f64>,
    /// Their covariance, row by row.
    pub covariance: Vec<Vec<f64>>,
    /// White level less mean bias, raw values.
    pub full_scale: f64,
    /// Raw value at zero light and zero exposure, by place of the layout.
    pub bias: [f64; 4],
    /// The range of `s / full_scale` in which the curve was checked; brighter values are not used.
    pub usable: [f64; 2],
    /// The measured curve.
    pub points: Vec<LinearityPoint>,
    /// How raw values scatter.
    pub transfer: PhotonTransfer,
}

/// One exposure of the linearity series in one channel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LinearityPoint {
    /// Exposure time, milliseconds.
    pub exposure_ms: f64,
    /// 0 red, 1 green, 2 blue.
    pub channel: usize,
    /// Mean raw value less dark.
    pub signal: f64,
    /// Its standard error.
    pub signal_se: f64,
    /// Relative deviation of the corrected signal from proportionality to the exposure.
    pub residual: f64,
}

/// Photon transfer: `variance = variance_per_signal * signal + read_noise^2`, raw values, signal linear.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PhotonTransfer {
    /// Slope by channel, raw values (one over the gain in electrons per raw value).
    pub variance_per_signal: [f64; 3],
    /// Its standard error.
    pub variance_per_signal_se: [f64; 3],
    /// Standard deviation of one raw value without light.
    pub read_noise: f64,
    /// Its standard error.
    pub read_noise_se: f64,
    /// The measured curve.
    pub points: Vec<TransferPoint>,
}

/// One pair of frames of one thing, in one channel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TransferPoint {
    /// 0 red, 1 green, 2 blue.
    pub channel: usize,
    /// Mean linear signal, raw values.
    pub signal: f64,
    /// Variance of one raw value, in the linear scale.
    pub variance: f64,
    /// Its standard error.
    pub variance_se: f64,
}

/// Relative response of every value of a frame to the same light: vignetting, unequal pixels, dust on the sensor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlatField {
    /// The map's file, beside this one: OpenEXR with channels `response` and `response_se`.
    pub file: String,
    /// Its SHA-256, hexadecimal.
    pub sha256: String,
    /// Relative standard uncertainty of the source's evenness over the sample square, common to all pixels.
    pub uniformity_se: f64,
    /// Standard deviation over pixels of the response about its smooth part, by channel (pixel response
    /// non-uniformity).
    pub scatter: [f64; 3],
    /// Light lost at the image corners relative to the middle, by channel.
    pub falloff: [f64; 3],
    /// By index in a frame's data: response over the channel's mean response in the middle of the image. Read from
    /// `file`.
    #[serde(skip)]
    pub response: Vec<f32>,
    /// Its standard error, by index.
    #[serde(skip)]
    pub response_se: Vec<f32>,
}

/// A white standard, read at one geometry.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WhiteStandard {
    /// Which panel: maker, serial number.
    pub panel: String,
    /// Polar angle of the light, degrees.
    pub light_theta_deg: f64,
    /// Azimuth of the light, degrees.
    pub light_phi_deg: f64,
    /// Polar angle of the camera, degrees.
    pub camera_theta_deg: f64,
    /// Azimuth of the camera, degrees.
    pub camera_phi_deg: f64,
    /// Reflectance factor there, by channel (1: perfect diffuser).
    pub reflectance_factor: [f64; 3],
    /// Its standard uncertainty.
    pub reflectance_factor_se: [f64; 3],
    /// Raw values per (normalized radiance x millisecond) at the sample center, linear, by channel, for the lamp as it was.
    pub responsivity: [f64; 3],
    /// Its standard error, the reflectance factor's included.
    pub responsivity_se: [f64; 3],
}

/// From the camera's red, green, blue to a stated color space: `out = matrix * camera`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ColorMatrix {
    /// Name of the space, linear: e.g. `srgb` (Rec. 709 primaries, D65 white).
    pub space: String,
    /// Rows: red, green, blue of the space.
    pub matrix: [[f64; 3]; 3],
    /// For each row, the covariance of its three entries.
    pub covariance: [[[f64; 3]; 3]; 3],
    /// Root mean square residual over the patches, relative to the brightest patch, by channel of the space.
    pub residual: [f64; 3],
    /// Patches used.
    pub patches: usize,
}

/// Scale, pointing and lens of the camera, and how well poses are known.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Geometry {
    /// Millimeters per pixel, as in the session's manifest.
    pub pixel_mm: f64,
    /// Its standard error.
    pub pixel_mm_se: f64,
    /// Image point of the sample center at camera polar angle 0, pixels.
    pub center_px: [f64; 2],
    /// Its standard error.
    pub center_px_se: [f64; 2],
    /// The lens.
    pub lens: Lens,
    /// Standard deviation of the image's place from pose to pose that the lens does not explain, pixels.
    pub pointing_sd_px: [f64; 2],
    /// How well poses are known, as stated by the operator.
    #[serde(default)]
    pub pose: PoseErrors,
    /// Root mean square distance of the found corners from the fitted ones, pixels.
    pub residual_px: f64,
    /// Corners used.
    pub corners: usize,
}

/// Standard uncertainties of where things stand.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PoseErrors {
    /// Of the camera's polar angle in one pose, degrees.
    pub camera_theta_deg: f64,
    /// Of the light's polar angle in one pose, degrees.
    pub light_theta_deg: f64,
    /// Of the turntable's angle in one pose, degrees.
    pub rotation_deg: f64,
    /// Of the sample surface's height over the center of rotation, millimeters.
    pub height_mm: f64,
}

/// How the lamp behaves, from reference frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LampDrift {
    /// Mean relative change per hour, by channel.
    pub per_hour: [f64; 3],
    /// Its standard error.
    pub per_hour_se: [f64; 3],
    /// Relative standard deviation of one frame's brightness about the slow course, noise of the pixels taken off.
    pub flicker: f64,
    /// Its standard error.
    pub flicker_se: f64,
    /// Seconds after the first frame until the level stays within 0.5 % of its last value; 0 when it always does.
    pub settled_after_s: f64,
    /// Visits used.
    pub visits: usize,
}
