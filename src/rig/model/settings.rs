//! The `$` settings of the two kinds of controller, with the decimals they are printed with.

use super::Flavor;
use std::collections::BTreeMap;

/// Value and printed decimals by setting number.
#[derive(Debug, Clone)]
pub(super) struct Settings(BTreeMap<u16, (f64, usize)>);

const COMMON: &[(u16, f64, usize)] = &[
    (1, 25.0, 0),
    (2, 0.0, 0),
    (3, 0.0, 0),
    (5, 0.0, 0),
    (6, 0.0, 0),
    (11, 0.010, 3),
    (12, 0.002, 3),
    (13, 0.0, 0),
    (20, 0.0, 0),
    (21, 0.0, 0),
    (22, 0.0, 0),
    (23, 0.0, 0),
    (26, 250.0, 0),
    (27, 1.0, 3),
    (32, 0.0, 0),
];

const GRBL: &[(u16, f64, usize)] = &[
    (0, 10.0, 0),
    (4, 0.0, 0),
    (10, 1.0, 0),
    (24, 25.0, 3),
    (25, 500.0, 3),
    (30, 1000.0, 0),
    (31, 0.0, 0),
];

/// The part of grblHAL's settings that a rig's driver may look at.
const GRBLHAL: &[(u16, f64, usize)] = &[
    (0, 5.0, 1),
    (4, 31.0, 0),
    (9, 1.0, 0),
    (10, 511.0, 0),
    (14, 0.0, 0),
    (15, 0.0, 0),
    (24, 25.0, 1),
    (25, 500.0, 1),
    (28, 0.1, 3),
    (29, 0.0, 1),
    (30, 1000.0, 3),
    (31, 0.0, 3),
    (37, 0.0, 0),
    (40, 0.0, 0),
    (43, 1.0, 0),
    (44, 4.0, 0),
    (45, 3.0, 0),
    (376, 3.0, 0),
    (398, 100.0, 0),
];

impl Settings {
    /// What a blank controller starts with.
    pub(super) fn factory(flavor: Flavor, n_axes: usize) -> Self {
        let own = match flavor {
            Flavor::Grbl => GRBL,
            Flavor::GrblHal => GRBLHAL,
        };
        let mut map: BTreeMap<u16, (f64, usize)> = COMMON
            .iter()
            .chain(own)
            .map(|&(n, v, d)| (n, (v, d)))
            .collect();
        let step_decimals = if flavor == Flavor::Grbl { 3 } else { 5 };
        for axis in 0..n_axes as u16 {
            map.insert(100 + axis, (250.0, step_decimals));
            map.insert(110 + axis, (500.0, 3));
            map.insert(120 + axis, (10.0, 3));
            map.insert(130 + axis, (200.0, 3));
        }
        Self(map)
    }

    /// A setting's value; zero when the controller has none of that number.
    pub(super) fn get(&self, number: u16) -> f64 {
        self.0.get(&number).map_or(0.0, |s| s.0)
    }

    /// The values of `base`, `base + 1`, ...
    pub(super) fn per_axis(&self, base: u16, n_axes: usize) -> Vec<f64> {
        (0..n_axes as u16).map(|a| self.get(base + a)).collect()
    }

    /// Sets a value; false when the controller has no such setting.
    pub(super) fn set(&mut self, number: u16, value: f64) -> bool {
        match self.0.get_mut(&number) {
            Some(slot) => {
                slot.0 = value;
                true
            }
            None => false,
        }
    }

    /// `$n=v`, as the controller prints it.
    pub(super) fn line(&self, number: u16) -> Option<String> {
        let &(value, decimals) = self.0.get(&number)?;
        Some(format!("${number}={value:.decimals$}"))
    }

    /// All of them.
    pub(super) fn lines(&self) -> Vec<String> {
        self.0.keys().filter_map(|&n| self.line(n)).collect()
    }
}
