//! The one radius that makes cylinders around lines cover the fiber voxels best (Khungurn 2015 eq. 26), and a bound on it.

use super::near::Near;
use crate::fabric::VoxelTile;
use glam::DVec3;
use rayon::prelude::*;
use serde::Serialize;

/// Candidates r = side (1 + 3 k / 19), k = 0 to 19.
const CANDIDATES: usize = 20;
/// Voxels are divided by this along each axis; one of the parts is looked at in each voxel.
const PARTS: u64 = 4;

/// A radius found from lines and voxels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FoundRadius {
    /// The lesser of the next two, millimeters.
    pub radius: f64,
    /// The best candidate by covering (Khungurn 2015 eq. 26). Too large where fibers are packed, as those that were missed
    /// are covered by others.
    pub by_covering: f64,
    /// Of cylinders along all lines that hold what the voxels hold, a voxel counting by its density. Too large where fibers
    /// were missed.
    pub by_volume: f64,
    /// From the radius by volume if a third of the fibers was missed, to the larger of the two.
    pub range: [f64; 2],
    /// Share of fiber voxels that cylinders of the covering radius cover, and of the cylinders' voxels that hold fiber.
    pub covered: [f64; 2],
}

/// The radius for lines given as segments in voxels; voxels `belong` to the fibers asked about or are left out.
///
/// `|C and V| - |C or V and not both| = 3 |C and V| - |C| - |V|`, C the parts of voxels within a radius of a line, V those
/// in voxels that hold fiber; counted at one part of 64 in each voxel.
pub(super) fn best_radius(
    tile: &VoxelTile,
    segments: Vec<[DVec3; 2]>,
    belong: impl Fn(usize) -> bool + Sync,
) -> Option<FoundRadius> {
    if segments.is_empty() {
        return None;
    }
    let length: f64 = segments.iter().map(|[a, b]| a.distance(*b)).sum();
    let near = Near::new(segments, 4.0);
    let [nx, ny, nz] = tile.shape();
    let layers: Vec<Vec<(f32, f32)>> = (0..nz)
        .into_par_iter()
        .map(|k| {
            let mut list = Vec::new();
            for place in (k * nx * ny)..((k + 1) * nx * ny) {
                let density = tile.density()[place];
                if density > 0.0 && !belong(place) {
                    continue;
                }
                let voxel = [place % nx, place / nx % ny, k].map(|v| v as f64);
                let p = DVec3::from_array(voxel) + part(place as u64);
                let distance = near.nearest(p).map_or(f64::INFINITY, |n| n.0);
                if density > 0.0 || distance.is_finite() {
                    list.push((distance as f32, density));
                }
            }
            list
        })
        .collect();
    let v = layers.iter().flatten().filter(|p| p.1 > 0.0).count() as f64;
    if v <= 0.0 || length <= 0.0 {
        return None;
    }
    let scored = (0..CANDIDATES).map(|k| {
        let radius = 1.0 + 3.0 * k as f32 / 19.0;
        let inside = layers.iter().flatten().filter(|p| p.0 <= radius);
        let (c, both) = inside.fold((0.0, 0.0), |(c, both), p| {
            (c + 1.0, both + f64::from(u8::from(p.1 > 0.0)))
        });
        let covered = [both / f64::max(v, 1.0), both / f64::max(c, 1.0)];
        (3.0 * both - c - v, f64::from(radius), covered)
    });
    let first = (f64::NEG_INFINITY, 1.0, [0.0; 2]);
    let (_, covering, covered) = scored.fold(first, |b, s| if s.0 > b.0 { s } else { b });
    let by_covering = covering * tile.side();
    let volume =
        layers.iter().flatten().map(|p| f64::from(p.1)).sum::<f64>() / solid_density(&layers);
    let by_volume = (volume / (std::f64::consts::PI * length)).sqrt() * tile.side();
    Some(FoundRadius {
        radius: by_covering.min(by_volume),
        by_covering,
        by_volume,
        range: [
            by_volume * (2.0_f64 / 3.0).sqrt(),
            by_covering.max(by_volume),
        ],
        covered,
    })
}

/// Density inside fibers: what a tenth of the fiber voxels exceed.
fn solid_density(layers: &[Vec<(f32, f32)>]) -> f64 {
    let mut list: Vec<f32> = layers
        .iter()
        .flatten()
        .map(|p| p.1)
        .filter(|d| *d > 0.0)
        .collect();
    list.sort_unstable_by(f32::total_cmp);
    list.get(9 * list.len() / 10).map_or(1.0, |d| f64::from(*d))
}

/// The middle of one of a voxel's 64 parts, spread evenly by the place.
fn part(place: u64) -> DVec3 {
    let bits = place.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 58;
    let middle = |b: u64| (b as f64 + 0.5) / PARTS as f64;
    DVec3::new(
        middle(bits % PARTS),
        middle(bits / PARTS % PARTS),
        middle(bits / (PARTS * PARTS)),
    )
}
