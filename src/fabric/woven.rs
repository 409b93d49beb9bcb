//! A woven description (weave, two yarn systems, segmentation) and the tile it makes.
//!
//! The tile holds a whole number of weave repeats, so twist turns and migration periods per tile are rounded to the
//! nearest whole number; [`Closing`] tells what was asked and what was used.

use super::centerline::CenterLine;
use super::weave::Draft;
use super::yarn::{Strand, Yarn, YarnShape};
use super::{FiberTile, Segment};
use crate::base::{Error, Result};
use crate::math::Random;
use glam::DVec3;
use rayon::prelude::*;
use std::f64::consts::TAU;

/// Most segments a tile may have (1.4 GB of them).
pub const MAX_SEGMENTS: usize = 20_000_000;

/// A closed fiber needs at least this many segments to be told from a straight line back and forth.
const MIN_SEGMENTS_PER_FIBER: usize = 3;

/// Stream numbers of the keyed randomness, after the fabric's seed.
const STREAM_PHASE: u64 = 1;
const STREAM_FIBER: u64 = 2;

/// One yarn system as described by the user; lengths in millimeters, angles in radians.
#[derive(Debug, Clone, PartialEq)]
pub struct System {
    /// Distance between neighboring yarns.
    pub pitch: f64,
    /// Fibers per yarn.
    pub fibers: u32,
    /// Fiber radius.
    pub fiber_radius: f64,
    /// Full width of the yarn's section.
    pub width: f64,
    /// Full thickness of the yarn's section.
    pub thickness: f64,
    /// Height of the center line's crowns over the middle plane.
    pub crown: f64,
    /// Li's u_max.
    pub crown_angle: f64,
    /// Twist, turns per millimeter; positive is Z twist.
    pub twist: f64,
    /// Li's G.
    pub migration_depth: f64,
    /// Migration periods per millimeter.
    pub migration: f64,
    /// Upper limit of Li's J.
    pub jitter: f64,
    /// Fiber density, g/cm^3, when known.
    pub density: Option<f64>,
}

/// How fibers are cut into straight segments.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Segmentation {
    /// Segments of this length along the yarn's axis, millimeters (rounded so that a whole number fits).
    Length(f64),
    /// As many as keep curve and chord closer than this at segment middles, millimeters; the same number for all fibers of
    /// a system, all of the same length along the axis.
    ChordError(f64),
    /// As few as keep every fiber closer to its segments than this, millimeters: short where a fiber bends, long where it
    /// is straight.
    Tolerance(f64),
}

/// Where the fibers of a system are cut.
#[derive(Debug, Clone)]
pub(crate) enum Cuts {
    /// Into so many pieces of the same length along the axis.
    Even(usize),
    /// Each at its own places: positions along the axis, millimeters, from 0, for each fiber of each yarn.
    Own(Vec<Vec<f64>>),
}

/// Everything the generator needs.
#[derive(Debug, Clone, PartialEq)]
pub struct Woven {
    /// The weave.
    pub draft: Draft,
    /// Weave repeats per tile along x and y.
    pub repeats: [usize; 2],
    /// Half width of the blend around each change of side, cells.
    pub join: f64,
    /// The warp system (along y).
    pub warp: System,
    /// The weft system (along x).
    pub weft: System,
    /// Segment length rule.
    pub segmentation: Segmentation,
    /// Seed of the fibers' random numbers.
    pub seed: u64,
}

/// A rate that was rounded so that the tile closes.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Closing {
    /// `warp` or `weft`.
    pub system: &'static str,
    /// `twist turns` or `migration periods`.
    pub quantity: &'static str,
    /// As described, per tile.
    pub asked_per_tile: f64,
    /// As generated, per tile.
    pub used_per_tile: i32,
}

/// One yarn system made concrete on the tile.
#[derive(Debug, Clone)]
pub(crate) struct WovenSystem {
    pub(crate) name: &'static str,
    pub(crate) pitch: f64,
    pub(crate) shape: YarnShape,
    pub(crate) yarns: Vec<Yarn>,
    pub(crate) fiber_radius: f64,
    pub(crate) cuts: Cuts,
    pub(crate) strands: Vec<Vec<Strand>>,
}

/// The concrete swatch before its fibers are cut into segments.
#[derive(Debug, Clone)]
pub(crate) struct Swatch {
    pub(crate) size: [f64; 2],
    /// Warp, weft.
    pub(crate) systems: [WovenSystem; 2],
    pub(crate) closings: Vec<Closing>,
    /// Largest distance of a curve from the middle of its chord, millimeters.
    pub(crate) chord_error: f64,
}

impl Woven {
    /// Tile size in x and y, millimeters.
    pub fn size(&self) -> [f64; 2] {
        [
            (self.draft.columns() * self.repeats[0]) as f64 * self.warp.pitch,
            (self.draft.rows() * self.repeats[1]) as f64 * self.weft.pitch,
        ]
    }

    /// Lays yarns and fibers.
    ///
    /// # Errors
    /// The tile would have more than [`MAX_SEGMENTS`] segments.
    pub(crate) fn swatch(&self) -> Result<Swatch> {
        self.check_fibers()?;
        let mut closings = Vec::new();
        let warp = self.system(0, &mut closings);
        let weft = self.system(1, &mut closings);
        let mut swatch = Swatch {
            size: self.size(),
            systems: [warp, weft],
            closings,
            chord_error: 0.0,
        };
        match self.segmentation {
            Segmentation::Length(length) => {
                for system in &mut swatch.systems {
                    let n = (system.yarns[0].length / length)
                        .round()
                        .max(MIN_SEGMENTS_PER_FIBER as f64);
                    system.cuts = Cuts::Even(n.min(u32::MAX.into()) as usize);
                }
                swatch.check_count()?;
            }
            Segmentation::ChordError(limit) => swatch.refine(limit)?,
            Segmentation::Tolerance(limit) => {
                for system in &mut swatch.systems {
                    system.cuts = Cuts::Own(
                        system
                            .fibers()
                            .map(|(yarn, strand)| system.places(yarn, strand, limit))
                            .collect(),
                    );
                }
                swatch.check_count()?;
            }
        }
        swatch.chord_error = swatch
            .systems
            .iter()
            .map(WovenSystem::chord_error)
            .fold(0.0, f64::max);
        Ok(swatch)
    }

    /// Refuses counts that could not even be laid, before any memory is taken for them.
    fn check_fibers(&self) -> Result<()> {
        let yarns = |per_repeat: usize, repeats: usize| per_repeat.saturating_mul(repeats);
        let warp =
            yarns(self.draft.columns(), self.repeats[0]).saturating_mul(self.warp.fibers as usize);
        let weft =
            yarns(self.draft.rows(), self.repeats[1]).saturating_mul(self.weft.fibers as usize);
        let fibers = warp.saturating_add(weft);
        if fibers <= MAX_SEGMENTS / MIN_SEGMENTS_PER_FIBER {
            return Ok(());
        }
        Err(Error::new(format!(
            "the tile would have {fibers} fibers: expected at most {}",
            MAX_SEGMENTS / MIN_SEGMENTS_PER_FIBER
        ))
        .with_hint("fewer [warp]/[weft] fibers, or fewer [weave] repeats"))
    }

    fn system(&self, index: usize, closings: &mut Vec<Closing>) -> WovenSystem {
        let size = self.size();
        let (name, own, other) = if index == 0 {
            ("warp", &self.warp, &self.weft)
        } else {
            ("weft", &self.weft, &self.warp)
        };
        let length = size[1 - index];
        let mut close = |quantity, rate: f64| {
            let asked = rate * length;
            let used = asked.round() as i32;
            if (asked - f64::from(used)).abs() > 1e-9 {
                closings.push(Closing {
                    system: name,
                    quantity,
                    asked_per_tile: asked,
                    used_per_tile: used,
                });
            }
            used
        };
        let shape = YarnShape {
            fibers: own.fibers,
            width: own.width,
            thickness: own.thickness,
            jitter: own.jitter,
            migration_depth: own.migration_depth,
            turns: close("twist turns", own.twist),
            migrations: close("migration periods", own.migration),
        };
        let repeat = [self.draft.columns(), self.draft.rows()][index];
        let count = repeat * self.repeats[index];
        let yarns: Vec<Yarn> = (0..count)
            .map(|k| self.yarn(index, k, own, other.pitch, length))
            .collect();
        let strands = yarns
            .iter()
            .enumerate()
            .map(|(k, yarn)| self.strands(index, k, &shape, yarn.phase))
            .collect();
        WovenSystem {
            name,
            pitch: own.pitch,
            shape,
            yarns,
            fiber_radius: own.fiber_radius,
            cuts: Cuts::Even(0),
            strands,
        }
    }

    fn yarn(&self, index: usize, k: usize, own: &System, cell: f64, length: f64) -> Yarn {
        let across = (k as f64 + 0.5) * own.pitch;
        let (cells, origin, axis, lateral) = if index == 0 {
            let cells = self.draft.warp_cells(k % self.draft.columns());
            (cells, DVec3::new(across, 0.0, 0.0), DVec3::Y, -DVec3::X)
        } else {
            let cells = self.draft.weft_cells(k % self.draft.rows());
            (cells, DVec3::new(0.0, across, 0.0), DVec3::X, DVec3::Y)
        };
        let mut random = Random::keyed(&[self.seed, STREAM_PHASE, index as u64, k as u64]);
        Yarn {
            origin,
            axis,
            lateral,
            length,
            cell,
            line: CenterLine::new(&cells, own.crown, own.crown_angle, self.join),
            phase: TAU * random.uniform(),
        }
    }

    fn strands(&self, index: usize, k: usize, shape: &YarnShape, phase: f64) -> Vec<Strand> {
        (1..=shape.fibers)
            .map(|i| {
                let key = [
                    self.seed,
                    STREAM_FIBER,
                    index as u64,
                    k as u64,
                    u64::from(i),
                ];
                Strand::draw(shape, i, phase, &mut Random::keyed(&key))
            })
            .collect()
    }
}

impl WovenSystem {
    /// Every fiber of every yarn, yarn by yarn.
    fn fibers(&self) -> impl IndexedParallelIterator<Item = (&Yarn, &Strand)> {
        let per_yarn = self.shape.fibers as usize;
        (0..self.yarns.len() * per_yarn)
            .into_par_iter()
            .map(move |k| {
                (
                    &self.yarns[k / per_yarn],
                    &self.strands[k / per_yarn][k % per_yarn],
                )
            })
    }

    /// Segments of all fibers.
    fn segment_count(&self) -> usize {
        match &self.cuts {
            Cuts::Even(n) => self
                .yarns
                .len()
                .saturating_mul(self.shape.fibers as usize)
                .saturating_mul(*n),
            Cuts::Own(places) => places.iter().map(Vec::len).sum(),
        }
    }

    /// Segments of a fiber: the mean, rounded.
    pub(crate) fn segments_per_fiber(&self) -> usize {
        let fibers = self.yarns.len() * self.shape.fibers as usize;
        (self.segment_count() as f64 / fibers as f64).round() as usize
    }

    /// Where fiber `index` (yarn by yarn) of the given length begins its segments.
    fn places_of(&self, index: usize, length: f64) -> Vec<f64> {
        match &self.cuts {
            Cuts::Even(n) => (0..*n).map(|k| length * k as f64 / *n as f64).collect(),
            Cuts::Own(places) => places[index].clone(),
        }
    }

    /// Largest distance of a curve from its segment, at segment middles (even cuts) or at seven points of each, millimeters.
    fn chord_error(&self) -> f64 {
        self.fibers()
            .enumerate()
            .map(|(index, (yarn, strand))| {
                let places = self.places_of(index, yarn.length);
                let checks: &[f64] = match self.cuts {
                    Cuts::Even(_) => &[0.5],
                    Cuts::Own(_) => &CHECKS,
                };
                self.error_of(yarn, strand, &places, checks)
            })
            .reduce(|| 0.0, f64::max)
    }

    /// Largest distance of one fiber from its segments, at the fractions `checks` of each.
    fn error_of(&self, yarn: &Yarn, strand: &Strand, places: &[f64], checks: &[f64]) -> f64 {
        let at = |s: f64| yarn.point(&self.shape, strand, s);
        let ends = places.iter().skip(1).chain([&yarn.length]);
        places
            .iter()
            .zip(ends)
            .map(|(&from, &to)| {
                let (a, chord) = (at(from), (at(to) - at(from)).normalize());
                checks
                    .iter()
                    .map(|u| (at(from + u * (to - from)) - a).cross(chord).length())
                    .fold(0.0, f64::max)
            })
            .fold(0.0, f64::max)
    }

    /// Cuts one fiber so that it stays within `limit` of its segments, and those are as few and as equal in error as the
    /// curvature k tells: an arc of length l leaves its chord by k l^2 / 8, so cuts lie at equal steps of the integral
    /// of sqrt(k / (8 limit)) over the arc.
    fn places(&self, yarn: &Yarn, strand: &Strand, limit: f64) -> Vec<f64> {
        let cells = (yarn.length / yarn.cell).round().max(1.0) as usize;
        let n = FINE_STEPS * cells;
        let step = yarn.length / n as f64;
        let at = |k: f64| yarn.point(&self.shape, strand, step * k);
        // The same integral, from how far each fine piece leaves its own chord.
        let weights: Vec<f64> = (0..n)
            .map(|k| {
                let k = k as f64;
                let (a, m, b) = (at(k), at(k + 0.5), at(k + 1.0));
                let sagitta = (m - a).cross((b - a).normalize()).length();
                (sagitta / limit).sqrt()
            })
            .collect();
        // A tenth of the mean weight everywhere: a straight stretch is not cut less than ten times as often.
        let least = 0.1 * weights.iter().sum::<f64>() / n as f64;
        let total: f64 = weights.iter().map(|w| w.max(least)).sum();
        let mut count = (total.ceil() as usize).max(MIN_SEGMENTS_PER_FIBER);
        loop {
            let places = spread(&weights, least, total, count, step);
            let error = self.error_of(yarn, strand, &places, &CHECKS);
            if error <= limit || count >= MAX_SEGMENTS {
                return places;
            }
            count += (count as f64 * ((error / limit).sqrt() - 1.0).clamp(0.0, 1.0) * 0.5).ceil()
                as usize
                + 1;
        }
    }
}

/// Where along a segment its distance from the curve is checked.
const CHECKS: [f64; 7] = [0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875];

/// Pieces per weave cell on which a fiber's curvature is measured.
const FINE_STEPS: usize = 64;

/// `count` places at equal steps of the sum of `weights` (each at least `least`), which belong to pieces of length `step`.
fn spread(weights: &[f64], least: f64, total: f64, count: usize, step: f64) -> Vec<f64> {
    let mut places = Vec::with_capacity(count);
    let (mut sum, mut piece) = (0.0, 0);
    for k in 0..count {
        let wanted = total * k as f64 / count as f64;
        while piece + 1 < weights.len() && sum + weights[piece].max(least) <= wanted {
            sum += weights[piece].max(least);
            piece += 1;
        }
        let within = (wanted - sum) / weights[piece].max(least);
        places.push(step * (piece as f64 + within.clamp(0.0, 1.0)));
    }
    places
}

impl Swatch {
    fn segment_count(&self) -> usize {
        self.systems
            .iter()
            .map(WovenSystem::segment_count)
            .fold(0, usize::saturating_add)
    }

    fn check_count(&self) -> Result<()> {
        let count = self.segment_count();
        if count <= MAX_SEGMENTS {
            return Ok(());
        }
        Err(Error::new(format!(
            "the tile would have {count} segments: expected at most {MAX_SEGMENTS}"
        ))
        .with_hint(
            "fewer fibers or repeats, or longer segments ([segments] length_mm, chord_error_um, tolerance_um)",
        ))
    }

    /// Finds for each system a segment count that keeps the chord error under `limit`.
    fn refine(&mut self, limit: f64) -> Result<()> {
        for index in 0..2 {
            let cells = self.systems[index].yarns[0].length / self.systems[index].yarns[0].cell;
            let mut count = 8 * cells.round() as usize;
            loop {
                self.systems[index].cuts = Cuts::Even(count);
                self.check_count()?;
                let error = self.systems[index].chord_error();
                if error <= limit {
                    break;
                }
                // The error falls with the square of the count; 1.02 so that the end is reached.
                let factor = 1.02 * (error / limit).sqrt();
                count = (count as f64 * factor).ceil().min(u32::MAX.into()) as usize;
            }
        }
        Ok(())
    }

    /// Cuts all fibers into segments: warp first, yarn by yarn, each fiber's segments in order, the last one linked to
    /// the first across the seam.
    pub(crate) fn tile(&self) -> FiberTile {
        let mut segments = Vec::with_capacity(self.segment_count());
        for (index, system) in self.systems.iter().enumerate() {
            let curves: Vec<Vec<DVec3>> = system
                .fibers()
                .enumerate()
                .map(|(fiber, (yarn, strand))| {
                    let mut points: Vec<DVec3> = system
                        .places_of(fiber, yarn.length)
                        .into_iter()
                        .map(|s| yarn.point(&system.shape, strand, s))
                        .collect();
                    points.push(points[0] + yarn.axis * yarn.length);
                    points
                })
                .collect();
            for points in curves {
                push_closed(&mut segments, &points, system.fiber_radius, index as u8);
            }
        }
        FiberTile {
            size: self.size,
            segments,
        }
    }
}

/// Appends the segments of a polyline whose last point repeats the first one in another copy of the tile.
fn push_closed(segments: &mut Vec<Segment>, points: &[DVec3], radius: f64, yarn_system: u8) {
    let first = segments.len() as u32;
    let n = points.len() as u32 - 1;
    for (k, pair) in (0..n).zip(points.windows(2)) {
        segments.push(Segment {
            start: pair[0],
            end: pair[1],
            radius,
            yarn_system,
            previous: first + (k + n - 1) % n,
            next: first + (k + 1) % n,
        });
    }
}
