//! Tiles of voxels as NRRD: density and direction, four single precision numbers a voxel (`vector domain domain domain`).
//!
//! Written raw and little-endian, 16 bytes a voxel; 3D Slicer shows such a file as a vector volume. Reads raw and gzip,
//! both byte orders, header attached. The lower corner of a tile is at x = y = 0, whatever the file says.

use super::{PackedDirection, VoxelTile};
use crate::base::{Context, Error, Result};
use crate::fabric::aside::write_aside;
use crate::fabric::ct::header::Packing;
use crate::fabric::ct::nrrd::{Fields, MAGIC, endian, geometry, packing};
use crate::fabric::ct::{Endian, Unit};
use glam::DVec3;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

impl VoxelTile {
    /// Writes the tile as NRRD, four single precision numbers a voxel: density and direction (0 where it is empty).
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write(&self, out: &Path) -> Result<()> {
        let ([nx, ny, nz], side) = (self.shape, self.side);
        let (first, z) = (0.5 * side, self.bottom + 0.5 * side);
        let header = format!(
            "NRRD0004\n# goniofit voxels: density, then the direction of the fiber; the tile repeats in x and y\n\
             type: float\ndimension: 4\nspace: 3D-right-handed\nsizes: 4 {nx} {ny} {nz}\n\
             space directions: none ({side},0,0) (0,{side},0) (0,0,{side})\nkinds: vector domain domain domain\n\
             endian: little\nencoding: raw\nspace units: \"mm\" \"mm\" \"mm\"\nspace origin: ({first},{first},{z})\n\n"
        );
        let what = || format!("{} cannot be written", out.display());
        write_aside(out, |file| {
            file.write_all(header.as_bytes()).context(what)?;
            for (density, direction) in self.density.iter().zip(&self.direction) {
                let d = match *density > 0.0 {
                    true => direction.unpack(),
                    false => DVec3::ZERO,
                };
                let numbers = [*density, d.x as f32, d.y as f32, d.z as f32];
                let bytes = numbers.map(f32::to_le_bytes);
                file.write_all(bytes.as_flattened()).context(what)?;
            }
            Ok(())
        })
    }

    /// Reads a tile from NRRD of four single precision numbers a voxel, as [`VoxelTile::write`] and 3D Slicer write it.
    ///
    /// # Errors
    /// The file is not such a file, is cut off or damaged, its voxels are no cubes along the axes or of unknown size, a
    /// density is negative, or a direction where there is density is no unit vector.
    pub fn read(path: &Path) -> Result<Self> {
        read(path).context(|| format!("voxels {} cannot be used", path.display()))
    }

    /// Whether a file's header is one of a tile of voxels (and not of a gray volume).
    pub fn is_in(path: &Path) -> bool {
        let mut start = [0; 8];
        let opened = File::open(path).and_then(|mut f| f.read(&mut start));
        matches!(opened, Ok(n) if start[..n].starts_with(MAGIC))
            && Fields::read(path)
                .is_ok_and(|(fields, _, _)| fields.get(&["dimension"]) == Some("4"))
    }
}

fn read(path: &Path) -> Result<VoxelTile> {
    let mut file = File::open(path).context(|| "it cannot be opened")?;
    let mut start = [0; 8];
    let read = file.read(&mut start).context(|| "it cannot be read")?;
    if !start[..read].starts_with(MAGIC) {
        return Err(Error::new("it is no NRRD file").with_hint(EXPECTED));
    }
    let (fields, ended, after) = Fields::read(path)?;
    if !ended {
        return Err(Error::new("the header does not end with an empty line")
            .with_hint("was the file cut off?"));
    }
    let shape = shape(&fields)?;
    let (side, bottom) = place(&fields)?;
    let swap = endian(fields.needed(&["endian"])?)? == Endian::Big;
    file.seek(SeekFrom::Start(after))
        .context(|| "it cannot be read")?;
    let file = BufReader::with_capacity(1 << 20, file);
    let mut source: Box<dyn Read> = match packing(fields.needed(&["encoding"])?)? {
        Packing::None => Box::new(file),
        _ => Box::new(flate2::bufread::MultiGzDecoder::new(file)),
    };
    let count: usize = shape.iter().product();
    let (mut density, mut direction) = (Vec::new(), Vec::new());
    let mut row = vec![0; 16 * shape[0]];
    while density.len() < count {
        source.read_exact(&mut row).map_err(|e| {
            let [x, y, z] = shape;
            Error::new(format!(
                "cut off: expected {x} x {y} x {z} voxels of four numbers, the file ends in voxel row {}",
                density.len() / shape[0]
            ))
            .with_hint("copy it again")
            .with_source(e)
        })?;
        for bytes in row.as_chunks::<16>().0 {
            let number = |k: usize| {
                let four = [bytes[k], bytes[k + 1], bytes[k + 2], bytes[k + 3]];
                if swap {
                    f32::from_be_bytes(four)
                } else {
                    f32::from_le_bytes(four)
                }
            };
            let voxel = [number(0), number(4), number(8), number(12)];
            direction.push(checked(voxel, density.len(), shape)?);
            density.push(voxel[0]);
        }
    }
    if source.read(&mut [0; 1]).context(|| "it cannot be read")? > 0 {
        return Err(Error::new("there are more voxels than the header says")
            .with_hint("do sizes in the header belong to other data?"));
    }
    VoxelTile::from_parts(shape, side, bottom, density, direction)
}

const EXPECTED: &str = "goniofit ct orient writes tiles of voxels; density and direction, four single precision numbers a voxel";

/// Voxels along x, y, z.
fn shape(fields: &Fields) -> Result<[usize; 3]> {
    let kind = fields.needed(&["type"])?;
    let sizes = fields.needed(&["sizes"])?;
    let list: Option<Vec<usize>> = sizes.split_whitespace().map(|t| t.parse().ok()).collect();
    let float = kind.eq_ignore_ascii_case("float");
    match list.as_deref() {
        Some([4, rest @ ..]) if float && rest.len() == 3 => {
            let shape = [rest[0], rest[1], rest[2]];
            VoxelTile::check_shape(shape)?;
            Ok(shape)
        }
        _ => Err(Error::new(format!(
            "voxels of type {kind} and sizes {sizes}: expected float and 4 numbers for each voxel of x, y, z"
        ))
        .with_hint(EXPECTED)),
    }
}

/// Side of a voxel and lower end along z.
fn place(fields: &Fields) -> Result<(f64, f64)> {
    let found = geometry(fields)?;
    let unit = found.unit.map_or(1.0, Unit::millimeters);
    let spacing = found
        .spacing
        .ok_or_else(|| Error::new("the file states no voxel size (space directions)"))?;
    let side = spacing[0] * unit;
    let even = spacing.iter().all(|s| (s / spacing[0] - 1.0).abs() < 1e-3);
    if !(even && found.axes == Some(crate::fabric::ct::Axes::SAME)) {
        return Err(Error::new(format!(
            "voxels of {spacing:?} along directions of their own: expected cubes along x, y and z"
        )));
    }
    let origin = found.origin.unwrap_or_default()[2] * unit;
    Ok((side, origin - 0.5 * side))
}

/// The direction of a voxel that makes sense.
fn checked(voxel: [f32; 4], at: usize, [nx, ny, _]: [usize; 3]) -> Result<PackedDirection> {
    let [density, x, y, z] = voxel;
    let direction = DVec3::new(x.into(), y.into(), z.into());
    let unit = (direction.length_squared() - 1.0).abs() < 1e-3;
    let fine = voxel.iter().all(|v| v.is_finite()) && density >= 0.0;
    if !(fine && (unit || density == 0.0)) {
        return Err(Error::new(format!(
            "voxel ({}, {}, {}) has density {density} and direction ({x}, {y}, {z}): expected a density of at least 0 and a unit vector",
            at % nx,
            at / nx % ny,
            at / (nx * ny)
        )));
    }
    Ok(if unit {
        PackedDirection::pack(direction)
    } else {
        PackedDirection::default()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    fn some() -> VoxelTile {
        let mut tile = VoxelTile::empty([5, 4, 3], 0.005, -0.0125).unwrap();
        let mut random = Random::keyed(&[3]);
        for place in (0..60).filter(|p| p % 3 != 0) {
            let v = DVec3::new(random.normal(), random.normal(), random.normal()).normalize();
            tile.set(place, random.uniform_open() as f32, v).unwrap();
        }
        tile
    }

    #[test]
    fn what_was_written_is_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.nrrd");
        let tile = some();
        tile.write(&path).unwrap();
        let back = VoxelTile::read(&path).unwrap();
        assert_eq!((back.shape(), back.side()), (tile.shape(), tile.side()));
        assert!((back.bottom() - tile.bottom()).abs() < 1e-12);
        assert_eq!(back.density(), tile.density());
        for place in (0..60).filter(|p| p % 3 != 0) {
            assert!(back.direction(place).angle_between(tile.direction(place)) < 1e-4);
        }
        assert!(VoxelTile::is_in(&path));
        // As 3D Slicer writes it: gzip, and its own order of fields.
        let bytes = std::fs::read(&path).unwrap();
        let cut = bytes.windows(2).position(|w| w == b"\n\n").unwrap() + 2;
        let header = String::from_utf8(bytes[..cut].to_vec()).unwrap();
        let mut packed = header
            .replace("encoding: raw", "encoding: gzip")
            .into_bytes();
        let mut encoder = flate2::write::GzEncoder::new(&mut packed, flate2::Compression::fast());
        std::io::Write::write_all(&mut encoder, &bytes[cut..]).unwrap();
        encoder.finish().unwrap();
        std::fs::write(&path, packed).unwrap();
        assert_eq!(VoxelTile::read(&path).unwrap(), back);
    }

    #[test]
    fn damage_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.nrrd");
        some().write(&path).unwrap();
        let whole = std::fs::read(&path).unwrap();
        let cut = whole.windows(2).position(|w| w == b"\n\n").unwrap() + 2;
        let header = String::from_utf8(whole[..cut].to_vec()).unwrap();
        let fails = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            VoxelTile::read(&path).unwrap_err().report()
        };
        let with = |from: &str, to: &str| {
            assert!(header.contains(from), "{from}");
            [header.replace(from, to).as_bytes(), &whole[cut..]].concat()
        };
        let number = |at: usize, value: f32| {
            let mut bytes = whole.clone();
            bytes[cut + 4 * at..cut + 4 * at + 4].copy_from_slice(&value.to_le_bytes());
            bytes
        };
        assert!(fails(b"hello").contains("no NRRD file"));
        assert!(fails(&whole[..200]).contains("cut off"));
        assert!(fails(&whole[..cut + 100]).contains("ends in voxel row 1"));
        assert!(fails(&[&whole, &b"x"[..]].concat()).contains("more voxels"));
        assert!(fails(&with("sizes: 4", "sizes: 3")).contains("expected float and 4"));
        assert!(fails(&with("type: float", "type: short")).contains("expected float and 4"));
        assert!(fails(&with("(0,0.005,0)", "(0,0.007,0)")).contains("expected cubes"));
        assert!(fails(&with("sizes: 4 5 4 3", "sizes: 4 5 4 0")).contains("no meaning"));
        assert!(fails(&number(4, -1.0)).contains("voxel (1, 0, 0) has density -1"));
        assert!(fails(&number(4, f32::NAN)).contains("density NaN"));
        assert!(
            fails(&number(5, 2.0)).contains("expected a density of at least 0 and a unit vector")
        );
    }
}
