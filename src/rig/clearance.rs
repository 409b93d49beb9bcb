//! How near the rig's bodies come to each other, at a pose and all along a leg.

use super::kinematics::AxisAngles;

/// Two bodies at their nearest.
#[derive(Debug, Clone, PartialEq)]
pub struct Contact {
    /// One body.
    pub a: String,
    /// The other.
    pub b: String,
    /// Distance between their surfaces, millimeters; negative when they overlap.
    pub distance_mm: f64,
    /// Where.
    pub at: AxisAngles,
}
