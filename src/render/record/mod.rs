//! Recorded paths: means and derivatives at other parameters without tracing.
//!
//! Where a path goes depends on the parameters only through probabilities. So its contribution at other parameters is the
//! product of `S` there over its events, times factors that stay: cosines, sampling densities, roulette. A [`Recording`]
//! keeps per event what the model needs for `S` and that factor, about 20 bytes, and only of paths that reach a lamp.
//! Near the parameters of the recording its estimates are as unbiased as traced ones, and as good; farther away they
//! come from ever fewer paths that matter, and at last are wrong *without their standard errors saying so*. Hence every
//! estimate brings its [`Trust`].

mod pair;
mod recorder;
mod replay;
mod trust;

pub use pair::RecordingPair;
pub use trust::{ConfigurationTrust, TRUST_THRESHOLD, Trust};

use super::allocation::{Group, groups};
use super::estimate::{self, cpu_seconds};
use super::scene::{FiberPaths, FiberScene, Integrator};
use super::{Estimates, Recall, Request};
use crate::base::{Error, Result, Watch};
use crate::scatter::{BatchEvaluate, CHANNELS, Defensive, Model, OneByOne, Parameters, Scattering};
use rayon::prelude::*;
use recorder::{Page, Recorder};
use replay::{Kernels, LampSums, Replay};
use std::sync::atomic::{AtomicU64, Ordering};
use trust::Shares;

/// How paths are recorded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RecordOptions {
    /// Share of the bounces that is drawn from wider lobes, in [0, 1): it costs a little accuracy at the recording's
    /// parameters and extends the reach to larger widths.
    pub defensive: f64,
    /// How much wider these lobes are, see [`Model::widened`].
    pub widening: f64,
    /// Most memory the recording may take, bytes.
    pub budget: u64,
}

impl Default for RecordOptions {
    fn default() -> Self {
        Self {
            defensive: 0.1,
            widening: 1.5,
            budget: 2 << 30,
        }
    }
}

/// Some paths of one group.
struct RecordedBatch {
    group: usize,
    paths: u64,
    pages: Vec<Page>,
}

/// Paths of all configurations of a request, to be evaluated at other parameters.
pub struct Recording {
    model: &'static dyn Model,
    parameters: Parameters,
    /// Per configuration: its id and its camera paths.
    configurations: Vec<(u32, u64)>,
    /// Per group: its configurations, in the order of its lamps.
    members: Vec<Vec<usize>>,
    batches: Vec<RecordedBatch>,
    /// Per group and lamp: inverses of the means at the parameters of the recording, so that no channel outshines the others
    /// where paths are weighed against each other.
    weights: Vec<Vec<[f32; CHANNELS]>>,
}

/// What a recording says at some parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Recalled {
    /// Means, derivatives and their standard errors from the scatter of the same batches as of a traced estimate.
    pub estimates: Estimates,
    /// Whether to believe them.
    pub trust: Trust,
}

impl std::fmt::Debug for Recording {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Recording")
            .field("parameters", &self.parameters)
            .field("paths", &self.paths())
            .field("events", &self.events())
            .field("bytes", &self.bytes())
            .finish_non_exhaustive()
    }
}

impl FiberScene {
    /// Traces the request's paths as [`super::Scene::estimate`] does with [`Integrator::Fast`] and records them. Without
    /// defensive sampling they are the same paths.
    ///
    /// # Errors
    /// As [`super::Scene::estimate`]; when the integrator is another; when the options have no meaning; when the recording
    /// would exceed its budget.
    pub fn record(
        &self,
        request: &Request<'_>,
        options: &RecordOptions,
        watch: &dyn Watch,
    ) -> Result<Recording> {
        request.check()?;
        self.check_poses(request.configurations)?;
        check(options, self.options.integrator)?;
        let at = self.model.prepare_each(request.parameters)?;
        let kernels = kernels(&at);
        let widened = self.model.widened(request.parameters, options.widening);
        let wide = self.model.prepare_each(&widened)?;
        let mut mixtures: Vec<Box<dyn Scattering + '_>> = Vec::new();
        for (at, wide) in at.iter().zip(&wide) {
            mixtures.push(Box::new(Defensive {
                at: &**at,
                wide: &**wide,
                share: options.defensive,
            }));
        }
        let sampled = if options.defensive > 0.0 {
            &mixtures
        } else {
            &at
        };
        let groups = groups(&self.options, request.configurations);
        let paths = FiberPaths {
            scene: self,
            sets: sampled,
        };
        let round = estimate::plan(&paths, &groups, request, watch)?;
        let used = AtomicU64::new(0);
        let recorded = round.run(watch, |batch| {
            let mut recorder = Recorder::new(&*kernels[0], groups[batch.group].lamps.len());
            round.trace(batch, &mut recorder, Recorder::end_path);
            let pages = recorder.finish()?;
            let bytes: usize = pages.iter().map(Page::bytes).sum();
            let total = used.fetch_add(bytes as u64, Ordering::Relaxed) + bytes as u64;
            if total > options.budget {
                return Err(over_budget(options.budget, round.total_paths()));
            }
            Ok(pages)
        })?;
        let batches = recorded.into_iter().map(|(batch, pages)| RecordedBatch {
            group: batch.group,
            paths: batch.paths,
            pages,
        });
        let ids = request.configurations.iter().enumerate();
        let ones = |g: &Group| vec![[1.0; CHANNELS]; g.members.len()];
        let mut recording = Recording {
            model: self.model,
            parameters: request.parameters.clone(),
            configurations: ids.map(|(i, c)| (c.id, round.paths_of(i))).collect(),
            members: groups.iter().map(|g| g.members.clone()).collect(),
            batches: batches.collect(),
            weights: groups.iter().map(ones).collect(),
        };
        recording.weigh(&kernels);
        Ok(recording)
    }
}

fn check(options: &RecordOptions, integrator: Integrator) -> Result<()> {
    if integrator != Integrator::Fast {
        return Err(Error::new(format!(
            "paths of the {integrator:?} integrator cannot be recorded"
        ))
        .with_hint("record with the fast integrator: it estimates the same means"));
    }
    if !(0.0..1.0).contains(&options.defensive) {
        return Err(Error::new(format!(
            "defensive share {}: expected 0 to below 1",
            options.defensive
        ))
        .with_hint("0.1 draws a tenth of the bounces from wider lobes"));
    }
    if !(1.0..=10.0).contains(&options.widening) {
        return Err(Error::new(format!(
            "widening {}: expected 1 to 10",
            options.widening
        )));
    }
    Ok(())
}

fn over_budget(budget: u64, paths: u64) -> Error {
    Error::new(format!(
        "recording {paths} paths takes more than the budget of {:.3} MB",
        budget as f64 * 1e-6
    ))
    .with_hint("record fewer paths, or allow more memory: a path takes about 100 to 300 bytes")
}

/// The model's kernels, or the one that serves all models.
fn kernels(sets: &[Box<dyn Scattering>]) -> Vec<Box<dyn BatchEvaluate + '_>> {
    sets.iter().map(|s| kernel(&**s)).collect()
}

fn kernel(scattering: &dyn Scattering) -> Box<dyn BatchEvaluate + '_> {
    match scattering.batch() {
        Some(kernel) => kernel,
        None => Box::new(OneByOne(scattering)),
    }
}

impl Recording {
    /// The parameters of the recording.
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// Camera paths traced, of all groups.
    pub fn paths(&self) -> u64 {
        self.batches.iter().map(|b| b.paths).sum()
    }

    /// Events kept.
    pub fn events(&self) -> u64 {
        self.pages().map(|p| p.events() as u64).sum()
    }

    /// Memory taken, bytes.
    pub fn bytes(&self) -> u64 {
        self.pages().map(|p| p.bytes() as u64).sum()
    }

    fn pages(&self) -> impl Iterator<Item = &Page> {
        self.batches.iter().flat_map(|b| &b.pages)
    }

    /// Means and derivatives at `parameters`, with standard errors from the scatter of batches, and whether to trust
    /// them. The same on any number of threads.
    ///
    /// # Errors
    /// When the parameters have no meaning for the model, or a number is not finite.
    pub fn estimate(&self, parameters: &Parameters) -> Result<Recalled> {
        self.recall(parameters, self.model.parameters().len())
    }

    /// As [`Recording::estimate`] without derivatives, in about two thirds of the time.
    ///
    /// # Errors
    /// As [`Recording::estimate`].
    pub fn means(&self, parameters: &Parameters) -> Result<Recalled> {
        self.recall(parameters, 0)
    }

    fn recall(&self, parameters: &Parameters, rows: usize) -> Result<Recalled> {
        let clock = (std::time::Instant::now(), cpu_seconds());
        let sets = self.model.prepare_each(parameters)?;
        let sums = self.sums(&kernels(&sets), rows);
        let estimate = |(index, &(id, paths)): (usize, &(u32, u64))| {
            let mine = self.of_configuration(index, &sums);
            let moments = estimate::combine(mine.map(|(sums, n)| (&sums.sums, n)), rows);
            estimate::finished(id, &moments, rows, paths, parameters)
        };
        let trust = |(index, &(id, _)): (usize, &(u32, u64))| {
            let mine = self.of_configuration(index, &sums);
            let shares = mine.fold(Shares::default(), |all, (sums, _)| all.merge(&sums.shares));
            shares.trust(id)
        };
        let configurations = || self.configurations.iter().enumerate();
        Ok(Recalled {
            estimates: Estimates {
                configurations: configurations().map(estimate).collect::<Result<_>>()?,
                cpu_s: cpu_seconds() - clock.1,
                wall_s: clock.0.elapsed().as_secs_f64(),
            },
            trust: Trust {
                configurations: configurations().map(trust).collect(),
            },
        })
    }

    /// Sums of every batch, per lamp of its group.
    fn sums(&self, kernels: Kernels<'_>, rows: usize) -> Vec<Vec<LampSums>> {
        let one = |replay: &mut Replay, batch: &RecordedBatch| {
            let weights = &self.weights[batch.group];
            let mut lamps = vec![LampSums::default(); weights.len()];
            for page in &batch.pages {
                replay.add(page, kernels, rows, weights, &mut lamps);
            }
            lamps
        };
        let batches = self.batches.par_iter();
        batches.map_init(Replay::default, one).collect()
    }

    /// The sums that belong to a configuration, with the paths of each.
    fn of_configuration<'a>(
        &'a self,
        index: usize,
        sums: &'a [Vec<LampSums>],
    ) -> impl Iterator<Item = (&'a LampSums, f64)> + Clone {
        let lamp = |members: &Vec<usize>| members.iter().position(|&m| m == index);
        let found = self.members.iter().map(lamp);
        let found: Vec<Option<usize>> = found.collect();
        let batches = self.batches.iter().zip(sums);
        batches.filter_map(move |(b, sums)| Some((&sums[found[b.group]?], b.paths as f64)))
    }

    /// Keeps what every path contributes at the parameters of the recording.
    fn weigh(&mut self, kernels: Kernels<'_>) {
        let sums = self.sums(kernels, 0);
        for (group, members) in self.members.iter().enumerate() {
            for (lamp, &member) in members.iter().enumerate() {
                let mine = self.of_configuration(member, &sums);
                let total = mine.fold([0.0; CHANNELS], |all, (sums, _)| {
                    std::array::from_fn(|c| all[c] + sums.sums.value[c])
                });
                let paths = self.configurations[member].1 as f64;
                let inverse = |x: f64| if x > 0.0 { (paths / x) as f32 } else { 0.0 };
                self.weights[group][lamp] = total.map(inverse);
            }
        }
        let weights = &self.weights;
        let weigh = |replay: &mut Replay, batch: &mut RecordedBatch| {
            for page in &mut batch.pages {
                page.before = replay.brightness(page, kernels, &weights[batch.group]);
            }
        };
        let batches = self.batches.par_iter_mut();
        batches.for_each_init(Replay::default, weigh);
    }
}

impl Recall for Recording {
    fn recall(&self, parameters: &Parameters) -> Result<Recalled> {
        self.estimate(parameters)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;
    use crate::render::path::{Event, Visitor};
    use crate::render::summation::{Rows, Summation};
    use crate::scatter::Khungurn;
    use glam::DVec3;

    /// Both visitors see the same path.
    struct Both<'a>(Summation, Recorder<'a>);

    impl Visitor for Both<'_> {
        fn bounce(&mut self, depth: usize, event: Event<'_>) {
            self.0.bounce(depth, Event { ..event });
            self.1.bounce(depth, event);
        }
        fn reflect(&mut self, depth: usize, weight: [f64; CHANNELS]) {
            self.0.reflect(depth, weight);
            self.1.reflect(depth, weight);
        }
        fn connect(&mut self, depth: usize, lamp: usize, event: Event<'_>) {
            self.0.connect(depth, lamp, Event { ..event });
            self.1.connect(depth, lamp, event);
        }
        fn arrive(&mut self, depth: usize, lamp: usize, factor: [f64; CHANNELS]) {
            self.0.arrive(depth, lamp, factor);
            self.1.arrive(depth, lamp, factor);
        }
    }

    /// A path that splits up to three times at every event, with connections, arrivals and reflections in between.
    fn grow(depth: usize, at: &dyn Scattering, random: &mut Random, both: &mut Both<'_>) {
        let wo = DVec3::new(random.normal(), random.normal(), random.normal()).normalize();
        let event = |random: &mut Random, use_it: &mut dyn FnMut(Event<'_>)| {
            let factor = 0.3 + random.uniform();
            let Some(sampled) = at.sample(&at.outgoing(wo, 0.0, [1.0; CHANNELS]), random) else {
                return;
            };
            let evaluation = at.evaluate(sampled.wi, wo, 0.0);
            use_it(Event {
                wi: sampled.wi,
                wo,
                h: 0.0,
                set: 0,
                factor: factor / evaluation.value[1],
                evaluation: &evaluation,
            });
        };
        for lamp in 0..2 {
            if random.uniform() < 0.3 {
                event(random, &mut |e| both.connect(depth, lamp, e));
            }
        }
        let branches = (random.uniform() * 3.0) as usize;
        for _ in 0..branches.min(6_usize.saturating_sub(depth)) {
            if random.uniform() < 0.2 {
                both.reflect(depth, [0.3, 0.5, 0.9]);
            } else {
                event(random, &mut |e| both.bounce(depth, e));
            }
            if random.uniform() < 0.2 {
                both.arrive(depth + 1, 1, [0.1, 0.2, 0.3]);
            }
            grow(depth + 1, at, random, both);
        }
    }

    #[test]
    fn branching_paths_give_their_traced_sums() {
        let parameters = Parameters::defaults(&Khungurn);
        let at = Khungurn.prepare_each(&parameters).unwrap();
        let kernels = kernels(&at);
        let rows = Rows::of(&Khungurn);
        let mut both = Both(Summation::new(rows, 2), Recorder::new(&*kernels[0], 2));
        let mut random = Random::keyed(&[8]);
        for _ in 0..2000 {
            grow(0, &*at[0], &mut random, &mut both);
            both.1.end_path();
        }
        let pages = both.1.finish().unwrap();
        assert!(pages.len() > 3);
        let mut sums = [LampSums::default(); 2];
        let mut wrong = [LampSums::default(); 2];
        let mut replay = Replay::default();
        for mut page in pages {
            let ones = [[1.0; CHANNELS]; 2];
            replay.add(&page, &kernels, 5, &ones, &mut sums);
            // Negative control: every seventh bounce continues another path's start.
            let links = page.bounces.parent.iter_mut().step_by(7);
            links.for_each(|link| *link = 0);
            replay.add(&page, &kernels, 5, &ones, &mut wrong);
        }
        for lamp in 0..2 {
            let (traced, told) = (&both.0.lamps[lamp], &sums[lamp].sums);
            for c in 0..CHANNELS {
                let error = told.value[c] / traced.value[c] - 1.0;
                assert!(error.abs() < 1e-6, "lamp {lamp} channel {c}: {error}");
                for row in 0..5 {
                    let (a, b) = (told.derivative[row][c], traced.derivative[row][c]);
                    let scale = b.abs().max(traced.value[c]);
                    assert!(
                        (a - b).abs() < 1e-5 * scale,
                        "lamp {lamp} row {row}: {a} {b}"
                    );
                }
            }
        }
        let fault = wrong[0].sums.value[0] / both.0.lamps[0].value[0] - 1.0;
        assert!(fault.abs() > 1e-6, "{fault}");
    }
}
