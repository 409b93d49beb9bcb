//! Rungs that are formulas.

use super::facts::{Spread, relative_errors};
use super::{Evidence, Facts, Rung};
use crate::base::{Result, Watch};
use crate::fit::surface::{SurfaceOptions, SurfaceResult, fit_surface};
use crate::scatter::surface::{Surface, SurfaceModel, directional_albedo};
use crate::scatter::{CHANNELS, Parameters};
use crate::session::{Configuration, Measurements};
use glam::DVec3;
use rayon::prelude::*;
use std::f64::consts::PI;

/// Points of the rule that finds out whether a prediction reflects more light than there is; it stands in for none, so it may be coarse.
const ALBEDO_POINTS: usize = 10;

/// A reflectance model as a rung.
pub struct SurfaceRung {
    /// The model.
    pub model: Box<dyn SurfaceModel>,
    /// How it is fitted.
    pub options: SurfaceOptions,
}

impl Rung for SurfaceRung {
    fn name(&self) -> String {
        self.model.name().to_owned()
    }

    fn free(&self) -> usize {
        Parameters::defaults(&*self.model).values().len() - self.options.held.len()
    }

    fn traced(&self) -> bool {
        false
    }

    fn climb(&self, facts: &Facts<'_>, earlier: &[Evidence], _: &dyn Watch) -> Result<Evidence> {
        let options = SurfaceOptions {
            begin: earlier.iter().filter_map(|e| e.begin.clone()).collect(),
            ..self.options.clone()
        };
        let result = fit_surface(&*self.model, facts.measurements, &options)?;
        let surface = self.model.prepare(&result.parameters)?;
        let errors = of_poses(facts.measurements, &|c| means(surface.as_ref(), c));
        let unseen = self.leave_outs(facts, &result);
        Ok(evidence(facts, &result, surface.as_ref(), &errors, unseen))
    }
}

impl SurfaceRung {
    /// Errors of every row when its geometry is left out of the fit; none when a fit is not possible then.
    fn leave_outs(
        &self,
        facts: &Facts<'_>,
        full: &SurfaceResult,
    ) -> Option<Vec<Vec<[f64; CHANNELS]>>> {
        let options = SurfaceOptions {
            begin: vec![full.parameters.clone()],
            looks: 0,
            starts: 1,
            ..self.options.clone()
        };
        let left_out = |rows: &Vec<usize>| {
            let all = &facts.measurements.intensities;
            let part = |inside: bool| Measurements {
                intensities: (0..all.len())
                    .filter(|r| rows.contains(r) == inside)
                    .map(|r| all[r])
                    .collect(),
            };
            let result = fit_surface(&*self.model, &part(false), &options).ok()?;
            let surface = self.model.prepare(&result.parameters).ok()?;
            Some(of_poses(&part(true), &|c| {
                possible_means(surface.as_ref(), c)
            }))
        };
        facts.geometries.par_iter().map(left_out).collect()
    }
}

/// Normalized radiance of a pose.
fn means(surface: &dyn Surface, c: &Configuration) -> [f64; CHANNELS] {
    let wi = c.light_in_sample().vector();
    surface
        .value(wi, c.camera_in_sample().vector())
        .map(|f| PI * wi.z * f)
}

/// The same, made darker where the surface would reflect more light than falls on it: measurements without a highlight do not hold it in check.
fn possible_means(surface: &dyn Surface, c: &Configuration) -> [f64; CHANNELS] {
    let albedo = directional_albedo(surface, c.light_in_sample().vector(), ALBEDO_POINTS);
    let means = means(surface, c);
    std::array::from_fn(|k| means[k] / albedo[k].max(1.0))
}

/// Relative errors of every pose.
fn of_poses(
    measurements: &Measurements,
    means: &dyn Fn(&Configuration) -> [f64; CHANNELS],
) -> Vec<[f64; CHANNELS]> {
    let rows = measurements.intensities.iter();
    rows.map(|i| {
        let model = means(&i.configuration);
        relative_errors(i, std::array::from_fn(|c| model[c] - i.cleared().mean[c]))
    })
    .collect()
}

fn evidence(
    facts: &Facts<'_>,
    result: &SurfaceResult,
    surface: &dyn Surface,
    errors: &[[f64; CHANNELS]],
    unseen: Option<Vec<Vec<[f64; CHANNELS]>>>,
) -> Evidence {
    let rows = &facts.measurements.intensities;
    let present = |r: usize, e: &[f64; CHANNELS]| {
        rows[r]
            .where_present(*e)
            .into_iter()
            .flatten()
            .collect::<Vec<f64>>()
    };
    let numbers: Vec<Vec<f64>> = errors
        .iter()
        .enumerate()
        .map(|(r, e)| present(r, e))
        .collect();
    let left_out: Vec<Vec<f64>> = match &unseen {
        Some(all) => (facts.geometries.iter().zip(all))
            .map(|(list, errors)| {
                list.iter()
                    .zip(errors)
                    .flat_map(|(r, e)| present(*r, e))
                    .collect()
            })
            .collect(),
        None => Vec::new(),
    };
    let square =
        |list: &Vec<f64>| list.iter().map(|e| e * e).sum::<f64>() / list.len().max(1) as f64;
    let worst = (0..rows.len())
        .map(|r| (rows[r].configuration.id, square(&numbers[r]).sqrt()))
        .fold((0, -1.0), |a, b| if b.1 > a.1 { b } else { a });
    let named = |is: &dyn Fn(&crate::fit::surface::SurfaceInterval) -> bool| -> Vec<String> {
        result
            .intervals
            .iter()
            .filter(|i| is(i))
            .map(|i| i.name.clone())
            .collect()
    };
    Evidence {
        model: result.model.to_owned(),
        free: result.counts[2],
        traced: false,
        residual: result.residual,
        residual_se: 0.0,
        errors: Spread::of(numbers.iter().flatten().copied()).unwrap_or(Spread {
            median: 0.0,
            percentile_80: 0.0,
            rms: 0.0,
        }),
        unseen: Spread::of(left_out.iter().flatten().copied()),
        unseen_squares: left_out.iter().map(square).collect(),
        worst_pose: worst,
        at_bounds: named(&|i| i.at_bound),
        undetermined: named(&|i| !i.identified && !i.at_bound),
        starts: Some([result.starts[1], result.starts[0]]),
        parameters: result.parameters.to_json(),
        begin: Some(result.parameters.clone()),
        albedo: Some(directional_albedo(surface, DVec3::Z, 24)),
        criterion: result.aicc,
        seconds: 0.0,
    }
}
