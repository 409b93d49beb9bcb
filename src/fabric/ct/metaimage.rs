//! MetaImage of ITK (`.mhd` with its file of voxels, `.mha` in one file).
//!
//! Reads three-dimensional volumes of one number per voxel, raw or compressed by zlib. Does not read ASCII data or voxels
//! spread over several files; `MET_LONG` is refused, as it is four or eight bytes depending on who wrote it.

use super::header::{Data, Geometry, Header, Lines, Packing, beside, dims, numbers};
use super::{Endian, SampleType};
use crate::base::{Error, Result};
use std::path::Path;

/// Reads a header.
pub(super) fn header(path: &Path) -> Result<Header> {
    let mut lines = Lines::open(path)?;
    let mut fields = Fields(Vec::new());
    let name = loop {
        let Some(line) = lines.next()? else {
            return Err(Error::new("the header lacks ElementDataFile")
                .with_hint("is this a MetaImage file, and whole?"));
        };
        let Some((key, value)) = line.split_once('=') else {
            continue;
        };
        if key.trim() == "ElementDataFile" {
            break value.trim().to_owned();
        }
        fields
            .0
            .push((key.trim().to_owned(), value.trim().to_owned()));
    };
    let local = name.eq_ignore_ascii_case("local");
    let data_path = if local {
        path.to_owned()
    } else {
        beside(path, &name)?
    };
    fields.expect("NDims", "3", "3 dimensions")?;
    fields.expect("ElementNumberOfChannels", "1", "one number per voxel")?;
    if fields.get("BinaryData").is_some() && !fields.flag("BinaryData") {
        return Err(Error::new("voxels as text: expected BinaryData = True"));
    }
    let packed = fields.flag("CompressedData");
    let before = fields.get("HeaderSize").unwrap_or("0");
    let before: i64 = before
        .parse()
        .map_err(|_| Error::new(format!("HeaderSize '{before}': expected a whole number")))?;
    Ok(Header {
        dims: dims("DimSize", fields.needed("DimSize")?)?,
        sample: sample(fields.needed("ElementType")?)?,
        endian: Some(fields.endian()),
        geometry: geometry(&fields)?,
        data: Data {
            path: data_path,
            offset: if local {
                lines.at
            } else {
                u64::try_from(before).unwrap_or(0)
            },
            at_end: before < 0 && !packed,
            skip: 0,
            packing: if packed { Packing::Zlib } else { Packing::None },
        },
    })
}

struct Fields(Vec<(String, String)>);

impl Fields {
    fn get(&self, name: &str) -> Option<&str> {
        let found = self.0.iter().find(|f| f.0.eq_ignore_ascii_case(name));
        found.map(|f| f.1.as_str())
    }

    fn needed(&self, name: &str) -> Result<&str> {
        self.get(name)
            .ok_or_else(|| Error::new(format!("the header lacks {name}")))
    }

    fn flag(&self, name: &str) -> bool {
        self.get(name)
            .is_some_and(|v| v.eq_ignore_ascii_case("true") || v == "1")
    }

    /// Fails when a field is there and says otherwise.
    fn expect(&self, name: &str, value: &str, words: &str) -> Result<()> {
        match self.get(name) {
            Some(found) if found != value => {
                Err(Error::new(format!("{name} = {found}: expected {words}")))
            }
            _ => Ok(()),
        }
    }

    fn endian(&self) -> Endian {
        if self.flag("ElementByteOrderMSB") || self.flag("BinaryDataByteOrderMSB") {
            Endian::Big
        } else {
            Endian::Little
        }
    }
}

fn sample(text: &str) -> Result<SampleType> {
    match text {
        "MET_CHAR" => Ok(SampleType::I8),
        "MET_UCHAR" => Ok(SampleType::U8),
        "MET_SHORT" => Ok(SampleType::I16),
        "MET_USHORT" => Ok(SampleType::U16),
        "MET_INT" => Ok(SampleType::I32),
        "MET_UINT" => Ok(SampleType::U32),
        "MET_LONG_LONG" => Ok(SampleType::I64),
        "MET_ULONG_LONG" => Ok(SampleType::U64),
        "MET_FLOAT" => Ok(SampleType::F32),
        "MET_DOUBLE" => Ok(SampleType::F64),
        "MET_LONG" | "MET_ULONG" => Err(Error::new(format!(
            "unknown type {text}: four or eight bytes, depending on who wrote it"
        ))
        .with_hint("write MET_INT or MET_LONG_LONG (MET_UINT, MET_ULONG_LONG) in the header")),
        _ => Err(Error::new(format!(
            "unknown type {text}: expected MET_UCHAR, MET_SHORT, MET_USHORT, MET_INT, MET_UINT, MET_FLOAT or MET_DOUBLE"
        ))),
    }
}

fn geometry(fields: &Fields) -> Result<Geometry> {
    let mut geometry = Geometry::default();
    let place = ["Offset", "Position", "Origin"].into_iter();
    if let Some((key, text)) = place.filter_map(|k| Some((k, fields.get(k)?))).next() {
        geometry.origin = Some(numbers(key, text)?);
    }
    let sizes = ["ElementSpacing", "ElementSize"].into_iter();
    let Some((key, text)) = sizes.filter_map(|k| Some((k, fields.get(k)?))).next() else {
        return Ok(geometry);
    };
    let spacing: [f64; 3] = numbers(key, text)?;
    geometry.spacing = Some(spacing);
    let turned = ["TransformMatrix", "Rotation", "Orientation"].into_iter();
    if let Some((key, text)) = turned.filter_map(|k| Some((k, fields.get(k)?))).next() {
        let m = numbers::<9>(key, text)?;
        geometry.set_directions(
            [0, 1, 2].map(|axis| [0, 1, 2].map(|k| m[3 * axis + k] * spacing[axis])),
        );
        geometry.spacing = Some(spacing);
    }
    // Not a field of the standard, but written by some.
    if let Some(unit) = fields.get("ElementSpacingUnit").or(fields.get("Unit")) {
        geometry.unit = Some(unit.parse()?);
    }
    Ok(geometry)
}
