//! What a laboratory would have of the cloth: a scan, the directions found in it, and the fibers found again.

use super::stage::{Made, Order, RECORD, Stage, hash};
use super::truth::fabric_hash;
use crate::base::{Context, Result};
use crate::fabric::ct::{
    Gray, Method, Orienting, Reading, Simulating, Tracing, Volume, compare, orient, simulate,
    trace, transfer,
};
use crate::fabric::{self, FiberTile, Format, VoxelTile, export};
use crate::session::files;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Voxels held at a time while a scan is read, bytes.
const MEMORY: usize = 256 << 20;
/// Folder of the volume, and the description of a fabric of voxels.
const VOLUME: &str = "volume";
const CLOTH: &str = "cloth.toml";
/// Air above and below the cloth, millimeters.
const MARGIN: f64 = 0.05;

/// The virtual scan to be made.
pub(super) struct Scan {
    pub(super) fabric: PathBuf,
    /// Millimeters.
    pub(super) voxel: f64,
    /// Standard deviation, millimeters.
    pub(super) blur: f64,
    pub(super) noise: f64,
    pub(super) seed: u64,
}

/// How a scan is made fabrics.
pub(super) struct Finding {
    pub(super) radius: Radius,
    /// Density of a voxel of value 1, 1/mm.
    pub(super) density: f64,
    /// Whether voxels near fibers take the fibers' directions (Khungurn 2015 section 6).
    pub(super) transfer: bool,
    /// The fabric that was scanned, where it is known.
    pub(super) truth: Option<PathBuf>,
}

/// The fibers' radius as the laboratory knows it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Radius {
    /// From a microscope: the true mean.
    True,
    /// From the scan.
    Found,
    /// Millimeters.
    Given(f64),
}

/// The fabrics that come of it.
pub(super) struct Scanned {
    /// Description of the voxels, and the key of what they were made with.
    pub(super) cloth: (PathBuf, String),
    /// The fibers found again.
    pub(super) fibers: (PathBuf, String),
    /// How, and how well.
    pub(super) report: Value,
}

impl Scan {
    fn made(&self, order: &Order<'_>) -> Result<Made> {
        let stage = Stage {
            folder: order.out.join("scan"),
            record: RECORD,
            title: "scan: filling voxels with the fibers".to_owned(),
            asked: json!({
                "fabric": fabric_hash(&self.fabric)?,
                "voxel_mm": self.voxel,
                "blur_mm": self.blur,
                "noise": self.noise,
                "margin_mm": MARGIN,
                "seed": self.seed,
            }),
        };
        stage.made(order, |folder| {
            let options = Simulating {
                voxel: self.voxel,
                margin: MARGIN,
                blur: self.blur,
                noise: self.noise,
                seed: self.seed,
            };
            let what = || format!("{} cannot be scanned", self.fabric.display());
            let made =
                simulate(&true_fibers(&self.fabric)?, &options, order.terminal).context(what)?;
            made.gray.write(&folder.join("volume.nrrd"))?;
            let fiber: f64 = made.truth.density().iter().map(|d| f64::from(*d)).sum();
            Ok(json!({
                "dims": made.gray.shape,
                "voxel_mm": made.gray.side,
                "blur_mm": self.blur,
                "noise": self.noise,
                "stretch_y": made.stretch,
                "fiber_share": fiber / made.gray.values.len() as f64,
            }))
        })
    }
}

impl Finding {
    /// The fabrics found in a virtual scan: makes what is not there yet.
    pub(super) fn in_scan(&self, scan: &Scan, order: &Order<'_>) -> Result<Scanned> {
        let made = scan.made(order)?;
        let radius = self.known_radius()?;
        let (oriented, volume) = self.volume(order, &made, radius)?;
        let report = json!({"scan": made.found, "volume": volume.found});
        self.completed(order, (&oriented, &volume), radius, report)
    }

    /// The same of voxels whose directions are known already.
    pub(super) fn in_volume(&self, oriented: &Path, order: &Order<'_>) -> Result<Scanned> {
        let oriented = std::path::absolute(oriented)
            .context(|| format!("{} cannot be found", oriented.display()))?;
        let stage = Stage {
            folder: order.out.join(VOLUME),
            record: RECORD,
            title: format!("volume: that of {}", oriented.display()),
            asked: json!({"volume": hash(&oriented)?, "density_per_mm": self.density}),
        };
        let made = stage.made(order, |folder| {
            describe(&oriented, folder, self.density)?;
            Ok(json!({"file": oriented.display().to_string()}))
        })?;
        let report = json!({"volume": made.found});
        self.completed(order, (&oriented, &made), self.known_radius()?, report)
    }

    /// Finds the fibers.
    fn completed(
        &self,
        order: &Order<'_>,
        (oriented, volume): (&Path, &Made),
        radius: Option<f64>,
        mut report: Value,
    ) -> Result<Scanned> {
        let (fibers, traced) = self.fibers(order, oriented, volume, radius)?;
        let cloth = match self.transfer {
            true => (fibers.with_file_name(CLOTH), traced.key.clone()),
            false => (order.out.join(VOLUME).join(CLOTH), volume.key.clone()),
        };
        report["fibers"] = traced.found;
        Ok(Scanned {
            cloth,
            fibers: (fibers, traced.key),
            report,
        })
    }

    /// The radius with which fibers are looked for, if it is known.
    fn known_radius(&self) -> Result<Option<f64>> {
        Ok(match self.radius {
            Radius::Found => None,
            Radius::Given(radius) => Some(radius),
            Radius::True => self.truth.as_deref().map(mean_radius).transpose()?,
        })
    }

    /// Density and direction of every voxel.
    fn volume(
        &self,
        order: &Order<'_>,
        scan: &Made,
        radius: Option<f64>,
    ) -> Result<(PathBuf, Made)> {
        let folder = order.out.join(VOLUME);
        let oriented = folder.join("oriented.nrrd");
        let stage = Stage {
            folder,
            record: RECORD,
            title: "volume: finding directions".to_owned(),
            asked: json!({"scan": scan.key, "radius_mm": radius, "density_per_mm": self.density}),
        };
        let made = stage.made(order, |folder| {
            let path = order.out.join("scan").join("volume.nrrd");
            let what = || format!("volume {} cannot be oriented", path.display());
            let volume =
                Volume::open(&path, &Reading::new(folder), order.terminal).context(what)?;
            let mut gray = Gray::read(&volume, MEMORY, order.terminal).context(what)?;
            gray.periodic = true;
            let options = Orienting {
                fiber_radius: radius,
                ..Orienting::new(Method::Tensor)
            };
            let (tile, report) = orient(gray, &options, order.terminal).context(what)?;
            tile.write(&oriented)?;
            describe(&oriented, folder, self.density)?;
            serde_json::to_value(&report).context(|| "the report cannot be written as JSON")
        })?;
        Ok((oriented, made))
    }

    /// The fibers found in oriented voxels, and how well.
    fn fibers(
        &self,
        order: &Order<'_>,
        oriented: &Path,
        volume: &Made,
        radius: Option<f64>,
    ) -> Result<(PathBuf, Made)> {
        let folder = order.out.join("fibers");
        let out = folder.join("fibers.csv");
        let stage = Stage {
            folder,
            record: RECORD,
            title: "fibers: following them".to_owned(),
            asked: json!({"volume": volume.key, "radius_mm": radius, "transfer": self.transfer}),
        };
        let made = stage.made(order, |folder| {
            let tile = VoxelTile::read(oriented)?;
            let options = Tracing {
                radius,
                ..Tracing::default()
            };
            let (fibers, report) = trace(&tile, &options, order.terminal)
                .context(|| format!("fibers in {} cannot be traced", oriented.display()))?;
            files::write_atomic(&out, &export(&fibers, Format::Csv)?)?;
            let mut found = json!({ "found": report });
            if let Some(truth) = &self.truth {
                found["against_truth"] = json!(compare(&true_fibers(truth)?, &fibers));
            }
            if self.transfer {
                let reach = 2.0 * report.radius_mm[0].max(report.radius_mm[1]);
                let (moved, share) = transfer(&tile, &fibers, reach)?;
                let file = folder.join("transferred.nrrd");
                moved.write(&file)?;
                describe(&file, folder, self.density)?;
                found["transferred_share"] = json!(share);
            }
            Ok(found)
        })?;
        Ok((out, made))
    }
}

/// Writes the description of a fabric of voxels into a folder.
fn describe(oriented: &Path, folder: &Path, density: f64) -> Result<()> {
    let file = oriented.strip_prefix(folder).unwrap_or(oriented);
    let text = format!(
        "kind = \"voxels\"\nname = \"cloth found in a scan\"\nfile = {}\ndensity_per_mm = {density:?}\n",
        // A string of JSON is one of TOML.
        json!(file.display().to_string())
    );
    files::write_atomic(&folder.join(CLOTH), text.as_bytes())
}

fn true_fibers(fabric: &Path) -> Result<FiberTile> {
    Ok(fabric::load(fabric)?.tile)
}

/// Mean fiber radius of a fabric by length, millimeters.
fn mean_radius(fabric: &Path) -> Result<f64> {
    let tile = true_fibers(fabric)?;
    let segments = tile.segments.iter();
    let (whole, sum) = segments.fold((0.0, 0.0), |(whole, sum), s| {
        let length = s.start.distance(s.end);
        (whole + length, sum + length * s.radius)
    });
    Ok(sum / whole)
}
