//! From where the search ended to a [`FitResult`]: a fresh pair judges, verdicts are put into words.

use super::gain;
use super::goodness::{Residuals, SURPRISE};
use super::linear::{box_quadratic, inverse};
use super::objective::{PairedValue, RenderPair, relative_weight, rms_of};
use super::patterns::patterns;
use super::pool::Pool;
use super::profile::{Profiler, Recorded};
use super::result::{
    ConfigurationResult, Correlation, Cost, FitResult, Goodness, IntervalMethod, ObjectiveResult,
    ParameterResult, Verdict,
};
use super::search::{AFTER_INTERRUPT, Found, Problem, Spent, Stop, Stretch};
use super::uncertainty::{Density, Samples};
use crate::base::{Result, Watch};
use crate::render::{Effort, Request};
use crate::scatter::{CHANNELS, Parameters, Unit};

/// Pair index of the final check, far from those of the search.
const CHECK_INDEX: u64 = 1 << 40;
/// Pair index of the recorded paths.
const RECORD_INDEX: u64 = 1 << 41;
/// Most paths that are recorded, both sets together: evaluating them once takes about 0.02 seconds.
const MOST_RECORDED: u64 = 200_000;
/// A full Newton step from the fresh pair may change the means by this fraction beyond its noise.
const STILL: f64 = 0.002;
/// Shares of the range at which a parameter is weakly, and not, determined.
const WEAK: f64 = 0.2;
const NOT: f64 = 0.5;
/// Fewer numbers than this for each parameter leave room for other minima as good.
const FEW: usize = 2;

/// A pair at the fitted parameters that the search has never seen.
pub(super) struct FreshCheck {
    pair: RenderPair,
    /// Paths for profiles, where the scene can record.
    recorded: Option<Recorded>,
    paths: u64,
    value: PairedValue,
    /// Weighted rms change of the means that a full Newton step from this pair would make, and its noise.
    moved: (f64, f64),
}

impl FreshCheck {
    /// Renders the pair with what the search left of the budget, at most a third of what it used. After an interrupt, also
    /// one of this very pair, a short one that cannot be interrupted.
    pub(super) fn render(
        problem: &Problem<'_>,
        found: &mut Found,
        spent: &mut Spent,
        watch: &dyn Watch,
    ) -> Result<Self> {
        let objective = problem.objective;
        let least = 64 * objective.intensities().len() as u64;
        let left = spent.left(&problem.options.budget, 1.0).unwrap_or(u64::MAX);
        let stretch = |interruptible: bool| Stretch {
            watch,
            stage: "fit: final check",
            done: 0.0,
            each: 0.5,
            state: std::sync::Mutex::new((0, 0.0)),
            interruptible,
        };
        let mut recorded = None;
        let mut whole = None;
        if found.stop != Stop::Cancelled {
            let all = (spent.paths / 3).min(left).max(least);
            let ended = Self::recorded_and_rendered(problem, found, all, spent, &stretch(true));
            match ended {
                Err(_) if watch.cancelled() => {}
                ended => (recorded, whole) = ended.map(|(r, pair)| (r, Some(pair)))?,
            }
        }
        let (pair, paths) = match whole {
            Some(rendered) => rendered,
            None => {
                found.stop = Stop::Cancelled;
                let (index, paths) = (
                    AFTER_INTERRUPT + CHECK_INDEX,
                    spent.moment().min(left).max(least),
                );
                let stretch = stretch(false);
                let pair = problem.render(&found.u, paths, &found.check_shares, index, &stretch)?;
                (pair, paths)
            }
        };
        spent.add(paths, &pair);
        Ok(Self {
            value: objective.paired(&pair),
            moved: newton_move(problem, found, &pair),
            pair,
            recorded,
            paths,
        })
    }

    /// With `paths` in all: a recording where the scene can make one, and the pair with its paths.
    fn recorded_and_rendered(
        problem: &Problem<'_>,
        found: &Found,
        paths: u64,
        spent: &mut Spent,
        watch: &dyn Watch,
    ) -> Result<(Option<Recorded>, (RenderPair, u64))> {
        let recorded = record(problem, found, paths / 4, spent, watch)?;
        let paths = match &recorded {
            Some(_) => paths - (paths / 4).min(MOST_RECORDED),
            None => paths,
        };
        let pair = problem.render(&found.u, paths, &found.check_shares, CHECK_INDEX, watch)?;
        Ok((recorded, (pair, paths)))
    }
}

/// Records paths for profiles, two times half of `paths` or of the most.
fn record(
    problem: &Problem<'_>,
    found: &Found,
    paths: u64,
    spent: &mut Spent,
    watch: &dyn Watch,
) -> Result<Option<Recorded>> {
    let paths = paths.min(MOST_RECORDED);
    let configurations = problem.objective.configurations();
    // Profiles know of no gain.
    if paths < 128 * configurations.len() as u64 || problem.space.gain().is_some() {
        return Ok(None);
    }
    let request = Request {
        configurations: &configurations,
        parameters: &problem.space.to_parameters(&found.u),
        effort: Effort::Total {
            paths: paths / 2,
            shares: found.check_shares.clone(),
        },
        seed: problem.options.seed,
        stream: 0,
    };
    let recorded = Recorded::new(problem.scene, &request, RECORD_INDEX, watch)?;
    if let Some(recorded) = &recorded {
        spent.paths += paths;
        spent.wall_s += recorded.wall_s;
        spent.cpu_s += recorded.cpu_s;
    }
    Ok(recorded)
}

fn newton_move(problem: &Problem<'_>, found: &Found, pair: &RenderPair) -> (f64, f64) {
    let (space, objective) = (problem.space, problem.objective);
    let mut pool = Pool::new(objective);
    pool.push(
        space,
        &found.u,
        &space.to_parameters(&found.u),
        objective,
        pair,
    );
    let fresh = pool.model();
    let offset =
        |side: &[f64]| -> Vec<f64> { side.iter().zip(&found.u).map(|(s, u)| s - u).collect() };
    let step = box_quadratic(
        &found.curvature,
        &fresh.gradient,
        &offset(space.lower()),
        &offset(space.upper()),
    );
    let n = objective.n_numbers() as f64;
    let noise = inverse(&found.curvature).map_or(0.0, |inverse| {
        fresh.fitted_rms(&inverse, &fresh.monte_carlo, pool.weights())
    });
    (
        (found.curvature.form(&step, &step) / n).sqrt(),
        noise.hypot(found.monte_carlo_rms),
    )
}

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
        configs: objective
            .intensities()
            .iter()
            .zip(objective.factors())
            .zip(check.pair.estimates())
            .map(|((intensity, &robust_weight), [a, b])| {
                let weight = relative_weight(intensity, objective.tau());
                let rendered: [f64; CHANNELS] =
                    std::array::from_fn(|c| 0.5 * (a.mean[c] + b.mean[c]));
                let residual = intensity
                    .where_present(std::array::from_fn(|c| rendered[c] - intensity.mean[c]));
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
            .collect(),
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

/// Puts profiles in the place of quadratic distributions where those take much of the range or touch a bound, and says
/// which method each place has.
fn profile(
    problem: &Problem<'_>,
    found: &Found,
    check: &FreshCheck,
    density: &Density,
    residuals: &Residuals,
    samples: &mut Samples,
) -> Result<Vec<IntervalMethod>> {
    let space = problem.space;
    let mut methods = vec![IntervalMethod::Quadratic; space.len()];
    let Some(recorded) = &check.recorded else {
        return Ok(methods);
    };
    let profiler = Profiler::new(
        space,
        recorded,
        &found.model.weights,
        &found.u,
        &residuals.residual,
        &density.force,
    )?;
    for (j, method) in methods.iter_mut().enumerate() {
        let (low, high) = (space.lower()[j], space.upper()[j]);
        let [from, to] = samples.interval(space, j, 0.95, found.u[j]);
        let edge = 1e-3 * (high - low);
        if to - from < WEAK * (high - low) && from > low + edge && to < high - edge {
            continue;
        }
        if let Some(sorted) = profiler.quantiles(j, density.scales[j])? {
            samples.replace(j, sorted);
            *method = IntervalMethod::Profile;
        }
    }
    Ok(methods)
}

fn quality(problem: &Problem<'_>, found: &Found, check: &FreshCheck) -> ObjectiveResult {
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
fn verdict(
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
    // What stated errors of the measurements explain is no fault of the model.
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
fn doubts(problem: &Problem<'_>, start: &Parameters, goodness: Option<&Goodness>) -> String {
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
fn held(problem: &Problem<'_>, start: &Parameters, u: &[f64]) -> String {
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

fn parameter_results(
    problem: &Problem<'_>,
    start: &Parameters,
    found: &Found,
    samples: &Samples,
    methods: &[IntervalMethod],
) -> Vec<ParameterResult> {
    let space = problem.space;
    let names = start.flat_names();
    let initial = start.values();
    start
        .places()
        .into_iter()
        .enumerate()
        .map(|(j, (row, channel))| {
            let info = &start.infos()[row];
            let (unit, scale) = match info.unit {
                Unit::One => ("1", 1.0),
                Unit::Angle => ("degrees", 1.0_f64.to_degrees()),
            };
            let value = |u: f64| scale * space.value(j, u);
            let u = found.u[j];
            let seen = !info.per_channel || problem.objective.sees(channel);
            let interval = |level: f64| match seen {
                true => samples.interval(space, j, level, found.u[j]),
                false => [space.lower()[j], space.upper()[j]],
            };
            let outer = interval(0.95);
            let share = (outer[1] - outer[0]) / (space.upper()[j] - space.lower()[j]);
            let verdict = if share > NOT {
                Verdict::NotDetermined
            } else if u <= space.lower()[j] {
                Verdict::AtLowerBound
            } else if u >= space.upper()[j] {
                Verdict::AtUpperBound
            } else if share > WEAK {
                Verdict::WeaklyDetermined
            } else {
                Verdict::Determined
            };
            let half = samples.standard_error(j);
            let mut result = ParameterResult {
                name: names[j].clone(),
                unit: unit.to_owned(),
                value: value(u),
                initial: scale * initial[j],
                lower_bound: value(space.lower()[j]),
                upper_bound: value(space.upper()[j]),
                standard_error: 0.5 * (value(u + half) - value(u - half)),
                interval_68: interval(0.68).map(value),
                interval_95: outer.map(value),
                quantiles: ParameterResult::QUANTILE_LEVELS
                    .map(|t| value(samples.quantile(j, t)))
                    .to_vec(),
                interval_method: methods[j],
                range_share: share,
                verdict,
                sentence: String::new(),
            };
            result.sentence = match seen {
                true => sentence(&result),
                false => format!(
                    "{} is not determined: no measurement sees its channel; it stays at its start {}",
                    result.name,
                    three_digits(result.value)
                ),
            };
            result
        })
        .collect()
}

/// A number with three significant digits, at most five decimals.
pub fn three_digits(x: f64) -> String {
    if x.abs() < 1e-300 {
        return "0".to_owned();
    }
    let decimals = (2.0 - x.abs().log10().floor()).clamp(0.0, 5.0) as usize;
    format!("{x:.decimals$}")
}

fn sentence(p: &ParameterResult) -> String {
    let unit = if p.unit == "1" {
        String::new()
    } else {
        format!(" {}", p.unit)
    };
    let [low, high] = p.interval_95.map(three_digits);
    let value = three_digits(p.value);
    let name = &p.name;
    match p.verdict {
        Verdict::Determined => {
            format!("{name} is determined: {value}{unit} ({low}-{high} at 95 %)")
        }
        Verdict::WeaklyDetermined => {
            format!("{name} is weakly determined: {value}{unit} ({low}-{high} at 95 %)")
        }
        Verdict::NotDetermined => {
            format!("{name} is not determined by these configurations: {low}-{high}{unit} at 95 %")
        }
        Verdict::AtLowerBound => {
            format!("{name} is at its lower bound {value}{unit}; up to {high}{unit} fits at 95 %")
        }
        Verdict::AtUpperBound => {
            format!("{name} is at its upper bound {value}{unit}; down to {low}{unit} fits at 95 %")
        }
    }
}

fn correlation(parameters: &Parameters, samples: &Samples) -> Correlation {
    let matrix = &samples.correlation;
    let names = parameters.flat_names();
    // The gain, the last coordinate, is no parameter.
    let p = names.len();
    Correlation {
        search_sd: samples.sd[..p].to_vec(),
        names,
        matrix: (0..p).map(|i| matrix.row(i)[..p].to_vec()).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::three_digits;

    #[test]
    fn numbers_keep_three_digits() {
        let text: Vec<String> = [0.0, 12.345, 0.998_7, 0.001, 1234.6, -0.056_78]
            .into_iter()
            .map(three_digits)
            .collect();
        assert_eq!(text, ["0", "12.3", "0.999", "0.00100", "1235", "-0.0568"]);
    }
}
