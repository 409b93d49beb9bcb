//! One configuration: weighted means over the projected sample square, exposure by exposure, and what their variances
//! are made of.
//!
//! With pixel weights `w_i` (area the pixel stands for), the white fit `F_i` and the standard's normalized radiance `K`, exposure e
//! says
//!
//! ```text
//! m_e = sum_i g_i (raw_i - dark_i) / t_e,      g_i = w_i K / (F_i sum_j w_j)        (sums over one channel's pixels)
//! ```
//!
//! where `t_e` is the exposure time times the lamp's level then.

use super::frames::{Pixel, Region};
use super::lamp::Level;
use super::stack::Stack;
use super::white::{Terms, White};
use std::collections::HashMap;

/// One exposure of one configuration.
pub(super) struct ExposureSums {
    pub(super) exposure_ms: f64,
    /// How messages call its first frame.
    pub(super) title: String,
    pub(super) level: Level,
    pub(super) channels: [ChannelSums; 3],
}

/// One channel of one exposure. The variance of `mean` is `a shot + read + dark`, `a` the slope of the photon transfer.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct ChannelSums {
    pub(super) mean: f64,
    /// `sum g^2 signal / (repeats t^2)`.
    pub(super) shot: f64,
    /// `sum g^2 dark_variance / (repeats t^2)`.
    pub(super) read: f64,
    /// `sum g^2 dark_variance / (dark frames t^2)`.
    pub(super) dark: f64,
    /// Minus the derivative of `mean` by the coefficients of the white fit.
    pub(super) white: Terms,
}

/// Sums of one exposure.
pub(super) fn exposure_sums(region: &Region, stack: &Stack, white: &White) -> ExposureSums {
    let mut area = [0.0; 3];
    for pixel in &region.pixels {
        area[pixel.channel] += pixel.weight;
    }
    let mut channels = [ChannelSums::default(); 3];
    for (pixel, &signal) in region.pixels.iter().zip(&stack.signal) {
        let phi = white.terms(pixel.x, pixel.y);
        let rate = white.rate(pixel.channel, &phi);
        let g = pixel.weight * white.radiance[pixel.channel] / (rate * area[pixel.channel]);
        let t = stack.time(pixel.channel);
        let sums = &mut channels[pixel.channel];
        let (m, g2) = (g * signal / t, g * g / (t * t));
        sums.mean += m;
        sums.shot += g2 * signal / stack.repeats;
        sums.read += g2 * stack.dark_variance / stack.repeats;
        sums.dark += g2 * stack.dark_variance / stack.dark_count;
        for (sum, term) in sums.white.iter_mut().zip(&phi) {
            *sum += m * term / rate;
        }
    }
    ExposureSums {
        exposure_ms: stack.exposure_ms,
        title: stack.title.clone(),
        level: stack.level.clone(),
        channels,
    }
}

/// How far the mean over one channel's pixels may lie from the mean over the whole area, because a textured sample is
/// seen through a filter on every second or fourth pixel only.
///
/// What disturbs a mean over every second pixel is texture at half a cycle per pixel: along x or y or both for red and
/// blue, along both for green. Spectral densities there are estimated from differences, each passing 36 times the variance
/// of texture that is uncorrelated from pixel to pixel and nothing of slow variations.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Texture {
    /// Per channel, around a quarter cycle per pixel along both x and y.
    quarter: [Differences; 3],
    /// Greens, around a quarter cycle along x or y alone (mean of both).
    quarter_edge: [Differences; 2],
    /// Greens, around half a cycle along x or y alone.
    half_edge: Differences,
    /// [`Region::sampling`].
    share: [f64; 3],
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

impl Texture {
    /// Measures the texture of the crop on one exposure.
    pub(super) fn measure(region: &Region, stack: &Stack, white: &White) -> Self {
        let mut values = HashMap::with_capacity(region.pixels.len());
        for (pixel, &signal) in region.pixels.iter().zip(&stack.signal) {
            let rate = white.rate(pixel.channel, &white.terms(pixel.x, pixel.y));
            let g = white.radiance[pixel.channel] / (rate * stack.time(pixel.channel));
            values.insert((pixel.x, pixel.y), (g, signal));
        }
        let read = stack.dark_variance * (1.0 / stack.repeats + 1.0 / stack.dark_count);
        let differences = |channel: usize, along: [Filter; 2]| {
            let of_channel = region.pixels.iter().filter(|p| p.channel == channel);
            mean_differences(of_channel, &values, along, stack.repeats, read)
        };
        const DIFFERENCE: [f64; 3] = [1.0, -2.0, 1.0];
        const SUM: [f64; 3] = [1.0, 2.0, 1.0];
        let (x, y) = ((2, 0), (0, 2));
        Self {
            quarter: [0, 1, 2].map(|c| differences(c, [(x, DIFFERENCE), (y, DIFFERENCE)])),
            quarter_edge: [[DIFFERENCE, SUM], [SUM, DIFFERENCE]]
                .map(|[u, v]| differences(1, [(x, u), (y, v)])),
            half_edge: differences(1, [((1, 1), DIFFERENCE), ((1, -1), DIFFERENCE)]),
            share: region.sampling,
        }
    }

    /// The variance of a channel's mean from sampling texture at the filter's pixels, for photon-transfer slope `a`.
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
        self.share[channel] * density
    }
}

/// A step in x and y, and the factors at minus one, zero and one step.
type Filter = ((isize, isize), [f64; 3]);

/// The mean square of the product of two filters over all pixels whose nine neighbors are there.
fn mean_differences<'a>(
    pixels: impl Iterator<Item = &'a Pixel>,
    values: &HashMap<(usize, usize), (f64, f64)>,
    along: [Filter; 2],
    repeats: f64,
    read: f64,
) -> Differences {
    let [(u, factors_u), (v, factors_v)] = along;
    let mut sums = Differences::default();
    let mut count = 0.0;
    for pixel in pixels {
        let mut difference = 0.0;
        let (mut shot, mut constant) = (0.0, 0.0);
        let mut whole = true;
        for (i, factor_u) in (-1..=1).zip(factors_u) {
            for (j, factor_v) in (-1..=1).zip(factors_v) {
                let x = pixel.x.checked_add_signed(i * u.0 + j * v.0);
                let y = pixel.y.checked_add_signed(i * u.1 + j * v.1);
                let Some(&(g, signal)) = x.zip(y).and_then(|at| values.get(&at)) else {
                    whole = false;
                    continue;
                };
                let factor = factor_u * factor_v;
                difference += factor * g * signal;
                shot += factor * factor * g * g * signal / repeats;
                constant += factor * factor * g * g * read;
            }
        }
        if whole {
            sums.square += difference * difference / 36.0;
            sums.shot += shot / 36.0;
            sums.constant += constant / 36.0;
            count += 1.0;
        }
    }
    if count > 0.0 {
        sums.square /= count;
        sums.shot /= count;
        sums.constant /= count;
    }
    sums
}
