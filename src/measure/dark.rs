//! Dark frames: what every pixel reads without light, how much it scatters, and which pixels are hot.

use super::frames::{Loader, Taken, same_exposure, title};
use crate::base::{Error, Result};
use crate::session::{CfaPattern, FrameRecord};

/// The dark of one exposure time.
pub(super) struct Dark {
    pub(super) exposure_ms: f64,
    /// Mean raw value per pixel.
    pub(super) mean: Vec<f32>,
    /// Frames averaged.
    pub(super) count: usize,
    /// Variance of one raw value: read noise, dark current and quantization.
    pub(super) variance: f64,
    /// False when only one frame is there and the variance is the scatter over its pixels.
    pub(super) from_repeats: bool,
}

/// The darks of a session.
pub(super) struct Darks {
    pub(super) masters: Vec<Dark>,
    /// Pixels whose dark stands far out in some exposure; they are left out everywhere.
    pub(super) hot: Vec<bool>,
    pub(super) cfa: CfaPattern,
    /// Pixels per row, rows.
    pub(super) size: [usize; 2],
}

/// Rounding to whole raw values alone has this variance.
const QUANTIZATION: f64 = 1.0 / 12.0;

impl Darks {
    /// Averages the darks of each exposure time; `hot_sigma` is how many standard deviations make a pixel hot.
    pub(super) fn read(loader: &Loader<'_>, frames: &[&Taken], hot_sigma: f64) -> Result<Self> {
        let mut records: Vec<&FrameRecord> = frames.iter().map(|f| &f.record).collect();
        records.sort_by(|a, b| a.exposure_ms.total_cmp(&b.exposure_ms));
        let mut masters = Vec::new();
        let mut hot = Vec::new();
        let (mut cfa, mut size) = (CfaPattern::Rggb, [1, 1]);
        for group in records.chunk_by(|a, b| same_exposure(a.exposure_ms, b.exposure_ms)) {
            let mut sums: Vec<(f64, f64)> = Vec::new();
            for record in group {
                let frame = loader.load(record)?;
                (size, cfa) = ([frame.width, frame.height], frame.cfa());
                sums.resize(frame.data.len(), (0.0, 0.0));
                for (sum, &value) in sums.iter_mut().zip(&frame.data) {
                    let value = f64::from(value);
                    sum.0 += value;
                    sum.1 += value * value;
                }
            }
            let n = group.len() as f64;
            let mean: Vec<f32> = sums.iter().map(|s| (s.0 / n) as f32).collect();
            let mut outliers = vec![false; mean.len()];
            let scatter = spatial_scatter(&mean, size[0], hot_sigma, &mut outliers);
            hot.resize(mean.len(), false);
            for (hot, outlier) in hot.iter_mut().zip(&outliers) {
                *hot |= outlier;
            }
            let from_repeats = group.len() > 1;
            let variance = if from_repeats {
                let steady = sums.iter().zip(&outliers).filter(|(_, hot)| !**hot);
                let per_pixel = steady.map(|(s, _)| (s.1 - s.0 * s.0 / n) / (n - 1.0));
                mean_of(per_pixel)
            } else {
                scatter
            };
            masters.push(Dark {
                exposure_ms: group[0].exposure_ms,
                mean,
                count: group.len(),
                variance: variance.max(QUANTIZATION),
                from_repeats,
            });
        }
        Ok(Self {
            masters,
            hot,
            cfa,
            size,
        })
    }

    /// The dark for a frame's exposure time.
    ///
    /// # Errors
    /// When there is none.
    pub(super) fn find(&self, record: &FrameRecord) -> Result<&Dark> {
        self.masters
            .iter()
            .find(|d| same_exposure(d.exposure_ms, record.exposure_ms))
            .ok_or_else(|| {
                let times: Vec<String> = self
                    .masters
                    .iter()
                    .map(|d| format!("{} ms", d.exposure_ms))
                    .collect();
                Error::new(format!(
                    "{} has no dark frame of its exposure; there are darks of: {}",
                    title(record),
                    if times.is_empty() {
                        "none".to_owned()
                    } else {
                        times.join(", ")
                    }
                ))
                .with_hint("take a dark frame at every exposure of the sample, the white and the reference")
            })
    }
}

/// Marks pixels that stand more than `hot_sigma` scatters off the median of their place in the 2x2 block; returns the
/// variance over the other pixels.
fn spatial_scatter(mean: &[f32], width: usize, hot_sigma: f64, hot: &mut [bool]) -> f64 {
    let place = |i: usize| CfaPattern::position(i / width, i % width);
    let mut square = 0.0;
    let mut count = 0.0;
    for wanted in 0..4 {
        let mut values: Vec<f32> = (0..mean.len())
            .filter(|&i| place(i) == wanted)
            .map(|i| mean[i])
            .collect();
        if values.is_empty() {
            continue;
        }
        let middle = median(&mut values);
        let mut distances: Vec<f32> = values.iter().map(|v| (v - middle).abs()).collect();
        // 1.4826 median distances are one standard deviation of a normal law; raw values come in steps of one.
        let sigma = (1.4826 * f64::from(median(&mut distances))).max(0.5);
        let mut kept = crate::math::statistics::Running::default();
        for i in (0..mean.len()).filter(|&i| place(i) == wanted) {
            if f64::from((mean[i] - middle).abs()) > hot_sigma * sigma {
                hot[i] = true;
            } else {
                kept.push(f64::from(mean[i]));
            }
        }
        if kept.count() > 1 {
            square += kept.variance() * kept.count() as f64;
            count += kept.count() as f64;
        }
    }
    if count > 0.0 { square / count } else { 0.0 }
}

/// The upper median; reorders the values.
fn median(values: &mut [f32]) -> f32 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

fn mean_of(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = values.fold((0.0, 0.0), |(s, n), v| (s + v, n + 1.0));
    if n > 0.0 { sum / n } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hot_pixels_are_found_and_do_not_widen_the_scatter() {
        let mut random = crate::math::Random::keyed(&[4]);
        // Places of the 2x2 block differ by 10 raw values: that is no scatter.
        let mut mean: Vec<f32> = (0..100 * 80)
            .map(|i| {
                let place = CfaPattern::position(i / 100, i % 100);
                (100.0 + 10.0 * place as f64 + 2.0 * random.normal()) as f32
            })
            .collect();
        for i in [7, 2050, 7999] {
            mean[i] += 60.0;
        }
        let mut hot = vec![false; mean.len()];
        let variance = spatial_scatter(&mean, 100, 8.0, &mut hot);
        let found: Vec<usize> = (0..mean.len()).filter(|&i| hot[i]).collect();
        assert_eq!(found, [7, 2050, 7999]);
        // 8000 pixels: sees a variance off by 7 % (4.5 standard errors).
        assert!(
            (variance - 4.0).abs() < 4.0 * 4.5 * (2.0 / 8000.0_f64).sqrt(),
            "{variance}"
        );
    }
}
