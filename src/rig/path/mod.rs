//! The way from one pose to another: inside the limits, clear of everything, ending as gears with play want it.
//!
//! A straight leg when that is free, else a detour (see `planner`). Says no when it finds no way; that none exists is not
//! proven. Homing is not planned: where the axes stand is not known then.

mod planner;
mod search;

use super::clearance::too_near;
use super::description::{Axis, AxisName, MotorAxis, RigDescription};
use super::kinematics::AxisAngles;
use crate::base::{Error, Result};
use planner::Planner;

/// One piece of a way. All axes that differ from the leg before move at once; axes of different boards, and axes of a
/// board that does not move in line, each at their own pace.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Leg {
    /// Where it ends.
    pub to: AxisAngles,
}

/// Rounding of angles, degrees.
const ROUNDING_DEG: f64 = 1e-9;

impl RigDescription {
    /// The legs from `from` to `to`, at least one. Each ends inside the limits; with bodies in the rig file no two come
    /// nearer than the margin on any leg, whichever group of axes is ahead. The last leg ends at `to`, but an axis that is
    /// off by less than its tolerance stays where it is.
    ///
    /// From inside the margin the first leg brings no bodies nearer that are too near already. Axes with backlash end
    /// their way in their direction of approach.
    ///
    /// # Errors
    /// An angle is not a number or outside its limits, `to` is inside the margin, backlash leaves no room at a limit, or no
    /// free way is found.
    pub fn path(&self, from: &AxisAngles, to: &AxisAngles) -> Result<Vec<Leg>> {
        self.way(from, to, false)
    }

    /// As [`RigDescription::path`], when nobody knows on which side the play of the gears lies (after homing, or a stop on
    /// the way): every axis with backlash ends in its direction of approach, also one that stands at its target.
    ///
    /// # Errors
    /// As [`RigDescription::path`].
    pub fn path_with_slack(&self, from: &AxisAngles, to: &AxisAngles) -> Result<Vec<Leg>> {
        self.way(from, to, true)
    }

    fn way(&self, from: &AxisAngles, to: &AxisAngles, slack: bool) -> Result<Vec<Leg>> {
        if let Some(name) = AxisName::ALL
            .into_iter()
            .find(|n| !from.get(*n).is_finite())
        {
            return Err(Error::new(format!(
                "a way cannot start at {} = {}",
                name.name(),
                from.get(name)
            ))
            .with_hint("the position is not known; home the rig"));
        }
        self.check_angles(to)?;
        let planner = Planner::new(self);
        let (from, to) = (self.with_fixed(from), self.with_fixed(to));
        if let Some(contact) = planner.pose_contact(&to) {
            return Err(too_near("pose inside the clearance margin", &contact));
        }
        let mut end = self.without_small_moves(&from, &to);
        let slack = slack && self.play().next().is_some();
        if slack || planner.pose_contact(&end).is_some() {
            end = to;
        }
        if end == from && !slack {
            return Ok(vec![Leg { to: end }]);
        }
        // Axes that come from the far side of their target. A detour may turn further axes round.
        let mut overshoot: Vec<AxisName> = self
            .play()
            .filter(|(name, m)| {
                slack || (end.get(*name) - from.get(*name)) * m.approach < -ROUNDING_DEG
            })
            .map(|(name, _)| name)
            .collect();
        loop {
            let legs = self.path_taking_up(&planner, &from, &end, &overshoot)?;
            match self.slack_axis(&from, &legs) {
                None => return Ok(legs),
                Some(name) if !overshoot.contains(&name) => overshoot.push(name),
                Some(name) => {
                    return Err(Error::new(format!(
                        "no free way on which {} ends in its direction of approach",
                        name.name()
                    ))
                    .with_hint("visit the pose from another one, or turn the sign of approach"));
                }
            }
        }
    }

    /// Legs to `end` by way of a pose from which the axes of `overshoot` arrive in their direction of approach.
    fn path_taking_up(
        &self,
        planner: &Planner,
        from: &AxisAngles,
        end: &AxisAngles,
        overshoot: &[AxisName],
    ) -> Result<Vec<Leg>> {
        if overshoot.is_empty() {
            return planner.plan(from, end);
        }
        let mut beyond = *end;
        for (name, m) in self.play().filter(|(name, _)| overshoot.contains(name)) {
            let angle = end.get(name) - m.approach * m.backlash_deg;
            if !(m.min_deg..=m.max_deg).contains(&angle) {
                return Err(Error::new(format!(
                    "no room to take up the backlash of {}: to end at {:.4} in its direction of approach it must come from \
                     {angle:.4}, limits {} to {}",
                    name.name(),
                    end.get(name),
                    m.min_deg,
                    m.max_deg
                ))
                .with_hint("visit a pose farther from the limit, or turn the sign of approach"));
            }
            beyond.0[name as usize] = angle;
        }
        if let Some(contact) = planner.pose_contact(&beyond) {
            return Err(too_near(
                "no room to take up backlash before the pose",
                &contact,
            ));
        }
        let mut legs = planner.plan(from, &beyond)?;
        legs.extend(planner.plan(&beyond, end)?);
        Ok(legs)
    }

    /// An axis with backlash that does not end its way in its direction of approach, or not for long enough since it
    /// last went the other way.
    fn slack_axis(&self, from: &AxisAngles, legs: &[Leg]) -> Option<AxisName> {
        self.play().find_map(|(name, m)| {
            let mut last = from.get(name);
            // How far the motor went since it turned round; none while it never went the other way.
            let mut taken_up: Option<f64> = None;
            for leg in legs {
                let step = (leg.to.get(name) - last) * m.approach;
                last = leg.to.get(name);
                if step < -ROUNDING_DEG {
                    taken_up = Some(0.0);
                } else if let Some(way) = &mut taken_up {
                    *way += step.max(0.0);
                }
            }
            taken_up
                .is_some_and(|way| way < m.backlash_deg - ROUNDING_DEG)
                .then_some(name)
        })
    }

    /// The axes with backlash.
    fn play(&self) -> impl Iterator<Item = (AxisName, &MotorAxis)> {
        self.driven().filter(|(_, m)| m.backlash_deg > 0.0)
    }

    /// The axes with a motor.
    fn driven(&self) -> impl Iterator<Item = (AxisName, &MotorAxis)> {
        AxisName::ALL
            .into_iter()
            .filter_map(|name| match self.axis(name) {
                Axis::Motor(m) => Some((name, m)),
                Axis::Fixed { .. } => None,
            })
    }

    /// The pose with every fixed axis at its very angle.
    fn with_fixed(&self, pose: &AxisAngles) -> AxisAngles {
        let mut pose = *pose;
        for name in AxisName::ALL {
            if let Axis::Fixed { angle_deg, .. } = self.axis(name) {
                pose.0[name as usize] = *angle_deg;
            }
        }
        pose
    }

    /// The target with every axis left where it is that is off by less than its tolerance.
    fn without_small_moves(&self, from: &AxisAngles, to: &AxisAngles) -> AxisAngles {
        let mut end = *to;
        for (name, m) in self.driven() {
            let angle = from.get(name);
            let inside = (m.min_deg..=m.max_deg).contains(&angle);
            if inside && (to.get(name) - angle).abs() < m.tolerance_deg {
                end.0[name as usize] = angle;
            }
        }
        end
    }
}
