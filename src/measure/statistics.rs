//! What lies in a crop of one frame, channel by channel.

use super::RawFrame;
use crate::base::{Error, Result};
use crate::session::Layout;
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

/// Raw values of one channel; black not subtracted.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ChannelStatistics {
    /// Of a mosaic `R`, `G1` (the greens of even rows of the visible area), `G2` (of odd rows) or `B`; `Y` without filters;
    /// `R`, `G` or `B` with three values per pixel.
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

/// Statistics of a crop; channels in the order R, G1, G2, B, or Y, or R, G, B.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FrameStatistics {
    /// The crop, in visible-area coordinates.
    pub crop: Crop,
    /// The channels of the frame's layout.
    pub channels: Vec<ChannelStatistics>,
}

/// Means, extremes and clipped pixels of a crop, per channel.
///
/// # Errors
/// When the crop leaves the visible area, or has less than 2 x 2 pixels (and so might miss a channel).
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
    let values = frame.layout.values_per_pixel();
    for y in crop.y..crop.y + crop.height {
        let start = values * (y * frame.width + crop.x);
        let row = frame.data[start..start + values * crop.width].iter();
        for (index, &value) in (start..).zip(row) {
            let place = &mut places[frame.layout.place(frame.width, index)];
            place.0 += u64::from(value);
            place.1 = place.1.min(value);
            place.2 = place.2.max(value);
            place.3 += usize::from(value >= frame.white);
            place.4 += 1;
        }
    }
    let channels = channels(frame.layout).into_iter().map(|(channel, at)| {
        let (sum, min, max, clipped, pixels) = places[at];
        ChannelStatistics {
            channel,
            mean: sum as f64 / pixels as f64,
            min,
            max,
            clipped,
            pixels,
            black: frame.black[at],
        }
    });
    Ok(FrameStatistics {
        crop,
        channels: channels.collect(),
    })
}

/// Names of the channels, and which place of the layout each is.
fn channels(layout: Layout) -> Vec<(&'static str, usize)> {
    let cfa = match layout {
        Layout::Mono => return vec![("Y", 0)],
        Layout::Rgb => return vec![("R", 0), ("G", 1), ("B", 2)],
        Layout::Bayer(cfa) => cfa,
    };
    let name = |place: usize| match (cfa.channels()[place], place / 2) {
        (0, _) => "R",
        (2, _) => "B",
        (_, 0) => "G1",
        _ => "G2",
    };
    let mut named: Vec<_> = (0..4).map(|place| (name(place), place)).collect();
    named.sort_by_key(|(name, _)| ["R", "G1", "G2", "B"].iter().position(|n| n == name));
    named
}
