//! The order of poses with little travel: the best one for a few, a good one with a bound for many.
//!
//! Up to [`EXACT_UP_TO`] poses by dynamic programming over sets (Held and Karp 1962). Above, the nearest neighbor first,
//! then turning and shifting of pieces; how far that may be from the best is told by a lower bound: a Hamiltonian path is a
//! spanning tree, and weights on the poses make the cheapest tree resemble a path (Held and Karp 1970).

use super::description::RigDescription;
use super::kinematics::AxisAngles;
use crate::base::{Error, Result};
use crate::math::Random;
use rayon::prelude::*;

/// An order of poses.
#[derive(Debug, Clone, PartialEq)]
pub struct Tour {
    /// Indices of the poses, in the order to visit them.
    pub order: Vec<usize>,
    /// What it costs, from the start over all poses to the end.
    pub seconds: f64,
    /// No order costs less than this; equal to `seconds` when the order is known to be the best.
    pub lower_bound: f64,
}

/// The largest number of poses whose best order is found for sure.
pub const EXACT_UP_TO: usize = 16;

/// A cheap order to visit poses in: `costs[i][k]` seconds from pose i to pose k, `start_costs[i]` from the start to pose
/// i, `end_costs[i]` from pose i to the end. An infinite cost bars a way; `seconds` is infinite when every order found
/// uses a barred way.
///
/// # Errors
/// The lengths differ, or a cost is negative or not a number.
pub fn tour(costs: &[Vec<f64>], start_costs: &[f64], end_costs: &[f64]) -> Result<Tour> {
    let n = costs.len();
    let lengths = costs.iter().map(Vec::len);
    if lengths
        .chain([start_costs.len(), end_costs.len()])
        .any(|l| l != n)
    {
        return Err(Error::new(format!(
            "costs of a tour must be {n} rows of {n}, and {n} from the start and to the end"
        )));
    }
    let all = costs.iter().flatten().chain(start_costs).chain(end_costs);
    if let Some(bad) = all.clone().find(|c| c.is_nan() || **c < 0.0) {
        return Err(Error::new(format!(
            "a cost of a tour is {bad}, expected zero or more"
        )));
    }
    // Barred ways cost more than any order without them.
    let most: f64 = all.copied().filter(|c| c.is_finite()).fold(0.0, f64::max);
    let barred = (most + 1.0) * (n + 1) as f64;
    let plain = |c: &f64| if c.is_finite() { *c } else { barred };
    let table = Table {
        between: costs
            .iter()
            .map(|row| row.iter().map(plain).collect())
            .collect(),
        start: start_costs.iter().map(plain).collect(),
        end: end_costs.iter().map(plain).collect(),
    };
    let exact = n <= EXACT_UP_TO;
    let order = if exact { table.best() } else { table.good() };
    let found = table.seconds(&order);
    let lower_bound = if exact {
        found
    } else {
        table.bound(found).min(found)
    };
    let open = |seconds: f64| {
        if seconds >= barred {
            f64::INFINITY
        } else {
            seconds
        }
    };
    Ok(Tour {
        order,
        seconds: open(found),
        lower_bound: open(lower_bound),
    })
}

impl RigDescription {
    /// The order to visit poses in, from `start` and at last to `end` when there is one; costs are the seconds of
    /// [`RigDescription::path`] and of settling. Exposures do not depend on the order and do not count.
    ///
    /// # Errors
    /// A pose cannot be stood at, or no order has a free way.
    pub fn order(
        &self,
        poses: &[AxisAngles],
        start: &AxisAngles,
        end: Option<&AxisAngles>,
    ) -> Result<Tour> {
        for pose in poses.iter().chain(end) {
            self.check_angles(pose)?;
            self.check_pose_clearance(pose)?;
        }
        let cost = |from: &AxisAngles, to: &AxisAngles| -> Result<f64> {
            let legs = self.path(from, to)?;
            Ok(self.legs_seconds(from, &legs, None) + self.settle_ms_after(from, &legs) / 1000.0)
        };
        let to_all = |from: &AxisAngles| -> Vec<Result<f64>> {
            poses.iter().map(|to| cost(from, to)).collect()
        };
        let mut rows: Vec<Vec<Result<f64>>> = poses.par_iter().map(to_all).collect();
        rows.push(to_all(start));
        rows.push(
            poses
                .par_iter()
                .map(|from| end.map_or(Ok(0.0), |end| cost(from, end)))
                .collect(),
        );
        let mut reason = None;
        let mut costs: Vec<Vec<f64>> = rows
            .into_iter()
            .map(|row| {
                let open = |c: Result<f64>| {
                    c.unwrap_or_else(|error| {
                        reason.get_or_insert(error);
                        f64::INFINITY
                    })
                };
                row.into_iter().map(open).collect()
            })
            .collect();
        let end_costs = costs.pop().unwrap_or_default();
        let start_costs = costs.pop().unwrap_or_default();
        let found = tour(&costs, &start_costs, &end_costs)?;
        match reason {
            Some(error) if found.seconds.is_infinite() => {
                Err(Error::new("no order of the poses has a free way").with_source(error))
            }
            _ => Ok(found),
        }
    }
}

/// Finite costs.
struct Table {
    between: Vec<Vec<f64>>,
    start: Vec<f64>,
    end: Vec<f64>,
}

impl Table {
    fn n(&self) -> usize {
        self.between.len()
    }

    /// From one place to the next of an order; none stands for the start as well as for the end.
    fn step(&self, from: Option<&usize>, to: Option<&usize>) -> f64 {
        match (from, to) {
            (Some(&a), Some(&b)) => self.between[a][b],
            (None, Some(&b)) => self.start[b],
            (Some(&a), None) => self.end[a],
            (None, None) => 0.0,
        }
    }

    fn seconds(&self, order: &[usize]) -> f64 {
        let inner: f64 = order.windows(2).map(|w| self.between[w[0]][w[1]]).sum();
        inner + self.step(None, order.first()) + self.step(order.last(), None)
    }

    /// The best order: for every set of poses and every last one of it, the cheapest way through the set.
    fn best(&self) -> Vec<usize> {
        let n = self.n();
        if n == 0 {
            return Vec::new();
        }
        let sets = 1_usize << n;
        let mut least = vec![f64::INFINITY; sets * n];
        let mut before = vec![0_u8; sets * n];
        for last in 0..n {
            least[(1 << last) * n + last] = self.start[last];
        }
        for set in 1..sets {
            for last in (0..n).filter(|k| set & (1 << k) != 0) {
                let so_far = least[set * n + last];
                for next in (0..n).filter(|k| set & (1 << k) == 0) {
                    let slot = (set | 1 << next) * n + next;
                    let cost = so_far + self.between[last][next];
                    if cost < least[slot] {
                        least[slot] = cost;
                        before[slot] = last as u8;
                    }
                }
            }
        }
        let mut set = sets - 1;
        let whole = |k: &usize| least[set * n + k] + self.end[*k];
        let mut last = (0..n)
            .min_by(|a, b| whole(a).total_cmp(&whole(b)))
            .unwrap_or(0);
        let mut order = vec![last];
        while order.len() < n {
            let previous = before[set * n + last] as usize;
            set &= !(1 << last);
            last = previous;
            order.push(last);
        }
        order.reverse();
        order
    }

    /// A good order: nearest neighbors, improved, then shaken a few times and improved again.
    fn good(&self) -> Vec<usize> {
        let n = self.n();
        let mut best = self.nearest_neighbors();
        self.improve(&mut best);
        let mut least = self.seconds(&best);
        let mut random = Random::keyed(&[n as u64]);
        for _ in 0..(2_000_000 / (n * n)).min(300) {
            let mut cuts: [usize; 3] =
                std::array::from_fn(|_| 1 + (random.uniform() * (n - 1) as f64) as usize);
            cuts.sort_unstable();
            let [a, b, c] = cuts;
            // Two neighboring pieces change places: no turning of pieces undoes that.
            let mut order = [&best[..a], &best[b..c], &best[a..b], &best[c..]].concat();
            self.improve(&mut order);
            let seconds = self.seconds(&order);
            if seconds < least {
                (best, least) = (order, seconds);
            }
        }
        best
    }

    fn nearest_neighbors(&self) -> Vec<usize> {
        let mut left: Vec<usize> = (0..self.n()).collect();
        let mut order: Vec<usize> = Vec::new();
        while !left.is_empty() {
            let from = order.last().copied();
            let cost = |k: &usize| self.step(from.as_ref(), Some(k));
            let nearest = (0..left.len())
                .min_by(|&a, &b| cost(&left[a]).total_cmp(&cost(&left[b])))
                .unwrap_or(0);
            order.push(left.swap_remove(nearest));
        }
        order
    }

    /// Turns pieces round and shifts short ones for as long as that saves time.
    fn improve(&self, order: &mut Vec<usize>) {
        for _ in 0..1_000 {
            if !self.turn_pieces(order) && !self.shift_pieces(order) {
                return;
            }
        }
    }

    fn turn_pieces(&self, order: &mut [usize]) -> bool {
        let mut improved = false;
        for i in 0..order.len() {
            // Costs inside the piece, forward and backward.
            let (mut forward, mut backward) = (0.0, 0.0);
            for j in i + 1..order.len() {
                forward += self.between[order[j - 1]][order[j]];
                backward += self.between[order[j]][order[j - 1]];
                let before = i.checked_sub(1).and_then(|k| order.get(k));
                let after = order.get(j + 1);
                let now = self.step(before, Some(&order[i]))
                    + forward
                    + self.step(Some(&order[j]), after);
                let then = self.step(before, Some(&order[j]))
                    + backward
                    + self.step(Some(&order[i]), after);
                if then < now - 1e-9 {
                    order[i..=j].reverse();
                    std::mem::swap(&mut forward, &mut backward);
                    improved = true;
                }
            }
        }
        improved
    }

    fn shift_pieces(&self, order: &mut Vec<usize>) -> bool {
        let n = order.len();
        let mut improved = false;
        for length in 1..=3.min(n - 1) {
            for i in 0..=n - length {
                let rest = [&order[..i], &order[i + length..]].concat();
                let piece = &order[i..i + length];
                let turned: Vec<usize> = piece.iter().rev().copied().collect();
                let put = |at: usize, piece: &[usize]| {
                    let before = at.checked_sub(1).and_then(|k| rest.get(k));
                    let after = rest.get(at);
                    let inner: f64 = piece.windows(2).map(|w| self.between[w[0]][w[1]]).sum();
                    self.step(before, piece.first()) + inner + self.step(piece.last(), after)
                        - self.step(before, after)
                };
                let mut least = put(i, piece) - 1e-9;
                let mut better = None;
                for at in 0..=rest.len() {
                    for candidate in [piece, &turned] {
                        let cost = put(at, candidate);
                        if cost < least {
                            least = cost;
                            better = Some((at, candidate.to_vec()));
                        }
                    }
                }
                if let Some((at, candidate)) = better {
                    *order = [&rest[..at], &candidate, &rest[at..]].concat();
                    improved = true;
                }
            }
        }
        improved
    }

    /// A cost no order can beat, from the cost of a known one.
    fn bound(&self, known: f64) -> f64 {
        let n = self.n();
        // Nodes 0..n are the poses, n the start, n + 1 the end; start and end have one neighbor in a path, poses two.
        let cost = |a: usize, b: usize| -> f64 {
            let (a, b) = (a.min(b), a.max(b));
            match (a, b) {
                (a, b) if b < n => self.between[a][b].min(self.between[b][a]),
                (a, b) if a < n && b == n => self.start[a],
                (a, _) if a < n => self.end[a],
                _ => f64::INFINITY,
            }
        };
        let wanted = |k: usize| if k < n { 2.0 } else { 1.0 };
        let mut weights = vec![0.0; n + 2];
        let (mut best, mut stride, mut idle) = (0.0_f64, 1.0, 0);
        for _ in 0..400 {
            let (tree, degrees) = spanning_tree(n + 2, |a, b| cost(a, b) + weights[a] + weights[b]);
            let excess: Vec<f64> = (0..n + 2).map(|k| degrees[k] - wanted(k)).collect();
            let bound = tree - (0..n + 2).map(|k| weights[k] * wanted(k)).sum::<f64>();
            idle += 1;
            if bound > best {
                (best, idle) = (bound, 0);
            }
            let norm: f64 = excess.iter().map(|e| e * e).sum();
            if norm < 0.5 {
                break;
            }
            if idle > 10 {
                (stride, idle) = (stride * 0.7, 0);
            }
            let step = stride * (known - bound).max(1e-6 * known) / norm;
            for (w, e) in weights.iter_mut().zip(&excess) {
                *w += step * e;
            }
        }
        // Rounding must not turn a bound into a claim.
        best * (1.0 - 1e-12)
    }
}

/// Cost of the cheapest spanning tree and the number of neighbors of each node in it (Prim).
fn spanning_tree(n: usize, cost: impl Fn(usize, usize) -> f64) -> (f64, Vec<f64>) {
    let mut degrees = vec![0.0; n];
    let mut nearest: Vec<(f64, usize)> = (0..n).map(|k| (cost(0, k), 0)).collect();
    let mut outside: Vec<usize> = (1..n).collect();
    let mut total = 0.0;
    while !outside.is_empty() {
        let next = (0..outside.len())
            .min_by(|&a, &b| nearest[outside[a]].0.total_cmp(&nearest[outside[b]].0))
            .unwrap_or(0);
        let node = outside.swap_remove(next);
        let (way, parent) = nearest[node];
        total += way;
        degrees[node] += 1.0;
        degrees[parent] += 1.0;
        for &k in &outside {
            let way = cost(node, k);
            if way < nearest[k].0 {
                nearest[k] = (way, node);
            }
        }
    }
    (total, degrees)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn random_table(n: usize, random: &mut Random) -> Table {
        let places: Vec<[f64; 2]> = (0..n + 2)
            .map(|_| [random.uniform(), random.uniform()])
            .collect();
        // Hardly symmetric: one way costs up to a tenth more than the other.
        let mut cost = |a: usize, b: usize| {
            let (p, q) = (places[a], places[b]);
            (p[0] - q[0]).hypot(p[1] - q[1]) * (1.0 + 0.1 * random.uniform())
        };
        Table {
            between: (0..n)
                .map(|a| (0..n).map(|b| cost(a, b)).collect())
                .collect(),
            start: (0..n).map(|b| cost(n, b)).collect(),
            end: (0..n).map(|a| cost(a, n + 1)).collect(),
        }
    }

    #[test]
    fn the_good_order_lies_between_the_bound_and_a_tenth_above_the_best() {
        let mut random = Random::keyed(&[2015, 72]);
        for case in 0..60 {
            let table = random_table(5 + case % 9, &mut random);
            let good = table.seconds(&table.good());
            let best = table.seconds(&table.best());
            let bound = table.bound(good);
            assert!(bound <= best + 1e-9, "case {case}: {bound} {best} {good}");
            assert!(bound >= 0.85 * best, "case {case}: {bound} {best} {good}");
            assert!(
                best <= good + 1e-9 && good <= 1.1 * best,
                "case {case}: {bound} {best} {good}"
            );
        }
    }
}
