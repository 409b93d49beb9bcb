//! Smoothing of polylines (Khungurn 2015 eq. 25).

use glam::DVec3;

/// The points p that make `alpha |p - p0|^2 + |second differences of p|^2` least.
///
/// The normal equations have five bands and are positive definite; their factors L D L' are found and solved in one pass
/// each way.
pub(super) fn smooth(points: &[DVec3], alpha: f64) -> Vec<DVec3> {
    let n = points.len();
    if n < 3 {
        return points.to_vec();
    }
    let mut bands = vec![[alpha, 0.0, 0.0]; n];
    for i in 0..n - 2 {
        for (a, wa) in [(i, 1.0), (i + 1, -2.0), (i + 2, 1.0)] {
            for (b, wb) in [(i, 1.0), (i + 1, -2.0), (i + 2, 1.0)] {
                if b <= a {
                    bands[a][a - b] += wa * wb;
                }
            }
        }
    }
    // Row i of the factor: its diagonal, and the elements one and two to the left.
    let mut factor = vec![[0.0; 3]; n];
    let mut found = Vec::with_capacity(n);
    for i in 0..n {
        let [one, two] = [1, 2].map(|k| {
            if i >= k {
                factor[i - k]
            } else {
                [1.0, 0.0, 0.0]
            }
        });
        let l2 = bands[i][2] / two[0];
        let l1 = (bands[i][1] - l2 * two[0] * one[1]) / one[0];
        factor[i] = [bands[i][0] - l1 * l1 * one[0] - l2 * l2 * two[0], l1, l2];
        let before = |k: usize| if i >= k { found[i - k] } else { DVec3::ZERO };
        let value = alpha * points[i] - l1 * before(1) - l2 * before(2);
        found.push(value);
    }
    for i in (0..n).rev() {
        let mut value = found[i] / factor[i][0];
        if i + 1 < n {
            value -= factor[i + 1][1] * found[i + 1];
        }
        if i + 2 < n {
            value -= factor[i + 2][2] * found[i + 2];
        }
        found[i] = value;
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    #[test]
    fn the_normal_equations_hold() {
        let mut random = Random::keyed(&[11]);
        for n in [3, 4, 5, 6, 60] {
            let p0: Vec<DVec3> = (0..n)
                .map(|_| DVec3::new(random.normal(), random.normal(), random.normal()))
                .collect();
            let p = smooth(&p0, 0.1);
            let second: Vec<DVec3> = p.windows(3).map(|w| w[0] - 2.0 * w[1] + w[2]).collect();
            let at = |k: i64| second.get(k as usize).copied().unwrap_or(DVec3::ZERO);
            for i in 0..n as i64 {
                let bent = at(i - 2) - 2.0 * at(i - 1) + at(i);
                let bent = if i < 1 { at(0) } else { bent };
                let residual = 0.1 * (p[i as usize] - p0[i as usize]) + bent;
                assert!(residual.length() < 1e-12, "{n} {i}: {residual}");
            }
        }
    }

    #[test]
    fn gains_are_those_of_the_equation_and_straight_lines_stay() {
        // 0.1 / (0.1 + (2 - 2 cos(2 pi / n))^2) for waves of n vertices, in the middle of a long line.
        for (wave, gain) in [(4.0, 0.024), (8.0, 0.225), (20.0, 0.91)] {
            let at = |k: usize| (std::f64::consts::TAU * k as f64 / wave).cos();
            let line: Vec<DVec3> = (0..401).map(|k| DVec3::new(k as f64, at(k), 0.0)).collect();
            let found = smooth(&line, 0.1)[200].y / at(200);
            assert!((found - gain).abs() < 0.005, "{wave}: {found}");
        }
        let line: Vec<DVec3> = (0..50)
            .map(|k| DVec3::new(1.0, 2.0, -0.5) * k as f64)
            .collect();
        for (a, b) in smooth(&line, 0.1).into_iter().zip(line) {
            assert!(a.distance(b) < 1e-9);
        }
    }
}
