//! One configuration: weighted means over the projected sample square, and what their variances are made of.
//!
//! With weights `w_i` (area the value stands for), the white fit `F_i`, the flat field `f_i`, the standard's normalized
//! radiance `K` and the merged rates `x_i`,
//!
//! ```text
//! M = sum_i g_i x_i,      g_i = w_i K / (F_i f_i sum_j w_j),      x_i = sum_e p_ie s_ie
//! ```
//!
//! over one channel's values, with `s_ie` the linear raw value less dark in exposure e and `p_ie` its weight over the sum of
//! weights, over exposure time times the lamp's level.

use super::linear::Response;
use super::merge::Merged;
use super::radiance::scale;
use super::stack::{Stack, Target};
use super::white::{Flat, Terms, White};

/// One channel's mean over the crop, and its sensitivities.
#[derive(Debug, Clone, Default)]
pub(super) struct ChannelSums {
    pub(super) mean: f64,
    /// `sum g^2 p^2 signal / repeats`; times the slope of the photon transfer it is the variance of shot noise.
    pub(super) shot: f64,
    /// `sum g^2 p^2 r^2 / repeats`.
    pub(super) read: f64,
    /// `sum g^2 p^2 r^2 / dark frames`.
    pub(super) dark: f64,
    /// Minus the derivative of `mean` by the coefficients of the white fit.
    pub(super) white: Terms,
    /// By stack: the part of the mean that comes from it.
    pub(super) shares: Vec<f64>,
    /// Derivatives by the coefficients of the response curve.
    pub(super) by_response: Vec<f64>,
    /// Variance from the errors of the flat field's values.
    pub(super) flat: f64,
    /// `sum (g x)^2`.
    pub(super) squares: f64,
}

/// The sums of one channel.
pub(super) fn channel_sums(
    channel: usize,
    merged: &Merged,
    stacks: &[Stack],
    target: &Target<'_>,
    white: &White,
    flat: Option<&Flat>,
    response: &Response,
) -> ChannelSums {
    let mut sums = ChannelSums {
        shares: vec![0.0; stacks.len()],
        by_response: vec![0.0; response.order()],
        ..ChannelSums::default()
    };
    let plane = merged.plane(channel);
    let (mut flat_own, mut flat_both) = (0.0, 0.0);
    for value in &target.weights.channels[channel] {
        let i = value.index;
        let at = target.window.pixel(i);
        let g = value.weight / target.weights.total[channel] * scale(white, flat, channel, i, at);
        let mut m = 0.0;
        for share in plane.shares(stacks, i, channel) {
            let s = &stacks[share.stack];
            let signal = f64::from(s.signal[i]);
            let factor = g * share.part;
            m += factor * signal;
            sums.shot += factor * factor * signal / s.repeats;
            sums.read += factor * factor * s.dark_variance / s.repeats;
            sums.dark += factor * factor * s.dark_variance / s.dark_count;
            sums.shares[share.stack] += factor * signal;
            for (k, sum) in sums.by_response.iter_mut().enumerate() {
                *sum += factor * response.derivative(k, signal);
            }
        }
        sums.mean += m;
        sums.squares += m * m;
        let phi = white.terms(at.0, at.1);
        let rate = white.rate(channel, &phi);
        for (sum, term) in sums.white.iter_mut().zip(&phi) {
            *sum += m * term / rate;
        }
        if let Some(flat) = flat {
            let variance = f64::from(flat.se[i]).powi(2);
            flat_own += m * m * variance;
            flat_both += m * white.share(channel, at) * variance;
        }
    }
    // The white standard was divided by the same flat field: what pixels have in common cancels.
    sums.flat = flat_own - 2.0 * sums.mean * flat_both;
    for k in 0..response.order() {
        sums.by_response[k] -= white.by_response(channel, &sums.white, k);
    }
    sums
}
