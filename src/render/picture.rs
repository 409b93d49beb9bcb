//! What a picture is: numbers per pixel of a part of the sample, with standard errors. [`super::image`] makes them.

use super::{Scene, TAU, relative_error_weight};
use crate::base::{Error, Result, Watch};
use crate::scatter::{CHANNELS, Parameters};
use crate::session::Configuration;

/// Most pixels of a picture.
const MOST_PIXELS: usize = 1 << 26;

/// A rectangle of the sample plane, in the sample frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Region {
    /// Its middle, millimeters.
    pub center: [f64; 2],
    /// Its sides along x and y, millimeters.
    pub size: [f64; 2],
}

impl Region {
    /// A square around the origin.
    pub(super) fn square(side: f64) -> Self {
        Self {
            center: [0.0; 2],
            size: [side; 2],
        }
    }

    /// A rectangle from the origin on.
    pub(super) fn from_origin(size: [f64; 2]) -> Self {
        Self {
            center: size.map(|s| 0.5 * s),
            size,
        }
    }
}

/// A scene that can also be seen pixel by pixel.
pub trait Pictured: Scene {
    /// The square over which means are taken.
    fn sample_square(&self) -> Region;

    /// The tile that is repeated, from the origin on.
    fn tile(&self) -> Region;

    /// Renders a picture of each configuration of the request, in its order; unbiased, and the same on any number of
    /// threads. A configuration's noise depends on which others it shares camera paths with.
    ///
    /// # Errors
    /// When the picture is empty or too large, the parameters have no meaning for the model, the work is too little for a
    /// standard error, a pixel is not finite, or `watch` cancels.
    fn pictures(&self, request: &PictureRequest<'_>, watch: &dyn Watch) -> Result<Vec<Picture>>;
}

/// How much work a picture may cost.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PictureEffort {
    /// Camera paths for each pixel, at least 2.
    PathsPerPixel(u64),
    /// As many paths for each pixel of a pose as make the root mean square of its pixels' standard errors this fraction
    /// of its mean (of 0.02 if that is more).
    Accuracy(f64),
}

/// Which pictures are wanted.
#[derive(Debug, Clone)]
pub struct PictureRequest<'a> {
    /// The poses, a picture of each.
    pub configurations: &'a [Configuration],
    /// The model's parameter values.
    pub parameters: &'a Parameters,
    /// What is seen.
    pub region: Region,
    /// Pixels along x and along y.
    pub resolution: [usize; 2],
    /// How much work.
    pub effort: PictureEffort,
    /// By which parameters to differentiate: rows of the model's list.
    pub derivatives: &'a [usize],
    /// The user's seed.
    pub seed: u64,
}

/// One number per pixel and channel, the top left pixel (lowest x, highest y) first, row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct Layer {
    /// Estimates.
    pub value: Vec<[f32; CHANNELS]>,
    /// Their standard errors, independent from pixel to pixel.
    pub standard_error: Vec<[f32; CHANNELS]>,
}

impl Layer {
    /// The mean over all pixels and its standard error, per channel.
    pub fn mean(&self) -> ([f64; CHANNELS], [f64; CHANNELS]) {
        let n = self.value.len() as f64;
        let sum = |c: usize| self.value.iter().map(|v| f64::from(v[c])).sum::<f64>();
        (
            std::array::from_fn(|c| sum(c) / n),
            std::array::from_fn(|c| self.sum_variance(c).sqrt() / n),
        )
    }

    fn sum_variance(&self, channel: usize) -> f64 {
        let square = |e: &[f32; CHANNELS]| f64::from(e[channel]).powi(2);
        self.standard_error.iter().map(square).sum()
    }

    /// Root mean square standard error of a pixel, relative to the mean as [`relative_error_weight`] has it.
    pub(super) fn relative_error(&self) -> f64 {
        let n = (CHANNELS * self.value.len()) as f64;
        let variance: f64 = (0..CHANNELS).map(|c| self.sum_variance(c)).sum();
        (relative_error_weight(self.mean().0, TAU) * variance / n).sqrt()
    }
}

/// What the camera of one configuration sees.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// The configuration's id.
    pub config: u32,
    /// What is seen.
    pub region: Region,
    /// Pixels along x and along y.
    pub resolution: [usize; 2],
    /// Camera paths per pixel.
    pub paths: u64,
    /// Normalized radiance.
    pub radiance: Layer,
    /// Its derivatives, as many as were asked for (angles per radian).
    pub derivatives: Vec<Layer>,
}

impl Picture {
    /// The radiance at a point of the sample plane, millimeters, as if the picture's region were repeated without end (a
    /// tile is); bilinear between pixel centers.
    pub fn at(&self, point: [f64; 2]) -> [f64; CHANNELS] {
        let [nx, ny] = self.resolution;
        let place = |from_low_end: f64, size: f64, n: usize| {
            let x = (from_low_end / size).rem_euclid(1.0) * n as f64 - 0.5;
            let low = x.floor();
            let wrapped = |i: f64| i.rem_euclid(n as f64) as usize % n;
            (wrapped(low), wrapped(low + 1.0), x - low)
        };
        let Region { center, size } = self.region;
        let (x0, x1, fx) = place(point[0] - center[0] + 0.5 * size[0], size[0], nx);
        let (y0, y1, fy) = place(center[1] + 0.5 * size[1] - point[1], size[1], ny);
        std::array::from_fn(|c| {
            let value = |x: usize, y: usize| f64::from(self.radiance.value[y * nx + x][c]);
            let row = |y: usize| (1.0 - fx) * value(x0, y) + fx * value(x1, y);
            (1.0 - fy) * row(y0) + fy * row(y1)
        })
    }
}

impl PictureRequest<'_> {
    pub(super) fn check(&self) -> Result<()> {
        let [nx, ny] = self.resolution;
        if nx == 0 || ny == 0 || nx.saturating_mul(ny) > MOST_PIXELS {
            return Err(Error::new(format!(
                "a picture of {nx} x {ny} pixels: expected at least 1 and at most {MOST_PIXELS} in all"
            )));
        }
        let Region { center, size } = self.region;
        if !(center.iter().all(|c| c.is_finite()) && size.iter().all(|s| *s > 0.0 && s.is_finite()))
        {
            return Err(Error::new(format!(
                "a picture of {size:?} mm around {center:?} mm: expected a finite region with positive sides"
            )));
        }
        match self.effort {
            PictureEffort::PathsPerPixel(n) if n < 2 => {
                Err(Error::new(format!("{n} paths per pixel are too few"))
                    .with_hint("at least 2 are needed for a standard error"))
            }
            PictureEffort::Accuracy(a) if !(1e-4..=1.0).contains(&a) => Err(Error::new(format!(
                "accuracy {a} of a pixel is out of range: expected 0.0001 to 1"
            ))),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_is_read_between_its_pixels_and_beyond_its_edges() {
        let value: Vec<[f32; 3]> = [1.0, 2.0, 3.0, 4.0].map(|v: f32| [v, 10.0 * v, 0.0]).into();
        let picture = Picture {
            config: 1,
            region: Region {
                center: [1.0, 2.0],
                size: [2.0, 4.0],
            },
            resolution: [2, 2],
            paths: 2,
            radiance: Layer {
                standard_error: vec![[0.5; 3]; 4],
                value,
            },
            derivatives: Vec::new(),
        };
        let near = |p: [f64; 2], expected: f64| {
            let [r, g, _] = picture.at(p);
            assert!(
                (r - expected).abs() < 1e-6 && (g - 10.0 * expected).abs() < 1e-5,
                "{p:?}: {r}"
            );
        };
        // The first row is the upper one.
        near([0.5, 3.0], 1.0);
        near([1.5, 3.0], 2.0);
        near([0.5, 1.0], 3.0);
        near([1.0, 3.0], 1.5);
        near([1.5, 2.0], 3.0);
        // Across the seam, and a whole period away.
        near([0.0, 1.0], 3.5);
        near([0.5 - 2.0, 3.0 + 4.0], 1.0);
        let (mean, se) = picture.radiance.mean();
        assert!((mean[0] - 2.5).abs() < 1e-12 && (se[0] - 0.25).abs() < 1e-12);
    }
}
