//! TIFF files of linear 16-bit values: one per pixel (no filters) or red, green, blue.

use super::tiff_structure::{
    BITS, BLACK_LEVEL, COMPRESSION, Directory, HEIGHT, MAKE, MODEL, NEW_SUBFILE_TYPE, PHOTOMETRIC,
    PLANAR, SAMPLES, STRIP_BYTES, TILE_BYTES, Tiff, WHITE_LEVEL, WIDTH,
};
use super::{ExifFields, RawFrame, check_size, icc};
use crate::base::{Error, Result};
use crate::session::Layout;
use tiff::decoder::{Decoder, DecodingResult, Limits};

const LARGEST_VALUE: u16 = 281;
const TRANSFER_FUNCTION: u16 = 301;
const SAMPLE_FORMAT: u16 = 339;
const COLOR_PROFILE: u16 = 34675;

const EXPORT: &str = "export linear 16-bit values, gray or RGB";

/// No packing of TIFF makes an image smaller than by this.
const RATIO: usize = 2000;

/// True when a file begins with a finished picture, and such pictures fill most of it: other TIFF-based files are a
/// camera's, which begin with a thumbnail.
pub(super) fn is_plain(tiff: &Tiff<'_>, directories: &[Directory]) -> bool {
    let finished = |d: &&Directory| tiff.value(d, PHOTOMETRIC).is_some_and(|p| p <= 10);
    let sizes = directories.iter().filter(finished).flat_map(|d| {
        let sizes = [STRIP_BYTES, TILE_BYTES].map(|tag| tiff.values(d, tag).unwrap_or_default());
        sizes.into_iter().flatten()
    });
    directories.first().is_some_and(|first| finished(&first))
        && 2.0 * sizes.sum::<f64>() >= tiff.bytes.len() as f64
}

/// Decodes the only image of a plain TIFF file.
///
/// # Errors
/// When it is torn, has several images, samples of another kind, or values that are not linear.
pub(super) fn decode(tiff: &Tiff<'_>, directories: &[Directory]) -> Result<RawFrame> {
    let full = |d: &&Directory| {
        d.find(WIDTH).is_some() && tiff.value(d, NEW_SUBFILE_TYPE).unwrap_or(0) & 1 == 0
    };
    let images = directories.iter().filter(full).count();
    let Some(image) = directories.first().filter(|_| images == 1) else {
        return Err(Error::new(format!("a TIFF file of {images} images"))
            .with_hint("write one image into each file"));
    };
    let layout = layout(tiff, image)?;
    let fields = ExifFields::read(tiff.bytes);
    check_linear(tiff, image, &fields)?;
    tiff.check_whole(image)?;
    let missing = || Error::new("the TIFF file does not state its size");
    let width = tiff.value(image, WIDTH).ok_or_else(missing)?;
    let height = tiff.value(image, HEIGHT).ok_or_else(missing)?;
    let packed = tiff.value(image, COMPRESSION).unwrap_or(1) != 1;
    let ratio = if packed { RATIO } else { 1 };
    check_size(
        [width, height],
        layout.values_per_pixel(),
        tiff.bytes,
        ratio,
    )?;
    let [black, white] = levels(tiff, image, layout)?;
    let data = samples(tiff.bytes, width * height * layout.values_per_pixel())?;
    if data.len() != width * height * layout.values_per_pixel() {
        return Err(Error::new(format!(
            "{} values for {width} x {height} pixels",
            data.len()
        )));
    }
    let mut frame = RawFrame {
        make: tiff.text(image, MAKE),
        model: tiff.text(image, MODEL),
        width,
        height,
        margins: [0; 4],
        layout,
        black: [0, 1, 2, 3].map(|i| if i < layout.places() { black } else { 0.0 }),
        white: white as u16,
        data,
        exposure_ms: None,
        aperture: None,
        iso: None,
        date_time: None,
    };
    fields.fill(&mut frame);
    Ok(frame)
}

fn layout(tiff: &Tiff<'_>, image: &Directory) -> Result<Layout> {
    let bad = |what: String| Err(Error::new(what).with_hint(EXPORT));
    let whole = |tag: u16| {
        let values = tiff.values(image, tag).unwrap_or(vec![1.0]);
        values.into_iter().map(|v| v as usize).collect::<Vec<_>>()
    };
    let (bits, formats) = (whole(BITS), whole(SAMPLE_FORMAT));
    let samples = tiff.value(image, SAMPLES).unwrap_or(1);
    if formats.contains(&3) {
        return bad("a TIFF file of floating point values: not what a sensor delivers".to_owned());
    }
    if formats.iter().any(|f| *f != 1) {
        return bad("a TIFF file of signed or complex values".to_owned());
    }
    if let Some(bits) = bits.iter().find(|b| **b != 16) {
        return bad(format!(
            "a TIFF file of {bits} bits per value, expected 16: fewer are too coarse, and as a rule not linear"
        ));
    }
    match (tiff.value(image, PHOTOMETRIC), samples) {
        (Some(1), 1) => Ok(Layout::Mono),
        (Some(2), 3) if tiff.value(image, PLANAR).unwrap_or(1) == 1 => Ok(Layout::Rgb),
        (Some(2), 3) => bad("a TIFF file with separate planes, expected interleaved values".into()),
        (Some(0), _) => bad("a TIFF file whose white is zero (a negative)".into()),
        (Some(3), _) => bad("a TIFF file with a palette".into()),
        (Some(1), 2) | (Some(2), 4) => bad("a TIFF file with transparency (alpha)".into()),
        (photometric, _) => bad(format!(
            "a TIFF file with {samples} values per pixel of color space {}",
            photometric.unwrap_or(0)
        )),
    }
}

/// Fails when anything in the file says that its values are not linear.
fn check_linear(tiff: &Tiff<'_>, image: &Directory, fields: &ExifFields) -> Result<()> {
    if fields.srgb {
        return Err(super::srgb("EXIF"));
    }
    if image.find(TRANSFER_FUNCTION).is_some() {
        return Err(
            Error::new("a TIFF file with a transfer function: its values are not linear")
                .with_hint(EXPORT),
        );
    }
    if image.find(COLOR_PROFILE).is_some() {
        icc::check_linear(tiff.bytes_of(image, COLOR_PROFILE).unwrap_or_default())?;
    }
    Ok(())
}

/// Black and white level: 0 and 65535 where the file states none.
fn levels(tiff: &Tiff<'_>, image: &Directory, layout: Layout) -> Result<[f64; 2]> {
    let stated = |tag: u16| tiff.values(image, tag).unwrap_or_default();
    let mut white = stated(WHITE_LEVEL);
    white.extend(stated(LARGEST_VALUE));
    let white = white.into_iter().fold(65535.0, f64::min);
    let black = stated(BLACK_LEVEL);
    let first = black.first().copied().unwrap_or(0.0);
    let alike = black.iter().all(|b| (*b - first).abs() < 1e-9);
    if alike && (0.0..white).contains(&first) && white >= 1.0 {
        return Ok([first, white]);
    }
    Err(Error::new(format!(
        "black levels {black:?} and white level {white} of the TIFF file ({layout})"
    ))
    .with_hint("write one black level below the largest value, or none"))
}

/// All values, of which there are `count`.
fn samples(bytes: &[u8], count: usize) -> Result<Vec<u16>> {
    let explain = |e: tiff::TiffError| {
        Error::new(format!("the TIFF file cannot be read: {e}"))
            .with_hint("copy it again, or write it uncompressed")
    };
    let mut decoder = Decoder::new(std::io::Cursor::new(bytes)).map_err(explain)?;
    // A tag that stands twice is read otherwise than here: the size that was checked is the limit.
    let mut limits = Limits::unlimited();
    limits.decoding_buffer_size = count * size_of::<u16>();
    limits.intermediate_buffer_size = limits.decoding_buffer_size.max(bytes.len());
    limits.ifd_value_size = bytes.len();
    decoder = decoder.with_limits(limits);
    match decoder.read_image().map_err(explain)? {
        DecodingResult::U16(data) => Ok(data),
        _ => Err(Error::new("the TIFF file's values are not 16-bit integers").with_hint(EXPORT)),
    }
}
