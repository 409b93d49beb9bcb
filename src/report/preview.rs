//! A photograph for the eye, from linear intensities.

use crate::base::{Context, Error, Result};
use image::{ImageFormat, Rgb, RgbImage};
use std::io::Cursor;

/// A PNG of `width` by `height` linear RGB values, row by row; 0 is black and 1 full scale. Values outside are shown as
/// the nearest end.
///
/// # Errors
/// The numbers of pixels disagree, or a value is no number.
pub fn png(width: u32, height: u32, linear: &[[f64; 3]]) -> Result<Vec<u8>> {
    if linear.len() != width as usize * height as usize || linear.is_empty() {
        return Err(Error::new(format!(
            "{} values for a picture of {width} x {height} pixels",
            linear.len()
        )));
    }
    if linear.iter().flatten().any(|v| v.is_nan()) {
        return Err(Error::new("a value of the picture is not a number"));
    }
    let mut image = RgbImage::new(width, height);
    for (pixel, values) in image.pixels_mut().zip(linear) {
        *pixel = Rgb(values.map(|v| (255.0 * encoded(v)).round() as u8));
    }
    let mut bytes = Cursor::new(Vec::new());
    image
        .write_to(&mut bytes, ImageFormat::Png)
        .context(|| "the picture cannot be encoded")?;
    Ok(bytes.into_inner())
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
    fn what_is_no_picture_is_refused() {
        assert!(png(2, 2, &[[0.0; 3]]).is_err());
        assert!(png(0, 0, &[]).is_err());
        assert!(png(1, 1, &[[f64::NAN, 0.0, 0.0]]).is_err());
    }
}
