//! What a configuration's crop looks like once exposures are merged and corrected.

use super::RawFrame;
use crate::base::Result;
use crate::session::{Configuration, FrameRecord, Layout};

/// The surroundings of one configuration's crop: normalized radiance, value by value, never demosaiced.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Column and row of the visible area its top left pixel is.
    pub origin: [usize; 2],
    /// Columns and rows.
    pub size: [usize; 2],
    /// Which channels its pixels have, from its own top left pixel on.
    pub layout: Layout,
    /// `size[0] * size[1]` times [`Layout::values_per_pixel`] values, row by row; 0 where `kept` is false.
    pub values: Vec<f32>,
    /// Standard deviation of each value from noise.
    pub noise: Vec<f32>,
    /// False for hot pixels and for those saturated in every exposure.
    pub kept: Vec<bool>,
    /// Fraction of each pixel that the sample square covers, 0..=1.
    pub covered: Vec<f32>,
    /// Corners of the sample square in pixels of the visible area, in order around it.
    pub corners: Vec<[f64; 2]>,
}

/// Sees frames and crops go by while a session is measured; called from several threads.
pub trait Viewer: Sync {
    /// A frame was decoded.
    fn frame(&self, record: &FrameRecord, frame: &RawFrame) -> Result<()>;

    /// A configuration was merged.
    fn crop(&self, configuration: &Configuration, picture: &Picture) -> Result<()>;
}

/// Nobody looks.
#[derive(Debug, Clone, Copy)]
pub struct Unviewed;

impl Viewer for Unviewed {
    fn frame(&self, _: &FrameRecord, _: &RawFrame) -> Result<()> {
        Ok(())
    }

    fn crop(&self, _: &Configuration, _: &Picture) -> Result<()> {
        Ok(())
    }
}
