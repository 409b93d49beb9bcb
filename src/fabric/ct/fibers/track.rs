//! From centers in slices to lines: each center foretells where its fiber crosses the next slices.
//!
//! Pairs are taken greedily, nearest first, each center once on each side: at least half as good as the best matching
//! (Khungurn 2015 section 6, which goes by distance in the plane alone, within five voxels).

use super::centers::Center;
use glam::DVec3;

/// Fibers turn less than this from slice to slice (cosine).
const TURN: f64 = 0.8;
/// Slices that may be missed.
const MISSED: usize = 2;

/// A line along a fiber, in voxels: points about one voxel apart and the direction at each, from first to last.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Line {
    pub(super) points: Vec<DVec3>,
    pub(super) along: Vec<DVec3>,
}

/// Chains the centers of slices along an axis; `gate` is the largest distance from where a center was foretold, voxels.
pub(super) fn track(slices: &[Vec<Center>], axis: usize, gate: f64) -> Vec<Line> {
    let mut next: Vec<Vec<Option<(usize, usize)>>> =
        slices.iter().map(|s| vec![None; s.len()]).collect();
    let mut taken: Vec<Vec<bool>> = slices.iter().map(|s| vec![false; s.len()]).collect();
    for gap in 1..=1 + MISSED {
        for k in gap..slices.len() {
            let from = k - gap;
            let reach = gate * (1.0 + 0.25 * (gap - 1) as f64);
            let mut pairs = candidates(&slices[from], &slices[k], axis, reach);
            pairs.retain(|(_, a, b)| next[from][*a].is_none() && !taken[k][*b]);
            pairs.sort_by(|p, q| p.0.total_cmp(&q.0).then((p.1, p.2).cmp(&(q.1, q.2))));
            for (_, a, b) in pairs {
                if next[from][a].is_none() && !taken[k][b] {
                    next[from][a] = Some((k, b));
                    taken[k][b] = true;
                }
            }
        }
    }
    let mut lines = Vec::new();
    for (k, slice) in slices.iter().enumerate() {
        for index in (0..slice.len()).filter(|i| !taken[k][*i]) {
            lines.push(chained(slices, &next, (k, index)));
        }
    }
    lines
}

/// Pairs of centers of two slices with the distance of each from where the other foretells it.
fn candidates(from: &[Center], to: &[Center], axis: usize, gate: f64) -> Vec<(f64, usize, usize)> {
    let side = (axis + 1) % 3;
    let mut order: Vec<usize> = (0..to.len()).collect();
    order.sort_by(|i, j| to[*i].at[side].total_cmp(&to[*j].at[side]));
    let mut pairs = Vec::new();
    for (a, center) in from.iter().enumerate() {
        let Some(first) = to.first() else { break };
        let step = first.at[axis] - center.at[axis];
        let foretold = center.at + center.along * (step / center.along[axis]);
        // Directions differ, so the mean of both foretells up to this much elsewhere.
        let wide = gate + 0.6 * step;
        let start = order.partition_point(|i| to[*i].at[side] < foretold[side] - wide);
        for b in order[start..].iter().copied() {
            if to[b].at[side] > foretold[side] + wide {
                break;
            }
            if center.along.dot(to[b].along) < TURN {
                continue;
            }
            let mean = (center.along / center.along[axis] + to[b].along / to[b].along[axis]) * 0.5;
            let distance = (center.at + mean * step - to[b].at).length();
            if distance <= gate {
                pairs.push((distance, a, b));
            }
        }
    }
    pairs
}

fn chained(
    slices: &[Vec<Center>],
    next: &[Vec<Option<(usize, usize)>>],
    first: (usize, usize),
) -> Line {
    let mut line = Line {
        points: Vec::new(),
        along: Vec::new(),
    };
    let mut at = Some(first);
    while let Some((k, index)) = at {
        let center = &slices[k][index];
        line.bridge_to(center.at, center.along);
        at = next[k][index];
    }
    line
}

impl Line {
    /// Goes on to a point, with points in between about one voxel apart.
    pub(super) fn bridge_to(&mut self, to: DVec3, along: DVec3) {
        if let (Some(from), Some(d)) = (self.points.last().copied(), self.along.last().copied()) {
            let steps = ((to - from).abs().max_element() - 0.25).ceil().max(1.0);
            for t in (1..steps as i64).map(|s| s as f64 / steps) {
                self.points.push(from.lerp(to, t));
                self.along.push(d.lerp(along, t).normalize_or(d));
            }
        }
        self.points.push(to);
        self.along.push(along);
    }

    /// The same line from last to first.
    pub(super) fn reversed(mut self) -> Self {
        self.points.reverse();
        self.along.reverse();
        self.along.iter_mut().for_each(|d| *d = -*d);
        self
    }

    /// Its first or last point, and the direction out of the line there.
    fn end(&self, last: bool) -> (DVec3, DVec3) {
        let n = self.points.len();
        let few = n.min(4);
        let along = if last {
            &self.along[n - few..]
        } else {
            &self.along[..few]
        };
        let mean = along.iter().sum::<DVec3>().normalize_or(along[0]);
        match last {
            true => (self.points[n - 1], mean),
            false => (self.points[0], -mean),
        }
    }
}

/// Joins lines end to end where they go on in each other within `reach` voxels and `aside` sideways: over gaps, and where
/// fibers turn from one axis to another. Returns the lines and the number of joints.
pub(super) fn joined(lines: Vec<Line>, reach: f64, aside: f64) -> (Vec<Line>, usize) {
    let ends: Vec<(DVec3, DVec3)> = lines
        .iter()
        .flat_map(|l| [l.end(false), l.end(true)])
        .collect();
    let mut order: Vec<usize> = (0..ends.len()).collect();
    order.sort_by(|i, j| ends[*i].0.x.total_cmp(&ends[*j].0.x));
    let mut pairs = Vec::new();
    for (k, i) in order.iter().enumerate() {
        for j in &order[k + 1..] {
            if ends[*j].0.x > ends[*i].0.x + reach {
                break;
            }
            if i / 2 != j / 2
                && let Some(cost) = joint(ends[*i], ends[*j], reach, aside)
            {
                pairs.push((cost, *i.min(j), *i.max(j)));
            }
        }
    }
    pairs.sort_by(|p, q| p.0.total_cmp(&q.0).then((p.1, p.2).cmp(&(q.1, q.2))));
    let mut partner: Vec<Option<usize>> = vec![None; ends.len()];
    for (_, i, j) in pairs {
        if partner[i].is_none() && partner[j].is_none() {
            (partner[i], partner[j]) = (Some(j), Some(i));
        }
    }
    let joints = partner.iter().flatten().count() / 2;
    (chains(lines, &partner), joints)
}

/// How badly two ends fit, if they do.
fn joint(a: (DVec3, DVec3), b: (DVec3, DVec3), reach: f64, aside: f64) -> Option<f64> {
    let gap = b.0 - a.0;
    let way = (a.1 - b.1).normalize_or_zero();
    let ahead = gap.dot(way);
    let sideways = (gap - way * ahead).length();
    let fits = a.1.dot(-b.1) > 0.75 && ahead > 0.0 && ahead <= reach;
    (fits && sideways <= aside + 0.1 * ahead).then_some(sideways + 0.15 * ahead)
}

/// Follows lines from partner to partner.
fn chains(lines: Vec<Line>, partner: &[Option<usize>]) -> Vec<Line> {
    let mut lines: Vec<Option<Line>> = lines.into_iter().map(Some).collect();
    let mut found = Vec::new();
    let open = (0..partner.len()).filter(|e| partner[*e].is_none());
    // Rings have no open end: they are cut at their first line.
    for start in open.chain(0..partner.len()) {
        let mut chain: Option<Line> = None;
        let mut entered = start;
        while let Some(line) = lines[entered / 2].take() {
            let line = if entered % 2 == 0 {
                line
            } else {
                line.reversed()
            };
            match &mut chain {
                None => chain = Some(line),
                Some(chain) => {
                    for (p, d) in line.points.into_iter().zip(line.along) {
                        chain.bridge_to(p, d);
                    }
                }
            }
            match partner[entered ^ 1] {
                Some(next) => entered = next,
                None => break,
            }
        }
        found.extend(chain);
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slices(tracks: &[(DVec3, DVec3)], missing: &[(usize, usize)]) -> Vec<Vec<Center>> {
        let at = |k: usize, t: &(DVec3, DVec3)| Center {
            at: t.0 + t.1 * (k as f64 / t.1.x),
            along: t.1.normalize(),
        };
        let kept = |k: usize, i: usize| !missing.contains(&(k, i));
        (0..30)
            .map(|k| {
                let some = tracks.iter().enumerate().filter(|(i, _)| kept(k, *i));
                some.map(|(_, t)| at(k, t)).collect()
            })
            .collect()
    }

    #[test]
    fn crossing_fibers_are_not_exchanged_and_gaps_are_bridged() {
        // Two fibers that cross between two slices, each half a voxel a slice sideways: nearest in the plane is then the other one.
        // The control: with all directions along the axis they are exchanged.
        let a = (DVec3::new(0.0, 5.0, 0.0), DVec3::new(1.0, 0.5, 0.0));
        let b = (DVec3::new(0.0, 20.5, 0.0), DVec3::new(1.0, -0.5, 0.0));
        let made = slices(&[a, b], &[(8, 0), (9, 0), (20, 1)]);
        let bent = |lines: &[Line]| {
            let all = lines.iter().flat_map(|l| l.points.windows(3));
            let bends = all.map(|w| (w[0] - 2.0 * w[1] + w[2]).length());
            bends.fold(0.0, f64::max)
        };
        let lines = track(&made, 0, 1.6);
        assert_eq!(lines.len(), 2);
        assert!(lines.iter().all(|l| l.points.len() == 30));
        assert!(bent(&lines) < 1e-9);
        let mut blind = made;
        for center in blind.iter_mut().flatten() {
            center.along = DVec3::X;
        }
        assert!(bent(&track(&blind, 0, 1.6)) > 0.4);
    }

    #[test]
    fn ends_that_go_on_in_each_other_are_joined_and_others_are_not() {
        let line = |from: DVec3, to: DVec3, n: usize| {
            let mut line = Line {
                points: Vec::new(),
                along: Vec::new(),
            };
            for k in 0..n {
                line.points.push(from.lerp(to, k as f64 / (n - 1) as f64));
                line.along.push((to - from).normalize());
            }
            line
        };
        let a = line(DVec3::ZERO, DVec3::new(10.0, 0.0, 0.0), 11);
        let b = line(DVec3::new(20.0, 0.3, 0.0), DVec3::new(14.0, 0.3, 0.0), 7);
        let aside = line(DVec3::new(14.0, 3.0, 0.0), DVec3::new(20.0, 3.0, 0.0), 7);
        let across = line(DVec3::new(12.0, -4.0, 0.0), DVec3::new(12.0, 4.0, 0.0), 9);
        let (found, joints) = joined(vec![a, b, aside, across], 6.0, 0.8);
        assert_eq!((found.len(), joints), (3, 1));
        let long = found.iter().find(|l| l.points.len() > 15).unwrap();
        assert_eq!(long.points.len(), 21);
        assert!(long.points.windows(2).all(|w| w[0].distance(w[1]) < 1.1));
    }
}
