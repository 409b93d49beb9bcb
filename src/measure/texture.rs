//! How far the mean over one channel's pixels may lie from the mean over the whole area, because a textured sample is seen
//! through a filter on every second or fourth pixel only, and because a pixel on the edge of the square shows more than
//! the part of it inside.
//!
//! What disturbs a mean over every second pixel is texture at half a cycle per pixel: along x or y or both for red and
//! blue, along both for green. Spectral densities there are estimated from differences, each passing 36 times the variance
//! of texture that is uncorrelated from pixel to pixel and nothing of slow variations.

use super::field::{Weights, Window};
use super::merge::Merged;
use super::radiance::Radiance;
use crate::session::Layout;

/// What the differences between neighbors say.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Texture {
    /// Per channel, around a quarter cycle per pixel along both x and y (half a cycle where every pixel sees the channel).
    quarter: [Differences; 3],
    /// Greens, around a quarter cycle along x or y alone (mean of both).
    quarter_edge: [Differences; 2],
    /// Greens, around half a cycle along x or y alone.
    half_edge: Differences,
    /// [`Weights::sampling`].
    share: [f64; 3],
    /// [`Weights::edge`].
    edge: f64,
}

/// Mean square difference of normalized radiance, and what of it is noise: `a shot + constant`.
#[derive(Debug, Clone, Copy, Default)]
struct Differences {
    square: f64,
    shot: f64,
    constant: f64,
}

impl Differences {
    fn texture(&self, a: f64) -> f64 {
        (self.square - a * self.shot - self.constant).max(0.0)
    }
}

/// A step in x and y, and the factors at minus one, zero and one step.
type Filter = ((isize, isize), [f64; 3]);

const DIFFERENCE: [f64; 3] = [1.0, -2.0, 1.0];
const SUM: [f64; 3] = [1.0, 2.0, 1.0];

impl Texture {
    /// Measures the texture of the crop.
    pub(super) fn measure(
        radiance: &Radiance,
        merged: &Merged,
        window: &Window,
        weights: &Weights,
    ) -> Self {
        let crop = Crop {
            radiance,
            merged,
            window,
            weights,
        };
        let mosaic = matches!(window.layout, Layout::Bayer(_));
        let step = if mosaic { 2 } else { 1 };
        let (x, y) = ((step, 0), (0, step));
        let mut texture = Self {
            quarter: [0, 1, 2].map(|c| crop.differences(c, [(x, DIFFERENCE), (y, DIFFERENCE)])),
            share: weights.sampling,
            edge: weights.edge,
            ..Self::default()
        };
        if mosaic {
            texture.quarter_edge = [[DIFFERENCE, SUM], [SUM, DIFFERENCE]]
                .map(|[u, v]| crop.differences(1, [(x, u), (y, v)]));
            texture.half_edge = crop.differences(1, [((1, 1), DIFFERENCE), ((1, -1), DIFFERENCE)]);
        }
        texture
    }

    /// The variance of a channel's mean from sampling texture at the filter's pixels and from the square's edge, for
    /// photon-transfer slope `a`.
    ///
    /// Half a cycle along both x and y cannot be seen in any channel: it is extrapolated as if the spectrum were a product
    /// `A(f_x) A(f_y)`. The shape of the spectrum is taken from the greens, its size from each channel.
    pub(super) fn variance(&self, channel: usize, a: f64) -> f64 {
        let quarter = self.quarter[1].texture(a);
        let quarter_edge =
            0.5 * (self.quarter_edge[0].texture(a) + self.quarter_edge[1].texture(a));
        let edge = self.half_edge.texture(a);
        let product = edge * edge * quarter / (quarter_edge * quarter_edge);
        let corner = if product < edge { product } else { edge };
        let density = if channel == 1 {
            corner
        } else {
            let shape = (2.0 * edge + corner) / (3.0 * quarter);
            let shape = if shape < 4.0 { shape } else { 4.0 };
            self.quarter[channel].texture(a) * shape
        };
        self.share[channel] * density + self.edge * self.quarter[channel].texture(a)
    }
}

/// The values of one crop.
struct Crop<'a> {
    radiance: &'a Radiance,
    merged: &'a Merged,
    window: &'a Window,
    weights: &'a Weights,
}

impl Crop<'_> {
    /// The mean square of the product of two filters over all values of the crop whose nine neighbors are there.
    fn differences(&self, channel: usize, along: [Filter; 2]) -> Differences {
        let values = self.radiance.plane(channel);
        let plane = self.merged.plane(channel);
        let [(u, factors_u), (v, factors_v)] = along;
        let mut sums = Differences::default();
        let mut count = 0.0;
        'values: for value in &self.weights.channels[channel] {
            let (x, y) = self.window.pixel(value.index);
            let mut difference = 0.0;
            let (mut shot, mut constant) = (0.0, 0.0);
            for (i, factor_u) in (-1..=1).zip(factors_u) {
                for (j, factor_v) in (-1..=1).zip(factors_v) {
                    let x = x.checked_add_signed(i * u.0 + j * v.0);
                    let y = y.checked_add_signed(i * u.1 + j * v.1);
                    let index = x.zip(y).and_then(|(x, y)| self.window.index(x, y, channel));
                    let Some(index) = index.filter(|&i| plane.is_kept(i)) else {
                        continue 'values;
                    };
                    let factor = factor_u * factor_v;
                    difference += factor * f64::from(values.value[index]);
                    shot += factor * factor * f64::from(values.shot[index]);
                    constant += factor * factor * f64::from(values.constant[index]);
                }
            }
            sums.square += difference * difference / 36.0;
            sums.shot += shot / 36.0;
            sums.constant += constant / 36.0;
            count += 1.0;
        }
        if count > 0.0 {
            sums.square /= count;
            sums.shot /= count;
            sums.constant /= count;
        }
        sums
    }
}
