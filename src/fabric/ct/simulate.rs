//! A virtual CT scan: gray voxels of known fibers, to judge what is found in scans against a truth.
//!
//! Each voxel is the share of 64 points in it that lie inside a fiber, blurred by a Gaussian, with white noise. Does not
//! project and reconstruct: no rings, streaks, beam hardening or correlated noise.

use super::check_going_on;
use super::gaussian::blur;
use super::gray::Gray;
use crate::base::{Error, Result, Watch};
use crate::fabric::{FiberTile, PackedDirection, Segment, VoxelTile};
use crate::math::Random;
use glam::DVec3;
use rayon::prelude::*;
use serde::Serialize;

/// Layers worked on by one thread at a time.
const LAYERS: usize = 8;
/// Points per axis of a voxel.
const POINTS: usize = 4;
/// More voxels than this are refused.
const MOST: f64 = 1e9;
/// From a voxel's middle to its corner, voxels.
const CORNER: f64 = 0.867;

/// How a virtual scan is made.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Simulating {
    /// Side of a voxel, millimeters.
    pub voxel: f64,
    /// Air above and below the cloth, millimeters.
    pub margin: f64,
    /// Standard deviation of the Gaussian that blurs, millimeters.
    pub blur: f64,
    /// Standard deviation of the noise, as a share of the step from air to fiber.
    pub noise: f64,
    /// Of the noise.
    pub seed: u64,
}

/// A virtual scan and what it was made of.
#[derive(Debug, Clone, PartialEq)]
pub struct Simulated {
    /// What a scanner would have given: air 0, fiber 1.
    pub gray: Gray,
    /// Share of each voxel inside fibers, and the direction of the fiber whose axis is nearest.
    pub truth: VoxelTile,
    /// By how much the cloth was stretched along y so that whole voxels make a tile.
    pub stretch: f64,
}

/// Scans the fibers of a periodic tile.
///
/// # Errors
/// A number has no meaning, voxels are too many or too few, or the tile is no whole number of voxels along y even when
/// stretched by 1 %; the watch cancelled.
pub fn simulate(tile: &FiberTile, options: &Simulating, watch: &dyn Watch) -> Result<Simulated> {
    let grid = Grid::new(tile, options)?;
    let segments: Vec<Capsule> = tile.segments.iter().map(|s| grid.capsule(s)).collect();
    let [nx, ny, nz] = grid.shape;
    let starts: Vec<usize> = (0..nz).step_by(LAYERS).collect();
    let mut density = Vec::with_capacity(nx * ny * nz);
    let mut directions = Vec::with_capacity(nx * ny * nz);
    for group in starts.chunks(4) {
        check_going_on(watch)?;
        let slabs: Vec<Slab> = group
            .par_iter()
            .map(|first| Slab::drawn(&segments, grid.shape, *first))
            .collect();
        for slab in slabs {
            let share = |m: &u64| m.count_ones() as f32 / 64.0;
            density.extend(slab.inside.iter().map(share));
            directions.extend(
                slab.nearest
                    .iter()
                    .zip(&slab.inside)
                    .map(|((_, k), m)| match *m {
                        0 => PackedDirection::default(),
                        _ => PackedDirection::pack(segments[*k as usize].along),
                    }),
            );
        }
        watch.progress(
            "filling voxels",
            density.len() as u64,
            (nx * ny * nz) as u64,
        );
    }
    let mut gray = Gray {
        shape: grid.shape,
        side: grid.side,
        bottom: grid.bottom,
        values: density.clone(),
        periodic: true,
    };
    blur(&mut gray, options.blur / grid.side, watch)?;
    add_noise(&mut gray, options.noise, options.seed);
    let truth = VoxelTile::from_parts(grid.shape, grid.side, grid.bottom, density, directions)?;
    Ok(Simulated {
        gray,
        truth,
        stretch: grid.stretch,
    })
}

fn add_noise(gray: &mut Gray, noise: f64, seed: u64) {
    if noise <= 0.0 {
        return;
    }
    let layer = gray.shape[0] * gray.shape[1];
    let layers = gray.values.par_chunks_mut(layer).enumerate();
    layers.for_each(|(k, values)| {
        let mut random = Random::keyed(&[seed, k as u64]);
        for value in values {
            *value += (noise * random.normal()) as f32;
        }
    });
}

/// Where voxels lie.
struct Grid {
    shape: [usize; 3],
    side: f64,
    bottom: f64,
    stretch: f64,
}

impl Grid {
    fn new(tile: &FiberTile, options: &Simulating) -> Result<Self> {
        let Simulating {
            voxel,
            margin,
            blur,
            noise,
            ..
        } = *options;
        let fine = [margin, blur, noise].iter().all(|v| (0.0..1e3).contains(v));
        if !(voxel > 0.0 && voxel.is_finite() && fine) {
            return Err(Error::new(format!(
                "voxels of {voxel} mm, margin {margin} mm, blur {blur} mm, noise {noise}: expected a side above 0 and nothing negative"
            )));
        }
        if tile.segments.is_empty() {
            return Err(Error::new("no fibers to scan"));
        }
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for s in &tile.segments {
            low = low.min(s.start.z.min(s.end.z) - s.radius);
            high = high.max(s.start.z.max(s.end.z) + s.radius);
        }
        let nx = (tile.size[0] / voxel).round().max(1.0);
        let side = tile.size[0] / nx;
        let ny = (tile.size[1] / side).round().max(1.0);
        let nz = ((high - low + 2.0 * margin) / side).ceil().max(1.0);
        if !(nx * ny * nz <= MOST && nx >= 8.0 && ny >= 8.0) {
            return Err(Error::new(format!(
                "{nx} x {ny} x {nz} voxels: expected at least 8 along x and y and at most {MOST} in all"
            ))
            .with_hint("voxels of a third of the fiber radius to a whole one are usual"));
        }
        let stretch = ny * side / tile.size[1];
        if (stretch - 1.0).abs() > 0.01 {
            return Err(Error::new(format!(
                "a tile of {} x {} mm is no whole number of cubic voxels of {} um",
                tile.size[0],
                tile.size[1],
                1e3 * side
            ))
            .with_hint("choose smaller voxels, or a side that divides both lengths"));
        }
        let middle = 0.5 * (low + high);
        Ok(Self {
            shape: [nx as usize, ny as usize, nz as usize],
            side,
            bottom: middle - 0.5 * nz * side,
            stretch,
        })
    }

    fn capsule(&self, segment: &Segment) -> Capsule {
        let scale = DVec3::new(1.0, self.stretch, 1.0) / self.side;
        let low = DVec3::new(0.0, 0.0, self.bottom);
        let start = (segment.start - low) * scale;
        let way = (segment.end - low) * scale - start;
        Capsule {
            start,
            way,
            along: way.normalize_or(DVec3::X),
            radius: segment.radius / self.side,
        }
    }
}

/// A segment in voxels from the lower corner.
struct Capsule {
    start: DVec3,
    way: DVec3,
    along: DVec3,
    radius: f64,
}

impl Capsule {
    fn distance(&self, p: DVec3) -> f64 {
        let d = p - self.start;
        let t = (d.dot(self.way) / self.way.length_squared()).clamp(0.0, 1.0);
        (d - self.way * t).length()
    }

    /// The points of the voxel around `middle` that lie inside, one bit each.
    fn points_inside(&self, middle: DVec3) -> u64 {
        let distance = self.distance(middle);
        if distance > self.radius + CORNER {
            return 0;
        }
        if distance < self.radius - CORNER {
            return u64::MAX;
        }
        let step = |m: usize| (m as f64 + 0.5) / POINTS as f64 - 0.5;
        let mut inside = 0;
        for bit in 0..64 {
            let offset = DVec3::new(step(bit % 4), step(bit / 4 % 4), step(bit / 16));
            inside |= u64::from(self.distance(middle + offset) <= self.radius) << bit;
        }
        inside
    }
}

/// Some layers: which points of each voxel are inside fibers, and which axis is nearest.
struct Slab {
    inside: Vec<u64>,
    nearest: Vec<(f32, u32)>,
}

impl Slab {
    fn drawn(capsules: &[Capsule], [nx, ny, nz]: [usize; 3], first: usize) -> Self {
        let layers = LAYERS.min(nz - first);
        let count = nx * ny * layers;
        let mut slab = Self {
            inside: vec![0; count],
            nearest: vec![(f32::INFINITY, 0); count],
        };
        for (index, capsule) in capsules.iter().enumerate() {
            let end = capsule.start + capsule.way;
            let margin = DVec3::splat(capsule.radius);
            let low = (capsule.start.min(end) - margin).floor().as_i64vec3();
            let high = (capsule.start.max(end) + margin).floor().as_i64vec3();
            let z_from = low.z.max(first as i64);
            let z_to = high.z.min((first + layers) as i64 - 1);
            for z in z_from..=z_to {
                for y in low.y..=high.y {
                    let row = nx * (y.rem_euclid(ny as i64) as usize + ny * (z as usize - first));
                    for x in low.x..=high.x {
                        let middle = DVec3::new(x as f64, y as f64, z as f64) + 0.5;
                        let inside = capsule.points_inside(middle);
                        if inside != 0 {
                            let place = row + x.rem_euclid(nx as i64) as usize;
                            slab.inside[place] |= inside;
                            let gap = (capsule.distance(middle) - capsule.radius) as f32;
                            if gap < slab.nearest[place].0 {
                                slab.nearest[place] = (gap, index as u32);
                            }
                        }
                    }
                }
            }
        }
        slab
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::Unwatched;
    use crate::fabric::{Curve, from_curves};

    fn one_fiber(along: DVec3) -> FiberTile {
        let middle = DVec3::new(0.1, 0.1, 0.0);
        from_curves(
            [0.2, 0.2],
            &[Curve {
                points: vec![middle - 0.06 * along, middle + 0.06 * along],
                radii: vec![0.02],
                yarn_system: 0,
            }],
        )
    }

    fn options() -> Simulating {
        Simulating {
            voxel: 0.005,
            margin: 0.05,
            blur: 0.0,
            noise: 0.0,
            seed: 1,
        }
    }

    #[test]
    fn voxels_hold_the_volume_of_the_fiber_and_its_direction() {
        // Sees a radius off by 1 % and any exchange of axes.
        for along in [DVec3::X, DVec3::new(2.0, -1.0, 0.5).normalize()] {
            let done = simulate(&one_fiber(along), &options(), &Unwatched).unwrap();
            let sum: f64 = done.truth.density().iter().map(|d| f64::from(*d)).sum();
            let pi = std::f64::consts::PI;
            let expected = pi * 0.02_f64.powi(2) * 0.12 + 4.0 / 3.0 * pi * 0.02_f64.powi(3);
            let found = sum * 0.005_f64.powi(3);
            assert!((found / expected - 1.0).abs() < 0.01, "{found} {expected}");
            for (place, d) in done.truth.density().iter().enumerate() {
                let cos = done.truth.direction(place).dot(along).abs();
                assert!(*d == 0.0 || cos > 1.0 - 1e-6);
            }
            assert_eq!(done.gray.values, done.truth.density());
            // Air all around: what a fiber leaves through one side it enters through the other.
            let [nx, ny, nz] = done.gray.shape;
            assert_eq!([nx, ny], [40, 40]);
            assert!(
                done.gray.values[..nx * ny * 9].iter().all(|v| *v == 0.0),
                "{nz}"
            );
        }
    }

    #[test]
    fn blur_and_noise_are_as_wide_as_stated() {
        let options = Simulating {
            noise: 0.1,
            blur: 0.005,
            ..options()
        };
        let tile = one_fiber(DVec3::X);
        let noisy = simulate(&tile, &options, &Unwatched).unwrap();
        let clean = Simulating {
            noise: 0.0,
            ..options
        };
        let clean = simulate(&tile, &clean, &Unwatched).unwrap();
        let n = clean.gray.values.len() as f64;
        let pairs = noisy.gray.values.iter().zip(&clean.gray.values);
        let square: f64 = pairs.map(|(a, b)| f64::from(a - b).powi(2)).sum();
        // Standard error of a standard deviation from n normal numbers: 0.1 / sqrt(2 n), 0.0003 here; five of them.
        assert!(((square / n).sqrt() - 0.1).abs() < 5.0 * 0.1 / (2.0 * n).sqrt());
        assert_eq!(noisy, simulate(&tile, &options, &Unwatched).unwrap());
        let other = Simulating { seed: 2, ..options };
        assert_ne!(
            noisy.gray,
            simulate(&tile, &other, &Unwatched).unwrap().gray
        );
    }

    #[test]
    fn what_cannot_be_scanned_is_said() {
        let tile = one_fiber(DVec3::X);
        let fails = |change: fn(&mut Simulating)| {
            let mut options = options();
            change(&mut options);
            simulate(&tile, &options, &Unwatched).unwrap_err().report()
        };
        assert!(fails(|o| o.voxel = 0.0).contains("a side above 0"));
        assert!(fails(|o| o.noise = -1.0).contains("nothing negative"));
        assert!(fails(|o| o.voxel = 1e-5).contains("voxels: expected"));
        assert!(fails(|o| o.voxel = 0.1).contains("at least 8"));
        let mut uneven = tile.clone();
        uneven.size[1] = 0.2123;
        let coarse = Simulating {
            voxel: 0.02,
            ..options()
        };
        let error = simulate(&uneven, &coarse, &Unwatched).unwrap_err();
        assert!(error.report().contains("no whole number of cubic voxels"));
    }
}
