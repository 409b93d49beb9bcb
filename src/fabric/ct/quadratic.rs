//! Quadratic surfaces over the plane, fitted by least squares.

use crate::base::{Error, Result};
use serde::Serialize;

/// `c0 + c1 u + c2 v + c3 u^2 + c4 u v + c5 v^2` with `u = (x - center_x) / half_x`, `v` likewise in y.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Quadratic {
    /// Where u = v = 0, millimeters.
    pub center_mm: [f64; 2],
    /// Lengths over which u and v go from 0 to 1, millimeters.
    pub half_mm: [f64; 2],
    /// Coefficients 1, u, v, u^2, uv, v^2.
    pub coefficients: [f64; 6],
}

impl Quadratic {
    /// Its value at a point, millimeters.
    pub(super) fn at(&self, x: f64, y: f64) -> f64 {
        let basis = basis(self.center_mm, self.half_mm, x, y);
        basis
            .iter()
            .zip(self.coefficients)
            .map(|(b, c)| b * c)
            .sum()
    }

    /// Its slopes along x and y at the center.
    pub(super) fn slopes(&self) -> [f64; 2] {
        [0, 1].map(|k| self.coefficients[k + 1] / self.half_mm[k])
    }
}

fn basis(center: [f64; 2], half: [f64; 2], x: f64, y: f64) -> [f64; 6] {
    let (u, v) = ((x - center[0]) / half[0], (y - center[1]) / half[1]);
    [1.0, u, v, u * u, u * v, v * v]
}

/// The normal equations of a fit.
pub(super) struct Fit {
    center: [f64; 2],
    half: [f64; 2],
    products: [[f64; 6]; 6],
    right: [f64; 6],
}

impl Fit {
    pub(super) fn over(center: [f64; 2], half: [f64; 2]) -> Self {
        Self {
            center,
            half,
            products: [[0.0; 6]; 6],
            right: [0.0; 6],
        }
    }

    /// Adds a value seen at a point.
    pub(super) fn add(&mut self, x: f64, y: f64, value: f64, weight: f64) {
        let b = basis(self.center, self.half, x, y);
        for i in 0..6 {
            for j in 0..=i {
                self.products[i][j] += weight * b[i] * b[j];
            }
            self.right[i] += weight * b[i] * value;
        }
    }

    /// The surface of least squares, by Cholesky's decomposition.
    ///
    /// # Errors
    /// The points do not determine it; `what` names it.
    pub(super) fn solve(mut self, what: &str) -> Result<Quadratic> {
        let mass = self.products[0][0];
        let l = &mut self.products;
        for i in 0..6 {
            for j in 0..=i {
                let rest: f64 = l[i][j] - (0..j).map(|k| l[i][k] * l[j][k]).sum::<f64>();
                if i > j {
                    l[i][j] = rest / l[j][j];
                } else if rest > 1e-9 * mass {
                    l[i][i] = rest.sqrt();
                } else {
                    return Err(Error::new(format!(
                        "{what} cannot be fitted: its voxels do not spread over the cloth"
                    )));
                }
            }
        }
        let mut c = self.right;
        for i in 0..6 {
            c[i] = (c[i] - (0..i).map(|k| l[i][k] * c[k]).sum::<f64>()) / l[i][i];
        }
        for i in (0..6).rev() {
            c[i] = (c[i] - (i + 1..6).map(|k| l[k][i] * c[k]).sum::<f64>()) / l[i][i];
        }
        Ok(Quadratic {
            center_mm: self.center,
            half_mm: self.half,
            coefficients: c,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quadratic_is_found_and_too_few_points_are_refused() {
        let truth = Quadratic {
            center_mm: [1.0, 2.0],
            half_mm: [1.0, 3.0],
            coefficients: [0.3, -0.2, 0.1, 0.7, -0.4, 0.05],
        };
        let mut fit = Fit::over(truth.center_mm, truth.half_mm);
        let mut line = Fit::over(truth.center_mm, truth.half_mm);
        for k in 0..50 {
            let (x, y) = (f64::from(k % 7) / 3.0, f64::from(k / 7) - 1.0);
            fit.add(x, y, truth.at(x, y), 1.0 + f64::from(k % 3));
            line.add(x, 2.0, x, 1.0);
        }
        let found = fit.solve("a surface").unwrap();
        for (a, b) in found.coefficients.iter().zip(truth.coefficients) {
            assert!((a - b).abs() < 1e-12, "{found:?}");
        }
        assert!(
            line.solve("a surface")
                .unwrap_err()
                .to_string()
                .contains("do not spread")
        );
    }
}
