//! Promise: a table of real fabrics' BRDF becomes measurements by the command in docs/real_fabrics.md; fits of them are finite, say
//! how far off they are, and never call a residual surely above the tolerance converged. The slow test prints that page's tables;
//! `KEEP=DIR` leaves its fits there and takes those that are.
//!
//! The table lies outside the project (terms: research use); tests that need it skip with a message where it is absent.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

use assert_cmd::Command;
use goniofit::base::Unwatched;
use goniofit::fit::{Budget, FitResult, Options, ParameterResult, TAU, Verdict, fit};
use goniofit::render::{FiberScene, FiberSceneOptions, Plate};
use goniofit::session::{Configuration, Measurements, Plan};
use goniofit::{fabric, scatter};
use std::fmt::Write;
use std::path::{Path, PathBuf};

fn here() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The table, where it is.
fn table() -> Option<PathBuf> {
    let path = here().join("../shared/data/real_fabrics_16.csv");
    let there = path.exists();
    if !there {
        println!("skipped: {} is not there", path.display());
    }
    there.then_some(path)
}

/// What the documented command makes of a table, or its exit code.
fn converted(table: &Path, (source, material): (&str, &str)) -> Result<String, i32> {
    let output = Command::new("awk")
        .args(["-v", &format!("source={source}")])
        .args(["-v", &format!("material={material}")])
        .arg("-f")
        .arg(here().join("tests/peer/real_fabrics/to_measurements.awk"))
        .arg(table)
        .output()
        .unwrap();
    match output.status.code().unwrap() {
        0 => Ok(String::from_utf8(output.stdout).unwrap()),
        code => Err(code),
    }
}

/// Row by row the BRDF times pi of a material, with its number: a second way to read the table.
fn over_lambert(table: &Path, source: &str, material: &str) -> Vec<(u32, [f64; 3])> {
    let mut reader = csv::Reader::from_path(table).unwrap();
    let rows = reader.records().map(Result::unwrap);
    rows.filter(|r| &r[0] == source && &r[1] == material)
        .map(|r| {
            let number = |k: usize| r[k].parse::<f64>().unwrap();
            (
                r[2].parse::<u32>().unwrap(),
                [number(14), number(15), number(16)],
            )
        })
        .collect()
}

/// Source and material, as in the table's first two columns.
type Material = (&'static str, &'static str);
const BLACK: Material = ("nbrdf_merl", "black-fabric");
const PINK: Material = ("nbrdf_merl", "pink-felt");
const RED: Material = ("nbrdf_merl", "red-fabric");
const WHITE: Material = ("nbrdf_merl", "white-fabric");
const GREEN: Material = ("nbrdf_rgl", "acrylic_felt_green_rgb");
const BLACK_SGD: Material = ("sgd_merl", "black-fabric");
const PINK_SGD: Material = ("sgd_merl", "pink-felt");
const RED_SGD: Material = ("sgd_merl", "red-fabric");
const WHITE_SGD: Material = ("sgd_merl", "white-fabric");
const ALL: [Material; 9] = [
    BLACK, PINK, RED, WHITE, GREEN, BLACK_SGD, PINK_SGD, RED_SGD, WHITE_SGD,
];

const HEAD: &str = "source,material,config,plane,fabric_rot,light_angle,camera_angle,theta_i,phi_i,theta_o,phi_o,R,G,B";

#[test]
fn an_invented_table_becomes_normalized_radiance() {
    // A perfect white diffuser reads cos(theta) in every pose, another material and 80/80 are left out.
    let white = 1.0 / std::f64::consts::PI;
    let mut text = format!("{HEAD}\n");
    for (config, light, camera, phi) in [(0, 80, 80, 180), (1, 64, 48, 0), (9, 60, 0, 90)] {
        for (material, f) in [("white", white), ("gray", 0.1)] {
            writeln!(
                text,
                "s,{material},{config},in,90,{light},{camera},{light},0,{camera},{phi},{f},{f},{f}"
            )
            .unwrap();
        }
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("table.csv");
    std::fs::write(&path, text).unwrap();
    let csv = converted(&path, ("s", "white")).unwrap();
    let measured = Measurements::from_csv(&csv).unwrap();
    let ids: Vec<u32> = measured.configurations().iter().map(|c| c.id).collect();
    assert_eq!(ids, [2, 10]);
    for m in &measured.intensities {
        let cos = m.configuration.light.theta.cos();
        let floor = 2e-4 * std::f64::consts::PI;
        for c in 0..3 {
            assert!((m.mean[c] / cos - 1.0).abs() < 1e-9, "{m:?}");
            assert!(
                (m.standard_error[c] / cos - 0.02_f64.hypot(floor)).abs() < 1e-6,
                "{m:?}"
            );
        }
    }
    // Negative control: without the comment that says what it is the BRDF would be read as radiance.
    let bare = csv.split_once('\n').unwrap().1;
    let wrong = Measurements::from_csv(bare).unwrap().intensities[0].mean[0];
    assert!((wrong - white).abs() < 1e-9, "{wrong}");
    assert_eq!(converted(&path, ("s", "blue")), Err(2));
}

#[test]
fn the_real_table_becomes_measurements_of_the_plan() {
    let Some(table) = table() else { return };
    let plan = Plan::read(&here().join("rig_configs/plans/khungurn16.toml")).unwrap();
    // The same pose but for a mirror image: the materials are isotropic.
    let pose = |c: &Configuration| {
        let apart = (c.light.phi - c.camera.phi).cos();
        [c.light.theta, c.camera.theta, apart, c.rotation]
    };
    for (source, material) in ALL {
        let csv = converted(&table, (source, material)).unwrap();
        let measured = Measurements::from_csv(&csv).unwrap();
        assert_eq!(measured.n_numbers(), 39, "{source} {material}");
        let rows = over_lambert(&table, source, material);
        for m in &measured.intensities {
            let id = m.configuration.id;
            let planned = plan.configuration(id).unwrap();
            for (a, b) in pose(&m.configuration).into_iter().zip(pose(planned)) {
                assert!((a - b).abs() < 1e-9, "{source} {material} {id}");
            }
            let cos = m.configuration.light.theta.cos();
            let (_, factor) = rows.iter().find(|(k, _)| k + 1 == id).unwrap();
            for (mean, factor) in m.mean.iter().zip(factor) {
                let off = mean / (factor * cos) - 1.0;
                assert!(off.abs() < 1e-4, "{source} {material} {id}: {off}");
            }
        }
    }
}

/// One fit: of which material, with which cloth, how.
struct Trial {
    material: Material,
    fabric: &'static str,
    options: &'static [&'static str],
}

impl Trial {
    fn new(material: Material, fabric: &'static str, options: &'static [&'static str]) -> Self {
        Self {
            material,
            fabric,
            options,
        }
    }

    fn name(&self) -> String {
        let (source, material) = self.material;
        let short = material.trim_end_matches("_rgb");
        let short = short.replace(['_', '-'], " ");
        match source {
            "sgd_merl" => format!("{short} (SGD)"),
            _ => short,
        }
    }

    fn measurements(&self, table: &Path) -> Measurements {
        Measurements::from_csv(&converted(table, self.material).unwrap()).unwrap()
    }

    fn fit(&self, table: &Path, folder: &Path) -> FitResult {
        let options = self.options.concat();
        let folder = folder.join(format!(
            "{}.{}.{}{options}",
            self.material.0, self.material.1, self.fabric
        ));
        let file = folder.join("fit/fit.json");
        if !file.exists() {
            self.run(table, &folder);
        }
        let result = FitResult::read(&file).unwrap();
        check(&result);
        result
    }

    /// The same fit of the cloth on white; the command has only the published black turntable.
    fn run_on_white(&self, table: &Path, folder: &Path) {
        let cloth = fabric::load(&here().join(format!("fabrics/{}.toml", self.fabric))).unwrap();
        let options = FiberSceneOptions {
            plate: Plate::Diffuse([1.0; 3]),
            ..FiberSceneOptions::default()
        };
        let model = scatter::model("khungurn").unwrap();
        let scene = FiberScene::new(&cloth.tile, model, options).unwrap();
        let budget = Budget {
            paths: Some(PATHS.parse().unwrap()),
            ..Budget::default()
        };
        let options = Options::new(1, budget);
        let result = fit(&scene, &self.measurements(table), &options, &Unwatched).unwrap();
        std::fs::create_dir_all(folder.join("fit")).unwrap();
        result.write(&folder.join("fit/fit.json"), false).unwrap();
    }

    fn run(&self, table: &Path, folder: &Path) {
        std::fs::create_dir_all(folder).unwrap();
        if self.options == ON_WHITE {
            return self.run_on_white(table, folder);
        }
        let csv = folder.join("measurements.csv");
        std::fs::write(&csv, converted(table, self.material).unwrap()).unwrap();
        let output = Command::cargo_bin("goniofit")
            .unwrap()
            .args(["fit", "--seed", "1", "--paths", PATHS])
            .arg("--measurements")
            .arg(&csv)
            .arg("--fabric")
            .arg(here().join(format!("fabrics/{}.toml", self.fabric)))
            .arg("--out")
            .arg(folder.join("fit"))
            .args(self.options)
            .output()
            .unwrap();
        let talk = String::from_utf8_lossy(&output.stderr);
        assert!(matches!(output.status.code(), Some(0 | 1)), "{talk}");
        let result = FitResult::read(&folder.join("fit/fit.json")).unwrap();
        assert_eq!(output.status.code() == Some(0), result.converged, "{talk}");
    }
}

/// What an honest fit says, whatever it found.
fn check(result: &FitResult) {
    let o = &result.objective;
    let surely = o.weighted_rms_percent - 3.0 * o.weighted_rms_se_percent;
    assert!(!result.converged || surely <= result.tolerance_percent);
    assert!(o.weighted_rms_percent > 0.0 && o.weighted_rms_percent < 200.0);
    assert!(
        o.misfit_percent > 0.0 || o.paired < 4.0 * o.se,
        "a residual beyond the errors must widen the intervals"
    );
    for p in &result.uncertainty {
        let [low, high] = p.interval_95;
        assert!(
            (p.lower_bound..=p.value).contains(&low) && (p.value..=p.upper_bound).contains(&high),
            "{p:?}"
        );
    }
}

/// Not an option of the command: the cloth lies on a white diffuser.
const ON_WHITE: &[&str] = &["on white"];

/// Camera paths of each fit.
const PATHS: &str = "1000000";

/// Which cloths stand for which material.
const GEOMETRIES: [(Material, &[&str]); 5] = [
    (
        WHITE,
        &["plain_cotton", "gabardine", "bench_twill22", "fleece"],
    ),
    (RED, &["silk_satin", "gabardine", "fleece"]),
    (PINK, &["fleece"]),
    (GREEN, &["fleece"]),
    (BLACK, &["fleece"]),
];

/// What else was tried, and the cloth it was tried with.
const VARIANTS: [(Material, &str, &[&str]); 7] = [
    (WHITE, "fleece", ON_WHITE),
    (WHITE, "gabardine", ON_WHITE),
    (RED, "gabardine", ON_WHITE),
    (WHITE, "fleece", &["--loss", "huber:2"]),
    (WHITE, "fleece", &["--gain-prior", "0.05"]),
    (WHITE, "fleece", &["--per-system"]),
    (WHITE, "fleece", &["--model", "chiang"]),
];

/// Weighted rms difference from `measured`, percent, of what `other` gives for configuration i and channel c; the weights are those
/// of a fit.
fn difference(measured: &Measurements, other: impl Fn(usize, usize) -> f64) -> f64 {
    let mut sum = 0.0;
    for (i, m) in measured.intensities.iter().enumerate() {
        let scale = TAU.max(m.mean.iter().sum::<f64>() / 3.0);
        sum += (0..3)
            .map(|c| ((other(i, c) - m.mean[c]) / scale).powi(2))
            .sum::<f64>();
    }
    100.0 * (sum / measured.n_numbers() as f64).sqrt()
}

/// What a perfect diffuser of the best three albedos leaves, percent.
fn diffuser(measured: &Measurements) -> f64 {
    let cos = |i: usize| measured.intensities[i].configuration.light.theta.cos();
    let albedo: [f64; 3] = std::array::from_fn(|c| {
        let (mut up, mut down) = (0.0, 0.0);
        for (i, m) in measured.intensities.iter().enumerate() {
            let weight = TAU.max(m.mean.iter().sum::<f64>() / 3.0).powi(-2);
            up += weight * m.mean[c] * cos(i);
            down += weight * cos(i).powi(2);
        }
        up / down
    });
    difference(measured, |i, c| albedo[c] * cos(i))
}

fn list(names: Vec<&str>) -> String {
    match names.len() {
        0 => "-".to_owned(),
        _ => names.join(", "),
    }
}

/// Names of the parameters of which `is`.
fn named(result: &FitResult, is: impl Fn(&ParameterResult) -> bool) -> String {
    let all = result.uncertainty.iter().filter(|p| is(p));
    list(all.map(|p| p.name.as_str()).collect())
}

fn at_bound(p: &ParameterResult) -> bool {
    matches!(p.verdict, Verdict::AtLowerBound | Verdict::AtUpperBound)
}

/// A line of the tables of fits.
fn row(trial: &Trial, result: &FitResult) -> String {
    let o = &result.objective;
    let goodness = result.goodness.as_ref().map_or("-".to_owned(), |g| {
        format!("{:.0}", g.statistic / g.expected)
    });
    format!(
        "| {} | {}{} | {:.1} +- {:.1} | {goodness} | {} | {} | {} | {:.0} |",
        trial.name(),
        trial.fabric,
        trial
            .options
            .iter()
            .map(|o| format!(" {o}"))
            .collect::<String>(),
        o.weighted_rms_percent,
        o.weighted_rms_se_percent,
        if result.converged { "yes" } else { "no" },
        named(result, at_bound),
        named(result, |p| matches!(
            p.verdict,
            Verdict::NotDetermined | Verdict::WeaklyDetermined
        )),
        result.time.cpu_s,
    )
}

const ROW_HEAD: &str = "| material | cloth | residual, % | Q / expected | converged | at a bound | weakly or not determined | CPU s |
|---|---|---|---|---|---|---|---|";

/// Parameters, largest residuals and patterns of one fit.
fn details(name: &str, result: &FitResult) -> String {
    let mut text = format!(
        "\n### {name}\n\n| parameter | value | 95 % interval | verdict |\n|---|---|---|---|\n"
    );
    for p in &result.uncertainty {
        let [low, high] = p.interval_95;
        writeln!(
            text,
            "| {} | {:.4} | {low:.4} to {high:.4} | {} |",
            p.name,
            p.value,
            p.verdict.words()
        )
        .unwrap();
    }
    let mut worst: Vec<_> = result.configs.iter().collect();
    let size = |c: &&goniofit::fit::ConfigurationResult| {
        let squares = c.relative_residual.iter().flatten().map(|r| r * r);
        squares.sum::<f64>()
    };
    worst.sort_by(|a, b| size(b).total_cmp(&size(a)));
    text += "\nLargest residuals, percent (r, g, b):\n\n";
    for c in worst.iter().take(4) {
        let degrees = |d: goniofit::math::PolarDirection| d.theta.to_degrees().round();
        let residual = c.relative_residual.map(|r| 100.0 * r.unwrap());
        let turn = c.configuration.light.phi.to_degrees().round();
        writeln!(
            text,
            "- configuration {}: light {}, camera {}, {turn} apart, turn {:.0}: {:+.0}, {:+.0}, {:+.0}",
            c.configuration.id,
            degrees(c.configuration.light),
            degrees(c.configuration.camera),
            c.configuration.rotation.to_degrees(),
            residual[0],
            residual[1],
            residual[2]
        )
        .unwrap();
    }
    let patterns = result.patterns.iter().filter(|p| p.significant);
    let patterns =
        patterns.map(|p| format!("{} {:+.0} +- {:.0}", p.name, p.mean_percent, p.se_percent));
    let patterns: Vec<String> = patterns.collect();
    let patterns = list(patterns.iter().map(String::as_str).collect());
    writeln!(
        text,
        "\nPatterns that stand out, mean residual in percent: {patterns}."
    )
    .unwrap();
    text
}

/// What the fits are to be compared with.
fn print_yardsticks(table: &Path) {
    println!("| material | diffuser, % | other encoding, % | assumed errors, % |");
    println!("|---|---|---|---|");
    for (material, _) in GEOMETRIES {
        let trial = Trial::new(material, "", &[]);
        let measured = trial.measurements(table);
        let other = (material.0 == "nbrdf_merl").then(|| {
            let other = Trial::new(("sgd_merl", material.1), "", &[]).measurements(table);
            let off = difference(&measured, |i, c| other.intensities[i].mean[c]);
            format!("{off:.1}")
        });
        let errors = difference(&measured, |i, c| {
            let m = &measured.intensities[i];
            m.mean[c] + m.standard_error[c]
        });
        println!(
            "| {} | {:.1} | {} | {errors:.1} |",
            trial.name(),
            diffuser(&measured),
            other.unwrap_or("-".to_owned()),
        );
    }
}

#[test]
#[ignore = "slow: 15 min"]
fn real_fabrics_fitted_with_woven_cloth() {
    let Some(table) = table() else { return };
    let temporary = tempfile::tempdir().unwrap();
    let kept = std::env::var_os("KEEP").map(PathBuf::from);
    let folder = kept.as_deref().unwrap_or(temporary.path());
    print_yardsticks(&table);
    println!("\n{ROW_HEAD}");
    let mut best = String::new();
    for (material, fabrics) in GEOMETRIES {
        let mut results: Vec<(String, FitResult)> = Vec::new();
        for fabric in fabrics {
            let trial = Trial::new(material, fabric, &[]);
            let result = trial.fit(&table, folder);
            println!("{}", row(&trial, &result));
            results.push((format!("{}, {fabric}", trial.name()), result));
        }
        let rms = |r: &FitResult| r.objective.weighted_rms_percent;
        results.sort_by(|a, b| rms(&a.1).total_cmp(&rms(&b.1)));
        best += &details(&results[0].0, &results[0].1);
    }
    println!("\n{ROW_HEAD}");
    for (material, fabric, options) in VARIANTS {
        let trial = Trial::new(material, fabric, options);
        println!("{}", row(&trial, &trial.fit(&table, folder)));
    }
    println!("{best}");
}
