//! From a reading to intensities and their error budget.

use super::calibration::ColorMatrix;
use super::crop::ChannelSums;
use super::geometry::GeometryErrors;
use super::lamp::{Lamp, Level};
use super::linear::Response;
use super::noise::Scatter;
use super::reading::Reading;
use super::report::{Budget, Condition, ConfigurationReport, MeasureOptions};
use super::white::{Flat, White};
use crate::base::{Error, Result};
use crate::session::{Configuration, Intensity};

/// What a lamp that was looked at another day may differ by, relative.
const OTHER_DAY: f64 = 0.02;

/// A black level may wander by this from frame to frame, raw values.
const BLACK_LEVEL_WANDER: f64 = 0.3;

/// What all configurations are reduced with.
pub(super) struct Reducer<'a> {
    pub(super) white: &'a White,
    /// The flat field where the white was read.
    pub(super) white_flat: Option<&'a Flat>,
    /// Where the white was read.
    pub(super) white_pose: &'a Configuration,
    pub(super) lamp: &'a Lamp,
    pub(super) response: &'a Response,
    pub(super) errors: GeometryErrors,
    pub(super) scatter: Scatter,
    pub(super) color: Option<&'a ColorMatrix>,
    pub(super) options: &'a MeasureOptions,
}

impl Reducer<'_> {
    /// The intensity of one configuration, if it is usable, and what there is to say of it.
    ///
    /// # Errors
    /// A frame is darker than its dark by more than noise explains, or a number is not finite.
    pub(super) fn reduce(
        &self,
        reading: &Reading,
    ) -> Result<(Option<Intensity>, ConfigurationReport)> {
        let id = reading.configuration.id;
        let mut report = ConfigurationReport {
            config: id,
            condition: Condition::Good,
            measured: false,
            message: None,
            notes: reading
                .checks
                .iter()
                .flat_map(|c| c.messages(&format!("configuration {id}")))
                .collect(),
            checks: reading.checks.clone(),
            masked: reading.masked.clone(),
            bounds: reading.bounds,
            exposures_ms: reading.used_exposures(),
            area_px: reading.area_px,
            budget: [Budget::default(); 3],
        };
        if !reading.captured {
            report.condition = Condition::NotCaptured;
            report.message = Some(format!(
                "configuration {id}: the journal has no frame of it; go on with the capture (`goniofit capture --resume DIR`)"
            ));
            return Ok((None, report));
        }
        if let Some(c) = reading.unseen {
            report.condition = Condition::NotCaptured;
            report.message = Some(format!(
                "configuration {id}: no frame through the {} filter; shoot every configuration through all three",
                COLORS[c]
            ));
            return Ok((None, report));
        }
        let Some(channels) = &reading.channels else {
            report.condition = Condition::Saturated;
            let what = reading.saturated.as_deref().unwrap_or("saturated");
            report.message = Some(format!("configuration {id} is {what}"));
            return Ok((None, report));
        };
        let mut mean = [0.0; 3];
        for (c, sums) in channels.iter().enumerate() {
            self.check_dark(reading, c)?;
            mean[c] = sums.mean;
            report.budget[c] = self.budget(reading, sums, c);
            let total = report.budget[c].total();
            if !mean[c].is_finite() || !total.is_finite() {
                return Err(Error::new(format!(
                    "configuration {id}: {} came out as {} +- {total}",
                    COLORS[c], mean[c]
                ))
                .with_hint("a number of the plan, session.json or a calibration has no meaning: check them"));
            }
        }
        // Judged in the camera's own colors: others may come from differences.
        let noisy = (0..3).any(|c| report.budget[c].noise() > self.options.underexposed * mean[c]);
        report.measured = mean.iter().all(|&m| m > 0.0);
        if let Some(color) = self.color {
            (mean, report.budget) = self.converted(color, mean, &report.budget, channels);
            if report.measured && !mean.iter().all(|&m| m > 0.0) {
                report.measured = false;
                report.condition = Condition::OutsideColorSpace;
                report.message = Some(format!(
                    "configuration {id} lies outside the color space {}: {mean:.5?}; left out: measure it without --color",
                    color.space
                ));
                return Ok((None, report));
            }
        }
        if noisy || !report.measured {
            report.condition = Condition::UnderExposed;
            let longest = report.exposures_ms.last().copied().unwrap_or(0.0);
            report.message = Some(format!(
                "configuration {id} is under-exposed: {mean:.2?} with noise {:.2?} at exposures up to {longest} ms{}",
                report.budget.map(|b| b.noise()),
                if report.measured { "" } else { "; left out" }
            ));
        }
        let intensity = report.measured.then(|| Intensity {
            configuration: reading.configuration,
            mean,
            standard_error: report.budget.map(|b| b.total()),
            present: [true; 3],
        });
        Ok((intensity, report))
    }

    fn budget(&self, reading: &Reading, sums: &ChannelSums, c: usize) -> Budget {
        let slope = self.scatter.slope[c];
        let m = sums.mean;
        let levels = reading.exposures.iter().zip(&sums.shares);
        let levels: Vec<(f64, &Level)> = levels.map(|(e, share)| (*share, &e.level)).collect();
        let white_levels = self.white.levels[c].iter();
        let white_levels: Vec<(f64, &Level)> = white_levels.map(|(w, l)| (m * w, l)).collect();
        let mut drift = self.lamp.variance(&levels, &white_levels, c, &self.scatter);
        if self.white.from_calibration {
            drift += (m * OTHER_DAY).powi(2);
        }
        let frames: f64 = reading
            .exposures
            .iter()
            .zip(&sums.shares)
            .filter(|(_, share)| **share != 0.0)
            .map(|(e, share)| share * share / e.repeats)
            .sum();
        let between = self.scatter.between_frames * (frames + m * m * self.white.flicker[c]).sqrt();
        let flat = match (self.white_flat, &self.options.calibrations.flat) {
            (Some(flat), Some(known)) => {
                let white = self.white.flat_variance(c, flat);
                let source = known.value.uniformity_se.powi(2);
                sums.flat + m * m * (white + source)
            }
            _ => self.white.unevenness(c, &self.scatter) * sums.squares,
        };
        let of_white = self.errors.of_white(self.white_pose);
        Budget {
            shot: (slope * sums.shot.max(0.0)).sqrt(),
            read: sums.read.sqrt(),
            dark: sums.dark.sqrt(),
            sampling: reading.texture.variance(c, slope).sqrt(),
            linearity: self.response.variance(&sums.by_response).sqrt(),
            flat: flat.max(0.0).sqrt(),
            white: self.white.variance(c, &sums.white, &self.scatter).sqrt(),
            reference: m.abs() * self.white.radiance_se[c],
            drift: drift.sqrt(),
            geometry: (reading.geometry[c] + (m * of_white).powi(2)).sqrt(),
            repeatability: between,
            color: 0.0,
        }
    }

    /// Fails when a frame is darker than its dark by more than noise explains.
    fn check_dark(&self, reading: &Reading, c: usize) -> Result<()> {
        let used = reading.channels.iter().flat_map(|all| &all[c].shares);
        for (exposure, share) in reading.exposures.iter().zip(used) {
            let Some((signal, shot, constant)) = exposure.mean[c].filter(|_| *share != 0.0) else {
                continue;
            };
            if signal > -BLACK_LEVEL_WANDER {
                continue;
            }
            let deviation = signal / (self.scatter.slope[c] * shot + constant).sqrt();
            if deviation < -6.0 {
                let [left, top, right, bottom] = reading.bounds;
                return Err(Error::new(format!(
                    "{}: the dark frame is brighter than the sample frame ({:.1} standard errors, {}, columns {left} to {right}, rows {top} to {bottom})",
                    exposure.title, -deviation, COLORS[c]
                ))
                .with_hint(
                    "was the light on for the dark frames, or did the sensor warm up? take darks again",
                ));
            }
        }
        Ok(())
    }

    /// Means and budgets in another color space. Parts that the three channels have in common add up with their signs where
    /// those are known (response curve) or are the same (reference, drift, flicker), and at their worst where they are not
    /// (geometry); the others add up as squares.
    fn converted(
        &self,
        color: &ColorMatrix,
        mean: [f64; 3],
        from: &[Budget; 3],
        channels: &[ChannelSums; 3],
    ) -> ([f64; 3], [Budget; 3]) {
        let budget = |i: usize| {
            let row = color.matrix[i];
            let sum = |value: &dyn Fn(usize) -> f64| (0..3).map(value).sum::<f64>();
            let apart =
                |part: &dyn Fn(&Budget) -> f64| sum(&|j| (row[j] * part(&from[j])).powi(2)).sqrt();
            let together = |part: &dyn Fn(&Budget) -> f64| sum(&|j| row[j] * part(&from[j])).abs();
            let derivatives: Vec<f64> = (0..self.response.order())
                .map(|k| sum(&|j| row[j] * channels[j].by_response[k]))
                .collect();
            let matrix = sum(&|j| sum(&|k| mean[j] * color.covariance[i][j][k] * mean[k]));
            Budget {
                shot: apart(&|b| b.shot),
                read: apart(&|b| b.read),
                dark: apart(&|b| b.dark),
                sampling: apart(&|b| b.sampling),
                linearity: self.response.variance(&derivatives).sqrt(),
                flat: apart(&|b| b.flat),
                white: apart(&|b| b.white),
                reference: together(&|b| b.reference),
                drift: together(&|b| b.drift),
                geometry: sum(&|j| (row[j] * from[j].geometry).abs()),
                repeatability: together(&|b| b.repeatability),
                color: matrix.max(0.0).sqrt(),
            }
        };
        let converted = |i: usize| (0..3).map(|j| color.matrix[i][j] * mean[j]).sum();
        ([0, 1, 2].map(converted), [0, 1, 2].map(budget))
    }
}

/// How messages call the channels.
pub(super) const COLORS: [&str; 3] = ["red", "green", "blue"];
