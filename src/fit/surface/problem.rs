//! The least squares behind a fit of a reflectance model.

use crate::base::{Error, Result};
use crate::fit::TAU;
use crate::fit::linear::{Matrix, box_quadratic};
use crate::scatter::surface::SurfaceModel;
use crate::scatter::{CHANNELS, Parameters};
use crate::session::{Configuration, Measurements};
use glam::DVec3;
use std::f64::consts::PI;

/// One configuration.
struct Sample {
    wi: DVec3,
    wr: DVec3,
    /// Normalized radiance over BRDF: `pi cos(theta_i)`.
    factor: f64,
    mean: [f64; CHANNELS],
    /// Square root of the weight; 0 where a channel was not measured.
    root_weight: [f64; CHANNELS],
}

/// Measurements and a model to fit to them.
pub(super) struct Problem<'a> {
    pub(super) model: &'a dyn SurfaceModel,
    samples: Vec<Sample>,
    /// (row, channel) of each flat place.
    pub(super) places: Vec<(usize, usize)>,
    pub(super) lower: Vec<f64>,
    pub(super) upper: Vec<f64>,
    /// Places of colors.
    pub(super) linear: Vec<usize>,
    /// Places of everything else.
    pub(super) shape: Vec<usize>,
    /// Numbers measured.
    pub(super) n: usize,
    /// Numbers measured at distinct geometries.
    pub(super) n_distinct: usize,
}

/// Residuals and their derivatives at one set of parameters.
pub(super) struct Linearized {
    /// Sum of squares.
    pub(super) objective: f64,
    /// Half the gradient and half the Hessian (Gauss and Newton) of the sum of squares.
    pub(super) gradient: Vec<f64>,
    pub(super) hessian: Matrix,
}

impl<'a> Problem<'a> {
    /// The problem with parameters named in `held` fixed.
    pub(super) fn new(
        model: &'a dyn SurfaceModel,
        measurements: &Measurements,
        held: &[(String, f64)],
    ) -> Result<Self> {
        let defaults = Parameters::defaults(model);
        let places = defaults.places();
        let infos = model.parameters();
        let mut lower: Vec<f64> = places.iter().map(|&(r, _)| infos[r].lower).collect();
        let mut upper: Vec<f64> = places.iter().map(|&(r, _)| infos[r].upper).collect();
        for (name, value) in held {
            let row = infos.iter().position(|p| p.name == name);
            let Some(row) = row.filter(|&r| !infos[r].per_channel) else {
                let known: Vec<_> = infos
                    .iter()
                    .filter(|p| !p.per_channel)
                    .map(|p| p.name)
                    .collect();
                return Err(
                    Error::new(format!("{}: no parameter '{name}' to hold", model.name()))
                        .with_hint(format!("it has {}", known.join(", "))),
                );
            };
            if !(infos[row].lower..=infos[row].upper).contains(value) {
                return Err(Error::new(format!(
                    "{}: '{name}' held at {value}, expected {} to {} (radians for angles)",
                    model.name(),
                    infos[row].lower,
                    infos[row].upper
                )));
            }
            let place = defaults.slot(row, 0);
            (lower[place], upper[place]) = (*value, *value);
        }
        let samples = samples(measurements);
        let of_kind = |per_channel: bool| -> Vec<usize> {
            let is = |p: &usize| infos[places[*p].0].per_channel == per_channel;
            (0..places.len()).filter(is).collect()
        };
        let (linear, shape) = (of_kind(true), of_kind(false));
        let n = measurements.n_numbers();
        let n_distinct = distinct(measurements);
        let problem = Self {
            model,
            samples,
            linear,
            shape,
            lower,
            upper,
            places,
            n,
            n_distinct,
        };
        let free = problem.n_free();
        if problem.n_distinct <= free + 2 {
            return Err(Error::new(format!(
                "{}: {free} parameters, but {n_distinct} numbers at distinct geometries: expected at least {}",
                model.name(),
                free + 3
            ))
            .with_hint("a simpler model, more poses, or parameters held fixed"));
        }
        Ok(problem)
    }

    /// Parameters that may move.
    pub(super) fn n_free(&self) -> usize {
        (0..self.lower.len())
            .filter(|&k| self.lower[k] < self.upper[k])
            .count()
    }

    pub(super) fn parameters(&self, x: &[f64]) -> Parameters {
        Parameters::defaults(self.model).with_values(x.to_vec())
    }

    /// Chooses the colors in `x` by least squares within their bounds, and returns the sum of squares; infinite where the model has no
    /// meaning.
    pub(super) fn choose_colors(&self, x: &mut [f64]) -> f64 {
        // Derivatives by colors do not depend on them.
        let Ok(surface) = self.model.prepare(&self.parameters(x)) else {
            return f64::INFINITY;
        };
        let evaluations: Vec<_> = self
            .samples
            .iter()
            .map(|s| surface.colors(s.wi, s.wr))
            .collect();
        let mut objective = 0.0;
        for channel in 0..CHANNELS {
            let mine: Vec<usize> = self
                .linear
                .iter()
                .copied()
                .filter(|&p| self.places[p].1 == channel)
                .collect();
            let k = mine.len();
            let mut h = Matrix::zeros(k, k);
            let mut g = vec![0.0; k];
            let mut constant = 0.0;
            for (s, basis) in self.samples.iter().zip(&evaluations) {
                let w = s.root_weight[channel] * s.root_weight[channel];
                constant += w * s.mean[channel] * s.mean[channel];
                let column = |j: usize| s.factor * basis[self.places[mine[j]].0];
                for a in 0..k {
                    g[a] -= w * column(a) * s.mean[channel];
                    for b in 0..k {
                        h[(a, b)] += w * column(a) * column(b);
                    }
                }
            }
            for a in 0..k {
                h[(a, a)] = h[(a, a)] * (1.0 + 1e-10) + 1e-12;
            }
            let bound = |of: &[f64]| -> Vec<f64> { mine.iter().map(|&p| of[p]).collect() };
            let found = box_quadratic(&h, &g, &bound(&self.lower), &bound(&self.upper));
            objective += constant + h.form(&found, &found);
            objective += 2.0 * g.iter().zip(&found).map(|(g, c)| g * c).sum::<f64>();
            for (j, &p) in mine.iter().enumerate() {
                x[p] = found[j];
            }
        }
        objective
    }

    /// Weighted means over the channels that were measured.
    pub(super) fn gray(&self) -> Vec<f64> {
        let mean = |s: &Sample| {
            let seen = s.root_weight.iter().filter(|w| **w > 0.0).count().max(1);
            (0..CHANNELS)
                .map(|c| s.root_weight[c] * s.mean[c])
                .sum::<f64>()
                / seen as f64
        };
        self.samples.iter().map(mean).collect()
    }

    /// What the colors of three rows are multiplied by in every configuration, weighted alike; none where the model has no meaning.
    pub(super) fn parts(&self, x: &[f64], rows: [usize; 3]) -> Option<[Vec<f64>; 3]> {
        let surface = self.model.prepare(&self.parameters(x)).ok()?;
        let weighted = |s: &Sample| {
            let root = s.root_weight.into_iter().fold(0.0, f64::max);
            let colors = surface.colors(s.wi, s.wr);
            rows.map(|r| root * s.factor * colors[r])
        };
        let all: Vec<[f64; 3]> = self.samples.iter().map(weighted).collect();
        Some(std::array::from_fn(|k| all.iter().map(|v| v[k]).collect()))
    }

    /// Residuals and derivatives at `x`; none where the model has no meaning.
    pub(super) fn linearize(&self, x: &[f64]) -> Option<Linearized> {
        let surface = self.model.prepare(&self.parameters(x)).ok()?;
        let k = x.len();
        let mut out = Linearized {
            objective: 0.0,
            gradient: vec![0.0; k],
            hessian: Matrix::zeros(k, k),
        };
        let mut row = vec![0.0; k];
        for s in &self.samples {
            let e = surface.evaluate(s.wi, s.wr);
            for c in (0..CHANNELS).filter(|&c| s.root_weight[c] > 0.0) {
                let scale = s.root_weight[c] * s.factor;
                let residual = scale * e.value[c] - s.root_weight[c] * s.mean[c];
                for (slope, &(r, channel)) in row.iter_mut().zip(&self.places) {
                    let mine = !self.model.parameters()[r].per_channel || channel == c;
                    *slope = if mine {
                        scale * e.derivative[r][c]
                    } else {
                        0.0
                    };
                }
                out.objective += residual * residual;
                for a in 0..k {
                    if row[a] == 0.0 {
                        continue;
                    }
                    out.gradient[a] += row[a] * residual;
                    for b in 0..=a {
                        out.hessian[(a, b)] += row[a] * row[b];
                    }
                }
            }
        }
        for a in 0..k {
            for b in 0..a {
                out.hessian[(b, a)] = out.hessian[(a, b)];
            }
        }
        Some(out)
    }

    /// Weighted rms residual of a sum of squares.
    pub(super) fn rms(&self, objective: f64) -> f64 {
        (objective.max(0.0) / self.n as f64).sqrt()
    }
}

fn samples(measurements: &Measurements) -> Vec<Sample> {
    let sample = |i: &crate::session::Intensity| {
        let wi = i.configuration.light_in_sample().vector();
        let seen = i.present.iter().filter(|p| **p).count().max(1);
        let i0 = i.cleared();
        let brightness = i0.mean.iter().sum::<f64>() / seen as f64;
        Sample {
            wi,
            wr: i.configuration.camera_in_sample().vector(),
            factor: PI * wi.z,
            mean: i0.mean,
            root_weight: i
                .present
                .map(|p| if p { 1.0 / brightness.max(TAU) } else { 0.0 }),
        }
    };
    measurements.intensities.iter().map(sample).collect()
}

/// What an isotropic sample would see of a pose: polar angles of light and camera, exchanged or not, and the angle between their
/// azimuths, in steps of 1e-5.
pub(in crate::fit) fn geometry(configuration: &Configuration) -> [i64; 3] {
    let (light, camera) = (configuration.light, configuration.camera);
    let grid = |angle: f64| (angle * 1e5).round() as i64;
    let low = light.theta.min(camera.theta);
    let high = light.theta.max(camera.theta);
    let between = (light.phi - camera.phi).rem_euclid(2.0 * PI);
    [grid(low), grid(high), grid(between.min(2.0 * PI - between))]
}

/// Numbers at distinct geometries. Turned samples show the same geometry again, and count once.
pub(in crate::fit) fn distinct(measurements: &Measurements) -> usize {
    let mut seen: Vec<[i64; 3]> = Vec::new();
    let mut n = 0;
    for i in &measurements.intensities {
        let key = geometry(&i.configuration);
        if !seen.contains(&key) {
            seen.push(key);
            n += i.present.iter().filter(|p| **p).count();
        }
    }
    n
}
