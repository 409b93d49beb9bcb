//! A picture taken apart into regular grids of one kind of value each.

use super::Crop;
use super::Picture;

/// The values of one place of the mosaic, or of one channel.
#[derive(Debug, Clone)]
pub(super) struct Plane {
    /// 0 red, 1 green, 2 blue; none where one value stands for all three.
    pub(super) channel: Option<usize>,
    /// Pixels of the picture from one cell to the next.
    pub(super) step: usize,
    /// Pixel of the picture the first cell begins at.
    pub(super) start: [usize; 2],
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) values: Vec<f32>,
    /// Standard deviation of each from noise.
    pub(super) noise: Vec<f32>,
    /// Covered fraction; 0 for what does not count, negative for what was taken out.
    pub(super) weight: Vec<f32>,
}

impl Plane {
    /// Planes of a picture: four of a mosaic, one without filters, three of three values per pixel.
    pub(super) fn of(picture: &Picture) -> Vec<Self> {
        let per_pixel = picture.layout.values_per_pixel();
        match picture.layout.cfa() {
            Some(cfa) => (0..4)
                .map(|place| {
                    let start = [place % 2, place / 2];
                    Self::cut(
                        picture,
                        Some(cfa.channel(start[1], start[0])),
                        2,
                        start,
                        1,
                        0,
                    )
                })
                .collect(),
            None => (0..per_pixel)
                .map(|k| {
                    Self::cut(
                        picture,
                        (per_pixel == 3).then_some(k),
                        1,
                        [0, 0],
                        per_pixel,
                        k,
                    )
                })
                .collect(),
        }
    }

    fn cut(
        picture: &Picture,
        channel: Option<usize>,
        step: usize,
        start: [usize; 2],
        per_pixel: usize,
        first: usize,
    ) -> Self {
        let [columns, rows] = picture.size;
        let width = columns.saturating_sub(start[0]).div_ceil(step);
        let height = rows.saturating_sub(start[1]).div_ceil(step);
        let mut plane = Self {
            channel,
            step,
            start,
            width,
            height,
            values: Vec::with_capacity(width * height),
            noise: Vec::with_capacity(width * height),
            weight: Vec::with_capacity(width * height),
        };
        for y in (start[1]..rows).step_by(step) {
            for x in (start[0]..columns).step_by(step) {
                let pixel = y * columns + x;
                let value = pixel * per_pixel + first;
                plane.values.push(picture.values[value]);
                plane.noise.push(picture.noise[value]);
                let counts = picture.kept[value];
                plane
                    .weight
                    .push(if counts { picture.covered[pixel] } else { 0.0 });
            }
        }
        plane
    }

    /// The pixel of the picture in the middle of a cell.
    pub(super) fn pixel(&self, x: usize, y: usize) -> [usize; 2] {
        [self.start[0] + x * self.step, self.start[1] + y * self.step]
    }

    /// Mean over the square; 0 when nothing counts.
    pub(super) fn mean(&self) -> f64 {
        let (mut sum, mut area) = (0.0, 0.0);
        for (value, weight) in self.values.iter().zip(&self.weight) {
            sum += f64::from(value * weight);
            area += f64::from(*weight);
        }
        if area > 0.0 { sum / area } else { 0.0 }
    }

    /// Cells of `n` by `n` averaged into one. A new cell counts when it lies in the square and half of it was not taken out.
    pub(super) fn binned(&self, n: usize) -> Self {
        let (width, height) = (self.width / n, self.height / n);
        let mut sums = vec![[0.0f32; 4]; width * height];
        for y in 0..height * n {
            let row = y * self.width;
            for x in 0..width * n {
                let (i, sum) = (row + x, &mut sums[y / n * width + x / n]);
                let weight = self.weight[i].max(0.0);
                sum[0] += weight * self.values[i];
                sum[1] += (weight * self.noise[i]).powi(2);
                sum[2] += weight;
                sum[3] += f32::from(u8::from(self.weight[i].abs() > 0.5));
            }
        }
        let whole = (n * n) as f32;
        let counts = |s: &[f32; 4]| s[3] >= whole && 2.0 * s[2] >= whole;
        let of = |f: fn(&[f32; 4]) -> f32| -> Vec<f32> {
            sums.iter()
                .map(|s| if counts(s) { f(s) } else { 0.0 })
                .collect()
        };
        Self {
            channel: self.channel,
            step: self.step * n,
            start: self.start,
            width,
            height,
            values: of(|s| s[0] / s[2]),
            noise: of(|s| s[1].sqrt() / s[2]),
            weight: of(|_| 1.0),
        }
    }
}

/// A box that grows to hold pixels of the picture.
#[derive(Debug, Clone, Copy)]
pub(super) struct Grown {
    low: [usize; 2],
    high: [usize; 2],
}

impl Grown {
    pub(super) fn empty() -> Self {
        Self {
            low: [usize::MAX; 2],
            high: [0; 2],
        }
    }

    /// Takes in a square of `side` pixels whose first pixel this is.
    pub(super) fn add(&mut self, pixel: [usize; 2], side: usize) {
        for k in 0..2 {
            self.low[k] = self.low[k].min(pixel[k]);
            self.high[k] = self.high[k].max(pixel[k] + side);
        }
    }

    /// In pixels of the visible area, within the picture; none when it holds nothing.
    pub(super) fn crop(&self, picture: &Picture) -> Option<Crop> {
        let high = [0, 1].map(|k| self.high[k].min(picture.size[k]));
        (self.low[0] < high[0] && self.low[1] < high[1]).then(|| Crop {
            x: picture.origin[0] + self.low[0],
            y: picture.origin[1] + self.low[1],
            width: high[0] - self.low[0],
            height: high[1] - self.low[1],
        })
    }
}

/// The median; reorders. None of nothing.
pub(super) fn median(values: &mut [f32]) -> Option<f32> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f32::total_cmp).1)
}

/// Median and robust standard deviation (1.4826 times the median distance from it); none of nothing.
pub(super) fn robust(values: &[f32]) -> Option<(f32, f32)> {
    let mut values = values.to_vec();
    let center = median(&mut values)?;
    for value in &mut values {
        *value = (*value - center).abs();
    }
    Some((center, 1.4826 * median(&mut values)?))
}
