//! Pixel formats of GenICam cameras, and their frames as DNG files.

use crate::base::{Error, Result};
use crate::session::dng::{BitDepth, CfaPattern, DngImage, write_dng};

/// A pixel format with one 16-bit word per pixel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Format {
    /// Its name in the pixel format naming convention.
    pub(super) name: String,
    /// The mosaic; none for a monochrome sensor.
    pub(super) cfa: Option<CfaPattern>,
    /// Significant bits.
    bits: u32,
}

impl Format {
    /// The format of this name, if it is one that can be stored: unpacked, 10 bits or more.
    pub(super) fn named(name: &str) -> Option<Self> {
        let (cfa, bits) = if let Some(bits) = name.strip_prefix("Mono") {
            (None, bits)
        } else {
            let rest = name.strip_prefix("Bayer")?;
            let cfa = match rest.get(..2)? {
                "RG" => CfaPattern::Rggb,
                "BG" => CfaPattern::Bggr,
                "GR" => CfaPattern::Grbg,
                "GB" => CfaPattern::Gbrg,
                _ => return None,
            };
            (Some(cfa), rest.get(2..)?)
        };
        let bits = match bits {
            "10" => 10,
            "12" => 12,
            "14" => 14,
            "16" => 16,
            _ => return None,
        };
        Some(Self {
            name: name.to_owned(),
            cfa,
            bits,
        })
    }

    /// The best of those a camera offers: color before monochrome, then the most bits.
    pub(super) fn best_of<'a>(names: impl Iterator<Item = &'a str>) -> Option<Self> {
        let storable = names.filter_map(Self::named);
        storable.max_by_key(|f| (f.cfa.is_some(), f.bits))
    }

    /// Raw value taken as saturated. Sixteen bits are often fewer, shifted up: then the largest value is 65472 for ten
    /// bits and higher for more.
    fn white(&self) -> u16 {
        match self.bits {
            16 => 0xffc0,
            bits => (1 << bits) - 1,
        }
    }
}

/// One frame as it came, and what its file must say.
pub(super) struct Frame<'a> {
    pub(super) format: &'a Format,
    pub(super) width: usize,
    pub(super) height: usize,
    /// Little-endian words, row by row.
    pub(super) bytes: &'a [u8],
    pub(super) vendor: &'a str,
    pub(super) model: &'a str,
    pub(super) exposure_ms: f64,
}

/// The frame as DNG. A monochrome one is stored as a mosaic, so that its three channels are samples of the same image.
///
/// # Errors
/// It has another size than the camera said.
pub(super) fn to_dng(frame: &Frame<'_>) -> Result<Vec<u8>> {
    let (width, height) = (frame.width, frame.height);
    let needed = 2 * width * height;
    let Some(bytes) = frame.bytes.get(..needed).filter(|_| needed > 0) else {
        return Err(Error::new(format!(
            "a frame of {} bytes, expected {needed} for {width} x {height} pixels of {}",
            frame.bytes.len(),
            frame.format.name
        )));
    };
    let words = bytes.chunks_exact(2);
    let data: Vec<u16> = words.map(|w| u16::from_le_bytes([w[0], w[1]])).collect();
    write_dng(&DngImage {
        width,
        height,
        data: &data,
        bits: BitDepth::Sixteen,
        cfa: frame.format.cfa.unwrap_or(CfaPattern::Rggb),
        black: [0.0; 4],
        white: frame.format.white(),
        make: &printable(frame.vendor),
        model: &printable(frame.model),
        exposure_ms: Some(frame.exposure_ms),
        iso: None,
        date_time: None,
    })
}

/// A name as DNG takes it: printable ASCII, not empty.
fn printable(name: &str) -> String {
    let text: String = name
        .chars()
        .map(|c| if matches!(c, ' '..='~') { c } else { '?' })
        .collect();
    if text.trim().is_empty() {
        "unknown".to_owned()
    } else {
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn best(names: &[&str]) -> Option<String> {
        Format::best_of(names.iter().copied()).map(|f| f.name)
    }

    #[test]
    fn the_most_bits_in_color_are_chosen_and_8_bit_or_packed_formats_never() {
        let offered = [
            "Mono8",
            "BayerRG8",
            "Mono16",
            "BayerRG12",
            "BayerRG12Packed",
            "BayerRG10",
            "RGB8",
        ];
        assert_eq!(best(&offered).as_deref(), Some("BayerRG12"));
        assert_eq!(
            best(&["Mono8", "Mono16", "Mono12"]).as_deref(),
            Some("Mono16")
        );
        assert_eq!(
            best(&["BayerGB16", "BayerGB12"]).as_deref(),
            Some("BayerGB16")
        );
        assert_eq!(
            best(&[
                "Mono8",
                "BayerRG8",
                "BayerRG12p",
                "BayerXX12",
                "Bayer",
                "Mono"
            ]),
            None
        );
    }

    #[test]
    fn a_frame_of_another_size_is_refused() {
        let format = Format::named("BayerRG12").unwrap();
        let mut frame = Frame {
            format: &format,
            width: 4,
            height: 2,
            bytes: &[0; 16],
            vendor: "B\u{e4}sler",
            model: "",
            exposure_ms: 10.0,
        };
        assert!(to_dng(&frame).is_ok());
        frame.bytes = &[0; 15];
        let error = to_dng(&frame).unwrap_err().report();
        assert_eq!(
            error,
            "a frame of 15 bytes, expected 16 for 4 x 2 pixels of BayerRG12"
        );
    }
}
