//! Weave to yarns to fibers, and their files.
//!
//! Knows neither scattering nor sessions. Lengths are millimeters; x is the weft direction, y the warp direction, z the
//! sample normal, z = 0 the middle plane of the cloth.

use glam::DVec3;

/// "No segment": the fiber ends here.
pub const NO_SEGMENT: u32 = u32::MAX;

/// One straight piece of a fiber, a capsule once rendered.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Segment {
    /// Start point, millimeters.
    pub start: DVec3,
    /// End point, millimeters.
    pub end: DVec3,
    /// Fiber radius, millimeters.
    pub radius: f64,
    /// Which yarn system the fiber belongs to (0 warp, 1 weft, or as read from a file).
    pub yarn_system: u8,
    /// The segment whose end is this one's start (possibly across the tile's seam), or [`NO_SEGMENT`].
    pub previous: u32,
    /// The segment whose start is this one's end, or [`NO_SEGMENT`].
    pub next: u32,
}

/// Fibers on a rectangular tile that repeats forever in x and y. Points may lie outside the tile (a fiber is stored once,
/// unwrapped); copies at whole tile offsets are implied.
#[derive(Debug, Clone, PartialEq)]
pub struct FiberTile {
    /// Tile size in x and y, millimeters.
    pub size: [f64; 2],
    /// All segments, neighbors along a fiber next to each other.
    pub segments: Vec<Segment>,
}
