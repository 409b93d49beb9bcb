//! Shortest ways in graphs whose edges are dear to check: A* that looks at an edge only when it is about to use it.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

/// A graph of poses by number.
pub(super) trait Graph {
    /// Where one can try to go from here.
    fn neighbors(&self, node: usize) -> Vec<usize>;

    /// What the straight way costs, were it free.
    fn cost(&self, from: usize, to: usize) -> f64;

    /// Whether the straight way is free; asked once per edge at most.
    fn is_free(&mut self, from: usize, to: usize) -> bool;
}

/// The best entry is the one with the least expected cost; equal ones in order of their node.
struct Entry {
    expected: f64,
    cost: f64,
    node: usize,
    parent: usize,
}

impl Ord for Entry {
    fn cmp(&self, other: &Self) -> Ordering {
        let by_cost = other.expected.total_cmp(&self.expected);
        by_cost
            .then_with(|| other.node.cmp(&self.node))
            .then_with(|| other.parent.cmp(&self.parent))
    }
}

impl PartialOrd for Entry {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Entry {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Entry {}

/// The nodes of a cheap way from `start` to `goal`, both included; none when there is none or `most_checks` edges were
/// looked at without reaching it. `n` is the number of nodes.
pub(super) fn search(
    graph: &mut dyn Graph,
    n: usize,
    start: usize,
    goal: usize,
    most_checks: usize,
) -> Option<Vec<usize>> {
    let mut parents: Vec<Option<usize>> = vec![None; n];
    let mut open = BinaryHeap::from([Entry {
        expected: graph.cost(start, goal),
        cost: 0.0,
        node: start,
        parent: start,
    }]);
    let mut checks = 0;
    while let Some(entry) = open.pop() {
        let node = entry.node;
        if parents[node].is_some() {
            continue;
        }
        if node != start {
            checks += 1;
            if checks > most_checks {
                return None;
            }
            if !graph.is_free(entry.parent, node) {
                continue;
            }
        }
        parents[node] = Some(entry.parent);
        if node == goal {
            return Some(trace(&parents, start, goal));
        }
        for next in graph.neighbors(node) {
            if parents[next].is_none() {
                let cost = entry.cost + graph.cost(node, next);
                open.push(Entry {
                    expected: cost + graph.cost(next, goal),
                    cost,
                    node: next,
                    parent: node,
                });
            }
        }
    }
    None
}

fn trace(parents: &[Option<usize>], start: usize, goal: usize) -> Vec<usize> {
    let mut way = vec![goal];
    let mut node = goal;
    while node != start {
        let Some(parent) = parents[node] else { break };
        way.push(parent);
        node = parent;
    }
    way.reverse();
    way
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cells of a square whose walls block; straight steps only.
    struct Maze(&'static [&'static [u8]]);

    impl Maze {
        fn place(&self, node: usize) -> (i32, i32) {
            let width = self.0[0].len();
            ((node % width) as i32, (node / width) as i32)
        }
    }

    impl Graph for Maze {
        fn neighbors(&self, node: usize) -> Vec<usize> {
            let (x, y) = self.place(node);
            let (w, h) = (self.0[0].len() as i32, self.0.len() as i32);
            [(x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)]
                .into_iter()
                .filter(|(x, y)| (0..w).contains(x) && (0..h).contains(y))
                .map(|(x, y)| (y * w + x) as usize)
                .collect()
        }

        fn cost(&self, from: usize, to: usize) -> f64 {
            let ((a, b), (c, d)) = (self.place(from), self.place(to));
            f64::from((a - c).abs() + (b - d).abs())
        }

        fn is_free(&mut self, _from: usize, to: usize) -> bool {
            let (x, y) = self.place(to);
            self.0[y as usize][x as usize] != b'#'
        }
    }

    #[test]
    fn the_shortest_way_round_a_wall_is_found_and_a_closed_room_is_not_entered() {
        let mut open = Maze(&[b".#.", b".#.", b"..."]);
        let way = search(&mut open, 9, 0, 2, 1000).unwrap();
        assert_eq!(way, [0, 3, 6, 7, 8, 5, 2]);
        assert_eq!(search(&mut open, 9, 0, 2, 3), None);
        let mut closed = Maze(&[b".#.", b".#.", b".#."]);
        assert_eq!(search(&mut closed, 9, 0, 2, 1000), None);
    }
}
