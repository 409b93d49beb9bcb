//! Uncompressed Bayer DNG files (Adobe DNG 1.4): what the virtual camera and converters of scientific cameras write.
//!
//! One image directory, one strip, little endian, 12-bit packed or 16-bit samples, and a small EXIF directory. The bytes
//! are a function of the arguments alone. It does not compress, makes no thumbnail, and the color matrix it states is
//! nominal (sRGB primaries), there only because readers demand one: measuring never uses it.

use super::tiff_directory::{Described, Directory, check_image, exif_directory, file, tag};
use crate::base::{Error, Result};

/// The color filter array: the channels of the 2x2 block at the image's top left corner, row by row.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum CfaPattern {
    /// Red, green / green, blue.
    Rggb,
    /// Blue, green / green, red.
    Bggr,
    /// Green, red / blue, green.
    Grbg,
    /// Green, blue / red, green.
    Gbrg,
}

impl CfaPattern {
    /// All four phases.
    pub const ALL: [Self; 4] = [Self::Rggb, Self::Bggr, Self::Grbg, Self::Gbrg];

    /// The channels (0 red, 1 green, 2 blue) of the 2x2 block, row by row.
    pub fn channels(self) -> [usize; 4] {
        match self {
            Self::Rggb => [0, 1, 1, 2],
            Self::Bggr => [2, 1, 1, 0],
            Self::Grbg => [1, 0, 2, 1],
            Self::Gbrg => [1, 2, 0, 1],
        }
    }

    /// The phase with these channels in its 2x2 block, if there is one.
    pub fn from_channels(channels: [usize; 4]) -> Option<Self> {
        Self::ALL.into_iter().find(|p| p.channels() == channels)
    }

    /// The channel (0 red, 1 green, 2 blue) of the pixel in this row and column.
    pub fn channel(self, row: usize, column: usize) -> usize {
        self.channels()[Self::position(row, column)]
    }

    /// The place of a pixel in the 2x2 block: `2 (row mod 2) + column mod 2`.
    pub fn position(row: usize, column: usize) -> usize {
        2 * (row % 2) + column % 2
    }

    /// The pattern seen by an image that begins `rows` further down and `columns` further right.
    #[must_use]
    pub fn shifted(self, rows: usize, columns: usize) -> Self {
        let channels = [(0, 0), (0, 1), (1, 0), (1, 1)]
            .map(|(row, column)| self.channel(row + rows, column + columns));
        Self::from_channels(channels).unwrap_or(self)
    }
}

impl std::fmt::Display for CfaPattern {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        for channel in self.channels() {
            f.write_str(["R", "G", "B"][channel])?;
        }
        Ok(())
    }
}

/// How samples lie in the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BitDepth {
    /// Two samples in three bytes, most significant bits first.
    Twelve,
    /// One little-endian word per sample.
    Sixteen,
}

impl BitDepth {
    /// The largest value a sample can have.
    pub fn largest(self) -> u16 {
        match self {
            Self::Twelve => 4095,
            Self::Sixteen => u16::MAX,
        }
    }
}

/// A Bayer image and what its file must say about it.
#[derive(Debug, Clone, PartialEq)]
pub struct DngImage<'a> {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `width * height` raw values, row by row.
    pub data: &'a [u16],
    /// Sample size in the file.
    pub bits: BitDepth,
    /// Color filter array.
    pub cfa: CfaPattern,
    /// Black level of each place of the 2x2 block, row by row, raw values (kept to 1e-4).
    pub black: [f64; 4],
    /// Raw value at which pixels saturate.
    pub white: u16,
    /// Maker of the camera, ASCII.
    pub make: &'a str,
    /// Model of the camera, ASCII.
    pub model: &'a str,
    /// Exposure time, milliseconds.
    pub exposure_ms: Option<f64>,
    /// Sensitivity setting.
    pub iso: Option<u16>,
    /// `YYYY:MM:DD HH:MM:SS`, as EXIF writes it.
    pub date_time: Option<&'a str>,
}

/// The bytes of the DNG file.
///
/// An odd width in 12 bits is stored with one more column that the ActiveArea tag hides, because readers take packed
/// rows as ending on byte boundaries.
///
/// # Errors
/// When `data` is not `width * height` values, a value does not fit the sample size, a size is zero or above 60000, a
/// level has no meaning, a text is not ASCII, or the exposure is not positive.
pub fn write_dng(image: &DngImage<'_>) -> Result<Vec<u8>> {
    check(image)?;
    let stored_width = match image.bits {
        BitDepth::Twelve => image.width + image.width % 2,
        BitDepth::Sixteen => image.width,
    };
    let strip = pack(image, stored_width);
    let main = main_directory(image, stored_width, strip.len());
    let exif = exif_directory(image.exposure_ms, image.iso, image.date_time)?;

    Ok(file(main, &exif, &strip))
}

fn check(image: &DngImage<'_>) -> Result<()> {
    check_image(&Described {
        kind: "DNG",
        size: [image.width, image.height],
        values_per_pixel: 1,
        data: image.data,
        largest: image.bits.largest(),
        white: image.white,
        texts: &[image.make, image.model, image.date_time.unwrap_or("-")],
        exposure_ms: image.exposure_ms,
    })?;
    match image
        .black
        .iter()
        .find(|&b| !(0.0..f64::from(image.white)).contains(b))
    {
        None => Ok(()),
        Some(black) => Err(Error::new(format!(
            "DNG cannot be written: black level {black}, expected 0 up to the white level {}",
            image.white
        ))),
    }
}

/// The samples as they lie in the file; `stored_width >= width`, further columns repeat the last one.
fn pack(image: &DngImage<'_>, stored_width: usize) -> Vec<u8> {
    let mut strip = Vec::with_capacity(stored_width * image.height * 2);
    for row in image.data.chunks_exact(image.width) {
        match image.bits {
            BitDepth::Sixteen => strip.extend(row.iter().flat_map(|v| v.to_le_bytes())),
            BitDepth::Twelve => {
                for pair in row.chunks(2) {
                    let (a, b) = (pair[0], *pair.last().unwrap_or(&0));
                    strip.extend([(a >> 4) as u8, (a << 4 | b >> 8) as u8, b as u8]);
                }
            }
        }
    }
    debug_assert!(
        image.bits == BitDepth::Sixteen || strip.len() == stored_width * 3 / 2 * image.height
    );
    strip
}

fn main_directory(image: &DngImage<'_>, stored_width: usize, strip_bytes: usize) -> Directory {
    let (width, height) = (image.width as u32, image.height as u32);
    let mut d = Directory::default();
    d.longs(254, &[0]); // NewSubfileType: the main image
    d.longs(256, &[stored_width as u32]);
    d.longs(257, &[height]);
    let bits = match image.bits {
        BitDepth::Twelve => 12,
        BitDepth::Sixteen => 16,
    };
    d.shorts(258, &[bits]);
    d.shorts(259, &[1]); // Compression: none
    d.shorts(262, &[32803]); // PhotometricInterpretation: color filter array
    d.ascii(271, image.make);
    d.ascii(272, image.model);
    d.longs(tag::STRIP_OFFSETS, &[0]);
    d.shorts(274, &[1]); // Orientation: normal
    d.shorts(277, &[1]); // SamplesPerPixel
    d.longs(278, &[height]); // RowsPerStrip
    d.longs(279, &[strip_bytes as u32]);
    d.shorts(284, &[1]); // PlanarConfiguration
    d.ascii(305, "goniofit");
    if let Some(text) = image.date_time {
        d.ascii(306, text);
    }
    d.shorts(33421, &[2, 2]); // CFARepeatPatternDim
    d.bytes(33422, &image.cfa.channels().map(|c| c as u8)); // CFAPattern
    d.longs(tag::EXIF_IFD, &[0]);
    d.bytes(50706, &[1, 4, 0, 0]); // DNGVersion
    d.bytes(50707, &[1, 1, 0, 0]); // DNGBackwardVersion
    d.ascii(50708, &format!("{} {}", image.make, image.model)); // UniqueCameraModel
    d.bytes(50710, &[0, 1, 2]); // CFAPlaneColor
    d.shorts(50711, &[1]); // CFALayout: rectangular
    d.shorts(50713, &[2, 2]); // BlackLevelRepeatDim
    let black = image.black.map(|b| [(b * 1e4).round() as u32, 10_000]);
    d.rationals(50714, &black);
    d.longs(50717, &[u32::from(image.white)]);
    // XYZ (D65) to linear sRGB, IEC 61966-2-1, times 10000.
    #[rustfmt::skip]
    let matrix: [i32; 9] = [32406, -15372, -4986, -9689, 18758, 415, 557, -2040, 10570];
    d.signed_rationals(50721, &matrix.map(|m| [m, 10_000]));
    d.rationals(50728, &[[1, 1]; 3]); // AsShotNeutral
    d.shorts(50778, &[21]); // CalibrationIlluminant1: D65
    d.longs(50829, &[0, 0, height, width]); // ActiveArea: top, left, bottom, right
    d
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(data: &[u16]) -> DngImage<'_> {
        DngImage {
            width: 3,
            height: 2,
            data,
            bits: BitDepth::Twelve,
            cfa: CfaPattern::Rggb,
            black: [128.0; 4],
            white: 4095,
            make: "goniofit",
            model: "virtual camera",
            exposure_ms: Some(12.5),
            iso: Some(100),
            date_time: None,
        }
    }

    #[test]
    fn images_that_do_not_fit_their_description_are_refused() {
        let error = |i: &DngImage<'_>| write_dng(i).unwrap_err().report();
        let good = [1, 2, 3, 4, 5, 6];
        assert!(write_dng(&image(&good)).is_ok());
        assert!(error(&image(&good[..5])).contains("5 raw values for 3 x 2 pixels, expected 6"));
        assert!(
            error(&image(&[1, 2, 3, 4, 5000, 6])).contains("5000 at column 1, row 1 is above 4095")
        );
        let mut bad = image(&good);
        bad.black[2] = f64::NAN;
        assert!(error(&bad).contains("black level NaN"));
        let mut bad = image(&good);
        bad.exposure_ms = Some(f64::NAN);
        assert!(error(&bad).contains("exposure NaN"));
        let mut bad = image(&good);
        bad.make = "k\u{f6}nig";
        assert!(error(&bad).contains("ASCII"));
        let mut bad = image(&good);
        bad.white = 5000;
        assert!(error(&bad).contains("white level 5000"));
        let mut bad = image(&good);
        bad.width = 0;
        assert!(error(&bad).contains("size 0 x 2"));
    }

    #[test]
    fn the_pattern_shifts_with_the_crop() {
        assert_eq!(CfaPattern::Rggb.shifted(1, 0), CfaPattern::Gbrg);
        assert_eq!(CfaPattern::Rggb.shifted(0, 1), CfaPattern::Grbg);
        assert_eq!(CfaPattern::Rggb.shifted(1, 1), CfaPattern::Bggr);
        for p in CfaPattern::ALL {
            assert_eq!(p.shifted(2, 4), p);
            assert_eq!(p.shifted(1, 1).shifted(1, 1), p);
        }
        assert_eq!(CfaPattern::Gbrg.to_string(), "GBRG");
    }
}
