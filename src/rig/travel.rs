//! How long a way takes: every leg from rest to rest, at constant acceleration, then at constant speed, then braking.
//!
//! A coordinated board moves all its axes on one line, held back by whichever axis is slowest (as GRBL plans it); the
//! axes of other boards go on their own, and the last to arrive counts. Leaves out what a controller adds: acknowledging,
//! polling, jerk limits.

use super::description::{Axis, AxisName, Protocol, RigDescription};
use super::devices::AxisLimits;
use super::kinematics::AxisAngles;
use super::path::Leg;
use crate::base::Result;
use std::collections::BTreeMap;

/// What controllers say of their axes.
pub type ControllerLimits = BTreeMap<AxisName, AxisLimits>;

impl Protocol {
    /// What brakes every axis of such a board, at any time, also in the middle of another line.
    pub fn stop_bytes(self) -> &'static [u8] {
        match self {
            Self::Grbl => b"!",
            Self::Zaber => b"\n/stop\n",
        }
    }

    /// True when all axes of one move of such a board progress on one straight line.
    pub fn moves_in_line(self) -> bool {
        match self {
            Self::Grbl => true,
            Self::Zaber => false,
        }
    }
}

/// Sets of axes that progress together in a leg, each set at its own pace: the driven axes of a coordinated board, or a
/// single axis.
pub(super) fn axis_groups(rig: &RigDescription) -> Vec<Vec<AxisName>> {
    let mut groups = Vec::new();
    for board in &rig.boards {
        let axes: Vec<AxisName> = rig.motors_of(&board.name).map(|(name, _)| name).collect();
        if board.protocol.moves_in_line() {
            groups.push(axes);
        } else {
            groups.extend(axes.into_iter().map(|name| vec![name]));
        }
    }
    groups.retain(|g| !g.is_empty());
    groups
}

/// How fast each axis goes, by group.
pub(super) struct Pace(Vec<Vec<AxisPace>>);

struct AxisPace {
    name: AxisName,
    /// Degrees per second.
    speed: f64,
    /// Degrees per second squared.
    acceleration: f64,
}

impl Pace {
    /// The rig file's speeds and accelerations, or the controllers' where those are less.
    pub(super) fn new(rig: &RigDescription, limits: Option<&ControllerLimits>) -> Self {
        let of = |name: AxisName| match rig.axis(name) {
            Axis::Motor(motor) => {
                let own = limits.and_then(|l| l.get(&name));
                let scale = motor.degrees_per_unit;
                let (speed, acceleration) = own.map_or((f64::INFINITY, f64::INFINITY), |l| {
                    (l.max_speed * scale, l.acceleration * scale)
                });
                Some(AxisPace {
                    name,
                    speed: motor.speed_deg_per_s.min(speed),
                    acceleration: motor.acceleration_deg_per_s2.min(acceleration),
                })
            }
            Axis::Fixed { .. } => None,
        };
        let groups = axis_groups(rig);
        Self(
            groups
                .into_iter()
                .map(|g| g.into_iter().filter_map(of).collect())
                .collect(),
        )
    }

    /// Seconds of one leg: the group that arrives last.
    pub(super) fn seconds(&self, from: &AxisAngles, to: &AxisAngles) -> f64 {
        let times = self.0.iter().map(|group| line_seconds(group, from, to));
        times.fold(0.0, f64::max)
    }
}

/// Seconds of one straight line of a group, from rest to rest.
fn line_seconds(group: &[AxisPace], from: &AxisAngles, to: &AxisAngles) -> f64 {
    // Progress runs from 0 to 1; these are its highest speed and acceleration.
    let (mut speed, mut acceleration) = (f64::INFINITY, f64::INFINITY);
    for axis in group {
        let way = (to.get(axis.name) - from.get(axis.name)).abs();
        if way > 0.0 {
            speed = speed.min(axis.speed / way);
            acceleration = acceleration.min(axis.acceleration / way);
        }
    }
    if speed.is_infinite() {
        return 0.0;
    }
    let top = speed.min(acceleration.sqrt());
    1.0 / top + top / acceleration
}

impl RigDescription {
    /// Seconds of these legs, one after the other. `limits` are the controllers' own, when known: the slower of both counts.
    pub fn legs_seconds(
        &self,
        from: &AxisAngles,
        legs: &[Leg],
        limits: Option<&ControllerLimits>,
    ) -> f64 {
        let pace = Pace::new(self, limits);
        let mut last = *from;
        let mut seconds = 0.0;
        for leg in legs {
            seconds += pace.seconds(&last, &leg.to);
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
}
