//! Many events of one scattering function at once, from what a record keeps of them.
//!
//! An event is a pair of directions at a fiber. A record of paths stores it as a [`Footprint`]: a few numbers in `f32` that
//! the *model* chooses and that do not depend on parameters, so that the same footprints serve all parameter values.

use super::{CHANNELS, Scattering, fiber_direction, longitudinal_angle};
use glam::DVec3;

/// Most numbers in a footprint.
pub const MAX_COLUMNS: usize = 6;

/// What is kept of an event: the first [`BatchEvaluate::columns`] of these numbers.
pub type Footprint = [f32; MAX_COLUMNS];

/// Values and slopes of many events, one array per quantity.
#[derive(Debug, Clone, Default)]
pub struct BatchValues {
    /// `value[channel][event]`: `S`, 1/sr.
    pub value: [Vec<f32>; CHANNELS],
    /// `slope[row][channel][event]`: `dS/dt` by the model's parameter `row` (angles per radian).
    pub slope: Vec<[Vec<f32>; CHANNELS]>,
}

impl BatchValues {
    /// Makes room for `events` events, with the slopes of `rows` parameters (0: values alone).
    pub fn resize(&mut self, events: usize, rows: usize) {
        self.value.iter_mut().for_each(|v| v.resize(events, 0.0));
        self.slope.resize_with(rows, Default::default);
        let slopes = self.slope.iter_mut().flatten();
        slopes.for_each(|v| v.resize(events, 0.0));
    }
}

/// A scattering function at fixed parameters, for arrays of events.
///
/// Two kernels of the same model agree on `columns` and `footprint`, whatever their parameters.
pub trait BatchEvaluate: Send + Sync {
    /// How many numbers of a [`Footprint`] are used.
    fn columns(&self) -> usize;

    /// What to keep of an event; see [`Scattering`] for the arguments.
    fn footprint(&self, wi: DVec3, wo: DVec3, h: f64) -> Footprint;

    /// Evaluates the events whose footprints are `columns[k][event]`. `out` has been resized to them; slopes are written
    /// when it has rows for them.
    fn evaluate(&self, columns: &[&[f32]], out: &mut BatchValues);
}

/// The kernel of a model that has none of its own: [`Scattering::evaluate`] event by event, in `f64`.
///
/// Keeps both directions as angles and `h`: 5 numbers. `f32` angles carry 1e-7 rad: the relative error of a lobe of width
/// `w` is below `1e-7 / w` times the distance from its peak in widths.
pub struct OneByOne<'a>(pub &'a dyn Scattering);

impl BatchEvaluate for OneByOne<'_> {
    fn columns(&self) -> usize {
        5
    }

    fn footprint(&self, wi: DVec3, wo: DVec3, h: f64) -> Footprint {
        let angles = |w: DVec3| [longitudinal_angle(w) as f32, w.z.atan2(w.y) as f32];
        let ([theta_i, phi_i], [theta_o, phi_o]) = (angles(wi), angles(wo));
        [theta_i, phi_i, theta_o, phi_o, h as f32, 0.0]
    }

    fn evaluate(&self, columns: &[&[f32]], out: &mut BatchValues) {
        for n in 0..columns[0].len() {
            let at = |k: usize| f64::from(columns[k][n]);
            let (wi, wo) = (fiber_direction(at(0), at(1)), fiber_direction(at(2), at(3)));
            let e = self.0.evaluate(wi, wo, at(4));
            for c in 0..CHANNELS {
                out.value[c][n] = e.value[c] as f32;
                for (row, slope) in out.slope.iter_mut().enumerate() {
                    slope[c][n] = e.derivative[row][c] as f32;
                }
            }
        }
    }
}
