//! The weighted squared error between measured and rendered intensities, estimated without bias.
//!
//! `f = sum_i w_i sum_c (R_ic - M_ic)^2`, `w_i = 1 / max(a_i, tau)^2`, `a_i` the channel mean of the measurement, tau =
//! 0.02 (Khungurn 2015 eq. 18-20). A number that was not measured has weight 0 and no part in `a_i`. The square of one
//! noisy render is too large by its variance; the product of two independent renders' errors is not, so nothing here takes
//! a single render. Does not know how parameters are searched.

use crate::base::{Context, Error, Result, Watch};
use crate::render::{Effort, Estimate, Estimates, Request, Scene, TAU};
use crate::scatter::{CHANNELS, Parameters};
use crate::session::{Configuration, Intensity, Measurements};

/// Correlations between the three channels' errors of one configuration.
pub(super) type ChannelCorrelation = [[f64; CHANNELS]; CHANNELS];

/// Two renders of the same configurations at the same parameters that share no random number.
///
/// The only way to make one is [`RenderPair::render`] (or to have kept one), so the independence the objective needs cannot
/// be forgotten.
#[derive(Debug, Clone)]
pub struct RenderPair {
    renders: [Estimates; 2],
}

impl RenderPair {
    /// Renders twice with `effort` each, on streams `2 index` and `2 index + 1` of `seed`.
    ///
    /// # Errors
    /// When the scene fails or is cancelled, answers with other configurations than asked for, or with a number that
    /// is not finite.
    pub fn render(
        scene: &dyn Scene,
        configurations: &[Configuration],
        parameters: &Parameters,
        effort: &Effort,
        seed: u64,
        index: u64,
        watch: &dyn Watch,
    ) -> Result<Self> {
        let one = |stream: u64| -> Result<Estimates> {
            let request = Request {
                configurations,
                parameters,
                effort: effort.clone(),
                seed,
                stream,
            };
            let estimates = scene.estimate(&request, watch)?;
            check(&estimates, configurations, parameters)
                .context(|| format!("render at {}", parameters.to_json()))?;
            Ok(estimates)
        };
        Ok(Self {
            renders: [one(2 * index)?, one(2 * index + 1)?],
        })
    }

    /// A pair that was rendered earlier, checked as then.
    pub(super) fn recalled(
        renders: [Estimates; 2],
        configurations: &[Configuration],
        parameters: &Parameters,
    ) -> Result<Self> {
        for render in &renders {
            check(render, configurations, parameters).context(|| "a recorded render")?;
        }
        Ok(Self { renders })
    }

    /// Both renders, for the record.
    pub(super) fn renders(&self) -> [&Estimates; 2] {
        self.renders.each_ref()
    }

    /// The pair times a gain.
    pub(super) fn scaled(mut self, gain: f64) -> Self {
        if gain.to_bits() == 1.0_f64.to_bits() {
            return self;
        }
        let all = self.renders.iter_mut().flat_map(|r| &mut r.configurations);
        for e in all {
            let numbers = e.mean.iter_mut().chain(&mut e.standard_error);
            let derivatives = e.derivative.iter_mut().chain(&mut e.derivative_se);
            numbers
                .chain(derivatives.flatten())
                .for_each(|x| *x *= gain);
        }
        self
    }

    /// Seconds of all threads spent on both renders.
    pub fn cpu_s(&self) -> f64 {
        self.renders.iter().map(|r| r.cpu_s).sum()
    }

    /// Seconds both renders took.
    pub fn wall_s(&self) -> f64 {
        self.renders.iter().map(|r| r.wall_s).sum()
    }

    /// The two estimates of each configuration.
    pub fn estimates(&self) -> impl Iterator<Item = [&Estimate; 2]> {
        let [a, b] = &self.renders;
        a.configurations
            .iter()
            .zip(&b.configurations)
            .map(|(a, b)| [a, b])
    }

    /// One render of the pair, `which` 0 or 1.
    pub(super) fn render_of(&self, which: usize) -> &[Estimate] {
        &self.renders[which].configurations
    }

    /// Standardized differences between the two renders, per configuration; zero where no error is known.
    pub(super) fn standardized_differences(&self) -> impl Iterator<Item = [f64; CHANNELS]> {
        self.estimates().map(|[a, b]| {
            std::array::from_fn(|c| {
                let sd = a.standard_error[c].hypot(b.standard_error[c]);
                if sd > 0.0 {
                    (a.mean[c] - b.mean[c]) / sd
                } else {
                    0.0
                }
            })
        })
    }
}

fn check(estimates: &Estimates, asked: &[Configuration], parameters: &Parameters) -> Result<()> {
    let ids = estimates.configurations.iter().map(|e| e.config);
    if !ids.eq(asked.iter().map(|c| c.id)) {
        return Err(Error::new(
            "the scene answered with other configurations than asked for",
        ));
    }
    for e in &estimates.configurations {
        if e.derivative.len() != parameters.infos().len()
            || e.derivative_se.len() != e.derivative.len()
        {
            return Err(Error::new(format!(
                "configuration {}: {} derivative rows, expected {}",
                e.config,
                e.derivative.len(),
                parameters.infos().len()
            )));
        }
        let numbers = e.mean.iter().chain(&e.standard_error);
        let derivatives = e.derivative.iter().chain(&e.derivative_se).flatten();
        if let Some(bad) = numbers.chain(derivatives).find(|x| !x.is_finite()) {
            return Err(Error::new(format!(
                "configuration {}: the scene estimated {bad}, expected a finite number",
                e.config
            )));
        }
    }
    Ok(())
}

/// The correlation of channels' errors pooled over standardized differences of render pairs; full where none is known.
pub(super) fn channel_correlation(
    differences: impl Iterator<Item = [f64; CHANNELS]>,
) -> ChannelCorrelation {
    let mut sum = [[0.0; CHANNELS]; CHANNELS];
    for z in differences {
        for c in 0..CHANNELS {
            for d in 0..CHANNELS {
                sum[c][d] += z[c] * z[d];
            }
        }
    }
    std::array::from_fn(|c| {
        std::array::from_fn(|d| {
            let scale = (sum[c][c] * sum[d][d]).sqrt();
            if c != d && scale > 0.0 {
                (sum[c][d] / scale).clamp(-1.0, 1.0)
            } else {
                1.0
            }
        })
    })
}

/// An unbiased estimate of the objective.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairedValue {
    /// `sum_i w_i sum_c (R1 - M)(R2 - M)`; may be negative.
    pub value: f64,
    /// Its standard error, from the renders' standard errors.
    pub standard_error: f64,
}

/// The objective for one set of measurements.
#[derive(Debug, Clone)]
pub struct Objective {
    intensities: Vec<Intensity>,
    tau: f64,
    factors: Vec<f64>,
    weights: Vec<NumberWeights>,
}

/// The weight of each channel's number of one configuration; 0 where nothing was measured.
pub(super) type NumberWeights = [f64; CHANNELS];

/// What errors of a configuration are relative to: its mean over the channels that are `seen`, not below `tau`.
pub(super) fn brightness(mean: [f64; CHANNELS], seen: [bool; CHANNELS], tau: f64) -> f64 {
    let of_seen = (0..CHANNELS).filter(|&c| seen[c]).map(|c| mean[c]);
    (of_seen.clone().sum::<f64>() / of_seen.count() as f64).max(tau)
}

/// The channels that any of several configurations was measured in; all of them where none says.
pub(super) fn channels_of(
    configurations: impl Iterator<Item = [bool; CHANNELS]>,
) -> [bool; CHANNELS] {
    let any = configurations.fold([false; CHANNELS], |any, present| {
        std::array::from_fn(|c| any[c] || present[c])
    });
    if any == [false; CHANNELS] {
        return [true; CHANNELS];
    }
    any
}

/// The weight of a measured configuration (Khungurn 2015 eq. 20).
pub(super) fn relative_weight(intensity: &Intensity, tau: f64) -> f64 {
    brightness(intensity.mean, intensity.present, tau)
        .powi(2)
        .recip()
}

/// The same for each number: 0 where nothing was measured.
pub(super) fn relative_weights(intensity: &Intensity, tau: f64) -> NumberWeights {
    let weight = relative_weight(intensity, tau);
    intensity.present.map(|p| if p { weight } else { 0.0 })
}

impl Objective {
    /// The objective with the weights of Khungurn 2015 eq. 20.
    ///
    /// # Errors
    /// When there are no measurements, a configuration has none, or one of them is negative or not finite.
    pub fn new(measurements: &Measurements) -> Result<Self> {
        Self::with_tau(measurements, TAU)
    }

    /// The same with another tau: configurations darker than this get no more weight.
    ///
    /// # Errors
    /// As [`Objective::new`], and when tau is not above 0 and at most 1.
    pub fn with_tau(measurements: &Measurements, tau: f64) -> Result<Self> {
        if !(tau > 0.0 && tau <= 1.0) {
            return Err(Error::new(format!(
                "tau, where the weight of dark configurations stops growing, is {tau}, expected a number above 0 and at most 1"
            ))
            .with_hint("the published value is 0.02"));
        }
        let cleared = measurements.intensities.iter().map(Intensity::cleared);
        let intensities: Vec<Intensity> = cleared.collect();
        if intensities.is_empty() {
            return Err(Error::new("no measurements to fit"));
        }
        for i in &intensities {
            if i.present == [false; CHANNELS] {
                return Err(Error::new(format!(
                    "configuration {}: no channel was measured",
                    i.configuration.id
                ))
                .with_hint("leave out a configuration that was not measured"));
            }
            for (what, value) in [("intensity", i.mean), ("standard error", i.standard_error)] {
                let mut present = i.where_present(value).into_iter().flatten();
                if let Some(bad) = present.find(|x| !(0.0..1e6).contains(x)) {
                    return Err(Error::new(format!(
                        "configuration {}: {what} is {bad}, expected a finite number >= 0",
                        i.configuration.id
                    ))
                    .with_hint("leave out a number that was not measured"));
                }
            }
        }
        let of = |i| relative_weights(i, tau);
        let weights = intensities.iter().map(of).collect();
        Ok(Self {
            tau,
            factors: vec![1.0; intensities.len()],
            intensities,
            weights,
        })
    }

    /// The same with weights times a factor for each configuration.
    pub(super) fn with_factors(&self, factors: Vec<f64>) -> Self {
        let rows = self.intensities.iter().zip(&factors);
        Self {
            intensities: self.intensities.clone(),
            tau: self.tau,
            weights: rows
                .map(|(i, q)| relative_weights(i, self.tau).map(|w| q * w))
                .collect(),
            factors,
        }
    }

    /// Configurations darker than this get no more weight.
    pub fn tau(&self) -> f64 {
        self.tau
    }

    /// By what a robust loss has multiplied the weight of each configuration; 1 without.
    pub(super) fn factors(&self) -> &[f64] {
        &self.factors
    }

    /// The same with these factors squared: what a configuration that counts less may at most contribute is bounded by the
    /// loss. Without a robust loss the objective itself.
    pub(super) fn bounded(&self) -> Self {
        self.with_factors(self.factors.iter().map(|q| q * q).collect())
    }

    /// What measurement errors alone contribute: `sum w se^2`.
    pub(super) fn measurement_sum(&self) -> f64 {
        let rows = self.intensities.iter().zip(&self.weights);
        rows.flat_map(|(i, w)| (0..CHANNELS).map(move |c| w[c] * i.standard_error[c].powi(2)))
            .sum()
    }

    /// The measurements.
    pub fn intensities(&self) -> &[Intensity] {
        &self.intensities
    }

    /// The weight of each number, per configuration and channel; 0 of one that was not measured.
    pub fn weights(&self) -> &[[f64; CHANNELS]] {
        &self.weights
    }

    /// The poses, in the measurements' order.
    pub fn configurations(&self) -> Vec<Configuration> {
        self.intensities.iter().map(|i| i.configuration).collect()
    }

    /// How many numbers are compared: those that were measured.
    pub fn n_numbers(&self) -> usize {
        let present = self.intensities.iter().flat_map(|i| i.present);
        present.filter(|p| *p).count()
    }

    /// Whether any configuration was measured in this channel.
    pub fn sees(&self, channel: usize) -> bool {
        self.intensities.iter().any(|i| i.present[channel])
    }

    /// The unbiased estimate of the objective from one pair.
    ///
    /// With `e = R - M` and errors of the two renders independent, of covariance S1 and S2 between channels,
    /// `Var(sum_c e1c e2c) = sum_cd [r_c r_d (S1 + S2)_cd + S1_cd S2_cd]`, `r_c r_d` estimated by the symmetrized
    /// `e1c e2d`. Correlations of channels are pooled over the pair's configurations.
    pub fn paired(&self, pair: &RenderPair) -> PairedValue {
        let targets: Vec<[f64; CHANNELS]> = self.intensities.iter().map(|i| i.mean).collect();
        paired_against(&targets, &self.weights, pair)
    }

    /// The unbiased estimate of the objective's gradient by the flat parameters (angles per radian):
    /// `sum_i w_i sum_c [(R1 - M) dR2 + (R2 - M) dR1]`.
    pub fn gradient(&self, pair: &RenderPair, parameters: &Parameters) -> Vec<f64> {
        let mut gradient = vec![0.0; parameters.values().len()];
        for ((i, w), [a, b]) in self
            .intensities
            .iter()
            .zip(&self.weights)
            .zip(pair.estimates())
        {
            for row in 0..parameters.infos().len() {
                for c in 0..CHANNELS {
                    gradient[parameters.slot(row, c)] += w[c]
                        * ((a.mean[c] - i.mean[c]) * b.derivative[row][c]
                            + (b.mean[c] - i.mean[c]) * a.derivative[row][c]);
                }
            }
        }
        gradient
    }
}

/// [`Objective::paired`] against any target intensities.
pub(super) fn paired_against(
    targets: &[[f64; CHANNELS]],
    weights: &[NumberWeights],
    pair: &RenderPair,
) -> PairedValue {
    let rho = channel_correlation(pair.standardized_differences());
    let (mut value, mut variance, mut floor) = (0.0, 0.0, 0.0);
    for ((target, w), [a, b]) in targets.iter().zip(weights).zip(pair.estimates()) {
        let e1: [f64; CHANNELS] = std::array::from_fn(|c| a.mean[c] - target[c]);
        let e2: [f64; CHANNELS] = std::array::from_fn(|c| b.mean[c] - target[c]);
        value += (0..CHANNELS).map(|c| w[c] * e1[c] * e2[c]).sum::<f64>();
        for c in 0..CHANNELS {
            for d in 0..CHANNELS {
                let s1 = rho[c][d] * a.standard_error[c] * a.standard_error[d];
                let s2 = rho[c][d] * b.standard_error[c] * b.standard_error[d];
                let rr = 0.5 * (e1[c] * e2[d] + e1[d] * e2[c]);
                variance += w[c] * w[d] * (rr * (s1 + s2) + s1 * s2);
            }
            floor += (w[c] * a.standard_error[c] * b.standard_error[c]).powi(2);
        }
    }
    // The plug-in may come out too small where all r are small; the noise products alone are a lower bound.
    PairedValue {
        value,
        standard_error: variance.max(floor).sqrt(),
    }
}

/// The weighted rms residual `sqrt(max(0, f) / n)` of an objective value over `n` numbers, with a standard error.
///
/// The error is `se_f / (2 sqrt(n f))`, but where f is within its own noise of zero the root's error is bounded by
/// `sqrt(se_f / n)`, which is then returned.
pub fn rms_of(paired: PairedValue, n_numbers: usize) -> (f64, f64) {
    let n = n_numbers as f64;
    let rms = (paired.value.max(0.0) / n).sqrt();
    let limit = (paired.standard_error / n).sqrt();
    let se = if rms > 0.0 {
        (paired.standard_error / (2.0 * n * rms)).min(limit)
    } else {
        limit
    };
    (rms, se)
}
