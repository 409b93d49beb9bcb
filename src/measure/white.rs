//! White frames: what radiance a raw value stands for, everywhere in the image.
//!
//! The panel is taken as uniform over the box that holds all crops, so what is not uniform in its image is the camera's
//! vignetting. Per channel, the rate in raw values per millisecond is fitted by
//!
//! ```text
//! F(u, v) = b0 + b1 u + b2 v + b3 u^2 + b4 u v + b5 v^2 + b6 (u^2 + v^2)^2
//! ```
//!
//! with (u, v) the offset from the image of the sample center over the distance to the box's farthest corner. A gradient of the light
//! across the panel cannot be told from vignetting; shoot the panel with the light near its normal.

use super::frames::Region;
use super::lamp::Level;
use super::noise::Cell;
use super::stack::Stack;
use crate::base::{Error, Result};
use crate::session::Manifest;
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
}

/// The fitted rate image of the white standard.
pub(super) struct White {
    center: [f64; 2],
    scale: f64,
    fits: [Fit; 3],
    /// Normalized radiance of the standard, `reflectance_factor cos(theta_light)`.
    pub(super) radiance: [f64; 3],
    corner: [f64; 2],
    exposures_ms: Vec<f64>,
    /// The lamp's level in each usable exposure, and that exposure's part in the fit.
    pub(super) levels: Vec<(f64, Level)>,
}

/// One channel's fit. Variances are `a first + second`, with `a` the slope of the photon transfer.
struct Fit {
    coefficients: Terms,
    covariance: [[Terms; TERMS]; 2],
    /// Mean square residual times `n / (n - TERMS)`.
    residual: f64,
    /// Mean of the pixel's expected variance.
    variance: [f64; 2],
    pixels: f64,
}

impl White {
    /// Fits the usable exposures of the white frames on `region`, whose bounding box is `bounds`.
    ///
    /// # Errors
    /// When every exposure is saturated, the standard is not brighter than the dark, or the fit has too few pixels.
    pub(super) fn fit(
        manifest: &Manifest,
        region: &Region,
        bounds: [usize; 4],
        stacks: &[Stack],
    ) -> Result<Self> {
        let usable: Vec<&Stack> = stacks.iter().filter(|s| s.clipped == 0).collect();
        if usable.is_empty() {
            let first = stacks.first().map_or("no white frame", |s| &s.title);
            let clipped = stacks.first().map_or(0, |s| s.clipped);
            return Err(Error::new(format!(
                "the white standard is saturated in every exposure: {first} has {clipped} pixels too bright in columns {} to {}, rows {} to {}",
                bounds[0], bounds[2], bounds[1], bounds[3]
            ))
            .with_hint("take white frames with a shorter exposure"));
        }
        let center = manifest.camera.center_px;
        let far = |low: usize, high: usize, c: f64| {
            let (low, high) = (low as f64, high as f64);
            if c - low > high - c { low } else { high }
        };
        let corner = [
            far(bounds[0], bounds[2], center[0]),
            far(bounds[1], bounds[3], center[1]),
        ];
        let scale = (corner[0] - center[0]).hypot(corner[1] - center[1]);
        let cosine = manifest.white.configuration.light.theta.cos();
        let mut fits = Vec::with_capacity(3);
        for channel in 0..3 {
            let fit = fit_channel(region, &usable, channel, |x, y| terms(center, scale, x, y))?;
            fits.push(fit);
        }
        let fits: [Fit; 3] = fits
            .try_into()
            .map_err(|_| Error::new("three channels were expected"))?;
        let total: f64 = usable.iter().map(|s| exposed(s)).sum();
        let levels = usable
            .iter()
            .map(|s| (exposed(s) / total, s.level.clone()))
            .collect();
        Ok(Self {
            center,
            scale,
            fits,
            levels,
            radiance: manifest.white.reflectance_factor.map(|f| f * cosine),
            corner,
            exposures_ms: usable.iter().map(|s| s.exposure_ms).collect(),
        })
    }

    /// The terms at a pixel.
    pub(super) fn terms(&self, x: usize, y: usize) -> Terms {
        terms(self.center, self.scale, x as f64 + 0.5, y as f64 + 0.5)
    }

    /// The fitted rate where the terms are `phi`, raw values per millisecond.
    pub(super) fn rate(&self, channel: usize, phi: &Terms) -> f64 {
        dot(&self.fits[channel].coefficients, phi)
    }

    /// The variance of `sum_k phi_k b_k` when the photon transfer's slope is `a`.
    pub(super) fn variance(&self, channel: usize, phi: &Terms, a: f64) -> f64 {
        let [first, second] = &self.fits[channel].covariance;
        let quadratic = |m: &[Terms; TERMS]| {
            let rows = m.iter().map(|row| dot(row, phi));
            rows.zip(phi).map(|(r, p)| r * p).sum::<f64>()
        };
        // Lack of fit beyond noise widens the error.
        let excess = self.chi_square(channel, a).max(1.0);
        (a * quadratic(first) + quadratic(second)) * excess
    }

    fn chi_square(&self, channel: usize, a: f64) -> f64 {
        let fit = &self.fits[channel];
        fit.residual / (a * fit.variance[0] + fit.variance[1])
    }

    /// Estimates of the photon transfer's slope from the residuals of the fit.
    pub(super) fn residual_cells(&self) -> Vec<Cell> {
        self.fits
            .iter()
            .map(|fit| Cell {
                x: fit.variance[0],
                y: fit.residual - fit.variance[1],
                variance: 2.0 * fit.residual * fit.residual / fit.pixels,
            })
            .collect()
    }

    pub(super) fn report(&self, a: f64) -> WhiteReport {
        let center = terms(self.center, self.scale, self.center[0], self.center[1]);
        let corner = terms(self.center, self.scale, self.corner[0], self.corner[1]);
        let channels = [0, 1, 2];
        WhiteReport {
            responsivity: channels.map(|c| self.rate(c, &center) / self.radiance[c]),
            vignetting_at_corner: channels
                .map(|c| 1.0 - self.rate(c, &corner) / self.rate(c, &center)),
            chi_square_per_pixel: channels.map(|c| self.chi_square(c, a)),
            exposures_ms: self.exposures_ms.clone(),
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

/// Least squares of the rate averaged over exposures (weights proportional to exposed time), and the covariance of its
/// coefficients by propagation of each pixel's own variance.
fn fit_channel(
    region: &Region,
    stacks: &[&Stack],
    channel: usize,
    terms: impl Fn(f64, f64) -> Terms,
) -> Result<Fit> {
    let total: f64 = stacks.iter().map(|s| exposed(s)).sum();
    let mut normal = [[0.0; TERMS]; TERMS];
    let mut right = [0.0; TERMS];
    let mut square = 0.0;
    let mut pixels = 0.0;
    let mut spread = [[[0.0; TERMS]; TERMS]; 2];
    let mut variance = [0.0; 2];
    let constant: f64 = stacks
        .iter()
        .map(|s| {
            let weight = exposed(s) / total / s.time(channel);
            weight * weight * s.dark_variance * (1.0 / s.repeats + 1.0 / s.dark_count)
        })
        .sum();
    for (i, pixel) in region.pixels.iter().enumerate() {
        if pixel.channel != channel {
            continue;
        }
        let phi = terms(pixel.x as f64 + 0.5, pixel.y as f64 + 0.5);
        let (mut rate, mut shot) = (0.0, 0.0);
        for s in stacks {
            let weight = exposed(s) / total / s.time(channel);
            rate += weight * s.signal[i];
            shot += weight * weight * s.signal[i] / s.repeats;
        }
        for j in 0..TERMS {
            right[j] += phi[j] * rate;
            for k in 0..TERMS {
                normal[j][k] += phi[j] * phi[k];
                spread[0][j][k] += phi[j] * phi[k] * shot;
                spread[1][j][k] += phi[j] * phi[k] * constant;
            }
        }
        square += rate * rate;
        variance[0] += shot;
        variance[1] += constant;
        pixels += 1.0;
    }
    let too_few = || {
        Error::new(format!(
            "{pixels} white pixels are too few to fit the vignetting"
        ))
        .with_hint("check camera.pixel_mm and sample_square_mm")
    };
    if pixels < 4.0 * TERMS as f64 {
        return Err(too_few());
    }
    let inverse = invert(&normal).ok_or_else(too_few)?;
    let coefficients: Terms = std::array::from_fn(|j| dot(&inverse[j], &right));
    let explained = dot(&coefficients, &right);
    if coefficients[0].is_nan() || coefficients[0] <= 0.0 {
        return Err(Error::new(format!(
            "the white standard is not brighter than the dark ({} raw values per millisecond)",
            coefficients[0]
        ))
        .with_hint("was the light on for the white frames, and off for the darks?"));
    }
    Ok(Fit {
        coefficients,
        covariance: spread.map(|s| sandwich(&inverse, &s)),
        residual: ((square - explained) / (pixels - TERMS as f64)).max(0.0),
        variance: variance.map(|v| v / pixels),
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
