//! Small sessions for calibrations, of a sensor whose every number is known.
#![allow(dead_code, unreachable_pub, missing_docs, clippy::unwrap_used)]

use goniofit::math::{PolarDirection, Random};
use goniofit::session::{
    BitDepth, CameraFacts, CfaPattern, Configuration, DngImage, Event, FrameKind, FrameRecord,
    Manifest, Plan, SessionFolder, WhiteReference, write_dng,
};
use std::path::Path;

/// A sensor: `electrons = Poisson(gain (rate lamp t V (1 + pattern) + dark t))`, `L(s) = electrons / gain`,
/// `raw = round(bias + s + read normal)`.
#[derive(Clone)]
pub struct Sensor {
    pub width: usize,
    pub height: usize,
    pub cfa: CfaPattern,
    pub bias: [f64; 4],
    pub white: u16,
    /// Electrons per raw value.
    pub gain: f64,
    pub read: f64,
    /// Raw values per millisecond.
    pub dark_per_ms: f64,
    /// Its standard deviation from pixel to pixel.
    pub dark_scatter: f64,
    /// Standard deviation of the black level from frame to frame.
    pub wander: f64,
    /// Raw values per millisecond, r, g, b.
    pub rate: [f64; 3],
    /// `c_1, c_2` of the correction.
    pub curve: [f64; 2],
    /// Unequal pixels: standard deviation of the response.
    pub pattern: f64,
    /// True: the pattern is another one in every frame.
    pub pattern_changes: bool,
    /// Loss of light in the corners.
    pub vignetting: f64,
    /// Column, row, dark current.
    pub hot: Vec<(usize, usize, f64)>,
    /// Standard deviation of the exposed time from frame to frame, relative.
    pub jitter: f64,
}

impl Default for Sensor {
    fn default() -> Self {
        Self {
            width: 48,
            height: 40,
            cfa: CfaPattern::Grbg,
            bias: [128.0, 127.5, 128.25, 128.0],
            white: 4095,
            gain: 2.5,
            read: 2.0,
            dark_per_ms: 0.02,
            dark_scatter: 0.0,
            wander: 0.0,
            rate: [30.0, 50.0, 40.0],
            curve: [0.04, -0.03],
            pattern: 0.01,
            pattern_changes: false,
            vignetting: 0.0,
            hot: Vec::new(),
            jitter: 0.0,
        }
    }
}

impl Sensor {
    pub fn full_scale(&self) -> f64 {
        f64::from(self.white) - self.bias.iter().sum::<f64>() / 4.0
    }

    /// The raw value less bias that the curve takes to `linear`.
    fn bend(&self, linear: f64) -> f64 {
        let mut s = linear;
        for _ in 0..6 {
            let u = s / self.full_scale();
            let at = s * (1.0 + self.curve[0] * u + self.curve[1] * u * u);
            let slope = 1.0 + 2.0 * self.curve[0] * u + 3.0 * self.curve[1] * u * u;
            s -= (at - linear) / slope;
        }
        s
    }

    pub fn response(&self, seed: u64, frame: u64, x: usize, y: usize) -> f64 {
        let (w, h) = (self.width as f64, self.height as f64);
        let (dx, dy) = (x as f64 + 0.5 - 0.5 * w, y as f64 + 0.5 - 0.5 * h);
        let r2 = (dx * dx + dy * dy) / (0.25 * (w * w + h * h));
        let frame = if self.pattern_changes { frame } else { 0 };
        let pixel = (y * self.width + x) as u64;
        let pattern = Random::keyed(&[seed, 5, frame, pixel]).normal();
        (1.0 - self.vignetting * r2) * (1.0 + self.pattern * pattern)
    }

    fn expose(&self, shot: &Shot, seed: u64, frame: u64) -> Vec<u16> {
        let mut random = Random::keyed(&[seed, 6, frame]);
        let lit = shot.kind != FrameKind::Dark;
        let time = shot.exposure_ms * (1.0 + self.jitter * random.normal());
        let wander = self.wander * random.normal();
        let mut data = Vec::new();
        for y in 0..self.height {
            for x in 0..self.width {
                let pixel = (y * self.width + x) as u64;
                let mut mean = self.dark_per_ms;
                if self.dark_scatter > 0.0 {
                    mean += self.dark_scatter * Random::keyed(&[seed, 7, pixel]).normal();
                }
                let hot = self.hot.iter().find(|h| (h.0, h.1) == (x, y));
                mean += hot.map_or(0.0, |h| h.2);
                if lit {
                    let rate = self.rate[self.cfa.channel(y, x)];
                    mean += rate * shot.lamp * self.response(seed, frame, x, y);
                }
                let electrons = self.gain * mean * time;
                let electrons = electrons + electrons.max(0.0).sqrt() * random.normal();
                let s = self.bend(electrons / self.gain);
                let bias = self.bias[CfaPattern::position(y, x)] + wander;
                let raw = (bias + s + self.read * random.normal()).round();
                data.push(raw.clamp(0.0, f64::from(self.white)) as u16);
            }
        }
        data
    }
}

/// One frame to be taken.
#[derive(Clone, Copy)]
pub struct Shot {
    pub kind: FrameKind,
    pub exposure_ms: f64,
    pub visit: u32,
    pub lamp: f64,
    pub iso: u16,
    pub elapsed_s: f64,
}

/// Every exposure so many times.
pub fn shots(kind: FrameKind, exposures_ms: &[f64], repeats: usize) -> Vec<Shot> {
    let shot = |&exposure_ms: &f64| Shot {
        kind,
        exposure_ms,
        visit: 0,
        lamp: 1.0,
        iso: 100,
        elapsed_s: 0.0,
    };
    let all = exposures_ms.iter().map(shot);
    all.flat_map(|s| vec![s; repeats]).collect()
}

/// Gives the shots their times: one after another, 10 s apart.
pub fn timed(mut shots: Vec<Shot>) -> Vec<Shot> {
    for (i, shot) in shots.iter_mut().enumerate() {
        shot.elapsed_s = 10.0 * i as f64;
    }
    shots
}

pub fn pose() -> Configuration {
    Configuration {
        id: 0,
        light: PolarDirection::from_degrees(32.0, 180.0),
        camera: PolarDirection::from_degrees(0.0, 0.0),
        rotation: 0.0,
    }
}

pub fn manifest(sensor: &Sensor) -> Manifest {
    Manifest {
        format: Manifest::FORMAT.to_owned(),
        program: "test".to_owned(),
        started_utc: "2024-02-29T12:00:00Z".to_owned(),
        note: String::new(),
        synthetic: true,
        rig: "bench".to_owned(),
        camera: CameraFacts {
            name: "Test camera".to_owned(),
            width: sensor.width,
            height: sensor.height,
            pixel_mm: 0.5,
            center_px: [0.5 * sensor.width as f64, 0.5 * sensor.height as f64],
            lens: Default::default(),
        },
        white: WhiteReference {
            configuration: pose(),
            reflectance_factor: [1.02, 0.99, 0.96],
            reflectance_factor_se: [0.003; 3],
        },
        sample_square_mm: 15.0,
        exposures_ms: vec![1.0],
        provenance: Default::default(),
    }
}

/// A temporary folder, in memory where there is one (journals are fsynced).
pub fn folder() -> tempfile::TempDir {
    tempfile::tempdir_in("/dev/shm").unwrap_or_else(|_| tempfile::tempdir().unwrap())
}

/// Records a session; the shots with the same kind, visit and exposure are repeats.
pub fn record(root: &Path, sensor: &Sensor, shots: &[Shot], seed: u64) -> SessionFolder {
    record_as(root, &manifest(sensor), sensor, shots, seed)
}

pub fn record_as(
    root: &Path,
    manifest: &Manifest,
    sensor: &Sensor,
    shots: &[Shot],
    seed: u64,
) -> SessionFolder {
    let plan = Plan {
        name: "test".to_owned(),
        description: String::new(),
        shows: goniofit::session::FrameKind::Sample,
        configurations: vec![Configuration { id: 1, ..pose() }],
    };
    let (session, mut journal) = SessionFolder::create(root, manifest, &plan, "").unwrap();
    let ready = Event::Ready {
        firmware: String::new(),
        utc: None,
    };
    journal.append(0.0, ready).unwrap();
    for (number, shot) in shots.iter().enumerate() {
        let same = |s: &&Shot| {
            (s.kind, s.visit) == (shot.kind, shot.visit)
                && (s.exposure_ms - shot.exposure_ms).abs() < 1e-9
        };
        let bytes = write_dng(&DngImage {
            width: sensor.width,
            height: sensor.height,
            data: &sensor.expose(shot, seed, number as u64),
            bits: BitDepth::Sixteen,
            cfa: sensor.cfa,
            black: sensor.bias,
            white: sensor.white,
            make: "Test",
            model: "camera",
            exposure_ms: Some(shot.exposure_ms),
            iso: Some(shot.iso),
            date_time: None,
        })
        .unwrap();
        let record = FrameRecord {
            file: FrameRecord::standard_name(number, shot.kind, None, shot.exposure_ms, "dng"),
            kind: shot.kind,
            config: None,
            exposure_ms: shot.exposure_ms,
            requested_ms: None,
            repeat: shots[..number].iter().filter(same).count() as u32,
            visit: shot.visit,
            filter: None,
            exposed: None,
            utc: None,
            axes_deg: Default::default(),
            sha256: String::new(),
        };
        session
            .add_frame(&mut journal, shot.elapsed_s, record, &bytes)
            .unwrap();
    }
    session
}
