//! What a camera with one channel leaves open stays open: in predictions, and where configurations are left out.
#![allow(clippy::unwrap_used, missing_docs)]

mod toy;

use goniofit::base::Unwatched;
use goniofit::fit::{
    Budget, Compared, Comparison, FitResult, Refit, compare, fit, predict, validate,
};
use goniofit::render::Effort;
use goniofit::session::Measurements;
use toy::{INSIDE, Toy, options, seed};

/// The toy's measurements in green alone; what stands at the other channels is no number.
fn green() -> Measurements {
    let mut all = Toy::default().measure(&Toy::truth(&INSIDE), 0.01, seed(500));
    for i in &mut all.intensities {
        i.present = [false, true, false];
        for c in [0, 2] {
            i.mean[c] = f64::NAN;
            i.standard_error[c] = f64::NAN;
        }
    }
    all
}

fn fitted(measurements: &Measurements) -> FitResult {
    let options = options(seed(500), 6_000_000);
    fit(&Toy::default(), measurements, &options, &Unwatched).unwrap()
}

fn of_one_channel(row: &Compared) -> bool {
    row.z.map(|z| z.is_some()) == [false, true, false]
        && row.residual.map(|r| r.is_some()) == [false, true, false]
}

/// Every number that is said is finite, and those that cannot be said are not.
fn check(comparison: &Comparison) {
    let [rms, se] = comparison.weighted_rms_percent;
    assert!(
        (0.0..20.0).contains(&rms) && (0.0..20.0).contains(&se),
        "{rms} {se}"
    );
    assert!(
        (0.3..3.0).contains(&comparison.rms_z),
        "{}",
        comparison.rms_z
    );
    for row in &comparison.rows {
        assert!(of_one_channel(row), "{row:?}");
        let p = &row.prediction;
        let errors = [p.parameter_se, p.monte_carlo_se, p.model_se];
        let numbers = errors.as_flattened().iter().chain(&p.mean);
        assert!(
            numbers
                .chain(p.renders.as_flattened())
                .all(|x| x.is_finite())
        );
        // Of a color that nobody saw no prediction is sure.
        for c in [0, 2] {
            assert!(
                p.parameter_se[c] > 3.0 * p.parameter_se[1],
                "{:?} {:?}",
                p.configuration.id,
                p.parameter_se
            );
        }
    }
}

#[test]
fn predictions_are_relative_to_the_channel_that_was_seen() {
    let measurements = green();
    let mut result = fitted(&measurements);
    result.objective.misfit_percent = 10.0;
    let (poses, effort) = (measurements.configurations(), Effort::Paths(200_000));
    let toy = Toy::default();
    let predictions = predict(&toy, &result, &poses, &effort, seed(501), &Unwatched).unwrap();
    let mut others = 0;
    for p in &predictions {
        let of_green = 0.1 * p.mean[1].max(0.02);
        for se in p.model_se {
            assert!((se / of_green - 1.0).abs() < 1e-12, "{p:?}");
        }
        // Negative control: the mean of all channels is another number.
        let of_all = 0.1 * (p.mean.iter().sum::<f64>() / 3.0).max(0.02);
        others += usize::from((of_all / of_green - 1.0).abs() > 0.02);
    }
    assert!(others > 8, "{others} of 16");
    result.objective.misfit_percent = 0.0;
    let predictions = predict(&toy, &result, &poses, &effort, seed(501), &Unwatched).unwrap();
    check(&compare(&predictions, &measurements, goniofit::fit::TAU).unwrap());
}

#[test]
fn configurations_are_left_out_of_one_channel() {
    let measurements = green();
    let result = fitted(&measurements);
    let run = |folds: &[Vec<u32>], refit: &Refit| {
        let toy = Toy::default();
        let seed = seed(502);
        validate(&toy, &measurements, &result, folds, refit, seed, &Unwatched).unwrap()
    };
    let each: Vec<Vec<u32>> = (1..=16).map(|id| vec![id]).collect();
    let fast = run(&each, &Refit::Linear { paths: 400_000 });
    check(&fast);
    let budget = Budget {
        paths: Some(3_000_000),
        ..Budget::default()
    };
    let paths = 400_000;
    check(&run(&[vec![2, 6, 11]], &Refit::Search { budget, paths }));
}
