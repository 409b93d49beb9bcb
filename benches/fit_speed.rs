//! Time from the published start to a given residual, for each fitting method on the demo fabrics with noise-free truth.
//!
//! `cargo bench --bench fit_speed [-- --quick] [--json] [--only FABRIC] [--method M] [--seeds N] [--time S] [--make-references]
//! [--chart] [--from runs.jsonl] [--out CHART.svg]`
//!
//! The measurements are converged renders at published parameters (`benches/references/`, weighted rms error about 0.2 %, made
//! once by `--make-references`; gabardine's is the truth of the recorded session in `mocks/`). Each run fits them with its own
//! seed. Its *true residual* is `sqrt(max(0, paired estimate) / 48)` of a fresh render pair at the fitted parameters against the
//! reference, with a standard error. On the way there the residual at an iterate is the quadratic form of its distance from the
//! truth with the Gram matrix of the Jacobian rendered there (its noise taken off): right to first order, so good near the truth
//! and rough above 10 %; the last iterate's is the true residual. Seconds count rendering of the search and, in `total`, of the
//! final check too. All fits run first and are judged afterwards, so that only the fits need a quiet machine.
//!
//! Rows are kept in `benches/runs/DATE_fit_speed.jsonl` as they come, those of `--quick` excepted. `--chart` draws them to
//! `docs/charts/fit_speed.svg`; with `--from FILE` it draws kept rows and runs nothing.
//!
//! `--quick`: one fabric, two seeds, 30 s each. Times depend on the machine and its load, which is printed.
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    clippy::print_stderr,
    missing_docs
)]

#[path = "fit_speed/chart.rs"]
mod chart;

use goniofit::base::Unwatched;
use goniofit::fit::{
    Budget, FitResult, Method, Objective, Options, ParameterResult, RenderPair, fit, rms_of,
};
use goniofit::render::{Effort, Estimate, FiberScene, FiberSceneOptions, Request, Scene};
use goniofit::scatter::{self, Parameters, Unit};
use goniofit::session::{Configuration, Intensity, Measurements, Plan};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Fabric and fibers.
const FABRICS: [(&str, &str); 4] = [
    ("gabardine", "gabardine"),
    ("fleece", "fleece"),
    ("silk_satin", "silk"),
    ("plain_cotton", "cotton"),
];

/// Truth of the recorded session: parameters and converged means.
const RECORDED: &str = "mocks/khungurn16_gabardine/truth.json";

/// Residuals whose time is asked for, percent.
const TARGETS: [f64; 5] = [10.0, 5.0, 2.0, 1.0, 0.5];

/// Seconds a fit may take.
const USUAL_TIME_S: f64 = 30.0;

/// Weighted rms error of a reference.
const REFERENCE: f64 = 0.002;
/// The same of each render of the pair that judges a result: first the coarse one, then the fine one where the residual is
/// below the third figure, in percent.
const JUDGE: (f64, f64, f64) = (0.02, 0.01, 3.0);
/// Camera paths per configuration of each render that gives the Jacobian at the truth.
const JACOBIAN_PATHS: u64 = 40_000;

/// One target of one run.
#[derive(Serialize, Deserialize, Clone)]
struct Row {
    method: String,
    fabric: String,
    seed: u64,
    target_residual: f64,
    /// Seconds of rendering until the search was at the target for good; none when it never was.
    wall_s: Option<f64>,
    cpu_s: Option<f64>,
    /// Of the result, percent, with its standard error.
    true_residual: f64,
    true_residual_se: f64,
    /// Whole run.
    total_wall_s: f64,
    total_cpu_s: f64,
    /// Largest relative error of a color that matters, and of the widths beta_tt and gamma_tt, percent.
    color_error: f64,
    width_error: f64,
    /// What the fit says of itself: whether it converged, the Monte Carlo part of its error in percent, and of how many
    /// parameters the 95 % interval holds the truth. None in rows of earlier versions.
    converged: Option<bool>,
    stated_error: Option<f64>,
    held: Option<usize>,
    load: f64,
}

/// Converged means, as a session's `truth.json` has them.
#[derive(Serialize, Deserialize)]
struct Reference {
    configs: Vec<Converged>,
}

#[derive(Serialize, Deserialize)]
struct Converged {
    config: u32,
    mean: [f64; 3],
    se: [f64; 3],
}

struct Arguments(Vec<String>);

impl Arguments {
    fn has(&self, flag: &str) -> bool {
        self.0.iter().any(|a| a == flag)
    }
    fn value(&self, flag: &str) -> Option<&str> {
        let at = self.0.iter().position(|a| a == flag)?;
        self.0.get(at + 1).map(String::as_str)
    }
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn load() -> f64 {
    let text = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    text.split(' ')
        .next()
        .and_then(|x| x.parse().ok())
        .unwrap_or(0.0)
}

fn main() {
    let arguments = Arguments(std::env::args().collect());
    let date = goniofit::rig::utc_now()[..10].to_owned();
    if let Some(from) = arguments.value("--from") {
        let name = Path::new(from).file_name().unwrap().to_string_lossy();
        let dated = name.split('_').next().unwrap_or(&date);
        draw(&kept(Path::new(from)), dated, &arguments);
        return;
    }
    let quick = arguments.has("--quick");
    let seeds: u64 =
        (arguments.value("--seeds")).map_or(if quick { 2 } else { 10 }, |n| n.parse().unwrap());
    let time: f64 = (arguments.value("--time")).map_or(USUAL_TIME_S, |t| t.parse().unwrap());
    let only = arguments.value("--only").or(quick.then_some("gabardine"));
    let mut cases = Vec::new();
    for (fabric, fibers) in FABRICS {
        if only.is_some_and(|o| o != fabric) {
            continue;
        }
        let case = Case::new(fabric, fibers);
        if arguments.has("--make-references") {
            case.make_reference();
            continue;
        }
        cases.push(case);
    }
    let mut runs = Vec::new();
    for case in &cases {
        for method in Method::GENERAL {
            if arguments
                .value("--method")
                .is_some_and(|m| m != method.name())
            {
                continue;
            }
            for seed in 1..=seeds {
                runs.push(case.run(method, seed, time));
                eprintln!("{} {} seed {seed}: fitted", case.fabric, method.name());
            }
        }
    }
    let mut rows = Vec::new();
    for case in &cases {
        let judge = Judge::new(case);
        for run in runs.iter().filter(|r| r.fabric == case.fabric) {
            for row in judge.rows(run) {
                report(&row, arguments.has("--json"));
                if !quick {
                    keep(&row, &date);
                }
                rows.push(row);
            }
        }
    }
    if arguments.has("--chart") {
        draw(&rows, &date, &arguments);
    }
}

fn draw(rows: &[Row], date: &str, arguments: &Arguments) {
    let usual = root().join("docs/charts/fit_speed.svg");
    let file = arguments.value("--out").map_or(usual, PathBuf::from);
    chart::draw(rows, date, &file);
    eprintln!("wrote {}", file.display());
}

/// Rows of an earlier run; lines that are none (of another program's output) are passed over.
fn kept(file: &Path) -> Vec<Row> {
    let text = std::fs::read_to_string(file).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
    let rows = text.lines().filter_map(|l| serde_json::from_str(l).ok());
    rows.collect()
}

/// Adds a row to the day's.
fn keep(row: &Row, date: &str) {
    use std::io::Write;
    let path = root().join(format!("benches/runs/{date}_fit_speed.jsonl"));
    let file = std::fs::File::options()
        .create(true)
        .append(true)
        .open(path);
    writeln!(file.unwrap(), "{}", serde_json::to_string(row).unwrap()).unwrap();
}

fn report(row: &Row, json: bool) {
    if json {
        println!("{}", serde_json::to_string(row).unwrap());
        return;
    }
    let seconds = |s: Option<f64>| s.map_or("-".to_owned(), |s| format!("{s:.1}"));
    println!(
        "{:12} {:12} seed {:2} to {:4} %: {:>6} s, {:>6} CPU s; end {:.2} +- {:.2} % in {:.1} s ({:.1} CPU s), colors {:.1} %, widths {:.1} %, {} intervals hold, converged {}, load {:.1}",
        row.fabric,
        row.method,
        row.seed,
        row.target_residual,
        seconds(row.wall_s),
        seconds(row.cpu_s),
        row.true_residual,
        row.true_residual_se,
        row.total_wall_s,
        row.total_cpu_s,
        row.color_error,
        row.width_error,
        row.held.map_or("?".to_owned(), |n| n.to_string()),
        row.converged.map_or("?".to_owned(), |c| c.to_string()),
        row.load
    );
}

/// What the reference was rendered with, as a parameter file's object: gabardine's stands with the recorded session.
fn true_parameters(fabric: &str, fibers: &str) -> serde_json::Value {
    let read = |file: PathBuf| -> serde_json::Value {
        serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap()
    };
    match fabric {
        "gabardine" => read(root().join(RECORDED))["parameters"].take(),
        _ => read(root().join(format!("fabrics/params/{fibers}.json"))),
    }
}

/// A fabric with known fibers.
struct Case {
    fabric: &'static str,
    scene: FiberScene,
    truth: Parameters,
    configurations: Vec<Configuration>,
}

impl Case {
    fn new(fabric: &'static str, fibers: &str) -> Self {
        let path = root().join(format!("fabrics/{fabric}.toml"));
        let tile = goniofit::fabric::load(&path).unwrap().tile;
        let model = scatter::model("khungurn").unwrap();
        let values = true_parameters(fabric, fibers);
        let plan = Plan::read(&root().join("rig_configs/plans/khungurn16.toml")).unwrap();
        Self {
            fabric,
            scene: FiberScene::new(&tile, model, FiberSceneOptions::default()).unwrap(),
            truth: Parameters::from_json(model, &values).unwrap(),
            configurations: plan.configurations,
        }
    }

    fn request(&self, effort: Effort, seed: u64) -> Request<'_> {
        Request {
            configurations: &self.configurations,
            parameters: &self.truth,
            effort,
            seed,
            stream: 0,
        }
    }

    fn reference_path(&self) -> PathBuf {
        match self.fabric {
            "gabardine" => root().join(RECORDED),
            name => root().join(format!("benches/references/{name}.json")),
        }
    }

    fn make_reference(&self) {
        let path = self.reference_path();
        if path.exists() {
            eprintln!("{} is there", path.display());
            return;
        }
        let request = self.request(Effort::Accuracy(REFERENCE), 77);
        let estimates = self.scene.estimate(&request, &Unwatched).unwrap();
        eprintln!(
            "{}: weighted rms error {:.3} %, {:.0} CPU s",
            self.fabric,
            100.0 * estimates.weighted_rms_error(),
            estimates.cpu_s
        );
        let converged = |e: &Estimate| Converged {
            config: e.config,
            mean: e.mean,
            se: e.standard_error,
        };
        let reference = Reference {
            configs: estimates.configurations.iter().map(converged).collect(),
        };
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(
            path,
            serde_json::to_string_pretty(&reference).unwrap() + "\n",
        )
        .unwrap();
    }

    fn measurements(&self) -> Measurements {
        let path = self.reference_path();
        let text = std::fs::read_to_string(&path)
            .unwrap_or_else(|e| panic!("{}: {e}; --make-references makes it", path.display()));
        let reference: Reference = serde_json::from_str(&text).unwrap();
        let intensity = |(configuration, c): (&Configuration, &Converged)| {
            assert_eq!(configuration.id, c.config);
            Intensity {
                configuration: *configuration,
                mean: c.mean,
                standard_error: c.se,
                present: [true; 3],
            }
        };
        let pairs = self.configurations.iter().zip(&reference.configs);
        Measurements {
            intensities: pairs.map(intensity).collect(),
        }
    }

    fn run(&self, method: Method, seed: u64, time: f64) -> Run {
        let budget = Budget {
            time_s: Some(time),
            ..Budget::default()
        };
        let options = Options {
            method,
            ..Options::new(seed, budget)
        };
        let load = load();
        let usual = time.to_bits() == USUAL_TIME_S.to_bits();
        Run {
            fabric: self.fabric,
            method: match usual {
                true => method.name().to_owned(),
                false => format!("{}, {time} s", method.name()),
            },
            seed,
            result: fit(&self.scene, &self.measurements(), &options, &Unwatched).unwrap(),
            load,
        }
    }

    /// Largest relative errors of colors above 0.02 and of beta_tt and gamma_tt, percent.
    fn errors(&self, found: &Parameters) -> [f64; 2] {
        let truth = &self.truth;
        let relative = |a: f64, b: f64| 100.0 * (a / b - 1.0).abs();
        let colors = ["c_r", "c_tt"].into_iter().flat_map(|name| {
            let pairs = found.channels(name).into_iter().zip(truth.channels(name));
            pairs
                .filter(|(_, t)| *t > 0.02)
                .map(|(f, t)| relative(f, t))
                .collect::<Vec<_>>()
        });
        let widths = ["beta_tt", "gamma_tt"];
        let widths = widths.map(|name| relative(found.scalar(name), truth.scalar(name)));
        [colors.fold(0.0, f64::max), widths[0].max(widths[1])]
    }

    /// Parameters whose 95 % interval holds the truth.
    fn held(&self, result: &FitResult) -> usize {
        let truths = self.truth.places().into_iter().zip(self.truth.values());
        let inside = |(p, ((row, _), truth)): (&ParameterResult, ((usize, usize), &f64))| {
            let truth = match self.truth.infos()[row].unit {
                Unit::One => *truth,
                Unit::Angle => truth.to_degrees(),
            };
            (p.interval_95[0]..=p.interval_95[1]).contains(&truth)
        };
        let pairs = result.uncertainty.iter().zip(truths);
        pairs.filter(|pair| inside(*pair)).count()
    }
}

/// A fit, not judged yet.
struct Run {
    fabric: &'static str,
    /// With the seconds where these are not the usual ones.
    method: String,
    seed: u64,
    result: FitResult,
    load: f64,
}

/// Knows the truth.
struct Judge<'a> {
    case: &'a Case,
    objective: Objective,
    /// Of the weighted means by the parameters, at the truth; rows and columns as [`Parameters::values`].
    gram: Vec<Vec<f64>>,
}

impl<'a> Judge<'a> {
    fn new(case: &'a Case) -> Self {
        let objective = Objective::new(&case.measurements()).unwrap();
        let effort = Effort::Paths(JACOBIAN_PATHS);
        let configurations = &case.configurations;
        let pair = RenderPair::render(
            &case.scene,
            configurations,
            &case.truth,
            &effort,
            78,
            0,
            &Unwatched,
        )
        .unwrap();
        let n = case.truth.values().len();
        let mut gram = vec![vec![0.0; n]; n];
        let mut noise = vec![0.0; n];
        for (weights, renders) in objective.weights().iter().zip(pair.estimates()) {
            for (c, &weight) in weights.iter().enumerate() {
                let mut slope = vec![0.0; n];
                for row in 0..case.truth.infos().len() {
                    let place = case.truth.slot(row, c);
                    for e in renders {
                        slope[place] += 0.5 * e.derivative[row][c];
                        noise[place] += 0.25 * weight * e.derivative_se[row][c].powi(2);
                    }
                }
                for i in 0..n {
                    for j in 0..n {
                        gram[i][j] += weight * slope[i] * slope[j];
                    }
                }
            }
        }
        // What is mostly noise says nothing: such a parameter moves the means by little.
        for i in 0..n {
            if noise[i] > 0.3 * gram[i][i] {
                gram[i].fill(0.0);
                gram.iter_mut().for_each(|row| row[i] = 0.0);
            } else {
                gram[i][i] -= noise[i];
            }
        }
        Self {
            case,
            objective,
            gram,
        }
    }

    /// Percent, to first order in the distance from the truth.
    fn residual(&self, parameters: &Parameters) -> f64 {
        let pairs = (parameters.values().iter()).zip(self.case.truth.values());
        let away: Vec<f64> = pairs.map(|(a, b)| a - b).collect();
        let form: f64 = (self.gram.iter().zip(&away))
            .map(|(row, a)| a * row.iter().zip(&away).map(|(g, b)| g * b).sum::<f64>())
            .sum();
        100.0 * (form.max(0.0) / self.objective.n_numbers() as f64).sqrt()
    }

    fn rows(&self, run: &Run) -> Vec<Row> {
        let result = &run.result;
        let model = scatter::model(&result.model).unwrap();
        let found = Parameters::from_json(model, &result.parameters).unwrap();
        let (coarse, fine, near) = JUDGE;
        let mut residual = self.fresh_residual(&found, coarse, 1000 + run.seed);
        if residual.0 < near {
            residual = self.fresh_residual(&found, fine, 2000 + run.seed);
        }
        let mut curve = self.curve(result, &found);
        if let Some(end) = curve.last_mut() {
            end.2 = residual.0;
        }
        let [color_error, width_error] = self.case.errors(&found);
        let row = |target: f64| {
            // For good: no later iterate is worse than the target.
            let last_bad = curve.iter().rposition(|c| c.2 > target);
            let reached = match last_bad {
                None => curve.first(),
                Some(bad) => curve.get(bad + 1),
            };
            Row {
                method: run.method.clone(),
                fabric: self.case.fabric.to_owned(),
                seed: run.seed,
                target_residual: target,
                wall_s: reached.map(|c| c.0),
                cpu_s: reached.map(|c| c.1),
                true_residual: residual.0,
                true_residual_se: residual.1,
                total_wall_s: result.time.wall_s,
                total_cpu_s: result.time.cpu_s,
                color_error,
                width_error,
                converged: Some(result.converged),
                stated_error: Some(result.objective.fit_monte_carlo_percent),
                held: Some(self.case.held(result)),
                load: run.load,
            }
        };
        TARGETS.into_iter().map(row).collect()
    }

    /// Wall seconds, CPU seconds and residual after each iteration.
    fn curve(&self, result: &FitResult, end: &Parameters) -> Vec<(f64, f64, f64)> {
        let model = scatter::model("khungurn").unwrap();
        let later = result.history.iter().skip(1);
        let places = later.map(|h| Parameters::from_json(model, &h.parameters).unwrap());
        let cpu_per_wall = result.time.cpu_s / result.time.wall_s;
        (result.history.iter().zip(places.chain([end.clone()])))
            .map(|(h, p)| (h.wall_s, h.wall_s * cpu_per_wall, self.residual(&p)))
            .collect()
    }

    /// Percent, with its standard error, from a fresh pair.
    fn fresh_residual(&self, parameters: &Parameters, accuracy: f64, seed: u64) -> (f64, f64) {
        let pair = RenderPair::render(
            &self.case.scene,
            &self.case.configurations,
            parameters,
            &Effort::Accuracy(accuracy),
            seed,
            0,
            &Unwatched,
        )
        .unwrap();
        let (rms, se) = rms_of(self.objective.paired(&pair), self.objective.n_numbers());
        (100.0 * rms, 100.0 * se)
    }
}
