//! How good a fit is, whether it converged, and what speaks against it, in words.

use super::check::FreshCheck;
use super::goodness::SURPRISE;
use super::objective::rms_of;
use super::result::{Goodness, ObjectiveResult};
use super::search::{Found, Problem, Stop};
use crate::scatter::Parameters;

/// A full Newton step from the fresh pair may change the means by this fraction beyond its noise.
const STILL: f64 = 0.002;
/// Fewer numbers than this for each parameter leave room for other minima as good.
const FEW: usize = 2;

/// Numbers of the final check, and the model error that the residual shows.
pub(super) fn quality(problem: &Problem<'_>, found: &Found, check: &FreshCheck) -> ObjectiveResult {
    let objective = problem.objective;
    let n = objective.n_numbers();
    let (rms, rms_se) = rms_of(check.value, n);
    let from_measurements = objective.measurement_sum();
    // Outliers that count less must not pass for a misfit of all.
    let bounded = objective.bounded();
    let judged = bounded.paired(&check.pair);
    // Expected when the model is right: measurement errors less what the fit absorbs of them, plus its own noise.
    let absorbed = n as f64 * found.measurement_rms.powi(2);
    let own = n as f64 * found.monte_carlo_rms.powi(2);
    let expected = (bounded.measurement_sum() - absorbed).max(0.0) + own;
    let freedom = n.saturating_sub(problem.space.len()).max(1) as f64;
    let spread = judged
        .standard_error
        .hypot(expected * (2.0 / freedom).sqrt());
    let excess = judged.value - expected;
    let misfit = if excess > 3.0 * spread {
        (excess / n as f64).sqrt()
    } else {
        0.0
    };
    ObjectiveResult {
        paired: check.value.value,
        se: check.value.standard_error,
        weighted_rms_percent: 100.0 * rms,
        weighted_rms_se_percent: 100.0 * rms_se,
        measurement_rms_percent: 100.0 * (from_measurements / n as f64).sqrt(),
        fit_monte_carlo_percent: 100.0 * found.monte_carlo_rms,
        fit_measurement_percent: 100.0 * found.measurement_rms,
        misfit_percent: 100.0 * misfit,
        n,
        paths: check.paths,
    }
}

/// Whether the fit converged, and the reason in words.
pub(super) fn verdict(
    problem: &Problem<'_>,
    found: &Found,
    check: &FreshCheck,
    quality: &ObjectiveResult,
) -> (bool, String) {
    let options = problem.options;
    let n = problem.objective.n_numbers() as f64;
    let noise = format!("{:.2} %", quality.fit_monte_carlo_percent);
    let ended = match found.stop {
        Stop::Accuracy => "the accuracy asked for was reached",
        Stop::BesideMeasurement => "Monte Carlo noise is small beside the measurement errors",
        Stop::Schedule => "all iterations of the schedule were made",
        Stop::Paths => "the paths were used up",
        Stop::Time => "the time was used up",
        Stop::Cancelled => "the fit was interrupted",
    };
    if found.stop == Stop::Cancelled {
        return (
            false,
            format!("{ended}; this is the best so far (Monte Carlo part of the error {noise})"),
        );
    }
    if let Some(accuracy) = options
        .budget
        .accuracy
        .filter(|_| found.stop != Stop::Accuracy)
    {
        return (
            false,
            format!(
                "{ended} at a Monte Carlo error of {noise}, before the {:.2} % asked for",
                100.0 * accuracy
            ),
        );
    }
    let (moved, still) = check.moved;
    if moved > 3.0 * still + STILL {
        return (
            false,
            format!(
                "{ended} while the parameters were still moving: the next step would change the means by {:.1} %",
                100.0 * moved
            ),
        );
    }
    if found.monte_carlo_rms > options.tolerance {
        return (
            false,
            format!(
                "{ended} at a Monte Carlo error of {noise}, above the tolerance of {:.1} %: give the fit more paths",
                100.0 * options.tolerance
            ),
        );
    }
    let bounded = problem.objective.bounded();
    // What stated errors of the measurements explain is no fault of the model. Errors of 10 % leave 9.0 +- 1.0 % of 48
    // numbers after nine parameters have absorbed their part; with a tolerance of 5 % up to 11.2 % pass.
    let tolerated = options.tolerance.powi(2) * n + bounded.measurement_sum();
    let judged = bounded.paired(&check.pair);
    if judged.value - 2.0 * judged.standard_error > tolerated {
        return (
            false,
            format!(
                "the parameters came to rest, but a weighted rms residual of {:.1} % remains, above the tolerance of {:.1} %: \
                 from this start nothing better was found; another --start may, or this model and fabric do not explain \
                 the measurements",
                quality.weighted_rms_percent,
                100.0 * options.tolerance
            ),
        );
    }
    (
        true,
        format!("{ended}; the parameters are at rest (Monte Carlo part of the error {noise})"),
    )
}

/// What a fit that came to rest has against itself; empty when nothing.
pub(super) fn doubts(
    problem: &Problem<'_>,
    start: &Parameters,
    goodness: Option<&Goodness>,
) -> String {
    let mut doubts = String::new();
    if goodness.is_some_and(|g| g.probability < SURPRISE) {
        doubts += "; but residuals are larger than the stated errors and the noise of the renders explain: model, fabric, \
                   measurements or their errors are wrong somewhere, and parameters may be off by more than their intervals";
    }
    let seen = |&(row, channel): &(usize, usize)| {
        !start.infos()[row].per_channel || problem.objective.sees(channel)
    };
    let n_seen = start.places().iter().filter(|p| seen(p)).count();
    let n = problem.objective.n_numbers();
    if n < FEW * n_seen {
        doubts += &format!(
            "; but {n} numbers are few for {n_seen} parameters: others may fit as well, and the intervals know only of those found"
        );
    }
    doubts
}

/// Which parameters lie on bounds that were asked for, where the model has no bound; empty when none.
pub(super) fn held(problem: &Problem<'_>, start: &Parameters, u: &[f64]) -> String {
    let space = problem.space;
    let inner = |value: f64, limit: f64| (value - limit).abs() > 0.0;
    let names: Vec<String> = (start.places().iter().zip(start.flat_names()))
        .zip(space.ends())
        .enumerate()
        .filter(|(j, (((row, _), _), [low, high]))| {
            let info = &start.infos()[*row];
            (u[*j] <= space.lower()[*j] && inner(*low, info.lower))
                || (u[*j] >= space.upper()[*j] && inner(*high, info.upper))
        })
        .map(|(_, ((_, name), _))| name)
        .collect();
    match names.len() {
        0 => String::new(),
        1 => format!("; {} is held by a bound that was asked for", names[0]),
        _ => format!(
            "; {} are held by bounds that were asked for",
            names.join(", ")
        ),
    }
}
