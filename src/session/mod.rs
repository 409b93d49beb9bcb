//! What travels between the stages: poses, plans, frame records, intensities, and their files.
//!
//! The acquiring half (`rig`, `measure`) and the fitting half (`render`, `fit`) meet only here. Knows neither ports nor
//! renderers.
//!
//! A session folder holds
//! ```text
//! session.json        manifest: written once, before the first frame (atomic)
//! plan.toml rig.toml  copies of what was asked for
//! journal.jsonl       append-only, one fsynced line per event; a torn last line is tolerated
//! frames/             the camera's files, never overwritten
//! measurements.csv    the intensities, once measured
//! measurements.json   the same with everything known about them
//! ```

mod alta;
mod astm;
mod brdf_tables;
pub mod dng;
pub mod files;
pub mod frame_tiff;
mod journal;
mod layout;
mod manifest;
mod measurements;
mod plan;
mod projection;
pub mod protocols;
mod quantity;
mod record;
mod tiff_directory;

pub use alta::alta_text;
pub use astm::{astm_standard_errors, astm_text};
pub use brdf_tables::{BrdfTable, brdf_tables};
pub use dng::{BitDepth, CfaPattern, DngImage, write_dng};
pub use files::sha256;
pub use frame_tiff::{TiffImage, write_tiff};
pub use journal::{Entry, Event, Exposedness, FrameKind, FrameRecord, Journal, read_journal};
pub use layout::{Filter, Layout};
pub use manifest::{CameraFacts, Lens, Manifest, Provenance, SessionFolder, WhiteReference};
pub use measurements::{Intensity, Measurements};
pub use plan::{Configuration, Plan};
pub use projection::{Coverage, Perturbation, Projection, RowSpan};
pub use quantity::Quantity;
pub use record::{
    CalibrationUsed, LampPoint, MeasurementRecord, RecordedConfiguration, SessionStamp,
};
