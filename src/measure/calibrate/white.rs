//! The white standard.
use super::{Calibrated, WhiteOptions};
use crate::base::{Result, Watch};
use crate::measure::calibration::{Calibrations, WhiteStandard};
use crate::session::SessionFolder;
/// The responsivity, from the white standard at the session's reference geometry.
///
/// # Errors
/// Every white is clipped, no dark, the panel's factor is not known at this geometry; a frame is missing, changed or of
/// another camera.
pub fn white(
    session: &SessionFolder,
    known: &Calibrations,
    options: &WhiteOptions,
    watch: &dyn Watch,
) -> Result<Calibrated<WhiteStandard>> {
    todo!()
}
