//! One camera path through a medium: next-event estimation to every lamp of a group, one collision after another.
//!
//! A flight passes an exponentially distributed optical depth; where it ends the light is scattered as `alpha p` says, with
//! directions in the frame of the voxel's fiber. Free flights have no color, so all three channels travel on one path. A
//! path's derivatives are those of `alpha p` and the scores of its flights (docs/decisions/0008-media.md), handed on
//! together: an event's derivatives contain the score of the flight that led to it. Nothing is clamped.

use super::VolumeScene;
use super::extinction::{Extinction, Scores};
use super::grid::{End, Flight};
use crate::math::{Frame, Random};
use crate::render::estimate::{CameraRay, Followed, Rules};
use crate::render::light::Lamp;
use crate::render::path::{
    CONNECTION_FLOOR, Comb, Event, Visitor, cosine_direction, largest, times,
};
use crate::render::scene::{FiberSceneOptions, Plate};
use crate::scatter::media::{Medium, Outgoing};
use crate::scatter::{CHANNELS, Evaluation, MAX_ROWS};
use glam::DVec3;
use std::f64::consts::FRAC_1_PI;

/// A scene at fixed parameters.
pub(super) struct VolumePaths<'a> {
    scene: &'a VolumeScene,
    medium: Box<dyn Medium>,
    extinction: Extinction,
}

/// A ray of a path, with what it carries and how it began.
struct Leg {
    /// Events before it.
    depth: usize,
    origin: DVec3,
    direction: DVec3,
    /// What it carries, as [`Medium::importance`] has it: it decides what is followed, not what is found.
    carried: [f64; CHANNELS],
    begun: Begun,
}

/// How a leg began.
enum Begun {
    Camera,
    Medium {
        wi: DVec3,
        wo: DVec3,
        factor: f64,
        pdf: f64,
        /// Of the flight before.
        scores: Scores,
        state: usize,
    },
    Plate {
        albedo: [f64; CHANNELS],
        factor: f64,
        pdf: f64,
        scores: Scores,
        state: usize,
    },
}

/// A path being followed.
struct Follower<'a, V> {
    paths: &'a VolumePaths<'a>,
    rules: &'a Rules<'a>,
    random: &'a mut Random,
    visitor: &'a mut V,
    open: Vec<Leg>,
}

impl<'a> VolumePaths<'a> {
    pub(super) fn new(scene: &'a VolumeScene, medium: Box<dyn Medium>) -> Self {
        Self {
            extinction: Extinction::new(&*medium),
            scene,
            medium,
        }
    }

    fn fly(&self, origin: DVec3, direction: DVec3, budget: f64) -> Flight {
        let medium = (&self.extinction, self.scene.density);
        self.scene.grid.fly(medium, origin, direction, budget)
    }
}

impl Followed for VolumePaths<'_> {
    fn options(&self) -> &FiberSceneOptions {
        &self.scene.options
    }

    fn follow<V: Visitor>(
        &self,
        rules: &Rules<'_>,
        ray: CameraRay,
        random: &mut Random,
        visitor: &mut V,
    ) {
        let top = self.scene.grid.z_range()[1].max(0.0);
        let back = ray.toward_camera;
        let first = Leg {
            depth: 0,
            origin: ray.through + back * (top / back.z),
            direction: -back,
            carried: [1.0; CHANNELS],
            begun: Begun::Camera,
        };
        let mut follower = Follower {
            paths: self,
            rules,
            random,
            visitor,
            open: vec![first],
        };
        follower.run();
    }
}

/// A value whose derivatives are its scores: what a flight multiplies with, times `value`.
fn scored(value: [f64; CHANNELS], scores: &Scores) -> Evaluation {
    Evaluation {
        value,
        derivative: scores.map(|score| value.map(|v| v * score)),
    }
}

/// Adds a flight's scores to an event's derivatives.
fn with_scores(mut e: Evaluation, scores: &Scores) -> Evaluation {
    for (derivative, score) in e.derivative.iter_mut().zip(scores) {
        (0..CHANNELS).for_each(|c| derivative[c] += e.value[c] * score);
    }
    e
}

fn sum(a: &Scores, b: &Scores) -> Scores {
    std::array::from_fn(|k| a[k] + b[k])
}

/// The visitor's form of an event; recorded paths, which want its directions, are not for media.
fn event(evaluation: &Evaluation, factor: f64) -> Event<'_> {
    Event {
        wi: DVec3::Z,
        wo: DVec3::Z,
        h: 0.0,
        set: 0,
        factor,
        evaluation,
    }
}

impl<V: Visitor> Follower<'_, V> {
    fn run(&mut self) {
        while let Some(leg) = self.open.pop() {
            let carried = leg.carried.iter().all(|c| c.is_finite());
            if !(carried && leg.direction.is_finite() && leg.origin.is_finite()) {
                // Found in the result, and reported there.
                (0..self.rules.lamps.len())
                    .for_each(|lamp| self.visitor.arrive(0, lamp, [f64::NAN; CHANNELS]));
                return;
            }
            self.begin(&leg);
            let budget = -self.random.uniform_open().ln();
            let flight = self.paths.fly(leg.origin, leg.direction, budget);
            match flight.end {
                End::Met { distance, fiber } => {
                    self.collide(&leg, &flight, leg.origin + leg.direction * distance, fiber);
                }
                End::Down => self.at_plate(&leg, &flight),
                End::Up => {}
            }
        }
    }

    /// Tells of the event with which a leg begins, and of lamps it may meet.
    fn begin(&mut self, leg: &Leg) {
        let (evaluation, factor, pdf, state) = match &leg.begun {
            Begun::Camera => return,
            Begun::Medium {
                wi,
                wo,
                factor,
                pdf,
                scores,
                state,
            } => {
                let e = with_scores(self.paths.medium.evaluate(*wi, *wo), scores);
                (e, *factor, *pdf, *state)
            }
            Begun::Plate {
                albedo,
                factor,
                pdf,
                scores,
                state,
            } => (scored(*albedo, scores), *factor, *pdf, *state),
        };
        self.visitor
            .bounce(leg.depth - 1, event(&evaluation, factor));
        self.visitor.set_out(leg.depth, state);
        self.arrive_on_lamps(leg, pdf);
    }

    /// Connects a collision to the lamps, and goes on in a few of the sampled directions, see
    /// [`crate::render::guide::Guide`].
    fn collide(&mut self, leg: &Leg, flight: &Flight, at: DVec3, fiber: DVec3) {
        let medium = &*self.paths.medium;
        let frame = Frame::from_tangent(fiber);
        let wo = frame.to_local(-leg.direction);
        let outgoing = medium.outgoing(wo, leg.carried);
        for lamp in 0..self.rules.lamps.len() {
            self.connect_lamp(lamp, leg, flight, at, &frame, &outgoing);
        }
        let candidates = self.rules.guide.candidates();
        let share = 1.0 / candidates as f64;
        let mut comb = Comb::new(self.random);
        for _ in 0..candidates {
            let sampled = medium.sample(&outgoing, self.random);
            let direction = frame.to_world(sampled.wi);
            let grown = times(leg.carried, sampled.weight.map(|w| w * share));
            let state = self.paths.scene.map.state(at, direction);
            let survival = self.rules.guide.survival(state, grown);
            if !comb.takes(survival) {
                continue;
            }
            self.open.push(Leg {
                depth: leg.depth + 1,
                origin: at,
                direction,
                carried: grown.map(|g| g / survival),
                begun: Begun::Medium {
                    wi: sampled.wi,
                    wo,
                    factor: share / (sampled.pdf * survival),
                    pdf: sampled.pdf,
                    scores: flight.scores,
                    state,
                },
            });
        }
    }

    /// Next-event estimation, weighted against [`Follower::arrive_on_lamps`] by the balance heuristic. One point of the lamp
    /// is looked at: four, one of them chosen, cost more than they saved (docs/decisions/0009-volume-tracking.md).
    fn connect_lamp(
        &mut self,
        index: usize,
        leg: &Leg,
        flight: &Flight,
        at: DVec3,
        frame: &Frame,
        o: &Outgoing,
    ) {
        let lamp = &self.rules.lamps[index];
        let medium = &*self.paths.medium;
        let Some(point) = lamp.sample(at, self.random) else {
            return;
        };
        let wi = frame.to_local(point.direction);
        let (value, pdf) = medium.importance(wi, o);
        let factor = lamp.normalized_radiance() / (point.pdf + pdf);
        let strength = factor * largest(times(leg.carried, value));
        if strength <= 0.0 {
            return;
        }
        let odds = (strength / self.rules.worth[index]).clamp(CONNECTION_FLOOR, 1.0);
        // What is not a number goes on and is found in the result.
        if self.random.uniform() >= odds {
            return;
        }
        let along = self.light_along(at, point.direction, index, strength / odds);
        let Some((through, scores)) = along else {
            return;
        };
        let scores = sum(&scores, &flight.scores);
        let evaluation = with_scores(medium.evaluate(wi, o.wo), &scores);
        let factor = factor / odds * through;
        self.visitor
            .connect(leg.depth, index, event(&evaluation, factor));
    }

    /// The leg that begins here may leave the cloth and meet a lamp.
    fn arrive_on_lamps(&mut self, leg: &Leg, pdf: f64) {
        for (index, lamp) in self.rules.lamps.iter().enumerate() {
            let Some(lamp_pdf) = lamp.pdf(leg.origin, leg.direction) else {
                continue;
            };
            let factor = lamp.normalized_radiance() * pdf / (pdf + lamp_pdf);
            let strength = factor * largest(leg.carried);
            let along = self.light_along(leg.origin, leg.direction, index, strength);
            if let Some((through, scores)) = along {
                let passed = scored([factor * through; CHANNELS], &scores);
                self.visitor.connect(leg.depth, index, event(&passed, 1.0));
            }
        }
    }

    /// What share of a lamp's light comes through along a direction, with its scores, unbiased; none when none does. `strength`
    /// is what would come if nothing stood between: as long as what is left of it counts, optical depth is taken off
    /// exactly, from there on it is met or not.
    fn light_along(
        &mut self,
        from: DVec3,
        direction: DVec3,
        lamp: usize,
        strength: f64,
    ) -> Option<(f64, Scores)> {
        if direction.z <= 0.0 && self.paths.scene.options.plate != Plate::Open {
            return None;
        }
        let exact = (strength / self.rules.worth[lamp]).ln().max(0.0);
        let budget = exact - self.random.uniform_open().ln();
        let flight = self.paths.fly(from, direction, budget);
        let out = !matches!(flight.end, End::Met { .. });
        out.then(|| ((-flight.depth.min(exact)).exp(), flight.scores))
    }

    /// The plate below the cloth, as a diffuse surface.
    fn at_plate(&mut self, leg: &Leg, flight: &Flight) {
        let Plate::Diffuse(albedo) = self.paths.scene.options.plate else {
            return;
        };
        let fall = (self.paths.scene.grid.z_range()[0] - leg.origin.z) / leg.direction.z;
        let point = leg.origin + leg.direction * fall;
        if !point.is_finite() {
            return; // a horizontal ray never arrives
        }
        for index in 0..self.rules.lamps.len() {
            self.light_plate(index, leg, flight, point, albedo);
        }
        let (direction, pdf) = cosine_direction(self.random);
        let grown = times(leg.carried, albedo);
        let state = self.paths.scene.map.state(point, direction);
        let survival = self.rules.guide.survival(state, grown);
        if self.random.uniform() < survival {
            self.open.push(Leg {
                depth: leg.depth + 1,
                origin: point,
                direction,
                carried: grown.map(|g| g / survival),
                begun: Begun::Plate {
                    albedo,
                    factor: 1.0 / survival,
                    pdf,
                    scores: flight.scores,
                    state,
                },
            });
        }
    }

    fn light_plate(
        &mut self,
        index: usize,
        leg: &Leg,
        flight: &Flight,
        point: DVec3,
        albedo: [f64; CHANNELS],
    ) {
        let lamp: &Lamp = &self.rules.lamps[index];
        let Some(light) = lamp.sample(point, self.random) else {
            return;
        };
        let cosine = light.direction.z;
        if cosine <= 0.0 {
            return;
        }
        let pdf = cosine * FRAC_1_PI;
        let factor = lamp.normalized_radiance() * pdf / (light.pdf + pdf);
        let strength = factor * largest(times(leg.carried, albedo));
        let along = self.light_along(point, light.direction, index, strength);
        if let Some((through, scores)) = along {
            let scores = sum(&scores, &flight.scores);
            let reflected = scored(albedo.map(|a| a * factor * through), &scores);
            self.visitor
                .connect(leg.depth, index, event(&reflected, 1.0));
        }
    }
}

const _: () = assert!(MAX_ROWS >= 7, "a medium's parameters and its density");
