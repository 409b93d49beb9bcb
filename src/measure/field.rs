//! Which part of the frames is read, and which of its values stand for the sample square.

use crate::session::{CfaPattern, Coverage, Layout};

/// A box of pixels of the visible area.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Window {
    /// Left, top, right, bottom; one past the end.
    pub(super) bounds: [usize; 4],
    /// Pixels per row of the visible area.
    pub(super) frame_width: usize,
    pub(super) layout: Layout,
}

impl Window {
    /// The box around some boxes with a margin, inside frames of this size.
    pub(super) fn around(
        boxes: impl IntoIterator<Item = [usize; 4]>,
        margin: usize,
        [width, height]: [usize; 2],
        layout: Layout,
    ) -> Self {
        let start = [usize::MAX, usize::MAX, 0, 0];
        let [left, top, right, bottom] = boxes.into_iter().fold(start, |a, b| {
            [
                a[0].min(b[0]),
                a[1].min(b[1]),
                a[2].max(b[2]),
                a[3].max(b[3]),
            ]
        });
        Self {
            bounds: [
                left.saturating_sub(margin).min(width),
                top.saturating_sub(margin).min(height),
                (right + margin).min(width),
                (bottom + margin).min(height),
            ],
            frame_width: width,
            layout,
        }
    }

    pub(super) fn width(&self) -> usize {
        self.bounds[2].saturating_sub(self.bounds[0])
    }

    pub(super) fn height(&self) -> usize {
        self.bounds[3].saturating_sub(self.bounds[1])
    }

    /// Number of values.
    pub(super) fn len(&self) -> usize {
        self.width() * self.height() * self.layout.values_per_pixel()
    }

    /// The window's rows as index ranges into a frame's data, top to bottom.
    pub(super) fn rows(&self) -> impl Iterator<Item = std::ops::Range<usize>> + '_ {
        let n = self.layout.values_per_pixel();
        (self.bounds[1]..self.bounds[3]).map(move |y| {
            let row = y * self.frame_width;
            (row + self.bounds[0]) * n..(row + self.bounds[2]) * n
        })
    }

    /// The values of another box's data that lie in this one, which that box contains, row by row.
    pub(super) fn rows_within(&self, outer: &Window) -> Vec<std::ops::Range<usize>> {
        let n = self.layout.values_per_pixel();
        let (width, [left, top, ..]) = (outer.width(), outer.bounds);
        (self.bounds[1]..self.bounds[3])
            .map(|y| {
                let row = (y - top) * width;
                (row + self.bounds[0] - left) * n..(row + self.bounds[2] - left) * n
            })
            .collect()
    }

    /// Where a channel of the pixel (x, y) of the visible area lies in the window's data; none outside the window and
    /// where the pixel does not see the channel.
    pub(super) fn index(&self, x: usize, y: usize, channel: usize) -> Option<usize> {
        let [left, top, right, bottom] = self.bounds;
        if !(left..right).contains(&x) || !(top..bottom).contains(&y) {
            return None;
        }
        if let Layout::Bayer(cfa) = self.layout
            && cfa.channel(y, x) != channel
        {
            return None;
        }
        let pixel = (y - top) * self.width() + x - left;
        Some(match self.layout {
            Layout::Rgb => 3 * pixel + channel,
            Layout::Bayer(_) | Layout::Mono => pixel,
        })
    }

    /// The pixel of the visible area a value belongs to.
    pub(super) fn pixel(&self, index: usize) -> (usize, usize) {
        let pixel = index / self.layout.values_per_pixel();
        let width = self.width().max(1);
        (
            self.bounds[0] + pixel % width,
            self.bounds[1] + pixel / width,
        )
    }

    /// Which of [`Layout::places`] a value is of.
    pub(super) fn place(&self, index: usize) -> usize {
        match self.layout {
            Layout::Bayer(_) => {
                let (x, y) = self.pixel(index);
                CfaPattern::position(y, x)
            }
            Layout::Mono => 0,
            Layout::Rgb => index % 3,
        }
    }

    /// The layout as seen from the window's own top left pixel.
    pub(super) fn own_layout(&self) -> Layout {
        match self.layout {
            Layout::Bayer(cfa) => Layout::Bayer(cfa.shifted(self.bounds[1], self.bounds[0])),
            other => other,
        }
    }
}

/// One value that stands for a part of an area.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Weighted {
    /// In the window's data.
    pub(super) index: usize,
    /// Area it stands for, pixels.
    pub(super) weight: f64,
}

/// The values that stand for an area, channel by channel; hot ones are left out.
pub(super) struct Weights {
    pub(super) channels: [Vec<Weighted>; 3],
    /// Sum of each channel's weights.
    pub(super) total: [f64; 3],
    /// Variance of (channel mean - area mean) per unit of pixel variance of texture that is uncorrelated from pixel to
    /// pixel, because a channel sees only its own pixels.
    pub(super) sampling: [f64; 3],
    /// The same for the area mean, because a pixel on the edge shows more than the part of it inside:
    /// `sum f (1 - f) / area^2` over covered fractions f.
    pub(super) edge: f64,
    /// A value stands for all channels: each has the same list.
    alike: bool,
}

impl Weights {
    /// All values of a window alike.
    pub(super) fn whole(window: &Window, hot: &[bool]) -> Self {
        let mut channels: [Vec<Weighted>; 3] = Default::default();
        for y in window.bounds[1]..window.bounds[3] {
            for x in window.bounds[0]..window.bounds[2] {
                for (c, list) in channels.iter_mut().enumerate() {
                    if let Some(index) = window.index(x, y, c).filter(|&i| !hot[i]) {
                        list.push(Weighted { index, weight: 1.0 });
                    }
                }
            }
        }
        Self {
            total: [0, 1, 2].map(|c| channels[c].len() as f64),
            channels,
            sampling: [0.0; 3],
            edge: 0.0,
            alike: window.layout == Layout::Mono,
        }
    }

    /// The values that carry a projected square. A value stands for its own covered area and, at the places of other
    /// channels around it, for its share in linear interpolation; so a channel mean is exact for every radiance that is
    /// linear across the square, however few rows a grazing view leaves of it.
    pub(super) fn covered(coverage: &Coverage, window: &Window, hot: &[bool]) -> Self {
        let area = coverage.area();
        let squares: f64 = coverage.pixels().map(|(_, _, w)| w * w).sum();
        let mut weights = Self {
            channels: Default::default(),
            total: [0.0; 3],
            sampling: [0.0; 3],
            edge: coverage
                .pixels()
                .map(|(_, _, w)| w * (1.0 - w))
                .sum::<f64>()
                / (area * area),
            alike: window.layout == Layout::Mono,
        };
        for channel in 0..3 {
            let mut of_value = vec![0.0; window.len()];
            for (x, y, weight) in coverage.pixels() {
                let around = Around::of(window, hot, channel, x, y);
                let share = weight / around.count.max(1) as f64;
                for &i in around.values() {
                    of_value[i] += share;
                }
            }
            let list = of_value.iter().enumerate().filter(|(_, w)| **w > 0.0);
            weights.channels[channel] = list
                .map(|(index, &weight)| Weighted { index, weight })
                .collect();
            let list = &weights.channels[channel];
            let total: f64 = list.iter().map(|v| v.weight).sum();
            // sum_p (W_p / sum W - w_p / sum w)^2 over all pixels, from sum W^2, sum W w and sum w^2.
            let own: f64 = list.iter().map(|v| v.weight * v.weight).sum();
            let both: f64 = coverage
                .pixels()
                .filter_map(|(x, y, w)| Some(w * of_value[window.index(x, y, channel)?]))
                .sum();
            weights.total[channel] = total;
            weights.sampling[channel] =
                own / (total * total) - 2.0 * both / (total * area) + squares / (area * area);
        }
        weights
    }

    /// Every value once, with its channel; those of a monochrome camera with channel 0.
    pub(super) fn values(&self) -> impl Iterator<Item = (usize, Weighted)> + '_ {
        let channels = if self.alike { 1 } else { 3 };
        self.values_of(0..channels)
    }

    /// The values of some channels, each with its channel.
    pub(super) fn values_of(
        &self,
        channels: std::ops::Range<usize>,
    ) -> impl Iterator<Item = (usize, Weighted)> + '_ {
        channels.flat_map(|c| self.channels[c].iter().map(move |v| (c, *v)))
    }
}

/// The values of a channel whose plain mean is its linear interpolation at a pixel: the pixel's own, or its nearest
/// neighbors of that channel (two or four), hot ones and those outside the window left out.
pub(super) struct Around {
    found: [usize; 4],
    count: usize,
}

impl Around {
    pub(super) fn of(window: &Window, hot: &[bool], channel: usize, x: usize, y: usize) -> Self {
        const CROSS: [(isize, isize); 4] = [(-1, 0), (1, 0), (0, -1), (0, 1)];
        let offsets: &[(isize, isize)] = match window.layout {
            Layout::Bayer(cfa) => {
                let has = |dx: usize, dy: usize| cfa.channel(y + dy, x + dx) == channel;
                match (has(0, 0), has(1, 0), has(0, 1)) {
                    (true, ..) => &[(0, 0)],
                    (_, true, true) => &CROSS,
                    (_, true, false) => &CROSS[..2],
                    (_, false, true) => &CROSS[2..],
                    _ => &[(-1, -1), (1, -1), (-1, 1), (1, 1)],
                }
            }
            Layout::Mono | Layout::Rgb => {
                let own = window.index(x, y, channel);
                if own.is_some_and(|i| !hot[i]) {
                    &[(0, 0)]
                } else {
                    &CROSS
                }
            }
        };
        let mut around = Self {
            found: [0; 4],
            count: 0,
        };
        for &(dx, dy) in offsets {
            let at = x.checked_add_signed(dx).zip(y.checked_add_signed(dy));
            let index = at.and_then(|(x, y)| window.index(x, y, channel));
            if let Some(index) = index.filter(|&i| !hot[i]) {
                around.found[around.count] = index;
                around.count += 1;
            }
        }
        around
    }

    pub(super) fn values(&self) -> &[usize] {
        &self.found[..self.count]
    }
}
