//! Shadows, bright patches and slopes: 8 x 8 means over the crop against a plane, and against a plane plus a step. The means
//! overlap and taper off, so that yarns cut by their edges do not count as brightness.

use super::Picture;
use super::planes::{Grown, Plane, robust};
use super::{CheckOptions, Evenness, Step};

/// Blocks along each side of the crop's box.
const BLOCKS: usize = 8;
/// Fine cells per block, along each side.
const FINE: usize = 3;
/// How fine cells around a block's middle one count, along each side.
const TAPER: [f64; 5] = [1.0, 2.0, 3.0, 2.0, 1.0];
/// Directions and places of the edges that are tried.
const DIRECTIONS: usize = 24;
/// A step must exceed its standard error by this factor: the best of several hundred edges is looked at.
const SIGNIFICANT: f64 = 5.0;
/// A part has at least this many blocks.
const FEWEST: usize = 3;

/// Slope and steps of the brightness across the square.
pub(super) fn evenness(picture: &Picture, planes: &[Plane], options: &CheckOptions) -> Evenness {
    let blocks = Blocks::of(picture, planes);
    if blocks.all.len() < 4 * FEWEST {
        return Evenness::default();
    }
    let values: Vec<f64> = blocks.all.iter().map(|b| b.brightness).collect();
    let (plane, rest) = blocks.fit(&values);
    let step = blocks.step(&rest, &values, options);
    // The step explains part of what the plane had to.
    let step = step.filter(|step| blocks.range(&step.plane) < options.slope_limit);
    let slope = blocks.range(step.as_ref().map_or(&plane, |s| &s.plane));
    let sigma = blocks.variance(&rest, 3).sqrt();
    // The ends of a plane through n blocks are known to about three standard errors of their mean; four times that.
    let certain = slope - options.slope_limit > 12.0 * sigma / (values.len() as f64).sqrt();
    Evenness {
        slope: Some(slope),
        steep: certain,
        step: step.and_then(|found| blocks.describe(picture, &found)),
    }
}

/// A part of the blocks, how much it stands off, and the plane that is left without it.
struct Found {
    part: Vec<bool>,
    depth: f64,
    plane: [f64; 3],
}

struct Block {
    /// Place in the box, -1..=1.
    at: [f64; 2],
    /// Column and row of the grid.
    cell: [usize; 2],
    /// Pixels covered.
    area: f64,
    /// Over the mean.
    brightness: f64,
    /// Its standard deviation from noise.
    noise: f64,
}

struct Blocks {
    all: Vec<Block>,
    /// Box of the square in pixels of the picture: first pixel and size.
    first: [usize; 2],
    size: [usize; 2],
}

impl Blocks {
    fn of(picture: &Picture, planes: &[Plane]) -> Self {
        let (first, size) = square_box(picture);
        let cells = FINE * BLOCKS;
        let mut sums = vec![[0.0f64; 4]; cells * cells];
        let place = |k: usize| -> Vec<usize> {
            let places = 0..picture.size[k];
            places
                .map(|p| p.saturating_sub(first[k]) * cells / size[k].max(1))
                .collect()
        };
        let (columns, rows) = (place(0), place(1));
        for plane in planes {
            let mean = plane.mean();
            if mean <= 0.0 {
                continue;
            }
            for y in 0..plane.height {
                for x in 0..plane.width {
                    let i = y * plane.width + x;
                    let weight = f64::from(plane.weight[i]);
                    if weight > 0.0 {
                        let [x, y] = plane.pixel(x, y);
                        let sum = &mut sums[rows[y] * cells + columns[x]];
                        sum[0] += weight * f64::from(plane.values[i]);
                        sum[1] += weight * mean;
                        sum[2] += (weight * f64::from(plane.noise[i])).powi(2);
                        sum[3] += weight;
                    }
                }
            }
        }
        let all: Vec<Block> = (0..BLOCKS * BLOCKS)
            .map(|i| Block::of(&sums, [i % BLOCKS, i / BLOCKS]))
            .collect();
        let largest = all.iter().map(|b| b.area).fold(0.0, f64::max);
        Self {
            all: all.into_iter().filter(|b| b.area > 0.3 * largest).collect(),
            first,
            size,
        }
    }

    /// Least squares plane, as value at the middle and slopes per half box, and what it leaves.
    fn fit(&self, values: &[f64]) -> ([f64; 3], Vec<f64>) {
        let mut normal = [[0.0; 3]; 3];
        let mut right = [0.0; 3];
        for (block, value) in self.all.iter().zip(values) {
            let terms = block.terms();
            for i in 0..3 {
                right[i] += terms[i] * value;
                for j in 0..3 {
                    normal[i][j] += terms[i] * terms[j];
                }
            }
        }
        let plane = solve(normal, right);
        let left = |(b, value): (&Block, &f64)| value - dot(&b.terms(), &plane);
        (plane, self.all.iter().zip(values).map(left).collect())
    }

    /// Largest less smallest value of a plane over the blocks.
    fn range(&self, plane: &[f64; 3]) -> f64 {
        let values = self.all.iter().map(|b| dot(&b.terms(), plane));
        let (low, high) = values.fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)));
        high - low
    }

    /// The part that, lifted by one depth, explains most of what a plane leaves.
    fn step(&self, rest: &[f64], values: &[f64], options: &CheckOptions) -> Option<Found> {
        let square = |r: &[f64]| r.iter().map(|x| x * x).sum::<f64>();
        let mut best: Option<(f64, Vec<bool>, f64)> = None;
        for part in self.half_planes().chain(self.patch(values)) {
            let (_, own) = self.fit(&indicator(&part));
            let size = square(&own);
            if size < 1e-6 {
                continue;
            }
            let depth = dot(&own, rest) / size;
            let gain = depth * depth * size;
            if best.as_ref().is_none_or(|b| gain > b.0) {
                best = Some((gain, part, depth));
            }
        }
        let (gain, part, depth) = best?;
        let lowered = values
            .iter()
            .zip(indicator(&part))
            .map(|(v, i)| v - depth * i);
        let (plane, left) = self.fit(&lowered.collect::<Vec<f64>>());
        let told = depth.abs() > options.step_limit
            && gain > SIGNIFICANT.powi(2) * self.variance(&left, 6);
        told.then_some(Found { part, depth, plane })
    }

    /// Variance of what a fit of some parameters leaves of one block. A yarn that runs through the crop makes blocks of one
    /// row alike: then the rows' means tell.
    fn variance(&self, left: &[f64], parameters: usize) -> f64 {
        let free = self.all.len().saturating_sub(parameters).max(1) as f64;
        let single = left.iter().map(|x| x * x).sum::<f64>() / free;
        let noise = self.all.iter().map(|b| b.noise * b.noise).sum::<f64>() / self.all.len() as f64;
        let lines = |k: usize| {
            let mut sums = [[0.0; 2]; BLOCKS];
            for (block, x) in self.all.iter().zip(left) {
                let sum = &mut sums[block.cell[k]];
                sum[0] += x;
                sum[1] += 1.0;
            }
            let used = sums.iter().filter(|s| s[1] > 0.0);
            let count = used.clone().count() as f64;
            // Two of the plane's parameters and one of the step's are spent on each direction.
            used.map(|s| s[0] * s[0] / s[1]).sum::<f64>() / (count - 3.0).max(1.0)
        };
        single.max(noise).max(lines(0)).max(lines(1))
    }

    /// All ways to cut the blocks in two by a straight edge; the smaller part is true.
    fn half_planes(&self) -> impl Iterator<Item = Vec<bool>> + '_ {
        (0..DIRECTIONS).flat_map(move |k| {
            let (sin, cos) = (std::f64::consts::PI * k as f64 / DIRECTIONS as f64).sin_cos();
            let along: Vec<f64> = self
                .all
                .iter()
                .map(|b| cos * b.at[0] + sin * b.at[1])
                .collect();
            let edges = 3 * BLOCKS;
            (1..edges).filter_map(move |e| {
                let edge = (2.0 * e as f64 / edges as f64 - 1.0) * (cos.abs() + sin.abs());
                let part: Vec<bool> = along.iter().map(|a| *a > edge).collect();
                self.smaller(part)
            })
        })
    }

    /// The part or its complement, whichever is smaller; none when it is too small.
    fn smaller(&self, part: Vec<bool>) -> Option<Vec<bool>> {
        let count = part.iter().filter(|p| **p).count();
        let few = count.min(part.len() - count);
        let flip = 2 * count > part.len();
        (few >= FEWEST).then(|| part.iter().map(|p| *p != flip).collect())
    }

    /// The blocks that stand off most others: a patch of any shape.
    fn patch(&self, values: &[f64]) -> Option<Vec<bool>> {
        let as_f32: Vec<f32> = values.iter().map(|v| *v as f32).collect();
        let (center, scatter) = robust(&as_f32)?;
        let sign = |v: &&f64| (**v as f32 - center).abs() > 5.0 * scatter;
        let (dark, bright): (Vec<&f64>, Vec<&f64>) = values
            .iter()
            .filter(sign)
            .partition(|v| (**v as f32) < center);
        let darker = dark.len() > bright.len();
        let part = as_f32.iter().map(|v| {
            let off = if darker { center - v } else { v - center };
            off > 5.0 * scatter
        });
        self.smaller(part.collect())
    }

    fn describe(&self, picture: &Picture, found: &Found) -> Option<Step> {
        let mut region = Grown::empty();
        let (mut area, mut whole, mut middle) = (0.0, 0.0, [0.0; 2]);
        let size = self.size.map(|s| s.div_ceil(BLOCKS));
        for (block, inside) in self.all.iter().zip(&found.part) {
            whole += block.area;
            if *inside {
                area += block.area;
                let first = [0, 1].map(|k| self.first[k] + block.cell[k] * self.size[k] / BLOCKS);
                region.add(first, 1);
                region.add([0, 1].map(|k| first[k] + size[k] - 1), 1);
                middle = [0, 1].map(|k| middle[k] + block.area * block.at[k]);
            }
        }
        Some(Step {
            part: name(middle.map(|m| m / area)),
            region: region.crop(picture)?,
            fraction: area / whole,
            depth: found.depth,
        })
    }
}

impl Block {
    /// From brightness, its mean, the variance of its noise, and area of the fine cells.
    fn of(sums: &[[f64; 4]], cell: [usize; 2]) -> Self {
        let cells = FINE * BLOCKS;
        let reach = TAPER.len() / 2;
        let mut tapered = [0.0; 3];
        let mut area = 0.0;
        // Column and row of the fine cells, counted from `reach` cells before the first.
        let span = |k: usize| (0..TAPER.len()).map(move |d| cell[k] * FINE + FINE / 2 + d);
        for (y, weight_y) in span(1).zip(TAPER) {
            for (x, weight_x) in span(0).zip(TAPER) {
                let inside = reach..reach + cells;
                if !inside.contains(&x) || !inside.contains(&y) {
                    continue;
                }
                let sum = &sums[(y - reach) * cells + x - reach];
                let weight = weight_x * weight_y;
                tapered[0] += weight * sum[0];
                tapered[1] += weight * sum[1];
                tapered[2] += weight * weight * sum[2];
                // The block's own cells are those of full and next to full weight.
                if weight_x.min(weight_y) > 1.0 {
                    area += sum[3];
                }
            }
        }
        Self {
            at: cell.map(|c| (2 * c + 1) as f64 / BLOCKS as f64 - 1.0),
            cell,
            area,
            brightness: tapered[0] / tapered[1],
            noise: tapered[2].sqrt() / tapered[1],
        }
    }

    fn terms(&self) -> [f64; 3] {
        [1.0, self.at[0], self.at[1]]
    }
}

/// Where a part lies, by its middle in the box (-1..=1, x right, y down).
fn name(middle: [f64; 2]) -> &'static str {
    let third = |m: f64| {
        if m < -0.25 {
            0
        } else {
            1 + usize::from(m > 0.25)
        }
    };
    [
        ["top left", "top", "top right"],
        ["left", "middle", "right"],
        ["bottom left", "bottom", "bottom right"],
    ][third(middle[1])][third(middle[0])]
}

/// First pixel and size of the box around the covered pixels, in the picture.
pub(super) fn square_box(picture: &Picture) -> ([usize; 2], [usize; 2]) {
    let [width, _] = picture.size;
    let (mut low, mut high) = ([usize::MAX; 2], [0; 2]);
    for (y, row) in picture.covered.chunks(width.max(1)).enumerate() {
        let first = row.iter().position(|c| *c > 0.0);
        let last = row.iter().rposition(|c| *c > 0.0);
        if let (Some(first), Some(last)) = (first, last) {
            low = [low[0].min(first), low[1].min(y)];
            high = [high[0].max(last + 1), high[1].max(y + 1)];
        }
    }
    if high == [0; 2] {
        return ([0; 2], [0; 2]);
    }
    (low, [high[0] - low[0], high[1] - low[1]])
}

fn indicator(part: &[bool]) -> Vec<f64> {
    part.iter().map(|p| f64::from(u8::from(*p))).collect()
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Three linear equations by Cramer's rule.
fn solve(m: [[f64; 3]; 3], right: [f64; 3]) -> [f64; 3] {
    let determinant = |m: &[[f64; 3]; 3]| -> f64 {
        let minor = |j: usize, k: usize| m[1][j] * m[2][k] - m[1][k] * m[2][j];
        m[0][0] * minor(1, 2) - m[0][1] * minor(0, 2) + m[0][2] * minor(0, 1)
    };
    let whole = determinant(&m);
    [0, 1, 2].map(|k| {
        let mut replaced = m;
        for i in 0..3 {
            replaced[i][k] = right[i];
        }
        determinant(&replaced) / whole
    })
}
