//! How near the rig's bodies come to each other, at a pose and all along a leg.
//!
//! A leg is free only when that is proven: between two looked-at places the distance of two bodies changes by no more
//! than radius times angle, so boxes of progress are halved until each is proven free or too near. Nothing is sampled.
//! Knows neither cables nor how far a body bends.

use super::bodies::{Body, Clearance};
use super::description::{AxisName, RigDescription};
use super::kinematics::AxisAngles;
use super::travel::axis_groups;
use crate::base::{Error, Result};
use glam::DVec3;
use std::fmt;

/// Two bodies at a pose.
#[derive(Debug, Clone, PartialEq)]
pub struct Contact {
    /// One body.
    pub a: String,
    /// The other.
    pub b: String,
    /// Distance between their surfaces, millimeters; negative when they overlap.
    pub distance_mm: f64,
    /// What it must be at least, millimeters.
    pub margin_mm: f64,
    /// Where.
    pub at: AxisAngles,
}

impl fmt::Display for Contact {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (a, b, d) = (&self.a, &self.b, self.distance_mm);
        if d < 0.0 {
            write!(f, "'{a}' and '{b}' overlap by {:.2} mm, at", -d)?;
        } else {
            let margin = self.margin_mm;
            write!(
                f,
                "'{a}' and '{b}' are {d:.2} mm apart, margin {margin} mm, at"
            )?;
        }
        for (i, name) in AxisName::ALL.into_iter().enumerate() {
            let comma = if i == 0 { "" } else { "," };
            write!(f, "{comma} {} {:.2}", name.name(), self.at.get(name))?;
        }
        Ok(())
    }
}

/// What a pose must keep beyond the margin, millimeters, so that legs can be proven free up to it.
pub(super) const SPARE_MM: f64 = 0.01;

/// How much less than at its start two bodies may come to while they leave the margin, millimeters.
const ESCAPE_MM: f64 = 0.02;

/// A box of progress in which the distance changes less than this is not halved again, millimeters.
const FINEST_MM: f64 = 1e-4;

/// Places looked at for one pair on one leg before it counts as not free.
pub(super) const MOST_LOOKS: usize = 20_000;

impl RigDescription {
    /// The two bodies that come nearest to each other at a pose, of all that are checked.
    pub fn nearest(&self, at: &AxisAngles) -> Option<Contact> {
        Checker::new(self)?.nearest(at)
    }

    /// Checks that no two bodies are nearer than the margin (and 0.01 mm) at a pose; passes when the rig has no bodies.
    ///
    /// # Errors
    /// With both bodies, their distance and the pose.
    pub fn check_pose_clearance(&self, at: &AxisAngles) -> Result<()> {
        match Checker::new(self).and_then(|c| c.pose_contact(at)) {
            Some(contact) => Err(too_near("pose inside the clearance margin", &contact)),
            None => Ok(()),
        }
    }

    /// Checks that all axes can go straight from pose to pose, whichever group is ahead of the others, without two
    /// bodies coming nearer than the margin; passes when the rig has no bodies.
    ///
    /// # Errors
    /// With both bodies, their distance and the place: too near, or not to be proven free.
    pub fn check_leg_clearance(&self, from: &AxisAngles, to: &AxisAngles) -> Result<()> {
        let Some(checker) = Checker::new(self) else {
            return Ok(());
        };
        match checker.sweep(from, to, &checker.margins(), MOST_LOOKS) {
            Some(contact) => Err(too_near("leg inside the clearance margin", &contact)),
            None => Ok(()),
        }
    }
}

/// The error of a pose or leg that is not free.
pub(super) fn too_near(what: &str, contact: &Contact) -> Error {
    Error::new(format!("{what}: {contact}"))
        .with_hint("choose another pose, or correct the bodies in the rig file if they are larger than the real parts")
}

/// A body ready to be placed.
struct Solid {
    name: String,
    azimuth: Option<AxisName>,
    elevation: Option<AxisName>,
    ends: [DVec3; 2],
    radius: f64,
    /// Largest distance of its piece from the sample center.
    reach: f64,
    /// Largest distance from the elevation axis (y of its frame).
    swing: f64,
    /// Largest distance from the vertical, at any elevation.
    girth: f64,
}

impl Solid {
    fn new(body: &Body) -> Self {
        let ends = [
            DVec3::from_array(body.from_mm),
            DVec3::from_array(body.to_mm),
        ];
        // Over a straight piece each of these is largest at an end.
        let largest = |f: fn(DVec3) -> f64| f(ends[0]).max(f(ends[1]));
        let reach = largest(|p| p.length());
        let elevation = body.on.elevation();
        Self {
            name: body.name.clone(),
            azimuth: body.on.azimuth(),
            elevation,
            ends,
            radius: body.radius_mm,
            reach,
            swing: largest(|p| p.x.hypot(p.z)),
            girth: match elevation {
                Some(_) => reach,
                None => largest(|p| p.x.hypot(p.y)),
            },
        }
    }

    /// Its piece at an elevation and azimuth, radians.
    fn placed(&self, elevation: f64, azimuth: f64) -> [DVec3; 2] {
        let (st, ct) = elevation.sin_cos();
        let (sp, cp) = azimuth.sin_cos();
        self.ends.map(|p| {
            let tipped = DVec3::new(ct * p.x + st * p.z, p.y, ct * p.z - st * p.x);
            DVec3::new(
                cp * tipped.x - sp * tipped.y,
                sp * tipped.x + cp * tipped.y,
                tipped.z,
            )
        })
    }
}

/// What decides the distance of two bodies, radians: both elevations, and one azimuth less the other.
type Relative = [f64; 3];

/// Two bodies on different carriers.
struct Pair {
    a: usize,
    b: usize,
    /// Millimeters the distance changes at most per radian of each of [`Relative`].
    slopes: Relative,
}

/// The bodies of a rig and which progress together.
pub(super) struct Checker {
    margin: f64,
    solids: Vec<Solid>,
    pairs: Vec<Pair>,
    /// The group of each axis.
    group: [usize; 5],
}

impl Checker {
    /// None when the rig has no bodies.
    pub(super) fn new(rig: &RigDescription) -> Option<Self> {
        let Clearance { margin_mm, bodies } = rig.clearance.as_ref()?;
        let solids: Vec<Solid> = bodies.iter().map(Solid::new).collect();
        let mut pairs = Vec::new();
        for (a, one) in bodies.iter().enumerate() {
            for (b, other) in bodies.iter().enumerate().skip(a + 1) {
                let may_touch =
                    one.may_touch.contains(&other.name) || other.may_touch.contains(&one.name);
                if one.on != other.on && !may_touch {
                    pairs.push(Pair::new(&solids, a, b));
                }
            }
        }
        let mut group = [usize::MAX; 5];
        for (i, axes) in axis_groups(rig).iter().enumerate() {
            for name in axes {
                group[*name as usize] = i;
            }
        }
        Some(Self {
            margin: *margin_mm,
            solids,
            pairs,
            group,
        })
    }

    /// For every pair, the smallest distance allowed.
    pub(super) fn margins(&self) -> Vec<f64> {
        vec![self.margin; self.pairs.len()]
    }

    /// As [`Checker::margins`], but a pair that is nearer at `start` only may not come nearer than it is there.
    pub(super) fn margins_from(&self, start: &AxisAngles) -> Vec<f64> {
        let floor = |p| {
            let distance = self.distance(p, self.relative(p, start));
            if distance < self.margin {
                distance - ESCAPE_MM
            } else {
                self.margin
            }
        };
        self.pairs.iter().map(floor).collect()
    }

    /// The two bodies nearest to each other.
    pub(super) fn nearest(&self, at: &AxisAngles) -> Option<Contact> {
        let distances = self
            .pairs
            .iter()
            .map(|p| (p, self.distance(p, self.relative(p, at))));
        let (pair, distance) = distances.min_by(|x, y| x.1.total_cmp(&y.1))?;
        Some(self.contact(pair, distance, *at))
    }

    /// Two bodies that are too near for the end of a leg.
    pub(super) fn pose_contact(&self, at: &AxisAngles) -> Option<Contact> {
        self.nearest(at)
            .filter(|c| c.distance_mm.is_nan() || c.distance_mm < self.margin + SPARE_MM)
    }

    /// True when no two bodies are nearer than the margin.
    pub(super) fn is_free(&self, at: &AxisAngles) -> bool {
        self.nearest(at)
            .is_none_or(|c| c.distance_mm >= self.margin)
    }

    /// True for axes that bring bodies nearer to each other or farther away.
    pub(super) fn matters(&self, name: AxisName) -> bool {
        self.pairs.iter().any(|pair| {
            let (a, b) = (&self.solids[pair.a], &self.solids[pair.b]);
            let own = [a.elevation, b.elevation].contains(&Some(name));
            own || (a.azimuth == Some(name)) != (b.azimuth == Some(name))
        })
    }

    /// Two bodies that may come nearer than `floors` says on the way, or none when it is proven free with at most
    /// `most_looks` at each pair.
    pub(super) fn sweep(
        &self,
        from: &AxisAngles,
        to: &AxisAngles,
        floors: &[f64],
        most_looks: usize,
    ) -> Option<Contact> {
        self.pairs
            .iter()
            .zip(floors)
            .find_map(|(pair, floor)| self.sweep_pair(pair, from, to, *floor, most_looks))
    }

    fn sweep_pair(
        &self,
        pair: &Pair,
        from: &AxisAngles,
        to: &AxisAngles,
        floor: f64,
        most_looks: usize,
    ) -> Option<Contact> {
        // How the pair's angles change while one group progresses from 0 to 1, and the distance at most with them.
        let mut steps: Vec<(usize, Relative, f64)> = Vec::new();
        for group in 0..5 {
            let alone = self.progressed(from, to, |g| if g == group { 1.0 } else { 0.0 });
            let (start, end) = (self.relative(pair, from), self.relative(pair, &alone));
            let step: Relative = std::array::from_fn(|k| end[k] - start[k]);
            let change: f64 = (0..3).map(|k| pair.slopes[k] * step[k].abs()).sum();
            if change > 0.0 || change.is_nan() {
                steps.push((group, step, change));
            }
        }
        let start = self.relative(pair, from);
        let mut boxes = vec![([0.5; 5], [0.5; 5])];
        let mut looks = 0;
        while let Some((center, half)) = boxes.pop() {
            looks += 1;
            let mut place = start;
            let mut change = 0.0;
            for (i, (_, step, most)) in steps.iter().enumerate() {
                for k in 0..3 {
                    place[k] += center[i] * step[k];
                }
                change += half[i] * most;
            }
            let distance = self.distance(pair, place);
            if distance - change >= floor {
                continue;
            }
            let hopeless = change < FINEST_MM || looks >= most_looks;
            if distance.is_nan() || distance < floor || hopeless {
                let groups: Vec<usize> = steps.iter().map(|s| s.0).collect();
                let at = self.progressed(from, to, |g| {
                    groups
                        .iter()
                        .position(|x| *x == g)
                        .map_or(0.0, |i| center[i])
                });
                return Some(self.contact(pair, distance, at));
            }
            let widest = (0..steps.len())
                .max_by(|&x, &y| (half[x] * steps[x].2).total_cmp(&(half[y] * steps[y].2)))?;
            for side in [-0.5, 0.5] {
                let (mut c, mut h) = (center, half);
                c[widest] += side * half[widest];
                h[widest] *= 0.5;
                boxes.push((c, h));
            }
        }
        None
    }

    /// The pose at which every group has this progress.
    fn progressed(
        &self,
        from: &AxisAngles,
        to: &AxisAngles,
        progress: impl Fn(usize) -> f64,
    ) -> AxisAngles {
        AxisAngles(std::array::from_fn(|i| {
            from.0[i] + progress(self.group[i]) * (to.0[i] - from.0[i])
        }))
    }

    fn relative(&self, pair: &Pair, at: &AxisAngles) -> Relative {
        let angle = |name: Option<AxisName>| name.map_or(0.0, |n| at.get(n).to_radians());
        let (a, b) = (&self.solids[pair.a], &self.solids[pair.b]);
        let turned = if a.azimuth == b.azimuth {
            0.0
        } else {
            angle(a.azimuth) - angle(b.azimuth)
        };
        [angle(a.elevation), angle(b.elevation), turned]
    }

    fn distance(&self, pair: &Pair, relative: Relative) -> f64 {
        let (a, b) = (&self.solids[pair.a], &self.solids[pair.b]);
        let between = segment_distance(
            a.placed(relative[0], relative[2]),
            b.placed(relative[1], 0.0),
        );
        between - a.radius - b.radius
    }

    fn contact(&self, pair: &Pair, distance_mm: f64, at: AxisAngles) -> Contact {
        Contact {
            a: self.solids[pair.a].name.clone(),
            b: self.solids[pair.b].name.clone(),
            distance_mm,
            margin_mm: self.margin,
            at,
        }
    }
}

impl Pair {
    /// Turning one body by an angle is turning the other back by it: the smaller radius bounds what the distance does.
    fn new(solids: &[Solid], a: usize, b: usize) -> Self {
        let (one, other) = (&solids[a], &solids[b]);
        Self {
            a,
            b,
            slopes: [
                one.swing.min(other.reach),
                other.swing.min(one.reach),
                one.girth.min(other.girth),
            ],
        }
    }
}

/// Smallest distance between two straight pieces; either may be a point.
fn segment_distance(one: [DVec3; 2], other: [DVec3; 2]) -> f64 {
    let (d1, d2, r) = (one[1] - one[0], other[1] - other[0], one[0] - other[0]);
    let (a, e, f, c, b) = (
        d1.length_squared(),
        d2.length_squared(),
        d2.dot(r),
        d1.dot(r),
        d1.dot(d2),
    );
    // Of the four ends, each to the other piece; and, when the pieces are not parallel, the inner places of both.
    let along = |from: DVec3, length2: f64, way: DVec3, p: DVec3| {
        let t = if length2 > 0.0 {
            ((p - from).dot(way) / length2).clamp(0.0, 1.0)
        } else {
            0.0
        };
        (from + t * way - p).length()
    };
    let mut least = along(other[0], e, d2, one[0])
        .min(along(other[0], e, d2, one[1]))
        .min(along(one[0], a, d1, other[0]))
        .min(along(one[0], a, d1, other[1]));
    let denominator = a * e - b * b;
    if denominator > 1e-12 * a * e {
        let s = (b * f - c * e) / denominator;
        let t = (a * f - b * c) / denominator;
        if (0.0..=1.0).contains(&s) && (0.0..=1.0).contains(&t) {
            least = least.min((r + s * d1 - t * d2).length());
        }
    }
    least
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    fn random_point(random: &mut Random) -> DVec3 {
        DVec3::from_array(std::array::from_fn(|_| 2.0 * random.uniform() - 1.0))
    }

    /// Against a fine grid of both pieces, whose spacing bounds the grid's own error.
    #[test]
    fn distances_of_pieces_agree_with_a_grid() {
        let mut random = Random::keyed(&[2015, 71]);
        for case in 0..300 {
            let mut p: [DVec3; 4] = std::array::from_fn(|_| random_point(&mut random));
            match case % 5 {
                1 => p[1] = p[0],
                2 => p[3] = p[2] + (p[1] - p[0]),
                3 => (p[1], p[3]) = (p[0], p[2]),
                4 => p[2] = p[0].lerp(p[1], 0.3),
                _ => {}
            }
            let (one, other) = ([p[0], p[1]], [p[2], p[3]]);
            let found = segment_distance(one, other);
            let n = 200;
            let mut least = f64::INFINITY;
            for i in 0..=n {
                for k in 0..=n {
                    let at = |piece: [DVec3; 2], i: i32| {
                        piece[0].lerp(piece[1], f64::from(i) / f64::from(n))
                    };
                    least = least.min(at(one, i).distance(at(other, k)));
                }
            }
            let spacing = (p[0].distance(p[1]) + p[2].distance(p[3])) / f64::from(2 * n);
            assert!(
                found <= least + 1e-12 && least <= found + spacing,
                "case {case}: {found} against {least} +- {spacing}"
            );
        }
    }
}
