//! Bias, dark current, read noise and hot pixels.
use super::{Calibrated, DarkOptions};
use crate::base::{Result, Watch};
use crate::measure::calibration::{Calibrations, DarkCurrent};
use crate::session::SessionFolder;
/// Bias, dark current, read noise and hot pixels from dark frames.
///
/// # Errors
/// Too few exposures or repeats; a frame is missing, changed or of another camera.
pub fn dark(
    session: &SessionFolder,
    known: &Calibrations,
    options: &DarkOptions,
    watch: &dyn Watch,
) -> Result<Calibrated<DarkCurrent>> {
    todo!()
}
