//! How long a way takes: every leg from rest to rest, at constant acceleration, then at constant speed, then braking.
//!
//! A coordinated board moves all its axes on one line, held back by whichever axis is slowest (as GRBL plans it); the
//! axes of other boards go on their own, and the last to arrive counts. Leaves out what a controller adds: acknowledging,
//! polling, jerk limits.

use super::description::{Axis, AxisName, MotorAxis, Protocol, RigDescription};
use super::devices::AxisLimits;
use super::kinematics::AxisAngles;
use super::path::Leg;
use crate::base::Result;
use std::collections::BTreeMap;

/// What controllers say of their axes.
pub type ControllerLimits = BTreeMap<AxisName, AxisLimits>;

impl Protocol {
    /// True when all axes of one move of such a board progress on one straight line.
    pub fn moves_in_line(self) -> bool {
        match self {
            Self::Grbl => true,
            Self::Zaber => false,
        }
    }
}

impl RigDescription {
    /// Sets of axes that progress together in a leg, each set at its own pace: the driven axes of a coordinated board, or
    /// a single axis.
    pub fn groups(&self) -> Vec<Vec<AxisName>> {
        let mut groups = Vec::new();
        for board in &self.boards {
            let axes: Vec<AxisName> = self.motors_of(&board.name).map(|(name, _)| name).collect();
            if board.protocol.moves_in_line() {
                groups.push(axes);
            } else {
                groups.extend(axes.into_iter().map(|name| vec![name]));
            }
        }
        groups.retain(|g| !g.is_empty());
        groups
    }

    /// Seconds of one leg. `limits` are the controllers' own, when known: the slower of both counts.
    pub fn leg_seconds(
        &self,
        from: &AxisAngles,
        to: &AxisAngles,
        limits: Option<&ControllerLimits>,
    ) -> f64 {
        self.groups()
            .iter()
            .map(|group| self.line_seconds(group, from, to, limits))
            .fold(0.0, f64::max)
    }

    /// Seconds of these legs, one after the other.
    pub fn legs_seconds(
        &self,
        from: &AxisAngles,
        legs: &[Leg],
        limits: Option<&ControllerLimits>,
    ) -> f64 {
        let mut last = *from;
        let mut seconds = 0.0;
        for leg in legs {
            seconds += self.leg_seconds(&last, &leg.to, limits);
            last = leg.to;
        }
        seconds
    }

    /// Seconds from pose to pose on the way of [`RigDescription::path`], without settling.
    ///
    /// # Errors
    /// As [`RigDescription::path`].
    pub fn path_seconds(&self, from: &AxisAngles, to: &AxisAngles) -> Result<f64> {
        Ok(self.legs_seconds(from, &self.path(from, to)?, None))
    }

    /// Milliseconds to wait after the way from pose to pose: the longest settle time of the axes that move on it.
    ///
    /// # Errors
    /// As [`RigDescription::path`].
    pub fn settle_ms_of(&self, from: &AxisAngles, to: &AxisAngles) -> Result<f64> {
        Ok(self.settle_ms_after(from, &self.path(from, to)?))
    }

    /// The longest settle time of the axes that move on these legs, milliseconds.
    pub fn settle_ms_after(&self, from: &AxisAngles, legs: &[Leg]) -> f64 {
        let mut longest = 0.0_f64;
        let mut last = *from;
        for leg in legs {
            for name in AxisName::ALL {
                if let Axis::Motor(motor) = self.axis(name)
                    && (last.get(name) - leg.to.get(name)).abs() > 1e-9
                {
                    longest = longest.max(motor.settle_ms);
                }
            }
            last = leg.to;
        }
        longest
    }

    /// Seconds of one straight line of a set of axes, from rest to rest.
    fn line_seconds(
        &self,
        group: &[AxisName],
        from: &AxisAngles,
        to: &AxisAngles,
        limits: Option<&ControllerLimits>,
    ) -> f64 {
        // Progress runs from 0 to 1; these are its highest speed and acceleration.
        let (mut speed, mut acceleration) = (f64::INFINITY, f64::INFINITY);
        for &name in group {
            let Axis::Motor(motor) = self.axis(name) else {
                continue;
            };
            let way = (to.get(name) - from.get(name)).abs();
            if way > 0.0 {
                let own = limits.and_then(|l| l.get(&name));
                let (v, a) = slower(motor, own);
                speed = speed.min(v / way);
                acceleration = acceleration.min(a / way);
            }
        }
        if speed.is_infinite() {
            return 0.0;
        }
        let top = speed.min(acceleration.sqrt());
        1.0 / top + top / acceleration
    }
}

/// Degrees per second and per second squared: the rig file's, or the controller's where that is less.
fn slower(motor: &MotorAxis, own: Option<&AxisLimits>) -> (f64, f64) {
    let scale = motor.degrees_per_unit;
    let (speed, acceleration) = own.map_or((f64::INFINITY, f64::INFINITY), |l| {
        (l.max_speed * scale, l.acceleration * scale)
    });
    (
        motor.speed_deg_per_s.min(speed),
        motor.acceleration_deg_per_s2.min(acceleration),
    )
}
