//! All renders of a fit together as one linear model of the residuals, without bias from a render meeting itself.
//!
//! Every render `a` at search point `u_a` gives residuals `r_a` (R - M, one number per configuration and channel) and
//! their Jacobian `J_a` by `u`. With weights `v_a` (sum 1) over *different* renders a, b, which are independent,
//! ```text
//! u0 = sum_a v_a u_a
//! g0 = sum_{a != b} v_a v_b J_a' W r_b / (1 - sum v_a^2)      gradient of f/2 at u0
//! H  = sum_{a != b} v_a v_b J_a' W J_b / (1 - sum v_a^2)      Gauss-Newton curvature of f/2
//! ```
//! For one pair this is the paired gradient of [`super::Objective::gradient`] (halved). For renders at one point both are
//! unbiased; across points they are right to first order in `u_a - u0`, and the weights below keep the rest small.
//! The minimizer `u0 - H^-1 g0` is the average of iterates minus a common Newton step. The curvature leaves out the
//! second derivatives of the means, as Gauss-Newton does.

use super::gain::Prior;
use super::linear::{Matrix, dot, eigen};
use super::objective::{ChannelCorrelation, Objective, RenderPair, channel_correlation};
use super::space::SearchSpace;
use crate::scatter::{CHANNELS, Parameters};

/// By how much the curvature for a step is raised along each coordinate.
const MARQUARDT: f64 = 0.05;

/// One render, in search coordinates.
#[derive(Debug, Clone)]
struct Record {
    u: Vec<f64>,
    /// R - M per number.
    residual: Vec<f64>,
    /// Per number and flat place.
    jacobian: Matrix,
    /// Standard error of each mean.
    mean_se: Vec<f64>,
    /// Variance of each Jacobian entry.
    jacobian_variance: Matrix,
    /// Camera paths per configuration.
    paths: Vec<f64>,
}

/// The renders so far.
#[derive(Debug, Clone)]
pub(super) struct Pool {
    /// Weight of each number; 0 where nothing was measured.
    weights: Vec<f64>,
    /// How many were measured.
    n_numbers: usize,
    measured_se: Vec<f64>,
    /// Of the gain, if there is one.
    prior: Option<Prior>,
    records: Vec<Record>,
    differences: Vec<[f64; CHANNELS]>,
}

/// The linear model of a [`Pool`] around a point.
#[derive(Debug, Clone)]
pub(super) struct LinearModel {
    /// Where it is centered.
    pub(super) center: Vec<f64>,
    /// Gradient of half the objective at the center.
    pub(super) gradient: Vec<f64>,
    /// Gauss-Newton curvature of half the objective; symmetric, not necessarily positive.
    pub(super) curvature: Matrix,
    /// By how much noise would inflate the diagonal if renders met themselves: the size of what cannot be seen.
    pub(super) curvature_noise: Vec<f64>,
    /// Covariance of the gradient from Monte Carlo noise.
    pub(super) monte_carlo: Matrix,
    /// Of the gain, in gradient and curvature already.
    prior: Option<Prior>,
    /// Covariance of the gradient from measurement errors (independent numbers).
    pub(super) measurement: Matrix,
    /// Averaged Jacobian.
    pub(super) jacobian: Matrix,
    /// Weight of each number; 0 where nothing was measured.
    pub(super) weights: Vec<f64>,
    /// How many were measured.
    pub(super) n_numbers: usize,
}

/// One of the directions that diagonalize the curvature: along `step` it is `curvature`, and the curvature matrix is the
/// sum over directions of `curvature form form'`.
#[derive(Debug, Clone)]
pub(super) struct Direction {
    pub(super) curvature: f64,
    /// How much curvature noise could feign.
    pub(super) unseen: f64,
    pub(super) step: Vec<f64>,
    pub(super) form: Vec<f64>,
}

impl Pool {
    pub(super) fn new(objective: &Objective) -> Self {
        Self {
            weights: objective.weights().as_flattened().to_vec(),
            n_numbers: objective.n_numbers(),
            measured_se: objective
                .intensities()
                .iter()
                .flat_map(|i| i.standard_error)
                .collect(),
            prior: None,
            records: Vec::new(),
            differences: Vec::new(),
        }
    }

    /// The objective's weight of each number.
    pub(super) fn weights(&self) -> &[f64] {
        &self.weights
    }

    fn n_configurations(&self) -> usize {
        self.weights.len() / CHANNELS
    }

    /// Adds both renders of a pair made at `u`.
    pub(super) fn push(
        &mut self,
        space: &SearchSpace,
        u: &[f64],
        parameters: &Parameters,
        objective: &Objective,
        pair: &RenderPair,
    ) {
        let slopes = space.slopes(parameters);
        self.prior = Prior::of(space, objective);
        for which in 0..2 {
            let n = self.weights.len();
            let mut record = Record {
                u: u.to_vec(),
                residual: Vec::with_capacity(n),
                jacobian: Matrix::zeros(n, space.len()),
                mean_se: Vec::with_capacity(n),
                jacobian_variance: Matrix::zeros(n, space.len()),
                paths: Vec::with_capacity(n / CHANNELS),
            };
            for (i, (measured, e)) in objective
                .intensities()
                .iter()
                .zip(pair.render_of(which))
                .enumerate()
            {
                record.paths.push(e.paths as f64);
                for c in 0..CHANNELS {
                    record.residual.push(e.mean[c] - measured.mean[c]);
                    record.mean_se.push(e.standard_error[c]);
                    if let Some(Prior { place, .. }) = self.prior {
                        let number = (CHANNELS * i + c, place);
                        record.jacobian[number] = e.mean[c];
                        record.jacobian_variance[number] = e.standard_error[c].powi(2);
                    }
                    for row in 0..parameters.infos().len() {
                        let (m, j) = (CHANNELS * i + c, parameters.slot(row, c));
                        record.jacobian[(m, j)] = e.derivative[row][c] * slopes[j];
                        record.jacobian_variance[(m, j)] =
                            (e.derivative_se[row][c] * slopes[j]).powi(2);
                    }
                }
            }
            self.records.push(record);
        }
        self.differences.extend(pair.standardized_differences());
    }

    /// Forgets all but the latest `pairs`.
    pub(super) fn keep_latest(&mut self, pairs: usize) {
        let excess = self.records.len().saturating_sub(2 * pairs);
        self.records.drain(..excess);
    }

    /// The model of all renders, each counting by its paths. They must have been made near each other.
    pub(super) fn model(&self) -> LinearModel {
        let paths = |r: &Record| r.paths.iter().sum::<f64>();
        let all: f64 = self.records.iter().map(paths).sum();
        let v: Vec<f64> = self.records.iter().map(|r| paths(r) / all).collect();
        self.assemble(&v)
    }

    /// The model with the given weights over records.
    fn assemble(&self, v: &[f64]) -> LinearModel {
        let weights = self.weights.clone();
        let (n, p) = (self.weights.len(), self.records[0].u.len());
        let mut center = vec![0.0; p];
        let mut residual = vec![0.0; n];
        let mut jacobian = Matrix::zeros(n, p);
        let mut self_gradient = vec![0.0; p];
        let mut self_curvature = Matrix::zeros(p, p);
        let mut curvature_noise = vec![0.0; p];
        for (record, &v) in self.records.iter().zip(v).filter(|(_, v)| **v > 0.0) {
            let w = &weights;
            add(&mut center, v, &record.u);
            add(&mut residual, v, &record.residual);
            jacobian.add_scaled(v, &record.jacobian);
            let own = record
                .jacobian
                .weighted_transpose_times(w, &record.residual);
            add(&mut self_gradient, v * v, &own);
            self_curvature.add_scaled(v * v, &record.jacobian.weighted_gram(w, &record.jacobian));
            for m in 0..n {
                for (j, noise) in curvature_noise.iter_mut().enumerate() {
                    *noise += v * v * w[m] * record.jacobian_variance[(m, j)];
                }
            }
        }
        let pairs = 1.0 - v.iter().map(|v| v * v).sum::<f64>();
        let mut gradient = jacobian.weighted_transpose_times(&weights, &residual);
        add(&mut gradient, -1.0, &self_gradient);
        gradient.iter_mut().for_each(|g| *g /= pairs);
        let mut curvature = jacobian.weighted_gram(&weights, &jacobian);
        curvature.add_scaled(-1.0, &self_curvature);
        curvature.scale(1.0 / pairs);
        let squared: Vec<f64> = (0..n)
            .map(|m| (weights[m] * self.measured_se[m]).powi(2))
            .collect();
        let measurement = jacobian.weighted_gram(&squared, &jacobian);
        if let Some(prior) = self.prior {
            let j = prior.place;
            gradient[j] += prior.curvature * center[j];
            curvature[(j, j)] += prior.curvature;
        }
        LinearModel {
            monte_carlo: self.gradient_noise(v, &weights, &jacobian, &residual),
            measurement,
            prior: self.prior,
            center,
            gradient,
            curvature: curvature.symmetrized(),
            curvature_noise,
            jacobian,
            weights,
            n_numbers: self.n_numbers,
        }
    }

    /// Covariance of the weighted gradient, to first order in the noise: `J' W S W J` of the means' noise (channels of a
    /// configuration correlated) plus the Jacobian's own noise times the residual.
    fn gradient_noise(
        &self,
        v: &[f64],
        weights: &[f64],
        jacobian: &Matrix,
        residual: &[f64],
    ) -> Matrix {
        let p = jacobian.n_columns();
        let rho = self.channel_correlation();
        let variances = self.path_variances();
        let mut noise = Matrix::zeros(p, p);
        for i in 0..self.n_configurations() {
            let per_path: f64 = self
                .records
                .iter()
                .zip(v)
                .map(|(r, v)| v * v / r.paths[i])
                .sum();
            for c in 0..CHANNELS {
                for d in 0..CHANNELS {
                    let (m, k) = (CHANNELS * i + c, CHANNELS * i + d);
                    let s = per_path * (variances[m] * variances[k]).sqrt();
                    let s = s * rho[c][d] * weights[m] * weights[k];
                    for j in 0..p {
                        for l in 0..p {
                            noise[(j, l)] += jacobian[(m, j)] * s * jacobian[(k, l)];
                        }
                    }
                }
                let m = CHANNELS * i + c;
                let wr = (weights[m] * residual[m]).powi(2);
                for j in 0..p {
                    let own = self
                        .records
                        .iter()
                        .zip(v)
                        .map(|(r, v)| v * v * r.jacobian_variance[(m, j)]);
                    noise[(j, j)] += wr * own.sum::<f64>();
                }
            }
        }
        noise
    }

    /// Variance of one path's contribution to each number, pooled over all renders.
    fn path_variances(&self) -> Vec<f64> {
        (0..self.weights.len())
            .map(|m| {
                let i = m / CHANNELS;
                let paths: f64 = self.records.iter().map(|r| r.paths[i]).sum();
                let squares = self
                    .records
                    .iter()
                    .map(|r| (r.paths[i] * r.mean_se[m]).powi(2));
                squares.sum::<f64>() / paths
            })
            .collect()
    }

    /// The channels' error correlation over all pairs so far.
    pub(super) fn channel_correlation(&self) -> ChannelCorrelation {
        channel_correlation(self.differences.iter().copied())
    }

    /// How the next paths are best shared over configurations: Neyman's rule for the weighted squared error of the
    /// *fitted* means, `n_i` in proportion to `sqrt(sum_c w_i s_ic^2 h_ic)`, with `s_ic` the per-path standard
    /// deviation seen so far and `h_ic` the leverage `w_i J_ic H^-1 J_ic'`. Every configuration gets at least a quarter
    /// of an equal share, because a rare contribution may not have been seen yet.
    /// Without a curvature all numbers count alike (for judging, not for fitting).
    pub(super) fn shares(
        &self,
        model: &LinearModel,
        inverse_curvature: Option<&Matrix>,
    ) -> Vec<f64> {
        let n = self.n_configurations();
        let variances = self.path_variances();
        let raw: Vec<f64> = (0..n)
            .map(|i| {
                (0..CHANNELS)
                    .map(|c| {
                        let m = CHANNELS * i + c;
                        let row = model.jacobian.row(m);
                        let leverage = inverse_curvature
                            .map_or(1.0, |inverse| self.weights[m] * inverse.form(row, row));
                        self.weights[m] * variances[m] * (leverage.clamp(0.0, 1.0) + 0.05)
                    })
                    .sum::<f64>()
                    .sqrt()
            })
            .collect();
        let mean = raw.iter().sum::<f64>() / n as f64;
        if !(mean > 0.0 && mean.is_finite()) {
            return vec![1.0; n];
        }
        raw.iter().map(|x| 0.25 + 0.75 * x / mean).collect()
    }
}

fn add(sum: &mut [f64], factor: f64, x: &[f64]) {
    for (s, x) in sum.iter_mut().zip(x) {
        *s += factor * x;
    }
}

impl LinearModel {
    /// Gradient of half the objective at `u`.
    pub(super) fn gradient_at(&self, u: &[f64], curvature: &Matrix) -> Vec<f64> {
        let offset: Vec<f64> = u.iter().zip(&self.center).map(|(a, b)| a - b).collect();
        curvature
            .times(&offset)
            .iter()
            .zip(&self.gradient)
            .map(|(a, b)| a + b)
            .collect()
    }

    /// Unit lengths in which the curvature's noise is about the same along every axis. Without them a precisely known
    /// parameter would share its eigenvectors, and their damping, with a noisy one.
    fn scales(&self) -> Vec<f64> {
        let p = self.curvature.n_rows();
        let largest = (0..p).fold(0.0_f64, |m, j| m.max(self.curvature[(j, j)]));
        (0..p)
            .map(|j| {
                let floor = 1e-4 * self.curvature[(j, j)].max(0.0) + 1e-9 * largest + 1e-30;
                (self.curvature_noise[j] + floor).sqrt().recip()
            })
            .collect()
    }

    /// Eigenvectors of the curvature in the unit lengths of [`LinearModel::scales`].
    fn directions(&self, scales: &[f64]) -> Vec<Direction> {
        let p = scales.len();
        let mut scaled = Matrix::zeros(p, p);
        for i in 0..p {
            for j in 0..p {
                scaled[(i, j)] = scales[i] * self.curvature[(i, j)] * scales[j];
            }
        }
        eigen(&scaled)
            .into_iter()
            .map(|(curvature, vector)| {
                let step: Vec<f64> = vector.iter().zip(scales).map(|(e, s)| e * s).collect();
                let noise = |(x, b): (&f64, &f64)| x * x * b;
                Direction {
                    curvature,
                    unseen: step.iter().zip(&self.curvature_noise).map(noise).sum(),
                    form: vector.iter().zip(scales).map(|(e, s)| e / s).collect(),
                    step,
                }
            })
            .collect()
    }

    /// The curvature for a step: the Gram matrix of the averaged Jacobian, which noise can only enlarge, with its diagonal
    /// raised a little (Marquardt 1963).
    pub(super) fn marquardt_curvature(&self) -> Matrix {
        let mut curvature = self.jacobian.weighted_gram(&self.weights, &self.jacobian);
        if let Some(prior) = self.prior {
            curvature[(prior.place, prior.place)] += prior.curvature;
        }
        for j in 0..curvature.n_rows() {
            curvature[(j, j)] = (1.0 + MARQUARDT) * curvature[(j, j)] + 1e-12;
        }
        curvature
    }

    /// The curvature made safely positive for a step. Along a direction of curvature l, with unseen curvature b and
    /// Newton step of standard deviation s, it is `l [1 + (2 b / l)^2 + (s / reach)^2]`: a step is shortened as the best
    /// linear guess of a distance of size `reach` would be, and a direction lost in noise keeps its place.
    pub(super) fn damped_curvature(&self, reach: f64) -> Matrix {
        let p = self.curvature.n_rows();
        let scales = self.scales();
        let directions = self.directions(&scales);
        let largest = directions.iter().fold(0.0_f64, |m, d| m.max(d.curvature));
        let mut damped = Matrix::zeros(p, p);
        for d in &directions {
            let l = d
                .curvature
                .max(0.1 * d.unseen)
                .max(1e-9 * largest)
                .max(1e-12);
            let variance = self.monte_carlo.form(&d.step, &d.step).max(0.0) / (l * l);
            let length = dot(&d.step, &d.step);
            let noise = (2.0 * d.unseen / l).powi(2) + variance * length / (reach * reach);
            let safe = l.max(d.unseen) * (1.0 + noise);
            for i in 0..p {
                for j in 0..p {
                    damped[(i, j)] += safe * d.form[i] * d.form[j];
                }
            }
        }
        damped
    }

    /// The directions along which the data, without any prior, see the curvature: more than three times what noise could feign.
    pub(super) fn seen_directions(&self) -> Vec<Direction> {
        if let Some(prior) = self.prior {
            let mut data = self.clone();
            data.prior = None;
            data.curvature[(prior.place, prior.place)] -= prior.curvature;
            return data.seen_directions();
        }
        let directions = self.directions(&self.scales());
        let largest = directions.iter().fold(0.0_f64, |m, d| m.max(d.curvature));
        directions
            .into_iter()
            .filter(|d| d.curvature > (3.0 * d.unseen).max(1e-9 * largest))
            .collect()
    }

    /// The weighted rms change of the fitted means per number that gradient noise of covariance `noise` causes through
    /// the step `H^-1`: `sqrt(tr(J' W J H^-1 noise H^-1) / n)`, with the objective's own weights W.
    pub(super) fn fitted_rms(
        &self,
        inverse_curvature: &Matrix,
        noise: &Matrix,
        objective_weights: &[f64],
    ) -> f64 {
        let p = noise.n_rows();
        let gram = self
            .jacobian
            .weighted_gram(objective_weights, &self.jacobian);
        let columns = |j: usize| -> Vec<f64> { inverse_curvature.row(j).to_vec() };
        let trace: f64 = (0..p)
            .flat_map(|i| (0..p).map(move |j| (i, j)))
            .map(|(i, j)| gram[(i, j)] * noise.form(&columns(i), &columns(j)))
            .sum();
        (trace.max(0.0) / self.n_numbers as f64).sqrt()
    }
}
