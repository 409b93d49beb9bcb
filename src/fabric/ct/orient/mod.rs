//! From gray voxels to density and direction (Zhao 2011 section 5; docs/ct.md compares the methods against truths).
//!
//! Voxels below a threshold on density are air. For the others a direction is found, and voxels whose direction is not to
//! be believed are dropped. Does not tell two fibers in one voxel apart.

mod directions;
mod eigen;
mod search;
mod settings;
mod tensor;
#[cfg(test)]
mod tests;

pub use directions::Filter;

use super::gray::Gray;
use crate::base::{Result, Watch};
use crate::fabric::{PackedDirection, VoxelTile};
use serde::Serialize;
use settings::Settings;

/// How directions are found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Structure tensor.
    Tensor,
    /// The oriented filter of Zhao 2011.
    Filter,
    /// The same filter integrated along lines: fast, nearly the same weights.
    Line,
}

/// How to orient a volume. Nothing given: the defaults in parentheses.
#[derive(Debug, Clone, PartialEq)]
pub struct Orienting {
    /// How directions are found.
    pub method: Method,
    /// Filter and line: try all 3072 directions, not from coarse to fine.
    pub exact: bool,
    /// Expected fiber radius, millimeters: sets the widths of the tensor (unknown: 1 and 2.5 voxels).
    pub fiber_radius: Option<f64>,
    /// Standard deviation of the tensor's derivatives, voxels (0.6 radii).
    pub gradient: Option<f64>,
    /// Standard deviation of the tensor's window, voxels (1.55 radii).
    pub window: Option<f64>,
    /// The filter, in voxels (s, t, h = 1, 2, 16 of 5 um, as published for gabardine, scaled to the voxel).
    pub filter: Option<Filter>,
    /// Least density (Otsu's threshold of the volume).
    pub eps_d: Option<f64>,
    /// Least value of the filter along the direction, on its own scale: at most 0 (none).
    pub eps_j: Option<f64>,
    /// Least confidence, 0 to 1 (0).
    pub least_confidence: f64,
    /// Share of voxels to drop, those of least confidence (0).
    pub drop_share: f64,
}

impl Orienting {
    /// This method with all defaults.
    pub fn new(method: Method) -> Self {
        Self {
            method,
            exact: false,
            fiber_radius: None,
            gradient: None,
            window: None,
            filter: None,
            eps_d: None,
            eps_j: None,
            least_confidence: 0.0,
            drop_share: 0.0,
        }
    }
}

/// A threshold on density and what it would keep.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DensityChoice {
    /// Place between the mean of air (0) and of fiber (1).
    pub level: f64,
    /// The threshold.
    pub eps_d: f64,
    /// Share of all voxels from it on.
    pub share: f64,
}

/// What was done and found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct OrientReport {
    /// How directions were found.
    pub method: Method,
    /// Whether all directions were tried.
    pub exact: bool,
    /// Standard deviations of the tensor's derivatives and window, voxels.
    pub gradient: f64,
    /// See `gradient`.
    pub window: f64,
    /// The filter, voxels.
    pub filter: Filter,
    /// Least density used.
    pub eps_d: f64,
    /// Least filter value used.
    pub eps_j: Option<f64>,
    /// Least confidence used; that of `drop_share` where it is more.
    pub least_confidence: f64,
    /// Voxels in all.
    pub voxels: usize,
    /// Those from `eps_d` on.
    pub solid: usize,
    /// Those kept in the end.
    pub kept: usize,
    /// Dropped for their confidence (those without any direction among them).
    pub dropped_by_confidence: usize,
    /// Dropped by `eps_j`.
    pub dropped_by_fit: usize,
    /// What other thresholds on density would keep.
    pub density_choices: Vec<DensityChoice>,
    /// Share of solid voxels and the confidence they do not exceed.
    pub confidence_quantiles: Vec<(f64, f64)>,
    /// Share of solid voxels and the filter value they do not exceed; empty when it was not needed.
    pub fit_quantiles: Vec<(f64, f64)>,
    /// Shares of kept voxels along x, y and z most of all.
    pub axis_shares: [f64; 3],
}

/// A voxel's direction.
#[derive(Debug, Clone, Copy)]
struct Found {
    place: usize,
    direction: PackedDirection,
    /// 0 to 1, hardly depending on how densely fibers are packed.
    confidence: f32,
    /// Value of the filter; minus infinity where it was not asked for.
    fit: f32,
}

/// Finds density and direction of every voxel. The density of a voxel that is kept is its gray value, of others 0.
///
/// Takes about 16 bytes a voxel. Results do not depend on the number of threads.
///
/// # Errors
/// A number has no meaning, the volume is empty, a threshold leaves nothing (the hint has one that leaves something), or
/// the watch cancelled.
pub fn orient(
    gray: Gray,
    options: &Orienting,
    watch: &dyn Watch,
) -> Result<(VoxelTile, OrientReport)> {
    gray.check()?;
    let settings = Settings::new(&gray, options)?;
    let scores = settings.scores(&gray, None, watch)?;
    settings.thresholded(gray, scores, options)
}
