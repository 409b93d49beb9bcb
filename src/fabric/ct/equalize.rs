//! Evening out density and contrast between the center of a scan and its edge.
//!
//! Zhao 2011 section 5 asks for it without giving a method. Here the level of air and the level of fiber are quadratics
//! in x and y, each fitted to the voxels of its class; a voxel becomes (value - air) / (fiber - air), so air is 0 and
//! fiber 1 everywhere. This also sets the scale, nearly 0 to 1, on which that paper's thresholds are stated. Levels that
//! vary along z are not evened out.

use super::coarse::Coarse;
use super::quadratic::{Fit, Quadratic};
use crate::base::{Context, Error, Result};
use serde::Serialize;

const ROUNDS: usize = 20;
/// Contrast below this share of the mean contrast is noise made large.
const LEAST_CONTRAST: f64 = 0.2;

/// The two levels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Levels {
    /// Mean value of voxels of air.
    pub air: Quadratic,
    /// Mean value of voxels of fiber.
    pub fiber: Quadratic,
}

impl Levels {
    /// The value on the scale from air, 0, to fiber, 1; `x`, `y` in millimeters from the volume's lower corner.
    pub(super) fn even(&self, x: f64, y: f64, value: f64) -> f64 {
        let air = self.air.at(x, y);
        (value - air) / (self.fiber.at(x, y) - air)
    }

    /// Fits the levels to a volume of `size` millimeters in x and y; the classes are first split by `threshold`, then
    /// half way between the levels until no voxel changes its class.
    ///
    /// # Errors
    /// A class does not spread over the cloth, or the contrast vanishes somewhere.
    pub(super) fn fit(coarse: &Coarse, size: [f64; 2], threshold: f64) -> Result<Self> {
        let hint = || "the levels of air and fiber cannot be found (--no-equalize leaves values as they are)";
        let mut levels: Option<Self> = None;
        let mut split = usize::MAX;
        for _ in 0..ROUNDS {
            let half = size.map(|s| 0.5 * s);
            let [mut air, mut fiber] = [0, 1].map(|_| Fit::over(half, half));
            let mut solid = 0;
            for (p, value) in coarse.points() {
                let is_fiber = match &levels {
                    None => value >= threshold,
                    Some(levels) => levels.even(p.x, p.y, value) >= 0.5,
                };
                let class = if is_fiber { &mut fiber } else { &mut air };
                class.add(p.x, p.y, value, 1.0);
                solid += usize::from(is_fiber);
            }
            let found = Self {
                air: air.solve("the level of air").context(hint)?,
                fiber: fiber.solve("the level of fiber").context(hint)?,
            };
            found.check(size).context(hint)?;
            levels = Some(found);
            if solid == split {
                break;
            }
            split = solid;
        }
        levels.ok_or_else(|| Error::new(hint()))
    }

    fn check(&self, size: [f64; 2]) -> Result<()> {
        let grid = (0..11 * 11).map(|k| {
            let [x, y] = [k % 11, k / 11].map(|i| f64::from(i) / 10.0);
            let (x, y) = (x * size[0], y * size[1]);
            (self.fiber.at(x, y) - self.air.at(x, y), x, y)
        });
        let mean = grid.clone().map(|g| g.0).sum::<f64>() / 121.0;
        match grid.min_by(|a, b| a.0.total_cmp(&b.0)) {
            Some((least, x, y)) if least <= LEAST_CONTRAST * mean => Err(Error::new(format!(
                "at x = {x:.2} mm, y = {y:.2} mm fiber is {least:.4} above air, {mean:.4} on average"
            ))
            .with_hint("crop away what lies outside the scanner's field of view")),
            _ => Ok(()),
        }
    }
}
