//! Fibers as capsules on a tile that repeats forever in x and y, in an acceleration structure.
//!
//! Every capsule that reaches into the tile's cell, from whichever periodic copy, lies in one bounding volume hierarchy;
//! a ray walks from cell to cell and only hits inside the current cell count. Does not know how fibers scatter.

use crate::base::{Error, Result};
use crate::fabric::{FiberTile, NO_SEGMENT, Segment};
use glam::{DVec3, Vec3A};
use obvhs::cwbvh::{CwBvh, builder::build_cwbvh};
use obvhs::ray::{Ray, RayHit};
use obvhs::{Boundable, BvhBuildParams, aabb::Aabb};
use std::time::Duration;

/// One periodic copy of a segment: which segment, moved by how many whole tiles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Image {
    pub(super) segment: u32,
    pub(super) cell: [i32; 2],
}

const NO_IMAGE: Image = Image {
    segment: NO_SEGMENT,
    cell: [0, 0],
};

/// The segments a ray that leaves a fiber must not see: the one it leaves and its two neighbors.
#[derive(Debug, Clone, Copy)]
pub(super) struct Skip([Image; 3]);

impl Skip {
    pub(super) const NOTHING: Self = Self([NO_IMAGE; 3]);

    fn contains(&self, image: Image) -> bool {
        self.0.contains(&image)
    }

    fn segment(&self, segment: u32) -> bool {
        self.0.iter().any(|i| i.segment == segment)
    }
}

/// Where a ray enters a fiber.
#[derive(Debug, Clone, Copy)]
pub(super) struct Hit {
    /// Distance along the ray, millimeters.
    pub(super) distance: f64,
    pub(super) image: Image,
}

/// How a ray ended.
#[derive(Debug, Clone, Copy)]
pub(super) enum Ended {
    /// It enters a fiber.
    Fiber(Hit),
    /// It leaves the cloth upward.
    Up,
    /// It leaves the cloth downward.
    Down,
}

/// One capsule of the cell, as the ray test wants it: 32 bytes.
#[derive(Debug, Clone, Copy)]
struct Capsule {
    start: [f32; 3],
    radius: f32,
    axis: [f32; 3],
    /// Index into `images`.
    image: u32,
}

struct Boxed(Aabb);

impl Boundable for Boxed {
    fn aabb(&self) -> Aabb {
        self.0
    }
}

/// All fibers of a tile, ready for rays.
pub(super) struct Geometry {
    bvh: CwBvh,
    /// In the hierarchy's order.
    capsules: Vec<Capsule>,
    images: Vec<Image>,
    segments: Vec<Segment>,
    /// Whole-tile step from a segment to its `previous` and its `next`.
    steps: Vec<[[i32; 2]; 2]>,
    size: [f64; 2],
    z_range: [f64; 2],
}

/// Farthest a ray is followed inside the cloth, millimeters: only a ray within 1e-5 of horizontal can get there, and
/// the real sample has ended long before.
const REACH: f64 = 1e4;

impl Geometry {
    pub(super) fn new(tile: &FiberTile) -> Result<Self> {
        check(tile)?;
        let (boxes, capsules, images, z_range) = cell_contents(tile);
        let bvh = build_cwbvh(
            &boxes,
            BvhBuildParams::medium_build(),
            &mut Duration::default(),
        );
        let capsules = bvh
            .primitive_indices
            .iter()
            .map(|&i| capsules[i as usize])
            .collect();
        let steps = tile
            .segments
            .iter()
            .map(|s| neighbor_steps(tile, s))
            .collect();
        Ok(Self {
            bvh,
            capsules,
            images,
            segments: tile.segments.clone(),
            steps,
            size: tile.size,
            z_range,
        })
    }

    /// Lowest and highest z of any fiber, millimeters.
    pub(super) fn z_range(&self) -> [f64; 2] {
        self.z_range
    }

    /// Start, end and radius of a copy.
    pub(super) fn placed(&self, image: Image) -> (DVec3, DVec3, f64) {
        let s = &self.segments[image.segment as usize];
        let offset = self.offset(image.cell);
        (s.start + offset, s.end + offset, s.radius)
    }

    /// The copies that continue this one along its fiber, before and after.
    pub(super) fn neighbors(&self, image: Image) -> [Option<Image>; 2] {
        let Skip([_, before, after]) = self.skip(image);
        [before, after].map(|i| (i != NO_IMAGE).then_some(i))
    }

    /// What a ray that leaves this copy must not see.
    pub(super) fn skip(&self, image: Image) -> Skip {
        let s = &self.segments[image.segment as usize];
        let neighbor = |segment: u32, step: [i32; 2]| match segment {
            NO_SEGMENT => NO_IMAGE,
            _ => Image {
                segment,
                cell: [image.cell[0] + step[0], image.cell[1] + step[1]],
            },
        };
        let [before, after] = self.steps[image.segment as usize];
        Skip([image, neighbor(s.previous, before), neighbor(s.next, after)])
    }

    /// The first fiber a ray enters; `direction` is a unit vector.
    pub(super) fn closest(&self, origin: DVec3, direction: DVec3, skip: &Skip) -> Ended {
        let mut found = None;
        let ended = self.walk(origin, direction, |ray, cell, walked| {
            let mut hit = RayHit::none();
            let mut winner = NO_IMAGE;
            self.bvh.ray_traverse(ray, &mut hit, |ray, i| {
                let (t, image) = self.test(ray, i, cell, skip);
                if t < ray.tmax {
                    winner = image;
                }
                t
            });
            if winner != NO_IMAGE {
                found = Some(Hit {
                    distance: walked + f64::from(hit.t),
                    image: winner,
                });
            }
            winner != NO_IMAGE
        });
        found.map_or(ended, Ended::Fiber)
    }

    /// True when the ray leaves the cloth, up or down, without entering a fiber.
    pub(super) fn passes(&self, origin: DVec3, direction: DVec3, skip: &Skip) -> bool {
        let mut blocked = false;
        self.walk(origin, direction, |ray, cell, _| {
            blocked = !self
                .bvh
                .ray_traverse_miss(ray, |ray, i| self.test(ray, i, cell, skip).0);
            blocked
        });
        !blocked
    }

    /// Distance at which the cell's ray enters capsule `i`; infinite when it does not, or must not see it.
    #[inline(always)]
    fn test(&self, ray: &Ray, i: usize, cell: [i32; 2], skip: &Skip) -> (f32, Image) {
        let capsule = &self.capsules[i];
        let t = enter_capsule(ray, capsule);
        if t == f32::INFINITY {
            return (t, NO_IMAGE);
        }
        let local = self.images[capsule.image as usize];
        let image = Image {
            segment: local.segment,
            cell: [local.cell[0] + cell[0], local.cell[1] + cell[1]],
        };
        if skip.segment(image.segment) && skip.contains(image) {
            return (f32::INFINITY, NO_IMAGE);
        }
        (t, image)
    }

    fn offset(&self, cell: [i32; 2]) -> DVec3 {
        DVec3::new(
            f64::from(cell[0]) * self.size[0],
            f64::from(cell[1]) * self.size[1],
            0.0,
        )
    }

    /// Walks a ray through the cells between the cloth's lowest and highest z. `visit(ray, cell, walked)` gets the
    /// piece inside one cell, in the cell's coordinates and starting `walked` along the ray, and returns true to end.
    #[inline(always)]
    fn walk(
        &self,
        origin: DVec3,
        direction: DVec3,
        mut visit: impl FnMut(Ray, [i32; 2], f64) -> bool,
    ) -> Ended {
        // Adding +0.0 turns -0.0 into +0.0, which the hierarchy's node test needs.
        let d = direction + DVec3::ZERO;
        let ended = if d.z > 0.0 { Ended::Up } else { Ended::Down };
        let (mut t, mut t_end) = (0.0_f64, REACH);
        if d.z != 0.0 {
            let (a, b) = (
                (self.z_range[0] - origin.z) / d.z,
                (self.z_range[1] - origin.z) / d.z,
            );
            t = t.max(a.min(b));
            t_end = t_end.min(a.max(b));
        } else if !(self.z_range[0]..=self.z_range[1]).contains(&origin.z) {
            return ended;
        }
        if t >= t_end {
            return ended;
        }
        let direction32 = d.as_vec3a();
        let start = origin + d * t;
        let mut cell = [
            (start.x / self.size[0]).floor() as i32,
            (start.y / self.size[1]).floor() as i32,
        ];
        loop {
            let exit = |axis: usize, o: f64, d: f64| {
                let wall = f64::from(cell[axis] + i32::from(d > 0.0)) * self.size[axis];
                if d == 0.0 {
                    f64::INFINITY
                } else {
                    (wall - o) / d
                }
            };
            let (tx, ty) = (exit(0, origin.x, d.x), exit(1, origin.y, d.y));
            let t_next = tx.min(ty).min(t_end).max(t);
            let local = origin + d * t - self.offset(cell);
            let ray = Ray::new(local.as_vec3a(), direction32, 0.0, (t_next - t) as f32);
            if visit(ray, cell, t) || t_next >= t_end {
                return ended;
            }
            t = t_next;
            if tx <= ty {
                cell[0] += if d.x > 0.0 { 1 } else { -1 };
            } else {
                cell[1] += if d.y > 0.0 { 1 } else { -1 };
            }
        }
    }
}

/// Distance at which a ray enters a capsule; infinite when it misses, starts inside, or the capsule lies behind.
///
/// The origin is first moved to the point of the ray closest to the capsule's middle, so that f32 loses nothing over long
/// distances; cross products keep the quadratic's coefficients exact for rays almost parallel to the axis.
#[inline(always)]
fn enter_capsule(ray: &Ray, capsule: &Capsule) -> f32 {
    const MISS: f32 = f32::INFINITY;
    let axis = Vec3A::from_array(capsule.axis);
    let start = Vec3A::from_array(capsule.start);
    let radius = capsule.radius;
    let d = ray.direction;
    let middle = start + 0.5 * axis;
    let shift = (middle - ray.origin).dot(d);
    let from_start = ray.origin + d * shift - start;
    let n = d.cross(axis);
    let m = from_start.cross(axis);
    let length2 = axis.length_squared();
    let (a, b, c) = (
        n.length_squared(),
        n.dot(m),
        m.length_squared() - radius * radius * length2,
    );
    let h = b * b - a * c;
    if h < 0.0 {
        return MISS;
    }
    let along_axis = d.dot(axis);
    // For a == 0 (parallel ray) this is not finite and the comparisons below choose the facing cap.
    let t = (-b - h.sqrt()) / a;
    let y = from_start.dot(axis) + t * along_axis;
    let entry = if y > 0.0 && y < length2 {
        t
    } else {
        let at_start = if a > 0.0 { y <= 0.0 } else { along_axis > 0.0 };
        let oc = if at_start {
            from_start
        } else {
            from_start - axis
        };
        let b = d.dot(oc);
        // The squared distance of the cap's center from the line, without cancellation.
        let h = radius * radius - (oc - d * b).length_squared();
        if h < 0.0 {
            return MISS;
        }
        -b - h.sqrt()
    };
    let distance = entry + shift;
    if distance >= 0.0 { distance } else { MISS }
}

fn check(tile: &FiberTile) -> Result<()> {
    if !tile.size.iter().all(|s| (1e-3..=1e3).contains(s)) {
        return Err(Error::new(format!(
            "tile size {} x {} mm: expected 0.001 to 1000 mm",
            tile.size[0], tile.size[1]
        ))
        .with_hint("lengths are millimeters"));
    }
    if tile.segments.is_empty() {
        return Err(Error::new("the fabric has no fiber segments")
            .with_hint("an empty fabric cannot be rendered"));
    }
    let mut copies = 0.0;
    for (i, s) in tile.segments.iter().enumerate() {
        if !(s.start.is_finite() && s.end.is_finite() && (1e-6..=10.0).contains(&s.radius)) {
            return Err(Error::new(format!("segment {i} is not usable: {s:?}"))
                .with_hint("points must be finite and radii between 1e-6 and 10 mm"));
        }
        let extent = (s.end - s.start).abs() + 2.0 * s.radius;
        let spanned = (extent.x / tile.size[0] + 2.0) * (extent.y / tile.size[1] + 2.0);
        copies += spanned;
        if spanned > 1e4 || copies > 1e8 {
            return Err(Error::new(format!(
                "segment {i} spans {spanned:.0} tiles of {} x {} mm",
                tile.size[0], tile.size[1]
            ))
            .with_hint("is the tile size right, and are lengths millimeters?"));
        }
    }
    Ok(())
}

/// The capsules that reach into the cell, their boxes cut to the cell, and the z range of all fibers.
fn cell_contents(tile: &FiberTile) -> (Vec<Boxed>, Vec<Capsule>, Vec<Image>, [f64; 2]) {
    let [width, height] = tile.size;
    let mut z_range = [f64::INFINITY, f64::NEG_INFINITY];
    for s in &tile.segments {
        z_range[0] = z_range[0].min(s.start.z.min(s.end.z) - s.radius);
        z_range[1] = z_range[1].max(s.start.z.max(s.end.z) + s.radius);
    }
    // A little air, so that no hit is lost to rounding at the slab's faces.
    let air = 1e-6 * (z_range[1] - z_range[0]).max(1e-3);
    let z_range = [z_range[0] - air, z_range[1] + air];
    let margin = 1e-6 * width.max(height);
    let (mut boxes, mut capsules, mut images) = (Vec::new(), Vec::new(), Vec::new());
    for (index, s) in tile.segments.iter().enumerate() {
        let low = s.start.min(s.end) - s.radius;
        let high = s.start.max(s.end) + s.radius;
        // Copies moved by (i, j) tiles that overlap [0, width] x [0, height].
        let range = |low: f64, high: f64, size: f64| {
            let first = ((-margin - high) / size).ceil() as i32;
            let last = ((size + margin - low) / size).floor() as i32;
            first..=last
        };
        for j in range(low.y, high.y, height) {
            for i in range(low.x, high.x, width) {
                let offset = DVec3::new(f64::from(i) * width, f64::from(j) * height, 0.0);
                let cell_low = DVec3::new(-margin, -margin, z_range[0]);
                let cell_high = DVec3::new(width + margin, height + margin, z_range[1]);
                boxes.push(Boxed(Aabb::new(
                    (low + offset).max(cell_low).as_vec3a(),
                    (high + offset).min(cell_high).as_vec3a(),
                )));
                capsules.push(Capsule {
                    start: (s.start + offset).as_vec3().to_array(),
                    radius: s.radius as f32,
                    axis: (s.end - s.start).as_vec3().to_array(),
                    image: images.len() as u32,
                });
                images.push(Image {
                    segment: index as u32,
                    cell: [i, j],
                });
            }
        }
    }
    (boxes, capsules, images, z_range)
}

/// How many whole tiles lie between a segment's ends and the stored neighbors that continue it.
fn neighbor_steps(tile: &FiberTile, s: &Segment) -> [[i32; 2]; 2] {
    let step = |from: DVec3, to: DVec3| {
        let d = from - to;
        [
            (d.x / tile.size[0]).round() as i32,
            (d.y / tile.size[1]).round() as i32,
        ]
    };
    let neighbor = |i: u32| tile.segments.get(i as usize);
    [
        neighbor(s.previous).map_or([0, 0], |p| step(s.start, p.end)),
        neighbor(s.next).map_or([0, 0], |n| step(s.end, n.start)),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    fn soup(n: usize, seed: u64, thickest: f64) -> FiberTile {
        let mut random = Random::keyed(&[seed]);
        let size = [2.0, 1.5];
        let segments = (0..n)
            .map(|_| {
                let mut u = || random.uniform();
                let start = DVec3::new(3.0 * u() - 0.5, 2.0 * u() - 0.5, 0.3 * u());
                let end = start + DVec3::new(u() - 0.5, u() - 0.5, 0.1 * u()) * 0.6;
                let radius = thickest * (0.2 + 0.8 * u());
                Segment {
                    start,
                    end,
                    radius,
                    yarn_system: 0,
                    previous: NO_SEGMENT,
                    next: NO_SEGMENT,
                }
            })
            .collect();
        FiberTile { size, segments }
    }

    /// Entry into the capsule by f64 on the definition: first point at distance `radius` from the segment.
    fn enter_by_definition(s: &Segment, offset: DVec3, origin: DVec3, d: DVec3) -> f64 {
        let distance = |t: f64| {
            let p = origin + d * t - s.start - offset;
            let axis = s.end - s.start;
            let along = (p.dot(axis) / axis.length_squared()).clamp(0.0, 1.0);
            (p - axis * along).length() - s.radius
        };
        // The distance to a convex body is convex along the ray: minimize by ternary search, then bisect.
        let (mut low, mut high) = (0.0, 40.0);
        for _ in 0..200 {
            let (a, b) = (low + (high - low) / 3.0, high - (high - low) / 3.0);
            if distance(a) < distance(b) {
                high = b
            } else {
                low = a
            }
        }
        let closest = 0.5 * (low + high);
        if distance(closest) >= 0.0 || distance(0.0) < 0.0 {
            return f64::INFINITY;
        }
        let (mut low, mut high) = (0.0, closest);
        for _ in 0..100 {
            let middle = 0.5 * (low + high);
            if distance(middle) > 0.0 {
                low = middle
            } else {
                high = middle
            }
        }
        low
    }

    fn brute_force(tile: &FiberTile, origin: DVec3, d: DVec3, skip: &Skip) -> Option<(f64, Image)> {
        let mut best = None;
        for (index, s) in tile.segments.iter().enumerate() {
            for j in -6..=6 {
                for i in -6..=6 {
                    let image = Image {
                        segment: index as u32,
                        cell: [i, j],
                    };
                    let offset = DVec3::new(
                        f64::from(i) * tile.size[0],
                        f64::from(j) * tile.size[1],
                        0.0,
                    );
                    if skip.contains(image) {
                        continue;
                    }
                    let t = enter_by_definition(s, offset, origin, d);
                    if t < best.map_or(8.0, |(t, _)| t) {
                        best = Some((t, image));
                    }
                }
            }
        }
        best
    }

    fn compare(tile: &FiberTile, geometry: &Geometry, origin: DVec3, d: DVec3, skip: &Skip) {
        let expected = brute_force(tile, origin, d, skip);
        let found = geometry.closest(origin, d, skip);
        match (expected, found) {
            (None, Ended::Up | Ended::Down) => {}
            (None, Ended::Fiber(hit)) if hit.distance > 7.9 => {}
            (Some((t, image)), Ended::Fiber(hit)) => {
                assert!(
                    (t - hit.distance).abs() < 2e-4,
                    "{t} {hit:?} from {origin} along {d}"
                );
                assert!(
                    image == hit.image || (t - hit.distance).abs() < 1e-5,
                    "{image:?} {hit:?}"
                );
            }
            // A graze: the ray passes within f32 rounding of the surface.
            (Some((t, image)), _) => {
                let (a, b, r) = geometry.placed(image);
                let p = origin + d * t;
                let along = ((p - a).dot(b - a) / (b - a).length_squared()).clamp(0.0, 1.0);
                let normal = (p - a - (b - a) * along) / r;
                assert!(
                    normal.dot(d).abs() < 0.02,
                    "missed {image:?} at {t} from {origin} along {d}"
                );
            }
            (None, Ended::Fiber(hit)) => {
                panic!("{hit:?} from {origin} along {d}, but nothing is there")
            }
        }
    }

    #[test]
    fn closest_hits_match_brute_force_over_the_repeated_tile() {
        let tile = soup(12, 3, 0.025);
        let geometry = Geometry::new(&tile).unwrap();
        let mut random = Random::keyed(&[4]);
        for _ in 0..60 {
            let mut u = || random.uniform();
            let origin = DVec3::new(6.0 * u() - 3.0, 6.0 * u() - 3.0, 0.5 * u() - 0.1);
            let d = DVec3::new(u() - 0.5, u() - 0.5, 0.3 * (u() - 0.5)).normalize();
            compare(&tile, &geometry, origin, d, &Skip::NOTHING);
        }
    }

    #[test]
    fn axis_aligned_rays_hit_whatever_the_sign_of_their_zeros() {
        let tile = soup(40, 5, 0.15);
        let geometry = Geometry::new(&tile).unwrap();
        let mut hits = 0;
        for (i, d) in [
            DVec3::X,
            -DVec3::X,
            DVec3::Y,
            -DVec3::Y,
            DVec3::Z,
            -DVec3::Z,
        ]
        .into_iter()
        .enumerate()
        {
            for zero in [0.0, -0.0] {
                let d = DVec3::from_array(d.to_array().map(|x| if x == 0.0 { zero } else { x }));
                let origin = DVec3::new(
                    0.31 * i as f64,
                    0.7,
                    if d.z == 0.0 {
                        0.15
                    } else {
                        -0.5 * d.z.signum() + 0.15
                    },
                );
                compare(&tile, &geometry, origin, d, &Skip::NOTHING);
                hits += i32::from(matches!(
                    geometry.closest(origin, d, &Skip::NOTHING),
                    Ended::Fiber(_)
                ));
            }
        }
        assert!(hits >= 8, "{hits}");
    }

    #[test]
    fn a_skipped_image_is_transparent_but_its_periodic_copies_are_not() {
        let mut tile = soup(1, 7, 0.025);
        tile.segments[0].start = DVec3::new(0.5, 0.5, 0.1);
        tile.segments[0].end = DVec3::new(0.5, 0.9, 0.1);
        let geometry = Geometry::new(&tile).unwrap();
        let origin = DVec3::new(0.0, 0.7, 0.1);
        let Ended::Fiber(first) = geometry.closest(origin, DVec3::X, &Skip::NOTHING) else {
            panic!("no hit")
        };
        assert_eq!(
            first.image,
            Image {
                segment: 0,
                cell: [0, 0]
            }
        );
        let skip = geometry.skip(first.image);
        let Ended::Fiber(second) = geometry.closest(origin, DVec3::X, &skip) else {
            panic!("no second hit")
        };
        assert_eq!(
            second.image,
            Image {
                segment: 0,
                cell: [1, 0]
            }
        );
        assert!((second.distance - first.distance - 2.0).abs() < 1e-5);
    }

    #[test]
    fn a_ray_along_a_fiber_enters_its_facing_cap() {
        let segment = |start: DVec3, end: DVec3| Segment {
            start,
            end,
            radius: 0.01,
            yarn_system: 0,
            previous: NO_SEGMENT,
            next: NO_SEGMENT,
        };
        let tile = FiberTile {
            size: [2.0, 2.0],
            segments: vec![segment(
                DVec3::new(0.5, 1.0, 0.1),
                DVec3::new(1.5, 1.0, 0.1),
            )],
        };
        let geometry = Geometry::new(&tile).unwrap();
        for (origin, d) in [
            (DVec3::new(0.1, 1.0, 0.1), DVec3::X),
            (DVec3::new(1.9, 1.0, 0.1), -DVec3::X),
        ] {
            let Ended::Fiber(hit) = geometry.closest(origin, d, &Skip::NOTHING) else {
                panic!("missed")
            };
            assert!((hit.distance - 0.39).abs() < 1e-6, "{hit:?}");
        }
        let inside = geometry.closest(DVec3::new(1.0, 1.0, 0.1), DVec3::Z, &Skip::NOTHING);
        assert!(
            matches!(inside, Ended::Up),
            "only entering hits count: {inside:?}"
        );
    }

    #[test]
    fn unusable_tiles_are_refused() {
        let refused = |tile: FiberTile| {
            Geometry::new(&tile)
                .err()
                .map(|e| e.report())
                .unwrap_or_default()
        };
        assert!(
            refused(FiberTile {
                size: [1.0, 1.0],
                segments: vec![]
            })
            .contains("no fiber segments")
        );
        let mut tile = soup(1, 1, 0.025);
        tile.segments[0].radius = f64::NAN;
        assert!(refused(tile).contains("segment 0"));
        assert!(
            refused(FiberTile {
                size: [f64::NAN, 1.0],
                ..soup(1, 1, 0.025)
            })
            .contains("tile size")
        );
    }
}
