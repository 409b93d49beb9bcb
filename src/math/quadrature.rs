//! Gauss-Legendre quadrature: one rule, composite panels, and an adaptive form.
//!
//! For integrands that are smooth inside each panel. Singular ends and infinite ranges are not handled.

use std::f64::consts::PI;

/// The Gauss-Legendre rule with `n` points: exact for polynomials up to degree `2n - 1`.
#[derive(Debug, Clone, PartialEq)]
pub struct GaussLegendre {
    /// (node in (-1, 1), weight), nodes rising.
    points: Vec<(f64, f64)>,
}

impl GaussLegendre {
    /// The rule with `n >= 1` points, to about 1e-15 (Newton's method on the Legendre polynomial).
    pub fn new(n: usize) -> Self {
        let points = (0..n)
            .map(|k| {
                let mut x = -(PI * (k as f64 + 0.75) / (n as f64 + 0.5)).cos();
                for _ in 0..8 {
                    let (p, slope) = legendre(n, x);
                    let step = p / slope;
                    x -= step;
                    if step.abs() < 1e-16 {
                        break;
                    }
                }
                let (_, slope) = legendre(n, x);
                (x, 2.0 / ((1.0 - x * x) * slope * slope))
            })
            .collect();
        Self { points }
    }

    /// Nodes and weights moved to [a, b].
    pub fn on(&self, a: f64, b: f64) -> impl Iterator<Item = (f64, f64)> + '_ {
        let (middle, half) = (0.5 * (a + b), 0.5 * (b - a));
        self.points
            .iter()
            .map(move |&(x, w)| (middle + half * x, half * w))
    }

    /// The integral of `f` over [a, b] by this rule once.
    pub fn integrate(&self, a: f64, b: f64, mut f: impl FnMut(f64) -> f64) -> f64 {
        self.on(a, b).map(|(x, w)| w * f(x)).sum()
    }

    /// The integral over [a, b] cut into `panels` equal parts.
    pub fn integrate_panels(
        &self,
        a: f64,
        b: f64,
        panels: usize,
        mut f: impl FnMut(f64) -> f64,
    ) -> f64 {
        let at = |k: usize| a + (b - a) * k as f64 / panels as f64;
        (0..panels)
            .map(|k| self.integrate(at(k), at(k + 1), &mut f))
            .sum()
    }

    /// The integral over [a, b], panels halved until one panel and its two halves agree to `tolerance` times the
    /// integral of |f| (estimated), or 40 halvings. The first cut is into 8 panels, so that a peak is not overlooked
    /// unless it is narrower than about (b - a)/(8 n).
    pub fn integrate_adaptive(
        &self,
        a: f64,
        b: f64,
        tolerance: f64,
        mut f: impl FnMut(f64) -> f64,
    ) -> f64 {
        let first = 8;
        let at = |k: usize| a + (b - a) * k as f64 / first as f64;
        let mut open: Vec<(f64, f64, f64, u32)> = (0..first)
            .map(|k| {
                (
                    at(k),
                    at(k + 1),
                    self.integrate(at(k), at(k + 1), &mut f),
                    0,
                )
            })
            .collect();
        let mut scale: f64 = open.iter().map(|panel| panel.2.abs()).sum();
        let mut total = 0.0;
        while let Some((low, high, whole, depth)) = open.pop() {
            let middle = 0.5 * (low + high);
            let left = self.integrate(low, middle, &mut f);
            let right = self.integrate(middle, high, &mut f);
            scale += (left.abs() + right.abs() - whole.abs()).max(0.0);
            if (left + right - whole).abs() <= tolerance * scale || depth >= 40 {
                total += left + right;
            } else {
                open.push((low, middle, left, depth + 1));
                open.push((middle, high, right, depth + 1));
            }
        }
        total
    }
}

/// Legendre polynomial of degree `n` and its slope at `x` (three-term recurrence).
fn legendre(n: usize, x: f64) -> (f64, f64) {
    let (mut previous, mut current) = (1.0, x);
    for k in 2..=n {
        let k = k as f64;
        (previous, current) = (
            current,
            ((2.0 * k - 1.0) * x * current - (k - 1.0) * previous) / k,
        );
    }
    (current, n as f64 * (x * current - previous) / (x * x - 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rule_is_exact_up_to_its_degree_and_no_further() {
        for n in [1_usize, 2, 5, 16, 33, 64] {
            let rule = GaussLegendre::new(n);
            assert_eq!(rule.points.len(), n);
            let even = 2 * (n as i32) - 2;
            let integral = rule.integrate(-1.0, 1.0, |x| x.powi(even));
            assert!(
                (integral * f64::from(even + 1) - 2.0).abs() < 1e-13,
                "{n}: {integral}"
            );
            if n <= 5 {
                let beyond = rule.integrate(-1.0, 1.0, |x| x.powi(even + 2));
                assert!(
                    (beyond * f64::from(even + 3) - 2.0).abs() > 1e-4,
                    "{n}: {beyond}"
                );
            }
        }
    }

    #[test]
    fn panels_and_adaptive_panels_agree_with_the_closed_form() {
        let rule = GaussLegendre::new(16);
        let lorentz = |x: f64| 1e-3 / (1e-6 + (x - 0.3) * (x - 0.3));
        let exact = (0.7_f64 / 1e-3).atan() + (1.3_f64 / 1e-3).atan();
        let adaptive = rule.integrate_adaptive(-1.0, 1.0, 1e-13, lorentz);
        assert!((adaptive - exact).abs() < 1e-11, "{adaptive} {exact}");
        assert!((rule.integrate(-1.0, 1.0, lorentz) - exact).abs() > 1e-2);
        let wave = rule.integrate_panels(0.0, 50.0, 20, f64::cos);
        assert!((wave - 50.0_f64.sin()).abs() < 1e-13, "{wave}");
    }
}
