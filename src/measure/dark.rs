//! Dark frames: what every pixel reads without light, how much it scatters, and which pixels are hot.

use super::calibration::DarkCurrent;
use super::field::Window;
use super::frames::{Loader, Taken, same_exposure, title};
use super::linear::Response;
use super::white::Flat;
use crate::base::{Error, Result};
use crate::session::{FrameRecord, Layout};
use rayon::prelude::*;

/// The dark of one exposure time.
pub(super) struct Dark {
    pub(super) exposure_ms: f64,
    /// Mean raw value, made linear, per value of the field.
    pub(super) mean: Vec<f32>,
    /// Mean of that over the field.
    pub(super) level: f64,
    /// Frames averaged.
    pub(super) count: usize,
    /// Variance of one raw value: read noise, dark current and quantization.
    pub(super) variance: f64,
    /// False when only one frame is there and the variance is the scatter over its pixels, or a calibration's.
    pub(super) from_repeats: bool,
}

/// The darks of a session, on the part of the frames that is measured.
pub(super) struct Darks {
    pub(super) masters: Vec<Dark>,
    /// Values of pixels whose dark stands far out in some exposure, or which a calibration lists; left out everywhere.
    pub(super) hot: Vec<bool>,
    /// The part of the frames that is measured.
    pub(super) field: Window,
    pub(super) response: Response,
}

/// A value with less than this relative response is not used.
const BLIND: f32 = 0.05;

/// A value whose response has this relative error is not known: dead, or hot when the flat field was made.
const UNKNOWN: f32 = 0.5;

/// Rounding to whole raw values alone has this variance.
pub(super) const QUANTIZATION: f64 = 1.0 / 12.0;

impl Darks {
    /// Averages the darks of each exposure time; `hot_sigma` is how many standard deviations make a pixel hot.
    pub(super) fn read(
        loader: &Loader<'_>,
        frames: &[&Taken],
        field: Window,
        response: Response,
        known: Option<&DarkCurrent>,
        hot_sigma: f64,
    ) -> Result<Self> {
        let mut records: Vec<&FrameRecord> = frames.iter().map(|f| &f.record).collect();
        records.sort_by(|a, b| a.exposure_ms.total_cmp(&b.exposure_ms));
        let groups: Vec<&[&FrameRecord]> = records
            .chunk_by(|a, b| same_exposure(a.exposure_ms, b.exposure_ms))
            .collect();
        let averaged: Vec<Result<(Dark, Vec<bool>)>> = groups
            .par_iter()
            .map(|group| average(loader, group, &field, &response, known, hot_sigma))
            .collect();
        let mut hot = known_hot(known, &field);
        let mut masters = Vec::new();
        for one in averaged {
            let (master, outliers) = one?;
            for (hot, outlier) in hot.iter_mut().zip(&outliers) {
                *hot |= outlier;
            }
            masters.push(master);
        }
        let mut darks = Self {
            masters,
            hot,
            field,
            response,
        };
        darks.spread_over_pixels();
        Ok(darks)
    }

    /// A pixel with one hot value is not used at all.
    fn spread_over_pixels(&mut self) {
        if let Layout::Rgb = self.field.layout {
            for pixel in self.hot.chunks_mut(3) {
                let any = pixel.iter().any(|&h| h);
                pixel.fill(any);
            }
        }
    }

    /// Leaves out values that see next to nothing of an even light, or whose response is not known.
    pub(super) fn leave_out_blind(&mut self, flat: &Flat) {
        for (i, hot) in self.hot.iter_mut().enumerate() {
            *hot |= flat.response[i] < BLIND || flat.se[i] >= UNKNOWN;
        }
        self.spread_over_pixels();
    }

    /// Which values of a window inside the field are hot.
    pub(super) fn hot_on(&self, window: &Window) -> Vec<bool> {
        let rows = window.rows_within(&self.field);
        rows.into_iter()
            .flat_map(|row| self.hot[row].iter().copied())
            .collect()
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

/// The values of a calibration's hot pixels.
fn known_hot(known: Option<&DarkCurrent>, field: &Window) -> Vec<bool> {
    let mut hot = vec![false; field.len()];
    for pixel in known.iter().flat_map(|k| &k.hot) {
        for channel in 0..3 {
            if let Some(index) = field.index(pixel.x, pixel.y, channel) {
                hot[index] = true;
            }
        }
    }
    hot
}

/// The mean of one exposure's darks and its outliers.
fn average(
    loader: &Loader<'_>,
    group: &[&FrameRecord],
    field: &Window,
    response: &Response,
    known: Option<&DarkCurrent>,
    hot_sigma: f64,
) -> Result<(Dark, Vec<bool>)> {
    let mut mean = vec![0.0_f32; field.len()];
    // Sum of squared deviations from the mean so far (Welford 1962).
    let mut spread = vec![0.0_f32; if group.len() > 1 { field.len() } else { 0 }];
    for (n, record) in group.iter().enumerate() {
        let frame = loader.load(record)?;
        let n = n as f32 + 1.0;
        let values = field.rows().flat_map(|row| &frame.data[row]);
        for (i, &value) in values.enumerate() {
            let step = f32::from(value) - mean[i];
            mean[i] += step / n;
            if let Some(spread) = spread.get_mut(i) {
                *spread += step * (f32::from(value) - mean[i]);
            }
        }
    }
    let mut outliers = vec![false; mean.len()];
    let scatter = spatial_scatter(&mean, field, hot_sigma, &mut outliers);
    let from_repeats = group.len() > 1;
    let variance = if from_repeats {
        let steady = spread.iter().zip(&outliers).filter(|(_, hot)| !**hot);
        mean_of(steady.map(|(s, _)| f64::from(*s) / (group.len() as f64 - 1.0)))
    } else {
        known.map_or(scatter, |k| k.variance_at(group[0].exposure_ms))
    };
    for (i, value) in mean.iter_mut().enumerate() {
        *value = response.linear_mean(*value, field.place(i)) as f32;
    }
    let dark = Dark {
        exposure_ms: group[0].exposure_ms,
        level: mean_of(mean.iter().map(|&m| f64::from(m))),
        mean,
        count: group.len(),
        variance: variance.max(QUANTIZATION),
        from_repeats,
    };
    Ok((dark, outliers))
}

/// Marks values that stand more than `hot_sigma` scatters off the median of their place of the layout; returns the
/// variance over the others.
fn spatial_scatter(mean: &[f32], field: &Window, hot_sigma: f64, hot: &mut [bool]) -> f64 {
    let places: Vec<u8> = (0..mean.len()).map(|i| field.place(i) as u8).collect();
    let mut square = 0.0;
    let mut count = 0.0;
    for wanted in 0..field.layout.places() as u8 {
        let of_place = || (0..mean.len()).filter(|&i| places[i] == wanted);
        let mut values: Vec<f32> = of_place().map(|i| mean[i]).collect();
        if values.is_empty() {
            continue;
        }
        let middle = median(&mut values);
        let mut distances: Vec<f32> = values.iter().map(|v| (v - middle).abs()).collect();
        // 1.4826 median distances are one standard deviation of a normal law; raw values come in steps of one.
        let sigma = (1.4826 * f64::from(median(&mut distances))).max(0.5);
        let mut kept = crate::math::statistics::Running::default();
        for i in of_place() {
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
    use crate::session::CfaPattern;

    #[test]
    fn hot_pixels_are_found_and_do_not_widen_the_scatter() {
        let mut random = crate::math::Random::keyed(&[4]);
        let field = Window {
            bounds: [0, 0, 100, 80],
            frame_width: 100,
            layout: Layout::Bayer(CfaPattern::Rggb),
        };
        // Places of the 2x2 block differ by 10 raw values: that is no scatter.
        let mut mean: Vec<f32> = (0..100 * 80)
            .map(|i| {
                let place = field.place(i);
                (100.0 + 10.0 * place as f64 + 2.0 * random.normal()) as f32
            })
            .collect();
        for i in [7, 2050, 7999] {
            mean[i] += 60.0;
        }
        let mut hot = vec![false; mean.len()];
        let variance = spatial_scatter(&mean, &field, 8.0, &mut hot);
        let found: Vec<usize> = (0..mean.len()).filter(|&i| hot[i]).collect();
        assert_eq!(found, [7, 2050, 7999]);
        // 8000 pixels: sees a variance off by 7 % (4.5 standard errors).
        assert!(
            (variance - 4.0).abs() < 4.0 * 4.5 * (2.0 / 8000.0_f64).sqrt(),
            "{variance}"
        );
    }
}
