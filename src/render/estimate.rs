//! Means, derivatives and standard errors from batches of camera paths.
//!
//! Configurations with the same camera direction in the sample frame share their camera paths (Khungurn 2015's 16 make 7
//! groups): each path connects to all lamps of its group, so their estimates are correlated, but each is unbiased.
//!
//! Pilot paths, from streams of their own, choose path counts, roulette thresholds and which branches to follow, and are
//! then thrown away: what is returned comes from paths whose number and rules were fixed beforehand, so means and
//! derivatives are unbiased.

use super::allocation::{
    Group, groups, paths_for_accuracy, planned_paths, weighted_variance, worth,
};
use super::guide::{Guide, Lesson, Pupil};
use super::light::Lamp;
use super::path::Visitor;
use super::scene::FiberSceneOptions;
use super::summation::{Rows, Summation, Sums};
use super::{
    Effort, Estimate, Estimates, MIN_PATHS, Request, TAU, relative_error_weight, weighted_rms,
};
use crate::base::{Error, Result, Watch};
use crate::math::Random;
use crate::scatter::{CHANNELS, Parameters};
use crate::session::Configuration;
use glam::DVec3;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering};

/// Paths per batch aimed at, and the range of the number of batches.
const BATCH_PATHS: u64 = 512;
const BATCHES: (u64, u64) = (32, 512);

/// Fraction of an asked accuracy aimed at: pilots miss the rarest bright paths and promise a little too much.
const AIM: f64 = 0.9;

/// Most pilot rounds.
const MAX_PILOTS: u64 = 6;

/// Fewest pilot paths of a group that teach its guide more than they cost.
const SCHOOL: u64 = 500;

/// By how much variance times cost has to grow before a guide is blamed: pilots are noisy.
const CLEARLY: f64 = 1.5;

/// What a ray of a guided path costs in rays of one without: more directions are sampled at each hit.
const GUIDED_RAY: f64 = 1.25;

/// A scene at fixed parameters, through which paths can be followed.
pub(super) trait Followed: Sync {
    /// What surrounds the cloth.
    fn options(&self) -> &FiberSceneOptions;

    /// Follows one camera path with all its branches.
    fn follow<V: Visitor>(
        &self,
        rules: &Rules<'_>,
        ray: CameraRay,
        random: &mut Random,
        visitor: &mut V,
    );
}

/// The rules by which the paths of a group are followed.
pub(super) struct Rules<'a> {
    pub(super) lamps: &'a [Lamp],
    /// Per lamp: connections that would add less than this are made with proportionally smaller probability.
    pub(super) worth: &'a [f64],
    pub(super) guide: &'a Guide,
}

/// A ray that arrives at the camera.
#[derive(Debug, Clone, Copy)]
pub(super) struct CameraRay {
    /// A point of the plane z = 0.
    pub(super) through: DVec3,
    pub(super) toward_camera: DVec3,
}

/// One round of paths over all groups.
pub(super) struct Round<'a, F> {
    followed: &'a F,
    groups: &'a [Group],
    /// Paths per group.
    paths: Vec<u64>,
    /// Per configuration, see [`Rules::worth`].
    worth: Vec<f64>,
    guides: Vec<Guide>,
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
    pub(super) mean: Sums,
    pub(super) variance: Sums,
}

/// What a group's pilot paths taught, and how many rays they took.
type Learned = (Lesson, f64);

impl<F: Followed> Round<'_, F> {
    /// Camera paths of all groups.
    pub(super) fn total_paths(&self) -> u64 {
        self.paths.iter().sum()
    }

    /// Camera paths of one configuration.
    pub(super) fn paths_of(&self, configuration: usize) -> u64 {
        let group = |g: &Group| g.members.contains(&configuration);
        let found = self.groups.iter().position(group);
        found.map_or(0, |g| self.paths[g])
    }

    fn batches(&self, group: usize) -> impl Iterator<Item = Batch> {
        let paths = self.paths[group];
        let count = (paths / BATCH_PATHS).clamp(BATCHES.0, BATCHES.1);
        (0..count).map(move |number| Batch {
            group,
            number,
            paths: paths / count + u64::from(number < paths % count),
        })
    }

    /// What `one` makes of every batch, in a fixed order.
    pub(super) fn run<T: Send>(
        &self,
        watch: &dyn Watch,
        one: impl Fn(Batch) -> Result<T> + Sync,
    ) -> Result<Vec<(Batch, T)>> {
        let tasks: Vec<Batch> = (0..self.groups.len())
            .flat_map(|group| self.batches(group))
            .collect();
        let (done, total) = (AtomicU64::new(0), self.total_paths());
        tasks
            .par_iter()
            .map(|&batch| {
                if watch.cancelled() {
                    return Err(interrupted());
                }
                let result = one(batch)?;
                let so_far = done.fetch_add(batch.paths, Ordering::Relaxed) + batch.paths;
                watch.progress(self.stage_name, so_far, total);
                Ok((batch, result))
            })
            .collect()
    }

    /// Traces the paths of one batch; `finish_path` hears of the end of each.
    pub(super) fn trace<V: Visitor>(
        &self,
        batch: Batch,
        visitor: &mut V,
        finish_path: impl Fn(&mut V),
    ) {
        let g = batch.group;
        let group = &self.groups[g];
        let worth: Vec<f64> = group.members.iter().map(|&m| self.worth[m]).collect();
        let rules = Rules {
            lamps: &group.lamps,
            worth: &worth,
            guide: &self.guides[g],
        };
        let options = self.followed.options();
        let [seed, stream, round] = self.key;
        let mut random = Random::keyed(&[seed, stream, round, g as u64, batch.number]);
        for _ in 0..batch.paths {
            let through = options.start(&mut random);
            let toward_camera = options.view.toward_camera(through, group.toward_camera);
            let ray = CameraRay {
                through,
                toward_camera,
            };
            self.followed.follow(&rules, ray, &mut random, visitor);
            finish_path(visitor);
        }
    }

    /// Moments of all configurations.
    fn render(
        &self,
        rows: Rows,
        n_configurations: usize,
        watch: &dyn Watch,
    ) -> Result<Vec<Moments>> {
        let batches = self.run(watch, |batch| {
            let mut sums = Summation::new(rows, self.groups[batch.group].lamps.len());
            self.trace(batch, &mut sums, |_| ());
            Ok(sums.lamps)
        })?;
        Ok(self.moments(&batches, rows.all, n_configurations))
    }

    /// Moments of the values alone, and per group what the paths taught and how many rays they took.
    fn pilot(
        &self,
        n_configurations: usize,
        watch: &dyn Watch,
    ) -> Result<(Vec<Moments>, Vec<Learned>)> {
        let batches = self.run(watch, |batch| {
            let mut pupil = Pupil::new(self.groups[batch.group].lamps.len());
            self.trace(batch, &mut pupil, Pupil::finish_path);
            Ok(pupil)
        })?;
        let lesson = |group: &Group| (Lesson::new(group.lamps.len()), 0.0);
        let mut learned: Vec<Learned> = self.groups.iter().map(lesson).collect();
        for (batch, pupil) in &batches {
            let (lesson, rays) = &mut learned[batch.group];
            lesson.merge(&pupil.lesson);
            *rays += pupil.rays;
        }
        let value = |&value: &[f64; CHANNELS]| Sums {
            value,
            ..Sums::default()
        };
        let values: Vec<(Batch, Vec<Sums>)> = batches
            .iter()
            .map(|(batch, pupil)| (*batch, pupil.sums.iter().map(value).collect()))
            .collect();
        Ok((self.moments(&values, 0, n_configurations), learned))
    }

    fn moments(&self, batches: &[(Batch, Vec<Sums>)], rows: usize, n: usize) -> Vec<Moments> {
        let mut moments = vec![Moments::default(); n];
        for (g, group) in self.groups.iter().enumerate() {
            for (lamp, &member) in group.members.iter().enumerate() {
                let mine = batches.iter().filter(|(batch, _)| batch.group == g);
                let sums = mine.map(|(batch, sums)| (&sums[lamp], batch.paths as f64));
                moments[member] = combine(sums, rows);
            }
        }
        moments
    }
}

pub(super) fn interrupted() -> Error {
    Error::new("interrupted")
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

/// What the pilots have settled so far; vectors hold one entry per group, `moments` one per configuration.
struct Settled {
    moments: Vec<Moments>,
    /// Paths of the latest pilot.
    paths: Vec<u64>,
    guides: Vec<Guide>,
    /// Weighted variance of one path, and its cost in rays, at the latest pilot.
    variance: Vec<f64>,
    cost: Vec<f64>,
    /// The same of a path without a guide.
    unguided: Vec<[f64; 2]>,
    /// Whether a guide made things worse: then there is none any more.
    refused: Vec<bool>,
}

impl Settled {
    fn nothing(n_configurations: usize, groups: usize) -> Self {
        Self {
            moments: vec![Moments::default(); n_configurations],
            paths: vec![0; groups],
            guides: vec![Guide::FRESH; groups],
            variance: vec![0.0; groups],
            cost: vec![1.0; groups],
            unguided: vec![[f64::INFINITY; 2]; groups],
            refused: vec![false; groups],
        }
    }

    /// Takes over a pilot's results, and learns from it where it was large enough. A guide that made things clearly worse
    /// is dropped for good.
    fn learn<F: Followed>(
        &mut self,
        round: &Round<'_, F>,
        moments: Vec<Moments>,
        learned: &[Learned],
    ) {
        for (g, (lesson, rays)) in learned.iter().enumerate() {
            let members = &round.groups[g].members;
            let paths = round.paths[g] as f64;
            let variance: f64 = members
                .iter()
                .map(|&m| weighted_variance(&moments[m]))
                .sum();
            let (rays, variance) = (rays / paths, variance * paths);
            let fresh = round.guides[g].is_fresh();
            let cost = if fresh { rays } else { GUIDED_RAY * rays };
            (self.variance[g], self.cost[g]) = (variance, cost);
            if fresh {
                self.unguided[g] = [variance, cost];
            }
            let [unguided_variance, unguided_cost] = self.unguided[g];
            if cost * variance > CLEARLY * unguided_cost * unguided_variance {
                self.refused[g] = true;
                (self.variance[g], self.cost[g]) = (unguided_variance, unguided_cost);
            }
            let guide = if self.refused[g] || round.paths[g] < SCHOOL {
                None
            } else {
                let weight = |&m: &usize| relative_error_weight(moments[m].mean.value, TAU);
                let weights: Vec<f64> = members.iter().map(weight).collect();
                lesson.guide(&weights, rays / variance)
            };
            self.guides[g] = guide.unwrap_or(Guide::FRESH);
        }
        self.moments = moments;
        self.paths.clone_from(&round.paths);
    }
}

/// The round of paths that are kept, its path counts and rules settled by pilots.
pub(super) fn plan<'a, F: Followed>(
    followed: &'a F,
    groups: &'a [Group],
    request: &Request<'_>,
    watch: &dyn Watch,
) -> Result<Round<'a, F>> {
    let n = request.configurations.len();
    let round = |number: u64, paths: Vec<u64>, settled: &Settled, stage_name| Round {
        followed,
        groups,
        paths,
        worth: worth(&settled.moments),
        guides: settled.guides.clone(),
        key: [request.seed, request.stream, number],
        stage_name,
    };
    let mut settled = Settled::nothing(n, groups.len());
    let pilot = |number: u64, paths: Vec<u64>, settled: &mut Settled| -> Result<()> {
        let round = round(number, paths, settled, "pilot");
        let (moments, learned) = round.pilot(n, watch)?;
        for (c, m) in request.configurations.iter().zip(&moments) {
            finished(c.id, m, 0, 0, request.parameters)?; // refuses what is not finite
        }
        settled.learn(&round, moments, &learned);
        Ok(())
    };
    let final_paths = match planned_paths(&request.effort, groups) {
        Some(planned) => {
            for (number, paths) in planned_pilots(&planned).into_iter().enumerate() {
                pilot(number as u64, paths, &mut settled)?;
            }
            planned
        }
        None => {
            let Effort::Accuracy(target) = request.effort else {
                unreachable!("only an accuracy leaves the path counts open")
            };
            pilot(0, vec![2048; groups.len()], &mut settled)?;
            // Rare bright paths make a small pilot's variances too low: repeat with larger ones until a pilot is about an
            // eighth of the work it predicts.
            let needed = |s: &Settled| paths_for_accuracy(&s.variance, &s.cost, n, AIM * target);
            for number in 1..MAX_PILOTS {
                let wanted = needed(&settled);
                if 9 * settled.paths.iter().sum::<u64>() >= wanted.iter().sum::<u64>() {
                    break;
                }
                let larger = wanted.iter().map(|n| (n / 8).max(MIN_PATHS)).collect();
                pilot(number, larger, &mut settled)?;
            }
            needed(&settled)
        }
    };
    Ok(round(MAX_PILOTS, final_paths, &settled, "render"))
}

/// See [`super::Scene::estimate`].
pub(super) fn estimate(
    followed: &impl Followed,
    rows: Rows,
    clock: &Clock,
    request: &Request<'_>,
    watch: &dyn Watch,
) -> Result<Estimates> {
    let configurations = request.configurations;
    let groups = groups(followed.options(), configurations);
    let last = plan(followed, &groups, request, watch)?;
    let moments = last.render(rows, configurations.len(), watch)?;
    let finish = |(index, c): (usize, &Configuration)| {
        let paths = last.paths_of(index);
        finished(c.id, &moments[index], rows.all, paths, request.parameters)
    };
    Ok(Estimates {
        configurations: configurations
            .iter()
            .enumerate()
            .map(finish)
            .collect::<Result<_>>()?,
        cpu_s: clock.cpu_s(),
        wall_s: clock.wall_s(),
    })
}

/// Sizes of the pilots before a planned number of paths: a small one without guide, and one more to learn from where
/// there is enough to gain.
fn planned_pilots(planned: &[u64]) -> Vec<Vec<u64>> {
    let of = |part: u64| -> Vec<u64> {
        planned
            .iter()
            .map(|n| (n / part).clamp(MIN_PATHS, 8192))
            .collect()
    };
    if planned.iter().any(|n| n / 16 >= SCHOOL) {
        vec![of(16), of(12)]
    } else {
        vec![of(16)]
    }
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
            "configuration {config}: the render is not finite (mean {:?}, variance {:?}) at {}",
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

/// What a task takes.
pub(super) struct Clock {
    wall: std::time::Instant,
    cpu: f64,
}

impl Clock {
    pub(super) fn now() -> Self {
        Self {
            wall: std::time::Instant::now(),
            cpu: cpu_seconds(),
        }
    }

    /// CPU time of all threads since then, seconds.
    pub(super) fn cpu_s(&self) -> f64 {
        cpu_seconds() - self.cpu
    }

    /// Elapsed time since then, seconds.
    pub(super) fn wall_s(&self) -> f64 {
        self.wall.elapsed().as_secs_f64()
    }
}

/// CPU time of this process so far, all threads, seconds.
pub(super) fn cpu_seconds() -> f64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    t.tv_sec as f64 + t.tv_nsec as f64 * 1e-9
}
