//! A scale error common to all measurements: `measured = g rendered`, one unknown more.
//!
//! ln g is one more coordinate of the search, after the model's, with a normal prior of mean 0 and standard deviation s. Were
//! the numbers' errors a common relative error e of the brightness, minus twice the logarithm of the posterior density would
//! be `f / e^2 + (ln g)^2 / s^2`, f the objective, a *relative squared* error. So the prior adds `e^2 (ln g)^2 / s^2` to f: a
//! datum of value 0 and weight `e^2 / s^2`, with `e^2 = sum w se^2 / n` from the measurements' standard errors (no less than
//! a ten thousandth squared). Model errors are not in e: where they are larger than e the data pull at the gain more, and the
//! prior less, than they should. Renders are multiplied by g before anything else sees them.

use super::certainty::three_digits;
use super::objective::{Objective, RenderPair};
use super::result::GainResult;
use super::space::SearchSpace;
use super::uncertainty::Samples;
use crate::scatter::CHANNELS;

/// Least relative error of the data.
const LEAST_ERROR: f64 = 1e-4;
/// A gain this many prior standard deviations from 1 is no scale error.
const FAR: f64 = 3.0;

/// The prior as a datum of half the objective.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Prior {
    /// The gain's coordinate.
    pub(super) place: usize,
    /// Curvature `e^2 / s^2`.
    pub(super) curvature: f64,
}

impl Prior {
    /// That of a fit; none without a gain.
    pub(super) fn of(space: &SearchSpace, objective: &Objective) -> Option<Self> {
        let (place, sd) = space.gain()?;
        let squares = objective.measurement_sum() / objective.n_numbers() as f64;
        let e2 = squares.max(LEAST_ERROR * LEAST_ERROR);
        Some(Self {
            place,
            curvature: e2 / (sd * sd),
        })
    }
}

/// Derivative of the objective and the prior by ln g, unbiased; none without a gain. The pair has the gain in it.
pub(super) fn gradient(
    space: &SearchSpace,
    objective: &Objective,
    u: &[f64],
    pair: &RenderPair,
) -> Option<f64> {
    let prior = Prior::of(space, objective)?;
    let rows = objective.intensities().iter().zip(objective.weights());
    let of_data = rows.zip(pair.estimates()).map(|((i, w), [a, b])| {
        let of = |c: usize| {
            w[c] * ((a.mean[c] - i.mean[c]) * b.mean[c] + (b.mean[c] - i.mean[c]) * a.mean[c])
        };
        (0..CHANNELS).map(of).sum::<f64>()
    });
    Some(of_data.sum::<f64>() + 2.0 * prior.curvature * u[prior.place])
}

/// What is known of the gain; none when it was not fitted.
pub(super) fn result(space: &SearchSpace, u: &[f64], samples: &Samples) -> Option<GainResult> {
    let (place, prior_sd) = space.gain()?;
    let value = u[place].exp();
    let interval = |level: f64| {
        samples
            .interval(space, place, level, u[place])
            .map(f64::exp)
    };
    let interval_95 = interval(0.95);
    let [low, high] = interval_95.map(three_digits);
    let off = u[place].abs() / prior_sd;
    let doubt = if off > FAR {
        format!(
            "; it is {off:.1} prior standard deviations from 1 and takes up what is not a scale error"
        )
    } else {
        String::new()
    };
    Some(GainResult {
        value,
        prior_sd,
        standard_error: value * samples.standard_error(place),
        interval_68: interval(0.68),
        interval_95,
        sentence: format!(
            "all measurements are {} times what the renders show ({low}-{high} at 95 %; prior 1 +- {:.1} %): a gain of the \
             session, not a parameter of the model{doubt}",
            three_digits(value),
            100.0 * prior_sd
        ),
    })
}
