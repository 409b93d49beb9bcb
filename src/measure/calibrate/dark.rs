//! Bias, dark current, read noise and hot pixels, from dark frames at several exposures.
//!
//! ```text
//! mean raw value of a place = bias + per_ms t,    variance of one raw value = read_noise^2 + a per_ms t
//! ```
//!
//! The frames are read twice: first for each pixel's own line, which tells the hot ones, then for means without those.

use super::least_squares::{Normal, Solution, chi_square_limit, middle_and_spread};
use super::recording::{Reader, Recording};
use super::{Calibrated, DarkOptions};
use crate::base::{Error, Result, Watch};
use crate::measure::calibration::{Calibrations, DarkCurrent, DarkExposure, Dated, HotPixel, Kind};
use crate::measure::frames::{Taken, same_exposure};
use crate::session::{FrameKind, SessionFolder};

const HOW: &str = "cap the lens and shoot at least two exposures (the shortest and the longest that are used), each at least twice";

/// Bias, dark current, read noise and hot pixels from dark frames.
///
/// # Errors
/// Fewer than two exposures, an exposure shot only once; a frame is missing, torn, changed or of another camera or
/// sensitivity.
pub fn dark(
    session: &SessionFolder,
    known: &Calibrations,
    options: &DarkOptions,
    watch: &dyn Watch,
) -> Result<Calibrated<DarkCurrent>> {
    let recording = Recording::open(session)?;
    let frames = recording.need(FrameKind::Dark, HOW)?;
    let groups = groups(&frames)?;
    let (reader, first) = recording.reader(&[&frames[..], &frames[..]].concat(), watch)?;
    drop(first);
    let lines = Lines::read(&reader, &frames)?;
    let hot = lines.hot(&reader, options.hot_sigma);
    let exposures = groups
        .iter()
        .map(|g| Exposure::read(&reader, g, &hot))
        .collect::<Result<Vec<_>>>()?;
    let places = reader.layout.places();
    let wander = wander(&exposures, places);
    let fits = (0..places)
        .map(|place| line(&exposures, place, wander))
        .collect::<Option<Vec<_>>>()
        .ok_or_else(|| Error::new("the darks do not determine a straight line").with_hint(HOW))?;
    let mut faults = bent(&fits, &exposures);
    let widened = if faults.is_empty() {
        1.0
    } else {
        reduced(&fits).sqrt()
    };
    let at = |f: &dyn Fn(&Solution) -> f64| -> [f64; 4] {
        std::array::from_fn(|p| fits.get(p).map_or(0.0, f))
    };
    let (read_noise, read_noise_se) = read_noise(&exposures)?;
    let value = DarkCurrent {
        bias: at(&|f| f.values[0]),
        bias_se: at(&|f| f.se(0) * widened),
        per_ms: at(&|f| f.values[1]),
        per_ms_se: at(&|f| f.se(1) * widened),
        bias_per_ms_covariance: at(&|f| f.covariance[0][1] * widened * widened),
        read_noise,
        read_noise_se,
        per_ms_scatter: lines.scatter(&reader, &hot, &exposures),
        hot: lines.list(&reader, &hot),
        exposures: exposures.iter().map(|e| e.stated).collect(),
    };
    let clipped = exposures.iter().map(|e| e.zeros).fold(0.0, f64::max);
    if clipped > 1e-3 {
        faults.push(format!(
            "{:.1} % of the values of a dark are 0: the camera cuts its noise off below, and bias and noise come out wrong; choose a higher black level (offset)",
            100.0 * clipped
        ));
    }
    let mut warnings = moved(&value, known, places);
    let share = value.hot.len() as f64 / (reader.size[0] * reader.size[1]) as f64;
    if share > 0.01 {
        warnings.push(format!(
            "{:.1} % of the pixels are hot: was the lens capped?",
            100.0 * share
        ));
    }
    Ok(Calibrated {
        dated: Dated {
            header: recording.header(Kind::Dark),
            value,
        },
        warnings,
        faults,
    })
}

/// The frames by exposure.
fn groups(frames: &[Taken]) -> Result<Vec<&[Taken]>> {
    let same = |a: &Taken, b: &Taken| same_exposure(a.record.exposure_ms, b.record.exposure_ms);
    let groups: Vec<&[Taken]> = frames.chunk_by(same).collect();
    if groups.len() < 2 {
        return Err(Error::new(format!(
            "too few exposures: all {} dark frames have {} ms",
            frames.len(),
            frames[0].record.exposure_ms
        ))
        .with_hint(HOW));
    }
    let alone: Vec<String> = groups
        .iter()
        .filter(|g| g.len() < 2)
        .map(|g| format!("{} ms", g[0].record.exposure_ms))
        .collect();
    if !alone.is_empty() {
        return Err(Error::new(format!(
            "too few repeats: one dark frame only of {}",
            alone.join(", ")
        ))
        .with_hint(HOW));
    }
    Ok(groups)
}

/// Each value's own straight line over all frames, every frame counting alike.
struct Lines {
    /// Sum of a value, and of it times exposure less mean exposure.
    sums: Vec<[f64; 2]>,
    n: f64,
    mean_t: f64,
    /// Sum over frames of (exposure - mean)^2.
    spread_t: f64,
}

impl Lines {
    fn read(reader: &Reader<'_>, frames: &[Taken]) -> Result<Self> {
        let n = frames.len() as f64;
        let times = || frames.iter().map(|f| f.record.exposure_ms);
        let mean_t = times().sum::<f64>() / n;
        let mut sums = vec![[0.0; 2]; reader.values()];
        for frame in frames {
            let off = frame.record.exposure_ms - mean_t;
            for (sum, &value) in sums.iter_mut().zip(&reader.load(frame)?.data) {
                sum[0] += f64::from(value);
                sum[1] += off * f64::from(value);
            }
        }
        Ok(Self {
            sums,
            n,
            mean_t,
            spread_t: times().map(|t| (t - mean_t).powi(2)).sum(),
        })
    }

    fn slope(&self, i: usize) -> f64 {
        self.sums[i][1] / self.spread_t
    }

    fn bias(&self, i: usize) -> f64 {
        self.sums[i][0] / self.n - self.slope(i) * self.mean_t
    }

    /// The values whose line stands out from the others of their place, in slope or at zero exposure.
    fn hot(&self, reader: &Reader<'_>, sigma: f64) -> Vec<bool> {
        let mut hot = vec![false; self.sums.len()];
        // Rounding alone scatters a line by this much.
        let floor = crate::measure::dark::QUANTIZATION;
        let floors = [
            floor / self.spread_t,
            floor * (1.0 / self.n + self.mean_t.powi(2) / self.spread_t),
        ];
        for place in 0..reader.layout.places() {
            let of_place: Vec<usize> = (0..hot.len())
                .filter(|&i| reader.place(i) == place)
                .collect();
            for (k, floor) in floors.iter().enumerate() {
                let value = |i: usize| if k == 0 { self.slope(i) } else { self.bias(i) };
                let mut values: Vec<f32> = of_place.iter().map(|&i| value(i) as f32).collect();
                let (middle, spread) = middle_and_spread(&mut values);
                let limit = sigma * spread.max(floor.sqrt());
                for &i in &of_place {
                    hot[i] |= (value(i) - middle).abs() > limit;
                }
            }
        }
        hot
    }

    fn list(&self, reader: &Reader<'_>, hot: &[bool]) -> Vec<HotPixel> {
        let n = reader.layout.values_per_pixel();
        let pixel = |i: usize| HotPixel {
            x: i / n % reader.size[0],
            y: i / n / reader.size[0],
            per_ms: self.slope(i),
        };
        let mut list: Vec<HotPixel> = (0..hot.len()).filter(|&i| hot[i]).map(pixel).collect();
        list.dedup_by_key(|h| (h.x, h.y));
        list
    }

    /// Standard deviation of the slopes about their place's mean, without that of the noise.
    fn scatter(&self, reader: &Reader<'_>, hot: &[bool], exposures: &[Exposure]) -> f64 {
        let mut places = [crate::math::statistics::Running::default(); 4];
        for i in (0..hot.len()).filter(|&i| !hot[i]) {
            places[reader.place(i)].push(self.slope(i));
        }
        let seen = places.iter().filter(|p| p.count() > 1);
        let (sum, n) = seen.fold((0.0, 0.0), |(s, n), p| {
            let count = p.count() as f64;
            (s + count * p.variance(), n + count)
        });
        let noise: f64 = exposures
            .iter()
            .map(|e| {
                e.n * e.variance * ((e.stated.exposure_ms - self.mean_t) / self.spread_t).powi(2)
            })
            .sum();
        (sum / f64::max(n, 1.0) - noise).max(0.0).sqrt()
    }
}

/// The darks of one exposure, without hot pixels.
struct Exposure {
    stated: DarkExposure,
    n: f64,
    /// Values by place.
    values: [f64; 4],
    /// Of one raw value, from repeats.
    variance: f64,
    freedom: f64,
    /// Sum of squared deviations of the frames' means, over places.
    between: f64,
    /// Share of values that are 0.
    zeros: f64,
}

impl Exposure {
    fn read(reader: &Reader<'_>, group: &[Taken], hot: &[bool]) -> Result<Self> {
        let n = group.len() as f64;
        let mut sums = vec![[0.0_f64; 2]; hot.len()];
        let mut frame_means = Vec::new();
        let (mut values, mut zeros) = ([0.0; 4], 0.0);
        for frame in group {
            let read = reader.load(frame)?;
            let mut mean = [0.0; 4];
            values = [0.0; 4];
            for (i, &value) in read.data.iter().enumerate().filter(|(i, _)| !hot[*i]) {
                let value = f64::from(value);
                sums[i][0] += value;
                sums[i][1] += value * value;
                let place = reader.place(i);
                mean[place] += value;
                values[place] += 1.0;
                zeros += f64::from(u8::from(value < 0.5));
            }
            frame_means.push([0, 1, 2, 3].map(|p| mean[p] / f64::max(values[p], 1.0)));
        }
        let mean = [0, 1, 2, 3].map(|p| frame_means.iter().map(|m| m[p]).sum::<f64>() / n);
        let between = frame_means
            .iter()
            .flat_map(|m| (0..4).map(|p| (m[p] - mean[p]).powi(2)));
        let total: f64 = values.iter().sum();
        let freedom = total * (n - 1.0);
        let steady = sums.iter().zip(hot).filter(|(_, hot)| !**hot);
        let square: f64 = steady.map(|(s, _)| s[1] - s[0] * s[0] / n).sum();
        if total < 1000.0 {
            return Err(Error::new(format!(
                "only {total} pixels are not hot in the darks of {} ms",
                group[0].record.exposure_ms
            ))
            .with_hint("was the lens capped? raise --hot-sigma when the sensor is that uneven"));
        }
        let variance = (square / freedom).max(crate::measure::dark::QUANTIZATION);
        Ok(Self {
            stated: DarkExposure {
                exposure_ms: group[0].record.exposure_ms,
                frames: group.len(),
                mean,
                sigma: variance.sqrt(),
            },
            n,
            values,
            variance,
            freedom,
            between: between.sum(),
            zeros: zeros / (n * total),
        })
    }
}

/// Variance of a frame's mean beyond the noise of its pixels: the black level wanders from frame to frame.
fn wander(exposures: &[Exposure], places: usize) -> f64 {
    let freedom: f64 = exposures.iter().map(|e| e.n - 1.0).sum();
    let found: f64 = exposures.iter().map(|e| e.between).sum::<f64>() / (freedom * places as f64);
    let noise = |e: &Exposure| {
        let of_places = e.values[..places]
            .iter()
            .map(|v| e.variance / v)
            .sum::<f64>();
        (e.n - 1.0) * of_places / places as f64
    };
    let expected = exposures.iter().map(noise).sum::<f64>() / freedom;
    (found - expected).max(0.0)
}

fn line(exposures: &[Exposure], place: usize, wander: f64) -> Option<Solution> {
    let mut normal = Normal::new(2);
    for e in exposures {
        let variance = (e.variance / e.values[place] + wander) / e.n;
        normal.add(&[1.0, e.stated.exposure_ms], e.stated.mean[place], variance);
    }
    normal.solve()
}

/// Chi-square per degree of freedom over all places.
fn reduced(fits: &[Solution]) -> f64 {
    let sum = |f: &dyn Fn(&Solution) -> f64| fits.iter().map(f).sum::<f64>();
    sum(&|f| f.chi_square) / sum(&|f| f.freedom as f64).max(1.0)
}

/// Says where the mean is no straight line over the exposure. Places wander together, so they count as one.
fn bent(fits: &[Solution], exposures: &[Exposure]) -> Vec<String> {
    let freedom = fits.first().map_or(0, |f| f.freedom);
    if freedom == 0 || reduced(fits) * freedom as f64 <= chi_square_limit(freedom) {
        return Vec::new();
    }
    let off = |e: &Exposure, (p, f): (usize, &Solution)| {
        e.stated.mean[p] - f.values[0] - f.values[1] * e.stated.exposure_ms
    };
    let all = exposures.iter().flat_map(|e| {
        fits.iter()
            .enumerate()
            .map(move |f| (e.stated.exposure_ms, off(e, f)))
    });
    let worst = all.max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()));
    let (exposure_ms, off) = worst.unwrap_or((0.0, 0.0));
    vec![format!(
        "the mean dark is not a straight line over the exposure: off by {off:+.3} raw values at {exposure_ms} ms (chi-square {:.1} per degree of freedom); did the sensor warm up, or light leak in?",
        reduced(fits)
    )]
}

/// The standard deviation at zero exposure and its standard error, from a straight line through the variances.
fn read_noise(exposures: &[Exposure]) -> Result<(f64, f64)> {
    let mut normal = Normal::new(2);
    for e in exposures {
        let se_square = 2.0 * e.variance.powi(2) / e.freedom;
        normal.add(&[1.0, e.stated.exposure_ms], e.variance, se_square);
    }
    let line = normal.solve().filter(|l| l.values[0] > 0.0);
    let line = line.ok_or_else(|| {
        Error::new("the variance of the darks does not extrapolate to zero exposure").with_hint(HOW)
    })?;
    let sigma = line.values[0].sqrt();
    Ok((sigma, line.se(0) / (2.0 * sigma)))
}

/// Warns when the bias has moved since the dark calibration that is known.
fn moved(value: &DarkCurrent, known: &Calibrations, places: usize) -> Vec<String> {
    let Some(old) = &known.dark else {
        return Vec::new();
    };
    let change = |p: usize| value.bias[p] - old.value.bias[p];
    let far =
        |p: &usize| change(*p).abs() > 0.2 + 5.0 * value.bias_se[*p].hypot(old.value.bias_se[*p]);
    let text = |p: usize| {
        format!(
            "the bias moved by {:+.2} raw values since {}: were gain, offset or temperature changed?",
            change(p),
            old.header.date_utc
        )
    };
    (0..places).find(far).map(text).into_iter().collect()
}
