//! Which fraction of each pixel a polygon covers.
//!
//! Scan conversion with exact areas: every edge adds, in each row it crosses, the signed area to its right to the pixel it
//! lies in and the rest to the next one; a running sum along the row is then the covered fraction. Work grows with the
//! length of the outline plus the pixels inside. Edges must not cross one another.

/// The pixels of one image row that a polygon covers.
#[derive(Debug, Clone, PartialEq)]
pub struct RowSpan {
    /// Row.
    pub y: usize,
    /// First column.
    pub x: usize,
    /// Covered fraction of the pixels `x, x + 1, ...`, each in 0..=1.
    pub weights: Vec<f64>,
}

/// Which fraction of each pixel a polygon covers, exactly.
#[derive(Debug, Clone, PartialEq)]
pub struct Coverage {
    /// The rows it touches, from top to bottom.
    pub rows: Vec<RowSpan>,
}

impl Coverage {
    /// The coverage of a simple polygon of either orientation, convex or not, whose corners (pixels; integer = pixel
    /// corner) lie in 0..=width, 0..=height.
    pub(super) fn of_polygon(corners: &[[f64; 2]], [width, height]: [usize; 2]) -> Self {
        let low = |axis: usize| corners.iter().map(|p| p[axis]).fold(f64::MAX, f64::min);
        let high = |axis: usize| corners.iter().map(|p| p[axis]).fold(f64::MIN, f64::max);
        let (left, top) = (low(0).floor() as usize, low(1).floor() as usize);
        let right = (high(0).ceil() as usize).min(width);
        let bottom = (high(1).ceil() as usize).min(height);
        let mut sheet = Sheet::new([left, top, right.max(left), bottom.max(top)]);
        for (i, &p) in corners.iter().enumerate() {
            sheet.add_edge(p, corners[(i + 1) % corners.len()]);
        }
        Self {
            rows: sheet.into_rows(),
        }
    }

    /// Column, row and weight of every covered pixel, row by row.
    pub fn pixels(&self) -> impl Iterator<Item = (usize, usize, f64)> + '_ {
        self.rows.iter().flat_map(|row| {
            let weighted = row.weights.iter().enumerate();
            weighted.map(move |(i, &w)| (row.x + i, row.y, w))
        })
    }

    /// The covered area in pixels.
    pub fn area(&self) -> f64 {
        self.pixels().map(|(_, _, w)| w).sum()
    }

    /// The smallest box of whole pixels around it: left, top, right, bottom (right and bottom are one past the end).
    pub fn bounds(&self) -> [usize; 4] {
        let left = self.rows.iter().map(|r| r.x).min().unwrap_or(0);
        let right = self.rows.iter().map(|r| r.x + r.weights.len()).max();
        let top = self.rows.iter().map(|r| r.y).min().unwrap_or(0);
        let bottom = self.rows.iter().map(|r| r.y + 1).max().unwrap_or(0);
        [left, top, right.unwrap_or(0), bottom]
    }
}

/// The steps of the running sums over the box around a polygon.
struct Sheet {
    left: usize,
    top: usize,
    columns: usize,
    /// One column more than the box, for what an edge hands on to the right of it.
    steps: Vec<f64>,
    /// Per row, the outline's smallest and largest x.
    extents: Vec<[f64; 2]>,
}

impl Sheet {
    fn new([left, top, right, bottom]: [usize; 4]) -> Self {
        let columns = right - left + 1;
        Self {
            left,
            top,
            columns,
            steps: vec![0.0; columns * (bottom - top)],
            extents: vec![[f64::MAX, f64::MIN]; bottom - top],
        }
    }

    fn add_edge(&mut self, p: [f64; 2], q: [f64; 2]) {
        let (sign, upper, lower) = match p[1] < q[1] {
            true => (1.0, p, q),
            false => (-1.0, q, p),
        };
        let height = lower[1] - upper[1];
        let at = |y: f64| upper[0] + (lower[0] - upper[0]) * ((y - upper[1]) / height);
        let first = upper[1].floor() as usize - self.top;
        let last = (lower[1].ceil() as usize - self.top).min(self.extents.len());
        for row in first..last {
            let y = (row + self.top) as f64;
            let (begin, end) = (upper[1].max(y), lower[1].min(y + 1.0));
            let x_begin = if begin > upper[1] {
                at(begin)
            } else {
                upper[0]
            };
            let x_end = if end < lower[1] { at(end) } else { lower[0] };
            self.add_piece(row, sign * (end - begin), x_begin, x_end);
        }
    }

    /// A piece of an edge within one row, of signed height `rise`.
    fn add_piece(&mut self, row: usize, rise: f64, x_begin: f64, x_end: f64) {
        let (low, high) = (x_begin.min(x_end), x_begin.max(x_end));
        let extent = &mut self.extents[row];
        *extent = [extent[0].min(low), extent[1].max(high)];
        let steps = &mut self.steps[row * self.columns..(row + 1) * self.columns];
        let first = low.floor() as usize;
        // A piece that ends on a pixel boundary leaves nothing for the next column.
        let last = (high.ceil() as usize).max(first + 1);
        for column in first..last {
            let (begin, end) = (low.max(column as f64), high.min((column + 1) as f64));
            let share = match last - first {
                1 => rise,
                _ => rise * ((end - begin) / (high - low)),
            };
            let own = share * ((column + 1) as f64 - 0.5 * (begin + end));
            let place = column - self.left;
            if place < steps.len() {
                steps[place] += own;
            }
            if place + 1 < steps.len() {
                steps[place + 1] += share - own;
            }
        }
    }

    fn into_rows(self) -> Vec<RowSpan> {
        let mut rows = Vec::with_capacity(self.extents.len());
        for (i, &[low, high]) in self.extents.iter().enumerate() {
            let first = low.floor() as usize;
            let last = (high.ceil() as usize).min(self.left + self.columns - 1);
            if low > high || first >= last {
                continue;
            }
            let start = i * self.columns + first - self.left;
            let mut sum = 0.0_f64;
            let running = self.steps[start..start + last - first].iter().map(|step| {
                sum += step;
                // Rounding of the sum may leave a bit below 0 or above 1.
                sum.abs().min(1.0)
            });
            rows.push(RowSpan {
                y: self.top + i,
                x: first,
                weights: running.collect(),
            });
        }
        rows
    }
}
