//! From raw values to values proportional to light.

use super::calibration::Linearity;
use super::field::Window;

/// The response curve `linear = s (1 + sum_k c_k (s / full)^k)` over raw values, tabulated; without a calibration it is the
/// raw value itself.
pub(super) struct Response {
    /// By place of the layout, then by raw value; empty: the identity.
    tables: Vec<Vec<f32>>,
    coefficients: Vec<f64>,
    covariance: Vec<Vec<f64>>,
    full_scale: f64,
    /// Raw values from here on are not used.
    pub(super) limit: Option<f64>,
}

impl Response {
    pub(super) fn new(linearity: Option<&Linearity>) -> Self {
        let Some(l) = linearity else {
            return Self {
                tables: Vec::new(),
                coefficients: Vec::new(),
                covariance: Vec::new(),
                full_scale: 1.0,
                limit: None,
            };
        };
        let linear = |raw: usize, bias: f64| {
            let s = raw as f64 - bias;
            (s * (1.0 + series(&l.coefficients, s / l.full_scale))) as f32
        };
        let largest = (1.3 * l.full_scale + l.bias[0]).clamp(1.0, 65535.0) as usize;
        let table = |bias: &f64| (0..=largest).map(|raw| linear(raw, *bias)).collect();
        let bias = l.bias.iter().copied().fold(0.0, f64::max);
        Self {
            tables: l.bias.iter().map(table).collect(),
            coefficients: l.coefficients.clone(),
            covariance: l.covariance.clone(),
            full_scale: l.full_scale,
            limit: Some(bias + l.usable[1] * l.full_scale),
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
        self.coefficients.len()
    }

    /// The derivative of a linear value by coefficient k (from 0): `s (s / full)^(k + 1)`, to first order in the curve.
    pub(super) fn derivative(&self, k: usize, linear: f64) -> f64 {
        linear * (linear / self.full_scale).powi(k as i32 + 1)
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

fn series(coefficients: &[f64], u: f64) -> f64 {
    coefficients.iter().rev().fold(0.0, |sum, c| (sum + c) * u)
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
