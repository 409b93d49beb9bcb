//! A session's frames to its intensities.

use super::crop::{ChannelSums, ExposureSums, Texture, exposure_sums};
use super::dark::Darks;
use super::frames::{Loader, Region, Taken, taken};
use super::lamp::{Lamp, Level};
use super::noise::{self, Cell, NoiseReport};
use super::report::{Budget, Condition, ConfigurationReport, MeasureOptions, MeasureReport};
use super::stack::{Stack, read_stacks};
use super::visit::read_lamp;
use super::white::{TERMS, White};
use crate::base::{Context, Error, Result, Watch};
use crate::session::{
    Configuration, Coverage, Event, FrameKind, Intensity, Manifest, Measurements, Projection,
    SessionFolder, read_journal,
};
use rayon::prelude::*;

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
    let journal = read_journal(&session.journal_path())?;
    let finished = journal.iter().any(|e| e.event == Event::Finished);
    let frames = taken(journal);
    check_frames(&frames, finished, |id| plan.configuration(id).is_some())?;
    let coverages = plan
        .configurations
        .iter()
        .map(|c| Projection::new(&manifest.camera, c).coverage(manifest.sample_square_mm))
        .collect::<Result<Vec<_>>>()?;
    let loader = Loader::new(session, &manifest, &frames, watch)?;
    let of_kind = |kind: FrameKind| -> Vec<&Taken> {
        frames.iter().filter(|f| f.record.kind == kind).collect()
    };
    let darks = Darks::read(&loader, &of_kind(FrameKind::Dark), options.hot_sigma)?;
    let references = of_kind(FrameKind::Reference);
    let (mut lamp, mut cells) = follow_lamp(&loader, &manifest, &references, &darks, options)?;
    let whites = of_kind(FrameKind::White);
    lamp.note_white(&whites);

    let bounds = union(&coverages, darks.size);
    let white_region = Region::whole_box(bounds, darks.size[0], darks.cfa, &darks.hot);
    let (white_stacks, white_cells) = read_stacks(
        &loader,
        &whites,
        &white_region,
        &darks,
        &lamp,
        options.usable_fraction,
    )?;
    cells.extend(white_cells);
    let white = White::fit(&manifest, &white_region, bounds, &white_stacks)?;
    drop(white_stacks);

    let readings: Vec<Result<Reading>> = plan
        .configurations
        .par_iter()
        .zip(&coverages)
        .map(|(c, coverage)| {
            let own =
                |f: &&Taken| f.record.kind == FrameKind::Sample && f.record.config == Some(c.id);
            let own: Vec<&Taken> = frames.iter().filter(own).collect();
            let region = Region::covered(coverage, darks.size, darks.cfa, &darks.hot);
            let (stacks, cells) = read_stacks(
                &loader,
                &own,
                &region,
                &darks,
                &lamp,
                options.usable_fraction,
            )?;
            Ok(Reading::of(c, coverage, &region, &stacks, cells, &white))
        })
        .collect();
    let readings = readings.into_iter().collect::<Result<Vec<_>>>()?;

    cells.extend(readings.iter().flat_map(|r| &r.cells));
    let noise = noise_report(&cells, &white, &darks)?;
    let a = noise.variance_per_signal;
    let mut intensities = Vec::new();
    let mut reports = Vec::new();
    for reading in &readings {
        let (intensity, report) = reduce(reading, &white, &lamp, &manifest, a, options)?;
        intensities.extend(intensity);
        reports.push(report);
    }
    let mut warnings = warnings(&darks, &noise, &white, a);
    let lit = frames.iter().filter(|f| f.record.kind != FrameKind::Dark);
    warnings.extend(lamp.warnings(lit.map(|f| f.moment)));
    let report = MeasureReport {
        synthetic: manifest.synthetic,
        warnings,
        lamp: lamp.report(a),
        white: white.report(a),
        noise,
        hot_pixels: darks.hot.iter().filter(|&&h| h).count(),
        frames: frames.len(),
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

fn check_frames(frames: &[Taken], finished: bool, known: impl Fn(u32) -> bool) -> Result<()> {
    let records = || frames.iter().map(|f| &f.record);
    for record in records().filter(|r| r.kind == FrameKind::Sample) {
        if !record.config.is_some_and(&known) {
            return Err(Error::new(format!(
                "frame {} belongs to no configuration of the plan",
                record.file
            ))
            .with_hint("journal.jsonl and plan.toml are not of the same session"));
        }
    }
    for kind in [FrameKind::Sample, FrameKind::White, FrameKind::Dark] {
        if !records().any(|r| r.kind == kind) {
            return Err(Error::new(format!(
                "the session has no {} frames",
                kind.name()
            ))
            .with_hint(if finished {
                "a session needs sample frames, white frames, and dark frames of every exposure used"
            } else {
                "the capture did not finish: go on with it (`goniofit capture --resume DIR`), then measure"
            }));
        }
    }
    Ok(())
}

/// Follows the lamp over the visits of the reference pose, if there are any.
fn follow_lamp(
    loader: &Loader<'_>,
    manifest: &Manifest,
    references: &[&Taken],
    darks: &Darks,
    options: &MeasureOptions,
) -> Result<(Lamp, Vec<Cell>)> {
    if references.is_empty() {
        return Ok((Lamp::default(), Vec::new()));
    }
    let coverage = Projection::new(&manifest.camera, &manifest.white.configuration)
        .coverage(manifest.sample_square_mm)
        .context(|| "reference geometry")?;
    let region = Region::covered(&coverage, darks.size, darks.cfa, &darks.hot);
    read_lamp(loader, references, &region, darks, options.usable_fraction)
}

/// The box around all crops and the pixels next to them.
fn union(coverages: &[Coverage], [width, height]: [usize; 2]) -> [usize; 4] {
    let start = [usize::MAX, usize::MAX, 0, 0];
    let [left, top, right, bottom] = coverages.iter().map(Coverage::bounds).fold(start, |a, b| {
        [
            a[0].min(b[0]),
            a[1].min(b[1]),
            a[2].max(b[2]),
            a[3].max(b[3]),
        ]
    });
    [
        left.saturating_sub(1),
        top.saturating_sub(1),
        (right + 1).min(width),
        (bottom + 1).min(height),
    ]
}

impl Reading {
    fn of(
        configuration: &Configuration,
        coverage: &Coverage,
        region: &Region,
        stacks: &[Stack],
        cells: Vec<Cell>,
        white: &White,
    ) -> Self {
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
        Self {
            configuration: *configuration,
            area_px: coverage.area(),
            sums: usable().map(|s| exposure_sums(region, s, white)).collect(),
            texture: usable()
                .next_back()
                .map(|s| Texture::measure(region, s, white))
                .unwrap_or_default(),
            cells,
            saturated,
            captured: !stacks.is_empty(),
        }
    }
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
    lamp: &Lamp,
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
    for (channel, mean) in mean.iter_mut().enumerate() {
        let factor_se = manifest.white.reflectance_factor_se[channel]
            / manifest.white.reflectance_factor[channel];
        check_dark(reading, channel, a)?;
        let (value, mut budget) = combine(&reading.sums, white, lamp, channel, a);
        budget.sampling = reading.texture.variance(channel, a).sqrt();
        budget.reference = value.abs() * factor_se;
        *mean = value;
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
fn combine(
    exposures: &[ExposureSums],
    white: &White,
    lamp: &Lamp,
    channel: usize,
    a: f64,
) -> (f64, Budget) {
    let sums = || exposures.iter().map(|e| &e.channels[channel]);
    let weights: Vec<f64> = sums().map(|s| 1.0 / variance(s, a)).collect();
    let total: f64 = weights.iter().sum();
    let (mut value, mut shot, mut read, mut dark) = (0.0, 0.0, 0.0, 0.0);
    let mut phi = [0.0; TERMS];
    for (s, weight) in sums().zip(&weights) {
        let w = weight / total;
        value += w * s.mean;
        shot += w * w * a * s.shot.max(0.0);
        read += w * w * s.read;
        dark += w * w * s.dark;
        for (p, t) in phi.iter_mut().zip(&s.white) {
            *p += w * t;
        }
    }
    let levels = exposures.iter().zip(&weights);
    let levels: Vec<(f64, &Level)> = levels.map(|(e, w)| (w / total, &e.level)).collect();
    let white_levels: Vec<(f64, &Level)> = white.levels.iter().map(|(w, l)| (*w, l)).collect();
    let drift = lamp.relative_variance(&levels, &white_levels, channel, a);
    let budget = Budget {
        shot: shot.sqrt(),
        read: read.sqrt(),
        dark: dark.sqrt(),
        white: white.variance(channel, &phi, a).sqrt(),
        drift: value.abs() * drift.sqrt(),
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
                "{}: the dark frame is brighter than the sample frame ({:.1} standard errors, {})",
                exposure.title,
                -deviation,
                ["red", "green", "blue"][channel]
            ))
            .with_hint(
                "was the light on for the dark frames, or did the sensor warm up? take darks again",
            ));
        }
    }
    Ok(())
}
