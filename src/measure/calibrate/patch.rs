//! The values of a frame that something is measured on.

use super::recording::Reader;
use crate::base::{Error, Result};
use crate::session::{Coverage, Filter, Layout};
use std::ops::Range;

/// One value: where it lies in a frame's data, its place in the layout, and how much of it counts.
#[derive(Debug, Clone, Copy)]
pub(super) struct Spot {
    pub(super) index: usize,
    pub(super) place: usize,
    /// 0: left out.
    pub(super) weight: f64,
}

/// A box of pixels with weights.
#[derive(Debug, Clone)]
pub(super) struct Patch {
    layout: Layout,
    width: usize,
    /// Left, top, right, bottom; one past the end.
    bounds: [usize; 4],
    /// By value of the box, row by row.
    weights: Vec<f32>,
}

impl Patch {
    /// All pixels of a box.
    pub(super) fn of_box(reader: &Reader<'_>, bounds: [usize; 4]) -> Result<Self> {
        let [left, top, right, bottom] = bounds;
        let inside = right <= reader.size[0] && bottom <= reader.size[1];
        if !inside || right < left + 8 || bottom < top + 8 {
            return Err(Error::new(format!(
                "the box from column {left}, row {top} to column {right}, row {bottom} does not fit frames of {} x {} pixels, or is smaller than 8 x 8",
                reader.size[0], reader.size[1]
            )).with_hint("choose a box inside the image, evenly lit and well over a thousand pixels large"));
        }
        let values = (right - left) * (bottom - top) * reader.layout.values_per_pixel();
        Ok(Self {
            layout: reader.layout,
            width: reader.size[0],
            bounds,
            weights: vec![1.0; values],
        })
    }

    /// All values of a frame; the n-th spot is the n-th value.
    pub(super) fn whole(reader: &Reader<'_>) -> Result<Self> {
        Self::of_box(reader, [0, 0, reader.size[0], reader.size[1]])
    }

    /// A square of a quarter of the image's shorter side around an image point, moved inside the image.
    pub(super) fn around(reader: &Reader<'_>, center: [f64; 2]) -> Result<Self> {
        let side = (reader.size[0].min(reader.size[1]) / 4).max(8);
        let start = |axis: usize| -> usize {
            let last = reader.size[axis].saturating_sub(side) as f64;
            (center[axis] - 0.5 * side as f64).round().clamp(0.0, last) as usize
        };
        let (left, top) = (start(0), start(1));
        Self::of_box(reader, [left, top, left + side, top + side])
    }

    /// The pixels of a projected square, by the area that is covered.
    pub(super) fn covered(reader: &Reader<'_>, coverage: &Coverage) -> Self {
        let bounds = coverage.bounds();
        let [left, top, right, bottom] = bounds;
        let n = reader.layout.values_per_pixel();
        let columns = (right - left) * n;
        let mut weights = vec![0.0; columns * (bottom - top)];
        for (x, y, weight) in coverage.pixels() {
            let first = (y - top) * columns + (x - left) * n;
            weights[first..first + n].fill(weight as f32);
        }
        Self {
            layout: reader.layout,
            width: reader.size[0],
            bounds,
            weights,
        }
    }

    /// How many spots there are, those left out included.
    pub(super) fn len(&self) -> usize {
        self.weights.len()
    }

    /// All spots, row by row.
    pub(super) fn spots(&self) -> impl Iterator<Item = Spot> + '_ {
        let n = self.layout.values_per_pixel();
        let [left, top, right, bottom] = self.bounds;
        let indices = (top..bottom)
            .flat_map(move |y| (y * self.width + left) * n..(y * self.width + right) * n);
        indices.zip(&self.weights).map(|(index, &weight)| Spot {
            index,
            place: self.layout.place(self.width, index),
            weight: f64::from(weight),
        })
    }

    /// Leaves out the marked spots.
    pub(super) fn leave_out(&mut self, marked: &[bool]) {
        for (weight, _) in self.weights.iter_mut().zip(marked).filter(|(_, m)| **m) {
            *weight = 0.0;
        }
    }

    /// The spot of a pixel's first value, and how many it has; none outside the box.
    pub(super) fn spots_of(&self, x: usize, y: usize) -> Range<usize> {
        let [left, top, right, bottom] = self.bounds;
        if !(left..right).contains(&x) || !(top..bottom).contains(&y) {
            return 0..0;
        }
        let n = self.layout.values_per_pixel();
        let first = ((y - top) * (right - left) + x - left) * n;
        first..first + n
    }

    /// The channels a value of this place tells of, behind this filter: without a filter, a value without color stands
    /// for all three.
    pub(super) fn channels(&self, filter: Option<Filter>, place: usize) -> Range<usize> {
        channels(self.layout, filter, place)
    }

    /// How many channels are copies of one another behind this filter: three for a sensor without color, else one.
    pub(super) fn copies(&self, filter: Option<Filter>) -> f64 {
        self.channels(filter, 0).len() as f64
    }

    /// How messages call it.
    pub(super) fn region(&self) -> String {
        let [left, top, right, bottom] = self.bounds;
        format!(
            "columns {left} to {}, rows {top} to {}",
            right.saturating_sub(1),
            bottom.saturating_sub(1)
        )
    }
}

/// See [`Patch::channels`].
pub(super) fn channels(layout: Layout, filter: Option<Filter>, place: usize) -> Range<usize> {
    let one = match (layout, filter) {
        (Layout::Bayer(cfa), _) => cfa.channels()[place],
        (Layout::Rgb, _) => place,
        (Layout::Mono, Some(filter)) => filter.channel(),
        (Layout::Mono, None) => return 0..3,
    };
    one..one + 1
}

/// The names of the channels in messages.
pub(super) const NAMES: [&str; 3] = ["red", "green", "blue"];
