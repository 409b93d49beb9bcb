//! Tables, charts, pictures and the HTML pages of a fit and of a measurement.
//!
//! Lays out what it is given and computes nothing. A page is one file: style and charts are inline, no script runs,
//! nothing is loaded from elsewhere.

mod charts;
mod comparison;
pub mod contact_sheet;
mod convergence;
pub mod cut;
pub mod diverging;
mod html;
mod ladder;
pub mod linear_picture;
pub mod measurement;
mod page;
mod png_file;
mod prediction;
pub mod preview;
mod residual_map;
mod svg;
pub mod swatch;

pub use comparison::{ComparisonNotes, PosePictures, comparison_page};
pub use convergence::{Course, CoursePoint, convergence_chart};
pub use ladder::{ladder_page, ladder_table};
pub use page::{Picture, Provenance, Section, Table, page};
pub use prediction::prediction_chart;
