//! Sums of what paths contribute, with derivatives.

use super::path::{Event, Visitor};
use crate::scatter::{CHANNELS, MAX_DERIVATIVES, Parametric};

/// Sums of one lamp: value and derivatives.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sums {
    pub(super) value: [f64; CHANNELS],
    pub(super) derivative: [[f64; CHANNELS]; MAX_DERIVATIVES],
}

/// Follows paths and sums their contributions and derivatives (Khungurn 2015 eq. 11-17) by the product rule: along a path
/// the derivative of its contribution is what the scores `(dS/dt)/S` of its events make of it, but without dividing by a
/// value that may be zero. Sampling is not differentiated. An event's own derivatives belong to the rows of its fiber's set of
/// parameters.
pub(super) struct Summation {
    rows: Rows,
    /// `before[n]`: what the first `n` events of the present path left.
    before: Vec<Sums>,
    /// What the latest event brought to a lamp.
    found: Sums,
    pub(super) lamps: Vec<Sums>,
}

/// How many derivatives there are.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rows {
    /// Of all sets of parameters.
    pub(super) all: usize,
    /// Of each set; those of set `k` begin at `k * own`.
    pub(super) own: usize,
}

impl Rows {
    /// The rows of `model`, where each of its sets has a scattering function.
    pub(super) fn of(model: &dyn Parametric) -> Self {
        let all = model.parameters().len();
        let own = all / model.systems().len().max(1);
        Self { all, own }
    }

    /// Values alone.
    pub(super) const NONE: Self = Self { all: 0, own: 0 };
}

impl Sums {
    const ONE: Self = Self {
        value: [1.0; CHANNELS],
        derivative: [[0.0; CHANNELS]; MAX_DERIVATIVES],
    };

    /// Makes `left` what is left after an event; rows past `rows` mean nothing.
    fn after(&self, event: &Event<'_>, rows: Rows, left: &mut Self) {
        let e = event.evaluation;
        let carried = self.value.map(|v| v * event.factor);
        let weight = e.value.map(|v| event.factor * v);
        left.value = std::array::from_fn(|c| carried[c] * e.value[c]);
        for (left, before) in left.derivative.iter_mut().zip(&self.derivative[..rows.all]) {
            *left = std::array::from_fn(|c| before[c] * weight[c]);
        }
        let own = &mut left.derivative[event.set * rows.own..][..rows.own];
        for (left, derivative) in own.iter_mut().zip(&e.derivative) {
            (0..CHANNELS).for_each(|c| left[c] += carried[c] * derivative[c]);
        }
    }

    /// Makes `left` what is left after an event that depends on no parameter; rows past `rows` mean nothing.
    fn times(&self, weight: [f64; CHANNELS], rows: Rows, left: &mut Self) {
        left.value = std::array::from_fn(|c| self.value[c] * weight[c]);
        for (left, before) in left.derivative.iter_mut().zip(&self.derivative[..rows.all]) {
            *left = std::array::from_fn(|c| before[c] * weight[c]);
        }
    }

    fn add(&mut self, other: &Self, rows: Rows) {
        (0..CHANNELS).for_each(|c| self.value[c] += other.value[c]);
        for (sum, other) in self
            .derivative
            .iter_mut()
            .zip(&other.derivative[..rows.all])
        {
            (0..CHANNELS).for_each(|c| sum[c] += other[c]);
        }
    }
}

impl Summation {
    pub(super) fn new(rows: Rows, n_lamps: usize) -> Self {
        Self {
            rows,
            before: vec![Sums::ONE],
            found: Sums::default(),
            lamps: vec![Sums::default(); n_lamps],
        }
    }

    /// What the first `depth` events left, and the place for what the next one leaves.
    fn step(&mut self, depth: usize) -> (&Sums, &mut Sums) {
        if self.before.len() == depth + 1 {
            self.before.push(Sums::default());
        }
        let (before, after) = self.before.split_at_mut(depth + 1);
        (&before[depth], &mut after[0])
    }
}

impl Visitor for Summation {
    fn bounce(&mut self, depth: usize, event: Event<'_>) {
        let rows = self.rows;
        let (before, left) = self.step(depth);
        before.after(&event, rows, left);
    }

    fn reflect(&mut self, depth: usize, weight: [f64; CHANNELS]) {
        let rows = self.rows;
        let (before, left) = self.step(depth);
        before.times(weight, rows, left);
    }

    fn connect(&mut self, depth: usize, lamp: usize, event: Event<'_>) {
        self.before[depth].after(&event, self.rows, &mut self.found);
        self.lamps[lamp].add(&self.found, self.rows);
    }

    fn arrive(&mut self, depth: usize, lamp: usize, factor: [f64; CHANNELS]) {
        self.before[depth].times(factor, self.rows, &mut self.found);
        self.lamps[lamp].add(&self.found, self.rows);
    }
}
