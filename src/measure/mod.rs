//! RAW frames to linear mean RGB with standard error.
//!
//! Never demosaics: means are per channel of the color filter array. What is corrected and what is not is written in
//! docs/measure.md. Knows no rig: frames come from a session folder.

mod container;
mod crop;
mod dark;
mod decode;
mod frames;
mod noise;
mod run;
mod statistics;
mod white;

pub use decode::{RawFrame, decode, decode_file};
pub use noise::NoiseReport;
pub use run::{
    Budget, Condition, ConfigurationReport, MeasureOptions, MeasureReport, measure_session,
};
pub use statistics::{ChannelStatistics, Crop, FrameStatistics, frame_statistics};
pub use white::WhiteReport;
