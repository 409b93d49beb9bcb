//! Parameters per yarn system: the fiber that is hit decides which set scatters, and its derivatives go to that set's rows;
//! in both integrators, in pictures and in recorded paths.
#![allow(
    clippy::unwrap_used,
    clippy::float_cmp,
    clippy::print_stdout,
    missing_docs
)]

#[path = "common/render_scenes.rs"]
mod render_scenes;

use assert_cmd::Command;
use glam::DVec3;
use goniofit::base::Unwatched;
use goniofit::fabric::{FiberTile, Segment};
use goniofit::render::{
    Effort, Estimate, FiberScene, FiberSceneOptions, Integrator, PictureEffort, PictureRequest,
    Pictured, Plate, RecordOptions, Request, Scene,
};
use goniofit::scatter::{self, CHANNELS, Model, Parameters, YARN_SYSTEMS, per_system};
use goniofit::session::Configuration;
use render_scenes::{
    SOFT, Scores, WIDE, felt, khungurn, one_fiber, parameters, pose, seed, segment, twill, z_bound,
};
use serde_json::{Value, json};

/// Darker and narrower than [`SOFT`].
const DARK: [f64; 9] = [0.3, 0.05, 0.1, 0.4, 0.7, 0.2, 5.0, 15.0, 20.0];

const WHITE: Plate = Plate::Diffuse([0.9, 0.6, 0.3]);

fn model() -> &'static dyn Model {
    per_system(khungurn()).unwrap()
}

/// The warp's set, then the weft's.
fn sets(warp: [f64; 9], weft: [f64; 9]) -> Parameters {
    let both = [parameters(warp), parameters(weft)];
    let values = both.iter().flat_map(Parameters::values).copied().collect();
    Parameters::defaults(model()).with_values(values)
}

/// A felt whose fibers belong to both systems by turns.
fn mixed(n: usize) -> FiberTile {
    let mut tile = felt(n, 0.2);
    for (i, s) in tile.segments.iter_mut().enumerate() {
        s.yarn_system = (i % 2) as u8;
    }
    tile
}

fn poses() -> Vec<Configuration> {
    vec![
        pose(1, [32.0, 180.0], [32.0, 0.0]),
        pose(2, [64.0, 0.0], [48.0, 20.0]),
        pose(3, [40.0, 270.0], [48.0, 20.0]),
        pose(4, [70.0, 90.0], [75.0, 0.0]),
    ]
}

fn options(integrator: Integrator, plate: Plate) -> FiberSceneOptions {
    FiberSceneOptions {
        light: WIDE,
        plate,
        integrator,
        ..FiberSceneOptions::default()
    }
}

fn request<'a>(poses: &'a [Configuration], at: &'a Parameters, paths: u64) -> Request<'a> {
    Request {
        configurations: poses,
        parameters: at,
        effort: Effort::Paths(paths),
        seed: seed(21),
        stream: 0,
    }
}

fn render(
    tile: &FiberTile,
    model: &'static dyn Model,
    integrator: Integrator,
    at: &Parameters,
    paths: u64,
) -> Vec<Estimate> {
    let scene = FiberScene::new(tile, model, options(integrator, WHITE)).unwrap();
    let poses = poses();
    let estimates = scene.estimate(&request(&poses, at, paths), &Unwatched);
    estimates.unwrap().configurations
}

/// Means are the same bit for bit, and the derivatives of the two sets add up to those of one.
fn assert_is_one_set(what: &str, two: &Estimate, one: &Estimate) {
    let rows = one.derivative.len();
    assert_eq!(two.derivative.len(), YARN_SYSTEMS.len() * rows);
    assert_eq!((two.mean, two.paths), (one.mean, one.paths), "{what}");
    for row in 0..rows {
        for c in 0..CHANNELS {
            let parts = [two.derivative[row][c], two.derivative[rows + row][c]];
            let (sum, whole) = (parts[0] + parts[1], one.derivative[row][c]);
            // Both systems take part, and only rounding differs.
            assert!(parts[0] != 0.0 && parts[1] != 0.0, "{what}: {parts:?}");
            let scale = parts[0].abs() + parts[1].abs();
            assert!(
                (sum - whole).abs() < 1e-9 * scale,
                "{what}, row {row}, channel {c}: {parts:?} add up to {sum}, not {whole}"
            );
        }
    }
}

#[test]
fn equal_sets_are_one_set() {
    // Sees any event whose derivative goes to no set, to a wrong row or to both, however rare.
    let tile = mixed(60);
    let (one, two) = (parameters(SOFT), sets(SOFT, SOFT));
    for integrator in [Integrator::Fast, Integrator::Basic] {
        let single = render(&tile, khungurn(), integrator, &one, 4000);
        let double = render(&tile, model(), integrator, &two, 4000);
        for (two, one) in double.iter().zip(&single) {
            let what = format!("{integrator:?}, pose {}", one.config);
            assert_is_one_set(&what, two, one);
        }
        // Negative control: another weft shows.
        let other = render(&tile, model(), integrator, &sets(SOFT, DARK), 4000);
        assert!(other.iter().zip(&single).all(|(a, b)| a.mean != b.mean));
    }
}

#[test]
fn pictures_know_the_sets() {
    let tile = mixed(60);
    let poses = &poses()[..1];
    let pictures = |model: &'static dyn Model, at: &Parameters, derivatives: &[usize]| {
        let scene = FiberScene::new(&tile, model, options(Integrator::Fast, WHITE)).unwrap();
        let request = PictureRequest {
            configurations: poses,
            parameters: at,
            region: scene.tile(),
            resolution: [4, 4],
            derivatives,
            effort: PictureEffort::PathsPerPixel(64),
            seed: seed(22),
        };
        scene.pictures(&request, &Unwatched).unwrap().remove(0)
    };
    let one = pictures(khungurn(), &parameters(SOFT), &[1]);
    let two = pictures(model(), &sets(SOFT, SOFT), &[1, 6]);
    assert_eq!(one.radiance.value, two.radiance.value);
    let [warp, weft] = [0, 1].map(|layer| &two.derivatives[layer].value);
    let (mut differ, whole) = (0, &one.derivatives[0].value);
    for (pixel, whole) in whole.iter().enumerate() {
        for c in 0..CHANNELS {
            let (a, b) = (warp[pixel][c], weft[pixel][c]);
            assert!((a + b - whole[c]).abs() <= 1e-5 * whole[c].abs());
            // Negative control: neither is all of it.
            differ += usize::from((a - whole[c]).abs() > 0.1 * whole[c].abs());
        }
    }
    assert!(differ > 10, "{differ}");
}

#[test]
fn the_fiber_on_top_decides() {
    // A closed layer of warp fibers above a layer of weft fibers, seen from above: the lower one sees light only through the
    // upper one. Which of them is black decides by far, so that an exchange of the systems shows.
    let layer = |system: u8, z: f64| {
        (0..20).map(move |i| {
            let y = (f64::from(i) + 0.5) / 20.0;
            Segment {
                yarn_system: system,
                ..segment(DVec3::new(0.0, y, z), DVec3::new(1.0, y, z), 0.026)
            }
        })
    };
    let tile = FiberTile {
        size: [1.0, 1.0],
        segments: layer(0, 0.1).chain(layer(1, 0.0)).collect(),
    };
    let black = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 8.0, 25.0, 30.0];
    let means = |warp, weft| {
        let scene = FiberScene::new(&tile, model(), options(Integrator::Fast, Plate::Black));
        let poses = [pose(1, [20.0, 180.0], [20.0, 0.0])];
        let at = sets(warp, weft);
        let estimates = scene
            .unwrap()
            .estimate(&request(&poses, &at, 20_000), &Unwatched);
        estimates.unwrap().configurations[0].mean
    };
    let (bright_warp, bright_weft) = (means(SOFT, black), means(black, SOFT));
    for c in 0..CHANNELS {
        assert!(
            bright_warp[c] > 5.0 * bright_weft[c],
            "{bright_warp:?} {bright_weft:?}"
        );
    }
}

#[test]
fn derivatives_match_finite_differences_along_the_same_paths() {
    // Recorded paths at moved parameters: the paths stay, so that the difference quotient has no noise. A recording's own
    // means and derivatives are those that were traced, to 2e-6, so this holds the traced ones too. The quotient's error of
    // second order is below 1e-3 of the derivative's scale; a derivative in the wrong set misses by all of it.
    let tile = mixed(60);
    let poses = poses();
    let plain = RecordOptions {
        defensive: 0.0,
        ..RecordOptions::default()
    };
    let scene = FiberScene::new(&tile, model(), options(Integrator::Fast, WHITE)).unwrap();
    let at = sets(SOFT, DARK);
    let request = request(&poses, &at, 4000);
    let traced = scene.estimate(&request, &Unwatched).unwrap();
    let recording = scene.record(&request, &plain, &Unwatched).unwrap();
    let recalled = recording.estimate(&at).unwrap();
    assert!(recalled.trust.least_ratio() > 0.999_999);
    let recalled = recalled.estimates.configurations;
    for (a, b) in recalled.iter().zip(&traced.configurations) {
        let brightness = b.mean.iter().fold(0.0_f64, |m, x| m.max(*x));
        let of = |e: &Estimate| [vec![e.mean], e.derivative.clone()].concat();
        for (x, y) in of(a).as_flattened().iter().zip(of(b).as_flattened()) {
            assert!((x - y).abs() < 2e-6 * brightness.max(y.abs()), "{x} {y}");
        }
    }
    let rows = at.infos().len() / YARN_SYSTEMS.len();
    let (mut compared, mut caught) = (0, 0);
    for (slot, (row, only)) in at.places().into_iter().enumerate() {
        let h = 0.01 * at.values()[slot];
        let moved = |sign: f64| {
            let mut values = at.values().to_vec();
            values[slot] += sign * h;
            recording.means(&at.with_values(values)).unwrap().estimates
        };
        let (up, down) = (moved(1.0), moved(-1.0));
        let channels = if at.infos()[row].per_channel {
            only..only + 1
        } else {
            0..CHANNELS
        };
        for ((up, down), e) in (up.configurations.iter().zip(&down.configurations)).zip(&recalled) {
            for c in channels.clone() {
                let quotient = (up.mean[c] - down.mean[c]) / (2.0 * h);
                let scale = e.derivative[row][c].abs() + e.mean[c] / at.values()[slot];
                let exact = e.derivative[row][c];
                assert!(
                    (quotient - exact).abs() < 2e-3 * scale,
                    "{}: {quotient} against {exact}",
                    at.infos()[row].name
                );
                // Negative control: the other system's row.
                let other = e.derivative[(row + rows) % (2 * rows)][c];
                compared += 1;
                caught += usize::from((quotient - other).abs() > 2e-3 * scale);
            }
        }
    }
    assert!(
        compared > 100 && 2 * caught > compared,
        "{caught} of {compared}"
    );
}

/// All numbers of two lists of estimates.
fn compare(what: &str, a: &[Estimate], b: &[Estimate]) -> Scores {
    let mut scores = Scores::default();
    let numbers = |e: &Estimate| {
        let values = [vec![e.mean], e.derivative.clone()].concat();
        let errors = [vec![e.standard_error], e.derivative_se.clone()].concat();
        let (values, errors) = (values.concat(), errors.concat());
        values.into_iter().zip(errors).collect::<Vec<_>>()
    };
    for (a, b) in a.iter().zip(b) {
        for (k, (a, b)) in numbers(a).into_iter().zip(numbers(b)).enumerate() {
            scores.add(&format!("{what}, number {k}"), a, b);
        }
    }
    println!("{} of bound {:.2}", scores.sentence, z_bound(scores.cells));
    scores
}

#[test]
fn the_fast_integrator_agrees_with_the_basic_one() {
    // Means and all derivatives of both sets by z-test, family-wise level 1e-3 in each comparison. What it can see: the bound
    // (4.6) times the standard errors of both sides, about 2 % of the means.
    for (name, tile) in [("felt", mixed(60)), ("twill", twill())] {
        let at = sets(SOFT, DARK);
        let fast = render(&tile, model(), Integrator::Fast, &at, 40_000);
        let basic = render(&tile, model(), Integrator::Basic, &at, 40_000);
        compare(name, &fast, &basic).assert_agree();
        // Negative controls: sets exchanged, and one number of one set moved by a tenth.
        let mut values = at.values().to_vec();
        values[13] *= 1.1;
        for wrong in [sets(DARK, SOFT), at.with_values(values)] {
            let basic = render(&tile, model(), Integrator::Basic, &wrong, 40_000);
            compare(name, &fast, &basic).assert_differ();
        }
    }
}

#[test]
fn recorded_paths_reach_other_sets() {
    // Family-wise level 1e-3 over the means; nearby parameters, so that the recording holds.
    let tile = mixed(60);
    let poses = poses();
    let scene = FiberScene::new(&tile, model(), options(Integrator::Fast, WHITE)).unwrap();
    let at = sets(SOFT, DARK);
    let recording = scene
        .record(
            &request(&poses, &at, 30_000),
            &RecordOptions::default(),
            &Unwatched,
        )
        .unwrap();
    let mut values = at.values().to_vec();
    values[3..6].iter_mut().for_each(|c| *c *= 0.8);
    values[16] *= 1.1;
    let moved = at.with_values(values);
    let recalled = recording.estimate(&moved).unwrap();
    assert!(recalled.trust.holds(goniofit::render::TRUST_THRESHOLD));
    let fresh = |at: &Parameters| {
        let request = Request {
            stream: 5,
            ..request(&poses, at, 30_000)
        };
        scene.estimate(&request, &Unwatched).unwrap().configurations
    };
    let recalled = recalled.estimates.configurations;
    compare("moved", &recalled, &fresh(&moved)).assert_agree();
    // Negative control: where it was recorded.
    compare("not moved", &recalled, &fresh(&at)).assert_differ();
}

#[test]
fn a_fabric_must_have_the_systems_of_the_model() {
    let refused = |tile: &FiberTile| {
        let error = FiberScene::new(tile, model(), FiberSceneOptions::default());
        error.unwrap_err().report()
    };
    let text = refused(&one_fiber(1.0, 0.05));
    assert!(
        text.starts_with(
            "the fabric has fibers of the yarn systems {0}, model khungurn-per-system"
        ) && text.contains("0 (warp) and 1 (weft)\nhint: one set"),
        "{text}"
    );
    let mut third = mixed(6);
    third.segments[0].yarn_system = 2;
    assert!(refused(&third).contains("{0, 1, 2}"));
    assert!(FiberScene::new(&third, khungurn(), FiberSceneOptions::default()).is_ok());
}

#[test]
fn names_are_those_of_the_fabric() {
    let fabric = goniofit::fabric::load("fabrics/bench_twill22.toml".as_ref()).unwrap();
    let systems: Vec<&str> = fabric.report.systems.iter().map(|s| s.system).collect();
    assert_eq!(systems, YARN_SYSTEMS);
    let names = Parameters::defaults(model()).flat_names();
    assert_eq!(names.len(), 18);
    assert_eq!([&*names[0], &*names[17]], ["warp.c_r.r", "weft.gamma_tt"]);
    let again = per_system(model()).unwrap();
    assert_eq!(again.name(), "khungurn-per-system");
    assert_eq!(
        scatter::model("chiang-per-system").unwrap().systems(),
        YARN_SYSTEMS
    );
    let alone = model().prepare(&sets(SOFT, DARK)).err().unwrap().report();
    assert!(
        alone.contains("hint: ask for one system's with model khungurn"),
        "{alone}"
    );
}

#[test]
fn parameter_files_have_one_set_or_one_for_each_system() {
    let at = sets(SOFT, DARK);
    let file = at.to_json();
    assert_eq!(file["weft"]["c_tt"], json!([0.4, 0.7, 0.2]));
    assert_eq!(file.as_object().unwrap().len(), 2);
    assert_eq!(Parameters::from_json(model(), &file).unwrap(), at);
    let plain = Parameters::from_json(model(), &parameters(SOFT).to_json()).unwrap();
    assert_eq!(plain, sets(SOFT, SOFT));

    let refused = |model: &dyn Model, change: &dyn Fn(&mut Value)| {
        let mut file = file.clone();
        change(&mut file);
        Parameters::from_json(model, &file).unwrap_err().report()
    };
    for (text, change) in [
        (
            "parameters: 'weft' is missing\nhint: expected {\"warp\": {...}, \"weft\": {...}}",
            (&|f: &mut Value| {
                f.as_object_mut().unwrap().remove("weft");
            }) as &dyn Fn(&mut Value),
        ),
        (
            "unknown key 'c_r' beside those of yarn systems\nhint: expected {\"warp\"",
            &|f| f["c_r"] = json!([1, 1, 1]),
        ),
        (
            "yarn system weft: parameters: 'c_r' is missing\nhint: expected {\"c_r\"",
            &|f| {
                f["weft"].as_object_mut().unwrap().remove("c_r");
            },
        ),
    ] {
        let error = refused(model(), change);
        assert!(error.contains(text), "{error}");
    }
    let error = refused(khungurn(), &|_| ());
    assert!(
        error.contains("unknown key 'warp'") && error.contains("model khungurn-per-system"),
        "{error}"
    );
}

#[test]
fn the_command_takes_both_forms_of_parameters() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("sets.json");
    std::fs::write(&file, sets(SOFT, DARK).to_json().to_string()).unwrap();
    let tile = folder.path().join("one.csv");
    let text =
        "# tile_mm = [1, 1]\nx0,y0,z0,x1,y1,z1,radius_mm,yarn_system\n0,0.75,0,1,0.75,0,0.05,0\n";
    std::fs::write(&tile, text).unwrap();
    let one = folder.path().join("one.toml");
    std::fs::write(&one, "name = 'one'\nfibers = 'one.csv'\n").unwrap();
    let run = |fabric: &std::path::Path| {
        Command::cargo_bin("goniofit")
            .unwrap()
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .args([
                "render",
                "means",
                "--paths",
                "64",
                "--derivatives",
                "--json",
                "--fabric",
            ])
            .arg(fabric)
            .arg("--params")
            .arg(&file)
            .args(["--pose", "light=30,180 camera=30,0 rotation=0"])
            .output()
            .unwrap()
    };
    let output = run("fabrics/bench_twill22.toml".as_ref());
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{text}");
    let result: Value = serde_json::from_slice(&output.stdout).unwrap();
    let derivatives = result["configs"][0]["derivatives"].as_object().unwrap();
    assert_eq!(derivatives.len(), 10);
    assert!(derivatives.contains_key("warp.c_r") && derivatives.contains_key("weft.gamma_tt"));
    assert_eq!(result["parameters"]["weft"]["c_tt"], json!([0.4, 0.7, 0.2]));

    let output = run(&one);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(
        text.contains("yarn systems {0}") && text.contains("hint:"),
        "{text}"
    );
}
