//! Where fibers cross the slices of a volume: minima of the scale-normalized Laplacian of Gaussians.

use crate::base::{Result, Watch};
use crate::fabric::VoxelTile;
use crate::fabric::ct::check_going_on;
use crate::fabric::ct::gaussian::{Field, kernel};
use glam::DVec3;
use rayon::prelude::*;

/// Scales as shares of radius / sqrt(2), where the response to a disc is strongest.
const SCALES: [f64; 3] = [0.6, 0.8, 1.0];
/// Voxels whose direction is nearer than this cosine to the slices' axis are looked at.
const ALONG: f64 = 0.5;
/// Slices worked on between two reports of progress.
const AT_ONCE: usize = 32;
/// Half the length over which density is averaged along fibers, radii.
const AVERAGED: f64 = 1.5;

/// A fiber's crossing of a slice, in voxels from the lower corner.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Center {
    pub(super) at: DVec3,
    /// Unit vector along the fiber, upward along the slices' axis.
    pub(super) along: DVec3,
}

/// The axis a direction is along most of all.
pub(super) fn main_axis(d: DVec3) -> usize {
    let d = d.abs();
    if d.x >= d.y && d.x >= d.z {
        0
    } else if d.y >= d.z {
        1
    } else {
        2
    }
}

/// Density averaged along the fiber through each voxel: gaps between fibers stay, noise along them goes.
pub(super) fn averaged(tile: &VoxelTile, radius: f64) -> Vec<f32> {
    let [nx, ny, nz] = tile.shape();
    let steps = (AVERAGED * radius).ceil().max(1.0) as i64;
    let density = tile.density();
    let value = |p: DVec3| {
        let low = p.floor();
        let part = p - low;
        let mut sum = 0.0;
        for corner in 0..8 {
            let bit = |k: usize| corner >> k & 1;
            let place =
                |k: usize, n: usize| (low[k] as i64 + bit(k)).clamp(0, n as i64 - 1) as usize;
            let weight = |k: usize| if bit(k) == 1 { part[k] } else { 1.0 - part[k] };
            let at = place(0, nx) + nx * (place(1, ny) + ny * place(2, nz));
            sum += weight(0) * weight(1) * weight(2) * f64::from(density[at]);
        }
        sum
    };
    let mut found = vec![0.0; density.len()];
    found
        .par_chunks_mut(nx * ny)
        .enumerate()
        .for_each(|(k, layer)| {
            for (at, v) in layer.iter_mut().enumerate() {
                let place = at + k * nx * ny;
                if density[place] > 0.0 {
                    let p = DVec3::new((at % nx) as f64, (at / nx) as f64, k as f64);
                    let d = tile.direction(place);
                    let sum: f64 = (-steps..=steps).map(|u| value(p + d * u as f64)).sum();
                    *v = (sum / (2 * steps + 1) as f64) as f32;
                }
            }
        });
    found
}

/// Looks for centers in slices perpendicular to an axis.
pub(super) struct Finder<'a> {
    pub(super) tile: &'a VoxelTile,
    /// Density averaged along fibers.
    pub(super) density: &'a [f32],
    pub(super) axis: usize,
    /// Expected radius, voxels.
    pub(super) radius: f64,
    /// Least response, on the scale of density.
    pub(super) least: f64,
}

impl Finder<'_> {
    /// Centers of every slice.
    pub(super) fn all(&self, watch: &dyn Watch) -> Result<Vec<Vec<Center>>> {
        let n = self.tile.shape()[self.axis];
        let stage = ["x", "y", "z"].map(|a| format!("fibers along {a}"));
        let mut found = Vec::with_capacity(n);
        while found.len() < n {
            check_going_on(watch)?;
            let some = found.len()..(found.len() + AT_ONCE).min(n);
            found.par_extend(some.into_par_iter().map(|k| self.slice(k)));
            watch.progress(&stage[self.axis], found.len() as u64, n as u64);
        }
        Ok(found)
    }

    /// The axes across a slice.
    fn across(&self) -> [usize; 2] {
        [(self.axis + 1) % 3, (self.axis + 2) % 3]
    }

    fn place(&self, index: usize, i: usize, j: usize) -> usize {
        let [a, b] = self.across();
        let mut voxel = [0; 3];
        (voxel[self.axis], voxel[a], voxel[b]) = (index, i, j);
        self.tile.place(voxel)
    }

    /// Density of a slice where fibers run along the axis, with a border of zeros.
    fn picture(&self, index: usize, border: usize) -> Option<Field> {
        let [na, nb] = self.across().map(|k| self.tile.shape()[k]);
        let dims = [na + 2 * border, nb + 2 * border, 1];
        let mut values = vec![0.0; dims[0] * dims[1]];
        let mut any = false;
        for (j, i) in (0..nb).flat_map(|j| (0..na).map(move |i| (j, i))) {
            let place = self.place(index, i, j);
            let density = self.density[place];
            if density > 0.0 && self.tile.direction(place)[self.axis].abs() >= ALONG {
                values[i + border + dims[0] * (j + border)] = density;
                any = true;
            }
        }
        any.then_some(Field { dims, values })
    }

    fn slice(&self, index: usize) -> Vec<Center> {
        let sigmas = SCALES.map(|s| (s * self.radius / std::f64::consts::SQRT_2).max(0.5));
        let kernels = sigmas.map(kernel);
        let widest = kernels.iter().map(Vec::len).fold(0, usize::max) / 2;
        // One more on each side for the Laplacian.
        let Some(picture) = self.picture(index, widest + 1) else {
            return Vec::new();
        };
        let [na, nb] = self.across().map(|k| self.tile.shape()[k]);
        let mut least = vec![f32::INFINITY; na * nb];
        for (sigma, kernel) in sigmas.iter().zip(&kernels) {
            let blurred = picture.along(0, kernel).along(1, kernel);
            let [width, ..] = blurred.dims;
            let border = (width - na) / 2;
            for (j, i) in (0..nb).flat_map(|j| (0..na).map(move |i| (j, i))) {
                let at = i + border + width * (j + border);
                let v = &blurred.values;
                let around = v[at - 1] + v[at + 1] + v[at - width] + v[at + width];
                let response = (sigma * sigma) as f32 * (around - 4.0 * v[at]);
                least[i + na * j] = least[i + na * j].min(response);
            }
        }
        self.minima(index, &least, na, nb)
    }

    fn minima(&self, index: usize, least: &[f32], na: usize, nb: usize) -> Vec<Center> {
        let mut found = Vec::new();
        for (j, i) in (1..nb - 1).flat_map(|j| (1..na - 1).map(move |i| (j, i))) {
            let at = i + na * j;
            let here = least[at];
            if f64::from(here) > -self.least {
                continue;
            }
            let before = [at - 1, at - na - 1, at - na, at - na + 1];
            let after = [at + 1, at + na - 1, at + na, at + na + 1];
            // Of equal neighbors the first is taken.
            let lowest =
                before.iter().all(|k| here < least[*k]) && after.iter().all(|k| here <= least[*k]);
            let place = self.place(index, i, j);
            let d = self.tile.direction(place);
            if !lowest || self.tile.density()[place] <= 0.0 || main_axis(d) != self.axis {
                continue;
            }
            let shift = |step: usize| {
                let (l, r) = (f64::from(least[at - step]), f64::from(least[at + step]));
                let bend = l + r - 2.0 * f64::from(here);
                if bend > 0.0 {
                    (0.5 * (l - r) / bend).clamp(-0.5, 0.5)
                } else {
                    0.0
                }
            };
            let [a, b] = self.across();
            let mut p = [0.0; 3];
            p[self.axis] = index as f64 + 0.5;
            p[a] = i as f64 + 0.5 + shift(1);
            p[b] = j as f64 + 0.5 + shift(na);
            found.push(Center {
                at: DVec3::from_array(p),
                along: d * d[self.axis].signum(),
            });
        }
        found
    }
}
