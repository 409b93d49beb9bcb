//! Plans of published measurements, and grids.

use super::{Configuration, Plan};
use crate::base::{Error, Result};
use crate::math::PolarDirection;
use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI};

/// The 16 configurations of Khungurn 2015 (`rig_configs/plans/khungurn16.toml`).
///
/// # Errors
/// None: the file is part of the program.
pub fn khungurn16() -> Result<Plan> {
    Plan::from_toml(include_str!("../../rig_configs/plans/khungurn16.toml"))
}

/// Cells along each side of Irawan's grid of incident directions.
pub const IRAWAN_SIDE: usize = 15;

/// Irawan's exitant directions: polar angle, azimuth, degrees, sample frame (Irawan 2008, chapter 8).
pub const IRAWAN_EXITANT_DEG: [[f64; 2]; 7] = [
    [0.0, 0.0],
    [30.0, 0.0],
    [30.0, 90.0],
    [60.0, 0.0],
    [60.0, 45.0],
    [60.0, 90.0],
    [60.0, 135.0],
];

/// Shirley and Chiu's map (1997) of the square -1..1 onto the unit disk: radius and azimuth, radians in 0..2 pi.
/// One to one; areas shrink by pi / 4 everywhere.
pub fn concentric_map([p, q]: [f64; 2]) -> [f64; 2] {
    let [radius, azimuth] = if p.abs() > q.abs() {
        [p, FRAC_PI_4 * q / p]
    } else if q.abs() > 0.0 {
        [q, FRAC_PI_2 - FRAC_PI_4 * p / q]
    } else {
        return [0.0, 0.0];
    };
    let opposite = if radius < 0.0 { PI } else { 0.0 };
    [radius.abs(), (azimuth + opposite).rem_euclid(2.0 * PI)]
}

/// The plan of Irawan 2008: 15 x 15 incident directions under the concentric map, for each of 7 exitant directions.
///
/// Incident directions are the centers of the grid's cells, so that each stands for the same area of the disk, and none
/// occurs twice: the middle cell is the normal. The disk's rim is at `max_theta_deg`, polar angle proportional to radius (the
/// radial law is not published); with 75 degrees the rings are at 0, 10, ..., 70 degrees. Ids run from 1 to 1575, exitant
/// directions outermost. The camera is at azimuth 0 of the laboratory: the sample is turned to it. Poses in which camera
/// and light nearly coincide are kept: what a rig cannot reach is the rig's to say.
///
/// # Errors
/// When `max_theta_deg` is not above 0 and at most 90.
pub fn irawan(max_theta_deg: f64) -> Result<Plan> {
    if !(max_theta_deg > 0.0 && max_theta_deg <= 90.0) {
        return Err(Error::new(format!(
            "largest polar angle {max_theta_deg}: expected 0 < angle <= 90 degrees"
        )));
    }
    let center = |i: usize| (2 * i + 1) as f64 / IRAWAN_SIDE as f64 - 1.0;
    let mut configurations = Vec::new();
    for [camera_theta, camera_phi] in IRAWAN_EXITANT_DEG {
        for row in 0..IRAWAN_SIDE {
            for column in 0..IRAWAN_SIDE {
                let [radius, phi] = concentric_map([center(column), center(row)]);
                configurations.push(facing(
                    configurations.len(),
                    PolarDirection::new((max_theta_deg * radius).to_radians(), phi),
                    PolarDirection::from_degrees(camera_theta, camera_phi),
                ));
            }
        }
    }
    Ok(Plan {
        shows: super::FrameKind::Sample,
        name: "irawan".to_owned(),
        description: format!(
            "225 incident directions (15 x 15 concentric map, cell centers, rim at {max_theta_deg} degrees) x 7 exitant directions of Irawan 2008; camera at azimuth 0, the sample turned to it"
        ),
        configurations,
    })
}

/// Directions for a grid, degrees, sample frame; every light direction is combined with every camera direction.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Grid {
    /// Polar angles of the light.
    pub light_theta_deg: Vec<f64>,
    /// Azimuths of the light.
    pub light_phi_deg: Vec<f64>,
    /// Polar angles of the camera.
    pub camera_theta_deg: Vec<f64>,
    /// Azimuths of the camera.
    pub camera_phi_deg: Vec<f64>,
}

/// A plan of all pairs of light and camera directions of a grid; a polar angle of 0 is taken once, whatever the azimuths.
///
/// # Errors
/// When a list is empty, a polar angle is not in 0 <= angle < 90, or an azimuth is not within two turns.
pub fn grid(grid: &Grid) -> Result<Plan> {
    let lights = directions("light", &grid.light_theta_deg, &grid.light_phi_deg)?;
    let cameras = directions("camera", &grid.camera_theta_deg, &grid.camera_phi_deg)?;
    let mut configurations = Vec::new();
    for camera in &cameras {
        for light in &lights {
            configurations.push(facing(configurations.len(), *light, *camera));
        }
    }
    Ok(Plan {
        shows: super::FrameKind::Sample,
        name: "grid".to_owned(),
        description: format!(
            "{} light directions x {} camera directions; camera at azimuth 0, the sample turned to it",
            lights.len(),
            cameras.len()
        ),
        configurations,
    })
}

fn directions(what: &str, thetas: &[f64], phis: &[f64]) -> Result<Vec<PolarDirection>> {
    if thetas.is_empty() || phis.is_empty() {
        return Err(Error::new(format!("the grid has no {what} directions"))
            .with_hint("give at least one polar angle and one azimuth"));
    }
    let bad = |name: &str, value: f64, expected: &str| {
        Error::new(format!("{what} {name} {value}: expected {expected}"))
    };
    let mut found = Vec::new();
    for &theta in thetas {
        if !(0.0..90.0).contains(&theta) {
            return Err(bad("polar angle", theta, "0 <= angle < 90 degrees"));
        }
        let once = if theta > 0.0 { phis } else { &phis[..1] };
        for &phi in once {
            if !(-360.0..=360.0).contains(&phi) {
                return Err(bad("azimuth", phi, "an angle in degrees within one turn"));
            }
            found.push(PolarDirection::from_degrees(theta, phi));
        }
    }
    Ok(found)
}

/// The pose with these directions in the sample frame and the camera at azimuth 0 of the laboratory.
fn facing(index: usize, light: PolarDirection, camera: PolarDirection) -> Configuration {
    let phi = if light.theta > 0.0 {
        super::measurements::tidy_azimuth(light.phi - camera.phi)
    } else {
        0.0
    };
    Configuration {
        id: index as u32 + 1,
        light: PolarDirection::new(light.theta, phi),
        camera: PolarDirection::new(camera.theta, 0.0),
        rotation: if camera.phi.abs() > 0.0 {
            -camera.phi
        } else {
            0.0
        },
    }
}
