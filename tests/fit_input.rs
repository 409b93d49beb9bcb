//! Measurements as labs have them: numbers that were not measured, cameras with one channel, more and fewer poses than 16.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

mod toy;

use goniofit::base::Unwatched;
use goniofit::fit::{FitResult, Loss, Method, Objective, Options, RenderPair, Verdict, fit};
use goniofit::render::Effort;
use goniofit::scatter::Parameters;
use goniofit::session::{Intensity, Measurements};
use toy::{INSIDE, TOY, Toy, options, seed};

fn fitted(result: &FitResult) -> Parameters {
    Parameters::from_json(&TOY, &result.parameters).unwrap()
}

/// Measurements of the toy of which `keep` (by configuration and channel) is left; what is at the others is `filler`.
fn some(sd: f64, seed: u64, filler: f64, keep: impl Fn(usize, usize) -> bool) -> Measurements {
    let mut all = Toy::default().measure(&Toy::truth(&INSIDE), sd, seed);
    for (i, intensity) in all.intensities.iter_mut().enumerate() {
        for c in 0..3 {
            if !keep(i, c) {
                intensity.present[c] = false;
                intensity.mean[c] = filler;
                intensity.standard_error[c] = filler;
            }
        }
    }
    all
}

/// A third of all numbers is missing, none of them in configurations 1, 4, 7, ...
fn gappy(i: usize, c: usize) -> bool {
    i.is_multiple_of(3) || c != i % 2
}

#[test]
fn the_objective_is_the_sum_over_what_was_measured() {
    let toy = Toy::default();
    let measurements = some(0.02, seed(300), 5.0, gappy);
    let objective = Objective::new(&measurements).unwrap();
    let at = Parameters::defaults(&TOY);
    let poses = measurements.configurations();
    let effort = Effort::Paths(2000);
    let pair = RenderPair::render(&toy, &poses, &at, &effort, 1, 0, &Unwatched).unwrap();
    let (mut value, mut n) = (0.0, 0);
    for (i, (m, [a, b])) in measurements
        .intensities
        .iter()
        .zip(pair.estimates())
        .enumerate()
    {
        let present: Vec<usize> = (0..3).filter(|&c| gappy(i, c)).collect();
        let brightness = present.iter().map(|&c| m.mean[c]).sum::<f64>() / present.len() as f64;
        for &c in &present {
            let w = brightness.max(0.02).powi(-2);
            value += w * (a.mean[c] - m.mean[c]) * (b.mean[c] - m.mean[c]);
            n += 1;
        }
    }
    assert_eq!(objective.n_numbers(), n);
    let found = objective.paired(&pair);
    assert!(
        (found.value / value - 1.0).abs() < 1e-12,
        "{found:?} {value}"
    );
    // What stands where nothing was measured changes nothing, in value, error and gradient; where it counts it does.
    for filler in [9.0, f64::NAN] {
        let other = Objective::new(&some(0.02, seed(300), filler, gappy)).unwrap();
        assert_eq!(other.paired(&pair), found);
        assert_eq!(other.gradient(&pair, &at), objective.gradient(&pair, &at));
    }
    let all = Objective::new(&some(0.02, seed(300), 5.0, |_, _| true)).unwrap();
    assert!((all.paired(&pair).value / value - 1.0).abs() > 1e-3);
}

#[test]
fn a_fit_with_gaps_finds_the_truth_and_never_looks_into_them() {
    let toy = Toy::default();
    let run = |filler: f64| {
        let measurements = some(0.01, seed(310), filler, gappy);
        fit(
            &toy,
            &measurements,
            &options(seed(310), 10_000_000),
            &Unwatched,
        )
        .unwrap()
    };
    let (a, b) = (run(0.0), run(f64::NAN));
    assert_eq!(a.to_json().unwrap(), b.to_json().unwrap());
    let error = 100.0 * toy.distance(&fitted(&a), &Toy::truth(&INSIDE));
    assert!(
        error < 5.0 && a.objective.n == 38,
        "{error} % of {}",
        a.objective.n
    );
    // fit.json has nulls there, and reads back.
    let gap = &a.configs[1];
    assert_eq!(gap.measured.map(|m| m.is_some()), [true, false, true]);
    assert_eq!(
        gap.residual[1]
            .or(gap.measured_se[1])
            .or(gap.relative_residual[1]),
        None
    );
    let back: FitResult = serde_json::from_str(&a.to_json().unwrap()).unwrap();
    assert_eq!(back, a);
    // Negative control: taken for data the filler spoils the fit.
    let mut spoiled = some(0.01, seed(310), 3.0, gappy);
    spoiled
        .intensities
        .iter_mut()
        .for_each(|i| i.present = [true; 3]);
    let result = fit(&toy, &spoiled, &options(seed(310), 10_000_000), &Unwatched).unwrap();
    assert!(100.0 * toy.distance(&fitted(&result), &Toy::truth(&INSIDE)) > 5.0);
}

#[test]
fn a_camera_with_one_channel_determines_its_color_and_says_that_it_does_not_see_the_others() {
    let toy = Toy::default();
    let one = some(0.005, seed(320), 0.0, |_, c| c == 1);
    let text = one.to_csv().unwrap();
    let one = Measurements::from_csv(&text).unwrap();
    let result = fit(&toy, &one, &options(seed(320), 20_000_000), &Unwatched).unwrap();
    assert_eq!(result.objective.n, 16);
    let (found, truth) = (fitted(&result), Toy::truth(&INSIDE));
    let rms: f64 = (0..16)
        .map(|i| (toy.mean(found.values(), i, 1) / toy.mean(truth.values(), i, 1) - 1.0).powi(2))
        .sum();
    assert!((rms / 16.0).sqrt() < 0.05, "{rms} {}", result.parameters);
    for p in &result.uncertainty {
        let unseen = p.name.ends_with(".r") || p.name.ends_with(".b");
        assert_eq!(
            p.sentence.contains("no measurement sees"),
            unseen,
            "{}",
            p.sentence
        );
        assert_eq!(
            result.not_determined.contains(&p.name),
            p.verdict == Verdict::NotDetermined
        );
        if unseen {
            assert_eq!(p.verdict, Verdict::NotDetermined);
            assert_eq!(p.interval_95, [p.lower_bound, p.upper_bound]);
            assert!(
                (p.value - p.initial).abs() < 1e-9,
                "{} moved to {}",
                p.name,
                p.value
            );
        }
    }
    let of = |name: &str| result.uncertainty.iter().find(|p| p.name == name).unwrap();
    assert_ne!(
        of("c_tt.g").verdict,
        Verdict::NotDetermined,
        "{}",
        of("c_tt.g").sentence
    );
}

#[test]
fn any_number_of_configurations_can_be_fitted() {
    let toy = Toy::default();
    let of = |n: usize| {
        let all = toy
            .measure(&Toy::truth(&INSIDE), 0.01, seed(330))
            .intensities;
        let nth = |k: usize| {
            let mut i: Intensity = all[k % 16];
            i.configuration.id = k as u32 + 1;
            i
        };
        let measurements = Measurements {
            intensities: (0..n).map(nth).collect(),
        };
        fit(
            &toy,
            &measurements,
            &options(seed(330), 6_000_000),
            &Unwatched,
        )
        .unwrap()
    };
    for n in [1, 5, 16, 37] {
        let result = of(n);
        assert_eq!((result.objective.n, result.configs.len()), (3 * n, n));
        let error = 100.0 * toy.distance(&fitted(&result), &Toy::truth(&INSIDE));
        assert!(n < 16 || error < 8.0, "{n} configurations: {error} %");
        // One pose of three numbers cannot determine nine parameters.
        assert!(
            n > 1 || result.not_determined.len() >= 3,
            "{:?}",
            result.not_determined
        );
    }
}

/// Percent the fitted means are away from the truth's, noise-free, and the result.
fn judged(measurements: &Measurements, options: &Options) -> (f64, FitResult) {
    let toy = Toy::default();
    let result = fit(&toy, measurements, options, &Unwatched).unwrap();
    let error = 100.0 * toy.distance(&fitted(&result), &Toy::truth(&INSIDE));
    (error, result)
}

/// Measurements of 1 % of which configurations are off by factors.
fn off(seed: u64, factors: &[(usize, f64)]) -> Measurements {
    let mut measurements = Toy::default().measure(&Toy::truth(&INSIDE), 0.01, seed);
    for &(i, factor) in factors {
        let m = &mut measurements.intensities[i];
        m.mean = m.mean.map(|x| x * factor);
        m.standard_error = m.standard_error.map(|x| x * factor);
    }
    measurements
}

#[test]
fn an_outlier_spoils_the_squared_loss_and_not_the_robust_one() {
    // One configuration three times too bright. Sees an outlier that keeps a tenth of its
    // pull: the squared loss is off by more than 20 %.
    let robust = |k: u64| Options {
        loss: Loss::Huber(2.0),
        ..options(seed(400) + k, 20_000_000)
    };
    let squared = |k: u64| options(seed(400) + k, 20_000_000);
    let (clean, _) = judged(&off(seed(400), &[]), &squared(0));
    let allowed = 2.0 * clean + 1.0;
    for (k, outlier) in [(0, (4, 3.0)), (1, (9, 3.0))] {
        let measurements = off(seed(400), &[outlier]);
        let (error, result) = judged(&measurements, &robust(k));
        let weights: Vec<f64> = result.configs.iter().map(|c| c.robust_weight).collect();
        assert!(
            error < allowed,
            "{outlier:?}: {error} %, allowed {allowed} %; weights {weights:.3?}, {}",
            result.reason
        );
        for (i, q) in weights.iter().enumerate() {
            assert!(
                if i == outlier.0 { *q < 0.2 } else { *q > 0.4 },
                "{weights:.3?}"
            );
        }
        assert_eq!(result.loss, "huber:2");
        let words = result.outliers_in_words().unwrap();
        assert!(
            words.contains(&format!("{} to 0.", outlier.0 + 1)),
            "{words}"
        );
        // Negative control.
        let (spoiled, result) = judged(&measurements, &squared(k));
        assert!(
            spoiled > allowed,
            "{outlier:?}: the squared loss comes to {spoiled} %"
        );
        assert!(result.configs.iter().all(|c| c.robust_weight == 1.0));
        assert!(result.outliers_in_words().is_none());
    }
    // Without outliers it costs little.
    let (error, _) = judged(&off(seed(400), &[]), &robust(3));
    assert!(error < allowed, "{error} %, allowed {allowed} %");
}

#[test]
fn a_gain_takes_up_a_scale_error_that_spoils_the_parameters_otherwise() {
    let all: Vec<(usize, f64)> = (0..16).map(|i| (i, 1.04)).collect();
    let measurements = off(seed(410), &all);
    let with = Options {
        gain_prior: Some(0.05),
        ..options(seed(410), 20_000_000)
    };
    let misses = |result: &FitResult| -> usize {
        let truth = Toy::truth(&INSIDE);
        let scale = |i: usize| if i < 6 { 1.0 } else { 1_f64.to_degrees() };
        let rows = result.uncertainty.iter().zip(truth.values()).enumerate();
        rows.filter(|(i, (p, t))| {
            let t = scale(*i) * **t;
            !(p.interval_95[0]..=p.interval_95[1]).contains(&t)
        })
        .count()
    };
    let (error, result) = judged(&measurements, &with);
    let gain = result.gain.clone().unwrap();
    let [low, high] = gain.interval_95;
    assert!((low..=high).contains(&1.04), "{}", gain.sentence);
    assert!(
        low > 0.9 && high < 1.2 && gain.value > 1.0,
        "{}",
        gain.sentence
    );
    assert!(
        error < 2.5 && misses(&result) <= 1,
        "{error} %, {} miss",
        misses(&result)
    );
    // It is no parameter: names, file and covariance are the model's.
    assert_eq!(
        (result.uncertainty.len(), result.correlation.matrix.len()),
        (9, 9)
    );
    assert!(result.parameters.get("gain").is_none());
    // Negative control: the parameters take it up.
    let (spoiled, result) = judged(&measurements, &options(seed(410), 20_000_000));
    assert!(
        spoiled > 2.5 && misses(&result) >= 2,
        "{spoiled} %, {} miss",
        misses(&result)
    );
    assert!(result.gain.is_none());
}

#[test]
fn a_prior_without_data_against_it_stays_what_it_is_and_senseless_ones_are_refused() {
    // A camera that sees one pose cannot tell the gain from colors: the prior is all there is. Three numbers leave nine
    // parameters so free that some fits are still moving at the end, and say so; of those at rest (12 of 16) the gain is
    // within 1.3 standard deviations of the prior from 1. Sees a prior twice too weak or too strong in the intervals.
    let one = |k: u64| {
        let mut one = off(seed(420) + k, &[]);
        one.intensities.truncate(1);
        one
    };
    let with = |method: Method, k: u64| Options {
        method,
        gain_prior: Some(0.03),
        ..options(seed(420) + k, 4_000_000)
    };
    let mut at_rest = 0;
    for k in 0..16 {
        let (_, result) = judged(&one(k), &with(Method::GaussNewton, k));
        let gain = result.gain.unwrap();
        if result.converged {
            at_rest += 1;
            let spread = gain.standard_error / 0.03;
            assert!((spread - 1.0).abs() < 0.2, "{k}: {gain:?}");
            assert!((gain.value - 1.0).abs() < 0.06, "{k}: {gain:?}");
        }
    }
    assert!(at_rest >= 8, "{at_rest} of 16");
    let (_, result) = judged(&one(0), &with(Method::Adam, 0));
    assert!((result.gain.unwrap().value - 1.0).abs() < 0.1);
    let sgd = with(Method::Sgd, 0);
    let refused = fit(&Toy::default(), &one(0), &sgd, &Unwatched);
    assert!(refused.unwrap_err().report().contains("no gain"));
}
