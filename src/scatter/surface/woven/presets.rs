//! Published fabrics: the segments and parameters of the six cloths of Irawan 2008, as his weave files give them.
//!
//! Source: the weave data of Piti Irawan as distributed with the renderer LuxCore (`materials/cloth`, Apache License 2.0).
//! Lengths there are counts of a unit of the pattern; here a unit is [`UNIT_MM`]. The BRDF does not depend on it.
//! The coefficients are not part of these data; those of the models' defaults stand in.

use super::shape::Shape;
use super::texture::{Placed, Repeat};
use crate::base::{Error, Result};

/// The unit of the patterns, millimeters: not published, of the order of a fine yarn.
pub const UNIT_MM: f64 = 0.1;

/// Twist and inclination in degrees, curvature.
struct Yarn {
    twist_deg: f64,
    inclination_deg: f64,
    curvature: f64,
}

const fn yarn(twist_deg: f64, inclination_deg: f64, curvature: f64) -> Yarn {
    Yarn {
        twist_deg,
        inclination_deg,
        curvature,
    }
}

/// Segments of one size: system, width, length, and the middles as shares of the repeat.
struct Group {
    system: usize,
    width: f64,
    length: f64,
    centers: &'static [[f64; 2]],
}

/// A published fabric.
pub struct Preset {
    /// Its name, e.g. `denim`.
    pub name: &'static str,
    /// What it is.
    pub description: &'static str,
    /// The weave by name, as the generator of fibers knows it (`fabric::Draft::named`), where the segments are those of one.
    pub weave: &'static str,
    size: [f64; 2],
    uniform: f64,
    forward: f64,
    smoothing: f64,
    yarns: [Yarn; 2],
    groups: &'static [Group],
}

/// All published fabrics.
pub const PRESETS: &[Preset] = &[
    Preset {
        name: "denim",
        description: "cotton denim, blue weft and white warp in the thesis",
        weave: "2/1 twill",
        size: [3.0, 6.0],
        uniform: 0.01,
        forward: 4.0,
        smoothing: 0.0,
        yarns: [yarn(-30.0, 12.0, 0.0), yarn(-30.0, 38.0, 0.0)],
        groups: &[
            Group {
                system: 0,
                width: 1.0,
                length: 5.0,
                centers: &[
                    [1.0 / 6.0, 0.75],
                    [0.5, 1.0 / 12.0],
                    [5.0 / 6.0, 5.0 / 12.0],
                ],
            },
            Group {
                system: 1,
                width: 1.0,
                length: 1.0,
                centers: &[
                    [1.0 / 6.0, 0.25],
                    [0.5, 7.0 / 12.0],
                    [5.0 / 6.0, 11.0 / 12.0],
                ],
            },
        ],
    },
    Preset {
        name: "twill",
        description: "black cotton twill",
        weave: "3/1 twill",
        size: [4.0, 8.0],
        uniform: 0.01,
        forward: 4.0,
        smoothing: 0.0,
        // Published: 36 degrees for the weft, at which `w sin(u_max)` exceeds l and the model has no meaning.
        yarns: [yarn(-30.0, 24.0, 0.0), yarn(-30.0, 25.0, 0.0)],
        groups: &[
            Group {
                system: 0,
                width: 1.0,
                length: 6.0,
                centers: &[
                    [0.125, 0.375],
                    [0.375, 0.125],
                    [0.625, 0.875],
                    [0.875, 0.625],
                ],
            },
            Group {
                system: 1,
                width: 2.0,
                length: 1.0,
                centers: &[
                    [0.125, 0.875],
                    [0.375, 0.625],
                    [0.625, 0.375],
                    [0.875, 0.125],
                ],
            },
        ],
    },
    Preset {
        name: "gabardine",
        description: "red wool gabardine",
        weave: "2/1 twill",
        size: [6.0, 9.0],
        uniform: 0.01,
        forward: 4.0,
        smoothing: 0.0,
        yarns: [yarn(30.0, 30.0, 0.0), yarn(30.0, 30.0, 0.0)],
        groups: &[
            Group {
                system: 0,
                width: 2.0,
                length: 6.0,
                centers: &[[1.0 / 6.0, 2.0 / 3.0], [0.5, 0.0], [5.0 / 6.0, 1.0 / 3.0]],
            },
            Group {
                system: 1,
                width: 3.0,
                length: 2.0,
                centers: &[[1.0 / 6.0, 1.0 / 6.0], [0.5, 0.5], [5.0 / 6.0, 5.0 / 6.0]],
            },
        ],
    },
    Preset {
        name: "lining",
        description: "red polyester lining",
        weave: "plain",
        size: [2.0, 2.0],
        uniform: 0.015,
        forward: 4.0,
        smoothing: 0.5,
        yarns: [yarn(0.0, 22.0, -0.7), yarn(0.0, 16.0, -0.7)],
        groups: &[
            Group {
                system: 0,
                width: 1.0,
                length: 1.0,
                centers: &[[0.25, 0.25], [0.75, 0.75]],
            },
            Group {
                system: 1,
                width: 1.0,
                length: 1.0,
                centers: &[[0.25, 0.75], [0.75, 0.25]],
            },
        ],
    },
    Preset {
        name: "charmeuse",
        description: "red silk charmeuse",
        weave: "5-end satin",
        size: [5.0, 10.0],
        uniform: 0.02,
        forward: 7.3,
        smoothing: 0.5,
        yarns: [yarn(0.0, 40.0, 2.0), yarn(0.0, 60.0, 0.0)],
        groups: &[
            Group {
                system: 0,
                width: 1.0,
                length: 9.0,
                centers: &[
                    [0.1, 0.45],
                    [0.3, 0.05],
                    [0.5, 0.65],
                    [0.7, 0.25],
                    [0.9, 0.85],
                ],
            },
            Group {
                system: 1,
                width: 1.0,
                length: 1.0,
                centers: &[
                    [0.1, 0.95],
                    [0.3, 0.55],
                    [0.5, 0.15],
                    [0.7, 0.75],
                    [0.9, 0.35],
                ],
            },
        ],
    },
    Preset {
        name: "shantung",
        description: "red silk shantung, finer gray warp",
        weave: "plain",
        size: [6.0, 8.0],
        uniform: 0.02,
        forward: 1.5,
        smoothing: 0.5,
        yarns: [yarn(0.0, 50.0, -0.5), yarn(0.0, 23.0, -0.3)],
        groups: &[
            Group {
                system: 0,
                width: 2.0,
                length: 4.0,
                centers: &[[1.0 / 3.0, 0.25], [5.0 / 6.0, 0.75]],
            },
            Group {
                system: 1,
                width: 4.0,
                length: 4.0,
                centers: &[[1.0 / 3.0, 0.75], [5.0 / 6.0, 0.25]],
            },
        ],
    },
];

/// The published fabric with this name.
///
/// # Errors
/// When there is none; the hint lists those that exist.
pub fn preset(name: &str) -> Result<&'static Preset> {
    PRESETS.iter().find(|p| p.name == name).ok_or_else(|| {
        let known: Vec<_> = PRESETS.iter().map(|p| p.name).collect();
        Error::new(format!("unknown published fabric '{name}'"))
            .with_hint(format!("known fabrics: {}", known.join(", ")))
    })
}

impl Preset {
    /// The visible segments with their places.
    pub fn repeat(&self) -> Repeat {
        let size = self.size.map(|s| s * UNIT_MM);
        let place = |g: &Group, c: &[f64; 2]| Placed {
            system: g.system,
            center: [c[0] * size[0], c[1] * size[1]],
            width: g.width * UNIT_MM,
            length: g.length * UNIT_MM,
        };
        let of_group = |g: &'static Group| g.centers.iter().map(move |c| place(g, c));
        Repeat {
            size,
            segments: self.groups.iter().flat_map(of_group).collect(),
        }
    }

    /// The shape of the segments of a yarn system; width and length are those of its first segments.
    pub fn shape(&self, system: usize) -> Shape {
        let yarn = &self.yarns[system.min(1)];
        let size = self.groups.iter().find(|g| g.system == system.min(1));
        let (width, length) = size.map_or((1.0, 1.0), |g| (g.width, g.length));
        Shape {
            twist: yarn.twist_deg.to_radians(),
            inclination: yarn.inclination_deg.to_radians(),
            curvature: yarn.curvature,
            uniform: self.uniform,
            forward: self.forward,
            smoothing: self.smoothing,
            width: width * UNIT_MM,
            length: length * UNIT_MM,
        }
    }
}
