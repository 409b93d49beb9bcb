//! What is known of the measurements before any model is fitted.

use crate::base::{Error, Result};
use crate::fit::TAU;
use crate::fit::goodness::chi_square_above;
use crate::fit::objective::relative_weights;
use crate::fit::surface::{distinct, geometry};
use crate::scatter::CHANNELS;
use crate::session::{Intensity, Measurements};
use serde::Serialize;

/// A right model's residuals are larger than what is taken as the noise in this share of measurements.
const SURPRISE: f64 = 0.05;

/// How errors are spread over the numbers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spread {
    /// Half of them are smaller.
    pub median: f64,
    /// Four fifths of them are smaller.
    pub percentile_80: f64,
    /// Root mean square.
    pub rms: f64,
}

impl Spread {
    /// Of these errors, whatever their signs; none of no numbers.
    pub fn of(errors: impl Iterator<Item = f64>) -> Option<Self> {
        let mut sizes: Vec<f64> = errors.map(f64::abs).collect();
        sizes.sort_by(f64::total_cmp);
        let n = sizes.len();
        let at = |share: f64| {
            let place = share * (n - 1) as f64;
            let below = sizes[place as usize];
            let above = sizes[(place as usize + 1).min(n - 1)];
            below + place.fract() * (above - below)
        };
        (n > 0).then(|| Self {
            median: at(0.5),
            percentile_80: at(0.8),
            rms: (sizes.iter().map(|e| e * e).sum::<f64>() / n as f64).sqrt(),
        })
    }
}

/// What the measurements are, whatever the model.
pub struct Facts<'a> {
    /// The measurements.
    pub measurements: &'a Measurements,
    /// Residual up to which a model is good enough.
    pub tolerance: f64,
    /// Numbers measured.
    pub n: usize,
    /// Numbers at distinct geometries: turned copies of a pose count once.
    pub n_distinct: usize,
    /// Rows of each distinct geometry.
    pub geometries: Vec<Vec<usize>>,
    /// What the errors of the measurements alone leave, weighted rms.
    pub noise: f64,
    /// As many numbers of equal error would vary as much together.
    pub effective: f64,
    /// Largest polar angle of light or camera, radians.
    pub steepest: f64,
}

impl<'a> Facts<'a> {
    /// Those of some measurements.
    ///
    /// # Errors
    /// There are none, or a mean or an error is negative or not finite.
    pub fn of(measurements: &'a Measurements, tolerance: f64) -> Result<Self> {
        let rows = &measurements.intensities;
        let mut geometries: Vec<([i64; 3], Vec<usize>)> = Vec::new();
        let (mut sum, mut squares, mut steepest) = (0.0, 0.0, 0.0_f64);
        for (row, i) in rows.iter().enumerate() {
            let c = &i.configuration;
            steepest = steepest.max(c.light.theta).max(c.camera.theta);
            let key = geometry(c);
            match geometries.iter_mut().find(|g| g.0 == key) {
                Some((_, list)) => list.push(row),
                None => geometries.push((key, vec![row])),
            }
            for (mean, se) in i
                .where_present(std::array::from_fn::<_, CHANNELS, _>(|c| {
                    (i.mean[c], i.standard_error[c])
                }))
                .into_iter()
                .flatten()
            {
                if !(0.0..f64::INFINITY).contains(&mean) || !(0.0..f64::INFINITY).contains(&se) {
                    return Err(Error::new(format!(
                        "configuration {}: mean {mean} with error {se}, expected finite numbers >= 0",
                        c.id
                    )));
                }
            }
            let variances = relative_errors(i, i.standard_error).map(|e| e * e);
            for v in i.where_present(variances).into_iter().flatten() {
                sum += v;
                squares += v * v;
            }
        }
        let n = measurements.n_numbers();
        if n == 0 {
            return Err(Error::new("there are no measurements to fit"));
        }
        Ok(Self {
            measurements,
            tolerance,
            n,
            n_distinct: distinct(measurements),
            geometries: geometries.into_iter().map(|g| g.1).collect(),
            noise: (sum / n as f64).sqrt(),
            effective: if squares > 0.0 {
                sum * sum / squares
            } else {
                n as f64
            },
            steepest,
        })
    }

    /// Whether the errors of the measurements explain a residual of a model with `free` parameters: a right one would leave more in one
    /// of twenty measurements. Errors are taken as independent and normal; the parameters absorb their share.
    pub fn reaches_noise(&self, residual: f64, free: usize) -> bool {
        let left = 1.0 - free as f64 / self.n as f64;
        if left <= 0.0 || self.noise <= 0.0 {
            return residual <= 1e-9;
        }
        let freedom = left * self.effective;
        let statistic = residual * residual / (self.noise * self.noise * left);
        chi_square_above(statistic * freedom, freedom) > SURPRISE
    }

    /// Corrected information criterion over numbers at distinct geometries (Hurvich and Tsai 1989); smaller is better. One more
    /// parameter is the spread. Residuals below the noise count as the noise: nothing is to be gained there. Infinite where there are too few numbers.
    pub fn criterion(&self, residual: f64, free: usize) -> f64 {
        let (n, k) = (self.n_distinct as f64, free as f64 + 1.0);
        if n <= k + 1.0 {
            return f64::INFINITY;
        }
        let variance = residual.max(self.noise).powi(2).max(1e-24);
        n * variance.ln() + 2.0 * k * n / (n - k - 1.0)
    }
}

/// Differences from a measurement, relative to its brightness; 0 where there is none.
pub(super) fn relative_errors(i: &Intensity, difference: [f64; CHANNELS]) -> [f64; CHANNELS] {
    let i = i.cleared();
    let weights = relative_weights(&i, TAU);
    std::array::from_fn(|c| match i.present[c] {
        true => weights[c].sqrt() * difference[c],
        false => 0.0,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Sees one place in the order, or a percentile off by a hundredth.
    #[test]
    fn percentiles_are_those_of_the_sizes() {
        let spread =
            Spread::of((0..101).map(|k| if k % 2 == 0 { 1.0 } else { -1.0 } * f64::from(k)));
        let spread = spread.unwrap();
        assert!((spread.median - 50.0).abs() < 1e-12);
        assert!((spread.percentile_80 - 80.0).abs() < 1e-12);
        assert!((spread.rms - 3350.0_f64.sqrt()).abs() < 1e-9);
        assert_eq!(Spread::of(std::iter::empty()), None);
    }
}
