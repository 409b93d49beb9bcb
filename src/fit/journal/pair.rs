//! The line of one render pair: what was asked, and both renders in full precision.

use crate::render::{Estimate, Estimates};
use crate::scatter::Parameters;
use serde::{Deserialize, Serialize};

/// What a pair is a function of, besides the header.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(in crate::fit) struct Asked {
    /// Of this stage of the fit.
    pub(in crate::fit) seed: u64,
    pub(in crate::fit) index: u64,
    /// Camera paths of each of the two renders.
    pub(in crate::fit) paths: u64,
    pub(in crate::fit) shares: Vec<f64>,
    pub(in crate::fit) parameters: Vec<f64>,
}

impl Asked {
    pub(in crate::fit) fn new(
        seed: u64,
        index: u64,
        paths: u64,
        shares: &[f64],
        parameters: &Parameters,
    ) -> Self {
        Self {
            seed,
            index,
            paths,
            shares: shares.to_vec(),
            parameters: parameters.values().to_vec(),
        }
    }

    /// Which pair of a fit it is.
    pub(super) fn key(&self) -> (u64, u64) {
        (self.seed, self.index)
    }

    /// In words, what differs when `now` is asked.
    pub(super) fn difference(&self, now: &Self) -> String {
        if self.paths != now.paths {
            return format!("{} camera paths then, {} now", self.paths, now.paths);
        }
        let (what, then, now) = if self.parameters == now.parameters {
            ("path shares", &self.shares, &now.shares)
        } else {
            ("parameters", &self.parameters, &now.parameters)
        };
        format!("{what} {then:?} then, {now:?} now")
    }
}

/// One render, a list per quantity over configurations.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Columns {
    wall_s: f64,
    pub(super) cpu_s: f64,
    config: Vec<u32>,
    paths: Vec<u64>,
    mean: Vec<[f64; 3]>,
    se: Vec<[f64; 3]>,
    derivative: Vec<Vec<[f64; 3]>>,
    derivative_se: Vec<Vec<[f64; 3]>>,
}

impl Columns {
    pub(super) fn of(estimates: &Estimates) -> Self {
        let all = &estimates.configurations;
        Self {
            wall_s: estimates.wall_s,
            cpu_s: estimates.cpu_s,
            config: all.iter().map(|e| e.config).collect(),
            paths: all.iter().map(|e| e.paths).collect(),
            mean: all.iter().map(|e| e.mean).collect(),
            se: all.iter().map(|e| e.standard_error).collect(),
            derivative: all.iter().map(|e| e.derivative.clone()).collect(),
            derivative_se: all.iter().map(|e| e.derivative_se.clone()).collect(),
        }
    }

    /// None when the lists are not equally long.
    pub(super) fn estimates(&self) -> Option<Estimates> {
        let one = |i: usize| {
            Some(Estimate {
                config: self.config[i],
                paths: *self.paths.get(i)?,
                mean: *self.mean.get(i)?,
                standard_error: *self.se.get(i)?,
                derivative: self.derivative.get(i)?.clone(),
                derivative_se: self.derivative_se.get(i)?.clone(),
            })
        };
        Some(Estimates {
            configurations: (0..self.config.len()).map(one).collect::<Option<_>>()?,
            cpu_s: self.cpu_s,
            wall_s: self.wall_s,
        })
    }
}

/// The line of one pair.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct PairLine {
    pub(super) asked: Asked,
    pub(super) renders: [Columns; 2],
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The numbers that shortest decimal forms and hasty readers get wrong.
    #[test]
    fn numbers_come_back_bit_for_bit() {
        let mut random = crate::math::Random::keyed(&[11, 0x10a]);
        let mut numbers = vec![
            0.1,
            -0.0,
            5e-324,
            f64::MIN_POSITIVE,
            f64::MAX,
            2.225_073_858_507_201e-308,
            9_007_199_254_740_993.0,
        ];
        numbers.extend((0..20_000).map(|_| {
            let x = f64::from_bits(random.bits());
            if x.is_finite() { x } else { 1.0 }
        }));
        let estimate = |n: &[f64]| Estimate {
            config: 3,
            mean: [n[0], n[1], n[2]],
            standard_error: [n[3], n[4], n[5]],
            derivative: vec![[n[6], n[0], n[1]]],
            derivative_se: vec![[n[2], n[3], n[4]]],
            paths: u64::MAX,
        };
        let renders = [7.25, 0.1 + 0.2].map(|s| Estimates {
            configurations: numbers.chunks_exact(7).map(estimate).collect(),
            cpu_s: s,
            wall_s: s / 3.0,
        });
        let line = serde_json::to_vec(&renders.each_ref().map(Columns::of)).unwrap();
        let again: [Columns; 2] = serde_json::from_slice(&line).unwrap();
        for (a, b) in renders.iter().zip(&again) {
            let b = b.estimates().unwrap();
            // Text of the shortest form tells -0 from 0.
            assert_eq!(format!("{a:?}"), format!("{b:?}"));
        }
    }
}
