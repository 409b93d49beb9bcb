//! One RAW file to the visible mosaic of its sensor.

use super::container::{self, Container};
use super::raw_claims;
use crate::base::{Context, Error, Result};
use crate::session::{CfaPattern, Layout};
use std::path::Path;

/// The visible part of a sensor's mosaic, as read: black not subtracted, nothing scaled.
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
    /// The mosaic.
    pub fn cfa(&self) -> CfaPattern {
        self.layout.cfa().unwrap_or(CfaPattern::Rggb)
    }
}

/// Reads and decodes a RAW file; see [`decode`].
///
/// # Errors
/// With the path: when it cannot be read, or as [`decode`].
pub fn decode_file(path: &Path) -> Result<RawFrame> {
    let bytes = std::fs::read(path).context(|| format!("{} cannot be read", path.display()))?;
    decode(&bytes).context(|| format!("{} cannot be decoded", path.display()))
}

/// Decodes the bytes of a RAW file with a 2x2 red-green-blue mosaic: any camera the decoder knows, and DNG.
///
/// # Errors
/// When the file is torn, no RAW file, of an unknown camera, compressed in a way that is not read, or has another mosaic.
pub fn decode(bytes: &[u8]) -> Result<RawFrame> {
    let container = container::inspect(bytes)?;
    raw_claims::check(bytes)?;
    let image = rawloader::decode(&mut &bytes[..]).map_err(|e| explain(&e.to_string()))?;
    let [top, right, bottom, left] = image.crops;
    let (Some(width), Some(height)) = (
        image.width.checked_sub(left + right).filter(|&w| w > 0),
        image.height.checked_sub(top + bottom).filter(|&h| h > 0),
    ) else {
        return Err(Error::new(format!(
            "the margins {:?} leave nothing of {} x {} pixels",
            image.crops, image.width, image.height
        )));
    };
    if image.cpp != 1 {
        return Err(Error::new(format!(
            "{} values per pixel: not a mosaic",
            image.cpp
        )));
    }
    let rawloader::RawImageData::Integer(full) = &image.data else {
        return Err(Error::new("raw values are not integers").with_hint("convert to 16-bit DNG"));
    };
    if full.len() < image.width * image.height {
        return Err(Error::new(format!(
            "{} raw values for {} x {} pixels",
            full.len(),
            image.width,
            image.height
        )));
    }
    let (cfa, black) = mosaic(&image, container)?;
    let rows = full.chunks_exact(image.width).skip(top).take(height);
    let data = rows.flat_map(|row| &row[left..left + width]).copied();
    let data: Vec<u16> = data.collect();
    let white = image.whitelevels.into_iter().filter(|&w| w > 0).min();
    let exif = Exif::read(bytes);
    Ok(RawFrame {
        width,
        height,
        margins: image.crops,
        layout: Layout::Bayer(cfa),
        black,
        white: white.unwrap_or(u16::MAX),
        data,
        exposure_ms: exif.exposure_ms,
        aperture: exif.aperture,
        iso: exif.iso,
        date_time: exif.date_time,
        make: image.make,
        model: image.model,
    })
}

/// Turns the decoder's message into one for a person.
fn explain(message: &str) -> Error {
    let text = message.trim_start_matches("RawLoaderError: ");
    let text = text.trim_matches('"').lines().next().unwrap_or(text);
    if text.contains("decoder for this file") {
        return Error::new("not a RAW file the decoder knows").with_hint(
            "give a camera's RAW file or a DNG file; convert others to uncompressed DNG",
        );
    }
    let hint = if text.contains("panic") {
        "the file is damaged or of an unknown kind; copy it again or convert to uncompressed DNG"
    } else {
        "convert to uncompressed DNG"
    };
    Error::new(format!("the decoder says: {text}")).with_hint(hint)
}

/// Color filters and black levels of the visible area.
///
/// The decoder's four black levels mean different things: by color (red, green, blue, fourth) for most cameras, by place
/// in the 2x2 block for DNG (fractions cut off; the file's own values are used instead), and red, green of the red rows,
/// green of the blue rows, blue for Pentax and Olympus files.
fn mosaic(image: &rawloader::RawImage, container: Container) -> Result<(CfaPattern, [f64; 4])> {
    let pattern = |channels: [usize; 4], name: &str| {
        CfaPattern::from_channels(channels).ok_or_else(|| {
            Error::new(format!(
                "color filter array '{name}', expected a 2 x 2 pattern of red, green and blue"
            ))
            .with_hint("only Bayer cameras are measured")
        })
    };
    if let Container::Dng(facts) = container {
        // Adobe DNG 1.4: both patterns begin at the active area's top left corner, which is the visible one.
        return Ok((
            pattern(facts.cfa, &format!("{:?}", facts.cfa))?,
            facts.black,
        ));
    }
    if (image.cfa.width, image.cfa.height) != (2, 2) {
        return Err(Error::new(format!(
            "color filter array '{}', expected a 2 x 2 pattern of red, green and blue",
            image.cfa
        ))
        .with_hint("only Bayer cameras are measured"));
    }
    let shifted = image.cropped_cfa();
    let places = [(0, 0), (0, 1), (1, 0), (1, 1)];
    let channels = places.map(|(row, column)| shifted.color_at(row, column));
    let cfa = pattern(channels, &shifted.name)?;
    let levels = image.blacklevels.map(f64::from);
    let by_rows = ["PENTAX", "RICOH", "OLYMPUS"];
    let make = image.make.to_uppercase();
    let four_places = levels[3] > 0.0 && by_rows.iter().any(|m| make.starts_with(m));
    let black = places.map(|(row, column)| {
        let color = cfa.channel(row, column);
        let in_red_row = cfa.channel(row, column + 1) == 0;
        match (four_places, color) {
            (true, 1) => levels[if in_red_row { 1 } else { 2 }],
            (true, 2) => levels[3],
            _ => levels[color],
        }
    });
    Ok((cfa, black))
}

/// What EXIF says; fields it lacks stay empty.
#[derive(Default)]
struct Exif {
    exposure_ms: Option<f64>,
    aperture: Option<f64>,
    iso: Option<u32>,
    date_time: Option<String>,
}

impl Exif {
    fn read(bytes: &[u8]) -> Self {
        let mut reader = exif::Reader::new();
        reader.continue_on_error(true);
        let read = reader
            .read_from_container(&mut std::io::Cursor::new(bytes))
            .or_else(|e| e.distill_partial_result(|_| ()));
        let Ok(exif) = read else {
            return Self::default();
        };
        let field = |tag| exif.get_field(tag, exif::In::PRIMARY).map(|f| &f.value);
        let exposure = match field(exif::Tag::ExposureTime) {
            Some(exif::Value::Rational(v)) => v.first().map(|r| r.to_f64() * 1000.0),
            _ => None,
        };
        let aperture = match field(exif::Tag::FNumber) {
            Some(exif::Value::Rational(v)) => v.first().map(exif::Rational::to_f64),
            _ => None,
        };
        let date_time = match field(exif::Tag::DateTimeOriginal) {
            Some(exif::Value::Ascii(v)) => v
                .first()
                .map(|text| String::from_utf8_lossy(text).into_owned()),
            _ => None,
        };
        Self {
            exposure_ms: exposure.filter(|ms| *ms > 0.0 && ms.is_finite()),
            aperture: aperture.filter(|f| *f > 0.0 && f.is_finite()),
            iso: field(exif::Tag::PhotographicSensitivity).and_then(|v| v.get_uint(0)),
            date_time,
        }
    }
}
