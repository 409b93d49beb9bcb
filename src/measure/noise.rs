//! How much raw values scatter, from the session's own frames (photon transfer).
//!
//! `variance = a signal + dark_variance`: the dark variance comes from dark frames, the slope `a` (raw values squared per
//! raw value, 1 / gain in electrons per raw value) from pairs of frames of the same thing, where the texture cancels. Not
//! modeled: a gain that differs between channels, and unequal pixels (their pattern repeats and cancels in pairs).

use super::frames::{Region, same_exposure};
use serde::Serialize;

/// One frame's dark-subtracted raw values on a region.
pub(super) struct Sample {
    pub(super) exposure_ms: f64,
    pub(super) values: Vec<f64>,
    pub(super) dark_variance: f64,
    pub(super) dark_count: f64,
}

/// One estimate of the slope: `y = a x`, with the variance of y.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Cell {
    pub(super) x: f64,
    pub(super) y: f64,
    pub(super) variance: f64,
}

/// Where the noise of the session is known from.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NoiseReport {
    /// Shot noise: variance per signal, raw values (1 / gain in electrons per raw value).
    pub variance_per_signal: f64,
    /// Its standard error.
    pub variance_per_signal_se: f64,
    /// `frame pairs` or, when there are none, `white residuals` (which count unequal pixels and a textured panel as noise).
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
/// One cell per place of the 2x2 block; none where the signal drowns in the dark's scatter.
pub(super) fn pair_cells(first: &Sample, second: &Sample, region: &Region) -> Vec<Cell> {
    let mut sums = [[0.0f64; 6]; 4];
    for (i, pixel) in region.pixels.iter().enumerate() {
        let (p, q) = (first.values[i], second.values[i]);
        let sum = &mut sums[pixel.place];
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
            Some(Cell {
                x: mean_1 + k * k * mean_2,
                y: difference - first.dark_variance - k * k * second.dark_variance - darks,
                variance: 2.0 * difference * difference / n,
            })
        })
        .collect()
}

/// The slope of all cells (weighted least squares through the origin) and its standard error; none without cells.
pub(super) fn slope(cells: &[Cell]) -> Option<(f64, f64)> {
    let (mut xy, mut xx) = (0.0, 0.0);
    for cell in cells.iter().filter(|c| c.variance > 0.0) {
        xy += cell.x * cell.y / cell.variance;
        xx += cell.x * cell.x / cell.variance;
    }
    (xx > 0.0).then(|| ((xy / xx).max(0.0), (1.0 / xx).sqrt()))
}
