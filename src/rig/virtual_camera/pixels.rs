//! What each pixel makes of the light: unequal response and dark current, blooming, and a curve that is not straight.

use super::SensorModel;
use crate::base::{Error, Result};
use crate::math::Random;
use crate::session::Layout;
use rayon::prelude::*;

/// How the pixels of a sensor depart from linear and equal; by default not at all.
#[derive(Debug, Clone, PartialEq)]
pub struct PixelFaults {
    /// `raw - black = q (1 - n[0] q / full - n[1] (q / full)^2)` with `q` the charge in raw values and `full = white -
    /// black`; a straight line of slope 1 goes on from 1.5 full.
    pub nonlinearity: [f64; 2],
    /// Charge a pixel holds, raw values. What is above it spills along the column, one half up and one down, into the
    /// nearest pixels that have room; at the image's edge it is lost. Infinite: pixels hold any charge.
    pub full_well: f64,
    /// Relative standard deviation of the response from pixel to pixel (normal).
    pub response_sd: f64,
    /// Standard deviation of the dark current from pixel to pixel, raw values per millisecond (log-normal).
    pub dark_current_sd: f64,
    /// Fraction of the pixels that are hot.
    pub hot_fraction: f64,
    /// Mean of the dark current that hot pixels have beside the usual one, raw values per millisecond (exponential).
    pub hot_per_ms: f64,
    /// Gain of each channel over that of the sensor; a sensor without colors has the green one's.
    pub gains: [f64; 3],
    /// Selects which pixel is how. Two cameras with the same one are the same sensor, whatever their noise.
    pub pattern_seed: u64,
}

impl Default for PixelFaults {
    fn default() -> Self {
        Self {
            nonlinearity: [0.0; 2],
            full_well: f64::INFINITY,
            response_sd: 0.0,
            dark_current_sd: 0.0,
            hot_fraction: 0.0,
            hot_per_ms: 0.0,
            gains: [1.0; 3],
            pattern_seed: 0,
        }
    }
}

/// Where the curve ends, in units of full scale.
const CURVE_END: f64 = 1.5;

impl PixelFaults {
    pub(super) fn check(&self, dark_current: f64) -> Result<()> {
        let bad = |what: &str| Err(Error::new(format!("sensor model: {what}")));
        let rises = |k: usize| self.raw(f64::from(k as u32) / 100.0, 1.0);
        let monotonic = (1..=150).all(|k| rises(k) > rises(k - 1));
        let beyond = rises(150) > 1.0;
        if !monotonic || !beyond {
            return bad(
                "nonlinearity must leave raw values that rise with the charge, beyond the white level",
            );
        }
        let holds = self.full_well > 0.0;
        if !holds || !self.gains.iter().all(|g| (0.01..100.0).contains(g)) {
            return bad("full_well must be positive, and gains 0.01 to 100");
        }
        let numbers = [self.dark_current_sd, self.hot_per_ms];
        if !numbers.iter().all(|x| (0.0..1e6).contains(x)) {
            return bad("dark_current_sd and hot_per_ms must not be negative");
        }
        if !(0.0..0.2).contains(&self.response_sd) || !(0.0..=0.5).contains(&self.hot_fraction) {
            return bad("response_sd must lie in 0..0.2 and hot_fraction in 0..=0.5");
        }
        let has_mean = dark_current > 0.0;
        if self.dark_current_sd > 0.0 && !has_mean {
            return bad("dark_current_sd needs a dark_current");
        }
        Ok(())
    }

    /// Raw value above black for a charge, both in raw values.
    pub fn raw(&self, charge: f64, full: f64) -> f64 {
        let [n1, n2] = self.nonlinearity;
        let curve = |q: f64| q * (1.0 - n1 * q / full - n2 * (q / full).powi(2));
        let end = CURVE_END * full;
        if charge > end {
            return curve(end) + charge - end;
        }
        curve(charge)
    }

    fn equal_pixels(&self) -> bool {
        let [none, same] = [0.0, 1.0].map(f64::to_bits);
        let spread = [self.response_sd, self.dark_current_sd, self.hot_fraction];
        spread.iter().all(|s| s.to_bits() == none) && self.gains.iter().all(|g| g.to_bits() == same)
    }
}

/// What is fixed of every value of a frame, by index in its data.
#[derive(Debug, Clone)]
pub(super) struct FixedPattern {
    /// Share of the light: vignetting, dust, response of the pixel.
    pub(super) light: Vec<f64>,
    /// Dark current, raw values per millisecond.
    pub(super) dark: Vec<f64>,
    /// Electrons per raw value.
    pub(super) gain: Vec<f64>,
}

impl FixedPattern {
    pub(super) fn new(sensor: &SensorModel) -> Self {
        let per_pixel = sensor.layout.values_per_pixel();
        let faults = &sensor.faults;
        let equal = faults.equal_pixels();
        let spread = dark_spread(faults.dark_current_sd, sensor.dark_current);
        let one = |index: usize| {
            let (x, y) = (
                index / per_pixel % sensor.width,
                index / per_pixel / sensor.width,
            );
            let light = sensor.vignette(x as f64 + 0.5, y as f64 + 0.5);
            if equal {
                return [light, sensor.dark_current, sensor.gain];
            }
            let mut random = Random::keyed(&[faults.pattern_seed, 0x70a7, index as u64]);
            let response = 1.0 + faults.response_sd * random.normal();
            let mut dark =
                sensor.dark_current * (spread * random.normal() - 0.5 * spread * spread).exp();
            if random.uniform() < faults.hot_fraction {
                dark -= faults.hot_per_ms * random.uniform_open().ln();
            }
            let channel = match sensor.layout {
                Layout::Bayer(cfa) => cfa.channel(y, x),
                Layout::Mono => 1,
                Layout::Rgb => index % 3,
            };
            [
                light * response.max(0.0),
                dark,
                sensor.gain * faults.gains[channel],
            ]
        };
        let all: Vec<[f64; 3]> = (0..sensor.values()).into_par_iter().map(one).collect();
        let part = |k: usize| all.iter().map(|v| v[k]).collect();
        Self {
            light: part(0),
            dark: part(1),
            gain: part(2),
        }
    }
}

/// Standard deviation of the logarithm of a log-normal number with this mean and standard deviation.
fn dark_spread(sd: f64, mean: f64) -> f64 {
    if sd > 0.0 {
        return (1.0 + (sd / mean).powi(2)).ln().sqrt();
    }
    0.0
}

/// What the sensor's pixels have gathered: charge and read noise, raw values, by index in the frame's data.
pub(super) struct Charges {
    pub(super) charge: Vec<f64>,
    pub(super) noise: Vec<f64>,
}

impl Charges {
    /// Lets charge above `full_well` spill along the columns; `stride` values make a row.
    pub(super) fn bloom(&mut self, full_well: f64, stride: usize) {
        if !full_well.is_finite() || self.charge.iter().all(|&q| q <= full_well) {
            return;
        }
        let rows = self.charge.len() / stride;
        for column in 0..stride {
            let index = |row: usize| row * stride + column;
            let spilled: Vec<f64> = (0..rows)
                .map(|row| {
                    let excess = (self.charge[index(row)] - full_well).max(0.0);
                    self.charge[index(row)] -= excess;
                    0.5 * excess
                })
                .collect();
            self.pour(full_well, (0..rows).map(|row| (index(row), spilled[row])));
            self.pour(
                full_well,
                (0..rows).rev().map(|row| (index(row), spilled[row])),
            );
        }
    }

    /// Carries what spilled along a column into the pixels that have room.
    fn pour(&mut self, full_well: f64, way: impl Iterator<Item = (usize, f64)>) {
        let mut carried = 0.0_f64;
        for (index, spilled) in way {
            let taken = carried.min(full_well - self.charge[index]);
            self.charge[index] += taken;
            carried += spilled - taken;
        }
    }

    /// Raw values as the converter gives them.
    pub(super) fn raw_values(&self, sensor: &SensorModel) -> Vec<u16> {
        let one = |(index, (&charge, &noise)): (usize, (&f64, &f64))| {
            let black = sensor.black[sensor.layout.place(sensor.width, index)];
            let white = f64::from(sensor.white);
            let raw = black + sensor.faults.raw(charge, white - black) + sensor.read_noise * noise;
            raw.round().clamp(0.0, white) as u16
        };
        self.charge
            .iter()
            .zip(&self.noise)
            .enumerate()
            .map(one)
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::statistics::Running;

    fn sensor(faults: PixelFaults) -> SensorModel {
        SensorModel {
            vignetting: 0.0,
            dark_current: 0.01,
            faults,
            ..SensorModel::default()
        }
    }

    #[test]
    fn the_response_curve_is_the_stated_one() {
        let faults = PixelFaults {
            nonlinearity: [0.03, 0.01],
            ..PixelFaults::default()
        };
        assert!((faults.raw(1000.0, 4000.0) - 1000.0 * (1.0 - 0.0075 - 0.000_625)).abs() < 1e-9);
        let end = faults.raw(6000.0, 4000.0);
        assert!((faults.raw(6500.0, 4000.0) - end - 500.0).abs() < 1e-9 && end > 4000.0);
        // A curve that turns back before the white level is refused.
        let turning = PixelFaults {
            nonlinearity: [0.4, 0.0],
            ..PixelFaults::default()
        };
        assert!(faults.check(0.01).is_ok() && turning.check(0.01).is_err());
    }

    #[test]
    fn blooming_stays_in_its_column_and_loses_no_charge() {
        let (stride, rows) = (7, 20);
        let mut charges = Charges {
            charge: vec![10.0; stride * rows],
            noise: vec![0.0; stride * rows],
        };
        charges.charge[9 * stride + 3] = 700.0;
        charges.charge[10 * stride + 3] = 300.0;
        let before: f64 = charges.charge.iter().sum();
        charges.bloom(100.0, stride);
        let after: f64 = charges.charge.iter().sum();
        assert!((before - after).abs() < 1e-9, "{before} {after}");
        for (i, &q) in charges.charge.iter().enumerate() {
            assert!(q <= 100.0 + 1e-9);
            assert!(
                i % stride == 3 || (q - 10.0).abs() < 1e-12,
                "value {i}: {q}"
            );
        }
        let column: Vec<f64> = (0..rows).map(|y| charges.charge[y * stride + 3]).collect();
        // 400 each way, 90 per pixel.
        for (y, &q) in column.iter().enumerate() {
            let expected = match y {
                5..=14 => 100.0,
                4 | 15 => 50.0,
                _ => 10.0,
            };
            assert!((q - expected).abs() < 1e-9, "row {y}: {column:?}");
        }
        // At the edge it leaves the sensor.
        charges.charge = vec![0.0; stride * rows];
        charges.charge[0] = 300.0;
        charges.bloom(100.0, stride);
        assert!((charges.charge.iter().sum::<f64>() - 200.0).abs() < 1e-9);
    }

    #[test]
    fn pixels_are_as_unequal_as_stated() {
        // 43,200 pixels see a standard deviation off by 1.4 % and a fraction off by 6 % of itself.
        let faults = PixelFaults {
            response_sd: 0.01,
            dark_current_sd: 0.004,
            gains: [1.0, 0.9, 1.1],
            pattern_seed: 3,
            ..PixelFaults::default()
        };
        let pattern = FixedPattern::new(&sensor(faults.clone()));
        let running = |values: &[f64]| {
            let mut r = Running::default();
            values.iter().for_each(|&v| r.push(v));
            (r.mean(), r.variance().sqrt())
        };
        let (mean, sd) = running(&pattern.light);
        assert!(
            (mean - 1.0).abs() < 2.5e-4 && (sd / 0.01 - 1.0).abs() < 0.015,
            "{mean} {sd}"
        );
        let (mean, sd) = running(&pattern.dark);
        assert!(
            (mean / 0.01 - 1.0).abs() < 0.01 && (sd / 0.004 - 1.0).abs() < 0.04,
            "{mean} {sd}"
        );
        assert!(pattern.dark.iter().all(|&d| d > 0.0));
        assert!((pattern.gain[0] - 2.5).abs() < 1e-12 && (pattern.gain[1] - 2.25).abs() < 1e-12);
        // The pattern belongs to the sensor: the same seed, the same pixels.
        assert_eq!(
            pattern.light,
            FixedPattern::new(&sensor(faults.clone())).light
        );
        let other = PixelFaults {
            pattern_seed: 4,
            ..faults
        };
        assert_ne!(pattern.light, FixedPattern::new(&sensor(other)).light);
    }

    #[test]
    fn some_pixels_are_hot() {
        let faults = PixelFaults {
            hot_fraction: 0.02,
            hot_per_ms: 2.0,
            ..PixelFaults::default()
        };
        let dark = FixedPattern::new(&sensor(faults)).dark;
        let hot: Vec<f64> = dark
            .iter()
            .map(|d| d - 0.01)
            .filter(|&d| d > 1e-9)
            .collect();
        let (n, fraction) = (hot.len() as f64, hot.len() as f64 / dark.len() as f64);
        assert!((fraction / 0.02 - 1.0).abs() < 0.15, "{fraction}");
        let mean = hot.iter().sum::<f64>() / n;
        assert!((mean / 2.0 - 1.0).abs() < 0.15, "{mean}");
    }
}
