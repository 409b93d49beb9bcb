//! A photograph for the eye, from linear intensities.

use super::png_file;
use crate::base::{Error, Result};
use image::{Rgb, RgbImage};

/// A PNG of `width` by `height` linear RGB values, row by row; 0 is black and 1 full scale. Values outside are shown as
/// the nearest end.
///
/// # Errors
/// The numbers of pixels disagree, or a value is no number.
pub fn png(width: u32, height: u32, linear: &[[f64; 3]]) -> Result<Vec<u8>> {
    annotated_png([width as usize, height as usize], linear, &[])
}

/// As [`png`], with `notes` (keyword and text) in the file.
///
/// # Errors
/// As [`png`].
pub fn annotated_png(
    size: [usize; 2],
    linear: &[[f64; 3]],
    notes: &[(&str, String)],
) -> Result<Vec<u8>> {
    let shown: Vec<[f64; 3]> = linear.iter().map(|p| p.map(encoded)).collect();
    png_file::encode(&bitmap(size, &shown)?, notes)
}

/// The factor that makes the brightest hundredth of these pixels white; 1 when they are black.
pub fn exposure(linear: &[[f64; 3]]) -> f64 {
    let mut peaks: Vec<f64> = linear
        .iter()
        .map(|p| p.iter().copied().fold(0.0, f64::max))
        .collect();
    match percentile_99(&mut peaks) {
        Some(bright) if bright > 0.0 => 1.0 / bright,
        _ => 1.0,
    }
}

/// The value that a hundredth of them reaches; sorts them.
pub(super) fn percentile_99(values: &mut [f64]) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() * 99 / 100).copied()
}

/// Eight bits per channel from the screen's scale, 0 to 1; values outside become the nearest end.
pub(super) fn bitmap([width, height]: [usize; 2], screen: &[[f64; 3]]) -> Result<RgbImage> {
    let sides = [width, height].map(u32::try_from);
    let ([Ok(columns), Ok(rows)], true, false) = (
        sides,
        width.checked_mul(height) == Some(screen.len()),
        screen.is_empty(),
    ) else {
        return Err(Error::new(format!(
            "{} values for a picture of {width} x {height} pixels",
            screen.len()
        )));
    };
    if screen.iter().flatten().any(|v| v.is_nan()) {
        return Err(Error::new("a value of the picture is not a number"));
    }
    let mut image = RgbImage::new(columns, rows);
    for (pixel, values) in image.pixels_mut().zip(screen) {
        *pixel = Rgb(values.map(|v| (255.0 * v.clamp(0.0, 1.0)).round() as u8));
    }
    Ok(image)
}

/// IEC 61966-2-1: from linear to the screen's scale.
fn encoded(linear: f64) -> f64 {
    let v = linear.clamp(0.0, 1.0);
    if v <= 0.003_130_8 {
        12.92 * v
    } else {
        1.055 * v.powf(1.0 / 2.4) - 0.055
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn linear_values_come_out_on_the_screens_scale() {
        let bytes = png(
            3,
            1,
            &[[0.0, 1.0, 2.0], [0.18, 0.5, 0.001], [-1.0, 0.0, 0.0]],
        )
        .unwrap();
        let image = image::load_from_memory(&bytes).unwrap().to_rgb8();
        assert_eq!(image.get_pixel(0, 0).0, [0, 255, 255]);
        assert_eq!(image.get_pixel(1, 0).0, [118, 188, 3]);
        assert_eq!(image.get_pixel(2, 0).0, [0, 0, 0]);
    }

    #[test]
    fn the_brightest_hundredth_becomes_white() {
        let mut linear = vec![[0.1, 0.25, 0.2]; 195];
        linear.extend([[9.0, 0.0, 0.0]; 1]);
        assert!((exposure(&linear) - 4.0).abs() < 1e-12);
        assert!((exposure(&[[0.0; 3]]) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn what_is_no_picture_is_refused() {
        assert!(png(2, 2, &[[0.0; 3]]).is_err());
        assert!(png(0, 0, &[]).is_err());
        assert!(png(1, 1, &[[f64::NAN, 0.0, 0.0]]).is_err());
    }
}
