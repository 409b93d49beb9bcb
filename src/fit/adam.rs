//! Adam (Kingma and Ba 2015, algorithm 1) on the paired gradients, a baseline beside Gauss-Newton and the published
//! descent.
//!
//! Moves in the coordinates of [`SearchSpace`]; each step is projected into the bounds. The step size falls as
//! `rate / sqrt(t)`, as in the paper's proof of convergence (theorem 4.1). The gradient is unbiased; the running mean of
//! its squares is too large by its variance, which shortens steps and turns none around. Does not restart.
//!
//! [`SearchSpace`]: super::space::SearchSpace

use super::gain;
use super::gradient::Walk;
use super::search::{Found, Problem, Spent};
use crate::base::{Error, Result, Watch};

/// Pair indices of the iterations begin here.
const ITERATION_INDEX: u64 = 3 << 32;

/// What may be asked of Adam.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamOptions {
    /// Step size at t = 1, in search coordinates (logarithms of widths, softened logits of colors): 0.3. It falls as
    /// `1 / sqrt(t)`.
    pub rate: f64,
    /// How many steps: 200.
    pub iterations: u32,
    /// Decay of the running means of the gradient and of its square: 0.9 and 0.99. The published 0.999 remembers the
    /// steep first gradients for longer than 200 steps.
    pub beta: [f64; 2],
    /// Added to the root of the mean square: 1e-8.
    pub epsilon: f64,
}

impl Default for AdamOptions {
    fn default() -> Self {
        Self {
            rate: 0.3,
            iterations: 200,
            beta: [0.9, 0.99],
            epsilon: 1e-8,
        }
    }
}

impl AdamOptions {
    pub(super) fn check(&self) -> Result<()> {
        let fault = if !(1e-9..1e9).contains(&self.rate) {
            "the step size must be a positive number"
        } else if self.iterations == 0 {
            "at least one iteration is needed"
        } else if !self.beta.iter().all(|b| (0.0..1.0).contains(b)) {
            "both decays must be at least 0 and less than 1"
        } else if !(f64::MIN_POSITIVE..1.0).contains(&self.epsilon) {
            "epsilon must be a small positive number"
        } else {
            return Ok(());
        };
        Err(Error::new(format!("adam: {fault}")))
    }
}

/// The running means.
#[derive(Debug, Clone)]
struct Memory {
    options: AdamOptions,
    t: i32,
    gradient: Vec<f64>,
    square: Vec<f64>,
}

impl Memory {
    fn new(options: AdamOptions, n: usize) -> Self {
        Self {
            options,
            t: 0,
            gradient: vec![0.0; n],
            square: vec![0.0; n],
        }
    }

    /// Takes in a gradient. Returns the step, and by how much it changes with this gradient.
    fn step(&mut self, gradient: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let AdamOptions {
            rate,
            beta: [b1, b2],
            epsilon,
            ..
        } = self.options;
        self.t += 1;
        let [c1, c2] = [1.0 - b1.powi(self.t), 1.0 - b2.powi(self.t)];
        let rate = rate / f64::from(self.t).sqrt();
        let (mut steps, mut gains) = (Vec::new(), Vec::new());
        for (j, g) in gradient.iter().enumerate() {
            self.gradient[j] = b1 * self.gradient[j] + (1.0 - b1) * g;
            self.square[j] = b2 * self.square[j] + (1.0 - b2) * g * g;
            let gain = rate / c1 / ((self.square[j] / c2).sqrt() + epsilon);
            steps.push(-gain * self.gradient[j]);
            gains.push((1.0 - b1) * gain);
        }
        (steps, gains)
    }
}

/// Runs Adam from `start`; the second answer says in words what was done.
///
/// # Errors
/// When a render fails, the budget is too small, or the fit is interrupted before the first iteration.
pub(super) fn search(
    problem: &Problem<'_>,
    start: &[f64],
    spent: &mut Spent,
    watch: &dyn Watch,
) -> Result<(Found, String)> {
    let options = problem.options.adam;
    let (space, objective) = (problem.space, problem.objective);
    let mut walk = Walk::new(problem, start, f64::from(options.iterations), spent, watch)?;
    let mut memory = Memory::new(options, start.len());
    let mut u = start.to_vec();
    for k in 0..options.iterations {
        let Some(pair) = walk.render(&u, 1.0, ITERATION_INDEX + u64::from(k))? else {
            break;
        };
        let parameters = space.to_parameters(&u);
        let slopes = space.slopes(&parameters);
        let gradient: Vec<f64> = objective
            .gradient(&pair, &parameters)
            .iter()
            .zip(&slopes)
            .map(|(g, slope)| g * slope)
            .chain(gain::gradient(space, objective, &u, &pair))
            .collect();
        let (step, gains) = memory.step(&gradient);
        walk.record(&u, &pair, &gains);
        let moved: Vec<f64> = u.iter().zip(&step).map(|(u, d)| u + d).collect();
        u = space.clamped(&moved);
    }
    let note = format!(
        "Adam: {} of {} iterations of {}",
        walk.n_recorded(),
        options.iterations,
        walk.cost_in_words()
    );
    Ok((walk.finish(u)?, note))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn memory(options: AdamOptions) -> Memory {
        Memory::new(options, 2)
    }

    #[test]
    fn the_first_step_has_the_rates_size_against_the_gradients_sign() {
        let (step, _) = memory(AdamOptions::default()).step(&[1e-3, -40.0]);
        for (found, expected) in step.iter().zip([-0.3, 0.3]) {
            assert!((found - expected).abs() < 1e-5, "{step:?}");
        }
    }

    #[test]
    fn two_steps_follow_algorithm_1() {
        let options = AdamOptions {
            beta: [0.9, 0.999],
            rate: 0.1,
            ..AdamOptions::default()
        };
        let mut memory = memory(options);
        let _ = memory.step(&[2.0, 0.0]);
        let (step, gains) = memory.step(&[-1.0, 0.0]);
        // m = 0.9 * 0.2 - 0.1 = 0.08, corrected by 0.19; v = 0.999 * 0.004 + 0.001 = 0.004996, corrected by 0.001999.
        let expected = -0.1 / 2.0_f64.sqrt() * (0.08 / 0.19) / (0.004_996_f64 / 0.001_999).sqrt();
        assert!((step[0] - expected).abs() < 1e-9, "{step:?} {expected}");
        assert!(step[1].abs() < 1e-300, "{step:?}");
        // With this gradient alone the step would be its gain times it, reversed.
        assert!((gains[0] - 1.25 * step[0].abs()).abs() < 1e-9, "{gains:?}");
    }

    #[test]
    fn senseless_options_are_refused() {
        let good = AdamOptions::default();
        assert!(good.check().is_ok());
        let bad = [
            AdamOptions {
                rate: f64::NAN,
                ..good
            },
            AdamOptions {
                iterations: 0,
                ..good
            },
            AdamOptions {
                beta: [0.9, 1.0],
                ..good
            },
            AdamOptions {
                epsilon: 0.0,
                ..good
            },
        ];
        for options in bad {
            assert!(options.check().is_err(), "{options:?}");
        }
    }
}
