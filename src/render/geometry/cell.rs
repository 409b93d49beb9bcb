//! What lies in one periodic cell: the copies of segments that reach into it, and what is refused.

use super::Image;
use super::capsules::Capsule;
use super::grid::PAD;
use crate::base::{Error, Result};
use crate::fabric::{FiberTile, Segment};
use glam::DVec3;

/// Farthest from the plane z = 0 that a segment may lie, millimeters: a cloth's thickness is small beside the lamp's distance, and
/// `f32` keeps it to less than 0.01 micrometer.
const HIGHEST: f64 = 100.0;

/// Refuses tiles and segments that cannot be rendered.
pub(super) fn check(tile: &FiberTile) -> Result<()> {
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
        let heights = [s.start.z, s.end.z];
        if let Some(z) = heights.into_iter().find(|z| z.abs() > HIGHEST) {
            return Err(Error::new(format!(
                "segment {i} is at z = {z} mm: expected -{HIGHEST} to {HIGHEST} mm"
            ))
            .with_hint("the sample lies about z = 0, and lengths are millimeters"));
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

/// The capsules that reach into one periodic cell, from whichever copy.
pub(super) struct Cell {
    pub(super) capsules: Vec<Capsule>,
    /// Which copy each capsule is; copies of a segment lie together, in the segments' order.
    pub(super) images: Vec<Image>,
    /// Where each segment's copies start in `images`, and the end of the last.
    pub(super) first: Vec<u32>,
    /// Lowest and highest z of any fiber.
    pub(super) z_range: [f64; 2],
}

impl Cell {
    pub(super) fn new(tile: &FiberTile) -> Self {
        let [width, height] = tile.size;
        let mut z_range = [f64::INFINITY, f64::NEG_INFINITY];
        for s in &tile.segments {
            z_range[0] = z_range[0].min(s.start.z.min(s.end.z) - s.radius);
            z_range[1] = z_range[1].max(s.start.z.max(s.end.z) + s.radius);
        }
        // A little air, so that no hit is lost to rounding at the slab's faces.
        let air = 1e-6 * (z_range[1] - z_range[0]).max(1e-3);
        let z_range = [z_range[0] - air, z_range[1] + air];
        let margin = f64::from(PAD) * width.max(height).max(z_range[1] - z_range[0]);
        let (mut capsules, mut images) = (Vec::new(), Vec::new());
        let mut first = Vec::with_capacity(tile.segments.len() + 1);
        for (index, s) in tile.segments.iter().enumerate() {
            first.push(images.len() as u32);
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
                    capsules.push(Capsule::new(
                        (0.5 * (s.start + s.end) + offset).as_vec3().to_array(),
                        s.radius as f32,
                        (0.5 * (s.end - s.start)).as_vec3().to_array(),
                        images.len() as u32,
                    ));
                    images.push(Image {
                        segment: index as u32,
                        cell: [i, j],
                    });
                }
            }
        }
        first.push(images.len() as u32);
        Self {
            capsules,
            images,
            first,
            z_range,
        }
    }
}

/// How many whole tiles lie between a segment's ends and the stored neighbors that continue it.
pub(super) fn neighbor_steps(tile: &FiberTile, s: &Segment) -> [[i32; 2]; 2] {
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
