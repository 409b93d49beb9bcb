//! The flat field: relative response of every value, from frames of something evenly bright.
//!
//! ```text
//! response_i = sum_f W_f (L(p_fi) - L(D_i)) / m_f / sum_f W_f,    m_f = mean of L(p) - L(D) in the middle of frame f
//! ```
//!
//! per channel, with `W_f = m_f`. Each frame is measured against its own middle, so the lamp need not be steady. Hot pixels
//! (those of the darks) and dead ones get response 1 with standard error 1: it is the dark's list that leaves them out.

use super::Calibrated;
use super::darks::{Darks, wanted};
use super::patch::{NAMES, Patch, channels};
use super::readings::{Reading, Rules, check_not_all_clipped};
use super::recording::{Reader, Recording};
use super::transfer::Noise;
use crate::base::{Error, Result, Watch};
use crate::math::statistics::Running;
use crate::measure::RawFrame;
use crate::measure::calibration::{Calibrations, Dated, FlatField, Kind};
use crate::measure::frames::{Taken, same_exposure};
use crate::measure::linear::Curve;
use crate::session::{FrameKind, Layout, SessionFolder};

/// A response below this is a dead pixel's.
const DEAD: f64 = 0.1;

/// The relative response of every value of a frame, from flats; `uniformity_se` is the relative standard uncertainty of
/// the source's evenness over the sample square.
///
/// # Errors
/// No flat that is not clipped, no dark; a frame is missing, torn, changed or of another camera or sensitivity.
pub fn flat(
    session: &SessionFolder,
    known: &Calibrations,
    uniformity_se: f64,
    watch: &dyn Watch,
) -> Result<Calibrated<FlatField>> {
    if !(0.0..=0.5).contains(&uniformity_se) {
        return Err(Error::new(format!(
            "the source's evenness is stated to {uniformity_se}, expected 0 to 0.5"
        )));
    }
    let recording = Recording::open(session)?;
    let flats = recording.need(
        FrameKind::Flat,
        "shoot a diffuser on the lens, or a panel that fills the image, 8 or more times at half the white level, and darks of that exposure",
    )?;
    let dark_frames = wanted(&recording, &flats);
    let frames = [&dark_frames[..], &flats[..], &flats[..]].concat();
    let (reader, first) = recording.reader(&frames, watch)?;
    drop(first);
    let mut whole = Patch::whole(&reader)?;
    let darks = Darks::read(&reader, &dark_frames, &mut whole, &flats, known)?;
    let linearity = known.linearity.as_ref().map(|d| &d.value);
    let curve = Curve::known(linearity, darks.bias);
    let rules = Rules {
        patch: &whole,
        darks: &darks,
        curve: &curve,
        response: None,
        limit: super::USABLE_FRACTION * reader.white,
    };
    let (readings, points) = rules.read(&reader, &flats)?;
    check_not_all_clipped(&readings, &whole, rules.limit)?;
    let noise = Noise::known(linearity, &points, &darks)?;
    let middle = Middle::new(&reader, &whole);
    let mut sum = Accumulated::new(&reader);
    for (taken, reading) in flats.iter().zip(&readings) {
        let frame = reader.load(taken)?;
        sum.add(&reader, taken, reading, &frame, &rules, &middle, &noise)?;
    }
    let (value, warnings) = sum.finish(&reader, &whole, uniformity_se)?;
    let (mut warnings, mut faults) = (warnings, Vec::new());
    if linearity.is_none() {
        warnings
            .push("no linearity calibration is known: raw values are taken as linear".to_owned());
    }
    let clipped = |r: &&Reading| r.channels.iter().flatten().any(|s| s.clipped > 0);
    let lost = readings.iter().filter(clipped).count();
    if lost > 0 {
        warnings.push(format!(
            "{lost} of {} flats are clipped somewhere: those channels are left out",
            readings.len()
        ));
    }
    let worst = value.falloff.iter().copied().fold(0.0, f64::max);
    if worst > 0.7 {
        faults.push(format!(
            "the corners are {:.0} % darker than the middle: does the source fill the image?",
            100.0 * worst
        ));
    }
    Ok(Calibrated {
        dated: Dated {
            header: recording.header(Kind::Flat),
            value,
        },
        warnings,
        faults,
    })
}

/// Values that are normalized together: a channel, or all of a sensor without color.
fn class(layout: Layout, place: usize) -> usize {
    match layout {
        Layout::Mono => 0,
        _ => channels(layout, None, place).start,
    }
}

/// Which values lie in the middle of the image: the central quarter of its width and height, hot pixels left out.
struct Middle {
    indices: Vec<usize>,
}

impl Middle {
    fn new(reader: &Reader<'_>, whole: &Patch) -> Self {
        let [width, height] = reader.size;
        let n = reader.layout.values_per_pixel();
        let inside = |v: usize, size: usize| 8 * v >= 3 * size && 8 * v < 5 * size;
        let counts = whole.spots().filter(|s| {
            s.weight > 0.0
                && inside(s.index / n % width, width)
                && inside(s.index / n / width, height)
        });
        Self {
            indices: counts.map(|s| s.index).collect(),
        }
    }
}

/// Sums over frames.
struct Accumulated {
    /// `sum_f W_f r_f` by value.
    sums: Vec<f64>,
    /// By class: `sum W`; `sum W^2 a / m` and `sum W^2 r^2 / m^2` of the variance.
    weight: [f64; 3],
    shot: [f64; 3],
    read: [f64; 3],
    /// By class and dark: exposure, frames, variance of the dark's mean.
    darks: [Vec<(f64, f64, f64)>; 3],
}

impl Accumulated {
    fn new(reader: &Reader<'_>) -> Self {
        Self {
            sums: vec![0.0; reader.values()],
            weight: [0.0; 3],
            shot: [0.0; 3],
            read: [0.0; 3],
            darks: Default::default(),
        }
    }

    /// Adds the channels of a frame that are not clipped anywhere.
    #[expect(
        clippy::too_many_arguments,
        reason = "one frame and all that is known of it"
    )]
    fn add(
        &mut self,
        reader: &Reader<'_>,
        taken: &Taken,
        reading: &Reading,
        frame: &RawFrame,
        rules: &Rules<'_>,
        middle: &Middle,
        noise: &Noise,
    ) -> Result<()> {
        let dark = rules.darks.find(taken)?;
        let signal = |i: usize, place: usize| {
            let bias = rules.curve.bias[place];
            let linear = |raw: f64| rules.curve.at(raw - bias);
            linear(f64::from(frame.data[i])) - linear(f64::from(dark.mean[i]))
        };
        let mut means = [Running::default(); 3];
        for &i in &middle.indices {
            let place = reader.place(i);
            means[class(reader.layout, place)].push(signal(i, place));
        }
        let mut used = [false; 3];
        for class in 0..3 {
            let (channel, mean) = match reader.layout {
                Layout::Mono => (
                    taken.record.filter.map_or(1, |f| f.channel()),
                    means[class].mean(),
                ),
                _ => (class, means[class].mean()),
            };
            if means[class].count() == 0 || reading.usable(channel).is_none() {
                continue;
            }
            if mean <= 0.0 {
                return Err(Error::new(format!(
                    "frame {}: {} is not brighter than the dark in the middle of the image",
                    taken.record.file, NAMES[channel]
                ))
                .with_hint("was the light on for the flats, and off for the darks?"));
            }
            used[class] = true;
            self.weight[class] += mean;
            self.shot[class] += noise.slope[channel] * mean;
            self.read[class] += noise.read;
            let variance = dark.variance.into_iter().fold(0.0, f64::max) / dark.count;
            let list = &mut self.darks[class];
            match list
                .iter_mut()
                .find(|d| same_exposure(d.0, dark.exposure_ms))
            {
                Some(found) => found.1 += 1.0,
                None => list.push((dark.exposure_ms, 1.0, variance)),
            }
        }
        for (i, sum) in self.sums.iter_mut().enumerate() {
            let place = reader.place(i);
            if used[class(reader.layout, place)] {
                // W = m, so W r is the signal itself.
                *sum += signal(i, place);
            }
        }
        Ok(())
    }

    fn finish(
        self,
        reader: &Reader<'_>,
        whole: &Patch,
        uniformity_se: f64,
    ) -> Result<(FlatField, Vec<String>)> {
        let mut response = vec![1.0_f32; self.sums.len()];
        let mut response_se = vec![1.0_f32; self.sums.len()];
        let mut good = vec![false; self.sums.len()];
        let mut dead = Vec::new();
        for spot in whole.spots() {
            let (i, class) = (spot.index, class(reader.layout, spot.place));
            let weight = self.weight[class];
            if weight <= 0.0 {
                return Err(Error::new(format!("{} is clipped in every flat", NAMES[class]))
                    .with_hint("shoot the flats shorter: the brightest pixel must stay below 92 % of the white level"));
            }
            let found = self.sums[i] / weight;
            if spot.weight <= 0.0 {
                continue;
            }
            if found.is_nan() || found < DEAD {
                dead.push(i);
                continue;
            }
            let darks = self.darks[class]
                .iter()
                .map(|(_, n, v)| n * n * v)
                .sum::<f64>();
            let variance = self.shot[class] * found + self.read[class] + darks;
            response[i] = found as f32;
            response_se[i] = (variance.sqrt() / weight) as f32;
            good[i] = true;
        }
        let map = Map {
            reader,
            response: &response,
            se: &response_se,
            good: &good,
        };
        let classes = [0, 1, 2].map(|c| if reader.layout == Layout::Mono { 0 } else { c });
        let (scatter, falloff) = (map.scatter(), map.falloff());
        let warnings = dead_pixels(&dead, reader);
        let value = FlatField {
            file: String::new(),
            sha256: String::new(),
            uniformity_se,
            scatter: classes.map(|c| scatter[c]),
            falloff: classes.map(|c| falloff[c]),
            response,
            response_se,
        };
        Ok((value, warnings))
    }
}

fn dead_pixels(dead: &[usize], reader: &Reader<'_>) -> Vec<String> {
    let n = reader.layout.values_per_pixel();
    let place = |i: &usize| {
        format!(
            "column {} row {}",
            i / n % reader.size[0],
            i / n / reader.size[0]
        )
    };
    let first: Vec<String> = dead.iter().take(5).map(place).collect();
    let text = format!(
        "{} dead values (response below {DEAD}) get response 1, and the darks do not list them as hot: {}{}",
        dead.len(),
        first.join(", "),
        if dead.len() > 5 { ", ..." } else { "" }
    );
    (!dead.is_empty()).then_some(text).into_iter().collect()
}

/// A finished map.
struct Map<'a> {
    reader: &'a Reader<'a>,
    response: &'a [f32],
    se: &'a [f32],
    good: &'a [bool],
}

impl Map<'_> {
    fn class(&self, i: usize) -> usize {
        class(self.reader.layout, self.reader.place(i))
    }

    /// Standard deviation of the response over the mean of the neighbors of its place (5 x 5 without itself), noise taken
    /// off, by class.
    fn scatter(&self) -> [f64; 3] {
        let n = self.reader.layout.values_per_pixel();
        let step = if self.reader.layout.cfa().is_some() {
            2
        } else {
            1
        };
        let [width, height] = self.reader.size;
        let margin = 2 * step;
        let (mut square, mut count) = ([0.0; 3], [0.0; 3]);
        for y in margin..height.saturating_sub(margin) {
            for v in margin * n..(width.saturating_sub(margin)) * n {
                let i = y * width * n + v;
                let around = (0..25).filter(|k| *k != 12).map(|k| {
                    let (row, column) =
                        (y + k / 5 * step - margin, v + k % 5 * step * n - margin * n);
                    row * width * n + column
                });
                if !self.good[i] || around.clone().any(|j| !self.good[j]) {
                    continue;
                }
                let (mut mean, mut noise) = (0.0, f64::from(self.se[i]).powi(2));
                for j in around {
                    mean += f64::from(self.response[j]) / 24.0;
                    noise += (f64::from(self.se[j]) / 24.0).powi(2);
                }
                let off = f64::from(self.response[i]) - mean;
                square[self.class(i)] += (off * off - noise) / (mean * mean);
                count[self.class(i)] += 1.0;
            }
        }
        // Unequal neighbors widen the difference by 1/24 of their variance.
        [0, 1, 2].map(|c| {
            (square[c] / f64::max(count[c], 1.0) * 24.0 / 25.0)
                .max(0.0)
                .sqrt()
        })
    }

    /// Light lost in the corners (boxes of a sixteenth of width and height), by class.
    fn falloff(&self) -> [f64; 3] {
        let n = self.reader.layout.values_per_pixel();
        let [width, height] = self.reader.size;
        let mut means = [Running::default(); 3];
        let at_edge = |v: usize, size: usize| 16 * v < size || 16 * (v + 1) > 15 * size;
        for i in (0..self.response.len()).filter(|&i| self.good[i]) {
            if at_edge(i / n % width, width) && at_edge(i / n / width, height) {
                means[self.class(i)].push(f64::from(self.response[i]));
            }
        }
        means.map(|m| if m.count() > 0 { 1.0 - m.mean() } else { 0.0 })
    }
}
