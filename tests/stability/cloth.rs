//! Cases that need rendered cloth: a small twill, the 16 published poses, few paths.

use crate::render_scenes::{WIDE, khungurn, parameters, twill};
use crate::stability::{Outcome, Row, judge};
use goniofit::base::Unwatched;
use goniofit::fabric::FiberTile;
use goniofit::fit::{Budget, Options, fit};
use goniofit::math::Random;
use goniofit::render::{Effort, FiberScene, FiberSceneOptions, Request, Scene};
use goniofit::scatter::{Model, Parameters, per_system};
use goniofit::session::{Configuration, Intensity, Measurements, Plan};
use std::path::Path;

/// Camera paths of each measured configuration, and of a fit.
const MEASURED_PATHS: u64 = 100_000;
const FIT_PATHS: u64 = 2_000_000;
/// Relative error of the measurements besides that of their renders.
const SD: f64 = 0.01;
/// A weft of other fibers than Twill's.
const WEFT: [f64; 9] = [0.25, 0.25, 0.3, 0.3, 0.5, 0.8, 8.0, 20.0, 25.0];

fn plan(wanted: impl Fn(&Configuration) -> bool) -> Vec<Configuration> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("rig_configs/plans/khungurn16.toml");
    let plan = Plan::read(&path).unwrap();
    plan.configurations.into_iter().filter(wanted).collect()
}

fn scene(tile: &FiberTile, model: &'static dyn Model) -> FiberScene {
    let options = FiberSceneOptions {
        light: WIDE,
        ..FiberSceneOptions::default()
    };
    FiberScene::new(tile, model, options).unwrap()
}

/// Measurements, and the means without their errors.
fn measured(
    scene: &FiberScene,
    truth: &Parameters,
    configurations: &[Configuration],
    seed: u64,
) -> (Measurements, Vec<[f64; 3]>) {
    let request = Request {
        configurations,
        parameters: truth,
        effort: Effort::Paths(MEASURED_PATHS),
        seed,
        stream: 77,
    };
    let rendered = scene.estimate(&request, &Unwatched).unwrap().configurations;
    let mut random = Random::keyed(&[seed, 0xc10]);
    let intensities = configurations.iter().zip(&rendered);
    let intensities = intensities.map(|(&configuration, e)| Intensity {
        configuration,
        mean: e.mean.map(|m| m * (1.0 + SD * random.normal())),
        standard_error: std::array::from_fn(|c| e.standard_error[c].hypot(SD * e.mean[c])),
        present: [true; 3],
    });
    let measurements = Measurements {
        intensities: intensities.collect(),
    };
    (measurements, rendered.iter().map(|e| e.mean).collect())
}

/// `cloth` measured in these poses and fitted with the fabric `believed`.
fn outcome(
    cloth: &FiberScene,
    truth: &Parameters,
    believed: &FiberTile,
    configurations: &[Configuration],
    seed: u64,
) -> Outcome {
    let (measurements, means) = measured(cloth, truth, configurations, seed);
    let budget = Budget {
        paths: Some(FIT_PATHS),
        ..Budget::default()
    };
    let believed = scene(believed, khungurn());
    let options = Options::new(seed, budget);
    let mut result = fit(&believed, &measurements, &options, &Unwatched).unwrap();
    let one = Parameters::defaults(khungurn());
    let own = truth.values().len() == one.values().len();
    let nominal = if own { truth } else { &one };
    result.add_truth(nominal.to_json(), means).unwrap();
    let found = result.truth.as_ref().unwrap();
    let means_off = found.weighted_rms_percent - 3.0 * found.weighted_rms_se_percent;
    Outcome {
        truth: if own {
            found.values.clone()
        } else {
            Vec::new()
        },
        means_off: means_off.max(0.0),
        result,
    }
}

/// All of them, one fit each.
pub(crate) fn rows() -> Vec<Row> {
    let tile = twill();
    let truth = parameters(crate::material("twill"));
    let all = plan(|_| true);
    let grazing = |c: &Configuration| c.light.theta.to_degrees() > 79.0;
    let right = scene(&tile, khungurn());
    let two_models = per_system(khungurn()).unwrap();
    let both = [truth.clone(), parameters(WEFT)];
    let both = both.iter().flat_map(Parameters::values).copied().collect();
    let both = Parameters::defaults(two_models).with_values(both);
    let two = scene(&tile, two_models);
    let seed = crate::seed(950);
    let changed = |radius: f64, height: f64| {
        let mut tile = tile.clone();
        for s in &mut tile.segments {
            s.radius *= radius;
            s.start.z *= height;
            s.end.z *= height;
        }
        tile
    };
    let cases = [
        ("cloth: nothing wrong", (&right, &truth, &tile, &all)),
        (
            "cloth: only 80 degrees",
            (&right, &truth, &tile, &plan(grazing)),
        ),
        (
            "cloth: no 80 degrees",
            (&right, &truth, &tile, &plan(|c| !grazing(c))),
        ),
        (
            "cloth: fibers believed 10 % too thick",
            (&right, &truth, &changed(1.1, 1.0), &all),
        ),
        (
            "cloth: believed 10 % too flat",
            (&right, &truth, &changed(1.0, 0.9), &all),
        ),
        (
            "cloth: warp and weft differ, one set fitted",
            (&two, &both, &tile, &all),
        ),
    ];
    let row = |(name, (cloth, truth, believed, poses)): (
        &str,
        (&FiberScene, &Parameters, &FiberTile, &Vec<Configuration>),
    )| Row {
        name: name.to_owned(),
        fits: vec![judge(&outcome(cloth, truth, believed, poses, seed))],
    };
    cases.into_iter().map(row).collect()
}
