//! What EXIF says of a shot; fields it lacks stay empty.

use super::RawFrame;

/// The EXIF fields that are used.
#[derive(Debug, Default)]
pub(super) struct ExifFields {
    exposure_ms: Option<f64>,
    aperture: Option<f64>,
    iso: Option<u32>,
    date_time: Option<String>,
    /// The color space is stated to be sRGB.
    pub(super) srgb: bool,
}

impl ExifFields {
    /// Reads the EXIF part of a TIFF-based file or a PNG file.
    pub(super) fn read(bytes: &[u8]) -> Self {
        // The parser copies what it is given; as a rule all fields lie before the image.
        let start = bytes.get(..START).and_then(parse).filter(|read| read.1);
        match start.or_else(|| parse(bytes)) {
            Some((exif, _)) => Self::of(&exif),
            None => Self::default(),
        }
    }

    fn of(exif: &exif::Exif) -> Self {
        let field = |tag| exif.get_field(tag, exif::In::PRIMARY).map(|f| &f.value);
        let fraction = |tag| match field(tag) {
            Some(exif::Value::Rational(v)) => v.first().map(exif::Rational::to_f64),
            _ => None,
        };
        let positive = |value: &f64| *value > 0.0 && value.is_finite();
        let date_time = match field(exif::Tag::DateTimeOriginal) {
            Some(exif::Value::Ascii(v)) => v
                .first()
                .map(|text| String::from_utf8_lossy(text).into_owned()),
            _ => None,
        };
        Self {
            exposure_ms: fraction(exif::Tag::ExposureTime)
                .map(|s| 1000.0 * s)
                .filter(positive),
            aperture: fraction(exif::Tag::FNumber).filter(positive),
            iso: field(exif::Tag::PhotographicSensitivity).and_then(|v| v.get_uint(0)),
            date_time,
            srgb: field(exif::Tag::ColorSpace).and_then(|v| v.get_uint(0)) == Some(1),
        }
    }

    /// Writes the fields into a frame.
    pub(super) fn fill(self, frame: &mut RawFrame) {
        frame.exposure_ms = self.exposure_ms;
        frame.aperture = self.aperture;
        frame.iso = self.iso;
        frame.date_time = self.date_time;
    }
}

/// Bytes looked at first.
const START: usize = 1 << 18;

/// The fields of a file, and whether none was torn.
fn parse(bytes: &[u8]) -> Option<(exif::Exif, bool)> {
    let mut whole = true;
    let mut reader = exif::Reader::new();
    reader.continue_on_error(true);
    let read = reader
        .read_from_container(&mut std::io::Cursor::new(bytes))
        .or_else(|e| e.distill_partial_result(|_| whole = false));
    Some((read.ok()?, whole))
}
