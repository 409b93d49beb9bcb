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
use super::{Effort, Estimate, Estimates, MIN_PATHS, Request, relative_error_weight, weighted_rms};
use crate::base::{Error, Result, Watch};
use crate::math::Random;
use crate::scatter::{CHANNELS, Evaluation, MAX_ROWS, Scattering};
use crate::session::Configuration;
use glam::DVec3;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering};

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
struct Group {
    toward_camera: DVec3,
    /// Indices into the request's configurations.
    members: Vec<usize>,
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
struct Round<'a> {
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

/// Mean, its squared standard error, and the same for the derivatives.
#[derive(Debug, Clone, Copy, Default)]
struct Moments {
    mean: Sums,
    variance: Sums,
}

impl Round<'_> {
    fn run(&self, n_configurations: usize, watch: &dyn Watch) -> Result<Vec<Moments>> {
        let batches: Vec<u64> = self
            .paths
            .iter()
            .map(|n| (n / BATCH_PATHS).clamp(BATCHES.0, BATCHES.1))
            .collect();
        let tasks: Vec<(usize, u64)> = batches
            .iter()
            .enumerate()
            .flat_map(|(g, &n)| (0..n).map(move |b| (g, b)))
            .collect();
        let (done, total) = (AtomicU64::new(0), self.paths.iter().sum::<u64>());
        let results: Vec<Option<Vec<Sums>>> = tasks
            .par_iter()
            .map(|&(g, b)| {
                if watch.cancelled() {
                    return None;
                }
                let n = batch_size(self.paths[g], batches[g], b);
                let sums = self.batch(g, b, n);
                watch.progress(
                    self.stage_name,
                    done.fetch_add(n, Ordering::Relaxed) + n,
                    total,
                );
                Some(sums)
            })
            .collect();
        let results: Vec<Vec<Sums>> = results
            .into_iter()
            .collect::<Option<_>>()
            .ok_or_else(interrupted)?;

        let mut moments = vec![Moments::default(); n_configurations];
        let mut rest = results.as_slice();
        for (g, group) in self.groups.iter().enumerate() {
            let (mine, others) = rest.split_at(batches[g] as usize);
            rest = others;
            for (lamp, &member) in group.members.iter().enumerate() {
                let sizes =
                    (0..batches[g]).map(|b| batch_size(self.paths[g], batches[g], b) as f64);
                moments[member] = combine(mine.iter().map(|b| &b[lamp]).zip(sizes), self.rows);
            }
        }
        Ok(moments)
    }

    fn batch(&self, g: usize, batch: u64, n: u64) -> Vec<Sums> {
        let group = &self.groups[g];
        let worth: Vec<f64> = group.members.iter().map(|&m| self.worth[m]).collect();
        let stage = self.scene.stage(self.scattering, &group.lamps, &worth);
        let [seed, stream, round] = self.key;
        let mut random = Random::keyed(&[seed, stream, round, g as u64, batch]);
        let mut sums = Summation::new(self.rows, group.lamps.len());
        for _ in 0..n {
            let through = self.scene.start(&mut random);
            let view = self.scene.options.view;
            let toward_camera = view.toward_camera(through, group.toward_camera);
            stage.follow(through, toward_camera, &mut random, &mut sums);
        }
        sums.lamps
    }
}

/// Paths of batch `b` when `n` paths are split into `batches`.
fn batch_size(n: u64, batches: u64, b: u64) -> u64 {
    n / batches + u64::from(b < n % batches)
}

/// Mean over all paths, and its variance from the scatter of the batches.
fn combine<'a>(batches: impl Iterator<Item = (&'a Sums, f64)> + Clone, rows: usize) -> Moments {
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

fn interrupted() -> Error {
    Error::new("interrupted")
}

/// See [`super::Scene::estimate`].
pub(super) fn estimate(
    scene: &FiberScene,
    request: &Request<'_>,
    watch: &dyn Watch,
) -> Result<Estimates> {
    let clock = (std::time::Instant::now(), cpu_seconds());
    let configurations = request.configurations;
    let scattering = scene.model.prepare(request.parameters)?;
    let groups = groups(scene, configurations);
    let rows = scene.model.parameters().len();
    let round = |number: u64, paths: Vec<u64>, worth: Vec<f64>, stage_name: &str| {
        let key = [request.seed, request.stream, number];
        let round = Round {
            scene,
            scattering: &*scattering,
            rows,
            groups: &groups,
            paths,
            worth,
            key,
            stage_name,
        };
        round
            .run(configurations.len(), watch)
            .map(|m| (m, round.paths))
    };

    let planned = planned_paths(&request.effort, &groups);
    let pilot_paths = |n: u64| (n / 16).clamp(MIN_PATHS, 1024);
    let pilot = planned.as_ref().map_or(vec![2048; groups.len()], |p| {
        p.iter().map(|&n| pilot_paths(n)).collect()
    });
    let (mut moments, mut paths) = round(0, pilot, vec![0.0; configurations.len()], "pilot")?;
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
                (moments, paths) = round(number, larger, worth(&moments), "pilot")?;
                needed = paths_for_accuracy(&moments, &paths, &groups, AIM * target);
            }
            needed
        }
        (_, Some(planned)) => planned,
        (_, None) => unreachable!("only an accuracy leaves the path counts open"),
    };
    let (moments, paths) = round(MAX_PILOTS, final_paths, worth(&moments), "render")?;

    let mut estimates = Vec::with_capacity(configurations.len());
    for (index, (c, m)) in configurations.iter().zip(&moments).enumerate() {
        let group = groups.iter().position(|g| g.members.contains(&index));
        estimates.push(finished(
            c,
            m,
            rows,
            group.map_or(0, |g| paths[g]),
            request,
        )?);
    }
    Ok(Estimates {
        configurations: estimates,
        cpu_s: cpu_seconds() - clock.1,
        wall_s: clock.0.elapsed().as_secs_f64(),
    })
}

fn finished(
    c: &Configuration,
    m: &Moments,
    rows: usize,
    paths: u64,
    request: &Request<'_>,
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
            c.id,
            m.mean.value,
            m.variance.value,
            request.parameters.to_json()
        ))
        .with_hint("this is a fault of the model at these parameters; please report it with the parameters"));
    }
    Ok(Estimate {
        config: c.id,
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
fn planned_paths(effort: &Effort, groups: &[Group]) -> Option<Vec<u64>> {
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
