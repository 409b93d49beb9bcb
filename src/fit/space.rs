//! The coordinates the search moves in.
//!
//! Every flat parameter has a smooth monotone coordinate `u` in which a step of 0.1 is a moderate change anywhere in
//! its range: the logarithm for lengths of range (widths), a softened logit for fractions (colors), the fraction of the
//! range otherwise. Slopes stay finite at the bounds, so a parameter can sit on a bound and leave it again.

use super::bounds::Bounds;
use crate::base::{Error, Result};
use crate::scatter::{ParameterInfo, Parameters, Unit};

/// Softening of the logit: the slope at a bound is that of a logit this fraction of the range away from it.
const SOFTENING: f64 = 0.05;

#[derive(Debug, Clone, Copy)]
enum Scale {
    /// `u = ln v`
    Logarithm,
    /// `u = ln(t + s) - ln(1 - t + s)`, `t = (v - lower) / (upper - lower)`, `s` = [`SOFTENING`]
    SoftLogit,
    /// `u = 4 t`
    Linear,
}

#[derive(Debug, Clone, Copy)]
struct Axis {
    scale: Scale,
    lower: f64,
    upper: f64,
}

impl Axis {
    fn of(info: &ParameterInfo) -> Result<Self> {
        if !(info.lower < info.upper && info.lower.is_finite() && info.upper.is_finite()) {
            return Err(Error::new(format!(
                "parameter {}: bounds {} to {} are no range",
                info.name, info.lower, info.upper
            )));
        }
        let scale = if info.unit == Unit::One && info.lower >= 0.0 && info.upper <= 1.0 {
            Scale::SoftLogit
        } else if info.lower > 0.0 {
            Scale::Logarithm
        } else {
            Scale::Linear
        };
        Ok(Self {
            scale,
            lower: info.lower,
            upper: info.upper,
        })
    }

    fn fraction(&self, value: f64) -> f64 {
        (value - self.lower) / (self.upper - self.lower)
    }

    fn to_search(self, value: f64) -> f64 {
        match self.scale {
            Scale::Logarithm => value.ln(),
            Scale::SoftLogit => {
                let t = self.fraction(value);
                ((t + SOFTENING) / (1.0 - t + SOFTENING)).ln()
            }
            Scale::Linear => 4.0 * self.fraction(value),
        }
    }

    /// The value at `u`; never outside the bounds by rounding.
    fn to_value(self, u: f64) -> f64 {
        let value = match self.scale {
            Scale::Logarithm => u.exp(),
            Scale::SoftLogit => {
                let e = u.exp();
                let t = (e * (1.0 + SOFTENING) - SOFTENING) / (1.0 + e);
                self.lower + t * (self.upper - self.lower)
            }
            Scale::Linear => self.lower + 0.25 * u * (self.upper - self.lower),
        };
        value.clamp(self.lower, self.upper)
    }

    /// `d value / d u`.
    fn slope(self, value: f64) -> f64 {
        match self.scale {
            Scale::Logarithm => value,
            Scale::SoftLogit => {
                let t = self.fraction(value);
                (t + SOFTENING) * (1.0 - t + SOFTENING) / (1.0 + 2.0 * SOFTENING)
                    * (self.upper - self.lower)
            }
            Scale::Linear => 0.25 * (self.upper - self.lower),
        }
    }
}

/// The box of a model's parameters in search coordinates, one per flat place, and one more where a gain is searched.
#[derive(Debug, Clone)]
pub(super) struct SearchSpace {
    template: Parameters,
    axes: Vec<Axis>,
    /// Least and greatest value of each place of the model.
    ends: Vec<[f64; 2]>,
    lower: Vec<f64>,
    upper: Vec<f64>,
    /// Standard deviation of the prior of ln g, when the gain g is searched too: the last coordinate.
    gain: Option<f64>,
}

/// How many standard deviations of its prior the gain may be away from 1.
const GAIN_REACH: f64 = 5.0;

impl SearchSpace {
    /// The space of the model `template` belongs to.
    ///
    /// # Errors
    /// When a parameter has no range.
    pub(super) fn new(template: &Parameters) -> Result<Self> {
        let axes = template
            .places()
            .into_iter()
            .map(|(row, _)| Axis::of(&template.infos()[row]))
            .collect::<Result<Vec<_>>>()?;
        Ok(Self {
            template: template.clone(),
            lower: axes.iter().map(|a| a.to_search(a.lower)).collect(),
            upper: axes.iter().map(|a| a.to_search(a.upper)).collect(),
            ends: axes.iter().map(|a| [a.lower, a.upper]).collect(),
            axes,
            gain: None,
        })
    }

    /// The part of the space inside narrower bounds, in the same coordinates.
    ///
    /// # Errors
    /// When the bounds name no parameter, or leave hardly anything.
    pub(super) fn within(mut self, bounds: &Bounds) -> Result<Self> {
        self.ends = bounds.over(&self.template)?;
        for (j, (axis, [low, high])) in self.axes.iter().zip(&self.ends).enumerate() {
            self.lower[j] = axis.to_search(*low);
            self.upper[j] = axis.to_search(*high);
        }
        Ok(self)
    }

    /// The space with the logarithm of a gain as one more coordinate, with a prior of this standard deviation.
    pub(super) fn with_gain(mut self, sd: Option<f64>) -> Self {
        if let Some(sd) = sd {
            self.lower.push(-GAIN_REACH * sd);
            self.upper.push(GAIN_REACH * sd);
        }
        self.gain = sd;
        self
    }

    /// The gain's coordinate and the standard deviation of its prior, if there is one.
    pub(super) fn gain(&self) -> Option<(usize, f64)> {
        self.gain.map(|sd| (self.axes.len(), sd))
    }

    /// By what renders at `u` are multiplied.
    pub(super) fn gain_at(&self, u: &[f64]) -> f64 {
        self.gain().map_or(1.0, |(place, _)| u[place].exp())
    }

    /// Number of coordinates: the model's flat places, and the gain.
    pub(super) fn len(&self) -> usize {
        self.lower.len()
    }

    pub(super) fn lower(&self) -> &[f64] {
        &self.lower
    }

    pub(super) fn upper(&self) -> &[f64] {
        &self.upper
    }

    /// Least and greatest value of each place of the model.
    pub(super) fn ends(&self) -> &[[f64; 2]] {
        &self.ends
    }

    /// Parameter values moved inside the bounds.
    pub(super) fn inside(&self, parameters: &Parameters) -> Parameters {
        let pairs = parameters.values().iter().zip(&self.ends);
        parameters.with_values(pairs.map(|(v, [low, high])| v.clamp(*low, *high)).collect())
    }

    /// Search coordinates of parameter values moved inside the bounds, without that of a gain.
    ///
    /// # Errors
    /// When a value is outside the model's own bounds.
    pub(super) fn to_search(&self, parameters: &Parameters) -> Result<Vec<f64>> {
        let names = parameters.flat_names();
        self.axes
            .iter()
            .zip(parameters.values())
            .zip(&names)
            .enumerate()
            .map(|(j, ((axis, &value), name))| {
                // One part in 1e9 of slack: files hold degrees.
                let slack = 1e-9 * (axis.upper - axis.lower);
                if !(axis.lower - slack..=axis.upper + slack).contains(&value) {
                    return Err(Error::new(format!(
                        "start value of {name} is {value}, outside its bounds {} to {}",
                        axis.lower, axis.upper
                    ))
                    .with_hint(
                        "a fit searches inside the published bounds; angles here are in radians",
                    ));
                }
                let [low, high] = self.ends[j];
                Ok(if value <= low + slack {
                    self.lower[j]
                } else if value >= high - slack {
                    self.upper[j]
                } else {
                    axis.to_search(value)
                })
            })
            .collect()
    }

    /// Parameter values at `u`; coordinates on a side of the box give the bound exactly.
    pub(super) fn to_parameters(&self, u: &[f64]) -> Parameters {
        self.template
            .with_values((0..self.axes.len()).map(|j| self.value(j, u[j])).collect())
    }

    /// The value of the model's place `j` at its coordinate.
    pub(super) fn value(&self, j: usize, u: f64) -> f64 {
        let [low, high] = self.ends[j];
        if u <= self.lower[j] {
            low
        } else if u >= self.upper[j] {
            high
        } else {
            self.axes[j].to_value(u).clamp(low, high)
        }
    }

    /// `d value / d u` per place of the model.
    pub(super) fn slopes(&self, parameters: &Parameters) -> Vec<f64> {
        self.axes
            .iter()
            .zip(parameters.values())
            .map(|(axis, &value)| axis.slope(value))
            .collect()
    }

    /// `u` moved into the box.
    pub(super) fn clamped(&self, u: &[f64]) -> Vec<f64> {
        (0..self.len())
            .map(|j| u[j].clamp(self.lower[j], self.upper[j]))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const AXES: [Axis; 3] = [
        Axis {
            scale: Scale::Logarithm,
            lower: 0.017,
            upper: 0.8,
        },
        Axis {
            scale: Scale::SoftLogit,
            lower: 0.001,
            upper: 0.999,
        },
        Axis {
            scale: Scale::Linear,
            lower: -2.0,
            upper: 3.0,
        },
    ];

    #[test]
    fn coordinates_round_trip_and_slopes_are_their_derivatives() {
        for axis in AXES {
            for i in 0..=40 {
                let t = f64::from(i) / 40.0;
                let value = axis.lower + t * (axis.upper - axis.lower);
                let u = axis.to_search(value);
                assert!((axis.to_value(u) - value).abs() < 1e-12, "{axis:?} {value}");
                if (1..40).contains(&i) {
                    let h = 1e-5;
                    let numeric = (axis.to_value(u + h) - axis.to_value(u - h)) / (2.0 * h);
                    let slope = axis.slope(value);
                    assert!(
                        (numeric - slope).abs() < 1e-7 * slope.abs().max(1.0),
                        "{axis:?} {value}: {numeric} {slope}"
                    );
                }
            }
        }
    }
}
