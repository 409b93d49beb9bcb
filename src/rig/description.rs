//! What a rig is: boards, axes with their limits, lamp, camera, white reference. One TOML file per rig.
//!
//! docs/rig.md explains every key; docs/conventions.md every sign.

use crate::base::{Context, Result};
use crate::math::PolarDirection;
use crate::session::{Configuration, files};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;

/// The five axes a goniometer may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum AxisName {
    /// Polar angle of the camera from the sample normal.
    CameraElevation,
    /// Azimuth of the camera.
    CameraAzimuth,
    /// Polar angle of the light from the sample normal.
    LightElevation,
    /// Azimuth of the light.
    LightAzimuth,
    /// Rotation of the sample about its normal.
    Turntable,
}

impl AxisName {
    /// All of them, in the order of [`super::AxisAngles`].
    pub const ALL: [Self; 5] = [
        Self::CameraElevation,
        Self::CameraAzimuth,
        Self::LightElevation,
        Self::LightAzimuth,
        Self::Turntable,
    ];

    /// The name in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::CameraElevation => "camera_elevation",
            Self::CameraAzimuth => "camera_azimuth",
            Self::LightElevation => "light_elevation",
            Self::LightAzimuth => "light_azimuth",
            Self::Turntable => "turntable",
        }
    }
}

/// How a board's position becomes known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Homing {
    /// With `$H`, to its limit switches.
    Cycle,
    /// The operator puts the axes at their zero marks and confirms it.
    ByHand,
}

/// One controller board.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Board {
    /// Name used by the axes and the lamp.
    pub name: String,
    /// Device path.
    pub port: String,
    /// Baud rate.
    #[serde(default = "default_baud")]
    pub baud: u32,
    /// DTR while opening; left to the system when absent.
    #[serde(default)]
    pub dtr: Option<bool>,
    /// How the position becomes known.
    pub homing: Homing,
}

fn default_baud() -> u32 {
    115_200
}

/// An axis with a motor.
#[derive(Debug, Clone, PartialEq)]
pub struct MotorAxis {
    /// Which board.
    pub board: String,
    /// Axis letter on that board.
    pub letter: char,
    /// Degrees per controller unit, positive.
    pub degrees_per_unit: f64,
    /// +1 or -1: direction of the controller unit.
    pub sign: f64,
    /// Angle at controller position 0, degrees.
    pub offset_deg: f64,
    /// Lower limit, degrees.
    pub min_deg: f64,
    /// Upper limit, degrees.
    pub max_deg: f64,
    /// In-position tolerance, degrees.
    pub tolerance_deg: f64,
    /// Wait after a move of this axis, milliseconds.
    pub settle_ms: f64,
}

impl MotorAxis {
    /// Controller position of an angle.
    pub fn units(&self, angle_deg: f64) -> f64 {
        (angle_deg - self.offset_deg) / (self.sign * self.degrees_per_unit)
    }

    /// Angle of a controller position, degrees.
    pub fn angle_deg(&self, units: f64) -> f64 {
        self.offset_deg + self.sign * self.degrees_per_unit * units
    }
}

/// One axis of the rig.
#[derive(Debug, Clone, PartialEq)]
pub enum Axis {
    /// Driven.
    Motor(MotorAxis),
    /// Bolted at an angle.
    Fixed {
        /// The angle, degrees.
        angle_deg: f64,
        /// How far a pose may ask for something else, degrees.
        tolerance_deg: f64,
    },
}

/// The lamp, switched through a board's spindle output.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lamp {
    /// Which board.
    pub board: String,
    /// Spindle speed `S` that gives the wanted brightness.
    pub power_s: f64,
    /// Wait after switching on, seconds.
    pub warm_up_s: f64,
}

/// The light source as the sample sees it.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Light {
    /// Width and height, millimeters.
    pub size_mm: [f64; 2],
    /// From the sample center to its center, millimeters.
    pub distance_mm: f64,
}

/// The camera's scale and exposures.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraDescription {
    /// Maker and model.
    pub name: String,
    /// Millimeters on a plane through the sample center, perpendicular to the view, per pixel.
    pub pixel_mm: f64,
    /// Exposure bracket, milliseconds, ascending.
    pub exposures_ms: Vec<f64>,
    /// Frames per configuration and exposure.
    #[serde(default = "one")]
    pub repeats: u32,
    /// Dark frames per exposure.
    #[serde(default = "one")]
    pub dark_repeats: u32,
    /// Side of the measured square on the sample, millimeters.
    pub sample_square_mm: f64,
}

fn one() -> u32 {
    1
}

/// The white standard and the one geometry it is read at.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct White {
    /// Light direction, degrees.
    pub light_theta_deg: f64,
    /// Light azimuth, degrees.
    pub light_phi_deg: f64,
    /// Camera direction, degrees.
    pub camera_theta_deg: f64,
    /// Camera azimuth, degrees.
    pub camera_phi_deg: f64,
    /// Turntable, degrees.
    #[serde(default)]
    pub rotation_deg: f64,
    /// Its reflectance factor there, r, g, b.
    pub reflectance_factor: [f64; 3],
    /// Standard error of the factor, r, g, b.
    pub reflectance_factor_se: [f64; 3],
}

impl White {
    /// The reference geometry under the id `id`.
    pub fn configuration(&self, id: u32) -> Configuration {
        Configuration {
            id,
            light: PolarDirection::from_degrees(self.light_theta_deg, self.light_phi_deg),
            camera: PolarDirection::from_degrees(self.camera_theta_deg, self.camera_phi_deg),
            rotation: self.rotation_deg.to_radians(),
        }
    }
}

/// A rig.
#[derive(Debug, Clone, PartialEq)]
pub struct RigDescription {
    /// Short name.
    pub name: String,
    /// What it is.
    pub description: String,
    /// Speed of the fastest axis in a move, degrees per minute.
    pub feed_deg_per_min: f64,
    /// At least one.
    pub boards: Vec<Board>,
    /// In the order of [`AxisName::ALL`].
    pub axes: [Axis; 5],
    /// Where to leave each axis at the end, degrees; axes not named stay.
    pub park_deg: BTreeMap<AxisName, f64>,
    /// The lamp.
    pub lamp: Lamp,
    /// The light source.
    pub light: Light,
    /// The camera.
    pub camera: CameraDescription,
    /// The white standard.
    pub white: White,
    /// The file's text, which goes into the session folder.
    pub text: String,
}

impl RigDescription {
    /// Reads and checks a rig file.
    ///
    /// # Errors
    /// The file cannot be read, or as [`RigDescription::from_toml`].
    pub fn read(path: &Path) -> Result<Self> {
        Self::from_toml(&files::read_text(path)?).context(|| format!("rig {}", path.display()))
    }

    /// The axis of this name.
    pub fn axis(&self, name: AxisName) -> &Axis {
        &self.axes[name as usize]
    }

    /// The driven axes of one board.
    pub fn motors_of<'a>(
        &'a self,
        board: &'a str,
    ) -> impl Iterator<Item = (AxisName, &'a MotorAxis)> {
        AxisName::ALL
            .into_iter()
            .filter_map(move |name| match self.axis(name) {
                Axis::Motor(m) if m.board == board => Some((name, m)),
                _ => None,
            })
    }
}
