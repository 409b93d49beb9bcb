//! The published descent and Adam: the trajectory without noise is that of the equations, with noise the minimum is reached
//! at the rate expected, bounds hold, the best of the rates is chosen by fresh renders, budgets are kept, and the same seed
//! and paths repeat exactly.
#![allow(
    clippy::unwrap_used,
    clippy::float_cmp,
    clippy::print_stdout,
    missing_docs
)]

mod toy;

use goniofit::base::{Result, Unwatched, Watch};
use goniofit::fit::{Budget, FitResult, Loss, Method, Options, Selection, SgdOptions, TAU, fit};
use goniofit::math::Random;
use goniofit::render::{
    Effort, Estimate, Estimates, Request, Scene, relative_error_weight, weighted_rms,
};
use goniofit::scatter::{Parameters, Parametric};
use goniofit::session::{Intensity, Measurements};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use toy::{INSIDE, TOY, Toy, seed};

/// Means that are linear in the parameters: the objective is a parabola, and every rescaling curve a straight line.
struct Linear {
    /// Standard deviation of one path's contribution to a mean, and to a derivative.
    noise: f64,
    /// Camera paths per second of the virtual clock.
    speed: f64,
    /// When set, renders of this many paths answer `measured` from the first to before the second of their numbers.
    lie: Option<(u64, std::ops::Range<u64>, Measurements)>,
    lied: AtomicU64,
}

impl Linear {
    fn new(noise: f64) -> Self {
        Self {
            noise,
            speed: 50_000.0,
            lie: None,
            lied: AtomicU64::new(0),
        }
    }

    fn slope(i: usize, row: usize) -> f64 {
        let range = TOY.parameters()[row].upper - TOY.parameters()[row].lower;
        let turn = std::f64::consts::PI * (i as f64 + 0.5) * (row as f64 + 1.0) / 16.0;
        0.5 / range * turn.cos()
    }

    fn mean(values: &[f64], i: usize, c: usize) -> f64 {
        let p = Parameters::defaults(&TOY);
        let sum: f64 = (0..5)
            .map(|row| Self::slope(i, row) * (values[p.slot(row, c)] - p.infos()[row].lower))
            .sum();
        1.5 + sum
    }

    fn measure(values: &[f64]) -> Measurements {
        let one = |(i, configuration)| Intensity {
            configuration,
            mean: std::array::from_fn(|c| Self::mean(values, i, c)),
            standard_error: [0.0; 3],
            present: [true; 3],
        };
        let intensities = Toy::configurations().into_iter().enumerate().map(one);
        Measurements {
            intensities: intensities.collect(),
        }
    }

    /// The exact objective.
    fn objective(measured: &Measurements, values: &[f64]) -> f64 {
        let rows = measured.intensities.iter().enumerate().map(|(i, m)| {
            let e = std::array::from_fn(|c| Self::mean(values, i, c) - m.mean[c]);
            (relative_error_weight(m.mean, TAU), e)
        });
        48.0 * weighted_rms(rows).powi(2)
    }
}

impl Scene for Linear {
    fn model(&self) -> &'static dyn Parametric {
        &TOY
    }

    fn estimate(&self, request: &Request<'_>, watch: &dyn Watch) -> Result<Estimates> {
        let Effort::Total { paths, .. } = request.effort else {
            panic!("the methods state totals")
        };
        let lie = self.lie.as_ref().filter(|(of, range, _)| {
            *of == paths && range.contains(&self.lied.fetch_add(1, Ordering::Relaxed))
        });
        let sd = self.noise / (paths as f64 / 16.0).sqrt();
        let mut random = Random::keyed(&[request.seed, request.stream, 0x11e]);
        let values = request.parameters.values();
        let mut configurations = Vec::new();
        for (i, c) in request.configurations.iter().enumerate() {
            if watch.cancelled() {
                return Err(goniofit::base::Error::new("cancelled"));
            }
            let honest = std::array::from_fn(|k| Self::mean(values, i, k) + sd * random.normal());
            configurations.push(Estimate {
                config: c.id,
                mean: lie.map_or(honest, |(.., measured)| measured.intensities[i].mean),
                standard_error: [sd; 3],
                derivative: (0..5)
                    .map(|row| [0; 3].map(|_| Self::slope(i, row) + sd * random.normal()))
                    .collect(),
                derivative_se: vec![[sd; 3]; 5],
                paths: paths / 16,
            });
        }
        let wall_s = paths as f64 / self.speed;
        Ok(Estimates {
            configurations,
            cpu_s: wall_s,
            wall_s,
        })
    }
}

fn options(method: Method, seed: u64, paths: u64) -> Options {
    Options {
        method,
        ..Options::new(
            seed,
            Budget {
                paths: Some(paths),
                ..Budget::default()
            },
        )
    }
}

/// One run of the published descent.
fn single(a: f64) -> SgdOptions {
    SgdOptions {
        rates: vec![a],
        ..SgdOptions::default()
    }
}

fn fitted(result: &FitResult) -> Vec<f64> {
    let p = Parameters::from_json(&TOY, &result.parameters).unwrap();
    p.values().to_vec()
}

/// The truth of most tests, and one whose c_r.g lies below and gamma_tt above its bounds.
fn inside() -> Vec<f64> {
    Toy::truth(&INSIDE).values().to_vec()
}
fn outside() -> Vec<f64> {
    let mut values = inside();
    values[1] = -0.3;
    values[8] = 1.2;
    values
}

/// What the equations say: 60 steps of a / i along straight rescaling curves, ten more at a tenth of the last rate, all
/// projected. Returns the objectives on the way and the end.
fn predicted(measured: &Measurements, a: f64, first: u32, divisor: f64) -> (Vec<f64>, Vec<f64>) {
    let p = Parameters::defaults(&TOY);
    let weights: Vec<f64> = measured
        .intensities
        .iter()
        .map(|m| relative_error_weight(m.mean, TAU))
        .collect();
    // d r_p / d value: all three channels change alike, so f_image is three squares.
    let stretch: Vec<f64> = p
        .places()
        .into_iter()
        .map(|(row, _)| {
            let of = |(i, w): (usize, &f64)| (3.0 * w).sqrt() * Linear::slope(i, row).abs();
            let whole: f64 = weights.iter().enumerate().map(of).sum();
            if row < 2 { whole / divisor } else { whole }
        })
        .collect();
    let mut values = p.values().to_vec();
    let mut objectives = Vec::new();
    for k in 0..70 {
        objectives.push(Linear::objective(measured, &values));
        let rate = if k < 60 {
            a / f64::from(first + k)
        } else {
            0.1 * a / f64::from(first + 59)
        };
        let mut gradient = [0.0; 9];
        for (i, (m, w)) in measured.intensities.iter().zip(&weights).enumerate() {
            for c in 0..3 {
                let e = Linear::mean(&values, i, c) - m.mean[c];
                for row in 0..5 {
                    gradient[p.slot(row, c)] += 2.0 * w * e * Linear::slope(i, row);
                }
            }
        }
        for (j, (row, _)) in p.places().into_iter().enumerate() {
            let info = &p.infos()[row];
            let moved = values[j] - rate * gradient[j] / stretch[j].powi(2);
            values[j] = moved.clamp(info.lower, info.upper);
        }
    }
    (objectives, values)
}

fn farthest(a: &[f64], b: &[f64]) -> f64 {
    let differences = a.iter().zip(b).map(|(a, b)| (a - b).abs() / b.abs());
    differences.fold(0.0, f64::max)
}

#[test]
fn without_noise_the_published_descent_follows_equations_21_to_23() {
    for (truth, bound) in [(inside(), false), (outside(), true)] {
        let measured = Linear::measure(&truth);
        let options = Options {
            sgd: single(16.0),
            ..options(Method::Sgd, 1, 10_000_000)
        };
        let result = fit(&Linear::new(0.0), &measured, &options, &Unwatched).unwrap();
        let (objectives, end) = predicted(&measured, 16.0, 50, 3.0);
        let found: Vec<f64> = result.history.iter().map(|h| h.paired_objective).collect();
        assert_eq!(found.len(), 70);
        let off = farthest(&found, &objectives).max(farthest(&fitted(&result), &end));
        assert!(off < 1e-8, "off by {off}: {found:?} {objectives:?}");
        assert!(objectives[69] < 0.2 * objectives[0], "{objectives:?}");
        if bound {
            assert_eq!((end[1], end[8]), (0.001, TOY.parameters()[4].upper));
        }
        // Negative controls: counting from 1, or colors not shared among their channels, is another trajectory.
        for (first, divisor) in [(1, 3.0), (50, 1.0)] {
            let (_, other) = predicted(&measured, 16.0, first, divisor);
            assert!(
                farthest(&fitted(&result), &other) > 1e-3,
                "{first} {divisor}"
            );
        }
    }
}

/// Mean distance from the minimum, as objective, over seeds.
fn mean_excess(method: Method, sgd: &SgdOptions, rate: f64, paths: u64) -> f64 {
    let truth = inside();
    let measured = Linear::measure(&truth);
    let n = 24;
    let sum: f64 = (0..n)
        .map(|k| {
            let mut options = Options {
                sgd: sgd.clone(),
                ..options(method, seed(300) + k, paths)
            };
            options.adam.rate = rate;
            let result = fit(&Linear::new(0.3), &measured, &options, &Unwatched).unwrap();
            Linear::objective(&measured, &fitted(&result))
        })
        .sum();
    sum / n as f64
}

#[test]
fn sixteen_times_the_paths_bring_the_noise_down_sixteen_times() {
    // The excess objective of an iterate lost in noise goes as the gradient's variance, one over the paths. 24 runs of
    // nine parameters know each mean to about 10 %: sees a rate wrong by a factor of two.
    let quick = single(64.0);
    let adam = Options::new(1, Budget::default()).adam.rate;
    for (method, least, most) in [(Method::Sgd, 8.0, 32.0), (Method::Adam, 8.0, 40.0)] {
        let coarse = mean_excess(method, &quick, adam, 2_000_000);
        let fine = mean_excess(method, &quick, adam, 32_000_000);
        println!("{method:?}: excess {coarse:.3e}, with 16 times the paths {fine:.3e}");
        assert!(
            (least..most).contains(&(coarse / fine)),
            "{method:?}: {coarse} {fine}, n 24"
        );
    }
    // Negative control: at a rate too low to arrive, paths do not help.
    let (slow, tiny) = (single(0.01), 1e-4);
    for method in [Method::Sgd, Method::Adam] {
        let coarse = mean_excess(method, &slow, tiny, 2_000_000);
        let fine = mean_excess(method, &slow, tiny, 32_000_000);
        assert!(coarse / fine < 1.5, "{method:?}: {coarse} {fine}");
    }
}

#[test]
fn adam_without_noise_comes_to_the_minimum_and_to_bounds() {
    let start = Parameters::defaults(&TOY);
    let run = |truth: &[f64], rate: f64| {
        let measured = Linear::measure(truth);
        let mut options = options(Method::Adam, 1, 10_000_000);
        options.adam.rate = rate;
        let result = fit(&Linear::new(0.0), &measured, &options, &Unwatched).unwrap();
        let end = fitted(&result);
        let fall =
            Linear::objective(&measured, &end) / Linear::objective(&measured, start.values());
        (fall, end)
    };
    let (fall, _) = run(&inside(), 0.3);
    assert!(fall < 1e-3, "the objective fell to {fall} of the start's");
    let (_, end) = run(&outside(), 0.3);
    assert_eq!((end[1], end[8]), (0.001, TOY.parameters()[4].upper));
    // Negative control: with tiny steps it does not arrive.
    let (slow, _) = run(&inside(), 1e-3);
    assert!(slow > 0.1, "{slow}");
}

#[test]
fn the_best_rate_is_chosen_by_fresh_renders() {
    // Renders of a selection have twice the paths of an iteration's pair in each. The second rate's are told to be
    // perfect: only a choice by them names it.
    let measured = Linear::measure(&inside());
    let choose = |lie: bool, selection: Selection| {
        let mut scene = Linear::new(0.0);
        if lie {
            scene.lie = Some((2 * 32_000, 2..4, measured.clone()));
        }
        let options = Options {
            iteration_paths: Some(32_000),
            sgd: SgdOptions {
                selection,
                ..SgdOptions::default()
            },
            ..options(Method::Sgd, 1, 30_000_000)
        };
        fit(&scene, &measured, &options, &Unwatched).unwrap()
    };
    let truly = choose(false, Selection::FreshRenders);
    let told = choose(true, Selection::FreshRenders);
    let reported = choose(true, Selection::LowestReported);
    assert!(
        told.reason.contains("a = 1 chosen by fresh renders"),
        "{}",
        told.reason
    );
    assert!(!truly.reason.contains("a = 1 chosen"), "{}", truly.reason);
    // Negative control: by the iterations' own renders the choice is another.
    assert!(
        reported
            .reason
            .contains("chosen by the lowest value reported")
            && !reported.reason.contains("a = 1 chosen"),
        "{}",
        reported.reason
    );
    // The record holds all runs, and marks the one that was gone on from.
    let accepted: Vec<usize> = (0..370).filter(|k| told.history[*k].accepted).collect();
    let expected: Vec<usize> = (60..120).chain(360..370).collect();
    assert_eq!(accepted, expected);
}

#[test]
fn noise_misleads_a_choice_by_reported_values() {
    // The least of 60 noisy values says little of where a run ends. Sees fresh renders that choose no better than that.
    let measured = Linear::measure(&inside());
    let mean = |selection: Selection| -> f64 {
        let one = |k: u64| {
            let options = Options {
                sgd: SgdOptions {
                    selection,
                    final_iterations: 0,
                    ..SgdOptions::default()
                },
                ..options(Method::Sgd, seed(320) + k, 3_000_000)
            };
            let result = fit(&Linear::new(3.0), &measured, &options, &Unwatched).unwrap();
            Linear::objective(&measured, &fitted(&result))
        };
        (0..16).map(one).sum::<f64>() / 16.0
    };
    let (fresh, reported) = (
        mean(Selection::FreshRenders),
        mean(Selection::LowestReported),
    );
    println!("excess objective: {fresh:.3e} by fresh renders, {reported:.3e} by reported values");
    assert!(fresh < 0.8 * reported, "{fresh} {reported}");
}

#[test]
fn the_same_seed_and_paths_repeat_exactly() {
    let toy = Toy::default();
    let measured = toy.measure(&Toy::truth(&INSIDE), 0.01, 3);
    for method in [Method::Sgd, Method::Adam] {
        let run = |seed: u64| {
            let options = options(method, seed, 4_000_000);
            fit(&toy, &measured, &options, &Unwatched).unwrap()
        };
        let first = run(8);
        assert_eq!(first, run(8));
        assert_ne!(first.parameters, run(9).parameters);
        assert_eq!(first.method, method.name());
        assert!(first.time.paths <= 4_000_000, "{}", first.time.paths);
        assert!(first.time.paths > 3_500_000, "{}", first.time.paths);
        assert!(
            first.reason.contains("so that all fit in the budget"),
            "{}",
            first.reason
        );
    }
}

#[test]
fn both_methods_come_closer_on_cloth_like_noise() {
    let toy = Toy::default();
    let truth = Toy::truth(&INSIDE);
    let measured = toy.measure(&truth, 0.0, 1);
    let start = toy.distance(&Parameters::defaults(&TOY), &truth);
    for method in [Method::Sgd, Method::Adam] {
        let mut distances: Vec<f64> = (0..5)
            .map(|k| {
                let options = options(method, seed(330) + k, 40_000_000);
                let result = fit(&toy, &measured, &options, &Unwatched).unwrap();
                let end = Parameters::from_json(&TOY, &result.parameters).unwrap();
                toy.distance(&end, &truth)
            })
            .collect();
        distances.sort_by(f64::total_cmp);
        println!("{method:?}: {start:.3} at the start, then {distances:.3?}");
        assert!(
            distances[2] < 0.3 * start,
            "{method:?}: {start} {distances:?}"
        );
    }
}

#[test]
fn budgets_are_kept_or_refused() {
    let measured = Linear::measure(&inside());
    let scene = Linear::new(5.0);
    // Time: the virtual clock runs at 50,000 paths a second.
    for method in [Method::Sgd, Method::Adam] {
        let options = Options {
            method,
            ..Options::new(
                1,
                Budget {
                    time_s: Some(100.0),
                    ..Budget::default()
                },
            )
        };
        let result = fit(&scene, &measured, &options, &Unwatched).unwrap();
        assert!(
            (85.0..101.0).contains(&result.time.wall_s),
            "{method:?}: {}",
            result.time.wall_s
        );
        assert!(
            result.reason.contains("all iterations"),
            "{}",
            result.reason
        );
        // More paths in an iteration than the time allows: the best so far, and it says so.
        let greedy = Options {
            iteration_paths: Some(60_000),
            ..options
        };
        let result = fit(&scene, &measured, &greedy, &Unwatched).unwrap();
        assert!(
            result.reason.contains("time was used up"),
            "{}",
            result.reason
        );
        assert!(result.time.wall_s < 102.0, "{}", result.time.wall_s);
        // Paths: refused before any work.
        let refused = Options {
            iteration_paths: Some(60_000),
            ..self::options(method, 1, 5_000_000)
        };
        let error = fit(&scene, &measured, &refused, &Unwatched)
            .unwrap_err()
            .report();
        assert!(
            error.contains("do not hold the schedule") && error.contains("hint:"),
            "{error}"
        );
        // Of a robust fit each stage must hold it; the paths named are that stage's.
        let robust = Options {
            loss: Loss::Huber(2.0),
            ..refused
        };
        let error = fit(&scene, &measured, &robust, &Unwatched).unwrap_err();
        let error = error.report();
        assert!(
            error.contains("stage 1 of the robust fit")
                && error.contains("1500000 paths do not hold the schedule")
                && error.contains("hint:"),
            "{error}"
        );
        let error = fit(
            &scene,
            &measured,
            &self::options(method, 1, 10_000),
            &Unwatched,
        )
        .unwrap_err()
        .report();
        assert!(error.contains("10000 paths"), "{error}");
    }
}

/// Interrupts after so many looks.
struct Impatient {
    looks: Mutex<u32>,
}

impl Watch for Impatient {
    fn progress(&self, _: &str, _: u64, _: u64) {}
    fn cancelled(&self) -> bool {
        let mut looks = self.looks.lock().unwrap();
        *looks = looks.saturating_sub(1);
        *looks == 0
    }
}

#[test]
fn an_interrupt_keeps_the_best_so_far() {
    let measured = Linear::measure(&inside());
    let start = Linear::objective(&measured, Parameters::defaults(&TOY).values());
    let run = |method: Method, looks: u32| {
        let looks = Mutex::new(looks);
        let options = options(method, 1, 20_000_000);
        fit(&Linear::new(1.0), &measured, &options, &Impatient { looks })
    };
    // A pair takes 33 looks or more: well into the third run, and half way through Adam's iterations.
    for (method, looks, least) in [(Method::Sgd, 7_000, 121), (Method::Adam, 3_500, 61)] {
        let result = run(method, looks).unwrap();
        assert!(
            !result.converged && result.reason.contains("interrupted"),
            "{}",
            result.reason
        );
        let n = result.history.len();
        assert!((least..200).contains(&n), "{method:?}: {n} iterations");
        let end = Linear::objective(&measured, &fitted(&result));
        assert!(end < 0.3 * start, "{method:?}: {end} {start}");
    }
    // Before the first iteration there is nothing to keep.
    let error = run(Method::Sgd, 40).unwrap_err().report();
    assert!(error.contains("before the first iteration"), "{error}");
}

#[test]
fn methods_have_names() {
    for method in Method::ALL {
        assert_eq!(Method::named(method.name()).unwrap(), method);
    }
    let error = Method::named("newton").unwrap_err().report();
    assert!(error.contains("gauss-newton, sgd, adam"), "{error}");
}
