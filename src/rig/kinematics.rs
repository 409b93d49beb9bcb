//! From configurations to axis angles, and back.
//!
//! Elevation axes carry the polar angle from the sample normal, azimuth axes the azimuth, the turntable the rotation
//! (docs/conventions.md). A direction (theta, phi) is also (-theta, phi + 180 degrees): an elevation axis that goes
//! through the normal may use that. Because limits are per axis, a straight move between two allowed poses stays inside
//! them. Collisions between arms are the business of `path`. Never turns the whole scene to reach a pose.

use super::description::{Axis, AxisName, RigDescription};
use crate::base::{Error, Result};
use crate::math::PolarDirection;
use crate::session::{Configuration, Plan};
use std::collections::BTreeMap;

/// One angle per axis, degrees, in the order of [`AxisName::ALL`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AxisAngles(pub [f64; 5]);

impl AxisAngles {
    /// The angle of one axis, degrees.
    pub fn get(&self, name: AxisName) -> f64 {
        self.0[name as usize]
    }

    /// The angles by axis name, as a session's journal keeps them.
    pub fn by_name(&self) -> BTreeMap<String, f64> {
        AxisName::ALL
            .iter()
            .map(|a| (a.name().to_owned(), self.get(*a)))
            .collect()
    }

    /// The configuration these angles stand for.
    pub fn configuration(&self, id: u32) -> Configuration {
        let direction = |elevation, azimuth| {
            let (theta, phi) = (self.get(elevation), self.get(azimuth));
            if theta < 0.0 {
                PolarDirection::from_degrees(-theta, phi + 180.0)
            } else {
                PolarDirection::from_degrees(theta, phi)
            }
        };
        Configuration {
            id,
            light: direction(AxisName::LightElevation, AxisName::LightAzimuth),
            camera: direction(AxisName::CameraElevation, AxisName::CameraAzimuth),
            rotation: self.get(AxisName::Turntable).to_radians(),
        }
    }
}

/// Degrees by which a limit may be exceeded by rounding.
const ROUNDING_DEG: f64 = 1e-6;

impl RigDescription {
    /// Axis angles of every configuration of a plan: the check of the whole plan before anything moves.
    ///
    /// # Errors
    /// "pose outside limits" with configuration, axis, value and limits.
    pub fn plan_angles(&self, plan: &Plan) -> Result<Vec<AxisAngles>> {
        plan.configurations.iter().map(|c| self.angles(c)).collect()
    }

    /// Axis angles of one configuration.
    ///
    /// # Errors
    /// As [`RigDescription::plan_angles`].
    pub fn angles(&self, c: &Configuration) -> Result<AxisAngles> {
        use AxisName as A;
        let [camera_elevation, camera_azimuth] =
            self.direction(c.id, c.camera, A::CameraElevation, A::CameraAzimuth)?;
        let [light_elevation, light_azimuth] =
            self.direction(c.id, c.light, A::LightElevation, A::LightAzimuth)?;
        let turntable = self
            .turned(A::Turntable, c.rotation.to_degrees())
            .ok_or_else(|| self.outside(c.id, A::Turntable, c.rotation.to_degrees()))?;
        Ok(AxisAngles([
            camera_elevation,
            camera_azimuth,
            light_elevation,
            light_azimuth,
            turntable,
        ]))
    }

    fn direction(
        &self,
        id: u32,
        direction: PolarDirection,
        elevation: AxisName,
        azimuth: AxisName,
    ) -> Result<[f64; 2]> {
        let (theta, phi) = (direction.theta.to_degrees(), direction.phi.to_degrees());
        for (theta, phi) in [(theta, phi), (-theta, phi + 180.0)] {
            // At the normal the azimuth means nothing: any place will do.
            let azimuth_deg = if theta.abs() < ROUNDING_DEG {
                self.turned(azimuth, phi).or(Some(self.middle(azimuth)))
            } else {
                self.turned(azimuth, phi)
            };
            if let (Some(e), Some(a)) = (self.plain(elevation, theta), azimuth_deg) {
                return Ok([e, a]);
            }
        }
        if self.plain(elevation, theta).is_none() {
            return Err(self.outside(id, elevation, theta));
        }
        Err(self.outside(id, azimuth, phi))
    }

    /// An angle that means the same only as it is.
    fn plain(&self, name: AxisName, angle: f64) -> Option<f64> {
        match self.axis(name) {
            Axis::Motor(m) => (m.min_deg - ROUNDING_DEG..=m.max_deg + ROUNDING_DEG)
                .contains(&angle)
                .then(|| angle.clamp(m.min_deg, m.max_deg)),
            Axis::Fixed {
                angle_deg,
                tolerance_deg,
            } => ((angle - angle_deg).abs() <= *tolerance_deg).then_some(*angle_deg),
        }
    }

    /// An angle that means the same after whole turns; of several inside the limits, the one nearest to zero.
    fn turned(&self, name: AxisName, angle: f64) -> Option<f64> {
        if !angle.is_finite() {
            return None;
        }
        if let Axis::Fixed { .. } = self.axis(name) {
            return (-3..=3).find_map(|k| self.plain(name, angle + 360.0 * f64::from(k)));
        }
        (-3..=3)
            .filter_map(|k| self.plain(name, angle + 360.0 * f64::from(k)))
            .min_by(|a, b| a.abs().total_cmp(&b.abs()))
    }

    fn middle(&self, name: AxisName) -> f64 {
        match self.axis(name) {
            Axis::Motor(m) => 0.0_f64.clamp(m.min_deg, m.max_deg),
            Axis::Fixed { angle_deg, .. } => *angle_deg,
        }
    }

    fn outside(&self, id: u32, name: AxisName, angle: f64) -> Error {
        let limits = match self.axis(name) {
            Axis::Motor(m) => format!("limits {} to {}", m.min_deg, m.max_deg),
            Axis::Fixed { angle_deg, .. } => format!("fixed at {angle_deg}"),
        };
        let shown = (angle * 1e6).round() / 1e6;
        Error::new(format!(
            "pose outside limits: configuration {id}, axis {}: {shown} degrees, {limits}",
            name.name()
        ))
        .with_hint("change the plan, or the limits in the rig file if the rig really reaches there")
    }

    /// Where the axes stand parked, coming from `at`: those without a parking place stay, inside their limits (switches may
    /// lie beyond them).
    pub fn parked(&self, at: &AxisAngles) -> AxisAngles {
        let mut angles = *at;
        for name in AxisName::ALL {
            if let Axis::Motor(motor) = self.axis(name) {
                let stays = at.get(name).clamp(motor.min_deg, motor.max_deg);
                angles.0[name as usize] = self.park_deg.get(&name).copied().unwrap_or(stays);
            }
        }
        angles
    }

    /// Checks angles right before they are sent; nothing that is not a number inside the limits gets through.
    ///
    /// # Errors
    /// With axis, value and limits.
    pub fn check_angles(&self, angles: &AxisAngles) -> Result<()> {
        for name in AxisName::ALL {
            let angle = angles.get(name);
            if self.plain(name, angle).is_none() {
                return Err(self.outside(0, name, angle));
            }
        }
        Ok(())
    }
}
