//! PNG files of linear 16-bit values: one per pixel (no filters) or red, green, blue.

use super::{ExifFields, RawFrame, check_size, icc, srgb};
use crate::base::{Error, Result};
use crate::session::Layout;
use png::{BitDepth, ColorType, Decoder, Info, Transformations};

/// How every PNG file begins.
pub(super) const SIGNATURE: &[u8] = b"\x89PNG\r\n\x1a\n";

const EXPORT: &str = "export linear 16-bit values, gray or RGB, without transparency";

/// Deflate makes nothing smaller than by 1032.
const RATIO: usize = 1100;

/// Decodes a PNG file.
///
/// # Errors
/// When it is torn or damaged, of another kind, or says that its values are not linear.
pub(super) fn decode(bytes: &[u8]) -> Result<RawFrame> {
    let explain = |e: png::DecodingError| {
        Error::new(format!("the PNG file cannot be read: {e}"))
            .with_hint("the file is torn or damaged; copy it again")
    };
    let mut decoder = Decoder::new(std::io::Cursor::new(bytes));
    decoder.set_transformations(Transformations::IDENTITY);
    let header = decoder.read_header_info().map_err(explain)?;
    let layout = layout(header)?;
    let size = [header.width as usize, header.height as usize];
    let values = layout.values_per_pixel();
    check_size(size, values, bytes, RATIO)?;
    let mut reader = decoder.read_info().map_err(explain)?;
    check_linear(reader.info())?;
    let mut words = vec![0; 2 * values * size[0] * size[1]];
    reader.next_frame(&mut words).map_err(explain)?;
    reader.finish().map_err(explain)?;
    check_linear(reader.info())?;
    let data = words.chunks_exact(2);
    let fields = ExifFields::read(bytes);
    if fields.srgb {
        return Err(srgb("EXIF"));
    }
    let mut frame = RawFrame {
        make: String::new(),
        model: String::new(),
        width: size[0],
        height: size[1],
        margins: [0; 4],
        layout,
        black: [0.0; 4],
        white: u16::MAX,
        data: data.map(|b| u16::from_be_bytes([b[0], b[1]])).collect(),
        exposure_ms: None,
        aperture: None,
        iso: None,
        date_time: None,
    };
    fields.fill(&mut frame);
    Ok(frame)
}

fn layout(info: &Info<'_>) -> Result<Layout> {
    let bad = |what: String| Err(Error::new(what).with_hint(EXPORT));
    match (info.color_type, info.bit_depth) {
        (ColorType::Indexed, _) => bad("a PNG file with a palette".into()),
        (ColorType::GrayscaleAlpha | ColorType::Rgba, _) => {
            bad("a PNG file with transparency (alpha)".into())
        }
        (ColorType::Grayscale, BitDepth::Sixteen) => Ok(Layout::Mono),
        (ColorType::Rgb, BitDepth::Sixteen) => Ok(Layout::Rgb),
        (_, bits) => bad(format!(
            "a PNG file of {} bits per value, expected 16: fewer are too coarse, and as a rule not linear",
            bits as u8
        )),
    }
}

/// Fails when a chunk says that values are not linear, or that some are transparent.
fn check_linear(info: &Info<'_>) -> Result<()> {
    if info.trns.is_some() {
        return Err(Error::new("a PNG file with transparency (tRNS)").with_hint(EXPORT));
    }
    if info.srgb.is_some() {
        return Err(srgb("the sRGB chunk"));
    }
    if let Some(gamma) = info.gama_chunk.map(png::ScaledFloat::into_value)
        && (gamma - 1.0).abs() > 1e-4
    {
        return Err(Error::new(format!(
            "a PNG file with gamma {gamma}: its values are not linear"
        ))
        .with_hint("export linear values, with gamma 1 or without a gAMA chunk"));
    }
    // Rec. ITU-T H.273: transfer characteristics 8 are linear.
    if let Some(code) = info.coding_independent_code_points
        && code.transfer_function != 8
    {
        return Err(Error::new(format!(
            "a PNG file with transfer function {}: its values are not linear",
            code.transfer_function
        ))
        .with_hint(EXPORT));
    }
    info.icc_profile
        .as_ref()
        .map_or(Ok(()), |p| icc::check_linear(p))
}
