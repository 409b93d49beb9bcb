//! The published binary search for microflakes: on a scene in closed form, and on a volume; what it cannot do is refused.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

#[path = "common/render_scenes.rs"]
mod render_scenes;
#[path = "common/volumes.rs"]
mod volumes;

use glam::DVec3;
use goniofit::base::{Result, Unwatched, Watch};
use goniofit::fit::{Budget, FitResult, Loss, Method, Options, fit};
use goniofit::math::Random;
use goniofit::render::{
    Effort, Estimate, Estimates, FiberSceneOptions, Integrator, Request, Scene,
};
use goniofit::scatter::media::{self, MediumModel};
use goniofit::scatter::{Parameters, Parametric};
use goniofit::session::{Configuration, Intensity, Measurements};
use render_scenes::{WIDE, pose, seed};
use volumes::{Volume, medium, slab};

/// Eight poses in closed form, bright in proportion to the albedo, the less different the wider the flakes.
struct ClosedForm(&'static dyn MediumModel);

/// How much of a pose is highlight.
const HIGHLIGHT: [f64; 8] = [0.9, 0.5, 0.1, -0.2, 0.3, -0.1, 0.2, -0.3];

/// Mean and derivatives by albedo and by gamma.
fn closed_form(pose: usize, albedo: f64, gamma: f64) -> [f64; 3] {
    let share = 0.4 + 0.1 * HIGHLIGHT[pose] * (1.5 / gamma).ln();
    let slope = -0.1 * HIGHLIGHT[pose] / gamma;
    [albedo * share, share, albedo * slope]
}

impl Scene for ClosedForm {
    fn model(&self) -> &'static dyn Parametric {
        self.0
    }

    fn estimate(&self, request: &Request<'_>, _: &dyn Watch) -> Result<Estimates> {
        let Effort::Total { paths, .. } = request.effort else {
            unreachable!("fits state their paths")
        };
        let noise = 0.3 / (paths as f64 / 8.0).sqrt();
        let (albedo, gamma) = (
            request.parameters.channels("albedo"),
            request.parameters.scalar("gamma"),
        );
        let one = |(k, c): (usize, &Configuration)| {
            let mut random = Random::keyed(&[request.seed, request.stream, k as u64]);
            let exact = albedo.map(|a| closed_form(k, a, gamma));
            Estimate {
                config: c.id,
                mean: exact.map(|[mean, ..]| mean * (1.0 + noise * random.normal())),
                standard_error: exact.map(|[mean, ..]| mean * noise),
                derivative: vec![exact.map(|[_, a, _]| a), exact.map(|[_, _, g]| g)],
                derivative_se: vec![[noise; 3]; 2],
                paths: paths / 8,
            }
        };
        Ok(Estimates {
            configurations: request.configurations.iter().enumerate().map(one).collect(),
            cpu_s: 1e-6 * paths as f64,
            wall_s: 1e-6 * paths as f64,
        })
    }
}

/// The first looks along the cloth against the light from `grazing_deg`.
fn poses(grazing_deg: f64) -> Vec<Configuration> {
    vec![
        pose(1, [grazing_deg, 180.0], [grazing_deg, 0.0]),
        pose(2, [20.0, 180.0], [30.0, 0.0]),
        pose(3, [45.0, 180.0], [30.0, 0.0]),
        pose(4, [60.0, 0.0], [30.0, 0.0]),
        pose(5, [45.0, 90.0], [30.0, 0.0]),
        pose(6, [70.0, 180.0], [65.0, 0.0]),
        pose(7, [70.0, 90.0], [65.0, 0.0]),
        pose(8, [80.0, 90.0], [80.0, 0.0]),
    ]
}

const ALBEDO: [f64; 3] = [0.8, 0.3, 0.6];
const GAMMA: f64 = 0.1;

/// The closed form at [`ALBEDO`] and [`GAMMA`], the first pose three times too bright.
fn measured(grazing_deg: f64) -> Measurements {
    let one = |(k, configuration): (usize, Configuration)| {
        let factor = if k == 0 { 3.0 } else { 1.0 };
        let mean = ALBEDO.map(|a| factor * closed_form(k, a, GAMMA)[0]);
        Intensity {
            configuration,
            mean,
            standard_error: mean.map(|m| 0.001 * m),
            present: [true; 3],
        }
    };
    Measurements {
        intensities: poses(grazing_deg)
            .into_iter()
            .enumerate()
            .map(one)
            .collect(),
    }
}

fn options(paths: u64) -> Options {
    let budget = Budget {
        paths: Some(paths),
        ..Budget::default()
    };
    Options {
        method: Method::BinarySearch,
        ..Options::new(seed(71), budget)
    }
}

fn values(result: &FitResult) -> Vec<f64> {
    result.uncertainty.iter().map(|p| p.value).collect()
}

/// Brackets end 0.004 wide in albedo and 2 % in gamma, renders scatter by 0.2 %: 0.02 and 8 % off are seen. A grazing pose that is three
/// times too bright is left out; the control is the same brightness 10 degrees higher, where it counts.
#[test]
fn it_finds_the_flakes_whose_means_and_spread_are_measured() {
    let scene = ClosedForm(media::model("microflake").unwrap());
    let found = |grazing_deg| {
        fit(
            &scene,
            &measured(grazing_deg),
            &options(20_000_000),
            &Unwatched,
        )
        .unwrap()
    };
    let off = |found: &[f64]| {
        let albedo = |c: usize| (found[c] - ALBEDO[c]).abs() / 0.02;
        let gamma = (found[3] / GAMMA).ln().abs() / 0.08;
        (0..3).map(albedo).fold(gamma, f64::max)
    };
    let result = found(80.0);
    println!("{:?}: {}", values(&result), result.reason);
    assert!(off(&values(&result)) < 1.0, "{:?}", values(&result));
    assert_eq!(
        (result.history.len(), &*result.method),
        (27, "binary-search")
    );
    for said in [
        "27 of 27",
        "without the grazing 1",
        "no pixels were measured",
    ] {
        assert!(result.reason.contains(said), "{said}: {}", result.reason);
    }
    let control = values(&found(70.0));
    assert!(off(&control) > 3.0, "{control:?}");
}

#[test]
fn what_it_cannot_do_is_refused() {
    let flakes = ClosedForm(media::model("microflake").unwrap());
    let refused =
        |scene: &dyn Scene, measurements: &Measurements, options: &Options, fault: &str| {
            let error = fit(scene, measurements, options, &Unwatched).unwrap_err();
            assert!(
                error.report().contains(fault),
                "{fault}: {}",
                error.report()
            );
        };
    let (all, good) = (measured(80.0), options(20_000_000));
    let lobes = ClosedForm(media::model("khungurn-volume").unwrap());
    refused(&lobes, &all, &good, "has no parameter gamma");
    let huber = Options {
        loss: Loss::Huber(2.0),
        ..options(20_000_000)
    };
    refused(&flakes, &all, &huber, "neither a gain nor another loss");
    refused(&flakes, &all, &options(10_000), "do not hold the schedule");
    let grazing = Measurements {
        intensities: all.intensities[..1].to_vec(),
    };
    refused(&flakes, &grazing, &good, "two configurations or more");
}

/// Flakes in a slab of aligned fibers, where the spread between poses does not fall with gamma all the way, as the search takes
/// for granted: it goes astray, and the fit says so. Pixels of a weave, which the published search looks at, are not in the data.
#[test]
fn where_the_spread_rises_with_gamma_it_goes_astray_and_says_so() {
    let file = r#"{"albedo": [0.6, 0.9, 0.3], "gamma": 0.3}"#;
    let (model, truth) = medium("microflake", file);
    let tile = slab(8, 0.02, 0.6, DVec3::new(0.9, 0.3, 0.3).normalize());
    let volume = Volume {
        tile: &tile,
        density: 40.0,
        options: FiberSceneOptions {
            light: WIDE,
            ..FiberSceneOptions::default()
        },
        medium: (model, truth.clone()),
    };
    let rendered = |at: &Parameters| {
        let volume = Volume {
            medium: (model, at.clone()),
            options: volume.options,
            ..volume
        };
        let effort = Effort::Paths(20_000);
        volume.render(Integrator::Fast, &poses(80.0), effort, seed(72))
    };
    let gammas = [0.01, 0.03, 0.1, 0.3, 1.0];
    let spreads = gammas.map(|gamma| {
        let mut values = truth.values().to_vec();
        values[3] = gamma;
        let poses = rendered(&truth.with_values(values));
        let of = |c: usize| {
            let mean = poses[1..].iter().map(|e| e.mean[c]).sum::<f64>() / 7.0;
            poses[1..]
                .iter()
                .map(|e| (e.mean[c] - mean).powi(2))
                .sum::<f64>()
                / 6.0
        };
        (of(0) + of(1) + of(2)).sqrt()
    });
    println!("spread by gamma {gammas:?}: {spreads:?}");
    let intensity = |(configuration, e): (Configuration, Estimate)| Intensity {
        configuration,
        mean: e.mean,
        standard_error: e.standard_error,
        present: [true; 3],
    };
    let pairs = poses(80.0).into_iter().zip(rendered(&truth));
    let measurements = Measurements {
        intensities: pairs.map(intensity).collect(),
    };
    let scene = volume.scene(Integrator::Fast);
    let result = fit(&scene, &measurements, &options(2_000_000), &Unwatched).unwrap();
    println!("{:?}: {}", values(&result), result.reason);
    println!("residual {} %", result.objective.misfit_percent);
    assert!(spreads[2] > spreads[1] && spreads[4] < spreads[3]);
    assert!(!result.converged, "{}", result.reason);
    assert!(result.objective.misfit_percent > 20.0);
}
