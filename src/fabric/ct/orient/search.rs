//! Directions by trying them: the published oriented filter, and a fast form of it that integrates along lines.
//!
//! The filter weighs air around a line (Zhao 2011 section 5.2): the best direction has the least. Every direction of half
//! a cubemap is tried, or one in each of 192 cells and then all in the six best cells. Among equal directions the first
//! in the cubemap's order wins. The line form blurs the air once by the filter's two Gaussians and sums the result along
//! each line: nearly the same weights, at a hundredth of the work.

use super::Found;
use super::directions::{COARSE, FINE, Filter, Tap, children, half_cubemap, texel};
use crate::fabric::PackedDirection;
use crate::fabric::ct::gaussian::Field;
use crate::fabric::ct::gray::{Area, Gray};
use glam::DVec3;

/// Voxels of a box.
pub(super) const BLOCK: [usize; 3] = [ROW, 8, 8];
/// Cells of which all directions are tried.
const CELLS: usize = 6;
/// Voxels worked on together.
const ROW: usize = 32;

/// What is tried.
pub(super) struct Search {
    filter: Filter,
    line: bool,
    fine: Vec<Vec<Tap>>,
    coarse: Vec<Vec<Tap>>,
    directions: Vec<PackedDirection>,
    /// One-dimensional Gaussians of the line form and the weight of each.
    blurs: [(f32, Vec<f32>); 2],
}

impl Search {
    /// `exact`: all directions, else from coarse to fine.
    pub(super) fn new(filter: Filter, line: bool, exact: bool) -> Self {
        let taps = |d: &DVec3| {
            if line {
                filter.line(*d)
            } else {
                filter.taps(*d)
            }
        };
        let fine = half_cubemap(FINE);
        let coarse = half_cubemap(COARSE);
        let coarse = if exact { Vec::new() } else { coarse };
        Self {
            filter,
            line,
            fine: fine.iter().map(taps).collect(),
            coarse: coarse.iter().map(taps).collect(),
            directions: fine.into_iter().map(PackedDirection::pack).collect(),
            blurs: [(-2.0, bell(filter.s)), (1.0, bell(filter.t))],
        }
    }

    /// Directions of the voxels of a box from `solid` on.
    pub(super) fn directions(&self, gray: &Gray, area: &Area, solid: f32) -> Vec<Found> {
        let rows = area.rows(gray.shape);
        let n = area.dims[0];
        let voxels: Vec<(usize, usize)> = rows
            .enumerate()
            .flat_map(|(r, first)| (0..n).map(move |i| (r * ROW + i, first + i)))
            .filter(|(_, place)| gray.values[*place] >= solid)
            .collect();
        if voxels.is_empty() {
            return Vec::new();
        }
        // Rows of full length, also at the volume's end.
        let mut full = *area;
        full.dims[0] = ROW;
        let tried = Tried {
            field: self.field(gray, &full, solid),
            reach: self.filter.reach(),
            dims: full.dims,
        };
        let mut best: Vec<Best> = vec![Best::default(); ROW * full.dims[1] * full.dims[2]];
        let used = used_rows(&voxels, full.dims[1] * full.dims[2]);
        let first = if self.coarse.is_empty() {
            &self.fine
        } else {
            &self.coarse
        };
        for (index, taps) in first.iter().enumerate() {
            tried.rows(taps, &used, |at, j| best[at].take(index, j));
        }
        let mean = |b: &Best| b.sum / first.len() as f32;
        voxels
            .into_iter()
            .map(|(at, place)| {
                let coarse = &best[at];
                let (index, j) = if self.coarse.is_empty() {
                    (coarse.index[0], coarse.j[0])
                } else {
                    let cells = coarse.index.into_iter().flat_map(children);
                    self.best_of(cells, &tried, at)
                };
                Found {
                    place,
                    direction: self.directions[index],
                    confidence: contrast(j, mean(coarse)),
                    fit: j,
                }
            })
            .collect()
    }

    /// Fills in the filter's value along directions that were found otherwise.
    pub(super) fn fill_fit(&self, gray: &Gray, area: &Area, solid: f32, found: &mut [Found]) {
        let tried = Tried {
            field: self.field(gray, area, solid),
            reach: self.filter.reach(),
            dims: area.dims,
        };
        let [nx, ny, _] = gray.shape;
        let low = area.low.map(|v| v as usize);
        for voxel in found {
            let (i, j, k) = (
                voxel.place % nx,
                voxel.place / nx % ny,
                voxel.place / (nx * ny),
            );
            let row = j - low[1] + tried.dims[1] * (k - low[2]);
            let taps = &self.fine[texel(voxel.direction.unpack())];
            voxel.fit = tried.one(taps, tried.row(row) + i - low[0]);
        }
    }

    fn best_of(
        &self,
        cells: impl Iterator<Item = usize>,
        tried: &Tried,
        at: usize,
    ) -> (usize, f32) {
        let place = tried.row(at / ROW) + at % ROW;
        let values = cells.map(|index| (index, tried.one(&self.fine[index], place)));
        values.fold((0, f32::NEG_INFINITY), |best, (index, j)| {
            match j > best.1 || (j.total_cmp(&best.1).is_eq() && index < best.0) {
                true => (index, j),
                false => best,
            }
        })
    }

    /// Air of a box and its border: 1, 0 where voxels are solid; blurred for the line form.
    fn field(&self, gray: &Gray, area: &Area, solid: f32) -> Field {
        let air = |v: f32| if v >= solid { 0.0 } else { 1.0 };
        let wide = area.grown(self.filter.reach());
        if !self.line {
            return Field {
                dims: wide.dims,
                values: gray.padded(&wide, air),
            };
        }
        let border = self.blurs[0].1.len() / 2;
        let wider = wide.grown(border);
        let field = Field {
            dims: wider.dims,
            values: gray.padded(&wider, air),
        };
        let mut sum = vec![0.0; wide.dims.iter().product()];
        for (weight, kernel) in &self.blurs {
            let blurred = field.shrunk(border - kernel.len() / 2).blurred(kernel);
            for (s, v) in sum.iter_mut().zip(blurred.values) {
                *s += weight * v;
            }
        }
        Field {
            dims: wide.dims,
            values: sum,
        }
    }
}

/// `exp(-s x^2)` on voxels, scaled so that its cube, summed along a line, weighs `exp(-s r^2)` around it.
fn bell(s: f64) -> Vec<f32> {
    let reach = (12.0 / s).sqrt().ceil() as i64;
    let scale = (s / std::f64::consts::PI).sqrt().cbrt();
    (-reach..=reach)
        .map(|x| (scale * (-s * (x * x) as f64).exp()) as f32)
        .collect()
}

/// How far the best value is above the mean of all, as a share of that.
fn contrast(best: f32, mean: f32) -> f32 {
    if mean < 0.0 {
        ((best - mean) / -mean).clamp(0.0, 1.0)
    } else {
        0.0
    }
}

/// Rows of a box in which some voxel is asked for.
fn used_rows(voxels: &[(usize, usize)], count: usize) -> Vec<usize> {
    let mut used = vec![false; count];
    for (at, _) in voxels {
        used[at / ROW] = true;
    }
    (0..count).filter(|r| used[*r]).collect()
}

/// The best directions of a voxel, best first, and the sum over all.
#[derive(Clone)]
struct Best {
    j: [f32; CELLS],
    index: [usize; CELLS],
    sum: f32,
}

impl Default for Best {
    fn default() -> Self {
        Self {
            j: [f32::NEG_INFINITY; CELLS],
            index: [0; CELLS],
            sum: 0.0,
        }
    }
}

impl Best {
    fn take(&mut self, index: usize, j: f32) {
        self.sum += j;
        // Of equal ones the first stays ahead.
        let rank = self.j.iter().position(|best| j > *best);
        if let Some(rank) = rank {
            self.j[rank..].rotate_right(1);
            self.index[rank..].rotate_right(1);
            (self.j[rank], self.index[rank]) = (j, index);
        }
    }
}

/// A box on which directions are tried.
struct Tried {
    field: Field,
    reach: usize,
    dims: [usize; 3],
}

impl Tried {
    fn offset(&self, tap: &Tap) -> i64 {
        let [nx, ny, _] = self.field.dims;
        tap.0[0] + nx as i64 * (tap.0[1] + ny as i64 * tap.0[2])
    }

    /// Place in the field of the first voxel of a row of the box.
    fn row(&self, row: usize) -> usize {
        let [nx, ny, _] = self.field.dims;
        let (j, k) = (row % self.dims[1], row / self.dims[1]);
        self.reach + nx * (self.reach + j + ny * (self.reach + k))
    }

    /// Sums along a direction for whole rows.
    fn rows(&self, taps: &[Tap], rows: &[usize], mut each: impl FnMut(usize, f32)) {
        let offsets: Vec<(i64, f32)> = taps.iter().map(|t| (self.offset(t), t.1)).collect();
        for row in rows {
            let first = self.row(*row) as i64;
            let mut sums = [0.0_f32; ROW];
            for (offset, weight) in &offsets {
                let from = &self.field.values[(first + offset) as usize..][..ROW];
                for (sum, v) in sums.iter_mut().zip(from) {
                    *sum += weight * v;
                }
            }
            for (i, sum) in sums.into_iter().enumerate() {
                each(row * ROW + i, sum);
            }
        }
    }

    /// The same sum for one voxel of the field.
    fn one(&self, taps: &[Tap], place: usize) -> f32 {
        taps.iter().fold(0.0, |sum, tap| {
            sum + tap.1 * self.field.values[(place as i64 + self.offset(tap)) as usize]
        })
    }
}
