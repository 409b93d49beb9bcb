//! White frames: what radiance a raw value stands for, everywhere in the image.
//!
//! Without a flat field the panel is taken as uniform over the box that holds all crops, so what is not uniform in its
//! image is the camera's vignetting. Per channel, the rate in raw values per millisecond is fitted by
//!
//! ```text
//! F(u, v) = b0 + b1 u + b2 v + b3 u^2 + b4 u v + b5 v^2 + b6 (u^2 + v^2)^2
//! ```
//!
//! with (u, v) the offset from the image of the sample center over the distance to the box's farthest corner. A gradient of
//! the light across the panel cannot be told from vignetting; shoot the panel with the light near its normal. With a flat
//! field, raw values are divided by it and `F` is one number: their mean over the sample square.

use super::calibration::{FlatField, WhiteStandard};
use super::field::Window;
use super::lamp::Level;
use super::linear::Response;
use super::noise::{Cell, Scatter};
use super::reduce::COLORS;
use super::stack::{Stack, Target};
use crate::base::{Error, Result};
use crate::session::WhiteReference;
use serde::Serialize;

/// Terms of the fit.
pub(super) const TERMS: usize = 7;

/// One number per term.
pub(super) type Terms = [f64; TERMS];

/// What the white frames said.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct WhiteReport {
    /// Raw values per (normalized radiance x millisecond) at the image of the sample center, r, g, b.
    pub responsivity: [f64; 3],
    /// Fitted loss (negative: gain) of light at the farthest corner of the fitted box relative to the sample center.
    pub vignetting_at_corner: [f64; 3],
    /// Mean square residual of the fit over the variance expected from noise; well above 1: an uneven panel.
    pub chi_square_per_pixel: [f64; 3],
    /// Exposures used, milliseconds.
    pub exposures_ms: Vec<f64>,
    /// True when it is not of this session: the responsivity of a calibration.
    pub from_calibration: bool,
}

/// A flat field on a window: relative response and its relative standard error, value by value.
#[derive(Debug, Clone)]
pub(super) struct Flat {
    pub(super) response: Vec<f32>,
    pub(super) se: Vec<f32>,
}

impl Flat {
    /// The part of a calibration that lies in a window; none when there is no flat field.
    pub(super) fn of(known: Option<&FlatField>, window: &Window) -> Option<Self> {
        let known = known?;
        let rows = || window.rows();
        let take = |map: &[f32]| {
            rows()
                .flat_map(|row| map[row].to_vec())
                .collect::<Vec<f32>>()
        };
        let response = take(&known.response);
        let se = take(&known.response_se);
        let se = se.iter().zip(&response).map(|(s, r)| s / r.max(1e-6));
        Some(Self {
            se: se.collect(),
            response,
        })
    }
}

/// The fitted rate image of the white standard.
pub(super) struct White {
    center: [f64; 2],
    scale: f64,
    /// 1 or [`TERMS`].
    order: usize,
    fits: [Fit; 3],
    /// Normalized radiance of the standard, `reflectance_factor cos(theta_light)`.
    pub(super) radiance: [f64; 3],
    /// Relative standard uncertainty of it.
    pub(super) radiance_se: [f64; 3],
    corner: [f64; 2],
    exposures_ms: Vec<f64>,
    /// By channel: the lamp's level in each usable exposure, and that exposure's part in the fit.
    pub(super) levels: [Vec<(f64, Level)>; 3],
    /// By channel: `sum part^2 / repeats` over exposures.
    pub(super) flicker: [f64; 3],
    /// With a flat field: the window, and the part of each of its values in the mean, by channel.
    shares: Option<(Window, [Vec<f32>; 3])>,
    pub(super) from_calibration: bool,
}

/// One channel's fit. Variances are `a first + second`, with `a` the slope of the photon transfer.
struct Fit {
    coefficients: Terms,
    covariance: [[Terms; TERMS]; 2],
    /// Derivatives of the coefficients by those of the response curve.
    by_response: Vec<Terms>,
    /// Mean square residual times `n / (n - order)`.
    residual: f64,
    /// Mean of the pixel's expected variance.
    variance: [f64; 2],
    pixels: f64,
}

/// Where the white standard is fitted, and by how many terms.
pub(super) struct WhitePlace<'a> {
    pub(super) target: Target<'a>,
    pub(super) flat: Option<&'a Flat>,
    /// Image of the sample center.
    pub(super) center: [f64; 2],
}

impl White {
    /// Fits the usable exposures of the white frames.
    ///
    /// # Errors
    /// When every exposure is saturated, the standard is not brighter than the dark, or the fit has too few pixels.
    pub(super) fn fit(
        reference: &WhiteReference,
        place: &WhitePlace<'_>,
        stacks: &[Stack],
        response: &Response,
    ) -> Result<Self> {
        let bounds = place.target.window.bounds;
        let usable: Vec<&Stack> = stacks.iter().filter(|s| s.clipped_in_crop == 0).collect();
        if let Some(c) = (0..3).find(|&c| !usable.iter().any(|s| s.sees(c))) {
            return Err(unusable(stacks, c, bounds));
        }
        let order = if place.flat.is_some() { 1 } else { TERMS };
        let mut white = Self::empty(reference, place, order);
        for c in 0..3 {
            let of_channel: Vec<&Stack> = usable.iter().copied().filter(|s| s.sees(c)).collect();
            let total: f64 = of_channel.iter().map(|s| exposed(s)).sum();
            white.fits[c] =
                fit_channel(place, &of_channel, c, response, |x, y| white.terms_at(x, y))?;
            let part = |s: &&Stack| exposed(s) / total;
            white.levels[c] = of_channel
                .iter()
                .map(|s| (part(s), s.level.clone()))
                .collect();
            white.flicker[c] = of_channel.iter().map(|s| part(s).powi(2) / s.repeats).sum();
        }
        white.exposures_ms = usable.iter().map(|s| s.exposure_ms).collect();
        white.shares = place.flat.map(|flat| {
            let shares = [0, 1, 2].map(|c| shares(place, flat, &usable, c));
            (place.target.window, shares)
        });
        Ok(white)
    }

    /// What a calibration says of the standard and the lamp.
    pub(super) fn known(known: &WhiteStandard, place: &WhitePlace<'_>) -> Self {
        let cosine = known.light_theta_deg.to_radians().cos();
        let reference = WhiteReference {
            configuration: crate::session::Configuration {
                id: 0,
                light: crate::math::PolarDirection::from_degrees(
                    known.light_theta_deg,
                    known.light_phi_deg,
                ),
                camera: crate::math::PolarDirection::from_degrees(
                    known.camera_theta_deg,
                    known.camera_phi_deg,
                ),
                rotation: 0.0,
            },
            reflectance_factor: known.reflectance_factor,
            // Part of the responsivity's.
            reflectance_factor_se: [0.0; 3],
        };
        let mut white = Self::empty(&reference, place, 1);
        for c in 0..3 {
            let rate = known.responsivity[c] * known.reflectance_factor[c] * cosine;
            let relative = known.responsivity_se[c] / known.responsivity[c];
            let fit = &mut white.fits[c];
            fit.coefficients[0] = rate;
            fit.covariance[1][0][0] = (rate * relative).powi(2);
            fit.variance[1] = 1.0;
        }
        white.from_calibration = true;
        white
    }

    /// Takes the standard as one gray: a camera that sees no color has one number for it. How it weights the colors is not
    /// known, so where their factors differ the range is an error, evenly likely throughout.
    pub(super) fn gray(&mut self) {
        let mean = self.radiance.iter().sum::<f64>() / 3.0;
        let (low, high) = self
            .radiance
            .iter()
            .fold((f64::MAX, 0.0_f64), |(l, h), &r| (l.min(r), h.max(r)));
        let spread = (high - low) / (12.0_f64.sqrt() * mean);
        let stated = self.radiance_se.iter().sum::<f64>() / 3.0;
        self.radiance = [mean; 3];
        self.radiance_se = [stated.hypot(spread); 3];
    }

    fn empty(reference: &WhiteReference, place: &WhitePlace<'_>, order: usize) -> Self {
        let bounds = place.target.window.bounds;
        // A crop far from the sample center is fitted about its own middle.
        let inside = |k: usize| (bounds[k] as f64..bounds[k + 2] as f64).contains(&place.center[k]);
        let center = if inside(0) && inside(1) {
            place.center
        } else {
            [0, 1].map(|k| 0.5 * (bounds[k] + bounds[k + 2]) as f64)
        };
        let far = |low: usize, high: usize, c: f64| {
            let (low, high) = (low as f64, high as f64);
            if c - low > high - c { low } else { high }
        };
        let corner = [
            far(bounds[0], bounds[2], center[0]),
            far(bounds[1], bounds[3], center[1]),
        ];
        let cosine = reference.configuration.light.theta.cos();
        let factor = reference.reflectance_factor;
        Self {
            center,
            scale: (corner[0] - center[0]).hypot(corner[1] - center[1]),
            order,
            fits: [0, 1, 2].map(|_| Fit::zero()),
            radiance: factor.map(|f| f * cosine),
            radiance_se: [0, 1, 2].map(|c| reference.reflectance_factor_se[c] / factor[c]),
            corner,
            exposures_ms: Vec::new(),
            levels: Default::default(),
            flicker: [0.0; 3],
            shares: None,
            from_calibration: false,
        }
    }

    /// The terms at a pixel.
    pub(super) fn terms(&self, x: usize, y: usize) -> Terms {
        self.terms_at(x as f64 + 0.5, y as f64 + 0.5)
    }

    fn terms_at(&self, x: f64, y: f64) -> Terms {
        let mut terms = terms(self.center, self.scale, x, y);
        terms[self.order..].fill(0.0);
        terms
    }

    /// The fitted rate where the terms are `phi`, raw values per millisecond.
    pub(super) fn rate(&self, channel: usize, phi: &Terms) -> f64 {
        dot(&self.fits[channel].coefficients, phi)
    }

    /// The derivative of `sum_k phi_k b_k` by coefficient k of the response curve.
    pub(super) fn by_response(&self, channel: usize, phi: &Terms, k: usize) -> f64 {
        let by_response = self.fits[channel].by_response.get(k);
        by_response.map_or(0.0, |terms| dot(terms, phi))
    }

    /// The part of a pixel in the white mean that a flat field was applied to; 0 outside it.
    pub(super) fn share(&self, channel: usize, (x, y): (usize, usize)) -> f64 {
        let Some((window, shares)) = &self.shares else {
            return 0.0;
        };
        let index = window.index(x, y, channel);
        index.map_or(0.0, |i| f64::from(shares[channel][i]))
    }

    /// The sum over the values of the white mean of the squares of part times relative error of the flat field.
    pub(super) fn flat_variance(&self, channel: usize, flat: &Flat) -> f64 {
        let Some((_, shares)) = &self.shares else {
            return 0.0;
        };
        let parts = shares[channel].iter().zip(&flat.se);
        parts.map(|(p, s)| f64::from(p * s).powi(2)).sum()
    }

    /// The variance of `sum_k phi_k b_k`.
    pub(super) fn variance(&self, channel: usize, phi: &Terms, scatter: &Scatter) -> f64 {
        let [first, second] = &self.fits[channel].covariance;
        let quadratic = |m: &[Terms; TERMS]| {
            let rows = m.iter().map(|row| dot(row, phi));
            rows.zip(phi).map(|(r, p)| r * p).sum::<f64>()
        };
        // Lack of fit beyond noise widens the error.
        let excess = self.chi_square(channel, scatter).max(1.0);
        (scatter.slope[channel] * quadratic(first) + quadratic(second)) * excess
    }

    fn chi_square(&self, channel: usize, scatter: &Scatter) -> f64 {
        let fit = &self.fits[channel];
        fit.residual / (scatter.slope[channel] * fit.variance[0] + fit.variance[1])
    }

    /// Relative variance of a pixel's rate about the fit that noise does not explain: unequal pixels, or an uneven panel.
    pub(super) fn unevenness(&self, channel: usize, scatter: &Scatter) -> f64 {
        let fit = &self.fits[channel];
        let noise = scatter.slope[channel] * fit.variance[0] + fit.variance[1];
        let excess = fit.residual - noise;
        // Within the scatter of the residual itself it is nothing.
        let sure = excess > 3.0 * fit.residual * (2.0 / fit.pixels.max(1.0)).sqrt();
        if sure {
            excess / fit.coefficients[0].powi(2)
        } else {
            0.0
        }
    }

    /// Estimates of the photon transfer's slope from the residuals of the fit.
    pub(super) fn residual_cells(&self) -> Vec<Cell> {
        let known = self.fits.iter().filter(|f| f.pixels > 0.0);
        known
            .map(|fit| Cell {
                x: fit.variance[0],
                y: fit.residual - fit.variance[1],
                constant: fit.variance[1],
                n: fit.pixels,
            })
            .collect()
    }

    pub(super) fn report(&self, scatter: &Scatter) -> WhiteReport {
        let center = self.terms_at(self.center[0], self.center[1]);
        let corner = self.terms_at(self.corner[0], self.corner[1]);
        let channels = [0, 1, 2];
        WhiteReport {
            responsivity: channels.map(|c| self.rate(c, &center) / self.radiance[c]),
            vignetting_at_corner: channels
                .map(|c| 1.0 - self.rate(c, &corner) / self.rate(c, &center)),
            chi_square_per_pixel: channels.map(|c| self.chi_square(c, scatter)),
            exposures_ms: self.exposures_ms.clone(),
            from_calibration: self.from_calibration,
        }
    }
}

/// Why no white frame of a channel can be used.
fn unusable(stacks: &[Stack], channel: usize, bounds: [usize; 4]) -> Error {
    let Some(shortest) = stacks.iter().find(|s| s.sees(channel)) else {
        return Error::new(format!(
            "there is no white frame through the {} filter",
            COLORS[channel]
        ))
        .with_hint("take white frames through all three filters");
    };
    Error::new(format!(
        "the white standard is saturated in every exposure: {} has {} pixels too bright in columns {} to {}, rows {} to {}",
        shortest.title, shortest.clipped_in_crop, bounds[0], bounds[2], bounds[1], bounds[3]
    ))
    .with_hint("take white frames with a shorter exposure")
}

impl Fit {
    fn zero() -> Self {
        Self {
            coefficients: [0.0; TERMS],
            covariance: [[[0.0; TERMS]; TERMS]; 2],
            by_response: Vec::new(),
            residual: 0.0,
            variance: [0.0; 2],
            pixels: 0.0,
        }
    }
}

fn terms(center: [f64; 2], scale: f64, x: f64, y: f64) -> Terms {
    let (u, v) = ((x - center[0]) / scale, (y - center[1]) / scale);
    let r2 = u * u + v * v;
    [1.0, u, v, u * u, u * v, v * v, r2 * r2]
}

fn dot(a: &Terms, b: &Terms) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Milliseconds exposed in all.
fn exposed(stack: &Stack) -> f64 {
    stack.exposure_ms * stack.repeats
}

/// A value's rate averaged over exposures, weights proportional to exposed time.
fn mean_rate(stacks: &[&Stack], channel: usize, index: usize) -> f64 {
    let total: f64 = stacks.iter().map(|s| exposed(s)).sum();
    let parts = stacks
        .iter()
        .map(|s| exposed(s) / total / s.time(channel) * f64::from(s.signal[index]));
    parts.sum()
}

/// The part of each value of the window in one channel's mean.
fn shares(place: &WhitePlace<'_>, flat: &Flat, usable: &[&Stack], channel: usize) -> Vec<f32> {
    let of_channel: Vec<&Stack> = usable.iter().copied().filter(|s| s.sees(channel)).collect();
    let mut shares = vec![0.0; place.target.window.len()];
    let mut total = 0.0;
    for value in &place.target.weights.channels[channel] {
        let rate = mean_rate(&of_channel, channel, value.index);
        let part = value.weight * rate / f64::from(flat.response[value.index]);
        shares[value.index] = part as f32;
        total += part;
    }
    shares.iter_mut().for_each(|s| *s /= total as f32);
    shares
}

/// Least squares of the rate averaged over exposures (weights proportional to exposed time), and the covariance of its
/// coefficients by propagation of each pixel's own variance.
fn fit_channel(
    place: &WhitePlace<'_>,
    stacks: &[&Stack],
    channel: usize,
    response: &Response,
    terms: impl Fn(f64, f64) -> Terms,
) -> Result<Fit> {
    let total: f64 = stacks.iter().map(|s| exposed(s)).sum();
    let mut normal = [[0.0; TERMS]; TERMS];
    let mut right = [0.0; TERMS];
    let mut by_response = vec![[0.0; TERMS]; response.order()];
    let mut square = 0.0;
    let (mut pixels, mut area) = (0.0, 0.0);
    let mut spread = [[[0.0; TERMS]; TERMS]; 2];
    let mut variance = [0.0; 2];
    let constant: f64 = stacks
        .iter()
        .map(|s| {
            let weight = exposed(s) / total / s.time(channel);
            weight * weight * s.dark_variance * (1.0 / s.repeats + 1.0 / s.dark_count)
        })
        .sum();
    for value in &place.target.weights.channels[channel] {
        let (x, y) = place.target.window.pixel(value.index);
        let phi = terms(x as f64 + 0.5, y as f64 + 0.5);
        let flat = place
            .flat
            .map_or(1.0, |f| f64::from(f.response[value.index]));
        let w = value.weight;
        let (mut rate, mut shot) = (0.0, 0.0);
        for s in stacks {
            let weight = exposed(s) / total / s.time(channel);
            let signal = f64::from(s.signal[value.index]);
            rate += weight * signal / flat;
            shot += weight * weight * signal / s.repeats / (flat * flat);
            for (k, sums) in by_response.iter_mut().enumerate() {
                let derivative = w * weight * response.derivative(k, signal) / flat;
                for j in 0..TERMS {
                    sums[j] += phi[j] * derivative;
                }
            }
        }
        let constant = constant / (flat * flat);
        for j in 0..TERMS {
            right[j] += w * phi[j] * rate;
            for k in 0..TERMS {
                let both = phi[j] * phi[k];
                normal[j][k] += w * both;
                spread[0][j][k] += w * w * both * shot;
                spread[1][j][k] += w * w * both * constant;
            }
        }
        square += w * rate * rate;
        variance[0] += w * shot;
        variance[1] += w * constant;
        area += w;
        pixels += 1.0;
    }
    let too_few = || {
        Error::new(format!(
            "{pixels} white pixels are too few to fit the vignetting"
        ))
        .with_hint("check camera.pixel_mm and sample_square_mm")
    };
    // Terms that are not fitted stay zero.
    let mut order = 0.0;
    for k in 0..TERMS {
        if normal[k][k] > 0.0 {
            order += 1.0;
        } else {
            normal[k][k] = 1.0;
        }
    }
    if pixels < 4.0 * order {
        return Err(too_few());
    }
    let inverse = invert(&normal).ok_or_else(too_few)?;
    let solve = |right: &Terms| -> Terms { std::array::from_fn(|j| dot(&inverse[j], right)) };
    let coefficients = solve(&right);
    let explained = dot(&coefficients, &right);
    if coefficients[0].is_nan() || coefficients[0] <= 0.0 {
        let [left, top, right, bottom] = place.target.window.bounds;
        return Err(Error::new(format!(
            "the white standard is not brighter than the dark: {} of {} reads {} raw values per millisecond in columns {left} to {right}, rows {top} to {bottom}",
            COLORS[channel],
            stacks.first().map_or("no frame", |s| &s.title),
            coefficients[0]
        ))
        .with_hint("was the light on for the white frames, and off for the darks?"));
    }
    Ok(Fit {
        coefficients,
        covariance: spread.map(|s| sandwich(&inverse, &s)),
        by_response: by_response.iter().map(solve).collect(),
        residual: ((square - explained) / area * pixels / (pixels - order)).max(0.0),
        variance: variance.map(|v| v / area),
        pixels,
    })
}

/// `a s a` for symmetric a.
fn sandwich(a: &[Terms; TERMS], s: &[Terms; TERMS]) -> [Terms; TERMS] {
    let product = |l: &[Terms; TERMS], r: &[Terms; TERMS]| -> [Terms; TERMS] {
        std::array::from_fn(|i| {
            std::array::from_fn(|j| (0..TERMS).map(|k| l[i][k] * r[k][j]).sum())
        })
    };
    product(&product(a, s), a)
}

/// Inverse of a symmetric positive definite matrix (Gauss-Jordan on the matrix scaled to unit diagonal).
fn invert(matrix: &[Terms; TERMS]) -> Option<[Terms; TERMS]> {
    let scale: Terms = std::array::from_fn(|i| 1.0 / matrix[i][i].sqrt());
    let mut a: [Terms; TERMS] =
        std::array::from_fn(|i| std::array::from_fn(|j| matrix[i][j] * scale[i] * scale[j]));
    let mut inverse: [Terms; TERMS] =
        std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j))));
    for column in 0..TERMS {
        let pivot =
            (column..TERMS).max_by(|&i, &j| a[i][column].abs().total_cmp(&a[j][column].abs()))?;
        if !(1e-12..f64::INFINITY).contains(&a[pivot][column].abs()) {
            return None;
        }
        a.swap(column, pivot);
        inverse.swap(column, pivot);
        let factor = 1.0 / a[column][column];
        for k in 0..TERMS {
            a[column][k] *= factor;
            inverse[column][k] *= factor;
        }
        for row in (0..TERMS).filter(|&r| r != column) {
            let factor = a[row][column];
            for k in 0..TERMS {
                a[row][k] -= factor * a[column][k];
                inverse[row][k] -= factor * inverse[column][k];
            }
        }
    }
    Some(std::array::from_fn(|i| {
        std::array::from_fn(|j| inverse[i][j] * scale[i] * scale[j])
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_matrix_times_its_inverse_is_the_identity() {
        let mut random = crate::math::Random::keyed(&[3]);
        let mut matrix = [[0.0; TERMS]; TERMS];
        for _ in 0..100 {
            let phi = terms([0.1, -0.2], 1.0, random.uniform(), random.uniform());
            for j in 0..TERMS {
                for k in 0..TERMS {
                    matrix[j][k] += phi[j] * phi[k];
                }
            }
        }
        let inverse = invert(&matrix).unwrap();
        for (i, row) in matrix.iter().enumerate() {
            for j in 0..TERMS {
                let product: f64 = row.iter().zip(&inverse).map(|(m, n)| m * n[j]).sum();
                assert!(
                    (product - f64::from(u8::from(i == j))).abs() < 1e-8,
                    "{i} {j} {product}"
                );
            }
        }
        assert!(invert(&[[1.0; TERMS]; TERMS]).is_none());
    }
}
