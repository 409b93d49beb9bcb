//! Rays that run on inside the fiber they have met, or inside one that overlaps it.
//!
//! A near-field path goes straight on through its fiber. A steep ray gets past the neighbors of the segment it was met in,
//! and there it enters the round end of the next capsule while it is still inside the fiber. The surface of a fiber is that of
//! the union of its capsules: such a hit, inside a neighbor of the segment that is hit, is none.

use super::geometry::{Ended, Geometry, Hit, Image, Skip};
use glam::DVec3;

/// How far below a neighbor's surface a hit must lie to be inside it, as a fraction of the radius: more than the ray test's
/// rounding, so that no entry from outside is lost at a joint.
const DEPTH: f64 = 1e-4;

/// Most joints one ray passes inside its fiber; it is taken to meet the fiber there.
const MOST_JOINTS: usize = 10_000;

impl Geometry {
    /// [`Geometry::closest`] for a ray that starts inside the fiber that `skip` belongs to.
    pub(super) fn closest_from_within(
        &self,
        origin: DVec3,
        direction: DVec3,
        skip: &Skip,
    ) -> Ended {
        let (mut walked, mut skip) = (0.0, *skip);
        let mut joint = None;
        for _ in 0..MOST_JOINTS {
            let start = origin + direction * walked;
            let hit = match self.closest(start, direction, &skip) {
                Ended::Fiber(hit) => hit,
                ended => return ended,
            };
            walked += hit.distance;
            if !self.is_joint(hit.image, origin + direction * walked) {
                return Ended::Fiber(Hit {
                    distance: walked,
                    image: hit.image,
                });
            }
            skip = self.skip(hit.image);
            joint = Some(hit.image);
        }
        joint.map_or(Ended::Down, |image| {
            Ended::Fiber(Hit {
                distance: walked,
                image,
            })
        })
    }

    /// [`Geometry::passes`] for such a ray.
    pub(super) fn passes_from_within(&self, origin: DVec3, direction: DVec3, skip: &Skip) -> bool {
        self.passes(origin, direction, skip)
            || !matches!(
                self.closest_from_within(origin, direction, skip),
                Ended::Fiber(_)
            )
    }

    /// Is this point of a segment's surface inside the fiber?
    fn is_joint(&self, image: Image, point: DVec3) -> bool {
        self.neighbors(image).into_iter().flatten().any(|neighbor| {
            let (start, end, radius) = self.placed(neighbor);
            let (axis, from_start) = (end - start, point - start);
            let along = (from_start.dot(axis) / axis.length_squared().max(f64::MIN_POSITIVE))
                .clamp(0.0, 1.0);
            (from_start - axis * along).length() < radius * (1.0 - DEPTH)
        })
    }
}
