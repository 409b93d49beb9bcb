//! Frames of cameras without a mosaic: baseline TIFF 6.0 with 16-bit linear samples, one per pixel or three.
//!
//! One image directory, one strip, little endian, uncompressed, and a small EXIF directory. The bytes are a function of
//! the arguments alone. Mosaics go into DNG files ([`super::dng`]), which can name their filters.

use super::Layout;
use super::tiff_directory::{Described, Directory, check_image, exif_directory, file, tag};
use crate::base::{Error, Result};

/// An image and what its file must say about it.
#[derive(Debug, Clone, PartialEq)]
pub struct TiffImage<'a> {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// [`Layout::Mono`] or [`Layout::Rgb`].
    pub layout: Layout,
    /// `width * height` times [`Layout::values_per_pixel`] raw values, row by row; black not subtracted.
    pub data: &'a [u16],
    /// Raw value at which pixels saturate (the file's MaxSampleValue).
    pub white: u16,
    /// Maker of the camera, ASCII.
    pub make: &'a str,
    /// Model of the camera, ASCII.
    pub model: &'a str,
    /// Exposure time, milliseconds.
    pub exposure_ms: Option<f64>,
    /// Sensitivity setting.
    pub iso: Option<u16>,
}

/// The bytes of the TIFF file.
///
/// # Errors
/// When the layout is a mosaic, `data` has not as many values as the size asks for, a size is zero or above 60000, the
/// white level is zero, a text is not ASCII, or the exposure is not positive.
pub fn write_tiff(image: &TiffImage<'_>) -> Result<Vec<u8>> {
    if image.layout.cfa().is_some() {
        return Err(Error::new(
            "TIFF cannot be written: a plain TIFF file cannot name the color filters of a mosaic",
        )
        .with_hint("write mosaics as DNG"));
    }
    check_image(&Described {
        kind: "TIFF",
        size: [image.width, image.height],
        values_per_pixel: image.layout.values_per_pixel(),
        data: image.data,
        largest: u16::MAX,
        white: image.white,
        texts: &[image.make, image.model],
        exposure_ms: image.exposure_ms,
    })?;
    let strip: Vec<u8> = image.data.iter().flat_map(|v| v.to_le_bytes()).collect();
    let exif = exif_directory(image.exposure_ms, image.iso, None)?;
    Ok(file(main_directory(image, strip.len()), &exif, &strip))
}

fn main_directory(image: &TiffImage<'_>, strip_bytes: usize) -> Directory {
    let samples = image.layout.values_per_pixel();
    let per_sample = |value: u16| vec![value; samples];
    // BlackIsZero, or RGB.
    let photometric = if samples == 3 { 2 } else { 1 };
    let mut d = Directory::default();
    d.longs(256, &[image.width as u32]);
    d.longs(257, &[image.height as u32]);
    d.shorts(258, &per_sample(16)); // BitsPerSample
    d.shorts(259, &[1]); // Compression: none
    d.shorts(262, &[photometric]);
    d.ascii(271, image.make);
    d.ascii(272, image.model);
    d.longs(tag::STRIP_OFFSETS, &[0]);
    d.shorts(274, &[1]); // Orientation: normal
    d.shorts(277, &[samples as u16]); // SamplesPerPixel
    d.longs(278, &[image.height as u32]); // RowsPerStrip
    d.longs(279, &[strip_bytes as u32]);
    d.shorts(281, &per_sample(image.white)); // MaxSampleValue
    d.rationals(282, &[[72, 1]]); // XResolution, YResolution: baseline TIFF demands them
    d.rationals(283, &[[72, 1]]);
    d.shorts(284, &[1]); // PlanarConfiguration: interleaved
    d.shorts(296, &[2]); // ResolutionUnit: inch
    d.ascii(305, "goniofit");
    d.shorts(339, &per_sample(1)); // SampleFormat: unsigned integer
    d.longs(tag::EXIF_IFD, &[0]);
    d
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::CfaPattern;

    fn image(layout: Layout, data: &[u16]) -> TiffImage<'_> {
        TiffImage {
            width: 3,
            height: 2,
            layout,
            data,
            white: 50_000,
            make: "goniofit",
            model: "virtual camera",
            exposure_ms: Some(12.5),
            iso: Some(100),
        }
    }

    #[test]
    fn images_that_do_not_fit_their_description_are_refused() {
        let error = |i: &TiffImage<'_>| write_tiff(i).unwrap_err().report();
        let data = [7; 18];
        assert!(
            error(&image(Layout::Mono, &data))
                .contains("18 raw values for 3 x 2 pixels, expected 6")
        );
        assert!(error(&image(Layout::Rgb, &data[..6])).contains("expected 18"));
        let mosaic = error(&image(Layout::Bayer(CfaPattern::Rggb), &data[..6]));
        assert!(mosaic.contains("mosaic") && mosaic.contains("hint: write mosaics as DNG"));
        let mut bad = image(Layout::Rgb, &data);
        bad.white = 0;
        assert!(error(&bad).contains("TIFF cannot be written: white level 0"));
    }
}
