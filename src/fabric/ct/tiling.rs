//! A larger tile from a scanned patch, without continuity (Zhao 2011 section 5.3): woven cloth by random translations of
//! whole repeats of the weave, pile and felt by random turns of a central square.
//!
//! Turns are quarter turns, so no voxel is interpolated. Fibers are cut at every seam; [`SeamReport`] says how badly.

use super::check_going_on;
use crate::base::{Error, Result, Watch};
use crate::fabric::{PackedDirection, VoxelTile};
use crate::math::Random;
use serde::Serialize;

/// More voxels than this are refused.
const MOST: usize = 2_000_000_000;

/// How cells of the larger tile are taken from the patch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Patch {
    /// Each a whole repeat of the weave of this size along x and y, millimeters, from anywhere in the patch.
    Repeats([f64; 2]),
    /// Each the central square of the patch, turned by 0, 90, 180 or 270 degrees.
    Turns,
}

/// What crossing a seam is like, beside crossing from voxel to voxel within the patch.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SeamReport {
    /// Cells that could be chosen from.
    pub choices: usize,
    /// Mean difference of density across seams.
    pub density_at_seams: f64,
    /// The same within the patch.
    pub density_within: f64,
    /// Mean angle of fibers across seams where both voxels hold fiber, degrees.
    pub degrees_at_seams: f64,
    /// The same within the patch.
    pub degrees_within: f64,
    /// Share of fiber voxels at seams that end in air there.
    pub ends_at_seams: f64,
    /// The same within the patch.
    pub ends_within: f64,
}

/// Makes a tile of `copies` cells along x and y.
///
/// # Errors
/// The repeat is no length within the patch, copies are none, the result has more than two billion voxels, or the watch
/// cancelled.
pub fn tiled(
    patch: &VoxelTile,
    cells: Patch,
    copies: [usize; 2],
    seed: u64,
    watch: &dyn Watch,
) -> Result<(VoxelTile, SeamReport)> {
    let source = Source::new(patch, cells)?;
    let ends: [Vec<usize>; 2] = [0, 1].map(|k| {
        let border = |i: usize| (i as f64 * source.cell[k]).round() as usize;
        (0..=copies[k]).map(border).collect()
    });
    let nz = patch.shape()[2];
    let [nx, ny] = [0, 1].map(|k| ends[k].last().copied().unwrap_or(0));
    let count = nx.checked_mul(ny).and_then(|n| n.checked_mul(nz));
    if !count.is_some_and(|n| (1..=MOST).contains(&n)) {
        return Err(Error::new(format!(
            "{} x {} copies make {nx} x {ny} x {nz} voxels: expected at least one copy along each axis and at most {MOST} voxels",
            copies[0], copies[1]
        )));
    }
    let mut random = Random::keyed(&[seed, 0x7469]);
    let chosen: Vec<usize> = (0..copies[0] * copies[1])
        .map(|_| (random.uniform() * source.choices as f64) as usize)
        .collect();
    let cell_of = |axis: usize, v: usize| ends[axis].partition_point(|e| *e <= v) - 1;
    let columns: Vec<(usize, usize)> = (0..nx)
        .map(|x| (cell_of(0, x), x - ends[0][cell_of(0, x)]))
        .collect();
    let mut density = Vec::with_capacity(nx * ny * nz);
    let mut direction = Vec::with_capacity(nx * ny * nz);
    for z in 0..nz {
        check_going_on(watch)?;
        watch.progress("tiling", z as u64, nz as u64);
        for y in 0..ny {
            let row = cell_of(1, y);
            for (column, x) in &columns {
                let choice = chosen[column + copies[0] * row];
                let (place, turns) = source.voxel(patch, choice, [*x, y - ends[1][row], z]);
                density.push(patch.density()[place]);
                direction.push(turned(patch, place, turns));
            }
        }
    }
    let tile = VoxelTile::from_parts(
        [nx, ny, nz],
        patch.side(),
        patch.bottom(),
        density,
        direction,
    )?;
    let report = seams(patch, &tile, &ends, source.choices);
    Ok((tile, report))
}

/// Where cells come from.
struct Source {
    cells: Patch,
    /// Size of a cell, voxels; repeats need not be whole.
    cell: [f64; 2],
    across: usize,
    choices: usize,
}

impl Source {
    fn new(patch: &VoxelTile, cells: Patch) -> Result<Self> {
        let [nx, ny, _] = patch.shape();
        let n = [nx, ny];
        match cells {
            Patch::Turns => Ok(Self {
                cells,
                cell: [nx.min(ny) as f64; 2],
                across: 1,
                choices: 4,
            }),
            Patch::Repeats(repeat) => {
                let cell = repeat.map(|r| r / patch.side());
                // A repeat that is short by half a voxel is whole.
                let fit = [0, 1].map(|k| ((n[k] as f64 + 0.5) / cell[k]).floor());
                if !(0..2).all(|k| cell[k] >= 2.0 && fit[k] >= 1.0) {
                    return Err(Error::new(format!(
                        "repeats of {} x {} mm in a patch of {:.4} x {:.4} mm: expected at least two voxels and at most the patch",
                        repeat[0],
                        repeat[1],
                        patch.size()[0],
                        patch.size()[1]
                    )));
                }
                Ok(Self {
                    cells,
                    cell,
                    across: fit[0] as usize,
                    choices: (fit[0] * fit[1]) as usize,
                })
            }
        }
    }

    /// Place in the patch of a voxel of a cell, and the quarter turns it is turned by.
    fn voxel(&self, patch: &VoxelTile, choice: usize, [x, y, z]: [usize; 3]) -> (usize, usize) {
        let [nx, ny, _] = patch.shape();
        match self.cells {
            Patch::Repeats(_) => {
                let start = |axis: usize, i: usize| (i as f64 * self.cell[axis]).round() as usize;
                let from = [
                    start(0, choice % self.across),
                    start(1, choice / self.across),
                ];
                let voxel = [(from[0] + x) % nx, (from[1] + y) % ny, z];
                (patch.place(voxel), 0)
            }
            Patch::Turns => {
                let n = nx.min(ny);
                let last = n - 1;
                // The voxel that comes here when the square is turned counter-clockwise.
                let (u, v) = match choice {
                    0 => (x, y),
                    1 => (y, last - x),
                    2 => (last - x, last - y),
                    _ => (last - y, x),
                };
                (patch.place([u + (nx - n) / 2, v + (ny - n) / 2, z]), choice)
            }
        }
    }
}

fn turned(patch: &VoxelTile, place: usize, turns: usize) -> PackedDirection {
    let mut d = patch.direction(place);
    for _ in 0..turns {
        (d.x, d.y) = (-d.y, d.x);
    }
    PackedDirection::pack(d)
}

/// Sums over pairs of neighbors.
#[derive(Default)]
struct Pairs {
    count: f64,
    density: f64,
    both: f64,
    degrees: f64,
    solid: f64,
    ending: f64,
}

impl Pairs {
    fn add(&mut self, tile: &VoxelTile, a: usize, b: usize) {
        let [da, db] = [a, b].map(|p| f64::from(tile.density()[p]));
        self.count += 1.0;
        self.density += (da - db).abs();
        if da > 0.0 || db > 0.0 {
            self.solid += 1.0;
            if da > 0.0 && db > 0.0 {
                let cos = tile.direction(a).dot(tile.direction(b)).abs().min(1.0);
                self.both += 1.0;
                self.degrees += cos.acos().to_degrees();
            } else {
                self.ending += 1.0;
            }
        }
    }

    fn means(&self) -> [f64; 3] {
        let share = |part: f64, whole: f64| if whole > 0.0 { part / whole } else { 0.0 };
        [
            share(self.density, self.count),
            share(self.degrees, self.both),
            share(self.ending, self.solid),
        ]
    }
}

fn seams(
    patch: &VoxelTile,
    tile: &VoxelTile,
    ends: &[Vec<usize>; 2],
    choices: usize,
) -> SeamReport {
    let [mut at, mut within] = [Pairs::default(), Pairs::default()];
    let [nx, ny, nz] = tile.shape();
    for z in 0..nz {
        for x in &ends[0][1..] {
            for y in 0..ny {
                at.add(tile, tile.place([x - 1, y, z]), tile.place([x % nx, y, z]));
            }
        }
        for y in &ends[1][1..] {
            for x in 0..nx {
                at.add(tile, tile.place([x, y - 1, z]), tile.place([x, y % ny, z]));
            }
        }
    }
    let [px, py, pz] = patch.shape();
    for z in 0..pz {
        for (x, y) in (1..py).flat_map(|y| (1..px).map(move |x| (x, y))) {
            let here = patch.place([x, y, z]);
            within.add(patch, here - 1, here);
            within.add(patch, here - px, here);
        }
    }
    let (
        [density_at_seams, degrees_at_seams, ends_at_seams],
        [density_within, degrees_within, ends_within],
    ) = (at.means(), within.means());
    SeamReport {
        choices,
        density_at_seams,
        density_within,
        degrees_at_seams,
        degrees_within,
        ends_at_seams,
        ends_within,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::Unwatched;
    use glam::DVec3;

    /// Fibers along x in every second row; density tells the repeat it is from.
    fn patch() -> VoxelTile {
        let mut tile = VoxelTile::empty([12, 8, 2], 0.005, -0.005).unwrap();
        for place in 0..192 {
            let [x, y] = [place % 12, place / 12 % 8];
            if y % 2 == 0 {
                let repeat = x / 4 + 3 * (y / 4);
                tile.set(place, 1.0 + repeat as f32, DVec3::X).unwrap();
            }
        }
        tile
    }

    #[test]
    fn cells_are_whole_repeats_of_the_patch() {
        let cells = Patch::Repeats([0.02, 0.02]);
        let (tile, report) = tiled(&patch(), cells, [5, 6], 3, &Unwatched).unwrap();
        assert_eq!(tile.shape(), [20, 24, 2]);
        assert_eq!(report.choices, 6);
        let mut seen = std::collections::BTreeSet::new();
        for (cx, cy) in (0..5).flat_map(|x| (0..6).map(move |y| (x, y))) {
            let value = |x: usize, y: usize, z: usize| {
                tile.density()[tile.place([4 * cx + x, 4 * cy + y, z])]
            };
            let first = value(0, 0, 0);
            seen.insert(first as u32);
            for (x, y) in (0..4).flat_map(|x| (0..4).map(move |y| (x, y))) {
                let expected = if y % 2 == 0 { first } else { 0.0 };
                assert!((value(x, y, 1) - expected).abs() < 1e-6);
            }
        }
        assert!(seen.len() > 3, "{seen:?}");
        // Across rows fiber ends in the patch as at seams; fibers stay parallel.
        assert!(report.degrees_at_seams < 0.01 && report.degrees_within < 0.01);
        assert!(report.density_at_seams > 0.0 && report.ends_at_seams > 0.0);
        assert_eq!(
            tiled(&patch(), cells, [5, 6], 3, &Unwatched).unwrap(),
            (tile.clone(), report)
        );
        assert_ne!(
            tiled(&patch(), cells, [5, 6], 4, &Unwatched).unwrap().0,
            tile
        );
        // With one repeat there is nothing to choose, and no seam worse than the patch's own.
        let whole = Patch::Repeats([0.06, 0.04]);
        let (tile, report) = tiled(&patch(), whole, [2, 1], 3, &Unwatched).unwrap();
        assert_eq!((tile.shape(), report.choices), ([24, 8, 2], 1));
        assert_eq!(tile.density()[..12], tile.density()[12..24]);
    }

    #[test]
    fn turns_take_directions_along() {
        // Rows of the central square along x become columns along y when turned by 90 degrees.
        let (tile, report) = tiled(&patch(), Patch::Turns, [6, 4], 1, &Unwatched).unwrap();
        assert_eq!((tile.shape(), report.choices), ([48, 32, 2], 4));
        let mut upright = 0;
        for (cx, cy) in (0..6).flat_map(|x| (0..4).map(move |y| (x, y))) {
            let at = |x: usize, y: usize| tile.place([8 * cx + x, 8 * cy + y, 0]);
            let along_y = tile.density()[at(0, 0)] > 0.0 && tile.density()[at(0, 1)] > 0.0
                || tile.density()[at(1, 0)] > 0.0 && tile.density()[at(1, 1)] > 0.0;
            upright += usize::from(along_y);
            for (x, y) in (0..8).flat_map(|x| (0..8).map(move |y| (x, y))) {
                let d = tile.direction(at(x, y)).abs();
                if tile.density()[at(x, y)] > 0.0 {
                    assert!(d.distance(if along_y { DVec3::Y } else { DVec3::X }) < 1e-3);
                }
            }
        }
        assert!((4..20).contains(&upright), "{upright}");
        assert!(report.degrees_at_seams > report.degrees_within + 10.0);
    }

    #[test]
    fn what_cannot_be_tiled_is_said() {
        let fails = |cells, copies| {
            tiled(&patch(), cells, copies, 1, &Unwatched)
                .unwrap_err()
                .report()
        };
        assert!(fails(Patch::Repeats([0.1, 0.02]), [1, 1]).contains("at most the patch"));
        assert!(fails(Patch::Repeats([0.001, 0.02]), [1, 1]).contains("two voxels"));
        assert!(fails(Patch::Turns, [0, 1]).contains("at least one copy"));
        assert!(fails(Patch::Turns, [100_000, 100_000]).contains("at most 2000000000"));
    }
}
