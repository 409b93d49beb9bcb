//! The reflectance factor of a white panel.
use std::path::PathBuf;
/// Where a panel's reflectance factor at the reference geometry comes from.
#[derive(Debug, Clone, PartialEq)]
pub enum Factor {
    /// The session's manifest.
    Session,
    /// Stated: factor and standard uncertainty, r, g, b.
    Stated([f64; 3], [f64; 3]),
    /// A table by geometry (CSV), and its standard uncertainty; none: the manifest's.
    Table(PathBuf, Option<[f64; 3]>),
}
