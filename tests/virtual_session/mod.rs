//! Small sessions photographed by the virtual camera, with their truth: measurements, and what calibrations are made from.
#![allow(dead_code, unreachable_pub, missing_docs, clippy::unwrap_used)]

use goniofit::math::{PolarDirection, Random};
use goniofit::measure::calibration::PoseErrors;
use goniofit::rig::virtual_camera::{Misalignment, Stand};
use goniofit::rig::{Camera, SensorModel, VirtualCamera};
use goniofit::session::{
    CameraFacts, Configuration, FrameKind, Manifest, Plan, SessionFolder, WhiteReference,
};
use pictures::{Board, Chart, Cloth, Panel, Scene, lommel_seeliger};
use script::{Script, Step};
use std::f64::consts::TAU;
use std::path::Path;
use std::sync::{Arc, Mutex};

pub mod calibration;
pub mod chain;
pub mod colors;
pub mod faulty;
pub mod pictures;
pub mod pulls;
pub mod script;

/// How to make a session.
#[derive(Clone)]
pub struct Setup {
    pub sensor: SensorModel,
    /// The sensor while the darks are shot.
    pub dark_sensor: SensorModel,
    pub exposures_ms: Vec<f64>,
    pub dark_exposures_ms: Vec<f64>,
    /// Camera polar angle (degrees), rotation (degrees) and true mean of each configuration.
    pub poses: Vec<(f64, f64, [f64; 3])>,
    pub sample_repeats: u32,
    pub white_repeats: u32,
    pub dark_repeats: u32,
    pub grain: f64,
    /// The reference pose is visited at the beginning, after every so many sample shots, and at the end; 0 = never.
    pub reference_every: usize,
    pub reference_exposures_ms: Vec<f64>,
    pub reference_mean: [f64; 3],
    /// Stretches without a visit.
    pub unvisited: Vec<usize>,
    /// Sample shots before which the capture is interrupted and goes on.
    pub breaks: Vec<usize>,
    /// The lamp's brightness by time, 0 at the first shot after the whites and 1 at the last, and by stretch.
    pub lamp: Option<fn(f64, usize) -> [f64; 3]>,
    /// A monochrome camera's frames are shot through red, green and blue filters one after another.
    pub filters: bool,
    /// The white standard's true reflectance factor at the reference geometry.
    pub white_factor: [f64; 3],
    /// Standard error of the stated reflectance factor; the stated one is drawn around the true one.
    pub white_se: f64,
    /// What manifests state of the camera; none: the truth.
    pub stated: Option<CameraFacts>,
    /// How far things stand from where they were asked to be: standard deviations, one draw per pose, and one height
    /// for all.
    pub pose_sd: PoseErrors,
    /// The same for where the camera points, pixels.
    pub pointing_sd_px: [f64; 2],
    /// Bright spots on the cloth.
    pub glints: usize,
    /// Relative change of the flats' source per millimeter.
    pub flat_gradient: [f64; 2],
    pub seed: u64,
}

impl Setup {
    pub fn new(seed: u64) -> Self {
        let sensor = SensorModel {
            width: 100,
            height: 84,
            pixel_mm: 10.0 / 64.0,
            center_px: [49.3, 42.2],
            subsamples: 2,
            spacing_mm: 0.06,
            ..SensorModel::default()
        };
        Self {
            dark_sensor: sensor.clone(),
            sensor,
            exposures_ms: vec![4.0, 16.0, 64.0],
            dark_exposures_ms: vec![4.0, 16.0, 64.0],
            poses: vec![
                (0.0, 0.0, [0.9, 1.1, 0.7]),
                (48.0, 90.0, [0.3, 0.25, 0.2]),
                (64.0, 0.0, [0.02, 0.03, 0.015]),
                (80.0, 90.0, [0.5, 0.4, 0.45]),
            ],
            sample_repeats: 1,
            white_repeats: 2,
            dark_repeats: 3,
            grain: 0.5,
            reference_every: 0,
            reference_exposures_ms: vec![16.0],
            reference_mean: [0.6, 0.5, 0.55],
            unvisited: Vec::new(),
            breaks: Vec::new(),
            lamp: None,
            filters: false,
            white_factor: TRUE_WHITE,
            white_se: 0.003,
            stated: None,
            pose_sd: PoseErrors::default(),
            pointing_sd_px: [0.0; 2],
            glints: 0,
            flat_gradient: [0.0; 2],
            seed,
        }
    }

    pub fn configurations(&self) -> Vec<Configuration> {
        let poses = self.poses.iter().zip(1..);
        poses
            .map(|(&(theta, rotation, _), id)| Configuration {
                id,
                light: PolarDirection::from_degrees(32.0, 180.0),
                camera: PolarDirection::from_degrees(theta, 0.0),
                rotation: f64::to_radians(rotation),
            })
            .collect()
    }
}

pub const TRUE_WHITE: [f64; 3] = [1.02, 0.99, 0.96];
pub const SAMPLE_SQUARE_MM: f64 = 10.0;

pub fn true_white() -> WhiteReference {
    WhiteReference {
        configuration: Configuration {
            id: 0,
            light: PolarDirection::from_degrees(20.0, 180.0),
            camera: PolarDirection::from_degrees(0.0, 0.0),
            rotation: 0.0,
        },
        reflectance_factor: TRUE_WHITE,
        reflectance_factor_se: [0.0; 3],
    }
}

/// A temporary folder, in memory where there is one (journals are fsynced).
pub fn folder() -> tempfile::TempDir {
    tempfile::tempdir_in("/dev/shm").unwrap_or_else(|_| tempfile::tempdir().unwrap())
}

/// Which session of a rig: its noise, its pose errors, its cloth's place differ from those of the others.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    Measurement,
    Dark,
    Linearity,
    Flat,
    White,
    Drift,
    Board,
    Chart,
}

impl Setup {
    /// Everything there is to photograph; of the cloth a patch whose mean is as stated in every configuration.
    pub fn scene(&self) -> Scene {
        let mut random = Random::keyed(&[self.seed, 77]);
        let phases = std::array::from_fn(|_| random.uniform() * TAU);
        Scene {
            cloth: Cloth::new(phases, self.grain, self.glints, self.seed),
            panel: Panel {
                factor: self.white_factor,
                reference: true_white().configuration,
            },
            board: Board {
                columns: 5,
                rows: 4,
                square_mm: 2.0,
            },
            chart: Chart {
                patches: colors::patches(self.seed),
                patch_mm: 1.5,
                pitch_mm: 1.8,
            },
            flat_gradient: self.flat_gradient,
        }
    }

    /// The scene with the cloth as bright as stated in every configuration: its texture is the same in all of them.
    fn scene_with_cloth(&self) -> Scene {
        let mut scene = self.scene();
        let reference = true_white().configuration;
        let camera = VirtualCamera::new(self.sensor.clone(), Box::new(self.scene()), 0).unwrap();
        let mean = camera.true_mean(&reference, SAMPLE_SQUARE_MM).unwrap();
        let texture = mean.map(|m| m / lommel_seeliger(&reference));
        let targets = self
            .configurations()
            .into_iter()
            .zip(self.poses.iter().map(|p| p.2));
        for (pose, target) in targets.chain([(reference, self.reference_mean)]) {
            let law = lommel_seeliger(&pose);
            let level = [0, 1, 2].map(|c| target[c] / (law * texture[c]));
            scene.cloth.levels.insert(pose.id, level);
        }
        scene
    }

    /// What the session is recorded with.
    pub fn camera(&self, purpose: Purpose, sensor: &SensorModel) -> VirtualCamera {
        let scene = match purpose {
            Purpose::Measurement | Purpose::Drift => self.scene_with_cloth(),
            _ => self.scene(),
        };
        let noise = match purpose {
            Purpose::Measurement => self.seed,
            _ => Random::keyed(&[self.seed, purpose as u64, 99]).bits(),
        };
        VirtualCamera::new(sensor.clone(), Box::new(scene), noise)
            .unwrap()
            .with_misalignment(self.misalignment(purpose))
    }

    /// Where things stand: the same at every visit of a pose.
    pub fn misalignment(&self, purpose: Purpose) -> Misalignment {
        let (sd, pointing, seed) = (self.pose_sd, self.pointing_sd_px, self.seed);
        let height = sd.height_mm * Random::keyed(&[seed, purpose as u64, 555]).normal();
        Box::new(move |shot| {
            let key = [seed, purpose as u64, 556, u64::from(shot.pose.id)];
            let mut random = Random::keyed(&key);
            let mut draw = |sd_deg: f64| sd_deg.to_radians() * random.normal();
            let mut pose = shot.pose;
            // Polar angles are positive: beyond the normal they would be the other side's.
            pose.camera.theta = (pose.camera.theta + draw(sd.camera_theta_deg)).abs();
            pose.light.theta = (pose.light.theta + draw(sd.light_theta_deg)).abs();
            pose.rotation += draw(sd.rotation_deg);
            Stand {
                pose,
                shift_px: pointing.map(|p| p * random.normal()),
                height_mm: height,
            }
        })
    }

    /// The manifest of a session of this rig.
    pub fn manifest(&self) -> Manifest {
        Manifest {
            format: Manifest::FORMAT.to_owned(),
            program: "test".to_owned(),
            started_utc: "2024-02-29T12:00:00Z".to_owned(),
            note: String::new(),
            synthetic: true,
            rig: "virtual".to_owned(),
            camera: self.stated.clone().unwrap_or(self.sensor.facts()),
            white: self.stated_white(),
            sample_square_mm: SAMPLE_SQUARE_MM,
            exposures_ms: self.exposures_ms.clone(),
            provenance: Default::default(),
        }
    }

    /// The white standard as its certificate has it.
    pub fn stated_white(&self) -> WhiteReference {
        let mut random = Random::keyed(&[self.seed, 78]);
        let mut stated = true_white();
        stated.reflectance_factor = self.white_factor;
        for c in 0..3 {
            stated.reflectance_factor_se[c] = self.white_se;
            stated.reflectance_factor[c] += self.white_se * random.normal();
        }
        stated
    }

    /// Darks, whites, then samples with visits of the reference pose in between.
    fn script(&self) -> Script {
        let white = true_white().configuration;
        let mut script = Script::new();
        let mut stretch = 0;
        let visit = |script: &mut Script, stretch: usize| {
            if self.reference_every > 0 && !self.unvisited.contains(&stretch) {
                script.visit(&white, &self.reference_exposures_ms);
            }
        };
        script.shots(
            FrameKind::Dark,
            &white,
            &self.dark_exposures_ms,
            self.dark_repeats,
        );
        script.shots(
            FrameKind::White,
            &white,
            &self.exposures_ms,
            self.white_repeats,
        );
        visit(&mut script, stretch);
        let mut taken = 0;
        for pose in self.configurations() {
            let first = script.steps.len();
            script.shots(
                FrameKind::Sample,
                &pose,
                &self.exposures_ms,
                self.sample_repeats,
            );
            for step in script.steps.split_off(first) {
                if self.breaks.contains(&taken) {
                    script.steps.push(Step::Ready);
                    stretch += 1;
                    visit(&mut script, stretch);
                }
                taken += 1;
                script.steps.push(step);
                if self.reference_every > 0 && taken % self.reference_every == 0 {
                    visit(&mut script, stretch);
                }
            }
        }
        visit(&mut script, stretch);
        script
    }
}

/// The plan of some poses.
pub fn plan(configurations: Vec<Configuration>) -> Plan {
    Plan {
        name: "test".to_owned(),
        description: String::new(),
        shows: goniofit::session::FrameKind::Sample,
        configurations,
    }
}

/// Records the session into `root`.
pub fn record(root: &Path, setup: &Setup) -> SessionFolder {
    let brightness = Arc::new(Mutex::new([1.0; 3]));
    let now = brightness.clone();
    let mut light = setup
        .camera(Purpose::Measurement, &setup.sensor)
        .with_lamp(Box::new(move |_| *now.lock().unwrap()));
    // Darks show no cloth; the capped camera has the same noise and fixed pattern.
    let mut dark = VirtualCamera::new(
        setup.dark_sensor.clone(),
        Box::new(setup.scene()),
        setup.seed,
    )
    .unwrap();
    let script = match setup.filters {
        true => setup.script().through_filters(),
        false => setup.script(),
    };
    let times = script.times();
    let early = |s: &Step| matches!(s, Step::Shot(shot) | Step::Through(shot, _) if matches!(shot.kind, FrameKind::Dark | FrameKind::White));
    let start_s = script.steps.iter().filter(|s| early(s)).count() as f64;
    let end_s = times[times.len() - 1] - 1.0;
    script.record(
        root,
        &setup.manifest(),
        &plan(setup.configurations()),
        |shot, filter, elapsed_s, stretch| {
            if let Some(law) = setup.lamp {
                let x = ((elapsed_s - start_s) / (end_s - start_s)).max(0.0);
                *brightness.lock().unwrap() = law(x, stretch);
            }
            match (shot.kind, filter) {
                (FrameKind::Dark, _) => dark.expose(shot).unwrap(),
                (_, Some(filter)) => light.expose_through(shot, filter).unwrap(),
                (_, None) => light.expose(shot).unwrap(),
            }
        },
    )
}
