//! Range, histogram and threshold of a volume.

use super::Volume;
use crate::base::{Error, Result, Watch};

/// Bins where there are not as many values.
const BINS: usize = 1 << 16;

/// The shares at which [`Statistics::quantiles`] are given.
const SHARES: [f64; 9] = [0.001, 0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 0.999];

/// What a volume's values are like.
#[derive(Debug, Clone, PartialEq)]
pub struct Statistics {
    /// Number of voxels.
    pub voxels: u64,
    /// Smallest value.
    pub min: f32,
    /// Largest value.
    pub max: f32,
    /// Mean value.
    pub mean: f64,
    /// Share of voxels and the value they do not exceed; exact for whole numbers that span less than 65536, else to
    /// 1/65536 of the range.
    pub quantiles: Vec<(f64, f64)>,
    /// Otsu's threshold between empty and not (Otsu 1979 eq. 18): voxels from it on are not empty.
    pub otsu: f64,
    /// Share of voxels from the threshold on.
    pub nonempty: f64,
}

/// Reads a volume twice, with `memory` bytes at a time.
///
/// # Errors
/// A voxel is not a number, the file cannot be read, all voxels are the same, or the watch cancelled.
pub fn statistics(volume: &Volume, memory: usize, watch: &dyn Watch) -> Result<Statistics> {
    let (mut min, mut max) = (f32::INFINITY, f32::NEG_INFINITY);
    let (mut sum, mut voxels) = (0.0, 0);
    volume.sweep(memory, "reading the range", watch, |block| {
        for v in &block.values {
            min = min.min(*v);
            max = max.max(*v);
            sum += f64::from(*v);
        }
        voxels += block.values.len() as u64;
        Ok(())
    })?;
    if min >= max {
        return Err(
            Error::new(format!("every voxel is {min}: the volume is empty")).with_hint(
                "is this the right file, and are its type and offset as the header says?",
            ),
        );
    }
    let mut histogram = Histogram::new(!volume.sample().is_float(), min.into(), max.into());
    volume.sweep(memory, "counting values", watch, |block| {
        block.values.iter().for_each(|v| histogram.add((*v).into()));
        Ok(())
    })?;
    let otsu = histogram.otsu();
    Ok(Statistics {
        voxels,
        min,
        max,
        mean: sum / voxels as f64,
        quantiles: SHARES.map(|q| (q, histogram.quantile(q))).to_vec(),
        otsu,
        nonempty: histogram.share_from(otsu),
    })
}

impl Statistics {
    /// The value that this share of voxels does not exceed; shares are those of [`Statistics::quantiles`].
    pub fn quantile(&self, share: f64) -> Option<f64> {
        let found = self.quantiles.iter().find(|q| (q.0 - share).abs() < 1e-9);
        found.map(|q| q.1)
    }
}

/// Otsu's threshold of values that are not all the same.
pub(super) fn otsu(values: &[f32]) -> f64 {
    let ends = values
        .iter()
        .fold([f32::INFINITY, f32::NEG_INFINITY], |e, v| {
            [e[0].min(*v), e[1].max(*v)]
        });
    let mut histogram = Histogram::new(false, ends[0].into(), ends[1].into());
    values.iter().for_each(|v| histogram.add((*v).into()));
    histogram.otsu()
}

struct Histogram {
    low: f64,
    width: f64,
    /// One bin for each whole number.
    exact: bool,
    counts: Vec<u64>,
}

impl Histogram {
    fn new(whole: bool, low: f64, high: f64) -> Self {
        let span = high - low;
        let exact = whole && span < BINS as f64;
        let (bins, width) = if exact {
            (span as usize + 1, 1.0)
        } else {
            (BINS, span / BINS as f64)
        };
        Self {
            low,
            width,
            exact,
            counts: vec![0; bins],
        }
    }

    fn add(&mut self, value: f64) {
        let bin = ((value - self.low) / self.width) as usize;
        let last = self.counts.len() - 1;
        self.counts[bin.min(last)] += 1;
    }

    /// The value a bin stands for.
    fn value(&self, bin: usize) -> f64 {
        let within = if self.exact { 0.0 } else { 0.5 };
        self.low + (bin as f64 + within) * self.width
    }

    fn total(&self) -> u64 {
        self.counts.iter().sum()
    }

    fn quantile(&self, share: f64) -> f64 {
        let needed = share * self.total() as f64;
        let mut sum = 0;
        let bin = self.counts.iter().position(|n| {
            sum += n;
            sum as f64 >= needed
        });
        self.value(bin.unwrap_or(self.counts.len() - 1))
    }

    fn share_from(&self, threshold: f64) -> f64 {
        let above = (0..self.counts.len()).filter(|bin| self.value(*bin) >= threshold);
        above.map(|bin| self.counts[bin]).sum::<u64>() as f64 / self.total() as f64
    }

    /// The border that makes the variance between the classes largest, in the middle of those that make it equally large.
    fn otsu(&self) -> f64 {
        let total = self.total() as f64;
        let whole: f64 = (0..self.counts.len())
            .map(|b| self.counts[b] as f64 * self.value(b))
            .sum();
        let (mut below, mut sum_below, mut best) = (0.0, 0.0, (-1.0, 0, 0));
        for bin in 0..self.counts.len() - 1 {
            below += self.counts[bin] as f64;
            sum_below += self.counts[bin] as f64 * self.value(bin);
            let above = total - below;
            if below <= 0.0 || above <= 0.0 {
                continue;
            }
            let apart = sum_below / below - (whole - sum_below) / above;
            let between = below * above * apart * apart;
            if between > best.0 * (1.0 + 1e-12) {
                best = (between, bin, bin);
            } else if between >= best.0 * (1.0 - 1e-12) {
                best.2 = bin;
            }
        }
        // The border lies above the last bin of the lower class.
        0.5 * (self.value(best.1) + self.value(best.2 + 1))
    }
}
