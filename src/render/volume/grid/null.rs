//! For the probe: flights with null collisions under a majorant for each brick, and counts of voxels.

use super::{EMPTY, Grid, LOG, Walk, walk_direction};
use crate::math::Random;
use crate::render::volume::extinction::Extinction;
use glam::DVec3;

impl Grid {
    /// Voxels that hold anything on a flight's way.
    pub(in crate::render::volume) fn count(
        &self,
        (extinction, scale): (&Extinction, f64),
        origin: DVec3,
        direction: DVec3,
        budget: f64,
    ) -> usize {
        let Ok(mut walk) = Walk::new(self, origin, direction) else {
            return 0;
        };
        let unit = scale * self.densest * self.side / f64::from(u16::MAX);
        let (mut depth, mut count) = (0.0, 0);
        loop {
            let place = self.places[self.brick(walk.wrapped.map(|c| c >> LOG))];
            let ended = if place == EMPTY {
                walk.leave_brick(self)
            } else {
                let voxels = &self.voxels[(place as usize) << (3 * LOG)..][..1 << (3 * LOG)];
                walk.through_brick(self, voxels, |voxel, length| {
                    count += 1;
                    let sine = voxel.sine(walk_direction(direction));
                    depth += unit * f64::from(voxel.density) * extinction.at(sine) * length;
                    (depth >= budget).then_some(length)
                })
            };
            if ended.is_some() {
                return count;
            }
        }
    }

    /// Per brick: the largest extinction of any of its voxels in any direction, per voxel's side, given that of a voxel of
    /// density 1, 1/mm.
    pub(in crate::render::volume) fn brick_majorants(&self, full: f64) -> Vec<f64> {
        let most = |place: &u32| {
            if *place == EMPTY {
                return 0.0;
            }
            let voxels = &self.voxels[(*place as usize) << (3 * LOG)..][..1 << (3 * LOG)];
            let most = voxels.iter().map(|v| v.density).max().unwrap_or(0);
            f64::from(most) / f64::from(u16::MAX) * self.densest * full * self.side
        };
        self.places.iter().map(most).collect()
    }

    /// Whether a flight with null collisions meets anything, and how many voxels it looks up.
    pub(in crate::render::volume) fn fly_null(
        &self,
        (extinction, scale): (&Extinction, f64),
        majorants: &[f64],
        origin: DVec3,
        direction: DVec3,
        random: &mut Random,
    ) -> (bool, usize) {
        let Ok(mut walk) = Walk::new(self, origin, direction) else {
            return (false, 0);
        };
        let unit = scale * self.densest * self.side / f64::from(u16::MAX);
        let mut count = 0;
        loop {
            let brick = self.brick(walk.wrapped.map(|c| c >> LOG));
            let (majorant, mut t, turn) = (majorants[brick], walk.t, walk.turn());
            let end = walk.leave_brick(self);
            t = match majorant > 0.0 {
                true => t - random.uniform_open().ln() / majorant,
                false => f64::INFINITY,
            };
            while t < walk.t {
                count += 1;
                let inside = |a: usize| {
                    let x = (walk.origin[a] + walk.direction[a] * t).floor() as i32 - turn[a];
                    x.clamp(0, self.shape[a] - 1)
                };
                let voxel = self
                    .voxel([inside(0), inside(1), inside(2)])
                    .unwrap_or_default();
                let e = extinction.at(voxel.sine(walk_direction(direction)));
                if random.uniform() * majorant < unit * f64::from(voxel.density) * e {
                    return (true, count);
                }
                t -= random.uniform_open().ln() / majorant;
            }
            if end.is_some() {
                return (false, count);
            }
        }
    }
}
