//! The curve that makes signals proportional to exposures: generalized least squares.

use super::least_squares::{Normal, Solution, cholesky, excess_variance, forward};
use super::patch::NAMES;
use crate::base::{Error, Result};
use crate::measure::calibration::LinearityPoint;
use crate::measure::frames::same_exposure;
use crate::measure::linear::Curve;

/// The corrected signal may be off from proportionality by this much.
const TOLERANCE: f64 = 0.003;

/// Fewer exposures say nothing of a curve.
pub(super) const FEWEST_EXPOSURES: usize = 5;

/// One exposure: its channels that are not clipped in any frame.
#[derive(Debug, Clone)]
pub(super) struct Group {
    pub(super) exposure_ms: f64,
    pub(super) channels: Vec<Channel>,
}

/// One channel of one exposure, averaged over frames.
#[derive(Debug, Clone, Copy)]
pub(super) struct Channel {
    pub(super) channel: usize,
    pub(super) powers: [f64; 4],
    pub(super) level: f64,
    /// Exposed time by the lamp's level, milliseconds.
    pub(super) time: f64,
    /// Of `powers[0]`.
    pub(super) variance: f64,
    /// How many channels are copies of this one, itself included.
    pub(super) copies: f64,
}

/// A fitted curve.
pub(super) struct Fit {
    order: usize,
    solution: Solution,
    /// Relative variance of the exposed time of one exposure.
    pub(super) jitter: f64,
}

impl Fit {
    pub(super) fn coefficients(&self) -> &[f64] {
        &self.solution.values[..self.order]
    }

    pub(super) fn rate(&self, channel: usize) -> f64 {
        self.solution.values[self.order + channel]
    }

    pub(super) fn covariance(&self) -> Vec<Vec<f64>> {
        let rows = self.solution.covariance[..self.order].iter();
        rows.map(|r| r[..self.order].to_vec()).collect()
    }

    pub(super) fn faults(&self, residuals: &[LinearityPoint]) -> Vec<String> {
        let worst = residuals
            .iter()
            .filter(|p| p.residual.abs() > TOLERANCE + 4.0 * p.signal_se / p.signal)
            .max_by(|a, b| a.residual.abs().total_cmp(&b.residual.abs()));
        let text = |p: &LinearityPoint| {
            format!(
                "the corrected signal is not proportional to the exposure: {} at {} ms is off by {:+.2} % (tolerance {} %); is the light steady, are the exposure times true? (scatter of the exposed time {:.2} %)",
                NAMES[p.channel],
                p.exposure_ms,
                100.0 * p.residual,
                100.0 * TOLERANCE,
                100.0 * self.jitter.sqrt()
            )
        };
        worst.map(text).into_iter().collect()
    }
}

/// Fits, and leaves out the brightest exposures as long as they do not follow the curve.
pub(super) fn fit_where_straight(
    mut groups: Vec<Group>,
    full_scale: f64,
    max_order: usize,
) -> Result<(Vec<Group>, Fit)> {
    groups.sort_by(|a, b| a.exposure_ms.total_cmp(&b.exposure_ms));
    loop {
        let fit = fit(&groups, full_scale, max_order)?;
        let curve = Curve::new(fit.coefficients().to_vec(), full_scale, [0.0; 4]);
        let points = residuals(&groups, &fit, &curve);
        let brightest = groups.last().map_or(0.0, |g| g.exposure_ms);
        let off = points.iter().any(|p| {
            same_exposure(p.exposure_ms, brightest)
                && p.signal > 0.5 * full_scale
                && p.residual.abs() > TOLERANCE + 4.0 * p.signal_se / p.signal
        });
        if !off || groups.len() <= FEWEST_EXPOSURES {
            return Ok((groups, fit));
        }
        groups.pop();
    }
}

/// Always of the highest order the exposures allow: an order chosen by the data would make the covariance too small.
fn fit(groups: &[Group], full_scale: f64, max_order: usize) -> Result<Fit> {
    let order = max_order.min(3).min(groups.len() - 3);
    let jitter = jitter(groups, full_scale, order);
    let solution = solve(groups, full_scale, order, jitter).ok_or_else(|| {
        Error::new("the exposures do not determine the response curve")
            .with_hint("shoot all three channels at exposures from nearly dark to nearly saturated")
    })?;
    Ok(Fit {
        order,
        solution,
        jitter,
    })
}

/// Relative variance of an exposure's exposed time: what the channels' residuals have in common beyond their noise. What
/// they do not share is left aside, since no error of the time explains it.
fn jitter(groups: &[Group], full_scale: f64, order: usize) -> f64 {
    let freedom = groups.len().saturating_sub(order + 1);
    excess_variance(freedom, 0.1, |v| {
        let solution = solve(groups, full_scale, order, v);
        solution.map_or(0.0, |s| common_chi_square(groups, full_scale, order, &s, v))
    })
}

/// Chi-square of the exposures' mean relative residuals over the channels.
fn common_chi_square(
    groups: &[Group],
    full_scale: f64,
    order: usize,
    solution: &Solution,
    jitter: f64,
) -> f64 {
    let curve = Curve::new(solution.values[..order].to_vec(), full_scale, [0.0; 4]);
    let mut chi_square = 0.0;
    for group in groups {
        let (mut sum, mut weights) = (0.0, 0.0);
        for c in &group.channels {
            let found = linear(c, &curve, full_scale);
            let expected = solution.values[order + c.channel] * c.time;
            let se = c.variance.sqrt() * curve.slope(c.level) / expected;
            let weight = 1.0 / (c.copies * se * se);
            sum += weight * (found / expected - 1.0);
            weights += weight;
        }
        chi_square += (sum / weights).powi(2) / (1.0 / weights + jitter);
    }
    chi_square
}

/// Generalized least squares; variances are brought through the curve of the round before.
fn solve(groups: &[Group], full_scale: f64, order: usize, jitter: f64) -> Option<Solution> {
    let mut coefficients = vec![0.0; order];
    let mut found = None;
    for _ in 0..4 {
        let curve = Curve::new(coefficients, full_scale, [0.0; 4]);
        let mut normal = Normal::new(order + 3);
        for group in groups {
            add(&mut normal, group, &curve, full_scale, order, jitter)?;
        }
        let solution = normal.solve()?;
        coefficients = solution.values[..order].to_vec();
        found = Some(solution);
    }
    found
}

/// Adds one exposure: its channels have the exposed time's error in common.
fn add(
    normal: &mut Normal,
    group: &Group,
    curve: &Curve,
    full_scale: f64,
    order: usize,
    jitter: f64,
) -> Option<()> {
    let linear: Vec<f64> = group
        .channels
        .iter()
        .map(|c| linear(c, curve, full_scale))
        .collect();
    let n = linear.len();
    let mut covariance = vec![vec![0.0; n]; n];
    for i in 0..n {
        for j in 0..n {
            covariance[i][j] = jitter * linear[i] * linear[j];
        }
        let c = &group.channels[i];
        covariance[i][i] += c.copies * c.variance * curve.slope(c.level).powi(2);
    }
    let lower = cholesky(&covariance)?;
    let row = |c: &Channel| -> Vec<f64> {
        let mut row = vec![0.0; order + 4];
        for k in 0..order {
            row[k] = -c.powers[k + 1] / full_scale.powi(k as i32 + 1);
        }
        row[order + c.channel] = c.time;
        row[order + 3] = c.powers[0];
        row
    };
    let rows: Vec<Vec<f64>> = group.channels.iter().map(row).collect();
    // Whitened: L^-1 times rows and values.
    let mut columns: Vec<Vec<f64>> = (0..order + 4)
        .map(|k| rows.iter().map(|r| r[k]).collect())
        .collect();
    for column in &mut columns {
        forward(&lower, column);
    }
    for i in 0..n {
        let row: Vec<f64> = columns[..order + 3].iter().map(|c| c[i]).collect();
        normal.add(&row, columns[order + 3][i], 1.0);
    }
    Some(())
}

/// Mean linear signal of a channel.
fn linear(c: &Channel, curve: &Curve, full_scale: f64) -> f64 {
    let coefficients = curve.coefficients().iter().zip(1..);
    let terms = coefficients.map(|(v, k)| v * c.powers[k as usize] / full_scale.powi(k));
    c.powers[0] + terms.sum::<f64>()
}

pub(super) fn residuals(groups: &[Group], fit: &Fit, curve: &Curve) -> Vec<LinearityPoint> {
    let point = |g: &Group, c: &Channel| LinearityPoint {
        exposure_ms: g.exposure_ms,
        channel: c.channel,
        signal: c.powers[0],
        signal_se: c.variance.sqrt(),
        residual: linear(c, curve, curve.full_scale()) / (fit.rate(c.channel) * c.time) - 1.0,
    };
    groups
        .iter()
        .flat_map(|g| g.channels.iter().map(move |c| point(g, c)))
        .collect()
}
