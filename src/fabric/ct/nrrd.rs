//! NRRD (teem.sourceforge.net/nrrd/format.html): a text header, then voxels, in one file or two.
//!
//! Reads three-dimensional volumes, encoding raw or gzip, attached or detached. Does not read the encodings ascii, hex and
//! bzip2, voxels spread over several files, or more than one number per voxel.

use super::header::{Data, Geometry, Header, Lines, Packing, beside, dims, numbers};
use super::{Endian, SampleType};
use crate::base::{Error, Result};
use std::path::Path;

pub(in crate::fabric) const MAGIC: &[u8] = b"NRRD000";

/// Reads a header.
pub(super) fn header(path: &Path) -> Result<Header> {
    let (fields, ended, after) = Fields::read(path)?;
    let detached = fields.get(&["data file", "datafile"]);
    if !ended && detached.is_none() {
        return Err(Error::new("the header does not end with an empty line")
            .with_hint("was the file cut off?"));
    }
    let (data_path, offset) = match detached {
        Some(name) => (beside(path, name)?, 0),
        None => (path.to_owned(), after),
    };
    let dimension = fields.needed(&["dimension"])?;
    if dimension != "3" {
        return Err(
            Error::new(format!("a volume of dimension {dimension}: expected 3")).with_hint(
                "one number per voxel, and one point in time; tiles of density and direction are read by goniofit ct view and fibers",
            ),
        );
    }
    let packing = packing(fields.needed(&["encoding"])?)?;
    let (skip_bytes, lines_before) = (
        fields.count(&["byte skip", "byteskip"])?,
        fields.count(&["line skip", "lineskip"])?,
    );
    let offset = offset + line_bytes(&data_path, offset, lines_before)?;
    let at_end = skip_bytes < 0 && packing == Packing::None;
    let skip = u64::try_from(skip_bytes).unwrap_or(0);
    let packed = packing != Packing::None;
    Ok(Header {
        dims: dims("sizes", fields.needed(&["sizes"])?)?,
        sample: sample(fields.needed(&["type"])?)?,
        endian: fields.get(&["endian"]).map(endian).transpose()?,
        geometry: geometry(&fields)?,
        data: Data {
            path: data_path,
            offset: offset + if packed { 0 } else { skip },
            at_end,
            skip: if packed { skip } else { 0 },
            packing,
        },
    })
}

/// A header for little-endian single precision voxels of `voxel` millimeters, with the center of the first at `origin`.
pub(super) fn written(dims: [usize; 3], voxel: f64, origin: [f64; 3]) -> String {
    let ([nx, ny, nz], [x, y, z]) = (dims, origin);
    format!(
        "NRRD0004\n# goniofit ct prepare\ntype: float\ndimension: 3\nspace: 3D-right-handed\nsizes: {nx} {ny} {nz}\n\
         space directions: ({voxel},0,0) (0,{voxel},0) (0,0,{voxel})\nkinds: domain domain domain\nendian: little\n\
         encoding: raw\nspace units: \"mm\" \"mm\" \"mm\"\nspace origin: ({x},{y},{z})\n\n"
    )
}

/// The fields of a header.
#[derive(Default)]
pub(in crate::fabric) struct Fields(Vec<(String, String)>);

impl Fields {
    /// Reads the fields of a file, whether the empty line that ends them is there, and the byte after it.
    pub(in crate::fabric) fn read(path: &Path) -> Result<(Self, bool, u64)> {
        let mut lines = Lines::open(path)?;
        let mut fields = Self::default();
        lines.next()?;
        while let Some(line) = lines.next()? {
            if line.is_empty() {
                return Ok((fields, true, lines.at));
            }
            // `key:=value` is a user's note, `# ...` a comment.
            if !line.starts_with('#')
                && let Some((key, value)) = line.split_once(": ")
            {
                fields
                    .0
                    .push((key.trim().to_lowercase(), value.trim().to_owned()));
            }
        }
        Ok((fields, false, lines.at))
    }

    pub(in crate::fabric) fn get(&self, names: &[&str]) -> Option<&str> {
        let found = self.0.iter().find(|f| names.contains(&f.0.as_str()));
        found.map(|f| f.1.as_str())
    }

    pub(in crate::fabric) fn needed(&self, names: &[&str]) -> Result<&str> {
        self.get(names)
            .ok_or_else(|| Error::new(format!("the header lacks the field '{}'", names[0])))
    }

    fn count(&self, names: &[&str]) -> Result<i64> {
        let text = self.get(names).unwrap_or("0");
        match text.parse() {
            Ok(n) if n >= -1 => Ok(n),
            _ => Err(Error::new(format!(
                "{} '{text}': expected a whole number",
                names[0]
            ))),
        }
    }
}

/// Bytes of `count` lines of a file from `offset` on.
fn line_bytes(path: &Path, offset: u64, count: i64) -> Result<u64> {
    if count <= 0 {
        return Ok(0);
    }
    let mut lines = Lines::open(path)?;
    while lines.at < offset {
        lines.next()?;
    }
    for _ in 0..count {
        if lines.next()?.is_none() {
            return Err(Error::new(format!("fewer than {count} lines to skip")));
        }
    }
    Ok(lines.at - offset)
}

pub(in crate::fabric) fn packing(encoding: &str) -> Result<Packing> {
    match encoding.to_lowercase().as_str() {
        "raw" => Ok(Packing::None),
        "gzip" | "gz" => Ok(Packing::Gzip),
        other => Err(
            Error::new(format!("encoding '{other}': expected raw or gzip"))
                .with_hint("unu save -f nrrd -e raw writes such a file"),
        ),
    }
}

pub(in crate::fabric) fn endian(text: &str) -> Result<Endian> {
    match text.to_lowercase().as_str() {
        "little" => Ok(Endian::Little),
        "big" => Ok(Endian::Big),
        _ => Err(Error::new(format!(
            "endian '{text}': expected little or big"
        ))),
    }
}

fn sample(text: &str) -> Result<SampleType> {
    match text.to_lowercase().as_str() {
        "signed char" | "int8" | "int8_t" => Ok(SampleType::I8),
        "uchar" | "unsigned char" | "uint8" | "uint8_t" => Ok(SampleType::U8),
        "short" | "short int" | "signed short" | "signed short int" | "int16" | "int16_t" => {
            Ok(SampleType::I16)
        }
        "ushort" | "unsigned short" | "unsigned short int" | "uint16" | "uint16_t" => {
            Ok(SampleType::U16)
        }
        "int" | "signed int" | "int32" | "int32_t" => Ok(SampleType::I32),
        "uint" | "unsigned int" | "uint32" | "uint32_t" => Ok(SampleType::U32),
        "longlong"
        | "long long"
        | "long long int"
        | "signed long long"
        | "signed long long int"
        | "int64"
        | "int64_t" => Ok(SampleType::I64),
        "ulonglong" | "unsigned long long" | "unsigned long long int" | "uint64" | "uint64_t" => {
            Ok(SampleType::U64)
        }
        "float" => Ok(SampleType::F32),
        "double" => Ok(SampleType::F64),
        _ => Err(Error::new(format!(
            "unknown type '{text}': expected an integer of 8 to 64 bits, float or double"
        ))),
    }
}

pub(in crate::fabric) fn geometry(fields: &Fields) -> Result<Geometry> {
    let mut geometry = Geometry::default();
    if let Some(text) = fields.get(&["space origin"]) {
        geometry.origin = Some(numbers("space origin", text)?);
    }
    if let Some(text) = fields.get(&["space directions"]) {
        // Of several numbers per voxel, the axis of these has no direction.
        let n = numbers::<9>("space directions", text.trim_start_matches("none"))?;
        geometry.set_directions([0, 3, 6].map(|k| [n[k], n[k + 1], n[k + 2]]));
    } else if let Some(text) = fields.get(&["spacings"]) {
        geometry.spacing = Some(numbers("spacings", text)?);
    }
    let units = fields.get(&["space units", "units"]).unwrap_or_default();
    let mut named = units
        .split('"')
        .map(str::trim)
        .filter(|u| !u.is_empty())
        .map(str::parse);
    if let Some(first) = named.next().transpose()? {
        for other in named {
            if other? != first {
                return Err(Error::new(format!(
                    "units {units}: expected the same along all axes"
                )));
            }
        }
        geometry.unit = Some(first);
    }
    Ok(geometry)
}
