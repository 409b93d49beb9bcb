//! How much raw values scatter, from the session's own frames (photon transfer).
//!
//! `variance = a signal + dark_variance`: the dark variance comes from dark frames, the slope `a` (raw values squared per
//! raw value, 1 / gain in electrons per raw value) from pairs of frames of the same thing, where the texture cancels. Not
//! modeled: a gain that differs between channels, and unequal pixels (their pattern repeats and cancels in pairs).

use super::frames::same_exposure;
use super::stack::Target;
use crate::session::{Filter, Layout};
use serde::Serialize;

/// One frame's linear raw values less the dark, on a window.
pub(super) struct Sample {
    pub(super) exposure_ms: f64,
    pub(super) filter: Option<Filter>,
    pub(super) values: Vec<f32>,
    pub(super) dark_variance: f64,
    pub(super) dark_count: f64,
}

/// How numbers scatter: within a frame and from frame to frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Scatter {
    /// Slope of the photon transfer by channel, raw values.
    pub(super) slope: [f64; 3],
    /// Relative standard deviation of a frame's brightness (lamp, shutter) beyond the noise of its pixels.
    pub(super) between_frames: f64,
}

/// One estimate of the slope from n pixels: `mean square = a x + constant`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Cell {
    pub(super) x: f64,
    /// What was found less the constant.
    pub(super) y: f64,
    pub(super) constant: f64,
    pub(super) n: f64,
}

/// Where the noise of the session is known from.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NoiseReport {
    /// Shot noise: variance per signal, raw values (1 / gain in electrons per raw value), r, g, b.
    pub variance_per_signal: [f64; 3],
    /// Its standard error.
    pub variance_per_signal_se: [f64; 3],
    /// `calibration`, `frame pairs` or, when there are none, `white residuals` (which count unequal pixels and a textured
    /// panel as noise).
    pub source: &'static str,
    /// Estimates combined.
    pub cells: usize,
    /// Exposure, milliseconds, and standard deviation of a raw value without light, for each dark exposure.
    pub dark_sigma: Vec<(f64, f64)>,
}

/// Compares two frames of the same thing: with `k` the ratio of their mean signals, `d = s_1 - k s_2` has mean zero in
/// every pixel, whatever the texture, and variance
///
/// ```text
/// a (S_1 + k^2 S_2) + r_1^2 + k^2 r_2^2 + variance of the darks subtracted
/// ```
///
/// One cell per place of the layout; none where the signal drowns in the dark's scatter.
pub(super) fn pair_cells(first: &Sample, second: &Sample, target: &Target<'_>) -> Vec<Cell> {
    if first.filter != second.filter {
        return Vec::new();
    }
    let window = &target.window;
    let channels = match window.layout {
        // Its values stand for all channels alike.
        Layout::Mono => 0..1,
        Layout::Bayer(_) | Layout::Rgb => 0..3,
    };
    let mut sums = [[0.0f64; 6]; 4];
    for value in channels.flat_map(|c| &target.weights.channels[c]) {
        let i = value.index;
        let (p, q) = (f64::from(first.values[i]), f64::from(second.values[i]));
        let sum = &mut sums[window.place(i)];
        for (s, v) in sum.iter_mut().zip([1.0, p, q, p * p, p * q, q * q]) {
            *s += v;
        }
    }
    let same = same_exposure(first.exposure_ms, second.exposure_ms);
    sums.iter()
        .filter_map(|&[n, p, q, pp, pq, qq]| {
            let (mean_1, mean_2) = (p / n, q / n);
            if n < 30.0
                || mean_1 < 2.0 * first.dark_variance.sqrt()
                || mean_2 < 2.0 * second.dark_variance.sqrt()
            {
                return None;
            }
            let k = mean_1 / mean_2;
            let difference = (pp - 2.0 * k * pq + k * k * qq) / (n - 1.0);
            let darks = if same {
                (1.0 - k).powi(2) * first.dark_variance / first.dark_count
            } else {
                first.dark_variance / first.dark_count
                    + k * k * second.dark_variance / second.dark_count
            };
            let constant = first.dark_variance + k * k * second.dark_variance + darks;
            Some(Cell {
                x: mean_1 + k * k * mean_2,
                y: difference - constant,
                constant,
                n,
            })
        })
        .collect()
}

/// The slope of all cells (weighted least squares through the origin) and its standard error; none without cells. A cell's
/// variance `2 (a x + constant)^2 / n` is taken at the slope of the round before, not from what it happened to scatter.
pub(super) fn slope(cells: &[Cell]) -> Option<(f64, f64)> {
    let sum = |of: fn(&Cell) -> f64| cells.iter().map(of).sum::<f64>();
    let mut slope = (sum(|c| c.y) / sum(|c| c.x)).max(0.0);
    let mut information = 0.0;
    for _ in 0..6 {
        let mut xy = 0.0;
        information = 0.0;
        for cell in cells {
            let weight = 0.5 * cell.n / (slope * cell.x + cell.constant).powi(2);
            xy += weight * cell.x * cell.y;
            information += weight * cell.x * cell.x;
        }
        slope = (xy / information).max(0.0);
    }
    let known = slope.is_finite() && information > 0.0;
    known.then(|| (slope, (1.0 / information).sqrt()))
}
