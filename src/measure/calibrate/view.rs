//! A box of a RAW frame, values as they are, mean over repeats.

use crate::measure::RawFrame;
use crate::session::Layout;

/// A box of a frame, mean over its repeats.
pub(super) struct View {
    layout: Layout,
    /// Width of the whole frame.
    width: usize,
    /// Left, top, right, bottom; one past the end.
    bounds: [usize; 4],
    /// By value of the box, row by row; frames are added up.
    values: Vec<f32>,
    /// False where a value is clipped in any of the frames, or hot.
    kept: Vec<bool>,
    frames: f32,
    /// Black level by place, as the file states it.
    pub(super) black: [f64; 4],
}

/// A value of a view: its pixel's middle, its place in the layout, what it reads.
#[derive(Clone, Copy)]
pub(super) struct Value {
    pub(super) at: [f64; 2],
    pub(super) place: usize,
    pub(super) reading: f64,
}

impl View {
    /// The box of these frames, which are of one pose and exposure. `hot` lists pixels (column, row) to leave out.
    pub(super) fn new(
        first: &RawFrame,
        bounds: [usize; 4],
        limit: f64,
        hot: &[[usize; 2]],
    ) -> Self {
        let [left, top, right, bottom] = bounds;
        let n = first.layout.values_per_pixel();
        let values = (right - left) * (bottom - top) * n;
        let mut view = Self {
            layout: first.layout,
            width: first.width,
            bounds,
            values: vec![0.0; values],
            kept: vec![true; values],
            frames: 0.0,
            black: first.black,
        };
        for &[x, y] in hot {
            if (left..right).contains(&x) && (top..bottom).contains(&y) {
                let start = ((y - top) * (right - left) + x - left) * n;
                view.kept[start..start + n].fill(false);
            }
        }
        view.add(first, limit);
        view
    }

    /// Adds a repeat.
    pub(super) fn add(&mut self, frame: &RawFrame, limit: f64) {
        let [left, top, right, bottom] = self.bounds;
        let n = self.layout.values_per_pixel();
        let rows = (top..bottom)
            .flat_map(|y| &frame.data[(y * self.width + left) * n..(y * self.width + right) * n]);
        for ((sum, kept), &raw) in self.values.iter_mut().zip(&mut self.kept).zip(rows) {
            *sum += f32::from(raw);
            *kept &= f64::from(raw) < limit;
        }
        self.frames += 1.0;
    }

    /// The fraction of values that are clipped or hot.
    pub(super) fn clipped(&self) -> f64 {
        let clipped = self.kept.iter().filter(|k| !**k).count();
        clipped as f64 / self.kept.len().max(1) as f64
    }

    /// The kept values of the pixel in this column and row of the frame.
    pub(super) fn pixel(&self, x: usize, y: usize) -> impl Iterator<Item = Value> + '_ {
        let [left, top, right, bottom] = self.bounds;
        let n = self.layout.values_per_pixel();
        let inside = (left..right).contains(&x) && (top..bottom).contains(&y);
        let first = match inside {
            true => ((y - top) * (right - left) + x - left) * n,
            false => 0,
        };
        let values = (0..if inside { n } else { 0 }).filter(move |k| self.kept[first + k]);
        values.map(move |k| Value {
            at: [x as f64 + 0.5, y as f64 + 0.5],
            place: self.layout.place(self.width, (y * self.width + x) * n + k),
            reading: f64::from(self.values[first + k] / self.frames),
        })
    }

    /// The values of all pixels whose middles lie this close (pixels, in x and y) to a point.
    pub(super) fn around(&self, [x, y]: [f64; 2], reach: f64) -> impl Iterator<Item = Value> + '_ {
        let range = |middle: f64, low: usize, high: usize| {
            let first = (middle - reach).floor().max(low as f64) as usize;
            let last = ((middle + reach).ceil().max(0.0) as usize).min(high);
            first..last
        };
        let [left, top, right, bottom] = self.bounds;
        let columns = range(x, left, right);
        range(y, top, bottom)
            .flat_map(move |y| columns.clone().map(move |x| (x, y)))
            .flat_map(|(x, y)| self.pixel(x, y))
    }

    /// What dark and bright squares read, by place: the values one twentieth from either end.
    pub(super) fn levels(&self) -> [[f64; 2]; 4] {
        let [left, top, right, bottom] = self.bounds;
        let mut sorted: [Vec<f64>; 4] = Default::default();
        for (x, y) in (top..bottom).flat_map(|y| (left..right).map(move |x| (x, y))) {
            for value in self.pixel(x, y) {
                sorted[value.place].push(value.reading);
            }
        }
        sorted.map(|mut values| {
            values.sort_by(f64::total_cmp);
            let at = |part: f64| {
                let last = values.len().saturating_sub(1) as f64;
                values.get((part * last) as usize).copied()
            };
            [at(0.05).unwrap_or(0.0), at(0.95).unwrap_or(0.0)]
        })
    }
}
