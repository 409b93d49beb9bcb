//! Does the fit predict what it has not seen? Leaves configurations out, predicts them, compares.
//!
//! By refits from the full fit's parameters, or by a linear model around them in closed form: with A the curvature of half
//! the objective, J the derivatives of the configurations left out and e their residuals in the full fit (both times the
//! square root of the weight), the residuals without them are `(1 - H)^-1 e`, `H = J A^-1 J'` their leverage. Parameters on
//! a bound stay there; the bounds of the others enter as a weak prior, so what the rest does not determine stays put, and so
//! does what the renders' noise hides.

use super::information::{self, Place, Seen, Shot};
use super::linear::Matrix;
use super::objective::{Objective, RenderPair, brightness, relative_weight};
use super::options::{Budget, Options};
use super::predict::{Compared, Comparison, Prediction, compare, parameters_of, predict};
use super::result::FitResult;
use super::robust::Loss;
use crate::base::{Error, Result, Watch};
use crate::render::{Effort, Scene};
use crate::scatter::CHANNELS;
use crate::session::{Configuration, Intensity, Measurements};

/// Index of the linear model's pair, far from those of searches, checks and predictions.
const LINEAR_INDEX: u64 = (1 << 41) + 1;

/// How the configurations left out are predicted.
#[derive(Debug, Clone, PartialEq)]
pub enum Refit {
    /// Fits the others anew, from the full fit's parameters, each within this budget; predictions get as many paths per
    /// configuration and render as stated.
    Search {
        /// Of each refit.
        budget: Budget,
        /// Of each prediction.
        paths: u64,
    },
    /// Closed form around the full fit, from a pair of renders with this many paths per camera direction each.
    Linear {
        /// Per camera direction and render.
        paths: u64,
    },
}

/// Leaves each of `folds` (lists of configuration ids) out in turn and compares what the others predict with what was
/// measured. `full` is the fit of all of `measurements`.
///
/// # Errors
/// When a fold is empty or names a configuration that was not measured, nothing is left to fit, or a fit or a render fails.
pub fn validate(
    scene: &dyn Scene,
    measurements: &Measurements,
    full: &FitResult,
    folds: &[Vec<u32>],
    refit: &Refit,
    seed: u64,
    watch: &dyn Watch,
) -> Result<Comparison> {
    for fold in folds {
        check_fold(measurements, fold)?;
    }
    let mut rows: Vec<Compared> = Vec::new();
    match refit {
        Refit::Search { budget, paths } => {
            for (number, fold) in (1..).zip(folds) {
                let watch = &Fold {
                    watch,
                    name: format!("{number} of {}", folds.len()),
                };
                let (rest, left_out) = split(measurements, fold);
                let options = Options {
                    start: Some(parameters_of(scene, full)?),
                    tolerance: 0.01 * full.tolerance_percent,
                    loss: Loss::named(&full.loss)?,
                    tau: full.tau,
                    bounds: full.bounds.clone(),
                    gain_prior: full.gain.as_ref().map(|g| g.prior_sd),
                    ..Options::new(seed, *budget)
                };
                let without = super::fit(scene, &rest, &options, watch)?;
                let poses: Vec<Configuration> = left_out
                    .intensities
                    .iter()
                    .map(|i| i.configuration)
                    .collect();
                let effort = Effort::Paths(*paths);
                let predictions = predict(scene, &without, &poses, &effort, seed, watch)?;
                rows.extend(compare(&predictions, &left_out, full.tau)?.rows);
            }
        }
        Refit::Linear { paths } => {
            let linear = Linear::new(scene, measurements, full, *paths, seed, watch)?;
            for fold in folds {
                let (_, left_out) = split(measurements, fold);
                rows.extend(compare(&linear.predict(fold)?, &left_out, full.tau)?.rows);
            }
        }
    }
    Ok(Comparison::of(rows, full.tau))
}

/// Says in the name of every stage which fold it belongs to.
struct Fold<'a> {
    watch: &'a dyn Watch,
    name: String,
}

impl Watch for Fold<'_> {
    fn progress(&self, stage: &str, done: u64, total: u64) {
        self.watch
            .progress(&format!("{}, {stage}", self.name), done, total);
    }

    fn cancelled(&self) -> bool {
        self.watch.cancelled()
    }
}

fn check_fold(measurements: &Measurements, fold: &[u32]) -> Result<()> {
    let ids: Vec<u32> = measurements
        .intensities
        .iter()
        .map(|i| i.configuration.id)
        .collect();
    if let Some(unknown) = fold.iter().find(|id| !ids.contains(id)) {
        let known: Vec<_> = ids.iter().map(u32::to_string).collect();
        return Err(
            Error::new(format!("configuration {unknown} was not measured"))
                .with_hint(format!("those that were: {}", known.join(", "))),
        );
    }
    if fold.is_empty() || ids.iter().all(|id| fold.contains(id)) {
        return Err(Error::new(format!(
            "{} of {} configurations are to be left out, expected some but not all",
            fold.len(),
            ids.len()
        )));
    }
    Ok(())
}

/// The measurements without a fold, and those of the fold.
fn split(measurements: &Measurements, fold: &[u32]) -> (Measurements, Measurements) {
    let (left_out, rest): (Vec<Intensity>, Vec<Intensity>) = measurements
        .intensities
        .iter()
        .partition(|i| fold.contains(&i.configuration.id));
    let of = |intensities| Measurements { intensities };
    (of(rest), of(left_out))
}

/// The linear model around a fit. Rows are whitened: numbers divided by the error of each.
struct Linear {
    configurations: Vec<Configuration>,
    /// What the numbers of a configuration are divided by: its brightness times the relative error the fit shows.
    unit: Vec<f64>,
    /// By the parameters that are not on a bound, of what was measured.
    shots: Vec<Shot>,
    /// The same of all channels: a prediction is made of each.
    views: Vec<Shot>,
    n_free: usize,
    /// Rendered minus measured of both renders, not whitened.
    residuals: Vec<[[f64; CHANNELS]; 2]>,
    measured: Vec<Intensity>,
    monte_carlo_se: Vec<[f64; CHANNELS]>,
    paths: Vec<u64>,
    /// Relative error of the model, and of all numbers as the fit shows it.
    model_error: f64,
    error: f64,
    tau: f64,
}

impl Linear {
    fn new(
        scene: &dyn Scene,
        measurements: &Measurements,
        full: &FitResult,
        paths: u64,
        seed: u64,
        watch: &dyn Watch,
    ) -> Result<Self> {
        let parameters = parameters_of(scene, full)?;
        let place = Place::within(&parameters, &full.bounds)?;
        let objective = Objective::with_tau(measurements, full.tau)?;
        let configurations = objective.configurations();
        let pair = RenderPair::render(
            scene,
            &configurations,
            &parameters,
            &Effort::Paths(paths),
            seed,
            LINEAR_INDEX,
            watch,
        )?
        .scaled(full.gain_value());
        let model_error = 0.01 * full.objective.misfit_percent;
        let measured_error = 0.01 * full.objective.measurement_rms_percent;
        // Exact data would leave no room for a prior: a ten thousandth is too small to matter.
        let error = measured_error.hypot(model_error).max(1e-4);
        let unit: Vec<f64> = objective
            .intensities()
            .iter()
            .map(|i| error / relative_weight(i, full.tau).sqrt())
            .collect();
        let free: Vec<usize> = (0..place.len())
            .filter(|&j| place.u[j] > place.space.lower()[j] && place.u[j] < place.space.upper()[j])
            .collect();
        let shots_of = |counts: &dyn Fn(usize) -> [bool; CHANNELS]| -> Result<Vec<Shot>> {
            let error = |i: usize, _| counts(i).map(|c| c.then_some(unit[i]));
            let whole = Shot::of_pair(&place, &configurations, &pair, error)?;
            Ok(whole.iter().map(|shot| shot.by(&free)).collect())
        };
        let measured = objective.intensities().to_vec();
        Ok(Self {
            shots: shots_of(&|i| measured[i].present)?,
            views: shots_of(&|_| [true; CHANNELS])?,
            residuals: pair
                .estimates()
                .zip(&measured)
                .map(|([a, b], i)| [a, b].map(|e| std::array::from_fn(|c| e.mean[c] - i.mean[c])))
                .collect(),
            monte_carlo_se: pair
                .estimates()
                .map(|[a, b]| {
                    std::array::from_fn(|c| 0.5 * a.standard_error[c].hypot(b.standard_error[c]))
                })
                .collect(),
            paths: pair.estimates().map(|[a, b]| a.paths + b.paths).collect(),
            configurations,
            unit,
            n_free: free.len(),
            measured,
            model_error,
            error,
            tau: full.tau,
        })
    }

    /// What the others predict for the configurations of `fold`.
    fn predict(&self, fold: &[u32]) -> Result<Vec<Prediction>> {
        let (members, rest): (Vec<usize>, Vec<usize>) = (0..self.configurations.len())
            .partition(|&i| fold.contains(&self.configurations[i].id));
        let shots: Vec<Shot> = rest.iter().map(|&i| self.shots[i].clone()).collect();
        // Directions in which the rest says no more than the renders' noise could feign stay put.
        let seen = Seen::of(self.n_free, &shots);
        let inverse = information::covariance(&seen.information).ok_or_else(|| {
            Error::new(format!(
                "without configurations {fold:?} the linear model has no curvature"
            ))
            .with_hint("refit without --fast")
        })?;
        // Errors of the measurements that are left, on average, and of the prior.
        let mut noise = seen.information.clone();
        noise.scale(rest.iter().map(|&i| self.variance(i)).sum::<f64>() / rest.len() as f64);
        (0..self.n_free).for_each(|j| noise[(j, j)] += 1.0);
        let covariance = inverse.times_matrix(&noise).times_matrix(&inverse);
        // (1 - H)^-1 e = e + J step, with the step the others' minimum is away from the full fit's.
        let mut pull = vec![0.0; self.n_free];
        for &i in &members {
            // One render's derivatives with the other's residuals: noise does not meet itself.
            let [a, b] = self.shots[i].each();
            for (jacobian, e) in [(a, self.whitened(i, 1)), (b, self.whitened(i, 0))] {
                let half = jacobian.weighted_transpose_times(&[0.5; CHANNELS], &e);
                pull.iter_mut().zip(half).for_each(|(p, x)| *p += x);
            }
        }
        let step = seen.part_of(&inverse.times(&pull));
        Ok(members
            .iter()
            .map(|&i| self.prediction(i, &step, &covariance))
            .collect())
    }

    /// Mean whitened variance of a configuration's numbers.
    fn variance(&self, i: usize) -> f64 {
        let measured = self.measured[i].where_present(self.measured[i].standard_error);
        let (mut squares, mut n) = (0.0, 0.0);
        for se in measured.into_iter().flatten() {
            squares += (se / self.unit[i]).powi(2);
            n += 1.0;
        }
        squares / n + (self.model_error / self.error).powi(2)
    }

    /// Whitened residual of a configuration in one of the renders.
    fn whitened(&self, i: usize, which: usize) -> [f64; CHANNELS] {
        self.residuals[i][which].map(|r| r / self.unit[i])
    }

    fn prediction(&self, i: usize, step: &[f64], covariance: &Matrix) -> Prediction {
        let unit = self.unit[i];
        let moved = self.views[i].mean().times(step);
        let renders = self.residuals[i]
            .map(|r| std::array::from_fn(|c| self.measured[i].mean[c] + r[c] + unit * moved[c]));
        let [a, b] = self.views[i].each();
        let mean: [f64; CHANNELS] = std::array::from_fn(|c| 0.5 * (renders[0][c] + renders[1][c]));
        let model = self.model_error * brightness(mean, self.measured[i].present, self.tau);
        Prediction {
            configuration: self.configurations[i],
            mean,
            parameter_se: std::array::from_fn(|c| {
                unit * information::variance(covariance, a.row(c), b.row(c)).sqrt()
            }),
            monte_carlo_se: self.monte_carlo_se[i],
            model_se: [model; CHANNELS],
            renders,
            in_fit: false,
            paths: self.paths[i],
        }
    }
}
