//! Where fits fail: every case ends converged, or flagged with a sentence for the user; never wrong and confident. Cases that
//! do end so are listed by name. The slow test runs all of them and prints the table of docs/stability.md.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

#[path = "stability/cloth.rs"]
mod cloth;
#[path = "common/render_scenes.rs"]
mod render_scenes;
mod stability;
mod toy;

use goniofit::base::Unwatched;
use goniofit::fit::{Bounds, Budget, Loss, Options, TAU, Verdict, fit};
use goniofit::scatter::Parameters;
use goniofit::session::Measurements;
use rayon::prelude::*;
use stability::{Class, Outcome, Row, judge, table};
use std::path::Path;
use toy::{INSIDE, TOY, Toy, seed};

/// Cases known to end wrong and confident (docs/stability.md says why).
const KNOWN_FAILURES: [&str; 2] = [
    "lamp drifts by 5 % over the session",
    "scale 5 % too bright",
];

type Change = fn(&mut Measurements);

/// A fit of the smooth stand-in.
#[derive(Clone)]
struct Case {
    name: String,
    truth: [f64; 9],
    /// Relative error of the measurements.
    sd: f64,
    paths: u64,
    start: Option<Parameters>,
    loss: Loss,
    gain_prior: Option<f64>,
    tau: f64,
    /// Asked for, as on the command line.
    bounds: Vec<String>,
    /// What was wrong with the session.
    change: Change,
    /// Whether the normal test run has it.
    fast: bool,
}

fn case(name: &str) -> Case {
    Case {
        name: name.to_owned(),
        truth: INSIDE,
        sd: 0.01,
        paths: 10_000_000,
        start: None,
        loss: Loss::Squared,
        gain_prior: None,
        tau: TAU,
        bounds: Vec::new(),
        change: |_| {},
        fast: true,
    }
}

impl Case {
    fn run(&self, seed: u64) -> Outcome {
        let toy = Toy::default();
        let truth = Toy::truth(&self.truth);
        let mut measurements = toy.measure(&truth, self.sd, seed);
        (self.change)(&mut measurements);
        let budget = Budget {
            paths: Some(self.paths),
            ..Budget::default()
        };
        let options = Options {
            start: self.start.clone(),
            loss: self.loss,
            gain_prior: self.gain_prior,
            tau: self.tau,
            bounds: Bounds::parse(&self.bounds).unwrap(),
            ..Options::new(seed, budget)
        };
        let result = fit(&toy, &measurements, &options, &Unwatched).unwrap();
        let fitted = Parameters::from_json(&TOY, &result.parameters).unwrap();
        let (fitted, exact) = (toy.means(&fitted), toy.means(&truth));
        let rows = measurements.intensities.iter().map(|m| {
            let i = m.configuration.id as usize - 1;
            let weight = goniofit::render::relative_error_weight(exact[i], self.tau);
            (weight, std::array::from_fn(|c| fitted[i][c] - exact[i][c]))
        });
        Outcome {
            means_off: 100.0 * goniofit::render::weighted_rms(rows),
            truth: self.truth.to_vec(),
            result,
        }
    }
}

/// Published fits (Khungurn 2015, Table IV), flat.
fn material(name: &str) -> [f64; 9] {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("fabrics/params/{name}.json"));
    let text = std::fs::read_to_string(path).unwrap();
    let json: serde_json::Value = serde_json::from_str(&text).unwrap();
    let number = |v: &serde_json::Value| v.as_f64().unwrap();
    std::array::from_fn(|j| match j {
        0..3 => number(&json["c_r"][j]),
        3..6 => number(&json["c_tt"][j - 3]),
        _ => number(&json[["beta_r_deg", "beta_tt_deg", "gamma_tt_deg"][j - 6]]),
    })
}

/// Multiplies a configuration, its stated error with it.
fn times(measurements: &mut Measurements, i: usize, factor: f64) {
    let m = &mut measurements.intensities[i];
    m.mean = m.mean.map(|x| factor * x);
    m.standard_error = m.standard_error.map(|x| factor * x);
}

fn keep(measurements: &mut Measurements, wanted: impl Fn(f64) -> bool) {
    let theta = |m: &goniofit::session::Intensity| m.configuration.light.theta.to_degrees();
    measurements.intensities.retain(|m| wanted(theta(m)));
}

fn drifting(measurements: &mut Measurements) {
    for i in 0..16 {
        times(measurements, i, 1.0 - 0.05 * i as f64 / 15.0);
    }
}

fn five_percent_bright(measurements: &mut Measurements) {
    (0..16).for_each(|i| times(measurements, i, 1.05));
}

/// The corner of the bounds with these sides: bits for C_R, C_TT, beta_R, beta_TT, gamma_TT.
fn corner(bits: usize) -> Parameters {
    let defaults = Parameters::defaults(&TOY);
    let value = |&(row, _): &(usize, usize)| {
        let info = &defaults.infos()[row];
        if bits >> row & 1 == 1 {
            info.upper
        } else {
            info.lower
        }
    };
    defaults.with_values(defaults.places().iter().map(value).collect())
}

fn starts_and_bounds() -> Vec<Case> {
    let mut cases = vec![case("nothing wrong")];
    cases.extend((0..32).map(|bits| Case {
        start: Some(corner(bits)),
        fast: [0, 5, 26, 31].contains(&bits),
        ..case("start in a corner of the bounds")
    }));
    let names = ["C_R green", "C_TT red", "beta_R", "beta_TT", "gamma_TT"];
    for (name, place) in names.into_iter().zip([1, 3, 6, 7, 8]) {
        let info = &Parameters::defaults(&TOY).infos()[[0, 0, 0, 1, 1, 1, 2, 3, 4][place]];
        let scale = if place < 6 { 1.0 } else { 1_f64.to_degrees() };
        for (side, bound) in [("lower", info.lower), ("upper", info.upper)] {
            let mut truth = INSIDE;
            truth[place] = scale * bound;
            cases.push(Case {
                truth,
                ..case(&format!("truth of {name} on its {side} bound"))
            });
        }
    }
    let mut narrow = INSIDE;
    narrow[7] = 7.0;
    cases.push(Case {
        truth: narrow,
        ..case("beta_TT = 7 degrees, below its bound")
    });
    cases
}

fn materials() -> Vec<Case> {
    let mut black = material("velvet");
    black[..3].fill(0.001);
    let mut cases = vec![
        Case {
            truth: black,
            ..case("black Velvet, C_R = 0.001")
        },
        Case {
            truth: black,
            bounds: vec!["c_r=0.04..1".to_owned()],
            ..case("black Velvet, C_R = 0.001, --bound c_r=0.04..1")
        },
    ];
    let named = [
        ("Velvet", "velvet", ""),
        ("Cotton", "cotton", ", near-white"),
        ("Silk", "silk", ", colored R, beta_R = 1 degree"),
        ("Twill", "twill", ""),
        ("Gabardine", "gabardine", ", beta_TT on its bound"),
        ("Fleece", "fleece", ""),
    ];
    cases.extend(named.map(|(name, file, what)| Case {
        truth: material(file),
        ..case(&format!("{name}{what}"))
    }));
    cases
}

fn sessions() -> Vec<Case> {
    let mut cases = Vec::new();
    let outliers: [(&str, Change); 4] = [
        ("configuration 5 times 3", |m| times(m, 4, 3.0)),
        ("configuration 5 divided by 3", |m| times(m, 4, 1.0 / 3.0)),
        ("configuration 10 times 3", |m| times(m, 9, 3.0)),
        ("configuration 10 divided by 3", |m| times(m, 9, 1.0 / 3.0)),
    ];
    for (name, change) in outliers {
        for loss in [Loss::Squared, Loss::Huber(2.0)] {
            let name = format!("{name}, {} loss", loss.name());
            cases.push(Case {
                change,
                loss,
                ..case(&name)
            });
        }
    }
    let with = |name: &str, change: Change| Case {
        change,
        ..case(name)
    };
    cases.push(with("lamp drifts by 5 % over the session", drifting));
    cases.push(with("scale 5 % too bright", five_percent_bright));
    cases.push(Case {
        gain_prior: Some(0.05),
        ..with("scale 5 % too bright, --gain-prior 5%", five_percent_bright)
    });
    cases.push(with("only the four steepest lamps", |m| {
        keep(m, |t| t < 24.0)
    }));
    cases.push(with("only the four most grazing lamps", |m| {
        keep(m, |t| t > 56.0)
    }));
    cases.push(with("without the four most grazing lamps", |m| {
        keep(m, |t| t < 56.0)
    }));
    for (name, sd) in [("0.1", 0.001), ("1", 0.01), ("10", 0.1)] {
        cases.push(Case {
            sd,
            ..case(&format!("measurement errors of {name} %"))
        });
    }
    for tau in [0.002, 0.1, 0.5] {
        cases.push(Case {
            tau,
            ..case(&format!("tau = {tau}"))
        });
    }
    for paths in [5_000, 20_000, 100_000, 500_000] {
        cases.push(Case {
            paths,
            ..case(&format!("{paths} camera paths in all"))
        });
    }
    cases
}

fn cases() -> Vec<Case> {
    [starts_and_bounds(), materials(), sessions()].concat()
}

/// Runs every case `repeats` times with seeds of its own; cases of one name make one row.
fn rows(cases: &[Case], repeats: usize) -> Vec<Row> {
    let job = |k: usize| judge(&cases[k / repeats].run(seed(900) + k as u64));
    let judged: Vec<_> = (0..cases.len() * repeats)
        .into_par_iter()
        .map(job)
        .collect();
    let mut rows: Vec<Row> = Vec::new();
    for (k, one) in judged.into_iter().enumerate() {
        let name = &cases[k / repeats].name;
        match rows.last_mut().filter(|r| r.name == *name) {
            Some(row) => row.fits.push(one),
            None => rows.push(Row {
                name: name.clone(),
                fits: vec![one],
            }),
        }
    }
    rows
}

fn assert_no_unknown_failure(rows: &[Row]) {
    let failed = rows.iter().filter(|r| r.worst().class == Class::Failed);
    let unknown: Vec<_> = failed
        .filter(|r| !KNOWN_FAILURES.contains(&r.name.as_str()))
        .map(|r| (&r.name, &r.worst().wrong, &r.worst().details))
        .collect();
    assert!(
        unknown.is_empty(),
        "wrong, confident, no warning: {unknown:?}"
    );
}

#[test]
fn nothing_ends_wrong_and_confident() {
    // A determined parameter three half widths of its 95 % interval from the truth is six standard errors off: with normal
    // errors all cases together come there once in 1e6 runs. Sees intervals three times too narrow.
    let fast: Vec<Case> = cases().into_iter().filter(|c| c.fast).collect();
    let rows = rows(&fast, 1);
    println!("{}", table(&rows));
    assert_no_unknown_failure(&rows);
    // What has nothing wrong must not be flagged, or flags say nothing.
    assert_eq!(rows[0].worst().class, Class::Converged);
}

#[test]
#[ignore = "slow: 7 min"]
fn the_table_of_all_cases() {
    let mut rows = rows(&cases(), 3);
    rows.extend(cloth::rows());
    println!("{}", table(&rows));
    assert_no_unknown_failure(&rows);
}

#[test]
fn a_confident_wrong_result_is_called_failed() {
    // Negative controls of the judgement itself, each made from a good fit.
    let good = case("nothing wrong").run(seed(890));
    assert_eq!(judge(&good).class, Class::Converged);
    let determined = |p: &goniofit::fit::ParameterResult| p.verdict == Verdict::Determined;
    let j = good.result.uncertainty.iter().position(determined).unwrap();
    let mut shifted = good.clone();
    let [low, high] = good.result.uncertainty[j].interval_95;
    shifted.truth[j] = high + 1.5 * (high - low);
    assert_eq!(judge(&shifted).class, Class::Failed);
    let mut means = good.clone();
    means.means_off = 50.0;
    assert_eq!(judge(&means).class, Class::Failed);
    // That another parameter is open excuses nothing; a warning does.
    let mut open = shifted.clone();
    open.result.uncertainty[(j + 1) % 9].verdict = Verdict::NotDetermined;
    assert_eq!(judge(&open).class, Class::Failed);
    let mut warned = shifted;
    warned.result.converged = false;
    assert_eq!(judge(&warned).class, Class::Flagged);
}

#[test]
fn residuals_beyond_the_stated_errors_are_part_of_the_reason() {
    let told = |stated: f64| {
        let mut measurements = Toy::default().measure(&Toy::truth(&INSIDE), 0.02, seed(880));
        for m in &mut measurements.intensities {
            m.standard_error = m.standard_error.map(|s| stated * s);
        }
        let budget = Budget {
            paths: Some(10_000_000),
            ..Budget::default()
        };
        let options = Options::new(seed(880), budget);
        let result = fit(&Toy::default(), &measurements, &options, &Unwatched).unwrap();
        (result.converged, result.reason.contains("larger than"))
    };
    assert_eq!(told(0.2), (true, true));
    // Negative control.
    assert_eq!(told(1.0), (true, false));
}

#[test]
fn few_numbers_are_part_of_the_reason() {
    let told = |n: usize, k: u64| {
        let mut case = case("few");
        case.change = match n {
            4 => |m| m.intensities.truncate(4),
            _ => |_| {},
        };
        let result = case.run(seed(870) + k).result;
        (
            result.converged,
            result.reason.contains("few for 9 parameters"),
        )
    };
    let few = [0, 1, 2].map(|k| told(4, k));
    assert!(few.iter().all(|(converged, few)| converged == few));
    assert!(few.iter().any(|(converged, _)| *converged));
    // Negative control.
    assert_eq!(told(16, 0), (true, false));
}
