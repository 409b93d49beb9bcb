//! Rig files for tests: a few numbers in, a whole file out.

#![allow(dead_code)]

use goniofit::rig::{AxisName, RigDescription};
use std::fmt::Write;

/// Five axes by their keys in a rig file, in the order of [`AxisName::ALL`], and what else the file says.
#[derive(Clone)]
pub(crate) struct SmallRig {
    /// Tables `[[boards]]`.
    pub(crate) boards: String,
    /// The keys of each axis.
    pub(crate) axes: [String; 5],
    /// Polar angle and azimuth of light and camera at the white reference.
    pub(crate) white: [f64; 4],
    /// `[clearance]` and `[[bodies]]`.
    pub(crate) bodies: String,
}

/// The keys of a driven axis.
pub(crate) fn driven(board: &str, letter: char, low: f64, high: f64) -> String {
    format!("board = '{board}'\nletter = '{letter}'\nmin_deg = {low:?}\nmax_deg = {high:?}\n")
}

/// The key of a bolted axis.
pub(crate) fn fixed(angle: f64) -> String {
    format!("fixed_deg = {angle:?}\n")
}

/// A table `[[boards]]`.
pub(crate) fn board(name: &str, protocol: &str) -> String {
    format!(
        "[[boards]]\nname = '{name}'\nport = '/dev/{name}'\nhoming = 'cycle'\nprotocol = '{protocol}'\n"
    )
}

/// A body that is a sphere.
pub(crate) fn sphere(name: &str, on: &str, center: [f64; 3], radius: f64) -> String {
    format!(
        "[[bodies]]\nname = '{name}'\non = '{on}'\nsphere = {{ center_mm = {center:?}, radius_mm = {radius:?} }}\n"
    )
}

/// A body that is a capsule.
pub(crate) fn capsule(name: &str, on: &str, ends: [[f64; 3]; 2], radius: f64) -> String {
    format!(
        "[[bodies]]\nname = '{name}'\non = '{on}'\ncapsule = {{ from_mm = {:?}, to_mm = {:?}, radius_mm = {radius:?} }}\n",
        ends[0], ends[1]
    )
}

/// The table `[clearance]`.
pub(crate) fn margin(margin_mm: f64) -> String {
    format!("[clearance]\nmargin_mm = {margin_mm:?}\n")
}

impl SmallRig {
    /// Camera and light bolted at 60 degrees but for their azimuths, with a sphere of 20 mm each 100 mm from the sample;
    /// white at azimuths -90 (light) and 90 (camera).
    pub(crate) fn carousel(boards: String, light: &str, camera: &str) -> Self {
        Self {
            boards,
            axes: [
                fixed(60.0),
                driven(
                    camera,
                    if camera == light { 'X' } else { '1' },
                    -170.0,
                    170.0,
                ),
                fixed(60.0),
                driven(
                    light,
                    if camera == light { 'Y' } else { '2' },
                    -170.0,
                    170.0,
                ),
                fixed(0.0),
            ],
            white: [60.0, -90.0, 60.0, 90.0],
            bodies: margin(5.0)
                + &sphere("lens", "camera", [0.0, 0.0, 100.0], 20.0)
                + &sphere("bulb", "light", [0.0, 0.0, 100.0], 20.0),
        }
    }

    pub(crate) fn text(&self) -> String {
        let mut text = format!("name = 'small'\nfeed_deg_per_min = 600.0\n{}", self.boards);
        for (name, keys) in AxisName::ALL.iter().zip(&self.axes) {
            write!(text, "[axes.{}]\n{keys}", name.name()).unwrap();
        }
        let [light_theta, light_phi, camera_theta, camera_phi] = self.white;
        text + &format!(
            "[lamp]\nscpi_port = '/dev/lamp'\ncurrent_a = 1.0\nwarm_up_s = 0.0\n\
             [light]\nsize_mm = [10.0, 10.0]\ndistance_mm = 100.0\n\
             [camera]\nname = 'c'\npixel_mm = 0.1\nexposures_ms = [1.0]\nsample_square_mm = 1.0\n\
             [white]\nlight_theta_deg = {light_theta:?}\nlight_phi_deg = {light_phi:?}\n\
             camera_theta_deg = {camera_theta:?}\ncamera_phi_deg = {camera_phi:?}\n\
             reflectance_factor = [1.0, 1.0, 1.0]\nreflectance_factor_se = [0.0, 0.0, 0.0]\n{}",
            self.bodies
        )
    }

    pub(crate) fn rig(&self) -> RigDescription {
        RigDescription::from_toml(&self.text()).unwrap_or_else(|e| panic!("{}", e.report()))
    }
}
