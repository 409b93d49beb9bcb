//! The interval mean +- 1.96 standard errors of an [`Estimate`](goniofit::render::Estimate) contains the true mean 95 % of
//! the time, for every number of the plan, the grazing ones included: what is rare is neither missed nor understated.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

#[path = "common/render_scenes.rs"]
mod render_scenes;

use goniofit::base::Unwatched;
use goniofit::math::statistics::{Running, sidak_level};
use goniofit::render::{Effort, FiberScene, FiberSceneOptions, Request, Scene};
use goniofit::scatter::Parameters;
use goniofit::session::protocols::khungurn16;
use render_scenes::{SILK, SOFT, WIDE, felt, khungurn, parameters, seed};
use statrs::distribution::{Binomial, DiscreteCDF};
use std::path::Path;

/// The two-sided 95 % quantile of the normal distribution.
const NORMAL_95: f64 = 1.959_964;

/// Family-wise 1e-3 over the numbers: how many of `runs` intervals may contain the truth when each does with probability 0.95.
fn allowed(runs: u64, numbers: usize) -> [u64; 2] {
    let law = Binomial::new(0.95, runs).unwrap();
    let tail = 0.5 * sidak_level(1e-3, numbers);
    [law.inverse_cdf(tail), law.inverse_cdf(1.0 - tail)]
}

#[test]
fn three_hundred_runs_allow_89_to_99_percent() {
    let [low, high] = allowed(300, 48).map(|n| 100.0 * n as f64 / 300.0);
    assert!(
        (low - 89.0).abs() < 0.4 && (high - 99.3).abs() < 0.4,
        "{low} {high}"
    );
}

/// A setting of the slow test from the environment.
fn setting(name: &str, otherwise: f64) -> f64 {
    std::env::var(name).map_or(otherwise, |text| text.parse().unwrap())
}

/// How often the intervals of `runs` runs at `accuracy` hold each of the plan's numbers, printed and judged.
///
/// The truth is a run at a seventh of the error, whose own error is added to each interval (it is common to all runs: 1 % of
/// the width). The control is that the same intervals 0.8 as wide fail.
fn intervals_hold(scene: &FiberScene, parameters: &Parameters, accuracy: f64, runs: u64) {
    let plan = khungurn16().unwrap();
    let ask = |stream: u64, accuracy: f64| {
        let request = Request {
            configurations: &plan.configurations,
            parameters,
            effort: Effort::Accuracy(accuracy),
            seed: seed(31),
            stream,
        };
        scene.estimate(&request, &Unwatched).unwrap()
    };
    let truth = ask(0, accuracy / 7.0).configurations;
    let n = 3 * truth.len();
    let (mut held, mut shrunk) = (vec![0_u64; n], vec![0_u64; n]);
    let mut squares = vec![Running::default(); n];
    let (mut errors, mut cpu_s) = (Running::default(), Running::default());
    for run in 1..=runs {
        let estimates = ask(run, accuracy);
        errors.push(estimates.weighted_rms_error());
        cpu_s.push(estimates.cpu_s);
        for (i, e) in estimates.configurations.iter().enumerate() {
            for c in 0..3 {
                let off = (e.mean[c] - truth[i].mean[c]).abs();
                let z = off / e.standard_error[c].hypot(truth[i].standard_error[c]);
                assert!(z.is_finite(), "{e:?}");
                held[3 * i + c] += u64::from(z <= NORMAL_95);
                shrunk[3 * i + c] += u64::from(z <= 0.8 * NORMAL_95);
                squares[3 * i + c].push(z * z);
            }
        }
        if run % 25 == 0 {
            let [least, most] = [held.iter().min(), held.iter().max()].map(Option::unwrap);
            println!("{run} of {runs} runs: {least} to {most} held");
        }
    }
    println!(
        "{runs} runs, weighted rms error {:.3} %, {:.1} CPU s each",
        100.0 * errors.mean(),
        cpu_s.mean()
    );
    println!("config c      mean  truth se %   held %   mean z^2   held % when 0.8 as wide");
    let percent = |count: u64| 100.0 * count as f64 / runs as f64;
    for k in 0..n {
        let (e, c) = (&truth[k / 3], k % 3);
        println!(
            "{:6} {c} {:9.5} {:11.2} {:8.1} {:10.2} {:10.1}",
            e.config,
            e.mean[c],
            100.0 * e.standard_error[c] / e.mean[c],
            percent(held[k]),
            squares[k].mean(),
            percent(shrunk[k])
        );
    }
    let all = |counts: &[u64]| percent(counts.iter().sum()) / n as f64;
    println!(
        "all: {:.2} %, 0.8 as wide {:.2} %",
        all(&held),
        all(&shrunk)
    );
    let [low, high] = allowed(runs, n);
    let outside = |counts: &[u64]| counts.iter().filter(|x| !(low..=high).contains(*x)).count();
    assert_eq!(
        outside(&held),
        0,
        "numbers outside {low} to {high} of {runs}"
    );
    assert!(
        outside(&shrunk) > 0,
        "{runs} runs cannot tell intervals 0.8 as wide"
    );
}

/// A small cloth of wide lobes under a wide light, where paths that carry light are not rare. Sees, for one number, intervals
/// that hold 83 instead of 95 %.
///
/// As measured: 94.3 % of all intervals hold at 5 %, the worst number's 90.5 % of 200; at 10 % it is 93.0 and 86 to 88 %, and this
/// fails. A number whose own error is above a tenth has not seen its rarest paths often enough to state it.
#[test]
fn stated_intervals_hold_the_truth_of_a_soft_cloth() {
    let options = FiberSceneOptions {
        light: WIDE,
        ..FiberSceneOptions::default()
    };
    let scene = FiberScene::new(&felt(60, 0.2), khungurn(), options).unwrap();
    intervals_hold(&scene, &parameters(SOFT), 0.05, 120);
}

/// 300 runs at 2 % over Khungurn's 16 configurations of the bench twill with Silk's fibers, under the real light.
/// `RENDER_COVERAGE_RUNS` and `RENDER_COVERAGE_ACCURACY` choose other numbers for partial checks; the limits follow. Sees, for one
/// number, intervals that hold 86 instead of 95 %.
///
/// As measured: 94.2 % of all intervals hold, 89.0 to 97.0 % of each number's.
#[test]
#[ignore = "slow: 22 min on two idle cores"]
fn stated_intervals_hold_the_truth() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("fabrics/bench_twill22.toml");
    let fabric = goniofit::fabric::load(&path).unwrap();
    let scene = FiberScene::new(&fabric.tile, khungurn(), FiberSceneOptions::default()).unwrap();
    let runs = setting("RENDER_COVERAGE_RUNS", 300.0) as u64;
    let accuracy = setting("RENDER_COVERAGE_ACCURACY", 0.02);
    intervals_hold(&scene, &parameters(SILK), accuracy, runs);
}
