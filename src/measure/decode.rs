//! One file to the raw values of the visible part of its sensor.
//!
//! Camera RAW files and compressed DNG go through `rawloader`; plain 16-bit DNG, TIFF, PNG and FITS are read by the files
//! beside this one. Refuses what would be read wrongly: docs/cameras.md lists it.

mod camera_raw;
mod dng;
mod exif_fields;
mod fits;
mod icc;
mod plain_png;
mod plain_tiff;
mod raw_claims;
mod tiff_structure;

use crate::base::{Context, Error, Result};
use crate::session::{CfaPattern, Layout};
use exif_fields::ExifFields;
use std::path::Path;
use tiff_structure::{DNG_VERSION, Tiff};

/// The visible part of a sensor, as read: black not subtracted, nothing scaled, never demosaiced.
#[derive(Debug, Clone, PartialEq)]
pub struct RawFrame {
    /// Camera maker, as in the file.
    pub make: String,
    /// Camera model, as in the file.
    pub model: String,
    /// Visible pixels per row.
    pub width: usize,
    /// Visible rows.
    pub height: usize,
    /// Masked pixels around the visible area: top, right, bottom, left.
    pub margins: [usize; 4],
    /// Which channels the pixels of the visible area have.
    pub layout: Layout,
    /// Black level of each place of the layout: of the visible area's 2x2 block, row by row; of the three channels; or one
    /// for all. 0 when the file and the camera table state none, and for places the layout does not have.
    pub black: [f64; 4],
    /// Raw value at which pixels saturate.
    pub white: u16,
    /// `width * height` times [`Layout::values_per_pixel`] raw values, row by row.
    pub data: Vec<u16>,
    /// Exposure time by EXIF, milliseconds.
    pub exposure_ms: Option<f64>,
    /// Aperture by EXIF, as an f-number.
    pub aperture: Option<f64>,
    /// Sensitivity by EXIF.
    pub iso: Option<u32>,
    /// Time stamp by EXIF, as written.
    pub date_time: Option<String>,
}

impl RawFrame {
    /// The values of the pixel (x, y): channel (0 red, 1 green, 2 blue) and index in the data. The one value of
    /// [`Layout::Mono`] is given as channel 0.
    pub fn values_at(&self, x: usize, y: usize) -> impl Iterator<Item = (usize, usize)> {
        let pixel = y * self.width + x;
        let (channel, first, count) = match self.layout {
            Layout::Bayer(cfa) => (cfa.channel(y, x), pixel, 1),
            Layout::Mono => (0, pixel, 1),
            Layout::Rgb => (0, 3 * pixel, 3),
        };
        (0..count).map(move |i| (channel + i, first + i))
    }

    /// A raw value as fraction of the way from the black level of its place to the white level.
    pub fn fraction(&self, value: u16, index: usize) -> f64 {
        let black = self.black[self.layout.place(self.width, index)];
        (f64::from(value) - black) / (f64::from(self.white) - black)
    }
}

/// Reads and decodes a frame's file; see [`decode`].
///
/// # Errors
/// With the path: when it cannot be read, or as [`decode`].
pub fn decode_file(path: &Path) -> Result<RawFrame> {
    let bytes = std::fs::read(path).context(|| format!("{} cannot be read", path.display()))?;
    decode(&bytes).context(|| format!("{} cannot be decoded", path.display()))
}

/// Decodes the bytes of a frame: any camera the decoder knows with a 2x2 red-green-blue mosaic, DNG, and linear 16-bit TIFF,
/// PNG and FITS.
///
/// # Errors
/// When the file is torn, no image, of an unknown camera, compressed in a way that is not read, has another mosaic, fewer
/// than 16 bits in a container for pictures, levels without meaning, or says that its values are not linear.
pub fn decode(bytes: &[u8]) -> Result<RawFrame> {
    let frame = decode_any(bytes)?;
    if frame.black.iter().all(|&b| b < f64::from(frame.white)) {
        return Ok(frame);
    }
    Err(Error::new(format!(
        "black levels {:?} that are not below the white level {}",
        frame.black, frame.white
    ))
    .with_hint(CONVERT))
}

fn decode_any(bytes: &[u8]) -> Result<RawFrame> {
    if fits::is_fits(bytes) {
        return fits::decode(bytes);
    }
    if bytes.starts_with(plain_png::SIGNATURE) {
        return plain_png::decode(bytes);
    }
    refuse_by_name(bytes)?;
    let Some(tiff) = Tiff::open(bytes) else {
        return camera_raw::decode(bytes, None);
    };
    let directories = tiff.directories()?;
    if bytes.get(8..10) == Some(b"CR") {
        for directory in &directories {
            tiff.check_whole(directory)?;
        }
    }
    if directories.iter().any(|d| d.find(DNG_VERSION).is_some()) {
        let facts = dng::inspect(&tiff, &directories)?;
        let Some(mut frame) = facts.plain(bytes)? else {
            return camera_raw::decode(bytes, Some(&facts));
        };
        ExifFields::read(bytes).fill(&mut frame);
        return Ok(frame);
    }
    if plain_tiff::is_plain(&tiff, &directories) {
        return plain_tiff::decode(&tiff, &directories);
    }
    camera_raw::decode(bytes, None)
}

const CONVERT: &str = "convert to uncompressed DNG";

/// Refuses formats that are told by their first bytes and never read.
fn refuse_by_name(bytes: &[u8]) -> Result<()> {
    let bad = |what: &str, hint: &str| Err(Error::new(what).with_hint(hint));
    if bytes.get(4..8) == Some(b"ftyp") {
        return bad(
            "a Canon CR3 or other ISO media file, which the decoder does not read",
            CONVERT,
        );
    }
    if bytes.starts_with(b"\xff\xd8\xff") {
        return bad(
            "a JPEG image: its values are neither linear nor complete",
            "store the camera's RAW files",
        );
    }
    if bytes.starts_with(b"II\x2b\0") || bytes.starts_with(b"MM\0\x2b") {
        return bad("a BigTIFF file, which is not read", "write classic TIFF");
    }
    Ok(())
}

/// Columns and rows inside the margins (top, right, bottom, left).
fn visible_size([width, height]: [usize; 2], margins: [usize; 4]) -> Result<[usize; 2]> {
    let [top, right, bottom, left] = margins;
    let inside = |whole: usize, a: usize, b: usize| whole.checked_sub(a + b).filter(|&n| n > 0);
    match (inside(width, left, right), inside(height, top, bottom)) {
        (Some(width), Some(height)) => Ok([width, height]),
        _ => Err(Error::new(format!(
            "the margins {margins:?} leave nothing of {width} x {height} pixels"
        ))),
    }
}

/// The mosaic with these channels.
fn bayer(channels: [usize; 4], name: &str) -> Result<Layout> {
    let pattern = CfaPattern::from_channels(channels);
    pattern.map(Layout::Bayer).ok_or_else(|| no_bayer(name))
}

fn no_bayer(name: &str) -> Error {
    Error::new(format!(
        "color filter array '{name}', expected a 2 x 2 pattern of red, green and blue"
    ))
    .with_hint("of mosaics only Bayer's are measured")
}

/// Checks the size a file states before memory is asked for: packed at most `ratio` times smaller it must fit the file.
fn check_size(size: [usize; 2], values_per_pixel: usize, bytes: &[u8], ratio: usize) -> Result<()> {
    let [width, height] = size;
    let needed = width.checked_mul(height);
    let needed = needed.and_then(|n| n.checked_mul(2 * values_per_pixel));
    match needed {
        Some(0) => Err(Error::new(format!("an image of {width} x {height} pixels"))),
        Some(needed) if needed / ratio <= bytes.len() => Ok(()),
        _ => Err(tiff_structure::torn(&format!(
            "its image: {} bytes cannot hold {width} x {height} pixels",
            bytes.len()
        ))),
    }
}

fn srgb(whose: &str) -> Error {
    Error::new(format!(
        "sRGB-encoded values are not linear (so says {whose})"
    ))
    .with_hint("export linear 16-bit values, or the camera's RAW files")
}
