//! The choice of poses out of candidates, one after another.

use super::information::{self, Shot};
use super::linear::{Matrix, eigen};
use super::suggest::Aim;
use crate::base::{Error, Result};
use crate::scatter::Parameters;

/// Least gain in the logarithm of a standard deviation for which a pose is suggested.
const WORTHWHILE: f64 = 1e-3;

/// A candidate counts by what is left of its information after so many standard errors of its noise.
const DOUBT: f64 = 3.0;

/// An [`Aim`] with its parameter found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Target {
    Weakest,
    All,
    Place(usize),
}

impl Target {
    pub(super) fn of(aim: &Aim, parameters: &Parameters) -> Result<Self> {
        match aim {
            Aim::Weakest => Ok(Self::Weakest),
            Aim::All => Ok(Self::All),
            Aim::Parameter(name) => {
                let names = parameters.flat_names();
                let place = names.iter().position(|n| n == name);
                place.map(Self::Place).ok_or_else(|| {
                    Error::new(format!("there is no parameter '{name}'"))
                        .with_hint(format!("those that exist: {}", names.join(", ")))
                })
            }
        }
    }

    /// The parameters meant when this much is known, the first first; none stands for all together.
    fn parameters(self, covariance: &Matrix) -> Vec<Option<usize>> {
        match self {
            Self::All => vec![None],
            Self::Place(j) => vec![Some(j)],
            Self::Weakest => {
                let mut places: Vec<usize> = (0..covariance.n_rows()).collect();
                places.sort_by(|&i, &j| covariance[(j, j)].total_cmp(&covariance[(i, i)]));
                places.into_iter().map(Some).collect()
            }
        }
    }
}

/// Logarithm of the standard deviation that is to shrink: of a parameter, or the geometric mean over all directions.
fn merit(covariance: &Matrix, parameter: Option<usize>) -> f64 {
    0.5 * match parameter {
        Some(j) => covariance[(j, j)].ln(),
        None => {
            let all = eigen(covariance);
            all.iter().map(|(value, _)| value.ln()).sum::<f64>() / all.len() as f64
        }
    }
}

/// One choice out of the candidates.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Choice {
    pub(super) index: usize,
    pub(super) for_parameter: Option<usize>,
    pub(super) better_than_median: f64,
}

/// Chooses up to `shots` candidates one after another, none twice, each the best after those before it. When no candidate
/// is seen to say anything of the weakest parameter the next weakest is looked at.
pub(super) fn greedy(base: &Matrix, candidates: &[Shot], shots: usize, aim: Target) -> Vec<Choice> {
    let mut known = base.clone();
    let mut choices: Vec<Choice> = Vec::new();
    while choices.len() < shots {
        let Some(covariance) = information::covariance(&known) else {
            break;
        };
        let left: Vec<usize> = (0..candidates.len())
            .filter(|i| choices.iter().all(|c| c.index != *i))
            .collect();
        let best = aim
            .parameters(&covariance)
            .into_iter()
            .find_map(|parameter| best_of(candidates, &left, &known, &covariance, parameter));
        let Some((choice, own)) = best else { break };
        known.add_scaled(1.0, &own);
        choices.push(choice);
    }
    choices
}

/// The best of the candidates `left` and what it is seen to say; `None` when none is seen to say anything.
fn best_of(
    candidates: &[Shot],
    left: &[usize],
    known: &Matrix,
    covariance: &Matrix,
    parameter: Option<usize>,
) -> Option<(Choice, Matrix)> {
    let directions = directions(covariance, parameter);
    let now = merit(covariance, parameter);
    let mut outcomes: Vec<(f64, usize, Matrix)> = left
        .iter()
        .filter_map(|&index| {
            let own = beyond_doubt(&candidates[index], &directions);
            let mut sum = known.clone();
            sum.add_scaled(1.0, &own);
            // Where the sum is not positive a candidate's information is lost in noise.
            let then = merit(&information::covariance(&sum)?, parameter);
            then.is_finite().then_some((then, index, own))
        })
        .collect();
    outcomes.sort_by(|a, b| a.0.total_cmp(&b.0));
    let median = outcomes.get(outcomes.len() / 2)?.0;
    let (best, index, own) = outcomes.swap_remove(0);
    (best < now - WORTHWHILE).then(|| {
        let choice = Choice {
            index,
            for_parameter: parameter,
            better_than_median: (median - best).exp(),
        };
        (choice, own)
    })
}

/// The directions whose variances a merit is about: the columns of the covariance times their length.
fn directions(covariance: &Matrix, parameter: Option<usize>) -> Vec<Vec<f64>> {
    match parameter {
        Some(j) => vec![covariance.row(j).to_vec()],
        None => {
            let scaled = |(value, e): (f64, Vec<f64>)| {
                let length = value.max(0.0).sqrt();
                e.into_iter().map(|e| e * length).collect()
            };
            eigen(covariance).into_iter().map(scaled).collect()
        }
    }
}

/// A shot's information less what noise may have feigned along these directions.
fn beyond_doubt(shot: &Shot, directions: &[Vec<f64>]) -> Matrix {
    let mut own = shot.information();
    let along: f64 = directions.iter().map(|e| own.form(e, e)).sum();
    let doubt: f64 = directions.iter().map(|e| shot.noise_along(e)).sum();
    own.scale(if along > 0.0 {
        (1.0 - DOUBT * doubt / along).max(0.0)
    } else {
        0.0
    });
    own
}
