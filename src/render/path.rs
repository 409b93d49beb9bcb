//! One camera path through the fibers: next-event estimation to every lamp of a group, one bounce after another.
//!
//! How a hit becomes a scattering event (Khungurn 2015 does not say): at a hit on the segment with tangent `d`, `S` is
//! evaluated with both directions in the frame of `d` (`wo` back along the camera side of the path, `wi` toward the
//! light side) and weighted with `cos(theta_i)`, the cosine to the fiber's normal plane, not to the surface normal. The
//! new ray leaves as the model's [`Passage`] says. It does not see the segment it leaves nor that segment's two neighbors,
//! nor, when it runs on inside its fiber, the joints there; only rays entering a fiber count as hits, as fibers may overlap.
//!
//! All three channels travel on one path. Nothing is clamped; a path ends by roulette, by leaving, or on the plate under the
//! cloth when that is black.

use super::geometry::{Ended, Geometry, Hit, Skip};
use super::light::Lamp;
use super::scene::Plate;
use crate::math::{Frame, Random};
use crate::scatter::{CHANNELS, Evaluation, Passage, Scattering};
use glam::DVec3;
use std::f64::consts::{FRAC_1_PI, TAU};

/// One use of the scattering function along a path.
#[derive(Debug, Clone, Copy)]
pub(super) struct Event<'a> {
    /// Toward the light side of the path, fiber frame.
    #[cfg_attr(
        not(test),
        expect(dead_code, reason = "read by visitors that record paths")
    )]
    pub(super) wi: DVec3,
    /// Toward the camera side, fiber frame.
    #[cfg_attr(
        not(test),
        expect(dead_code, reason = "read by visitors that record paths")
    )]
    pub(super) wo: DVec3,
    /// Where across the fiber the camera side meets it, see [`Scattering`].
    #[expect(dead_code, reason = "read by visitors that record paths")]
    pub(super) h: f64,
    /// `S(wi, wo)` times everything that does not depend on the parameters (cosine, densities, roulette).
    pub(super) weight: [f64; CHANNELS],
    /// Value and derivatives of `S` at the two directions.
    pub(super) evaluation: &'a Evaluation,
}

/// Whoever follows a path: sums it up, or records it.
///
/// `depth` counts the events between the camera and this one, of fibers and of the plate. A path may branch: an event at
/// depth `n` continues the latest event before it that had depth `n - 1`.
pub(super) trait Visitor {
    /// The path goes on through this event.
    fn bounce(&mut self, depth: usize, event: Event<'_>);
    /// The path goes on through an event that depends on no parameter.
    fn reflect(&mut self, depth: usize, weight: [f64; CHANNELS]);
    /// A side branch through this event ends on a lamp; its normalized radiance is in the weight.
    fn connect(&mut self, depth: usize, lamp: usize, event: Event<'_>);
    /// The path itself, after `depth` events, arrived on a lamp; `factor` is the lamp's share.
    fn arrive(&mut self, depth: usize, lamp: usize, factor: [f64; CHANNELS]);
}

/// What a path needs to know that does not change from path to path.
pub(super) struct Stage<'a> {
    pub(super) geometry: &'a Geometry,
    pub(super) scattering: &'a dyn Scattering,
    pub(super) lamps: &'a [Lamp],
    /// Per lamp: connections that would add less than this are made with proportionally smaller probability.
    pub(super) worth: &'a [f64],
    pub(super) plate: Plate,
}

/// Least probability with which a path goes on, or a small connection is made.
const SURVIVAL_FLOOR: f64 = 0.05;

/// A ray of a path, with what it carries.
struct Leg {
    origin: DVec3,
    direction: DVec3,
    throughput: [f64; CHANNELS],
    skip: Skip,
    /// Whether it may run along inside the fiber it comes from, see [`Place::runs_within`].
    within: bool,
}

impl Stage<'_> {
    /// Follows the path that arrives at the camera along `-toward_camera` through the point `through` of the plane z = 0.
    pub(super) fn follow(
        &self,
        through: DVec3,
        toward_camera: DVec3,
        random: &mut Random,
        visitor: &mut impl Visitor,
    ) {
        let top = self.geometry.z_range()[1];
        let mut leg = Leg {
            origin: through + toward_camera * (top.max(0.0) / toward_camera.z),
            direction: -toward_camera,
            throughput: [1.0; CHANNELS],
            skip: Skip::NOTHING,
            within: false,
        };
        for depth in 0.. {
            let ended = if leg.within {
                self.geometry
                    .closest_from_within(leg.origin, leg.direction, &leg.skip)
            } else {
                self.geometry.closest(leg.origin, leg.direction, &leg.skip)
            };
            let next = match ended {
                Ended::Fiber(hit) => self.at_fiber(&leg, hit, depth, random, visitor),
                Ended::Down => self.at_plate(&leg, depth, random, visitor),
                Ended::Up => None,
            };
            match next {
                Some(next) => leg = next,
                None => return,
            }
        }
    }

    fn at_fiber(
        &self,
        leg: &Leg,
        hit: Hit,
        depth: usize,
        random: &mut Random,
        visitor: &mut impl Visitor,
    ) -> Option<Leg> {
        let place = Place::new(self, leg.origin, leg.direction, hit);
        let wo = place.frame.to_local(-leg.direction);
        self.connect_lamps(&place, wo, leg.throughput, depth, random, visitor);

        let sampled = self.scattering.sample(wo, place.h, random)?;
        let grown = times(leg.throughput, sampled.weight);
        let survival = largest(grown).clamp(SURVIVAL_FLOOR, 1.0);
        if random.uniform() >= survival {
            return None;
        }
        visitor.bounce(
            depth,
            Event {
                wi: sampled.wi,
                wo,
                h: place.h,
                weight: sampled.weight.map(|w| w / survival),
                evaluation: &sampled.evaluation,
            },
        );
        let direction = place.frame.to_world(sampled.wi);
        let next = Leg {
            origin: place.exit(direction),
            direction,
            throughput: grown.map(|g| g / survival),
            skip: self.geometry.skip(hit.image),
            within: place.runs_within(direction),
        };
        // Asked from the fiber's axis, as in `connect_lamps`, so that both strategies mean the same set of directions.
        self.arrive_on_lamps(
            &next,
            place.center,
            sampled.evaluation.pdf,
            depth + 1,
            visitor,
        );
        Some(next)
    }

    /// Next-event estimation: one point on each lamp, weighted against [`Stage::arrive_on_lamps`] by the balance
    /// heuristic.
    fn connect_lamps(
        &self,
        place: &Place,
        wo: DVec3,
        throughput: [f64; CHANNELS],
        depth: usize,
        random: &mut Random,
        visitor: &mut impl Visitor,
    ) {
        let skip = self.geometry.skip(place.hit.image);
        for (index, lamp) in self.lamps.iter().enumerate() {
            let Some(point) = lamp.sample(place.center, random) else {
                continue;
            };
            let wi = place.frame.to_local(point.direction);
            let (value, pdf) = self.scattering.value(wi, wo, place.h);
            let cosine = wi.y.hypot(wi.z);
            let factor = lamp.normalized_radiance() * cosine / (point.pdf + pdf);
            let worth = factor * largest(times(throughput, value));
            let odds = (worth / self.worth[index]).clamp(SURVIVAL_FLOOR, 1.0);
            if worth <= 0.0 || random.uniform() >= odds {
                continue;
            }
            let ray = (place.exit(point.direction), point.direction);
            if self.sees_light(ray, &skip, place.runs_within(point.direction)) {
                let evaluation = self.scattering.evaluate(wi, wo, place.h);
                visitor.connect(
                    depth,
                    index,
                    Event {
                        wi,
                        wo,
                        h: place.h,
                        weight: evaluation.value.map(|s| s * factor / odds),
                        evaluation: &evaluation,
                    },
                );
            }
        }
    }

    /// The leg that begins here may leave the cloth and meet a lamp: `from` is where the other strategy looks from.
    fn arrive_on_lamps(
        &self,
        leg: &Leg,
        from: DVec3,
        pdf: f64,
        depth: usize,
        visitor: &mut impl Visitor,
    ) {
        let mut free = None;
        for (index, lamp) in self.lamps.iter().enumerate() {
            let Some(lamp_pdf) = lamp.pdf(from, leg.direction) else {
                continue;
            };
            let sees = || self.sees_light((leg.origin, leg.direction), &leg.skip, leg.within);
            if *free.get_or_insert_with(sees) {
                let share = pdf / (pdf + lamp_pdf);
                visitor.arrive(depth, index, [lamp.normalized_radiance() * share; CHANNELS]);
            }
        }
    }

    /// Is there nothing between a point and a lamp in that direction? `within` as in [`Leg`].
    fn sees_light(&self, (origin, direction): (DVec3, DVec3), skip: &Skip, within: bool) -> bool {
        if direction.z <= 0.0 && self.plate != Plate::Open {
            return false;
        }
        if within {
            self.geometry.passes_from_within(origin, direction, skip)
        } else {
            self.geometry.passes(origin, direction, skip)
        }
    }

    /// The plate below the cloth, as a diffuse surface of the given albedo.
    fn at_plate(
        &self,
        leg: &Leg,
        depth: usize,
        random: &mut Random,
        visitor: &mut impl Visitor,
    ) -> Option<Leg> {
        let Plate::Diffuse(albedo) = self.plate else {
            return None;
        };
        let fall = (self.geometry.z_range()[0] - leg.origin.z) / leg.direction.z;
        let point = leg.origin + leg.direction * fall;
        if !point.is_finite() {
            return None;
        }
        for (index, lamp) in self.lamps.iter().enumerate() {
            let Some(light) = lamp.sample(point, random) else {
                continue;
            };
            let cosine = light.direction.z;
            if cosine > 0.0 && self.geometry.passes(point, light.direction, &Skip::NOTHING) {
                let factor = lamp.normalized_radiance() * cosine * FRAC_1_PI
                    / (light.pdf + cosine * FRAC_1_PI);
                visitor.arrive(depth, index, albedo.map(|a| a * factor));
            }
        }
        let survival = largest(times(leg.throughput, albedo)).clamp(SURVIVAL_FLOOR, 1.0);
        if random.uniform() >= survival {
            return None;
        }
        let weight = albedo.map(|a| a / survival);
        visitor.reflect(depth, weight);
        let (sin2, turn) = (random.uniform(), TAU * random.uniform());
        let cosine = (1.0 - sin2).sqrt();
        let direction = DVec3::new(sin2.sqrt() * turn.cos(), sin2.sqrt() * turn.sin(), cosine);
        let next = Leg {
            origin: point,
            direction,
            throughput: times(leg.throughput, weight),
            skip: Skip::NOTHING,
            within: false,
        };
        self.arrive_on_lamps(&next, point, cosine * FRAC_1_PI, depth + 1, visitor);
        Some(next)
    }
}

fn times(a: [f64; CHANNELS], b: [f64; CHANNELS]) -> [f64; CHANNELS] {
    std::array::from_fn(|c| a[c] * b[c])
}

fn largest(v: [f64; CHANNELS]) -> f64 {
    v[0].max(v[1]).max(v[2])
}

/// A hit, with the fiber's frame and cross-section.
struct Place {
    hit: Hit,
    frame: Frame,
    /// Point of the axis at the hit's longitudinal coordinate.
    center: DVec3,
    /// From there to the hit, perpendicular to the axis.
    offset: DVec3,
    /// Where across the fiber the ray met it, see [`Scattering`].
    h: f64,
    passage: Passage,
    /// Where along the segment, millimeters.
    along: f64,
    /// Between which coordinates along it no capsules reach but its own and its neighbors', millimeters.
    clear: [f64; 2],
}

impl Place {
    fn new(stage: &Stage<'_>, origin: DVec3, direction: DVec3, hit: Hit) -> Self {
        let (start, end, _) = stage.geometry.placed(hit.image);
        let passage = stage.scattering.passage();
        let tangent = (end - start).normalize_or(DVec3::X);
        let from_start = origin + direction * hit.distance - start;
        let along = from_start.dot(tangent);
        let offset = from_start - tangent * along;
        let frame = Frame::from_tangent(tangent);
        let (n, wo) = (frame.to_local(offset), frame.to_local(-direction));
        let area = (n.y.hypot(n.z)) * (wo.y.hypot(wo.z));
        let h = if area > 0.0 {
            ((n.y * wo.z - n.z * wo.y) / area).clamp(-1.0, 1.0)
        } else {
            0.0
        };
        Self {
            hit,
            frame,
            center: start + tangent * along,
            offset,
            h,
            passage,
            along,
            clear: match passage {
                Passage::Across => [f64::NEG_INFINITY, f64::INFINITY],
                Passage::Straight => stage.geometry.clear_range(hit.image),
            },
        }
    }

    /// May a ray toward `direction`, going straight on, meet others of its fiber's capsules before it leaves the cylinder?
    fn runs_within(&self, direction: DVec3) -> bool {
        let inward = -self.offset.dot(direction);
        if self.passage == Passage::Across || inward <= 0.0 {
            return false;
        }
        let lengthwise = direction.dot(self.frame.x);
        let run = lengthwise * 2.0 * inward;
        let across2 = 1.0 - lengthwise * lengthwise;
        let [low, high] = self.clear.map(|c| (c - self.along) * across2);
        run.min(0.0) < low || run.max(0.0) > high
    }

    /// Where a ray toward `direction` leaves the fiber.
    fn exit(&self, direction: DVec3) -> DVec3 {
        let surface = self.center + self.offset;
        if self.passage == Passage::Straight {
            return surface;
        }
        let across = direction - self.frame.x * direction.dot(self.frame.x);
        let length2 = across.length_squared();
        let inward = -self.offset.dot(across);
        if inward > 0.0 && length2 > 0.0 {
            surface + across * (2.0 * inward / length2)
        } else {
            surface
        }
    }
}
