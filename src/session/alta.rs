//! BRDF as a text data file of ALTA (the library for analysis and fitting of BRDF of Belcour, Barla and Pacanowski).
//!
//! A header of `#KEY value` lines, then one line per point: polar angle and azimuth toward the light, then toward the
//! viewer (`SPHERICAL_TL_PL_TV_PV`, radians, sample frame), the BRDF of r, g, b (1/sr), and a vertical segment per channel:
//! the lower and upper end of mean -+ 2 standard errors. `#VS 2` means a segment by both its ends; it is repeated for each
//! channel, as older versions want it. Newer versions read the first channel's segment only. Lines that begin with `# `
//! are comments.

use super::measurements::sample_angles;
use super::{Measurements, Quantity, SessionStamp};
use std::fmt::Write;

/// Half a segment, in standard errors.
const COVERAGE: f64 = 2.0;

/// The file's text; see the head of this module.
pub fn alta_text(measurements: &Measurements, stamp: &SessionStamp, synthetic: bool) -> String {
    let line = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
    let mut text = String::from("#ALTA BEGIN HEADER\n");
    if synthetic {
        text += "# synthetic: no camera saw any cloth\n";
    }
    // Writing to a string cannot fail.
    let _ = writeln!(
        text,
        "# session {}, {}, rig {}, camera {}",
        line(&stamp.name),
        line(&stamp.started_utc),
        line(&stamp.rig),
        line(&stamp.camera)
    );
    text += "# BRDF, 1/sr (cosine of the light divided out); angles in radians, azimuths in the sample frame\n";
    text += "# columns: theta_light phi_light theta_view phi_view r g b r_low r_high g_low g_high b_low b_high\n";
    text += "# low and high: mean - and + 2 standard errors\n";
    text +=
        "#DIM 4 3\n#PARAM_IN SPHERICAL_TL_PL_TV_PV\n#PARAM_OUT RGB_COLOR\n#VS 2\n#VS 2\n#VS 2\n";
    text += "#ALTA END HEADER\n";
    for intensity in &measurements.intensities {
        let (mean, se) = Quantity::Brdf.of(intensity);
        let segments =
            (0..3).flat_map(|k| [mean[k] - COVERAGE * se[k], mean[k] + COVERAGE * se[k]]);
        let numbers = sample_angles(&intensity.configuration).into_iter();
        let cells: Vec<String> = numbers
            .chain(mean)
            .chain(segments)
            .map(|x| x.to_string())
            .collect();
        text += &cells.join("\t");
        text.push('\n');
    }
    text
}
