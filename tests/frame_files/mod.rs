//! Frame files as other programs write them, for tests.
#![allow(clippy::unwrap_used, dead_code, missing_docs, unreachable_pub)]

use tiff::encoder::{Compression, TiffEncoder, colortype};

pub const COMPRESSIONS: [Compression; 4] = [
    Compression::Uncompressed,
    Compression::Lzw,
    Compression::Deflate(tiff::encoder::DeflateLevel::Balanced),
    Compression::Packbits,
];

/// A TIFF file in several strips.
pub fn encoded_tiff(
    [width, height]: [usize; 2],
    data: &[u16],
    samples: usize,
    compression: Compression,
) -> Vec<u8> {
    let mut file = std::io::Cursor::new(Vec::new());
    let mut encoder = TiffEncoder::new(&mut file)
        .unwrap()
        .with_compression(compression);
    let (width, height) = (width as u32, height as u32);
    if samples == 3 {
        let mut image = encoder
            .new_image::<colortype::RGB16>(width, height)
            .unwrap();
        image.rows_per_strip(5).unwrap();
        image.write_data(data).unwrap();
    } else {
        let mut image = encoder
            .new_image::<colortype::Gray16>(width, height)
            .unwrap();
        image.rows_per_strip(5).unwrap();
        image.write_data(data).unwrap();
    }
    file.into_inner()
}

/// A TIFF file with the same image twice.
pub fn encoded_tiff_pages([width, height]: [usize; 2], data: &[u16]) -> Vec<u8> {
    let mut file = std::io::Cursor::new(Vec::new());
    let mut encoder = TiffEncoder::new(&mut file).unwrap();
    for _ in 0..2 {
        encoder
            .write_image::<colortype::Gray16>(width as u32, height as u32, data)
            .unwrap();
    }
    file.into_inner()
}

/// One entry of a TIFF directory: tag, type, count, value bytes.
pub struct Entry(u16, u16, u32, Vec<u8>);

impl Entry {
    pub fn short(tag: u16, value: u16) -> Self {
        Self(tag, 3, 1, value.to_le_bytes().to_vec())
    }

    fn long(tag: u16, value: u32) -> Self {
        Self(tag, 4, 1, value.to_le_bytes().to_vec())
    }

    pub fn bytes(tag: u16, value: &[u8]) -> Self {
        Self(tag, 7, value.len() as u32, value.to_vec())
    }

    /// An EXIF directory that states the color space sRGB, placed by [`tiff_with`].
    pub fn srgb_exif() -> Self {
        Self(34665, 4, 1, Vec::new())
    }
}

/// A monochrome little-endian TIFF file with one more entry, its image behind the header.
pub fn tiff_with([width, height]: [usize; 2], data: &[u16], more: Entry) -> Vec<u8> {
    let image_bytes = 2 * data.len();
    let mut entries = vec![
        Entry::long(256, width as u32),
        Entry::long(257, height as u32),
        Entry::short(258, 16),
        Entry::short(259, 1),
        Entry::short(262, 1),
        Entry::long(273, 8),
        Entry::short(277, 1),
        Entry::long(278, height as u32),
        Entry::long(279, image_bytes as u32),
        more,
    ];
    entries.sort_by_key(|e| e.0);
    let directory = 8 + image_bytes;
    let mut behind = directory + 2 + 12 * entries.len() + 4;
    let mut bytes = b"II\x2a\0".to_vec();
    bytes.extend_from_slice(&(directory as u32).to_le_bytes());
    bytes.extend(data.iter().flat_map(|v| v.to_le_bytes()));
    bytes.extend_from_slice(&(entries.len() as u16).to_le_bytes());
    let mut values = Vec::new();
    for Entry(tag, kind, count, mut value) in entries {
        bytes.extend_from_slice(&tag.to_le_bytes());
        bytes.extend_from_slice(&kind.to_le_bytes());
        bytes.extend_from_slice(&count.to_le_bytes());
        let at = (behind as u32).to_le_bytes();
        if value.is_empty() {
            // An EXIF directory with one entry: ColorSpace, 1.
            value = [&[1, 0, 1, 0xa0, 3, 0, 1, 0, 0, 0, 1, 0, 0, 0][..], &[0; 4]].concat();
            bytes.extend_from_slice(&at);
        } else if value.len() > 4 {
            bytes.extend_from_slice(&at);
        } else {
            value.resize(4, 0);
            bytes.append(&mut value);
        }
        behind += value.len();
        values.append(&mut value);
    }
    bytes.extend_from_slice(&[0; 4]);
    bytes.append(&mut values);
    bytes
}

/// A big-endian TIFF file, its image behind the header.
pub fn big_endian_tiff([width, height]: [usize; 2], data: &[u16], samples: u16) -> Vec<u8> {
    let image_bytes = 2 * data.len();
    let photometric = if samples == 3 { 2 } else { 1 };
    let bits_at = 8 + image_bytes;
    let directory = bits_at + 6;
    let entries: [(u16, u16, u32, u32); 9] = [
        (256, 4, 1, width as u32),
        (257, 4, 1, height as u32),
        if samples == 3 {
            (258, 3, 3, bits_at as u32)
        } else {
            (258, 3, 1, 16 << 16)
        },
        (259, 3, 1, 1 << 16),
        (262, 3, 1, photometric << 16),
        (273, 4, 1, 8),
        (277, 3, 1, u32::from(samples) << 16),
        (278, 4, 1, height as u32),
        (279, 4, 1, image_bytes as u32),
    ];
    let mut bytes = b"MM\0\x2a".to_vec();
    bytes.extend_from_slice(&(directory as u32).to_be_bytes());
    bytes.extend(data.iter().flat_map(|v| v.to_be_bytes()));
    bytes.extend_from_slice(&[0, 16, 0, 16, 0, 16]);
    bytes.extend_from_slice(&(entries.len() as u16).to_be_bytes());
    for (tag, kind, count, value) in entries {
        bytes.extend_from_slice(&tag.to_be_bytes());
        bytes.extend_from_slice(&kind.to_be_bytes());
        bytes.extend_from_slice(&count.to_be_bytes());
        bytes.extend_from_slice(&value.to_be_bytes());
    }
    bytes.extend_from_slice(&[0; 4]);
    bytes
}

/// A color profile whose gray curve is the identity.
pub fn linear_profile() -> Vec<u8> {
    let mut bytes = vec![0; 128];
    bytes.extend_from_slice(&1_u32.to_be_bytes());
    bytes.extend_from_slice(b"kTRC");
    bytes.extend_from_slice(&144_u32.to_be_bytes());
    bytes.extend_from_slice(&12_u32.to_be_bytes());
    bytes.extend_from_slice(b"curv\0\0\0\0\0\0\0\0");
    bytes
}

/// A 16-bit PNG file; `set` changes what its chunks say.
pub fn png(
    [width, height]: [usize; 2],
    data: &[u16],
    samples: usize,
    set: impl FnOnce(&mut png::Info<'_>),
) -> Vec<u8> {
    let mut info = png::Info::with_size(width as u32, height as u32);
    info.bit_depth = png::BitDepth::Sixteen;
    info.color_type = if samples == 3 {
        png::ColorType::Rgb
    } else {
        png::ColorType::Grayscale
    };
    set(&mut info);
    let mut bytes = Vec::new();
    let encoder = png::Encoder::with_info(&mut bytes, info).unwrap();
    let mut writer = encoder.write_header().unwrap();
    let words: Vec<u8> = data.iter().flat_map(|v| v.to_be_bytes()).collect();
    writer.write_image_data(&words).unwrap();
    writer.finish().unwrap();
    bytes
}

/// A small 8-bit PNG file.
pub fn png8(kind: png::ColorType) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, 4, 4);
    encoder.set_color(kind);
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header().unwrap();
    writer
        .write_image_data(&vec![9; 16 * kind.samples()])
        .unwrap();
    writer.finish().unwrap();
    bytes
}

/// Keyword and value of a FITS card, as written.
pub type Card<'a> = (&'a str, &'a str);

/// A FITS file of unsigned 16-bit values; the cards go before its own.
pub fn fits(
    [width, height]: [usize; 2],
    planes: usize,
    data: &[u16],
    cards: &[Card<'_>],
) -> Vec<u8> {
    let [width, height, planes_text] = [width, height, planes].map(|n| n.to_string());
    let mut all: Vec<Card<'_>> = vec![("SIMPLE", "T")];
    all.extend_from_slice(cards);
    all.extend([
        ("BITPIX", "16"),
        ("NAXIS", if planes > 1 { "3" } else { "2" }),
        ("NAXIS1", width.as_str()),
        ("NAXIS2", height.as_str()),
        ("NAXIS3", planes_text.as_str()),
        ("BZERO", "32768"),
        ("COMMENT", "of no meaning / here"),
    ]);
    let mut bytes = Vec::new();
    for (keyword, value) in all {
        let card = match value.starts_with('\'') {
            true => format!("{keyword:<8}= {value}"),
            false => format!("{keyword:<8}= {value:>20} / comment"),
        };
        bytes.extend_from_slice(format!("{card:<80}").as_bytes());
    }
    bytes.extend_from_slice(format!("{:<80}", "END").as_bytes());
    bytes.resize(bytes.len().next_multiple_of(2880), b' ');
    bytes.extend(data.iter().flat_map(|v| (v ^ 0x8000).to_be_bytes()));
    bytes.resize(bytes.len().next_multiple_of(2880), 0);
    bytes
}

/// Where the entry of a tag of the first directory of a little-endian TIFF file lies.
fn entry_of(bytes: &[u8], tag: u16) -> usize {
    let start = u32::from_le_bytes([bytes[4], bytes[5], bytes[6], bytes[7]]) as usize;
    let count = usize::from(u16::from_le_bytes([bytes[start], bytes[start + 1]]));
    let mut entries = (0..count).map(|i| start + 2 + 12 * i);
    entries
        .find(|&e| u16::from_le_bytes([bytes[e], bytes[e + 1]]) == tag)
        .unwrap()
}

/// The file with every value of a tag of shorts (or the low word of a long) set.
pub fn set_tag(bytes: &[u8], tag: u16, value: u16) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    let entry = entry_of(&bytes, tag);
    let word =
        |at: usize| u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
    let count = word(entry + 4) as usize;
    let at = if count > 2 {
        word(entry + 8) as usize
    } else {
        entry + 8
    };
    for i in 0..count {
        bytes[at + 2 * i..at + 2 * i + 2].copy_from_slice(&value.to_le_bytes());
    }
    bytes
}

/// The file with the values of a tag of longs set.
pub fn set_longs(bytes: &[u8], tag: u16, values: &[u32]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    let entry = entry_of(&bytes, tag);
    let at = u32::from_le_bytes([
        bytes[entry + 8],
        bytes[entry + 9],
        bytes[entry + 10],
        bytes[entry + 11],
    ]);
    for (i, value) in values.iter().enumerate() {
        let at = at as usize + 4 * i;
        bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
    }
    bytes
}

/// The file with a tag renamed.
pub fn rename_tag(bytes: &[u8], tag: u16, new: u16) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    let entry = entry_of(&bytes, tag);
    bytes[entry..entry + 2].copy_from_slice(&new.to_le_bytes());
    bytes
}
