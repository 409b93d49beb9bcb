//! Weave to yarns to fibers, and their files.
//!
//! Knows neither scattering nor sessions. Lengths are millimeters; x is the weft direction, y the warp direction, z the
//! sample normal, z = 0 the middle plane of the cloth.
//!
//! [`load`] reads a fabric description (a woven swatch, or a pointer to a file of fibers) and gives a [`Fabric`]: the
//! periodic [`FiberTile`] a renderer needs, and a [`FabricReport`] of what it is made of. [`ct`] reads and prepares micro-CT volumes.

mod aside;
mod centerline;
mod csv_format;
pub mod ct;
mod curves;
mod describe;
mod description;
mod hair_format;
mod link;
mod mitsuba_format;
mod overlap;
mod visible;
mod voxel_fabric;
mod voxels;
mod weave;
mod wif;
mod woven;
mod yarn;

pub use centerline::{CenterLine, Jet, L_MAX, L_MIN, float_profile};
pub use curves::{Curve, curves, from_curves};
pub use describe::{FabricReport, SystemReport};
pub use description::{fiber_file, load, weave_of};
pub use visible::VisibleSegment;
pub use voxel_fabric::{VoxelFabric, load_voxels, voxel_file};
pub use voxels::{PackedDirection, VoxelTile};
pub use weave::{Draft, MAX_DRAFT};
pub use woven::{Closing, MAX_SEGMENTS, Segmentation, System, Woven};
pub use yarn::{RADIAL_EXPONENT, ZETA, base_angle, base_radius, migrated_radius, offset};

use crate::base::{Context, Error, Result};
use glam::DVec3;
use std::path::Path;

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

/// A fabric ready to render, and what it is.
#[derive(Debug, Clone, PartialEq)]
pub struct Fabric {
    /// Short name.
    pub name: String,
    /// What it stands for.
    pub description: String,
    /// Where its numbers come from, one note each.
    pub sources: Vec<String>,
    /// The fibers.
    pub tile: FiberTile,
    /// Counts, thickness, overlap and so on.
    pub report: FabricReport,
}

/// The file formats of fibers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Comma-separated segments with the tile size in a comment.
    Csv,
    /// Curve text of Mitsuba 3 (`linearcurve`, `bsplinecurve`).
    Mitsuba,
    /// Cem Yuksel's binary `.hair`.
    Hair,
}

impl Format {
    /// The format with this name, or the one of this file name's extension (`csv`, `txt`, `hair`).
    ///
    /// # Errors
    /// Neither tells a format.
    pub fn choose(name: Option<&str>, path: &Path) -> Result<Self> {
        let extension = path
            .extension()
            .and_then(|e| e.to_str())
            .map(str::to_lowercase);
        let hint = "formats: csv, mitsuba (.txt), hair";
        match (name, extension.as_deref()) {
            (Some("csv"), _) | (None, Some("csv")) => Ok(Self::Csv),
            (Some("mitsuba"), _) | (None, Some("txt")) => Ok(Self::Mitsuba),
            (Some("hair"), _) | (None, Some("hair")) => Ok(Self::Hair),
            (Some(other), _) => {
                Err(Error::new(format!("unknown fiber format '{other}'")).with_hint(hint))
            }
            (None, _) => Err(Error::new(format!(
                "the format of {} cannot be told from its name",
                path.display()
            ))
            .with_hint(hint)),
        }
    }
}

/// Reads a file of fibers.
///
/// `tile` is the tile size in millimeters; CSV files carry it in a comment, the other formats need it here.
///
/// # Errors
/// The file cannot be read, is torn or malformed (with the line or byte), holds no segment, a non-finite point or a radius
/// that is not positive, or its tile size is missing or contradicts `tile`.
pub fn import(path: &Path, format: Format, tile: Option<[f64; 2]>) -> Result<FiberTile> {
    let bytes =
        std::fs::read(path).context(|| format!("fibers {} cannot be read", path.display()))?;
    match format {
        Format::Csv => csv_format::read(&bytes, tile),
        Format::Mitsuba => mitsuba_format::read(&bytes, tile),
        Format::Hair => hair_format::read(&bytes, tile),
    }
    .context(|| format!("fibers {} cannot be used", path.display()))
}

/// The bytes of a file of fibers.
///
/// # Errors
/// The tile does not fit the format (coordinates beyond single precision, too many points for `.hair`).
pub fn export(tile: &FiberTile, format: Format) -> Result<Vec<u8>> {
    match format {
        Format::Csv => Ok(csv_format::write(tile)),
        Format::Mitsuba => Ok(mitsuba_format::write(tile)),
        Format::Hair => hair_format::write(tile),
    }
}

/// Checks a tile size in millimeters.
///
/// # Errors
/// A side is not a number in (1e-3, 1e4].
pub(crate) fn check_tile(size: [f64; 2]) -> Result<[f64; 2]> {
    if size.iter().all(|s| (1e-3..=1e4).contains(s)) {
        return Ok(size);
    }
    Err(Error::new(format!(
        "tile size {} x {} mm: expected two numbers from 0.001 to 10000",
        size[0], size[1]
    )))
}

/// The tile size from an argument for a format that does not store it.
///
/// # Errors
/// It is missing or senseless.
fn needed_tile(tile: Option<[f64; 2]>) -> Result<[f64; 2]> {
    let size = tile.ok_or_else(|| {
        Error::new("this format does not store the tile size").with_hint(
            "give it in millimeters: --tile X,Y, or tile_mm = [X, Y] in the fabric description",
        )
    })?;
    check_tile(size)
}

/// Checks one segment's numbers; `what` names its place in the file.
fn check_segment(start: DVec3, end: DVec3, radius: f64, what: impl Fn() -> String) -> Result<()> {
    if !(start.is_finite() && end.is_finite()) {
        return Err(Error::new(format!(
            "{}: expected finite coordinates, found {start} to {end}",
            what()
        )));
    }
    if !(start.abs().max_element() <= 1e6 && end.abs().max_element() <= 1e6) {
        return Err(Error::new(format!(
            "{}: coordinates {start} to {end} lie more than a kilometer away",
            what()
        ))
        .with_hint("coordinates are millimeters"));
    }
    if !(radius > 0.0 && radius <= 1e3) {
        return Err(Error::new(format!(
            "{}: expected a fiber radius above 0 and at most 1000 mm, found {radius}",
            what()
        )));
    }
    if start.distance(end) <= 0.0 {
        return Err(
            Error::new(format!("{}: the segment has no length ({start})", what()))
                .with_hint("remove repeated points: a segment needs a direction"),
        );
    }
    Ok(())
}
