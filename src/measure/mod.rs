//! RAW frames to linear mean RGB with standard error.
//!
//! Never demosaics: means are per channel of the color filter array. What is corrected and what is not is written in
//! docs/measure.md. Knows no rig: frames come from a session folder.

pub mod calibrate;
pub mod calibration;
pub mod checks;
mod crop;
mod dark;
mod decode;
mod field;
mod frames;
mod geometry;
mod judge;
mod lamp;
mod linear;
mod merge;
mod noise;
mod picture;
mod radiance;
mod reading;
mod reduce;
mod repeat;
mod report;
mod run;
mod stack;
mod statistics;
mod texture;
mod visit;
mod white;

pub use decode::{RawFrame, decode, decode_file};
pub use judge::FrameJudge;
pub use lamp::{LampReport, LampVisit};
pub use noise::NoiseReport;
pub use picture::{Picture, Unviewed, Viewer};
pub use reading::Footprint;
pub use report::{Budget, Condition, ConfigurationReport, CropRule, MeasureOptions, MeasureReport};
pub use run::{measure_session, measure_viewed};
pub use statistics::{ChannelStatistics, Crop, FrameStatistics, frame_statistics};
pub use white::WhiteReport;
