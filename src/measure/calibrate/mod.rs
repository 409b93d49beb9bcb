//! From recorded sessions to calibrations: what pixels read without light, how they answer to light, the white standard,
//! the lamp, the camera's geometry and its colors; each value with its uncertainty.
//!
//! Frames are read one after another; never more than two are held, beside sums over pixels. docs/calibration.md has the
//! equations and says how each session is shot.

mod board;
mod chart;
mod chart_rates;
mod color;
mod corners;
mod curve_fit;
mod dark;
mod darks;
mod drift;
mod flat;
mod geometry;
mod least_squares;
mod linearity;
mod panel;
mod patch;
mod readings;
mod recording;
mod tour;
mod transfer;
mod view;
mod white;

pub use color::{ColorOptions, ColorPatch, ColorReport, color};
pub use dark::dark;
pub use drift::drift;
pub use flat::flat;
pub use geometry::{GeometryOptions, GeometryReport, LensPart, PoseReport, geometry};
pub use linearity::linearity;
pub use panel::Factor;
pub use white::white;

use super::calibration::Dated;
use crate::session::FrameKind;

/// A calibration and what must be said of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibrated<T> {
    /// The calibration; [`Dated::write`] makes its file.
    pub dated: Dated<T>,
    /// What the operator should know.
    pub warnings: Vec<String>,
    /// What is out of tolerance; empty when it can be relied on.
    pub faults: Vec<String>,
}

/// How darks are judged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DarkOptions {
    /// A pixel is hot when its dark current or its bias stands this many robust standard deviations off.
    pub hot_sigma: f64,
}

impl Default for DarkOptions {
    fn default() -> Self {
        Self { hot_sigma: 8.0 }
    }
}

/// How the response curve is measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinearityOptions {
    /// The frames with steady light; none: the whites, or, without any, the flats.
    pub kind: Option<FrameKind>,
    /// The pixels used: column and row of the first one, columns, rows; none: a square of a quarter of the image's shorter
    /// side around the sample center.
    pub region: Option<[usize; 4]>,
    /// Highest power of the signal in the correction, 0..=3.
    pub max_order: usize,
    /// Frames in which a pixel of the region reaches this fraction of the white level are not used.
    pub usable_fraction: f64,
}

impl Default for LinearityOptions {
    fn default() -> Self {
        Self {
            kind: None,
            region: None,
            max_order: 2,
            usable_fraction: USABLE_FRACTION,
        }
    }
}

/// How the white standard is read.
#[derive(Debug, Clone, PartialEq)]
pub struct WhiteOptions {
    /// Which panel: maker, serial number.
    pub panel: String,
    /// Where its reflectance factor comes from.
    pub factor: Factor,
}

/// Frames with brighter pixels are not used (fraction of the white level), where no other limit is given.
const USABLE_FRACTION: f64 = 0.92;
