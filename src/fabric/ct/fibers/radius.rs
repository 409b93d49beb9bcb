//! The one radius that makes cylinders around lines cover the fiber voxels best (Khungurn 2015 eq. 26).

use super::near::Near;
use crate::fabric::VoxelTile;
use glam::DVec3;
use rayon::prelude::*;
use serde::Serialize;

/// Candidates r = side (1 + 3 k / 19), k = 0 to 19.
const CANDIDATES: usize = 20;
/// Voxels are divided by this along each axis; one of the parts is looked at in each voxel.
const PARTS: u64 = 4;

/// A radius found by covering.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FoundRadius {
    /// The best candidate, millimeters.
    pub radius: f64,
    /// The best candidates when the least density is moved by two fifths up and, as far as the voxels tell, down.
    pub range: [f64; 2],
    /// Share of fiber voxels that cylinders of this radius cover, and of the cylinders' voxels that hold fiber.
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
    let near = Near::new(segments, 4.0);
    let mut solid: Vec<f32> = tile
        .density()
        .iter()
        .copied()
        .filter(|d| *d > 0.0)
        .collect();
    solid.sort_unstable_by(f32::total_cmp);
    let least = *solid.first()?;
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
    let best = |eps: f32| {
        let scored = (0..CANDIDATES).map(|k| {
            let radius = 1.0 + 3.0 * k as f32 / 19.0;
            let (mut both, mut c, mut v) = (0_u64, 0_u64, 0_u64);
            for (distance, density) in layers.iter().flatten() {
                let (inside, fiber) = (*distance <= radius, *density > 0.0 && *density >= eps);
                both += u64::from(inside && fiber);
                c += u64::from(inside);
                v += u64::from(fiber);
            }
            let score = 3.0 * both as f64 - c as f64 - v as f64;
            (
                score,
                radius,
                [both as f64 / v.max(1) as f64, both as f64 / c.max(1) as f64],
            )
        });
        scored.fold((f64::NEG_INFINITY, 1.0, [0.0; 2]), |b, s| {
            if s.0 > b.0 { s } else { b }
        })
    };
    let millimeters = |r: f32| f64::from(r) * tile.side();
    let (_, radius, covered) = best(0.0);
    // Below the least density kept nothing is known: the mirror image of going up stands for going down.
    let up = best(1.4 * least).1;
    Some(FoundRadius {
        radius: millimeters(radius),
        range: [
            millimeters(up.min(radius)),
            millimeters(2.0 * radius - up.min(radius)),
        ],
        covered,
    })
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
