//! A camera that is a program: photographs a picture given from outside, through a model of a sensor, into real DNG files.
//!
//! ```text
//! electrons = Poisson(gain (responsivity_c M V(x, y) + dark_current) exposure)
//! raw       = clip(round(black + electrons / gain + read_noise normal), 0, white)
//! ```
//!
//! with `M` the normalized radiance averaged over the pixel's area (times the lamp's brightness, when it drifts), `V` the
//! vignetting and `gain` in electrons per raw value. Not modeled: lens blur, stray light, non-linearity, unequal pixels,
//! blooming.

use super::{Camera, CapturedFrame, Shot};
use crate::base::{Error, Result};
use crate::math::Random;
use crate::session::{
    BitDepth, CameraFacts, CfaPattern, Configuration, DngImage, FrameKind, Projection,
    WhiteReference, write_dng,
};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// What the virtual camera looks at.
pub trait Appearance: Send + Sync {
    /// Normalized radiance (r, g, b) toward the camera of the point `point_mm` of the sample plane (millimeters, in the
    /// sample frame, which is turned by `pose.rotation`), for a [`FrameKind::Sample`] or [`FrameKind::White`] frame;
    /// never asked for darks. A white frame shows [`white_radiance`], everywhere.
    fn radiance(&self, kind: FrameKind, pose: &Configuration, point_mm: [f64; 2]) -> [f64; 3];
}

/// The lamp's brightness, r, g, b, at each shot with light; 1 is what radiances are stated for. Whoever makes it lets it
/// count shots or read a clock.
pub type LampLaw = Box<dyn FnMut(&Shot) -> [f64; 3] + Send + Sync>;

/// The normalized radiance of the white standard at its reference geometry:
/// `M = pi f_r cos(theta_light) = reflectance_factor cos(theta_light)`.
pub fn white_radiance(white: &WhiteReference) -> [f64; 3] {
    let cosine = white.configuration.light.theta.cos();
    white.reflectance_factor.map(|factor| factor * cosine)
}

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
    /// Color filter array.
    pub cfa: CfaPattern,
    /// Sample size of the files.
    pub bits: BitDepth,
    /// Black level of each place of the 2x2 block, row by row, raw values.
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
    /// Each pixel averages `subsamples x subsamples` points of the picture.
    pub subsamples: usize,
}

impl Default for SensorModel {
    /// A 12-bit camera that sees a 1 cm square 140 pixels wide; 0.4 (raw value)^2 of shot noise per raw value, as
    /// measured on a 10-bit consumer camera (0.1) and scaled by 4.
    fn default() -> Self {
        Self {
            name: "virtual camera".to_owned(),
            width: 240,
            height: 180,
            pixel_mm: 1.0 / 14.0,
            center_px: [120.0, 90.0],
            cfa: CfaPattern::Rggb,
            bits: BitDepth::Twelve,
            black: [128.0, 127.5, 128.25, 128.0],
            white: 4095,
            responsivity: [42.0, 60.0, 48.0],
            gain: 2.5,
            read_noise: 2.0,
            dark_current: 0.004,
            vignetting: 0.04,
            subsamples: 3,
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
            lens: Default::default(),
        }
    }

    /// Light lost to vignetting: the factor at the image point (x, y).
    pub fn vignette(&self, x: f64, y: f64) -> f64 {
        let (half_width, half_height) = (0.5 * self.width as f64, 0.5 * self.height as f64);
        let corner = half_width.hypot(half_height);
        let r = (x - half_width).hypot(y - half_height) / corner;
        1.0 - self.vignetting * r * r
    }

    fn check(&self) -> Result<()> {
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
        if !(1..=32).contains(&self.subsamples) {
            return bad("subsamples must be 1 to 32");
        }
        if self.white > self.bits.largest()
            || !self
                .black
                .iter()
                .all(|b| (0.0..f64::from(self.white)).contains(b))
        {
            return bad("black must lie below white, and white within the sample size");
        }
        Ok(())
    }
}

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
/// Frames are a function of sensor, appearance, seed, shot and the lamp's brightness alone, on any number of threads: the
/// order of shots does not matter, and a shot asked for again after an interruption gives the same frame.
pub struct VirtualCamera {
    sensor: SensorModel,
    appearance: Box<dyn Appearance>,
    seed: u64,
    /// Factors on the radiance by configuration id.
    factors: BTreeMap<u32, [f64; 3]>,
    /// The last picture; brackets and repeats show it again.
    last: Option<(FrameKind, Configuration, NoiseFreeImage)>,
    lamp: Option<LampLaw>,
}

impl VirtualCamera {
    /// A camera in front of this picture; `seed` selects its noise.
    ///
    /// # Errors
    /// When a number of the sensor model has no meaning.
    pub fn new(sensor: SensorModel, appearance: Box<dyn Appearance>, seed: u64) -> Result<Self> {
        sensor.check()?;
        Ok(Self {
            sensor,
            appearance,
            seed,
            factors: BTreeMap::new(),
            last: None,
            lamp: None,
        })
    }

    /// Lets the lamp's brightness change from shot to shot.
    #[must_use]
    pub fn with_lamp(mut self, law: LampLaw) -> Self {
        self.lamp = Some(law);
        self
    }

    /// The sensor.
    pub fn sensor(&self) -> &SensorModel {
        &self.sensor
    }

    /// What each pixel would see without vignetting, noise and filters: the radiance averaged over the pixel's area
    /// (`subsamples^2` points), in normalized radiance.
    ///
    /// # Errors
    /// When the appearance returns a radiance that is negative or not finite.
    pub fn noise_free_image(
        &self,
        kind: FrameKind,
        pose: &Configuration,
    ) -> Result<NoiseFreeImage> {
        let projection = Projection::new(&self.sensor.facts(), pose);
        let factor = match kind {
            FrameKind::White | FrameKind::Dark => [1.0; 3],
            _ => self.factors.get(&pose.id).copied().unwrap_or([1.0; 3]),
        };
        let width = self.sensor.width;
        let mut pixels = vec![[0.0; 3]; width * self.sensor.height];
        pixels
            .par_chunks_mut(width)
            .enumerate()
            .try_for_each(|(y, row)| {
                for (x, pixel) in row.iter_mut().enumerate() {
                    let mean = self.pixel_average(&projection, kind, pose, x, y);
                    if !mean.iter().all(|m| (0.0..1e9).contains(m)) {
                        return Err(Error::new(format!(
                            "virtual camera: radiance {mean:?} at column {x}, row {y} of configuration {}, expected finite numbers >= 0",
                            pose.id
                        )));
                    }
                    *pixel = [0, 1, 2].map(|c| mean[c] * factor[c]);
                }
                Ok(())
            })?;
        Ok(NoiseFreeImage { width, pixels })
    }

    fn pixel_average(
        &self,
        projection: &Projection,
        kind: FrameKind,
        pose: &Configuration,
        x: usize,
        y: usize,
    ) -> [f64; 3] {
        let k = self.sensor.subsamples;
        let step = 1.0 / k as f64;
        let mut sum = [0.0; 3];
        for j in 0..k {
            for i in 0..k {
                let pixel = [
                    x as f64 + (i as f64 + 0.5) * step,
                    y as f64 + (j as f64 + 0.5) * step,
                ];
                let point = projection.to_sample(pixel);
                let radiance = self.appearance.radiance(kind, pose, point);
                for c in 0..3 {
                    sum[c] += radiance[c];
                }
            }
        }
        sum.map(|s| s * step * step)
    }

    /// The exact mean of the noise-free picture over the projection of the sample square, pixels weighted by the covered
    /// fraction: what a perfect measurement returns.
    ///
    /// # Errors
    /// When the square leaves the image, or as [`Self::noise_free_image`].
    pub fn true_mean(&self, pose: &Configuration, sample_square_mm: f64) -> Result<[f64; 3]> {
        let image = self.noise_free_image(FrameKind::Sample, pose)?;
        let coverage = Projection::new(&self.sensor.facts(), pose).coverage(sample_square_mm)?;
        let (mut sum, mut area) = ([0.0; 3], 0.0);
        for (x, y, weight) in coverage.pixels() {
            let pixel = image.pixels[y * image.width + x];
            area += weight;
            for c in 0..3 {
                sum[c] += weight * pixel[c];
            }
        }
        Ok(sum.map(|s| s / area))
    }

    /// Rescales the picture of one configuration so that [`Self::true_mean`] is `target` (to rounding); returns the
    /// factors. Frames taken from now on show it.
    ///
    /// # Errors
    /// When the picture is black in a channel whose target is not zero, the target is negative or not finite, or as
    /// [`Self::true_mean`].
    pub fn rescale_to(
        &mut self,
        pose: &Configuration,
        sample_square_mm: f64,
        target: [f64; 3],
    ) -> Result<[f64; 3]> {
        self.factors.remove(&pose.id);
        let mean = self.true_mean(pose, sample_square_mm)?;
        let mut factors = [1.0; 3];
        for c in 0..3 {
            factors[c] = if target[c] > 0.0 {
                target[c] / mean[c]
            } else {
                target[c]
            };
            if !(0.0..1e12).contains(&factors[c]) {
                return Err(Error::new(format!(
                    "virtual camera: configuration {}: a picture with mean {} cannot be rescaled to {}",
                    pose.id, mean[c], target[c]
                )));
            }
        }
        self.factors.insert(pose.id, factors);
        self.last = None;
        Ok(factors)
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

    /// The raw values of one shot, with the lamp at this brightness.
    fn raw(&self, shot: &Shot, picture: Option<&NoiseFreeImage>, lamp: [f64; 3]) -> Vec<u16> {
        let sensor = &self.sensor;
        let mut data = vec![0; sensor.width * sensor.height];
        data.par_chunks_mut(sensor.width)
            .enumerate()
            .for_each(|(y, row)| {
                for (x, value) in row.iter_mut().enumerate() {
                    let channel = sensor.cfa.channel(y, x);
                    let radiance =
                        picture.map_or(0.0, |p| p.pixels[y * p.width + x][channel] * lamp[channel]);
                    let mut random = self.pixel_stream(shot, x, y);
                    *value = self.pixel_value(radiance, x, y, shot.exposure_ms, &mut random);
                }
            });
        data
    }

    fn pixel_stream(&self, shot: &Shot, x: usize, y: usize) -> Random {
        Random::keyed(&[
            self.seed,
            // Kind and visit share a word.
            shot.kind as u64 | u64::from(shot.visit) << 8,
            shot.config.map_or(u64::MAX, u64::from),
            shot.exposure_ms.to_bits(),
            u64::from(shot.repeat),
            (y * self.sensor.width + x) as u64,
        ])
    }

    fn pixel_value(
        &self,
        radiance: f64,
        x: usize,
        y: usize,
        exposure_ms: f64,
        random: &mut Random,
    ) -> u16 {
        let sensor = &self.sensor;
        let light = sensor.responsivity[sensor.cfa.channel(y, x)]
            * radiance
            * sensor.vignette(x as f64 + 0.5, y as f64 + 0.5);
        let expected = sensor.gain * exposure_ms * (light + sensor.dark_current);
        let electrons = poisson(expected, random);
        let raw = sensor.black[CfaPattern::position(y, x)]
            + electrons / sensor.gain
            + sensor.read_noise * random.normal();
        raw.round().clamp(0.0, f64::from(sensor.white)) as u16
    }
}

impl Camera for VirtualCamera {
    fn facts(&self) -> CameraFacts {
        self.sensor.facts()
    }

    fn expose(&mut self, shot: &Shot) -> Result<CapturedFrame> {
        if !(1e-3..1e7).contains(&shot.exposure_ms) {
            return Err(Error::new(format!(
                "virtual camera: exposure {} ms, expected 0.001 to 10000000",
                shot.exposure_ms
            )));
        }
        let lamp = self.brightness(shot)?;
        let shown = self
            .last
            .as_ref()
            .is_some_and(|(kind, pose, _)| *kind == shot.kind && *pose == shot.pose);
        if shot.kind != FrameKind::Dark && !shown {
            let image = self.noise_free_image(shot.kind, &shot.pose)?;
            self.last = Some((shot.kind, shot.pose, image));
        }
        let picture = match shot.kind {
            FrameKind::Dark => None,
            _ => self.last.as_ref().map(|l| &l.2),
        };
        let bytes = write_dng(&DngImage {
            width: self.sensor.width,
            height: self.sensor.height,
            data: &self.raw(shot, picture, lamp),
            bits: self.sensor.bits,
            cfa: self.sensor.cfa,
            black: self.sensor.black,
            white: self.sensor.white,
            make: "goniofit",
            model: &self.sensor.name,
            exposure_ms: Some(shot.exposure_ms),
            iso: Some(100),
            date_time: None,
        })?;
        Ok(CapturedFrame {
            bytes,
            extension: "dng".to_owned(),
            exposure_ms: shot.exposure_ms,
        })
    }
}

/// A Poisson number, exact for every mean: multiplication of uniforms below 10 (Knuth 1969), transformed rejection with
/// squeeze above (Hormann 1993, PTRS).
fn poisson(mean: f64, random: &mut Random) -> f64 {
    if mean < 10.0 {
        let limit = (-mean).exp();
        let mut product = random.uniform_open();
        let mut count = 0.0;
        while product > limit {
            product *= random.uniform_open();
            count += 1.0;
        }
        return count;
    }
    let log_mean = mean.ln();
    let b = 0.931 + 2.53 * mean.sqrt();
    let a = -0.059 + 0.02483 * b;
    let inverse_alpha = 1.1239 + 1.1328 / (b - 3.4);
    let v_r = 0.9277 - 3.6224 / (b - 2.0);
    loop {
        let u = random.uniform() - 0.5;
        let v = random.uniform_open();
        let us = 0.5 - u.abs();
        let k = ((2.0 * a / us + b) * u + mean + 0.43).floor();
        if us >= 0.07 && v <= v_r {
            return k;
        }
        if k < 0.0 || (us < 0.013 && v > us) {
            continue;
        }
        let accept = (v * inverse_alpha / (a / (us * us) + b)).ln();
        if accept <= k * log_mean - mean - libm::lgamma(k + 1.0) {
            return k;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::PolarDirection;
    use crate::math::statistics::{Running, sidak_level};
    use statrs::distribution::{ContinuousCDF, DiscreteCDF, Normal, Poisson};

    fn seed(default: u64) -> u64 {
        std::env::var("SEED").map_or(default, |s| s.parse().unwrap())
    }

    /// Chi-square statistic of Poisson draws over cells of about equal probability, as a standard normal number
    /// (Wilson and Hilferty 1931).
    fn poisson_chi_square(mean: f64, drawn_at: f64, n: usize, seed: u64) -> f64 {
        let law = Poisson::new(mean).unwrap();
        let quantile = |p: f64| (0..).find(|&k| law.cdf(k) >= p).unwrap();
        let mut edges: Vec<u64> = (1..20).map(|i| quantile(f64::from(i) / 20.0)).collect();
        edges.dedup();
        let mut counts = vec![0.0; edges.len() + 1];
        let mut random = Random::keyed(&[seed, mean.to_bits()]);
        for _ in 0..n {
            let k = poisson(drawn_at, &mut random) as u64;
            counts[edges.partition_point(|&e| e < k)] += 1.0;
        }
        let mut below = 0.0;
        let mut chi_square = 0.0;
        for (i, count) in counts.iter().enumerate() {
            let cdf = edges.get(i).map_or(1.0, |&e| law.cdf(e));
            let expected = (cdf - below) * n as f64;
            chi_square += (count - expected) * (count - expected) / expected;
            below = cdf;
        }
        let dof = edges.len() as f64;
        let spread = 2.0 / (9.0 * dof);
        ((chi_square / dof).cbrt() - 1.0 + spread) / spread.sqrt()
    }

    #[test]
    fn electrons_follow_poisson_law() {
        // 200,000 draws see a mean that is off by 0.013 standard deviations.
        let (n, seed) = (200_000, seed(20_260_101));
        let means = [0.05, 1.0, 9.9, 10.1, 37.0, 1000.0];
        let level = sidak_level(1e-3, means.len());
        let limit = Normal::standard().inverse_cdf(1.0 - level);
        for mean in means {
            let z = poisson_chi_square(mean, mean, n, seed);
            assert!(z < limit, "mean {mean}: z = {z} (limit {limit}, n = {n})");
        }
        // Negative control: a mean off by 3 % of its standard deviation is caught.
        for mean in [9.9, 37.0, 1000.0] {
            let z = poisson_chi_square(mean, mean + 0.03 * mean.sqrt(), n, seed);
            assert!(z > limit, "mean {mean}: a shifted law passed, z = {z}");
        }
    }

    /// A gradient that depends on where the sample points.
    struct Slope;

    impl Appearance for Slope {
        fn radiance(&self, _: FrameKind, _: &Configuration, [x, y]: [f64; 2]) -> [f64; 3] {
            [0.5 + 0.02 * x, 0.3 + 0.01 * y, 0.2]
        }
    }

    fn pose(id: u32, theta_deg: f64) -> Configuration {
        Configuration {
            id,
            light: PolarDirection::from_degrees(45.0, 180.0),
            camera: PolarDirection::from_degrees(theta_deg, 0.0),
            rotation: 0.4,
        }
    }

    fn shot(kind: FrameKind, exposure_ms: f64, repeat: u32) -> Shot {
        Shot {
            kind,
            config: (kind == FrameKind::Sample).then_some(3),
            pose: pose(3, 20.0),
            exposure_ms,
            repeat,
            visit: 0,
        }
    }

    #[test]
    fn a_rescaled_picture_has_the_stated_mean() {
        let mut camera = VirtualCamera::new(SensorModel::default(), Box::new(Slope), 1).unwrap();
        let before = camera.true_mean(&pose(3, 70.0), 8.0).unwrap();
        assert!((before[0] - 0.5).abs() < 1e-3, "{before:?}");
        let target = [0.123, 0.456, 0.0];
        camera.rescale_to(&pose(3, 70.0), 8.0, target).unwrap();
        let mean = camera.true_mean(&pose(3, 70.0), 8.0).unwrap();
        for c in 0..3 {
            assert!((mean[c] - target[c]).abs() < 1e-14, "{mean:?}");
        }
        // Twice is as once, and other poses keep their picture.
        camera.rescale_to(&pose(3, 70.0), 8.0, target).unwrap();
        let again = camera.true_mean(&pose(3, 70.0), 8.0).unwrap();
        assert!((again[0] - target[0]).abs() < 1e-14);
        assert!((camera.true_mean(&pose(4, 70.0), 8.0).unwrap()[2] - 0.2).abs() < 1e-12);
        assert!(
            camera
                .rescale_to(&pose(3, 70.0), 8.0, [f64::NAN, 0.1, 0.1])
                .is_err()
        );
    }

    #[test]
    fn raw_values_have_the_mean_and_variance_of_the_model() {
        // 21,600 green pixels: sees a mean off by 0.03 read-noise units and a variance off by 4 %.
        let sensor = SensorModel {
            vignetting: 0.0,
            black: [128.0; 4],
            ..SensorModel::default()
        };
        let camera = VirtualCamera::new(sensor, Box::new(Slope), seed(7)).unwrap();
        let image = NoiseFreeImage {
            width: 240,
            pixels: vec![[0.5; 3]; 240 * 180],
        };
        let check = |read_noise: f64| {
            let raw = camera.raw(&shot(FrameKind::Sample, 30.0, 0), Some(&image), [1.0; 3]);
            let mut green = Running::default();
            for (i, &v) in raw.iter().enumerate() {
                if CfaPattern::Rggb.channel(i / 240, i % 240) == 1 {
                    green.push(f64::from(v) - 128.0);
                }
            }
            let signal = 30.0 * (60.0 * 0.5 + 0.004);
            let variance = signal / 2.5 + read_noise * read_noise + 1.0 / 12.0;
            let n = green.count() as f64;
            let z_mean = (green.mean() - signal) / (variance / n).sqrt();
            let z_variance = (green.variance() / variance - 1.0) / (2.0 / n).sqrt();
            (z_mean, z_variance, n)
        };
        // Two tests at a family-wise level of 1e-3.
        let limit = Normal::standard().inverse_cdf(1.0 - 0.5 * sidak_level(1e-3, 2));
        let (z_mean, z_variance, n) = check(2.0);
        assert!(z_mean.abs() < limit, "z = {z_mean}, n = {n}");
        assert!(z_variance.abs() < limit, "z = {z_variance}, n = {n}");
        // Negative control: a read noise of 6 instead of 2 is caught.
        assert!(check(6.0).1.abs() > limit);
    }

    #[test]
    fn frames_are_a_function_of_the_shot_on_any_number_of_threads() {
        let take = |seed: u64, threads: usize, shot: &Shot| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            pool.unwrap().install(|| {
                VirtualCamera::new(SensorModel::default(), Box::new(Slope), seed)
                    .unwrap()
                    .expose(shot)
                    .unwrap()
                    .bytes
            })
        };
        let first = shot(FrameKind::Sample, 30.0, 0);
        let bytes = take(5, 1, &first);
        assert_eq!(bytes, take(5, 3, &first));
        assert_ne!(bytes, take(6, 1, &first));
        assert_ne!(bytes, take(5, 1, &shot(FrameKind::Sample, 30.0, 1)));
        assert_ne!(bytes, take(5, 1, &shot(FrameKind::Dark, 30.0, 0)));
    }

    #[test]
    fn an_interrupted_capture_gives_the_same_frames_when_it_goes_on() {
        let camera = || VirtualCamera::new(SensorModel::default(), Box::new(Slope), 5).unwrap();
        let visit = |kind, visit| Shot {
            visit,
            config: None,
            ..shot(kind, 30.0, 0)
        };
        let shots = [
            visit(FrameKind::White, 0),
            visit(FrameKind::Reference, 0),
            shot(FrameKind::Sample, 30.0, 0),
            visit(FrameKind::Reference, 1),
            visit(FrameKind::Dark, 0),
        ];
        let mut whole = camera();
        let whole: Vec<Vec<u8>> = shots
            .iter()
            .map(|s| whole.expose(s).unwrap().bytes)
            .collect();
        // A camera that is asked for the later shots only, and backwards.
        let mut again = camera();
        for (shot, bytes) in shots.iter().zip(&whole).skip(2).rev() {
            assert!(again.expose(shot).unwrap().bytes == *bytes, "{shot:?}");
        }
        // No two of them are the same frame, the visits of the reference included.
        for (i, a) in whole.iter().enumerate() {
            assert!(whole[..i].iter().all(|b| a != b), "frame {i} is a copy");
        }
    }

    #[test]
    fn a_drifting_lamp_scales_what_is_lit_and_nothing_else() {
        let sensor = SensorModel {
            read_noise: 0.0,
            dark_current: 0.0,
            gain: 1e6,
            ..SensorModel::default()
        };
        let mut lit = 0;
        let law = move |_: &Shot| {
            lit += 1;
            [1.0, 0.5, 0.25].map(|b| if lit == 1 { 1.0 } else { b })
        };
        let mut camera = VirtualCamera::new(sensor, Box::new(Slope), 5)
            .unwrap()
            .with_lamp(Box::new(law));
        let mut mean = |kind| {
            let bytes = camera.expose(&shot(kind, 30.0, 0)).unwrap().bytes;
            // The pixels lie at the end of the file, two in three bytes, and begin with a red and a green one.
            let row = &bytes[bytes.len() - 180 * 360..][..360];
            let pair = |c: &[u8]| {
                let red = u16::from(c[0]) << 4 | u16::from(c[1]) >> 4;
                let green = (u16::from(c[1]) & 15) << 8 | u16::from(c[2]);
                [f64::from(red) - 128.0, f64::from(green) - 127.5]
            };
            row.chunks(3)
                .map(pair)
                .fold([0.0; 2], |s, p| [s[0] + p[0], s[1] + p[1]])
        };
        let first = mean(FrameKind::Sample);
        let dark = mean(FrameKind::Dark);
        let later = mean(FrameKind::Reference);
        assert!(first[0] > 1e4 && dark[0].abs() < 61.0, "{first:?} {dark:?}");
        assert!(
            (later[0] / first[0] - 1.0).abs() < 2e-3,
            "{first:?} {later:?}"
        );
        assert!(
            (later[1] / first[1] - 0.5).abs() < 2e-3,
            "{first:?} {later:?}"
        );
    }

    #[test]
    fn senseless_sensors_shots_and_pictures_are_refused() {
        let sensor = SensorModel {
            gain: f64::NAN,
            ..SensorModel::default()
        };
        assert!(VirtualCamera::new(sensor, Box::new(Slope), 1).is_err());
        struct Broken;
        impl Appearance for Broken {
            fn radiance(&self, _: FrameKind, _: &Configuration, _: [f64; 2]) -> [f64; 3] {
                [0.1, f64::NAN, 0.1]
            }
        }
        let mut camera = VirtualCamera::new(SensorModel::default(), Box::new(Broken), 1).unwrap();
        let error = camera.expose(&shot(FrameKind::Sample, 1.0, 0)).unwrap_err();
        assert!(error.report().contains("configuration 3"), "{error}");
        assert!(camera.expose(&shot(FrameKind::Dark, 1.0, 0)).is_ok());
        assert!(camera.expose(&shot(FrameKind::Dark, f64::NAN, 0)).is_err());
        let camera = VirtualCamera::new(SensorModel::default(), Box::new(Slope), 1).unwrap();
        let mut camera = camera.with_lamp(Box::new(|_| [1.0, f64::NAN, 1.0]));
        let error = camera.expose(&shot(FrameKind::Sample, 1.0, 0)).unwrap_err();
        assert!(error.report().contains("lamp brightness"), "{error}");
    }

    #[test]
    fn the_white_standard_reads_its_factor_times_the_cosine() {
        let white = WhiteReference {
            configuration: pose(0, 0.0),
            reflectance_factor: [1.02, 1.0, 0.98],
            reflectance_factor_se: [0.0; 3],
        };
        let m = white_radiance(&white);
        assert!((m[0] - 1.02 * 0.5_f64.sqrt()).abs() < 1e-15);
    }
}
