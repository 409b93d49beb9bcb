//! BRDF as a text table in the manner of ASTM E1392-96.
//!
//! The layout is the one that published data files of this standard have and their readers expect: header lines of a
//! keyword and its value, the last two `NUM_POINTS` and `VARS`, then one line per point, separated by commas: polar angle
//! and azimuth toward the light, polar angle and azimuth of scatter (toward the camera), all radians, and one value per
//! channel, 1/sr. Azimuths are in the sample frame: the turntable's angle is taken off. Readers take exactly three values
//! for colors, so standard errors go into a second file of the same layout. The standard's own catalog of header keywords
//! is not reproduced.

use super::measurements::sample_angles;
use super::{Measurements, Quantity, SessionStamp};
use std::fmt::Write;

/// The table of the BRDF; see the head of this module.
pub fn astm_text(measurements: &Measurements, stamp: &SessionStamp, synthetic: bool) -> String {
    table(measurements, stamp, synthetic, "BRDF", |i| {
        Quantity::Brdf.of(i).0
    })
}

/// The table of the BRDF's standard errors (one standard deviation), point by point as in [`astm_text`].
pub fn astm_standard_errors(
    measurements: &Measurements,
    stamp: &SessionStamp,
    synthetic: bool,
) -> String {
    let quantity = "standard error of the BRDF (one standard deviation)";
    table(measurements, stamp, synthetic, quantity, |i| {
        Quantity::Brdf.of(i).1
    })
}

fn table(
    measurements: &Measurements,
    stamp: &SessionStamp,
    synthetic: bool,
    quantity: &str,
    values: impl Fn(&super::Intensity) -> [f64; 3],
) -> String {
    let source = if synthetic {
        "synthetic, no camera saw any cloth"
    } else {
        "measured"
    };
    let heads = [
        ("STANDARD", "after ASTM E1392-96"),
        ("SESSION", &stamp.name),
        ("DATE", &stamp.started_utc),
        ("INSTRUMENT", &stamp.rig),
        ("DETECTOR", &stamp.camera),
        ("SOURCE", source),
        ("QUANTITY", quantity),
        (
            "UNITS",
            "1/sr, angles in radians, azimuths in the sample frame",
        ),
        ("CHANNELS", "R G B of the camera"),
    ];
    let mut text = String::new();
    for (key, value) in heads {
        // Readers look for these two words anywhere in the header.
        let value = value
            .replace("VARS", "vars")
            .replace("NUM_POINTS", "points");
        let value: Vec<&str> = value.split_whitespace().collect();
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{key} {}", value.join(" "));
    }
    let _ = writeln!(text, "NUM_POINTS {}", measurements.intensities.len());
    text += "VARS theta_i,phi_i,theta_s,phi_s,R,G,B\n";
    for intensity in &measurements.intensities {
        let numbers = sample_angles(&intensity.configuration).into_iter();
        let cells: Vec<String> = numbers
            .chain(values(intensity))
            .map(|x| x.to_string())
            .collect();
        text += &cells.join(",");
        text.push('\n');
    }
    text
}
