//! Which pose to measure next: the one whose information shrinks what is least known.
//!
//! Greedy: after each shot the next is chosen as if the earlier had been taken. The choice is made from one pair of
//! renders of all candidates. The best of many noisy numbers looks better than it is, so candidates count by what is left of
//! their information after three standard errors, and what the chosen poses buy is told from another pair that had no part
//! in the choice. Intervals are those of measurements weighted by their errors; a fit that weights all relative errors alike
//! (Khungurn 2015 eq. 20) can do no better. Does not know which poses a rig reaches.

use super::bounds::Bounds;
use super::choice::{Target, greedy};
use super::information::{self, Place, Seen, Shot};
use super::objective::{RenderPair, brightness, channels_of};
use super::uncertainty::Samples;
use crate::base::{Error, Result, Watch};
use crate::render::{Effort, Estimate, Scene};
use crate::scatter::{CHANNELS, Parameters, Unit};
use crate::session::Configuration;
use serde::Serialize;

/// Index of the first pair, far from those of searches, checks and predictions.
const FIRST_INDEX: u64 = 1 << 42;

/// How many times the paths per camera direction of the candidates the measured and the chosen poses get.
const CONFIRM: u64 = 8;

/// What a new shot is to make known.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Aim {
    /// The flat parameter that is then known worst, relative to its range in search coordinates; the next when no pose is
    /// seen to say anything of it.
    Weakest,
    /// All: the volume of the region of uncertainty (D-optimal).
    All,
    /// The flat parameter of this name.
    Parameter(String),
}

/// A configuration that was measured, with the standard error of each mean, none of a channel that was not measured. Without
/// standard errors, or where one is 0, the stated relative error holds.
pub type MeasuredPose = (Configuration, Option<[Option<f64>; CHANNELS]>);

/// What a suggestion needs besides the scene and the poses.
#[derive(Debug, Clone, PartialEq)]
pub struct SuggestOptions {
    /// How many poses to suggest.
    pub shots: usize,
    /// What they are to make known.
    pub aim: Aim,
    /// Standard error of a new measurement (and of a measured one of which none is known), relative to the configuration's
    /// brightness: its mean over the channels measured, not below tau.
    pub relative_error: f64,
    /// Brightness below which errors are no longer relative: that of the fit.
    pub tau: f64,
    /// Bounds narrower than the model's own: those of the fit.
    pub bounds: Bounds,
    /// Error of the model itself, relative to the brightness: added to all measurements' errors in squares.
    pub model_error: f64,
    /// Camera paths per camera direction and render of the candidates; the measured and the chosen poses get eight times as
    /// many.
    pub paths: u64,
    /// Every random number is a function of it.
    pub seed: u64,
}

/// What is known of a flat parameter; angles in degrees.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Knowledge {
    /// Flat name.
    pub name: String,
    /// `degrees` or `1`.
    pub unit: &'static str,
    /// Where it stands.
    pub value: f64,
    /// Standard deviation divided by that of a parameter of which only the bounds are known, in search coordinates:
    /// 1 = nothing is known.
    pub share_unknown: f64,
    /// Relative standard error of that from the renders' noise.
    pub share_unknown_noise: f64,
    /// Expected 95 % interval, inside the bounds.
    pub interval_95: [f64; 2],
    /// Share of the range, in search coordinates, that it takes.
    pub range_share: f64,
}

/// One suggested shot.
#[derive(Debug, Clone, PartialEq)]
pub struct SuggestedShot {
    /// The pose.
    pub configuration: Configuration,
    /// Expected normalized radiance there.
    pub mean: [f64; CHANNELS],
    /// Its standard error from the renders.
    pub mean_se: [f64; CHANNELS],
    /// The parameter it was chosen for; none when for all.
    pub chosen_for: Option<String>,
    /// By which factor the choice was better than the candidates' median: the ratio of the standard deviations of the
    /// parameter it was chosen for (of their geometric mean when for all), from the pair the choice was made with.
    pub better_than_median: f64,
    /// What is known once it has been taken too.
    pub after: Vec<Knowledge>,
}

/// The answer of [`suggest`].
#[derive(Debug, Clone, PartialEq)]
pub struct Suggestion {
    /// What is known now.
    pub now: Vec<Knowledge>,
    /// In the order in which they are to be taken; fewer than asked for when no other pose is seen to say anything.
    pub shots: Vec<SuggestedShot>,
    /// How many candidates there were.
    pub candidates: usize,
    /// Camera paths of one render of the choice per camera direction.
    pub paths: u64,
}

/// Suggests the next poses out of `candidates`, after `measured` gave `parameters`.
///
/// # Errors
/// When there are no candidates, a number asked for is out of range, the aim names no parameter, a parameter is outside
/// its bounds, or a render fails.
pub fn suggest(
    scene: &dyn Scene,
    parameters: &Parameters,
    measured: &[MeasuredPose],
    candidates: &[Configuration],
    options: &SuggestOptions,
    watch: &dyn Watch,
) -> Result<Suggestion> {
    options.check(candidates)?;
    let place = Place::within(parameters, &options.bounds)?;
    let aim = Target::of(&options.aim, parameters)?;
    let stated = measured.iter().filter_map(|(_, errors)| *errors);
    let look = Look {
        channels: channels_of(stated.map(|errors| errors.map(|e| e.is_some()))),
        scene,
        parameters,
        place: &place,
        options,
        watch,
    };
    let poses: Vec<Configuration> = measured.iter().map(|(c, _)| *c).collect();
    let more = CONFIRM * options.paths;
    let (_, mut known) = look.shots(&poses, |i| measured[i].1, more, 0)?;
    let (_, new) = look.shots(candidates, |_| None, options.paths, 1)?;
    let seen = Seen::of(place.len(), &known);
    let choices = greedy(&seen.information, &new, options.shots, aim);
    if choices.is_empty() {
        return Err(Error::new(format!(
            "none of {} poses is seen to make anything better known",
            candidates.len()
        ))
        .with_hint("give more --paths: the renders' noise hides what the poses say"));
    }
    let chosen: Vec<Configuration> = choices.iter().map(|c| candidates[c.index]).collect();
    let (estimates, bought) = look.shots(&chosen, |_| None, more, 2)?;
    let names = parameters.flat_names();
    let now = look.knowledge(&known)?;
    let mut shots = Vec::new();
    for (k, (choice, shot)) in choices.iter().zip(bought).enumerate() {
        known.push(shot);
        let [a, b] = &estimates[k];
        shots.push(SuggestedShot {
            configuration: chosen[k],
            mean: std::array::from_fn(|c| 0.5 * (a.mean[c] + b.mean[c])),
            mean_se: std::array::from_fn(|c| 0.5 * a.standard_error[c].hypot(b.standard_error[c])),
            chosen_for: choice.for_parameter.map(|j| names[j].clone()),
            better_than_median: choice.better_than_median,
            after: look.knowledge(&known)?,
        });
    }
    Ok(Suggestion {
        now,
        shots,
        candidates: candidates.len(),
        paths: options.paths,
    })
}

impl SuggestOptions {
    fn check(&self, candidates: &[Configuration]) -> Result<()> {
        if candidates.is_empty() {
            return Err(
                Error::new("no pose is left to suggest").with_hint("widen the grid of candidates")
            );
        }
        if self.shots == 0 {
            return Err(Error::new("0 shots were asked for, expected at least 1"));
        }
        if !(self.relative_error > 0.0 && self.relative_error < 1.0) {
            return Err(Error::new(format!(
                "the relative error of a measurement is {}, expected a fraction between 0 and 1",
                self.relative_error
            ))
            .with_hint("state it: 1% or 0.01"));
        }
        if !(0.0..10.0).contains(&self.model_error) {
            return Err(Error::new(format!(
                "the model's relative error is {}, expected a fraction >= 0",
                self.model_error
            )));
        }
        Ok(())
    }
}

/// What renders are made of.
struct Look<'a> {
    /// Those that a new pose is measured in: the channels of the measured ones.
    channels: [bool; CHANNELS],
    scene: &'a dyn Scene,
    parameters: &'a Parameters,
    place: &'a Place,
    options: &'a SuggestOptions,
    watch: &'a dyn Watch,
}

impl Look<'_> {
    /// The estimates of a pair at some poses, and their shots; `known` gives a pose's errors where they are known.
    fn shots(
        &self,
        poses: &[Configuration],
        known: impl Fn(usize) -> Option<[Option<f64>; CHANNELS]>,
        paths: u64,
        index: u64,
    ) -> Result<(Vec<[Estimate; 2]>, Vec<Shot>)> {
        if poses.is_empty() {
            return Ok((Vec::new(), Vec::new()));
        }
        let pair = RenderPair::render(
            self.scene,
            poses,
            self.parameters,
            &Effort::Paths(paths),
            self.options.seed,
            FIRST_INDEX + index,
            self.watch,
        )?;
        let SuggestOptions {
            relative_error,
            model_error,
            tau,
            ..
        } = *self.options;
        let shots = Shot::of_pair(self.place, poses, &pair, |i, mean| {
            let brightness = brightness(mean, self.channels, tau);
            let stated = relative_error * brightness;
            let own = known(i).unwrap_or(self.channels.map(|c| c.then_some(stated)));
            own.map(|se| {
                let se = se.map(|s| if s > 0.0 { s } else { stated });
                se.map(|s| s.hypot(model_error * brightness))
            })
        })?;
        let estimates = pair.estimates().map(|renders| renders.map(Clone::clone));
        Ok((estimates.collect(), shots))
    }

    /// What these shots make known.
    fn knowledge(&self, shots: &[Shot]) -> Result<Vec<Knowledge>> {
        let (place, p) = (self.place, self.place.len());
        let space = &place.space;
        let seen = Seen::of(p, shots);
        let covariance = information::covariance(&seen.information)
            .ok_or_else(|| Error::new("the information of the poses is not usable"))?;
        let precision = place.precision(&seen.information);
        let samples = Samples::around(space, &place.u, &precision, self.options.seed);
        let names = self.parameters.flat_names();
        let places = self.parameters.places();
        let one = |j: usize| {
            let (unit, scale) = match self.parameters.infos()[places[j].0].unit {
                Unit::One => ("1", 1.0),
                Unit::Angle => ("degrees", 1.0_f64.to_degrees()),
            };
            let interval = samples.interval(space, j, 0.95, place.u[j]);
            Knowledge {
                name: names[j].clone(),
                unit,
                value: scale * self.parameters.values()[j],
                share_unknown: covariance[(j, j)].sqrt(),
                share_unknown_noise: seen.relative_error(shots, &covariance, j),
                interval_95: interval.map(|u| scale * space.value(j, u)),
                range_share: (interval[1] - interval[0]) / (space.upper()[j] - space.lower()[j]),
            }
        };
        Ok((0..p).map(one).collect())
    }
}
