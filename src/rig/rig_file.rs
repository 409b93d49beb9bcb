//! The rig file: from TOML to a checked [`RigDescription`].

use super::description::{
    Axis, AxisName, Board, CameraDescription, Lamp, Light, MotorAxis, RigDescription, White,
};
use crate::base::{Context, Error, Result};
use serde::Deserialize;
use std::collections::BTreeMap;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct AxisFile {
    board: Option<String>,
    letter: Option<char>,
    degrees_per_unit: Option<f64>,
    sign: Option<f64>,
    offset_deg: Option<f64>,
    min_deg: Option<f64>,
    max_deg: Option<f64>,
    tolerance_deg: Option<f64>,
    settle_ms: Option<f64>,
    fixed_deg: Option<f64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RigFile {
    name: String,
    #[serde(default)]
    description: String,
    feed_deg_per_min: f64,
    boards: Vec<Board>,
    axes: BTreeMap<String, AxisFile>,
    #[serde(default)]
    park: BTreeMap<String, f64>,
    lamp: Lamp,
    light: Light,
    camera: CameraDescription,
    white: White,
}

impl RigDescription {
    /// Parses and checks the text of a rig file.
    ///
    /// # Errors
    /// It is not of the form, an axis is missing, a name is unknown or used twice, a number is out of range (limits in
    /// the wrong order and NaN included), or the white geometry or the parking place is out of reach.
    pub fn from_toml(text: &str) -> Result<Self> {
        let file: RigFile = toml::from_str(text).context(|| "not a rig file")?;
        let names: Vec<&str> = AxisName::ALL.iter().map(|a| a.name()).collect();
        let known = |key: &str| {
            AxisName::ALL
                .into_iter()
                .find(|a| a.name() == key)
                .ok_or_else(|| {
                    Error::new(format!("unknown axis '{key}'"))
                        .with_hint(format!("the axes are {}", names.join(", ")))
                })
        };
        let mut axes = BTreeMap::new();
        for (key, axis) in file.axes {
            let name = known(&key)?;
            axes.insert(name, axis.checked().context(|| format!("axis {key}"))?);
        }
        let mut park_deg = BTreeMap::new();
        for (key, angle) in file.park {
            park_deg.insert(known(&key)?, angle);
        }
        let mut in_order = Vec::new();
        for name in AxisName::ALL {
            in_order.push(axes.remove(&name).ok_or_else(|| {
                Error::new(format!("axis {} is missing", name.name()))
                    .with_hint("an axis without a motor is written { fixed_deg = .. }")
            })?);
        }
        let axes = in_order
            .try_into()
            .map_err(|_| Error::new("expected five axes"))?;
        let rig = Self {
            name: file.name,
            description: file.description,
            feed_deg_per_min: file.feed_deg_per_min,
            boards: file.boards,
            axes,
            park_deg,
            lamp: file.lamp,
            light: file.light,
            camera: file.camera,
            white: file.white,
            text: text.to_owned(),
        };
        rig.check()?;
        Ok(rig)
    }

    fn check(&self) -> Result<()> {
        let mut names: Vec<&str> = self.boards.iter().map(|b| b.name.as_str()).collect();
        names.sort_unstable();
        if names.is_empty() || names.windows(2).any(|w| w[0] == w[1]) {
            return Err(Error::new("board names must be unique, at least one")
                .with_hint("see rig_configs/five_axis_grblhal.toml"));
        }
        let board_known = |board: &str, what: &str| {
            if names.contains(&board) {
                return Ok(());
            }
            Err(Error::new(format!("{what}: unknown board '{board}'"))
                .with_hint(format!("the boards are {}", names.join(", "))))
        };
        let mut used = Vec::new();
        for name in AxisName::ALL {
            if let Axis::Motor(m) = self.axis(name) {
                board_known(&m.board, name.name())?;
                if used.contains(&(&m.board, m.letter)) {
                    return Err(Error::new(format!(
                        "axis {}: letter {} of board '{}' is used twice",
                        name.name(),
                        m.letter,
                        m.board
                    )));
                }
                used.push((&m.board, m.letter));
            }
        }
        board_known(&self.lamp.board, "lamp")?;
        for board in &self.boards {
            if board.name != self.lamp.board && self.motors_of(&board.name).next().is_none() {
                return Err(Error::new(format!("board '{}' is not used", board.name)));
            }
        }
        self.check_numbers()?;
        self.check_park()?;
        self.angles(&self.white.configuration(0))
            .context(|| "white reference geometry")?;
        Ok(())
    }

    fn check_numbers(&self) -> Result<()> {
        let c = &self.camera;
        in_range("feed_deg_per_min", self.feed_deg_per_min, 1.0, 1e5)?;
        in_range("lamp.power_s", self.lamp.power_s, 1e-3, 1e6)?;
        in_range("lamp.warm_up_s", self.lamp.warm_up_s, 0.0, 7200.0)?;
        in_range("light.distance_mm", self.light.distance_mm, 1.0, 1e5)?;
        for side in self.light.size_mm {
            in_range("light.size_mm", side, 0.1, 1e4)?;
        }
        in_range("camera.pixel_mm", c.pixel_mm, 1e-6, 100.0)?;
        in_range("camera.sample_square_mm", c.sample_square_mm, 1e-3, 1e4)?;
        in_range("camera.repeats", f64::from(c.repeats), 1.0, 1000.0)?;
        in_range(
            "camera.dark_repeats",
            f64::from(c.dark_repeats),
            0.0,
            1000.0,
        )?;
        for &e in &c.exposures_ms {
            in_range("camera.exposures_ms", e, 1e-3, 3.6e6)?;
        }
        if c.exposures_ms.is_empty() || !c.exposures_ms.windows(2).all(|w| w[0] < w[1]) {
            return Err(Error::new(
                "camera.exposures_ms must be at least one time, ascending",
            ));
        }
        let w = &self.white;
        for (name, theta) in [
            ("white.light_theta_deg", w.light_theta_deg),
            ("white.camera_theta_deg", w.camera_theta_deg),
        ] {
            in_range(name, theta, 0.0, 89.0)?;
        }
        for phi in [w.light_phi_deg, w.camera_phi_deg, w.rotation_deg] {
            in_range("an azimuth of white", phi, -720.0, 720.0)?;
        }
        for (factor, se) in w.reflectance_factor.iter().zip(w.reflectance_factor_se) {
            in_range("white.reflectance_factor", *factor, 0.01, 2.0)?;
            in_range("white.reflectance_factor_se", se, 0.0, 1.0)?;
        }
        Ok(())
    }

    fn check_park(&self) -> Result<()> {
        for (name, angle) in &self.park_deg {
            let key = format!("park.{}", name.name());
            match self.axis(*name) {
                Axis::Motor(m) => in_range(&key, *angle, m.min_deg, m.max_deg)?,
                Axis::Fixed { .. } => {
                    return Err(Error::new(format!("{key}: a fixed axis cannot be parked")));
                }
            }
        }
        Ok(())
    }
}

/// Fails when `value` is not in `low..=high`; NaN never is.
fn in_range(name: &str, value: f64, low: f64, high: f64) -> Result<()> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(Error::new(format!(
        "{name} is {value}, expected {low} to {high}"
    )))
}

impl AxisFile {
    fn checked(self) -> Result<Axis> {
        let tolerance_deg = self.tolerance_deg.unwrap_or(0.05);
        in_range("tolerance_deg", tolerance_deg, 1e-4, 5.0)?;
        if let Some(angle_deg) = self.fixed_deg {
            let motor_keys =
                self.board.is_some() || self.letter.is_some() || self.min_deg.is_some();
            if motor_keys {
                return Err(Error::new(
                    "fixed_deg and the keys of a driven axis exclude each other",
                ));
            }
            in_range("fixed_deg", angle_deg, -720.0, 720.0)?;
            return Ok(Axis::Fixed {
                angle_deg,
                tolerance_deg,
            });
        }
        let missing = |key: &str| {
            Error::new(format!("{key} is missing")).with_hint(
                "a driven axis needs board, letter, min_deg and max_deg; a fixed one fixed_deg",
            )
        };
        let axis = MotorAxis {
            board: self.board.ok_or_else(|| missing("board"))?,
            letter: self.letter.ok_or_else(|| missing("letter"))?,
            degrees_per_unit: self.degrees_per_unit.unwrap_or(1.0),
            sign: self.sign.unwrap_or(1.0),
            offset_deg: self.offset_deg.unwrap_or(0.0),
            min_deg: self.min_deg.ok_or_else(|| missing("min_deg"))?,
            max_deg: self.max_deg.ok_or_else(|| missing("max_deg"))?,
            tolerance_deg,
            settle_ms: self.settle_ms.unwrap_or(0.0),
        };
        if !"XYZABC".contains(axis.letter) {
            return Err(Error::new(format!(
                "letter '{}' is not one of X Y Z A B C",
                axis.letter
            )));
        }
        in_range("degrees_per_unit", axis.degrees_per_unit, 1e-6, 1e4)?;
        in_range("offset_deg", axis.offset_deg, -1e4, 1e4)?;
        in_range("min_deg", axis.min_deg, -1e4, 1e4)?;
        in_range("max_deg", axis.max_deg, -1e4, 1e4)?;
        in_range("settle_ms", axis.settle_ms, 0.0, 60_000.0)?;
        if (axis.sign.abs() - 1.0).abs() > 0.0 || axis.sign.is_nan() {
            return Err(Error::new(format!(
                "sign is {}, expected 1 or -1",
                axis.sign
            )));
        }
        if axis.min_deg >= axis.max_deg {
            return Err(Error::new(format!(
                "min_deg {} is not below max_deg {}",
                axis.min_deg, axis.max_deg
            )));
        }
        Ok(Axis::Motor(axis))
    }
}
