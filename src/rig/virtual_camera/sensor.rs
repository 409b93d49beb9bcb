//! The numbers of a sensor and the optics in front of it.

use super::optics::Optics;
use super::pixels::PixelFaults;
use crate::base::{Error, Result};
use crate::session::{BitDepth, CameraFacts, CfaPattern, Layout};

/// A sensor and the optics in front of it.
#[derive(Debug, Clone, PartialEq)]
pub struct SensorModel {
    /// Camera model as the frames state it, ASCII.
    pub name: String,
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Millimeters per pixel on a plane through the sample center, perpendicular to the view.
    pub pixel_mm: f64,
    /// Image point of the sample center, pixels (integer = pixel corner).
    pub center_px: [f64; 2],
    /// Which channels the pixels have. Mosaics are written as DNG, the others as TIFF of 16 bits.
    pub layout: Layout,
    /// Sample size of DNG files.
    pub bits: BitDepth,
    /// Black level of each place of the layout, raw values.
    pub black: [f64; 4],
    /// Largest raw value.
    pub white: u16,
    /// Raw values per (normalized radiance x millisecond) at the image center, r, g, b.
    pub responsivity: [f64; 3],
    /// Electrons per raw value.
    pub gain: f64,
    /// Read noise, raw values (one standard deviation).
    pub read_noise: f64,
    /// Dark current, raw values per millisecond.
    pub dark_current: f64,
    /// Loss of light at the image corner, `V = 1 - vignetting (r / r_corner)^2` about the image center.
    pub vignetting: f64,
    /// What else the optics do.
    pub optics: Optics,
    /// How the pixels depart from linear and equal.
    pub faults: PixelFaults,
    /// Relative standard deviation of the true exposure time from shot to shot.
    pub shutter_jitter: f64,
    /// Relative standard deviation of the lamp's brightness from shot to shot.
    pub flicker: f64,
    /// Each pixel averages at least `subsamples x subsamples` points of the picture,
    pub subsamples: usize,
    /// and so many that they lie no farther apart than this on the sample, millimeters.
    pub spacing_mm: f64,
}

impl Default for SensorModel {
    /// A 12-bit camera that sees a 1 cm square 140 pixels wide; 0.4 (raw value)^2 of shot noise per raw value, as
    /// measured on a 10-bit consumer camera (0.1) and scaled by 4. Without faults.
    fn default() -> Self {
        Self {
            name: "virtual camera".to_owned(),
            width: 240,
            height: 180,
            pixel_mm: 1.0 / 14.0,
            center_px: [120.0, 90.0],
            layout: Layout::Bayer(CfaPattern::Rggb),
            bits: BitDepth::Twelve,
            black: [128.0, 127.5, 128.25, 128.0],
            white: 4095,
            responsivity: [42.0, 60.0, 48.0],
            gain: 2.5,
            read_noise: 2.0,
            dark_current: 0.004,
            vignetting: 0.04,
            optics: Optics::default(),
            faults: PixelFaults::default(),
            shutter_jitter: 0.0,
            flicker: 0.0,
            subsamples: 3,
            spacing_mm: f64::INFINITY,
        }
    }
}

impl SensorModel {
    /// What a session's manifest must say about this camera.
    pub fn facts(&self) -> CameraFacts {
        CameraFacts {
            name: format!("goniofit {}", self.name),
            width: self.width,
            height: self.height,
            pixel_mm: self.pixel_mm,
            center_px: self.center_px,
            lens: self.optics.lens,
        }
    }

    /// Values in a frame.
    pub(super) fn values(&self) -> usize {
        self.width * self.height * self.layout.values_per_pixel()
    }

    pub(super) fn check(&self) -> Result<()> {
        let bad = |what: &str| Err(Error::new(format!("sensor model: {what}")));
        if !(1..=20000).contains(&self.width) || !(1..=20000).contains(&self.height) {
            return bad("width and height must be 1 to 20000 pixels");
        }
        let positive = |x: f64| x > 0.0 && x.is_finite();
        if !positive(self.pixel_mm) || !positive(self.gain) {
            return bad("pixel_mm and gain must be positive");
        }
        if !self.responsivity.iter().all(|&r| positive(r)) {
            return bad("responsivity must be positive");
        }
        let not_negative = |x: f64| (0.0..1e9).contains(&x);
        if !not_negative(self.read_noise) || !not_negative(self.dark_current) {
            return bad("read_noise and dark_current must not be negative");
        }
        if !(0.0..1.0).contains(&self.vignetting) {
            return bad("vignetting must lie in 0..1");
        }
        let unsteady = [self.shutter_jitter, self.flicker];
        if !unsteady.iter().all(|x| (0.0..0.2).contains(x)) {
            return bad("shutter_jitter and flicker must lie in 0..0.2");
        }
        let apart = self.spacing_mm > 0.0;
        if !(1..=32).contains(&self.subsamples) || !apart {
            return bad("subsamples must be 1 to 32, and spacing_mm positive");
        }
        let largest = match self.layout {
            Layout::Bayer(_) => self.bits.largest(),
            Layout::Mono | Layout::Rgb => u16::MAX,
        };
        let below = |b: &f64| (0.0..f64::from(self.white)).contains(b);
        if self.white > largest || !self.black.iter().all(below) {
            return bad("black must lie below white, and white within the sample size");
        }
        self.optics.check()?;
        self.faults.check(self.dark_current)
    }
}
