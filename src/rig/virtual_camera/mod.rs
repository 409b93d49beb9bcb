//! A camera that is a program: photographs a picture given from outside, through a model of optics and sensor with the
//! faults of real ones, into real files. What is true is known exactly.
//!
//! ```text
//! light     = responsivity_c M V(x, y) P_i                    raw values per millisecond
//! electrons = Poisson(gain_c (light + dark_current_i) exposure)
//! charge    = electrons / gain_c, what exceeds the full well spilled along the column
//! raw       = clip(round(black + curve(charge) + read_noise normal), 0, white)
//! ```
//!
//! with `M` the normalized radiance averaged over the pixel's area (times the lamp's brightness, when it drifts or flickers),
//! blurred by the lens; `V` vignetting, gradient and dust; `P_i` the pixel's response; `gain_c` in electrons per raw value;
//! `exposure` with the shutter's jitter. The camera photographs where things stand in truth ([`Stand`]), which may differ from the pose it is asked
//! for. Not modeled: stray light, color fringes, lag, a dark current that changes with temperature.
//!
//! | file | what is in it |
//! |---|---|
//! | `appearance.rs` | what is photographed, the lamp, where things stand |
//! | `picture.rs` | the picture without noise, its true mean |
//! | `optics.rs` | falloff, dust, blur |
//! | `sensor.rs`, `pixels.rs` | the sensor's numbers; charge to raw values, unequal pixels, blooming |

mod appearance;
#[cfg(test)]
mod fault_tests;
mod optics;
mod picture;
mod pixels;
mod poisson;
mod sensor;
#[cfg(test)]
mod tests;

pub use appearance::{Appearance, LampLaw, Misalignment, Stand, white_radiance};
pub use optics::{Dust, Optics};
pub use pixels::PixelFaults;
pub use sensor::SensorModel;

use super::{Camera, CapturedFrame, Shot};
use crate::base::{Error, Result};
use crate::math::Random;
use crate::session::{
    CameraFacts, CfaPattern, DngImage, Filter, FrameKind, Layout, TiffImage, write_dng, write_tiff,
};
use pixels::{Charges, FixedPattern};
use poisson::poisson;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// A picture without noise: normalized radiance per pixel.
#[derive(Debug, Clone, PartialEq)]
pub struct NoiseFreeImage {
    /// Pixels per row.
    pub width: usize,
    /// Row by row.
    pub pixels: Vec<[f64; 3]>,
}

/// A [`Camera`] whose frames show an [`Appearance`].
///
/// Frames are a function of sensor, appearance, seed, shot, misalignment and the lamp's brightness alone, on any number of
/// threads: the order of shots does not matter, and a shot asked for again after an interruption gives the same frame.
pub struct VirtualCamera {
    sensor: SensorModel,
    pattern: FixedPattern,
    appearance: Box<dyn Appearance>,
    seed: u64,
    /// Factors on the radiance by configuration id.
    factors: BTreeMap<u32, [f64; 3]>,
    /// The last picture; brackets and repeats show it again.
    last: Option<(FrameKind, Stand, NoiseFreeImage)>,
    lamp: Option<LampLaw>,
    misalignment: Option<Misalignment>,
}

/// How one shot is lit and timed.
struct Exposure {
    /// The lamp's brightness.
    lamp: [f64; 3],
    /// The true exposure time, milliseconds.
    time_ms: f64,
    filter: Option<Filter>,
}

impl VirtualCamera {
    /// A camera in front of this picture; `seed` selects its noise.
    ///
    /// # Errors
    /// When a number of the sensor model has no meaning.
    pub fn new(sensor: SensorModel, appearance: Box<dyn Appearance>, seed: u64) -> Result<Self> {
        sensor.check()?;
        Ok(Self {
            pattern: FixedPattern::new(&sensor),
            sensor,
            appearance,
            seed,
            factors: BTreeMap::new(),
            last: None,
            lamp: None,
            misalignment: None,
        })
    }

    /// Lets the lamp's brightness change from shot to shot.
    #[must_use]
    pub fn with_lamp(mut self, law: LampLaw) -> Self {
        self.lamp = Some(law);
        self
    }

    /// Lets things stand elsewhere than they are asked to.
    #[must_use]
    pub fn with_misalignment(mut self, misalignment: Misalignment) -> Self {
        self.misalignment = Some(misalignment);
        self
    }

    /// The sensor.
    pub fn sensor(&self) -> &SensorModel {
        &self.sensor
    }

    /// Where things stand at a shot.
    fn stand(&self, shot: &Shot) -> Stand {
        match &self.misalignment {
            Some(misalignment) => misalignment(shot),
            None => Stand::exact(&shot.pose),
        }
    }

    /// The lamp's brightness at a shot.
    fn brightness(&mut self, shot: &Shot) -> Result<[f64; 3]> {
        let Some(law) = self.lamp.as_mut().filter(|_| shot.kind != FrameKind::Dark) else {
            return Ok([1.0; 3]);
        };
        let brightness = law(shot);
        if !brightness.iter().all(|b| (0.0..1e3).contains(b)) {
            return Err(Error::new(format!(
                "virtual camera: lamp brightness {brightness:?}, expected numbers from 0 to 1000"
            )));
        }
        Ok(brightness)
    }

    /// Brightness and true time of a shot, with flicker and the shutter's jitter.
    fn exposure(&mut self, shot: &Shot, filter: Option<Filter>) -> Result<Exposure> {
        let mut lamp = self.brightness(shot)?;
        let mut random = self.stream(shot, filter, u64::MAX);
        let flicker = 1.0 + self.sensor.flicker * random.normal();
        let jitter = 1.0 + self.sensor.shutter_jitter * random.normal();
        for brightness in &mut lamp {
            *brightness *= flicker.max(0.0);
        }
        Ok(Exposure {
            lamp,
            time_ms: shot.exposure_ms * jitter.max(0.0),
            filter,
        })
    }

    /// The raw values of one shot.
    fn raw(&self, shot: &Shot, picture: Option<&NoiseFreeImage>, exposure: &Exposure) -> Vec<u16> {
        let sensor = &self.sensor;
        let gathered: Vec<(f64, f64)> = (0..sensor.values())
            .into_par_iter()
            .map(|index| {
                let light = picture.map_or(0.0, |p| self.light(p, index, exposure));
                let mut random = self.stream(shot, exposure.filter, index as u64);
                let gain = self.pattern.gain[index];
                let expected = gain * exposure.time_ms * (light + self.pattern.dark[index]);
                (poisson(expected, &mut random) / gain, random.normal())
            })
            .collect();
        let (charge, noise) = gathered.into_iter().unzip();
        let mut charges = Charges { charge, noise };
        let stride = sensor.width * sensor.layout.values_per_pixel();
        charges.bloom(sensor.faults.full_well, stride);
        charges.raw_values(sensor)
    }

    /// Light that one value of a frame gathers, raw values per millisecond.
    fn light(&self, picture: &NoiseFreeImage, index: usize, exposure: &Exposure) -> f64 {
        let sensor = &self.sensor;
        let per_pixel = sensor.layout.values_per_pixel();
        let pixel = picture.pixels[index / per_pixel];
        let of = |c: usize| sensor.responsivity[c] * (pixel[c] * exposure.lamp[c]);
        let gathered = match (sensor.layout, exposure.filter) {
            (Layout::Bayer(cfa), _) => of(cfa.channel(index / sensor.width, index % sensor.width)),
            (Layout::Rgb, _) => of(index % 3),
            (Layout::Mono, Some(filter)) => of(filter.channel()),
            (Layout::Mono, None) => (of(0) + of(1) + of(2)) / 3.0,
        };
        gathered * self.pattern.light[index]
    }

    /// The random numbers of one value of a frame.
    fn stream(&self, shot: &Shot, filter: Option<Filter>, index: u64) -> Random {
        Random::keyed(&[
            self.seed,
            // Kind, filter and visit share a word.
            shot.kind as u64
                | filter.map_or(0, |f| f.channel() as u64 + 1) << 4
                | u64::from(shot.visit) << 8,
            shot.config.map_or(u64::MAX, u64::from),
            shot.exposure_ms.to_bits(),
            u64::from(shot.repeat),
            index,
        ])
    }

    /// Takes one shot through a color filter in front of the lens.
    ///
    /// # Errors
    /// When the sensor sees colors itself, the exposure or the lamp's brightness has no meaning, or as
    /// [`Self::noise_free_image`].
    pub fn expose_through(&mut self, shot: &Shot, filter: Filter) -> Result<CapturedFrame> {
        if self.sensor.layout != Layout::Mono {
            return Err(Error::new(format!(
                "virtual camera: a filter in front of a sensor with layout {}, expected a monochrome one",
                self.sensor.layout
            )));
        }
        self.take(shot, Some(filter))
    }

    fn take(&mut self, shot: &Shot, filter: Option<Filter>) -> Result<CapturedFrame> {
        if !(1e-3..1e7).contains(&shot.exposure_ms) {
            return Err(Error::new(format!(
                "virtual camera: exposure {} ms, expected 0.001 to 10000000",
                shot.exposure_ms
            )));
        }
        let exposure = self.exposure(shot, filter)?;
        let stand = self.stand(shot);
        let shown = |(kind, at, _): &(FrameKind, Stand, _)| *kind == shot.kind && *at == stand;
        if shot.kind != FrameKind::Dark && !self.last.as_ref().is_some_and(shown) {
            let image = self.picture(shot.kind, &stand)?;
            self.last = Some((shot.kind, stand, image));
        }
        let picture = match shot.kind {
            FrameKind::Dark => None,
            _ => self.last.as_ref().map(|l| &l.2),
        };
        let data = self.raw(shot, picture, &exposure);
        let (bytes, extension) = match self.sensor.layout {
            Layout::Bayer(cfa) => (self.dng(shot, &data, cfa)?, "dng"),
            Layout::Mono | Layout::Rgb => (self.tiff(shot, &data)?, "tif"),
        };
        Ok(CapturedFrame {
            bytes,
            extension: extension.to_owned(),
            exposure_ms: shot.exposure_ms,
        })
    }

    fn dng(&self, shot: &Shot, data: &[u16], cfa: CfaPattern) -> Result<Vec<u8>> {
        write_dng(&DngImage {
            width: self.sensor.width,
            height: self.sensor.height,
            data,
            bits: self.sensor.bits,
            cfa,
            black: self.sensor.black,
            white: self.sensor.white,
            make: "goniofit",
            model: &self.sensor.name,
            exposure_ms: Some(shot.exposure_ms),
            iso: Some(100),
            date_time: None,
        })
    }

    fn tiff(&self, shot: &Shot, data: &[u16]) -> Result<Vec<u8>> {
        write_tiff(&TiffImage {
            width: self.sensor.width,
            height: self.sensor.height,
            layout: self.sensor.layout,
            data,
            white: self.sensor.white,
            make: "goniofit",
            model: &self.sensor.name,
            exposure_ms: Some(shot.exposure_ms),
            iso: Some(100),
        })
    }
}

impl Camera for VirtualCamera {
    fn facts(&self) -> CameraFacts {
        self.sensor.facts()
    }

    fn expose(&mut self, shot: &Shot) -> Result<CapturedFrame> {
        self.take(shot, None)
    }
}
