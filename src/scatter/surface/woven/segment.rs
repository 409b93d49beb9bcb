//! What one yarn segment scatters: the integral over its highlight curve, split where it has kinks, with derivatives.
//!
//! `f = int G f_c A` (Irawan 2008 eq. 8.1), mm^2/rad for one segment. No shadowing between segments, no interreflection, no
//! transmission.

use super::highlight::Highlight;
use super::kinks::{End, FIT_SEARCH, Few, MARKS, Panel, REPORT_SEARCH, Search, visible_parts};
use super::shape::{Fade, Phase, SHAPE_ROWS, Shape, Spine};
use crate::base::Result;
use crate::math::{GaussLegendre, kronrod};
use glam::DVec3;

/// How the integral over the highlight curve is done.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Quality {
    /// A fixed rule on the visible parts of the curve: for searches.
    #[default]
    Fit,
    /// Halved until the estimated error is below [`TOLERANCE`] of the value: for what is reported.
    Report,
    /// The trapezoid with this many samples over all inclinations (staple) or all normals (filament), 11 in Irawan 2008
    /// sec. 8.3. Its derivatives are those of [`Quality::Fit`].
    Published(usize),
}

/// Relative error at which [`Quality::Report`] stops.
pub const TOLERANCE: f64 = 1e-6;

/// Most panels of [`Quality::Report`]; what error is left then is in the estimate.
const MOST_PANELS: usize = 64;

/// Points of the fixed rule on each visible part.
const FIT_POINTS: usize = 8;

/// An integral and an estimate of its error, above the true one in all but rare cases.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// The integral, mm^2/rad.
    pub value: f64,
    /// How far the value may be off.
    pub error: f64,
}

/// A yarn segment at a fixed shape.
#[derive(Debug, Clone)]
pub struct Segment {
    shape: Shape,
    spine: Spine,
    phase: Phase,
    fade: Option<Fade>,
    /// Radius of the yarn, a, mm.
    radius: f64,
    /// L: half the length that is left to the spine, mm.
    straight: f64,
    rule: GaussLegendre,
}

impl Segment {
    /// Prepares a shape.
    ///
    /// # Errors
    /// As [`Shape::check`].
    pub fn new(shape: Shape) -> Result<Self> {
        shape.check()?;
        let radius = 0.5 * shape.width;
        Ok(Self {
            shape,
            spine: Spine::new(shape.inclination, shape.curvature),
            phase: Phase::new(&shape),
            fade: Fade::new(&shape),
            radius,
            straight: 0.5 * shape.length - radius * shape.inclination.sin(),
            rule: GaussLegendre::new(FIT_POINTS),
        })
    }

    /// The shape it was made from.
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// Radius of curvature of the spine where it is inclined by u, millimeters.
    pub fn spine_radius(&self, u: f64) -> f64 {
        self.straight * self.spine.radius(u.sin())
    }

    /// The integral for directions in the segment's frame: unit vectors away from the surface, x across the yarn, y along it,
    /// z up. Zero when either is not above the surface.
    pub fn value(&self, wi: DVec3, wr: DVec3, quality: Quality) -> f64 {
        match quality {
            Quality::Fit => self.fixed(wi, wr),
            Quality::Report => self.estimate(wi, wr, TOLERANCE).value,
            Quality::Published(samples) => self.trapezoid(wi, wr, samples),
        }
    }

    /// The integral by the fixed rule.
    fn fixed(&self, wi: DVec3, wr: DVec3) -> f64 {
        let Some(highlight) = self.highlight(wi, wr) else {
            return unseen(wi, wr);
        };
        let panels = self.panels(&highlight, &FIT_SEARCH);
        let integral: f64 = panels
            .as_slice()
            .iter()
            .flat_map(|p| self.rule.on(p.low, p.high))
            .map(|(x, w)| w * self.integrand(&highlight, x))
            .sum();
        self.radius * self.phase.value(wi.dot(wr)).0 * integral
    }

    /// The integral to a relative error of `tolerance`, as far as [`MOST_PANELS`] parts allow, and an estimate of its error: the sum
    /// over the parts of the distance between a 7-point and a 15-point rule.
    pub fn estimate(&self, wi: DVec3, wr: DVec3, tolerance: f64) -> Estimate {
        let Some(highlight) = self.highlight(wi, wr) else {
            let value = unseen(wi, wr);
            return Estimate {
                value,
                error: value,
            };
        };
        let parts = self.refined(&highlight, tolerance);
        let factor = self.radius * self.phase.value(wi.dot(wr)).0;
        let sum = |pick: fn(&Part) -> f64| parts.as_slice().iter().map(pick).sum::<f64>();
        Estimate {
            value: factor * sum(|p| p.value),
            error: factor * sum(|p| p.error),
        }
    }

    /// The integral and its derivatives by the numbers of the [`Shape`], in their order. At a smoothing of 0 the derivative by it is
    /// the one to the right. For a twist of 0 without smoothing the integral jumps by the inclination where the highlight enters the
    /// segment; there no derivative exists.
    pub fn slopes(&self, wi: DVec3, wr: DVec3, quality: Quality) -> (f64, [f64; SHAPE_ROWS]) {
        let Some(highlight) = self.highlight(wi, wr) else {
            return (unseen(wi, wr), [unseen(wi, wr); SHAPE_ROWS]);
        };
        let mut sums = Sums::default();
        if quality == Quality::Report {
            let panels = self.panels(&highlight, &REPORT_SEARCH);
            self.add_ends(&highlight, panels.as_slice(), &mut sums);
            for part in self.refined(&highlight, TOLERANCE).as_slice() {
                for (x, w) in kronrod::nodes(part.low, part.high) {
                    self.add(&highlight, x, w, &mut sums);
                }
            }
        } else {
            let panels = self.panels(&highlight, &FIT_SEARCH);
            self.add_ends(&highlight, panels.as_slice(), &mut sums);
            for panel in panels.as_slice() {
                for (x, w) in self.rule.on(panel.low, panel.high) {
                    self.add(&highlight, x, w, &mut sums);
                }
            }
        }
        self.collect(&sums, self.phase.value(wi.dot(wr)))
    }

    fn highlight(&self, wi: DVec3, wr: DVec3) -> Option<Highlight> {
        let are_directions = !wi.is_nan() && !wr.is_nan();
        if are_directions && wi.z > 0.0 && wr.z > 0.0 {
            Highlight::new(&self.shape, wi, wr)
        } else {
            None
        }
    }

    /// `a (R + a cos v)`, mm^2.
    pub(super) fn band(&self, u: f64, cos_v: f64) -> f64 {
        self.radius * (self.spine_radius(u) + self.radius * cos_v)
    }

    /// The phase function times the smoothing of the highlight's ends.
    pub(super) fn phase_and_fade(&self, wi: DVec3, wr: DVec3, u: f64) -> f64 {
        self.phase.value(wi.dot(wr)).0 * self.fade.map_or(1.0, |f| f.value(u))
    }

    /// `G f_c A / (a f_c)` per unit of the curve's variable; zero where light or camera do not see the fiber.
    #[inline]
    fn integrand(&self, highlight: &Highlight, x: f64) -> f64 {
        let place = highlight.place(x);
        if !place.visible() {
            return 0.0;
        }
        let band = self.straight * self.spine.radius(place.sin_u) + self.radius * place.cos_v;
        let fade = self
            .fade
            .map_or(1.0, |f| f.value(place.sin_u.atan2(place.cos_u)));
        highlight.weight(&place) * fade * band
    }

    /// The visible parts of the curve.
    fn panels(&self, highlight: &Highlight, search: &Search) -> Few<Panel, MARKS> {
        let fades = (1.0 - self.shape.smoothing) * self.shape.inclination;
        visible_parts(highlight, search, self.fade.map(|_| fades))
    }

    /// Parts of the visible panels on which the 15-point rule is good enough, the worst halved first.
    fn refined(&self, highlight: &Highlight, tolerance: f64) -> Few<Part, MOST_PANELS> {
        let part = |low: f64, high: f64| {
            let (value, error) = kronrod::integrate(low, high, |x| self.integrand(highlight, x));
            Part {
                low,
                high,
                value,
                error,
            }
        };
        let mut parts: Few<Part, MOST_PANELS> = Few::new();
        for panel in self.panels(highlight, &REPORT_SEARCH).as_slice() {
            parts.push(part(panel.low, panel.high));
        }
        while parts.count > 0 && parts.count < MOST_PANELS {
            let (mut value, mut error, mut worst) = (0.0, 0.0, 0);
            for (k, p) in parts.as_slice().iter().enumerate() {
                value += p.value;
                error += p.error;
                if p.error > parts.items[worst].error {
                    worst = k;
                }
            }
            let Part { low, high, .. } = parts.items[worst];
            let middle = 0.5 * (low + high);
            if error <= tolerance * value || !(low < middle && middle < high) {
                break;
            }
            parts.items[worst] = part(low, middle);
            parts.push(part(middle, high));
        }
        parts
    }

    /// Adds one node of the integrals behind [`Segment::slopes`].
    fn add(&self, highlight: &Highlight, x: f64, w: f64, sums: &mut Sums) {
        let place = highlight.place(x);
        if !place.visible() {
            return;
        }
        let weight = highlight.weight(&place);
        let spine = self.spine.slopes(place.sin_u, place.cos_u);
        let twist = highlight.by_twist(&place, weight);
        let band = self.straight * spine.value + self.radius * place.cos_v;
        let mut fade = 1.0;
        let mut fade_by_twist = 0.0;
        if let Some(f) = self.fade {
            let f = f.slopes(place.sin_u.atan2(place.cos_u));
            fade = f.value;
            fade_by_twist = f.by_u * twist.u;
            sums.by_inclination += w * weight * f.by_inclination * band;
            sums.by_smoothing += w * weight * f.by_smoothing * band;
        }
        let wf = w * weight * fade;
        sums.spine += wf * spine.value;
        sums.tube += wf * place.cos_v;
        sums.by_inclination += wf * self.straight * spine.by_inclination;
        sums.by_curvature += wf * self.straight * spine.by_curvature;
        sums.by_twist += w * (twist.weight * fade + weight * fade_by_twist) * band
            + wf * (self.straight * spine.by_u * twist.u + self.radius * twist.cos_v);
    }

    /// Adds what the derivatives gain because the ends of the curve move.
    fn add_ends(&self, highlight: &Highlight, panels: &[Panel], sums: &mut Sums) {
        for panel in panels {
            for (x, end, outward) in [
                (panel.low, panel.low_end, -1.0),
                (panel.high, panel.high_end, 1.0),
            ] {
                if end == End::Still {
                    continue;
                }
                let place = highlight.place(x);
                // Rounding may have turned the end's fiber out of sight.
                let value = self.integrand(highlight, x.midpoint(x - outward * 1e-9));
                if end == End::Turned {
                    sums.by_twist += outward * value * highlight.turn_by_twist(&place);
                    continue;
                }
                let by_u = highlight.by_u(&place);
                sums.by_twist += outward * value * highlight.end_by_twist(&place);
                sums.by_inclination += value * by_u;
                if self.fade.is_none() {
                    sums.by_smoothing -= 0.5 * self.shape.inclination * value * by_u;
                }
            }
        }
    }

    fn collect(
        &self,
        sums: &Sums,
        (phase, phase_by_forward): (f64, f64),
    ) -> (f64, [f64; SHAPE_ROWS]) {
        let (a, straight) = (self.radius, self.straight);
        let (sin, cos) = self.shape.inclination.sin_cos();
        let integral = a * (straight * sums.spine + a * sums.tube);
        let scale = a * phase;
        let by_radius = straight * sums.spine + 2.0 * a * sums.tube - a * sin * sums.spine;
        let slopes = Shape {
            twist: scale * sums.by_twist * 1.0_f64.copysign(self.shape.twist),
            inclination: scale * (sums.by_inclination - a * cos * sums.spine),
            curvature: scale * sums.by_curvature,
            uniform: integral,
            forward: integral * phase_by_forward,
            smoothing: scale * sums.by_smoothing,
            width: 0.5 * phase * by_radius,
            length: 0.5 * scale * sums.spine,
        };
        (phase * integral, slopes.numbers())
    }
}

/// A part of a panel with its integral.
#[derive(Debug, Clone, Copy, Default)]
struct Part {
    low: f64,
    high: f64,
    value: f64,
    error: f64,
}

/// The integrals behind value and derivatives, over `a f_c`.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    /// Of R/L, and of cos v.
    spine: f64,
    tube: f64,
    by_twist: f64,
    by_inclination: f64,
    by_curvature: f64,
    by_smoothing: f64,
}

/// Zero, or NaN for directions that are none.
fn unseen(wi: DVec3, wr: DVec3) -> f64 {
    if wi.is_nan() || wr.is_nan() {
        f64::NAN
    } else {
        0.0
    }
}
