//! What a pose says about the parameters: Fisher information from pairs of renders, without bias.
//!
//! Everything is in units of a weak prior: search coordinates divided by the standard deviation of a parameter of which
//! nothing is known but its bounds (`range / sqrt 12`), so that prior is the unit matrix and every variance is finite.
//! With J the Jacobian of a pose's three means in those units and s their errors, the information is `J' S^-2 J`. Two
//! renders a and b that share no random number give `(Ja' S^-2 Jb + Jb' S^-2 Ja) / 2`: unbiased, where the square of one
//! render's Jacobian would count its noise as knowledge. Knows no second derivatives: what it says holds near the fit.

use super::bounds::Bounds;
use super::linear::{Matrix, dot, eigen, inverse};
use super::objective::RenderPair;
use super::space::SearchSpace;
use crate::base::{Error, Result};
use crate::render::Estimate;
use crate::scatter::{CHANNELS, Parameters};
use crate::session::Configuration;
use glam::DVec3;

/// Parameters' place in their box, and what a coordinate is measured in.
#[derive(Debug, Clone)]
pub(super) struct Place {
    pub(super) space: SearchSpace,
    pub(super) u: Vec<f64>,
    /// Standard deviation of a uniform number between the bounds, in search coordinates.
    unit: Vec<f64>,
    /// From derivatives by the flat values to those by coordinates in their units.
    slopes: Vec<f64>,
    parameters: Parameters,
}

impl Place {
    /// The place of `parameters`.
    ///
    /// # Errors
    /// When a value is outside its bounds.
    pub(super) fn new(parameters: &Parameters) -> Result<Self> {
        Self::within(parameters, &Bounds::default())
    }

    /// The same in the smaller box of narrower bounds.
    ///
    /// # Errors
    /// As [`Place::new`], and when the bounds are not those of the model.
    pub(super) fn within(parameters: &Parameters, bounds: &Bounds) -> Result<Self> {
        let space = SearchSpace::new(parameters)?.within(bounds)?;
        let u = space.to_search(parameters)?;
        let parameters = space.to_parameters(&u);
        let width = |(high, low): (&f64, &f64)| (high - low) / 12.0_f64.sqrt();
        let unit: Vec<f64> = space.upper().iter().zip(space.lower()).map(width).collect();
        let per_unit = |(s, unit): (f64, &f64)| s * unit;
        Ok(Self {
            slopes: space
                .slopes(&parameters)
                .into_iter()
                .zip(&unit)
                .map(per_unit)
                .collect(),
            u,
            unit,
            space,
            parameters,
        })
    }

    /// How many flat places there are.
    pub(super) fn len(&self) -> usize {
        self.unit.len()
    }

    /// Units in search coordinates.
    pub(super) fn units(&self) -> &[f64] {
        &self.unit
    }

    /// The Jacobian of one configuration's means, rows divided by `per`.
    pub(super) fn jacobian(&self, e: &Estimate, per: [f64; CHANNELS]) -> Matrix {
        self.spread(|row, c| e.derivative[row][c], per)
    }

    /// The same of anything that is known by parameter row and channel.
    fn spread(&self, of: impl Fn(usize, usize) -> f64, per: [f64; CHANNELS]) -> Matrix {
        let mut jacobian = Matrix::zeros(CHANNELS, self.len());
        for row in 0..self.parameters.infos().len() {
            for c in 0..CHANNELS {
                let j = self.parameters.slot(row, c);
                jacobian[(c, j)] = of(row, c) * self.slopes[j] / per[c];
            }
        }
        jacobian
    }

    /// A precision in search coordinates from an information in units.
    pub(super) fn precision(&self, information: &Matrix) -> Matrix {
        let mut precision = information.clone();
        for i in 0..self.len() {
            for j in 0..self.len() {
                precision[(i, j)] /= self.unit[i] * self.unit[j];
            }
        }
        precision
    }
}

/// The Jacobians of one pose by two independent renders, each row divided by the error of its number.
#[derive(Debug, Clone)]
pub(super) struct Shot {
    /// Shots seen from one direction share camera paths: their noise is not independent.
    toward_camera: DVec3,
    jacobians: [Matrix; 2],
    /// Standard error of each entry in one render.
    noise: Matrix,
}

impl Shot {
    /// One shot per configuration of a pair; `error` gives each number's standard error from its configuration's index and
    /// rendered means, none of a channel that is not measured: it says nothing.
    ///
    /// # Errors
    /// When an error is not a positive number.
    pub(super) fn of_pair(
        place: &Place,
        configurations: &[Configuration],
        pair: &RenderPair,
        error: impl Fn(usize, [f64; CHANNELS]) -> [Option<f64>; CHANNELS],
    ) -> Result<Vec<Self>> {
        let one = |(i, (c, renders)): (usize, (&Configuration, [&Estimate; 2]))| {
            let [a, b] = renders;
            let mean = std::array::from_fn(|k| 0.5 * (a.mean[k] + b.mean[k]));
            let error = error(i, mean);
            let mut known = error.into_iter().flatten();
            if let Some(bad) = known.find(|s| !(*s > 0.0 && s.is_finite())) {
                return Err(Error::new(format!(
                    "configuration {}: an error of {bad} was given to a number, expected one above 0",
                    c.id
                ))
                .with_hint("state the relative error of a measurement"));
            }
            // Divided by an infinite error a number says nothing.
            let error = error.map(|e| e.unwrap_or(f64::INFINITY));
            Ok(Self {
                toward_camera: c.camera_in_sample().vector(),
                jacobians: renders.map(|e| place.jacobian(e, error)),
                noise: place.spread(
                    |row, c| {
                        (0.5_f64).sqrt() * a.derivative_se[row][c].hypot(b.derivative_se[row][c])
                    },
                    error,
                ),
            })
        };
        configurations
            .iter()
            .zip(pair.estimates())
            .enumerate()
            .map(one)
            .collect()
    }

    /// The unbiased information of this shot; symmetric, not necessarily positive.
    pub(super) fn information(&self) -> Matrix {
        let [a, b] = &self.jacobians;
        a.weighted_gram(&[1.0; CHANNELS], b).symmetrized()
    }

    /// The same shot by some of the parameters.
    pub(super) fn by(&self, keep: &[usize]) -> Self {
        Self {
            toward_camera: self.toward_camera,
            jacobians: self.jacobians.each_ref().map(|j| j.columns(keep)),
            noise: self.noise.columns(keep),
        }
    }

    /// By how much noise may have raised `e' I e` of this shot, one standard deviation: from the standard errors of the
    /// derivatives, which do not depend on what the two renders happened to give. Channels share paths, so theirs add.
    pub(super) fn noise_along(&self, e: &[f64]) -> f64 {
        let mean = self.mean().times(e);
        mean.iter()
            .enumerate()
            .map(|(c, g)| {
                let squares = self
                    .noise
                    .row(c)
                    .iter()
                    .zip(e)
                    .map(|(s, e)| (s * e).powi(2));
                let variance: f64 = squares.sum();
                (2.0 * g * g * variance + variance * variance).sqrt()
            })
            .sum()
    }

    /// The Jacobians of both renders.
    pub(super) fn each(&self) -> [&Matrix; 2] {
        self.jacobians.each_ref()
    }

    /// Their mean.
    pub(super) fn mean(&self) -> Matrix {
        let [a, b] = &self.jacobians;
        let mut mean = a.clone();
        mean.add_scaled(1.0, b);
        mean.scale(0.5);
        mean
    }
}

/// The information of several shots together.
pub(super) fn information(n: usize, shots: &[Shot]) -> Matrix {
    let mut sum = Matrix::zeros(n, n);
    for shot in shots {
        sum.add_scaled(1.0, &shot.information());
    }
    sum
}

/// Standard error of `e' I e` from the renders' noise, I the information of `shots`.
///
/// With `x = (g + a)(g + b)` per number, g exact and a, b noise, what the renders' difference says of `g (a + b)` and of
/// `a b`, summed with its sign over shots that share camera paths and squared over those that do not.
pub(super) fn standard_error(shots: &[Shot], e: &[f64]) -> f64 {
    let mut groups: Vec<(DVec3, f64, f64)> = Vec::new();
    for shot in shots {
        let [a, b] = shot.jacobians.each_ref().map(|j| j.times(e));
        let (mut first, mut second) = (0.0, 0.0);
        for (a, b) in a.iter().zip(&b) {
            first += 0.5 * (a + b) * (a - b);
            second += 0.5 * (a - b).powi(2);
        }
        let same = |g: &&mut (DVec3, f64, f64)| (g.0 - shot.toward_camera).length() < 1e-12;
        match groups.iter_mut().find(same) {
            Some(group) => {
                group.1 += first;
                group.2 += second;
            }
            None => groups.push((shot.toward_camera, first, second)),
        }
    }
    let squares = |(_, first, second): &(DVec3, f64, f64)| first * first + second * second;
    groups.iter().map(squares).sum::<f64>().sqrt()
}

/// The part of some shots' information that is not noise.
pub(super) struct Seen {
    /// That part.
    pub(super) information: Matrix,
    /// The directions it lies in: along `step` and nothing else `form` is one.
    directions: Vec<(Vec<f64>, Vec<f64>)>,
}

impl Seen {
    /// Keeps the directions that diagonalize the information and along which it is more than three standard errors. They are
    /// orthogonal where prior and noise are about alike along every axis: otherwise a well known parameter would share its
    /// directions, and their doubt, with a noisy one.
    pub(super) fn of(n: usize, shots: &[Shot]) -> Self {
        let scales: Vec<f64> = (0..n)
            .map(|j| {
                let rows = shots
                    .iter()
                    .flat_map(|s| (0..CHANNELS).map(move |c| s.noise[(c, j)]));
                (1.0 + rows.map(|s| s * s).sum::<f64>()).sqrt().recip()
            })
            .collect();
        let mut scaled = information(n, shots);
        for i in 0..n {
            for j in 0..n {
                scaled[(i, j)] *= scales[i] * scales[j];
            }
        }
        let (mut kept, mut directions) = (Matrix::zeros(n, n), Vec::new());
        for (value, e) in eigen(&scaled) {
            let step: Vec<f64> = e.iter().zip(&scales).map(|(e, s)| e * s).collect();
            if value > 3.0 * standard_error(shots, &step) {
                let form: Vec<f64> = e.iter().zip(&scales).map(|(e, s)| e / s).collect();
                for i in 0..n {
                    for j in 0..n {
                        kept[(i, j)] += value * form[i] * form[j];
                    }
                }
                directions.push((step, form));
            }
        }
        Self {
            information: kept,
            directions,
        }
    }

    /// The part of a step that lies in what is seen.
    pub(super) fn part_of(&self, whole: &[f64]) -> Vec<f64> {
        let mut part = vec![0.0; whole.len()];
        for (step, form) in &self.directions {
            let along = dot(form, whole);
            part.iter_mut().zip(step).for_each(|(p, e)| *p += along * e);
        }
        part
    }

    /// Relative standard error, from the renders' noise, of the standard deviation of coordinate `j`: `dC = -C dI C`, so
    /// that of the variance is that of `f' I f` with f column j of C, as far as it lies in what is seen.
    pub(super) fn relative_error(&self, shots: &[Shot], covariance: &Matrix, j: usize) -> f64 {
        let f = self.part_of(covariance.row(j));
        0.5 * standard_error(shots, &f) / covariance[(j, j)]
    }
}

/// Covariance from an information and the prior; `None` when together they are not positive.
pub(super) fn covariance(information: &Matrix) -> Option<Matrix> {
    let n = information.n_rows();
    let mut precision = information.clone();
    (0..n).for_each(|j| precision[(j, j)] += 1.0);
    inverse(&precision)
}

/// Variance that a covariance gives a linear quantity, from two renders a, b of its derivatives: their product, which has no
/// bias, but no less than what their difference can hide (half the variance their noise would feign in one of them).
pub(super) fn variance(covariance: &Matrix, a: &[f64], b: &[f64]) -> f64 {
    let half: Vec<f64> = a.iter().zip(b).map(|(a, b)| 0.5 * (a - b)).collect();
    covariance
        .form(a, b)
        .max(covariance.form(&half, &half))
        .max(0.0)
}
