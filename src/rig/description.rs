//! What a rig is: boards, axes with their limits, lamp, camera, white reference. One TOML file per rig.
//!
//! docs/rig.md explains every key; docs/conventions.md every sign.

use super::bodies::Clearance;
use super::shots::white_id;
use crate::base::{Context, Result};
use crate::math::PolarDirection;
use crate::session::{Configuration, Plan, WhiteReference, files};
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
    /// What it speaks.
    #[serde(default)]
    pub protocol: Protocol,
    /// Device number in its daisy chain (Zaber); of no meaning to GRBL.
    #[serde(default = "one_address")]
    pub address: u8,
}

/// What a motion controller speaks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Protocol {
    /// GRBL 1.1 or grblHAL.
    #[default]
    Grbl,
    /// Zaber ASCII, version 2, with checksums.
    Zaber,
}

/// How a device's byte stream is opened.
#[derive(Debug, Clone, PartialEq)]
pub struct Port {
    /// Name in the rig file: a board's, or `lamp`.
    pub name: String,
    /// Device path.
    pub path: String,
    /// Baud rate.
    pub baud: u32,
    /// DTR while opening; left to the system when absent.
    pub dtr: Option<bool>,
}

impl Board {
    /// How it is reached.
    pub fn connection(&self) -> Port {
        Port {
            name: self.name.clone(),
            path: self.port.clone(),
            baud: self.baud,
            dtr: self.dtr,
        }
    }
}

fn one_address() -> u8 {
    1
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
    /// Play of the gear, degrees: a move that ends against `approach` goes this far beyond and comes back. 0 = none.
    pub backlash_deg: f64,
    /// +1 or -1: the direction in which every move of an axis with backlash ends.
    pub approach: f64,
    /// The fastest this axis shall go, degrees per second.
    pub speed_deg_per_s: f64,
    /// Degrees per second squared, for time estimates and the bound on a move's time; the board's own is compared.
    pub acceleration_deg_per_s2: f64,
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

/// What switches the lamp.
#[derive(Debug, Clone, PartialEq)]
pub enum LampOutput {
    /// The spindle output of a GRBL board.
    Board {
        /// Which board.
        board: String,
        /// Spindle speed `S` that gives the wanted brightness.
        power_s: f64,
    },
    /// A current source of its own that speaks SCPI over a serial port.
    Scpi {
        /// How it is reached.
        port: Port,
        /// Output channel, from 1.
        channel: u8,
        /// Current, amperes.
        current_a: f64,
    },
}

/// The lamp.
#[derive(Debug, Clone, PartialEq)]
pub struct Lamp {
    /// What switches it.
    pub output: LampOutput,
    /// Wait after switching on, seconds.
    pub warm_up_s: f64,
    /// Sample frames after which the reference pose is shot again, to follow the lamp's drift; 0 = never.
    pub reference_every: u32,
}

impl Lamp {
    /// The board whose spindle output it is, if it is one.
    pub fn board(&self) -> Option<&str> {
        match &self.output {
            LampOutput::Board { board, .. } => Some(board),
            LampOutput::Scpi { .. } => None,
        }
    }

    /// What [`super::Light::switch_on`] is asked for.
    pub fn power(&self) -> f64 {
        match &self.output {
            LampOutput::Board { power_s, .. } => *power_s,
            LampOutput::Scpi { current_a, .. } => *current_a,
        }
    }
}

/// The light source as the sample sees it.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LightSource {
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
    /// How the exposures of a configuration are chosen.
    #[serde(default)]
    pub metering: Metering,
    /// Metered: how many neighboring exposures of the list each configuration gets.
    #[serde(default = "two")]
    pub bracket: u32,
    /// Shots at further exposures when none of a configuration's is well exposed; needs frames that are looked at.
    #[serde(default = "two")]
    pub reshoots: u32,
    /// Shortest exposure the camera can be asked for when a frame is clipped, milliseconds.
    #[serde(default)]
    pub min_exposure_ms: Option<f64>,
    /// Longest exposure the camera can be asked for when a frame is too dark, milliseconds.
    #[serde(default)]
    pub max_exposure_ms: Option<f64>,
    /// Visible image size, pixels, for cameras that cannot tell.
    #[serde(default)]
    pub size_px: Option<[usize; 2]>,
    /// Image point (x right, y down, pixels) of the sample center, for cameras that cannot tell; else the middle.
    #[serde(default)]
    pub center_px: Option<[f64; 2]>,
}

/// How the exposures of a configuration are chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Metering {
    /// Every configuration gets the whole list.
    #[default]
    Fixed,
    /// A metering shot first; then the longest exposures of the list that do not clip.
    Metered,
}

fn one() -> u32 {
    1
}

fn two() -> u32 {
    2
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

    /// What a session with this plan says of it.
    pub fn reference(&self, plan: &Plan) -> WhiteReference {
        WhiteReference {
            configuration: self.configuration(white_id(plan)),
            reflectance_factor: self.reflectance_factor,
            reflectance_factor_se: self.reflectance_factor_se,
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
    pub light: LightSource,
    /// The camera.
    pub camera: CameraDescription,
    /// The white standard.
    pub white: White,
    /// The solid parts and the distance they keep; none when the file has no bodies.
    pub clearance: Option<Clearance>,
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

    /// True when the file says which solid parts there are; without bodies nothing keeps arms from meeting.
    pub fn clearance_is_checked(&self) -> bool {
        self.clearance.is_some()
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
