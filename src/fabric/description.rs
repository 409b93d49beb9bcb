//! Fabric description files (`fabrics/*.toml`): reading and checking. `docs/fabric.md` lists the keys.

use super::woven::{Segmentation, System, Woven};
use super::{Draft, Fabric, FabricReport, Format, VoxelTile, import};
use crate::base::{Context, Error, Result};
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// The file of a woven swatch.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WovenFile {
    name: String,
    #[serde(default)]
    description: String,
    #[serde(default)]
    sources: Vec<String>,
    #[serde(default)]
    seed: u64,
    weave: WeaveFile,
    warp: SystemFile,
    weft: SystemFile,
    #[serde(default)]
    segments: SegmentsFile,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WeaveFile {
    pattern: Option<String>,
    draft: Option<Vec<String>>,
    wif: Option<PathBuf>,
    #[serde(default = "once")]
    repeats: [usize; 2],
    #[serde(default = "quarter")]
    join_cells: f64,
}

fn once() -> [usize; 2] {
    [1, 1]
}

fn quarter() -> f64 {
    0.25
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SystemFile {
    pitch_mm: f64,
    fibers: u32,
    fiber_radius_um: f64,
    yarn_radius_mm: Option<f64>,
    yarn_width_mm: Option<f64>,
    yarn_thickness_mm: Option<f64>,
    crown_mm: f64,
    #[serde(default = "sixty")]
    crown_angle_deg: f64,
    twist_per_mm: Option<f64>,
    twist_per_tile: Option<f64>,
    #[serde(default)]
    migration_depth: f64,
    migration_per_mm: Option<f64>,
    migration_per_tile: Option<f64>,
    migration_per_turn: Option<f64>,
    #[serde(default = "tenth")]
    jitter: f64,
    density_g_cm3: Option<f64>,
}

fn sixty() -> f64 {
    60.0
}

fn tenth() -> f64 {
    0.1
}

#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields)]
struct SegmentsFile {
    length_mm: Option<f64>,
    chord_error_um: Option<f64>,
    tolerance_um: Option<f64>,
}

/// The file that points to a file of fibers.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ImportedFile {
    name: String,
    #[serde(default)]
    description: String,
    #[serde(default)]
    sources: Vec<String>,
    fibers: String,
    format: Option<String>,
    tile_mm: Option<[f64; 2]>,
    density_g_cm3: Option<f64>,
}

/// Reads a fabric: a woven description or a pointer to fibers (`.toml`), or a CSV of segments.
///
/// # Errors
/// The file cannot be read, has an unknown or missing key, a value without meaning, or describes no fiber or too many.
pub fn load(path: &Path) -> Result<Fabric> {
    let what = || format!("fabric {} cannot be used", path.display());
    if path.extension().is_some_and(|e| e == "csv") {
        let tile = import(path, Format::Csv, None)?;
        let report = FabricReport::of_tile(&tile, &[None]);
        let name = path
            .file_stem()
            .map_or_else(String::new, |s| s.to_string_lossy().into_owned());
        return Ok(Fabric {
            name,
            description: String::new(),
            sources: Vec::new(),
            tile,
            report,
        });
    }
    if VoxelTile::is_in(path) {
        return Err(of_voxels()).context(what);
    }
    let text = std::fs::read_to_string(path)
        .context(|| format!("fabric {} cannot be read", path.display()))?;
    let folder = path.parent().unwrap_or(Path::new("."));
    read(&text, folder).context(what)
}

fn of_voxels() -> Error {
    Error::new("it describes voxels, expected fibers").with_hint(
        "render, fit, predict and validate take voxels with a model of volumes: --model khungurn-volume",
    )
}

/// The file of fibers that a description points to; none where it describes a weave or cannot be read.
pub fn fiber_file(path: &Path) -> Option<PathBuf> {
    let table: toml::Table = toml::from_str(&std::fs::read_to_string(path).ok()?).ok()?;
    let folder = path.parent().unwrap_or(Path::new("."));
    Some(folder.join(table.get("fibers")?.as_str()?))
}

/// The weave of a woven description with the distances of its warp and of its weft yarns, millimeters; none where a file describes
/// no weave or cannot be read.
pub fn weave_of(path: &Path) -> Option<(Draft, [f64; 2])> {
    let file: WovenFile = parse(&std::fs::read_to_string(path).ok()?).ok()?;
    let folder = path.parent().unwrap_or(Path::new("."));
    let pitches = [file.warp.pitch_mm, file.weft.pitch_mm];
    Some((file.weave.draft(folder).ok()?, pitches))
}

/// Makes the fabric a description says; a fiber file it names is looked for in `folder`.
fn read(text: &str, folder: &Path) -> Result<Fabric> {
    let table: toml::Table = parse(text)?;
    if table.get("kind").and_then(|k| k.as_str()) == Some("voxels") {
        return Err(of_voxels());
    }
    if table.contains_key("fibers") {
        return imported(parse(text)?, folder);
    }
    let file: WovenFile = parse(text)?;
    let woven = file.check(folder)?;
    let swatch = woven.swatch()?;
    let tile = swatch.tile();
    let densities = [woven.warp.density, woven.weft.density];
    let mut report = FabricReport::of_tile(&tile, &densities);
    report.add_swatch(&swatch);
    Ok(Fabric {
        name: file.name,
        description: file.description,
        sources: file.sources,
        tile,
        report,
    })
}

pub(super) fn parse<T: serde::de::DeserializeOwned>(text: &str) -> Result<T> {
    toml::from_str(text).map_err(|e: toml::de::Error| {
        let line = e
            .span()
            .map(|span| text[..span.start.min(text.len())].matches('\n').count() + 1);
        let message = e.message().trim().replace('\n', " ");
        let place = line.map_or_else(String::new, |line| format!("line {line}: "));
        Error::new(format!("{place}{message}")).with_hint("docs/fabric.md lists the keys")
    })
}

fn imported(file: ImportedFile, folder: &Path) -> Result<Fabric> {
    if let Some(density) = file.density_g_cm3 {
        within("density_g_cm3", density, 0.01, 30.0)?;
    }
    let path = folder.join(&file.fibers);
    let format = Format::choose(file.format.as_deref(), &path)?;
    let tile = import(&path, format, file.tile_mm)?;
    let report = FabricReport::of_tile(&tile, &[file.density_g_cm3]);
    Ok(Fabric {
        name: file.name,
        description: file.description,
        sources: file.sources,
        tile,
        report,
    })
}

/// The draft of a WIF file.
fn read_wif(path: &Path) -> Result<Draft> {
    let bytes = std::fs::read(path).context(|| format!("{} cannot be read", path.display()))?;
    // Names in other sections may be in any encoding.
    Draft::from_wif(&String::from_utf8_lossy(&bytes)).context(|| format!("{}", path.display()))
}

impl WeaveFile {
    fn draft(&self, folder: &Path) -> Result<Draft> {
        match (&self.pattern, &self.draft, &self.wif) {
            (Some(name), None, None) => Draft::named(name),
            (None, Some(rows), None) => Draft::from_rows(rows),
            (None, None, Some(path)) => read_wif(&folder.join(path)),
            _ => Err(
                Error::new("expected one of 'pattern', 'draft' and 'wif'").with_hint(
                    "pattern = \"2/2 twill\", or draft = [\"10\", \"01\"] (1 = warp on top)",
                ),
            ),
        }
        .context(|| "[weave]")
    }
}

impl WovenFile {
    fn check(&self, folder: &Path) -> Result<Woven> {
        let weave = &self.weave;
        let draft = weave.draft(folder)?;
        if weave.repeats.contains(&0) {
            return Err(
                Error::new("[weave] repeats: expected two counts of at least 1")
                    .with_hint("repeats = [along x, along y]"),
            );
        }
        within("[weave] join_cells", weave.join_cells, 0.05, 0.5)?;
        let size = [
            (draft.columns() as f64) * weave.repeats[0] as f64 * self.warp.pitch_mm,
            (draft.rows() as f64) * weave.repeats[1] as f64 * self.weft.pitch_mm,
        ];
        let woven = Woven {
            repeats: weave.repeats,
            join: weave.join_cells,
            warp: self.warp.check(size[1]).context(|| "[warp]")?,
            weft: self.weft.check(size[0]).context(|| "[weft]")?,
            segmentation: self.segments.check()?,
            seed: self.seed,
            draft,
        };
        super::check_tile(size)?;
        Ok(woven)
    }
}

impl SystemFile {
    /// The system in millimeters and radians, on a tile `length` millimeters long along its yarns.
    fn check(&self, length: f64) -> Result<System> {
        within("pitch_mm", self.pitch_mm, 1e-3, 100.0)?;
        within("fiber_radius_um", self.fiber_radius_um, 0.01, 5000.0)?;
        within("crown_mm", self.crown_mm, 0.0, 100.0)?;
        within("crown_angle_deg", self.crown_angle_deg, 0.0, 90.0)?;
        within("migration_depth", self.migration_depth, 0.0, 1.0)?;
        within("jitter", self.jitter, 0.0, 1.0)?;
        if let Some(density) = self.density_g_cm3 {
            within("density_g_cm3", density, 0.01, 30.0)?;
        }
        if self.fibers == 0 {
            return Err(Error::new("fibers = 0: the fabric would be empty")
                .with_hint("expected at least one fiber per yarn in warp and weft"));
        }
        let (width, thickness) = self.section()?;
        let twist = self.twist(length)?;
        Ok(System {
            pitch: self.pitch_mm,
            fibers: self.fibers,
            fiber_radius: self.fiber_radius_um * 1e-3,
            width,
            thickness,
            crown: self.crown_mm,
            crown_angle: self.crown_angle_deg.to_radians(),
            twist,
            migration_depth: self.migration_depth,
            migration: self.migration(twist, length)?,
            jitter: self.jitter,
            density: self.density_g_cm3,
        })
    }

    fn section(&self) -> Result<(f64, f64)> {
        let (width, thickness) = match (
            self.yarn_radius_mm,
            self.yarn_width_mm,
            self.yarn_thickness_mm,
        ) {
            (Some(r), None, None) => (2.0 * r, 2.0 * r),
            (None, Some(w), Some(t)) => (w, t),
            _ => {
                return Err(Error::new("the yarn's section is not described").with_hint(
                    "give yarn_radius_mm, or both yarn_width_mm and yarn_thickness_mm",
                ));
            }
        };
        within("yarn width in mm", width, 1e-4, 100.0)?;
        within("yarn thickness in mm", thickness, 1e-4, 100.0)?;
        Ok((width, thickness))
    }

    /// Turns per millimeter.
    fn twist(&self, length: f64) -> Result<f64> {
        let twist = match (self.twist_per_mm, self.twist_per_tile) {
            (None, None) => 0.0,
            (Some(rate), None) => rate,
            (None, Some(turns)) => turns / length,
            _ => {
                return Err(Error::new(
                    "expected at most one of 'twist_per_mm' and 'twist_per_tile'",
                ));
            }
        };
        within("twist in turns per mm", twist, -1e3, 1e3)?;
        Ok(twist)
    }

    /// Periods per millimeter.
    fn migration(&self, twist: f64, length: f64) -> Result<f64> {
        let given = [
            self.migration_per_mm,
            self.migration_per_tile.map(|n| n / length),
            self.migration_per_turn.map(|s| s * twist),
        ];
        let mut given = given.into_iter().flatten();
        let rate = given.next().unwrap_or(0.0);
        if given.next().is_some() {
            return Err(Error::new(
                "expected at most one of 'migration_per_mm', 'migration_per_tile' and 'migration_per_turn'",
            ));
        }
        within("migration in periods per mm", rate, -1e3, 1e3)?;
        Ok(rate)
    }
}

impl SegmentsFile {
    fn check(&self) -> Result<Segmentation> {
        match (self.length_mm, self.chord_error_um, self.tolerance_um) {
            (None, None, None) => Ok(Segmentation::ChordError(2e-4)),
            (Some(length), None, None) => {
                within("[segments] length_mm", length, 1e-5, 100.0)?;
                Ok(Segmentation::Length(length))
            }
            (None, Some(error), None) => {
                within("[segments] chord_error_um", error, 1e-4, 1e3)?;
                Ok(Segmentation::ChordError(error * 1e-3))
            }
            (None, None, Some(error)) => {
                within("[segments] tolerance_um", error, 1e-4, 1e3)?;
                Ok(Segmentation::Tolerance(error * 1e-3))
            }
            _ => Err(Error::new(
                "[segments] expected at most one of 'length_mm', 'chord_error_um' and 'tolerance_um'",
            )),
        }
    }
}

fn within(key: &str, value: f64, low: f64, high: f64) -> Result<()> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(Error::new(format!(
        "{key} = {value}: expected a number from {low} to {high}"
    )))
}
