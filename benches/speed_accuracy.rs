//! Error against CPU seconds of the renderers, for each configuration and for all 48 numbers, with rays and paths per second.
//!
//! `cargo bench --bench speed_accuracy [-- --quick] [--json] [--chart] [--only MATERIAL] [--runs N] [--steps N] [--from FILE]`
//!
//! On `fabrics/bench_twill22.toml` with the published fibers (Khungurn 2015 Table IV) and Khungurn's 16 poses. Errors are
//! weighted rms over the 48 numbers (Khungurn 2015 eq. 20). *Stated* is what a run says of itself; *actual* is the scatter
//! of independent runs about their mean, which also sees what a run's own bright paths were too rare to show.
//! CPU seconds to 1 % are `cpu_s (error / 1 %)^2`, pilots included, of the actual error where there are several runs. A
//! path's cost includes its derivatives, and pilots count as time but not as paths.
//!
//! `--quick`: one run of 3 to 15 CPU seconds each, stated errors only. Otherwise `--steps` efforts (4) with `--runs` runs
//! (4) each, kept in `benches/runs/`; `--chart` draws them to `docs/charts/`, `--from FILE` draws an earlier run's instead.
//! With a Python that has Mitsuba in `GONIOFIT_MITSUBA`, `tests/peer/mitsuba/compare.py` adds its rows for model `chiang`.
//!
//! Processor time depends on the machine and, by up to half, on what else it does: compare within one run.
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    clippy::print_stderr,
    missing_docs
)]

#[path = "speed_accuracy/charts.rs"]
mod charts;
#[path = "speed_accuracy/gradient.rs"]
mod gradient;
#[path = "speed_accuracy/peer.rs"]
mod peer;

use goniofit::base::Unwatched;
use goniofit::fabric::Fabric;
use goniofit::render::{
    Effort, Estimates, FiberScene, FiberSceneOptions, Integrator, RaySpeed, Request, Scene,
    relative_error_weight, weighted_rms,
};
use goniofit::scatter::{self, CHANNELS, Parameters};
use goniofit::session::{Configuration, Plan};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Published fibers, and the CPU seconds to 1 % of the first prototype, on another machine of the same kind.
const MATERIALS: [(&str, [f64; 2]); 4] = [
    ("fleece", [130.0, 147.0]),
    ("gabardine", [169.0, 223.0]),
    ("silk", [155.0, 167.0]),
    ("cotton", [204.0, 213.0]),
];

/// Where the weight of dark configurations stops growing (Khungurn 2015 section 5.3).
const TAU: f64 = 0.02;

/// Efforts of a full run, cheapest first, and of a quick one.
const FAST: [f64; 4] = [0.08, 0.04, 0.02, 0.01];
const BASIC: [u64; 4] = [4096, 16384, 65536, 262_144];
const QUICK: (f64, u64) = (0.03, 16384);

/// One renderer on one material at one effort.
#[derive(Serialize, Deserialize, Clone)]
struct Row {
    fabric: String,
    renderer: String,
    model: String,
    effort: String,
    seed: u64,
    runs: usize,
    /// Of one run, pilots included.
    cpu_s: f64,
    error_stated: f64,
    error_actual: Option<f64>,
    cpu_s_for_1pct: f64,
    /// CPU seconds of the prototype, middle of its range, over ours.
    prototype_ratio: Option<f64>,
    paths_per_s_core: Option<f64>,
    mrays_closest: Option<f64>,
    mrays_any: Option<f64>,
    derivatives: bool,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    configurations: Vec<ConfigurationError>,
}

/// Relative errors of one configuration.
#[derive(Serialize, Deserialize, Clone)]
struct ConfigurationError {
    config: u32,
    mean: [f64; CHANNELS],
    error_stated: f64,
    error_actual: Option<f64>,
    paths: u64,
}

/// A run as it is kept.
#[derive(Serialize, Deserialize)]
struct Results {
    date: String,
    processor: String,
    cores: usize,
    /// Load averages over one minute, before and after: above the cores, processor times are inflated.
    load: [f64; 2],
    segments: usize,
    rows: Vec<Row>,
    gradient: Vec<gradient::Cost>,
}

impl Row {
    /// What `cpu_s_for_1pct` is scaled from.
    fn error(&self) -> f64 {
        self.error_actual.unwrap_or(self.error_stated)
    }
}

/// The command line.
struct Options {
    quick: bool,
    json: bool,
    chart: bool,
    only: Option<String>,
    runs: usize,
    steps: usize,
    from: Option<PathBuf>,
}

impl Options {
    fn read() -> Self {
        let arguments: Vec<String> = std::env::args().collect();
        let has = |flag: &str| arguments.iter().any(|a| a == flag);
        let value = |flag: &str| {
            let at = arguments.iter().position(|a| a == flag)?;
            arguments.get(at + 1).cloned()
        };
        let count = |flag: &str| value(flag).map_or(4, |v| v.parse().unwrap());
        let quick = has("--quick");
        Self {
            quick,
            json: has("--json"),
            chart: has("--chart"),
            only: value("--only"),
            runs: if quick { 1 } else { count("--runs") },
            steps: if quick { 1 } else { count("--steps") },
            from: value("--from").map(Into::into),
        }
    }
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn main() {
    let options = Options::read();
    let results = match &options.from {
        Some(file) => serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap(),
        None => measure(&options),
    };
    if options.from.is_none() && !options.quick {
        keep(&results);
        eprintln!("kept in benches/runs");
    }
    if options.chart {
        charts::draw(&results, &root().join("docs/charts"));
    }
}

fn measure(options: &Options) -> Results {
    let fabric = goniofit::fabric::load(&root().join("fabrics/bench_twill22.toml")).unwrap();
    let mut results = Results {
        date: goniofit::rig::utc_now(),
        processor: processor(),
        cores: rayon::current_num_threads(),
        load: [load(); 2],
        segments: fabric.tile.segments.len(),
        rows: Vec::new(),
        gradient: Vec::new(),
    };
    let plan = Plan::read(&root().join("rig_configs/plans/khungurn16.toml")).unwrap();
    if !options.json {
        print!("{}{HEADINGS}", heading(&results));
    }
    let bench = Bench::new(&fabric, &plan.configurations, options);
    let wanted = |name: &str| options.only.as_deref().is_none_or(|o| o == name);
    let materials = MATERIALS.iter().filter(|(name, _)| wanted(name));
    for (material, prototype) in materials.clone() {
        for integrator in [Integrator::Fast, Integrator::Basic] {
            for effort in efforts(integrator, options) {
                let row = bench.row((material, *prototype), integrator, &effort);
                report(&row, options.json);
                results.rows.push(row);
                if !options.quick {
                    keep(&results);
                }
            }
        }
    }
    for row in peer::rows(options.quick) {
        report(&row, options.json);
        results.rows.push(row);
    }
    let rounds = if options.quick { 2 } else { 4 };
    for (material, _) in materials.take(if options.quick { 1 } else { usize::MAX }) {
        let cost = gradient::cost(
            &fabric,
            &plan.configurations,
            material,
            &parameters(material),
            rounds,
        );
        if options.json {
            println!("{}", serde_json::to_string(&cost).unwrap());
        } else {
            print!("{}", cost.line());
        }
        results.gradient.push(cost);
    }
    results.load[1] = load();
    if !options.json {
        println!("load average at the end {:.1}", results.load[1]);
    }
    results
}

fn efforts(integrator: Integrator, options: &Options) -> Vec<Effort> {
    let (accuracies, paths) = match options.quick {
        true => (vec![QUICK.0], vec![QUICK.1]),
        false => (FAST.to_vec(), BASIC.to_vec()),
    };
    let all: Vec<Effort> = match integrator {
        Integrator::Fast => accuracies.into_iter().map(Effort::Accuracy).collect(),
        Integrator::Basic => paths.into_iter().map(Effort::Paths).collect(),
    };
    all.into_iter().take(options.steps).collect()
}

fn parameters(material: &str) -> Parameters {
    let file = root().join(format!("fabrics/params/{material}.json"));
    let values = serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap();
    Parameters::from_json(scatter::model("khungurn").unwrap(), &values).unwrap()
}

/// What all rows share.
struct Bench<'a> {
    configurations: &'a [Configuration],
    fabric: &'a Fabric,
    rays: RaySpeed,
    runs: usize,
}

impl<'a> Bench<'a> {
    fn new(fabric: &'a Fabric, configurations: &'a [Configuration], options: &Options) -> Self {
        let rays = if options.quick { 50_000 } else { 200_000 };
        Self {
            rays: scene(fabric, Integrator::Fast).ray_speed(rays, 1),
            configurations,
            fabric,
            runs: options.runs,
        }
    }

    fn row(
        &self,
        (material, prototype): (&str, [f64; 2]),
        integrator: Integrator,
        effort: &Effort,
    ) -> Row {
        let (scene, parameters) = (scene(self.fabric, integrator), parameters(material));
        let run = |stream: usize| {
            let request = Request {
                configurations: self.configurations,
                parameters: &parameters,
                effort: effort.clone(),
                seed: 1,
                stream: stream as u64,
            };
            scene.estimate(&request, &Unwatched).unwrap()
        };
        let runs: Vec<Estimates> = (0..self.runs).map(run).collect();
        let errors = configuration_errors(&runs);
        let n = runs.len() as f64;
        let cpu_s = runs.iter().map(|r| r.cpu_s).sum::<f64>() / n;
        let rms = |of: &dyn Fn(&ConfigurationError) -> Option<f64>| {
            let squares: Option<f64> = errors.iter().map(|e| of(e).map(|e| e * e)).sum();
            squares.map(|s| (s / errors.len() as f64).sqrt())
        };
        let error_actual = rms(&|e| e.error_actual);
        let error_stated = rms(&|e| Some(e.error_stated)).unwrap_or(f64::NAN);
        let for_one_percent = seconds_to(0.01, cpu_s, error_actual.unwrap_or(error_stated));
        let paths = traced(self.configurations, &errors, integrator);
        Row {
            fabric: material.to_owned(),
            renderer: format!("{integrator:?}").to_lowercase(),
            model: "khungurn".to_owned(),
            effort: match effort {
                Effort::Accuracy(a) => format!("{}%", 100.0 * a),
                Effort::Paths(n) => format!("{n} paths"),
                Effort::Total { paths, .. } => format!("{paths} paths in all"),
            },
            seed: 1,
            runs: runs.len(),
            cpu_s,
            error_stated,
            error_actual,
            cpu_s_for_1pct: for_one_percent,
            prototype_ratio: Some(0.5 * (prototype[0] + prototype[1]) / for_one_percent),
            paths_per_s_core: Some(paths as f64 / cpu_s),
            mrays_closest: Some(self.rays.mrays_closest),
            mrays_any: Some(self.rays.mrays_any),
            derivatives: true,
            configurations: errors,
        }
    }
}

fn scene(fabric: &Fabric, integrator: Integrator) -> FiberScene {
    let options = FiberSceneOptions {
        integrator,
        ..FiberSceneOptions::default()
    };
    FiberScene::new(&fabric.tile, scatter::model("khungurn").unwrap(), options).unwrap()
}

/// CPU seconds to a relative error: it falls with the square root of the work.
fn seconds_to(target: f64, cpu_s: f64, error: f64) -> f64 {
    cpu_s * (error / target).powi(2)
}

/// Stated and actual relative errors of a run, per configuration; actual ones need two runs.
fn configuration_errors(runs: &[Estimates]) -> Vec<ConfigurationError> {
    let n = runs.len() as f64;
    let one = |i: usize| {
        let of = |r: usize| &runs[r].configurations[i];
        let average = |pick: &dyn Fn(usize, usize) -> f64| -> [f64; CHANNELS] {
            std::array::from_fn(|c| (0..runs.len()).map(|r| pick(r, c)).sum::<f64>() / n)
        };
        let mean = average(&|r, c| of(r).mean[c]);
        let stated = average(&|r, c| of(r).standard_error[c].powi(2));
        let scatter = average(&|r, c| (of(r).mean[c] - mean[c]).powi(2));
        let weight = relative_error_weight(mean, TAU);
        let relative = |squares: [f64; CHANNELS]| {
            weighted_rms(std::iter::once((weight, squares.map(f64::sqrt))))
        };
        ConfigurationError {
            config: of(0).config,
            mean,
            error_stated: relative(stated),
            error_actual: (runs.len() > 1).then(|| relative(scatter.map(|s| s * n / (n - 1.0)))),
            paths: of(0).paths,
        }
    };
    (0..runs[0].configurations.len()).map(one).collect()
}

/// Camera paths of a run without its pilots: the fast renderer traces those of configurations with the same view once.
fn traced(all: &[Configuration], errors: &[ConfigurationError], integrator: Integrator) -> u64 {
    let view = |i: usize| all[i].camera_in_sample().vector();
    let seen = |i: usize| (0..i).any(|j| (view(i) - view(j)).length() < 1e-12);
    let counts = |i: &usize| integrator == Integrator::Basic || !seen(*i);
    let own = (0..all.len()).filter(counts);
    own.map(|i| errors[i].paths).sum()
}

const HEADINGS: &str = "material   renderer  effort        runs   CPU s  stated %  actual %  CPU s for 1 %  prototype/this  paths/s/core  Mrays/s closest  any\n";

fn report(row: &Row, json: bool) {
    if json {
        println!("{}", serde_json::to_string(row).unwrap());
    } else {
        print!("{}", line(row));
    }
}

fn line(row: &Row) -> String {
    let optional = |x: Option<f64>, digits: usize| {
        x.map_or_else(|| "-".to_owned(), |x| format!("{x:.digits$}"))
    };
    format!(
        "{:<10} {:<9} {:<12} {:5} {:7.1} {:9.2} {:>9} {:14.1} {:>15} {:>13} {:>16} {:>4}\n",
        row.fabric,
        row.renderer,
        row.effort,
        row.runs,
        row.cpu_s,
        100.0 * row.error_stated,
        optional(row.error_actual.map(|e| 100.0 * e), 2),
        row.cpu_s_for_1pct,
        optional(row.prototype_ratio, 2),
        optional(row.paths_per_s_core, 0),
        optional(row.mrays_closest, 2),
        optional(row.mrays_any, 2),
    )
}

fn heading(r: &Results) -> String {
    format!(
        "{}, {}, {} threads, load average {:.1}; bench_twill22, {} segments, khungurn16\n",
        r.date, r.processor, r.cores, r.load[0], r.segments
    )
}

/// Writes `benches/runs/DATE_speed_accuracy.{json,txt}`: after every row, so that a stopped run leaves what it has.
fn keep(results: &Results) {
    let stem = format!("benches/runs/{}_speed_accuracy", &results.date[..10]);
    let mut text = heading(results) + HEADINGS;
    results.rows.iter().for_each(|row| text += &line(row));
    (results.gradient.iter()).for_each(|cost| text += &cost.line());
    text += &format!("load average at the end {:.1}\n", results.load[1]);
    text += "\nerror of each configuration, percent (actual; stated where there was one run)\n";
    for row in &results.rows {
        let errors: Vec<String> = row
            .configurations
            .iter()
            .map(|c| format!("{:6.2}", 100.0 * c.error_actual.unwrap_or(c.error_stated)))
            .collect();
        text += &format!(
            "{:<10} {:<9} {:<12} {}\n",
            row.fabric,
            row.renderer,
            row.effort,
            errors.join(" ")
        );
    }
    std::fs::write(root().join(format!("{stem}.txt")), text).unwrap();
    let json = serde_json::to_string(results).unwrap() + "\n";
    let json = json.replace("{\"fabric\"", "\n{\"fabric\"");
    std::fs::write(root().join(format!("{stem}.json")), json).unwrap();
}

fn processor() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let line = text.lines().find(|l| l.starts_with("model name"));
    let name = line.and_then(|l| l.split(": ").nth(1));
    name.unwrap_or("unknown processor").to_owned()
}

fn load() -> f64 {
    let text = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let first = text.split(' ').next().and_then(|l| l.parse().ok());
    first.unwrap_or(f64::NAN)
}
