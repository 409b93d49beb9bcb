//! Pictures: what the camera sees of a part of the sample, pixel by pixel, with derivatives from the same paths.
//!
//! A pixel is a rectangle of the sample plane z = 0 in the sample frame (columns along +x, rows along -y): its value is
//! the mean normalized radiance over the camera's rays through that rectangle. So a picture is rectified: foreshortening
//! is taken out, every pixel stands for the same area of cloth, and the mean of a picture of the sample square is what
//! [`super::Scene::estimate`] estimates. It does not show the outline that the cloth has for the camera.
//!
//! Poses that share their camera direction share paths, as in [`super::estimate`]; pixels never do. What is pictured is
//! anything through which paths can be followed: fibers, or voxels.

use super::allocation::{Group, groups, worth_of};
use super::estimate::{CameraRay, Followed, Rules};
use super::guide::Guide;
use super::picture::{Layer, Picture, PictureEffort, PictureRequest, Region};
use super::summation::{Rows, Summation, Sums};
use crate::base::{Error, Result, Watch};
use crate::math::Random;
use crate::math::statistics::Running;
use crate::scatter::CHANNELS;
use glam::DVec3;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering};

/// Most strata a pixel is divided into.
const MOST_STRATA: u64 = 4096;
/// Paths between two looks at whether to stop.
const PATHS_PER_LOOK: u64 = 4096;
/// Side and paths per pixel of the first pilot, which sets the roulette on connections.
const PILOT: (usize, u64) = (8, 32);
/// Fewest paths of a picture from which an accuracy is foreseen, and how often that is tried again with more.
const FORESEEING_PATHS: u64 = 8192;
const MAX_PILOTS: u64 = 6;
/// Fraction of an asked accuracy aimed at: pilots miss the rarest bright paths.
const AIM: f64 = 0.9;
/// Names the random streams of pictures.
const STREAM: u64 = 0x7049_6354;

/// See [`super::Pictured::pictures`]; derivatives have these `rows`.
pub(super) fn pictures(
    followed: &impl Followed,
    rows: Rows,
    request: &PictureRequest<'_>,
    watch: &dyn Watch,
) -> Result<Vec<Picture>> {
    let groups = groups(followed.options(), request.configurations);
    let mut pictures = vec![None; request.configurations.len()];
    for (g, group) in groups.iter().enumerate() {
        let canvas = Canvas {
            followed,
            rows,
            request,
            group,
            parts: [g as u64, groups.len() as u64],
        };
        let done = canvas.finished(watch)?;
        for (&member, picture) in group.members.iter().zip(done) {
            pictures[member] = Some(picture);
        }
    }
    Ok(pictures.into_iter().flatten().collect())
}

/// The pictures that share camera paths.
struct Canvas<'a, F> {
    followed: &'a F,
    rows: Rows,
    request: &'a PictureRequest<'a>,
    group: &'a Group,
    /// Which of how many groups it is.
    parts: [u64; 2],
}

/// One pass over all pixels.
struct Pass<'a> {
    resolution: [usize; 2],
    /// Per pixel.
    paths: u64,
    /// By which parameters to differentiate.
    rows: &'a [usize],
    /// Of the group's members, see [`Rules::worth`].
    worth: &'a [f64],
    /// Selects the random streams.
    round: u64,
    name: &'a str,
}

/// An estimate and its standard error.
type Number = [f32; 2];

impl<F: Followed> Canvas<'_, F> {
    /// Pilots as needed, then the pass whose numbers are returned; its paths and roulette were fixed beforehand.
    fn finished(&self, watch: &dyn Watch) -> Result<Vec<Picture>> {
        let (side, pilot_paths) = PILOT;
        let mut pass = Pass {
            resolution: [side; 2],
            paths: pilot_paths,
            rows: &[],
            worth: &vec![0.0; self.group.members.len()],
            round: 0,
            name: "pilot",
        };
        let pilot = self.pass(&pass, watch)?;
        let worth: Vec<f64> = pilot.iter().map(|p| worth_of(p[0].mean().0)).collect();
        pass = Pass {
            resolution: self.request.resolution,
            worth: &worth,
            ..pass
        };
        pass.paths = match self.request.effort {
            PictureEffort::PathsPerPixel(n) => n,
            PictureEffort::Accuracy(target) => self.needed_paths(&mut pass, AIM * target, watch)?,
        };
        pass.round = MAX_PILOTS;
        pass.rows = self.request.derivatives;
        pass.name = "picture";
        let layers = self.pass(&pass, watch)?;
        let of = |(&member, mut layers): (&usize, Vec<Layer>)| {
            let derivatives = layers.split_off(1);
            layers.pop().map(|radiance| Picture {
                config: self.request.configurations[member].id,
                region: self.request.region,
                resolution: pass.resolution,
                paths: pass.paths,
                radiance,
                derivatives,
            })
        };
        Ok(self
            .group
            .members
            .iter()
            .zip(layers)
            .filter_map(of)
            .collect())
    }

    /// Paths per pixel for an accuracy, from pilots that grow until one is about an eighth of the work it foresees.
    fn needed_paths(&self, pass: &mut Pass<'_>, target: f64, watch: &dyn Watch) -> Result<u64> {
        let pixels = (pass.resolution[0] * pass.resolution[1]) as u64;
        pass.paths = FORESEEING_PATHS.div_ceil(pixels).max(2);
        let mut needed = pass.paths;
        for round in 1..MAX_PILOTS {
            pass.round = round;
            let pilot = self.pass(pass, watch)?;
            let worst = pilot
                .iter()
                .map(|p| p[0].relative_error())
                .fold(0.0, f64::max);
            needed = (pass.paths as f64 * (worst / target).powi(2)).ceil() as u64;
            needed = needed.max(2);
            if 9 * pass.paths >= needed {
                break;
            }
            pass.paths = (needed / 8).max(2);
        }
        Ok(needed)
    }

    /// Renders all pixels: per member of the group, the radiance and the derivatives.
    fn pass(&self, pass: &Pass<'_>, watch: &dyn Watch) -> Result<Vec<Vec<Layer>>> {
        let pixels = pass.resolution[0] * pass.resolution[1];
        let layers = 1 + pass.rows.len();
        let numbers = self.group.members.len() * layers * CHANNELS;
        let per_task = (2048 / pass.paths).clamp(1, 64) as usize;
        let strata = strata((pass.paths / 2).min(MOST_STRATA));
        let done = AtomicU64::new(0);
        let mut all: Vec<Number> = vec![[0.0; 2]; numbers * pixels];
        all.par_chunks_mut(numbers * per_task)
            .enumerate()
            .try_for_each(|(task, chunk)| {
                let rules = Rules {
                    lamps: &self.group.lamps,
                    worth: pass.worth,
                    guide: &Guide::FRESH,
                };
                for (i, out) in chunk.chunks_mut(numbers).enumerate() {
                    self.pixel(pass, &rules, task * per_task + i, &strata, out, watch)?;
                }
                let n = (chunk.len() / numbers) as u64;
                let finished = done.fetch_add(n, Ordering::Relaxed) + n;
                let [part, parts] = self.parts;
                let total = pixels as u64;
                watch.progress(pass.name, part * total + finished, parts * total);
                Ok(())
            })?;
        let layer = |first: usize| {
            let take = |k: usize| {
                let of_pixel = |p: &[Number]| std::array::from_fn(|c| p[first + c][k]);
                all.chunks(numbers).map(of_pixel).collect()
            };
            Layer {
                value: take(0),
                standard_error: take(1),
            }
        };
        let of_member = |m: usize| {
            (0..layers)
                .map(|l| layer((m * layers + l) * CHANNELS))
                .collect()
        };
        Ok((0..self.group.members.len()).map(of_member).collect())
    }

    /// Estimates one pixel. Its strata have equal areas and two or more paths each, so that the scatter inside them tells
    /// the standard error without bias: variance = sum of s^2 / m over the strata, over their number squared.
    fn pixel(
        &self,
        pass: &Pass<'_>,
        rules: &Rules<'_>,
        index: usize,
        strata: &[Rectangle],
        out: &mut [Number],
        watch: &dyn Watch,
    ) -> Result<()> {
        let all_rows = match pass.rows {
            [] => Rows::NONE,
            _ => self.rows,
        };
        let view = self.followed.options().view;
        let n_strata = strata.len() as u64;
        let mut random = Random::keyed(&self.key(pass, index));
        let mut path = Summation::new(all_rows, self.group.lamps.len());
        let mut totals = vec![[0.0_f64; 2]; out.len()];
        let mut inside = vec![Running::default(); out.len()];
        let mut since_look = 0;
        for (j, stratum) in strata.iter().enumerate() {
            inside.fill(Running::default());
            let paths = pass.paths / n_strata + u64::from((j as u64) < pass.paths % n_strata);
            for _ in 0..paths {
                since_look += 1;
                if since_look % PATHS_PER_LOOK == 1 && watch.cancelled() {
                    return Err(Error::new("interrupted"));
                }
                let through = self.point(pass.resolution, index, stratum, &mut random);
                let ray = CameraRay {
                    through,
                    toward_camera: view.toward_camera(through, self.group.toward_camera),
                };
                path.lamps.fill(Sums::default());
                self.followed.follow(rules, ray, &mut random, &mut path);
                let found = path
                    .lamps
                    .iter()
                    .flat_map(|sums| numbers_of(sums, pass.rows));
                for (number, x) in inside.iter_mut().zip(found) {
                    number.push(x);
                }
            }
            for (total, number) in totals.iter_mut().zip(&inside) {
                total[0] += number.mean();
                total[1] += number.variance() / number.count() as f64;
            }
        }
        let count = n_strata as f64;
        for (place, [mean, variance]) in out.iter_mut().zip(totals) {
            if !(mean.is_finite() && variance.is_finite()) {
                return Err(self.not_finite(index, [mean / count, variance]));
            }
            *place = [(mean / count) as f32, (variance.sqrt() / count) as f32];
        }
        Ok(())
    }

    fn key(&self, pass: &Pass<'_>, pixel: usize) -> [u64; 5] {
        let first = self.request.configurations[self.group.members[0]].id;
        [
            self.request.seed,
            STREAM,
            pass.round,
            u64::from(first),
            pixel as u64,
        ]
    }

    /// A uniform point of a stratum of a pixel, on the sample plane.
    fn point(
        &self,
        [nx, ny]: [usize; 2],
        index: usize,
        stratum: &Rectangle,
        random: &mut Random,
    ) -> DVec3 {
        let [u, v] = stratum.map(|[low, length]| low + length * random.uniform());
        let Region { center, size } = self.request.region;
        let x = ((index % nx) as f64 + u) / nx as f64 - 0.5;
        let y = 0.5 - ((index / nx) as f64 + v) / ny as f64;
        DVec3::new(center[0] + x * size[0], center[1] + y * size[1], 0.0)
    }

    fn not_finite(&self, pixel: usize, [mean, variance]: [f64; 2]) -> Error {
        let ids = self
            .group
            .members
            .iter()
            .map(|&m| self.request.configurations[m].id);
        Error::new(format!(
            "pixel {pixel} of configurations {:?} is not finite (mean {mean}, variance {variance}) at {}",
            ids.collect::<Vec<_>>(),
            self.request.parameters.to_json()
        ))
        .with_hint("this is a fault of the model at these parameters; please report it with the parameters")
    }
}

/// A path's radiance and the derivatives by `rows`, channel by channel.
fn numbers_of<'a>(sums: &'a Sums, rows: &'a [usize]) -> impl Iterator<Item = f64> + 'a {
    let derivatives = rows.iter().flat_map(|&row| sums.derivative[row]);
    sums.value.into_iter().chain(derivatives)
}

/// Lower end and length along x and along y, of a unit square.
type Rectangle = [[f64; 2]; 2];

/// Divides the unit square into `n` rectangles of equal area, nearly squares.
fn strata(n: u64) -> Vec<Rectangle> {
    let n = n.max(1);
    let bands = (n as f64).sqrt().round().max(1.0) as u64;
    let mut low = 0;
    let mut strata = Vec::new();
    for band in 0..bands {
        let count = n / bands + u64::from(band < n % bands);
        let vertical = [low as f64 / n as f64, count as f64 / n as f64];
        let width = 1.0 / count as f64;
        strata.extend((0..count).map(|k| [[k as f64 * width, width], vertical]));
        low += count;
    }
    strata
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strata_have_equal_areas_and_cover_the_square_once() {
        for n in [1, 2, 3, 7, 16, 50, 97] {
            let all = strata(n);
            assert_eq!(all.len() as u64, n);
            for [[_, w], [_, h]] in &all {
                assert!((w * h * n as f64 - 1.0).abs() < 1e-12, "{n}: {w} x {h}");
            }
            // Every point of a grid that avoids the edges lies in exactly one of them.
            for k in 0..400 {
                let point = [
                    (k % 20) as f64 / 20.0 + 0.0213,
                    (k / 20) as f64 / 20.0 + 0.0171,
                ];
                let within = |r: &&Rectangle| {
                    (0..2).all(|a| (r[a][0]..r[a][0] + r[a][1]).contains(&point[a]))
                };
                assert_eq!(all.iter().filter(within).count(), 1, "{n}: {point:?}");
            }
        }
    }
}
