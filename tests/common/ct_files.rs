//! What the tests of micro-CT volumes share: files made by hand, byte by byte, and opening them.

#![allow(dead_code)]

use flate2::Compression;
use flate2::write::{GzEncoder, ZlibEncoder};
use goniofit::base::Unwatched;
use goniofit::fabric::ct::{Reading, Volume};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Opens a volume as its file says, with voxels of 5 um where it does not.
pub(crate) fn open(
    path: &Path,
    change: impl FnOnce(&mut Reading),
) -> goniofit::base::Result<Volume> {
    let mut reading = Reading::new(std::env::temp_dir());
    change(&mut reading);
    Volume::open(path, &reading, &Unwatched)
}

pub(crate) fn five_um(reading: &mut Reading) {
    reading.voxel_um = Some([5.0; 3]);
}

/// All voxels, x fastest.
pub(crate) fn all(volume: &Volume) -> Vec<f32> {
    volume.slab(0..volume.dims()[2]).unwrap().values
}

pub(crate) fn write(folder: &Path, name: &str, parts: &[&[u8]]) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, parts.concat()).unwrap();
    path
}

/// A page of a TIFF file.
#[derive(Clone)]
pub(crate) struct Page {
    pub(crate) size: [u32; 2],
    pub(crate) bits: u16,
    /// 1 unsigned, 2 signed, 3 floating point.
    pub(crate) format: u16,
    /// Voxels in the file's byte order.
    pub(crate) data: Vec<u8>,
    pub(crate) description: String,
    /// Pixels per unit as a fraction.
    pub(crate) resolution: Option<[u32; 2]>,
    pub(crate) photometric: u16,
}

impl Page {
    pub(crate) fn new(size: [u32; 2], bits: u16, format: u16, data: Vec<u8>) -> Self {
        Self {
            size,
            bits,
            format,
            data,
            description: String::new(),
            resolution: None,
            photometric: 1,
        }
    }
}

/// A TIFF file of uncompressed pages, one strip each.
pub(crate) fn tiff(pages: &[Page], big: bool) -> Vec<u8> {
    let u16s = |v: u16| {
        if big {
            v.to_be_bytes()
        } else {
            v.to_le_bytes()
        }
    };
    let u32s = |v: u32| {
        if big {
            v.to_be_bytes()
        } else {
            v.to_le_bytes()
        }
    };
    let mut file = if big { b"MM".to_vec() } else { b"II".to_vec() };
    file.extend(u16s(42));
    file.extend(u32s(0));
    let mut link = 4;
    for page in pages {
        let data_at = file.len() as u32;
        file.extend(&page.data);
        file.resize(file.len().next_multiple_of(2), 0);
        let text_at = file.len() as u32;
        let text = format!("{}\0", page.description);
        file.extend(text.as_bytes());
        file.resize(file.len().next_multiple_of(4), 0);
        let fraction_at = file.len() as u32;
        for part in page.resolution.unwrap_or_default() {
            file.extend(u32s(part));
        }
        const SHORT: u16 = 3;
        const LONG: u16 = 4;
        let mut tags = vec![
            (256, LONG, 1, page.size[0]),
            (257, LONG, 1, page.size[1]),
            (258, SHORT, 1, u32::from(page.bits)),
            (259, SHORT, 1, 1),
            (262, SHORT, 1, u32::from(page.photometric)),
        ];
        if !page.description.is_empty() {
            tags.push((270, 2, text.len() as u32, text_at));
        }
        tags.extend([
            (273, LONG, 1, data_at),
            (277, SHORT, 1, 1),
            (278, LONG, 1, page.size[1]),
            (279, LONG, 1, page.data.len() as u32),
        ]);
        if page.resolution.is_some() {
            tags.extend([(282, 5, 1, fraction_at), (283, 5, 1, fraction_at)]);
        }
        tags.push((339, SHORT, 1, u32::from(page.format)));
        let directory = file.len() as u32;
        file[link..link + 4].copy_from_slice(&u32s(directory));
        file.extend(u16s(tags.len() as u16));
        for (tag, kind, count, value) in tags {
            file.extend(u16s(tag));
            file.extend(u16s(kind));
            file.extend(u32s(count));
            if kind == SHORT {
                file.extend(u16s(value as u16));
                file.extend([0, 0]);
            } else {
                file.extend(u32s(value));
            }
        }
        link = file.len();
        file.extend(u32s(0));
    }
    file
}

/// A NRRD file of single precision voxels of `voxel_um`.
pub(crate) fn nrrd_f32(
    dims: [usize; 3],
    voxel_um: [f64; 3],
    values: impl Fn(usize, usize, usize) -> f32,
) -> Vec<u8> {
    let [nx, ny, nz] = dims;
    let [a, b, c] = voxel_um;
    let mut file = format!(
        "NRRD0004\ntype: float\ndimension: 3\nsizes: {nx} {ny} {nz}\nspacings: {a} {b} {c}\nunits: \"um\" \"um\" \"um\"\n\
         encoding: raw\nendian: little\n\n"
    )
    .into_bytes();
    for z in 0..nz {
        for y in 0..ny {
            for x in 0..nx {
                file.extend(values(x, y, z).to_le_bytes());
            }
        }
    }
    file
}

/// Voxels of the small volumes.
pub(crate) const DIMS: [usize; 3] = [4, 3, 5];

/// Small enough for every type, different for every voxel.
pub(crate) fn value(x: usize, y: usize, z: usize) -> i32 {
    (x + 4 * y + 12 * z) as i32
}

pub(crate) fn in_file_order() -> Vec<i32> {
    let [nx, ny, nz] = DIMS;
    let all = (0..nz).flat_map(|z| (0..ny).flat_map(move |y| (0..nx).map(move |x| value(x, y, z))));
    all.collect()
}

pub(crate) fn bytes(kind: &str, big: bool) -> Vec<u8> {
    macro_rules! encode {
        ($t:ty) => {
            in_file_order()
                .into_iter()
                .flat_map(|v| {
                    let v = v as $t;
                    if big {
                        v.to_be_bytes()
                    } else {
                        v.to_le_bytes()
                    }
                })
                .collect()
        };
    }
    match kind {
        "u8" => encode!(u8),
        "i8" => encode!(i8),
        "u16" => encode!(u16),
        "i16" => encode!(i16),
        "u32" => encode!(u32),
        "i32" => encode!(i32),
        "u64" => encode!(u64),
        "i64" => encode!(i64),
        "f32" => encode!(f32),
        _ => encode!(f64),
    }
}

pub(crate) fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut packer = GzEncoder::new(Vec::new(), Compression::fast());
    packer.write_all(bytes).unwrap();
    packer.finish().unwrap()
}

pub(crate) fn zlib(bytes: &[u8]) -> Vec<u8> {
    let mut packer = ZlibEncoder::new(Vec::new(), Compression::fast());
    packer.write_all(bytes).unwrap();
    packer.finish().unwrap()
}

pub(crate) fn nrrd_header(kind: &str, big: bool, rest: &str) -> String {
    let endian = if big { "big" } else { "little" };
    format!(
        "NRRD0001\n# by hand\ntype: {kind}\ndimension: 3\nsizes: 4 3 5\nendian: {endian}\nnote:=a b\n{rest}"
    )
}

pub(crate) fn pages(kind: &str, bits: u16, format: u16, big: bool) -> Vec<Page> {
    let raw = bytes(kind, big);
    let slices = raw.chunks(raw.len() / DIMS[2]);
    slices
        .map(|s| Page::new([4, 3], bits, format, s.to_vec()))
        .collect()
}
