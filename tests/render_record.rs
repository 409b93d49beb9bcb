//! Promise: recorded paths give at their own parameters what was traced, near them what tracing would give within stated
//! errors, and farther away a verdict that says they should not be believed.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

#[path = "common/render_scenes.rs"]
mod render_scenes;

use glam::DVec3;
use goniofit::base::{Result, Unwatched};
use goniofit::fit::RenderPair;
use goniofit::math::statistics::sidak_level;
use goniofit::math::{PolarDirection, Random};
use goniofit::render::{
    Effort, Estimate, Estimates, FiberScene, FiberSceneOptions, LightShape, Plate, RecordOptions,
    Recording, Request, Scene, TRUST_THRESHOLD,
};
use goniofit::scatter::{
    Evaluation, Khungurn, Model, Outgoing, ParameterInfo, Parameters, Parametric, Sampled,
    Scattering,
};
use goniofit::session::Configuration;
use render_scenes::felt;

fn seed() -> u64 {
    std::env::var("SEED").map_or(2015, |s| s.parse().unwrap())
}

/// A wide lamp, so that paths arrive on it as well as connect to it.
fn scene(model: &'static dyn Model, plate: Plate) -> FiberScene {
    let options = FiberSceneOptions {
        light: LightShape {
            side: 400.0,
            distance: 610.0,
        },
        plate,
        ..FiberSceneOptions::default()
    };
    FiberScene::new(&felt(60, 0.2), model, options).unwrap()
}

/// Two cameras, one with two lamps.
fn poses() -> Vec<Configuration> {
    let pose = |id, light: (f64, f64), camera| Configuration {
        id,
        light: PolarDirection::from_degrees(light.0, light.1),
        camera: PolarDirection::from_degrees(camera, 0.0),
        rotation: 0.0,
    };
    vec![
        pose(1, (32.0, 180.0), 32.0),
        pose(2, (50.0, 90.0), 32.0),
        pose(3, (60.0, 170.0), 60.0),
    ]
}

fn parameters(flat_deg: [f64; 9]) -> Parameters {
    let values = flat_deg.iter().enumerate();
    let values = values.map(|(i, v)| if i < 6 { *v } else { v.to_radians() });
    Parameters::defaults(&Khungurn).with_values(values.collect())
}

/// Khungurn 2015 Table IV, fibers: Gabardine, with wider lobes so that small scenes need few paths.
fn cloth() -> Parameters {
    parameters([0.185, 0.047, 0.069, 0.95, 0.330, 0.354, 5.0, 15.0, 25.0])
}

/// All widths times `widths`, logits of all colors plus `logit`.
fn moved(at: &Parameters, widths: f64, logit: f64) -> Parameters {
    let values = at.values().iter().enumerate().map(|(slot, &v)| {
        if slot < 6 {
            1.0 / (1.0 + (-logit).exp() * (1.0 - v) / v)
        } else {
            v * widths
        }
    });
    at.with_values(values.collect())
}

fn request<'a>(poses: &'a [Configuration], at: &'a Parameters, paths: u64) -> Request<'a> {
    Request {
        configurations: poses,
        parameters: at,
        effort: Effort::Paths(paths),
        seed: seed(),
        stream: 0,
    }
}

fn plain() -> RecordOptions {
    RecordOptions {
        defensive: 0.0,
        ..RecordOptions::default()
    }
}

fn record(scene: &FiberScene, at: &Parameters, paths: u64, options: &RecordOptions) -> Recording {
    let poses = poses();
    scene
        .record(&request(&poses, at, paths), options, &Unwatched)
        .unwrap()
}

/// Traced with other random numbers than [`record`].
fn fresh(scene: &FiberScene, at: &Parameters, paths: u64) -> Estimates {
    let poses = poses();
    let request = Request {
        stream: 99,
        ..request(&poses, at, paths)
    };
    scene.estimate(&request, &Unwatched).unwrap()
}

/// The two-sided normal limit for `n` tests at family-wise level 1e-3, by bisection.
fn limit(n: usize) -> f64 {
    let level = sidak_level(1e-3, n);
    let (mut low, mut high) = (0.0, 20.0);
    for _ in 0..80 {
        let middle: f64 = 0.5 * (low + high);
        if libm::erfc(middle / 2.0_f64.sqrt()) > level {
            low = middle
        } else {
            high = middle
        }
    }
    low
}

/// Every number of an estimate with its standard error: means, then derivatives.
fn numbers(e: &Estimate) -> impl Iterator<Item = (f64, f64)> {
    let means = e.mean.iter().zip(&e.standard_error);
    let slopes = e
        .derivative
        .iter()
        .flatten()
        .zip(e.derivative_se.iter().flatten());
    means.chain(slopes).map(|(x, se)| (*x, *se))
}

/// Largest difference in standard errors over all means (and derivatives).
fn worst_z(a: &Estimates, b: &Estimates, derivatives: bool) -> f64 {
    let pairs = a.configurations.iter().zip(&b.configurations);
    let kept = if derivatives { usize::MAX } else { 3 };
    pairs
        .flat_map(|(a, b)| numbers(a).zip(numbers(b)).take(kept))
        .map(|((x, s), (y, t))| {
            let se = s.hypot(t);
            if se > 0.0 { (x - y).abs() / se } else { 0.0 }
        })
        .fold(0.0, f64::max)
}

/// Largest difference of all numbers and standard errors, relative to the mean per published range of the parameter.
fn largest_difference(a: &Estimates, b: &Estimates) -> f64 {
    let mut largest = 0.0_f64;
    for (a, b) in a.configurations.iter().zip(&b.configurations) {
        assert_eq!((a.config, a.paths), (b.config, b.paths));
        let brightness = b.mean.iter().fold(0.0_f64, |m, x| m.max(*x));
        for ((x, s), (y, t)) in numbers(a).zip(numbers(b)) {
            let scale = brightness.max(y.abs());
            largest = largest
                .max((x - y).abs() / scale)
                .max((s - t).abs() / scale.max(t));
        }
    }
    largest
}

#[test]
fn at_its_own_parameters_a_recording_gives_what_was_traced() {
    // The same paths, so only the rounding of f32 differs: 2e-6 with derivatives. Black extremes: a channel without
    // transmission, one without reflection, one almost without either.
    let extremes = parameters([0.0, 0.5, 0.001, 0.001, 0.0, 0.0, 10.0, 20.0, 30.0]);
    let white = parameters([0.9, 0.5, 0.0, 1.0, 1.0, 1.0, 3.0, 12.0, 20.0]);
    let grey = Plate::Diffuse([0.2, 0.5, 0.8]);
    let poses = poses();
    for plate in [Plate::Black, Plate::Open, grey] {
        let scene = scene(&Khungurn, plate);
        for at in [cloth(), extremes.clone(), white.clone()] {
            let request = request(&poses, &at, 3000);
            let traced = scene.estimate(&request, &Unwatched).unwrap();
            let recording = scene.record(&request, &plain(), &Unwatched).unwrap();
            let recalled = recording.estimate(&at).unwrap();
            let difference = largest_difference(&recalled.estimates, &traced);
            println!("{plate:?}: largest difference {difference:.1e}");
            assert!(
                difference < 2e-6,
                "{plate:?} {}: {difference:e}",
                at.to_json()
            );
            assert!(
                recalled.trust.least_ratio() > 0.999999,
                "{:?}",
                recalled.trust
            );
            let means = recording.means(&at).unwrap().estimates;
            for (a, b) in means
                .configurations
                .iter()
                .zip(&recalled.estimates.configurations)
            {
                assert!((0..3).all(|c| (a.mean[c] / b.mean[c] - 1.0).abs() < 1e-6));
            }
            // Negative control: a width moved by 1e-4 of itself is seen.
            let mut values = at.values().to_vec();
            values[7] *= 1.0 + 1e-4;
            let other = recording
                .estimate(&at.with_values(values))
                .unwrap()
                .estimates;
            assert!(largest_difference(&other, &traced) > 2e-6);
        }
    }
}

/// Khungurn's model without its kernel.
struct Kernelless;

/// A scattering function without its kernel.
struct Bare(Box<dyn Scattering>);

impl Scattering for Bare {
    fn evaluate(&self, wi: DVec3, wo: DVec3, h: f64) -> Evaluation {
        self.0.evaluate(wi, wo, h)
    }
    fn importance(&self, wi: DVec3, o: &Outgoing) -> ([f64; 3], f64) {
        self.0.importance(wi, o)
    }
    fn sample(&self, o: &Outgoing, random: &mut Random) -> Option<Sampled> {
        self.0.sample(o, random)
    }
    fn light_points(&self, wi: DVec3, o: &Outgoing, half_angle: f64) -> usize {
        self.0.light_points(wi, o, half_angle)
    }
}

impl Parametric for Kernelless {
    fn name(&self) -> &'static str {
        "kernelless"
    }

    fn parameters(&self) -> &'static [ParameterInfo] {
        Khungurn.parameters()
    }
}

impl Model for Kernelless {
    fn prepare(&self, parameters: &Parameters) -> Result<Box<dyn Scattering>> {
        Ok(Box::new(Bare(Khungurn.prepare(parameters)?)))
    }
}

#[test]
fn a_model_without_a_kernel_is_recorded_too() {
    let at = cloth();
    let there = moved(&at, 1.1, 0.3);
    let own = record(&scene(&Khungurn, Plate::Black), &at, 2000, &plain());
    let general = record(&scene(&Kernelless, Plate::Black), &at, 2000, &plain());
    let [own, general] = [own, general].map(|r| r.estimate(&there).unwrap().estimates);
    let difference = largest_difference(&own, &general);
    assert!(difference < 1e-5, "{difference:e}");
}

#[test]
fn derivatives_of_a_recording_are_those_of_its_means() {
    // Five-point differences in steps of 2 % (1 % of a color's distance to 0 or 1): their truncation and the rounding of
    // f32 leave 2e-5 of the mean per parameter's size (limit 4e-5). All nine parameters, away from the recording's own point.
    let at = cloth();
    let grey = Plate::Diffuse([0.2, 0.5, 0.8]);
    let recording = record(
        &scene(&Khungurn, grey),
        &at,
        4000,
        &RecordOptions::default(),
    );
    let there = moved(&at, 1.07, 0.2);
    let exact = recording.estimate(&there).unwrap().estimates;
    let mut caught = 0;
    for (slot, (row, only)) in there.places().into_iter().enumerate() {
        let value = there.values()[slot];
        let h = if slot < 6 {
            0.01 * value.min(1.0 - value)
        } else {
            0.02 * value
        };
        let means = |k: f64| {
            let mut values = there.values().to_vec();
            values[slot] += k * h;
            recording
                .means(&there.with_values(values))
                .unwrap()
                .estimates
                .configurations
        };
        let at = [-2.0, -1.0, 1.0, 2.0].map(means);
        for (i, e) in exact.configurations.iter().enumerate() {
            let channels = if slot < 6 { only..only + 1 } else { 0..3 };
            for c in channels {
                let m = |k: usize| at[k][i].mean[c];
                let difference = (m(0) - m(3) + 8.0 * (m(2) - m(1))) / (12.0 * h);
                let found = e.derivative[row][c];
                let scale = found.abs() + e.mean[c] / value;
                let error = (found - difference).abs() / scale;
                assert!(
                    error < 4e-5,
                    "{row} {c}: {found} against {difference}, {error:e}"
                );
                // Negative control: off by a five hundredth.
                caught += usize::from((1.002 * found - difference).abs() > 4e-5 * scale);
            }
        }
    }
    assert!(caught > 30, "{caught}");
}

#[test]
fn near_its_parameters_a_recording_agrees_with_tracing() {
    // 4 moves, each 3 poses x 18 numbers, at family-wise 1e-3; standard errors near 1 % see a fault of about 6 %.
    let scene = scene(&Khungurn, Plate::Black);
    let at = cloth();
    let moves = [(1.15, 0.0), (0.85, 0.0), (1.0, 0.7), (1.0, -0.7)];
    let bound = limit(moves.len() * 3 * 18);
    let recording = record(&scene, &at, 60_000, &RecordOptions::default());
    let stale = recording.estimate(&at).unwrap().estimates;
    for (widths, logit) in moves {
        let there = moved(&at, widths, logit);
        let recalled = recording.estimate(&there).unwrap();
        let traced = fresh(&scene, &there, 60_000);
        let z = worst_z(&recalled.estimates, &traced, true);
        let stale = worst_z(&stale, &traced, true);
        println!(
            "widths x {widths}, logit + {logit}: ratio {:.2}, worst z {z:.1} (not moved: {stale:.1})",
            recalled.trust.least_ratio()
        );
        assert!(
            recalled.trust.holds(TRUST_THRESHOLD),
            "{:?}",
            recalled.trust
        );
        assert!(z < bound, "widths x {widths}, logit + {logit}: {z}");
        // Negative control: the numbers of the recording's own parameters.
        assert!(stale > bound, "widths x {widths}, logit + {logit}: {stale}");
    }
}

#[test]
fn far_away_a_recording_is_wrong_and_says_so() {
    // Narrow lobes seen at three times their width: the paths that would matter were hardly ever drawn.
    let scene = scene(&Khungurn, Plate::Black);
    let at = parameters([0.185, 0.047, 0.069, 0.95, 0.330, 0.354, 2.0, 10.0, 10.0]);
    let recording = record(&scene, &at, 30_000, &plain());
    let there = moved(&at, 3.0, 0.0);
    let recalled = recording.estimate(&there).unwrap();
    let traced = fresh(&scene, &there, 60_000);
    let pairs = recalled
        .estimates
        .configurations
        .iter()
        .zip(&traced.configurations);
    let wrong = pairs
        .flat_map(|(a, b)| (0..3).map(|c| (a.mean[c] - b.mean[c]).abs() / a.standard_error[c]))
        .fold(0.0, f64::max);
    println!("wrong by {wrong:.1} stated errors, {:?}", recalled.trust);
    assert!(wrong > 5.0, "{wrong}");
    assert!(
        !recalled.trust.holds(TRUST_THRESHOLD),
        "{:?}",
        recalled.trust
    );
    assert!(
        recording
            .estimate(&at)
            .unwrap()
            .trust
            .holds(TRUST_THRESHOLD)
    );
}

/// Draws as [`goniofit::scatter::Defensive`] does but says the density of the narrow lobes alone: the fault to be caught.
struct WrongDensity;

struct Wrong {
    at: Box<dyn Scattering>,
    wide: Box<dyn Scattering>,
}

impl Scattering for Wrong {
    fn evaluate(&self, wi: DVec3, wo: DVec3, h: f64) -> Evaluation {
        self.at.evaluate(wi, wo, h)
    }
    fn importance(&self, wi: DVec3, o: &Outgoing) -> ([f64; 3], f64) {
        self.at.importance(wi, o)
    }
    fn sample(&self, o: &Outgoing, random: &mut Random) -> Option<Sampled> {
        if random.uniform() >= 0.1 {
            return self.at.sample(o, random);
        }
        let wi = self.wide.sample(o, random)?.wi;
        let (value, pdf) = self.at.importance(wi, o);
        let factor = wi.y.hypot(wi.z) / pdf;
        Some(Sampled {
            wi,
            weight: value.map(|s| s * factor),
            pdf,
        })
    }
}

impl Parametric for WrongDensity {
    fn name(&self) -> &'static str {
        "wrong density"
    }

    fn parameters(&self) -> &'static [ParameterInfo] {
        Khungurn.parameters()
    }
}

impl Model for WrongDensity {
    fn prepare(&self, parameters: &Parameters) -> Result<Box<dyn Scattering>> {
        Ok(Box::new(Wrong {
            at: Khungurn.prepare(parameters)?,
            wide: Khungurn.prepare(&Khungurn.widened(parameters, 1.5))?,
        }))
    }
}

#[test]
fn defensive_sampling_is_unbiased() {
    // 3 poses x 18 numbers at family-wise 1e-3; standard errors near 1 % see a bias of about 5 %.
    let at = cloth();
    let bound = limit(3 * 18);
    let right = scene(&Khungurn, Plate::Black);
    let traced = fresh(&right, &at, 60_000);
    let recalled = record(&right, &at, 60_000, &RecordOptions::default())
        .estimate(&at)
        .unwrap();
    let z = worst_z(&recalled.estimates, &traced, true);
    assert!(z < bound, "{z}");
    let wrong = fresh(&scene(&WrongDensity, Plate::Black), &at, 60_000);
    let caught = worst_z(&wrong, &traced, true);
    println!("worst z {z:.1}; with the wrong density {caught:.1}");
    assert!(caught > bound, "{caught}");
}

#[test]
fn defensive_sampling_extends_the_reach_to_larger_widths() {
    // The scatter of 60 recordings' means about their mean, at widths half as large again, with and without it.
    let scene = scene(&Khungurn, Plate::Black);
    let at = cloth();
    let there = moved(&at, 1.5, 0.0);
    let truth = fresh(&scene, &there, 200_000);
    let poses = poses();
    let error = |defensive: f64| {
        let options = RecordOptions {
            defensive,
            ..RecordOptions::default()
        };
        let mut square = 0.0;
        for stream in 0..60 {
            let request = Request {
                stream,
                ..request(&poses, &at, 4000)
            };
            let recording = scene.record(&request, &options, &Unwatched).unwrap();
            let found = recording.means(&there).unwrap().estimates;
            for (a, b) in found.configurations.iter().zip(&truth.configurations) {
                square += (0..3)
                    .map(|c| (a.mean[c] / b.mean[c] - 1.0).powi(2))
                    .sum::<f64>();
            }
        }
        (square / (60.0 * 9.0)).sqrt()
    };
    let (without, with) = (error(0.0), error(0.1));
    println!("rms error at widths x 1.5: {without:.3} without, {with:.3} with defensive sampling");
    assert!(with < 0.9 * without, "{with} {without}");
}

#[test]
fn a_recording_over_its_budget_is_refused() {
    let scene = scene(&Khungurn, Plate::Black);
    let (at, poses) = (cloth(), poses());
    let fits = record(&scene, &at, 3000, &plain());
    let options = |budget| RecordOptions { budget, ..plain() };
    let asked = request(&poses, &at, 3000);
    assert!(
        scene
            .record(&asked, &options(fits.bytes()), &Unwatched)
            .is_ok()
    );
    let refused = scene.record(&asked, &options(fits.bytes() - 1), &Unwatched);
    let report = refused.unwrap_err().report();
    assert!(
        report.contains("budget") && report.contains("hint: record fewer paths"),
        "{report}"
    );
    for wrong in [
        RecordOptions {
            defensive: 1.0,
            ..plain()
        },
        RecordOptions {
            defensive: f64::NAN,
            ..plain()
        },
        RecordOptions {
            widening: 0.5,
            ..plain()
        },
    ] {
        let report = scene
            .record(&asked, &wrong, &Unwatched)
            .unwrap_err()
            .report();
        assert!(report.contains("expected"), "{report}");
    }
    let meaningless = at.with_values(vec![2.0; 9]);
    assert!(fits.estimate(&meaningless).is_err());
}

#[test]
fn threads_do_not_change_a_recording() {
    let scene = scene(&Khungurn, Plate::Black);
    let (at, there) = (cloth(), moved(&cloth(), 1.1, 0.1));
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| {
            let recalled = record(&scene, &at, 3000, &RecordOptions::default()).estimate(&there);
            let recalled = recalled.unwrap();
            (recalled.estimates.configurations, recalled.trust)
        })
    };
    assert_eq!(on(1), on(3));
}

#[test]
fn two_recordings_make_a_render_pair() {
    // Their differences are as large as independent errors make them: sum of 9 squared z between 1 and 40 (chi-square with
    // correlated channels), where equal streams give 0.
    let scene = scene(&Khungurn, Plate::Black);
    let (at, poses) = (cloth(), poses());
    let asked = request(&poses, &at, 8000);
    let pair = Recording::pair(&scene, &asked, &RecordOptions::default(), &Unwatched).unwrap();
    let there = moved(&at, 1.05, 0.1);
    let render = RenderPair::render(&pair, &poses, &there, &Effort::Paths(1), 7, 3, &Unwatched);
    let sum: f64 = render
        .unwrap()
        .estimates()
        .flat_map(|[a, b]| {
            let z =
                |c: usize| (a.mean[c] - b.mean[c]) / a.standard_error[c].hypot(b.standard_error[c]);
            [0, 1, 2].map(z)
        })
        .map(|z| z * z)
        .sum();
    assert!((1.0..40.0).contains(&sum), "{sum}");
    assert!(pair.trust(&there).unwrap().holds(TRUST_THRESHOLD));
    let fewer = RenderPair::render(
        &pair,
        &poses[..2],
        &there,
        &Effort::Paths(1),
        7,
        3,
        &Unwatched,
    );
    assert!(fewer.unwrap_err().report().contains("other configurations"));
}
