//! Signed numbers as colors: blue below zero, white at zero, red above.

use super::{png_file, preview};
use crate::base::{Error, Result};

/// Ends of the scale, sRGB: at -1 and at +1 (dark ends of a blue-red diverging map, equally bright).
const ENDS: [[f64; 3]; 2] = [[0.02, 0.30, 0.64], [0.70, 0.09, 0.17]];

/// The magnitude that should get the full color: the 99th percentile, so that a few outliers do not pale the rest; 1 when
/// everything is zero.
pub fn scale(values: &[f64]) -> f64 {
    let mut sizes: Vec<f64> = values.iter().map(|v| v.abs()).collect();
    match preview::percentile_99(&mut sizes) {
        Some(bright) if bright > 0.0 => bright,
        _ => 1.0,
    }
}

/// A PNG of `width * height` signed values, row by row: zero is white, `-scale` and `+scale` (and beyond) are full blue and
/// full red. `notes` (keyword and text) go into the file.
///
/// # Errors
/// The numbers of pixels disagree, a value is no number, or the scale is not positive.
pub fn png(
    [width, height]: [usize; 2],
    values: &[f64],
    scale: f64,
    notes: &[(&str, String)],
) -> Result<Vec<u8>> {
    if !(scale > 0.0 && scale.is_finite()) {
        return Err(Error::new(format!(
            "a color scale of {scale}, expected a positive number"
        )));
    }
    let colors: Vec<[f64; 3]> = values.iter().map(|v| color(v / scale)).collect();
    let image = preview::bitmap([width, height], &colors)?;
    png_file::encode(&image, notes)
}

/// sRGB from 0 to 1 of a value whose full scale is 1.
fn color(value: f64) -> [f64; 3] {
    let end = ENDS[usize::from(value > 0.0)];
    let strength = value.abs().min(1.0);
    if value.is_nan() {
        return [f64::NAN; 3];
    }
    end.map(|e| 1.0 + strength * (e - 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zero_is_white_and_the_ends_are_blue_and_red() {
        let notes = [("scale", "2 per radian".to_owned())];
        let bytes = png([5, 1], &[-4.0, -2.0, 0.0, 1.0, 2.0], 2.0, &notes).unwrap();
        let image = image::load_from_memory(&bytes).unwrap().to_rgb8();
        let at = |x| image.get_pixel(x, 0).0;
        assert_eq!(at(2), [255; 3]);
        assert_eq!(at(0), at(1));
        assert!(at(0)[2] > 2 * at(0)[0] && at(4)[0] > 2 * at(4)[2]);
        assert!((at(3)[1] > at(4)[1]) && at(3)[1] < 255);
        let text = b"scale\0\0\0\0\x002 per radian";
        assert!(bytes.windows(text.len()).any(|w| w == text));
    }

    #[test]
    fn what_has_no_color_is_refused() {
        assert!(png([1, 1], &[f64::NAN], 1.0, &[]).is_err());
        assert!(png([1, 1], &[1.0], 0.0, &[]).is_err());
        assert!(png([2, 1], &[1.0], 1.0, &[]).is_err());
    }

    #[test]
    fn outliers_do_not_set_the_scale() {
        let mut values = vec![-1.0; 500];
        values.push(1e6);
        assert!((scale(&values) - 1.0).abs() < 1e-12);
        assert!((scale(&[0.0, 0.0]) - 1.0).abs() < 1e-12);
    }
}
