//! Yarn center lines: one float after Li 2024 eq. 5-6, and how over and under floats are joined.
//!
//! A float is a run of crossings with the yarn on one side. Li's float ends at the middle plane with a slope that depends
//! on its length, so floats of unequal length would meet with a kink. Here each change of side is bridged by the quintic
//! that takes over height, slope and curvature of the float on its left `join` cells before the change and of the float
//! on its right `join` cells after it: the center line is twice continuously differentiable, and crowns are untouched
//! because `join` is at most half a cell.
//!
//! Does not know forces: crown heights are what the file says, whatever the yarns' stiffness.

use std::f64::consts::FRAC_PI_2;

/// Float length at which the profile is the plain arc, in cells (Li 2024).
pub const L_MIN: f64 = 1.0;
/// Float length from which on the profile is the flattest one, in cells (Li 2024).
pub const L_MAX: f64 = 4.0;

/// A height and its first two derivatives by the position along the yarn.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Jet {
    /// Height.
    pub value: f64,
    /// First derivative.
    pub slope: f64,
    /// Second derivative.
    pub bend: f64,
}

impl Jet {
    fn scaled(self, factor: f64) -> Self {
        Self {
            value: factor * self.value,
            slope: factor * self.slope,
            bend: factor * self.bend,
        }
    }
}

/// Center line of one float, Li 2024 eq. 5-6 (`z_cen`), with derivatives by `y`.
///
/// `y` in [0, length] and `length` are in weave cells, `u_max` in radians within [0, pi/2]; the height has the unit of
/// `beta` and peaks at exactly `beta` at `y = length / 2`. The weight `w = (length - 1) / 3` of the flat profile is
/// clamped to [0, 1]. Written without the paper's radius `r = length / (2 sin u_max)`, which has no limit for
/// `u_max = 0`; there the float is the parabola `4 beta y (length - y) / length^2`. At `u_max = pi/2` the slope is
/// infinite at both ends.
pub fn float_profile(y: f64, length: f64, u_max: f64, beta: f64) -> Jet {
    debug_assert!((0.0..=FRAC_PI_2).contains(&u_max), "u_max = {u_max}");
    let (s, cos_u) = u_max.sin_cos();
    let a = 0.5 * length;
    let c = y - a;
    let w = ((length - L_MIN) / (L_MAX - L_MIN)).clamp(0.0, 1.0);
    // q = sin(u_max) sqrt(r^2 - c^2); arc = z_cir / sin(u_max).
    let q = (a * a - (c * s) * (c * s)).max(0.0).sqrt();
    let arc = y * (length - y) / (q + a * cos_u);
    let arc_slope = -c / q;
    let arc_bend = -a * a / (q * q * q);
    // flat = 1 + w (z_par - 1)
    let k = 2.0 * w * s / (length * length);
    let (flat, flat_slope, flat_bend) = (1.0 + k * c * c, 2.0 * k * c, 2.0 * k);
    // beta sin(u_max) / (r - r cos(u_max)) = beta (1 + cos(u_max)) / (length / 2)
    Jet {
        value: arc * flat,
        slope: arc_slope * flat + arc * flat_slope,
        bend: arc_bend * flat + 2.0 * arc_slope * flat_slope + arc * flat_bend,
    }
    .scaled(beta * (1.0 + cos_u) / a)
}

/// A run of cells on one side of the cloth.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Float {
    /// First cell boundary, in cells from the origin; may be negative (the float then began in the repeat before).
    start: f64,
    /// Number of cells.
    length: f64,
    /// +1 on top, -1 below.
    side: f64,
}

/// The periodic center line of one yarn: height over the middle plane along the yarn.
#[derive(Debug, Clone, PartialEq)]
pub struct CenterLine {
    /// Floats in order; the last one ends one period after the first one starts.
    floats: Vec<Float>,
    period: f64,
    crown: f64,
    u_max: f64,
    join: f64,
}

impl CenterLine {
    /// The center line of a yarn whose sides per cell are `on_top` (periodic), with crowns at `crown` above and below the
    /// middle plane, end angle parameter `u_max` (radians) and joins reaching `join` cells to both sides of each change.
    ///
    /// # Panics
    /// When the yarn never changes side ([`super::Draft`] refuses such drafts) or `join` is outside (0, 0.5].
    pub fn new(on_top: &[bool], crown: f64, u_max: f64, join: f64) -> Self {
        assert!(join > 0.0 && join <= 0.5, "join = {join}");
        let n = on_top.len();
        let changes: Vec<usize> = (0..n)
            .filter(|&k| on_top[k] != on_top[(k + n - 1) % n])
            .collect();
        assert!(!changes.is_empty(), "a yarn must change side");
        let floats = changes
            .iter()
            .enumerate()
            .map(|(i, &start)| {
                let end = changes.get(i + 1).map_or(changes[0] + n, |&next| next);
                Float {
                    start: start as f64,
                    length: (end - start) as f64,
                    side: if on_top[start] { 1.0 } else { -1.0 },
                }
            })
            .collect();
        Self {
            floats,
            period: n as f64,
            crown,
            u_max,
            join,
        }
    }

    /// Height and derivatives at `y` cells from the origin (any real number), derivatives per cell.
    pub fn at(&self, y: f64) -> Jet {
        let first = self.floats[0].start;
        let y = first + (y - first).rem_euclid(self.period);
        let index = self.floats.partition_point(|f| f.start <= y).max(1) - 1;
        let float = self.floats[index];
        let inside = y - float.start;
        let n = self.floats.len();
        if inside < self.join {
            self.bridge(&self.floats[(index + n - 1) % n], &float, inside)
        } else if float.length - inside < self.join {
            let next = self.floats[(index + 1) % n];
            self.bridge(&float, &next, inside - float.length)
        } else {
            self.inside(&float, inside)
        }
    }

    fn inside(&self, float: &Float, y: f64) -> Jet {
        float_profile(y, float.length, self.u_max, self.crown).scaled(float.side)
    }

    /// The quintic from `left` to `right`, `y` cells after the change of side between them.
    fn bridge(&self, left: &Float, right: &Float, y: f64) -> Jet {
        let from = self.inside(left, left.length - self.join);
        let to = self.inside(right, self.join);
        quintic(from, to, 2.0 * self.join, y + self.join)
    }
}

/// The quintic with the given values and two derivatives at 0 and `width`, at `x`.
fn quintic(from: Jet, to: Jet, width: f64, x: f64) -> Jet {
    // In t = x / width; the lowest three coefficients come from the left end, the others solve the right end.
    let t = x / width;
    let (c0, c1, c2) = (
        from.value,
        from.slope * width,
        0.5 * from.bend * width * width,
    );
    let value = to.value - (c0 + c1 + c2);
    let slope = to.slope * width - (c1 + 2.0 * c2);
    let bend = to.bend * width * width - 2.0 * c2;
    let c3 = 10.0 * value - 4.0 * slope + 0.5 * bend;
    let c4 = -15.0 * value + 7.0 * slope - bend;
    let c5 = 6.0 * value - 3.0 * slope + 0.5 * bend;
    Jet {
        value: c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * c5)))),
        slope: (c1 + t * (2.0 * c2 + t * (3.0 * c3 + t * (4.0 * c4 + t * 5.0 * c5)))) / width,
        bend: (2.0 * c2 + t * (6.0 * c3 + t * (12.0 * c4 + t * 20.0 * c5))) / (width * width),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_of_the_float_agree_with_differences() {
        let h = 1e-5;
        for l in [1.0, 2.0, 3.0, 7.0] {
            for u in [0.0, 0.3, 1.0, 1.5, FRAC_PI_2] {
                for k in 1..10 {
                    let y = l * k as f64 / 10.0;
                    let f = |y| float_profile(y, l, u, 0.7);
                    let slope = (f(y + h).value - f(y - h).value) / (2.0 * h);
                    let bend = (f(y + h).slope - f(y - h).slope) / (2.0 * h);
                    assert!((f(y).slope - slope).abs() < 1e-7, "l={l} u={u} y={y}");
                    assert!((f(y).bend - bend).abs() < 1e-6 * (1.0 + bend.abs()));
                }
            }
        }
    }

    #[test]
    fn joins_are_monotone_and_never_rise_above_the_crown() {
        for cells in [
            &[true, false][..],
            &[true, true, false],
            &[true, true, true, true, true, true, true, false],
            &[true, true, false, true, false, false, false, false],
        ] {
            for u in [0.0, 0.1, 0.8, 1.5, FRAC_PI_2] {
                for join in [0.05, 0.25, 0.5] {
                    let line = CenterLine::new(cells, 0.1, u, join);
                    let middle_of = |f: &Float| f.start + 0.5 * f.length;
                    for (k, float) in line.floats.iter().enumerate() {
                        let (middle, side) = (middle_of(float), float.side);
                        let next = line
                            .floats
                            .get(k + 1)
                            .map_or(middle_of(&line.floats[0]) + cells.len() as f64, middle_of);
                        let mut last = line.at(middle).value * side;
                        assert!((last - 0.1).abs() < 1e-14);
                        for j in 1..=400 {
                            let y = middle + (next - middle) * j as f64 / 400.0;
                            let z = line.at(y).value * side;
                            assert!(z <= last + 1e-12, "{cells:?} u={u} join={join} y={y}");
                            last = z;
                        }
                    }
                }
            }
        }
    }
}
