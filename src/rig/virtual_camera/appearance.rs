//! What stands in front of the virtual camera, how brightly it is lit, and where things stand in truth.

use crate::rig::Shot;
use crate::session::{Configuration, FrameKind, WhiteReference};

/// What the virtual camera looks at.
pub trait Appearance: Send + Sync {
    /// Normalized radiance (r, g, b) toward the camera of the point `point_mm` of the sample plane (millimeters, in the
    /// sample frame, which is turned by `pose.rotation`), for a frame of this kind; never asked for darks. A white frame
    /// shows [`white_radiance`], everywhere; a flat one an even source; a chart or board what lies in the sample's place.
    ///
    /// `pose` is where light and camera stand in truth ([`Stand`]), under the id of the pose that was asked for.
    fn radiance(&self, kind: FrameKind, pose: &Configuration, point_mm: [f64; 2]) -> [f64; 3];
}

/// The lamp's brightness, r, g, b, at each shot with light; 1 is what radiances are stated for. Whoever makes it lets it
/// count shots or read a clock.
pub type LampLaw = Box<dyn FnMut(&Shot) -> [f64; 3] + Send + Sync>;

/// Where things stand in truth when a pose was asked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stand {
    /// Light, camera and turntable; with the id of the pose that was asked for.
    pub pose: Configuration,
    /// How far the image is shifted, pixels right and down: the camera points beside the sample center.
    pub shift_px: [f64; 2],
    /// Height of the sample's surface over the center of rotation, millimeters.
    pub height_mm: f64,
}

impl Stand {
    /// Everything where it was asked to be.
    pub fn exact(pose: &Configuration) -> Self {
        Self {
            pose: *pose,
            shift_px: [0.0; 2],
            height_mm: 0.0,
        }
    }
}

/// Where things stand in truth at a shot. It must be a function of the shot alone.
pub type Misalignment = Box<dyn Fn(&Shot) -> Stand + Send + Sync>;

/// The normalized radiance of the white standard at its reference geometry:
/// `M = pi f_r cos(theta_light) = reflectance_factor cos(theta_light)`.
pub fn white_radiance(white: &WhiteReference) -> [f64; 3] {
    let cosine = white.configuration.light.theta.cos();
    white.reflectance_factor.map(|factor| factor * cosine)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::PolarDirection;

    #[test]
    fn the_white_standard_reads_its_factor_times_the_cosine() {
        let white = WhiteReference {
            configuration: Configuration {
                id: 0,
                light: PolarDirection::from_degrees(45.0, 180.0),
                camera: PolarDirection::from_degrees(0.0, 0.0),
                rotation: 0.0,
            },
            reflectance_factor: [1.02, 1.0, 0.98],
            reflectance_factor_se: [0.0; 3],
        };
        let m = white_radiance(&white);
        assert!((m[0] - 1.02 * 0.5_f64.sqrt()).abs() < 1e-15);
    }
}
