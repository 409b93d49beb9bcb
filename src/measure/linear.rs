//! From raw values to values proportional to light.

use super::calibration::Linearity;
use super::field::Window;

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

    /// The derivative by coefficient k (from 0) at `s`.
    pub(super) fn by_coefficient(&self, k: usize, s: f64) -> f64 {
        s * (s / self.full_scale).powi(k as i32 + 1)
    }

    /// The derivatives by the coefficients at `s`.
    pub(super) fn by_coefficients(&self, s: f64) -> Vec<f64> {
        let orders = 0..self.coefficients.len();
        orders.map(|k| self.by_coefficient(k, s)).collect()
    }
}

/// [`Curve`] over raw values, tabulated; without a calibration it is the raw value itself.
pub(super) struct Response {
    /// By place of the layout, then by raw value; empty: the identity.
    tables: Vec<Vec<f32>>,
    curve: Curve,
    covariance: Vec<Vec<f64>>,
    /// Raw values from here on are not used.
    pub(super) limit: Option<f64>,
}

impl Response {
    pub(super) fn new(linearity: Option<&Linearity>) -> Self {
        let curve = Curve::known(linearity, [0.0; 4]);
        let Some(l) = linearity else {
            return Self {
                tables: Vec::new(),
                curve,
                covariance: Vec::new(),
                limit: None,
            };
        };
        let largest = (1.3 * l.full_scale + l.bias[0]).clamp(1.0, 65535.0) as usize;
        let linear = |raw: usize, bias: f64| curve.at(raw as f64 - bias) as f32;
        let table = |bias: &f64| (0..=largest).map(|raw| linear(raw, *bias)).collect();
        let bias = l.bias.iter().copied().fold(0.0, f64::max);
        Self {
            tables: l.bias.iter().map(table).collect(),
            covariance: l.covariance.clone(),
            limit: Some(bias + curve.brightest),
            curve,
        }
    }

    /// The linear value of a raw value of this place.
    pub(super) fn linear(&self, raw: u16, place: usize) -> f64 {
        match self.tables.get(place) {
            None => f64::from(raw),
            Some(table) => f64::from(table[usize::from(raw).min(table.len() - 1)]),
        }
    }

    /// The same for a mean of raw values, between whole ones.
    pub(super) fn linear_mean(&self, raw: f32, place: usize) -> f64 {
        let Some(table) = self.tables.get(place) else {
            return f64::from(raw);
        };
        let low = (raw.max(0.0) as usize).min(table.len() - 2);
        let along = f64::from(raw) - low as f64;
        let (a, b) = (f64::from(table[low]), f64::from(table[low + 1]));
        a + along * (b - a)
    }

    /// Number of coefficients.
    pub(super) fn order(&self) -> usize {
        self.curve.coefficients().len()
    }

    /// The derivative of a linear value by coefficient k (from 0): `s (s / full)^(k + 1)`, to first order in the curve.
    pub(super) fn derivative(&self, k: usize, linear: f64) -> f64 {
        self.curve.by_coefficient(k, linear)
    }

    /// The variance that the coefficients' covariance gives a quantity with these derivatives.
    pub(super) fn variance(&self, derivatives: &[f64]) -> f64 {
        let rows = self.covariance.iter().zip(derivatives);
        rows.map(|(row, d)| {
            let product: f64 = row.iter().zip(derivatives).map(|(c, e)| c * e).sum();
            d * product
        })
        .sum::<f64>()
        .max(0.0)
    }
}

/// The linear values of a window of a frame.
pub(super) fn linear_window(response: &Response, window: &Window, data: &[u16]) -> Vec<f32> {
    let mut values = Vec::with_capacity(window.len());
    if response.tables.is_empty() {
        for row in window.rows() {
            values.extend(data[row].iter().map(|&v| f32::from(v)));
        }
        return values;
    }
    for row in window.rows() {
        for &raw in &data[row] {
            let place = window.place(values.len());
            values.push(response.linear(raw, place) as f32);
        }
    }
    values
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
