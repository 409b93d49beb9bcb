//! The reflectance of woven cloth (Irawan 2008; Irawan and Marschner 2012): yarn segments whose twisted fibers reflect like mirrors
//! along a line.
//!
//! ```text
//! f(wi, wr) = k_d/pi + sum_j k_s,j n_j f_j(wi, wr)        f_j = int G f_c A, mm^2/rad, one segment of type j
//! ```
//!
//! n_j is the number of segments of type j per area of cloth, 1/mm^2. With it `k_s` is a pure number that means the same on
//! coarse and fine cloth; Irawan 2008 leaves n_j to k_s, see [`Weights`]. Not in the model: shadowing and masking between segments, light
//! that goes from yarn to yarn, transmission.

mod highlight;
mod kinks;
mod presets;
mod published;
mod segment;
mod shape;
mod texture;

pub use presets::{PRESETS, Preset, UNIT_MM, preset};
pub use published::Glint;
pub use segment::{Estimate, Quality, Segment, TOLERANCE};
pub use shape::{Phase, SHAPE_ROWS, Shape, Spine};
pub use texture::{Noise, Placed, Repeat, Texture, YarnLook};

use super::lambert::DIFFUSE;
use super::{
    MAX_SURFACE_ROWS, Surface, SurfaceEvaluation, SurfaceModel, above, check, coefficient, scalar,
};
use crate::base::{Error, Result};
use crate::scatter::{CHANNELS, ParameterInfo, Parameters, Parametric, Unit, YARN_SYSTEMS};
use glam::DVec3;
use std::f64::consts::FRAC_1_PI;

/// A kind of visible yarn segment of a cloth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SegmentType {
    /// 0: warp, along y; 1: weft, along x.
    pub system: usize,
    /// Across the yarn, millimeters.
    pub width: f64,
    /// Along the yarn, millimeters.
    pub length: f64,
    /// How many there are in one repeat.
    pub count: f64,
}

/// How the segments of a cloth are weighed: the conventions of k_s that are in use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Weights {
    /// By their number per area: k_s is a pure number. The convention of parameter files here.
    #[default]
    Count,
    /// By the share of the cloth that they cover, as the mean of a texture does: k_s in 1/mm^2, larger by 1/(w l).
    Area,
    /// Not at all, as in Irawan 2008 sec. 8.3: k_s in 1/mm^2 has the shares within it.
    Sum,
}

/// The visible segments of one repeat of a weave.
#[derive(Debug, Clone, PartialEq)]
pub struct Layout {
    types: Vec<SegmentType>,
    /// Of one repeat, mm^2.
    area: f64,
    weights: Weights,
    smoothing: f64,
}

impl Layout {
    /// Segments in a repeat of `area` mm^2; yarns may cover less than the cloth, or overlap.
    ///
    /// # Errors
    /// None, or a number that is not positive, or an unknown yarn system.
    pub fn new(types: Vec<SegmentType>, area: f64) -> Result<Self> {
        let positive = |x: f64| (1e-6..=1e6).contains(&x);
        let good = |t: &SegmentType| {
            t.system < YARN_SYSTEMS.len()
                && positive(t.width)
                && positive(t.length)
                && positive(t.count)
        };
        if types.is_empty() || !types.iter().all(good) || !positive(area) {
            return Err(Error::new(format!(
                "segments of a weave: expected at least one, with positive widths, lengths, counts and area, found {types:?} in \
                 {area} mm^2"
            ))
            .with_hint("lengths are millimeters; yarn system 0 is the warp, 1 the weft"));
        }
        Ok(Self {
            types,
            area,
            weights: Weights::Count,
            smoothing: 0.0,
        })
    }

    /// A plain weave of equal yarns at this distance, millimeters: one warp and one weft segment per two crossings.
    ///
    /// # Errors
    /// As [`Layout::new`].
    pub fn plain(pitch: f64) -> Result<Self> {
        let one = |system| SegmentType {
            system,
            width: pitch,
            length: pitch,
            count: 2.0,
        };
        Self::new(vec![one(0), one(1)], 4.0 * pitch * pitch)
    }

    /// The same with another convention of k_s.
    #[must_use]
    pub fn with_weights(mut self, weights: Weights) -> Self {
        self.weights = weights;
        self
    }

    /// The same with filament smoothing, 0 to 1 (Irawan 2008 sec. 9.3: 0 for staple, 0.5 for filament yarns).
    #[must_use]
    pub fn with_smoothing(mut self, smoothing: f64) -> Self {
        self.smoothing = smoothing;
        self
    }

    /// The segments.
    pub fn types(&self) -> &[SegmentType] {
        &self.types
    }

    /// What the integral of one segment of this type is multiplied by, beside k_s.
    pub fn weight(&self, t: &SegmentType) -> f64 {
        let per_area = t.count / self.area;
        match self.weights {
            Weights::Count => per_area,
            Weights::Area => per_area * t.width * t.length,
            Weights::Sum => 1.0,
        }
    }
}

/// Which parameters a woven model has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rung {
    /// `woven-9`: all yarns alike, circular spines, uniform scattering 0.01.
    Nine,
    /// `woven-11`: all yarns alike.
    Eleven,
    /// `woven-19`: warp and weft apart.
    Nineteen,
}

/// All rungs, from simple to rich.
pub const RUNGS: [Rung; 3] = [Rung::Nine, Rung::Eleven, Rung::Nineteen];

const fn angle(
    name: &'static str,
    lower_deg: f64,
    upper_deg: f64,
    default_deg: f64,
) -> ParameterInfo {
    ParameterInfo {
        name,
        per_channel: false,
        unit: Unit::Angle,
        lower: lower_deg.to_radians(),
        upper: upper_deg.to_radians(),
        default: default_deg.to_radians(),
    }
}

/// Ranges: Irawan 2008, Table 8.1 (typical values), wider for forward and uniform scattering, where fits end on them; defaults sec. 9.3.
macro_rules! yarn {
    ($prefix:literal) => {
        [
            coefficient(concat!($prefix, "k_s"), 100.0, 10.0),
            angle(concat!($prefix, "twist"), -90.0, 90.0, -30.0),
            angle(concat!($prefix, "inclination"), 1.0, 85.0, 30.0),
            scalar(concat!($prefix, "curvature"), -0.95, 10.0, 0.0),
            scalar(concat!($prefix, "uniform"), 0.0, 1.0, 0.01),
            scalar(concat!($prefix, "forward"), 0.0, 20.0, 4.0),
        ]
    };
}

const ALL: [ParameterInfo; 6] = yarn!("");
const WARP: [ParameterInfo; 6] = yarn!("warp_");
const WEFT: [ParameterInfo; 6] = yarn!("weft_");

const NINE: &[ParameterInfo] = &[DIFFUSE, ALL[0], ALL[1], ALL[2], ALL[5]];
const ELEVEN: &[ParameterInfo] = &[DIFFUSE, ALL[0], ALL[1], ALL[2], ALL[3], ALL[4], ALL[5]];
const NINETEEN: &[ParameterInfo] = &[
    DIFFUSE, WARP[0], WARP[1], WARP[2], WARP[3], WARP[4], WARP[5], WEFT[0], WEFT[1], WEFT[2],
    WEFT[3], WEFT[4], WEFT[5],
];

/// The rows of a yarn system: k_s, then those of twist, inclination, curvature, uniform and forward scattering that there are.
#[derive(Debug, Clone, Copy)]
struct Rows {
    specular: usize,
    shape: [Option<usize>; 5],
}

impl Rung {
    fn parameters(self) -> &'static [ParameterInfo] {
        match self {
            Self::Nine => NINE,
            Self::Eleven => ELEVEN,
            Self::Nineteen => NINETEEN,
        }
    }

    fn rows(self, system: usize) -> Rows {
        let five = |first: usize| std::array::from_fn(|k| Some(first + k));
        match self {
            Self::Nine => Rows {
                specular: 1,
                shape: [Some(2), Some(3), None, None, Some(4)],
            },
            Self::Eleven => Rows {
                specular: 1,
                shape: five(2),
            },
            Self::Nineteen => Rows {
                specular: 1 + 6 * system,
                shape: five(2 + 6 * system),
            },
        }
    }
}

/// The models `woven-9`, `woven-11` and `woven-19`; the sizes of the segments belong to the cloth and are no parameters.
#[derive(Debug, Clone)]
pub struct Woven {
    rung: Rung,
    layout: Layout,
    quality: Quality,
}

impl Woven {
    /// The model for a cloth with these segments, at the quality for fits.
    pub fn new(rung: Rung, layout: Layout) -> Self {
        Self {
            rung,
            layout,
            quality: Quality::Fit,
        }
    }

    /// The same with another way to integrate.
    #[must_use]
    pub fn with_quality(mut self, quality: Quality) -> Self {
        self.quality = quality;
        self
    }

    /// The shape of a type of segment at `parameters`.
    fn shape(&self, t: &SegmentType, parameters: &Parameters) -> Shape {
        let infos = self.rung.parameters();
        let row = |k: usize, default: f64| {
            let row = self.rung.rows(t.system).shape[k];
            row.map_or(default, |r| parameters.scalar(infos[r].name))
        };
        Shape {
            twist: row(0, ALL[1].default),
            inclination: row(1, ALL[2].default),
            curvature: row(2, ALL[3].default),
            uniform: row(3, ALL[4].default),
            forward: row(4, ALL[5].default),
            smoothing: self.layout.smoothing,
            width: t.width,
            length: t.length,
        }
    }
}

impl Parametric for Woven {
    fn name(&self) -> &'static str {
        match self.rung {
            Rung::Nine => "woven-9",
            Rung::Eleven => "woven-11",
            Rung::Nineteen => "woven-19",
        }
    }

    fn parameters(&self) -> &'static [ParameterInfo] {
        self.rung.parameters()
    }
}

impl SurfaceModel for Woven {
    fn prepare(&self, parameters: &Parameters) -> Result<Box<dyn Surface>> {
        let infos = self.parameters();
        let color = |row: usize| {
            let values = parameters.channels(infos[row].name);
            check(self.name(), &infos[row], values, 0.0, 1e9)
        };
        let mut yarns = Vec::new();
        for t in self.layout.types() {
            let rows = self.rung.rows(t.system);
            yarns.push(Yarn {
                system: t.system,
                segment: Segment::new(self.shape(t, parameters))?,
                weight: self.layout.weight(t),
                rows,
                k_s: color(rows.specular)?,
            });
        }
        Ok(Box::new(Cloth {
            k_d: color(0)?,
            yarns,
            quality: self.quality,
        }))
    }
}

/// The direction `w` in the frame of a segment of this yarn system: y along the yarn.
#[inline]
pub fn segment_frame(system: usize, w: DVec3) -> DVec3 {
    if system == 0 {
        w
    } else {
        DVec3::new(-w.y, w.x, w.z)
    }
}

/// A type of segment at fixed parameters.
struct Yarn {
    system: usize,
    segment: Segment,
    weight: f64,
    rows: Rows,
    k_s: [f64; CHANNELS],
}

/// Woven cloth at fixed parameters.
struct Cloth {
    k_d: [f64; CHANNELS],
    yarns: Vec<Yarn>,
    quality: Quality,
}

impl Surface for Cloth {
    fn value(&self, wi: DVec3, wr: DVec3) -> [f64; CHANNELS] {
        if !above(wi, wr) {
            return [0.0; CHANNELS];
        }
        let mut value = self.k_d.map(|k| k * FRAC_1_PI);
        for yarn in &self.yarns {
            let [i, r] = [wi, wr].map(|w| segment_frame(yarn.system, w));
            let f = yarn.weight * yarn.segment.value(i, r, self.quality);
            (0..CHANNELS).for_each(|c| value[c] += yarn.k_s[c] * f);
        }
        value
    }

    fn evaluate(&self, wi: DVec3, wr: DVec3) -> SurfaceEvaluation {
        let mut e = SurfaceEvaluation::zero();
        if !above(wi, wr) {
            return e;
        }
        e.value = self.k_d.map(|k| k * FRAC_1_PI);
        e.derivative[0] = [FRAC_1_PI; CHANNELS];
        for yarn in &self.yarns {
            let [i, r] = [wi, wr].map(|w| segment_frame(yarn.system, w));
            let (f, slopes) = yarn.segment.slopes(i, r, self.quality);
            for c in 0..CHANNELS {
                e.value[c] += yarn.k_s[c] * yarn.weight * f;
                e.derivative[yarn.rows.specular][c] += yarn.weight * f;
                for (row, slope) in yarn.rows.shape.iter().zip(slopes) {
                    if let Some(row) = row {
                        e.derivative[*row][c] += yarn.k_s[c] * yarn.weight * slope;
                    }
                }
            }
        }
        e
    }

    fn colors(&self, wi: DVec3, wr: DVec3) -> [f64; MAX_SURFACE_ROWS] {
        let mut rows = [0.0; MAX_SURFACE_ROWS];
        if !above(wi, wr) {
            return rows;
        }
        rows[0] = FRAC_1_PI;
        for yarn in &self.yarns {
            let [i, r] = [wi, wr].map(|w| segment_frame(yarn.system, w));
            rows[yarn.rows.specular] += yarn.weight * yarn.segment.value(i, r, self.quality);
        }
        rows
    }
}
