//! What lies around the square: a ring outside against a band inside, in stretches along each side.

use super::Picture;
use super::planes::{Grown, Plane, robust};
use super::{Border, BorderEnd, CheckOptions};

/// Stretches per side.
const STRETCHES: usize = 4;
/// Width of the ring at most, pixels.
const WIDEST: f64 = 16.0;
/// A narrower ring does not tell.
const NARROWEST: f64 = 3.0;
/// Bands inside, to see how much the cloth itself varies.
const BANDS: usize = 3;
/// Times the scatter of the cloth's own bands, and times the noise.
const SCATTER: f64 = 6.0;

/// One side of the square: where it begins, unit vector along it, unit vector outward, length.
struct Side {
    start: [f64; 2],
    along: [f64; 2],
    out: [f64; 2],
    length: f64,
    /// Pixels of the picture beyond it.
    margin: f64,
    /// Of ring and bands, pixels.
    width: f64,
}

/// Sums of one band of one stretch: brightness over the mean, its variance from noise, values.
#[derive(Debug, Clone, Copy, Default)]
struct Band {
    sum: f64,
    variance: f64,
    count: f64,
}

impl Band {
    fn mean(&self) -> f64 {
        self.sum / self.count
    }
}

/// Ring (0) and bands inward (1, 2, 3) of one stretch, and the ring's box.
#[derive(Clone, Copy)]
struct Stretch {
    bands: [Band; BANDS + 1],
    ring: Grown,
}

/// Compares the ring around the square with the square next to it.
pub(super) fn border(picture: &Picture, planes: &[Plane], options: &CheckOptions) -> Border {
    let sides = sides(picture);
    let mut border = Border {
        margin_px: [0, 1, 2, 3].map(|k| sides.get(k).map_or(0, |s| s.margin.max(0.0) as usize)),
        too_small: sides.len() != 4 || sides.iter().any(|s| s.width < NARROWEST),
        ends: Vec::new(),
    };
    let empty = Stretch {
        bands: Default::default(),
        ring: Grown::empty(),
    };
    let mut all = vec![[empty; STRETCHES]; sides.len()];
    for plane in planes {
        gather(picture, plane, &sides, &mut all);
    }
    let all: Vec<Stretch> = all.into_iter().flatten().collect();
    // How much one band of the cloth differs from the next.
    let steps = all.iter().flat_map(|s| s.bands[1..].windows(2));
    let steps = steps.filter(|b| b[0].count > 0.0 && b[1].count > 0.0 && b[0].sum > 0.0);
    let steps: Vec<f32> = steps
        .map(|b| (b[1].mean() / b[0].mean() - 1.0) as f32)
        .collect();
    let scatter = robust(&steps).map_or(0.0, |(_, s)| f64::from(s));
    for stretch in &all {
        let [ring, inner, ..] = &stretch.bands;
        if ring.count < 8.0 || inner.count < 8.0 || inner.sum <= 0.0 {
            continue;
        }
        let change = ring.mean() / inner.mean() - 1.0;
        let noise = (ring.variance.sqrt() / ring.count).hypot(inner.variance.sqrt() / inner.count);
        let limit = (SCATTER * scatter)
            .max(SCATTER * noise / inner.mean())
            .max(options.border_limit);
        if change.abs() > limit
            && let Some(region) = stretch.ring.crop(picture)
        {
            border.ends.push(BorderEnd { region, change });
        }
    }
    border
}

fn sides(picture: &Picture) -> Vec<Side> {
    let corners: Vec<[f64; 2]> = picture
        .corners
        .iter()
        .map(|c| [0, 1].map(|k| c[k] - picture.origin[k] as f64))
        .collect();
    let n = corners.len();
    let twice_area: f64 = (0..n)
        .map(|k| cross(corners[k], corners[(k + 1) % n]))
        .sum();
    (0..n)
        .map(|k| {
            let (start, end) = (corners[k], corners[(k + 1) % n]);
            let length = (end[0] - start[0]).hypot(end[1] - start[1]);
            let along = [0, 1].map(|k| (end[k] - start[k]) / length);
            let out = [along[1], -along[0]].map(|o| o * twice_area.signum());
            let margin = margin(picture.size, start, end, out);
            let thickness = 0.5 * twice_area.abs() / length;
            let width = margin.min(WIDEST).min(thickness / (BANDS + 1) as f64);
            Side {
                start,
                along,
                out,
                length,
                margin,
                width,
            }
        })
        .collect()
}

/// How far one can go outward from anywhere on the side before the picture ends.
fn margin(size: [usize; 2], start: [f64; 2], end: [f64; 2], out: [f64; 2]) -> f64 {
    let mut room = f64::MAX;
    for point in [start, end] {
        for k in 0..2 {
            let left = if out[k] > 0.0 {
                size[k] as f64 - point[k]
            } else {
                point[k]
            };
            if out[k].abs() > 1e-9 {
                room = room.min(left / out[k].abs());
            }
        }
    }
    room
}

fn gather(picture: &Picture, plane: &Plane, sides: &[Side], all: &mut [[Stretch; STRETCHES]]) {
    let mean = plane.mean();
    if mean <= 0.0 {
        return;
    }
    let per_pixel = picture.layout.values_per_pixel();
    let first = plane.channel.filter(|_| per_pixel == 3).unwrap_or(0);
    let widest = sides.iter().map(|s| s.width).fold(0.0, f64::max);
    let deepest = BANDS as f64 * widest;
    for y in 0..plane.height {
        let mut x = 0;
        while x < plane.width {
            let [px, py] = plane.pixel(x, y);
            let at = y * plane.width + x;
            x += 1;
            let pixel = py * picture.size[0] + px;
            let covered = picture.covered[pixel];
            if (covered > 0.0 && covered < 1.0) || !picture.kept[pixel * per_pixel + first] {
                continue;
            }
            let from = |s: &Side| [px as f64 + 0.5 - s.start[0], py as f64 + 0.5 - s.start[1]];
            // A pixel belongs to the side it is farthest beyond of, or nearest to from inside.
            let beyond = |s: &Side| dot(from(s), s.out);
            let nearest =
                (0..sides.len()).max_by(|a, b| beyond(&sides[*a]).total_cmp(&beyond(&sides[*b])));
            let Some(k) = nearest else {
                return;
            };
            let side = &sides[k];
            let distance = beyond(side);
            if distance > side.width {
                continue;
            }
            if distance < -deepest {
                // No pixel nearer than this can be nearer to any side than the bands reach.
                x += ((-distance - deepest) / plane.step as f64) as usize;
                continue;
            }
            if distance < -(BANDS as f64) * side.width {
                continue;
            }
            let place = dot(from(side), side.along) / side.length;
            if !(0.0..1.0).contains(&place) || side.width < NARROWEST {
                continue;
            }
            let stretch = &mut all[k][(place * STRETCHES as f64) as usize];
            let band = if distance > 0.0 {
                stretch.ring.add([px, py], 1);
                0
            } else {
                (1 + (-distance / side.width) as usize).min(BANDS)
            };
            let band = &mut stretch.bands[band];
            band.sum += f64::from(plane.values[at]) / mean;
            band.variance += (f64::from(plane.noise[at]) / mean).powi(2);
            band.count += 1.0;
        }
    }
}

fn dot(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[0] + a[1] * b[1]
}

fn cross(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[1] - a[1] * b[0]
}
