//! Photon transfer: how raw values scatter, from differences of pairs of frames of one thing.
//!
//! In the difference everything that repeats cancels: the texture, unequal pixels, dust, the dark.

use super::darks::{Dark, Darks};
use super::least_squares::{Normal, Solution, chi_square_limit};
use super::patch::{NAMES, Patch};
use crate::base::{Error, Result};
use crate::measure::RawFrame;
use crate::measure::calibration::{Linearity, PhotonTransfer, TransferPoint};
use crate::measure::dark::QUANTIZATION;
use crate::measure::linear::Curve;
use crate::session::Filter;

/// What is known of the noise: `variance = slope signal + read`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Noise {
    /// By channel, raw values.
    pub(super) slope: [f64; 3],
    /// Variance of one raw value without light.
    pub(super) read: f64,
}

impl Noise {
    /// From the calibration, or else from pairs of frames of the session.
    ///
    /// # Errors
    /// There are no pairs either.
    pub(super) fn known(
        linearity: Option<&Linearity>,
        points: &[TransferPoint],
        darks: &Darks,
    ) -> Result<Self> {
        if let Some(l) = linearity {
            let read = l.transfer.read_noise.powi(2).max(QUANTIZATION);
            return Ok(Self {
                slope: l.transfer.variance_per_signal,
                read,
            });
        }
        let variances: Vec<f64> = darks.iter().flat_map(|d| d.variance).collect();
        let read = variances.iter().sum::<f64>() / variances.len().max(1) as f64;
        let slope = [0, 1, 2].map(|c| {
            let (mut top, mut bottom) = (0.0, 0.0);
            for p in points.iter().filter(|p| p.channel == c && p.signal > 0.0) {
                let weight = 1.0 / p.variance_se.powi(2);
                top += weight * p.signal * (p.variance - read);
                bottom += weight * p.signal * p.signal;
            }
            (bottom > 0.0).then(|| (top / bottom).max(0.0))
        });
        let some = slope
            .iter()
            .flatten()
            .copied()
            .fold(None, |m: Option<f64>, s| Some(m.map_or(s, |m| m.max(s))));
        let some = some.ok_or_else(|| {
            Error::new(
                "the noise of the frames is not known: no two unclipped ones show the same thing",
            )
            .with_hint(
                "shoot every exposure twice, or calibrate first: `goniofit calibrate linearity`",
            )
        })?;
        // A channel without pairs of its own: that of the noisiest one.
        Ok(Self {
            slope: slope.map(|s| s.unwrap_or(some)),
            read,
        })
    }
}

/// What a pair of frames says, by channel: with `k` the ratio of the mean raw values less bias, `s_1 - k s_2` has mean
/// zero whatever the texture, and variance `(1 + k^2)` times that of one raw value; times the curve's squared slope it is
/// that of a linear one.
pub(super) fn pair_points(
    frames: [&RawFrame; 2],
    patch: &Patch,
    curve: &Curve,
    dark: &Dark,
    filter: Option<Filter>,
) -> Vec<TransferPoint> {
    let mut sums = [[0.0_f64; 6]; 4];
    let mut linear = [0.0; 4];
    for spot in patch.spots().filter(|s| s.weight > 0.0) {
        let bias = curve.bias[spot.place];
        let [p, q] = frames.map(|f| f64::from(f.data[spot.index]) - bias);
        let sum = &mut sums[spot.place];
        for (s, v) in sum.iter_mut().zip([1.0, p, q, p * p, p * q, q * q]) {
            *s += v;
        }
        linear[spot.place] += 0.5 * (curve.at(p) + curve.at(q));
    }
    let mut by_channel = [[0.0; 3]; 3];
    for (place, &[n, p, q, pp, pq, qq]) in sums.iter().enumerate().filter(|(_, s)| s[0] > 10.0) {
        // Where there is hardly any light the ratio is all noise.
        let k = if p / n > 10.0 * dark.variance[place].sqrt() {
            p / q
        } else {
            1.0
        };
        let difference = pp - 2.0 * k * pq + k * k * qq - (p - k * q).powi(2) / n;
        let slope = curve.slope(p / n);
        let sum = difference / (1.0 + k * k) * slope * slope;
        for c in patch.channels(filter, place) {
            by_channel[c][0] += n - 1.0;
            by_channel[c][1] += sum;
            by_channel[c][2] += linear[place] * (n - 1.0) / n;
        }
    }
    let point = |(channel, [freedom, square, linear]): (usize, [f64; 3])| TransferPoint {
        channel,
        signal: linear / freedom,
        variance: square / freedom,
        variance_se: square / freedom * (2.0 * patch.copies(filter) / freedom).sqrt(),
    };
    let seen = by_channel
        .into_iter()
        .enumerate()
        .filter(|(_, s)| s[0] > 0.0);
    seen.map(point).collect()
}

/// What the scatter between darks of one exposure says, by channel.
pub(super) fn dark_points(darks: &Darks, patch: &Patch, curve: &Curve) -> Vec<TransferPoint> {
    let mut points = Vec::new();
    for dark in darks.iter() {
        let mean = dark.by_place(patch);
        for channel in 0..3 {
            let (mut freedom, mut square, mut signal) = (0.0, 0.0, 0.0);
            for place in 0..4 {
                // Mono without a filter: every place is of every channel.
                if dark.freedom[place] > 0.0 && patch.channels(None, place).contains(&channel) {
                    freedom += dark.freedom[place];
                    square += dark.freedom[place] * dark.variance[place];
                    signal += dark.freedom[place] * curve.at(mean[place] - curve.bias[place]);
                }
            }
            if freedom > 0.0 {
                points.push(TransferPoint {
                    channel,
                    signal: signal / freedom,
                    variance: square / freedom,
                    variance_se: square / freedom * (2.0 * patch.copies(None) / freedom).sqrt(),
                });
            }
        }
    }
    points
}

/// Fits `variance = variance_per_signal signal + read_noise^2` with one read noise for all channels, weights from the
/// fitted variances. Also what is out of tolerance.
///
/// # Errors
/// A channel has no pair, or the read noise comes out negative.
pub(super) fn fit(points: Vec<TransferPoint>) -> Result<(PhotonTransfer, Vec<String>)> {
    let lit = |c: usize| {
        points
            .iter()
            .filter(move |p| p.channel == c && p.signal > 5.0 * p.variance.sqrt())
    };
    if let Some(c) = (0..3).find(|&c| lit(c).count() == 0) {
        return Err(Error::new(format!(
            "{} has no pair of frames of one exposure that is not clipped",
            NAMES[c]
        ))
        .with_hint("shoot every exposure of the series twice"));
    }
    let mut variances: Vec<f64> = points.iter().map(|p| p.variance).collect();
    let mut found = None;
    for _ in 0..4 {
        let mut normal = Normal::new(4);
        for (p, fitted) in points.iter().zip(&variances) {
            let mut row = [0.0, 0.0, 0.0, 1.0];
            row[p.channel] = p.signal;
            // variance_se is the variance times a number that depends on the count alone.
            normal.add(
                &row,
                p.variance,
                (fitted * p.variance_se / p.variance).powi(2),
            );
        }
        let solution = normal.solve().ok_or_else(|| {
            Error::new("the pairs of frames do not determine gain and read noise")
                .with_hint("shoot pairs at exposures from nearly dark to nearly saturated")
        })?;
        for (p, fitted) in points.iter().zip(&mut variances) {
            *fitted =
                (solution.values[p.channel] * p.signal + solution.values[3]).max(0.1 * p.variance);
        }
        found = Some(solution);
    }
    let solution = found.unwrap_or_default();
    let read = solution.values[3];
    if read.is_nan() || read <= 0.0 {
        return Err(Error::new(format!(
            "the variance of pairs extrapolates to {read:.3} +- {:.3} without light",
            solution.se(3)
        ))
        .with_hint(
            "shoot at least two dark frames of every exposure of the series, in the same session",
        ));
    }
    let faults = faults(&solution);
    let transfer = PhotonTransfer {
        variance_per_signal: [0, 1, 2].map(|c| solution.values[c]),
        variance_per_signal_se: [0, 1, 2].map(|c| solution.se(c)),
        read_noise: read.sqrt(),
        read_noise_se: solution.se(3) / (2.0 * read.sqrt()),
        points,
    };
    Ok((transfer, faults))
}

fn faults(solution: &Solution) -> Vec<String> {
    let (found, freedom) = (solution.chi_square, solution.freedom);
    let bad = freedom > 0 && found > chi_square_limit(freedom);
    let text = || {
        format!(
            "the variance of pairs is not a straight line over the signal: chi-square {found:.1} for {freedom} degrees of freedom; did the light flicker in patterns, or the camera smooth its frames?"
        )
    };
    bad.then(text).into_iter().collect()
}
