//! NumPy's `.npy` (numpy.org/doc/stable/reference/generated/numpy.lib.format.html): arrays of three axes, C or Fortran
//! order.
//!
//! The format states neither voxel size nor axes. Axes go by the array's indices, the last one first, whatever its order in
//! memory: the same array is the same volume.

use super::header::{Data, Geometry, Header, Packing};
use super::{Endian, SampleType};
use crate::base::{Context, Error, Result};
use std::fs::File;
use std::io::Read;
use std::path::Path;

pub(super) const MAGIC: &[u8] = b"\x93NUMPY";

/// Reads a header.
pub(super) fn header(path: &Path) -> Result<Header> {
    let mut file = File::open(path).context(|| format!("{} cannot be read", path.display()))?;
    let torn = || "the file ends within its header";
    let mut start = [0; 10];
    file.read_exact(&mut start).context(torn)?;
    let (length, offset) = match start[6] {
        1 => (u64::from(u16::from_le_bytes([start[8], start[9]])), 10),
        2 | 3 => {
            let mut rest = [0; 2];
            file.read_exact(&mut rest).context(torn)?;
            (
                u64::from(u32::from_le_bytes([start[8], start[9], rest[0], rest[1]])),
                12,
            )
        }
        version => {
            return Err(Error::new(format!(
                "npy version {version}: expected 1, 2 or 3"
            )));
        }
    };
    if length > 1 << 16 {
        return Err(Error::new(format!(
            "a header of {length} bytes: expected at most 65536"
        )));
    }
    let mut text = vec![0; length as usize];
    file.read_exact(&mut text).context(torn)?;
    let text = String::from_utf8_lossy(&text).into_owned();
    let (sample, endian) = sample(quoted(after(&text, "descr")?)?)?;
    let fortran = after(&text, "fortran_order")?.starts_with("True");
    let mut dims = shape(after(&text, "shape")?)?;
    if !fortran {
        dims.reverse();
    }
    let geometry = Geometry {
        slowest_first: fortran,
        ..Geometry::default()
    };
    Ok(Header {
        dims,
        sample,
        endian,
        geometry,
        data: Data {
            path: path.to_owned(),
            offset: offset + length,
            at_end: false,
            skip: 0,
            packing: Packing::None,
        },
    })
}

/// What follows a key of the header's dictionary.
fn after<'a>(text: &'a str, key: &str) -> Result<&'a str> {
    let found = [format!("'{key}'"), format!("\"{key}\"")]
        .iter()
        .find_map(|k| text.split_once(k.as_str()));
    let value = found.and_then(|(_, rest)| rest.trim_start().strip_prefix(':'));
    value
        .map(str::trim_start)
        .ok_or_else(|| Error::new(format!("the header lacks '{key}'")))
}

fn quoted(text: &str) -> Result<&str> {
    let bad = || {
        let shown: String = text.chars().take(40).collect();
        Error::new(format!(
            "unknown type {shown}: expected one number per voxel, as '<u2'"
        ))
    };
    let quote = text
        .chars()
        .next()
        .filter(|c| "'\"".contains(*c))
        .ok_or_else(bad)?;
    text[1..].split_once(quote).map(|s| s.0).ok_or_else(bad)
}

fn sample(descr: &str) -> Result<(SampleType, Option<Endian>)> {
    let unknown = || {
        Error::new(format!(
            "unknown type '{descr}': expected integers of 1 to 8 bytes, or floating point of 4 or 8"
        ))
        .with_hint("array.astype('<f4') in NumPy converts it")
    };
    let order = descr.chars().next().ok_or_else(unknown)?;
    let endian = match order {
        '<' | '=' => Some(Endian::Little),
        '>' => Some(Endian::Big),
        '|' => None,
        _ => return Err(unknown()),
    };
    let sample = match &descr[1..] {
        "u1" | "b1" => SampleType::U8,
        "i1" => SampleType::I8,
        "u2" => SampleType::U16,
        "i2" => SampleType::I16,
        "u4" => SampleType::U32,
        "i4" => SampleType::I32,
        "u8" => SampleType::U64,
        "i8" => SampleType::I64,
        "f4" => SampleType::F32,
        "f8" => SampleType::F64,
        _ => return Err(unknown()),
    };
    Ok((sample, endian))
}

fn shape(text: &str) -> Result<[usize; 3]> {
    let inside = text
        .strip_prefix('(')
        .and_then(|t| t.split_once(')'))
        .map_or("", |t| t.0);
    let bad = || Error::new(format!("an array of shape ({inside}): expected three axes"));
    let list = inside
        .split(',')
        .map(|t| t.trim().trim_end_matches('L'))
        .filter(|t| !t.is_empty())
        .map(|t| t.parse().map_err(|_| bad()))
        .collect::<Result<Vec<usize>>>()?;
    list.try_into().map_err(|_| bad())
}
