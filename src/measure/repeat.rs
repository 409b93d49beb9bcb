//! How much frames of the same thing differ in brightness beyond the noise of their pixels: lamp, shutter, and what of the
//! response curve is not known.

use super::field::Weights;
use super::stack::Stack;

/// A group of frames of one thing in one channel: the sum of squared relative deviations from their mean, what noise makes
/// of it, and its degrees of freedom.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Deviation {
    /// Sum of squared relative deviations.
    square: f64,
    /// What noise makes of one degree of freedom: `a shot + constant`.
    shot: f64,
    constant: f64,
    freedom: f64,
    channel: usize,
}

/// Fewer degrees of freedom than this say nothing.
const ENOUGH: f64 = 4.0;

/// A variance from frame to frame counts from this many of its standard errors on; noise alone would else be taken for it.
const SIGNIFICANT: f64 = 2.0;

/// The deviations of the repeats of each exposure, and of the exposures of a bracket from one another; clipped ones left
/// out.
pub(super) fn deviations(stacks: &[Stack], weights: &Weights) -> Vec<Deviation> {
    let whole: Vec<&Stack> = stacks.iter().filter(|s| s.clipped_in_crop == 0).collect();
    let mut found = Vec::new();
    for channel in 0..3 {
        let mut rates = Vec::new();
        for stack in whole.iter().filter(|s| s.sees(channel)) {
            let mean = stack.crop_mean(weights, channel);
            let square = mean.signal * mean.signal;
            let read = mean.squares * stack.dark_variance;
            let (shot, read) = (mean.shot / square, read / square);
            // Of one frame; the dark they share cancels.
            let n = stack.repeats;
            if n > 1.0 {
                let relative = stack
                    .repeat_means
                    .iter()
                    .map(|m| (m[channel] / mean.signal - 1.0).powi(2));
                found.push(Deviation {
                    square: relative.sum(),
                    shot: shot * n,
                    constant: read,
                    freedom: n - 1.0,
                    channel,
                });
            }
            let dark = read / stack.dark_count;
            rates.push((mean.signal / stack.time(channel), shot, read / n + dark, n));
        }
        found.extend(between_exposures(&rates, channel));
    }
    found.retain(|d| d.square.is_finite() && d.shot.is_finite() && d.constant.is_finite());
    found
}

/// Pairs of neighbors in the bracket: their difference over the square root of two is one degree of freedom.
fn between_exposures(rates: &[(f64, f64, f64, f64)], channel: usize) -> Vec<Deviation> {
    let pairs = rates.chunks_exact(2).map(|pair| {
        let [(m1, s1, c1, n1), (m2, s2, c2, n2)] = [pair[0], pair[1]];
        let mean = 0.5 * (m1 + m2);
        // A mean of n frames scatters less from frame to frame by n.
        let frames = 1.0 / n1 + 1.0 / n2;
        Deviation {
            square: ((m1 - m2) / mean).powi(2) / frames,
            shot: (s1 + s2) / frames,
            constant: (c1 + c2) / frames,
            freedom: 1.0,
            channel,
        }
    });
    pairs.collect()
}

/// The relative standard deviation from frame to frame and its degrees of freedom; none when there is too little to tell
/// it from; 0 when it is not told from noise. Solves `sum_j w_j (square_j - freedom_j (noise_j + s^2)) = 0` with `w_j = 1 / (noise_j + s^2)^2`.
pub(super) fn between_frames(deviations: &[Deviation], slope: [f64; 3]) -> Option<(f64, f64)> {
    let freedom: f64 = deviations.iter().map(|d| d.freedom).sum();
    // The three channels of a frame flicker together.
    let freedom = freedom / 3.0;
    if freedom < ENOUGH {
        return None;
    }
    let noise = |d: &Deviation| slope[d.channel] * d.shot.max(0.0) + d.constant;
    let mut variance = 0.0_f64;
    for _ in 0..30 {
        let (mut above, mut below) = (0.0, 0.0);
        for d in deviations {
            let weight = 1.0 / (noise(d) + variance).powi(2);
            above += weight * (d.square - d.freedom * noise(d));
            below += weight * d.freedom;
        }
        variance = (above / below).max(0.0);
    }
    let (mut spread, mut below) = (0.0, 0.0);
    for d in deviations {
        let of_one = noise(d) + variance;
        spread += 2.0 * d.freedom / of_one.powi(2);
        below += d.freedom / of_one.powi(2);
    }
    // The channels of a frame flicker together, so they are one observation.
    let error = (3.0 * spread).sqrt() / below;
    if variance < SIGNIFICANT * error {
        return Some((0.0, freedom));
    }
    variance.is_finite().then(|| (variance.sqrt(), freedom))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    fn scattered(flicker: f64, seed: u64) -> Vec<Deviation> {
        let mut random = Random::keyed(&[seed]);
        let groups = (0..400).map(|i| {
            let noise = 1e-6 * (1.0 + f64::from(i % 7)).powi(2);
            let values: Vec<f64> = (0..3)
                .map(|_| flicker * random.normal() + noise.sqrt() * random.normal())
                .collect();
            let mean = values.iter().sum::<f64>() / 3.0;
            Deviation {
                square: values.iter().map(|v| (v - mean).powi(2)).sum(),
                shot: noise / 0.4,
                constant: 0.0,
                freedom: 2.0,
                channel: 0,
            }
        });
        groups.collect()
    }

    #[test]
    fn scatter_from_frame_to_frame_is_told_from_noise() {
        // 800 degrees of freedom: sees an error of 10 % (4 standard errors).
        let (found, _) = between_frames(&scattered(3e-3, 1), [0.4; 3]).unwrap();
        assert!((found / 3e-3 - 1.0).abs() < 0.1, "{found}");
        let (none, _) = between_frames(&scattered(0.0, 2), [0.4; 3]).unwrap();
        assert!(none == 0.0, "{none}");
        // Noise said to be half of what it is turns up as flicker.
        let (wrong, _) = between_frames(&scattered(0.0, 2), [0.2; 3]).unwrap();
        assert!(wrong > 1e-3, "{wrong}");
        assert!(between_frames(&scattered(3e-3, 1)[..4], [0.4; 3]).is_none());
    }
}
