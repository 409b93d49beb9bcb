//! A shaded picture of fibers: the tile seen from above, and below it a cut across the middle.
//!
//! For the eye only: plain diffuse shading from the upper left, no shadows, no scattering model.

use super::png_file;
use crate::base::{Error, Result};
use glam::DVec3;
use image::{Rgb, RgbImage};

/// One fiber to draw.
#[derive(Debug, Clone)]
pub struct Line {
    /// Points along the axis, millimeters.
    pub points: Vec<DVec3>,
    /// Radius, millimeters.
    pub radius: f64,
    /// Index into the palette (warp, weft, others).
    pub group: usize,
}

const PALETTE: [[f64; 3]; 4] = [
    [0.36, 0.55, 0.80],
    [0.88, 0.68, 0.42],
    [0.55, 0.72, 0.50],
    [0.72, 0.58, 0.74],
];
const BACKGROUND: Rgb<u8> = Rgb([24, 24, 28]);
const GAP: u32 = 12;

/// How a view maps the world: unit vectors to the right, up and toward the eye.
struct View {
    right: DVec3,
    up: DVec3,
    toward: DVec3,
    origin: DVec3,
    /// The view repeats upward too (it always repeats to the right).
    repeats_up: bool,
    /// Period along `toward`, and the fibers are cut at depth 0.
    cut: Option<f64>,
}

/// A PNG of the periodic tile of `size` millimeters, `width` pixels wide.
///
/// Above: seen from +z, x to the right, y up. Below: cut in the middle of the tile's y, seen along +y, x to the right,
/// z up, cut fibers bright; the same scale.
///
/// # Errors
/// There is nothing to draw, `width` is outside 16..=8192, or the picture would be taller than 16384 pixels.
pub fn picture(lines: &[Line], size: [f64; 2], width: u32) -> Result<Vec<u8>> {
    if !(16..=8192).contains(&width) {
        return Err(Error::new(format!(
            "picture width {width}: expected 16 to 8192 pixels"
        )));
    }
    let heights = lines.iter().flat_map(|l| {
        l.points
            .iter()
            .flat_map(|p| [p.z - l.radius, p.z + l.radius])
    });
    let (low, high) = heights.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), z| {
        (a.min(z), b.max(z))
    });
    if low >= high {
        return Err(Error::new("no fibers to draw"));
    }
    let scale = f64::from(width) / size[0];
    let pixels = |length: f64| (length * scale).ceil().max(1.0);
    if pixels(size[1]) + pixels(high - low) > 16384.0 {
        return Err(Error::new("the picture would be taller than 16384 pixels")
            .with_hint("a smaller width"));
    }
    let top = View {
        right: DVec3::X,
        up: DVec3::Y,
        toward: DVec3::Z,
        origin: DVec3::ZERO,
        repeats_up: true,
        cut: None,
    };
    let side = View {
        right: DVec3::X,
        up: DVec3::Z,
        toward: -DVec3::Y,
        origin: DVec3::new(0.0, 0.5 * size[1], low),
        repeats_up: false,
        cut: Some(size[1]),
    };
    let above = draw(
        lines,
        &top,
        scale,
        [width, pixels(size[1]) as u32],
        high - low,
    );
    let below = draw(
        lines,
        &side,
        scale,
        [width, pixels(high - low) as u32],
        size[1],
    );
    let mut whole = RgbImage::from_pixel(
        width,
        above.height() + GAP + below.height(),
        Rgb([255, 255, 255]),
    );
    image::imageops::replace(&mut whole, &above, 0, 0);
    image::imageops::replace(&mut whole, &below, 0, i64::from(above.height() + GAP));
    png_file::encode(&whole, &[])
}

/// Draws all lines with a depth buffer; `range` is the depth over which colors darken.
fn draw(lines: &[Line], view: &View, scale: f64, size: [u32; 2], range: f64) -> RgbImage {
    let mut image = RgbImage::from_pixel(size[0], size[1], BACKGROUND);
    let mut depth = vec![f64::NEG_INFINITY; (size[0] * size[1]) as usize];
    let nearest = if view.cut.is_some() {
        0.0
    } else {
        lines
            .iter()
            .flat_map(|l| l.points.iter().map(|p| p.z))
            .fold(f64::NEG_INFINITY, f64::max)
    };
    for line in lines {
        for pair in line.points.windows(2) {
            let mut mark = |x: i64, y: i64, at: f64, shade: f64| {
                let x = x.rem_euclid(size[0].into()) as u32;
                let y = if view.repeats_up {
                    y.rem_euclid(size[1].into()) as u32
                } else if (0..i64::from(size[1])).contains(&y) {
                    y as u32
                } else {
                    return;
                };
                let index = (y * size[0] + x) as usize;
                if at > depth[index] {
                    depth[index] = at;
                    let dim = shade * (1.0 - 0.6 * ((nearest - at) / range).clamp(0.0, 1.0));
                    let color = PALETTE[line.group % PALETTE.len()].map(|c| {
                        let encoded = (c * dim).clamp(0.0, 1.0).powf(1.0 / 2.2);
                        (255.0 * encoded) as u8
                    });
                    image.put_pixel(x, size[1] - 1 - y, Rgb(color));
                }
            };
            segment(view, scale, [pair[0], pair[1]], line.radius, &mut mark);
        }
    }
    image
}

/// Visits the pixels a capsule covers with depth and shade.
fn segment(
    view: &View,
    scale: f64,
    ends: [DVec3; 2],
    radius: f64,
    mark: &mut impl FnMut(i64, i64, f64, f64),
) {
    let [a, b] = ends.map(|p| {
        let p = p - view.origin;
        DVec3::new(p.dot(view.right), p.dot(view.up), p.dot(view.toward))
    });
    let direction = b - a;
    let flat = direction.truncate();
    let low = (a.truncate().min(b.truncate()) - radius) * scale;
    let high = (a.truncate().max(b.truncate()) + radius) * scale;
    for y in low.y.floor() as i64..=high.y.floor() as i64 {
        for x in low.x.floor() as i64..=high.x.floor() as i64 {
            let p = glam::DVec2::new(x as f64 + 0.5, y as f64 + 0.5) / scale;
            let t = if flat.length_squared() > 0.0 {
                ((p - a.truncate()).dot(flat) / flat.length_squared()).clamp(0.0, 1.0)
            } else {
                0.5
            };
            let axis = a + direction * t;
            let across = p - axis.truncate();
            let rest = radius * radius - across.length_squared();
            if rest < 0.0 {
                continue;
            }
            let bulge = rest.sqrt();
            let normal = DVec3::new(across.x, across.y, bulge) / radius;
            let light = DVec3::new(-0.4, 0.5, 0.77);
            let shade = 0.25 + 0.75 * normal.dot(light).max(0.0);
            match view.cut {
                None => mark(x, y, axis.z + bulge, shade),
                Some(period) => {
                    // Depth 0 is the cut; the nearest copy behind it, or cut through by it.
                    let at = axis.z - bulge;
                    let back = at - period * (at / period).ceil();
                    if back + 2.0 * bulge >= 0.0 {
                        mark(x, y, 0.0, 1.3);
                    } else {
                        mark(x, y, back + 2.0 * bulge, shade);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(y: f64, group: usize) -> Line {
        Line {
            points: vec![DVec3::new(0.0, y, 0.0), DVec3::new(1.0, y, 0.0)],
            radius: 0.1,
            group,
        }
    }

    #[test]
    fn fibers_appear_where_they_are_and_wrap_around() {
        let png = picture(&[line(0.25, 0), line(1.0, 1)], [1.0, 1.0], 100).unwrap();
        let image = image::load_from_memory(&png).unwrap().to_rgb8();
        assert_eq!(image.dimensions(), (100, 100 + GAP + 20));
        let drawn = |x, y| *image.get_pixel(x, y) != BACKGROUND;
        assert!(drawn(50, 74) && drawn(50, 1) && drawn(50, 98));
        assert!(!drawn(50, 50) && !drawn(50, 88));
        // Blue warp, orange weft.
        let (warp, weft) = (image.get_pixel(50, 74), image.get_pixel(50, 1));
        assert!(warp[2] > warp[0] && weft[0] > weft[2]);
        assert!(picture(&[], [1.0, 1.0], 100).is_err());
        assert!(picture(&[line(0.2, 0)], [1.0, 1.0], 0).is_err());
    }
}
