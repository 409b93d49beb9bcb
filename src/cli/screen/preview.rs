//! A small picture of the last frame.

use crate::base::{Error, Result};
use crate::measure::{RawFrame, decode_file};
use crate::report::preview::png;
use crate::session::{Layout, files};
use std::path::Path;

/// The longest side of the picture, pixels.
const LONGEST: usize = 400;

/// Decodes the RAW file `frame` and writes a small picture of it to `out`, replacing an older one.
pub(super) fn write(frame: &Path, out: &Path) -> Result<()> {
    let raw = decode_file(frame)?;
    let (width, height, linear) = reduced(&raw, LONGEST)?;
    files::write_atomic(out, &png(width as u32, height as u32, &linear)?)
}

/// Means over whole blocks of 2x2 pixels (a mosaic's), as many blocks per pixel as it takes; 0 = black level, 1 = white level.
fn reduced(raw: &RawFrame, longest: usize) -> Result<(usize, usize, Vec<[f64; 3]>)> {
    let blocks = [raw.width / 2, raw.height / 2];
    let step = blocks[0].max(blocks[1]).div_ceil(longest).max(1);
    let (width, height) = (blocks[0] / step, blocks[1] / step);
    if width == 0 || height == 0 {
        return Err(Error::new(format!(
            "a frame of {} x {} pixels is too small for a picture",
            raw.width, raw.height
        )));
    }
    let side = 2 * step;
    let mut linear = Vec::with_capacity(width * height);
    for y in 0..height {
        for x in 0..width {
            linear.push(mean(raw, x * side, y * side, side));
        }
    }
    Ok((width, height, linear))
}

/// Mean of the square with this corner, r, g, b.
fn mean(raw: &RawFrame, left: usize, top: usize, side: usize) -> [f64; 3] {
    let mut sums = [0.0; 3];
    let mut counts = [0.0; 3];
    for row in top..top + side {
        for column in left..left + side {
            for (channel, index) in raw.values_at(column, row) {
                sums[channel] += raw.fraction(raw.data[index], index);
                counts[channel] += 1.0;
            }
        }
    }
    let gray = raw.layout == Layout::Mono;
    [0, 1, 2].map(|c| {
        let c = if gray { 0 } else { c };
        if counts[c] > 0.0 {
            sums[c] / counts[c]
        } else {
            0.0
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::CfaPattern;

    #[test]
    fn a_frame_is_reduced_to_means_of_whole_blocks() {
        // Red rises to the right from block to block, green is the white level, blue the black level.
        let (width, height) = (1602, 12);
        let cfa = CfaPattern::from_channels([0, 1, 1, 2]).unwrap();
        let data = (0..width * height).map(|i| {
            let (row, column) = (i / width, i % width);
            match cfa.channel(row, column) {
                0 => 100 + (column / 2) as u16,
                1 => 1100,
                _ => 100,
            }
        });
        let raw = RawFrame {
            make: String::new(),
            model: String::new(),
            width,
            height,
            margins: [0; 4],
            layout: Layout::Bayer(cfa),
            aperture: None,
            black: [100.0; 4],
            white: 1100,
            data: data.collect(),
            exposure_ms: None,
            iso: None,
            date_time: None,
        };
        let (w, h, linear) = reduced(&raw, 400).unwrap();
        // 801 blocks, three to a pixel.
        assert_eq!((w, h, linear.len()), (267, 2, 534));
        let red = |x: usize| linear[x][0];
        assert!((red(0) - 0.001).abs() < 1e-12 && (red(100) - 0.301).abs() < 1e-12);
        assert!(
            linear
                .iter()
                .all(|p| (p[1] - 1.0).abs() < 1e-12 && p[2].abs() < 1e-12)
        );
    }

    #[test]
    fn frames_without_a_mosaic_are_reduced_too() {
        for (layout, wanted) in [(Layout::Mono, [0.5; 3]), (Layout::Rgb, [0.5, 0.25, 0.0])] {
            let pixel: &[u16] = match layout {
                Layout::Rgb => &[600, 350, 100],
                _ => &[600],
            };
            let raw = RawFrame {
                make: String::new(),
                model: String::new(),
                width: 8,
                height: 6,
                margins: [0; 4],
                layout,
                aperture: None,
                black: [100.0; 4],
                white: 1100,
                data: pixel.repeat(48),
                exposure_ms: None,
                iso: None,
                date_time: None,
            };
            let (width, height, linear) = reduced(&raw, 400).unwrap();
            assert_eq!((width, height), (4, 3));
            for found in linear.iter().flatten().zip(wanted.iter().cycle()) {
                assert!((found.0 - found.1).abs() < 1e-12, "{layout}: {linear:?}");
            }
        }
    }

    #[test]
    fn a_file_that_is_no_frame_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let frame = folder.path().join("f.txt");
        std::fs::write(&frame, b"no frame").unwrap();
        let error = write(&frame, &folder.path().join("p.png")).unwrap_err();
        assert!(error.report().contains("cannot be decoded"));
        assert!(!folder.path().join("p.png").exists());
    }
}
