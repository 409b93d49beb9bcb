//! One camera path through the fibers: next-event estimation to every lamp of a group, one bounce after another.
//!
//! How a hit becomes a scattering event (Khungurn 2015 does not say): at a hit on the segment with tangent `d`, `S` is
//! evaluated with both directions in the frame of `d` (`wo` back along the camera side of the path, `wi` toward the
//! light side) and weighted with `cos(theta_i)`, the cosine to the fiber's normal plane, not to the surface normal. The
//! new ray leaves as the model's [`Passage`] says. It does not see the segment it leaves nor that segment's two neighbors,
//! nor, when it runs on inside its fiber, the joints there; only rays entering a fiber count as hits, as fibers may overlap.
//!
//! All three channels travel on one path, and lobes are chosen by what the channels still carry. Nothing is clamped; a path
//! branches and ends as a [`Guide`] advises, and ends by leaving or on the plate under the cloth when that is black.

use super::geometry::{Ended, Geometry, Hit, Skip};
use super::guide::{Guide, StateMap};
use super::light::Lamp;
use super::scene::Plate;
use crate::math::{Frame, Random};
use crate::scatter::{CHANNELS, Evaluation, Outgoing, Passage, Scattering};
use glam::DVec3;
use std::f64::consts::{FRAC_1_PI, TAU};

/// One use of the scattering function along a path.
#[derive(Debug, Clone, Copy)]
pub(super) struct Event<'a> {
    /// Toward the light side of the path, fiber frame.
    pub(super) wi: DVec3,
    /// Toward the camera side, fiber frame.
    pub(super) wo: DVec3,
    /// Where across the fiber the camera side meets it, see [`Scattering`].
    pub(super) h: f64,
    /// Which of [`Stage::sets`] the fiber has.
    pub(super) set: usize,
    /// Everything that does not depend on the parameters: cosine, densities, roulette, the lamp's radiance.
    pub(super) factor: f64,
    /// Value and derivatives of `S` at the two directions.
    pub(super) evaluation: &'a Evaluation,
}

impl Event<'_> {
    /// What light is multiplied with on its way through this event: `S` times the factor.
    pub(super) fn weight(&self) -> [f64; CHANNELS] {
        self.evaluation.value.map(|s| s * self.factor)
    }
}

/// Whoever follows a path: sums it up, or records it.
///
/// `depth` counts the events between the camera and this one, of fibers and of the plate. A path branches: an event at
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
    /// After its latest bounce or reflection, the event number `depth`, the path sets out in a state of the guide.
    fn set_out(&mut self, _depth: usize, _state: usize) {}
}

/// What a path needs to know that does not change from path to path.
pub(super) struct Stage<'a> {
    pub(super) geometry: &'a Geometry,
    /// The scattering functions: of all fibers, or of each yarn system's.
    pub(super) sets: &'a [Box<dyn Scattering + 'a>],
    pub(super) lamps: &'a [Lamp],
    /// Per lamp: connections that would add less than this are made with proportionally smaller probability.
    pub(super) worth: &'a [f64],
    pub(super) plate: Plate,
    pub(super) map: &'a StateMap,
    pub(super) guide: &'a Guide,
}

/// Least probability with which a small connection is made.
pub(super) const CONNECTION_FLOOR: f64 = 0.01;

/// Steps of the two-dimensional lattice of Roberts 2018 (powers of the inverse plastic number) for points on a lamp.
const LATTICE: [f64; 2] = [0.754_877_666_246_692_8, 0.569_840_290_998_053_3];

/// A ray of a path, with what it carries and how it began.
struct Leg {
    /// Events before it.
    depth: usize,
    origin: DVec3,
    direction: DVec3,
    /// What it carries, as [`Scattering::importance`] has it: it decides what is followed, not what is found.
    carried: [f64; CHANNELS],
    skip: Skip,
    /// Whether it may run along inside a fiber, see [`Place::runs_within`].
    within: bool,
    begun: Begun,
}

impl Leg {
    fn is_finite(&self) -> bool {
        let carried = self.carried.iter().all(|c| c.is_finite());
        carried && self.direction.is_finite() && self.origin.is_finite()
    }
}

/// How a leg began.
enum Begun {
    Camera,
    Fiber(Scatter),
    Plate {
        weight: [f64; CHANNELS],
        pdf: f64,
        from: DVec3,
        state: usize,
    },
}

/// A sampled scattering that goes on.
struct Scatter {
    wi: DVec3,
    wo: DVec3,
    h: f64,
    set: usize,
    factor: f64,
    pdf: f64,
    /// The fiber's axis, from where lamps are looked for.
    from: DVec3,
    state: usize,
}

impl Stage<'_> {
    /// Follows the path that arrives at the camera along `-toward_camera` through the point `through` of the plane z = 0,
    /// with all its branches.
    pub(super) fn follow(
        &self,
        through: DVec3,
        toward_camera: DVec3,
        random: &mut Random,
        visitor: &mut impl Visitor,
    ) {
        let top = self.geometry.z_range()[1];
        let mut open = vec![Leg {
            depth: 0,
            origin: through + toward_camera * (top.max(0.0) / toward_camera.z),
            direction: -toward_camera,
            carried: [1.0; CHANNELS],
            skip: Skip::NOTHING,
            within: false,
            begun: Begun::Camera,
        }];
        while let Some(leg) = open.pop() {
            if !leg.is_finite() {
                // Found in the result, and reported there.
                (0..self.lamps.len())
                    .for_each(|lamp| visitor.arrive(0, lamp, [f64::NAN; CHANNELS]));
                return;
            }
            self.begin(&leg, visitor);
            let ended = if leg.within {
                (self.geometry).closest_from_within(leg.origin, leg.direction, &leg.skip)
            } else {
                self.geometry.closest(leg.origin, leg.direction, &leg.skip)
            };
            match ended {
                Ended::Fiber(hit) => self.at_fiber(&leg, hit, random, visitor, &mut open),
                Ended::Down => self.at_plate(&leg, random, visitor, &mut open),
                Ended::Up => {}
            }
        }
    }

    /// Which of [`Stage::sets`] the fiber has that was hit.
    fn set_of(&self, hit: Hit) -> usize {
        match self.sets {
            [_] => 0,
            _ => self.geometry.system(hit.image),
        }
    }

    /// Tells of the event with which a leg begins, and of lamps it may meet.
    fn begin(&self, leg: &Leg, visitor: &mut impl Visitor) {
        match &leg.begun {
            Begun::Camera => {}
            Begun::Fiber(s) => {
                let evaluation = self.sets[s.set].evaluate(s.wi, s.wo, s.h);
                let event = Event {
                    wi: s.wi,
                    wo: s.wo,
                    h: s.h,
                    set: s.set,
                    factor: s.factor,
                    evaluation: &evaluation,
                };
                visitor.bounce(leg.depth - 1, event);
                visitor.set_out(leg.depth, s.state);
                self.arrive_on_lamps(leg, s.from, s.pdf, visitor);
            }
            Begun::Plate {
                weight,
                pdf,
                from,
                state,
            } => {
                visitor.reflect(leg.depth - 1, *weight);
                visitor.set_out(leg.depth, *state);
                self.arrive_on_lamps(leg, *from, *pdf, visitor);
            }
        }
    }

    /// Connects a hit to the lamps, and goes on in a few of the sampled directions, see [`Guide`].
    fn at_fiber(
        &self,
        leg: &Leg,
        hit: Hit,
        random: &mut Random,
        visitor: &mut impl Visitor,
        open: &mut Vec<Leg>,
    ) {
        let place = Place::new(self, leg.origin, leg.direction, hit);
        let wo = place.frame.to_local(-leg.direction);
        let scattering = &*self.sets[place.set];
        let outgoing = scattering.outgoing(wo, place.h, leg.carried);
        self.connect_lamps(&place, &outgoing, leg, random, visitor);

        let candidates = self.guide.candidates();
        let share = 1.0 / candidates as f64;
        let skip = self.geometry.skip(hit.image);
        let mut comb = Comb::new(random);
        for _ in 0..candidates {
            let Some(sampled) = scattering.sample(&outgoing, random) else {
                continue;
            };
            let direction = place.frame.to_world(sampled.wi);
            let grown = times(leg.carried, sampled.weight.map(|w| w * share));
            let state = self.map.state(place.center, direction);
            let survival = self.guide.survival(state, grown);
            if !comb.takes(survival) {
                continue;
            }
            open.push(Leg {
                depth: leg.depth + 1,
                origin: place.exit(direction),
                direction,
                carried: grown.map(|g| g / survival),
                skip,
                within: place.runs_within(),
                begun: Begun::Fiber(Scatter {
                    wi: sampled.wi,
                    wo,
                    h: place.h,
                    set: place.set,
                    factor: across(sampled.wi) / sampled.pdf * share / survival,
                    pdf: sampled.pdf,
                    from: place.center,
                    state,
                }),
            });
        }
    }

    /// Next-event estimation, weighted against [`Stage::arrive_on_lamps`] by the balance heuristic: where a lobe is narrower
    /// than a lamp, several of the lamp's points are looked at and one of them, chosen in proportion to what it would add,
    /// is asked whether it is seen (resampled importance sampling, Talbot 2005).
    fn connect_lamps(
        &self,
        place: &Place,
        o: &Outgoing,
        leg: &Leg,
        random: &mut Random,
        visitor: &mut impl Visitor,
    ) {
        let skip = self.geometry.skip(place.hit.image);
        let scattering = &*self.sets[place.set];
        for (index, lamp) in self.lamps.iter().enumerate() {
            let toward = place.frame.to_local(lamp.toward());
            let points = scattering.light_points(toward, o, lamp.half_angle());
            let shift = [random.uniform(), random.uniform()];
            let (mut sum, mut chosen) = (0.0, None);
            for k in 0..points {
                let uv = std::array::from_fn(|i| (shift[i] + k as f64 * LATTICE[i]).fract());
                let Some(point) = lamp.point(place.center, uv) else {
                    continue;
                };
                let wi = place.frame.to_local(point.direction);
                let (value, pdf) = scattering.importance(wi, o);
                let cosine = across(wi);
                let factor =
                    lamp.normalized_radiance() * cosine / (point.pdf + pdf) / points as f64;
                let worth = factor * largest(times(leg.carried, value));
                if worth <= 0.0 {
                    continue;
                }
                sum += worth;
                // What is not a number goes on and is found in the result.
                if points == 1 || worth.is_nan() || random.uniform() * sum < worth {
                    chosen = Some((point.direction, wi, factor, worth));
                }
            }
            let Some((direction, wi, factor, worth)) = chosen else {
                continue;
            };
            let odds = (sum / self.worth[index]).clamp(CONNECTION_FLOOR, 1.0);
            if random.uniform() >= odds {
                continue;
            }
            let ray = (place.exit(direction), direction);
            if !self.sees_light(ray, &skip, place.runs_within()) {
                continue;
            }
            let evaluation = scattering.evaluate(wi, o.wo, o.h);
            let event = Event {
                wi,
                wo: o.wo,
                h: o.h,
                set: place.set,
                // Not over worth * odds, which may underflow to zero.
                factor: factor * (sum / worth) / odds,
                evaluation: &evaluation,
            };
            visitor.connect(leg.depth, index, event);
        }
    }

    /// The leg that begins here may leave the cloth and meet a lamp: `from` is where the other strategy looks from, so that
    /// both mean the same set of directions.
    fn arrive_on_lamps(&self, leg: &Leg, from: DVec3, pdf: f64, visitor: &mut impl Visitor) {
        let mut free = None;
        for (index, lamp) in self.lamps.iter().enumerate() {
            let Some(lamp_pdf) = lamp.pdf(from, leg.direction) else {
                continue;
            };
            let sees = || self.sees_light((leg.origin, leg.direction), &leg.skip, leg.within);
            if *free.get_or_insert_with(sees) {
                let share = pdf / (pdf + lamp_pdf);
                let factor = [lamp.normalized_radiance() * share; CHANNELS];
                visitor.arrive(leg.depth, index, factor);
            }
        }
    }

    /// Is there nothing between a point and a lamp in that direction? `within` as in [`Leg`].
    fn sees_light(&self, (origin, direction): (DVec3, DVec3), skip: &Skip, within: bool) -> bool {
        if direction.z <= 0.0 && self.plate != Plate::Open {
            return false;
        }
        if within {
            (self.geometry).passes_from_within(origin, direction, skip)
        } else {
            self.geometry.passes(origin, direction, skip)
        }
    }

    /// The plate below the cloth, as a diffuse surface of the given albedo.
    fn at_plate(
        &self,
        leg: &Leg,
        random: &mut Random,
        visitor: &mut impl Visitor,
        open: &mut Vec<Leg>,
    ) {
        let Plate::Diffuse(albedo) = self.plate else {
            return;
        };
        let fall = (self.geometry.z_range()[0] - leg.origin.z) / leg.direction.z;
        let point = leg.origin + leg.direction * fall;
        if !point.is_finite() {
            return; // a horizontal ray never arrives
        }
        for (index, lamp) in self.lamps.iter().enumerate() {
            let Some(light) = lamp.sample(point, random) else {
                continue;
            };
            let cosine = light.direction.z;
            if cosine > 0.0 && self.geometry.passes(point, light.direction, &Skip::NOTHING) {
                let pdf = cosine * FRAC_1_PI;
                let factor = lamp.normalized_radiance() * pdf / (light.pdf + pdf);
                visitor.arrive(leg.depth, index, albedo.map(|a| a * factor));
            }
        }
        let (direction, pdf) = cosine_direction(random);
        let grown = times(leg.carried, albedo);
        let state = self.map.state(point, direction);
        let survival = self.guide.survival(state, grown);
        if random.uniform() < survival {
            open.push(Leg {
                depth: leg.depth + 1,
                origin: point,
                direction,
                carried: grown.map(|g| g / survival),
                skip: Skip::NOTHING,
                within: false,
                begun: Begun::Plate {
                    weight: albedo.map(|a| a / survival),
                    pdf,
                    from: point,
                    state,
                },
            });
        }
    }
}

/// Systematic resampling: of candidates taken with given probabilities, as nearly as possible the expected number is taken.
pub(super) struct Comb {
    sum: f64,
    next: f64,
}

impl Comb {
    pub(super) fn new(random: &mut Random) -> Self {
        Self {
            sum: 0.0,
            next: random.uniform(),
        }
    }

    pub(super) fn takes(&mut self, probability: f64) -> bool {
        self.sum += probability;
        // What is not a number goes on and is found in the result.
        let taken = self.sum > self.next || self.sum.is_nan();
        if taken {
            self.next += 1.0;
        }
        taken
    }
}

pub(super) fn times(a: [f64; CHANNELS], b: [f64; CHANNELS]) -> [f64; CHANNELS] {
    std::array::from_fn(|c| a[c] * b[c])
}

/// A direction above the horizon with density `cos / pi`, and that density, 1/sr.
pub(super) fn cosine_direction(random: &mut Random) -> (DVec3, f64) {
    let (sin2, turn) = (random.uniform(), TAU * random.uniform());
    let cosine = (1.0 - sin2).sqrt();
    let direction = DVec3::new(sin2.sqrt() * turn.cos(), sin2.sqrt() * turn.sin(), cosine);
    (direction, cosine * FRAC_1_PI)
}

/// The largest; not a number if one of them is none.
pub(super) fn largest(v: [f64; CHANNELS]) -> f64 {
    let none = v.iter().find(|x| x.is_nan()).copied();
    none.unwrap_or(v[0].max(v[1]).max(v[2]))
}

/// Length of a vector's part across the fiber; of a unit vector the cosine to the fiber's normal plane.
fn across(w: DVec3) -> f64 {
    (w.y * w.y + w.z * w.z).sqrt()
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
    /// Which of [`Stage::sets`] it has.
    set: usize,
    passage: Passage,
}

impl Place {
    fn new(stage: &Stage<'_>, origin: DVec3, direction: DVec3, hit: Hit) -> Self {
        let (start, end, _) = stage.geometry.placed(hit.image);
        let tangent = (end - start).normalize_or(DVec3::X);
        let from_start = origin + direction * hit.distance - start;
        let along = from_start.dot(tangent);
        let offset = from_start - tangent * along;
        let frame = Frame::from_tangent(tangent);
        let (n, wo) = (frame.to_local(offset), frame.to_local(-direction));
        let area = across(n) * across(wo);
        let h = if area > 0.0 {
            ((n.y * wo.z - n.z * wo.y) / area).clamp(-1.0, 1.0)
        } else {
            0.0
        };
        let set = stage.set_of(hit);
        Self {
            hit,
            frame,
            center: start + tangent * along,
            offset,
            h,
            set,
            passage: stage.sets[set].passage(),
        }
    }

    /// Whether rays from here may run along inside fibers: the one that was hit, or one that overlaps it.
    fn runs_within(&self) -> bool {
        self.passage == Passage::Straight
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
