//! The published search for microflakes: binary searches by turns, of the albedo of each channel for the mean of what is seen, and of
//! gamma for its standard deviation (Zhao 2011 sec. 7.1; Khungurn 2015 sec. 7.1, over all photographs at once, 27 renders in all,
//! the two extreme grazing ones left out).
//!
//! Measurements here are means, without pixels. Of the variance of all photographs' pixels only the part between photographs can
//! be matched: gamma answers to the spread of the means from pose to pose. Both statistics are unbiased, the spread as a product of two
//! independent renders. Whatever else the model has (the density) stays where it began. Does not look at noise, and does
//! not weigh poses by brightness: it is a baseline, and ends where the published search would, not at the least residual.
//!
//! Of what the papers leave open: three rounds of five renders for the albedos, all channels at once, and four for gamma; brackets are
//! halved in the search's coordinates, over the whole range in the first round, over a quarter of the last round's around
//! what was found in each later one.

use super::gradient::Walk;
use super::objective::{Objective, RenderPair};
use super::search::{Found, Problem, Spent};
use super::space::SearchSpace;
use crate::base::{Error, Result, Watch};
use crate::scatter::{CHANNELS, Parameters};
use crate::session::Configuration;

/// Rounds, and the renders of each for the albedos and for gamma: 27 in all, as published.
const ROUNDS: i32 = 3;
const RENDERS: [u64; 2] = [5, 4];
/// How much narrower the brackets of a round are than those of the round before.
const NARROWER: f64 = 0.25;
/// Light and camera are both lower than this polar angle, on opposite sides, where flakes are known to be too dark.
const GRAZING_DEG: f64 = 75.0;
/// Pair indices of the renders begin here.
const ITERATION_INDEX: u64 = 3 << 32;

/// What is searched with what.
struct Plan<'a> {
    objective: &'a Objective,
    /// Configurations that are compared.
    kept: Vec<bool>,
    /// Coordinates of the albedos, channel by channel, and of gamma.
    albedo: [usize; CHANNELS],
    gamma: usize,
}

/// What is matched.
#[derive(Debug, Clone, Copy)]
struct Statistics {
    /// Over the kept poses; zero of a channel that was not measured.
    mean: [f64; CHANNELS],
    /// Variance from pose to pose, summed over channels.
    spread: f64,
}

/// Whether the camera looks along the cloth against the light.
fn grazing(c: &Configuration) -> bool {
    let low = |theta: f64| theta >= (GRAZING_DEG - 1e-6).to_radians();
    let facing = (c.light.phi - c.camera.phi).cos() < -0.9;
    low(c.light.theta) && low(c.camera.theta) && facing
}

impl<'a> Plan<'a> {
    fn new(objective: &'a Objective, parameters: &Parameters, model: &str) -> Result<Self> {
        let place = |name: &str, channel: usize| {
            let row = parameters.infos().iter().position(|p| p.name == name);
            row.map(|row| parameters.slot(row, channel)).ok_or_else(|| {
                Error::new(format!(
                    "the binary search is for microflakes: model {model} has no parameter {name}"
                ))
                .with_hint("--model microflake, or another --method")
            })
        };
        let poses = objective.intensities().iter();
        let kept: Vec<bool> = poses.map(|i| !grazing(&i.configuration)).collect();
        let plan = Self {
            objective,
            kept,
            gamma: place("gamma", 0)?,
            albedo: [
                place("albedo", 0)?,
                place("albedo", 1)?,
                place("albedo", 2)?,
            ],
        };
        if (0..CHANNELS).all(|c| plan.poses(c).count() < 2) {
            return Err(Error::new(
                "the binary search matches the spread from pose to pose: expected two configurations or more that are not \
                 grazing",
            )
            .with_hint(format!(
                "configurations with light and camera beyond {GRAZING_DEG} degrees on opposite sides are left out, as published"
            )));
        }
        Ok(plan)
    }

    /// The configurations that count in a channel.
    fn poses(&self, channel: usize) -> impl Iterator<Item = usize> + Clone {
        let measured = self.objective.intensities().iter().zip(&self.kept);
        let counts = measured.map(move |(i, kept)| *kept && i.present[channel]);
        let counts: Vec<bool> = counts.collect();
        (0..counts.len()).filter(move |&k| counts[k])
    }

    /// The statistics of two independent sets of numbers, or of one taken twice.
    fn of(
        &self,
        one: &impl Fn(usize, usize) -> f64,
        other: &impl Fn(usize, usize) -> f64,
    ) -> Statistics {
        let mut statistics = Statistics {
            mean: [0.0; CHANNELS],
            spread: 0.0,
        };
        for c in 0..CHANNELS {
            let poses = self.poses(c);
            let n = poses.clone().count() as f64;
            if n < 1.0 {
                continue;
            }
            let mean =
                |of: &dyn Fn(usize, usize) -> f64| poses.clone().map(|i| of(i, c)).sum::<f64>() / n;
            let [a, b] = [mean(one), mean(other)];
            statistics.mean[c] = 0.5 * (a + b);
            if n > 1.0 {
                let product = |i: usize| (one(i, c) - a) * (other(i, c) - b);
                statistics.spread += poses.clone().map(product).sum::<f64>() / (n - 1.0);
            }
        }
        statistics
    }

    /// Those of the measurements; what their errors add to the spread is taken off.
    fn measured(&self) -> Statistics {
        let intensities = self.objective.intensities();
        let value = |i: usize, c: usize| intensities[i].mean[c];
        let mut statistics = self.of(&value, &value);
        for c in 0..CHANNELS {
            let poses = self.poses(c);
            let n = poses.clone().count() as f64;
            if n > 1.0 {
                let squares = poses.map(|i| intensities[i].standard_error[c].powi(2));
                statistics.spread -= squares.sum::<f64>() / n;
            }
        }
        statistics
    }

    fn rendered(&self, pair: &RenderPair) -> Statistics {
        let [one, other] = [0, 1].map(|which| pair.render_of(which));
        self.of(&|i, c| one[i].mean[c], &|i, c| other[i].mean[c])
    }

    /// What is too high for the `target`, coordinate by coordinate of those searched now: then it has to fall. Means rise
    /// with the albedo; the spread falls with gamma, as wide flakes send light everywhere.
    fn too_high(&self, places: &[usize], found: &Statistics, target: &Statistics) -> Vec<bool> {
        let of = |&place: &usize| match self.albedo.iter().position(|p| *p == place) {
            Some(c) => found.mean[c] > target.mean[c],
            None => found.spread < target.spread,
        };
        places.iter().map(of).collect()
    }

    /// The coordinates of one turn: the albedos of channels that were measured, or gamma.
    fn places(&self, turn: usize) -> Vec<usize> {
        match turn {
            0 => {
                let seen = (0..CHANNELS).filter(|&c| self.poses(c).next().is_some());
                seen.map(|c| self.albedo[c]).collect()
            }
            _ => vec![self.gamma],
        }
    }

    /// What was left out and what was matched, in words.
    fn in_words(&self, found: Option<&Statistics>, target: &Statistics) -> String {
        let poses = self.objective.intensities().iter().zip(&self.kept);
        let ids = poses.filter(|(_, kept)| !**kept);
        let ids: Vec<String> = ids.map(|(i, _)| i.configuration.id.to_string()).collect();
        let without = match ids.as_slice() {
            [] => String::new(),
            ids => format!(" (without the grazing {})", ids.join(", ")),
        };
        let root = |s: &Statistics| s.spread.max(0.0).sqrt();
        let spread = match found {
            Some(found) => format!("{:.4} for {:.4} measured", root(found), root(target)),
            None => format!("{:.4} measured", root(target)),
        };
        format!(
            "albedos match the means over all poses{without}; as no pixels were measured, gamma matches the spread of the means \
             from pose to pose instead of their standard deviation: at the last render {spread}"
        )
    }
}

/// Where to look in a round: around `u`, inside the bounds.
fn bracket(space: &SearchSpace, place: usize, u: f64, round: i32) -> [f64; 2] {
    let (low, high) = (space.lower()[place], space.upper()[place]);
    let half = 0.5 * (high - low) * NARROWER.powi(round);
    if round == 0 {
        return [low, high];
    }
    [(u - half).max(low), (u + half).min(high)]
}

/// Searches from `start`; the second answer says in words what was done.
///
/// # Errors
/// When the model is not one of microflakes, a render fails, the budget is too small, or the fit is interrupted before the first
/// render.
pub(super) fn search(
    problem: &Problem<'_>,
    start: &[f64],
    spent: &mut Spent,
    watch: &dyn Watch,
) -> Result<(Found, String)> {
    let space = problem.space;
    let model = problem.scene.model().name();
    let plan = Plan::new(problem.objective, &space.to_parameters(start), model)?;
    let target = plan.measured();
    let all = ROUNDS as u64 * RENDERS.iter().sum::<u64>();
    let mut walk = Walk::new(problem, start, all as f64, spent, watch)?;
    let mut u = start.to_vec();
    let mut latest = None;
    let turns =
        (0..ROUNDS).flat_map(|round| RENDERS.into_iter().enumerate().map(move |t| (round, t)));
    'turns: for (round, (turn, renders)) in turns {
        let places = plan.places(turn);
        let mut brackets: Vec<[f64; 2]> = places
            .iter()
            .map(|&p| bracket(space, p, u[p], round))
            .collect();
        for _ in 0..renders {
            for (&place, [low, high]) in places.iter().zip(&brackets) {
                u[place] = 0.5 * (low + high);
            }
            let index = ITERATION_INDEX + walk.n_recorded() as u64;
            let Some(pair) = walk.render(&u, 1.0, index)? else {
                break 'turns;
            };
            walk.record_search(&u, &pair);
            let found = plan.rendered(&pair);
            let high = plan.too_high(&places, &found, &target);
            for ((bracket, &place), high) in brackets.iter_mut().zip(&places).zip(high) {
                bracket[usize::from(high)] = u[place];
            }
            latest = Some(found);
        }
        for (&place, [low, high]) in places.iter().zip(&brackets) {
            u[place] = 0.5 * (low + high);
        }
    }
    let note = format!(
        "published binary search: {} of {all} renders of {}; {}",
        walk.n_recorded(),
        walk.cost_in_words(),
        plan.in_words(latest.as_ref(), &target)
    );
    Ok((walk.finish(u)?, note))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::Plan;
    use std::path::Path;

    #[test]
    fn the_published_renders_are_27_and_the_two_extreme_poses_are_left_out() {
        assert_eq!(ROUNDS as u64 * RENDERS.iter().sum::<u64>(), 27);
        let path = Path::new("rig_configs/plans/khungurn16.toml");
        let configurations = Plan::read(path).unwrap().configurations;
        let left_out = configurations.iter().filter(|c| grazing(c)).map(|c| c.id);
        assert_eq!(left_out.collect::<Vec<_>>(), [1, 5]);
    }
}
