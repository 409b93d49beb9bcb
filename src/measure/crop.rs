//! One configuration: weighted means over the projected sample square, exposure by exposure, and what their variances
//! are made of.
//!
//! With pixel weights `w_i` (covered fraction), the white fit `F_i` and the standard's normalized radiance `K`, exposure e
//! says
//!
//! ```text
//! m_e = sum_i g_i (raw_i - dark_i) / t_e,      g_i = w_i K / (F_i sum_j w_j)        (sums over one channel's pixels)
//! ```

use super::frames::{Pixel, Region, Stack};
use super::white::{TERMS, Terms, White};
use std::collections::HashMap;

/// One exposure of one configuration.
pub(super) struct ExposureSums {
    pub(super) exposure_ms: f64,
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
    let t = stack.exposure_ms;
    let mut channels = [ChannelSums::default(); 3];
    for (pixel, &signal) in region.pixels.iter().zip(&stack.signal) {
        let phi = white.terms(pixel.x, pixel.y);
        let rate = white.rate(pixel.channel, &phi);
        let g = pixel.weight * white.radiance[pixel.channel] / (rate * area[pixel.channel]);
        let sums = &mut channels[pixel.channel];
        let (m, g2) = (g * signal / t, g * g / (t * t));
        sums.mean += m;
        sums.shot += g2 * signal / stack.repeats;
        sums.read += g2 * stack.dark_variance / stack.repeats;
        sums.dark += g2 * stack.dark_variance / stack.dark_count;
        for k in 0..TERMS {
            sums.white[k] += m * phi[k] / rate;
        }
    }
    ExposureSums {
        exposure_ms: t,
        channels,
    }
}

/// How far the mean over one channel's pixels may lie from the mean over the whole area, because a textured sample is
/// seen through a filter on every second or fourth pixel only.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Texture {
    /// For each channel: mean square of the mixed second difference at a step of two pixels, over 36.
    nugget: [Differences; 3],
    /// The same for the greens along the diagonals, which sees what a step of two pixels hides.
    diagonal: Differences,
    /// Variance of a channel mean per unit of pixel variance, for uncorrelated texture.
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
    ///
    /// The filter `(1, -2, 1) x (1, -2, 1)` passes 36 times the variance of texture that is uncorrelated from pixel to
    /// pixel and nothing of slow variations.
    pub(super) fn measure(region: &Region, stack: &Stack, white: &White) -> Self {
        let mut area = [0.0; 3];
        let mut square_weights = [0.0; 3];
        let mut values = HashMap::with_capacity(region.pixels.len());
        for (pixel, &signal) in region.pixels.iter().zip(&stack.signal) {
            area[pixel.channel] += pixel.weight;
            square_weights[pixel.channel] += pixel.weight * pixel.weight;
            if pixel.weight > 0.999 {
                let rate = white.rate(pixel.channel, &white.terms(pixel.x, pixel.y));
                let g = white.radiance[pixel.channel] / (rate * stack.exposure_ms);
                values.insert((pixel.x, pixel.y), (g, signal));
            }
        }
        let read = stack.dark_variance * (1.0 / stack.repeats + 1.0 / stack.dark_count);
        let differences = |channel: usize, u: (isize, isize), v: (isize, isize)| {
            let of_channel = region.pixels.iter().filter(|p| p.channel == channel);
            mixed_differences(of_channel, &values, u, v, stack.repeats, read)
        };
        // A lattice that holds the fraction f of the pixels misses 1 - f of uncorrelated texture's variance.
        let missed = [0.75, 0.5, 0.75];
        let share = std::array::from_fn(|c| {
            let share = missed[c] * square_weights[c] / (area[c] * area[c]);
            if area[c] > 0.0 { share } else { 0.0 }
        });
        Self {
            nugget: std::array::from_fn(|c| differences(c, (2, 0), (0, 2))),
            diagonal: differences(1, (1, 1), (1, -1)),
            share,
        }
    }

    /// The variance of a channel's mean from sampling texture at the filter's pixels.
    ///
    /// Texture that vanishes at half a cycle per pixel does not disturb the mean; how much of the texture at a quarter
    /// cycle is left there is seen in the greens and taken over to the other channels.
    pub(super) fn variance(&self, channel: usize, a: f64) -> f64 {
        let green = self.nugget[1].texture(a);
        let left = self.diagonal.texture(a);
        let ratio = if green > left { left / green } else { 1.0 };
        self.share[channel] * self.nugget[channel].texture(a) * ratio
    }
}

fn mixed_differences<'a>(
    pixels: impl Iterator<Item = &'a Pixel>,
    values: &HashMap<(usize, usize), (f64, f64)>,
    u: (isize, isize),
    v: (isize, isize),
    repeats: f64,
    read: f64,
) -> Differences {
    let mut sums = Differences::default();
    let mut count = 0.0;
    for pixel in pixels {
        let mut difference = 0.0;
        let (mut shot, mut constant) = (0.0, 0.0);
        let mut whole = true;
        for (i, factor_u) in [(-1, 1.0), (0, -2.0), (1, 1.0)] {
            for (j, factor_v) in [(-1, 1.0), (0, -2.0), (1, 1.0)] {
                let x = pixel.x.checked_add_signed(i * u.0 + j * v.0);
                let y = pixel.y.checked_add_signed(i * u.1 + j * v.1);
                let value = x.zip(y).and_then(|at| values.get(&at));
                let Some(&(g, signal)) = value else {
                    whole = false;
                    continue;
                };
                let factor: f64 = factor_u * factor_v;
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
