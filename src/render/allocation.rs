//! Which configurations share camera paths, and how many paths each group gets.

use super::estimate::Moments;
use super::light::Lamp;
use super::scene::FiberSceneOptions;
use super::{Effort, MIN_PATHS, TAU, relative_error_weight};
use crate::scatter::CHANNELS;
use crate::session::Configuration;
use glam::DVec3;

/// Connections worth less than this multiple of a configuration's mean are made with smaller probability. Work to equal
/// error is flat between 1 and 10 and a tenth higher at 0.1.
const WORTH: f64 = 1.0;

/// Configurations that share camera paths.
pub(super) struct Group {
    pub(super) toward_camera: DVec3,
    /// Indices into the request's configurations.
    pub(super) members: Vec<usize>,
    pub(super) lamps: Vec<Lamp>,
}

pub(super) fn groups(options: &FiberSceneOptions, configurations: &[Configuration]) -> Vec<Group> {
    let mut groups: Vec<Group> = Vec::new();
    for (index, c) in configurations.iter().enumerate() {
        let toward_camera = c.camera_in_sample().vector();
        match groups
            .iter_mut()
            .find(|g| (g.toward_camera - toward_camera).length() < 1e-12)
        {
            Some(group) => group.members.push(index),
            None => groups.push(Group {
                toward_camera,
                members: vec![index],
                lamps: Vec::new(),
            }),
        }
    }
    for group in &mut groups {
        group.lamps = options.lamps(group.members.iter().map(|&i| configurations[i]));
    }
    groups
}

/// Paths per group when the effort states them; `None` for an accuracy.
pub(super) fn planned_paths(effort: &Effort, groups: &[Group]) -> Option<Vec<u64>> {
    match effort {
        Effort::Paths(n) => Some(vec![*n; groups.len()]),
        Effort::Total { paths, shares } => {
            let of = |g: &Group| g.members.iter().map(|&m| shares[m]).fold(0.0, f64::max);
            let all: f64 = groups.iter().map(of).sum();
            let paths = *paths as f64;
            Some(
                groups
                    .iter()
                    .map(|g| ((paths * of(g) / all).round() as u64).max(MIN_PATHS))
                    .collect(),
            )
        }
        Effort::Accuracy(_) => None,
    }
}

/// Roulette thresholds from a pilot's means.
pub(super) fn worth(pilot: &[Moments]) -> Vec<f64> {
    pilot.iter().map(|m| worth_of(m.mean.value)).collect()
}

/// The roulette threshold of a lamp that makes this mean.
pub(super) fn worth_of(mean: [f64; CHANNELS]) -> f64 {
    WORTH * (mean.iter().sum::<f64>() / CHANNELS as f64).max(TAU)
}

/// What a configuration's errors add to the objective: weight times the variances of its means.
pub(super) fn weighted_variance(m: &Moments) -> f64 {
    relative_error_weight(m.mean.value, TAU) * m.variance.value.iter().sum::<f64>()
}

/// Paths per group so that the weighted rms standard error meets `target` with the least work (Neyman 1934), given weighted
/// variance and cost of one path of each group.
pub(super) fn paths_for_accuracy(
    variance: &[f64],
    cost: &[f64],
    n_configurations: usize,
    target: f64,
) -> Vec<u64> {
    // Minimize sum n cost subject to sum variance / n = target^2 (number of values).
    let allowed = target * target * (CHANNELS * n_configurations) as f64;
    let of = |f: fn(f64, f64) -> f64| variance.iter().zip(cost).map(move |(&v, &c)| f(v, c));
    let root_sum: f64 = of(|v, c| (v * c).sqrt()).sum();
    of(|v, c| (v / c).sqrt())
        .map(|n| ((root_sum * n / allowed).ceil() as u64).max(MIN_PATHS))
        .collect()
}
