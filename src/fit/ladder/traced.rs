//! Rungs whose means are rendered: what a fit of fibers or voxels shows, in the terms of the ladder.

use super::facts::Spread;
use super::{Evidence, Facts};
use crate::base::{Error, Result};
use crate::fit::objective::relative_weights;
use crate::fit::{Comparison, FitResult, TAU, Verdict};

/// The evidence of a fit of all measurements, and of predictions of every geometry by the others.
///
/// # Errors
/// The fit is of other measurements.
pub fn evidence(
    facts: &Facts<'_>,
    fit: &FitResult,
    unseen: Option<&Comparison>,
) -> Result<Evidence> {
    let rows = &facts.measurements.intensities;
    if fit.configs.len() != rows.len() {
        return Err(Error::new(format!(
            "the fit of {} has {} configurations, expected {}",
            fit.model,
            fit.configs.len(),
            rows.len()
        )));
    }
    let errors = |k: usize| fit.configs[k].relative_residual.into_iter().flatten();
    let rms =
        |list: &[f64]| (list.iter().map(|e| e * e).sum::<f64>() / list.len().max(1) as f64).sqrt();
    let worst = (0..rows.len())
        .map(|k| {
            (
                fit.configs[k].configuration.id,
                rms(&errors(k).collect::<Vec<_>>()),
            )
        })
        .fold((0, -1.0), |a, b| if b.1 > a.1 { b } else { a });
    let spread = |list: Vec<f64>| Spread::of(list.into_iter());
    let left_out = unseen.map(|c| by_geometry(facts, c)).unwrap_or_default();
    let at_bound = |v: &Verdict| matches!(v, Verdict::AtLowerBound | Verdict::AtUpperBound);
    let bounded = fit.uncertainty.iter().filter(|p| at_bound(&p.verdict));
    Ok(Evidence {
        model: fit.model.clone(),
        free: fit.uncertainty.len(),
        traced: true,
        residual: 0.01 * fit.objective.weighted_rms_percent,
        residual_se: 0.01 * fit.objective.weighted_rms_se_percent,
        errors: spread((0..rows.len()).flat_map(errors).collect())
            .ok_or_else(|| Error::new("the fit has no residuals"))?,
        unseen: spread(left_out.iter().flatten().copied().collect()),
        unseen_squares: left_out.iter().map(|g| rms(g).powi(2)).collect(),
        worst_pose: worst,
        at_bounds: bounded.map(|p| p.name.clone()).collect(),
        undetermined: fit.not_determined.clone(),
        starts: None,
        parameters: fit.parameters.clone(),
        begin: None,
        albedo: None,
        criterion: 0.0,
        seconds: 0.0,
    })
}

/// Relative errors of predictions, by geometry.
fn by_geometry(facts: &Facts<'_>, comparison: &Comparison) -> Vec<Vec<f64>> {
    let of_row = |row: &usize| -> Vec<f64> {
        let measured = &facts.measurements.intensities[*row];
        let id = measured.configuration.id;
        let compared = comparison
            .rows
            .iter()
            .find(|r| r.measured.configuration.id == id);
        let weights = relative_weights(&measured.cleared(), TAU);
        let residuals = compared.map(|r| r.residual).unwrap_or_default();
        (residuals.into_iter().zip(weights))
            .filter_map(|(r, w)| Some(r? * w.sqrt()))
            .collect()
    };
    facts
        .geometries
        .iter()
        .map(|g| g.iter().flat_map(of_row).collect())
        .collect()
}
