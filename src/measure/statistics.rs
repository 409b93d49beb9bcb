//! What lies in a crop of one frame, channel by channel.

use super::RawFrame;
use crate::base::{Error, Result};
use crate::session::CfaPattern;
use serde::Serialize;

/// A box of pixels of the visible area.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Crop {
    /// First column.
    pub x: usize,
    /// First row.
    pub y: usize,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

/// Raw values of one channel of the color filter array; black not subtracted.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ChannelStatistics {
    /// `R`, `G1` (the greens of even rows of the visible area), `G2` (of odd rows) or `B`.
    pub channel: &'static str,
    /// Mean raw value.
    pub mean: f64,
    /// Smallest raw value.
    pub min: u16,
    /// Largest raw value.
    pub max: u16,
    /// Pixels at or above the white level.
    pub clipped: usize,
    /// Pixels.
    pub pixels: usize,
    /// Black level the file or the camera table states.
    pub black: f64,
}

/// Statistics of a crop, channels in the order R, G1, G2, B.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FrameStatistics {
    /// The crop, in visible-area coordinates.
    pub crop: Crop,
    /// The four channels.
    pub channels: Vec<ChannelStatistics>,
}

/// Means, extremes and clipped pixels of a crop, per channel of the color filter array.
///
/// # Errors
/// When the crop leaves the visible area, is empty, or misses a channel (less than 2 x 2 pixels).
pub fn frame_statistics(frame: &RawFrame, crop: Crop) -> Result<FrameStatistics> {
    let inside = |start: usize, size: usize, whole: usize| {
        size >= 2 && start.checked_add(size).is_some_and(|end| end <= whole)
    };
    if !inside(crop.x, crop.width, frame.width) || !inside(crop.y, crop.height, frame.height) {
        return Err(Error::new(format!(
            "crop {},{},{},{} does not lie in the visible area of {} x {} pixels",
            crop.x, crop.y, crop.width, crop.height, frame.width, frame.height
        ))
        .with_hint(
            "a crop is X,Y,WIDTH,HEIGHT, at least 2 x 2 pixels, from the top left visible pixel",
        ));
    }
    let mut places = [(0u64, u16::MAX, 0u16, 0usize, 0usize); 4];
    for y in crop.y..crop.y + crop.height {
        let row = &frame.data[y * frame.width..(y + 1) * frame.width];
        for (x, &value) in row.iter().enumerate().skip(crop.x).take(crop.width) {
            let place = &mut places[CfaPattern::position(y, x)];
            place.0 += u64::from(value);
            place.1 = place.1.min(value);
            place.2 = place.2.max(value);
            place.3 += usize::from(value >= frame.white);
            place.4 += 1;
        }
    }
    let names = names(frame.cfa());
    let channels = ["R", "G1", "G2", "B"].into_iter().filter_map(|channel| {
        let at = names.iter().position(|&n| n == channel)?;
        let (sum, min, max, clipped, pixels) = places[at];
        Some(ChannelStatistics {
            channel,
            mean: sum as f64 / pixels as f64,
            min,
            max,
            clipped,
            pixels,
            black: frame.black[at],
        })
    });
    Ok(FrameStatistics {
        crop,
        channels: channels.collect(),
    })
}

/// The channel names of the 2x2 block, row by row.
fn names(cfa: CfaPattern) -> [&'static str; 4] {
    let channels = cfa.channels();
    [0, 1, 2, 3].map(|place| match (channels[place], place / 2) {
        (0, _) => "R",
        (2, _) => "B",
        (_, 0) => "G1",
        _ => "G2",
    })
}
