//! A session's frames to its intensities.

use super::crop::{ChannelSums, ExposureSums, Texture, exposure_sums};
use super::dark::Darks;
use super::frames::{Loader, Region, read_stacks};
use super::noise::{self, Cell, NoiseReport};
use super::white::{TERMS, White, WhiteReport};
use crate::base::{Error, Result, Watch};
use crate::session::{
    Configuration, Coverage, FrameKind, FrameRecord, Intensity, Manifest, Measurements, Projection,
    SessionFolder,
};
use rayon::prelude::*;
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
}

impl Budget {
    /// The standard error: root of the sum of squares.
    pub fn total(&self) -> f64 {
        let other = self.sampling.powi(2) + self.white.powi(2) + self.reference.powi(2);
        (self.noise().powi(2) + other).sqrt()
    }

    /// The part that more light or more frames would reduce.
    fn noise(&self) -> f64 {
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

/// One configuration, read but not yet reduced.
struct Reading {
    configuration: Configuration,
    area_px: f64,
    sums: Vec<ExposureSums>,
    texture: Texture,
    cells: Vec<Cell>,
    /// What saturated, when nothing is usable.
    saturated: Option<String>,
    captured: bool,
}

/// Measures a session: the mean normalized radiance of the sample square in every configuration, with standard errors.
///
/// docs/measure.md has the equations. Configurations that are saturated or were not captured are left out and reported;
/// a result depends on the files alone, not on the number of threads.
///
/// # Errors
/// When a journaled frame is missing, changed, of another size, exposure or camera; there is no white frame, or no dark
/// of some exposure; a dark is brighter than a frame; a crop leaves the image; noise cannot be estimated; the work was
/// interrupted; or no configuration is left.
pub fn measure_session(
    session: &SessionFolder,
    options: &MeasureOptions,
    watch: &dyn Watch,
) -> Result<(Measurements, MeasureReport)> {
    let manifest = session.manifest()?;
    let plan = session.plan()?;
    let records = session.frames()?;
    check_records(&records, |id| plan.configuration(id).is_some())?;
    let coverages = plan
        .configurations
        .iter()
        .map(|c| Projection::new(&manifest.camera, c).coverage(manifest.sample_square_mm))
        .collect::<Result<Vec<_>>>()?;
    let loader = Loader::new(session, &manifest, &records, watch)?;
    let of_kind = |kind: FrameKind| -> Vec<&FrameRecord> {
        records.iter().filter(|r| r.kind == kind).collect()
    };
    let darks = Darks::read(&loader, &of_kind(FrameKind::Dark), options.hot_sigma)?;
    for frame in records.iter().filter(|r| r.kind != FrameKind::Dark) {
        darks.find(frame)?;
    }

    let bounds = union(&coverages);
    let white_region = Region::new(
        (bounds[1]..bounds[3]).flat_map(|y| (bounds[0]..bounds[2]).map(move |x| (x, y, 1.0))),
        manifest.camera.width,
        darks.cfa,
        &darks.hot,
    );
    let (white_stacks, mut cells) = read_stacks(
        &loader,
        &of_kind(FrameKind::White),
        &white_region,
        &darks,
        options.usable_fraction,
    )?;
    let white = White::fit(&manifest, &white_region, bounds, &white_stacks)?;
    drop(white_stacks);

    let readings: Vec<Result<Reading>> = plan
        .configurations
        .par_iter()
        .zip(&coverages)
        .map(|(c, coverage)| {
            read_configuration(&loader, &records, c, coverage, &darks, &white, options)
        })
        .collect();
    let readings = readings.into_iter().collect::<Result<Vec<_>>>()?;

    cells.extend(readings.iter().flat_map(|r| &r.cells));
    let noise = noise_report(&cells, &white, &darks)?;
    let a = noise.variance_per_signal;
    let mut intensities = Vec::new();
    let mut reports = Vec::new();
    for reading in &readings {
        let (intensity, report) = reduce(reading, &white, &manifest, a, options)?;
        intensities.extend(intensity);
        reports.push(report);
    }
    let report = MeasureReport {
        synthetic: manifest.synthetic,
        warnings: warnings(&darks, &noise, &white, a),
        white: white.report(a),
        noise,
        hot_pixels: darks.hot.iter().filter(|&&h| h).count(),
        frames: records.len(),
        configurations: reports,
    };
    if intensities.is_empty() {
        let reasons: Vec<&str> = report
            .configurations
            .iter()
            .filter_map(|c| c.message.as_deref())
            .collect();
        return Err(Error::new(format!(
            "no configuration could be measured: {}",
            reasons.join("; ")
        ))
        .with_hint(
            "choose exposures so that the brightest pixel of the crop stays below the white level",
        ));
    }
    Ok((Measurements { intensities }, report))
}

fn check_records(records: &[FrameRecord], known: impl Fn(u32) -> bool) -> Result<()> {
    for record in records.iter().filter(|r| r.kind == FrameKind::Sample) {
        if !record.config.is_some_and(&known) {
            return Err(Error::new(format!(
                "frame {} belongs to no configuration of the plan",
                record.file
            ))
            .with_hint("journal.jsonl and plan.toml are not of the same session"));
        }
    }
    let missing = |kind| !records.iter().any(|r| r.kind == kind);
    for (kind, name) in [
        (FrameKind::Sample, "sample"),
        (FrameKind::White, "white"),
        (FrameKind::Dark, "dark"),
    ] {
        if missing(kind) {
            return Err(Error::new(format!("the session has no {name} frames")).with_hint(
                "a session needs sample frames, white frames, and dark frames of every exposure",
            ));
        }
    }
    Ok(())
}

/// The box around all crops.
fn union(coverages: &[Coverage]) -> [usize; 4] {
    let start = [usize::MAX, usize::MAX, 0, 0];
    coverages.iter().map(Coverage::bounds).fold(start, |a, b| {
        [
            a[0].min(b[0]),
            a[1].min(b[1]),
            a[2].max(b[2]),
            a[3].max(b[3]),
        ]
    })
}

fn read_configuration(
    loader: &Loader<'_>,
    records: &[FrameRecord],
    configuration: &Configuration,
    coverage: &Coverage,
    darks: &Darks,
    white: &White,
    options: &MeasureOptions,
) -> Result<Reading> {
    let own: Vec<&FrameRecord> = records
        .iter()
        .filter(|r| r.kind == FrameKind::Sample && r.config == Some(configuration.id))
        .collect();
    let region = Region::new(coverage.pixels(), darks.width, darks.cfa, &darks.hot);
    let (stacks, cells) = read_stacks(loader, &own, &region, darks, options.usable_fraction)?;
    let usable = || stacks.iter().filter(|s| s.clipped == 0);
    let saturated = match (usable().next(), stacks.first()) {
        (None, Some(shortest)) => {
            let [left, top, right, bottom] = coverage.bounds();
            Some(format!(
                "saturated: {} of {} pixels of {} are too bright (crop in columns {left} to {right}, rows {top} to {bottom})",
                shortest.clipped,
                region.pixels.len(),
                shortest.title
            ))
        }
        _ => None,
    };
    Ok(Reading {
        configuration: *configuration,
        area_px: coverage.area(),
        sums: usable().map(|s| exposure_sums(&region, s, white)).collect(),
        texture: usable()
            .last()
            .map(|s| Texture::measure(&region, s, white))
            .unwrap_or_default(),
        cells,
        saturated,
        captured: !own.is_empty(),
    })
}

fn noise_report(cells: &[Cell], white: &White, darks: &Darks) -> Result<NoiseReport> {
    let residuals = white.residual_cells();
    let (cells, source) = if cells.is_empty() {
        (&residuals[..], "white residuals")
    } else {
        (cells, "frame pairs")
    };
    let (slope, se) = noise::slope(cells).ok_or_else(|| {
        Error::new("the noise of the frames cannot be estimated")
            .with_hint("take every shot twice, or at two exposures that are not saturated")
    })?;
    Ok(NoiseReport {
        variance_per_signal: slope,
        variance_per_signal_se: se,
        source,
        cells: cells.len(),
        dark_sigma: darks
            .masters
            .iter()
            .map(|d| (d.exposure_ms, d.variance.sqrt()))
            .collect(),
    })
}

fn warnings(darks: &Darks, noise: &NoiseReport, white: &White, a: f64) -> Vec<String> {
    let mut warnings = Vec::new();
    if darks.masters.iter().any(|d| !d.from_repeats) {
        warnings.push(
            "only one dark frame of some exposure: its read noise is the scatter over pixels"
                .to_owned(),
        );
    }
    if noise.source == "white residuals" {
        warnings.push(
            "no two frames show the same thing unsaturated: shot noise is the scatter of the white panel's image"
                .to_owned(),
        );
    }
    let worst = white
        .report(a)
        .chi_square_per_pixel
        .into_iter()
        .fold(0.0, f64::max);
    if worst > 1.5 {
        warnings.push(format!(
            "the white panel is uneven: its image scatters {:.1} times as much as noise explains; standard errors are widened",
            worst.sqrt()
        ));
    }
    warnings
}

/// Combines the exposures of one configuration by inverse variance.
fn reduce(
    reading: &Reading,
    white: &White,
    manifest: &Manifest,
    a: f64,
    options: &MeasureOptions,
) -> Result<(Option<Intensity>, ConfigurationReport)> {
    let id = reading.configuration.id;
    let mut report = ConfigurationReport {
        config: id,
        condition: Condition::Good,
        measured: false,
        message: None,
        exposures_ms: reading.sums.iter().map(|s| s.exposure_ms).collect(),
        area_px: reading.area_px,
        budget: [Budget::default(); 3],
    };
    if !reading.captured {
        report.condition = Condition::NotCaptured;
        report.message = Some(format!(
            "configuration {id}: the journal has no frame of it"
        ));
        return Ok((None, report));
    }
    if let Some(saturated) = &reading.saturated {
        report.condition = Condition::Saturated;
        report.message = Some(format!("configuration {id} is {saturated}"));
        return Ok((None, report));
    }
    let mut mean = [0.0; 3];
    for channel in 0..3 {
        let factor_se = manifest.white.reflectance_factor_se[channel]
            / manifest.white.reflectance_factor[channel];
        let sums: Vec<&ChannelSums> = reading.sums.iter().map(|s| &s.channels[channel]).collect();
        check_dark(reading, channel, a)?;
        let (value, mut budget) = combine(&sums, white, channel, a);
        budget.sampling = reading.texture.variance(channel, a).sqrt();
        budget.reference = value.abs() * factor_se;
        mean[channel] = value;
        report.budget[channel] = budget;
        if !value.is_finite() || !budget.total().is_finite() {
            return Err(Error::new(format!(
                "configuration {id}: channel {channel} came out as {value} +- {}",
                budget.total()
            )));
        }
    }
    report.measured = mean.iter().all(|&m| m > 0.0);
    let noisy = (0..3).any(|c| report.budget[c].noise() > options.underexposed * mean[c]);
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
    });
    Ok((intensity, report))
}

/// One channel's mean over all usable exposures, and its budget without sampling and reference.
fn combine(sums: &[&ChannelSums], white: &White, channel: usize, a: f64) -> (f64, Budget) {
    let weights: Vec<f64> = sums.iter().map(|s| 1.0 / variance(s, a)).collect();
    let total: f64 = weights.iter().sum();
    let (mut value, mut shot, mut read, mut dark) = (0.0, 0.0, 0.0, 0.0);
    let mut phi = [0.0; TERMS];
    for (s, weight) in sums.iter().zip(&weights) {
        let w = weight / total;
        value += w * s.mean;
        shot += w * w * a * s.shot.max(0.0);
        read += w * w * s.read;
        dark += w * w * s.dark;
        for (p, t) in phi.iter_mut().zip(&s.white) {
            *p += w * t;
        }
    }
    let budget = Budget {
        shot: shot.sqrt(),
        read: read.sqrt(),
        dark: dark.sqrt(),
        white: white.variance(channel, &phi, a).sqrt(),
        ..Budget::default()
    };
    (value, budget)
}

fn variance(sums: &ChannelSums, a: f64) -> f64 {
    a * sums.shot.max(0.0) + sums.read + sums.dark
}

/// Fails when a frame is darker than its dark by more than noise explains.
fn check_dark(reading: &Reading, channel: usize, a: f64) -> Result<()> {
    for exposure in &reading.sums {
        let sums = &exposure.channels[channel];
        let deviation = sums.mean / variance(sums, a).sqrt();
        if deviation < -6.0 {
            return Err(Error::new(format!(
                "configuration {}, {} ms: the dark frame is brighter than the sample frame ({:.1} standard errors, {})",
                reading.configuration.id,
                exposure.exposure_ms,
                -deviation,
                ["red", "green", "blue"][channel]
            ))
            .with_hint("was the light on for the dark frames, or did the sensor warm up? take darks again"));
        }
    }
    Ok(())
}
