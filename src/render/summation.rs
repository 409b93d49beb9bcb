//! Sums of what paths contribute, with derivatives.

use super::path::{Event, Visitor};
use crate::scatter::{CHANNELS, MAX_ROWS};

/// Sums of one lamp: value and derivatives.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sums {
    pub(super) value: [f64; CHANNELS],
    pub(super) derivative: [[f64; CHANNELS]; MAX_ROWS],
}

/// Follows paths and sums their contributions and derivatives (Khungurn 2015 eq. 11-17) by the product rule: along a path
/// the derivative of its contribution is what the scores `(dS/dt)/S` of its events make of it, but without dividing by a
/// value that may be zero. Sampling is not differentiated.
pub(super) struct Summation {
    rows: usize,
    /// `before[n]`: what the first `n` events of the present path left.
    before: Vec<Sums>,
    pub(super) lamps: Vec<Sums>,
}

impl Sums {
    const ONE: Self = Self {
        value: [1.0; CHANNELS],
        derivative: [[0.0; CHANNELS]; MAX_ROWS],
    };

    /// What is left after an event.
    fn after(&self, event: &Event<'_>, rows: usize) -> Self {
        let (mut left, e) = (*self, event.evaluation);
        for c in 0..CHANNELS {
            let carried = self.value[c] * event.factor;
            left.value[c] = carried * e.value[c];
            let weight = event.factor * e.value[c];
            for row in 0..rows {
                left.derivative[row][c] =
                    self.derivative[row][c] * weight + carried * e.derivative[row][c];
            }
        }
        left
    }

    /// What is left after an event that depends on no parameter.
    fn times(&self, weight: [f64; CHANNELS], rows: usize) -> Self {
        let mut left = *self;
        for c in 0..CHANNELS {
            left.value[c] *= weight[c];
            for row in 0..rows {
                left.derivative[row][c] *= weight[c];
            }
        }
        left
    }

    fn add(&mut self, other: &Self, rows: usize) {
        for c in 0..CHANNELS {
            self.value[c] += other.value[c];
            for row in 0..rows {
                self.derivative[row][c] += other.derivative[row][c];
            }
        }
    }
}

impl Summation {
    pub(super) fn new(rows: usize, n_lamps: usize) -> Self {
        Self {
            rows,
            before: vec![Sums::ONE],
            lamps: vec![Sums::default(); n_lamps],
        }
    }

    fn set(&mut self, depth: usize, carried: Sums) {
        match self.before.get_mut(depth) {
            Some(place) => *place = carried,
            None => self.before.push(carried),
        }
    }
}

impl Visitor for Summation {
    fn bounce(&mut self, depth: usize, event: Event<'_>) {
        let left = self.before[depth].after(&event, self.rows);
        self.set(depth + 1, left);
    }

    fn reflect(&mut self, depth: usize, weight: [f64; CHANNELS]) {
        let left = self.before[depth].times(weight, self.rows);
        self.set(depth + 1, left);
    }

    fn connect(&mut self, depth: usize, lamp: usize, event: Event<'_>) {
        let found = self.before[depth].after(&event, self.rows);
        self.lamps[lamp].add(&found, self.rows);
    }

    fn arrive(&mut self, depth: usize, lamp: usize, factor: [f64; CHANNELS]) {
        let found = self.before[depth].times(factor, self.rows);
        self.lamps[lamp].add(&found, self.rows);
    }
}
