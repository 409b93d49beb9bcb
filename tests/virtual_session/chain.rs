//! A rig's own calibrations, each made from a session of its own with those made before.

use super::{Setup, calibration, folder};
use goniofit::base::Unwatched;
use goniofit::measure::calibrate::{
    DarkOptions, Factor, GeometryOptions, LinearityOptions, WhiteOptions, dark, drift, flat,
    geometry, linearity, white,
};
use goniofit::measure::calibration::Calibrations;

/// Where the darks are shot, milliseconds: around the exposures of sessions.
const DARKS_MS: [f64; 4] = [1.0, 16.0, 64.0, 160.0];

/// The lamp of the drift session: it settles within an hour and fades by 4 % an hour. One that warms up between two visits
/// would be taken for flicker.
pub fn lamp(elapsed_s: f64) -> [f64; 3] {
    let hours = elapsed_s / 3600.0;
    [1.0, 0.9, 1.1].map(|c| 1.0 - 0.04 * c * hours - 0.01 * (-elapsed_s / 1800.0).exp())
}

/// The rig's calibrations but color; that of geometry states the errors which the setup's poses are drawn from.
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
    let session = calibration::board(&here("board"), setup);
    let board = setup.scene().board;
    let options = GeometryOptions {
        corners: [board.columns - 1, board.rows - 1],
        square_mm: board.square_mm,
        pose: setup.pose_sd,
        hold: Vec::new(),
    };
    let (made, _) = geometry(&session, &known, &options, &Unwatched).unwrap();
    known.geometry = Some(made.dated);
    known
}
