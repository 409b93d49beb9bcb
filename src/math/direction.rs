//! Directions as polar angle and azimuth, and orthonormal frames.

use glam::DVec3;

/// A direction away from the sample: polar angle `theta` from the sample normal (+z) and azimuth `phi`
/// counter-clockwise from +x, both in radians.
///
/// `w(theta, phi) = (sin theta cos phi, sin theta sin phi, cos theta)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PolarDirection {
    /// Polar angle from the sample normal, radians.
    pub theta: f64,
    /// Azimuth counter-clockwise from +x, radians.
    pub phi: f64,
}

impl PolarDirection {
    /// The direction with polar angle `theta` and azimuth `phi`, radians.
    pub fn new(theta: f64, phi: f64) -> Self {
        Self { theta, phi }
    }

    /// The direction with polar angle and azimuth in degrees.
    pub fn from_degrees(theta_deg: f64, phi_deg: f64) -> Self {
        Self::new(theta_deg.to_radians(), phi_deg.to_radians())
    }

    /// The unit vector.
    pub fn vector(self) -> DVec3 {
        let (st, ct) = self.theta.sin_cos();
        let (sp, cp) = self.phi.sin_cos();
        DVec3::new(st * cp, st * sp, ct)
    }

    /// The same direction seen from a sample turned by `rotation` about +z: azimuth in the sample frame is azimuth in
    /// the laboratory minus the rotation.
    pub fn in_sample_frame(self, rotation: f64) -> Self {
        Self::new(self.theta, self.phi - rotation)
    }
}

/// A right-handed orthonormal frame whose first axis is a given tangent.
///
/// The other two axes are arbitrary but continuous almost everywhere (Duff et al. 2017, branchless form).
#[derive(Debug, Clone, Copy)]
pub struct Frame {
    /// First axis: the tangent.
    pub x: DVec3,
    /// Second axis.
    pub y: DVec3,
    /// Third axis.
    pub z: DVec3,
}

impl Frame {
    /// The frame around the unit vector `tangent`.
    pub fn from_tangent(tangent: DVec3) -> Self {
        let n = tangent;
        let sign = 1.0_f64.copysign(n.z);
        let a = -1.0 / (sign + n.z);
        let b = n.x * n.y * a;
        Self {
            x: n,
            y: DVec3::new(1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x),
            z: DVec3::new(b, sign + n.y * n.y * a, -n.y),
        }
    }

    /// Components of the world vector `w` in this frame.
    pub fn to_local(&self, w: DVec3) -> DVec3 {
        DVec3::new(w.dot(self.x), w.dot(self.y), w.dot(self.z))
    }

    /// The world vector with components `w` in this frame.
    pub fn to_world(&self, w: DVec3) -> DVec3 {
        self.x * w.x + self.y * w.y + self.z * w.z
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn polar_directions_follow_the_convention() {
        let w = PolarDirection::from_degrees(90.0, 90.0).vector();
        assert!((w - DVec3::Y).length() < 1e-15, "{w}");
        let w = PolarDirection::new(1.1, -2.0).vector();
        assert!((w.z.acos() - 1.1).abs() < 1e-14 && (w.y.atan2(w.x) + 2.0).abs() < 1e-14);
    }

    #[test]
    fn a_frame_is_orthonormal_and_right_handed_for_hostile_tangents() {
        for t in [
            DVec3::X,
            -DVec3::X,
            DVec3::Y,
            DVec3::Z,
            -DVec3::Z,
            DVec3::new(1e-9, -0.0, -1.0),
        ] {
            let t = t.normalize();
            let f = Frame::from_tangent(t);
            assert!((f.x.cross(f.y) - f.z).length() < 1e-12, "{t}: {f:?}");
            assert!(f.x.dot(f.y).abs() < 1e-12 && (f.y.length() - 1.0).abs() < 1e-12);
            let w = DVec3::new(0.3, -0.4, 0.5);
            assert!((f.to_world(f.to_local(w)) - w).length() < 1e-12);
        }
    }
}
