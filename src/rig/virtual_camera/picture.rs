//! The picture without noise, and its exact mean over the sample square.

use super::{Appearance, NoiseFreeImage, Stand, VirtualCamera, optics};
use crate::base::{Error, Result};
use crate::math::GaussLegendre;
use crate::session::{Configuration, FrameKind, Perturbation, Projection};
use rayon::prelude::*;

/// Panels per side of the quadrature, until the mean settles; the ratio keeps patterns from hiding between two of them.
const PANELS: [usize; 8] = [24, 41, 71, 121, 207, 353, 601, 1023];

/// Relative change at which a mean has settled.
const SETTLED: f64 = 1e-5;

/// Relative change between the two finest quadratures up to which a picture with steps (rendered texels) is accepted.
const ROUGH: f64 = 2e-3;

impl VirtualCamera {
    /// What each pixel would see without vignetting, noise and filters, everything standing where it was asked to: the
    /// radiance averaged over the pixel's area, in normalized radiance, and blurred by the lens.
    ///
    /// # Errors
    /// When the appearance returns a radiance that is negative or not finite.
    pub fn noise_free_image(
        &self,
        kind: FrameKind,
        pose: &Configuration,
    ) -> Result<NoiseFreeImage> {
        self.picture(kind, &Stand::exact(pose))
    }

    /// The same, for where things stand in truth.
    pub(super) fn picture(&self, kind: FrameKind, stand: &Stand) -> Result<NoiseFreeImage> {
        let errors = Perturbation {
            shift_px: stand.shift_px,
            height_mm: stand.height_mm,
            ..Perturbation::default()
        };
        let projection = Projection::perturbed(&self.sensor.facts(), &stand.pose, &errors);
        let factor = self.factor(kind, &stand.pose);
        let show = |point| self.appearance.radiance(kind, &stand.pose, point);
        let width = self.sensor.width;
        let counts = self.subsamples(stand);
        let mut pixels = vec![[0.0; 3]; width * self.sensor.height];
        pixels
            .par_chunks_mut(width)
            .enumerate()
            .try_for_each(|(y, row)| {
                for (x, pixel) in row.iter_mut().enumerate() {
                    let mean = pixel_average(show, &projection, counts, x, y);
                    if !mean.iter().all(|m| (0.0..1e9).contains(m)) {
                        return Err(Error::new(format!(
                            "virtual camera: radiance {mean:?} at column {x}, row {y} of configuration {}, expected finite numbers >= 0",
                            stand.pose.id
                        )));
                    }
                    *pixel = [0, 1, 2].map(|c| mean[c] * factor[c]);
                }
                Ok(())
            })?;
        let blur_px = self.sensor.optics.blur_px;
        if blur_px > 0.0 {
            pixels = optics::blurred(&pixels, width, blur_px);
        }
        Ok(NoiseFreeImage { width, pixels })
    }

    /// The factor [`Self::rescale_to`] set.
    fn factor(&self, kind: FrameKind, pose: &Configuration) -> [f64; 3] {
        match kind {
            FrameKind::Sample | FrameKind::Reference => {
                self.factors.get(&pose.id).copied().unwrap_or([1.0; 3])
            }
            _ => [1.0; 3],
        }
    }

    /// Points per pixel along x and y.
    fn subsamples(&self, stand: &Stand) -> [usize; 2] {
        let footprint = self.sensor.pixel_mm / self.sensor.spacing_mm;
        let stretch = [1.0, 1.0 / stand.pose.camera.theta.cos()];
        stretch.map(|s| {
            self.sensor
                .subsamples
                .max((footprint * s).ceil().min(200.0) as usize)
        })
    }

    /// The exact mean of the picture over the sample square, everything standing where it was asked to: what a perfect
    /// measurement returns. An average over the area of the sample plane that knows neither pixels nor lens (composite
    /// Gauss-Legendre quadrature, finer and finer until the mean changes by less than 1e-5 of itself). Of a picture with steps,
    /// as rendered ones are, the finest quadrature is taken if it differs from the one before by less than 2e-3.
    ///
    /// # Errors
    /// When the picture is too rough for that, or as [`Self::noise_free_image`].
    pub fn true_mean(&self, pose: &Configuration, sample_square_mm: f64) -> Result<[f64; 3]> {
        let factor = self.factor(FrameKind::Sample, pose);
        let mut last: Option<[f64; 3]> = None;
        let within = |a: [f64; 3], b: [f64; 3], limit: f64| {
            (0..3).all(|c| (a[c] - b[c]).abs() <= limit * b[c])
        };
        for panels in PANELS {
            let mean = square_average(&*self.appearance, pose, sample_square_mm, panels);
            if !mean.iter().all(|m| (0.0..1e9).contains(m)) {
                return Err(Error::new(format!(
                    "virtual camera: mean radiance {mean:?} of configuration {}, expected finite numbers >= 0",
                    pose.id
                )));
            }
            let limit = if panels == PANELS[PANELS.len() - 1] {
                ROUGH
            } else {
                SETTLED
            };
            if last.is_some_and(|last| within(last, mean, limit)) {
                return Ok([0, 1, 2].map(|c| mean[c] * factor[c]));
            }
            last = Some(mean);
        }
        Err(Error::new(format!(
            "virtual camera: the mean of the picture of configuration {} does not settle to {ROUGH}",
            pose.id
        ))
        .with_hint("show a picture without steps, or with coarser detail"))
    }

    /// Rescales the picture of one configuration so that [`Self::true_mean`] is `target` (to rounding); returns the
    /// factors. Frames taken from now on show it.
    ///
    /// # Errors
    /// When the picture is black in a channel whose target is not zero, the target is negative or not finite, or as
    /// [`Self::true_mean`].
    pub fn rescale_to(
        &mut self,
        pose: &Configuration,
        sample_square_mm: f64,
        target: [f64; 3],
    ) -> Result<[f64; 3]> {
        self.factors.remove(&pose.id);
        let mean = self.true_mean(pose, sample_square_mm)?;
        let mut factors = [1.0; 3];
        for c in 0..3 {
            factors[c] = if target[c] > 0.0 {
                target[c] / mean[c]
            } else {
                target[c]
            };
            if !(0.0..1e12).contains(&factors[c]) {
                return Err(Error::new(format!(
                    "virtual camera: configuration {}: a picture with mean {} cannot be rescaled to {}",
                    pose.id, mean[c], target[c]
                )));
            }
        }
        self.factors.insert(pose.id, factors);
        self.last = None;
        Ok(factors)
    }
}

fn pixel_average(
    show: impl Fn([f64; 2]) -> [f64; 3],
    projection: &Projection,
    [columns, rows]: [usize; 2],
    x: usize,
    y: usize,
) -> [f64; 3] {
    let (step_x, step_y) = (1.0 / columns as f64, 1.0 / rows as f64);
    let mut sum = [0.0; 3];
    for j in 0..rows {
        for i in 0..columns {
            let pixel = [
                x as f64 + (i as f64 + 0.5) * step_x,
                y as f64 + (j as f64 + 0.5) * step_y,
            ];
            let radiance = show(projection.to_sample(pixel));
            for c in 0..3 {
                sum[c] += radiance[c];
            }
        }
    }
    sum.map(|s| s * step_x * step_y)
}

/// The mean over the centered square by four Gauss points in each of `panels` parts along x and y.
fn square_average(
    appearance: &dyn Appearance,
    pose: &Configuration,
    side_mm: f64,
    panels: usize,
) -> [f64; 3] {
    let rule = GaussLegendre::new(4);
    let edge = |k: usize| side_mm * (k as f64 / panels as f64 - 0.5);
    let points: Vec<(f64, f64)> = (0..panels)
        .flat_map(|k| rule.on(edge(k), edge(k + 1)))
        .collect();
    let row = |&(y, weight_y): &(f64, f64)| {
        points.iter().fold([0.0; 3], |sum, &(x, weight_x)| {
            let m = appearance.radiance(FrameKind::Sample, pose, [x, y]);
            [0, 1, 2].map(|c| sum[c] + weight_x * weight_y * m[c])
        })
    };
    let rows: Vec<[f64; 3]> = points.par_iter().map(row).collect();
    [0, 1, 2].map(|c| rows.iter().map(|r| r[c]).sum::<f64>() / (side_mm * side_mm))
}
