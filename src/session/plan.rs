//! Configurations and plans: which light and camera directions, at which turntable rotation.

use super::{FrameKind, files};
use crate::base::{Context, Error, Result};
use crate::math::PolarDirection;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// One pose of light, camera and turntable. Directions are in the laboratory frame (z the sample normal); the sample is
/// turned by `rotation` about +z, so azimuth in the sample frame is azimuth in the laboratory minus the rotation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Configuration {
    /// Number that names the configuration in every file (unique in a plan).
    pub id: u32,
    /// Toward the center of the light.
    pub light: PolarDirection,
    /// Toward the camera.
    pub camera: PolarDirection,
    /// Turntable angle, radians.
    pub rotation: f64,
}

impl Configuration {
    /// The pose whose light and camera have these polar angles and azimuths, all in degrees.
    ///
    /// # Errors
    /// A polar angle is not in 0 <= theta < 90, or another angle is beyond two turns.
    pub fn from_degrees(id: u32, light: [f64; 2], camera: [f64; 2], rotation: f64) -> Result<Self> {
        ConfigurationRow {
            config: id,
            light_theta_deg: light[0],
            light_phi_deg: light[1],
            camera_theta_deg: camera[0],
            camera_phi_deg: camera[1],
            rotation_deg: rotation,
        }
        .checked()
    }

    /// Toward the light, in the sample frame (x weft, y warp).
    pub fn light_in_sample(&self) -> PolarDirection {
        self.light.in_sample_frame(self.rotation)
    }

    /// Toward the camera, in the sample frame.
    pub fn camera_in_sample(&self) -> PolarDirection {
        self.camera.in_sample_frame(self.rotation)
    }
}

/// A list of configurations to visit, in order.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// Short name.
    pub name: String,
    /// Where the poses come from.
    pub description: String,
    /// What lies in the sample's place: [`FrameKind::Sample`], or [`FrameKind::Flat`], [`FrameKind::Chart`] or
    /// [`FrameKind::Board`] for a calibration. Its frames are of that kind.
    pub shows: FrameKind,
    /// At least one; ids unique.
    pub configurations: Vec<Configuration>,
}

/// A configuration as files write it: degrees, the column names of `measurements.csv`.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ConfigurationRow {
    pub(super) config: u32,
    pub(super) light_theta_deg: f64,
    pub(super) light_phi_deg: f64,
    pub(super) camera_theta_deg: f64,
    pub(super) camera_phi_deg: f64,
    pub(super) rotation_deg: f64,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PlanFile {
    name: String,
    #[serde(default)]
    description: String,
    #[serde(default = "sample", skip_serializing_if = "is_sample")]
    shows: FrameKind,
    configurations: Vec<ConfigurationRow>,
}

fn sample() -> FrameKind {
    FrameKind::Sample
}

fn is_sample(kind: &FrameKind) -> bool {
    *kind == FrameKind::Sample
}

/// Degrees without the last bits' noise of the conversion to radians and back.
pub(super) fn tidy_degrees(radians: f64) -> f64 {
    let degrees = radians.to_degrees();
    let rounded = (degrees * 1e6).round() / 1e6;
    if (degrees - rounded).abs() < 1e-9 {
        rounded
    } else {
        degrees
    }
}

impl From<Configuration> for ConfigurationRow {
    fn from(c: Configuration) -> Self {
        Self {
            config: c.id,
            light_theta_deg: tidy_degrees(c.light.theta),
            light_phi_deg: tidy_degrees(c.light.phi),
            camera_theta_deg: tidy_degrees(c.camera.theta),
            camera_phi_deg: tidy_degrees(c.camera.phi),
            rotation_deg: tidy_degrees(c.rotation),
        }
    }
}

impl ConfigurationRow {
    /// Checks ranges: finite, polar angles in 0 <= theta < 90 degrees.
    pub(super) fn checked(self) -> Result<Configuration> {
        for (name, theta) in [
            ("light_theta_deg", self.light_theta_deg),
            ("camera_theta_deg", self.camera_theta_deg),
        ] {
            if !(0.0..90.0).contains(&theta) {
                return Err(Error::new(format!(
                    "configuration {}: {name} is {theta}, expected 0 <= angle < 90",
                    self.config
                ))
                .with_hint("polar angles are measured from the sample normal, in degrees"));
            }
        }
        let azimuths = [
            ("light_phi_deg", self.light_phi_deg),
            ("camera_phi_deg", self.camera_phi_deg),
            ("rotation_deg", self.rotation_deg),
        ];
        for (name, angle) in azimuths {
            if !(-720.0..=720.0).contains(&angle) {
                return Err(Error::new(format!(
                    "configuration {}: {name} is {angle}, expected an angle in degrees within two turns",
                    self.config
                )));
            }
        }
        Ok(Configuration {
            id: self.config,
            light: PolarDirection::from_degrees(self.light_theta_deg, self.light_phi_deg),
            camera: PolarDirection::from_degrees(self.camera_theta_deg, self.camera_phi_deg),
            rotation: self.rotation_deg.to_radians(),
        })
    }
}

/// Fails on an id that occurs twice and on an empty list.
pub(super) fn check_ids(ids: impl Iterator<Item = u32>) -> Result<()> {
    let mut seen = std::collections::BTreeSet::new();
    for id in ids {
        if !seen.insert(id) {
            return Err(Error::new(format!("configuration {id} occurs twice"))
                .with_hint("ids name frames; make them unique"));
        }
    }
    if seen.is_empty() {
        return Err(Error::new("no configurations")
            .with_hint("see rig_configs/plans/khungurn16.toml for a plan"));
    }
    Ok(())
}

impl Plan {
    /// Reads and checks `plan.toml`.
    ///
    /// # Errors
    /// The file cannot be read, is not of the form, has no configurations, a repeated id, or an angle out of range.
    pub fn read(path: &Path) -> Result<Self> {
        Self::from_toml(&files::read_text(path)?).context(|| format!("plan {}", path.display()))
    }

    /// Parses and checks the text of a `plan.toml`; see [`Plan::read`].
    ///
    /// # Errors
    /// As [`Plan::read`].
    pub fn from_toml(text: &str) -> Result<Self> {
        let file: PlanFile = toml::from_str(text).context(|| "not a plan file")?;
        check_ids(file.configurations.iter().map(|c| c.config))?;
        if matches!(
            file.shows,
            FrameKind::Dark | FrameKind::White | FrameKind::Reference
        ) {
            return Err(Error::new(format!(
                "shows is '{}', expected 'sample', 'flat', 'chart' or 'board'",
                file.shows.name()
            ))
            .with_hint(
                "darks, the white standard and reference frames are part of every capture",
            ));
        }
        let configurations = file
            .configurations
            .into_iter()
            .map(ConfigurationRow::checked)
            .collect::<Result<_>>()?;
        Ok(Self {
            name: file.name,
            description: file.description,
            shows: file.shows,
            configurations,
        })
    }

    /// The text of the plan's file.
    ///
    /// # Errors
    /// Only if the TOML writer fails.
    pub fn to_toml(&self) -> Result<String> {
        let file = PlanFile {
            name: self.name.clone(),
            description: self.description.clone(),
            shows: self.shows,
            configurations: self.configurations.iter().map(|&c| c.into()).collect(),
        };
        toml::to_string(&file).context(|| "plan cannot be written as TOML")
    }

    /// The configuration with this id.
    pub fn configuration(&self, id: u32) -> Option<&Configuration> {
        self.configurations.iter().find(|c| c.id == id)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ONE: &str = "name = 'p'\n[[configurations]]\nconfig = 3\nlight_theta_deg = 80\nlight_phi_deg = 270\n\
                       camera_theta_deg = 48.25\ncamera_phi_deg = 0\nrotation_deg = 90\n";

    #[test]
    fn a_plan_survives_the_round_trip() {
        let plan = Plan::from_toml(ONE).unwrap();
        assert_eq!(Plan::from_toml(&plan.to_toml().unwrap()).unwrap(), plan);
        let text = plan.to_toml().unwrap();
        assert!(
            text.contains("light_theta_deg = 80.0\n")
                && text.contains("camera_theta_deg = 48.25\n"),
            "{text}"
        );
        // What old plans do not say stays unsaid: sessions are known by the text of their plan.
        assert!(!text.contains("shows"));
        let board = Plan::from_toml(&format!("shows = 'board'\n{ONE}")).unwrap();
        assert_eq!(board.shows, FrameKind::Board);
        assert_eq!(Plan::from_toml(&board.to_toml().unwrap()).unwrap(), board);
        let c = plan.configuration(3).unwrap();
        assert!((c.light_in_sample().phi.to_degrees() - 180.0).abs() < 1e-12);
    }

    #[test]
    fn bad_plans_are_refused_with_the_reason() {
        let error = |text: &str| Plan::from_toml(text).unwrap_err().report();
        assert!(error(&ONE.replace("80", "95")).contains("light_theta_deg is 95"));
        assert!(error(&ONE.replace("80", "nan")).contains("light_theta_deg is NaN"));
        assert!(error(&ONE.replace("= 90", "= inf")).contains("rotation_deg"));
        assert!(error(&format!("{ONE}{}", ONE.replace("name = 'p'", ""))).contains("occurs twice"));
        assert!(error(&format!("shows = 'dark'\n{ONE}")).contains("shows is 'dark'"));
        assert!(error(&format!("shows = 'cloth'\n{ONE}")).contains("cloth"));
        assert!(error("name = 'p'\nconfigurations = []").contains("no configurations"));
        assert!(error(&ONE.replace("rotation_deg", "rotation")).contains("rotation"));
    }
}
