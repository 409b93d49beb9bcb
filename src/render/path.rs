//! One camera path through the fibers: next-event estimation to every lamp of a group, one bounce after another.
//!
//! How a hit becomes a scattering event (Khungurn 2015 does not say): at a hit on the segment with tangent `d`, `S` is
//! evaluated with both directions in the frame of `d` (`wo` back along the camera side of the path, `wi` toward the
//! light side) and weighted with `cos(theta_i)`, the cosine to the fiber's normal plane, not to the surface normal. The
//! new ray leaves at the same longitudinal coordinate, at the far side of the circular cross-section along the new
//! direction's azimuth (where it arrived, if the direction points outward there). It does not see the segment it leaves
//! nor that segment's two neighbors, and only rays entering a fiber count as hits, as fibers may overlap.
//!
//! All three channels travel on one path. Nothing is clamped; a path ends by roulette, by leaving, or on the black plate
//! under the cloth.

use super::geometry::{Ended, Geometry, Hit};
use super::light::Lamp;
use crate::math::{Frame, Random};
use crate::scatter::{CHANNELS, Evaluation, Scattering};
use glam::DVec3;

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
    /// `S(wi, wo)` times everything that does not depend on the parameters (cosine, densities, roulette).
    pub(super) weight: [f64; CHANNELS],
    /// Value and derivatives of `S` at the two directions.
    pub(super) evaluation: &'a Evaluation,
}

/// Whoever follows a path: sums it up, or records it.
pub(super) trait Visitor {
    /// The path goes on through this event.
    fn bounce(&mut self, event: Event<'_>);
    /// A side branch through this event ends on a lamp; its normalized radiance is in the weight.
    fn connect(&mut self, lamp: usize, event: Event<'_>);
    /// The path itself arrived on a lamp; `factor` is the lamp's share.
    fn arrive(&mut self, lamp: usize, factor: f64);
}

/// What a path needs to know that does not change from path to path.
pub(super) struct Stage<'a> {
    pub(super) geometry: &'a Geometry,
    pub(super) scattering: &'a dyn Scattering,
    pub(super) lamps: &'a [Lamp],
    /// Per lamp: connections that would add less than this are made with proportionally smaller probability.
    pub(super) worth: &'a [f64],
}

/// Least probability with which a path goes on, or a small connection is made.
const SURVIVAL_FLOOR: f64 = 0.05;

impl Stage<'_> {
    /// Follows the path that arrives at the camera along `-toward_camera` through the point `through` of the plane z = 0.
    pub(super) fn follow(
        &self,
        through: DVec3,
        toward_camera: DVec3,
        random: &mut Random,
        visitor: &mut impl Visitor,
    ) {
        let mut direction = -toward_camera;
        let top = self.geometry.z_range()[1];
        let mut origin = through + toward_camera * (top.max(0.0) / toward_camera.z);
        let mut throughput = [1.0; CHANNELS];
        let mut ended = self
            .geometry
            .closest(origin, direction, &super::geometry::Skip::NOTHING);
        while let Ended::Fiber(hit) = ended {
            let place = Place::new(self.geometry, origin, direction, hit);
            let wo = place.frame.to_local(-direction);
            self.connect_lamps(&place, wo, throughput, random, visitor);

            let Some(sampled) = self.scattering.sample(wo, random) else {
                return;
            };
            let grown: [f64; CHANNELS] = std::array::from_fn(|c| throughput[c] * sampled.weight[c]);
            let survival = largest(grown).clamp(SURVIVAL_FLOOR, 1.0);
            if random.uniform() >= survival {
                return;
            }
            let weight = sampled.weight.map(|w| w / survival);
            visitor.bounce(Event {
                wi: sampled.wi,
                wo,
                weight,
                evaluation: &sampled.evaluation,
            });
            throughput = grown.map(|g| g / survival);

            direction = place.frame.to_world(sampled.wi);
            origin = place.exit(direction);
            ended = self
                .geometry
                .closest(origin, direction, &self.geometry.skip(hit.image));
            if matches!(ended, Ended::Up) {
                self.arrive_on_lamps(place.center, direction, sampled.evaluation.pdf, visitor);
            }
        }
    }

    /// Next-event estimation: one point on each lamp, weighted against [`Stage::arrive_on_lamps`] by the balance
    /// heuristic.
    fn connect_lamps(
        &self,
        place: &Place,
        wo: DVec3,
        throughput: [f64; CHANNELS],
        random: &mut Random,
        visitor: &mut impl Visitor,
    ) {
        for (index, lamp) in self.lamps.iter().enumerate() {
            let Some(point) = lamp.sample(place.center, random) else {
                continue;
            };
            let wi = place.frame.to_local(point.direction);
            let evaluation = self.scattering.evaluate(wi, wo);
            let cosine = wi.y.hypot(wi.z);
            let factor = lamp.normalized_radiance() * cosine / (point.pdf + evaluation.pdf);
            let worth =
                factor * largest(std::array::from_fn(|c| throughput[c] * evaluation.value[c]));
            let odds = (worth / self.worth[index]).clamp(SURVIVAL_FLOOR, 1.0);
            if worth <= 0.0 || random.uniform() >= odds {
                continue;
            }
            let skip = self.geometry.skip(place.hit.image);
            if self
                .geometry
                .reaches_sky(place.exit(point.direction), point.direction, &skip)
            {
                let weight = evaluation.value.map(|s| s * factor / odds);
                visitor.connect(
                    index,
                    Event {
                        wi,
                        wo,
                        weight,
                        evaluation: &evaluation,
                    },
                );
            }
        }
    }

    /// The sampled direction left the cloth: does it meet a lamp? Asked from the fiber's axis, as in
    /// [`Stage::connect_lamps`], so that both strategies mean exactly the same set of directions.
    fn arrive_on_lamps(
        &self,
        origin: DVec3,
        direction: DVec3,
        pdf: f64,
        visitor: &mut impl Visitor,
    ) {
        for (index, lamp) in self.lamps.iter().enumerate() {
            if let Some(lamp_pdf) = lamp.pdf(origin, direction) {
                visitor.arrive(index, lamp.normalized_radiance() * pdf / (pdf + lamp_pdf));
            }
        }
    }
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
}

impl Place {
    fn new(geometry: &Geometry, origin: DVec3, direction: DVec3, hit: Hit) -> Self {
        let (start, end, _) = geometry.placed(hit.image);
        let tangent = (end - start).normalize_or(DVec3::X);
        let from_start = origin + direction * hit.distance - start;
        let along = from_start.dot(tangent);
        Self {
            hit,
            frame: Frame::from_tangent(tangent),
            center: start + tangent * along,
            offset: from_start - tangent * along,
        }
    }

    /// Where a ray toward `direction` leaves the cross-section.
    fn exit(&self, direction: DVec3) -> DVec3 {
        let across = direction - self.frame.x * direction.dot(self.frame.x);
        let length2 = across.length_squared();
        let inward = -self.offset.dot(across);
        let chord = if inward > 0.0 && length2 > 0.0 {
            across * (2.0 * inward / length2)
        } else {
            DVec3::ZERO
        };
        self.center + self.offset + chord
    }
}
