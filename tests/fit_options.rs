//! Promise: tau, narrower bounds and what lies under the cloth reach everything a fit does, stand in `fit.json`, and hold for
//! what is made from it later.
#![allow(clippy::unwrap_used, missing_docs)]

mod toy;

use assert_cmd::cargo::cargo_bin;
use goniofit::base::{Result, Unwatched, Watch};
use goniofit::fit::{
    Aim, Bounds, Budget, FitResult, JournalHeader, Method, Objective, Options, ParameterResult,
    Refit, SgdOptions, SuggestOptions, Verdict, compare, fit, predict, suggest, validate,
};
use goniofit::render::{Effort, Estimates, Request, Scene};
use goniofit::scatter::{Parameters, Parametric};
use goniofit::session::Measurements;
use serde_json::Value;
use std::collections::BTreeMap;
use std::process::Command;
use std::sync::Mutex;
use toy::{INSIDE, TOY, Toy, seed};

#[path = "common/fit_list.rs"]
mod fit_list;
use fit_list::Place;

/// The toy, and the least and greatest value of every flat place it was rendered at.
struct Seen {
    toy: Toy,
    range: Mutex<Vec<[f64; 2]>>,
}

impl Seen {
    fn new() -> Self {
        let range = Mutex::new(vec![[f64::INFINITY, f64::NEG_INFINITY]; 9]);
        // Noise so small that the published descent comes to rest with few paths.
        let toy = Toy {
            path_sd: [1.0; 16],
            score_sd: 0.2,
            ..Toy::default()
        };
        Self { toy, range }
    }

    fn take(self) -> Vec<[f64; 2]> {
        self.range.into_inner().unwrap()
    }
}

impl Scene for Seen {
    fn model(&self) -> &'static dyn Parametric {
        &TOY
    }

    fn estimate(&self, request: &Request<'_>, watch: &dyn Watch) -> Result<Estimates> {
        let mut range = self.range.lock().unwrap();
        for ([low, high], value) in range.iter_mut().zip(request.parameters.values()) {
            (*low, *high) = (low.min(*value), high.max(*value));
        }
        drop(range);
        self.toy.estimate(request, watch)
    }
}

fn bounds(texts: &[&str]) -> Bounds {
    Bounds::parse(&texts.iter().map(|t| (*t).to_owned()).collect::<Vec<_>>()).unwrap()
}

fn options(method: Method, texts: &[&str]) -> Options {
    let paths = match method {
        Method::GaussNewton => 3_000_000,
        _ => 12_000_000,
    };
    let budget = Budget {
        paths: Some(paths),
        ..Budget::default()
    };
    Options {
        method,
        bounds: bounds(texts),
        sgd: SgdOptions {
            rates: vec![1.0, 4.0, 16.0],
            ..SgdOptions::default()
        },
        ..Options::new(seed(6000), budget)
    }
}

fn measured() -> Measurements {
    Toy::default().measure(&Toy::truth(&INSIDE), 0.02, seed(6000))
}

fn named<'a>(result: &'a FitResult, name: &str) -> &'a ParameterResult {
    result.uncertainty.iter().find(|p| p.name == name).unwrap()
}

const NARROW: [&str; 3] = ["c_r=0.15..1", "c_r.g=0.15..0.6", "beta_r=2..8"];

#[test]
fn a_truth_below_a_bound_is_fitted_at_the_bound_by_every_method() {
    // The truth has c_r.b = 0.10. Sees any render outside the bounds, from the first knot to the final check.
    for method in Method::GENERAL {
        let scene = Seen::new();
        let result = fit(&scene, &measured(), &options(method, &NARROW), &Unwatched).unwrap();
        let blue = named(&result, "c_r.b");
        assert_eq!(blue.verdict, Verdict::AtLowerBound, "{method:?} {blue:?}");
        assert!(
            blue.sentence.contains("at its lower bound 0.150"),
            "{blue:?}"
        );
        let held = "c_r.b is held by a bound that was asked for";
        assert!(result.reason.contains(held), "{}", result.reason);
        let unlike = |a: f64, b: f64| (a - b).abs() > 1e-12;
        assert!(!unlike(blue.value, 0.15) && !unlike(blue.lower_bound, 0.15));
        // The published start 0.1 lies outside.
        assert!(!unlike(blue.initial, 0.15), "{blue:?}");
        for p in &result.uncertainty {
            for x in [p.interval_68, p.interval_95].as_flattened() {
                assert!(
                    (p.lower_bound..=p.upper_bound).contains(x),
                    "{method:?} {p:?}"
                );
            }
        }
        assert!(!unlike(named(&result, "c_r.g").upper_bound, 0.6));
        assert!(!unlike(named(&result, "c_r.r").upper_bound, 0.999));
        let ends = result.bounds.over(&Parameters::defaults(&TOY)).unwrap();
        for ([low, high], [least, most]) in scene.take().into_iter().zip(ends) {
            assert!(
                low >= least && high <= most,
                "{method:?} {low} {high} {least} {most}"
            );
        }

        // Negative control: without the bound the same fit goes below it, and so do its renders.
        let scene = Seen::new();
        let free = fit(&scene, &measured(), &options(method, &[]), &Unwatched).unwrap();
        let blue = named(&free, "c_r.b");
        assert!(
            blue.value < 0.14 && blue.verdict != Verdict::AtLowerBound,
            "{method:?} {blue:?}"
        );
        assert!(scene.take()[2][0] < 0.14);
        assert!(free.bounds.is_empty() && !free.reason.contains("held"));
    }
}

#[test]
fn a_verdict_judges_by_the_narrower_range() {
    let share = |texts: &[&str]| {
        let scene = Toy::default();
        let result = fit(
            &scene,
            &measured(),
            &options(Method::GaussNewton, texts),
            &Unwatched,
        );
        let red = named(&result.unwrap(), "beta_r").clone();
        (red.interval_95, red.range_share)
    };
    let ([low, high], whole) = share(&[]);
    // Bounds well outside the interval leave it alone; the logarithmic range of 1 to 10 degrees shrinks to 2 to 8.
    assert!(low > 2.0 && high < 8.0, "{low} {high}");
    let (_, narrow) = share(&["beta_r=2..8"]);
    let expected = whole * 10.0_f64.ln() / 4.0_f64.ln();
    assert!((narrow / expected - 1.0).abs() < 0.15, "{whole} {narrow}");
}

#[test]
fn refits_and_suggested_knowledge_keep_to_the_fits_bounds() {
    let measured = measured();
    let options = options(Method::GaussNewton, &NARROW);
    let mut full = fit(&Toy::default(), &measured, &options, &Unwatched).unwrap();
    // As from the file.
    full = serde_json::from_str(&full.to_json().unwrap()).unwrap();
    assert_eq!(full.bounds, options.bounds);
    let refit = Refit::Search {
        budget: Budget {
            paths: Some(600_000),
            ..Budget::default()
        },
        paths: 10_000,
    };
    let least_blue = |full: &FitResult| {
        let scene = Seen::new();
        validate(&scene, &measured, full, &[vec![3]], &refit, 1, &Unwatched).unwrap();
        scene.take()[2][0]
    };
    assert!(least_blue(&full) >= 0.15);
    // What a suggestion takes for known; the toy's defaults are inside these.
    let least_known = |texts: &[&str]| {
        let asked = SuggestOptions {
            shots: 1,
            aim: Aim::Weakest,
            relative_error: 0.5,
            tau: full.tau,
            bounds: bounds(texts),
            model_error: 0.0,
            paths: 1000,
            seed: seed(6000),
        };
        let start = Parameters::defaults(&TOY);
        let poses = Toy::configurations();
        let told = suggest(&Toy::default(), &start, &[], &poses, &asked, &Unwatched).unwrap();
        told.now[2].interval_95[0]
    };
    assert!(least_known(&["c_r=0.05..1"]) >= 0.05);

    // Negative controls: a refit, and a suggestion, that have lost the bounds.
    assert!(least_known(&[]) < 0.049);
    full.bounds = Bounds::default();
    assert!(least_blue(&full) < 0.149);
}

#[test]
fn weights_stop_growing_at_tau() {
    let measured = measured();
    let brightness: Vec<f64> = (measured.intensities.iter())
        .map(|i| i.mean.iter().sum::<f64>() / 3.0)
        .collect();
    // One between the darkest and the brightest configuration.
    let tau = 0.5
        * (brightness.iter().copied().fold(1.0, f64::min)
            + brightness.iter().copied().fold(0.0, f64::max));
    let objective = Objective::with_tau(&measured, tau).unwrap();
    for (w, a) in objective.weights().iter().zip(&brightness) {
        assert!((w[0] * a.max(tau).powi(2) - 1.0).abs() < 1e-12, "{w:?} {a}");
    }
    for bad in [0.0, -0.02, 1.01, f64::NAN] {
        let report = Objective::with_tau(&measured, bad).unwrap_err().report();
        assert!(report.contains("above 0 and at most 1"), "{report}");
    }

    let options = Options {
        tau,
        ..options(Method::GaussNewton, &[])
    };
    let result = fit(&Toy::default(), &measured, &options, &Unwatched).unwrap();
    let result: FitResult = serde_json::from_str(&result.to_json().unwrap()).unwrap();
    assert!((result.tau - tau).abs() < 1e-15);
    for (c, w) in result.configs.iter().zip(objective.weights()) {
        assert!((c.weight - w[0]).abs() < 1e-9, "{c:?}");
    }
    // Predictions are judged alike: with tau = 1 all numbers weigh 1. They are those of another cloth, to have residuals.
    let other = Toy {
        distortion: 1.5,
        ..Toy::default()
    };
    let poses = objective.configurations();
    let effort = Effort::Paths(20_000);
    let predictions = predict(&other, &result, &poses, &effort, 1, &Unwatched).unwrap();
    let rms = |tau| {
        compare(&predictions, &measured, tau)
            .unwrap()
            .weighted_rms_percent[0]
    };
    let products = predictions
        .iter()
        .zip(&measured.intensities)
        .flat_map(|(p, m)| {
            (0..3).map(|c| (p.renders[0][c] - m.mean[c]) * (p.renders[1][c] - m.mean[c]))
        });
    let plain = 100.0 * (products.sum::<f64>() / 48.0).max(0.0).sqrt();
    assert!((rms(1.0) - plain).abs() < 1e-9, "{} {plain}", rms(1.0));
    assert!(rms(tau) > 1.01 * plain, "{} {plain}", rms(tau));
}

#[test]
fn a_journal_knows_tau_and_bounds() {
    let header = |options: &Options| JournalHeader::new(&TOY, options, BTreeMap::new());
    let plain = options(Method::GaussNewton, &[]);
    assert_eq!(header(&plain).difference(&header(&plain)), None);
    let darker = Options {
        tau: 0.05,
        ..plain.clone()
    };
    for (other, word) in [
        (darker, "tau: 0.02 then, tau: 0.05 now"),
        (
            options(Method::GaussNewton, &["c_r=0.04..1"]),
            "bounds: Bounds() then, bounds: Bounds(c_r=0.04..1) now",
        ),
    ] {
        let difference = header(&plain).difference(&header(&other)).unwrap();
        assert!(difference.contains(word), "{difference}");
    }
}

/// Exit code, stdout and stderr of a command in `place`.
fn run(place: &Place, words: &str) -> (Option<i32>, String, String) {
    let mut command = Command::new(cargo_bin("goniofit"));
    command.current_dir(place.at("")).args(words.split(' '));
    let output = command.env("RAYON_NUM_THREADS", "2").output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (
        output.status.code(),
        text(output.stdout),
        text(output.stderr),
    )
}

/// `fit.json` but for seconds and the command.
fn numbers(place: &Place, name: &str) -> Value {
    let mut fit: Value = serde_json::from_str(&place.read(name)).unwrap();
    for key in ["time", "history", "command"] {
        fit[key].take();
    }
    fit
}

const FIT: &str = "fit --measurements m1.csv --fabric net.toml --paths 40000";
const ASKED: &str = "--tau 0.3 --bound c_r=0.2..1 --bound gamma_tt=2..20 --plate 0.5";

#[test]
fn the_commands_keep_tau_bounds_and_plate() {
    let place = Place::new(
        "measurements = ['m1.csv']\nfabrics = ['net.toml']\n[[options]]\npaths = 40000\ntau = 0.3\n\
         bound = ['c_r=0.2..1', 'gamma_tt=2..20']\nplate = '0.5'\n",
    );
    let (code, _, err) = run(&place, &format!("{FIT} {ASKED} --out out"));
    assert!(code <= Some(1), "{err}");
    assert!(
        err.contains("bound c_r: the model's own upper bound 0.999 holds"),
        "{err}"
    );
    assert!(
        err.contains("c_r.r: the start 0.100 is outside the bounds, so the fit begins at 0.200"),
        "{err}"
    );
    let whole = numbers(&place, "out/fit.json");
    assert_eq!(whole["tau"], 0.3);
    assert_eq!(whole["plate"], "0.5,0.5,0.5");
    assert_eq!(whole["bounds"]["c_r"], serde_json::json!([0.2, 1.0]));
    assert_eq!(whole["uncertainty"][8]["upper_bound"], 20.0);
    assert!(place.read("out/report.html").contains("tau 0.3;"));

    // Going on is the same fit; nothing of it may be said anew.
    std::fs::remove_file(place.at("out/fit.json")).unwrap();
    let (code, _, err) = run(&place, "fit --resume out");
    assert!(code <= Some(1), "{err}");
    assert_eq!(numbers(&place, "out/fit.json"), whole);
    for other in ["--tau 0.4", "--bound c_r=0.3..1", "--plate black"] {
        let (code, _, err) = run(&place, &format!("fit --resume out {other}"));
        assert!(
            code == Some(2) && err.contains("cannot be used with"),
            "{err}"
        );
    }
    // A list of work asks for the same.
    let (code, _, err) = place.run("fits", &[]);
    assert!(code < 2, "{err}");
    let task = std::fs::read_dir(place.at("fits")).unwrap();
    let task = (task.map(|t| t.unwrap().path())).find(|t| t.join("fit.json").exists());
    let listed: Value =
        serde_json::from_str(&std::fs::read_to_string(task.unwrap().join("fit.json")).unwrap())
            .unwrap();
    for key in ["parameters", "tau", "bounds", "plate", "objective"] {
        assert_eq!(listed[key], whole[key], "{key}");
    }

    // Predictions show the fit's plate, or the one asked for; so does leaving out.
    let predict = |more: &str| {
        let words = format!("predict --fit out --measurements m1.csv --paths 4000 --json{more}");
        let (code, told, err) = run(&place, &words);
        assert_eq!(code, Some(0), "{err}");
        let told: Value = serde_json::from_str(&told).unwrap();
        told["configs"][0]["predicted"].clone()
    };
    let kept = predict("");
    assert_eq!(kept, predict(" --plate 0.5,0.5,0.5"));
    assert_ne!(kept, predict(" --plate black"));
    let validate = |more: &str| {
        let words = "validate --fit out --measurements m1.csv --fabric net.toml --hold-out 1 --refit-paths 10000";
        let (code, told, err) = run(&place, &format!("{words} --predict-paths 500{more}"));
        assert_eq!(code, Some(0), "{err}");
        told
    };
    assert_eq!(validate(""), validate(" --plate 0.5"));
    assert_ne!(validate(""), validate(" --plate open"));

    for (bad, fault) in [
        (
            "--tau 0",
            "'0' is not a normalized radiance above 0 and at most 1",
        ),
        ("--tau nan", "'nan' is not"),
        ("--tau 1.5", "'1.5' is not"),
        (
            "--bound c_x=0..1",
            "bound c_x: the model has no such parameter",
        ),
        ("--bound c_r=1..0", "bound 'c_r=1..0' is not NAME=LOW..HIGH"),
        ("--plate gray", "'gray' is not black, open, white"),
    ] {
        let (code, _, err) = run(&place, &format!("{FIT} {bad} --out other"));
        assert!(code == Some(2) && err.contains(fault), "{bad}: {err}");
        assert!(!place.at("other").exists(), "{bad}");
    }
}
