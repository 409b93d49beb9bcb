//! Which branches of a path are worth following: roulette and splitting by what branches like it have been worth.
//!
//! At every hit a few directions are sampled, and each is followed with a probability that depends on what it carries and on
//! its *state*, learned from pilot paths: how deep below the cloth's surface it starts and where it is heading. For the best
//! ratio of variance to work (Rath et al. 2022, efficiency-aware roulette and splitting) that probability is
//! ```text
//! q = sqrt(C / V) sqrt(sum_c T_c^2 M_c / R)
//! ```
//! with `T_c` what the branch carries in channel c, `M_c` the second moment of what branches of that state bring home per
//! unit carried (summed over lamps with the objective's weights), `R` the rays they cost, and `V`, `C` variance and rays of
//! a whole path. Any table gives unbiased estimates as long as it was fixed beforehand: a bad one costs time.

use super::path::{Event, Visitor};
use crate::scatter::CHANNELS;
use glam::DVec3;

/// States: depth below the surface, elevation and azimuth of the direction.
const DEPTHS: usize = 8;
const ELEVATIONS: usize = 6;
const AZIMUTHS: usize = 8;
const STATES: usize = DEPTHS * ELEVATIONS * AZIMUTHS;

/// Points of the height map along each side of the tile.
const MAP: usize = 128;

/// Least probability of following a branch, as a fraction of what it carries.
const FLOOR: f64 = 0.05;

/// Directions sampled at a hit by a guide that has learned.
const CANDIDATES: usize = 3;

/// Branches of average worth that each state is taken to have seen before the pilot.
const PRIOR: f64 = 10.0;

/// Where a branch sets out, as one of [`STATES`] states.
pub(super) struct StateMap {
    size: [f64; 2],
    z_range: [f64; 2],
    /// Height of the cloth's surface.
    top: Vec<f64>,
}

impl StateMap {
    /// `surface` is the height of what is first seen from above at a point of the tile, the cloth reaches over `z_range`.
    pub(super) fn new(
        size: [f64; 2],
        z_range: [f64; 2],
        surface: impl Fn(f64, f64) -> f64,
    ) -> Self {
        let at = |i: usize, size: f64| (i as f64 + 0.5) / MAP as f64 * size;
        let top = (0..MAP * MAP)
            .map(|k| surface(at(k % MAP, size[0]), at(k / MAP, size[1])))
            .collect();
        Self { size, z_range, top }
    }

    /// The state of a branch that sets out from `point` toward `direction`.
    pub(super) fn state(&self, point: DVec3, direction: DVec3) -> usize {
        let part = |x: f64| x - x.floor();
        let cell = |p: f64, size: f64| (part(p / size) * MAP as f64) as usize % MAP;
        let top = self.top[cell(point.y, self.size[1]) * MAP + cell(point.x, self.size[0])];
        let depth = ((top - point.z) / (self.z_range[1] - self.z_range[0])).max(0.0);
        let bin = |unit: f64, n: usize| ((unit * n as f64) as usize).min(n - 1);
        (bin(depth.sqrt(), DEPTHS) * ELEVATIONS + bin(0.5 * (direction.z + 1.0), ELEVATIONS))
            * AZIMUTHS
            + bin(turn(direction), AZIMUTHS)
    }
}

/// The azimuth of a direction as a part of a full turn, along a square instead of a circle: only bins are made of it.
fn turn(d: DVec3) -> f64 {
    let slope = d.y / (d.x.abs() + d.y.abs()).max(1e-300);
    let half = if d.x >= 0.0 { slope } else { 2.0 - slope };
    0.25 * (half + 1.0)
}

/// Advice on which branches to follow, for one group of configurations.
#[derive(Debug, Clone)]
pub(super) struct Guide {
    /// `(C / V) M_c / R` per state; empty before anything was learned.
    merit: Vec<[f64; CHANNELS]>,
}

impl Guide {
    /// Knows nothing: one direction per hit, followed with the probability of the largest channel it carries.
    pub(super) const FRESH: Self = Self { merit: Vec::new() };

    /// True when nothing was learned.
    pub(super) fn is_fresh(&self) -> bool {
        self.merit.is_empty()
    }

    /// How many directions to sample at a hit.
    pub(super) fn candidates(&self) -> usize {
        if self.merit.is_empty() { 1 } else { CANDIDATES }
    }

    /// The probability of following a branch that carries `carried`.
    pub(super) fn survival(&self, state: usize, carried: [f64; CHANNELS]) -> f64 {
        if carried.iter().any(|c| c.is_nan()) {
            return 1.0; // it is found in the result
        }
        let most = carried[0].max(carried[1]).max(carried[2]);
        let Some(merit) = self.merit.get(state) else {
            return most.clamp(FLOOR, 1.0);
        };
        let square: f64 = (0..CHANNELS)
            .map(|c| carried[c] * carried[c] * merit[c])
            .sum();
        square.sqrt().max(FLOOR * most).min(1.0)
    }
}

/// What branches of each state were worth and cost, seen with `lamps` lamps.
#[derive(Debug, Clone)]
pub(super) struct Lesson {
    lamps: usize,
    branches: f64,
    /// Rays per state.
    rays: Vec<f64>,
    /// Squares of what was brought home, per state and lamp.
    squares: Vec<[f64; CHANNELS]>,
}

impl Lesson {
    pub(super) fn new(lamps: usize) -> Self {
        Self {
            lamps,
            branches: 0.0,
            rays: vec![0.0; STATES],
            squares: vec![[0.0; CHANNELS]; STATES * lamps],
        }
    }

    /// One branch: what it brought home from each lamp per unit carried, and the rays it took.
    pub(super) fn add(&mut self, state: usize, home: &[[f64; CHANNELS]], rays: f64) {
        self.branches += 1.0;
        self.rays[state] += rays;
        for (sum, home) in self.squares[state * self.lamps..].iter_mut().zip(home) {
            (0..CHANNELS).for_each(|c| sum[c] += home[c] * home[c]);
        }
    }

    pub(super) fn merge(&mut self, other: &Self) {
        self.branches += other.branches;
        for (mine, theirs) in self.rays.iter_mut().zip(&other.rays) {
            *mine += theirs;
        }
        for (mine, theirs) in self.squares.iter_mut().zip(&other.squares) {
            (0..CHANNELS).for_each(|c| mine[c] += theirs[c]);
        }
    }

    /// The advice that follows when lamps count with `weights`, for paths with this ratio of rays to weighted variance;
    /// none when nothing was seen.
    pub(super) fn guide(&self, weights: &[f64], rays_per_variance: f64) -> Option<Guide> {
        let squares: Vec<[f64; CHANNELS]> = self
            .squares
            .chunks(self.lamps)
            .map(|lamps| {
                let of = |c: usize| lamps.iter().zip(weights).map(|(s, w)| w * s[c]).sum();
                std::array::from_fn(of)
            })
            .collect();
        let total = |c: usize| squares.iter().map(|s| s[c]).sum::<f64>();
        let all: [f64; CHANNELS] = std::array::from_fn(total);
        let all_rays: f64 = self.rays.iter().sum();
        let usable = self.branches > 0.0 && all.iter().sum::<f64>() > 0.0;
        if !(usable && rays_per_variance > 0.0 && rays_per_variance.is_finite()) {
            return None;
        }
        let prior = PRIOR / self.branches;
        let merit = |(square, rays): (&[f64; CHANNELS], &f64)| {
            let rays = rays + prior * all_rays;
            std::array::from_fn(|c| rays_per_variance * (square[c] + prior * all[c]) / rays)
        };
        Some(Guide {
            merit: squares.iter().zip(&self.rays).map(merit).collect(),
        })
    }
}

/// Follows pilot paths: sums what each lamp gives, and draws the lesson from every branch.
pub(super) struct Pupil {
    pub(super) lesson: Lesson,
    pub(super) sums: Vec<[f64; CHANNELS]>,
    pub(super) rays: f64,
    /// The branches being followed, outermost first.
    branches: Vec<Branch>,
    /// `throughput[n]`: what the first `n` events left.
    throughput: Vec<[f64; CHANNELS]>,
}

struct Branch {
    state: usize,
    carried: [f64; CHANNELS],
    home: Vec<[f64; CHANNELS]>,
    rays: f64,
}

impl Pupil {
    pub(super) fn new(lamps: usize) -> Self {
        Self {
            lesson: Lesson::new(lamps),
            sums: vec![[0.0; CHANNELS]; lamps],
            rays: 0.0,
            branches: Vec::new(),
            throughput: vec![[1.0; CHANNELS]],
        }
    }

    /// To be called when a path and all its branches have ended.
    pub(super) fn finish_path(&mut self) {
        self.close(0);
        self.rays += 1.0;
    }

    /// Ends the branches that set out after event number `depth`.
    fn close(&mut self, depth: usize) {
        while self.branches.len() > depth {
            let Some(mut ended) = self.branches.pop() else {
                return;
            };
            let (home, rays) = match self.branches.last_mut() {
                Some(outer) => (&mut outer.home, &mut outer.rays),
                None => (&mut self.sums, &mut self.rays),
            };
            *rays += ended.rays;
            for (sum, brought) in home.iter_mut().zip(&mut ended.home) {
                for c in 0..CHANNELS {
                    sum[c] += brought[c];
                    // A channel that carries nothing brings nothing home: it teaches nothing.
                    if ended.carried[c] > 0.0 {
                        brought[c] /= ended.carried[c];
                    }
                }
            }
            self.lesson.add(ended.state, &ended.home, ended.rays);
        }
    }

    fn go_on(&mut self, depth: usize, weight: [f64; CHANNELS]) {
        self.close(depth);
        let left = std::array::from_fn(|c| self.throughput[depth][c] * weight[c]);
        self.throughput.truncate(depth + 1);
        self.throughput.push(left);
    }

    fn add(&mut self, depth: usize, lamp: usize, weight: [f64; CHANNELS]) {
        self.close(depth);
        let carried = self.throughput[depth];
        let home = match self.branches.last_mut() {
            Some(branch) => &mut branch.home[lamp],
            None => &mut self.sums[lamp],
        };
        (0..CHANNELS).for_each(|c| home[c] += carried[c] * weight[c]);
    }
}

impl Visitor for Pupil {
    fn bounce(&mut self, depth: usize, event: Event<'_>) {
        self.go_on(depth, event.weight());
    }
    fn reflect(&mut self, depth: usize, weight: [f64; CHANNELS]) {
        self.go_on(depth, weight);
    }
    fn connect(&mut self, depth: usize, lamp: usize, event: Event<'_>) {
        self.add(depth, lamp, event.weight());
    }
    fn arrive(&mut self, depth: usize, lamp: usize, factor: [f64; CHANNELS]) {
        self.add(depth, lamp, factor);
    }
    fn set_out(&mut self, depth: usize, state: usize) {
        self.branches.push(Branch {
            state,
            carried: self.throughput[depth],
            home: vec![[0.0; CHANNELS]; self.sums.len()],
            rays: 1.0,
        });
    }
}
