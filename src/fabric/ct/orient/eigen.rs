//! Eigenvectors of symmetric 3x3 matrices.

use glam::DVec3;

/// Ascending eigenvalues and their unit eigenvectors of the matrix with diagonal xx, yy, zz and xy, xz, yz beside it
/// (cyclic Jacobi rotations, which stay accurate where eigenvalues are close).
pub(super) fn eigen([xx, yy, zz, xy, xz, yz]: [f64; 6]) -> ([f64; 3], [DVec3; 3]) {
    let mut a = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
    let mut v = [DVec3::X, DVec3::Y, DVec3::Z];
    let size: f64 = a.iter().flatten().map(|e| e * e).sum();
    for _ in 0..12 {
        let off = a[0][1].powi(2) + a[0][2].powi(2) + a[1][2].powi(2);
        if off <= 1e-28 * size {
            break;
        }
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            rotate(&mut a, &mut v, p, q);
        }
    }
    let mut order = [0, 1, 2];
    order.sort_by(|i, j| a[*i][*i].total_cmp(&a[*j][*j]));
    (
        order.map(|k| a[k][k]),
        order.map(|k| v[k].normalize_or(DVec3::X)),
    )
}

/// The rotation in the plane of axes p and q that makes their element zero.
fn rotate(a: &mut [[f64; 3]; 3], v: &mut [DVec3; 3], p: usize, q: usize) {
    let apq = a[p][q];
    if apq.abs() <= f64::MIN_POSITIVE {
        return;
    }
    let theta = 0.5 * (a[q][q] - a[p][p]) / apq;
    let t = theta.signum() / (theta.abs() + (1.0 + theta * theta).sqrt());
    let cos = 1.0 / (1.0 + t * t).sqrt();
    let sin = t * cos;
    let r = 3 - p - q;
    let (arp, arq) = (a[r][p], a[r][q]);
    a[p][p] -= t * apq;
    a[q][q] += t * apq;
    (a[p][q], a[q][p]) = (0.0, 0.0);
    let (rp, rq) = (cos * arp - sin * arq, sin * arp + cos * arq);
    (a[r][p], a[p][r], a[r][q], a[q][r]) = (rp, rp, rq, rq);
    (v[p], v[q]) = (cos * v[p] - sin * v[q], sin * v[p] + cos * v[q]);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    #[test]
    fn vectors_are_those_of_the_matrix_also_when_values_nearly_agree() {
        // Sees relative residuals above 1e-12.
        let mut random = Random::keyed(&[5]);
        for k in 0..3000 {
            let gap = 10f64.powi(-(k % 17));
            let values = [1.0, 1.0 + gap, 1.0 + gap * (1.0 + random.uniform())];
            let u = DVec3::new(random.normal(), random.normal(), random.normal()).normalize();
            let (v, w) = u.any_orthonormal_pair();
            let m = |i: usize, j: usize| -> f64 {
                let axes = [u, v, w].into_iter().zip(values);
                axes.map(|(e, s)| s * e[i] * e[j]).sum()
            };
            let six = [m(0, 0), m(1, 1), m(2, 2), m(0, 1), m(0, 2), m(1, 2)];
            let (found, vectors) = eigen(six);
            for (value, e) in found.into_iter().zip(vectors) {
                let image = DVec3::new(
                    m(0, 0) * e.x + m(0, 1) * e.y + m(0, 2) * e.z,
                    m(0, 1) * e.x + m(1, 1) * e.y + m(1, 2) * e.z,
                    m(0, 2) * e.x + m(1, 2) * e.y + m(2, 2) * e.z,
                );
                assert!((image - value * e).length() < 1e-12, "{six:?}");
                assert!((e.length() - 1.0).abs() < 1e-12);
            }
            assert!(found[0] <= found[1] && found[1] <= found[2]);
        }
        assert!(eigen([0.0; 6]).0.iter().all(|v| v.abs() <= 0.0));
        let (values, vectors) = eigen([2.0, 1.0, 3.0, 0.0, 0.0, 0.0]);
        assert_eq!((values, vectors[0]), ([1.0, 2.0, 3.0], DVec3::Y));
    }
}
