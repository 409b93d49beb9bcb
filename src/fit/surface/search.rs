//! The search for the parameters of a reflectance model, and what is known of them at its end.

use super::looks::starts;
use super::problem::{Linearized, Problem};
use crate::base::Result;
use crate::fit::linear::{box_quadratic, inverse};
use crate::scatter::Parameters;
use crate::scatter::surface::SurfaceModel;
use crate::session::Measurements;
use rayon::prelude::*;

/// What a search is asked.
#[derive(Debug, Clone)]
pub struct SurfaceOptions {
    /// The same seed gives the same starts.
    pub seed: u64,
    /// Random shapes that are looked at, colors by least squares; where warp and weft have shapes of their own, every warp with every
    /// weft of half as many.
    pub looks: usize,
    /// The best of them are followed to their optimum.
    pub starts: usize,
    /// Scalar parameters by name that stay as given; radians for angles.
    pub held: Vec<(String, f64)>,
    /// Fits of simpler models to begin from as well: parameters of the same name, or the same but for `warp_` and `weft_`.
    pub begin: Vec<Parameters>,
}

impl Default for SurfaceOptions {
    fn default() -> Self {
        Self {
            seed: 1,
            looks: 600,
            starts: 24,
            held: Vec::new(),
            begin: Vec::new(),
        }
    }
}

/// What is known of one flat parameter.
#[derive(Debug, Clone, PartialEq)]
pub struct SurfaceInterval {
    /// Flat name, e.g. `k_s.r`.
    pub name: String,
    /// Best value, radians for angles.
    pub value: f64,
    /// Half the width of the 95 % interval by the curvature at the optimum, with the spread of the residuals as error; none at a
    /// bound, when held, or when the measurements do not determine it at all.
    pub half_width: Option<f64>,
    /// The value lies on a bound.
    pub at_bound: bool,
    /// The interval is narrower than a quarter of the range (of a color: than its value).
    pub identified: bool,
}

/// Another optimum that explains the measurements as well, within 2 % of the residual.
#[derive(Debug, Clone, PartialEq)]
pub struct SurfaceRival {
    /// Where it is.
    pub parameters: Parameters,
    /// Its weighted rms residual.
    pub residual: f64,
    /// It is the best one with warp and weft exchanged.
    pub swapped: bool,
}

/// A fitted reflectance model.
#[derive(Debug, Clone, PartialEq)]
pub struct SurfaceResult {
    /// Name of the model.
    pub model: &'static str,
    /// The best parameters.
    pub parameters: Parameters,
    /// Weighted rms residual, weights as in Khungurn 2015 eq. 20.
    pub residual: f64,
    /// Numbers measured, those at distinct geometries, and parameters that were free.
    pub counts: [usize; 3],
    /// Corrected information criterion over numbers at distinct geometries; smaller is better.
    pub aicc: f64,
    /// Starts that were followed, and how many ended within 1 % of the best residual.
    pub starts: [usize; 2],
    /// Per flat parameter.
    pub intervals: Vec<SurfaceInterval>,
    /// Other optima.
    pub rivals: Vec<SurfaceRival>,
}

/// Fits a reflectance model to measurements.
///
/// # Errors
/// More parameters than numbers at distinct geometries allow, or an unknown or meaningless held parameter.
pub fn fit_surface(
    model: &dyn SurfaceModel,
    measurements: &Measurements,
    options: &SurfaceOptions,
) -> Result<SurfaceResult> {
    let problem = Problem::new(model, measurements, &options.held)?;
    let follow = |list: Vec<Vec<f64>>| -> Vec<End> {
        list.into_par_iter().map(|x| descend(&problem, x)).collect()
    };
    let mut ends = follow(starts(&problem, options));
    ends.sort_by(|a, b| a.objective.total_cmp(&b.objective));
    // Mirrored and exchanged copies of the best may be better, or as good.
    ends.extend(follow(copies(&problem, &ends[0].x)));
    ends.sort_by(|a, b| a.objective.total_cmp(&b.objective));
    Ok(summarize(&problem, &ends))
}

/// A parameter vector with its sum of squares.
#[derive(Debug, Clone)]
pub(super) struct End {
    pub(super) x: Vec<f64>,
    pub(super) objective: f64,
}

/// Levenberg and Marquardt within the bounds.
fn descend(problem: &Problem<'_>, mut x: Vec<f64>) -> End {
    const MOST_STEPS: usize = 60;
    let Some(mut here) = problem.linearize(&x) else {
        let objective = f64::INFINITY;
        return End { x, objective };
    };
    let (mut damping, mut small) = (1e-3, 0);
    for _ in 0..MOST_STEPS {
        let trial = step(problem, &x, &here, damping);
        let Some(there) = problem
            .linearize(&trial)
            .filter(|t| t.objective < here.objective)
        else {
            damping *= 6.0;
            if damping > 1e9 {
                break;
            }
            continue;
        };
        let gain = 1.0 - there.objective / here.objective;
        (x, here) = (trial, there);
        damping = (0.2 * damping).max(1e-9);
        small = if gain < 1e-5 { small + 1 } else { 0 };
        if small >= 2 {
            break;
        }
    }
    End {
        objective: here.objective,
        x,
    }
}

fn step(problem: &Problem<'_>, x: &[f64], here: &Linearized, damping: f64) -> Vec<f64> {
    let k = x.len();
    let mut h = here.hessian.clone();
    let largest = (0..k).map(|a| h[(a, a)]).fold(1e-30, f64::max);
    for a in 0..k {
        h[(a, a)] = h[(a, a)] * (1.0 + damping) + 1e-12 * largest;
    }
    let room = |bound: &[f64]| -> Vec<f64> { bound.iter().zip(x).map(|(b, x)| b - x).collect() };
    let (low, high) = (room(&problem.lower), room(&problem.upper));
    let s = box_quadratic(&h, &here.gradient, &low, &high);
    (0..k)
        .map(|a| (x[a] + s[a]).clamp(problem.lower[a], problem.upper[a]))
        .collect()
}

/// The place of the same parameter of the other yarn system, itself where there is none.
fn partner(problem: &Problem<'_>, place: usize) -> usize {
    let infos = problem.model.parameters();
    let (row, channel) = problem.places[place];
    let name = infos[row].name;
    let other = match (name.strip_prefix("warp_"), name.strip_prefix("weft_")) {
        (Some(own), _) => format!("weft_{own}"),
        (_, Some(own)) => format!("warp_{own}"),
        _ => return place,
    };
    let found = |p: &usize| {
        let (r, c) = problem.places[*p];
        infos[r].name == other && c == channel
    };
    (0..problem.places.len()).find(found).unwrap_or(place)
}

fn swapped(problem: &Problem<'_>, x: &[f64]) -> Vec<f64> {
    (0..x.len()).map(|p| x[partner(problem, p)]).collect()
}

/// The parameters with twists turned round, with warp and weft exchanged, and both; those that the bounds allow.
pub(super) fn copies(problem: &Problem<'_>, x: &[f64]) -> Vec<Vec<f64>> {
    let infos = problem.model.parameters();
    let mirrored = |x: &[f64]| -> Vec<f64> {
        (0..x.len())
            .map(|p| match infos[problem.places[p].0].name {
                name if name.ends_with("twist") => -x[p],
                _ => x[p],
            })
            .collect()
    };
    let exchanged = swapped(problem, x);
    let all = [mirrored(x), exchanged.clone(), mirrored(&exchanged)];
    let mut list: Vec<Vec<f64>> = Vec::new();
    for copy in all {
        let allowed =
            (0..x.len()).all(|p| (problem.lower[p]..=problem.upper[p]).contains(&copy[p]));
        if allowed && copy != x && !list.contains(&copy) {
            list.push(copy);
        }
    }
    list
}

/// Two sets of parameters are the same when no shape differs by more than a twentieth of its range.
fn same(problem: &Problem<'_>, a: &[f64], b: &[f64]) -> bool {
    problem.shape.iter().all(|&p| {
        let range = problem.upper[p] - problem.lower[p];
        (a[p] - b[p]).abs() <= 0.05 * range
    })
}

fn summarize(problem: &Problem<'_>, ends: &[End]) -> SurfaceResult {
    let best = &ends[0];
    let residual = problem.rms(best.objective);
    let free = problem.n_free();
    let near = |share: f64| {
        // Residuals below a millionth are as good as none.
        let limit = residual * (1.0 + share) + 1e-6;
        ends.iter()
            .filter(move |e| problem.rms(e.objective) <= limit)
    };
    let mut distinct: Vec<&End> = vec![best];
    for end in near(0.02) {
        if !distinct.iter().any(|d| same(problem, &d.x, &end.x)) {
            distinct.push(end);
        }
    }
    let exchanged = swapped(problem, &best.x);
    let rivals = distinct[1..]
        .iter()
        .map(|e| SurfaceRival {
            parameters: problem.parameters(&e.x),
            residual: problem.rms(e.objective),
            swapped: exchanged != best.x && same(problem, &exchanged, &e.x),
        })
        .collect();
    let (n, k) = (problem.n_distinct as f64, free as f64 + 1.0);
    SurfaceResult {
        model: problem.model.name(),
        parameters: problem.parameters(&best.x),
        residual,
        counts: [problem.n, problem.n_distinct, free],
        aicc: n * (residual * residual).max(1e-300).ln() + 2.0 * k * n / (n - k - 1.0),
        starts: [ends.len(), near(0.01).count()],
        intervals: intervals(problem, best),
        rivals,
    }
}

/// 95 % intervals by the curvature at the optimum.
fn intervals(problem: &Problem<'_>, best: &End) -> Vec<SurfaceInterval> {
    let k = best.x.len();
    let parameters = problem.parameters(&best.x);
    let held = |p: usize| problem.lower[p] >= problem.upper[p];
    let at_bound = |p: usize| {
        let slack = 1e-6 * (problem.upper[p] - problem.lower[p]);
        best.x[p] <= problem.lower[p] + slack || best.x[p] >= problem.upper[p] - slack
    };
    let mut free: Vec<usize> = (0..k).filter(|&p| !held(p) && !at_bound(p)).collect();
    let here = problem.linearize(&best.x);
    // What no number depends on is not determined, and would spoil the rest.
    if let Some(here) = &here {
        free.retain(|&p| here.hessian[(p, p)] > 0.0);
    }
    let degrees = problem.n as f64 - free.len() as f64;
    let covariance = here
        .filter(|_| degrees > 0.0)
        .and_then(|here| inverse(&here.hessian.sub(&free)));
    // Student's quantile of 0.975 to 1 % from 5 degrees of freedom on.
    let quantile = 1.96 + 2.4 / degrees.max(1.0) + 2.8 / (degrees * degrees).max(1.0);
    let spread = (best.objective / degrees.max(1.0)).sqrt();
    (0..k)
        .map(|p| {
            let place = free.iter().position(|&f| f == p);
            let variance = place.zip(covariance.as_ref()).map(|(a, c)| c[(a, a)]);
            let half_width = variance
                .filter(|v| *v > 0.0)
                .map(|v| quantile * spread * v.sqrt());
            let limit = match problem.linear.contains(&p) {
                true => best.x[p],
                false => 0.25 * (problem.upper[p] - problem.lower[p]),
            };
            SurfaceInterval {
                name: parameters.flat_names()[p].clone(),
                value: best.x[p],
                half_width,
                at_bound: !held(p) && at_bound(p),
                identified: half_width.is_some_and(|h| h < limit),
            }
        })
        .collect()
}
