//! What a volume file's header states, before any voxel is read.

use super::{Axes, Endian, SampleType, Unit};
use crate::base::{Context, Error, Result};
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};

/// The longest header that is read, bytes.
const LONGEST: u64 = 1 << 20;
/// The largest size along one axis; no scanner is near it.
const LARGEST: usize = 1 << 20;

/// How voxels are packed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::fabric) enum Packing {
    None,
    Gzip,
    Zlib,
}

/// Where the voxels are.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Data {
    pub(super) path: PathBuf,
    /// Bytes of the file before them (or before the packed stream).
    pub(super) offset: u64,
    /// They end where the file ends, whatever comes before.
    pub(super) at_end: bool,
    /// Bytes before them in the unpacked stream.
    pub(super) skip: u64,
    pub(super) packing: Packing,
}

/// A header of a file of raw voxels. Axes are the file's, fastest first.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Header {
    pub(super) dims: [usize; 3],
    pub(super) sample: SampleType,
    /// `None` where it is not stated, or does not matter.
    pub(super) endian: Option<Endian>,
    /// What the file says of its place in space.
    pub(super) geometry: Geometry,
    pub(super) data: Data,
}

/// What a file states of its voxels' size and place.
#[derive(Debug, Clone, Default, PartialEq)]
pub(in crate::fabric) struct Geometry {
    /// Voxel size along each file axis, in `unit`.
    pub(in crate::fabric) spacing: Option<[f64; 3]>,
    pub(in crate::fabric) unit: Option<Unit>,
    /// Scene axes of the file axes, where it states directions.
    pub(in crate::fabric) axes: Option<Axes>,
    /// Center of the first voxel, in `unit`, in the file's own space.
    pub(in crate::fabric) origin: Option<[f64; 3]>,
    /// A person counts the file's axes from the slowest on.
    pub(super) slowest_first: bool,
    /// What a person should know.
    pub(super) notes: Vec<String>,
}

impl Geometry {
    /// From a person's count of the file's axes to fastest first, or back.
    pub(super) fn counted<T>(&self, mut per_axis: [T; 3]) -> [T; 3] {
        if self.slowest_first {
            per_axis.reverse();
        }
        per_axis
    }

    /// Takes directions of the file axes, each as long as a voxel.
    pub(super) fn set_directions(&mut self, directions: [[f64; 3]; 3]) {
        let length = |d: [f64; 3]| d.iter().map(|v| v * v).sum::<f64>().sqrt();
        self.spacing = Some(directions.map(length));
        self.axes = Axes::from_directions(directions);
        if self.axes.is_none() {
            self.origin = None;
            self.notes.push(
                "the file's axes are oblique to its space; they are taken as x, y, z (--axes says otherwise)".to_owned(),
            );
        }
    }
}

/// Bytes of a volume of this size.
///
/// # Errors
/// A side is zero or absurd, or the product does not fit.
pub(super) fn byte_count(dims: [usize; 3], sample: SampleType) -> Result<u64> {
    let [x, y, z] = dims;
    let size = format!("a volume of {x} x {y} x {z} voxels");
    if dims.contains(&0) {
        return Err(Error::new(format!("{size} is empty")));
    }
    let voxels = dims.iter().try_fold(sample.bytes() as u64, |n, side| {
        n.checked_mul(*side as u64).filter(|n| *n <= 1 << 50)
    });
    match voxels {
        Some(bytes) if dims.iter().all(|side| *side <= LARGEST) => Ok(bytes),
        _ => Err(Error::new(format!(
            "{size}: expected at most {LARGEST} along each axis and 2^50 bytes in all"
        ))
        .with_hint("is the header damaged?")),
    }
}

/// Three whole numbers, fastest axis first.
pub(super) fn dims(key: &str, text: &str) -> Result<[usize; 3]> {
    let bad = || Error::new(format!("{key} '{text}': expected three whole numbers"));
    let list = text
        .split_whitespace()
        .map(|t| t.parse::<usize>().map_err(|_| bad()))
        .collect::<Result<Vec<_>>>()?;
    list.try_into().map_err(|_| bad())
}

/// `N` finite numbers separated by spaces or commas, in any brackets.
pub(super) fn numbers<const N: usize>(key: &str, text: &str) -> Result<[f64; N]> {
    let bad = || Error::new(format!("{key} '{text}': expected {N} numbers"));
    let list = text
        .split(|c: char| c.is_whitespace() || ",()".contains(c))
        .filter(|t| !t.is_empty())
        .map(|t| t.parse::<f64>().ok().filter(|v| v.is_finite()))
        .collect::<Option<Vec<_>>>()
        .ok_or_else(bad)?;
    list.try_into().map_err(|_| bad())
}

/// A file named by a header, beside it.
pub(super) fn beside(header: &Path, name: &str) -> Result<PathBuf> {
    if name.eq_ignore_ascii_case("list") || name.starts_with("LIST ") || name.contains('%') {
        return Err(Error::new(format!(
            "voxels in several files ('{name}'): expected one file"
        ))
        .with_hint("join them in the order of the header (cat a b c > all.raw), and name that"));
    }
    Ok(header.parent().unwrap_or(Path::new(".")).join(name))
}

/// Lines of a text header, and the byte after the last one.
pub(super) struct Lines {
    reader: BufReader<File>,
    pub(super) at: u64,
}

impl Lines {
    pub(super) fn open(path: &Path) -> Result<Self> {
        let file = File::open(path).context(|| format!("{} cannot be read", path.display()))?;
        Ok(Self {
            reader: BufReader::new(file),
            at: 0,
        })
    }

    /// The next line without its end; `None` at the file's end.
    pub(super) fn next(&mut self) -> Result<Option<String>> {
        let mut bytes = Vec::new();
        let mut limited = std::io::Read::take(&mut self.reader, LONGEST - self.at);
        let read = limited
            .read_until(b'\n', &mut bytes)
            .context(|| "the header cannot be read")?;
        self.at += read as u64;
        if read > 0 && self.at >= LONGEST {
            return Err(Error::new(format!(
                "the header does not end within {LONGEST} bytes"
            )));
        }
        let line = String::from_utf8_lossy(&bytes);
        Ok((read > 0).then(|| line.trim_end_matches(['\n', '\r']).to_owned()))
    }
}
