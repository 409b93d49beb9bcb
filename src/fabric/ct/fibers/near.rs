//! The nearest of many short segments.

use glam::DVec3;
use std::collections::HashMap;

/// Segments entered in cubic cells, for questions within a fixed reach.
pub(super) struct Near {
    segments: Vec<[DVec3; 2]>,
    cells: HashMap<[i32; 3], Vec<u32>>,
    cell: f64,
    reach: f64,
}

impl Near {
    /// `reach` is the largest distance asked for, in the unit of the segments.
    pub(super) fn new(segments: Vec<[DVec3; 2]>, reach: f64) -> Self {
        let cell = reach.max(1e-9);
        let mut cells: HashMap<[i32; 3], Vec<u32>> = HashMap::new();
        for (index, [a, b]) in segments.iter().enumerate() {
            let low = ((a.min(*b) - reach) / cell).floor().as_ivec3();
            let high = ((a.max(*b) + reach) / cell).floor().as_ivec3();
            for z in low.z..=high.z {
                for y in low.y..=high.y {
                    for x in low.x..=high.x {
                        cells.entry([x, y, z]).or_default().push(index as u32);
                    }
                }
            }
        }
        Self {
            segments,
            cells,
            cell,
            reach,
        }
    }

    /// Distance and number of the nearest segment within reach; the first of equally near ones.
    pub(super) fn nearest(&self, p: DVec3) -> Option<(f64, usize)> {
        let cell = (p / self.cell).floor().as_ivec3().to_array();
        let list = self.cells.get(&cell)?;
        let mut best: Option<(f64, usize)> = None;
        for index in list {
            let [a, b] = self.segments[*index as usize];
            let distance = distance(p, a, b);
            if distance <= self.reach && best.is_none_or(|found| distance < found.0) {
                best = Some((distance, *index as usize));
            }
        }
        best
    }

    /// Unit vector along a segment.
    pub(super) fn along(&self, index: usize) -> DVec3 {
        let [a, b] = self.segments[index];
        (b - a).normalize_or(DVec3::X)
    }
}

/// Distance of a point from a segment.
pub(super) fn distance(p: DVec3, a: DVec3, b: DVec3) -> f64 {
    let way = b - a;
    let t = ((p - a).dot(way) / way.length_squared().max(1e-300)).clamp(0.0, 1.0);
    (p - a - way * t).length()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    #[test]
    fn the_nearest_is_the_one_found_by_looking_at_all() {
        let mut random = Random::keyed(&[8]);
        let mut point = || 10.0 * DVec3::new(random.uniform(), random.uniform(), random.uniform());
        let segments: Vec<[DVec3; 2]> = (0..200)
            .map(|_| {
                let a = point();
                [a, a + 0.1 * (point() - a)]
            })
            .collect();
        let near = Near::new(segments.clone(), 1.5);
        for _ in 0..500 {
            let p = point();
            let all = segments.iter().map(|s| distance(p, s[0], s[1]));
            let best = all.fold(f64::INFINITY, f64::min);
            match near.nearest(p) {
                Some((found, _)) => assert!((found - best).abs() < 1e-12),
                None => assert!(best > 1.5),
            }
        }
    }
}
