//! Spots that stand out of the texture.
//!
//! The crop is cut into some 36 blocks. A texture repeats: each block's brightest value lies about equally far above that
//! block's median. A glint's does not. So a value is far off when it exceeds the blocks' typical extreme by as much again
//! as that extreme stands off the median, by ten times the extremes' own scatter, and by seven times its noise. The same
//! is asked of means of 4 x 4, 8 x 8 and 16 x 16 cells, in which a fine weave is gone and a grain of dust in it is not;
//! where these are too few for blocks, eight robust standard deviations of them all are the bar.
//! What fills more than about a third of the blocks counts as texture.

use super::Picture;
use super::planes::{Grown, Plane, median, robust};
use super::{CheckOptions, Outliers};

/// Blocks of a crop, about.
const BLOCKS: f64 = 36.0;
/// Fewer whole blocks than this have no typical extreme.
const ENOUGH_BLOCKS: usize = 16;
/// Fewer means than this have no robust standard deviation.
const ENOUGH_CELLS: usize = 30;
/// Times that standard deviation.
const SIGMAS: f32 = 8.0;
/// Times the scatter of the blocks' extremes.
const SCATTER: f32 = 10.0;
/// Times a value's noise.
const NOISE: f32 = 7.0;
/// Cells per side of the means that are looked at next: of 4, 8 and 16 in all.
const COARSER: [usize; 3] = [4, 2, 2];
/// Values from which a block's median is taken, at most about.
const MEDIAN_OF: usize = 512;

const BRIGHT: u8 = 1;
const DARK: u8 = 2;

/// Finds bright and dark spots, and takes them out of the planes.
pub(super) fn outliers(
    picture: &Picture,
    planes: &mut [Plane],
    options: &CheckOptions,
) -> [Outliers; 2] {
    let mut mask = vec![0u8; picture.size[0] * picture.size[1]];
    for plane in planes.iter_mut() {
        let fine = plane.step;
        look(&mut mask, picture.size, plane, fine, options.spot_limit);
        let mut coarse: Option<Plane> = None;
        for factor in COARSER {
            let mut grid = coarse.as_ref().unwrap_or(plane).binned(factor);
            look(&mut mask, picture.size, &mut grid, fine, options.spot_limit);
            coarse = Some(grid);
        }
        plane.weight.iter_mut().for_each(|w| *w = w.abs());
    }
    let reach = if picture.layout.cfa().is_some() { 2 } else { 1 };
    let mut found = [BRIGHT, DARK].map(|kind| grouped(picture, &mut mask, kind, reach));
    if found.iter().any(|f| f.spots > 0) {
        spread(&mut mask, picture.size, reach - 1);
        let shares = shares(planes, picture.size[0], &mask);
        for (found, share) in found.iter_mut().zip(shares) {
            found.share = if found.spots > 0 { share } else { [0.0; 3] };
        }
    }
    found
}

/// What the marked pixels add to the mean, bright and dark, per channel; takes them out.
fn shares(planes: &mut [Plane], width: usize, mask: &[u8]) -> [[f64; 3]; 2] {
    let mut excess = [[0.0; 3]; 2];
    let mut whole = [0.0; 3];
    for plane in planes {
        let blocks = Blocks::of(plane);
        let total = plane.mean() * plane.weight.iter().map(|w| f64::from(*w)).sum::<f64>();
        let channels = plane.channel.map_or(0..3, |c| c..c + 1);
        whole[channels.clone()].iter_mut().for_each(|w| *w += total);
        for block in &blocks.all {
            let (mut sums, mut areas, mut clean) = ([0.0; 2], [0.0; 2], [0.0; 2]);
            let mut out = Vec::new();
            blocks.cells(plane, block, |x, y, i| {
                let [px, py] = plane.pixel(x, y);
                let (value, weight) = (f64::from(plane.values[i]), f64::from(plane.weight[i]));
                let kind = mask[py * width + px];
                if kind == 0 {
                    clean[0] += weight * value;
                    clean[1] += weight;
                } else {
                    let sign = usize::from(kind & BRIGHT == 0);
                    sums[sign] += weight * value;
                    areas[sign] += weight;
                    out.push(i);
                }
            });
            // Where a spot fills the block, its neighbors are its surroundings.
            let enough = 4.0 * clean[1] > areas[0] + areas[1];
            let around = if enough {
                clean[0] / clean[1]
            } else {
                f64::from(block.median)
            };
            let sums = [0, 1].map(|k| sums[k] - around * areas[k]);
            out.into_iter().for_each(|i| plane.weight[i] = 0.0);
            for (all, sum) in excess.iter_mut().zip(sums) {
                all[channels.clone()].iter_mut().for_each(|e| *e += sum);
            }
        }
    }
    excess.map(|sums| {
        [0, 1, 2].map(|c| {
            if whole[c] > 0.0 {
                sums[c] / whole[c]
            } else {
                0.0
            }
        })
    })
}

/// Marks the pixels within `reach` of marked ones too.
fn spread(mask: &mut [u8], [width, height]: [usize; 2], reach: usize) {
    let before = mask.to_vec();
    for (at, kind) in before.iter().enumerate().filter(|(_, k)| **k != 0) {
        let (x, y) = (at % width, at / width);
        for j in y.saturating_sub(reach)..(y + reach + 1).min(height) {
            for i in x.saturating_sub(reach)..(x + reach + 1).min(width) {
                mask[j * width + i] |= kind;
            }
        }
    }
}

/// Marks what is far off in a plane, and takes it out of it.
fn look(mask: &mut [u8], size: [usize; 2], plane: &mut Plane, fine: usize, limit: f32) {
    for far in far_off(plane, fine, limit) {
        let kind = if far.excess > 0.0 { BRIGHT } else { DARK };
        mark(mask, size, plane, fine, &far, kind);
        take_out(plane, &far);
    }
}

/// A cell of a plane, and how far it stands off its surroundings.
struct Far {
    cell: [usize; 2],
    excess: f32,
}

fn far_off(grid: &Plane, fine: usize, limit: f32) -> Vec<Far> {
    let mut blocks = Blocks::of(grid);
    let coarse = grid.step > fine;
    let Some((high, low)) = blocks.bars().or_else(|| {
        let bar = coarse.then(|| blocks.join(grid)).flatten()?;
        Some((bar, bar))
    }) else {
        return Vec::new();
    };
    let mut found = Vec::new();
    let mut near = Vec::new();
    for block in &blocks.all {
        // Most blocks hold nothing of the kind.
        if 2.0 * block.high <= high && 2.0 * block.low <= low {
            continue;
        }
        blocks.cells(grid, block, |x, y, i| {
            let excess = grid.values[i] - block.median;
            let bar = if excess > 0.0 { high } else { low };
            let bar = bar
                .max(limit * block.median.abs())
                .max(NOISE * grid.noise[i]);
            let far = Far {
                cell: [x, y],
                excess,
            };
            if excess.abs() > bar {
                found.push(far);
            } else if 2.0 * excess.abs() > bar {
                near.push(far);
            }
        });
    }
    // The rim of a spot.
    let touches = |a: &Far, b: &Far| {
        a.excess * b.excess > 0.0 && (0..2).all(|k| a.cell[k].abs_diff(b.cell[k]) <= 1)
    };
    near.retain(|n| found.iter().any(|f| touches(f, n)));
    found.extend(near);
    found
}

/// A rectangle of cells; how far its largest and smallest values stand off its median, both positive.
struct Block {
    at: [usize; 2],
    count: usize,
    /// Of it and its neighbors.
    median: f32,
    high: f32,
    low: f32,
}

struct Blocks {
    side: usize,
    all: Vec<Block>,
}

impl Blocks {
    fn of(grid: &Plane) -> Self {
        let cells = grid.weight.iter().filter(|w| **w > 0.5).count();
        let side = ((cells as f64 / BLOCKS).sqrt().round() as usize).max(4);
        let mut blocks = Self {
            side,
            all: Vec::new(),
        };
        let mut values = Vec::new();
        for y in (0..grid.height).step_by(side) {
            for x in (0..grid.width).step_by(side) {
                let mut block = Block {
                    at: [x, y],
                    count: 0,
                    median: 0.0,
                    high: 0.0,
                    low: 0.0,
                };
                values.clear();
                blocks.cells(grid, &block, |_, _, i| values.push(grid.values[i]));
                block.count = values.len();
                let (low, high) = values
                    .iter()
                    .fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
                let skip = values.len().div_ceil(MEDIAN_OF).max(1);
                let mut some: Vec<f32> = values.iter().step_by(skip).copied().collect();
                if let Some(middle) = median(&mut some) {
                    block.median = middle;
                    block.high = high - middle;
                    block.low = middle - low;
                    blocks.all.push(block);
                }
            }
        }
        // A corner with a few cells has no median of its own.
        blocks.all.retain(|b| b.count * 8 >= side * side);
        blocks.settle();
        blocks
    }

    /// A spot may fill a block: the level of each is the median of its own and its neighbors' medians.
    fn settle(&mut self) {
        let near = |a: &Block, b: &Block| (0..2).all(|k| a.at[k].abs_diff(b.at[k]) <= self.side);
        let level = |block: &Block| {
            let around = self.all.iter().filter(|b| near(b, block));
            let mut medians: Vec<f32> = around.map(|b| b.median).collect();
            median(&mut medians).unwrap_or(block.median)
        };
        let levels: Vec<f32> = self.all.iter().map(level).collect();
        for (block, level) in self.all.iter_mut().zip(levels) {
            block.high += block.median - level;
            block.low += level - block.median;
            block.median = level;
        }
    }

    /// From where on a value is too bright, and too dark, by its distance from its block's median.
    fn bars(&self) -> Option<(f32, f32)> {
        let bar = |pick: fn(&Block) -> f32| {
            let whole: Vec<f32> = self.whole().map(pick).collect();
            let (typical, scatter) = robust(&whole).filter(|_| whole.len() >= ENOUGH_BLOCKS)?;
            Some(typical + typical.max(SCATTER * scatter))
        };
        Some((bar(|b| b.high)?, bar(|b| b.low)?))
    }

    /// Makes one block of all cells; returns its bar.
    fn join(&mut self, grid: &Plane) -> Option<f32> {
        self.side = grid.width.max(grid.height);
        let mut all = Block {
            at: [0, 0],
            count: 0,
            median: 0.0,
            high: f32::INFINITY,
            low: f32::INFINITY,
        };
        let mut values = Vec::new();
        self.cells(grid, &all, |_, _, i| values.push(grid.values[i]));
        let (median, sigma) = robust(&values).filter(|_| values.len() >= ENOUGH_CELLS)?;
        all.median = median;
        self.all = vec![all];
        Some(SIGMAS * sigma)
    }

    fn whole(&self) -> impl Iterator<Item = &Block> {
        self.all
            .iter()
            .filter(|b| b.count * 2 >= self.side * self.side)
    }

    /// Calls with column, row and index of each cell of the block that lies in the square.
    fn cells(&self, grid: &Plane, block: &Block, mut call: impl FnMut(usize, usize, usize)) {
        for y in block.at[1]..(block.at[1] + self.side).min(grid.height) {
            for x in block.at[0]..(block.at[0] + self.side).min(grid.width) {
                let i = y * grid.width + x;
                if grid.weight[i] > 0.5 {
                    call(x, y, i);
                }
            }
        }
    }
}

/// Takes the cell and those next to it out of further looks.
fn take_out(plane: &mut Plane, far: &Far) {
    let around = |k: usize, end: usize| far.cell[k].saturating_sub(1)..(far.cell[k] + 2).min(end);
    for y in around(1, plane.height) {
        for x in around(0, plane.width) {
            let weight = &mut plane.weight[y * plane.width + x];
            *weight = -weight.abs();
        }
    }
}

/// Marks a cell's pixels. The mean of a coarse cell of a mosaic stands for the pixels between its own as well.
fn mark(mask: &mut [u8], size: [usize; 2], plane: &Plane, fine: usize, far: &Far, kind: u8) {
    let side = if plane.step > fine { plane.step } else { 1 };
    let [left, top] = plane.pixel(far.cell[0], far.cell[1]);
    for y in top..(top + side).min(size[1]) {
        for x in left..(left + side).min(size[0]) {
            mask[y * size[0] + x] |= kind;
        }
    }
}

/// Groups marked pixels that touch, `reach` pixels apart at most. Single pixels are hot pixels or chance: their mark goes.
fn grouped(picture: &Picture, mask: &mut [u8], kind: u8, reach: usize) -> Outliers {
    let [width, height] = picture.size;
    let mut left: Vec<bool> = mask.iter().map(|m| m & kind != 0).collect();
    let mut found = Outliers::default();
    let mut largest = 1;
    for first in 0..left.len() {
        if !left[first] {
            continue;
        }
        left[first] = false;
        let (mut open, mut pixels, mut region) = (vec![first], 0, Grown::empty());
        while let Some(at) = open.pop() {
            let (x, y) = (at % width, at / width);
            pixels += 1;
            region.add([x, y], 1);
            for j in y.saturating_sub(reach)..(y + reach + 1).min(height) {
                for i in x.saturating_sub(reach)..(x + reach + 1).min(width) {
                    if std::mem::take(&mut left[j * width + i]) {
                        open.push(j * width + i);
                    }
                }
            }
        }
        if pixels == 1 {
            mask[first] &= !kind;
            continue;
        }
        found.spots += 1;
        found.pixels += pixels;
        if pixels > largest {
            largest = pixels;
            found.largest = region.crop(picture);
        }
    }
    found
}
