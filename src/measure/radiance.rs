//! A configuration's crop in normalized radiance, value by value.

use super::Picture;
use super::field::Weights;
use super::merge::{Merged, channel_of};
use super::noise::Scatter;
use super::stack::{Stack, Target};
use super::white::{Flat, White};
use crate::session::{Coverage, Layout};

/// Normalized radiance of every value of a window, and what its noise is made of. One plane for all channels; or three,
/// for frames through filters.
pub(super) struct Radiance {
    planes: Vec<Values>,
}

/// One number per value of the window.
#[derive(Default)]
pub(super) struct Values {
    pub(super) value: Vec<f32>,
    /// Its variance is `a shot + constant`, `a` the slope of the photon transfer.
    pub(super) shot: Vec<f32>,
    pub(super) constant: Vec<f32>,
}

impl Radiance {
    /// Divides merged rates by those of the white standard and by the flat field.
    pub(super) fn of(
        merged: &Merged,
        stacks: &[Stack],
        target: &Target<'_>,
        white: &White,
        flat: Option<&Flat>,
    ) -> Self {
        let filtered = stacks.iter().any(|s| s.filter.is_some());
        let window = &target.window;
        let plane = |only: Option<usize>| {
            let mut values = Values::default();
            for index in 0..window.len() {
                let c = only.unwrap_or_else(|| channel_of(window, index));
                let (x, y) = window.pixel(index);
                let scale = scale(white, flat, c, index, (x, y));
                let (mut rate, mut shot, mut constant) = (0.0, 0.0, 0.0);
                let plane = merged.plane(c);
                if !plane.is_kept(index) {
                    values.value.push(0.0);
                    values.shot.push(0.0);
                    values.constant.push(0.0);
                    continue;
                }
                for share in plane.shares(stacks, index, c) {
                    let s = &stacks[share.stack];
                    let signal = f64::from(s.signal[index]);
                    rate += share.part * signal;
                    let square = share.part * share.part;
                    shot += square * signal.max(0.0) / s.repeats;
                    constant += square * s.dark_variance * (1.0 / s.repeats + 1.0 / s.dark_count);
                }
                values.value.push((scale * rate) as f32);
                values.shot.push((scale * scale * shot) as f32);
                values.constant.push((scale * scale * constant) as f32);
            }
            values
        };
        Self {
            planes: if filtered {
                [0, 1, 2].map(|c| plane(Some(c))).into()
            } else {
                vec![plane(None)]
            },
        }
    }

    /// The plane a channel lies in.
    pub(super) fn plane(&self, channel: usize) -> &Values {
        &self.planes[if self.planes.len() > 1 { channel } else { 0 }]
    }

    /// The mean over the crop in one channel.
    pub(super) fn mean(&self, weights: &Weights, channel: usize) -> f64 {
        let values = &self.plane(channel).value;
        let list = weights.channels[channel].iter();
        let sum: f64 = list.map(|v| v.weight * f64::from(values[v.index])).sum();
        sum / weights.total[channel]
    }

    /// What people and checks look at.
    pub(super) fn picture(
        &self,
        merged: &Merged,
        target: &Target<'_>,
        coverage: &Coverage,
        corners: Vec<[f64; 2]>,
        scatter: &Scatter,
    ) -> Picture {
        let window = &target.window;
        let size = [window.width(), window.height()];
        let mut covered = vec![0.0; size[0] * size[1]];
        for (x, y, weight) in coverage.pixels() {
            if (window.bounds[0]..window.bounds[2]).contains(&x)
                && (window.bounds[1]..window.bounds[3]).contains(&y)
            {
                covered[(y - window.bounds[1]) * size[0] + x - window.bounds[0]] = weight as f32;
            }
        }
        let mut picture = Picture {
            origin: [window.bounds[0], window.bounds[1]],
            size,
            layout: window.own_layout(),
            values: Vec::new(),
            noise: Vec::new(),
            kept: Vec::new(),
            covered,
            corners,
        };
        let mut push = |channel: usize, index: usize| {
            let values = self.plane(channel);
            let kept = merged.plane(channel).is_kept(index);
            let variance = scatter.slope[channel] * f64::from(values.shot[index])
                + f64::from(values.constant[index]);
            picture.values.push(values.value[index]);
            picture.noise.push(variance.sqrt() as f32);
            picture.kept.push(kept);
        };
        if self.planes.len() > 1 {
            for index in 0..window.len() {
                (0..3).for_each(|c| push(c, index));
            }
            picture.layout = Layout::Rgb;
        } else {
            (0..window.len()).for_each(|index| push(channel_of(window, index), index));
        }
        picture
    }
}

/// Normalized radiance per rate of one value.
pub(super) fn scale(
    white: &White,
    flat: Option<&Flat>,
    channel: usize,
    index: usize,
    (x, y): (usize, usize),
) -> f64 {
    let rate = white.rate(channel, &white.terms(x, y));
    let flat = flat.map_or(1.0, |f| f64::from(f.response[index]));
    white.radiance[channel] / (rate * flat)
}
