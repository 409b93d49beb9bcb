//! What is made of a fit whose truth is known: right, flagged, or wrong and confident; and the table of many of them.
#![allow(unreachable_pub, missing_docs)]

use goniofit::fit::{FitResult, ParameterResult, Verdict};

/// A mean is off when it is this many times farther from the truth than the fit states.
const MEANS: f64 = 3.0;
/// Percent below which means are never called off: a search calls 0.2 % of movement rest.
const REST_PERCENT: f64 = 0.2;
/// A parameter is wrong when its truth is this many half widths from the middle of its 95 % interval.
const HALF_WIDTHS: f64 = 3.0;
/// A configuration whose robust weight is below this has been named as an outlier.
const NAMED: f64 = 0.5;

/// A fit and what it should have found.
#[derive(Clone)]
pub struct Outcome {
    pub result: FitResult,
    /// Flat, in the units of the result; may lie outside the bounds. Empty where the fit has no true parameters.
    pub truth: Vec<f64>,
    /// Weighted rms distance of the fitted means from the true ones, percent; without what its own noise explains.
    pub means_off: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Class {
    Converged,
    Flagged,
    Failed,
}

pub struct Judged {
    pub class: Class,
    pub means_off: f64,
    pub stated: f64,
    /// What is wrong, whether the fit says so or not.
    pub wrong: Vec<String>,
    /// What the fit says of the wrong parameters, with the truth.
    pub details: Vec<String>,
    /// The first thing that the user is told to warn him; empty when nothing is.
    pub told: String,
}

/// The rule: a wrong answer without a warning has failed. That other parameters are not determined is a warning of these
/// alone.
pub fn judge(outcome: &Outcome) -> Judged {
    let result = &outcome.result;
    let stated = stated_percent(result);
    let mut wrong = Vec::new();
    if outcome.means_off > MEANS * stated.max(REST_PERCENT / MEANS) {
        wrong.push("means".to_owned());
    }
    let pairs = || result.uncertainty.iter().zip(&outcome.truth);
    let far = pairs().filter(|(p, t)| half_widths_off(p, **t) > HALF_WIDTHS);
    let mut details = Vec::new();
    for (p, truth) in far {
        wrong.push(p.name.clone());
        details.push(format!("{}, truth {truth:.3}", p.sentence));
    }
    let beyond = pairs()
        .filter(|(p, t)| match p.verdict {
            Verdict::AtLowerBound => **t < p.lower_bound * (1.0 - 1e-9),
            Verdict::AtUpperBound => **t > p.upper_bound * (1.0 + 1e-9),
            _ => false,
        })
        .map(|(p, _)| p.sentence.clone());
    let warning = trouble(result).into_iter().chain(beyond).next();
    let open = || {
        let is_open = |p: &&ParameterResult| p.verdict == Verdict::NotDetermined;
        let mut open = result.uncertainty.iter().filter(is_open);
        open.next().map(|p| p.sentence.clone())
    };
    let (class, told) = match (warning, wrong.is_empty()) {
        (Some(told), _) => (Class::Flagged, told),
        (None, false) => (Class::Failed, String::new()),
        (None, true) => match open() {
            Some(told) => (Class::Flagged, told),
            None => (Class::Converged, String::new()),
        },
    };
    Judged {
        class,
        means_off: outcome.means_off,
        stated,
        wrong,
        details,
        told,
    }
}

/// How far the fit says that its means may be from the truth, percent.
fn stated_percent(result: &FitResult) -> f64 {
    let o = &result.objective;
    let gain = result
        .gain
        .as_ref()
        .map_or(0.0, |g| 100.0 * g.standard_error);
    [
        o.fit_monte_carlo_percent,
        o.fit_measurement_percent,
        o.misfit_percent,
        gain,
    ]
    .iter()
    .map(|x| x * x)
    .sum::<f64>()
    .sqrt()
}

/// What the fit tells of itself as a whole that warns of it, the loudest first.
fn trouble(result: &FitResult) -> Option<String> {
    if !result.converged {
        return Some(format!("not converged: {}", result.reason));
    }
    if result.reason.contains("; but ") {
        return Some(format!("converged: {}", result.reason));
    }
    if result.configs.iter().any(|c| c.robust_weight < NAMED) {
        return result.outliers_in_words();
    }
    let mut patterns = result.patterns.iter().filter(|p| p.significant);
    patterns.next().map(|p| p.sentence.clone())
}

/// Distance of the truth from the middle of the 95 % interval in half widths of it, ratios for angles; 0 for a parameter
/// that is called not determined. A truth outside the bounds counts as on the bound.
fn half_widths_off(p: &ParameterResult, truth: f64) -> f64 {
    if p.verdict == Verdict::NotDetermined {
        return 0.0;
    }
    let place = |x: f64| if p.unit == "1" { x } else { x.ln() };
    let truth = place(truth.clamp(p.lower_bound, p.upper_bound));
    let [low, high] = p.interval_95.map(place);
    (truth - 0.5 * (low + high)).abs() / (0.5 * (high - low)).max(1e-6)
}

/// One line of the table: all fits of one case.
pub struct Row {
    pub name: String,
    pub fits: Vec<Judged>,
}

impl Row {
    pub fn worst(&self) -> &Judged {
        self.fits.iter().max_by_key(|j| j.class).unwrap()
    }
}

/// Markdown.
pub fn table(rows: &[Row]) -> String {
    let mut text = "| case | fits | converged | flagged | failed | means off (stated), % | wrong | what the worst fit tells |\n\
                    |---|---|---|---|---|---|---|---|\n"
        .to_owned();
    for row in rows {
        let count = |class| row.fits.iter().filter(|j| j.class == class).count();
        let worst = row.worst();
        let mut wrong: Vec<&String> = row.fits.iter().flat_map(|j| &j.wrong).collect();
        wrong.sort();
        wrong.dedup();
        let wrong: Vec<&str> = wrong.into_iter().map(String::as_str).collect();
        text += &format!(
            "| {} | {} | {} | {} | {} | {:.1} ({:.1}) | {} | {} |\n",
            row.name,
            row.fits.len(),
            count(Class::Converged),
            count(Class::Flagged),
            count(Class::Failed),
            worst.means_off,
            worst.stated,
            wrong.join(", "),
            worst.told
        );
    }
    text
}
