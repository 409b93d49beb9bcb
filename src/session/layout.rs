//! How a sensor sees color: which channels a pixel has.

use super::CfaPattern;
use serde::{Deserialize, Serialize};

/// Which channels the pixels of a frame have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Layout {
    /// A 2x2 mosaic of color filters: one value per pixel, of the channel of its filter.
    Bayer(CfaPattern),
    /// One value per pixel and no filter on the sensor: the channel is that of the filter in front of the lens
    /// ([`Filter`]), or all three alike.
    Mono,
    /// Three values per pixel, red, green, blue: a camera with three sensors, or one that shifts its sensor.
    Rgb,
}

impl Layout {
    /// Values stored per pixel: 1, or 3 interleaved.
    pub fn values_per_pixel(self) -> usize {
        match self {
            Self::Rgb => 3,
            Self::Bayer(_) | Self::Mono => 1,
        }
    }

    /// Where `channel` (0 red, 1 green, 2 blue) of the pixel (x, y) lies in the data of an image of this width; none
    /// where the pixel does not see the channel. The one value of [`Layout::Mono`] stands for every channel.
    pub fn index(self, width: usize, x: usize, y: usize, channel: usize) -> Option<usize> {
        let pixel = y * width + x;
        match self {
            Self::Bayer(cfa) => (cfa.channel(y, x) == channel).then_some(pixel),
            Self::Mono => Some(pixel),
            Self::Rgb => Some(3 * pixel + channel),
        }
    }

    /// How many kinds of values there are that may differ in black level: places of the mosaic, or channels.
    pub fn places(self) -> usize {
        match self {
            Self::Bayer(_) => 4,
            Self::Mono => 1,
            Self::Rgb => 3,
        }
    }

    /// Which of the [`Layout::places`] a value belongs to, by its index in the data of an image of this width.
    pub fn place(self, width: usize, index: usize) -> usize {
        match self {
            Self::Bayer(_) => CfaPattern::position(index / width, index % width),
            Self::Mono => 0,
            Self::Rgb => index % 3,
        }
    }

    /// The mosaic, if it is one.
    pub fn cfa(self) -> Option<CfaPattern> {
        match self {
            Self::Bayer(cfa) => Some(cfa),
            Self::Mono | Self::Rgb => None,
        }
    }
}

impl std::fmt::Display for Layout {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Bayer(cfa) => cfa.fmt(f),
            Self::Mono => f.write_str("monochrome"),
            Self::Rgb => f.write_str("three values per pixel"),
        }
    }
}

/// The color filter in front of the lens of a monochrome camera (frame-sequential RGB).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Filter {
    /// Red.
    R,
    /// Green.
    G,
    /// Blue.
    B,
}

impl Filter {
    /// 0 red, 1 green, 2 blue.
    pub fn channel(self) -> usize {
        self as usize
    }

    /// `r`, `g` or `b`.
    pub fn name(self) -> &'static str {
        ["r", "g", "b"][self.channel()]
    }
}
