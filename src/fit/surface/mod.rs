//! Fits of reflectance models: colors by linear least squares within bounds, inside a bounded search from many starts over
//! the other parameters.
//!
//! Deterministic up to its seed: no renders, no noise of its own. Knows models by their contract only. The weights are those of the
//! fits of fibers (Khungurn 2015 eq. 20). Errors of the measurement are not used: what a model misses is larger by far, and intervals
//! take the spread of the residuals for the error.

mod looks;
mod problem;
mod search;

pub(super) use problem::{distinct, geometry};
pub use search::{SurfaceInterval, SurfaceOptions, SurfaceResult, SurfaceRival, fit_surface};

use crate::base::Result;
use crate::scatter::surface::SurfaceModel;
use crate::session::Measurements;

/// Fits of several models to the same measurements, each also begun from those before it, and the one that says most per parameter: the smallest corrected
/// information criterion (AICc) over numbers at distinct geometries.
///
/// # Errors
/// As [`fit_surface`], for the first model.
pub fn surface_ladder(
    models: &[Box<dyn SurfaceModel>],
    measurements: &Measurements,
    options: &SurfaceOptions,
) -> Result<(Vec<SurfaceResult>, usize)> {
    let mut results: Vec<SurfaceResult> = Vec::new();
    for model in models {
        let options = SurfaceOptions {
            begin: results.iter().map(|r| r.parameters.clone()).collect(),
            ..options.clone()
        };
        match fit_surface(model.as_ref(), measurements, &options) {
            Ok(result) => results.push(result),
            Err(e) if results.is_empty() => return Err(e),
            // A richer model than the measurements can carry.
            Err(_) => break,
        }
    }
    let best = (0..results.len())
        .min_by(|&a, &b| results[a].aicc.total_cmp(&results[b].aicc))
        .unwrap_or(0);
    Ok((results, best))
}
