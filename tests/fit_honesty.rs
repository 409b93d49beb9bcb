//! What a fit says of its own certainty: intervals cover, an inert parameter is called undetermined, a truth on a bound is
//! found there, the start does not matter, and the same seed and paths repeat exactly.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

mod toy;

use goniofit::base::Unwatched;
use goniofit::fit::{FitResult, Options, Verdict, fit};
use goniofit::scatter::Parameters;
use toy::{GABARDINE, INSIDE, TOY, Toy, options, seed};

fn run(toy: &Toy, truth: &[f64; 9], sd: f64, options: &Options) -> FitResult {
    let measurements = toy.measure(&Toy::truth(truth), sd, options.seed);
    fit(toy, &measurements, options, &Unwatched).unwrap()
}

/// Flat truth in the units of the result (degrees for angles).
fn in_file_units(truth: &[f64; 9]) -> Vec<f64> {
    let flat = Toy::truth(truth);
    flat.values()
        .iter()
        .enumerate()
        .map(|(i, v)| if i < 6 { *v } else { v.to_degrees() })
        .collect()
}

#[test]
fn intervals_cover_the_truth() {
    // 30 fits x 9 parameters at 95 %: about 14 misses expected if the parameters were independent; they are not, so up to
    // 40 are allowed. Sees intervals about half as wide as they should be.
    let toy = Toy::default();
    let truth = in_file_units(&INSIDE);
    let (mut misses, mut shrunk_misses) = (0, 0);
    for k in 0..30 {
        let result = run(&toy, &INSIDE, 0.02, &options(seed(200) + k, 5_000_000));
        for (p, t) in result.uncertainty.iter().zip(&truth) {
            let [low, high] = p.interval_95;
            assert!(
                low <= p.value && p.value <= high,
                "{}: {} outside {low}..{high}",
                p.name,
                p.value
            );
            misses += i32::from(!(low..=high).contains(t));
            // Negative control: intervals of a fifth of the width.
            let shrunk = |x: f64| p.value + 0.2 * (x - p.value);
            shrunk_misses += i32::from(!(shrunk(low)..=shrunk(high)).contains(t));
        }
    }
    assert!(misses <= 40, "{misses} of 270 intervals miss the truth");
    assert!(
        shrunk_misses > 40,
        "the test cannot see intervals five times too narrow: {shrunk_misses}"
    );
}

#[test]
fn a_parameter_without_effect_is_not_determined() {
    let verdict = |acts: bool| {
        let toy = Toy {
            beta_r_acts: acts,
            ..Toy::default()
        };
        let result = run(&toy, &INSIDE, 0.005, &options(seed(210), 20_000_000));
        let p = result
            .uncertainty
            .iter()
            .find(|p| p.name == "beta_r")
            .unwrap()
            .clone();
        (
            p.verdict,
            result.not_determined.contains(&"beta_r".to_owned()),
            p.sentence,
        )
    };
    let (inert, listed, sentence) = verdict(false);
    assert_eq!(inert, Verdict::NotDetermined, "{sentence}");
    assert!(listed && sentence.contains("not determined"), "{sentence}");
    // Negative control: where it acts, and the data are good, it is not called so.
    let (acting, listed, sentence) = verdict(true);
    assert!(acting != Verdict::NotDetermined && !listed, "{sentence}");
}

#[test]
fn truths_on_bounds_and_far_starts_are_found_or_flagged() {
    let toy = Toy::default();
    let truth = Toy::truth(&GABARDINE);
    let distance = |start: Option<Parameters>, k: u64| {
        let options = Options {
            start,
            ..options(seed(220) + k, 10_000_000)
        };
        let result = run(&toy, &GABARDINE, 0.0, &options);
        {
            let fitted = Parameters::from_json(&TOY, &result.parameters).unwrap();
            (100.0 * toy.distance(&fitted, &truth), result.converged)
        }
    };
    let corner = |colors: f64, upper: bool| {
        let defaults = Parameters::defaults(&TOY);
        let places = defaults.places();
        let values = places.iter().map(|&(row, _)| {
            let info = &defaults.infos()[row];
            if info.per_channel {
                colors
            } else if upper {
                info.upper
            } else {
                info.lower
            }
        });
        defaults.with_values(values.collect())
    };
    for (k, start) in [None, Some(corner(0.9, false)), Some(corner(0.3, true))]
        .into_iter()
        .enumerate()
    {
        let published = start.is_none();
        let (error, converged) = distance(start, k as u64);
        assert!(
            error < 10.0 || !(published || converged),
            "start {k}: {error} %, converged {converged}"
        );
    }
}

#[test]
fn the_same_seed_and_paths_give_the_same_fit() {
    let toy = Toy::default();
    let once = |seed: u64| run(&toy, &INSIDE, 0.01, &options(seed, 500_000));
    let (a, b, other) = (once(5), once(5), once(6));
    assert_eq!(a.parameters, b.parameters);
    assert_eq!(a.objective, b.objective);
    assert_ne!(a.parameters, other.parameters);
}

#[test]
fn large_errors_are_no_fault_of_the_model_where_they_are_stated() {
    // Measurements of 10 %, tolerance 5 %. Of right models 1.4 % pass the limit of 11.2 %: three of twelve would be once in
    // 2000 times. Sees a limit of 10 %.
    let toy = Toy::default();
    let beyond = |stated: f64| {
        let one = |k: &u64| {
            let options = options(seed(230) + k, 5_000_000);
            let mut measurements = toy.measure(&Toy::truth(&INSIDE), 0.1, options.seed);
            for i in &mut measurements.intensities {
                i.standard_error = i.standard_error.map(|s| stated * s);
            }
            let result = fit(&toy, &measurements, &options, &Unwatched).unwrap();
            result.reason.contains("above the tolerance")
        };
        (0..12).filter(one).count()
    };
    let (right, wrong) = (beyond(1.0), beyond(0.1));
    assert!(right <= 2, "{right} of 12");
    // Negative control: the same measurements with errors stated ten times too small.
    assert!(wrong >= 8, "{wrong} of 12");
}
