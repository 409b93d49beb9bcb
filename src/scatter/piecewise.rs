//! Smooth functions as piecewise polynomials, for hot loops.

use std::f64::consts::PI;

/// Highest power in one piece of a [`Piecewise`] polynomial.
const DEGREE: usize = 9;

/// `K` smooth functions on [0, 1] as polynomials of degree 9 on equal pieces, interpolated at Chebyshev points.
#[derive(Debug, Clone)]
pub(super) struct Piecewise<const K: usize> {
    /// `pieces[p][power][function]` in the local coordinate u in [-1, 1].
    pieces: Vec<[[f64; K]; DEGREE + 1]>,
}

impl<const K: usize> Piecewise<K> {
    pub(super) fn new(n_pieces: usize, f: impl Fn(f64) -> [f64; K]) -> Self {
        let pieces = (0..n_pieces)
            .map(|p| interpolate(|u| f((p as f64 + 0.5 * (u + 1.0)) / n_pieces as f64)))
            .collect();
        Self { pieces }
    }

    /// The functions at `t`; a NaN gives NaN.
    #[inline]
    pub(super) fn at(&self, t: f64) -> [f64; K] {
        let scaled = t * self.pieces.len() as f64;
        let index = (scaled as usize).min(self.pieces.len() - 1);
        let c = &self.pieces[index];
        let u = 2.0 * (scaled - index as f64) - 1.0;
        // Estrin's scheme: the same sum as Horner's, with a dependency chain a third as long.
        let (u2, u4) = (u * u, (u * u) * (u * u));
        std::array::from_fn(|k| {
            let pair = |n: usize| c[n][k] + u * c[n + 1][k];
            let low = pair(0) + u2 * pair(2);
            let high = pair(4) + u2 * pair(6);
            low + u4 * (high + u4 * pair(8))
        })
    }
}

/// Power coefficients on [-1, 1] of the polynomial through `f` at the Chebyshev points.
fn interpolate<const K: usize>(f: impl Fn(f64) -> [f64; K]) -> [[f64; K]; DEGREE + 1] {
    let n = (DEGREE + 1) as f64;
    let angle = |j: usize| PI * (j as f64 + 0.5) / n;
    let values: [[f64; K]; DEGREE + 1] = std::array::from_fn(|j| f(angle(j).cos()));
    let mut powers = [[0.0; K]; DEGREE + 1];
    // Chebyshev polynomials T_m as power coefficients, by T_{m+1} = 2 u T_m - T_{m-1}.
    let (mut previous, mut current) = ([0.0; DEGREE + 1], [0.0; DEGREE + 1]);
    current[0] = 1.0;
    for m in 0..=DEGREE {
        let scale = if m == 0 { 1.0 } else { 2.0 } / n;
        let weight: [f64; DEGREE + 1] =
            std::array::from_fn(|j| scale * (m as f64 * angle(j)).cos());
        for k in 0..K {
            let c: f64 = (0..=DEGREE).map(|j| weight[j] * values[j][k]).sum();
            for (power, t) in powers.iter_mut().zip(current) {
                power[k] += c * t;
            }
        }
        let factor = if m == 0 { 1.0 } else { 2.0 };
        let next = std::array::from_fn(|p| {
            let raised = if p == 0 { 0.0 } else { current[p - 1] };
            factor * raised - previous[p]
        });
        (previous, current) = (current, next);
    }
    powers
}
