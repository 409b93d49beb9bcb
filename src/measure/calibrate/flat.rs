//! The flat field.
use super::Calibrated;
use crate::base::{Result, Watch};
use crate::measure::calibration::{Calibrations, FlatField};
use crate::session::SessionFolder;
/// The relative response of every value of a frame, from flats; `uniformity_se` is the relative standard uncertainty of
/// the source's evenness over the sample square.
///
/// # Errors
/// No usable flat, no dark; a frame is missing, changed or of another camera.
pub fn flat(
    session: &SessionFolder,
    known: &Calibrations,
    uniformity_se: f64,
    watch: &dyn Watch,
) -> Result<Calibrated<FlatField>> {
    todo!()
}
