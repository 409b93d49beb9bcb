//! The response curve.
use super::{Calibrated, LinearityOptions};
use crate::base::{Result, Watch};
use crate::measure::calibration::{Calibrations, Linearity};
use crate::session::SessionFolder;
/// The response curve and the photon transfer from steady light at many exposures.
///
/// # Errors
/// Too few usable exposures or repeats, no dark; a frame is missing, changed or of another camera.
pub fn linearity(
    session: &SessionFolder,
    known: &Calibrations,
    options: &LinearityOptions,
    watch: &dyn Watch,
) -> Result<Calibrated<Linearity>> {
    todo!()
}
