//! The lamp, from the visits of the reference pose: its course, its slope, its flicker.
//!
//! A frame's level is its mean linear signal over the mean of all frames of its exposure, per channel; so everything that
//! stays the same cancels. Flicker is what a frame's level scatters about the straight line between its two neighbors in
//! time, beyond the noise of the pixels: a course that bends between neighbors counts as flicker.

use super::Calibrated;
use super::darks::{Darks, wanted};
use super::least_squares::{Normal, chi_square_limit};
use super::patch::{NAMES, Patch};
use super::readings::{Reading, Rules, check_not_all_clipped};
use super::recording::{Reader, Recording};
use super::transfer::Noise;
use crate::base::{Context, Error, Result, Watch};
use crate::measure::calibration::{Calibrations, Dated, Kind, LampDrift};
use crate::measure::frames::{Moment, Taken, same_exposure};
use crate::measure::linear::Curve;
use crate::session::{FrameKind, Projection, SessionFolder};

/// The level counts as settled within this of its last value.
const SETTLED: f64 = 0.005;

/// More flicker than this is out of tolerance.
const FLICKER: f64 = 0.005;

const HOW: &str = "visit the reference pose again and again (`reference_every` under [lamp] in the rig file), at one exposure that is not clipped, with darks of it";

/// How the lamp behaves, from the visits of the reference pose.
///
/// # Errors
/// Fewer than three visits with an exposure in common that is not clipped, no dark; a frame is missing, torn, changed or
/// of another camera or sensitivity.
pub fn drift(
    session: &SessionFolder,
    known: &Calibrations,
    watch: &dyn Watch,
) -> Result<Calibrated<LampDrift>> {
    let recording = Recording::open(session)?;
    let references = recording.need(FrameKind::Reference, HOW)?;
    let darks = wanted(&recording, &references);
    let frames = [&darks[..], &references[..]].concat();
    let (reader, first) = recording.reader(&frames, watch)?;
    drop(first);
    let course = Course::read(&recording, &reader, &darks, &references, known)?;
    if course.visits.len() < 3 {
        return Err(Error::new(format!(
            "too few visits of the reference pose: {}, at least 3 are needed",
            course.visits.len()
        ))
        .with_hint(HOW));
    }
    let (flicker, flicker_se) = course.flicker();
    let mut warnings = course.warnings.clone();
    let slopes = [0, 1, 2].map(|c| course.slope(c, flicker));
    if slopes.iter().any(|s| s.bent) {
        warnings.push("the lamp's course is not a straight line: the change per hour is a mean, its error is widened".to_owned());
    }
    let (settled_after_s, never) = course.settled_after();
    let mut faults = Vec::new();
    if never {
        faults.push(format!(
            "the lamp has not settled to {} % by the end: let it warm up longer before measuring",
            100.0 * SETTLED
        ));
    }
    if flicker > FLICKER && flicker > 3.0 * flicker_se {
        faults.push(format!(
            "the lamp flickers by {:.2} +- {:.2} % from frame to frame (tolerance {} %): feed it from a steady supply, or expose longer",
            100.0 * flicker,
            100.0 * flicker_se,
            100.0 * FLICKER
        ));
    }
    let value = LampDrift {
        per_hour: slopes.map(|s| s.per_hour),
        per_hour_se: slopes.map(|s| s.se),
        flicker,
        flicker_se,
        settled_after_s,
        visits: course.visits.len(),
    };
    Ok(Calibrated {
        dated: Dated {
            header: recording.header(Kind::Drift),
            value,
        },
        warnings,
        faults,
    })
}

/// One frame's brightness over the mean of its exposure, and its variance from noise; none: channel not seen.
#[derive(Debug, Clone)]
struct Brightness {
    moment: Moment,
    visit: u32,
    channels: [Option<(f64, f64)>; 3],
}

/// One visit's.
#[derive(Debug, Clone, Copy)]
struct Visit {
    moment: Moment,
    level: [f64; 3],
    variance: [f64; 3],
}

/// How bright the lamp was, by time. Without visits: always alike.
#[derive(Debug, Clone, Default)]
pub(super) struct Course {
    frames: Vec<Brightness>,
    visits: Vec<Visit>,
    warnings: Vec<String>,
}

impl Course {
    /// Reads the frames of the reference pose.
    pub(super) fn read(
        recording: &Recording<'_>,
        reader: &Reader<'_>,
        darks: &[Taken],
        references: &[Taken],
        known: &Calibrations,
    ) -> Result<Self> {
        let manifest = &recording.manifest;
        let coverage = Projection::new(&manifest.camera, &manifest.white.configuration)
            .coverage(manifest.sample_square_mm)
            .context(|| "reference geometry")?;
        let mut patch = Patch::covered(reader, &coverage);
        let darks = Darks::read(reader, darks, &mut patch, references, known)?;
        let rules = Rules {
            patch: &patch,
            darks: &darks,
            curve: &Curve::known(known.linearity.as_ref().map(|d| &d.value), darks.bias),
            response: known.flat.as_ref().map(|d| &d.value),
            limit: super::USABLE_FRACTION * reader.white,
        };
        let (readings, points) = rules.read(reader, references)?;
        check_not_all_clipped(&readings, &patch, rules.limit)?;
        let linearity = known.linearity.as_ref().map(|d| &d.value);
        let noise = Noise::known(linearity, &points, &darks)?;
        Self::new(readings, &noise)
    }

    fn new(mut readings: Vec<Reading>, noise: &Noise) -> Result<Self> {
        let mut warnings = Vec::new();
        let key = |r: &Reading| (r.frame.moment.stretch, r.frame.record.visit);
        let mut all: Vec<_> = readings.iter().map(key).collect();
        all.sort_unstable();
        all.dedup();
        // Clipped in one visit, an exposure would pull the others' mean.
        let complete = |r: &Reading| {
            let same = |o: &&Reading| {
                same_exposure(o.frame.record.exposure_ms, r.frame.record.exposure_ms)
                    && o.frame.record.filter == r.frame.record.filter
            };
            let sees =
                |o: &&Reading| (0..3).all(|c| o.channels[c].is_none() || o.usable(c).is_some());
            let mut visits: Vec<_> = readings.iter().filter(same).filter(sees).map(key).collect();
            visits.sort_unstable();
            visits.dedup();
            visits == all
        };
        let kept: Vec<bool> = readings.iter().map(complete).collect();
        let mut keep = kept.iter();
        readings.retain(|_| keep.next().is_some_and(|k| *k));
        if readings.is_empty() {
            return Err(Error::new("the visits of the reference pose have no exposure in common that is clipped in none").with_hint(HOW));
        }
        if readings.len() < kept.len() {
            warnings.push(
                "exposures that are not usable in every reference visit were left out".to_owned(),
            );
        }
        let mut frames: Vec<Brightness> = readings
            .iter()
            .map(|r| brightness(r, &readings, noise))
            .collect();
        let place = |m: &Moment| (m.stretch, m.elapsed_s);
        frames.sort_by(|a, b| {
            place(&a.moment)
                .partial_cmp(&place(&b.moment))
                .unwrap_or(std::cmp::Ordering::Equal)
        });
        let same_visit = |a: &Brightness, b: &Brightness| {
            (a.moment.stretch, a.visit) == (b.moment.stretch, b.visit)
        };
        let visits = frames
            .chunk_by(same_visit)
            .map(Visit::of)
            .collect::<Result<_>>()?;
        Ok(Self {
            frames,
            visits,
            warnings,
        })
    }

    /// The level at a time, and its variance: a straight line between visits of one stretch, else the nearest visit.
    pub(super) fn level(&self, at: &Moment, channel: usize) -> (f64, f64) {
        let within = self
            .visits
            .iter()
            .filter(|v| v.moment.stretch == at.stretch);
        let before = within.clone().rfind(|v| v.moment.elapsed_s <= at.elapsed_s);
        let after = within.clone().find(|v| v.moment.elapsed_s > at.elapsed_s);
        let any = self
            .visits
            .iter()
            .min_by_key(|v| v.moment.stretch.abs_diff(at.stretch));
        let of = |v: &Visit| (v.level[channel], v.variance[channel]);
        match (before, after) {
            (Some(a), Some(b)) => {
                let w =
                    (at.elapsed_s - a.moment.elapsed_s) / (b.moment.elapsed_s - a.moment.elapsed_s);
                let ((level_a, variance_a), (level_b, variance_b)) = (of(a), of(b));
                let variance = (1.0 - w).powi(2) * variance_a + w * w * variance_b;
                ((1.0 - w) * level_a + w * level_b, variance)
            }
            (Some(v), None) | (None, Some(v)) => of(v),
            (None, None) => any.map_or((1.0, 0.0), of),
        }
    }

    /// Standard deviation of one frame's brightness beyond noise, and its standard error.
    fn flicker(&self) -> (f64, f64) {
        let (mut excess, mut square, mut n) = (0.0, 0.0, 0.0);
        for three in self.frames.windows(3) {
            let [a, b, c] = [0, 1, 2].map(|i| three[i].mean());
            let time = |i: usize| three[i].moment.elapsed_s;
            if three[0].moment.stretch != three[2].moment.stretch {
                continue;
            }
            let whole = time(2) - time(0);
            let w = if whole > 0.0 {
                (time(1) - time(0)) / whole
            } else {
                0.5
            };
            let off = b.0 - (1.0 - w) * a.0 - w * c.0;
            let noise = b.1 + (1.0 - w).powi(2) * a.1 + w * w * c.1;
            let scale = 1.0 + (1.0 - w).powi(2) + w * w;
            excess += (off * off - noise) / scale;
            square += off * off / scale;
            n += 1.0;
        }
        if n < 1.0 {
            return (0.0, f64::MAX.sqrt());
        }
        // Neighboring second differences share frames: their mean scatters as that of n / 1.94 independent ones.
        let variance_se = square / n * (2.0 * 1.944_f64 / n).sqrt();
        let flicker = (excess / n).max(0.0).sqrt();
        // Where flicker drowns in noise its square is what is known: the error is that of a square at zero.
        let se = if flicker * flicker > variance_se {
            variance_se / (2.0 * flicker)
        } else {
            variance_se.sqrt()
        };
        (flicker, se)
    }

    /// Mean change per hour: one slope, an offset for each stretch.
    fn slope(&self, channel: usize, flicker: f64) -> Slope {
        const HOUR: f64 = 3600.0;
        let mut stretches: Vec<usize> = self.frames.iter().map(|f| f.moment.stretch).collect();
        stretches.dedup();
        let mut normal = Normal::new(1 + stretches.len());
        for frame in &self.frames {
            if let Some((level, variance)) = frame.channels[channel] {
                let mut row = vec![0.0; 1 + stretches.len()];
                row[0] = frame.moment.elapsed_s / HOUR;
                for (entry, stretch) in row[1..].iter_mut().zip(&stretches) {
                    *entry = f64::from(u8::from(*stretch == frame.moment.stretch));
                }
                normal.add(&row, level, variance + flicker * flicker);
            }
        }
        let Some(line) = normal.solve() else {
            return Slope::default();
        };
        let bent = line.freedom > 0 && line.chi_square > chi_square_limit(line.freedom);
        let widened = if bent {
            (line.chi_square / line.freedom as f64).sqrt()
        } else {
            1.0
        };
        Slope {
            per_hour: line.values[0],
            se: line.se(0) * widened,
            bent,
        }
    }

    /// Seconds from the first frame of a stretch until its level stays near its last value, the longest of all stretches;
    /// and whether it only did so at the end.
    fn settled_after(&self) -> (f64, bool) {
        let mut longest = (0.0, false);
        for stretch in self
            .visits
            .chunk_by(|a, b| a.moment.stretch == b.moment.stretch)
        {
            let mean = |v: &Visit| v.level.iter().sum::<f64>() / 3.0;
            let Some(last) = stretch.last() else {
                continue;
            };
            let off = |v: &Visit| (mean(v) / mean(last) - 1.0).abs() > SETTLED;
            let from = stretch.iter().rposition(off).map_or(0, |i| i + 1);
            let first = self
                .frames
                .iter()
                .find(|f| f.moment.stretch == last.moment.stretch);
            let start = first.map_or(0.0, |f| f.moment.elapsed_s);
            if from > 0 && stretch[from].moment.elapsed_s - start > longest.0 {
                longest = (
                    stretch[from].moment.elapsed_s - start,
                    from + 1 == stretch.len(),
                );
            }
        }
        longest
    }
}

/// A channel's mean change.
#[derive(Debug, Clone, Copy, Default)]
struct Slope {
    per_hour: f64,
    se: f64,
    /// Noise and flicker do not explain how far the course is from a line.
    bent: bool,
}

fn brightness(reading: &Reading, all: &[Reading], noise: &Noise) -> Brightness {
    let record = &reading.frame.record;
    let same = |r: &&Reading| same_exposure(r.frame.record.exposure_ms, record.exposure_ms);
    let channels = [0, 1, 2].map(|c| {
        let own = reading.usable(c)?;
        let others = all.iter().filter(same).filter_map(|r| r.usable(c));
        let (sum, n) = others.fold((0.0, 0.0), |(s, n), o| (s + o.signal, n + 1.0));
        let mean: f64 = sum / n;
        (mean > 0.0).then(|| {
            (
                own.signal / mean,
                own.own_variance(noise, c) / (mean * mean),
            )
        })
    });
    Brightness {
        moment: reading.frame.moment,
        visit: record.visit,
        channels,
    }
}

impl Brightness {
    /// Mean over the channels, and its variance.
    fn mean(&self) -> (f64, f64) {
        let seen: Vec<(f64, f64)> = self.channels.iter().flatten().copied().collect();
        let n = seen.len() as f64;
        let sum = seen.iter().fold((0.0, 0.0), |s, c| (s.0 + c.0, s.1 + c.1));
        (sum.0 / n, sum.1 / (n * n))
    }
}

impl Visit {
    fn of(frames: &[Brightness]) -> Result<Self> {
        let n = frames.len() as f64;
        let mut visit = Self {
            moment: Moment {
                stretch: frames[0].moment.stretch,
                elapsed_s: frames.iter().map(|f| f.moment.elapsed_s).sum::<f64>() / n,
            },
            level: [0.0; 3],
            variance: [0.0; 3],
        };
        for c in 0..3 {
            let mut weight = 0.0;
            for (level, variance) in frames.iter().filter_map(|f| f.channels[c]) {
                visit.level[c] += level / variance;
                weight += 1.0 / variance;
            }
            if weight <= 0.0 {
                return Err(Error::new(format!(
                    "reference visit {}: {} is not brighter than the dark",
                    frames[0].visit, NAMES[c]
                ))
                .with_hint("was the lamp on, and shot through every filter?"));
            }
            visit.level[c] /= weight;
            visit.variance[c] = 1.0 / weight;
        }
        Ok(visit)
    }
}
