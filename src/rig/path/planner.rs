//! Finds free legs: straight, then axis by axis, then over poses out of the way, then over poses at random.
//!
//! Deterministic: the same rig and poses give the same way. Every leg that is handed out was proven free.

use super::Leg;
use super::search::{Graph, search};
use crate::base::{Error, Result};
use crate::rig::clearance::{Checker, Contact, MOST_LOOKS};
use crate::rig::description::{Axis, AxisName, RigDescription};
use crate::rig::kinematics::AxisAngles;
use crate::rig::travel::Pace;

/// Legs proven at most on the lattice of out-of-the-way poses, and among random poses.
const LATTICE_CHECKS: usize = 2_000;
const ROADMAP_CHECKS: usize = 3_000;

/// Looks at a pair on a leg between random poses: there are others when one is hard to prove free.
const ROADMAP_LOOKS: usize = 400;

/// Random poses, tried few first.
const ROADMAPS: [usize; 2] = [200, 1_000];

/// Nearest random poses tried from each.
const NEAREST: usize = 14;

/// Knows a rig's bodies, speeds and limits.
pub(super) struct Planner<'a> {
    rig: &'a RigDescription,
    checker: Option<Checker>,
    pace: Pace,
    /// Driven axes on which distances between bodies depend, with their limits.
    relevant: Vec<(AxisName, [f64; 2])>,
}

impl<'a> Planner<'a> {
    pub(super) fn new(rig: &'a RigDescription) -> Self {
        let checker = Checker::new(rig);
        let relevant = AxisName::ALL
            .into_iter()
            .filter(|name| checker.as_ref().is_some_and(|c| c.matters(*name)))
            .filter_map(|name| match rig.axis(name) {
                Axis::Motor(m) => Some((name, [m.min_deg, m.max_deg])),
                Axis::Fixed { .. } => None,
            })
            .collect();
        Self {
            rig,
            checker,
            pace: Pace::new(rig, None),
            relevant,
        }
    }

    /// Two bodies too near for a pose to stand at.
    pub(super) fn pose_contact(&self, pose: &AxisAngles) -> Option<Contact> {
        self.checker.as_ref().and_then(|c| c.pose_contact(pose))
    }

    /// Free legs from pose to pose. `to` is inside the limits and clear.
    pub(super) fn plan(&self, from: &AxisAngles, to: &AxisAngles) -> Result<Vec<Leg>> {
        let poses = match &self.checker {
            None => vec![*from, *to],
            Some(checker) if checker.is_free(from) => Way {
                planner: self,
                checker,
            }
            .clear(from, to)?,
            Some(checker) => Way {
                planner: self,
                checker,
            }
            .out(from, to)?,
        };
        Ok(poses[1..].iter().map(|to| Leg { to: *to }).collect())
    }
}

/// A search for a way among bodies.
struct Way<'a> {
    planner: &'a Planner<'a>,
    checker: &'a Checker,
}

impl Way<'_> {
    /// Poses of a way that starts inside the margin.
    fn out(&self, from: &AxisAngles, to: &AxisAngles) -> Result<Vec<AxisAngles>> {
        let floors = self.checker.margins_from(from);
        let mut exits = self.corners(from, to);
        exits.remove(0);
        for (name, limits) in &self.planner.relevant {
            for angle in limits {
                let mut exit = *from;
                exit.0[*name as usize] = *angle;
                exits.push(exit);
            }
        }
        exits.retain(|exit| self.stands(exit));
        let seconds = |exit: &AxisAngles| self.planner.pace.seconds(from, exit);
        exits.sort_by(|a, b| seconds(a).total_cmp(&seconds(b)));
        // Straight to the target is best, when that leads out.
        exits.insert(0, *to);
        let mut blocked = None;
        for exit in exits {
            match self.checker.sweep(from, &exit, &floors, MOST_LOOKS) {
                None if exit == *to => return Ok(vec![*from, *to]),
                None => {
                    let mut poses = self.clear(&exit, to)?;
                    poses.insert(0, *from);
                    return Ok(poses);
                }
                Some(contact) => blocked = blocked.or(Some(contact)),
            }
        }
        Err(no_way(
            "two bodies are nearer than the margin, and no leg leads away from there",
            blocked,
        )
        .with_hint("jog the axes free by hand, away from the bodies named, and start again"))
    }

    /// Poses of a way that starts clear.
    fn clear(&self, from: &AxisAngles, to: &AxisAngles) -> Result<Vec<AxisAngles>> {
        let floors = self.checker.margins();
        let Some(blocked) = self.checker.sweep(from, to, &floors, MOST_LOOKS) else {
            return Ok(vec![*from, *to]);
        };
        // Right after homing axes may stand outside their limits: inside first.
        let inside = self.inside(from);
        if inside != *from && self.stands(&inside) && self.is_free(from, &inside, MOST_LOOKS) {
            let mut poses = self.clear(&inside, to)?;
            poses.insert(0, *from);
            return Ok(poses);
        }
        let found = self
            .over(self.corners(from, to), &Edges::Supersets, LATTICE_CHECKS)
            .or_else(|| self.over_lattice(from, to))
            .or_else(|| {
                ROADMAPS.iter().find_map(|n| {
                    self.over(self.roadmap(from, to, *n), &Edges::Nearest, ROADMAP_CHECKS)
                })
            });
        match found {
            Some(poses) => Ok(self.shortened(poses)),
            None => Err(no_way("no free way found", Some(blocked)).with_hint(
                "put a pose in between that leads around, widen the limits, or correct the bodies in the rig file",
            )),
        }
    }

    fn is_free(&self, from: &AxisAngles, to: &AxisAngles, most_looks: usize) -> bool {
        let floors = self.checker.margins();
        let contact = self.checker.sweep(from, to, &floors, most_looks);
        contact.is_none()
    }

    /// A leg may end here.
    fn stands(&self, pose: &AxisAngles) -> bool {
        self.planner.rig.check_angles(pose).is_ok() && self.checker.pose_contact(pose).is_none()
    }

    fn inside(&self, pose: &AxisAngles) -> AxisAngles {
        let mut inside = *pose;
        for name in AxisName::ALL {
            if let Axis::Motor(m) = self.planner.rig.axis(name) {
                inside.0[name as usize] = pose.get(name).clamp(m.min_deg, m.max_deg);
            }
        }
        inside
    }

    /// `from`, and `to` with some of the relevant axes still as at `from`; `to` itself last. Bit k of the index: the k-th
    /// relevant axis that differs has moved.
    fn corners(&self, from: &AxisAngles, to: &AxisAngles) -> Vec<AxisAngles> {
        let moving: Vec<usize> = self
            .planner
            .relevant
            .iter()
            .map(|(name, _)| *name as usize)
            .filter(|&i| (from.0[i] - to.0[i]).abs() > 0.0)
            .collect();
        let mut corners: Vec<AxisAngles> = (0..1_usize << moving.len())
            .map(|mask| {
                let mut corner = *to;
                for (k, &i) in moving.iter().enumerate() {
                    if mask & (1 << k) == 0 {
                        corner.0[i] = from.0[i];
                    }
                }
                corner
            })
            .collect();
        corners[0] = *from;
        if moving.is_empty() {
            corners.push(*to);
        }
        corners
    }

    /// A way over every combination of the angles of both ends, the limits, their middle and zero.
    fn over_lattice(&self, from: &AxisAngles, to: &AxisAngles) -> Option<Vec<AxisAngles>> {
        let mut nodes = vec![*to];
        let mut counts = Vec::new();
        for (name, [low, high]) in &self.planner.relevant {
            let i = *name as usize;
            let mut values: Vec<f64> = Vec::new();
            for value in [from.0[i], to.0[i], 0.0, *low, *high, 0.5 * (low + high)] {
                let new = values.iter().all(|v| (v - value).abs() > 1.0) || values.len() == 1;
                if new && (*low..=*high).contains(&value) {
                    values.push(value);
                }
            }
            nodes = values
                .iter()
                .flat_map(|value| {
                    nodes.iter().map(|node| {
                        let mut node = *node;
                        node.0[i] = *value;
                        node
                    })
                })
                .collect();
            counts.push(values.len());
        }
        nodes.insert(0, *from);
        nodes.push(*to);
        self.over(nodes, &Edges::Lattice(counts), LATTICE_CHECKS)
    }

    /// Both ends with `n` clear poses between them, spread over the relevant axes by the sequence of Halton.
    fn roadmap(&self, from: &AxisAngles, to: &AxisAngles, n: usize) -> Vec<AxisAngles> {
        const BASES: [u32; 5] = [2, 3, 5, 7, 11];
        let sample = |k: usize| {
            let mut pose = *to;
            for ((name, [low, high]), base) in self.planner.relevant.iter().zip(BASES) {
                pose.0[*name as usize] = low + (high - low) * radical_inverse(k, base);
            }
            pose
        };
        let mut nodes = vec![*from];
        nodes.extend((1..=4 * n).map(sample).filter(|p| self.stands(p)).take(n));
        nodes.push(*to);
        nodes
    }

    /// A way from the first of these poses to the last.
    fn over(&self, nodes: Vec<AxisAngles>, edges: &Edges, most: usize) -> Option<Vec<AxisAngles>> {
        let n = nodes.len();
        let mut graph = Poses {
            way: self,
            stands: vec![None; n],
            nodes,
            edges,
        };
        let found = search(&mut graph, n, 0, n - 1, most)?;
        Some(found.into_iter().map(|i| graph.nodes[i]).collect())
    }

    /// Leaves out poses that a free leg can pass by, as long as that saves time.
    fn shortened(&self, mut poses: Vec<AxisAngles>) -> Vec<AxisAngles> {
        let pace = &self.planner.pace;
        let mut i = 0;
        while i + 2 < poses.len() {
            let around = |k: usize| -> f64 {
                poses[i..=k]
                    .windows(2)
                    .map(|w| pace.seconds(&w[0], &w[1]))
                    .sum()
            };
            let straight = (i + 2..poses.len()).rev().find(|&k| {
                pace.seconds(&poses[i], &poses[k]) <= around(k)
                    && self.is_free(&poses[i], &poses[k], MOST_LOOKS)
            });
            if let Some(k) = straight {
                poses.drain(i + 1..k);
            }
            i += 1;
        }
        poses
    }
}

fn no_way(what: &str, blocked: Option<Contact>) -> Error {
    match blocked {
        Some(contact) => Error::new(format!("{what}; on the straight way {contact}")),
        None => Error::new(what),
    }
}

/// The digits of `k` in this base, mirrored at the point.
fn radical_inverse(mut k: usize, base: u32) -> f64 {
    let base = base as usize;
    let (mut value, mut digit) = (0.0, 1.0);
    while k > 0 {
        digit /= base as f64;
        value += digit * (k % base) as f64;
        k /= base;
    }
    value
}

/// Which poses are tried from which.
enum Edges {
    /// Corners: every further one.
    Supersets,
    /// Lattice with these numbers of values, between a start and a goal: one axis changes, or straight to the goal.
    Lattice(Vec<usize>),
    /// The nearest, and the goal.
    Nearest,
}

/// Poses as a graph; the first is the start, the last the goal.
struct Poses<'a> {
    way: &'a Way<'a>,
    nodes: Vec<AxisAngles>,
    /// Whether a leg may end there, as far as it was asked.
    stands: Vec<Option<bool>>,
    edges: &'a Edges,
}

impl Poses<'_> {
    fn nearest(&self, node: usize) -> Vec<usize> {
        let seconds = |k: &usize| self.cost(node, *k);
        let mut others: Vec<usize> = (1..self.nodes.len()).filter(|k| *k != node).collect();
        if others.len() > NEAREST {
            others.select_nth_unstable_by(NEAREST, |a, b| seconds(a).total_cmp(&seconds(b)));
            others.truncate(NEAREST);
        }
        others
    }
}

impl Graph for Poses<'_> {
    fn neighbors(&self, node: usize) -> Vec<usize> {
        let goal = self.nodes.len() - 1;
        match self.edges {
            Edges::Supersets => (node + 1..=goal).filter(|k| k & node == node).collect(),
            Edges::Lattice(counts) => {
                let mut next = vec![goal];
                if node == 0 {
                    next.extend(self.nearest(0));
                    return next;
                }
                let place = node - 1;
                let mut stride = 1;
                for count in counts {
                    let digit = place / stride % count;
                    next.extend(
                        (0..*count)
                            .filter(|d| *d != digit)
                            .map(|d| 1 + place + d * stride - digit * stride),
                    );
                    stride *= count;
                }
                next
            }
            Edges::Nearest => {
                let mut next = self.nearest(node);
                next.push(goal);
                next
            }
        }
    }

    fn cost(&self, from: usize, to: usize) -> f64 {
        // A leg that moves nothing still is one more.
        1e-3 + self
            .way
            .planner
            .pace
            .seconds(&self.nodes[from], &self.nodes[to])
    }

    fn is_free(&mut self, from: usize, to: usize) -> bool {
        let (start, end) = (self.nodes[from], self.nodes[to]);
        let stands = *self.stands[to].get_or_insert_with(|| self.way.stands(&end));
        let looks = match self.edges {
            Edges::Nearest => ROADMAP_LOOKS,
            _ => MOST_LOOKS,
        };
        stands && self.way.is_free(&start, &end, looks)
    }
}
