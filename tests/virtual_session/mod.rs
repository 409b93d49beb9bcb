//! Small sessions photographed by the virtual camera, with their truth.
#![allow(dead_code, unreachable_pub, missing_docs, clippy::unwrap_used)]

use goniofit::math::{PolarDirection, Random};
use goniofit::rig::virtual_camera::white_radiance;
use goniofit::rig::{Appearance, Camera, SensorModel, Shot, VirtualCamera};
use goniofit::session::{
    Configuration, Event, FrameKind, FrameRecord, Manifest, Plan, SessionFolder, WhiteReference,
};
use std::path::Path;
use std::sync::{Arc, Mutex};

pub mod pulls;

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
            reference_every: 0,
            reference_exposures_ms: vec![16.0],
            reference_mean: [0.6, 0.5, 0.55],
            unvisited: Vec::new(),
            breaks: Vec::new(),
            lamp: None,
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

/// What happens in a session.
enum Step {
    /// A stretch begins.
    Ready,
    Shot(Shot),
}

/// The steps of a session: darks, whites, then samples with visits of the reference pose in between.
struct Script<'a> {
    setup: &'a Setup,
    white: Configuration,
    steps: Vec<Step>,
    stretch: usize,
    visits: u32,
}

impl Script<'_> {
    fn shots(
        &mut self,
        kind: FrameKind,
        config: Option<u32>,
        pose: Configuration,
        exposures_ms: &[f64],
        repeats: u32,
    ) {
        for &exposure_ms in exposures_ms {
            for repeat in 0..repeats {
                let visit = match kind {
                    FrameKind::Reference => self.visits,
                    _ => 0,
                };
                let shot = Shot {
                    kind,
                    config,
                    pose,
                    exposure_ms,
                    repeat,
                    visit,
                };
                self.steps.push(Step::Shot(shot));
            }
        }
    }

    fn visit(&mut self) {
        let setup = self.setup;
        if setup.reference_every > 0 && !setup.unvisited.contains(&self.stretch) {
            let exposures_ms = &setup.reference_exposures_ms;
            self.shots(FrameKind::Reference, None, self.white, exposures_ms, 1);
            self.visits += 1;
        }
    }

    fn write(mut self) -> Vec<Step> {
        let setup = self.setup;
        let (white, pose) = (FrameKind::White, self.white);
        self.steps.push(Step::Ready);
        let dark = FrameKind::Dark;
        self.shots(
            dark,
            None,
            pose,
            &setup.dark_exposures_ms,
            setup.dark_repeats,
        );
        self.shots(white, None, pose, &setup.exposures_ms, setup.white_repeats);
        self.visit();
        let mut taken = 0;
        for pose in setup.configurations() {
            let first = self.steps.len();
            let sample = FrameKind::Sample;
            self.shots(
                sample,
                Some(pose.id),
                pose,
                &setup.exposures_ms,
                setup.sample_repeats,
            );
            for step in self.steps.split_off(first) {
                if setup.breaks.contains(&taken) {
                    self.steps.push(Step::Ready);
                    self.stretch += 1;
                    self.visit();
                }
                taken += 1;
                self.steps.push(step);
                if setup.reference_every > 0 && taken % setup.reference_every == 0 {
                    self.visit();
                }
            }
        }
        self.visit();
        self.steps
    }
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
    let brightness = Arc::new(Mutex::new([1.0; 3]));
    let now = brightness.clone();
    light = light.with_lamp(Box::new(move |_| *now.lock().unwrap()));
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
        shows: FrameKind::Sample,
        configurations: configurations.clone(),
    };
    for (pose, truth) in configurations.iter().zip(&setup.poses) {
        light.rescale_to(pose, SAMPLE_SQUARE_MM, truth.2).unwrap();
    }
    let reference = white.configuration;
    light
        .rescale_to(&reference, SAMPLE_SQUARE_MM, setup.reference_mean)
        .unwrap();
    let script = Script {
        setup,
        white: reference,
        steps: Vec::new(),
        stretch: 0,
        visits: 0,
    };
    let steps = script.write();
    let takes_time = |s: &&Step| matches!(s, Step::Shot(_));
    let early = |s: &&Step| matches!(s, Step::Shot(shot) if matches!(shot.kind, FrameKind::Dark | FrameKind::White));
    let start_s = steps.iter().filter(early).count() as f64;
    let end_s = steps.iter().filter(takes_time).count() as f64 - 1.0;
    let (session, mut journal) = SessionFolder::create(root, &manifest, &plan, "").unwrap();
    let (mut number, mut stretches, mut elapsed_s) = (0, 0, 0.0);
    for step in steps {
        let shot = match step {
            Step::Shot(shot) => shot,
            Step::Ready => {
                let firmware = String::new();
                let ready = Event::Ready {
                    firmware,
                    utc: None,
                };
                journal.append(elapsed_s, ready).unwrap();
                stretches += 1;
                continue;
            }
        };
        if let Some(law) = setup.lamp {
            *brightness.lock().unwrap() = law(
                ((elapsed_s - start_s) / (end_s - start_s)).max(0.0),
                stretches - 1,
            );
        }
        let frame = match shot.kind {
            FrameKind::Dark => dark.expose(&shot).unwrap(),
            _ => light.expose(&shot).unwrap(),
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
            visit: shot.visit,
            filter: None,
            exposed: None,
            utc: None,
            axes_deg: Default::default(),
            sha256: String::new(),
        };
        session
            .add_frame(&mut journal, elapsed_s, record, &frame.bytes)
            .unwrap();
        number += 1;
        elapsed_s += 1.0;
    }
    session
}
