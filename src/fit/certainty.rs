//! How certain each parameter is: which interval it gets, what is said of it, and how parameters trade off.

use super::check::FreshCheck;
use super::goodness::Residuals;
use super::profile::Profiler;
use super::result::{Correlation, IntervalMethod, ParameterResult, Verdict};
use super::search::{Found, Problem};
use super::uncertainty::{Density, Samples};
use crate::base::Result;
use crate::scatter::{Parameters, Unit};

/// Shares of the range at which a parameter is weakly, and not, determined.
const WEAK: f64 = 0.2;
const NOT: f64 = 0.5;

/// Puts profiles in the place of quadratic distributions where those take much of the range or touch a bound, and says
/// which method each place has.
pub(super) fn profile(
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

/// What is said of every flat parameter.
pub(super) fn parameter_results(
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

/// Correlations of the model's parameters.
pub(super) fn correlation(parameters: &Parameters, samples: &Samples) -> Correlation {
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
