//! A rig's own calibrations, each made from a session of its own with those made before.

use super::{Setup, calibration, folder};
use goniofit::base::Unwatched;
use goniofit::measure::calibrate::{
    DarkOptions, Factor, LinearityOptions, WhiteOptions, dark, drift, flat, linearity, white,
};
use goniofit::measure::calibration::Calibrations;

/// Where the darks are shot, milliseconds: around the exposures of sessions.
const DARKS_MS: [f64; 4] = [1.0, 16.0, 64.0, 160.0];

/// The lamp of the drift session: it warms up within minutes and fades by 4 % an hour.
pub fn lamp(elapsed_s: f64) -> [f64; 3] {
    let hours = elapsed_s / 3600.0;
    [1.0, 0.9, 1.1].map(|c| 1.0 - 0.04 * c * hours - 0.02 * (-elapsed_s / 240.0).exp())
}

/// The rig's calibrations but geometry and color.
pub fn calibrate(setup: &Setup) -> Calibrations {
    let mut known = Calibrations::default();
    let at = folder();
    let here = |name: &str| at.path().join(name);
    let session = calibration::darks(&here("dark"), setup, &DARKS_MS, 4);
    let made = dark(&session, &known, &DarkOptions::default(), &Unwatched).unwrap();
    known.dark = Some(made.dated);
    let session = calibration::linearity(&here("linearity"), setup, 3, false);
    let options = LinearityOptions::default();
    let made = linearity(&session, &known, &options, &Unwatched).unwrap();
    known.linearity = Some(made.dated);
    let session = calibration::flats(&here("flat"), setup, 8, 4);
    let made = flat(&session, &known, 0.0005, &Unwatched).unwrap();
    known.flat = Some(made.dated);
    let session = calibration::white(&here("white"), setup, 3);
    let options = WhiteOptions {
        panel: "virtual".to_owned(),
        factor: Factor::Session,
    };
    let made = white(&session, &known, &options, &Unwatched).unwrap();
    known.white = Some(made.dated);
    let session = calibration::drift(&here("drift"), setup, 13, lamp);
    let made = drift(&session, &known, &Unwatched).unwrap();
    known.drift = Some(made.dated);
    known
}
