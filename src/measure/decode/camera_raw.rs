//! Camera RAW files and packed DNG, through `rawloader`.

use super::dng::DngFacts;
use super::{ExifFields, RawFrame, bayer, no_bayer, raw_claims, visible_size};
use crate::base::{Error, Result};
use crate::session::Layout;

/// Decodes a file; a DNG's own words go before the decoder's.
///
/// # Errors
/// When the decoder does not know the file, or reads anything but raw integers of a layout that is measured.
pub(super) fn decode(bytes: &[u8], dng: Option<&DngFacts>) -> Result<RawFrame> {
    raw_claims::check(bytes)?;
    let mut image = rawloader::decode(&mut &bytes[..]).map_err(|e| explain(&e.to_string()))?;
    let [width, height] = visible_size([image.width, image.height], image.crops)?;
    let (layout, black) = match dng {
        Some(facts) => (facts.layout, facts.black),
        None => mosaic(&image)?,
    };
    let values = layout.values_per_pixel();
    if image.cpp != values {
        return Err(Error::new(format!(
            "{} values per pixel, expected {values} ({layout})",
            image.cpp
        )));
    }
    let data = std::mem::replace(
        &mut image.data,
        rawloader::RawImageData::Integer(Vec::new()),
    );
    let rawloader::RawImageData::Integer(full) = data else {
        return Err(Error::new("raw values are not integers").with_hint("convert to 16-bit DNG"));
    };
    if full.len() < image.width * image.height * values {
        return Err(Error::new(format!(
            "{} raw values for {} x {} pixels",
            full.len(),
            image.width,
            image.height
        )));
    }
    let [top, _, _, left] = image.crops;
    let data = visible(
        full,
        values * image.width,
        top,
        values * left,
        values * width,
        height,
    );
    let white = image.whitelevels.into_iter().filter(|&w| w > 0).min();
    let mut frame = RawFrame {
        width,
        height,
        margins: image.crops,
        layout,
        black,
        white: white.unwrap_or(u16::MAX),
        data,
        exposure_ms: None,
        aperture: None,
        iso: None,
        date_time: None,
        make: image.make,
        model: image.model,
    };
    ExifFields::read(bytes).fill(&mut frame);
    Ok(frame)
}

/// Cuts a box out of rows of `stride` values, in place.
fn visible(
    mut full: Vec<u16>,
    stride: usize,
    top: usize,
    left: usize,
    width: usize,
    height: usize,
) -> Vec<u16> {
    if stride != width || top > 0 {
        for row in 0..height {
            let from = (top + row) * stride + left;
            full.copy_within(from..from + width, row * width);
        }
    }
    full.truncate(width * height);
    full
}

/// Turns the decoder's message into one for a person.
fn explain(message: &str) -> Error {
    let text = message.trim_start_matches("RawLoaderError: ");
    let text = text.trim_matches('"').lines().next().unwrap_or(text);
    if text.contains("decoder for this file") {
        return Error::new("not a RAW file the decoder knows").with_hint(
            "give a camera's RAW file, DNG, or linear 16-bit TIFF, PNG or FITS; convert others to uncompressed DNG",
        );
    }
    let hint = if text.contains("panic") {
        "the file is damaged or of an unknown kind; copy it again or convert to uncompressed DNG"
    } else {
        "convert to uncompressed DNG"
    };
    Error::new(format!("the decoder says: {text}")).with_hint(hint)
}

/// Color filters and black levels of the visible area, of files that are no DNG.
///
/// The decoder's four black levels are by color (red, green, blue, fourth) for most cameras, and red, green of the red
/// rows, green of the blue rows, blue for Pentax and Olympus files.
fn mosaic(image: &rawloader::RawImage) -> Result<(Layout, [f64; 4])> {
    if (image.cfa.width, image.cfa.height) != (2, 2) {
        return Err(no_bayer(&image.cfa.to_string()));
    }
    let shifted = image.cropped_cfa();
    let places = [(0, 0), (0, 1), (1, 0), (1, 1)];
    let channels = places.map(|(row, column)| shifted.color_at(row, column));
    let layout = bayer(channels, &shifted.name)?;
    let levels = image.blacklevels.map(f64::from);
    let by_rows = ["PENTAX", "RICOH", "OLYMPUS"];
    let make = image.make.to_uppercase();
    let four_places = levels[3] > 0.0 && by_rows.iter().any(|m| make.starts_with(m));
    let black = [0, 1, 2, 3].map(|place| {
        let in_red_row = channels[place ^ 1] == 0;
        match (four_places, channels[place]) {
            (true, 1) => levels[if in_red_row { 1 } else { 2 }],
            (true, 2) => levels[3],
            (_, color) => levels[color],
        }
    });
    Ok((layout, black))
}
