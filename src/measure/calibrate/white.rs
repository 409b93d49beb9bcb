//! The white standard: raw values per normalized radiance and millisecond.
//!
//! ```text
//! responsivity = [L(p) - L(dark)] / response / (t factor cos(theta_light))
//! ```
//!
//! with brackets for the mean over the projected sample square, weighted by covered area. The lamp's brightness is part of
//! it: it holds for the lamp as it was.

use super::darks::{Darks, wanted};
use super::least_squares::excess_variance;
use super::patch::{NAMES, Patch};
use super::readings::{Reading, Rules, check_not_all_clipped};
use super::recording::Recording;
use super::transfer::Noise;
use super::{Calibrated, WhiteOptions};
use crate::base::{Context, Error, Result, Watch};
use crate::measure::calibration::{Calibrations, Dated, FlatField, Kind, Linearity, WhiteStandard};
use crate::measure::linear::Curve;
use crate::session::{FrameKind, Projection, SessionFolder};

/// Frames may differ in rate by this much, relative.
const TOLERANCE: f64 = 0.005;

/// The responsivity, from the white standard at the session's reference geometry.
///
/// # Errors
/// Every white is clipped, no dark, the panel's factor is not known at this geometry; a frame is missing, torn, changed or
/// of another camera or sensitivity.
pub fn white(
    session: &SessionFolder,
    known: &Calibrations,
    options: &WhiteOptions,
    watch: &dyn Watch,
) -> Result<Calibrated<WhiteStandard>> {
    let recording = Recording::open(session)?;
    let manifest = &recording.manifest;
    let pose = manifest.white.configuration;
    let (factor, factor_se) = options.factor.at(&manifest.white)?;
    let whites = recording.need(
        FrameKind::White,
        "shoot the white standard at the reference geometry, twice at some exposures, and darks of them",
    )?;
    let dark_frames = wanted(&recording, &whites);
    let frames = [&dark_frames[..], &whites[..]].concat();
    let (reader, first) = recording.reader(&frames, watch)?;
    drop(first);
    let coverage = Projection::new(&manifest.camera, &pose)
        .coverage(manifest.sample_square_mm)
        .context(|| "the white's geometry")?;
    let mut patch = Patch::covered(&reader, &coverage);
    let darks = Darks::read(&reader, &dark_frames, &mut patch, &whites, known)?;
    let linearity = known.linearity.as_ref().map(|d| &d.value);
    let response = known.flat.as_ref().map(|d| &d.value);
    let rules = Rules {
        patch: &patch,
        darks: &darks,
        curve: &Curve::known(linearity, darks.bias),
        response,
        limit: super::USABLE_FRACTION * reader.white,
    };
    let (readings, points) = rules.read(&reader, &whites)?;
    check_not_all_clipped(&readings, &patch, rules.limit)?;
    let noise = Noise::known(linearity, &points, &darks)?;
    let rates = rates(&readings, &noise, &patch)?;
    let cosine = pose.light.theta.cos();
    let (mut responsivity, mut responsivity_se) = ([0.0; 3], [0.0; 3]);
    for c in 0..3 {
        let rate = &rates.channels[c];
        let curve = linearity.map_or(0.0, |l| curve_variance(l, rate.level));
        let flat = response.map_or(0.0, |f| response_variance(f, &patch, c));
        let relative = rate.relative_variance + curve + flat + (factor_se[c] / factor[c]).powi(2);
        responsivity[c] = rate.rate / (factor[c] * cosine);
        responsivity_se[c] = responsivity[c] * relative.sqrt();
    }
    let (warnings, faults) = said(&readings, &rates, known);
    Ok(Calibrated {
        dated: Dated {
            header: recording.header(Kind::White),
            value: WhiteStandard {
                panel: options.panel.clone(),
                light_theta_deg: pose.light.theta.to_degrees(),
                light_phi_deg: pose.light.phi.to_degrees(),
                camera_theta_deg: pose.camera.theta.to_degrees(),
                camera_phi_deg: pose.camera.phi.to_degrees(),
                reflectance_factor: factor,
                reflectance_factor_se: factor_se,
                responsivity,
                responsivity_se,
            },
        },
        warnings,
        faults,
    })
}

/// One channel's rate over all frames that are not clipped.
#[derive(Debug, Clone, Copy, Default)]
struct Rate {
    /// Linear raw values per millisecond.
    rate: f64,
    /// From noise, darks and unsteady light.
    relative_variance: f64,
    /// Mean raw value less bias of its frames.
    level: f64,
}

struct Rates {
    channels: [Rate; 3],
    /// Relative standard deviation of a frame's brightness beyond noise.
    scatter: f64,
    /// Largest deviation of an exposure's rate, and that exposure.
    worst: (f64, f64),
}

/// One frame's rate in one channel: exposure, rate, its variance, level.
type Single = (f64, f64, f64, f64);

fn rates(readings: &[Reading], noise: &Noise, patch: &Patch) -> Result<Rates> {
    let singles = [0, 1, 2].map(|c| -> Vec<Single> {
        let single = |r: &Reading| {
            let (t, s) = (r.frame.record.exposure_ms, r.usable(c)?);
            let variance = s.own_variance(noise, c) + s.dark_variance();
            Some((t, s.signal / t, variance / (t * t), s.level))
        };
        readings.iter().filter_map(single).collect()
    });
    for (c, list) in singles.iter().enumerate() {
        if list.is_empty() || mean(list, 0.0).0 <= 0.0 {
            return Err(Error::new(format!(
                "{} of the white standard is clipped or not brighter than the dark in every frame ({})",
                NAMES[c],
                patch.region()
            ))
            .with_hint("shoot the white at exposures from a tenth to nine tenths of the white level, light on"));
        }
    }
    let freedom = singles.iter().map(|l| l.len() - 1).sum();
    let excess = excess_variance(freedom, 1.0, |v| singles.iter().map(|l| mean(l, v).2).sum());
    let mut worst = (0.0_f64, 0.0);
    for list in &singles {
        let (rate, _, _) = mean(list, excess);
        for group in list.chunk_by(|a, b| crate::measure::frames::same_exposure(a.0, b.0)) {
            let (own, variance, _) = mean(group, 0.0);
            let off = own / rate - 1.0;
            if off.abs() > worst.0.abs() && off.abs() > 4.0 * variance.sqrt() / rate {
                worst = (off, group[0].0);
            }
        }
    }
    let channels = singles.each_ref().map(|list| {
        let (rate, variance, _) = mean(list, excess);
        Rate {
            rate,
            relative_variance: variance / (rate * rate),
            level: list.iter().map(|s| s.3).sum::<f64>() / list.len() as f64,
        }
    });
    Ok(Rates {
        channels,
        scatter: excess.sqrt(),
        worst,
    })
}

/// Mean by inverse variance, its variance, and chi-square; frames scatter by this relative variance beyond their noise.
fn mean(list: &[Single], excess: f64) -> (f64, f64, f64) {
    let plain = list.iter().map(|s| s.1).sum::<f64>() / list.len() as f64;
    let weight = |s: &Single| 1.0 / (s.2 + excess * plain * plain);
    let total: f64 = list.iter().map(weight).sum();
    let mean = list.iter().map(|s| weight(s) * s.1).sum::<f64>() / total;
    let chi_square = list.iter().map(|s| weight(s) * (s.1 - mean).powi(2)).sum();
    (mean, 1.0 / total, chi_square)
}

/// Relative variance of the linear value at this level from the curve's coefficients.
fn curve_variance(linearity: &Linearity, level: f64) -> f64 {
    let curve = Curve::known(Some(linearity), linearity.bias);
    let slopes = curve.by_coefficients(level);
    let pairs = slopes.iter().zip(&linearity.covariance);
    let variance: f64 = pairs
        .map(|(a, row)| a * row.iter().zip(&slopes).map(|(v, b)| v * b).sum::<f64>())
        .sum();
    variance / curve.at(level).powi(2)
}

/// Relative variance of the patch's mean from the flat field.
fn response_variance(flat: &FlatField, patch: &Patch, channel: usize) -> f64 {
    let (mut sum, mut total) = (0.0, 0.0);
    for spot in patch.spots().filter(|s| s.weight > 0.0) {
        if patch.channels(None, spot.place).contains(&channel) {
            let relative = f64::from(flat.response_se[spot.index] / flat.response[spot.index]);
            sum += (spot.weight * relative).powi(2);
            total += spot.weight;
        }
    }
    sum / (total * total) + flat.uniformity_se.powi(2)
}

fn said(readings: &[Reading], rates: &Rates, known: &Calibrations) -> (Vec<String>, Vec<String>) {
    let mut warnings = Vec::new();
    if known.linearity.is_none() {
        warnings
            .push("no linearity calibration is known: raw values are taken as linear".to_owned());
    }
    if known.flat.is_none() {
        warnings.push(
            "no flat field is known: the responsivity is that of the square's mean, vignetting included"
                .to_owned(),
        );
    }
    let mut faults = Vec::new();
    let clipped = |r: &&Reading| r.channels.iter().flatten().any(|s| s.clipped > 0);
    let lost = readings.iter().filter(clipped).count();
    if lost > 0 && readings.len() - lost < 2 {
        faults.push(format!(
            "the panel is clipped in {lost} of {} frames: fewer than two are left; shoot shorter exposures",
            readings.len()
        ));
    } else if lost > 0 {
        warnings.push(format!(
            "the panel is clipped in {lost} of {} frames: those are left out",
            readings.len()
        ));
    }
    if rates.worst.0.abs() > TOLERANCE {
        faults.push(format!(
            "the exposures of the white standard disagree: {} ms is off by {:+.2} % (tolerance {} %, scatter of frames {:.2} %); is the light steady, the curve known?",
            rates.worst.1,
            100.0 * rates.worst.0,
            100.0 * TOLERANCE,
            100.0 * rates.scatter
        ));
    }
    (warnings, faults)
}
