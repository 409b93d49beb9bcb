//! The lamp.
use super::Calibrated;
use crate::base::{Result, Watch};
use crate::measure::calibration::{Calibrations, LampDrift};
use crate::session::SessionFolder;
/// How the lamp behaves, from the visits of the reference pose.
///
/// # Errors
/// Fewer than three visits with an exposure in common, no dark; a frame is missing, changed or of another camera.
pub fn drift(
    session: &SessionFolder,
    known: &Calibrations,
    watch: &dyn Watch,
) -> Result<Calibrated<LampDrift>> {
    todo!()
}
