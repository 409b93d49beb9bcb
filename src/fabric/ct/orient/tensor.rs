//! Directions by the structure tensor (Bigun and Granlund 1987): the direction along which gray changes least, from the
//! products of Gaussian derivatives averaged over a Gaussian window.
//!
//! Gradients near a border that is no seam are left out, and the window counts only what lies inside: borders do not
//! turn directions. Assumes that one fiber, or a bundle of parallel ones, fills most of the window.

use super::Found;
use super::eigen::eigen;
use crate::fabric::PackedDirection;
use crate::fabric::ct::gaussian::{Field, derivative, kernel, reach};
use crate::fabric::ct::gray::{Area, Gray};

/// Two Gaussians, standard deviations in voxels.
#[derive(Debug, Clone)]
pub(super) struct Tensor {
    smooth: Vec<f32>,
    slope: Vec<f32>,
    window: Vec<f32>,
    /// Gradients nearer than this to a border are left out.
    margin: i64,
}

impl Tensor {
    pub(super) fn new(gradient: f64, window: f64) -> Self {
        Self {
            smooth: kernel(gradient),
            slope: derivative(gradient),
            window: kernel(window),
            margin: (2.0 * gradient).round() as i64,
        }
    }

    /// Voxels it looks at beyond each side.
    pub(super) fn reach(gradient: f64, window: f64) -> usize {
        reach(gradient) + reach(window)
    }

    /// Directions of the voxels of a box from `solid` on.
    pub(super) fn directions(&self, gray: &Gray, area: &Area, solid: f32) -> Vec<Found> {
        let wide = area.grown(self.window.len() / 2);
        let [x, y, z] = self.gradients(gray, &wide);
        let pairs = [(&x, &x), (&y, &y), (&z, &z), (&x, &y), (&x, &z), (&y, &z)];
        let tensor = pairs.map(|(a, b)| {
            let product = a.values.iter().zip(&b.values).map(|(a, b)| a * b);
            let field = Field {
                dims: a.dims,
                values: product.collect(),
            };
            field.blurred(&self.window).values
        });
        let n = area.dims[0];
        let rows = area.rows(gray.shape).enumerate();
        let voxels = rows.flat_map(|(r, first)| (0..n).map(move |i| (r * n + i, first + i)));
        voxels
            .filter(|(_, place)| gray.values[*place] >= solid)
            .map(|(at, place)| found(place, tensor.each_ref().map(|t| f64::from(t[at]))))
            .collect()
    }

    /// The three components on a box, zero where the border spoils them.
    fn gradients(&self, gray: &Gray, area: &Area) -> [Field; 3] {
        let wide = area.grown(self.smooth.len() / 2);
        let field = Field {
            dims: wide.dims,
            values: gray.padded(&wide, |v| v),
        };
        let (smooth, slope) = (&self.smooth, &self.slope);
        let even = field.along(2, smooth);
        let z = field.along(2, slope).along(1, smooth).along(0, smooth);
        let x = even.along(1, smooth).along(0, slope);
        let y = even.along(1, slope).along(0, smooth);
        let mut gradients = [x, y, z];
        self.leave_out_borders(gray, area, &mut gradients);
        gradients
    }

    fn leave_out_borders(&self, gray: &Gray, area: &Area, gradients: &mut [Field; 3]) {
        let inside = |axis: usize, k: usize| {
            let at = area.low[axis] + k as i64;
            let n = gray.shape[axis] as i64;
            (gray.periodic && axis < 2) || (self.margin..n - self.margin).contains(&at)
        };
        let [nx, ny, nz] = area.dims;
        let columns: Vec<bool> = (0..nx).map(|i| inside(0, i)).collect();
        for (j, k) in (0..nz).flat_map(|k| (0..ny).map(move |j| (j, k))) {
            let row = inside(1, j) && inside(2, k);
            for i in (0..nx).filter(|i| !(row && columns[*i])) {
                let at = i + nx * (j + ny * k);
                gradients.iter_mut().for_each(|g| g.values[at] = 0.0);
            }
        }
    }
}

/// The direction of least change; confidence is how much less it is than the next, from 0 to 1.
fn found(place: usize, tensor: [f64; 6]) -> Found {
    let (values, vectors) = eigen(tensor);
    let [least, next] = [values[0].max(0.0), values[1].max(0.0)];
    let confidence = if next > 0.0 {
        (next - least) / (next + least)
    } else {
        0.0
    };
    Found {
        place,
        direction: PackedDirection::pack(vectors[0]),
        confidence: confidence as f32,
        fit: f32::NEG_INFINITY,
    }
}
