//! From a raw value to a linear one.

use crate::measure::calibration::Linearity;

/// `linear = s (1 + sum_k c_k (s / full_scale)^(k + 1))` with `s` the raw value less bias.
#[derive(Debug, Clone)]
pub(super) struct Curve {
    coefficients: Vec<f64>,
    full_scale: f64,
    /// By place of the layout.
    pub(super) bias: [f64; 4],
    /// Raw values less bias above this are not used.
    pub(super) brightest: f64,
}

impl Curve {
    /// The known curve, or a straight line from this bias.
    pub(super) fn known(linearity: Option<&Linearity>, bias: [f64; 4]) -> Self {
        linearity.map_or_else(
            || Self::new(Vec::new(), 1.0, bias),
            |l| Self {
                coefficients: l.coefficients.clone(),
                full_scale: l.full_scale,
                bias: l.bias,
                brightest: l.usable[1] * l.full_scale,
            },
        )
    }

    pub(super) fn new(coefficients: Vec<f64>, full_scale: f64, bias: [f64; 4]) -> Self {
        Self {
            coefficients,
            full_scale,
            bias,
            brightest: f64::INFINITY,
        }
    }

    pub(super) fn coefficients(&self) -> &[f64] {
        &self.coefficients
    }

    /// White level less mean bias, raw values.
    pub(super) fn full_scale(&self) -> f64 {
        self.full_scale
    }

    /// The linear value of `s`, the raw value less bias.
    pub(super) fn at(&self, s: f64) -> f64 {
        let u = s / self.full_scale;
        let sum = |sum: f64, c: &f64| (sum + c) * u;
        s * (1.0 + self.coefficients.iter().rev().fold(0.0, sum))
    }

    /// Its derivative.
    pub(super) fn slope(&self, s: f64) -> f64 {
        let u = s / self.full_scale;
        let powers = self.coefficients.iter().zip(1..);
        1.0 + powers
            .map(|(c, k)| f64::from(k + 1) * c * u.powi(k))
            .sum::<f64>()
    }

    /// The derivatives by the coefficients at `s`.
    pub(super) fn by_coefficients(&self, s: f64) -> Vec<f64> {
        let u = s / self.full_scale;
        let orders = 1..=self.coefficients.len() as i32;
        orders.map(|k| s * u.powi(k)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_slope_and_the_derivatives_are_those_of_the_curve() {
        let curve = |c: [f64; 3]| Curve::new(c.to_vec(), 4000.0, [0.0; 4]);
        let c = [0.03, -0.02, 0.01];
        let (s, h) = (2500.0, 1e-3);
        let slope = (curve(c).at(s + h) - curve(c).at(s - h)) / (2.0 * h);
        assert!((slope - curve(c).slope(s)).abs() < 1e-8, "{slope}");
        for k in 0..3 {
            let moved = |by: f64| {
                let mut c = c;
                c[k] += by;
                curve(c).at(s)
            };
            let found = (moved(h) - moved(-h)) / (2.0 * h);
            let stated = curve(c).by_coefficients(s)[k];
            assert!((found - stated).abs() < 1e-6, "{k}: {found} {stated}");
        }
    }
}
