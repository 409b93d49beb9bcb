//! The grid against a tree of another make (obvhs), which shares nothing with it but the fibers.

use super::tests::{bench_twill, enter_by_definition};
use super::*;
use crate::math::Random;
use obvhs::aabb::Aabb;
use obvhs::cwbvh::builder::build_cwbvh;
use obvhs::ray::RayHit;
use obvhs::{Boundable, BvhBuildParams};
use std::time::Duration;

struct Boxed(Aabb);

impl Boundable for Boxed {
    fn aabb(&self) -> Aabb {
        self.0
    }
}

#[test]
fn hits_in_the_bench_twill_match_those_of_a_tree() {
    let tile = bench_twill();
    let geometry = Geometry::new(&tile).unwrap();
    let [width, height] = tile.size;
    // Rays start in the tile and stay within half a tile of it.
    let copies: Vec<(&Segment, DVec3)> = tile
        .segments
        .iter()
        .flat_map(|s| {
            let at = move |(i, j): (i32, i32)| {
                (
                    s,
                    DVec3::new(f64::from(i) * width, f64::from(j) * height, 0.0),
                )
            };
            (-1..=1).flat_map(move |i| (-1..=1).map(move |j| at((i, j))))
        })
        .filter(|(s, offset)| {
            let p = 0.5 * (s.start + s.end) + *offset;
            (-0.5 * width..=1.5 * width).contains(&p.x)
                && (-0.5 * height..=1.5 * height).contains(&p.y)
        })
        .collect();
    let boxes: Vec<Boxed> = copies
        .iter()
        .map(|(s, offset)| {
            let low = s.start.min(s.end) + *offset - s.radius;
            let high = s.start.max(s.end) + *offset + s.radius;
            Boxed(Aabb::new(low.as_vec3a(), high.as_vec3a()))
        })
        .collect();
    let tree = build_cwbvh(
        &boxes,
        BvhBuildParams::fast_build(),
        &mut Duration::default(),
    );

    let mut random = Random::keyed(&[17]);
    let (n, mut hits, mut differ) = (10_000, 0, 0);
    for _ in 0..n {
        let mut u = || random.uniform();
        let origin = DVec3::new(width * u(), height * u(), geometry.z_range()[1] + 0.01);
        let direction = DVec3::new(0.8 * u() - 0.4, 0.8 * u() - 0.4, -1.0).normalize();
        let ray = obvhs::ray::Ray::new(origin.as_vec3a(), direction.as_vec3a(), 0.0, 10.0);
        let mut hit = RayHit::none();
        let mut nearest = f64::INFINITY;
        tree.ray_traverse(ray, &mut hit, |_, i| {
            let (segment, offset) = copies[tree.primitive_indices[i] as usize];
            let entry = enter_by_definition(segment, offset, origin, direction);
            let t = entry.map_or(f64::INFINITY, |(t, _)| t);
            nearest = nearest.min(t);
            t as f32
        });
        match geometry.closest(origin, direction, &Skip::NOTHING) {
            Ended::Fiber(found) => {
                hits += 1;
                differ += u32::from((found.distance - nearest).abs() > 1e-5);
            }
            Ended::Up | Ended::Down => differ += u32::from(nearest.is_finite()),
        }
    }
    // A graze within f32 rounding of a surface may go either way; a fault in either would show far more often.
    assert!(differ <= n / 2000, "{differ} of {n} rays differ");
    assert!(hits > n * 9 / 10, "{hits}");
}
