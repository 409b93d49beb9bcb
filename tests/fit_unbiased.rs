//! The paired objective and its gradient are unbiased; the naive squared objective is caught as biased.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

mod toy;

use goniofit::base::Unwatched;
use goniofit::fit::{Objective, RenderPair};
use goniofit::math::statistics::{Running, sidak_level};
use goniofit::render::Effort;
use statrs::distribution::{ContinuousCDF, Normal};
use toy::{INSIDE, Toy, seed};

/// |z| a test of this level may reach.
fn limit(level: f64) -> f64 {
    Normal::new(0.0, 1.0)
        .unwrap()
        .inverse_cdf(1.0 - 0.5 * level)
}

/// Means over `n` pairs of: paired objective, naive objective of the first render, gradient, naive gradient of the first
/// render; and z-scores need truth.
struct Means {
    paired: Running,
    naive: Running,
    reported_variance: Running,
    gradient: Vec<Running>,
    naive_gradient: Vec<Running>,
}

fn sample(toy: &Toy, n: u64, paths: u64) -> (Means, f64, Vec<f64>) {
    let truth = Toy::truth(&INSIDE);
    let measurements = toy.measure(&truth, 0.02, 5);
    // Away from the minimum, where both terms of the gradient count.
    let mut values = truth.values().to_vec();
    values[3] *= 0.9;
    values[7] *= 1.1;
    let at = truth.with_values(values);
    let objective = Objective::new(&measurements).unwrap();
    let configurations = objective.configurations();
    let mut means = Means {
        paired: Running::default(),
        naive: Running::default(),
        reported_variance: Running::default(),
        gradient: vec![Running::default(); 9],
        naive_gradient: vec![Running::default(); 9],
    };
    for index in 0..n {
        let effort = Effort::Paths(paths);
        let pair = RenderPair::render(
            toy,
            &configurations,
            &at,
            &effort,
            seed(31),
            index,
            &Unwatched,
        )
        .unwrap();
        let value = objective.paired(&pair);
        means.paired.push(value.value);
        means.reported_variance.push(value.standard_error.powi(2));
        let naive: f64 = pair
            .estimates()
            .zip(objective.intensities())
            .zip(objective.weights())
            .map(|(([a, _], m), w)| {
                w[0] * (0..3).map(|c| (a.mean[c] - m.mean[c]).powi(2)).sum::<f64>()
            })
            .sum();
        means.naive.push(naive);
        for (running, g) in means
            .gradient
            .iter_mut()
            .zip(objective.gradient(&pair, &at))
        {
            running.push(g);
        }
        let mut naive = vec![0.0; 9];
        for (([a, _], m), w) in pair
            .estimates()
            .zip(objective.intensities())
            .zip(objective.weights())
        {
            for row in 0..at.infos().len() {
                for c in 0..3 {
                    let product = (a.mean[c] - m.mean[c]) * a.derivative[row][c];
                    naive[at.slot(row, c)] += 2.0 * w[c] * product;
                }
            }
        }
        for (running, g) in means.naive_gradient.iter_mut().zip(naive) {
            running.push(g);
        }
    }
    // The exact objective and gradient from the toy's closed form.
    let (mut exact, mut gradient) = (0.0, vec![0.0; 9]);
    for (i, (m, w)) in objective
        .intensities()
        .iter()
        .zip(objective.weights())
        .enumerate()
    {
        for c in 0..3 {
            let (mean, derivative) = toy.exact(at.values(), i, c);
            exact += w[c] * (mean - m.mean[c]).powi(2);
            for (g, d) in gradient.iter_mut().zip(derivative) {
                *g += 2.0 * w[c] * (mean - m.mean[c]) * d;
            }
        }
    }
    (means, exact, gradient)
}

#[test]
fn paired_objective_and_gradient_are_unbiased_and_the_naive_square_is_not() {
    let toy = Toy::default();
    let n = 4000;
    let (means, exact, gradient) = sample(&toy, n, 4096);
    // Eleven numbers are judged together at 1e-3. Sees a bias of the objective of 4 standard errors: the test prints it
    // (about 2 % of the naive objective's bias).
    let limit = limit(sidak_level(1e-3, 11));
    let z = |r: &Running, truth: f64| (r.mean() - truth) / r.standard_error();
    let paired = z(&means.paired, exact);
    assert!(
        paired.abs() < limit,
        "paired {} se {} exact {exact} n {n}: z {paired}",
        means.paired.mean(),
        means.paired.standard_error()
    );
    for (j, (running, exact)) in means.gradient.iter().zip(&gradient).enumerate() {
        let z = z(running, *exact);
        assert!(
            z.abs() < limit,
            "gradient {j}: {} se {} exact {exact} n {n}: z {z}",
            running.mean(),
            running.standard_error()
        );
    }
    // Negative control: the gradient from one render's own errors fails the same test.
    let worst = means
        .naive_gradient
        .iter()
        .zip(&gradient)
        .map(|(running, exact)| z(running, *exact).abs())
        .fold(0.0, f64::max);
    assert!(
        worst > limit,
        "the naive gradient passed: |z| {worst}, n {n}"
    );
    // Negative control: the square of one render fails the same test.
    let naive = z(&means.naive, exact);
    assert!(
        naive > limit,
        "the naive objective passed: {} se {} exact {exact} n {n}: z {naive}",
        means.naive.mean(),
        means.naive.standard_error()
    );
}

#[test]
fn the_objectives_standard_error_is_the_scatter_it_has() {
    let n = 4000;
    let (means, ..) = sample(&Toy::default(), n, 4096);
    // Rare paths make both variances noisy: a factor of 1.25 in the standard error is the smallest fault this can see.
    let ratio = (means.reported_variance.mean() / means.paired.variance()).sqrt();
    assert!(
        (0.8..1.25).contains(&ratio),
        "reported / seen standard error {ratio}, n {n}"
    );
    // Negative control: errors reported by renders of four times the paths are too small for this scatter.
    let (finer, ..) = sample(&Toy::default(), n, 4 * 4096);
    let wrong = (finer.reported_variance.mean() / means.paired.variance()).sqrt();
    assert!(
        !(0.8..1.25).contains(&wrong),
        "the test cannot see errors of a finer render: {wrong}"
    );
}

#[test]
fn numbers_that_are_not_finite_stop_the_fit_with_their_place() {
    let toy = Toy {
        distortion: f64::NAN,
        ..Toy::default()
    };
    let truth = Toy::truth(&INSIDE);
    let good = Toy::default().measure(&truth, 0.01, 1);
    let configurations = good.configurations();
    let effort = Effort::Paths(100);
    let error = RenderPair::render(&toy, &configurations, &truth, &effort, 1, 0, &Unwatched)
        .unwrap_err()
        .report();
    assert!(
        error.contains("configuration 3") && error.contains("NaN"),
        "{error}"
    );

    for bad in [f64::NAN, f64::INFINITY, -0.1] {
        let mut measurements = good.clone();
        measurements.intensities[4].mean[1] = bad;
        let error = Objective::new(&measurements).unwrap_err().report();
        assert!(
            error.contains("configuration 5") && error.contains("hint:"),
            "{error}"
        );
        let mut measurements = good.clone();
        measurements.intensities[4].standard_error[1] = bad;
        assert!(Objective::new(&measurements).is_err());
    }
}
