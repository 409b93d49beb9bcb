//! Special functions in forms that neither overflow nor cancel.
//!
//! Written for use while a model is prepared, not inside its innermost loop: the Bessel functions sum up to about 80
//! terms. Complex and negative arguments are not handled (all odd and even continuations are the caller's).

use super::quadrature::GaussLegendre;
use std::f64::consts::{FRAC_1_SQRT_2, PI, TAU};

/// Density of the standard normal distribution, `exp(-z^2/2) / sqrt(2 pi)`.
pub fn normal_density(z: f64) -> f64 {
    (-0.5 * z * z).exp() / TAU.sqrt()
}

/// Probability that a standard normal number lies between `low` and `high` (`low <= high`, infinities allowed), to about
/// 1e-13 relative wherever it does not underflow.
///
/// Both ends on one side of zero: a difference of complementary error functions, never of two numbers near 1; a narrow
/// interval is integrated instead, since there both differences cancel.
pub fn normal_probability(low: f64, high: f64) -> f64 {
    let (near, far) = match (low > 0.0, high < 0.0) {
        (true, _) => (low, high),
        (_, true) => (-high, -low),
        _ => {
            return 0.5 * (libm::erf(high * FRAC_1_SQRT_2) - libm::erf(low * FRAC_1_SQRT_2));
        }
    };
    if (far - near) * near.max(1.0) < 1.0 {
        return GaussLegendre::new(16).integrate(near, far, normal_density);
    }
    0.5 * (libm::erfc(near * FRAC_1_SQRT_2) - libm::erfc(far * FRAC_1_SQRT_2))
}

/// The inverse of the error function: `erf(erf_inv(x)) = x`, to about 1e-15 relative wherever `x` is an exact number; infinite
/// at -1 and 1, NaN beyond.
pub fn erf_inv(x: f64) -> f64 {
    erf_inv_of(x.abs(), 1.0 - x.abs()).copysign(x)
}

/// The inverse of the complementary error function on [0, 1]: `erfc(erfc_inv(c)) = c`, to about 1e-15 relative for `c` up to 0.5;
/// infinite at 0, NaN outside. It knows how far from 1 the error function is where `1 - c` would not.
pub fn erfc_inv(c: f64) -> f64 {
    erf_inv_of(1.0 - c, c)
}

/// The `y >= 0` with `erf(y) = a` and `erfc(y) = c = 1 - a`.
///
/// From the approximation of Winitzki 2008 (0.2 %), Halley steps on `erf`, or on `erfc` where `a` is near 1 and `erf` would
/// cancel.
fn erf_inv_of(a: f64, c: f64) -> f64 {
    if !(a >= 0.0 && c > 0.0) {
        return if c == 0.0 { f64::INFINITY } else { f64::NAN };
    }
    const W: f64 = 0.147;
    let log = if a < 0.5 {
        (-a * a).ln_1p()
    } else {
        (c * (1.0 + a)).ln()
    };
    let t = 2.0 / (PI * W) + 0.5 * log;
    let root = (t * t - log / W).sqrt();
    let square = if t > 0.0 {
        -log / W / (root + t)
    } else {
        root - t
    };
    let mut y = square.sqrt();
    for _ in 0..8 {
        let excess = if a < 0.5 {
            libm::erf(y) - a
        } else {
            c - libm::erfc(y)
        };
        let newton = excess * 0.5 * PI.sqrt() * (y * y).exp();
        let step = newton / (1.0 + y * newton);
        y -= step;
        // The next step would be of the order of the cube of this one.
        if step.abs() <= 1e-6 * y {
            break;
        }
    }
    y
}

/// Where the power series ends and the asymptotic one begins: there the smallest term of the latter is about
/// `exp(-2 x) = 1e-26`.
const BESSEL_SWITCH: f64 = 30.0;

/// Exponentially scaled modified Bessel function `exp(-x) I_0(x)`, `x >= 0`, to about 1e-15 relative; never overflows.
pub fn i0e(x: f64) -> f64 {
    bessel_scaled(0, x)
}

/// Exponentially scaled modified Bessel function `exp(-x) I_1(x)`, `x >= 0`, to about 1e-15 relative; never overflows.
pub fn i1e(x: f64) -> f64 {
    bessel_scaled(1, x)
}

/// `1 - I_1(x)/I_0(x)`, `x >= 0`, without the cancellation that the quotient has at large `x` (it tends to `1/(2x)`);
/// to 1e-13 relative.
///
/// This is one minus the mean cosine of a von Mises distribution of concentration `x`.
pub fn bessel_ratio_deficit(x: f64) -> f64 {
    if x <= BESSEL_SWITCH {
        return 1.0 - i1e(x) / i0e(x);
    }
    // Numerator and denominator share the factor 1/sqrt(2 pi x); the leading 1 of both series cancels exactly.
    let difference: f64 = asymptotic_terms(0, x)
        .zip(asymptotic_terms(1, x))
        .skip(1)
        .map(|(a, b)| a - b)
        .sum();
    difference / asymptotic_terms(0, x).sum::<f64>()
}

fn bessel_scaled(order: i32, x: f64) -> f64 {
    if x <= BESSEL_SWITCH {
        (-x).exp() * bessel_series(order, x)
    } else {
        asymptotic_terms(order, x).sum::<f64>() / (TAU * x).sqrt()
    }
}

/// `I_n(x) = (x/2)^n sum_k (x^2/4)^k / (k! (k+n)!)` for n = 0, 1: all terms positive (Abramowitz and Stegun 9.6.10).
fn bessel_series(order: i32, x: f64) -> f64 {
    let quarter_square = 0.25 * x * x;
    let mut term = (0.5 * x).powi(order);
    let mut sum = term;
    let mut k = 1.0;
    while term > sum * 1e-18 {
        term *= quarter_square / (k * (k + f64::from(order)));
        sum += term;
        k += 1.0;
    }
    sum
}

/// Terms of `sqrt(2 pi x) exp(-x) I_n(x) ~ sum_k (-1)^k a_k(n) / x^k` (Abramowitz and Stegun 9.7.1), until they no longer
/// matter. For `x > 30` they fall below 1e-18 before the series begins to diverge.
fn asymptotic_terms(order: i32, x: f64) -> impl Iterator<Item = f64> {
    let four_square = f64::from(4 * order * order);
    (1..60).scan(1.0_f64, move |next, k| {
        let term = *next;
        let odd = f64::from(2 * k - 1);
        *next = -term * (four_square - odd * odd) / (f64::from(k) * 8.0 * x);
        (term.abs() > 1e-18).then_some(term)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn assert_close(found: f64, expected: f64, relative: f64) {
        assert!(
            (found - expected).abs() <= relative * expected.abs(),
            "found {found:e}, expected {expected:e}"
        );
    }

    // 30-digit mpmath: besseli(n, x) exp(-x) and 1 - I1/I0.
    const BESSEL: &[(f64, f64, f64, f64)] = &[
        (0.0, 1.0, 0.0, 1.0),
        (
            1e-05,
            0.9999900000749996,
            4.999950000312499e-06,
            0.9999950000000001,
        ),
        (
            0.5,
            0.6450352704491501,
            0.1564208031848717,
            0.757500387419198,
        ),
        (
            1.6211389382774044,
            0.35050528430101424,
            0.21895490381216887,
            0.37531639715842285,
        ),
        (
            7.75,
            0.1458122743089143,
            0.1360511000803391,
            0.06694343308777569,
        ),
        (
            15.0,
            0.10389953144882272,
            0.10037417504516666,
            0.033930436013491876,
        ),
        (
            29.5,
            0.07376861727872859,
            0.07250732615718372,
            0.01709793633218284,
        ),
        (
            30.5,
            0.07253878407077907,
            0.071339539285262,
            0.01653246330055547,
        ),
        (
            100.0,
            0.03994437929909668,
            0.03974415302513025,
            0.005012626994831235,
        ),
        (
            713.5,
            0.014937888578556241,
            0.014927416868711262,
            0.0007010167327136048,
        ),
        (
            3282.806350011744,
            0.0069631214897782345,
            0.006962060864937634,
            0.00015232031239984054,
        ),
        (
            100000.0,
            0.0012615678379767768,
            0.0012615615301218171,
            5.000012500125002e-06,
        ),
        (
            32828063.5,
            6.962856344944492e-05,
            6.962856238894125e-05,
            1.5230871105379635e-08,
        ),
    ];

    #[test]
    fn scaled_bessel_functions_match_30_digit_values() {
        for &(x, zero, one, deficit) in BESSEL {
            assert_close(i0e(x), zero, 1e-14);
            assert_close(i1e(x), one, 1e-14);
            assert_close(bessel_ratio_deficit(x), deficit, 1e-13);
        }
    }

    #[test]
    fn a_plain_quotient_would_fail_at_large_arguments() {
        let &(x, _, _, deficit) = BESSEL.last().unwrap();
        let naive = 1.0 - i1e(x) / i0e(x);
        assert!((naive / deficit - 1.0).abs() > 1e-13, "{naive:e}");
    }

    #[test]
    fn series_and_asymptotics_meet() {
        for order in [0, 1] {
            let series = (-BESSEL_SWITCH).exp() * bessel_series(order, BESSEL_SWITCH);
            let far =
                asymptotic_terms(order, BESSEL_SWITCH).sum::<f64>() / (TAU * BESSEL_SWITCH).sqrt();
            assert_close(series, far, 1e-14);
        }
        assert_close(
            bessel_ratio_deficit(30.0),
            bessel_ratio_deficit(30.0 + 1e-12),
            1e-12,
        );
    }

    // 30-digit mpmath: (erf(b/sqrt 2) - erf(a/sqrt 2)) / 2.
    const NORMAL: &[(f64, f64, f64)] = &[
        (-1.0, 1.0, 0.6826894921370859),
        (-0.3, 2.5, 0.6117017568631765),
        (0.5, 0.75, 0.0819101863491187),
        (0.1, 0.1001, 3.969505620592639e-05),
        (1.0, 4.0, 0.15862358268962393),
        (7.5, 8.0, 3.1286820671681786e-14),
        (7.5, 7.51, 2.3452351753500372e-15),
        (20.0, 21.0, 2.7536241153269555e-89),
        (30.0, 30.01, 1.2731211121828332e-198),
        (-40.0, -0.001, 0.49960105778608893),
        (2.0, 2.9, 0.020884318647795167),
        (0.001, 0.9, 0.31554093243932946),
    ];

    #[test]
    fn normal_probabilities_match_30_digit_values_and_mirror() {
        for &(low, high, expected) in NORMAL {
            assert_close(normal_probability(low, high), expected, 1e-13);
            assert_close(normal_probability(-high, -low), expected, 1e-13);
        }
        assert_close(
            normal_probability(f64::NEG_INFINITY, f64::INFINITY),
            1.0,
            0.0,
        );
    }

    #[test]
    fn a_difference_of_two_numbers_near_one_would_fail() {
        let cdf = |z: f64| 0.5 * (1.0 + libm::erf(z * FRAC_1_SQRT_2));
        let &(low, high, expected) = NORMAL.iter().find(|r| r.0 > 7.0).unwrap();
        let naive = cdf(high) - cdf(low);
        assert!((naive / expected - 1.0).abs() > 1e-6, "{naive:e}");
    }

    // 40-digit mpmath.
    const ERF_INV: &[(f64, f64)] = &[
        (1e-300, 8.86226925452758e-301),
        (1e-09, 8.86226925452758e-10),
        (0.001, 0.0008862271574665521),
        (0.1, 0.08885599049425769),
        (0.3, 0.2724627147267543),
        (0.499, 0.47582428088309237),
        (0.5, 0.4769362762044699),
        (0.7, 0.7328690779592167),
        (0.9, 1.1630871536766743),
        (0.99, 1.8213863677184494),
        (0.9999, 2.75106390571208),
        (0.99999999, 4.052237243268763),
        (1.0 - 1.0 / 1099511627776.0, 5.05125408524939),
        (1.0 - 1.0 / 281474976710656.0, 5.564773326996245),
        (1.0 - 1.0 / 9007199254740992.0, 5.8635847487551676),
    ];

    #[test]
    fn the_inverse_error_function_matches_40_digit_values_and_undoes_erf() {
        for &(x, expected) in ERF_INV {
            assert_close(erf_inv(x), expected, 1e-14);
            assert_close(erf_inv(-x), -expected, 1e-14);
        }
        for k in 0..4000 {
            let x = f64::from(k) / 4000.0;
            assert_close(libm::erf(erf_inv(x)), x, 1e-14);
        }
        for (c, expected) in [
            (0.7, 0.2724627147267544),
            (0.3, 0.7328690779592169),
            (1e-20, 6.601580622355143),
            (1e-100, 15.065574702592645),
            (1e-300, 26.209469960516124),
        ] {
            assert_close(erfc_inv(c), expected, 1e-14);
        }
        assert!(erfc_inv(0.0).is_infinite() && erfc_inv(1.0) == 0.0);
        assert!(erfc_inv(-0.1).is_nan() && erfc_inv(1.1).is_nan() && erfc_inv(f64::NAN).is_nan());
        assert_eq!(erf_inv(0.0).to_bits(), 0.0_f64.to_bits());
        for x in [-1.0_f64, 1.0] {
            assert!(erf_inv(x).is_infinite() && erf_inv(x) * x > 0.0);
        }
        assert!(erf_inv(1.0 + f64::EPSILON).is_nan() && erf_inv(f64::NAN).is_nan());
    }

    #[test]
    fn the_inverse_by_erf_alone_would_fail_near_one() {
        let &(x, expected) = ERF_INV.last().unwrap();
        let off = expected * 1.005;
        let newton = (libm::erf(off) - x) * 0.5 * PI.sqrt() * (off * off).exp();
        assert!(((off - newton) / expected - 1.0).abs() > 1e-4, "{newton}");
    }
}
