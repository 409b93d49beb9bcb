//! The square area light, sampled by area.

use crate::math::{PolarDirection, Random};
use glam::DVec3;
use std::f64::consts::PI;

/// Size and distance of the light: a square that faces the sample center, two of its edges horizontal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LightShape {
    /// Side of the square, millimeters.
    pub side: f64,
    /// Distance from the sample center to the square's center, millimeters.
    pub distance: f64,
}

impl Default for LightShape {
    /// 10 cm x 10 cm at 61 cm (Khungurn 2015, section 5.2).
    fn default() -> Self {
        Self {
            side: 100.0,
            distance: 610.0,
        }
    }
}

/// A light in place, in the sample frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Lamp {
    center: DVec3,
    /// Half edges of the square.
    half_u: DVec3,
    half_v: DVec3,
    /// Of the circle through its corners, seen from the sample center.
    half_angle: f64,
    /// Toward the sample.
    normal: DVec3,
    area: f64,
    /// Irradiance at the sample center on a plane facing the light, per unit radiance, steradian.
    normal_irradiance: f64,
}

/// A point on the light seen from somewhere.
pub(super) struct LampSample {
    /// Unit vector toward the point.
    pub(super) direction: DVec3,
    /// Density per solid angle with which area sampling chooses that direction, 1/sr.
    pub(super) pdf: f64,
}

impl Lamp {
    pub(super) fn new(shape: LightShape, toward: PolarDirection) -> Self {
        let w = toward.vector();
        let (st, ct) = toward.theta.sin_cos();
        let (sp, cp) = toward.phi.sin_cos();
        let half = 0.5 * shape.side;
        Self {
            center: w * shape.distance,
            half_u: DVec3::new(-sp, cp, 0.0) * half,
            half_v: DVec3::new(ct * cp, ct * sp, -st) * half,
            half_angle: (half * std::f64::consts::SQRT_2 / shape.distance).atan(),
            normal: -w,
            area: shape.side * shape.side,
            normal_irradiance: normal_irradiance(shape),
        }
    }

    /// A uniform point of the square, seen from `from`; `None` when `from` is behind the light.
    pub(super) fn sample(&self, from: DVec3, random: &mut Random) -> Option<LampSample> {
        self.point(from, [random.uniform(), random.uniform()])
    }

    /// Unit vector from the sample center to the light's center.
    pub(super) fn toward(&self) -> DVec3 {
        -self.normal
    }

    pub(super) fn half_angle(&self) -> f64 {
        self.half_angle
    }

    /// The point of the square at `uv` in the unit square.
    pub(super) fn point(&self, from: DVec3, uv: [f64; 2]) -> Option<LampSample> {
        let u = 2.0 * uv[0] - 1.0;
        let v = 2.0 * uv[1] - 1.0;
        let to = self.center + self.half_u * u + self.half_v * v - from;
        let distance2 = to.length_squared();
        let direction = to / distance2.sqrt();
        let cosine = -direction.dot(self.normal);
        (cosine > 0.0).then(|| LampSample {
            direction,
            pdf: distance2 / (self.area * cosine),
        })
    }

    /// The density [`Lamp::sample`] has for `direction` if that ray meets the light; `None` if it misses.
    pub(super) fn pdf(&self, from: DVec3, direction: DVec3) -> Option<f64> {
        let cosine = -direction.dot(self.normal);
        if cosine <= 0.0 {
            return None;
        }
        let distance = (from - self.center).dot(self.normal) / cosine;
        let on_plane = from + direction * distance - self.center;
        let inside = |half: DVec3| on_plane.dot(half).abs() <= half.length_squared();
        (distance > 0.0 && inside(self.half_u) && inside(self.half_v))
            .then(|| distance * distance / (self.area * cosine))
    }

    /// Normalized radiance `pi L / E_normal` that this light itself has: `pi` over its normal irradiance per radiance.
    pub(super) fn normalized_radiance(&self) -> f64 {
        PI / self.normal_irradiance
    }
}

/// Irradiance per unit radiance at distance `d` on the axis of a square of side `s`, on a plane facing it:
/// the form factor of a parallel square times pi (Siegel and Howell, configuration of a differential element to a
/// parallel rectangle, four quarters).
fn normal_irradiance(shape: LightShape) -> f64 {
    let x = 0.5 * shape.side / shape.distance;
    let root = (1.0 + x * x).sqrt();
    // Each quarter contributes (1 / 2 pi) 2 (x / root) atan(x / root); times 4 quarters, times pi.
    4.0 * (x / root) * (x / root).atan()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normal_irradiance_is_the_stated_fraction_of_a_point_light() {
        let shape = LightShape::default();
        let point = shape.side * shape.side / (shape.distance * shape.distance);
        assert!((normal_irradiance(shape) / point - 0.9911).abs() < 1e-4);
    }

    #[test]
    fn area_sampling_integrates_to_the_irradiance_at_grazing_elevation() {
        let lamp = Lamp::new(
            LightShape::default(),
            PolarDirection::from_degrees(80.0, 30.0),
        );
        let mut random = Random::keyed(&[11]);
        let facing = PolarDirection::from_degrees(80.0, 30.0).vector();
        let n = 100_000;
        let (mut irradiance, mut solid_angle) = (0.0, 0.0);
        for _ in 0..n {
            let s = lamp.sample(DVec3::ZERO, &mut random).unwrap();
            let back = lamp.pdf(DVec3::ZERO, s.direction).unwrap();
            assert!((back / s.pdf - 1.0).abs() < 1e-9);
            irradiance += s.direction.dot(facing) / s.pdf / f64::from(n);
            solid_angle += 1.0 / s.pdf / f64::from(n);
        }
        // The integrand varies by 1 %, so 1e-4 is more than 5 standard errors.
        assert!(
            (irradiance / normal_irradiance(LightShape::default()) - 1.0).abs() < 1e-4,
            "{irradiance}"
        );
        assert!((solid_angle - 0.02670).abs() < 1e-5, "{solid_angle}");
        assert!(lamp.pdf(DVec3::ZERO, DVec3::Z).is_none());
    }
}
