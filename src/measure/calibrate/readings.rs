//! What lit frames read on a patch, and how much they scatter.

use super::darks::{Dark, Darks};
use super::patch::{NAMES, Patch};
use super::recording::Reader;
use super::transfer::{Noise, pair_points};
use crate::base::{Error, Result};
use crate::measure::RawFrame;
use crate::measure::calibration::{FlatField, TransferPoint};
use crate::measure::frames::{Taken, same_exposure, title};
use crate::measure::linear::Curve;

/// One channel of one frame: weighted means over the spots of the patch.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sums {
    /// Linear signal less the dark's, over the response.
    pub(super) signal: f64,
    /// Powers 1, 2, 3, 4 of the raw value less bias, less those of the dark.
    pub(super) powers: [f64; 4],
    /// Raw value less bias: light and dark.
    pub(super) level: f64,
    /// Weighted sum of squared weights times (1, linear value, dark variance over the darks' count, variance common to
    /// the darks of a place) as they count in the variance of `signal`.
    pub(super) spread: [f64; 4],
    /// Spots at or above the limit.
    pub(super) clipped: usize,
    /// Spots.
    pub(super) spots: usize,
}

impl Sums {
    /// Variance of `signal` from the noise of the frame alone.
    pub(super) fn own_variance(&self, noise: &Noise, channel: usize) -> f64 {
        noise.slope[channel] * self.spread[1].max(0.0) + noise.read * self.spread[0]
    }

    /// Variance of `signal` from its dark.
    pub(super) fn dark_variance(&self) -> f64 {
        self.spread[2] + self.spread[3]
    }
}

/// What one frame reads.
#[derive(Debug, Clone)]
pub(super) struct Reading {
    pub(super) frame: Taken,
    /// None: the frame does not see the channel.
    pub(super) channels: [Option<Sums>; 3],
}

impl Reading {
    /// A channel that is there and not clipped.
    pub(super) fn usable(&self, channel: usize) -> Option<&Sums> {
        self.channels[channel].as_ref().filter(|s| s.clipped == 0)
    }
}

/// How frames are turned into numbers.
pub(super) struct Rules<'a> {
    pub(super) patch: &'a Patch,
    pub(super) darks: &'a Darks,
    pub(super) curve: &'a Curve,
    pub(super) response: Option<&'a FlatField>,
    /// Raw values from here on are clipped.
    pub(super) limit: f64,
}

impl Rules<'_> {
    /// Reads frames; also what pairs of neighbors in the list (same exposure, same filter) say of the noise, raw scale.
    ///
    /// # Errors
    /// A frame is missing or damaged, has no dark, or is darker than it.
    pub(super) fn read(
        &self,
        reader: &Reader<'_>,
        frames: &[Taken],
    ) -> Result<(Vec<Reading>, Vec<TransferPoint>)> {
        let mut readings: Vec<Reading> = Vec::new();
        let mut points = Vec::new();
        let mut earlier: Option<(Taken, RawFrame)> = None;
        for taken in frames {
            let frame = reader.load(taken)?;
            let reading = Reading {
                frame: taken.clone(),
                channels: self.sums(taken, &frame)?,
            };
            let partner = earlier.take().filter(|(other, _)| {
                other.record.filter == taken.record.filter
                    && other.moment.stretch == taken.moment.stretch
                    && same_exposure(other.record.exposure_ms, taken.record.exposure_ms)
            });
            if let (Some((_, other)), Some(last)) = (&partner, readings.last()) {
                let dark = self.darks.find(taken)?;
                let both = |c: usize| reading.usable(c).is_some() && last.usable(c).is_some();
                let pair = [other, &frame];
                let found = pair_points(pair, self.patch, self.curve, dark, taken.record.filter);
                points.extend(found.into_iter().filter(|p| both(p.channel)));
            } else {
                // Pairs do not overlap: the next frame is compared with this one.
                earlier = Some((taken.clone(), frame));
            }
            readings.push(reading);
        }
        Ok((readings, points))
    }

    fn sums(&self, taken: &Taken, frame: &RawFrame) -> Result<[Option<Sums>; 3]> {
        let dark = self.darks.find(taken)?;
        let mut sums = [Sums::default(); 3];
        let mut weights = [[0.0; 4]; 3];
        let mut totals = [0.0; 3];
        for (k, spot) in self.patch.spots().enumerate() {
            if spot.weight <= 0.0 {
                continue;
            }
            let raw = f64::from(frame.data[spot.index]);
            let bias = self.curve.bias[spot.place];
            let (s, d) = (raw - bias, f64::from(dark.mean[k]) - bias);
            let (light, without) = (self.curve.at(s), self.curve.at(d));
            let response = self
                .response
                .map_or(1.0, |f| f64::from(f.response[spot.index]));
            let slope = self.curve.slope(d);
            let w = spot.weight / response;
            for c in self.patch.channels(taken.record.filter, spot.place) {
                let sum = &mut sums[c];
                sum.signal += w * (light - without);
                for (k, power) in (1..).zip(&mut sum.powers) {
                    *power += spot.weight * (s.powi(k) - d.powi(k));
                }
                sum.level += spot.weight * s;
                sum.spread[0] += w * w;
                sum.spread[1] += w * w * light;
                sum.spread[2] += (w * slope).powi(2) * dark.variance[spot.place] / dark.count;
                weights[c][spot.place] += w;
                totals[c] += spot.weight;
                sum.clipped += usize::from(raw >= self.limit || s > self.curve.brightest);
                sum.spots += 1;
            }
        }
        let mut found = [None; 3];
        for (c, sum) in sums.iter_mut().enumerate().filter(|(_, s)| s.spots > 0) {
            let total = totals[c];
            sum.signal /= total;
            sum.level /= total;
            sum.powers = sum.powers.map(|p| p / total);
            sum.spread = sum.spread.map(|s| s / (total * total));
            sum.spread[3] = (0..4)
                .map(|p| (weights[c][p] / total).powi(2) * dark.common[p])
                .sum();
            check_brighter(taken, sum, c, dark, self.patch)?;
            found[c] = Some(*sum);
        }
        Ok(found)
    }
}

/// Fails when a frame is darker than its dark by more than noise explains.
fn check_brighter(
    taken: &Taken,
    sum: &Sums,
    channel: usize,
    dark: &Dark,
    patch: &Patch,
) -> Result<()> {
    let variance = dark.variance.into_iter().fold(0.0, f64::max) * sum.spread[0];
    let noise = (variance + sum.dark_variance()).sqrt();
    if sum.signal > -5.0 * noise - 0.05 {
        return Ok(());
    }
    Err(Error::new(format!(
        "{} is darker than the dark of its exposure: {} reads {:.2} +- {:.2} raw values in {}",
        title(&taken.record),
        NAMES[channel],
        sum.signal,
        noise,
        patch.region()
    ))
    .with_hint("was the light on, and the lens capped for the darks? shoot the darks again"))
}

/// Fails when no frame is usable, naming the least clipped one.
pub(super) fn check_not_all_clipped(readings: &[Reading], patch: &Patch, limit: f64) -> Result<()> {
    let all: usize = readings
        .iter()
        .flat_map(|r| r.channels.iter().flatten())
        .filter(|s| s.clipped == 0)
        .count();
    if all > 0 {
        return Ok(());
    }
    let clipped = |r: &Reading| {
        r.channels
            .iter()
            .flatten()
            .map(|s| s.clipped)
            .sum::<usize>()
    };
    let Some(best) = readings.iter().min_by_key(|r| clipped(r)) else {
        return Ok(());
    };
    let spots: usize = best.channels.iter().flatten().map(|s| s.spots).sum();
    Err(Error::new(format!(
        "all exposures are clipped: even in {} {} of {spots} values of {} reach {limit:.0}",
        title(&best.frame.record),
        clipped(best),
        patch.region(),
    ))
    .with_hint("shoot shorter exposures, or dim the light; the brightest pixel must stay below"))
}
