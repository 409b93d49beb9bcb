//! RAW frames to linear mean RGB with standard error.
//!
//! Never demosaics: means are per channel of the color filter array. What is corrected and what is not is written in
//! docs/measure.md. Knows no rig: frames come from a session folder.

pub mod calibration;
pub mod checks;
mod crop;
mod dark;
mod decode;
mod frames;
mod judge;
mod lamp;
mod noise;
mod picture;
mod report;
mod run;
mod stack;
mod statistics;
mod visit;
mod white;

pub use decode::{RawFrame, decode, decode_file};
pub use judge::FrameJudge;
pub use lamp::{LampReport, LampVisit};
pub use noise::NoiseReport;
pub use picture::{Picture, Unviewed, Viewer};
pub use report::{Budget, Condition, ConfigurationReport, MeasureOptions, MeasureReport};
pub use run::measure_session;
pub use statistics::{ChannelStatistics, Crop, FrameStatistics, frame_statistics};
pub use white::WhiteReport;
