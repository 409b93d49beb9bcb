//! Small dense linear algebra: symmetric eigenvectors, Cholesky solves, a quadratic program in a box.
//!
//! For matrices of at most a few dozen rows; does not pivot, block or parallelize.

use std::ops::{Index, IndexMut};

/// A dense row-major matrix.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Matrix {
    n_rows: usize,
    n_columns: usize,
    data: Vec<f64>,
}

impl Index<(usize, usize)> for Matrix {
    type Output = f64;
    fn index(&self, (row, column): (usize, usize)) -> &f64 {
        &self.data[row * self.n_columns + column]
    }
}

impl IndexMut<(usize, usize)> for Matrix {
    fn index_mut(&mut self, (row, column): (usize, usize)) -> &mut f64 {
        &mut self.data[row * self.n_columns + column]
    }
}

impl Matrix {
    pub(super) fn zeros(n_rows: usize, n_columns: usize) -> Self {
        Self {
            n_rows,
            n_columns,
            data: vec![0.0; n_rows * n_columns],
        }
    }

    pub(super) fn n_rows(&self) -> usize {
        self.n_rows
    }

    pub(super) fn n_columns(&self) -> usize {
        self.n_columns
    }

    pub(super) fn row(&self, row: usize) -> &[f64] {
        &self.data[row * self.n_columns..(row + 1) * self.n_columns]
    }

    /// `self += factor * other`.
    pub(super) fn add_scaled(&mut self, factor: f64, other: &Self) {
        for (a, b) in self.data.iter_mut().zip(&other.data) {
            *a += factor * b;
        }
    }

    pub(super) fn scale(&mut self, factor: f64) {
        self.data.iter_mut().for_each(|a| *a *= factor);
    }

    /// `self x`.
    pub(super) fn times(&self, x: &[f64]) -> Vec<f64> {
        (0..self.n_rows).map(|i| dot(self.row(i), x)).collect()
    }

    /// `x' self y`.
    pub(super) fn form(&self, x: &[f64], y: &[f64]) -> f64 {
        dot(x, &self.times(y))
    }

    /// `self' diag(w) other`, symmetric when both are the same matrix.
    pub(super) fn weighted_gram(&self, w: &[f64], other: &Self) -> Self {
        let mut gram = Self::zeros(self.n_columns, other.n_columns);
        for (m, &w) in w.iter().enumerate() {
            for i in 0..self.n_columns {
                let left = w * self[(m, i)];
                for j in 0..other.n_columns {
                    gram[(i, j)] += left * other[(m, j)];
                }
            }
        }
        gram
    }

    /// `self' (w * x)`.
    pub(super) fn weighted_transpose_times(&self, w: &[f64], x: &[f64]) -> Vec<f64> {
        let mut y = vec![0.0; self.n_columns];
        for m in 0..self.n_rows {
            let wx = w[m] * x[m];
            for (y, j) in y.iter_mut().zip(self.row(m)) {
                *y += wx * j;
            }
        }
        y
    }

    /// The mean of the matrix and its transpose.
    pub(super) fn symmetrized(&self) -> Self {
        let mut s = self.clone();
        for i in 0..self.n_rows {
            for j in 0..self.n_columns {
                s[(i, j)] = 0.5 * (self[(i, j)] + self[(j, i)]);
            }
        }
        s
    }

    /// `self other`.
    pub(super) fn times_matrix(&self, other: &Self) -> Self {
        let mut product = Self::zeros(self.n_rows, other.n_columns);
        for i in 0..self.n_rows {
            for (k, &a) in self.row(i).iter().enumerate() {
                for j in 0..other.n_columns {
                    product[(i, j)] += a * other[(k, j)];
                }
            }
        }
        product
    }

    /// The columns listed in `keep`.
    pub(super) fn columns(&self, keep: &[usize]) -> Self {
        let mut s = Self::zeros(self.n_rows, keep.len());
        for i in 0..self.n_rows {
            for (b, &j) in keep.iter().enumerate() {
                s[(i, b)] = self[(i, j)];
            }
        }
        s
    }

    /// `self' x`.
    pub(super) fn transpose_times(&self, x: &[f64]) -> Vec<f64> {
        self.weighted_transpose_times(&vec![1.0; self.n_rows], x)
    }

    /// Multiplies every row by its factor.
    pub(super) fn scale_rows(&mut self, factors: &[f64]) {
        for (m, factor) in factors.iter().enumerate() {
            for j in 0..self.n_columns {
                self[(m, j)] *= factor;
            }
        }
    }

    /// The rows and columns listed in `keep`.
    pub(super) fn sub(&self, keep: &[usize]) -> Self {
        let mut s = Self::zeros(keep.len(), keep.len());
        for (a, &i) in keep.iter().enumerate() {
            for (b, &j) in keep.iter().enumerate() {
                s[(a, b)] = self[(i, j)];
            }
        }
        s
    }
}

pub(super) fn dot(x: &[f64], y: &[f64]) -> f64 {
    x.iter().zip(y).map(|(a, b)| a * b).sum()
}

/// Eigenvalues and eigenvectors of a symmetric matrix by cyclic Jacobi rotations: `(value, unit vector)` pairs.
pub(super) fn eigen(symmetric: &Matrix) -> Vec<(f64, Vec<f64>)> {
    let n = symmetric.n_rows;
    let mut a = symmetric.clone();
    let mut v = Matrix::zeros(n, n);
    for i in 0..n {
        v[(i, i)] = 1.0;
    }
    for _sweep in 0..60 {
        let off: f64 = (0..n)
            .flat_map(|i| (0..i).map(move |j| (i, j)))
            .map(|ij| a[ij] * a[ij])
            .sum();
        let diagonal: f64 = (0..n).map(|i| a[(i, i)] * a[(i, i)]).sum();
        if off <= 1e-30 * diagonal || off < f64::MIN_POSITIVE {
            break;
        }
        for p in 0..n {
            for q in p + 1..n {
                rotate(&mut a, &mut v, p, q);
            }
        }
    }
    (0..n)
        .map(|k| (a[(k, k)], (0..n).map(|i| v[(i, k)]).collect()))
        .collect()
}

/// One Jacobi rotation that makes `a[(p, q)]` zero.
fn rotate(a: &mut Matrix, v: &mut Matrix, p: usize, q: usize) {
    let apq = a[(p, q)];
    if apq.abs() < f64::MIN_POSITIVE {
        return;
    }
    let theta = (a[(q, q)] - a[(p, p)]) / (2.0 * apq);
    let t = theta.signum() / (theta.abs() + theta.hypot(1.0));
    let c = 1.0 / t.hypot(1.0);
    let s = t * c;
    for k in 0..a.n_rows {
        let (akp, akq) = (a[(k, p)], a[(k, q)]);
        a[(k, p)] = c * akp - s * akq;
        a[(k, q)] = s * akp + c * akq;
    }
    for k in 0..a.n_rows {
        let (apk, aqk) = (a[(p, k)], a[(q, k)]);
        a[(p, k)] = c * apk - s * aqk;
        a[(q, k)] = s * apk + c * aqk;
        let (vkp, vkq) = (v[(k, p)], v[(k, q)]);
        v[(k, p)] = c * vkp - s * vkq;
        v[(k, q)] = s * vkp + c * vkq;
    }
}

/// Solves `a x = b` for a symmetric positive definite `a`; `None` when a pivot is not positive.
pub(super) fn solve(a: &Matrix, b: &[f64]) -> Option<Vec<f64>> {
    let n = a.n_rows;
    let mut l = Matrix::zeros(n, n);
    for i in 0..n {
        for j in 0..=i {
            let s = a[(i, j)] - (0..j).map(|k| l[(i, k)] * l[(j, k)]).sum::<f64>();
            if i == j {
                if !(s > 0.0 && s.is_finite()) {
                    return None;
                }
                l[(i, i)] = s.sqrt();
            } else {
                l[(i, j)] = s / l[(j, j)];
            }
        }
    }
    let mut x = b.to_vec();
    for i in 0..n {
        x[i] = (x[i] - (0..i).map(|k| l[(i, k)] * x[k]).sum::<f64>()) / l[(i, i)];
    }
    for i in (0..n).rev() {
        x[i] = (x[i] - (i + 1..n).map(|k| l[(k, i)] * x[k]).sum::<f64>()) / l[(i, i)];
    }
    Some(x)
}

/// The inverse of a symmetric positive definite matrix; `None` when it is not one.
pub(super) fn inverse(a: &Matrix) -> Option<Matrix> {
    let n = a.n_rows;
    let mut inverse = Matrix::zeros(n, n);
    for j in 0..n {
        let unit: Vec<f64> = (0..n).map(|i| f64::from(u8::from(i == j))).collect();
        for (i, x) in solve(a, &unit)?.into_iter().enumerate() {
            inverse[(i, j)] = x;
        }
    }
    Some(inverse)
}

/// Minimizes `g's + s'Hs/2` over `lower <= s <= upper` by a primal active-set method. `h` must be positive definite.
///
/// Returns the minimizer; coordinates that end on a side lie on it exactly.
pub(super) fn box_quadratic(h: &Matrix, g: &[f64], lower: &[f64], upper: &[f64]) -> Vec<f64> {
    let n = g.len();
    let mut s: Vec<f64> = (0..n).map(|j| 0.0_f64.clamp(lower[j], upper[j])).collect();
    let mut fixed = vec![false; n];
    for _ in 0..40 * (n + 1) {
        let free: Vec<usize> = (0..n).filter(|&j| !fixed[j]).collect();
        let slope: Vec<f64> = h.times(&s).iter().zip(g).map(|(a, b)| a + b).collect();
        let right: Vec<f64> = free.iter().map(|&j| -slope[j]).collect();
        let Some(step) = solve(&h.sub(&free), &right) else {
            return s;
        };
        // The longest part of the step that stays inside, and the side that stops it.
        let (mut fraction, mut blocking) = (1.0, None);
        for (&j, &d) in free.iter().zip(&step) {
            let room = if d > 0.0 {
                upper[j] - s[j]
            } else {
                lower[j] - s[j]
            };
            if d != 0.0 && room / d < fraction {
                (fraction, blocking) = (room / d, Some((j, d > 0.0)));
            }
        }
        for (&j, &d) in free.iter().zip(&step) {
            s[j] = (s[j] + fraction * d).clamp(lower[j], upper[j]);
        }
        if let Some((j, up)) = blocking {
            s[j] = if up { upper[j] } else { lower[j] };
            fixed[j] = true;
            continue;
        }
        let slope: Vec<f64> = h.times(&s).iter().zip(g).map(|(a, b)| a + b).collect();
        let worst = (0..n)
            .filter(|&j| fixed[j])
            .map(|j| {
                (
                    j,
                    if s[j] <= lower[j] {
                        -slope[j]
                    } else {
                        slope[j]
                    },
                )
            })
            .filter(|&(j, pull)| pull > 1e-12 * h[(j, j)] && upper[j] > lower[j])
            .max_by(|a, b| a.1.total_cmp(&b.1));
        match worst {
            Some((j, _)) => fixed[j] = false,
            None => return s,
        }
    }
    s
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    fn random_spd(n: usize, random: &mut Random) -> Matrix {
        let mut a = Matrix::zeros(n + 3, n);
        for m in 0..n + 3 {
            for j in 0..n {
                a[(m, j)] = random.normal();
            }
        }
        a.weighted_gram(&vec![1.0; n + 3], &a)
    }

    #[test]
    fn eigenvectors_rebuild_the_matrix_and_are_orthonormal() {
        let mut random = Random::keyed(&[11]);
        let a = random_spd(7, &mut random);
        let pairs = eigen(&a);
        let mut b = Matrix::zeros(7, 7);
        for (value, e) in &pairs {
            for i in 0..7 {
                for j in 0..7 {
                    b[(i, j)] += value * e[i] * e[j];
                }
            }
        }
        b.add_scaled(-1.0, &a);
        let worst = b.data.iter().fold(0.0_f64, |m, x| m.max(x.abs()));
        assert!(worst < 1e-11, "{worst}");
    }

    #[test]
    fn the_inverse_undoes_the_matrix() {
        let a = random_spd(9, &mut Random::keyed(&[12]));
        let x: Vec<f64> = (0..9).map(|i| f64::from(i) - 3.5).collect();
        let back = inverse(&a).unwrap().times(&a.times(&x));
        assert!(back.iter().zip(&x).all(|(a, b)| (a - b).abs() < 1e-8));
        assert!(inverse(&Matrix::zeros(2, 2)).is_none());
    }

    #[test]
    fn the_box_minimum_meets_the_optimality_conditions() {
        let mut random = Random::keyed(&[13]);
        for _ in 0..200 {
            let h = random_spd(6, &mut random);
            let g: Vec<f64> = (0..6).map(|_| 5.0 * random.normal()).collect();
            let lower: Vec<f64> = (0..6).map(|_| -random.uniform()).collect();
            let upper: Vec<f64> = (0..6).map(|_| random.uniform()).collect();
            let s = box_quadratic(&h, &g, &lower, &upper);
            let slope: Vec<f64> = h.times(&s).iter().zip(&g).map(|(a, b)| a + b).collect();
            for j in 0..6 {
                let inside = s[j] > lower[j] && s[j] < upper[j];
                let ok = if inside {
                    slope[j].abs() < 1e-8
                } else if s[j] <= lower[j] {
                    slope[j] > -1e-8
                } else {
                    slope[j] < 1e-8
                };
                assert!(ok, "{j}: s {} slope {}", s[j], slope[j]);
            }
        }
    }
}
