//! Separable Gaussians on boxes of voxels.

use super::check_going_on;
use super::gray::{Area, Gray};
use crate::base::{Result, Watch};
use rayon::prelude::*;

/// Voxels of a box on each side, before the border the kernels need.
pub(super) const BLOCK: [usize; 3] = [96, 96, 48];
/// Boxes worked on between two reports of progress.
pub(super) const GROUP: usize = 16;

/// Voxels on each side of a kernel's middle: beyond three standard deviations.
pub(super) fn reach(sigma: f64) -> usize {
    (3.0 * sigma + 0.5).ceil() as usize
}

/// Weights of a Gaussian, in sum 1; one weight for a width of zero.
pub(super) fn kernel(sigma: f64) -> Vec<f32> {
    if sigma <= 0.0 {
        return vec![1.0];
    }
    let reach = reach(sigma) as i64;
    let weight = |x: i64| (-0.5 * (x as f64 / sigma).powi(2)).exp();
    let sum: f64 = (-reach..=reach).map(weight).sum();
    (-reach..=reach).map(|x| (weight(x) / sum) as f32).collect()
}

/// Weights of a Gaussian's derivative, exact for a straight slope.
pub(super) fn derivative(sigma: f64) -> Vec<f32> {
    let reach = reach(sigma) as i64;
    let weight = |x: i64| x as f64 * (-0.5 * (x as f64 / sigma).powi(2)).exp();
    let slope: f64 = (-reach..=reach).map(|x| x as f64 * weight(x)).sum();
    (-reach..=reach)
        .map(|x| (weight(x) / slope) as f32)
        .collect()
}

/// Values on a box.
#[derive(Debug, Clone)]
pub(super) struct Field {
    pub(super) dims: [usize; 3],
    pub(super) values: Vec<f32>,
}

impl Field {
    /// Weighs neighbors along an axis; the result is shorter by the kernel's border.
    pub(super) fn along(&self, axis: usize, kernel: &[f32]) -> Self {
        let mut dims = self.dims;
        dims[axis] -= kernel.len() - 1;
        let [nx, ny, _] = self.dims;
        let stride = [1, nx, nx * ny][axis];
        let mut values = vec![0.0_f32; dims.iter().product()];
        for (r, row) in values.chunks_exact_mut(dims[0]).enumerate() {
            let first = nx * (r % dims[1] + ny * (r / dims[1]));
            for (t, weight) in kernel.iter().enumerate() {
                let from = &self.values[first + t * stride..][..dims[0]];
                for (sum, v) in row.iter_mut().zip(from) {
                    *sum += weight * v;
                }
            }
        }
        Self { dims, values }
    }

    /// The same along all axes.
    pub(super) fn blurred(&self, kernel: &[f32]) -> Self {
        self.along(2, kernel).along(1, kernel).along(0, kernel)
    }

    /// Without `by` voxels on each side.
    pub(super) fn shrunk(&self, by: usize) -> Self {
        let dims = self.dims.map(|n| n - 2 * by);
        let [nx, ny, _] = self.dims;
        let rows = (0..dims[2]).flat_map(|k| (0..dims[1]).map(move |j| (j, k)));
        let values = rows
            .flat_map(|(j, k)| {
                let first = by + nx * (j + by + ny * (k + by));
                self.values[first..first + dims[0]].iter().copied()
            })
            .collect();
        Self { dims, values }
    }
}

/// Blurs a volume by a Gaussian of `sigma` voxels.
pub(super) fn blur(gray: &mut Gray, sigma: f64, watch: &dyn Watch) -> Result<()> {
    if sigma <= 0.0 {
        return Ok(());
    }
    let kernel = kernel(sigma);
    let mut blurred = vec![0.0; gray.values.len()];
    let areas = Area::filling(gray.shape, BLOCK);
    for (done, group) in areas.chunks(GROUP).enumerate() {
        check_going_on(watch)?;
        let found: Vec<Field> = group
            .par_iter()
            .map(|area| {
                let wide = area.grown(kernel.len() / 2);
                let field = Field {
                    dims: wide.dims,
                    values: gray.padded(&wide, |v| v),
                };
                field.blurred(&kernel)
            })
            .collect();
        for (area, field) in group.iter().zip(&found) {
            let n = area.dims[0];
            for (place, row) in area.rows(gray.shape).zip(field.values.chunks_exact(n)) {
                blurred[place..place + n].copy_from_slice(row);
            }
        }
        let at = (done + 1) * GROUP;
        watch.progress("blurring", at.min(areas.len()) as u64, areas.len() as u64);
    }
    gray.values = blurred;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::Unwatched;

    #[test]
    fn kernels_keep_levels_and_slopes() {
        for sigma in [0.6, 1.0, 2.5, 8.0] {
            let sum: f32 = kernel(sigma).iter().sum();
            assert!((sum - 1.0).abs() < 1e-6);
            let derivative = derivative(sigma);
            let middle = derivative.len() as f32 / 2.0 - 0.5;
            let ramp = derivative.iter().enumerate();
            let slope: f32 = ramp.map(|(k, w)| w * (k as f32 - middle)).sum();
            assert!((slope - 1.0).abs() < 1e-6, "{sigma}: {slope}");
        }
    }

    #[test]
    fn a_blurred_point_is_a_gaussian_and_goes_round_the_seam() {
        // Sees a shift by one voxel, a width off by 1 % and a seam that is not closed.
        let shape = [20, 30, 25];
        let mut values = vec![0.0; shape.iter().product()];
        values[20 * (15 + 30 * 12)] = 1.0;
        let mut gray = Gray {
            shape,
            side: 0.005,
            bottom: 0.0,
            values,
            periodic: true,
        };
        blur(&mut gray, 1.5, &Unwatched).unwrap();
        let at = |i: usize, j: usize, k: usize| f64::from(gray.values[i + 20 * (j + 30 * k)]);
        let peak = at(0, 15, 12);
        for (i, j, k, r2) in [
            (1, 15, 12, 1.0),
            (19, 15, 12, 1.0),
            (2, 16, 11, 6.0),
            (18, 12, 12, 13.0),
        ] {
            let expected = peak * f64::exp(-0.5 * r2 / 2.25);
            assert!((at(i, j, k) - expected).abs() < 1e-6, "{i} {j} {k}");
        }
        assert!((gray.values.iter().sum::<f32>() - 1.0).abs() < 1e-4);
    }
}
