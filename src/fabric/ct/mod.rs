//! Micro-CT volumes: read from what scanners and their programs write, looked at, and prepared for finding fibers in them.
//!
//! A [`Volume`] knows its size and place and reads boxes of voxels from disk, in the scene's axes; nothing holds a volume
//! whole. [`prepare`] makes cloth lie flat, evenly bright, along the axes, and in cubic voxels (Zhao 2011 section 5; spec
//! of the method in docs/ct.md).

mod align;
mod axes;
mod coarse;
mod equalize;
mod fibers;
mod gaussian;
mod gray;
pub(in crate::fabric) mod header;
mod metaimage;
mod npy;
pub(in crate::fabric) mod nrrd;
mod numbering;
mod open;
mod orient;
mod prepare;
mod quadratic;
mod resample;
mod sample;
mod simulate;
mod slices;
mod statistics;
mod store;
mod tiff_stack;
mod tiling;

pub use axes::Axes;
pub use fibers::{FiberScore, FoundRadius, TraceReport, Tracing, compare, trace, transfer};
pub use gray::Gray;
pub use open::Reading;
pub use orient::{DensityChoice, Filter, Method, OrientReport, Orienting, orient};
pub use prepare::{Crop, PrepareReport, Preparing, prepare};
pub use sample::{Endian, SampleType, Unit};
pub use simulate::{Simulated, Simulating, simulate};
pub use slices::{Plane, slices};
pub use statistics::{Statistics, statistics};
pub use tiling::{Patch, SeamReport, tiled};

use crate::base::{Context, Error, Result, Watch};
use std::ops::Range;
use std::path::Path;
use store::Store;

/// A box of voxels.
#[derive(Debug, Clone, PartialEq)]
pub struct Block {
    /// The first voxel.
    pub low: [usize; 3],
    /// Voxels along x, y, z.
    pub dims: [usize; 3],
    /// Values, x fastest, then y.
    pub values: Vec<f32>,
}

/// A volume on disk. All its numbers are in the scene's axes: x along the weft, y along the warp, z up out of the cloth.
pub struct Volume {
    store: Store,
    /// Of the file's axes as a person counts them.
    axes: Axes,
    /// The same fastest first.
    stored: Axes,
    format: &'static str,
    sample: SampleType,
    voxel: [f64; 3],
    origin: [f64; 3],
    notes: Vec<String>,
}

impl Volume {
    /// Opens a volume: a folder of TIFF slices, a TIFF file of pages, NRRD, MetaImage or NPY.
    ///
    /// Packed voxels, and slices that must be read across, are first unpacked into the scratch folder.
    ///
    /// # Errors
    /// The file is of no known kind, damaged, cut off or empty; it states no voxel size, or one without a unit, and
    /// `reading` neither; the watch cancelled.
    pub fn open(path: &Path, reading: &Reading, watch: &dyn Watch) -> Result<Self> {
        open::open(path, reading, watch)
            .context(|| format!("volume {} cannot be used", path.display()))
    }

    /// Voxels along x, y, z.
    pub fn dims(&self) -> [usize; 3] {
        self.stored.to_scene(self.store.dims())
    }

    /// Size of a voxel along x, y, z, millimeters.
    pub fn voxel_mm(&self) -> [f64; 3] {
        self.voxel
    }

    /// Center of the first voxel, millimeters; 0 where the file states none.
    pub fn origin_mm(&self) -> [f64; 3] {
        self.origin
    }

    /// What the file's voxels are.
    pub fn sample(&self) -> SampleType {
        self.sample
    }

    /// What kind of file it is.
    pub fn format(&self) -> &'static str {
        self.format
    }

    /// Which scene axes the file's axes are.
    pub fn axes(&self) -> Axes {
        self.axes
    }

    /// What a person should know of how the file was understood.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// The size of its cubic voxels, millimeters.
    ///
    /// # Errors
    /// The voxels are not cubes (sides differ by more than 0.1 %).
    pub fn cubic_voxel_mm(&self) -> Result<f64> {
        let [x, y, z] = self.voxel;
        let largest = x.max(y).max(z);
        let smallest = x.min(y).min(z);
        if largest <= 1.001 * smallest {
            return Ok(smallest);
        }
        Err(Error::new(format!(
            "anisotropic voxels of {} um: expected cubes",
            sides_um(self.voxel)
        ))
        .with_hint("goniofit ct prepare resamples them"))
    }

    /// Reads the voxels from `low` up to but not including `high`.
    ///
    /// # Errors
    /// The box is not inside the volume, the file cannot be read, or a voxel is not a finite number.
    pub fn read(&self, low: [usize; 3], high: [usize; 3]) -> Result<Block> {
        let dims = self.dims();
        if (0..3).any(|k| low[k] >= high[k] || high[k] > dims[k]) {
            return Err(Error::new(format!(
                "voxels {low:?} to {high:?} of a volume of {dims:?}: expected a box inside it"
            )));
        }
        let sides = [0, 1, 2].map(|k| high[k] - low[k]);
        let (mut first, mut last) = ([0; 3], [0; 3]);
        for scene in 0..3 {
            let (file, backward) = self.stored.file_axis(scene);
            let n = dims[scene];
            (first[file], last[file]) = if backward {
                (n - high[scene], n - low[scene])
            } else {
                (low[scene], high[scene])
            };
        }
        let found = self.store.read(first, last)?;
        let values = if self.stored == Axes::SAME {
            found
        } else {
            self.turned(&found, sides)
        };
        if let Some(bad) = values.iter().position(|v| !v.is_finite()) {
            return Err(self.not_finite(values[bad], low, sides, bad));
        }
        Ok(Block {
            low,
            dims: sides,
            values,
        })
    }

    /// Reads whole layers of constant z.
    ///
    /// # Errors
    /// As [`Volume::read`].
    pub fn slab(&self, z: Range<usize>) -> Result<Block> {
        let [nx, ny, _] = self.dims();
        self.read([0, 0, z.start], [nx, ny, z.end])
    }

    /// Reads all layers from below, as many at a time as fit into `memory` bytes (at least one), telling progress as
    /// `stage`.
    ///
    /// # Errors
    /// As [`Volume::read`]; what `each` fails with; the watch cancelled.
    pub fn sweep(
        &self,
        memory: usize,
        stage: &str,
        watch: &dyn Watch,
        mut each: impl FnMut(&Block) -> Result<()>,
    ) -> Result<()> {
        let [nx, ny, nz] = self.dims();
        let layer = nx * ny * self.held_bytes();
        let layers = (memory / layer.max(1)).clamp(1, nz);
        for z in (0..nz).step_by(layers) {
            check_going_on(watch)?;
            let end = (z + layers).min(nz);
            each(&self.slab(z..end)?)?;
            watch.progress(stage, end as u64, nz as u64);
        }
        Ok(())
    }

    /// Warns when the bytes of raw voxels seem to be in the other order.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn byte_order_warning(&self) -> Result<Option<String>> {
        match &self.store {
            Store::Raw(raw) => raw.suspicion(),
            Store::Slices(_) => Ok(None),
        }
    }

    /// Bytes a voxel takes while it is read: as stored, as a number, and as a number in the scene's order.
    fn held_bytes(&self) -> usize {
        self.store.sample().bytes() + 8
    }

    /// The same volume, any box of which is read quickly.
    fn unpacked(self, scratch: &Path, watch: &dyn Watch) -> Result<Self> {
        Ok(Self {
            store: self.store.unpacked(scratch, watch)?,
            ..self
        })
    }

    /// From the file's order to the scene's.
    fn turned(&self, found: &[f32], sides: [usize; 3]) -> Vec<f32> {
        let mut file_sides = [0; 3];
        for scene in 0..3 {
            file_sides[self.stored.file_axis(scene).0] = sides[scene];
        }
        let strides = [1, file_sides[0], file_sides[0] * file_sides[1]];
        let place = |scene: usize, k: usize| {
            let (file, backward) = self.stored.file_axis(scene);
            strides[file] * if backward { sides[scene] - 1 - k } else { k }
        };
        let mut values = Vec::with_capacity(found.len());
        for z in 0..sides[2] {
            for y in 0..sides[1] {
                let row = place(2, z) + place(1, y);
                values.extend((0..sides[0]).map(|x| found[row + place(0, x)]));
            }
        }
        values
    }

    fn not_finite(&self, value: f32, low: [usize; 3], sides: [usize; 3], at: usize) -> Error {
        let place = [
            low[0] + at % sides[0],
            low[1] + at / sides[0] % sides[1],
            low[2] + at / (sides[0] * sides[1]),
        ];
        let swapped = matches!(self.byte_order_warning(), Ok(Some(_)));
        Error::new(format!(
            "voxel ({}, {}, {}) is {value}: expected a number",
            place[0], place[1], place[2]
        ))
        .with_hint(if swapped {
            "the byte order seems wrong: try --endian little or --endian big"
        } else {
            "write a number where the reconstruction has none (outside the field of view, say), or crop that away"
        })
    }
}

/// Fails when the watch cancelled.
fn check_going_on(watch: &dyn Watch) -> Result<()> {
    if watch.cancelled() {
        return Err(Error::new("interrupted"));
    }
    Ok(())
}

/// Sides of a voxel for a message, in micrometers.
fn sides_um(voxel: [f64; 3]) -> String {
    let [x, y, z] = voxel.map(|v| (v * 1e6).round() / 1e3);
    format!("{x} x {y} x {z}")
}
