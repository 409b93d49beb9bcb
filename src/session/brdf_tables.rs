//! BRDF tables, one per exitant direction, as Irawan's measurements are listed (Irawan 2008, chapter 8): the mean of a
//! small area over the cosine of the incident angle and over one reading of a white standard per channel.

use super::measurements::{sample_angles, tidy_azimuth};
use super::plan::tidy_degrees;
use super::{Intensity, Measurements, Quantity};
use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::PI;
use std::fmt::Write;

/// All points of one exitant direction (toward the camera, sample frame).
#[derive(Debug, Clone, PartialEq)]
pub struct BrdfTable {
    /// Polar angle of the exitant direction, degrees.
    pub theta_deg: f64,
    /// Its azimuth in the sample frame, degrees, 0 <= azimuth < 360.
    pub phi_deg: f64,
    /// The rows: measured ones in the order of the measurements, each followed by its copy.
    rows: Vec<Row>,
}

#[derive(Debug, Clone, PartialEq)]
struct Row {
    config: u32,
    /// 0: measured; 180: the copy by the symmetry.
    symmetry_deg: u32,
    /// Incident polar angle and azimuth, exitant polar angle and azimuth, degrees.
    angles_deg: [f64; 4],
    mean: [f64; 3],
    standard_error: [f64; 3],
}

/// Directions that agree to this are the same, degrees.
const SAME_DEG: f64 = 1e-4;

/// A direction as a key: polar angle and azimuth to [`SAME_DEG`]; at the normal the azimuth means nothing.
fn key(theta_deg: f64, phi_deg: f64) -> (i64, i64) {
    let whole = |x: f64| (x / SAME_DEG).round() as i64;
    let theta = whole(theta_deg);
    let turn = whole(360.0);
    (
        theta,
        if theta == 0 {
            0
        } else {
            whole(phi_deg).rem_euclid(turn)
        },
    )
}

/// The tables, in the order in which the measurements first have their exitant directions.
///
/// With `symmetry_180` each point is followed by a copy of itself turned by half a turn about the normal, marked as such,
/// which a weave with that symmetry would show; a copy that falls on a measured pair of directions is left out.
pub fn brdf_tables(measurements: &Measurements, symmetry_180: bool) -> Vec<BrdfTable> {
    let degrees = |i: &Intensity| sample_angles(&i.configuration).map(tidy_degrees);
    let pair = |a: [f64; 4]| (key(a[0], a[1]), key(a[2], a[3]));
    let measured: BTreeSet<_> = measurements
        .intensities
        .iter()
        .map(|i| pair(degrees(i)))
        .collect();
    let mut places: BTreeMap<(i64, i64), usize> = BTreeMap::new();
    let mut tables: Vec<BrdfTable> = Vec::new();
    for intensity in &measurements.intensities {
        let angles_deg = degrees(intensity);
        let [_, _, theta_deg, phi_deg] = angles_deg;
        let place = *places
            .entry(key(theta_deg, phi_deg))
            .or_insert(tables.len());
        if place == tables.len() {
            tables.push(BrdfTable {
                theta_deg,
                phi_deg: if key(theta_deg, 0.0).0 == 0 {
                    0.0
                } else {
                    phi_deg
                },
                rows: Vec::new(),
            });
        }
        let (mean, standard_error) = Quantity::Brdf.of(intensity);
        let row = Row {
            config: intensity.configuration.id,
            symmetry_deg: 0,
            angles_deg,
            mean,
            standard_error,
        };
        let turned = |phi_deg: f64| tidy_degrees(tidy_azimuth(phi_deg.to_radians() + PI));
        let [theta_i, phi_i, theta_e, phi_e] = angles_deg;
        let copy = Row {
            symmetry_deg: 180,
            angles_deg: [theta_i, turned(phi_i), theta_e, turned(phi_e)],
            ..row.clone()
        };
        tables[place].rows.push(row);
        if symmetry_180 && !measured.contains(&pair(copy.angles_deg)) {
            tables[place].rows.push(copy);
        }
    }
    tables
}

impl BrdfTable {
    /// A name for the table's file: `exitant_t60_p045`, degrees; fractions follow a `d`.
    pub fn name(&self) -> String {
        let angle = |deg: f64, width: usize| {
            let text = format!("{deg:.4}");
            let text = text.trim_end_matches('0').trim_end_matches('.');
            let (whole, fraction) = text.split_once('.').unwrap_or((text, ""));
            let mark = if fraction.is_empty() { "" } else { "d" };
            format!("{whole:0>width$}{mark}{fraction}")
        };
        format!(
            "exitant_t{}_p{}",
            angle(self.theta_deg, 2),
            angle(self.phi_deg, 3)
        )
    }

    /// Number of rows, copies included.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// True when it has no rows.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// The text of its file.
    pub fn to_csv(&self, synthetic: bool) -> String {
        let mut text = String::new();
        if synthetic {
            text += "# synthetic\n";
        }
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "# BRDF, unit 1/sr: mean of the sample square over cos(theta_i) and over one white reading per channel\n\
             # (f_r = M / (pi cos(theta_i)), M = pi L / E_normal; a perfect white diffuser is 1/pi = 0.31831)\n\
             # exitant direction: polar angle {} degrees, azimuth {} degrees; azimuths in the sample frame, from weft to warp\n\
             # symmetry_deg: 0 measured, 180 the same number copied to both directions turned by half a turn",
            self.theta_deg, self.phi_deg
        );
        text += "config,symmetry_deg,theta_i_deg,phi_i_deg,theta_e_deg,phi_e_deg,r,g,b,r_se,g_se,b_se\n";
        for row in &self.rows {
            let numbers = row.angles_deg.into_iter();
            let cells: Vec<String> = numbers
                .chain(row.mean)
                .chain(row.standard_error)
                .map(|x| x.to_string())
                .collect();
            let _ = writeln!(
                text,
                "{},{},{}",
                row.config,
                row.symmetry_deg,
                cells.join(",")
            );
        }
        text
    }
}
