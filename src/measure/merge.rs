//! One picture from a bracket: every value from the exposures in which it is not clipped, weighted by inverse variance.
//!
//! A weighted mean is unbiased only if neither weights nor masks depend on the noise of what they weight. So
//! - the weights use the crop's mean signal, never a pixel's own;
//! - a value is left out of an exposure when its *neighbors* in the next shorter one foretell that it comes near the
//!   limit, and only then by its own brightness (which decides for lone glints alone);
//! - neighbors of saturated pixels are left out with them.
//!
//! Nothing is ever replaced: a value that is too bright in every exposure makes the configuration saturated.

use super::field::{Weighted, Weights, Window};
use super::stack::{Stack, Target};
use crate::session::Layout;

/// Exposures that one bracket may have.
pub(super) const MOST_EXPOSURES: usize = 64;

/// Neighbors foretelling more than this fraction of the limit mask a value.
const FORETOLD: f64 = 0.9;

/// The merged rates of one configuration: raw values per millisecond at the lamp's level one.
pub(super) struct Merged {
    /// One plane of the window's size for all channels; or three, for frames through filters.
    planes: Vec<Plane>,
    /// Values that carry the crop and are too bright in every exposure, by channel; of a monochrome camera without filters
    /// all are counted in channel 0.
    pub(super) saturated: [usize; 3],
    /// Exposures in which values of the crop were left out: index of the stack, how many.
    pub(super) masked: Vec<(usize, usize)>,
}

/// One value per value of the window.
pub(super) struct Plane {
    /// Rate; 0 where `used` is 0.
    pub(super) rate: Vec<f32>,
    /// Bit e is set when exposure e of the bracket is used.
    used: Vec<u64>,
    /// Stacks that are bits of `used`.
    stacks: Vec<usize>,
    /// By bit and channel: the weight of that exposure.
    weights: Vec<[f64; 3]>,
}

/// What one value is made of.
pub(super) struct Share {
    /// Index of the stack.
    pub(super) stack: usize,
    /// Its weight over the sum of weights, over the time: rate = sum part signal.
    pub(super) part: f64,
}

impl Merged {
    /// The plane a channel lies in.
    pub(super) fn plane(&self, channel: usize) -> &Plane {
        &self.planes[if self.planes.len() > 1 { channel } else { 0 }]
    }

    /// Merges the stacks of one thing; `slope` is what is known beforehand of the photon transfer.
    pub(super) fn of(stacks: &[Stack], target: &Target<'_>, slope: [f64; 3]) -> Self {
        let filtered = stacks.iter().any(|s| s.filter.is_some());
        let planes: Vec<Plane> = if filtered {
            let all = (0..3).map(|c| Plane::of(stacks, target, slope, Some(c)));
            all.collect()
        } else {
            vec![Plane::of(stacks, target, slope, None)]
        };
        let mut merged = Self {
            planes,
            saturated: [0; 3],
            masked: Vec::new(),
        };
        let mut masked = vec![0; stacks.len()];
        let mut saturated = [0; 3];
        let mut count = |(c, value): (usize, Weighted)| {
            let plane = merged.plane(c);
            let used = plane.used[value.index];
            saturated[c] += usize::from(used == 0);
            for (bit, &stack) in plane.stacks.iter().enumerate() {
                masked[stack] += usize::from(used & (1 << bit) == 0);
            }
        };
        if filtered {
            target.weights.values_of(0..3).for_each(&mut count);
        } else {
            target.weights.values().for_each(&mut count);
        }
        merged.saturated = saturated;
        let masked = masked.into_iter().enumerate().filter(|(_, n)| *n > 0);
        merged.masked = masked.collect();
        merged
    }
}

impl Plane {
    fn of(stacks: &[Stack], target: &Target<'_>, slope: [f64; 3], channel: Option<usize>) -> Self {
        let window = &target.window;
        let sees = |s: &Stack| channel.is_none_or(|c| s.sees(c)) && !s.signal.is_empty();
        let mine: Vec<usize> = (0..stacks.len()).filter(|&i| sees(&stacks[i])).collect();
        let weights = inverse_variances(stacks, &mine, target.weights, slope, channel);
        let mut plane = Self {
            rate: vec![0.0; window.len()],
            used: vec![0; window.len()],
            weights,
            stacks: mine,
        };
        for bit in 0..plane.stacks.len() {
            let stack = &stacks[plane.stacks[bit]];
            let foretold = (bit > 0 && stack.clipped.iter().any(|&c| c))
                .then(|| foretold(&stacks[plane.stacks[bit - 1]], stack, target));
            for (i, used) in plane.used.iter_mut().enumerate() {
                let masked = stack.clipped[i] || foretold.as_ref().is_some_and(|f| f[i]);
                if !masked && !target.hot[i] {
                    *used |= 1 << bit;
                }
            }
        }
        for i in 0..window.len() {
            let c = channel.unwrap_or_else(|| channel_of(window, i));
            let rate: f64 = plane
                .shares(stacks, i, c)
                .map(|s| s.part * f64::from(stacks[s.stack].signal[i]))
                .sum();
            plane.rate[i] = rate as f32;
        }
        plane
    }

    /// True when some exposure of a value is used.
    pub(super) fn is_kept(&self, index: usize) -> bool {
        self.used[index] != 0
    }

    /// What a value of this channel is made of.
    pub(super) fn shares<'a>(
        &'a self,
        stacks: &'a [Stack],
        index: usize,
        channel: usize,
    ) -> impl Iterator<Item = Share> + 'a {
        let used = self.used[index];
        let bits = move || (0..self.stacks.len()).filter(move |bit| used & (1 << bit) != 0);
        let total: f64 = bits().map(|bit| self.weights[bit][channel]).sum();
        bits().map(move |bit| {
            let stack = self.stacks[bit];
            Share {
                stack,
                part: self.weights[bit][channel] / (total * stacks[stack].time(channel)),
            }
        })
    }
}

/// The channel a value is weighted as.
pub(super) fn channel_of(window: &Window, index: usize) -> usize {
    match window.layout {
        Layout::Bayer(cfa) => {
            let (x, y) = window.pixel(index);
            cfa.channel(y, x)
        }
        Layout::Rgb => index % 3,
        Layout::Mono => 1,
    }
}

/// Inverse variances of the rate at the crop's mean signal, by exposure and channel.
fn inverse_variances(
    stacks: &[Stack],
    mine: &[usize],
    weights: &Weights,
    slope: [f64; 3],
    channel: Option<usize>,
) -> Vec<[f64; 3]> {
    let whole = |&&i: &&usize| stacks[i].clipped_in_crop == 0;
    let pilot = mine.iter().rfind(whole).or(mine.first());
    mine.iter()
        .map(|&i| {
            let s = &stacks[i];
            [0, 1, 2].map(|c| {
                if channel.is_some_and(|only| only != c) {
                    return 0.0;
                }
                let rate = pilot.map_or(0.0, |&p| {
                    stacks[p].crop_mean(weights, c).signal / stacks[p].time(c)
                });
                let t = s.time(c);
                let shot = slope[c] * rate.max(0.0) * t;
                let read = s.dark_variance * (1.0 + s.repeats / s.dark_count);
                s.repeats * t * t / (shot + read)
            })
        })
        .collect()
}

/// Which values of `stack` come near the limit by what their neighbors of the same channel are in a shorter exposure; a
/// value's own signal does not count.
fn foretold(shorter: &Stack, stack: &Stack, target: &Target<'_>) -> Vec<bool> {
    let window = &target.window;
    let n = window.layout.values_per_pixel();
    let reach = match window.layout {
        Layout::Bayer(_) => 2,
        Layout::Mono | Layout::Rgb => 1,
    };
    let limit = FORETOLD * stack.limit;
    let ratio = [0, 1, 2].map(|c| stack.time(c) / shorter.time(c));
    let (width, height) = (window.width(), window.height());
    let mut masked = vec![false; window.len()];
    for (i, &value) in shorter.signal.iter().enumerate() {
        let foretold = f64::from(value) * ratio[channel_of(window, i)];
        if (foretold < limit && !shorter.clipped[i]) || target.hot[i] {
            continue;
        }
        let (pixel, c) = (i / n, i % n);
        let (x, y) = (pixel % width, pixel / width);
        for (j, k) in neighbors(x, y, reach) {
            if j < height && k < width {
                masked[(j * width + k) * n + c] = true;
            }
        }
    }
    masked
}

/// Row and column of the eight neighbors at this distance, those beyond the left and top edge left out.
fn neighbors(x: usize, y: usize, reach: isize) -> impl Iterator<Item = (usize, usize)> {
    let steps = [-reach, 0, reach];
    let offsets = steps.into_iter().flat_map(move |j| steps.map(|k| (j, k)));
    offsets
        .filter(|o| *o != (0, 0))
        .filter_map(move |(j, k)| y.checked_add_signed(j).zip(x.checked_add_signed(k)))
}
