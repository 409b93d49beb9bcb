//! Sums of what paths contribute, with derivatives.

use super::path::{Event, Visitor};
use crate::scatter::{CHANNELS, Evaluation, MAX_ROWS};

/// Sums of one lamp: value and derivatives.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sums {
    pub(super) value: [f64; CHANNELS],
    pub(super) derivative: [[f64; CHANNELS]; MAX_ROWS],
}

/// Follows paths and sums their contributions and scores (Khungurn 2015 eq. 11-17): along a path the derivative of its
/// contribution is the contribution times the sum of `(dS/dt)/S` over its events; sampling is not differentiated.
pub(super) struct Summation {
    rows: usize,
    /// `before[n]`: what the first `n` events of the present path left.
    before: Vec<Carried>,
    pub(super) lamps: Vec<Sums>,
}

/// What a path has gathered on its way.
#[derive(Debug, Clone, Copy)]
struct Carried {
    throughput: [f64; CHANNELS],
    score: [[f64; CHANNELS]; MAX_ROWS],
}

impl Summation {
    pub(super) fn new(rows: usize, n_lamps: usize) -> Self {
        Self {
            rows,
            before: vec![Carried {
                throughput: [1.0; CHANNELS],
                score: [[0.0; CHANNELS]; MAX_ROWS],
            }],
            lamps: vec![Sums::default(); n_lamps],
        }
    }

    fn set(&mut self, depth: usize, carried: Carried) {
        match self.before.get_mut(depth) {
            Some(place) => *place = carried,
            None => self.before.push(carried),
        }
    }
}

/// `(dS/dt)/S`; where `S` underflows to zero the path carries nothing and the score is taken as zero.
fn score(evaluation: &Evaluation, row: usize, channel: usize) -> f64 {
    let value = evaluation.value[channel];
    if value > 0.0 {
        evaluation.derivative[row][channel] / value
    } else {
        0.0
    }
}

impl Visitor for Summation {
    fn bounce(&mut self, depth: usize, event: Event<'_>) {
        let mut carried = self.before[depth];
        for c in 0..CHANNELS {
            carried.throughput[c] *= event.weight[c];
            for row in 0..self.rows {
                carried.score[row][c] += score(event.evaluation, row, c);
            }
        }
        self.set(depth + 1, carried);
    }

    fn reflect(&mut self, depth: usize, weight: [f64; CHANNELS]) {
        let mut carried = self.before[depth];
        for c in 0..CHANNELS {
            carried.throughput[c] *= weight[c];
        }
        self.set(depth + 1, carried);
    }

    fn connect(&mut self, depth: usize, lamp: usize, event: Event<'_>) {
        let (sums, carried) = (&mut self.lamps[lamp], &self.before[depth]);
        for c in 0..CHANNELS {
            let contribution = carried.throughput[c] * event.weight[c];
            sums.value[c] += contribution;
            for row in 0..self.rows {
                sums.derivative[row][c] +=
                    contribution * (carried.score[row][c] + score(event.evaluation, row, c));
            }
        }
    }

    fn arrive(&mut self, depth: usize, lamp: usize, factor: [f64; CHANNELS]) {
        let (sums, carried) = (&mut self.lamps[lamp], &self.before[depth]);
        for c in 0..CHANNELS {
            let contribution = carried.throughput[c] * factor[c];
            sums.value[c] += contribution;
            for row in 0..self.rows {
                sums.derivative[row][c] += contribution * carried.score[row][c];
            }
        }
    }
}
