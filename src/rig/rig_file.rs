//! The rig file: from TOML to a checked [`RigDescription`].

use super::bodies::{self, BodyFile, ClearanceFile};
use super::description::{
    Axis, AxisName, Board, CameraDescription, Lamp, LampOutput, LightSource, MotorAxis, Port,
    Protocol, RigDescription, White,
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
    backlash_deg: Option<f64>,
    approach: Option<f64>,
    speed_deg_per_s: Option<f64>,
    acceleration_deg_per_s2: Option<f64>,
    fixed_deg: Option<f64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct LampFile {
    board: Option<String>,
    power_s: Option<f64>,
    scpi_port: Option<String>,
    baud: Option<u32>,
    channel: Option<u8>,
    current_a: Option<f64>,
    warm_up_s: f64,
    #[serde(default)]
    reference_every: u32,
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
    lamp: LampFile,
    light: LightSource,
    camera: CameraDescription,
    white: White,
    clearance: Option<ClearanceFile>,
    #[serde(default)]
    bodies: Vec<BodyFile>,
}

impl RigDescription {
    /// Parses and checks the text of a rig file.
    ///
    /// # Errors
    /// It is not of the form, an axis is missing, a name is unknown or used twice, a number is out of range (limits in
    /// the wrong order and NaN included), the white geometry or the parking place is out of reach, or
    /// bodies are too near each other at the white geometry.
    pub fn from_toml(text: &str) -> Result<Self> {
        let file: RigFile = toml::from_str(text).context(|| "not a rig file")?;
        in_range("feed_deg_per_min", file.feed_deg_per_min, 1.0, 1e5)?;
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
            axes.insert(
                name,
                axis.checked(file.feed_deg_per_min)
                    .context(|| format!("axis {key}"))?,
            );
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
            lamp: file.lamp.checked().context(|| "lamp")?,
            light: file.light,
            camera: file.camera,
            white: file.white,
            clearance: bodies::checked(file.clearance, file.bodies)?,
            text: text.to_owned(),
        };
        rig.check()?;
        Ok(rig)
    }

    /// The same rig with another list of exposures, milliseconds, every one of which is taken of everything; with another
    /// number of frames per exposure, darks included; or both. Its text says so too, but loses its comments.
    ///
    /// # Errors
    /// The list is not ascending, or a number is out of range.
    pub fn with_exposures(
        &self,
        exposures_ms: Option<&[f64]>,
        repeats: Option<u32>,
    ) -> Result<Self> {
        let mut table: toml::Table = toml::from_str(&self.text).context(|| "not a rig file")?;
        let camera = table.get_mut("camera").and_then(toml::Value::as_table_mut);
        let camera = camera.ok_or_else(|| Error::new("the rig file has no table [camera]"))?;
        let mut set = |key: &str, value: toml::Value| camera.insert(key.to_owned(), value);
        if let Some(exposures) = exposures_ms {
            let list = exposures.iter().map(|e| toml::Value::Float(*e)).collect();
            set("exposures_ms", toml::Value::Array(list));
            set("metering", toml::Value::String("fixed".to_owned()));
            set("reshoots", toml::Value::Integer(0));
            // The range re-shooting keeps to has to hold the list.
            let [first, last] = [exposures.first(), exposures.last()];
            for (key, own, value) in [
                ("min_exposure_ms", self.camera.min_exposure_ms, first),
                ("max_exposure_ms", self.camera.max_exposure_ms, last),
            ] {
                if let (Some(_), Some(value)) = (own, value) {
                    set(key, toml::Value::Float(*value));
                }
            }
        }
        if let Some(repeats) = repeats {
            set("repeats", toml::Value::Integer(repeats.into()));
            set("dark_repeats", toml::Value::Integer(repeats.into()));
        }
        let text = toml::to_string(&table).context(|| "the rig file cannot be written again")?;
        Self::from_toml(&text)
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
        if let Some(board) = self.lamp.board() {
            board_known(board, "lamp")?;
        }
        for board in &self.boards {
            if self.lamp.board() != Some(&board.name)
                && self.motors_of(&board.name).next().is_none()
            {
                return Err(Error::new(format!("board '{}' is not used", board.name)));
            }
        }
        self.check_protocols()?;
        self.check_numbers()?;
        self.check_park()?;
        self.angles(&self.white.configuration(0))
            .and_then(|angles| self.check_pose_clearance(&angles))
            .context(|| "white reference geometry")
    }

    /// Axis letters are X Y Z A B C on a GRBL board and numbers on a Zaber controller, which has no lamp output.
    fn check_protocols(&self) -> Result<()> {
        for board in &self.boards {
            let letters = match board.protocol {
                Protocol::Grbl => "XYZABC",
                Protocol::Zaber => "123456789",
            };
            for (name, motor) in self.motors_of(&board.name) {
                if !letters.contains(motor.letter) {
                    return Err(Error::new(format!(
                        "axis {}: letter '{}' is not one of {letters}",
                        name.name(),
                        motor.letter
                    ))
                    .with_hint("GRBL axes have letters, Zaber axes numbers"));
                }
            }
            if board.protocol == Protocol::Zaber && self.lamp.board() == Some(&board.name) {
                return Err(Error::new(format!(
                    "lamp: board '{}' speaks Zaber and has no lamp output",
                    board.name
                ))
                .with_hint("name a GRBL board, or a current source with scpi_port"));
            }
        }
        Ok(())
    }

    fn check_numbers(&self) -> Result<()> {
        let c = &self.camera;
        in_range("the lamp's power", self.lamp.power(), 1e-3, 1e6)?;
        in_range("lamp.warm_up_s", self.lamp.warm_up_s, 0.0, 7200.0)?;
        in_range("light.distance_mm", self.light.distance_mm, 1.0, 1e5)?;
        for side in self.light.size_mm {
            in_range("light.size_mm", side, 0.1, 1e4)?;
        }
        in_range("camera.pixel_mm", c.pixel_mm, 1e-6, 100.0)?;
        in_range("camera.sample_square_mm", c.sample_square_mm, 1e-3, 1e4)?;
        in_range("camera.bracket", f64::from(c.bracket), 1.0, 100.0)?;
        in_range("camera.reshoots", f64::from(c.reshoots), 0.0, 20.0)?;
        let listed = [c.exposures_ms.first(), c.exposures_ms.last()];
        if let [Some(&first), Some(&last)] = listed {
            if let Some(shortest) = c.min_exposure_ms {
                in_range("camera.min_exposure_ms", shortest, 1e-3, first)?;
            }
            if let Some(longest) = c.max_exposure_ms {
                in_range("camera.max_exposure_ms", longest, last, 3.6e6)?;
            }
        }
        for side in c.size_px.iter().flatten() {
            in_range("camera.size_px", *side as f64, 2.0, 1e5)?;
        }
        for place in c.center_px.iter().flatten() {
            in_range("camera.center_px", *place, -1e5, 1e5)?;
        }
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

impl LampFile {
    fn checked(self) -> Result<Lamp> {
        let output =
            match (self.board, self.scpi_port) {
                (Some(board), None) => LampOutput::Board {
                    board,
                    power_s: self
                        .power_s
                        .ok_or_else(|| Error::new("power_s is missing"))?,
                },
                (None, Some(path)) => LampOutput::Scpi {
                    port: Port {
                        name: "lamp".to_owned(),
                        path,
                        baud: self.baud.unwrap_or(115_200),
                        dtr: None,
                    },
                    channel: self.channel.unwrap_or(1),
                    current_a: self
                        .current_a
                        .ok_or_else(|| Error::new("current_a is missing"))?,
                },
                _ => {
                    return Err(Error::new("exactly one of board and scpi_port is needed").with_hint(
                    "board = \"NAME\" with power_s, or scpi_port = \"/dev/...\" with current_a",
                ));
                }
            };
        Ok(Lamp {
            output,
            warm_up_s: self.warm_up_s,
            reference_every: self.reference_every,
        })
    }
}

impl AxisFile {
    fn checked(self, feed_deg_per_min: f64) -> Result<Axis> {
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
            backlash_deg: self.backlash_deg.unwrap_or(0.0),
            approach: self.approach.unwrap_or(1.0),
            speed_deg_per_s: self.speed_deg_per_s.unwrap_or(feed_deg_per_min / 60.0),
            acceleration_deg_per_s2: self.acceleration_deg_per_s2.unwrap_or(500.0),
        };
        in_range("backlash_deg", axis.backlash_deg, 0.0, 10.0)?;
        in_range("speed_deg_per_s", axis.speed_deg_per_s, 1e-3, 1e4)?;
        in_range(
            "acceleration_deg_per_s2",
            axis.acceleration_deg_per_s2,
            1e-3,
            1e6,
        )?;
        in_range("degrees_per_unit", axis.degrees_per_unit, 1e-6, 1e4)?;
        in_range("offset_deg", axis.offset_deg, -1e4, 1e4)?;
        in_range("min_deg", axis.min_deg, -1e4, 1e4)?;
        in_range("max_deg", axis.max_deg, -1e4, 1e4)?;
        in_range("settle_ms", axis.settle_ms, 0.0, 60_000.0)?;
        for (key, value) in [("sign", axis.sign), ("approach", axis.approach)] {
            if (value.abs() - 1.0).abs() > 0.0 || value.is_nan() {
                return Err(Error::new(format!("{key} is {value}, expected 1 or -1")));
            }
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
