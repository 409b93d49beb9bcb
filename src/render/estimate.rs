//! Means, derivatives and standard errors from batches of camera paths.
//!
//! Configurations with the same camera direction in the sample frame share their camera paths (Khungurn 2015's 16 make 7
//! groups): each path connects to all lamps of its group, so their estimates are correlated, but each is unbiased.
//!
//! Pilot paths, from a stream of their own, choose path counts and roulette thresholds and are then thrown away: what is
//! returned comes from paths whose number and thresholds were fixed beforehand, so means and derivatives are unbiased.

use super::light::Lamp;
use super::path::{Event, Visitor};
use super::scene::FiberScene;
use super::{Effort, Estimate, Estimates, Request, relative_error_weight, weighted_rms};
use crate::base::{Error, Result, Watch};
use crate::math::Random;
use crate::scatter::{CHANNELS, Evaluation, MAX_ROWS, Parameters, Scattering};
use crate::session::Configuration;
use glam::DVec3;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering};

/// Fewest paths per configuration an estimate can be made from: below, batch means say nothing about the error.
const MIN_PATHS: u64 = 64;
/// Paths per batch aimed at, and the range of the number of batches.
const BATCH_PATHS: u64 = 512;
const BATCHES: (u64, u64) = (32, 512);
/// The weights' threshold, in normalized radiance (Khungurn 2015 section 5.3).
const TAU: f64 = 0.02;
/// Connections worth less than this multiple of a configuration's mean are made with smaller probability. Work to equal
/// error is flat between 1 and 10 and a tenth higher at 0.1.
const WORTH: f64 = 1.0;

/// Sums of one lamp: value and derivatives.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sums {
    pub(super) value: [f64; CHANNELS],
    pub(super) derivative: [[f64; CHANNELS]; MAX_ROWS],
}

/// Follows paths and sums their contributions and scores (Khungurn 2015 eq. 11-17): along a path the derivative of its
/// contribution is the contribution times the sum of `(dS/dt)/S` over its events; sampling is not differentiated.
pub(super) struct Summation {
    rows: usize,
    /// `before[n]`: what the first `n` events of the present path left.
    before: Vec<Carried>,
    pub(super) lamps: Vec<Sums>,
}

/// What a path has gathered on its way.
#[derive(Debug, Clone, Copy)]
struct Carried {
    throughput: [f64; CHANNELS],
    score: [[f64; CHANNELS]; MAX_ROWS],
}

impl Summation {
    pub(super) fn new(rows: usize, n_lamps: usize) -> Self {
        Self {
            rows,
            before: vec![Carried {
                throughput: [1.0; CHANNELS],
                score: [[0.0; CHANNELS]; MAX_ROWS],
            }],
            lamps: vec![Sums::default(); n_lamps],
        }
    }

    fn set(&mut self, depth: usize, carried: Carried) {
        match self.before.get_mut(depth) {
            Some(place) => *place = carried,
            None => self.before.push(carried),
        }
    }
}

/// `(dS/dt)/S`; where `S` underflows to zero the path carries nothing and the score is taken as zero.
fn score(evaluation: &Evaluation, row: usize, channel: usize) -> f64 {
    let value = evaluation.value[channel];
    if value > 0.0 {
        evaluation.derivative[row][channel] / value
    } else {
        0.0
    }
}

impl Visitor for Summation {
    fn bounce(&mut self, depth: usize, event: Event<'_>) {
        let mut carried = self.before[depth];
        for c in 0..CHANNELS {
            carried.throughput[c] *= event.weight[c];
            for row in 0..self.rows {
                carried.score[row][c] += score(event.evaluation, row, c);
            }
        }
        self.set(depth + 1, carried);
    }

    fn reflect(&mut self, depth: usize, weight: [f64; CHANNELS]) {
        let mut carried = self.before[depth];
        for c in 0..CHANNELS {
            carried.throughput[c] *= weight[c];
        }
        self.set(depth + 1, carried);
    }

    fn connect(&mut self, depth: usize, lamp: usize, event: Event<'_>) {
        let (sums, carried) = (&mut self.lamps[lamp], &self.before[depth]);
        for c in 0..CHANNELS {
            let contribution = carried.throughput[c] * event.weight[c];
            sums.value[c] += contribution;
            for row in 0..self.rows {
                sums.derivative[row][c] +=
                    contribution * (carried.score[row][c] + score(event.evaluation, row, c));
            }
        }
    }

    fn arrive(&mut self, depth: usize, lamp: usize, factor: [f64; CHANNELS]) {
        let (sums, carried) = (&mut self.lamps[lamp], &self.before[depth]);
        for c in 0..CHANNELS {
            let contribution = carried.throughput[c] * factor[c];
            sums.value[c] += contribution;
            for row in 0..self.rows {
                sums.derivative[row][c] += contribution * carried.score[row][c];
            }
        }
    }
}

/// Configurations that share camera paths.
pub(super) struct Group {
    toward_camera: DVec3,
    /// Indices into the request's configurations.
    pub(super) members: Vec<usize>,
    lamps: Vec<Lamp>,
}

fn groups(scene: &FiberScene, configurations: &[Configuration]) -> Vec<Group> {
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
        group.lamps = scene.lamps(group.members.iter().map(|&i| configurations[i]));
    }
    groups
}

/// Fraction of an asked accuracy aimed at: pilots miss the rarest bright paths and promise a little too much.
const AIM: f64 = 0.9;

/// Most pilot rounds.
const MAX_PILOTS: u64 = 6;

/// One round of paths over all groups.
pub(super) struct Round<'a> {
    scene: &'a FiberScene,
    scattering: &'a dyn Scattering,
    rows: usize,
    groups: &'a [Group],
    /// Paths per group.
    paths: Vec<u64>,
    /// Per configuration, see [`super::path::Stage::worth`].
    worth: Vec<f64>,
    /// Key of the random streams: seed, stream, round.
    key: [u64; 3],
    stage_name: &'a str,
}

/// Camera paths of one group with a random stream of their own: what standard errors are made from.
#[derive(Debug, Clone, Copy)]
pub(super) struct Batch {
    pub(super) group: usize,
    /// Counts within the group.
    pub(super) number: u64,
    pub(super) paths: u64,
}

/// Mean, its squared standard error, and the same for the derivatives.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Moments {
    mean: Sums,
    variance: Sums,
}

impl Round<'_> {
    fn run(&self, n_configurations: usize, watch: &dyn Watch) -> Result<Vec<Moments>> {
        let results = self.batches(watch, |batch| {
            let mut sums = Summation::new(self.rows, self.groups[batch.group].members.len());
            self.follow(&batch, &mut sums, |_| {});
            Ok(sums.lamps)
        })?;
        let mut moments = vec![Moments::default(); n_configurations];
        for (g, group) in self.groups.iter().enumerate() {
            for (lamp, &member) in group.members.iter().enumerate() {
                let mine = results.iter().filter(|(batch, _)| batch.group == g);
                let sums = mine.map(|(batch, sums)| (&sums[lamp], batch.paths as f64));
                moments[member] = combine(sums, self.rows);
            }
        }
        Ok(moments)
    }

    /// What `each` makes of every batch of paths, in a fixed order.
    pub(super) fn batches<T: Send>(
        &self,
        watch: &dyn Watch,
        each: impl Fn(Batch) -> Result<T> + Sync,
    ) -> Result<Vec<(Batch, T)>> {
        let tasks: Vec<Batch> = (0..self.groups.len())
            .flat_map(|group| {
                let paths = self.paths[group];
                let count = (paths / BATCH_PATHS).clamp(BATCHES.0, BATCHES.1);
                (0..count).map(move |number| Batch {
                    group,
                    number,
                    paths: batch_size(paths, count, number),
                })
            })
            .collect();
        let (done, total) = (AtomicU64::new(0), self.paths.iter().sum::<u64>());
        tasks
            .par_iter()
            .map(|&batch| {
                if watch.cancelled() {
                    return Err(interrupted());
                }
                let result = each(batch)?;
                watch.progress(
                    self.stage_name,
                    done.fetch_add(batch.paths, Ordering::Relaxed) + batch.paths,
                    total,
                );
                Ok((batch, result))
            })
            .collect()
    }

    /// Follows the paths of a batch; `ended` hears of the end of each.
    pub(super) fn follow<V: Visitor>(
        &self,
        batch: &Batch,
        visitor: &mut V,
        mut ended: impl FnMut(&mut V),
    ) {
        let g = batch.group;
        let group = &self.groups[g];
        let worth: Vec<f64> = group.members.iter().map(|&m| self.worth[m]).collect();
        let stage = self.scene.stage(self.scattering, &group.lamps, &worth);
        let [seed, stream, round] = self.key;
        let mut random = Random::keyed(&[seed, stream, round, g as u64, batch.number]);
        for _ in 0..batch.paths {
            let through = self.scene.start(&mut random);
            let view = self.scene.options.view;
            let toward_camera = view.toward_camera(through, group.toward_camera);
            stage.follow(through, toward_camera, &mut random, visitor);
            ended(visitor);
        }
    }
}

/// Paths of batch `b` when `n` paths are split into `batches`.
fn batch_size(n: u64, batches: u64, b: u64) -> u64 {
    n / batches + u64::from(b < n % batches)
}

/// Mean over all paths, and its variance from the scatter of the batches.
pub(super) fn combine<'a>(
    batches: impl Iterator<Item = (&'a Sums, f64)> + Clone,
    rows: usize,
) -> Moments {
    let paths: f64 = batches.clone().map(|(_, n)| n).sum();
    let count = batches.clone().count() as f64;
    let one = |pick: &dyn Fn(&Sums) -> f64| {
        let mean = batches.clone().map(|(s, _)| pick(s)).sum::<f64>() / paths;
        let scatter: f64 = batches
            .clone()
            .map(|(s, n)| (pick(s) - n * mean).powi(2) / n)
            .sum();
        (mean, scatter / ((count - 1.0) * paths))
    };
    let mut moments = Moments::default();
    for c in 0..CHANNELS {
        (moments.mean.value[c], moments.variance.value[c]) = one(&|s| s.value[c]);
        for row in 0..rows {
            (
                moments.mean.derivative[row][c],
                moments.variance.derivative[row][c],
            ) = one(&|s| s.derivative[row][c]);
        }
    }
    moments
}

pub(super) fn interrupted() -> Error {
    Error::new("interrupted")
}

/// Groups, path counts and roulette thresholds of a request, fixed by pilots.
pub(super) struct Planned {
    pub(super) groups: Vec<Group>,
    /// Paths per group.
    pub(super) paths: Vec<u64>,
    /// Per configuration, see [`super::path::Stage::worth`].
    worth: Vec<f64>,
}

impl Planned {
    /// Camera paths of one configuration.
    pub(super) fn paths_of(&self, configuration: usize) -> u64 {
        let group = |g: &Group| g.members.contains(&configuration);
        self.groups
            .iter()
            .position(group)
            .map_or(0, |g| self.paths[g])
    }

    /// The paths that are kept.
    pub(super) fn round<'a>(
        &'a self,
        scene: &'a FiberScene,
        scattering: &'a dyn Scattering,
        request: &Request<'_>,
    ) -> Round<'a> {
        Round {
            scene,
            scattering,
            rows: scene.model.parameters().len(),
            groups: &self.groups,
            paths: self.paths.clone(),
            worth: self.worth.clone(),
            key: [request.seed, request.stream, MAX_PILOTS],
            stage_name: "render",
        }
    }
}

/// Spends pilots on what has to be known before the paths that are kept.
pub(super) fn plan(
    scene: &FiberScene,
    scattering: &dyn Scattering,
    request: &Request<'_>,
    watch: &dyn Watch,
) -> Result<Planned> {
    let configurations = request.configurations;
    if configurations.is_empty() {
        return Err(Error::new(
            "nothing to render: the plan has no configurations",
        ));
    }
    let groups = groups(scene, configurations);
    let pilot = |number: u64, paths: Vec<u64>, worth: Vec<f64>| {
        let round = Round {
            scene,
            scattering,
            rows: scene.model.parameters().len(),
            groups: &groups,
            paths,
            worth,
            key: [request.seed, request.stream, number],
            stage_name: "pilot",
        };
        round
            .run(configurations.len(), watch)
            .map(|m| (m, round.paths))
    };

    let planned = planned_paths(&request.effort, &groups)?;
    let pilot_paths = |n: u64| (n / 16).clamp(MIN_PATHS, 1024);
    let first = planned.as_ref().map_or(vec![2048; groups.len()], |p| {
        p.iter().map(|&n| pilot_paths(n)).collect()
    });
    let (mut moments, mut paths) = pilot(0, first, vec![0.0; configurations.len()])?;
    let final_paths = match (&request.effort, planned) {
        (Effort::Accuracy(target), _) => {
            // Rare bright paths make a small pilot's variances too low: repeat with larger ones until a pilot is about an
            // eighth of the work it predicts.
            let mut needed = paths_for_accuracy(&moments, &paths, &groups, AIM * target);
            for number in 1..MAX_PILOTS {
                if 9 * paths.iter().sum::<u64>() >= needed.iter().sum::<u64>() {
                    break;
                }
                let larger = needed.iter().map(|n| (n / 8).max(MIN_PATHS)).collect();
                (moments, paths) = pilot(number, larger, worth(&moments))?;
                needed = paths_for_accuracy(&moments, &paths, &groups, AIM * target);
            }
            needed
        }
        (_, Some(planned)) => planned,
        (_, None) => unreachable!("only an accuracy leaves the path counts open"),
    };
    Ok(Planned {
        worth: worth(&moments),
        paths: final_paths,
        groups,
    })
}

/// See [`super::Scene::estimate`].
pub(super) fn estimate(
    scene: &FiberScene,
    request: &Request<'_>,
    watch: &dyn Watch,
) -> Result<Estimates> {
    let clock = (std::time::Instant::now(), cpu_seconds());
    let scattering = scene.model.prepare(request.parameters)?;
    let planned = plan(scene, &*scattering, request, watch)?;
    let round = planned.round(scene, &*scattering, request);
    let moments = round.run(request.configurations.len(), watch)?;
    let rows = round.rows;
    let finish = |(index, c): (usize, &Configuration)| {
        let paths = planned.paths_of(index);
        finished(c.id, &moments[index], rows, paths, request.parameters)
    };
    let configurations = request.configurations.iter().enumerate();
    Ok(Estimates {
        configurations: configurations.map(finish).collect::<Result<_>>()?,
        cpu_s: cpu_seconds() - clock.1,
        wall_s: clock.0.elapsed().as_secs_f64(),
    })
}

pub(super) fn finished(
    config: u32,
    m: &Moments,
    rows: usize,
    paths: u64,
    parameters: &Parameters,
) -> Result<Estimate> {
    let finite = m
        .mean
        .value
        .iter()
        .chain(&m.variance.value)
        .all(|v| v.is_finite())
        && m.mean
            .derivative
            .iter()
            .chain(&m.variance.derivative)
            .flatten()
            .all(|v| v.is_finite());
    if !finite {
        return Err(Error::new(format!(
            "configuration {}: the render is not finite (mean {:?}, variance {:?}) at {}",
            config,
            m.mean.value,
            m.variance.value,
            parameters.to_json()
        ))
        .with_hint("this is a fault of the model at these parameters; please report it with the parameters"));
    }
    Ok(Estimate {
        config,
        mean: m.mean.value,
        standard_error: m.variance.value.map(f64::sqrt),
        derivative: m.mean.derivative[..rows].to_vec(),
        derivative_se: m.variance.derivative[..rows]
            .iter()
            .map(|v| v.map(f64::sqrt))
            .collect(),
        paths,
    })
}

/// Paths per group when the effort states them; `None` for an accuracy.
fn planned_paths(effort: &Effort, groups: &[Group]) -> Result<Option<Vec<u64>>> {
    match effort {
        Effort::Paths(n) if *n < MIN_PATHS => Err(Error::new(format!(
            "{n} paths per configuration are too few"
        ))
        .with_hint(format!(
            "at least {MIN_PATHS} are needed for a standard error"
        ))),
        Effort::Paths(n) => Ok(Some(vec![*n; groups.len()])),
        Effort::Total { paths, shares } => {
            let n: usize = groups.iter().map(|g| g.members.len()).sum();
            if shares.len() != n || !shares.iter().all(|s| *s > 0.0 && s.is_finite()) {
                return Err(Error::new(format!(
                    "path shares: expected {n} positive numbers, found {shares:?}"
                )));
            }
            let of = |g: &Group| g.members.iter().map(|&m| shares[m]).fold(0.0, f64::max);
            let all: f64 = groups.iter().map(of).sum();
            let paths = *paths as f64;
            Ok(Some(
                groups
                    .iter()
                    .map(|g| ((paths * of(g) / all).round() as u64).max(MIN_PATHS))
                    .collect(),
            ))
        }
        Effort::Accuracy(a) if (1e-5..=0.5).contains(a) => Ok(None),
        Effort::Accuracy(a) => Err(Error::new(format!(
            "accuracy {a} is out of range: expected 0.00001 to 0.5"
        ))
        .with_hint("write 1% or 0.01 for a weighted rms standard error of one percent")),
    }
}

/// Roulette thresholds from a pilot's means.
fn worth(pilot: &[Moments]) -> Vec<f64> {
    pilot
        .iter()
        .map(|m| WORTH * (m.mean.value.iter().sum::<f64>() / CHANNELS as f64))
        .collect()
}

/// Paths per group (Neyman 1934) so that the weighted rms standard error meets `target`, given a pilot.
fn paths_for_accuracy(pilot: &[Moments], paths: &[u64], groups: &[Group], target: f64) -> Vec<u64> {
    // Weighted variance per path of each group.
    let spread: Vec<f64> = groups
        .iter()
        .zip(paths)
        .map(|(g, &n)| {
            let of = |&m: &usize| {
                let Moments { mean, variance } = &pilot[m];
                relative_error_weight(mean.value, TAU) * variance.value.iter().sum::<f64>()
            };
            n as f64 * g.members.iter().map(of).sum::<f64>()
        })
        .collect();
    // Minimize sum n subject to sum spread / n = target^2 (number of values).
    let allowed = target * target * (CHANNELS * pilot.len()) as f64;
    let root_sum: f64 = spread.iter().map(|s| s.sqrt()).sum();
    spread
        .iter()
        .map(|s| ((root_sum * s.sqrt() / allowed).ceil() as u64).max(MIN_PATHS))
        .collect()
}

impl Estimates {
    /// The weighted rms standard error of all numbers, weights from the estimated means (Khungurn 2015 eq. 20).
    pub fn weighted_rms_error(&self) -> f64 {
        let weight = |e: &Estimate| relative_error_weight(e.mean, TAU);
        weighted_rms(
            self.configurations
                .iter()
                .map(|e| (weight(e), e.standard_error)),
        )
    }
}

/// CPU time of this process so far, all threads, seconds.
pub(super) fn cpu_seconds() -> f64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    t.tv_sec as f64 + t.tv_nsec as f64 * 1e-9
}
