//! Little-endian TIFF files under construction: what DNG and plain TIFF frames have in common.

use crate::base::{Error, Result};

/// Tags whose values are known only once all is laid out.
pub(super) mod tag {
    pub(in crate::session) const EXIF_IFD: u16 = 34665;
    pub(in crate::session) const STRIP_OFFSETS: u16 = 273;
}

/// Where the main directory begins.
const HEADER: usize = 8;

/// Offsets in the file have 32 bits.
const MOST_VALUES: usize = 2_000_000_000;

/// What every frame file must get right.
pub(super) struct Described<'a> {
    /// `DNG` or `TIFF`, for messages.
    pub(super) kind: &'static str,
    /// Columns, rows.
    pub(super) size: [usize; 2],
    pub(super) values_per_pixel: usize,
    pub(super) data: &'a [u16],
    /// The largest value the samples can hold.
    pub(super) largest: u16,
    pub(super) white: u16,
    pub(super) texts: &'a [&'a str],
    pub(super) exposure_ms: Option<f64>,
}

/// Fails when a description does not fit its data or has no meaning.
pub(super) fn check_image(image: &Described<'_>) -> Result<()> {
    let bad = |what: String| {
        Err(Error::new(format!(
            "{} cannot be written: {what}",
            image.kind
        )))
    };
    let [width, height] = image.size;
    if !(1..=60000).contains(&width) || !(1..=60000).contains(&height) {
        return bad(format!(
            "size {width} x {height}, expected 1 to 60000 pixels each way"
        ));
    }
    let expected = width * height * image.values_per_pixel;
    if image.data.len() != expected {
        return bad(format!(
            "{} raw values for {width} x {height} pixels, expected {expected}",
            image.data.len()
        ));
    }
    if expected > MOST_VALUES {
        return bad(format!(
            "{expected} raw values, expected {MOST_VALUES} at most"
        ));
    }
    if let Some(at) = image.data.iter().position(|&v| v > image.largest) {
        let pixel = at / image.values_per_pixel;
        return bad(format!(
            "raw value {} at column {}, row {} is above {}",
            image.data[at],
            pixel % width,
            pixel / width,
            image.largest
        ));
    }
    if image.white == 0 || image.white > image.largest {
        return bad(format!(
            "white level {}, expected 1 to {}",
            image.white, image.largest
        ));
    }
    for text in image.texts {
        if text.is_empty() || !text.bytes().all(|b| (0x20..0x7f).contains(&b)) {
            return bad(format!("text '{text}' is not printable ASCII"));
        }
    }
    match image.exposure_ms {
        Some(ms) if !(1e-6..4e9).contains(&ms) => bad(format!(
            "exposure {ms} ms, expected 1e-6 to 4e9 milliseconds"
        )),
        _ => Ok(()),
    }
}

/// The bytes of a file: header, main directory, EXIF directory, one strip. The main directory has the tags of [`tag`].
pub(super) fn file(mut main: Directory, exif: &Directory, strip: &[u8]) -> Vec<u8> {
    let exif_at = HEADER + main.size();
    let strip_at = (exif_at + exif.size()).next_multiple_of(16);
    main.set_long(tag::EXIF_IFD, exif_at);
    main.set_long(tag::STRIP_OFFSETS, strip_at);
    let mut bytes = Vec::with_capacity(strip_at + strip.len());
    bytes.extend_from_slice(b"II");
    bytes.extend_from_slice(&42u16.to_le_bytes());
    bytes.extend_from_slice(&(HEADER as u32).to_le_bytes());
    main.write(&mut bytes);
    exif.write(&mut bytes);
    bytes.resize(strip_at, 0);
    bytes.extend_from_slice(strip);
    bytes
}

/// The EXIF directory of a frame.
pub(super) fn exif_directory(
    exposure_ms: Option<f64>,
    iso: Option<u16>,
    date_time: Option<&str>,
) -> Result<Directory> {
    let mut d = Directory::default();
    if let Some(ms) = exposure_ms {
        d.rationals(33434, &[seconds_rational(ms)?]);
    }
    if let Some(iso) = iso {
        d.shorts(34855, &[iso]);
    }
    d.undefined(36864, b"0232"); // ExifVersion
    if let Some(text) = date_time {
        d.ascii(36867, text); // DateTimeOriginal
    }
    Ok(d)
}

/// Milliseconds as a fraction of seconds, with the finest decimal denominator that fits.
fn seconds_rational(ms: f64) -> Result<[u32; 2]> {
    let seconds = ms / 1000.0;
    (0..=9)
        .rev()
        .map(|digits| 10u32.pow(digits))
        .find(|&d| seconds * f64::from(d) < f64::from(u32::MAX))
        .map(|d| [(seconds * f64::from(d)).round() as u32, d])
        .ok_or_else(|| Error::new(format!("exposure {ms} ms does not fit an EXIF fraction")))
}

/// A TIFF image file directory under construction; tags must be added in ascending order.
#[derive(Default)]
pub(super) struct Directory {
    /// Tag, TIFF type, count, value bytes.
    entries: Vec<(u16, u16, u32, Vec<u8>)>,
}

impl Directory {
    fn add(&mut self, tag: u16, kind: u16, count: usize, value: Vec<u8>) {
        debug_assert!(self.entries.last().is_none_or(|e| e.0 < tag));
        self.entries.push((tag, kind, count as u32, value));
    }

    pub(super) fn bytes(&mut self, tag: u16, values: &[u8]) {
        self.add(tag, 1, values.len(), values.to_vec());
    }

    pub(super) fn ascii(&mut self, tag: u16, text: &str) {
        let mut value = text.as_bytes().to_vec();
        value.push(0);
        self.add(tag, 2, value.len(), value);
    }

    pub(super) fn shorts(&mut self, tag: u16, values: &[u16]) {
        let value = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.add(tag, 3, values.len(), value);
    }

    pub(super) fn longs(&mut self, tag: u16, values: &[u32]) {
        let value = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.add(tag, 4, values.len(), value);
    }

    pub(super) fn rationals(&mut self, tag: u16, values: &[[u32; 2]]) {
        let value = values.iter().flatten().flat_map(|v| v.to_le_bytes());
        self.add(tag, 5, values.len(), value.collect());
    }

    pub(super) fn undefined(&mut self, tag: u16, values: &[u8]) {
        self.add(tag, 7, values.len(), values.to_vec());
    }

    pub(super) fn signed_rationals(&mut self, tag: u16, values: &[[i32; 2]]) {
        let value = values.iter().flatten().flat_map(|v| v.to_le_bytes());
        self.add(tag, 10, values.len(), value.collect());
    }

    /// Puts the value of a single-LONG entry that was added with a placeholder.
    fn set_long(&mut self, tag: u16, value: usize) {
        for entry in self.entries.iter_mut().filter(|e| e.0 == tag) {
            entry.3 = (value as u32).to_le_bytes().to_vec();
        }
    }

    fn table_size(&self) -> usize {
        2 + 12 * self.entries.len() + 4
    }

    /// Bytes of the table and of the values that do not fit into it; even.
    fn size(&self) -> usize {
        let long_values = self.entries.iter().filter(|e| e.3.len() > 4);
        self.table_size()
            + long_values
                .map(|e| e.3.len().next_multiple_of(2))
                .sum::<usize>()
    }

    /// Appends table and values to the file written so far.
    fn write(&self, file: &mut Vec<u8>) {
        let start = file.len();
        let mut values = Vec::new();
        file.extend_from_slice(&(self.entries.len() as u16).to_le_bytes());
        for (tag, kind, count, value) in &self.entries {
            file.extend_from_slice(&tag.to_le_bytes());
            file.extend_from_slice(&kind.to_le_bytes());
            file.extend_from_slice(&count.to_le_bytes());
            if value.len() <= 4 {
                let mut inline = value.clone();
                inline.resize(4, 0);
                file.extend_from_slice(&inline);
            } else {
                let at = start + self.table_size() + values.len();
                file.extend_from_slice(&(at as u32).to_le_bytes());
                values.extend_from_slice(value);
                values.resize(values.len().next_multiple_of(2), 0);
            }
        }
        file.extend_from_slice(&0u32.to_le_bytes());
        file.extend_from_slice(&values);
    }
}
