//! The model on arrays of events, in `f32`, as loops that compilers turn into vector instructions.
//!
//! An event keeps `|tan(theta_i / 2)|`, `(theta_i + theta_o)^2` and `cos(phi_o - phi_i - pi) - 1`: then no transcendental
//! function but the exponential is left, and that is a polynomial. The normalizers are cubics on equal pieces of
//! `tan(theta_i / 2)`. Against `KhungurnScattering::evaluate` in `f64`: 2e-6 relative within four widths of the lobes'
//! peaks, growing as 1e-7 times the exponent beyond; `S` below 1e-38 times a lobe's peak is 0.

use super::{FiberAngles, KhungurnScattering, LongitudinalLobe};
use crate::scatter::CHANNELS;
use crate::scatter::batch::{BatchEvaluate, BatchValues, Footprint};
use glam::DVec3;
use std::f64::consts::TAU;

/// Events per vector: one of 512 bits or two of 256.
const LANES: usize = 16;
/// Events whose normalizers are looked up before their lobes are evaluated: far enough apart that the stores are done.
const STRIDE: usize = 128;
/// Rows of the model.
const ROWS: usize = 5;

/// Normalizers of both lobes: `1/G_R`, `(dG_R/dbeta_R)/G_R`, and the same for TT.
type Normalizers = [f32; 4];

/// See the head of this file.
pub(super) struct KhungurnBatch {
    /// `pieces[p][power]`, local coordinate in [0, 1].
    pieces: Vec<[Normalizers; 4]>,
    lobes: Lobes,
}

/// What the lobes need, as `f32`.
struct Lobes {
    c_r: [f32; CHANNELS],
    c_tt: [f32; CHANNELS],
    scale_r: f32,
    scale_tt: f32,
    half_inverse_square_r: f32,
    half_inverse_square_tt: f32,
    inverse_width_r: f32,
    inverse_width_tt: f32,
    k: f32,
    deficit: f32,
    k_by_gamma: f32,
}

impl KhungurnBatch {
    pub(super) fn new(s: &KhungurnScattering) -> Self {
        // A cubic on a sixteenth of the narrower width near the pole misses 1/G by 1e-7.
        let narrower = s.r.width.min(s.tt.width);
        let n_pieces = ((16.0 / narrower) as usize).clamp(64, 1 << 16);
        let pieces = (0..n_pieces)
            .map(|p| cubic(|u| normalizers(&s.r, &s.tt, (p as f64 + u) / n_pieces as f64)))
            .collect();
        let narrow = |c: [f64; CHANNELS]| c.map(|c| c as f32);
        Self {
            pieces,
            lobes: Lobes {
                c_r: narrow(s.c_r),
                c_tt: narrow(s.c_tt),
                scale_r: (s.r.scale / TAU) as f32,
                scale_tt: (s.tt.scale * s.azimuthal.scale) as f32,
                half_inverse_square_r: s.r.half_inverse_square as f32,
                half_inverse_square_tt: s.tt.half_inverse_square as f32,
                inverse_width_r: s.r.inverse_width as f32,
                inverse_width_tt: s.tt.inverse_width as f32,
                k: s.azimuthal.k as f32,
                deficit: s.azimuthal.deficit as f32,
                k_by_gamma: s.azimuthal.k_by_gamma as f32,
            },
        }
    }
}

/// The functions of the table at `t = tan(theta_i / 2)`.
fn normalizers(r: &LongitudinalLobe, tt: &LongitudinalLobe, t: f64) -> [f64; 4] {
    let ((g_r, d_r), (g_tt, d_tt)) = (r.table.normalizer(t), tt.table.normalizer(t));
    [1.0 / g_r, d_r / g_r, 1.0 / g_tt, d_tt / g_tt]
}

/// The cubic through four functions at the Chebyshev points of [0, 1], `[power][function]`.
fn cubic(f: impl Fn(f64) -> [f64; 4]) -> [Normalizers; 4] {
    let nodes: [f64; 4] =
        std::array::from_fn(|j| 0.5 - 0.5 * (TAU / 16.0 * (2 * j + 1) as f64).cos());
    let values = nodes.map(f);
    let mut powers = [[0.0; 4]; 4];
    for (function, _) in values[0].iter().enumerate() {
        // Newton's divided differences, then nested multiplication into powers.
        let mut d: [f64; 4] = std::array::from_fn(|j| values[j][function]);
        for order in 1..4 {
            for j in (order..4).rev() {
                d[j] = (d[j] - d[j - 1]) / (nodes[j] - nodes[j - order]);
            }
        }
        let mut p = [d[3], 0.0, 0.0, 0.0];
        for j in (0..3).rev() {
            for power in (1..4).rev() {
                p[power] = p[power - 1] - nodes[j] * p[power];
            }
            p[0] = d[j] - nodes[j] * p[0];
        }
        (0..4).for_each(|power| powers[power][function] = p[power] as f32);
    }
    powers
}

impl BatchEvaluate for KhungurnBatch {
    fn columns(&self) -> usize {
        3
    }

    fn footprint(&self, wi: DVec3, wo: DVec3, _h: f64) -> Footprint {
        let (i, o) = (FiberAngles::new(wi), FiberAngles::new(wo));
        let delta = 2.0 * (i.t + o.t).atan2(1.0 - i.t * o.t);
        let (az_y, az_z) = (i.az_y + o.az_y, i.az_z + o.az_z);
        let cos_minus_1 = -0.5 * (az_y * az_y + az_z * az_z);
        [
            i.t.abs() as f32,
            (delta * delta) as f32,
            cos_minus_1 as f32,
            0.0,
            0.0,
            0.0,
        ]
    }

    fn evaluate(&self, columns: &[&[f32]], out: &mut BatchValues) {
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512dq") {
                // One of the two hottest loops of a fit. Safe code compiled for instructions that were just detected.
                #[allow(unsafe_code)]
                unsafe {
                    return self.evaluate_avx512(columns, out);
                }
            }
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                #[allow(unsafe_code)]
                unsafe {
                    return self.evaluate_avx2(columns, out);
                }
            }
        }
        self.evaluate_in::<false>(columns, out);
    }
}

impl KhungurnBatch {
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
    fn evaluate_avx512(&self, columns: &[&[f32]], out: &mut BatchValues) {
        self.evaluate_in::<true>(columns, out);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn evaluate_avx2(&self, columns: &[&[f32]], out: &mut BatchValues) {
        self.evaluate_in::<true>(columns, out);
    }

    /// With `FMA` for processors that have fused multiply-add.
    #[inline(always)]
    fn evaluate_in<const FMA: bool>(&self, columns: &[&[f32]], out: &mut BatchValues) {
        let n = columns[0].len();
        let mut looked_up = [[0.0; 4]; STRIDE];
        let slopes = !out.slope.is_empty();
        for start in (0..n).step_by(STRIDE) {
            let stride = start..(start + STRIDE).min(n);
            let t = &columns[0][stride.clone()];
            for (normalizer, &t) in looked_up.iter_mut().zip(t) {
                *normalizer = self.look_up::<FMA>(t);
            }
            for first in stride.clone().step_by(LANES) {
                let count = LANES.min(stride.end - first);
                let column =
                    |k: usize| -> [f32; LANES] { lanes(&columns[k][first..first + count]) };
                let (t, square, cos_minus_1) = (column(0), column(1), column(2));
                let mut g = [[0.0; 4]; LANES];
                g[..count].copy_from_slice(&looked_up[first - start..first - start + count]);
                let mut block = Block::default();
                if slopes {
                    self.lobes
                        .evaluate::<FMA, true>(&t, &square, &cos_minus_1, &g, &mut block);
                } else {
                    self.lobes
                        .evaluate::<FMA, false>(&t, &square, &cos_minus_1, &g, &mut block);
                }
                block.store(first, count, out);
            }
        }
    }

    #[inline(always)]
    fn look_up<const FMA: bool>(&self, t: f32) -> Normalizers {
        let scaled = t * self.pieces.len() as f32;
        let index = (scaled as usize).min(self.pieces.len() - 1);
        let u = scaled - index as f32;
        let p = &self.pieces[index];
        std::array::from_fn(|k| {
            let high = fused::<FMA>(u, p[3][k], p[2][k]);
            fused::<FMA>(u, fused::<FMA>(u, high, p[1][k]), p[0][k])
        })
    }
}

/// A full vector from up to [`LANES`] numbers, the rest zero.
#[inline(always)]
fn lanes(numbers: &[f32]) -> [f32; LANES] {
    if let Ok(all) = numbers.try_into() {
        return all;
    }
    let mut some = [0.0; LANES];
    some[..numbers.len()].copy_from_slice(numbers);
    some
}

/// Values and slopes of one vector of events.
#[derive(Default)]
struct Block {
    value: [[f32; LANES]; CHANNELS],
    slope: [[[f32; LANES]; CHANNELS]; ROWS],
}

impl Block {
    #[inline(always)]
    fn store(&self, first: usize, count: usize, out: &mut BatchValues) {
        for c in 0..CHANNELS {
            out.value[c][first..first + count].copy_from_slice(&self.value[c][..count]);
            for (slope, mine) in out.slope.iter_mut().zip(&self.slope) {
                slope[c][first..first + count].copy_from_slice(&mine[c][..count]);
            }
        }
    }
}

impl Lobes {
    /// The same formulas as `KhungurnScattering::evaluate_angles`.
    #[inline(always)]
    fn evaluate<const FMA: bool, const SLOPES: bool>(
        &self,
        t: &[f32; LANES],
        square: &[f32; LANES],
        cos_minus_1: &[f32; LANES],
        g: &[Normalizers; LANES],
        out: &mut Block,
    ) {
        for l in 0..LANES {
            let t2 = t[l] * t[l];
            let w = 2.0 * t2 / (1.0 + t2);
            let w5 = (w * w) * (w * w) * w;
            let exponent_r = square[l] * self.half_inverse_square_r;
            let exponent_tt = square[l] * self.half_inverse_square_tt;
            let azimuth = self.k * cos_minus_1[l];
            let lobe_r = self.scale_r * g[l][0] * exp::<FMA>(-exponent_r);
            let lobe_tt = self.scale_tt * g[l][2] * exp::<FMA>(azimuth - exponent_tt);
            let log_r = fused::<FMA>(exponent_r, 2.0, -1.0) * self.inverse_width_r - g[l][1];
            let log_tt = fused::<FMA>(exponent_tt, 2.0, -1.0) * self.inverse_width_tt - g[l][3];
            let log_gamma = (cos_minus_1[l] + self.deficit) * self.k_by_gamma;
            for c in 0..CHANNELS {
                let f = fused::<FMA>(1.0 - self.c_r[c], w5, self.c_r[c]);
                let r = f * lobe_r;
                // 1 - F = (1 - C_R)(1 - (1 - cos theta_i)^5), without cancellation for C_R near 1.
                let tt_by_c_tt = (1.0 - self.c_r[c]) * (1.0 - w5) * lobe_tt;
                out.value[c][l] = fused::<FMA>(self.c_tt[c], tt_by_c_tt, r);
                if SLOPES {
                    let tt = self.c_tt[c] * tt_by_c_tt;
                    out.slope[0][c][l] = (1.0 - w5) * (lobe_r - self.c_tt[c] * lobe_tt);
                    out.slope[1][c][l] = tt_by_c_tt;
                    out.slope[2][c][l] = r * log_r;
                    out.slope[3][c][l] = tt * log_tt;
                    out.slope[4][c][l] = tt * log_gamma;
                }
            }
        }
    }
}

/// `a b + c`, rounded once where the processor can.
#[inline(always)]
fn fused<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// `exp(x)` for `x <= 0`, relative error below 2e-7; 0 below -87.3. A NaN stays one.
///
/// `2^n` from the exponent's bits, and the Taylor polynomial of degree 7 of the rest, which is within ln(2)/2.
#[inline(always)]
fn exp<const FMA: bool>(x: f32) -> f32 {
    const LOWEST: f32 = -87.3;
    // 1.5 * 2^23: adding it rounds to an integer.
    const ROUND: f32 = 12_582_912.0;
    // ln 2 in two parts, the first with few enough bits that its multiples are exact.
    const LN2_HIGH: f32 = 0.693_359_4;
    const LN2_LOW: f32 = -2.121_944_4e-4;
    let kept = if x < LOWEST { LOWEST } else { x };
    let shifted = fused::<FMA>(kept, std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    let r = fused::<FMA>(n, -LN2_LOW, fused::<FMA>(n, -LN2_HIGH, kept));
    let mut p = 1.0 / 5040.0;
    for c in [
        1.0 / 720.0,
        1.0 / 120.0,
        1.0 / 24.0,
        1.0 / 6.0,
        0.5,
        1.0,
        1.0,
    ] {
        p = fused::<FMA>(p, r, c);
    }
    let power = f32::from_bits((shifted.to_bits() << 23).wrapping_add(127 << 23));
    if x < LOWEST { 0.0 } else { p * power }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;
    use crate::scatter::batch::OneByOne;
    use crate::scatter::{Khungurn, Parameters, Scattering};

    fn scattering(colors: [f64; 2], widths_deg: [f64; 3]) -> KhungurnScattering {
        let [c_r, c_tt] = colors;
        let widths = widths_deg.map(f64::to_radians);
        let values = [[c_r, 0.3, 0.0], [c_tt, 0.5, 1.0], widths].concat();
        KhungurnScattering::new(&Parameters::defaults(&Khungurn).with_values(values)).unwrap()
    }

    /// Largest difference of values and slopes from `f64`, in units of the rounding that `f32` footprints allow.
    fn worst(s: &KhungurnScattering, evaluate: impl Fn(&[&[f32]], &mut BatchValues)) -> [f64; 2] {
        let kernel = KhungurnBatch::new(s);
        let mut random = Random::keyed(&[31]);
        let n = 1003;
        let mut columns = vec![Vec::new(); 3];
        let mut expected = Vec::new();
        while expected.len() < n {
            let mut u = || 2.0 * random.uniform() - 1.0;
            let wo = DVec3::new(u(), u(), u()).normalize();
            let wi = match expected.len() % 4 {
                0 => DVec3::new(u(), u(), u()).normalize(),
                _ => {
                    s.sample(&s.outgoing(wo, 0.0, [1.0; CHANNELS]), &mut random)
                        .unwrap()
                        .wi
                }
            };
            let footprint = kernel.footprint(wi, wo, 0.0);
            (0..3).for_each(|k| columns[k].push(footprint[k]));
            expected.push((s.evaluate(wi, wo, 0.0), footprint));
        }
        let columns: Vec<&[f32]> = columns.iter().map(Vec::as_slice).collect();
        let mut out = BatchValues::default();
        out.resize(n, ROWS);
        evaluate(&columns, &mut out);
        let narrowest = s.r.width.min(s.tt.width);
        let mut worst = [0.0_f64; 2];
        for (n, (e, footprint)) in expected.iter().enumerate() {
            let [t, square, cos_minus_1, ..] = footprint.map(f64::from);
            let exponent = square * s.r.half_inverse_square - s.azimuthal.k * cos_minus_1;
            // Near the pole 1/G changes by its own size over half a width of t, and t is rounded to 6e-8.
            let unit = 1e-7 * (4.0 + exponent + t / narrowest);
            for c in 0..CHANNELS {
                let value = f64::from(out.value[c][n]);
                let error = (value - e.value[c]).abs() / (e.value[c] + 1e-20);
                worst[0] = worst[0].max(error / unit);
                for row in 0..ROWS {
                    let slope = f64::from(out.slope[row][c][n]);
                    // Slopes are sums of terms of about this size.
                    let scale =
                        (e.value[c] * (1.0 + exponent) / narrowest).max(e.derivative[row][c].abs());
                    let error = (slope - e.derivative[row][c]).abs() / (scale + 1e-20);
                    worst[1] = worst[1].max(error / unit);
                }
            }
        }
        worst
    }

    #[test]
    fn the_kernel_gives_the_values_and_slopes_of_the_model() {
        for colors in [[0.185, 0.95], [0.0, 0.0], [0.999, 0.001], [1.0, 1.0]] {
            for widths in [
                [2.0, 12.0, 23.0],
                [1.0, 10.0, 1.0],
                [10.0, 45.0, 45.0],
                [0.3, 60.0, 90.0],
            ] {
                let s = scattering(colors, widths);
                let kernel = KhungurnBatch::new(&s);
                let detected = worst(&s, |columns, out| kernel.evaluate(columns, out));
                let portable = worst(&s, |columns, out| kernel.evaluate_in::<false>(columns, out));
                println!("{colors:?} {widths:?}: {detected:.2?} {portable:.2?}");
                for error in [detected, portable].concat() {
                    assert!(
                        error < 10.0,
                        "{colors:?} {widths:?}: {detected:?} {portable:?}"
                    );
                }
            }
        }
        // Negative control: a width off by 1e-5 of itself fails.
        let s = scattering([0.185, 0.95], [2.0, 12.0, 23.0]);
        let other =
            KhungurnBatch::new(&scattering([0.185, 0.95], [2.0 * (1.0 + 1e-4), 12.0, 23.0]));
        let caught = worst(&s, |columns, out| other.evaluate(columns, out));
        assert!(caught[0] > 10.0, "{caught:?}");
    }

    #[test]
    fn the_general_kernel_keeps_the_directions() {
        let s = scattering([0.185, 0.95], [2.0, 12.0, 23.0]);
        let kernel = OneByOne(&s);
        let mut random = Random::keyed(&[32]);
        for _ in 0..200 {
            let mut u = || 2.0 * random.uniform() - 1.0;
            let wo = DVec3::new(u(), u(), u()).normalize();
            let wi = s
                .sample(&s.outgoing(wo, 0.0, [1.0; CHANNELS]), &mut random)
                .unwrap()
                .wi;
            let footprint = kernel.footprint(wi, wo, 0.0);
            let columns: Vec<&[f32]> = footprint.iter().map(std::slice::from_ref).collect();
            let mut out = BatchValues::default();
            out.resize(1, 0);
            kernel.evaluate(&columns[..5], &mut out);
            let expected = s.evaluate(wi, wo, 0.0).value[0];
            let error = (f64::from(out.value[0][0]) / expected - 1.0).abs();
            // 1e-7 rad against a width of 2 degrees, four widths from the peak.
            assert!(error < 1e-4, "{error} at {wi}, {wo}");
        }
    }

    #[test]
    fn the_exponential_is_right_to_its_stated_error() {
        let mut worst = 0.0_f64;
        for k in 0..100_000 {
            let x = -87.29 * (k as f32) / 1e5;
            for y in [exp::<true>(x), exp::<false>(x)] {
                worst = worst.max((f64::from(y) / f64::from(x).exp() - 1.0).abs());
            }
        }
        assert!(worst < 2e-7, "{worst}");
        assert!(exp::<false>(-90.0) == 0.0 && exp::<false>(f32::NEG_INFINITY) == 0.0);
        assert!(exp::<false>(f32::NAN).is_nan() && (exp::<true>(0.0) - 1.0).abs() < 1e-9);
    }
}
