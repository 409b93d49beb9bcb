//! Sums of recorded paths at other parameters.
//!
//! Forward along the tree goes the throughput of every node, `T = T(parent) S factor`; backward the light `L` that arrives
//! at each node from a lamp, `L(parent) += S factor L`, which at a path's start is what the path adds to the lamp's mean.
//! Then an event adds `T(parent) factor L dS/dt` to the derivative: the chain rule in reverse, so that along the tree three
//! numbers per event and lamp are carried instead of three per parameter, and nothing is divided by an `S` near zero.

use super::recorder::{Events, Page};
use super::trust::Shares;
use crate::render::summation::Sums;
use crate::scatter::{BatchEvaluate, BatchValues, CHANNELS};

/// A color in four lanes; the last means nothing.
type Color = [f32; 4];

const WHITE: Color = [1.0; 4];
const DARK: Color = [0.0; 4];

/// What a batch of recorded paths adds up to for one lamp.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct LampSums {
    pub(super) sums: Sums,
    pub(super) shares: Shares,
}

/// Evaluates pages one after another; keeps its arrays.
#[derive(Default)]
pub(super) struct Replay {
    bounces: BatchValues,
    connections: BatchValues,
    /// Per node.
    throughput: Vec<Color>,
    /// Per node, of one lamp.
    light: Vec<Color>,
    /// Per event, what is multiplied with the slopes: `[channel][event]`.
    carried: [Vec<f32>; CHANNELS],
    sorted: Sorted,
}

/// The kernels of all fibers, or of each yarn system's.
pub(super) type Kernels<'a> = &'a [Box<dyn BatchEvaluate + 'a>];

/// The events of one set of parameters, side by side for its kernel.
#[derive(Default)]
struct Sorted {
    /// Where they come from.
    places: Vec<usize>,
    columns: Vec<Vec<f32>>,
    values: BatchValues,
}

impl Sorted {
    /// `S` times the frozen factor, and slopes of `S` by the rows of all sets.
    fn evaluate(
        &mut self,
        kernels: Kernels<'_>,
        events: &Events,
        rows: usize,
        out: &mut BatchValues,
    ) {
        out.resize(events.len(), rows);
        match kernels {
            [kernel] => evaluate(&**kernel, &events.columns, out),
            _ => (0..kernels.len()).for_each(|set| self.evaluate_set(kernels, set, events, out)),
        }
        for value in &mut out.value {
            for (value, factor) in value.iter_mut().zip(&events.factor) {
                *value *= factor;
            }
        }
    }

    /// Evaluates the events of one set; by the rows of the others they have no slope.
    fn evaluate_set(
        &mut self,
        kernels: Kernels<'_>,
        set: usize,
        events: &Events,
        out: &mut BatchValues,
    ) {
        let of = |n: usize| usize::from(events.set.get(n).copied().unwrap_or(0));
        self.places.clear();
        self.places
            .extend((0..events.len()).filter(|n| of(*n) == set));
        self.columns
            .resize_with(events.columns.len(), Default::default);
        for (own, column) in self.columns.iter_mut().zip(&events.columns) {
            own.clear();
            own.extend(self.places.iter().map(|n| column[*n]));
        }
        let rows = out.slope.len() / kernels.len();
        self.values.resize(self.places.len(), rows);
        evaluate(&*kernels[set], &self.columns, &mut self.values);
        for c in 0..CHANNELS {
            put(&self.places, &self.values.value[c], &mut out.value[c]);
        }
        for (row, slope) in out.slope.iter_mut().enumerate() {
            let own = row
                .checked_sub(set * rows)
                .and_then(|r| self.values.slope.get(r));
            for c in 0..CHANNELS {
                match own {
                    Some(own) => put(&self.places, &own[c], &mut slope[c]),
                    None => self.places.iter().for_each(|n| slope[c][*n] = 0.0),
                }
            }
        }
    }
}

fn put(places: &[usize], values: &[f32], out: &mut [f32]) {
    for (place, value) in places.iter().zip(values) {
        out[*place] = *value;
    }
}

impl Replay {
    /// Adds the page to `lamps`; derivatives of `rows` parameters, or none for 0. `weights` make one brightness of the
    /// channels, per lamp.
    pub(super) fn add(
        &mut self,
        page: &Page,
        kernels: Kernels<'_>,
        rows: usize,
        weights: &[[f32; CHANNELS]],
        lamps: &mut [LampSums],
    ) {
        self.begin(page, kernels, rows);
        for (lamp, sums) in lamps.iter_mut().enumerate() {
            self.illuminate(page, lamp, kernels, rows, sums);
            let before = page.before.get(lamp);
            for (start, path) in self.light[..page.starts].iter().enumerate() {
                (0..CHANNELS).for_each(|c| sums.sums.value[c] += f64::from(path[c]));
                let x = brightness(path, &weights[lamp]);
                sums.shares.push(x, before.map_or(x, |b| b[start]));
            }
            if rows > 0 {
                self.differentiate_bounces(page, sums);
            }
        }
    }

    /// The brightness of every path of the page at every lamp.
    pub(super) fn brightness(
        &mut self,
        page: &Page,
        kernels: Kernels<'_>,
        weights: &[[f32; CHANNELS]],
    ) -> Vec<Vec<f32>> {
        self.begin(page, kernels, 0);
        let one = |(lamp, weights): (usize, &[f32; CHANNELS])| {
            self.illuminate(page, lamp, kernels, 0, &mut LampSums::default());
            let starts = &self.light[..page.starts];
            starts
                .iter()
                .map(|path| brightness(path, weights))
                .collect()
        };
        weights.iter().enumerate().map(one).collect()
    }

    fn begin(&mut self, page: &Page, kernels: Kernels<'_>, rows: usize) {
        (self.sorted).evaluate(kernels, &page.bounces, rows, &mut self.bounces);
        for &(node, weight) in &page.reflections {
            for c in 0..CHANNELS {
                self.bounces.value[c][node as usize] = weight[c];
            }
        }
        self.forward(page);
    }

    /// The light of one lamp at every node, and the derivatives of the side branches.
    fn illuminate(
        &mut self,
        page: &Page,
        lamp: usize,
        kernels: Kernels<'_>,
        rows: usize,
        sums: &mut LampSums,
    ) {
        self.light.clear();
        self.light.resize(self.throughput.len(), DARK);
        self.connect(&page.connections[lamp], kernels, rows, sums);
        for &(parent, factor) in &page.arrivals[lamp] {
            let light = &mut self.light[parent as usize];
            (0..CHANNELS).for_each(|c| light[c] += factor[c]);
        }
        self.backward(page);
    }

    fn forward(&mut self, page: &Page) {
        self.throughput.clear();
        self.throughput.resize(page.starts, WHITE);
        self.throughput.reserve(page.bounces.len());
        let value = self
            .bounces
            .value
            .each_ref()
            .map(|v| &v[..page.bounces.len()]);
        for (b, &parent) in page.bounces.parent.iter().enumerate() {
            let before = self.throughput[parent as usize];
            let after = [
                before[0] * value[0][b],
                before[1] * value[1][b],
                before[2] * value[2][b],
                0.0,
            ];
            self.throughput.push(after);
        }
    }

    /// Light and derivatives of the side branches to one lamp.
    fn connect(&mut self, events: &Events, kernels: Kernels<'_>, rows: usize, sums: &mut LampSums) {
        (self.sorted).evaluate(kernels, events, rows, &mut self.connections);
        let value = self
            .connections
            .value
            .each_ref()
            .map(|v| &v[..events.len()]);
        for (e, &parent) in events.parent.iter().enumerate() {
            let light = &mut self.light[parent as usize];
            (0..CHANNELS).for_each(|c| light[c] += value[c][e]);
        }
        if rows > 0 {
            self.carried.iter_mut().for_each(Vec::clear);
            for (&parent, factor) in events.parent.iter().zip(&events.factor) {
                let throughput = &self.throughput[parent as usize];
                (0..CHANNELS).for_each(|c| self.carried[c].push(throughput[c] * factor));
            }
            add_slopes(&self.carried, &self.connections, sums);
        }
    }

    fn backward(&mut self, page: &Page) {
        let (starts, n) = (page.starts, page.bounces.len());
        let value = self.bounces.value.each_ref().map(|v| &v[..n]);
        let light = &mut self.light[..starts + n];
        for (b, &parent) in page.bounces.parent.iter().enumerate().rev() {
            let branch = light[starts + b];
            let trunk = &mut light[parent as usize];
            (0..CHANNELS).for_each(|c| trunk[c] += value[c][b] * branch[c]);
        }
    }

    fn differentiate_bounces(&mut self, page: &Page, sums: &mut LampSums) {
        let light = &self.light[page.starts..];
        self.carried.iter_mut().for_each(Vec::clear);
        let events = page.bounces.parent.iter().zip(&page.bounces.factor);
        for ((&parent, factor), light) in events.zip(light) {
            let throughput = &self.throughput[parent as usize];
            (0..CHANNELS).for_each(|c| self.carried[c].push(throughput[c] * factor * light[c]));
        }
        add_slopes(&self.carried, &self.bounces, sums);
    }
}

fn add_slopes(carried: &[Vec<f32>; CHANNELS], values: &BatchValues, sums: &mut LampSums) {
    for (slope, sum) in values.slope.iter().zip(&mut sums.sums.derivative) {
        for c in 0..CHANNELS {
            sum[c] += dot(&carried[c], &slope[c]);
        }
    }
}

fn brightness(light: &Color, weights: &[f32; CHANNELS]) -> f32 {
    light[0] * weights[0] + light[1] * weights[1] + light[2] * weights[2]
}

/// `S` and its slopes.
fn evaluate(kernel: &dyn BatchEvaluate, columns: &[Vec<f32>], out: &mut BatchValues) {
    let columns: Vec<&[f32]> = columns.iter().map(Vec::as_slice).collect();
    if !columns[0].is_empty() {
        kernel.evaluate(&columns, out);
    }
}

/// Scalar product, in 16 sums of `f32` side by side: pages are short.
fn dot(a: &[f32], b: &[f32]) -> f64 {
    let mut sums = [0.0_f32; 16];
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<16>(), b.as_chunks::<16>());
    for (a, b) in a.iter().zip(b) {
        for l in 0..16 {
            sums[l] += a[l] * b[l];
        }
    }
    let rest: f32 = a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum();
    sums.iter().map(|&s| f64::from(s)).sum::<f64>() + f64::from(rest)
}
