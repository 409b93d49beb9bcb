//! Outliers: configurations that differ from the fit far more than the others count less.
//!
//! A gross error is nearly always a whole shot (a lamp that did not fire, a sample that had moved, a shadow), so weights are
//! per configuration. With v_i the mean relative squared residual of configuration i and s^2 that of a usual one, the loss of
//! Huber (1964) is that of weights `q_i = min(1, K / z_i)`, `z_i = sqrt(v_i) / s`. A fit has three stages; the weights of one
//! come from a fresh pair at the end of the one before and stay as they are, so no pair is weighted by its own noise. That
//! pair's linear model is minimized with weights and scale renewed until they settle (iteratively reweighted least squares):
//! the first stage's result leans toward the outliers, its weights do not. v_i is the product of two renders' residuals, less
//! two of its standard errors: noise of a render makes no outlier. Finds no outliers when they are half of all, nor
//! one that is so dark that its relative weight has drawn the fit to itself.

use super::linear::box_quadratic;
use super::objective::{Objective, RenderPair, relative_weights};
use super::options::Options;
use super::pool::Pool;
use super::search::{Found, Problem, Spent, Stretch};
use crate::base::{Error, Result, Watch};
use crate::math::Random;
use crate::scatter::CHANNELS;

/// Shares of the budget at which the weights are renewed.
const STAGES: [f64; 2] = [0.3, 0.6];
/// Accuracy of the stages before the last when nothing else ends them.
const STAGE_ACCURACY: f64 = 0.03;
/// Of the paths so far, the share of the pair that weights come from.
const JUDGE_SHARE: f64 = 0.125;
/// Index of that pair, beside those of searches.
const JUDGE_INDEX: u64 = 6 << 32;
/// Renewals of the weights in one linear model, and how far a coordinate may move in it.
const RENEWALS: usize = 40;
const REACH: f64 = 0.5;
/// Median of chi-square with three degrees of freedom, over three.
const MEDIAN: f64 = 0.789;
/// Relative residuals below this are never outliers.
const LEAST_SCALE: f64 = 1e-3;
/// The usual K: three channels of normal errors exceed it once in 140 configurations.
const USUAL: f64 = 2.0;

/// How residuals count.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Loss {
    /// All alike (Khungurn 2015 eq. 18).
    #[default]
    Squared,
    /// Configurations whose residual is more than this many times a usual one count less (Huber 1964).
    Huber(f64),
}

impl Loss {
    /// The name on the command line and in files: `squared`, `huber:2`.
    pub fn name(self) -> String {
        match self {
            Self::Squared => "squared".to_owned(),
            Self::Huber(k) => format!("huber:{k}"),
        }
    }

    /// The loss of this name; `huber` alone is `huber:2`.
    ///
    /// # Errors
    /// When there is none, or K is not between 0.5 and 100.
    pub fn named(name: &str) -> Result<Self> {
        let (kind, k) = name.split_once(':').unwrap_or((name, ""));
        let k = if k.is_empty() { Ok(USUAL) } else { k.parse() };
        match (kind, k) {
            ("squared", _) if kind == name => Ok(Self::Squared),
            ("huber", Ok(k)) if (0.5..=100.0).contains(&k) => Ok(Self::Huber(k)),
            _ => Err(Error::new(format!("unknown loss '{name}'"))
                .with_hint("known: squared, huber:K with K from 0.5 to 100, e.g. huber:2")),
        }
    }

    /// What is asked of the stages before the last; their random numbers are others.
    pub(super) fn early_stages(self, options: &Options) -> Vec<Options> {
        if self == Self::Squared {
            return Vec::new();
        }
        let stage = |(number, share): (u64, f64)| {
            let mut stage = options.clone();
            let b = &mut stage.budget;
            b.paths = b.paths.map(|n| (n as f64 * share) as u64);
            b.time_s = b.time_s.map(|t| t * share);
            b.accuracy = b.accuracy.map(|a| a.max(STAGE_ACCURACY));
            stage.seed = Random::keyed(&[options.seed, number, 0x0b57]).bits();
            stage
        };
        (1..).zip(STAGES).map(stage).collect()
    }
}

/// The weights of the next stage, one per configuration, from a fresh pair where the last one ended.
///
/// # Errors
/// When the render fails or is cancelled.
pub(super) fn factors(
    problem: &Problem<'_>,
    found: &Found,
    spent: &mut Spent,
    watch: &dyn Watch,
) -> Result<Vec<f64>> {
    let least = 64 * problem.objective.intensities().len() as u64;
    let paths = ((JUDGE_SHARE * spent.paths as f64) as u64).max(least);
    let stretch = Stretch {
        watch,
        stage: "fit: outliers",
        done: 0.0,
        each: 0.5,
        state: std::sync::Mutex::new((0, 0.0)),
        interruptible: true,
    };
    let pair = problem.render(&found.u, paths, &found.check_shares, JUDGE_INDEX, &stretch)?;
    spent.add(paths, &pair);
    let mut factors = problem.objective.factors().to_vec();
    let Loss::Huber(k) = problem.options.loss else {
        return Ok(factors);
    };
    let objective = problem.objective;
    let moved = |factors: Vec<f64>| {
        let weighted = objective.with_factors(factors);
        moved(problem, &weighted, &found.u, &pair)
    };
    for _ in 0..RENEWALS {
        factors = Residuals::of(objective, &pair, &moved(factors)).weights(k);
    }
    Ok(factors)
}

/// How the means change on the way to the minimum of the pair's linear model.
fn moved(problem: &Problem<'_>, objective: &Objective, u: &[f64], pair: &RenderPair) -> Vec<f64> {
    let space = problem.space;
    let mut pool = Pool::new(objective);
    pool.push(space, u, &space.to_parameters(u), objective, pair);
    let model = pool.model();
    let side = |bounds: &[f64]| -> Vec<f64> {
        let room = |(bound, u): (&f64, &f64)| (bound - u).clamp(-REACH, REACH);
        bounds.iter().zip(u).map(room).collect()
    };
    let step = box_quadratic(
        &model.marquardt_curvature(),
        &model.gradient,
        &side(space.lower()),
        &side(space.upper()),
    );
    model.jacobian.times(&step)
}

/// Mean relative squared residuals, per configuration.
struct Residuals {
    values: Vec<f64>,
    /// The same less two standard errors of the renders' noise.
    beyond_noise: Vec<f64>,
    /// What measurement errors alone would leave.
    expected: Vec<f64>,
}

impl Residuals {
    /// Those of a pair whose means have moved by so much.
    fn of(objective: &Objective, pair: &RenderPair, moved: &[f64]) -> Self {
        let rows = objective.intensities().iter().zip(pair.estimates());
        let (mut values, mut expected, mut beyond_noise) = (Vec::new(), Vec::new(), Vec::new());
        for ((i, [a, b]), moved) in rows.zip(moved.chunks(CHANNELS)) {
            let weights = relative_weights(i, objective.tau());
            let (mut value, mut noise, mut measured, mut n) = (0.0, 0.0, 0.0, 0.0);
            for c in (0..CHANNELS).filter(|&c| i.present[c]) {
                let [e1, e2] = [a, b].map(|e| e.mean[c] + moved[c] - i.mean[c]);
                let s2 = 0.5 * (a.standard_error[c].powi(2) + b.standard_error[c].powi(2));
                value += weights[c] * e1 * e2;
                // Channels share paths: their noise adds.
                noise += weights[c] * (2.0 * (e1 * e2).max(0.0) * s2 + s2 * s2).sqrt();
                measured += weights[c] * i.standard_error[c].powi(2);
                n += 1.0;
            }
            values.push((value / n).max(0.0));
            expected.push(measured / n);
            beyond_noise.push(((value - 2.0 * noise) / n).max(0.0));
        }
        Self {
            values,
            beyond_noise,
            expected,
        }
    }

    /// Huber's weights.
    fn weights(&self, k: f64) -> Vec<f64> {
        let scale = (median(&self.values) / MEDIAN).max(median(&self.expected));
        let limit = k * scale.sqrt().max(LEAST_SCALE);
        let weight = |v: &f64| {
            if v.sqrt() > limit {
                limit / v.sqrt()
            } else {
                1.0
            }
        };
        self.beyond_noise.iter().map(weight).collect()
    }
}

fn median(values: &[f64]) -> f64 {
    let mut values = values.to_vec();
    values.sort_by(f64::total_cmp);
    let n = values.len();
    0.5 * (values[(n - 1) / 2] + values[n / 2])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn losses_are_known_by_name() {
        for loss in [Loss::Squared, Loss::Huber(2.0), Loss::Huber(1.5)] {
            assert_eq!(Loss::named(&loss.name()).unwrap(), loss);
        }
        assert_eq!(Loss::named("huber").unwrap(), Loss::Huber(2.0));
        for bad in [
            "",
            "huber:0",
            "huber:nan",
            "huber:x",
            "squared:2",
            "tukey:4",
        ] {
            assert!(Loss::named(bad).is_err(), "{bad}");
        }
    }
}
