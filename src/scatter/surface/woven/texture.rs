//! The texture of woven cloth (Irawan 2008 sec. 8.2): the highlight of every segment as a band across it.
//!
//! For flat pictures from afar to a few pixels per yarn; the inside of a yarn has no structure here. The mean over one repeat is
//! the BRDF: a segment's texture has the mean f_j over its rectangle, which is counted n_j times per area, so that its strength is
//! `k_s / (w l)` where the BRDF has `k_s n_j`. Rectangles must not overlap for that.

use super::segment::Segment;
use super::shape::Shape;
use super::{Layout, SegmentType, segment_frame};
use crate::base::{Error, Result};
use crate::math::Random;
use crate::scatter::CHANNELS;
use glam::DVec3;
use std::f64::consts::FRAC_1_PI;

/// A visible segment and where it is in the repeat.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placed {
    /// 0: warp, along y; 1: weft, along x.
    pub system: usize,
    /// Middle of its rectangle, millimeters.
    pub center: [f64; 2],
    /// Across the yarn, millimeters.
    pub width: f64,
    /// Along the yarn, millimeters.
    pub length: f64,
}

/// The visible segments of one repeat of a weave with their places.
#[derive(Debug, Clone, PartialEq)]
pub struct Repeat {
    /// Along x and y, millimeters.
    pub size: [f64; 2],
    /// Segments; a rectangle may reach over the repeat's edge and comes in again at the other side.
    pub segments: Vec<Placed>,
}

impl Repeat {
    /// The segments by type, for the BRDF.
    ///
    /// # Errors
    /// As [`Layout::new`].
    pub fn layout(&self) -> Result<Layout> {
        let mut types: Vec<SegmentType> = Vec::new();
        for s in &self.segments {
            let same = |t: &&mut SegmentType| {
                t.system == s.system
                    && (t.width - s.width).abs() < 1e-9
                    && (t.length - s.length).abs() < 1e-9
            };
            match types.iter_mut().find(same) {
                Some(t) => t.count += 1.0,
                None => types.push(SegmentType {
                    system: s.system,
                    width: s.width,
                    length: s.length,
                    count: 1.0,
                }),
            }
        }
        Layout::new(types, self.size[0] * self.size[1])
    }
}

/// Irregular brightness of the fibers (Irawan 2008 sec. 8.2.1): a factor with exponential distribution and mean 1, constant over
/// cells of a segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Noise {
    /// Cells along and across each segment.
    pub cells: u32,
    /// The same seed gives the same cloth.
    pub seed: u64,
}

/// The look of one yarn system.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct YarnLook {
    /// Width and length are those of each segment and not read here.
    pub shape: Shape,
    /// Specular coefficient, as in the BRDF weighed by the number of segments per area.
    pub k_s: [f64; CHANNELS],
}

/// A cloth with places.
#[derive(Debug, Clone)]
pub struct Texture {
    repeat: Repeat,
    /// The same order as the repeat's.
    segments: Vec<Segment>,
    looks: [YarnLook; 2],
    k_d: [f64; CHANNELS],
    share: f64,
    noise: Option<Noise>,
}

impl Texture {
    /// The texture with highlight bands that take `share` of a segment, 0 to 1 (0.5 in the published fabrics).
    ///
    /// # Errors
    /// A share outside (0, 1], a repeat without a size, or as [`Shape::check`].
    pub fn new(
        repeat: Repeat,
        k_d: [f64; CHANNELS],
        looks: [YarnLook; 2],
        share: f64,
        noise: Option<Noise>,
    ) -> Result<Self> {
        if !(1e-3..=1.0).contains(&share) {
            return Err(Error::new(format!(
                "texture: a highlight width of {share}, expected 0.001 to 1 of a segment"
            ))
            .with_hint("0.5 is the width in the published fabrics"));
        }
        repeat.layout()?;
        let segment = |p: &Placed| {
            Segment::new(Shape {
                width: p.width,
                length: p.length,
                ..looks[p.system].shape
            })
        };
        let segments = repeat.segments.iter().map(segment).collect::<Result<_>>()?;
        Ok(Self {
            repeat,
            segments,
            looks,
            k_d,
            share,
            noise,
        })
    }

    /// The BRDF at the place `(x, y)` of the cloth, millimeters, per channel, 1/sr. Between segments only the diffuse part is left.
    pub fn value(&self, wi: DVec3, wr: DVec3, (x, y): (f64, f64)) -> [f64; CHANNELS] {
        if wi.z <= 0.0 || wr.z <= 0.0 {
            return [0.0; CHANNELS];
        }
        let diffuse = self.k_d.map(|k| k * FRAC_1_PI);
        let Some((index, copy, offset)) = self.find(x, y) else {
            return diffuse;
        };
        let placed = &self.repeat.segments[index];
        // In the segment's frame: y along the yarn.
        let at = segment_frame(placed.system, DVec3::new(offset[0], offset[1], 0.0));
        let [i, r] = [wi, wr].map(|w| segment_frame(placed.system, w));
        let bright = self.segments[index].texture(i, r, (at.x, at.y), self.share);
        let scale = bright * self.factor(index, copy, at) / (placed.width * placed.length);
        std::array::from_fn(|c| diffuse[c] + self.looks[placed.system].k_s[c] * scale)
    }

    /// The segment under a place, which copy of the repeat it belongs to, and the place from its middle.
    fn find(&self, x: f64, y: f64) -> Option<(usize, [i64; 2], [f64; 2])> {
        let [w, h] = self.repeat.size;
        self.repeat.segments.iter().enumerate().find_map(|(k, s)| {
            let copy = [
                ((x - s.center[0]) / w).round(),
                ((y - s.center[1]) / h).round(),
            ];
            let offset = [x - s.center[0] - copy[0] * w, y - s.center[1] - copy[1] * h];
            let half = match s.system {
                0 => [0.5 * s.width, 0.5 * s.length],
                _ => [0.5 * s.length, 0.5 * s.width],
            };
            let inside = offset[0].abs() <= half[0] && offset[1].abs() <= half[1];
            inside.then(|| (k, copy.map(|c| c as i64), offset))
        })
    }

    /// The noise at a place of a segment.
    fn factor(&self, index: usize, copy: [i64; 2], at: DVec3) -> f64 {
        let Some(Noise { cells, seed }) = self.noise else {
            return 1.0;
        };
        let placed = &self.repeat.segments[index];
        let cell = |x: f64, extent: f64| ((x / extent + 0.5) * f64::from(cells)).floor() as i64;
        let key = [
            seed,
            index as u64,
            copy[0].cast_unsigned(),
            copy[1].cast_unsigned(),
            cell(at.x, placed.width).cast_unsigned(),
            cell(at.y, placed.length).cast_unsigned(),
        ];
        -Random::keyed(&key).uniform_open().ln()
    }
}
