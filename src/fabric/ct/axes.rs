//! Which axis of a volume lies along which axis of the scene.

use super::header::Geometry;
use crate::base::{Error, Result};
use std::fmt;
use std::str::FromStr;

const NAMES: [&str; 3] = ["x", "y", "z"];

/// For each axis of a volume's file, fastest first, the scene axis it runs along and whether it runs backward.
///
/// Scene axes are those of docs/conventions.md: x along the weft, y along the warp, z up out of the cloth. Written
/// `x,y,-z`: the file's first axis is x, its second y, its third runs against z.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Axes([(usize, bool); 3]);

impl Axes {
    /// File axes are scene axes.
    pub const SAME: Self = Self([(0, false), (1, false), (2, false)]);

    /// From the direction of each file axis in the scene; `None` unless each lies along one axis (within 1e-4) and no two
    /// along the same.
    pub(super) fn from_directions(directions: [[f64; 3]; 3]) -> Option<Self> {
        let mut axes = [(0, false); 3];
        for (axis, direction) in axes.iter_mut().zip(directions) {
            let along =
                (0..3).max_by(|a, b| direction[*a].abs().total_cmp(&direction[*b].abs()))?;
            let length = direction.iter().map(|d| d * d).sum::<f64>().sqrt();
            let across = (0..3).filter(|k| *k != along);
            if !across
                .into_iter()
                .all(|k| direction[k].abs() <= 1e-4 * length)
            {
                return None;
            }
            *axis = (along, direction[along] < 0.0);
        }
        Self::checked(axes)
    }

    fn checked(axes: [(usize, bool); 3]) -> Option<Self> {
        let whole = (0..3).all(|k| axes.iter().any(|a| a.0 == k));
        whole.then_some(Self(axes))
    }

    /// As stored in the file, where a person counts its axes as `geometry` says.
    pub(super) fn stored(self, geometry: &Geometry) -> Self {
        Self(geometry.counted(self.0))
    }

    /// The file axis that lies along a scene axis, and whether it runs backward.
    pub(super) fn file_axis(&self, scene: usize) -> (usize, bool) {
        let file = self.0.iter().position(|a| a.0 == scene).unwrap_or(scene);
        (file, self.0[file].1)
    }

    /// Numbers given per file axis, per scene axis.
    pub(super) fn to_scene<T: Copy>(self, file: [T; 3]) -> [T; 3] {
        [0, 1, 2].map(|scene| file[self.file_axis(scene).0])
    }

    /// True when the scene is a mirror image of the file: a yarn's S twist becomes Z.
    pub fn mirrors(&self) -> bool {
        let [a, b, _] = self.0.map(|a| a.0);
        let odd = (a + 1) % 3 != b;
        let backward = self.0.iter().filter(|a| a.1).count() % 2 == 1;
        odd != backward
    }
}

impl fmt::Display for Axes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let named = self
            .0
            .map(|(axis, backward)| format!("{}{}", if backward { "-" } else { "" }, NAMES[axis]));
        f.write_str(&named.join(","))
    }
}

impl FromStr for Axes {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let bad = || {
            Error::new(format!(
                "axes '{text}': expected x, y and z once each, with - where an axis runs backward"
            ))
            .with_hint("for example x,y,-z: the file's fastest axis is x, the next y, the slowest runs against z")
        };
        let parts: Vec<&str> = text.split(',').map(str::trim).collect();
        let [a, b, c] = parts.as_slice() else {
            return Err(bad());
        };
        let mut axes = [(0, false); 3];
        for (axis, part) in axes.iter_mut().zip([a, b, c]) {
            let name = part.trim_start_matches(['-', '+']);
            let found = NAMES.iter().position(|n| n.eq_ignore_ascii_case(name));
            *axis = (found.ok_or_else(bad)?, part.starts_with('-'));
        }
        Self::checked(axes).ok_or_else(bad)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_are_read_written_and_know_a_mirror() {
        for (text, mirrored) in [
            ("x,y,z", false),
            ("x,y,-z", true),
            ("y,x,z", true),
            ("y,x,-z", false),
            ("z,x,y", false),
            ("-x,-y,z", false),
            ("x,-z,y", false),
        ] {
            let axes: Axes = text.parse().unwrap();
            assert_eq!(axes.to_string(), text);
            assert_eq!(axes.mirrors(), mirrored, "{text}");
        }
        assert_eq!(
            "z,x,y".parse::<Axes>().unwrap().to_scene([1, 2, 3]),
            [2, 3, 1]
        );
        for bad in ["x,y", "x,x,y", "x,y,w", "", "x,y,z,z"] {
            let error = bad.parse::<Axes>().unwrap_err();
            assert!(error.to_string().contains("once each"), "{error}");
        }
    }
}
