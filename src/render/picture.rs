//! What the camera sees of one tile: normalized radiance over the sample plane.

use super::guide::Guide;
use super::path::{Event, Visitor};
use super::scene::FiberScene;
use crate::base::{Error, Result, Watch};
use crate::math::Random;
use crate::scatter::{CHANNELS, Parameters};
use crate::session::Configuration;
use glam::DVec3;
use rayon::prelude::*;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Normalized radiance of a tile by the point of the plane z = 0 the camera's ray passes through; it repeats with the
/// tile.
#[derive(Debug, Clone, PartialEq)]
pub struct TilePicture {
    /// Texels in x and y.
    pub resolution: [usize; 2],
    /// Tile size, millimeters.
    pub size: [f64; 2],
    /// Row by row (y, then x).
    pub texels: Vec<[f64; 3]>,
}

impl TilePicture {
    /// The radiance at a point of the sample plane, millimeters; bilinear between texel centers, periodic.
    pub fn at(&self, point: [f64; 2]) -> [f64; 3] {
        let [nx, ny] = self.resolution;
        let place = |p: f64, size: f64, n: usize| {
            let x = (p / size).rem_euclid(1.0) * n as f64 - 0.5;
            let low = x.floor();
            (
                (low.rem_euclid(n as f64)) as usize % n,
                (low + 1.0).rem_euclid(n as f64) as usize % n,
                x - low,
            )
        };
        let (x0, x1, fx) = place(point[0], self.size[0], nx);
        let (y0, y1, fy) = place(point[1], self.size[1], ny);
        std::array::from_fn(|c| {
            let row = |y: usize| {
                (1.0 - fx) * self.texels[y * nx + x0][c] + fx * self.texels[y * nx + x1][c]
            };
            (1.0 - fy) * row(y0) + fy * row(y1)
        })
    }
}

/// Radiance of one lamp, without derivatives.
struct Brightness {
    /// `throughput[n]`: what the first `n` events left.
    throughput: Vec<[f64; CHANNELS]>,
    sum: [f64; CHANNELS],
}

impl Brightness {
    fn go_on(&mut self, depth: usize, weight: [f64; CHANNELS]) {
        let left = std::array::from_fn(|c| self.throughput[depth][c] * weight[c]);
        self.throughput.truncate(depth + 1);
        self.throughput.push(left);
    }

    fn add(&mut self, depth: usize, weight: [f64; CHANNELS]) {
        self.sum = std::array::from_fn(|c| self.sum[c] + self.throughput[depth][c] * weight[c]);
    }
}

impl Visitor for Brightness {
    fn bounce(&mut self, depth: usize, event: Event<'_>) {
        self.go_on(depth, event.weight);
    }
    fn reflect(&mut self, depth: usize, weight: [f64; CHANNELS]) {
        self.go_on(depth, weight);
    }
    fn connect(&mut self, depth: usize, _lamp: usize, event: Event<'_>) {
        self.add(depth, event.weight);
    }
    fn arrive(&mut self, depth: usize, _lamp: usize, factor: [f64; CHANNELS]) {
        self.add(depth, factor);
    }
}

impl FiberScene {
    /// Renders one tile as the camera of `configuration` sees it, `paths` paths per texel.
    ///
    /// # Errors
    /// When the parameters have no meaning for the model, the picture is empty, or `watch` cancels.
    pub fn picture(
        &self,
        configuration: &Configuration,
        parameters: &Parameters,
        resolution: [usize; 2],
        paths: u64,
        seed: u64,
        watch: &dyn Watch,
    ) -> Result<TilePicture> {
        let [nx, ny] = resolution;
        if nx == 0 || ny == 0 || paths == 0 {
            return Err(Error::new(format!(
                "picture of {nx} x {ny} texels with {paths} paths each: expected at least 1"
            )));
        }
        let scattering = self.model.prepare(parameters)?;
        let lamps = self.lamps(std::iter::once(*configuration));
        let toward_camera = configuration.camera_in_sample().vector();
        let done = AtomicUsize::new(0);
        let row = |y: usize| -> Option<Vec<[f64; 3]>> {
            if watch.cancelled() {
                return None;
            }
            let guide = Guide::FRESH;
            let stage = self.stage(&*scattering, &lamps, &[0.0], &guide);
            let texel = |x: usize| {
                let key = [
                    seed,
                    0x7049_6354,
                    u64::from(configuration.id),
                    y as u64,
                    x as u64,
                ];
                let mut random = Random::keyed(&key);
                let mut path = Brightness {
                    throughput: vec![[1.0; CHANNELS]],
                    sum: [0.0; CHANNELS],
                };
                for _ in 0..paths {
                    let u = (x as f64 + random.uniform()) / nx as f64;
                    let v = (y as f64 + random.uniform()) / ny as f64;
                    let through = DVec3::new(u * self.tile_size[0], v * self.tile_size[1], 0.0);
                    stage.follow(through, toward_camera, &mut random, &mut path);
                }
                path.sum.map(|s| s / paths as f64)
            };
            let texels = (0..nx).map(texel).collect();
            watch.progress(
                "picture",
                done.fetch_add(1, Ordering::Relaxed) as u64 + 1,
                ny as u64,
            );
            Some(texels)
        };
        let rows: Option<Vec<Vec<[f64; 3]>>> = (0..ny).into_par_iter().map(row).collect();
        let texels = rows.ok_or_else(|| Error::new("interrupted"))?.concat();
        Ok(TilePicture {
            resolution,
            size: self.tile_size,
            texels,
        })
    }
}
