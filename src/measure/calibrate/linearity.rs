//! The response curve and the photon transfer, from steady light at many exposures.
//!
//! With `s` the raw value less bias, `u = s / full_scale` and brackets for means over a box of pixels,
//!
//! ```text
//! [L(s) - L(dark)] = R_channel t,    L(s) = s (1 + c_1 u + c_2 u^2 + c_3 u^3)
//! ```
//!
//! is linear in `c` and `R`; the powers of `s` are averaged over the box, so that it need not be evenly lit. The three
//! channels share the curve and, in each exposure, the error of the exposed time (shutter, flicker), whose size comes from
//! what the curve leaves unexplained. Not modeled: a curve that differs between pixels, a shutter that opens late by the
//! same time in every exposure.

use super::curve_fit::{Channel, FEWEST_EXPOSURES, Fit, Group, fit_where_straight, residuals};
use super::darks::{Darks, wanted};
use super::drift::Course;
use super::least_squares::Normal;
use super::patch::Patch;
use super::readings::{Reading, Rules, Sums, check_not_all_clipped};
use super::recording::{Reader, Recording};
use super::transfer::{Noise, dark_points, fit as fit_transfer};
use super::{Calibrated, LinearityOptions};
use crate::base::{Error, Result, Watch};
use crate::measure::calibration::{Calibrations, Dated, Kind, Linearity, TransferPoint};
use crate::measure::frames::{Taken, same_exposure};
use crate::measure::linear::Curve;
use crate::session::{FrameKind, SessionFolder};

/// The response curve and the photon transfer from steady light at many exposures.
///
/// # Errors
/// Fewer than five exposures that are not clipped, an exposure shot only once, no dark; a frame is missing, torn, changed
/// or of another camera or sensitivity.
pub fn linearity(
    session: &SessionFolder,
    known: &Calibrations,
    options: &LinearityOptions,
    watch: &dyn Watch,
) -> Result<Calibrated<Linearity>> {
    let recording = Recording::open(session)?;
    let lit = series(&recording, options)?;
    let references = recording.of(FrameKind::Reference);
    let all_lit = [&lit[..], &references[..]].concat();
    let darks = wanted(&recording, &all_lit);
    let frames = [&darks[..], &references[..], &darks[..], &lit[..]].concat();
    let (reader, first) = recording.reader(&frames, watch)?;
    drop(first);
    // What is to be found out is not taken as known.
    let known = Calibrations {
        linearity: None,
        ..known.clone()
    };
    let course = if references.is_empty() {
        Course::default()
    } else {
        Course::read(&recording, &reader, &darks, &references, &known)?
    };
    let mut patch = match options.region {
        Some([x, y, w, h]) => Patch::of_box(&reader, [x, y, x + w, y + h])?,
        None => Patch::around(&reader, recording.manifest.camera.center_px)?,
    };
    let darks = Darks::read(&reader, &darks, &mut patch, &lit, &known)?;
    let seen = read_series(&reader, &patch, &darks, &lit, options)?;
    let groups = group(&seen, &course, &patch)?;
    let full_scale = reader.white - mean_bias(&reader, darks.bias);
    let (groups, fit) = fit_where_straight(groups, full_scale, options.max_order)?;
    let curve = Curve::new(fit.coefficients().to_vec(), full_scale, darks.bias);
    let mut points: Vec<TransferPoint> = seen.points.iter().map(|p| through(&curve, p)).collect();
    points.extend(dark_points(&darks, &patch, &curve));
    let (transfer, mut faults) = fit_transfer(points)?;
    let residuals = residuals(&groups, &fit, &curve);
    faults.extend(fit.faults(&residuals));
    let mut warnings = Vec::new();
    if references.is_empty() {
        let said = judge_steadiness(&seen, &fit, &curve);
        warnings.extend(said.0);
        faults.extend(said.1);
    }
    let levels = || {
        groups
            .iter()
            .flat_map(|g| g.channels.iter().map(|c| c.level / full_scale))
    };
    let usable = [
        levels().fold(f64::MAX, f64::min),
        levels().fold(0.0, f64::max),
    ];
    if usable[1] < 0.7 {
        warnings.push(format!(
            "the curve was checked up to {:.0} % of the full scale only, and brighter values will not be used: add longer exposures",
            100.0 * usable[1]
        ));
    }
    let value = Linearity {
        covariance: fit.covariance(),
        coefficients: fit.coefficients().to_vec(),
        full_scale,
        bias: darks.bias,
        usable,
        points: residuals,
        transfer,
    };
    Ok(Calibrated {
        dated: Dated {
            header: recording.header(Kind::Linearity),
            value,
        },
        warnings,
        faults,
    })
}

/// The frames with steady light.
fn series(recording: &Recording<'_>, options: &LinearityOptions) -> Result<Vec<Taken>> {
    const HOW: &str = "shoot something steadily and evenly lit (the white panel) at 8 or more exposures from nearly dark to nearly saturated, each twice, and darks of the same exposures";
    let kind = options.kind.unwrap_or_else(|| {
        let whites = recording
            .frames
            .iter()
            .any(|f| f.record.kind == FrameKind::White);
        if whites {
            FrameKind::White
        } else {
            FrameKind::Flat
        }
    });
    let frames = recording.need(kind, HOW)?;
    let alone: Vec<String> = frames
        .chunk_by(|a, b| same_exposure(a.record.exposure_ms, b.record.exposure_ms))
        .filter(|g| g.len() < 2)
        .map(|g| format!("{} ms", g[0].record.exposure_ms))
        .collect();
    if !alone.is_empty() {
        return Err(Error::new(format!(
            "too few repeats: one {} frame only of {}",
            kind.name(),
            alone.join(", ")
        ))
        .with_hint("the noise comes from differences of pairs: shoot every exposure twice"));
    }
    Ok(frames)
}

/// What the frames of the series read.
struct Series {
    readings: Vec<Reading>,
    /// Pairs, raw scale.
    points: Vec<TransferPoint>,
    noise: Noise,
}

fn read_series(
    reader: &Reader<'_>,
    patch: &Patch,
    darks: &Darks,
    lit: &[Taken],
    options: &LinearityOptions,
) -> Result<Series> {
    let rules = Rules {
        patch,
        darks,
        curve: &Curve::new(Vec::new(), 1.0, darks.bias),
        response: None,
        limit: options.usable_fraction * reader.white,
    };
    let (readings, points) = rules.read(reader, lit)?;
    check_not_all_clipped(&readings, patch, rules.limit)?;
    let noise = Noise::known(None, &points, darks)?;
    Ok(Series {
        readings,
        points,
        noise,
    })
}

fn mean_bias(reader: &Reader<'_>, bias: [f64; 4]) -> f64 {
    let places = reader.layout.places();
    bias[..places].iter().sum::<f64>() / places as f64
}

/// Averages the frames of each exposure.
///
/// # Errors
/// Too few exposures that are not clipped.
fn group(seen: &Series, course: &Course, patch: &Patch) -> Result<Vec<Group>> {
    let exposure = |r: &Reading| r.frame.record.exposure_ms;
    let mut groups = Vec::new();
    for group in seen
        .readings
        .chunk_by(|a, b| same_exposure(exposure(a), exposure(b)))
    {
        let channel = |c: usize| {
            let sees = |r: &&Reading| r.channels[c].is_some();
            let used: Vec<(&Taken, &Sums)> = group
                .iter()
                .filter_map(|r| r.usable(c).map(|s| (&r.frame, s)))
                .collect();
            let whole = !used.is_empty() && used.len() == group.iter().filter(sees).count();
            whole.then(|| average(c, &used, seen, course, patch))
        };
        let channels: Vec<Channel> = (0..3).filter_map(channel).collect();
        if !channels.is_empty() {
            groups.push(Group {
                exposure_ms: exposure(&group[0]),
                channels,
            });
        }
    }
    if groups.len() < FEWEST_EXPOSURES {
        return Err(Error::new(format!(
            "too few exposures: {} that are not clipped, at least {FEWEST_EXPOSURES} are needed",
            groups.len()
        ))
        .with_hint("shoot 8 or more exposures from nearly dark to nearly saturated"));
    }
    Ok(groups)
}

fn average(
    channel: usize,
    used: &[(&Taken, &Sums)],
    seen: &Series,
    course: &Course,
    patch: &Patch,
) -> Channel {
    let n = used.len() as f64;
    let mut mean = Channel {
        channel,
        powers: [0.0; 4],
        level: 0.0,
        time: 0.0,
        variance: 0.0,
        copies: patch.copies(used[0].0.record.filter),
    };
    for (frame, sums) in used {
        for (mean, power) in mean.powers.iter_mut().zip(sums.powers) {
            *mean += power / n;
        }
        let (level, variance) = course.level(&frame.moment, channel);
        mean.level += sums.level / n;
        mean.time += frame.record.exposure_ms * level / n;
        let relative = variance / (level * level);
        mean.variance +=
            sums.own_variance(&seen.noise, channel) / (n * n) + sums.dark_variance() / n;
        mean.variance += sums.powers[0].powi(2) * relative / n;
    }
    mean
}

/// A pair's point through the curve.
fn through(curve: &Curve, point: &TransferPoint) -> TransferPoint {
    let square = curve.slope(point.signal).powi(2);
    TransferPoint {
        channel: point.channel,
        signal: curve.at(point.signal),
        variance: point.variance * square,
        variance_se: point.variance_se * square,
    }
}

/// Without reference visits the light must be steady: a warning when the frames cannot tell, and a fault when they say it
/// is not.
fn judge_steadiness(seen: &Series, fit: &Fit, curve: &Curve) -> (Option<String>, Option<String>) {
    let mut order: Vec<&Reading> = seen.readings.iter().collect();
    let elapsed = |r: &Reading| r.frame.moment.elapsed_s;
    order.sort_by(|a, b| elapsed(a).total_cmp(&elapsed(b)));
    let times: Vec<f64> = order.iter().map(|r| r.frame.record.exposure_ms).collect();
    if times.is_sorted() || times.is_sorted_by(|a, b| a >= b) {
        let text = "the light is taken as steady: exposures shot in order of length cannot tell a drifting lamp from a curve; shoot them up and down again, or with reference visits in between";
        return (Some(text.to_owned()), None);
    }
    let mut line = Normal::new(2);
    for reading in &order {
        for (c, sums) in (0..3).filter_map(|c| Some((c, reading.usable(c)?))) {
            let linear = curve.at(sums.level) - curve.at(sums.level - sums.powers[0]);
            let expected = fit.rate(c) * reading.frame.record.exposure_ms;
            let noise = sums.own_variance(&seen.noise, c) + sums.dark_variance();
            let variance = noise / (expected * expected) + fit.jitter;
            line.add(&[1.0, elapsed(reading)], linear / expected - 1.0, variance);
        }
    }
    let Some(line) = line.solve().filter(|l| l.freedom > 4) else {
        return (None, None);
    };
    // Channels share the jitter: three of them count as one.
    let se = line.se(1) * (3.0 * line.chi_square / line.freedom as f64).sqrt();
    let span = order.last().map_or(0.0, |r| elapsed(r)) - elapsed(order[0]);
    let change = line.values[1] * span;
    let drifted = change.abs() > 0.001 && line.values[1].abs() > 5.0 * se;
    let text = || {
        format!(
            "the light drifted by {:+.2} +- {:.2} % during the series: let the lamp warm up, or visit the reference pose in between",
            100.0 * change,
            100.0 * se * span
        )
    };
    (None, drifted.then(text))
}
