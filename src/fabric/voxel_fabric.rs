//! Fabrics that are volumes: a description (`kind = "voxels"`) that points to a file of voxels, or such a file itself.

use super::VoxelTile;
use crate::base::{Context, Error, Result};
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

/// The file of voxels a description points to, or the path itself where that is one; none where it describes fibers or
/// cannot be read.
pub fn voxel_file(path: &Path) -> Option<PathBuf> {
    if VoxelTile::is_in(path) {
        return Some(path.to_owned());
    }
    let table: toml::Table = toml::from_str(&std::fs::read_to_string(path).ok()?).ok()?;
    if table.get("kind")?.as_str()? != "voxels" {
        return None;
    }
    let folder = path.parent().unwrap_or(Path::new("."));
    Some(folder.join(table.get("file")?.as_str()?))
}

/// Reads a fabric that is a volume: its description, or the file of voxels alone.
///
/// # Errors
/// The description or its file of voxels cannot be read, has an unknown or missing key, or a density that is not positive.
pub fn load_voxels(path: &Path) -> Result<VoxelFabric> {
    let what = || format!("fabric {} cannot be used", path.display());
    if VoxelTile::is_in(path) {
        let name = path.file_stem().unwrap_or_default();
        return Ok(VoxelFabric {
            name: name.to_string_lossy().into_owned(),
            description: String::new(),
            sources: Vec::new(),
            tile: VoxelTile::read(path)?,
            density_per_mm: None,
        });
    }
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
        tile: VoxelTile::read(&folder.join(&file.file))?,
        density_per_mm: file.density_per_mm,
    })
}
