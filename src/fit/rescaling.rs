//! The search parameters of the published descent: every parameter stretched by how much it changes the renders
//! (Khungurn 2015 sec. 5.5).
//!
//! With the other parameters at the model's defaults, the means are rendered at knots `c_1 < ... < c_k` across the range
//! of parameter p, and
//! ```text
//! r_p(c_1) = 0,    r_p(c_{j+1}) - r_p(c_j) = sum_i sqrt(w_i f_image(R_j(i), R_{j+1}(i)))        (eq. 22, 23)
//! ```
//! linear in between. A color moves all its channels together, and each channel then has `r_p / 3`. The place of the
//! root and of the weights in eq. 23 is a reconstruction, and so are the knots: the paper says only toward which bound
//! they are finer. Every knot is rendered twice and `f_image` is the product of the two renders' differences, so that
//! noise alone adds little to `r_p`; a negative product counts as zero, and no increment is less than a share of the
//! whole, so that the inverse exists. The slope jumps at knots, which a descent does not mind.

use super::gradient::Walk;
use super::objective::{NumberWeights, RenderPair};
use crate::base::Result;
use crate::scatter::{CHANNELS, ParameterInfo, Parameters};

/// Parameters whose effect grows toward the upper bound; all others are finer toward the lower bound.
const FINE_AT_UPPER_BOUND: [&str; 3] = ["c_tt", "alpha", "color"];
/// Pair indices of the knots begin here.
const KNOT_INDEX: u64 = 2 << 32;

/// How the differences of images between two knots make one increment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Increment {
    /// `sum_i sqrt(w_i f_image)`, as eq. 23 is read here.
    #[default]
    SumOfRoots,
    /// `sqrt(sum_i w_i f_image)`, the other reading.
    RootOfSum,
}

/// What the paper leaves open about the rescaling.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RescalingOptions {
    /// Knots per parameter: nine (Khungurn 2015 sec. 5.5).
    pub knots: u32,
    /// Knot j of k lies `((j - 1) / (k - 1))^power` of the range from the bound where knots are finer: 2.
    pub power: f64,
    /// Reading of eq. 23.
    pub increment: Increment,
    /// Least increment, as a share of all increments of the parameter: 0.001.
    pub smallest: f64,
}

impl Default for RescalingOptions {
    fn default() -> Self {
        Self {
            knots: 9,
            power: 2.0,
            increment: Increment::default(),
            smallest: 1e-3,
        }
    }
}

/// One parameter's piecewise linear map from values to search parameters.
#[derive(Debug, Clone, PartialEq)]
struct Curve {
    values: Vec<f64>,
    positions: Vec<f64>,
}

impl Curve {
    /// The curve through `values` (ascending) with these increments of the search parameter, each over `divisor`.
    fn new(values: Vec<f64>, increments: &[f64], smallest: f64, divisor: f64) -> Self {
        let total: f64 = increments.iter().sum();
        let mut positions = vec![0.0];
        for increment in increments {
            // A parameter that changes nothing may as well be linear.
            let raised = if total > 0.0 {
                increment.max(smallest * total)
            } else {
                1.0 / increments.len() as f64
            };
            positions.push(positions[positions.len() - 1] + raised / divisor);
        }
        Self { values, positions }
    }

    /// The piece of `at` among ascending `ends`, by its lower end.
    fn piece(ends: &[f64], at: f64) -> usize {
        let inner = &ends[1..ends.len() - 1];
        inner.partition_point(|end| *end <= at)
    }

    fn to_position(&self, value: f64) -> f64 {
        if value >= self.values[self.values.len() - 1] {
            return self.length();
        }
        let j = Self::piece(&self.values, value);
        self.positions[j] + (value - self.values[j]) / self.slope_of(j)
    }

    fn to_value(&self, position: f64) -> f64 {
        let j = Self::piece(&self.positions, position);
        let value = self.values[j] + (position - self.positions[j]) * self.slope_of(j);
        value.clamp(self.values[0], self.values[self.values.len() - 1])
    }

    /// `d value / d position`; at a knot that of the piece above.
    fn slope(&self, position: f64) -> f64 {
        self.slope_of(Self::piece(&self.positions, position))
    }

    fn slope_of(&self, j: usize) -> f64 {
        (self.values[j + 1] - self.values[j]) / (self.positions[j + 1] - self.positions[j])
    }

    fn length(&self) -> f64 {
        self.positions[self.positions.len() - 1]
    }
}

/// The map of all parameters, one curve per flat place.
#[derive(Debug, Clone)]
pub(super) struct Rescaling {
    curves: Vec<Curve>,
    /// Least and greatest value of each place.
    ends: Vec<[f64; 2]>,
}

impl Rescaling {
    /// Renders the knots of every parameter; `None` when the budget ended or the fit was interrupted.
    ///
    /// # Errors
    /// When the scene fails.
    pub(super) fn render(walk: &mut Walk<'_>, options: &RescalingOptions) -> Result<Option<Self>> {
        let problem = walk.problem;
        let defaults = Parameters::defaults(problem.scene.model());
        let mut curves = Vec::new();
        let ends = problem.space.ends();
        for (row, info) in defaults.infos().iter().enumerate() {
            // A color's channels move together, each as far as its own bounds let it.
            let own = || (0..info.len()).map(|c| ends[defaults.slot(row, c)]);
            let whole = ParameterInfo {
                lower: own().fold(f64::INFINITY, |low, [l, _]| low.min(l)),
                upper: own().fold(f64::NEG_INFINITY, |high, [_, h]| high.max(h)),
                ..*info
            };
            let values = knots(&whole, options);
            let mut renders = Vec::new();
            for (j, value) in values.iter().enumerate() {
                let mut flat = defaults.values().to_vec();
                (0..CHANNELS).for_each(|c| flat[defaults.slot(row, c)] = *value);
                let u = problem.space.to_search(&defaults.with_values(flat))?;
                let index = KNOT_INDEX + ((row as u64) << 16) + j as u64;
                match walk.render(&u, 1.0, index)? {
                    Some(pair) => renders.push(means(&pair)),
                    None => return Ok(None),
                }
            }
            let weights = problem.objective.weights();
            let increments: Vec<f64> = renders
                .windows(2)
                .map(|w| increment(weights, &w[0], &w[1], options.increment))
                .collect();
            let curve = Curve::new(values, &increments, options.smallest, info.len() as f64);
            curves.extend(std::iter::repeat_n(curve, info.len()));
        }
        let ends = ends.to_vec();
        Ok(Some(Self { curves, ends }))
    }

    /// Search parameters of values inside their bounds.
    pub(super) fn to_search(&self, values: &[f64]) -> Vec<f64> {
        let pairs = self.curves.iter().zip(values);
        pairs.map(|(curve, v)| curve.to_position(*v)).collect()
    }

    /// Values at search parameters `s`.
    pub(super) fn to_values(&self, s: &[f64]) -> Vec<f64> {
        let pairs = self.curves.iter().zip(s);
        pairs.map(|(curve, s)| curve.to_value(*s)).collect()
    }

    /// `d value / d s` per place.
    pub(super) fn slopes(&self, s: &[f64]) -> Vec<f64> {
        let pairs = self.curves.iter().zip(s);
        pairs.map(|(curve, s)| curve.slope(*s)).collect()
    }

    /// `s` moved into the box: `0 .. r_p(c_k)`, of a color each channel's part of it.
    pub(super) fn projected(&self, s: &[f64]) -> Vec<f64> {
        let pairs = self.curves.iter().zip(&self.ends).zip(s);
        pairs
            .map(|((curve, ends), s)| {
                let [low, high] = ends.map(|end| curve.to_position(end));
                s.clamp(low, high)
            })
            .collect()
    }
}

/// The values a parameter is rendered at, ascending, both bounds among them.
fn knots(info: &ParameterInfo, options: &RescalingOptions) -> Vec<f64> {
    let last = options.knots - 1;
    let range = info.upper - info.lower;
    (0..=last)
        .map(|j| {
            let from_lower = f64::from(j) / f64::from(last);
            if j == 0 {
                info.lower
            } else if j == last {
                info.upper
            } else if FINE_AT_UPPER_BOUND.contains(&info.own_name()) {
                info.upper - range * (1.0 - from_lower).powf(options.power)
            } else {
                info.lower + range * from_lower.powf(options.power)
            }
        })
        .collect()
}

/// The two renders' means, per configuration.
type Means = Vec<[[f64; CHANNELS]; 2]>;

fn means(pair: &RenderPair) -> Means {
    pair.estimates().map(|[a, b]| [a.mean, b.mean]).collect()
}

/// The increment of eq. 23 between two neighboring knots.
fn increment(weights: &[NumberWeights], lower: &Means, upper: &Means, form: Increment) -> f64 {
    let differences = lower.iter().zip(upper).zip(weights).map(|((l, u), w)| {
        let product = |c: usize| w[c] * (u[0][c] - l[0][c]) * (u[1][c] - l[1][c]);
        (0..CHANNELS).map(product).sum::<f64>()
    });
    match form {
        Increment::SumOfRoots => differences.map(|d| d.max(0.0).sqrt()).sum(),
        Increment::RootOfSum => differences.sum::<f64>().max(0.0).sqrt(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::{Random, statistics::Running};
    use crate::scatter::Unit;

    const COLOR: ParameterInfo = ParameterInfo {
        name: "c_tt",
        per_channel: true,
        unit: Unit::One,
        lower: 0.001,
        upper: 0.999,
        default: 0.85,
    };
    const WIDTH: ParameterInfo = ParameterInfo {
        name: "beta_r",
        per_channel: false,
        unit: Unit::Angle,
        lower: 1.0,
        upper: 10.0,
        default: 5.0,
    };

    fn close(a: f64, b: f64) -> bool {
        (a - b).abs() < 1e-12 * b.abs().max(1.0)
    }

    #[test]
    fn nine_knots_are_finer_toward_the_bound_that_matters() {
        // c_j = lo + (hi - lo) ((j - 1) / 8)^2, and its mirror image for C_TT.
        let options = RescalingOptions::default();
        let width = knots(&WIDTH, &options);
        let expected = [
            1.0, 1.140_625, 1.562_5, 2.265_625, 3.25, 4.515_625, 6.062_5, 7.890_625, 10.0,
        ];
        assert!(
            width.iter().zip(expected).all(|(a, b)| close(*a, b)),
            "{width:?}"
        );
        let color = knots(&COLOR, &options);
        assert!(close(color[7], 0.999 - 0.998 / 64.0), "{color:?}");
        assert!(close(color[1], 0.999 - 0.998 * 49.0 / 64.0), "{color:?}");
        // So is that of a yarn system.
        let of_weft = ParameterInfo {
            name: "weft.c_tt",
            ..COLOR
        };
        assert_eq!(knots(&of_weft, &options), color);
    }

    /// Three knots of a parameter seen by two configurations of weights 4 and 25.
    fn example() -> ([NumberWeights; 2], [Means; 3]) {
        let both = |rows: [[f64; 3]; 2]| rows.map(|r| [r, r]).to_vec();
        let renders = [
            both([[0.1, 0.2, 0.3], [0.5, 0.5, 0.5]]),
            both([[0.4, 0.6, 0.3], [0.5, 0.5, 0.5]]),
            both([[0.4, 0.6, 0.3], [0.5, 0.8, 0.9]]),
        ];
        ([[4.0; 3], [25.0; 3]], renders)
    }

    #[test]
    fn increments_are_those_of_equation_23() {
        let (weights, r) = example();
        // f_image: 0.09 + 0.16 = 0.25 and 0; then 0 and 0.09 + 0.16 = 0.25.
        for (j, expected) in [(0, 2.0 * 0.5), (1, 5.0 * 0.5)] {
            let found = increment(&weights, &r[j], &r[j + 1], Increment::SumOfRoots);
            assert!(close(found, expected), "{j}: {found}");
        }
        // From the first to the third both change: 1 + 2.5, or the root of 1 + 6.25.
        let sum = increment(&weights, &r[0], &r[2], Increment::SumOfRoots);
        let root = increment(&weights, &r[0], &r[2], Increment::RootOfSum);
        assert!(
            close(sum, 3.5) && close(root, 7.25_f64.sqrt()),
            "{sum} {root}"
        );
    }

    #[test]
    fn curves_begin_at_zero_and_share_a_color_among_its_channels() {
        let curve = |divisor| Curve::new(vec![1.0, 2.0, 4.0], &[1.0, 2.5], 1e-3, divisor);
        let scalar = curve(1.0);
        assert_eq!(scalar.positions, [0.0, 1.0, 3.5]);
        for (value, position) in [(1.0, 0.0), (1.5, 0.5), (2.0, 1.0), (3.0, 2.25), (4.0, 3.5)] {
            assert!(close(scalar.to_position(value), position), "{value}");
            assert!(close(scalar.to_value(position), value), "{position}");
        }
        let channel = curve(3.0);
        for value in [1.3, 2.0, 3.9] {
            let third = scalar.to_position(value) / 3.0;
            assert!(close(channel.to_position(value), third), "{value}");
        }
    }

    #[test]
    fn slopes_are_the_derivatives_of_the_values() {
        let curve = Curve::new(vec![1.0, 2.0, 4.0], &[1.0, 2.5], 1e-3, 3.0);
        for s in [0.0, 0.2, 0.4, 1.0, curve.length()] {
            let h = if s < curve.length() { 1e-7 } else { -1e-7 };
            let numeric = (curve.to_value(s + h) - curve.to_value(s)) / h;
            assert!((numeric - curve.slope(s)).abs() < 1e-6, "{s}: {numeric}");
        }
    }

    #[test]
    fn without_any_effect_the_inverse_still_exists() {
        let flat = Curve::new(vec![0.0, 1.0, 3.0], &[0.0, 0.0], 1e-3, 1.0);
        assert!(close(flat.to_value(flat.to_position(2.0)), 2.0));
        let partly = Curve::new(vec![0.0, 1.0, 3.0], &[0.0, 2.0], 1e-3, 1.0);
        assert!(close(partly.positions[1], 0.002));
        assert!(close(partly.to_value(partly.to_position(0.5)), 0.5));
    }

    #[test]
    fn noise_alone_adds_little_and_less_than_unpaired_differences_would() {
        // 16 configurations of one noisy channel that no parameter changes: the product of two differences has a root of
        // 0.34 sqrt(2) standard deviations on average, the difference of one render has 0.80 sqrt(2).
        let seed = std::env::var("SEED").ok().and_then(|s| s.parse().ok());
        let mut random = Random::keyed(&[seed.unwrap_or(41)]);
        let weights = vec![[1.0; 3]; 16];
        let mut draw = || -> Means {
            (0..16)
                .map(|_| [0, 1].map(|_| [0.01 * random.normal(), 0.0, 0.0]))
                .collect()
        };
        let (mut paired, mut unpaired) = (Running::default(), Running::default());
        for _ in 0..400 {
            let (a, b) = (draw(), draw());
            paired.push(increment(&weights, &a, &b, Increment::SumOfRoots));
            let single = |m: &Means| -> Means { m.iter().map(|r| [r[0], r[0]]).collect() };
            unpaired.push(increment(
                &weights,
                &single(&a),
                &single(&b),
                Increment::SumOfRoots,
            ));
        }
        let scale = 16.0 * 0.01 * 2.0_f64.sqrt();
        // Within four standard errors: sees a bias of 3 % of the noise.
        for (running, expected) in [(paired, 0.338), (unpaired, 0.798)] {
            let off = running.mean() - expected * scale;
            assert!(
                off.abs() < 4.0 * running.standard_error() + 1e-3 * scale,
                "{} for {}, se {}, n 400",
                running.mean(),
                expected * scale,
                running.standard_error()
            );
        }
    }
}
