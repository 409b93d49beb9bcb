//! The rule: which rungs need not be tried, and which of those tried is the simplest that the data support.

use super::{Evidence, Facts, Rung};
use serde::Serialize;

/// Criteria that differ by less do not tell two models apart: odds of 33 to 1 (Burnham and Anderson 2002 sec. 2.6).
const TELLING: f64 = 7.0;
/// A model is worse at unseen geometries when the mean logarithm of its squared errors is larger by so many of its standard errors.
const VETO: f64 = 2.0;
/// The models differ most beyond this angle; without such poses no rule tells them apart.
const STEEP_DEG: f64 = 70.0;

/// The verdicts.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Choice {
    /// The simplest model that the data support.
    pub model: String,
    /// Whether it is good enough: it reaches the noise, or the tolerance.
    pub adequate: bool,
    /// Whether the errors of the measurements explain what it leaves.
    pub reaches_noise: bool,
    /// Models tried that could as well be the one.
    pub not_separable: Vec<String>,
    /// The model that the criterion had chosen, where leaving out geometries spoke against it.
    pub vetoed: Option<String>,
    /// Nothing speaks against taking the chosen model for the one needed.
    pub firm: bool,
    /// Why not.
    pub doubts: Vec<String>,
}

/// How a ladder is climbed and judged.
pub trait Rule {
    /// Why a rung need not be tried; none when it should be.
    fn needless(&self, facts: &Facts<'_>, tried: &[Evidence], rung: &dyn Rung) -> Option<String>;

    /// The verdicts on the rungs tried, at least one. `banned`: there were rungs with more parameters than the numbers allow.
    fn choose(&self, facts: &Facts<'_>, tried: &[Evidence], banned: bool) -> Choice;
}

/// The usual rule: the smallest corrected information criterion over numbers at distinct geometries, unless a simpler model is clearly better
/// where a geometry is left out; nothing is gained below the noise.
#[derive(Debug, Clone, Copy, Default)]
pub struct Sparing;

impl Sparing {
    fn best(tried: &[Evidence]) -> usize {
        (0..tried.len())
            .min_by(|&a, &b| tried[a].criterion.total_cmp(&tried[b].criterion))
            .unwrap_or(0)
    }

    /// The simpler rungs that are clearly better than rung `k` at unseen geometries; of these the one of the smallest criterion.
    fn better_unseen(facts: &Facts<'_>, tried: &[Evidence], k: usize) -> Option<usize> {
        (0..k)
            .filter(|&s| {
                tried[s].free < tried[k].free && clearly_worse(facts, &tried[k], &tried[s])
            })
            .min_by(|&a, &b| tried[a].criterion.total_cmp(&tried[b].criterion))
    }
}

/// Whether `a` is worse than `b` at unseen geometries beyond doubt. Logarithms, so that one wild extrapolation does not decide; the noise is added, so that
/// differences below it do not count.
fn clearly_worse(facts: &Facts<'_>, a: &Evidence, b: &Evidence) -> bool {
    let n = a.unseen_squares.len();
    if n < 3 || b.unseen_squares.len() != n {
        return false;
    }
    let noise = (facts.noise * facts.noise).max(1e-12);
    let pairs = a.unseen_squares.iter().zip(&b.unseen_squares);
    let logs: Vec<f64> = pairs
        .map(|(a, b)| ((a + noise) / (b + noise)).ln())
        .collect();
    let mean = logs.iter().sum::<f64>() / n as f64;
    let variance = logs.iter().map(|l| (l - mean).powi(2)).sum::<f64>() / (n - 1) as f64;
    mean > VETO * (variance / n as f64).sqrt() && mean > 0.0
}

impl Rule for Sparing {
    fn needless(&self, facts: &Facts<'_>, tried: &[Evidence], rung: &dyn Rung) -> Option<String> {
        let best = &tried.get(Self::best(tried))?;
        if let Some(there) = tried
            .iter()
            .find(|e| facts.reaches_noise(e.at_most(), e.free))
        {
            return Some(format!("{} reaches the noise", there.model));
        }
        if rung.traced() && best.at_most() <= facts.tolerance {
            let percent = 100.0 * facts.tolerance;
            return Some(format!("{} is within {percent:.1} %", best.model));
        }
        let most = facts.criterion(0.0, rung.free());
        (most >= best.criterion).then(|| {
            format!(
                "could not be told from {} even if it left nothing but noise",
                best.model
            )
        })
    }

    fn choose(&self, facts: &Facts<'_>, tried: &[Evidence], banned: bool) -> Choice {
        let first = Self::best(tried);
        let mut chosen = first;
        while let Some(simpler) = Self::better_unseen(facts, tried, chosen) {
            chosen = simpler;
        }
        let e = &tried[chosen];
        let near = |(k, other): &(usize, &Evidence)| {
            *k != chosen && (other.criterion - e.criterion).abs() < TELLING
        };
        let not_separable: Vec<String> = tried
            .iter()
            .enumerate()
            .filter(near)
            .map(|(_, o)| o.model.clone())
            .collect();
        let vetoed = (chosen != first).then(|| tried[first].model.clone());
        let doubts = doubts(facts, e, banned, &not_separable, vetoed.as_deref());
        let reaches_noise = facts.reaches_noise(e.at_most(), e.free);
        Choice {
            model: e.model.clone(),
            adequate: reaches_noise || e.at_most() <= facts.tolerance,
            reaches_noise,
            not_separable,
            vetoed,
            firm: doubts.is_empty(),
            doubts,
        }
    }
}

fn doubts(
    facts: &Facts<'_>,
    chosen: &Evidence,
    banned: bool,
    not_separable: &[String],
    vetoed: Option<&str>,
) -> Vec<String> {
    let mut list = Vec::new();
    if !not_separable.is_empty() {
        list.push(format!(
            "{} explain the numbers as well",
            not_separable.join(", ")
        ));
    }
    if let Some(vetoed) = vetoed {
        list.push(format!(
            "{vetoed} fits better, but predicts geometries left out worse"
        ));
    }
    if banned {
        list.push(format!(
            "{} numbers at distinct geometries are too few for the richest models",
            facts.n_distinct
        ));
    }
    if facts.steepest.to_degrees() < STEEP_DEG {
        list.push(format!(
            "no light or camera beyond {STEEP_DEG:.0} degrees, where the models differ most"
        ));
    }
    if chosen.unseen.is_none() {
        list.push("too few poses to leave any out".to_owned());
    }
    list
}
