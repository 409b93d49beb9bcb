//! Cem Yuksel's binary `.hair` file (cemyuksel.com/research/hairmodels).
//!
//! A header of 128 bytes, then arrays in this order, little-endian: segments per strand (u16), points (3 f32), thickness
//! (f32 a point), transparency (f32 a point), color (3 f32 a point); a bit field tells which arrays exist. The format knows
//! no unit, no tile and no yarn system: this module writes millimeters and says so in the header's 88 bytes of free text,
//! with the tile size; thickness is the fiber's *diameter*; reading needs the tile size, takes lengths as millimeters and
//! gives every fiber yarn system 0. Transparency and color are skipped.
//!
//! Single precision: at 50 mm from the origin points are rounded to 4 nm, near the 10 nm within which end points are
//! taken as one; tiles far larger do not survive the trip with their neighbors.

use super::{Curve, FiberTile, MAX_SEGMENTS, check_segment, curves, from_curves, needed_tile};
use crate::base::{Error, Result};
use glam::DVec3;

const HEADER: usize = 128;
const SEGMENTS: u32 = 1;
const POINTS: u32 = 2;
const THICKNESS: u32 = 4;
const TRANSPARENCY: u32 = 8;
const COLOR: u32 = 16;
const MAX_STRAND: usize = u16::MAX as usize;

pub(crate) fn write(tile: &FiberTile) -> Result<Vec<u8>> {
    // A strand holds at most 65535 segments; longer fibers become several strands that share an end point.
    let strands: Vec<(Vec<DVec3>, Vec<f64>)> = curves(tile)
        .into_iter()
        .flat_map(|curve| {
            let count = curve.radii.len();
            (0..count.div_ceil(MAX_STRAND))
                .map(|k| {
                    let (from, to) = (k * MAX_STRAND, ((k + 1) * MAX_STRAND).min(count));
                    (
                        curve.points[from..=to].to_vec(),
                        curve.radii[from..to].to_vec(),
                    )
                })
                .collect::<Vec<_>>()
        })
        .collect();
    let points: usize = strands.iter().map(|s| s.0.len()).sum();
    let count = |n: usize| {
        u32::try_from(n).map_err(|_| Error::new(format!("{n} points do not fit a .hair file")))
    };
    let mut bytes = Vec::with_capacity(HEADER + strands.len() * 2 + points * 16);
    bytes.extend(b"HAIR");
    for word in [
        count(strands.len())?,
        count(points)?,
        SEGMENTS | POINTS | THICKNESS,
        0,
    ] {
        bytes.extend(word.to_le_bytes());
    }
    let default_thickness = 2.0 * strands.first().map_or(0.0, |s| s.1[0]) as f32;
    for value in [default_thickness, 0.0, 1.0, 1.0, 1.0] {
        bytes.extend(value.to_le_bytes());
    }
    let info = format!(
        "goniofit; millimeters; thickness = diameter; tile_mm = [{}, {}]",
        tile.size[0], tile.size[1]
    );
    bytes.extend(info.bytes().take(87));
    bytes.resize(HEADER, 0);
    for (_, radii) in &strands {
        bytes.extend((radii.len() as u16).to_le_bytes());
    }
    for point in strands.iter().flat_map(|s| &s.0) {
        for value in point.to_array() {
            bytes.extend((value as f32).to_le_bytes());
        }
    }
    for (points, radii) in &strands {
        for k in 0..points.len() {
            let radius = radii[k.min(radii.len() - 1)];
            bytes.extend(((2.0 * radius) as f32).to_le_bytes());
        }
    }
    Ok(bytes)
}

pub(crate) fn read(bytes: &[u8], tile: Option<[f64; 2]>) -> Result<FiberTile> {
    let size = needed_tile(tile)?;
    let header = Header::read(bytes)?;
    let mut reader = Reader { bytes, at: HEADER };
    let counts: Vec<usize> = if header.bits & SEGMENTS != 0 {
        (0..header.strands)
            .map(|_| reader.u16().map(usize::from))
            .collect::<Result<_>>()?
    } else {
        vec![header.default_segments; header.strands]
    };
    let total: usize = counts.iter().map(|n| n + 1).sum();
    if total != header.points {
        return Err(Error::new(format!(
            "the strands have {total} points, the header says {}",
            header.points
        )));
    }
    let mut list = Vec::with_capacity(header.strands);
    for &count in &counts {
        let points = (0..=count)
            .map(|_| reader.point())
            .collect::<Result<Vec<_>>>()?;
        list.push(Curve {
            points,
            radii: vec![0.5 * header.default_thickness; count],
            yarn_system: 0,
        });
    }
    if header.bits & THICKNESS != 0 {
        for curve in &mut list {
            for radius in &mut curve.radii {
                *radius = 0.5 * f64::from(reader.f32()?);
            }
            reader.f32()?;
        }
    }
    for (strand, curve) in (1..).zip(&list) {
        for (k, pair) in curve.points.windows(2).enumerate() {
            check_segment(pair[0], pair[1], curve.radii[k], || {
                format!("strand {strand}, segment {}", k + 1)
            })?;
        }
    }
    list.retain(|c| !c.radii.is_empty());
    if list.is_empty() {
        return Err(Error::new("no segments: the fabric is empty"));
    }
    Ok(from_curves(size, &list))
}

struct Header {
    strands: usize,
    points: usize,
    bits: u32,
    default_segments: usize,
    default_thickness: f64,
}

impl Header {
    /// Reads the header and checks that the file is exactly as long as its arrays.
    fn read(bytes: &[u8]) -> Result<Self> {
        if !bytes.starts_with(b"HAIR") {
            return Err(Error::new("byte 0: expected 'HAIR'").with_hint("is this a .hair file?"));
        }
        if bytes.len() < HEADER {
            return Err(Error::new(format!(
                "byte {}: the file ends within its header of {HEADER} bytes",
                bytes.len()
            )));
        }
        let mut reader = Reader { bytes, at: 4 };
        let strands = reader.u32()? as usize;
        let points = reader.u32()? as usize;
        let bits = reader.u32()?;
        let default_segments = reader.u32()? as usize;
        let default_thickness = f64::from(reader.f32()?);
        if bits & POINTS == 0 {
            return Err(Error::new("the header says the file holds no points"));
        }
        if strands > MAX_SEGMENTS || points > 2 * MAX_SEGMENTS || default_segments > MAX_SEGMENTS {
            return Err(Error::new(format!(
                "the header says {strands} strands with {points} points: expected at most {MAX_SEGMENTS} segments"
            )));
        }
        let per_point = 12
            + 4 * usize::from(bits & THICKNESS != 0)
            + 4 * usize::from(bits & TRANSPARENCY != 0)
            + 12 * usize::from(bits & COLOR != 0);
        let expected =
            HEADER + 2 * strands * usize::from(bits & SEGMENTS != 0) + per_point * points;
        if bytes.len() != expected {
            return Err(Error::new(format!(
                "the file has {} bytes, its header asks for {expected}",
                bytes.len()
            ))
            .with_hint("was the file cut off?"));
        }
        Ok(Self {
            strands,
            points,
            bits,
            default_segments,
            default_thickness,
        })
    }
}

struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N]> {
        let found = self
            .bytes
            .get(self.at..self.at + N)
            .and_then(|b| b.try_into().ok())
            .ok_or_else(|| Error::new(format!("byte {}: the file ends too early", self.at)))?;
        self.at += N;
        Ok(found)
    }

    fn u16(&mut self) -> Result<u16> {
        self.take().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Result<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn f32(&mut self) -> Result<f32> {
        self.take().map(f32::from_le_bytes)
    }

    fn point(&mut self) -> Result<DVec3> {
        Ok(DVec3::new(
            self.f32()?.into(),
            self.f32()?.into(),
            self.f32()?.into(),
        ))
    }
}
