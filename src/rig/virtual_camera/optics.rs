//! What lies between the sample and the sensor: the lens with its falloff, and dust.
//!
//! Not modeled: stray light, color fringes, blur that differs over the image.

use super::SensorModel;
use crate::base::{Error, Result};
use crate::session::Lens;
use rayon::prelude::*;

/// How the optics depart from even, sharp and undistorted; all zero: not at all.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Optics {
    /// How the lens and its mount depart from an orthographic camera.
    pub lens: Lens,
    /// Where the falloff is centered, pixels from the middle of the image.
    pub falloff_center_px: [f64; 2],
    /// Loss of light that grows with the fourth power of the distance, at the distance of the image corner.
    pub falloff_quartic: f64,
    /// Relative change of the light from the middle of the image to its right and to its lower edge.
    pub gradient: [f64; 2],
    /// Dust on the sensor: in every frame, flats included.
    pub dust: Vec<Dust>,
    /// Blur of the lens: standard deviation of a Gaussian, pixels.
    pub blur_px: f64,
}

/// The shadow of one grain of dust on the sensor: full inside its radius, fading out as a cosine over as much again.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dust {
    /// Where its middle lies in the image, pixels.
    pub center_px: [f64; 2],
    /// Radius of the full shadow, pixels.
    pub radius_px: f64,
    /// Light lost in the full shadow, fraction.
    pub depth: f64,
}

impl Dust {
    /// Light that passes to the image point (x, y), fraction.
    fn passes(&self, x: f64, y: f64) -> f64 {
        let distance = (x - self.center_px[0]).hypot(y - self.center_px[1]) / self.radius_px;
        if distance >= 2.0 {
            return 1.0;
        }
        let edge = (distance - 1.0).max(0.0);
        1.0 - self.depth * 0.5 * (1.0 + (std::f64::consts::PI * edge).cos())
    }
}

impl Optics {
    pub(super) fn check(&self) -> Result<()> {
        let bad = |what: &str| Err(Error::new(format!("sensor model: {what}")));
        let small = |x: f64| (-1.0..=1.0).contains(&x);
        if !(0.0..1.0).contains(&self.falloff_quartic) || !self.gradient.iter().all(|&g| small(g)) {
            return bad("falloff_quartic must lie in 0..1 and gradient in -1..1");
        }
        if !self.falloff_center_px.iter().all(|c| c.is_finite()) {
            return bad("falloff_center_px must be finite");
        }
        let sound = |d: &Dust| {
            d.radius_px > 0.0
                && d.center_px
                    .iter()
                    .chain([&d.radius_px])
                    .all(|x| x.is_finite())
                && (0.0..=1.0).contains(&d.depth)
        };
        if !self.dust.iter().all(sound) {
            return bad("dust needs a positive radius and a depth in 0..=1");
        }
        if !(0.0..100.0).contains(&self.blur_px) {
            return bad("blur_px must be 0 to 100 pixels");
        }
        Ok(())
    }
}

impl SensorModel {
    /// Light that reaches the image point (x, y), relative to the center of the falloff: vignetting, gradient and dust.
    pub fn vignette(&self, x: f64, y: f64) -> f64 {
        let optics = &self.optics;
        let (half_width, half_height) = (0.5 * self.width as f64, 0.5 * self.height as f64);
        let corner = half_width.hypot(half_height);
        let (right, down) = (x - half_width, y - half_height);
        let [x0, y0] = optics.falloff_center_px;
        let r = (right - x0).hypot(down - y0) / corner;
        let falloff = 1.0 - self.vignetting * r * r - optics.falloff_quartic * r.powi(4);
        let [gx, gy] = optics.gradient;
        let even = falloff * (1.0 + gx * right / half_width + gy * down / half_height);
        optics.dust.iter().fold(even, |v, d| v * d.passes(x, y))
    }
}

/// A picture seen through a lens with a Gaussian blur of `sigma_px`; beyond its edges it goes on as it is at the edge.
pub(super) fn blurred(pixels: &[[f64; 3]], width: usize, sigma_px: f64) -> Vec<[f64; 3]> {
    let reach = (4.0 * sigma_px).ceil() as isize;
    let weights: Vec<f64> = (-reach..=reach)
        .map(|i| (-0.5 * (i as f64 / sigma_px).powi(2)).exp())
        .collect();
    let total: f64 = weights.iter().sum();
    let height = pixels.len() / width;
    let along = |from: &[[f64; 3]], step: usize, at: usize, count: usize, index: usize| {
        let mut sum = [0.0; 3];
        for (k, weight) in weights.iter().enumerate() {
            let offset = k as isize - reach;
            let other = (at as isize + offset).clamp(0, count as isize - 1) as usize;
            let value = from[index - at * step + other * step];
            for c in 0..3 {
                sum[c] += weight * value[c];
            }
        }
        sum.map(|s| s / total)
    };
    let rows: Vec<[f64; 3]> = (0..pixels.len())
        .into_par_iter()
        .map(|i| along(pixels, 1, i % width, width, i))
        .collect();
    (0..pixels.len())
        .into_par_iter()
        .map(|i| along(&rows, width, i / width, height, i))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn light_falls_off_as_stated() {
        let mut sensor = SensorModel {
            width: 80,
            height: 60,
            vignetting: 0.1,
            ..SensorModel::default()
        };
        let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-12, "{a} {b}");
        close(sensor.vignette(80.0, 60.0), 0.9);
        close(sensor.vignette(40.0, 60.0), 1.0 - 0.1 * 0.36);
        sensor.optics.falloff_quartic = 0.05;
        close(sensor.vignette(80.0, 0.0), 0.85);
        close(
            sensor.vignette(40.0, 0.0),
            1.0 - 0.1 * 0.36 - 0.05 * 0.36 * 0.36,
        );
        sensor.optics.gradient = [0.02, -0.01];
        close(sensor.vignette(80.0, 0.0), 0.85 * 1.03);
        sensor.optics.falloff_center_px = [40.0, 30.0];
        close(sensor.vignette(80.0, 60.0), 1.01);
    }

    #[test]
    fn dust_shades_a_disk_with_a_soft_edge() {
        let mut sensor = SensorModel {
            vignetting: 0.0,
            ..SensorModel::default()
        };
        sensor.optics.dust = vec![Dust {
            center_px: [50.0, 40.0],
            radius_px: 3.0,
            depth: 0.2,
        }];
        let at = |x: f64| sensor.vignette(50.0 + x, 40.0);
        assert!((at(0.0) - 0.8).abs() < 1e-12 && (at(3.0) - 0.8).abs() < 1e-12);
        assert!((at(4.5) - 0.9).abs() < 1e-12, "{}", at(4.5));
        assert!((at(6.0) - 1.0).abs() < 1e-12 && (at(-40.0) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn blur_keeps_the_light_and_spreads_it_by_sigma() {
        let width = 41;
        let mut pixels = vec![[0.0; 3]; width * 31];
        pixels[15 * width + 20] = [1.0, 2.0, 0.0];
        let out = blurred(&pixels, width, 1.5);
        let total: f64 = out.iter().map(|p| p[1]).sum();
        assert!((total - 2.0).abs() < 1e-12, "{total}");
        let spread = |f: &dyn Fn(usize) -> f64| -> f64 {
            out.iter().enumerate().map(|(i, p)| p[0] * f(i)).sum()
        };
        // The sampled Gaussian, cut at four sigma.
        let x2 = spread(&|i| ((i % width) as f64 - 20.0).powi(2));
        let y2 = spread(&|i| ((i / width) as f64 - 15.0).powi(2));
        assert!(
            (x2 - 2.25).abs() < 0.01 && (y2 - 2.25).abs() < 0.01,
            "{x2} {y2}"
        );
        // An even picture stays even up to its edges.
        let even = blurred(&vec![[0.3; 3]; width * 31], width, 2.0);
        assert!(even.iter().all(|p| (p[2] - 0.3).abs() < 1e-12));
    }
}
