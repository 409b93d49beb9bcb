//! The directions the published filter tries, and what it weighs along each.

use glam::DVec3;

/// Texels along a side of a face of the cubemap.
pub(super) const FINE: usize = 32;
/// Cells along a side when it is searched from coarse to fine.
pub(super) const COARSE: usize = 8;
/// Texels of a coarse cell, along a side.
const CHILDREN: usize = FINE / COARSE;

/// Directions of the middles of `n` x `n` texels of the faces +x, +y, +z: half a cubemap, as d and -d are one direction.
pub(super) fn half_cubemap(n: usize) -> Vec<DVec3> {
    let side = |i: usize| 2.0 * (i as f64 + 0.5) / n as f64 - 1.0;
    let mut list = Vec::with_capacity(3 * n * n);
    for face in 0..3 {
        for (j, i) in (0..n).flat_map(|j| (0..n).map(move |i| (j, i))) {
            let mut d = [0.0; 3];
            d[face] = 1.0;
            d[(face + 1) % 3] = side(i);
            d[(face + 2) % 3] = side(j);
            list.push(DVec3::from_array(d).normalize());
        }
    }
    list
}

/// The texels of a coarse cell.
pub(super) fn children(cell: usize) -> impl Iterator<Item = usize> {
    let (face, j, i) = (
        cell / (COARSE * COARSE),
        cell / COARSE % COARSE,
        cell % COARSE,
    );
    let first = face * FINE * FINE + CHILDREN * (j * FINE + i);
    (0..CHILDREN).flat_map(move |b| (0..CHILDREN).map(move |a| first + b * FINE + a))
}

/// The texel a direction lies in.
pub(super) fn texel(d: DVec3) -> usize {
    let size = d.abs();
    let face = (0..3).fold(0, |best, k| if size[k] > size[best] { k } else { best });
    let index = |axis: usize| {
        let side = d[axis] / d[face];
        (((side + 1.0) * 0.5 * FINE as f64) as usize).min(FINE - 1)
    };
    face * FINE * FINE + index((face + 2) % 3) * FINE + index((face + 1) % 3)
}

/// The published filter (Zhao 2011 section 5.2): `q = -2 exp(-s r^2) + exp(-t r^2)` at distance r from the line, in a cube.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Filter {
    /// Of the narrow Gaussian's exponent, per square voxel.
    pub s: f64,
    /// Of the wide one's; larger than `s`.
    pub t: f64,
    /// Edge of the cube, voxels; of an even one there is one voxel more on the lower side.
    pub h: usize,
}

/// A voxel's offset and weight.
pub(super) type Tap = ([i64; 3], f32);

impl Filter {
    /// Weights along a direction that are not negligible (a hundred-thousandth of the largest).
    pub(super) fn taps(&self, d: DVec3) -> Vec<Tap> {
        let low = -(self.h as i64 / 2);
        let span = low..low + self.h as i64;
        let mut taps = Vec::new();
        for z in span.clone() {
            for y in span.clone() {
                for x in span.clone() {
                    let p = DVec3::new(x as f64, y as f64, z as f64);
                    let r2 = (p - d * p.dot(d)).length_squared();
                    let q = -2.0 * (-self.s * r2).exp() + (-self.t * r2).exp();
                    if q.abs() > 1e-5 {
                        taps.push(([x, y, z], q as f32));
                    }
                }
            }
        }
        taps
    }

    /// Its value in air, the least it can have.
    #[cfg(test)]
    fn all_air(&self, d: DVec3) -> f64 {
        self.taps(d).iter().map(|t| f64::from(t.1)).sum()
    }

    /// Points on the line through the middle, as long as the cube's edge, for the line form.
    pub(super) fn line(&self, d: DVec3) -> Vec<Tap> {
        const POINTS: i64 = 20;
        let step = 0.5 * self.h as f64 / POINTS as f64;
        let places = (-POINTS..=POINTS).map(|k| (d * (k as f64 * step)).round().as_i64vec3());
        places.map(|p| (p.to_array(), step as f32)).collect()
    }

    /// Voxels the taps reach beyond the middle.
    pub(super) fn reach(&self) -> usize {
        self.h.div_ceil(2)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texels_cover_half_the_sphere_and_find_themselves() {
        for (index, d) in half_cubemap(FINE).into_iter().enumerate() {
            assert_eq!(texel(d), index);
            assert_eq!(texel(-d), index);
        }
        let coarse = half_cubemap(COARSE);
        let mut seen = vec![0; 3 * FINE * FINE];
        let fine = half_cubemap(FINE);
        for (cell, d) in coarse.iter().enumerate() {
            for child in children(cell) {
                seen[child] += 1;
                assert!(fine[child].angle_between(*d).to_degrees() < 10.0);
            }
        }
        assert!(seen.iter().all(|n| *n == 1));
    }

    #[test]
    fn air_all_around_gives_the_values_of_the_published_settings() {
        // J of a volume of air along an axis, worked out from the equation; sees one tap too many or too few.
        for (s, t, h, expected) in [
            (1.0, 2.0, 16, -74.7),
            (3.0, 4.0, 12, -16.1),
            (0.25, 0.75, 15, -314.0),
            (1.0, 2.0, 11, -51.3),
            (2.0, 3.0, 11, -22.3),
            (0.25, 0.75, 13, -272.0),
        ] {
            let found = Filter { s, t, h }.all_air(DVec3::Y);
            assert!(
                (found / expected - 1.0).abs() < 0.004,
                "{s} {t} {h}: {found}"
            );
        }
    }
}
