//! Directions in the fiber frame as longitudinal angle and azimuth (Khungurn 2015 eq. 1).
//!
//! Not to be confused with [`crate::math::PolarDirection`]: there theta is measured from the sample normal, here from
//! the plane perpendicular to the fiber.

use glam::DVec3;

/// The unit vector `(sin theta, cos theta cos phi, cos theta sin phi)`: fiber along x, longitudinal angle `theta` in
/// [-pi/2, pi/2] (0 = perpendicular to the fiber), azimuth `phi` around it, radians.
///
/// The vector carries `theta` to about 1e-16 absolute everywhere (read it back with [`longitudinal_angle`]) and `phi` to
/// 1e-16 as long as `cos theta` is not exactly zero, which it is for no `f64` angle.
pub fn fiber_direction(theta: f64, phi: f64) -> DVec3 {
    let (sin_theta, cos_theta) = theta.sin_cos();
    let (sin_phi, cos_phi) = phi.sin_cos();
    DVec3::new(sin_theta, cos_theta * cos_phi, cos_theta * sin_phi)
}

/// Longitudinal angle of a direction in the fiber frame (any length but zero), in [-pi/2, pi/2].
///
/// By the arctangent: an arcsine loses half the digits near the axis and fails where rounding makes |x| exceed 1.
pub fn longitudinal_angle(w: DVec3) -> f64 {
    w.x.atan2(w.y.hypot(w.z))
}

/// Below this `cos theta` a direction lies on the fiber's axis.
pub(super) const ON_AXIS: f64 = 1e-100;

/// A direction in the fiber frame as the formulas need it.
#[derive(Debug, Clone, Copy)]
pub(super) struct FiberAngles {
    pub(super) sin_theta: f64,
    pub(super) cos_theta: f64,
    /// `tan(theta/2)`, in [-1, 1].
    pub(super) t: f64,
    /// Unit azimuth vector.
    pub(super) az_y: f64,
    pub(super) az_z: f64,
}

impl FiberAngles {
    #[inline]
    pub(super) fn new(w: DVec3) -> Self {
        let cos_theta = (w.y * w.y + w.z * w.z).sqrt();
        if cos_theta < ON_AXIS {
            return Self {
                sin_theta: w.x,
                cos_theta: ON_AXIS,
                t: w.x,
                az_y: 1.0,
                az_z: 0.0,
            };
        }
        let inverse = 1.0 / cos_theta;
        Self {
            sin_theta: w.x,
            cos_theta,
            t: w.x / (1.0 + cos_theta),
            az_y: w.y * inverse,
            az_z: w.z * inverse,
        }
    }

    /// The direction of these sines, cosines and unit azimuth vector.
    #[inline]
    pub(super) fn of_parts(sin_theta: f64, cos_theta: f64, az_y: f64, az_z: f64) -> Self {
        Self {
            sin_theta,
            cos_theta,
            t: sin_theta / (1.0 + cos_theta),
            az_y,
            az_z,
        }
    }

    /// The direction of this sine and cosine of theta whose azimuth lies the angle of `cos_az` and `sin_az` beyond the opposite of
    /// this one's.
    #[inline]
    pub(super) fn beyond(&self, sin_theta: f64, cos_theta: f64, cos_az: f64, sin_az: f64) -> Self {
        Self::of_parts(
            sin_theta,
            cos_theta,
            -(self.az_y * cos_az - self.az_z * sin_az),
            -(self.az_z * cos_az + self.az_y * sin_az),
        )
    }

    /// `(1 - cos theta)^5`.
    #[inline]
    pub(super) fn schlick(&self) -> f64 {
        let w = self.sin_theta * self.t;
        (w * w) * (w * w) * w
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_survive_the_vector() {
        for theta_deg in [
            -90.0,
            -89.999_999,
            -45.0,
            0.0,
            1e-9,
            30.0,
            89.5,
            89.999_999_999,
            90.0,
        ] {
            for phi_deg in [0.0, 90.0, -135.0, 179.0] {
                let (theta, phi) = (f64::to_radians(theta_deg), f64::to_radians(phi_deg));
                let w = fiber_direction(theta, phi);
                assert!((w.length() - 1.0).abs() < 3e-16);
                assert!(
                    (longitudinal_angle(w) - theta).abs() < 3e-16,
                    "{theta_deg} {phi_deg}"
                );
                assert!(
                    (w.z.atan2(w.y) - phi).abs() < 5e-16,
                    "{theta_deg} {phi_deg}"
                );
            }
        }
    }
}
