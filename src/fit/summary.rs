//! From where the search ended to a [`FitResult`]: everything that is said of a fit, put together.

use super::certainty::{correlation, parameter_results, profile};
use super::check::FreshCheck;
use super::gain;
use super::goodness::Residuals;
use super::objective::{Objective, RenderPair, relative_weight};
use super::patterns::patterns;
use super::result::{ConfigurationResult, Cost, FitResult, Verdict};
use super::search::{Found, Problem, Spent};
use super::uncertainty::{Density, Samples};
use super::verdict::{doubts, held, quality, verdict};
use crate::base::Result;
use crate::scatter::{CHANNELS, Parameters};

/// Puts everything together.
pub(super) fn summarize(
    problem: &Problem<'_>,
    start: &Parameters,
    found: &Found,
    check: &FreshCheck,
    spent: Spent,
) -> Result<FitResult> {
    let Problem {
        scene,
        objective,
        space,
        options,
        ..
    } = problem;
    let parameters = space.to_parameters(&found.u);
    let quality = quality(problem, found, check);

    let mut noise = found.model.monte_carlo.clone();
    noise.add_scaled(1.0, &found.model.measurement);
    let jacobian = &found.model.jacobian;
    let bounded = objective.bounded();
    let gram = jacobian.weighted_gram(bounded.weights().as_flattened(), jacobian);
    noise.add_scaled((0.01 * quality.misfit_percent).powi(2), &gram);
    let density = Density::new(space, &found.u, &found.model, &noise);
    let mut samples = Samples::around(space, &density.center, &density.precision, options.seed);
    let residuals = Residuals::of(space, objective, found, &check.pair);
    let methods = profile(problem, found, check, &density, &residuals, &mut samples)?;
    let uncertainty = parameter_results(problem, start, found, &samples, &methods);
    let goodness = residuals.goodness();
    let (converged, mut reason) = verdict(problem, found, check, &quality);
    if converged {
        reason += &doubts(problem, start, goodness.as_ref());
    }
    reason += &held(problem, start, &found.u);
    Ok(FitResult {
        format: FitResult::FORMAT.to_owned(),
        parameters: parameters.to_json(),
        model: scene.model().name().to_owned(),
        fabric: String::new(),
        measurements: String::new(),
        synthetic: None,
        converged,
        reason,
        objective: quality,
        goodness,
        patterns: patterns(&residuals, objective),
        not_determined: uncertainty
            .iter()
            .filter(|p| p.verdict == Verdict::NotDetermined)
            .map(|p| p.name.clone())
            .collect(),
        gain: gain::result(space, &found.u, &samples),
        loss: options.loss.name(),
        tau: options.tau,
        bounds: options.bounds.clone(),
        plate: None,
        correlation: correlation(&parameters, &samples),
        uncertainty,
        configs: configurations(objective, &check.pair),
        initial_parameters: start.to_json(),
        method: options.method.name().to_owned(),
        seed: options.seed,
        tolerance_percent: 100.0 * options.tolerance,
        versions: [("goniofit".to_owned(), env!("CARGO_PKG_VERSION").to_owned())].into(),
        time: Cost {
            wall_s: spent.wall_s,
            cpu_s: spent.cpu_s,
            paths: spent.paths,
        },
        history: found.history.clone(),
        command: String::new(),
        truth: None,
    })
}

/// Every configuration, measured and rendered by the fresh pair.
fn configurations(objective: &Objective, pair: &RenderPair) -> Vec<ConfigurationResult> {
    objective
        .intensities()
        .iter()
        .zip(objective.factors())
        .zip(pair.estimates())
        .map(|((intensity, &robust_weight), [a, b])| {
            let weight = relative_weight(intensity, objective.tau());
            let rendered: [f64; CHANNELS] = std::array::from_fn(|c| 0.5 * (a.mean[c] + b.mean[c]));
            let residual =
                intensity.where_present(std::array::from_fn(|c| rendered[c] - intensity.mean[c]));
            ConfigurationResult {
                configuration: intensity.configuration,
                measured: intensity.where_present(intensity.mean),
                measured_se: intensity.where_present(intensity.standard_error),
                rendered,
                rendered_se: std::array::from_fn(|c| {
                    0.5 * a.standard_error[c].hypot(b.standard_error[c])
                }),
                residual,
                relative_residual: residual.map(|r| r.map(|r| r * weight.sqrt())),
                weight,
                robust_weight,
                renders: [a.mean, b.mean],
                paths: a.paths + b.paths,
            }
        })
        .collect()
}
