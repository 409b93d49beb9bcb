//! Rays against brute force: every processor path, hostile geometry, and laws that any ray tracer keeps.
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

/// Signed distance from a point to a capsule's surface.
fn outside(s: &Segment, offset: DVec3, p: DVec3) -> f64 {
    let (from_start, axis) = (p - s.start - offset, s.end - s.start);
    let along = (from_start.dot(axis) / axis.length_squared()).clamp(0.0, 1.0);
    (from_start - axis * along).length() - s.radius
}

/// Entry into the capsule in f64 from the definition, the first point on the surface, and how deep the ray then gets;
/// `None` when it misses or starts inside.
pub(super) fn enter_by_definition(
    s: &Segment,
    offset: DVec3,
    origin: DVec3,
    d: DVec3,
) -> Option<(f64, f64)> {
    let middle = (0.5 * (s.start + s.end) + offset - origin).dot(d);
    let half = 0.5 * s.start.distance(s.end) + s.radius;
    let distance = |t: f64| outside(s, offset, origin + d * t);
    // The distance to a convex body is convex along the ray: minimize by ternary search, then bisect.
    let (first, mut low, mut high) = (
        (middle - half).max(0.0),
        (middle - half).max(0.0),
        middle + half,
    );
    if high <= 0.0 {
        return None;
    }
    for _ in 0..120 {
        let (a, b) = (low + (high - low) / 3.0, high - (high - low) / 3.0);
        if distance(a) < distance(b) {
            high = b
        } else {
            low = a
        }
    }
    let closest = 0.5 * (low + high);
    if distance(closest) >= 0.0 || distance(0.0) < 0.0 {
        return None;
    }
    let (mut low, mut high) = (first, closest);
    for _ in 0..80 {
        let middle = 0.5 * (low + high);
        if distance(middle) > 0.0 {
            low = middle
        } else {
            high = middle
        }
    }
    Some((low, -distance(closest)))
}

/// The first entry within `reach` among all copies, one after the other: distance, copy, depth.
fn brute_force(
    tile: &FiberTile,
    origin: DVec3,
    d: DVec3,
    skip: &Skip,
    reach: f64,
) -> Option<(f64, Image, f64)> {
    let end = origin + d * reach;
    let mut best: Option<(f64, Image, f64)> = None;
    for (segment, s) in (0_u32..).zip(&tile.segments) {
        let half = 0.5 * s.start.distance(s.end) + s.radius;
        let middle = 0.5 * (s.start + s.end);
        let range = |k: usize| {
            let first = (origin[k].min(end[k]) - half - middle[k]) / tile.size[k];
            let last = (origin[k].max(end[k]) + half - middle[k]) / tile.size[k];
            first.floor() as i32..=last.ceil() as i32
        };
        for j in range(1) {
            for i in range(0) {
                let image = Image {
                    segment,
                    cell: [i, j],
                };
                let offset = DVec3::new(
                    f64::from(i) * tile.size[0],
                    f64::from(j) * tile.size[1],
                    0.0,
                );
                let to_middle = middle + offset - origin;
                let line = (to_middle - d * to_middle.dot(d)).length();
                if line > half || skip.contains(image) {
                    continue;
                }
                let entry = enter_by_definition(s, offset, origin, d);
                if let Some((t, depth)) = entry
                    && t < best.map_or(reach, |(t, ..)| t)
                {
                    best = Some((t, image, depth));
                }
            }
        }
    }
    best
}

/// Says what is wrong where the ray's hit and brute force disagree by more than f32 explains: at most a hundredth of a
/// radius in depth, where a ray only grazes a fiber, and the like in distance.
fn compare(
    tile: &FiberTile,
    geometry: &Geometry,
    origin: DVec3,
    d: DVec3,
    skip: &Skip,
    reach: f64,
) -> std::result::Result<(), String> {
    let at = || format!("from {origin} along {d}");
    let found = match geometry.closest(origin, d, skip) {
        Ended::Fiber(hit) if hit.distance < reach => Some(hit),
        _ => None,
    };
    // One rounding of the largest coordinate, times eight: 1 nm on a tile of 2 mm.
    let size = tile.size[0]
        .max(tile.size[1])
        .max(geometry.z_range[1] - geometry.z_range[0]);
    let rounding = 5e-7 * size;
    let offset = |image: Image| geometry.offset(image.cell);
    let segment = |image: Image| &tile.segments[image.segment as usize];
    if let Some(hit) = found {
        if skip.contains(hit.image) {
            return Err(format!("{hit:?} is to be skipped, {}", at()));
        }
        let off = outside(
            segment(hit.image),
            offset(hit.image),
            origin + d * hit.distance,
        );
        if off.abs() > rounding + 1e-3 * segment(hit.image).radius {
            return Err(format!("{hit:?} is {off} off the surface, {}", at()));
        }
    }
    let limit = found.map_or(reach, |hit| hit.distance);
    let expected = brute_force(
        tile,
        origin,
        d,
        skip,
        limit * (1.0 + 1e-3) + 10.0 * rounding,
    );
    let slight = |image: Image, depth: f64| depth < rounding + 1e-2 * segment(image).radius;
    match (expected, found) {
        (None, None) => Ok(()),
        (Some((t, image, depth)), _)
            if t < limit - 1e-2 * segment(image).radius - 10.0 * rounding =>
        {
            // Something nearer was missed: only a graze, or a start on its very surface.
            let start = outside(segment(image), offset(image), origin);
            if slight(image, depth) || start.abs() < rounding {
                return Ok(());
            }
            Err(format!(
                "missed {image:?} at {t}, found {found:?}, {}",
                at()
            ))
        }
        (Some(_), _) => Ok(()),
        (None, Some(hit)) => {
            let entry = enter_by_definition(segment(hit.image), offset(hit.image), origin, d);
            let start = outside(segment(hit.image), offset(hit.image), origin);
            // A graze the other way round: the nearest point of the ray lies just outside.
            let near =
                start.abs() < rounding || entry.is_some_and(|(_, depth)| slight(hit.image, depth));
            let beside = (0..=20).any(|k| {
                let t = hit.distance + 0.01 * f64::from(k) * segment(hit.image).radius;
                outside(segment(hit.image), offset(hit.image), origin + d * t).abs() < rounding
            });
            if near || beside {
                Ok(())
            } else {
                Err(format!("{hit:?}, but nothing is there, {}", at()))
            }
        }
    }
}

/// Random rays through the slab, some along an axis or along a fiber; all processor paths; the number of rays that are
/// wrong, and the first of them.
fn wrong_rays(
    tile: &FiberTile,
    geometry: &mut Geometry,
    rays: usize,
    reach: f64,
    seed: u64,
) -> (usize, String) {
    let mut random = Random::keyed(&[seed]);
    let (mut wrong, mut first) = (0, String::new());
    for k in 0..rays {
        let mut u = || random.uniform();
        let z = geometry.z_range;
        let s = &tile.segments[(u() * tile.segments.len() as f64) as usize];
        let mut origin = DVec3::new(
            (3.0 * u() - 1.0) * tile.size[0],
            (3.0 * u() - 1.0) * tile.size[1],
            z[0] + (z[1] - z[0]) * (1.4 * u() - 0.2),
        );
        let sphere = DVec3::new(u() - 0.5, u() - 0.5, u() - 0.5).normalize();
        let d = match k % 8 {
            0 => DVec3::new(sphere.x, sphere.y, 1e-3 * sphere.z).normalize(),
            1 => DVec3::AXES[k / 8 % 3] * sphere.x.signum(),
            2 => {
                origin = s.start - 0.5 * (s.end - s.start) + 0.5 * s.radius * sphere;
                (s.end - s.start).normalize()
            }
            _ => sphere,
        };
        for processor in Processor::all() {
            geometry.processor = processor;
            if let Err(what) = compare(tile, geometry, origin, d, &Skip::NOTHING, reach) {
                if wrong == 0 {
                    first = format!("{processor:?}: {what}");
                }
                wrong += 1;
            }
        }
    }
    (wrong, first)
}

fn scaled(mut tile: FiberTile, factor: f64) -> FiberTile {
    tile.size = tile.size.map(|s| s * factor);
    for s in &mut tile.segments {
        (s.start, s.end, s.radius) = (s.start * factor, s.end * factor, s.radius * factor);
    }
    tile
}

/// Long thin capsules in all directions, some spanning several tiles.
fn needles(n: usize, seed: u64) -> FiberTile {
    let mut tile = soup(n, seed, 0.004);
    let mut random = Random::keyed(&[seed, 1]);
    for s in &mut tile.segments {
        let mut u = || random.uniform() - 0.5;
        s.end = s.start + DVec3::new(4.0 * u(), 4.0 * u(), u());
    }
    tile
}

/// All capsules through one point: more than any list was sized for.
fn star(n: usize, seed: u64) -> FiberTile {
    let mut tile = soup(n, seed, 0.02);
    for s in &mut tile.segments {
        let half = 0.5 * (s.end - s.start);
        (s.start, s.end) = (
            DVec3::new(0.9, 0.7, 0.1) - half,
            DVec3::new(0.9, 0.7, 0.1) + half,
        );
    }
    tile
}

/// Sees when one capsule in twenty is missing.
#[test]
fn hits_match_brute_force_on_hostile_tiles_on_every_processor_path() {
    let tiles = [
        ("soup", soup(60, 3, 0.025)),
        ("thick and overlapping", soup(60, 5, 0.15)),
        ("needles", needles(60, 6)),
        ("star", star(200, 7)),
        ("two micrometers", scaled(soup(60, 8, 0.025), 1e-3)),
        ("ten centimeters", scaled(soup(60, 9, 0.025), 50.0)),
    ];
    for (name, tile) in tiles {
        let mut geometry = Geometry::new(&tile).unwrap();
        let reach = 4.0 * tile.size[0];
        let (wrong, first) = wrong_rays(&tile, &mut geometry, 400, reach, 11);
        assert_eq!(wrong, 0, "{name}: {first}");
        let mut less = tile.clone();
        less.segments.truncate(tile.segments.len() * 19 / 20);
        let mut geometry = Geometry::new(&less).unwrap();
        let (wrong, _) = wrong_rays(&tile, &mut geometry, 400, reach, 11);
        assert!(wrong > 0, "{name}: missing capsules are not seen");
    }
}

pub(super) fn bench_twill() -> FiberTile {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/fabrics/bench_twill22.toml");
    crate::fabric::load(std::path::Path::new(path))
        .unwrap()
        .tile
}

/// A bounce off a random fiber of the tile: a point of its surface, a direction away from it, what it must not see.
fn bounce(geometry: &Geometry, random: &mut Random) -> (DVec3, DVec3, Skip) {
    let segment = (random.uniform() * geometry.segments.len() as f64) as u32;
    let image = Image {
        segment,
        cell: [(random.uniform() * 3.0) as i32 - 1, 0],
    };
    let (start, end, radius) = geometry.placed(image);
    let mut u = || random.uniform() - 0.5;
    let d = DVec3::new(u(), u(), u()).normalize();
    let axis = (end - start).normalize();
    let normal = (d - axis * d.dot(axis)).normalize();
    let point = start + (end - start) * (0.5 + u()) + normal * radius;
    (point, d, geometry.skip(image))
}

#[test]
fn hits_in_the_bench_twill_match_brute_force_and_both_questions_agree() {
    let tile = bench_twill();
    let mut geometry = Geometry::new(&tile).unwrap();
    let mut random = Random::keyed(&[21]);
    for k in 0..100_000 {
        let (origin, d, skip) = bounce(&geometry, &mut random);
        let mut hits = Vec::new();
        for processor in Processor::all() {
            geometry.processor = processor;
            let ended = geometry.closest(origin, d, &skip);
            let passes = geometry.passes(origin, d, &skip);
            assert_eq!(
                passes,
                !matches!(ended, Ended::Fiber(_)),
                "{ended:?} from {origin} along {d}"
            );
            hits.push(match ended {
                Ended::Fiber(hit) => Some((hit.distance.to_bits(), hit.image)),
                _ => None,
            });
        }
        // All vector paths agree to the last bit.
        assert!(
            hits[1..].windows(2).all(|pair| pair[0] == pair[1]),
            "{hits:?} from {origin} along {d}"
        );
        if k < 150 {
            for processor in Processor::all() {
                geometry.processor = processor;
                let reach = tile.size[0];
                assert_eq!(
                    compare(&tile, &geometry, origin, d, &skip, reach),
                    Ok(()),
                    "{processor:?}"
                );
            }
        }
    }
}

#[test]
fn rays_that_are_no_rays_end() {
    let tile = soup(40, 5, 0.15);
    let geometry = Geometry::new(&tile).unwrap();
    for bad in [f64::NAN, f64::INFINITY, -f64::INFINITY, 1e300, -1e300] {
        for axis in 0..3 {
            let (mut origin, mut d) = (DVec3::new(0.3, 0.4, 0.1), DVec3::new(0.6, 0.0, 0.8));
            origin[axis] = bad;
            let found = geometry.closest(origin, d, &Skip::NOTHING);
            assert!(!matches!(found, Ended::Fiber(_)), "{found:?} from {origin}");
            assert!(geometry.passes(origin, d, &Skip::NOTHING));
            d[axis] = bad;
            geometry.closest(DVec3::new(0.3, 0.4, 0.1), d, &Skip::NOTHING);
            geometry.passes(DVec3::new(0.3, 0.4, 0.1), d, &Skip::NOTHING);
        }
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
            assert_eq!(
                compare(&tile, &geometry, origin, d, &Skip::NOTHING, 8.0),
                Ok(())
            );
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
    let mut tile = soup(1, 1, 0.025);
    tile.segments[0].end.z = 2e4;
    assert!(refused(tile).contains("z = 20000 mm"));
    assert!(
        refused(FiberTile {
            size: [f64::NAN, 1.0],
            ..soup(1, 1, 0.025)
        })
        .contains("tile size")
    );
}
