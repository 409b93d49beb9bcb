//! FITS files (FITS standard 4.0) as cameras for science write them: a primary image of 16-bit integers, with or without a
//! mosaic, or three planes.
//!
//! Reads no extensions, tables, compression or floating point values. `BAYERPAT` names the filters from the first pixel
//! stored, whichever way up the rows are; files without `ROWORDER` are taken as top down, as camera drivers write them.

use super::tiff_structure::torn;
use super::{RawFrame, check_size};
use crate::base::{Error, Result};
use crate::session::{CfaPattern, Layout};
use std::collections::BTreeMap;

const BLOCK: usize = 2880;
const CARD: usize = 80;

/// True when the bytes begin as a FITS file does.
pub(super) fn is_fits(bytes: &[u8]) -> bool {
    bytes.starts_with(b"SIMPLE  =")
}

/// Decodes the primary image.
///
/// # Errors
/// When the file is torn, or its image is of another kind.
pub(super) fn decode(bytes: &[u8]) -> Result<RawFrame> {
    let header = Header::read(bytes)?;
    let shape = Shape::of(&header)?;
    let [width, height] = shape.size;
    let values = shape.layout.values_per_pixel();
    let image = &bytes[header.end.min(bytes.len())..];
    check_size(shape.size, values, image, 1)?;
    let white = header.number("SATURATE")?;
    let white = white.map_or(shape.largest(), |w| w.min(shape.largest()));
    if white < 1.0 {
        return Err(Error::new(format!("a FITS file saturated at {white}"))
            .with_hint("mend the keyword SATURATE"));
    }
    let blank = header.whole("BLANK")?;
    let mut data = vec![0; width * height * values];
    for sample in 0..values {
        for y in 0..height {
            let stored = if shape.bottom_up { height - 1 - y } else { y };
            let at = 2 * width * (sample * height + stored);
            let row = image[at..at + 2 * width].chunks_exact(2);
            for (x, pair) in row.enumerate() {
                let stored = i16::from_be_bytes([pair[0], pair[1]]);
                if (!shape.unsigned && stored < 0) || blank == Some(i64::from(stored)) {
                    return Err(no_value(x, y));
                }
                let sign = if shape.unsigned { 0x8000 } else { 0 };
                data[values * (width * y + x) + sample] = stored as u16 ^ sign;
            }
        }
    }
    Ok(RawFrame {
        make: header.text("CAMMAKER"),
        model: header.text("INSTRUME"),
        width,
        height,
        margins: [0; 4],
        layout: shape.layout,
        black: [0.0; 4],
        white: white as u16,
        data,
        exposure_ms: header.exposure_ms()?,
        aperture: header.number("FOCRATIO")?.filter(|f| *f > 0.0),
        iso: header.sensitivity()?,
        date_time: Some(header.text("DATE-OBS")).filter(|t| !t.is_empty()),
    })
}

fn no_value(x: usize, y: usize) -> Error {
    Error::new(format!(
        "the pixel in column {x}, row {y} of the FITS image is negative or blank, expected a raw value"
    ))
    .with_hint("write raw frames, not calibrated ones, as unsigned 16-bit values (BZERO = 32768)")
}

/// The primary header: keyword and value, as written.
struct Header {
    cards: BTreeMap<String, String>,
    /// Where the data begin.
    end: usize,
}

impl Header {
    fn read(bytes: &[u8]) -> Result<Self> {
        let mut cards = BTreeMap::new();
        for (number, card) in bytes.chunks_exact(CARD).enumerate() {
            let text: String = card.iter().map(|&b| char::from(b)).collect();
            let keyword = text[..text.char_indices().nth(8).map_or(0, |c| c.0)].trim_end();
            if keyword == "END" {
                let end = ((number + 1) * CARD).next_multiple_of(BLOCK);
                return Ok(Self { cards, end });
            }
            if card[8] == b'=' && !cards.contains_key(keyword) {
                let value: String = text.chars().skip(9).collect();
                cards.insert(keyword.to_owned(), value_of(&value));
            }
        }
        Err(torn("the FITS header"))
    }

    /// A text; empty when the keyword is missing.
    fn text(&self, keyword: &str) -> String {
        self.cards.get(keyword).cloned().unwrap_or_default()
    }

    fn number(&self, keyword: &str) -> Result<Option<f64>> {
        let Some(text) = self.cards.get(keyword).filter(|t| !t.is_empty()) else {
            return Ok(None);
        };
        // Fortran's exponents may be written with D.
        match text.replace(['D', 'd'], "E").parse::<f64>() {
            Ok(number) if number.is_finite() => Ok(Some(number)),
            _ => Err(Error::new(format!(
                "keyword {keyword} of the FITS file is '{text}', expected a number"
            ))),
        }
    }

    fn whole(&self, keyword: &str) -> Result<Option<i64>> {
        match self.number(keyword)? {
            Some(n) if n.fract() != 0.0 || n.abs() > 1e9 => Err(Error::new(format!(
                "keyword {keyword} of the FITS file is {n}, expected a whole number"
            ))),
            n => Ok(n.map(|n| n as i64)),
        }
    }

    /// A number of pixels.
    fn count(&self, keyword: &str) -> Result<usize> {
        let count = self.whole(keyword)?.unwrap_or(0);
        usize::try_from(count)
            .ok()
            .filter(|&n| n > 0)
            .ok_or_else(|| {
                Error::new(format!(
                    "keyword {keyword} of the FITS file is {count}, expected 1 or more"
                ))
            })
    }

    fn exposure_ms(&self) -> Result<Option<f64>> {
        let seconds = match self.number("EXPTIME")? {
            None => self.number("EXPOSURE")?,
            seconds => seconds,
        };
        Ok(seconds.filter(|s| *s > 0.0).map(|s| 1000.0 * s))
    }

    /// The sensitivity, or the gain, when it is a whole number.
    fn sensitivity(&self) -> Result<Option<u32>> {
        let stated = match self.number("ISOSPEED")? {
            None => self.number("GAIN")?,
            stated => stated,
        };
        Ok(stated
            .filter(|g| g.fract() == 0.0 && (0.0..=4e9).contains(g))
            .map(|g| g as u32))
    }
}

/// The value of a card's text after `=`: what stands in quotes (two of them stand for one), or up to the comment.
fn value_of(text: &str) -> String {
    let text = text.trim_start();
    let Some(quoted) = text.strip_prefix('\'') else {
        return text.split('/').next().unwrap_or("").trim().to_owned();
    };
    let mut value = String::new();
    let mut rest = quoted.chars().peekable();
    while let Some(c) = rest.next() {
        if c == '\'' && rest.next_if_eq(&'\'').is_none() {
            break;
        }
        value.push(c);
    }
    value.trim().to_owned()
}

/// What kind of image it is.
struct Shape {
    size: [usize; 2],
    layout: Layout,
    bottom_up: bool,
    /// 32768 was taken off the values, so that they fit signed integers.
    unsigned: bool,
}

impl Shape {
    fn of(header: &Header) -> Result<Self> {
        let bits = header.whole("BITPIX")?.unwrap_or(0);
        if bits != 16 {
            return Err(
                Error::new(format!("a FITS image of BITPIX {bits}, expected 16"))
                    .with_hint("write the camera's 16-bit integers, neither scaled nor calibrated"),
            );
        }
        let axes = header.whole("NAXIS")?.unwrap_or(0);
        let planes = match axes {
            2 => 1,
            3 => header.count("NAXIS3")?,
            _ => {
                return Err(Error::new(format!(
                    "a FITS file whose primary image has {axes} axes, expected 2 or 3"
                ))
                .with_hint(
                    "extensions and compressed images (fpack) are not read; write a plain image",
                ));
            }
        };
        let size = [header.count("NAXIS1")?, header.count("NAXIS2")?];
        let bottom_up = match header.text("ROWORDER").to_uppercase().as_str() {
            "" | "TOP-DOWN" => false,
            "BOTTOM-UP" => true,
            other => {
                return Err(Error::new(format!(
                    "keyword ROWORDER of the FITS file is '{other}', expected TOP-DOWN or BOTTOM-UP"
                )));
            }
        };
        let layout = match (planes, pattern(header)?) {
            (1, None) => Layout::Mono,
            // The last row stored comes to the top.
            (1, Some(cfa)) => {
                Layout::Bayer(cfa.shifted(if bottom_up { size[1] - 1 } else { 0 }, 0))
            }
            (3, None) => Layout::Rgb,
            _ => {
                return Err(Error::new(format!(
                    "a FITS image of {planes} planes, expected 1 or 3, and of several only without a mosaic"
                ))
                .with_hint("write one frame into each file"));
            }
        };
        let scale = header.number("BSCALE")?.unwrap_or(1.0);
        let offset = header.number("BZERO")?.unwrap_or(0.0);
        let is = |value: f64, wanted: f64| (value - wanted).abs() < 1e-9;
        if !is(scale, 1.0) || !(is(offset, 0.0) || is(offset, 32768.0)) {
            return Err(Error::new(format!(
                "a FITS image with BSCALE {scale} and BZERO {offset}, expected 1 and 32768, or 1 and 0"
            ))
            .with_hint("write the camera's integers as they are"));
        }
        Ok(Self {
            size,
            layout,
            bottom_up,
            unsigned: offset > 1.0,
        })
    }

    /// The largest value there can be.
    fn largest(&self) -> f64 {
        if self.unsigned { 65535.0 } else { 32767.0 }
    }
}

/// The mosaic from the first pixel stored.
fn pattern(header: &Header) -> Result<Option<CfaPattern>> {
    let name = match header.text("BAYERPAT") {
        name if name.is_empty() => header.text("COLORTYP"),
        name => name,
    };
    let channels: Option<Vec<usize>> = name.to_uppercase().chars().map(|c| "RGB".find(c)).collect();
    let cfa = match (name.to_uppercase().as_str(), channels.as_deref()) {
        ("" | "NONE" | "MONO" | "MONOCHROME" | "RGB" | "COLOR", _) => return Ok(None),
        (_, Some(&[a, b, c, d])) => CfaPattern::from_channels([a, b, c, d]),
        _ => None,
    };
    let cfa = cfa.ok_or_else(|| super::no_bayer(&name))?;
    for binning in ["XBINNING", "YBINNING"] {
        if header.whole(binning)?.is_some_and(|b| b != 1) {
            return Err(Error::new(format!(
                "a FITS image of a mosaic with {binning} other than 1"
            ))
            .with_hint("binning mixes the colors of a mosaic; take frames without it"));
        }
    }
    let offset = |long: &str, short: &str| -> Result<usize> {
        let offset = header.whole(long)?.or(header.whole(short)?).unwrap_or(0);
        Ok(offset.rem_euclid(2) as usize)
    };
    let right = offset("XBAYROFF", "BAYOFFX")?;
    let down = offset("YBAYROFF", "BAYOFFY")?;
    Ok(Some(cfa.shifted(down, right)))
}
