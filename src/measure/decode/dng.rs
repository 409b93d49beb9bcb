//! What a DNG file says about itself before it is decoded: refuses what would be read wrongly or not at all, and reads
//! uncompressed 16-bit samples, which need no decoder.

use super::tiff_structure::{
    BITS, BLACK_LEVEL, COMPRESSION, Directory, HEIGHT, MAKE, MODEL, NEW_SUBFILE_TYPE, PHOTOMETRIC,
    PLANAR, SAMPLES, STRIP_BYTES, STRIP_OFFSETS, Tiff, WHITE_LEVEL, WIDTH, torn,
};
use super::{CONVERT, RawFrame, visible_size};
use crate::base::{Error, Result};
use crate::session::Layout;

const CFA_PATTERN: u16 = 33422;
const LINEARIZATION_TABLE: u16 = 50712;
const BLACK_REPEAT: u16 = 50713;
const ACTIVE_AREA: u16 = 50829;

/// [`PHOTOMETRIC`] of a mosaic, or of a sensor without color filters.
const COLOR_FILTER_ARRAY: usize = 32803;
/// [`PHOTOMETRIC`] of one linear value per sample.
const LINEAR_RAW: usize = 34892;

/// What a DNG says about its samples. Patterns begin at the top left corner of the active area.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct DngFacts {
    pub(super) layout: Layout,
    /// Black level of each place of the layout, with its fraction.
    pub(super) black: [f64; 4],
    /// Where the samples lie, when they are plain 16-bit words.
    words: Option<Words>,
}

/// An image of little-endian 16-bit words.
#[derive(Debug, Clone, PartialEq)]
struct Words {
    at: usize,
    /// Columns and rows, margins included.
    size: [usize; 2],
    /// Top, right, bottom, left.
    margins: [usize; 4],
    white: u16,
    make: String,
    model: String,
}

/// Looks at the structure of a DNG file.
///
/// # Errors
/// When it is torn, or of a kind that is not read or would be read wrongly.
pub(super) fn inspect(tiff: &Tiff<'_>, directories: &[Directory]) -> Result<DngFacts> {
    let full_size = |d: &&Directory| {
        d.find(COMPRESSION).is_some() && tiff.value(d, NEW_SUBFILE_TYPE).unwrap_or(0) & 1 == 0
    };
    // The decoder takes the first full-size image with a compression it knows of.
    let known = |d: &&Directory| matches!(tiff.value(d, COMPRESSION), Some(1 | 7 | 0x884c));
    let main = directories.iter().find(full_size);
    let Some(raw) = directories.iter().filter(full_size).find(known) else {
        let compression = main.and_then(|d| tiff.value(d, COMPRESSION));
        return Err(match compression {
            Some(c) => Error::new(format!("DNG compression {c} is not read")).with_hint(CONVERT),
            None => Error::new("the DNG file holds no full-size image"),
        });
    };
    let layout = layout(tiff, raw)?;
    if raw.find(LINEARIZATION_TABLE).is_some() {
        return Err(Error::new(
            "the DNG file's values need a linearization table, which the decoder does not apply",
        )
        .with_hint("convert to uncompressed linear 16-bit DNG"));
    }
    tiff.check_whole(raw)?;
    let mut words = None;
    match tiff.value(raw, COMPRESSION) {
        Some(1) => words = uncompressed(tiff, raw, layout)?,
        Some(0x884c) => {
            return Err(Error::new("a DNG file with lossy compression").with_hint(CONVERT));
        }
        _ => {}
    }
    let mosaic = tiff.value(raw, PHOTOMETRIC) == Some(COLOR_FILTER_ARRAY);
    if mosaic && raw.find(CFA_PATTERN).is_none() && words.is_none() {
        return Err(Error::new(
            "a DNG file that names no color filters and whose samples are not plain 16-bit words",
        )
        .with_hint("convert to uncompressed 16-bit DNG"));
    }
    let margins = margins(tiff, raw)?;
    if let Some(words) = &mut words {
        words.margins = margins;
        words.make = text(tiff, directories, MAKE);
        words.model = text(tiff, directories, MODEL);
    }
    Ok(DngFacts {
        layout,
        black: black(tiff, raw, layout)?,
        words,
    })
}

impl DngFacts {
    /// The frame, when its samples are plain 16-bit words.
    ///
    /// # Errors
    /// When the margins leave nothing.
    pub(super) fn plain(&self, bytes: &[u8]) -> Result<Option<RawFrame>> {
        let Some(words) = &self.words else {
            return Ok(None);
        };
        let [width, height] = visible_size(words.size, words.margins)?;
        let values = self.layout.values_per_pixel();
        let [top, _, _, left] = words.margins;
        let row_bytes = 2 * values * words.size[0];
        let lost = || torn("its image");
        let mut data = Vec::with_capacity(width * height * values);
        for row in top..top + height {
            let start = words.at + row * row_bytes + 2 * values * left;
            let samples = bytes.get(start..start + 2 * values * width);
            let samples = samples.ok_or_else(lost)?.chunks_exact(2);
            data.extend(samples.map(|b| u16::from_le_bytes([b[0], b[1]])));
        }
        Ok(Some(RawFrame {
            make: words.make.clone(),
            model: words.model.clone(),
            width,
            height,
            margins: words.margins,
            layout: self.layout,
            black: self.black,
            white: words.white,
            data,
            exposure_ms: None,
            aperture: None,
            iso: None,
            date_time: None,
        }))
    }
}

/// A text of the first directory that has it.
fn text(tiff: &Tiff<'_>, directories: &[Directory], tag: u16) -> String {
    let mut texts = directories.iter().map(|d| tiff.text(d, tag));
    texts.find(|t| !t.is_empty()).unwrap_or_default()
}

fn layout(tiff: &Tiff<'_>, raw: &Directory) -> Result<Layout> {
    let samples = tiff.value(raw, SAMPLES).unwrap_or(1);
    match (tiff.value(raw, PHOTOMETRIC), samples) {
        (Some(COLOR_FILTER_ARRAY), 1) if raw.find(CFA_PATTERN).is_none() => Ok(Layout::Mono),
        (Some(COLOR_FILTER_ARRAY), 1) => {
            let pattern = tiff.values(raw, CFA_PATTERN).unwrap_or_default();
            let [a, b, c, d] = pattern[..] else {
                return Err(Error::new(format!(
                    "a color filter array of {} places, expected 2 x 2",
                    pattern.len()
                )));
            };
            super::bayer([a, b, c, d].map(|v| v as usize), &format!("{pattern:?}"))
        }
        (Some(LINEAR_RAW), 1) => Ok(Layout::Mono),
        (Some(LINEAR_RAW), 3) if tiff.value(raw, PLANAR).unwrap_or(1) == 1 => Ok(Layout::Rgb),
        (Some(COLOR_FILTER_ARRAY | LINEAR_RAW), samples) => Err(Error::new(format!(
            "a DNG file with {samples} samples per pixel, expected one, or three interleaved linear ones"
        ))
        .with_hint("convert without demosaicing")),
        _ => Err(Error::new(
            "the DNG file holds no color filter mosaic and no linear raw image (a demosaiced image)",
        )
        .with_hint("measuring needs the camera's raw values; convert without demosaicing")),
    }
}

/// Checks an uncompressed image; where it lies when it is of 16-bit words.
fn uncompressed(tiff: &Tiff<'_>, raw: &Directory, layout: Layout) -> Result<Option<Words>> {
    let missing = || Error::new("the DNG file does not state the size or place of its image");
    let width = tiff.value(raw, WIDTH).ok_or_else(missing)?;
    let height = tiff.value(raw, HEIGHT).ok_or_else(missing)?;
    let bits = tiff.value(raw, BITS).ok_or_else(missing)?;
    let values = layout.values_per_pixel();
    let row_bytes = match bits {
        16 if tiff.big_endian => {
            return Err(Error::new(
                "a big-endian 16-bit DNG file, which the decoder reads wrongly",
            )
            .with_hint("convert to little-endian uncompressed DNG"));
        }
        16 => width * 2 * values,
        12 if width % 2 == 1 => {
            return Err(Error::new(
                "a 12-bit DNG file of odd width, which the decoder reads wrongly",
            )
            .with_hint("convert to 16-bit uncompressed DNG"));
        }
        12 if values == 1 => width / 2 * 3,
        _ => {
            return Err(Error::new(format!(
                "{bits} bits per sample in an uncompressed DNG file, expected 12 or 16"
            ))
            .with_hint("convert to 16-bit uncompressed DNG"));
        }
    };
    let offsets = tiff.values(raw, STRIP_OFFSETS).ok_or_else(missing)?;
    let sizes = tiff.values(raw, STRIP_BYTES).ok_or_else(missing)?;
    let contiguous = offsets
        .windows(2)
        .zip(&sizes)
        .all(|(pair, size)| (pair[0] + size - pair[1]).abs() < 0.5);
    if !contiguous || offsets.len() != sizes.len() {
        return Err(
            Error::new("the strips of the DNG file do not follow one another")
                .with_hint("convert to uncompressed DNG with one strip"),
        );
    }
    let total: f64 = sizes.iter().sum();
    let expected = row_bytes as f64 * height as f64;
    if total < expected {
        return Err(torn(&format!(
            "its image: {total} bytes where {width} x {height} pixels of {bits} bits need {expected}"
        )));
    }
    let levels = tiff.values(raw, WHITE_LEVEL).unwrap_or_default();
    let white = levels.into_iter().filter(|w| *w >= 1.0);
    let white = white.fold(f64::from(u16::MAX), f64::min);
    let at = offsets.first().copied().ok_or_else(missing)?;
    Ok((bits == 16).then(|| Words {
        at: at as usize,
        size: [width, height],
        margins: [0; 4],
        white: white as u16,
        make: String::new(),
        model: String::new(),
    }))
}

/// Pixels around the active area: top, right, bottom, left.
fn margins(tiff: &Tiff<'_>, raw: &Directory) -> Result<[usize; 4]> {
    if raw.find(ACTIVE_AREA).is_none() {
        return Ok([0; 4]);
    }
    let area = tiff.values(raw, ACTIVE_AREA).unwrap_or_default();
    let width = tiff.value(raw, WIDTH).unwrap_or(0) as f64;
    let height = tiff.value(raw, HEIGHT).unwrap_or(0) as f64;
    match area[..] {
        [top, left, bottom, right]
            if top < bottom && bottom <= height && left < right && right <= width =>
        {
            Ok([top, width - right, height - bottom, left].map(|side| side as usize))
        }
        _ => Err(Error::new(format!(
            "active area {area:?} does not fit a DNG image of {width} x {height} pixels"
        ))),
    }
}

/// Black level of each place of the layout (default 0, one value for all, or a repeating pattern of places, each with
/// one value per sample). A layout of fewer places than the pattern has gets their mean.
fn black(tiff: &Tiff<'_>, raw: &Directory, layout: Layout) -> Result<[f64; 4]> {
    let levels = tiff.values(raw, BLACK_LEVEL).unwrap_or(vec![0.0]);
    let repeat = tiff.values(raw, BLACK_REPEAT).unwrap_or(vec![1.0, 1.0]);
    let (rows, columns) = match repeat[..] {
        [r, c] if (1.0..=2.0).contains(&r) && (1.0..=2.0).contains(&c) => (r as usize, c as usize),
        _ => {
            return Err(Error::new(format!(
                "black levels repeat every {repeat:?} pixels, expected 1 or 2"
            )));
        }
    };
    let samples = layout.values_per_pixel();
    let level = |row: usize, column: usize, sample: usize| {
        let index = ((row % rows) * columns + column % columns) * samples + sample;
        let index = if levels.len() == 1 { 0 } else { index };
        match levels.get(index) {
            Some(level) if (0.0..65536.0).contains(level) => Ok(*level),
            _ => Err(Error::new(format!(
                "black levels {levels:?} of the DNG file"
            ))),
        }
    };
    let block = [(0, 0), (0, 1), (1, 0), (1, 1)];
    let mut black = [0.0; 4];
    for place in 0..layout.places() {
        black[place] = match layout {
            Layout::Bayer(_) => level(block[place].0, block[place].1, 0)?,
            Layout::Mono | Layout::Rgb => {
                let mut sum = 0.0;
                for (row, column) in block {
                    sum += level(row, column, place)?;
                }
                sum / block.len() as f64
            }
        };
    }
    Ok(black)
}
