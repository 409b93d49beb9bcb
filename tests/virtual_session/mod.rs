//! Small sessions photographed by the virtual camera, with their truth.
#![allow(dead_code, unreachable_pub, missing_docs, clippy::unwrap_used)]

use goniofit::math::{PolarDirection, Random};
use goniofit::rig::virtual_camera::white_radiance;
use goniofit::rig::{Appearance, Camera, SensorModel, Shot, VirtualCamera};
use goniofit::session::{
    Configuration, FrameKind, FrameRecord, Manifest, Plan, SessionFolder, WhiteReference,
};
use std::path::Path;

/// A cloth-like picture: slow waves, a weave of 0.4 mm, and grain; the white panel is uniform.
pub struct Cloth {
    pub white: [f64; 3],
    pub phases: [f64; 4],
    pub grain: f64,
    pub seed: u64,
}

impl Cloth {
    fn grain_at(&self, [x, y]: [f64; 2]) -> f64 {
        let cell = |v: f64| (v / 0.12).floor() as i64 as u64;
        Random::keyed(&[self.seed, cell(x), cell(y)]).uniform() - 0.5
    }
}

impl Appearance for Cloth {
    fn radiance(&self, kind: FrameKind, _: &Configuration, point: [f64; 2]) -> [f64; 3] {
        if kind == FrameKind::White {
            return self.white;
        }
        let [x, y] = point;
        let waves = 0.1 * (0.9 * x + self.phases[0]).sin() + 0.1 * (1.3 * y + self.phases[1]).sin();
        let weave = 0.2 * ((15.7 * x + self.phases[2]).sin() * (15.7 * y + self.phases[3]).sin());
        let grain = self.grain * self.grain_at(point);
        [1.0, 0.8, 1.2].map(|color| 1.0 + waves + color * (weave + grain))
    }
}

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
    /// Standard error of the stated reflectance factor; the stated one is drawn around the true one.
    pub white_se: f64,
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
            white_se: 0.003,
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

fn true_white() -> WhiteReference {
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

/// Records the session into `root`.
pub fn record(root: &Path, setup: &Setup) -> SessionFolder {
    let white = true_white();
    let mut random = Random::keyed(&[setup.seed, 77]);
    let picture = |random: &mut Random| Cloth {
        white: white_radiance(&white),
        phases: std::array::from_fn(|_| random.uniform() * std::f64::consts::TAU),
        grain: setup.grain,
        seed: setup.seed,
    };
    let camera = |sensor: &SensorModel, random: &mut Random| {
        VirtualCamera::new(sensor.clone(), Box::new(picture(random)), setup.seed).unwrap()
    };
    let mut light = camera(&setup.sensor, &mut random);
    let mut dark = camera(&setup.dark_sensor, &mut random);
    let mut stated = white.clone();
    for c in 0..3 {
        stated.reflectance_factor_se[c] = setup.white_se;
        stated.reflectance_factor[c] += setup.white_se * random.normal();
    }
    let configurations = setup.configurations();
    let manifest = Manifest {
        format: Manifest::FORMAT.to_owned(),
        program: "test".to_owned(),
        started_utc: "2024-02-29T12:00:00Z".to_owned(),
        note: String::new(),
        synthetic: true,
        rig: "virtual".to_owned(),
        camera: setup.sensor.facts(),
        white: stated,
        sample_square_mm: SAMPLE_SQUARE_MM,
        exposures_ms: setup.exposures_ms.clone(),
        provenance: Default::default(),
    };
    let plan = Plan {
        name: "test".to_owned(),
        description: String::new(),
        configurations: configurations.clone(),
    };
    let mut shots = Vec::new();
    let mut add = |kind, config: Option<u32>, pose: Configuration, repeats| {
        let exposures_ms = match kind {
            FrameKind::Dark => &setup.dark_exposures_ms,
            _ => &setup.exposures_ms,
        };
        for &exposure_ms in exposures_ms {
            for repeat in 0..repeats {
                shots.push(Shot {
                    kind,
                    config,
                    pose,
                    exposure_ms,
                    repeat,
                    visit: 0,
                });
            }
        }
    };
    add(
        FrameKind::Dark,
        None,
        white.configuration,
        setup.dark_repeats,
    );
    add(
        FrameKind::White,
        None,
        white.configuration,
        setup.white_repeats,
    );
    for (pose, truth) in configurations.iter().zip(&setup.poses) {
        light.rescale_to(pose, SAMPLE_SQUARE_MM, truth.2).unwrap();
        add(
            FrameKind::Sample,
            Some(pose.id),
            *pose,
            setup.sample_repeats,
        );
    }
    let (session, mut journal) = SessionFolder::create(root, &manifest, &plan, "").unwrap();
    for (number, shot) in shots.iter().enumerate() {
        let frame = match shot.kind {
            FrameKind::Dark => dark.expose(shot).unwrap(),
            _ => light.expose(shot).unwrap(),
        };
        let record = FrameRecord {
            file: FrameRecord::standard_name(
                number,
                shot.kind,
                shot.config,
                shot.exposure_ms,
                &frame.extension,
            ),
            kind: shot.kind,
            config: shot.config,
            exposure_ms: frame.exposure_ms,
            repeat: shot.repeat,
            requested_ms: None,
            visit: 0,
            exposed: None,
            utc: None,
            axes_deg: Default::default(),
            sha256: String::new(),
        };
        session
            .add_frame(&mut journal, number as f64, record, &frame.bytes)
            .unwrap();
    }
    session
}
