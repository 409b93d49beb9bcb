//! The way from one pose to another.

use super::description::RigDescription;
use super::kinematics::AxisAngles;
use crate::base::Result;

/// One piece of a way. All axes that differ from the leg before move at once; axes of different boards, and axes of a
/// board that does not move in line, each at their own pace.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Leg {
    /// Where it ends.
    pub to: AxisAngles,
}

impl RigDescription {
    /// The legs from `from` to `to`, the last of which ends at `to`.
    ///
    /// # Errors
    /// An angle is outside its limits.
    pub fn path(&self, _from: &AxisAngles, to: &AxisAngles) -> Result<Vec<Leg>> {
        self.check_angles(to)?;
        Ok(vec![Leg { to: *to }])
    }
}
