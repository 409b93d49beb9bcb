//! Sessions that calibrations are made from.

use super::script::{Script, Step};
use super::{Purpose, Setup, colors, plan, true_white};
use goniofit::math::PolarDirection;
use goniofit::rig::{Camera, VirtualCamera};
use goniofit::session::{Configuration, FrameKind, SessionFolder};
use std::path::Path;

/// Level of the flats and of the chart, of full scale in the brightest channel.
const FLAT_LEVEL: f64 = 0.4;

fn head_on(id: u32) -> Configuration {
    Configuration {
        id,
        light: PolarDirection::from_degrees(32.0, 180.0),
        camera: PolarDirection::from_degrees(0.0, 0.0),
        rotation: 0.0,
    }
}

/// The exposure at which the brightest channel of a uniform thing of this radiance reaches a fraction of full scale,
/// milliseconds, to three digits.
pub fn exposure_for(setup: &Setup, radiance: [f64; 3], fraction: f64) -> f64 {
    let sensor = &setup.sensor;
    let full = f64::from(sensor.white) - sensor.black[0];
    let rates = [0, 1, 2].map(|c| sensor.responsivity[c] * radiance[c]);
    let exposure_ms = fraction * full / rates.into_iter().fold(0.0, f64::max);
    let digit = 10_f64.powf(2.0 - exposure_ms.log10().floor());
    (exposure_ms * digit).round() / digit
}

fn white_radiance() -> [f64; 3] {
    goniofit::rig::white_radiance(&true_white())
}

/// Records a script with one camera.
fn record(
    root: &Path,
    setup: &Setup,
    purpose: Purpose,
    configurations: Vec<Configuration>,
    script: &Script,
) -> SessionFolder {
    let mut camera = setup.camera(purpose, &setup.sensor);
    record_with(root, setup, &mut camera, configurations, script)
}

fn record_with(
    root: &Path,
    setup: &Setup,
    camera: &mut VirtualCamera,
    configurations: Vec<Configuration>,
    script: &Script,
) -> SessionFolder {
    let manifest = setup.manifest();
    script.record(root, &manifest, &plan(configurations), |shot, _, _| {
        camera.expose(shot).unwrap()
    })
}

/// Darks at many exposures.
pub fn darks(root: &Path, setup: &Setup, exposures_ms: &[f64], repeats: u32) -> SessionFolder {
    let mut script = Script::new();
    let pose = true_white().configuration;
    script.shots(FrameKind::Dark, &pose, exposures_ms, repeats);
    record(root, setup, Purpose::Dark, vec![head_on(1)], &script)
}

/// The white panel at exposures 1 : 2 : 4 : ... from 1 to 120 percent of full scale, so many frames of each, with darks of
/// their own; after every exposure the reference is visited, when `visits`.
pub fn linearity(root: &Path, setup: &Setup, repeats: u32, visits: bool) -> SessionFolder {
    let pose = true_white().configuration;
    let longest = exposure_for(setup, white_radiance(), 1.2);
    let mut exposures_ms: Vec<f64> = (0..7).map(|k| longest / f64::from(1 << k)).collect();
    // Closer steps up to the white level.
    exposures_ms.extend([0.375, 0.55, 0.62, 0.7].map(|part| part * longest));
    exposures_ms.sort_by(f64::total_cmp);
    let mut script = Script::new();
    script.shots(FrameKind::Dark, &pose, &exposures_ms, 2);
    for exposure_ms in exposures_ms {
        script.shots(FrameKind::White, &pose, &[exposure_ms], repeats);
        if visits {
            script.visit(&pose, &setup.reference_exposures_ms);
        }
    }
    record(root, setup, Purpose::Linearity, vec![head_on(1)], &script)
}

/// Flats of one exposure with their darks.
pub fn flats(root: &Path, setup: &Setup, frames: u32, darks: u32) -> SessionFolder {
    let pose = head_on(1);
    let exposure_ms = [exposure_for(setup, [1.0; 3], FLAT_LEVEL)];
    let mut script = Script::new();
    script.shots(FrameKind::Dark, &pose, &exposure_ms, darks);
    script.shots(FrameKind::Flat, &pose, &exposure_ms, frames);
    record(root, setup, Purpose::Flat, vec![pose], &script)
}

/// The white standard at the reference geometry.
pub fn white(root: &Path, setup: &Setup, repeats: u32) -> SessionFolder {
    let pose = true_white().configuration;
    let exposures_ms = [0.3, 0.6].map(|f| exposure_for(setup, white_radiance(), f));
    let mut script = Script::new();
    script.shots(FrameKind::Dark, &pose, &exposures_ms, 3);
    script.shots(FrameKind::White, &pose, &exposures_ms, repeats);
    record(root, setup, Purpose::White, vec![head_on(1)], &script)
}

/// Visits of the reference over an hour, the lamp's level at time t (seconds) being `law(t)`.
pub fn drift(
    root: &Path,
    setup: &Setup,
    visits: u32,
    law: impl Fn(f64) -> [f64; 3] + Send + Sync + 'static,
) -> SessionFolder {
    let pose = true_white().configuration;
    let exposures_ms = &setup.reference_exposures_ms;
    let mut script = Script::new();
    script.shots(FrameKind::Dark, &pose, exposures_ms, 3);
    let wait_s = 3600.0 / f64::from(visits);
    for _ in 0..visits {
        script.visit(&pose, exposures_ms);
        script
            .steps
            .push(Step::Wait(wait_s - exposures_ms.len() as f64));
    }
    let first_s = (3 * exposures_ms.len()) as f64;
    let per_visit = exposures_ms.len() as u32;
    let mut shots = 0;
    let lamp = move |_: &goniofit::rig::Shot| {
        let (visit, frame) = (shots / per_visit, shots % per_visit);
        shots += 1;
        law(first_s + wait_s * f64::from(visit) + f64::from(frame))
    };
    let mut camera = setup
        .camera(Purpose::Drift, &setup.sensor)
        .with_lamp(Box::new(lamp));
    record_with(root, setup, &mut camera, vec![head_on(1)], &script)
}

/// Where the board is photographed: polar angle of the camera and turntable angle, degrees.
pub const BOARD_POSES: [(f64, f64); 9] = [
    (0.0, 0.0),
    (0.0, 90.0),
    (20.0, 0.0),
    (30.0, 90.0),
    (40.0, 0.0),
    (45.0, 90.0),
    (50.0, 0.0),
    (60.0, 0.0),
    (65.0, 90.0),
];

/// The checkerboard at many camera poses, two frames each, with darks.
pub fn board(root: &Path, setup: &Setup) -> SessionFolder {
    let poses = BOARD_POSES.iter().zip(1..);
    let poses: Vec<Configuration> = poses
        .map(|(&(theta, rotation), id)| Configuration {
            camera: PolarDirection::from_degrees(theta, 0.0),
            rotation: f64::to_radians(rotation),
            ..head_on(id)
        })
        .collect();
    let exposure_ms = [exposure_for(setup, [0.8; 3], FLAT_LEVEL)];
    let mut script = Script::new();
    script.shots(FrameKind::Dark, &poses[0], &exposure_ms, 2);
    for pose in &poses {
        script.shots(FrameKind::Board, pose, &exposure_ms, 2);
    }
    record(root, setup, Purpose::Board, poses, &script)
}

/// The color chart under normal view, with darks, and the white standard in its place; what its patches are is
/// [`colors::patches`] of the setup's seed.
pub fn chart(root: &Path, setup: &Setup, repeats: u32) -> (SessionFolder, Vec<colors::Patch>) {
    let pose = head_on(1);
    let exposure_ms = [exposure_for(setup, [0.9; 3], FLAT_LEVEL)];
    let white = true_white().configuration;
    let mut script = Script::new();
    script.shots(FrameKind::Dark, &pose, &exposure_ms, 2);
    script.shots(FrameKind::White, &white, &exposure_ms, repeats);
    script.shots(FrameKind::Chart, &pose, &exposure_ms, repeats);
    let session = record(root, setup, Purpose::Chart, vec![pose], &script);
    (session, colors::patches(setup.seed))
}
