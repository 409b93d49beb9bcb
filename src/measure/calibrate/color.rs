//! From the camera's red, green, blue to a stated color space, from a chart of known patches in the sample's place.
//!
//! ```text
//! reference cos(theta_light) = matrix camera,   camera = normalized radiance of a patch by channel
//! ```
//!
//! by least squares over the patches, row by row; the weights are one over the variance of `matrix camera` plus that of
//! what no matrix explains (the camera's filters are no mixtures of the eye's), which is estimated along. Light is taken as
//! even across the chart, and references as exact: their errors are part of what is not explained.

use super::chart::Chart;
use super::chart_rates::{Mean, Rates};
use super::least_squares::{Normal, Solution, excess_variance};
use super::patch::NAMES;
use super::recording::Recording;
use super::white::white;
use super::{Calibrated, Factor, WhiteOptions};
use crate::base::{Error, Result, Watch};
use crate::measure::calibration::{Calibrations, ColorMatrix, Dated, Kind};
use crate::measure::frames::Taken;
use crate::session::{Configuration, FrameKind, SessionFolder};
use serde::Serialize;
use std::path::PathBuf;

/// The chart, and what its references are.
#[derive(Debug, Clone, PartialEq)]
pub struct ColorOptions {
    /// CSV with the columns `patch`, `x_mm`, `y_mm` (its middle on the sample plane, in the sample frame), `width_mm`,
    /// `height_mm`, and either `r`, `g`, `b` (linear, in `space`) or `X`, `Y`, `Z` (illuminant D65, turned to linear sRGB);
    /// 1: a perfect diffuser.
    pub chart: PathBuf,
    /// Name of the linear space; `srgb` with X, Y, Z.
    pub space: String,
}

/// How the fit went.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ColorReport {
    /// What normalized radiance was taken from.
    pub scale: String,
    /// Every patch of the chart.
    pub patches: Vec<ColorPatch>,
    /// Mean and largest CIE 1976 color difference, for the space `srgb`.
    pub delta_e: Option<[f64; 2]>,
}

/// One patch.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ColorPatch {
    /// Its name.
    pub patch: String,
    /// The camera's normalized radiance over cos(theta_light).
    pub camera: [f64; 3],
    /// Its standard error from the scatter of the pixels.
    pub camera_se: [f64; 3],
    /// What the chart says.
    pub reference: [f64; 3],
    /// What the matrix says.
    pub fitted: [f64; 3],
    /// CIE 1976 color difference, for the space `srgb`.
    pub delta_e: Option<f64>,
}

/// Fewer patches do not make a matrix that can be checked.
const FEWEST: usize = 6;
/// The patches' colors must be less alike than this: by how much their likeness blows up a coefficient's variance.
const MOST_ALIKE: f64 = 3000.0;
/// Residuals above this part of the brightest patch are out of tolerance.
const TOLERANCE: f64 = 0.05;

/// Fits the matrix. docs/calibration.md says how to shoot the chart.
///
/// # Errors
/// The chart cannot be read, has fewer than six patches, or colors too much alike; a patch lies outside the image or is
/// clipped in every frame; there are neither whites nor a white calibration nor neutral patches; no chart frames or no
/// dark of their exposure; a frame is missing, changed or of another camera.
pub fn color(
    session: &SessionFolder,
    known: &Calibrations,
    options: &ColorOptions,
    watch: &dyn Watch,
) -> Result<(Calibrated<ColorMatrix>, ColorReport)> {
    let chart = Chart::read(&options.chart, &options.space)?;
    if chart.patches.len() < FEWEST {
        return Err(Error::new(format!(
            "{} has {} patches, expected {FEWEST} or more",
            options.chart.display(),
            chart.patches.len()
        ))
        .with_hint("a matrix of nine numbers needs a chart with many different colors, 24 say"));
    }
    let recording = Recording::open(session)?;
    let mut warnings = Vec::new();
    let (pose, frames) = chart_frames(&recording, session, &mut warnings)?;
    let rates = Rates::read(&recording, known, &chart, &pose, &frames, watch)?;
    let cosine = pose.light.theta.cos();
    let scale = Scale::find(&recording, session, known, &chart, &rates, cosine, watch)?;
    if known.flat.is_none() {
        warnings.push(
            "no flat field is known: vignetting across the chart goes into the matrix".to_owned(),
        );
    }
    warnings.extend(scale.warning.clone());
    let seen: Vec<[Mean; 3]> = rates
        .patches
        .iter()
        .map(|p| scale.apply(p, cosine))
        .collect();
    let (value, report) = fit(&chart, &seen, &scale, &options.space)?;
    let mut faults = Vec::new();
    for (c, residual) in value.residual.iter().enumerate() {
        if *residual > TOLERANCE {
            faults.push(format!(
                "the matrix misses {} of the patches by {:.1} % of the brightest (tolerance {} %): is the chart's file that of the chart, and in its orientation?",
                NAMES[c],
                100.0 * residual,
                100.0 * TOLERANCE
            ));
        }
    }
    let header = recording.header(Kind::Color);
    let dated = Dated { header, value };
    Ok((
        Calibrated {
            dated,
            warnings,
            faults,
        },
        report,
    ))
}

/// The chart frames of the first configuration that has some.
fn chart_frames(
    recording: &Recording<'_>,
    session: &SessionFolder,
    warnings: &mut Vec<String>,
) -> Result<(Configuration, Vec<Taken>)> {
    let mut frames = recording.need(
        FrameKind::Chart,
        "put a color chart flat in the sample's place and capture chart frames, and darks of their exposures",
    )?;
    let id = frames.iter().filter_map(|f| f.record.config).min();
    let plan = session.plan()?;
    let pose = id.and_then(|id| plan.configuration(id)).ok_or_else(|| {
        Error::new("the chart frames belong to no configuration of the plan")
            .with_hint("journal.jsonl and plan.toml are not of the same session")
    })?;
    let all = frames.len();
    frames.retain(|f| f.record.config == id);
    if frames.len() < all {
        warnings.push(format!(
            "only the chart frames of configuration {} are used, not those of others",
            pose.id
        ));
    }
    Ok((*pose, frames))
}

/// What makes normalized radiance of rates.
struct Scale {
    responsivity: [f64; 3],
    relative_se: [f64; 3],
    source: String,
    warning: Option<String>,
}

impl Scale {
    fn find(
        recording: &Recording<'_>,
        session: &SessionFolder,
        known: &Calibrations,
        chart: &Chart,
        rates: &Rates,
        cosine: f64,
        watch: &dyn Watch,
    ) -> Result<Self> {
        let relative = |r: [f64; 3], se: [f64; 3]| [0, 1, 2].map(|c| se[c] / r[c]);
        if !recording.of(FrameKind::White).is_empty() {
            let options = WhiteOptions {
                panel: String::new(),
                factor: Factor::Session,
            };
            let own = white(session, known, &options, watch)?.dated.value;
            return Ok(Self {
                responsivity: own.responsivity,
                relative_se: relative(own.responsivity, own.responsivity_se),
                source: "the session's white frames".to_owned(),
                warning: None,
            });
        }
        if let Some(white) = &known.white {
            let value = &white.value;
            return Ok(Self {
                responsivity: value.responsivity,
                relative_se: relative(value.responsivity, value.responsivity_se),
                source: format!("the white calibration of {}", white.header.date_utc),
                warning: Some(
                    "the session has no white frames: the lamp is taken to be as bright as when the white was calibrated"
                        .to_owned(),
                ),
            });
        }
        Self::of_neutrals(chart, rates, cosine)
    }

    /// From patches whose references are alike in red, green and blue.
    fn of_neutrals(chart: &Chart, rates: &Rates, cosine: f64) -> Result<Self> {
        let (mut top, mut bottom, mut n) = ([0.0; 3], 0.0, 0);
        for (patch, rate) in chart.patches.iter().zip(&rates.patches) {
            let gray = patch.reference.iter().sum::<f64>() / 3.0;
            let off = patch.reference.map(|r| (r - gray).abs());
            if off.into_iter().fold(0.0, f64::max) < 0.05 * gray {
                n += 1;
                bottom += gray * gray * cosine;
                top = [0, 1, 2].map(|c| top[c] + gray * rate[c].value);
            }
        }
        if n == 0 {
            return Err(Error::new(
                "nothing tells what a white object reads: no white frames, no white calibration, no neutral patch",
            )
            .with_hint("shoot the white standard in the chart's session"));
        }
        let source = format!("the best fit of {n} neutral patches");
        Ok(Self {
            responsivity: top.map(|t| t / bottom),
            relative_se: [0.0; 3],
            warning: Some(format!(
                "the matrix is scaled by {source}, not by a white standard"
            )),
            source,
        })
    }

    /// Rates to normalized radiance over the cosine of the light's angle.
    fn apply(&self, rates: &[Mean; 3], cosine: f64) -> [Mean; 3] {
        [0, 1, 2].map(|c| Mean {
            value: rates[c].value / (self.responsivity[c] * cosine),
            se: rates[c].se / (self.responsivity[c].abs() * cosine),
        })
    }
}

fn fit(
    chart: &Chart,
    seen: &[[Mean; 3]],
    scale: &Scale,
    space: &str,
) -> Result<(ColorMatrix, ColorReport)> {
    check_colors(seen)?;
    let mut matrix = [[0.0; 3]; 3];
    let mut covariance = [[[0.0; 3]; 3]; 3];
    let mut residual = [0.0; 3];
    for row in 0..3 {
        let wanted: Vec<f64> = chart.patches.iter().map(|p| p.reference[row]).collect();
        let solution = fit_row(seen, &wanted).ok_or_else(too_alike)?;
        for c in 0..3 {
            matrix[row][c] = solution.values[c];
            for d in 0..3 {
                covariance[row][c][d] = solution.covariance[c][d];
            }
            // An error of a channel's responsivity scales its column.
            covariance[row][c][c] += (matrix[row][c] * scale.relative_se[c]).powi(2);
        }
        let brightest = wanted.iter().copied().fold(0.0, f64::max);
        let off = seen
            .iter()
            .zip(&wanted)
            .map(|(s, w)| (dot(&matrix[row], s) - w).powi(2));
        residual[row] = (off.sum::<f64>() / seen.len() as f64).sqrt() / brightest;
    }
    let patches: Vec<ColorPatch> = chart
        .patches
        .iter()
        .zip(seen)
        .map(|(patch, seen)| {
            let fitted = [0, 1, 2].map(|row| dot(&matrix[row], seen));
            let delta_e = super::chart::delta_e(space, fitted, patch.reference);
            ColorPatch {
                patch: patch.name.clone(),
                camera: seen.map(|m| m.value),
                camera_se: seen.map(|m| m.se),
                reference: patch.reference,
                fitted,
                delta_e,
            }
        })
        .collect();
    let differences: Vec<f64> = patches.iter().filter_map(|p| p.delta_e).collect();
    let delta_e = (!differences.is_empty()).then(|| {
        let sum: f64 = differences.iter().sum();
        [
            sum / differences.len() as f64,
            differences.iter().copied().fold(0.0, f64::max),
        ]
    });
    let value = ColorMatrix {
        space: space.to_owned(),
        matrix,
        covariance,
        residual,
        patches: patches.len(),
    };
    let report = ColorReport {
        scale: scale.source.clone(),
        patches,
        delta_e,
    };
    Ok((value, report))
}

fn dot(row: &[f64; 3], seen: &[Mean; 3]) -> f64 {
    (0..3).map(|c| row[c] * seen[c].value).sum()
}

/// One row: weights need the row, so it is fitted a few times.
fn fit_row(seen: &[[Mean; 3]], wanted: &[f64]) -> Option<Solution> {
    let solve = |row: Option<&[f64; 3]>, excess: f64| {
        let mut normal = Normal::new(3);
        for (seen, wanted) in seen.iter().zip(wanted) {
            let noise = row.map_or(1.0, |a| (0..3).map(|c| (a[c] * seen[c].se).powi(2)).sum());
            normal.add(&seen.map(|m| m.value), *wanted, noise + excess);
        }
        normal.solve()
    };
    let mut solution = solve(None, 0.0)?;
    let largest = wanted.iter().map(|w| w * w).fold(0.0, f64::max);
    for _ in 0..5 {
        let row = [0, 1, 2].map(|c| solution.values[c]);
        let freedom = seen.len().saturating_sub(3);
        let excess = excess_variance(freedom, largest, |v| {
            solve(Some(&row), v).map_or(0.0, |s| s.chi_square)
        });
        solution = solve(Some(&row), excess)?;
    }
    Some(solution)
}

/// Fails when the patches' colors do not span the three channels.
fn check_colors(seen: &[[Mean; 3]]) -> Result<()> {
    let mut normal = Normal::new(3);
    for patch in seen {
        normal.add(&patch.map(|m| m.value), 0.0, 1.0);
    }
    let solution = normal.solve().ok_or_else(too_alike)?;
    for c in 0..3 {
        let square: f64 = seen.iter().map(|p| p[c].value * p[c].value).sum();
        let alike = solution.covariance[c][c] * square;
        if alike.is_nan() || alike > MOST_ALIKE {
            return Err(too_alike());
        }
    }
    Ok(())
}

fn too_alike() -> Error {
    Error::new("the patches' colors are too much alike to tell the nine numbers of a matrix")
        .with_hint("use a chart with saturated reds, greens and blues, not grays alone")
}
