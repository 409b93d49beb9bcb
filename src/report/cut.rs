//! A cut through a volume as a picture with a scale bar of known length.

use super::png_file;
use crate::base::{Error, Result};
use image::{Rgb, RgbImage};

/// Narrower pictures are enlarged by a whole number.
const LEAST_WIDTH: usize = 256;
const LARGEST_SIDE: usize = 16384;
const BAND: u32 = 26;
const INK: Rgb<u8> = Rgb([255, 255, 255]);
const PAPER: Rgb<u8> = Rgb([24, 24, 28]);

/// What a cut shows.
#[derive(Debug, Clone)]
pub struct Cut<'a> {
    /// Voxels across and up.
    pub size: [usize; 2],
    /// Red, green and blue of each voxel, first across, from below.
    pub color: &'a [[u8; 3]],
    /// Size of a voxel across and up, millimeters.
    pub voxel_mm: [f64; 2],
    /// Letters drawn in a color beside the bar, saying what it means.
    pub legend: &'a [(char, [u8; 3])],
    /// Keyword and text kept in the file.
    pub notes: Vec<(&'a str, String)>,
}

/// A PNG with the second axis upward, both axes at one scale (voxels that are not square are repeated), and below it a
/// bar of 1, 2 or 5 times a power of ten.
///
/// # Errors
/// The numbers of voxels disagree, a voxel has no size, or the picture would have a side of more than 16384 pixels.
pub fn png(cut: &Cut) -> Result<Vec<u8>> {
    let [nx, ny] = cut.size;
    if nx == 0 || ny == 0 || nx.checked_mul(ny) != Some(cut.color.len()) {
        return Err(Error::new(format!(
            "{} values for a cut of {nx} x {ny} voxels",
            cut.color.len()
        )));
    }
    if !cut.voxel_mm.iter().all(|v| *v > 0.0 && v.is_finite()) {
        return Err(Error::new("a voxel has no size"));
    }
    let finest = cut.voxel_mm[0].min(cut.voxel_mm[1]);
    let zoom = LEAST_WIDTH.div_ceil((nx as f64 * cut.voxel_mm[0] / finest).ceil() as usize);
    let pixel = finest / zoom as f64;
    let sides =
        [0, 1].map(|k| ((cut.size[k] as f64 * cut.voxel_mm[k] / pixel).round() as usize).max(1));
    if sides.iter().any(|s| *s > LARGEST_SIDE) {
        return Err(Error::new(format!(
            "a picture of {} x {} pixels: expected sides of at most {LARGEST_SIDE}",
            sides[0], sides[1]
        ))
        .with_hint("crop the volume first"));
    }
    let [width, height] = sides.map(|s| s as u32);
    let mut image = RgbImage::from_pixel(width, height + BAND, PAPER);
    for (v, row) in (0..height).rev().enumerate() {
        for u in 0..width {
            let across = (u as usize * nx / sides[0]).min(nx - 1);
            let up = (v * ny / sides[1]).min(ny - 1);
            image.put_pixel(u, row, Rgb(cut.color[up * nx + across]));
        }
    }
    let bar = bar_length(f64::from(width) * pixel);
    let mut x = draw_bar(&mut image, height, bar, pixel) + 12;
    for (letter, color) in cut.legend {
        x = draw_letter(&mut image, [x, height + 8], *letter, Rgb(*color));
    }
    let mut notes = cut.notes.clone();
    notes.push((
        "Scale",
        format!("{} um per pixel; bar {}", round(1e3 * pixel), label(bar)),
    ));
    png_file::encode(&image, &notes)
}

/// The largest of 1, 2 and 5 times a power of ten that is at most 0.4 of `width`.
fn bar_length(width: f64) -> f64 {
    let most = 0.4 * width * (1.0 + 1e-12);
    let ten = 10f64.powf(most.log10().floor());
    let fits = [5.0, 2.0, 1.0]
        .map(|k| k * ten)
        .into_iter()
        .find(|l| *l <= most);
    fits.unwrap_or(ten)
}

fn round(value: f64) -> f64 {
    (value * 1e6).round() / 1e6
}

fn label(millimeters: f64) -> String {
    if millimeters >= 0.999 {
        format!("{} mm", round(millimeters))
    } else {
        format!("{} um", round(1e3 * millimeters))
    }
}

/// The bar and its label in the band below a picture of `height` pixels; returns where the label ends.
fn draw_bar(image: &mut RgbImage, height: u32, length: f64, pixel: f64) -> u32 {
    let (left, pixels) = (8, (length / pixel).round().max(1.0) as u32);
    for y in height + 11..height + 15 {
        for x in left..(left + pixels).min(image.width()) {
            image.put_pixel(x, y, INK);
        }
    }
    label(length).chars().fold(left + pixels + 8, |x, letter| {
        draw_letter(image, [x, height + 8], letter, INK)
    })
}

/// A letter with its upper left corner at a pixel; returns where the next begins.
fn draw_letter(image: &mut RgbImage, [x, y]: [u32; 2], letter: char, ink: Rgb<u8>) -> u32 {
    let rows = glyph(letter);
    for (dy, row) in (0..10).map(|dy| (dy, rows[dy as usize / 2])) {
        for dx in (0..10).filter(|dx| row & (16 >> (dx / 2)) != 0) {
            if x + dx < image.width() {
                image.put_pixel(x + dx, y + dy, ink);
            }
        }
    }
    x + 2 * advance(letter)
}

/// Width of a letter with the gap after it, in dots.
fn advance(letter: char) -> u32 {
    match letter {
        'm' => 6,
        '.' => 2,
        _ => 4,
    }
}

/// Five rows of up to five dots, the leftmost the highest bit.
fn glyph(letter: char) -> [u8; 5] {
    let three = |rows: [u8; 5]| rows.map(|r| r << 2);
    match letter {
        '0' => three([0b111, 0b101, 0b101, 0b101, 0b111]),
        '1' => three([0b010, 0b110, 0b010, 0b010, 0b111]),
        '2' => three([0b111, 0b001, 0b111, 0b100, 0b111]),
        '3' => three([0b111, 0b001, 0b111, 0b001, 0b111]),
        '4' => three([0b101, 0b101, 0b111, 0b001, 0b001]),
        '5' => three([0b111, 0b100, 0b111, 0b001, 0b111]),
        '6' => three([0b111, 0b100, 0b111, 0b101, 0b111]),
        '7' => three([0b111, 0b001, 0b001, 0b010, 0b010]),
        '8' => three([0b111, 0b101, 0b111, 0b101, 0b111]),
        '9' => three([0b111, 0b101, 0b111, 0b001, 0b111]),
        'x' => three([0b000, 0b101, 0b010, 0b010, 0b101]),
        'y' => three([0b101, 0b101, 0b010, 0b010, 0b010]),
        'z' => three([0b000, 0b111, 0b001, 0b010, 0b111]),
        'u' => three([0b000, 0b101, 0b101, 0b101, 0b111]),
        'm' => [0b00000, 0b11110, 0b10101, 0b10101, 0b10101],
        '.' => [0, 0, 0, 0, 0b10000],
        _ => [0; 5],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_picture_stands_upright_and_its_bar_is_as_long_as_it_says() {
        // 400 x 2 voxels of 5 x 10 um: 2 mm wide, so a bar of 500 um is 100 pixels long.
        let mut color = vec![[10; 3]; 800];
        color[400..].fill([200; 3]);
        color[0] = [99, 0, 50];
        let cut = Cut {
            size: [400, 2],
            color: &color,
            legend: &[('x', [255, 0, 0])],
            voxel_mm: [0.005, 0.01],
            notes: vec![("Title", "xz, y = 3".to_owned())],
        };
        let bytes = png(&cut).unwrap();
        let image = image::load_from_memory(&bytes).unwrap().to_rgb8();
        assert_eq!(image.dimensions(), (400, 4 + BAND));
        assert_eq!(image.get_pixel(7, 0).0, [200; 3]);
        assert_eq!(image.get_pixel(7, 3).0, [10; 3]);
        assert_eq!(image.get_pixel(0, 2).0, [99, 0, 50]);
        let bar = (0..400).filter(|x| *image.get_pixel(*x, 4 + 12) == INK);
        // The label's dots share a row with the bar, beyond it.
        assert_eq!(bar.filter(|x| *x < 8 + 100 + 8).count(), 100);
        assert!((0..400).any(|x| image.get_pixel(x, 4 + 17).0 == [255, 0, 0]));
        let text = String::from_utf8_lossy(&bytes);
        assert!(text.contains("5 um per pixel; bar 500 um") && text.contains("xz, y = 3"));
    }

    #[test]
    fn bars_are_round_and_fit() {
        for (width, expected) in [
            (2.0, "500 um"),
            (1.24, "200 um"),
            (2.5, "1 mm"),
            (0.3, "100 um"),
            (60.0, "20 mm"),
        ] {
            assert_eq!(label(bar_length(width)), expected, "{width}");
        }
    }

    #[test]
    fn what_is_no_cut_is_refused() {
        let cut = |size, voxel| Cut {
            size,
            color: &[[1; 3], [2; 3]],
            legend: &[],
            voxel_mm: [voxel, 0.01],
            notes: Vec::new(),
        };
        assert!(png(&cut([2, 1], 0.01)).is_ok());
        assert!(png(&cut([2, 2], 0.01)).is_err());
        assert!(png(&cut([2, 1], 0.0)).is_err());
        assert!(png(&cut([2, 1], 1000.0)).is_err());
    }
}
