//! The dark of every exposure that is used: from the session's own dark frames, or from a dark calibration.

use super::least_squares::{Normal, middle_and_spread};
use super::patch::Patch;
use super::recording::{Reader, Recording};
use crate::base::{Error, Result};
use crate::measure::calibration::{Calibrations, DarkCurrent, Dated};
use crate::measure::dark::QUANTIZATION;
use crate::measure::frames::{Taken, same_exposure, title};
use crate::session::FrameKind;

/// A value stands out when its dark is this many robust standard deviations off.
const HOT_SIGMA: f64 = 8.0;

/// The dark of one exposure on a patch.
pub(super) struct Dark {
    pub(super) exposure_ms: f64,
    /// Mean raw value by spot.
    pub(super) mean: Vec<f32>,
    /// Frames averaged; infinite when it is a calibration's straight line.
    pub(super) count: f64,
    /// Variance of one raw value without light, by place.
    pub(super) variance: [f64; 4],
    /// Degrees of freedom of that, by place; 0 when it was not measured here.
    pub(super) freedom: [f64; 4],
    /// Variance of the mean that is common to all spots of a place.
    pub(super) common: [f64; 4],
}

/// The darks of a session on a patch.
pub(super) struct Darks {
    list: Vec<Dark>,
    /// Mean raw value at no light and no exposure, by place.
    pub(super) bias: [f64; 4],
}

/// The dark frames that are wanted for these frames.
pub(super) fn wanted(recording: &Recording<'_>, lit: &[Taken]) -> Vec<Taken> {
    let mut darks = recording.of(FrameKind::Dark);
    darks.retain(|d| {
        let same = |l: &Taken| same_exposure(l.record.exposure_ms, d.record.exposure_ms);
        lit.iter().any(same)
    });
    darks
}

impl Darks {
    /// Reads the darks of all exposures of the lit frames, and leaves hot pixels out of the patch.
    ///
    /// # Errors
    /// An exposure has no dark frame, and there is no dark calibration.
    pub(super) fn read(
        reader: &Reader<'_>,
        darks: &[Taken],
        patch: &mut Patch,
        lit: &[Taken],
        known: &Calibrations,
    ) -> Result<Self> {
        let mut hot = known_hot(known.dark.as_ref(), patch);
        let mut list: Vec<Dark> = Vec::new();
        for group in
            darks.chunk_by(|a, b| same_exposure(a.record.exposure_ms, b.record.exposure_ms))
        {
            list.push(Dark::average(reader, group, patch, &mut hot)?);
        }
        for frame in lit {
            let exposure_ms = frame.record.exposure_ms;
            if list
                .iter()
                .any(|d| same_exposure(d.exposure_ms, exposure_ms))
            {
                continue;
            }
            let line = known.dark.as_ref().ok_or_else(|| missing(frame, darks))?;
            list.push(Dark::on_line(&line.value, patch, exposure_ms));
        }
        patch.leave_out(&hot);
        let bias = match (&known.linearity, &known.dark) {
            (Some(curve), _) => curve.value.bias,
            (None, Some(dark)) => dark.value.bias,
            (None, None) => bias(&list, patch),
        };
        Ok(Self { list, bias })
    }

    /// The dark of a frame's exposure.
    pub(super) fn find(&self, frame: &Taken) -> Result<&Dark> {
        let same = |d: &&Dark| same_exposure(d.exposure_ms, frame.record.exposure_ms);
        self.list
            .iter()
            .find(same)
            .ok_or_else(|| missing(frame, &[]))
    }

    /// All of them.
    pub(super) fn iter(&self) -> impl Iterator<Item = &Dark> {
        self.list.iter()
    }
}

fn missing(frame: &Taken, darks: &[Taken]) -> Error {
    let mut times: Vec<String> = darks
        .iter()
        .map(|d| format!("{} ms", d.record.exposure_ms))
        .collect();
    times.dedup();
    let times = if times.is_empty() {
        "none that fit".to_owned()
    } else {
        times.join(", ")
    };
    Error::new(format!(
        "{} has no dark frame of its exposure; there are darks of: {times}",
        title(&frame.record)
    ))
    .with_hint(format!(
        "shoot at least two dark frames of {} ms, lens capped, or make a dark calibration first: `goniofit calibrate dark`",
        frame.record.exposure_ms
    ))
}

fn known_hot(dark: Option<&Dated<DarkCurrent>>, patch: &Patch) -> Vec<bool> {
    let mut hot = vec![false; patch.len()];
    for pixel in dark.iter().flat_map(|d| &d.value.hot) {
        hot[patch.spots_of(pixel.x, pixel.y)].fill(true);
    }
    hot
}

impl Dark {
    fn average(
        reader: &Reader<'_>,
        group: &[Taken],
        patch: &Patch,
        hot: &mut [bool],
    ) -> Result<Self> {
        let mut sums = vec![[0.0_f64; 2]; patch.len()];
        for frame in group {
            let read = reader.load(frame)?;
            for (sum, spot) in sums.iter_mut().zip(patch.spots()) {
                let value = f64::from(read.data[spot.index]);
                sum[0] += value;
                sum[1] += value * value;
            }
        }
        let n = group.len() as f64;
        let mean: Vec<f32> = sums.iter().map(|s| (s[0] / n) as f32).collect();
        mark_outliers(&mean, patch, hot);
        let (mut square, mut count) = ([0.0; 4], [0.0; 4]);
        for ((sum, spot), _) in sums
            .iter()
            .zip(patch.spots())
            .zip(&*hot)
            .filter(|(_, h)| !**h)
        {
            square[spot.place] += sum[1] - sum[0] * sum[0] / n;
            count[spot.place] += 1.0;
        }
        let freedom = count.map(|c| c * (n - 1.0));
        Ok(Self {
            exposure_ms: group[0].record.exposure_ms,
            mean,
            count: n,
            // Places the layout does not have read as the others.
            variance: [0, 1, 2, 3].map(|p| {
                let [square, freedom] = if freedom[p] > 0.0 {
                    [square[p], freedom[p]]
                } else {
                    [square.iter().sum(), freedom.iter().sum()]
                };
                if freedom > 0.0 {
                    (square / freedom).max(QUANTIZATION)
                } else {
                    QUANTIZATION
                }
            }),
            freedom,
            common: [0.0; 4],
        })
    }

    /// From the straight line of a dark calibration.
    fn on_line(line: &DarkCurrent, patch: &Patch, t: f64) -> Self {
        let mean = patch
            .spots()
            .map(|s| (line.bias[s.place] + line.per_ms[s.place] * t) as f32);
        let common = [0, 1, 2, 3].map(|p| {
            line.bias_se[p].powi(2)
                + 2.0 * t * line.bias_per_ms_covariance[p]
                + (t * line.per_ms_se[p]).powi(2)
        });
        Self {
            exposure_ms: t,
            mean: mean.collect(),
            count: f64::INFINITY,
            variance: [line.read_noise.powi(2).max(QUANTIZATION); 4],
            freedom: [0.0; 4],
            common,
        }
    }

    /// Mean raw value by place over the spots that count.
    pub(super) fn by_place(&self, patch: &Patch) -> [f64; 4] {
        let (mut sum, mut weight) = ([0.0; 4], [0.0; 4]);
        for (spot, &mean) in patch.spots().zip(&self.mean) {
            sum[spot.place] += spot.weight * f64::from(mean);
            weight[spot.place] += spot.weight;
        }
        [0, 1, 2, 3].map(|p| {
            if weight[p] > 0.0 {
                sum[p] / weight[p]
            } else {
                0.0
            }
        })
    }
}

fn mark_outliers(mean: &[f32], patch: &Patch, hot: &mut [bool]) {
    for place in 0..4 {
        let of_place = || {
            patch
                .spots()
                .zip(mean)
                .enumerate()
                .filter(move |(_, (s, _))| s.place == place)
        };
        let mut values: Vec<f32> = of_place().map(|(_, (_, m))| *m).collect();
        let (middle, spread) = middle_and_spread(&mut values);
        let limit = HOT_SIGMA * spread.max(0.5);
        for (k, (_, mean)) in of_place() {
            hot[k] |= (f64::from(*mean) - middle).abs() > limit;
        }
    }
}

/// The straight line through the darks, at zero exposure; the shortest exposure's mean when there is only one.
fn bias(list: &[Dark], patch: &Patch) -> [f64; 4] {
    let means: Vec<[f64; 4]> = list.iter().map(|d| d.by_place(patch)).collect();
    [0, 1, 2, 3].map(|place| {
        let mut line = Normal::new(2);
        for (dark, mean) in list.iter().zip(&means) {
            let variance = dark.variance[place] / dark.count;
            line.add(&[1.0, dark.exposure_ms], mean[place], variance);
        }
        match line.solve() {
            Some(found) if list.len() > 1 => found.values[0],
            _ => means.first().map_or(0.0, |m| m[place]),
        }
    })
}
