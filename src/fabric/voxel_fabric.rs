//! Fabrics that are volumes: a description (`kind = "voxels"`) that points to a file of voxels.

use super::VoxelTile;
use crate::base::{Context, Error, Result};
use glam::DVec3;
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// The description's keys.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct VoxelFile {
    kind: String,
    name: String,
    #[serde(default)]
    description: String,
    #[serde(default)]
    sources: Vec<String>,
    file: String,
    density_per_mm: Option<f64>,
}

/// A volume ready to render, and what it is.
#[derive(Debug, Clone, PartialEq)]
pub struct VoxelFabric {
    /// Short name.
    pub name: String,
    /// What it stands for.
    pub description: String,
    /// Where its numbers come from, one note each.
    pub sources: Vec<String>,
    /// The voxels.
    pub tile: VoxelTile,
    /// Density n of a voxel of value 1, 1/mm, where the description says it.
    pub density_per_mm: Option<f64>,
}

/// The file of voxels a description points to; none where it describes fibers or cannot be read.
pub fn voxel_file(path: &Path) -> Option<PathBuf> {
    let table: toml::Table = toml::from_str(&std::fs::read_to_string(path).ok()?).ok()?;
    if table.get("kind")?.as_str()? != "voxels" {
        return None;
    }
    let folder = path.parent().unwrap_or(Path::new("."));
    Some(folder.join(table.get("file")?.as_str()?))
}

/// Reads a fabric that is a volume.
///
/// # Errors
/// The description or its file of voxels cannot be read, has an unknown or missing key, or a density that is not positive.
pub fn load_voxels(path: &Path) -> Result<VoxelFabric> {
    let what = || format!("fabric {} cannot be used", path.display());
    let text = std::fs::read_to_string(path)
        .context(|| format!("fabric {} cannot be read", path.display()))?;
    let file: VoxelFile = super::description::parse(&text).context(what)?;
    let folder = path.parent().unwrap_or(Path::new("."));
    read(file, folder).context(what)
}

fn read(file: VoxelFile, folder: &Path) -> Result<VoxelFabric> {
    if file.kind != "voxels" {
        return Err(Error::new(format!(
            "kind is '{}', expected 'voxels'",
            file.kind
        )));
    }
    if let Some(density) = file.density_per_mm
        && !(1e-3..=1e6).contains(&density)
    {
        return Err(Error::new(format!(
            "density_per_mm is {density}, expected 0.001 to 1000000"
        ))
        .with_hint("the published fits take 400 per mm"));
    }
    Ok(VoxelFabric {
        name: file.name,
        description: file.description,
        sources: file.sources,
        tile: read_tile(&folder.join(&file.file))?,
        density_per_mm: file.density_per_mm,
    })
}

/// Reads a tile of voxels: NRRD, raw and little-endian, four single precision numbers a voxel (density and direction).
fn read_tile(path: &Path) -> Result<VoxelTile> {
    let bytes = std::fs::read(path).context(|| format!("voxels {}", path.display()))?;
    parse_tile(&bytes).context(|| format!("voxels {} cannot be used", path.display()))
}

fn parse_tile(bytes: &[u8]) -> Result<VoxelTile> {
    let end = bytes.windows(2).position(|w| w == b"\n\n");
    let end = end.ok_or_else(|| Error::new("it is no NRRD file with its header attached"))?;
    let header = String::from_utf8_lossy(&bytes[..end]);
    let field = |name: &str| {
        let line = header
            .lines()
            .find_map(|l| l.strip_prefix(name)?.strip_prefix(": "));
        line.ok_or_else(|| Error::new(format!("its header has no field '{name}'")))
    };
    for (name, expected) in [("type", "float"), ("encoding", "raw"), ("endian", "little")] {
        let found = field(name)?;
        if found != expected {
            return Err(Error::new(format!(
                "{name} is {found}, expected {expected}"
            )));
        }
    }
    let sizes: Vec<usize> = numbers(field("sizes")?);
    let [4, nx, ny, nz] = sizes[..] else {
        return Err(Error::new(
            "sizes: expected 4 numbers a voxel, and three counts",
        ));
    };
    let directions: Vec<f64> = numbers(field("space directions")?);
    let origin: Vec<f64> = numbers(field("space origin")?);
    let ([side, ..], [.., middle]) = (&directions[..], &origin[..]) else {
        return Err(Error::new("space directions and origin: expected numbers"));
    };
    let mut tile = VoxelTile::empty([nx, ny, nz], *side, middle - 0.5 * side)?;
    let voxels = bytes[end + 2..].as_chunks::<16>().0;
    if voxels.len() != tile.density().len() || !(bytes.len() - end - 2).is_multiple_of(16) {
        return Err(Error::new(format!(
            "{} bytes of voxels, expected {}",
            bytes.len() - end - 2,
            16 * tile.density().len()
        )));
    }
    for (place, voxel) in voxels.iter().enumerate() {
        let [density, x, y, z] = std::array::from_fn(|k| {
            f32::from_le_bytes(std::array::from_fn(|byte| voxel[4 * k + byte]))
        });
        let direction = DVec3::from_array([x, y, z].map(f64::from));
        tile.set(place, density, direction)?;
    }
    Ok(tile)
}

/// The numbers in a field, whatever stands around them.
fn numbers<T: std::str::FromStr>(text: &str) -> Vec<T> {
    let parts = text.split(|c: char| c.is_whitespace() || "(),".contains(c));
    parts.filter_map(|part| part.parse().ok()).collect()
}
