//! How long it takes to measure a session of 16 poses with 3 exposures of 15-megapixel RAW, against what it cannot be
//! shorter than: reading, hashing and decoding its frames on all cores. The answer is beside it: the numbers against what was
//! written. Peak memory is the process's (VmHWM).
//!
//! `cargo bench --bench measure_speed` (writes 1.8 GB into the temporary folder; `TMPDIR` chooses another)

#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

use goniofit::base::Unwatched;
use goniofit::math::Random;
use goniofit::measure::{MeasureOptions, decode, measure_session};
use goniofit::session::{
    BitDepth, CameraFacts, CfaPattern, Configuration, DngImage, Event, FrameKind, FrameRecord,
    Manifest, Plan, SessionFolder, WhiteReference, sha256, write_dng,
};
use rayon::prelude::*;
use std::path::Path;
use std::time::Instant;

const WIDTH: usize = 4752;
const HEIGHT: usize = 3168;
const BLACK: f64 = 512.0;
const EXPOSURES_MS: [f64; 3] = [4.0, 45.0, 512.0];
/// Raw values per normalized radiance and millisecond.
const RATE: [f64; 3] = [150.0, 240.0, 180.0];
/// Variance per signal, raw values.
const SLOPE: f64 = 0.8;
const READ: f64 = 4.0;

fn main() {
    let folder = tempfile::tempdir().unwrap();
    let truth = |id: u32| 0.4 / f64::from(id);
    let session = write(folder.path(), truth);
    let frames = session.frames().unwrap();
    let bytes: u64 = frames
        .iter()
        .map(|f| {
            std::fs::metadata(session.frame_path(&f.file))
                .unwrap()
                .len()
        })
        .sum();
    println!(
        "{} frames of {WIDTH} x {HEIGHT}, {:.2} GB, {} threads",
        frames.len(),
        bytes as f64 / 1e9,
        rayon::current_num_threads()
    );
    // Twice, so that both find the files in memory.
    let mut floor = f64::MAX;
    for _ in 0..2 {
        let start = Instant::now();
        frames.par_iter().for_each(|f| {
            let bytes = std::fs::read(session.frame_path(&f.file)).unwrap();
            assert_eq!(sha256(&bytes), f.sha256);
            let frame = decode(&bytes).unwrap();
            assert_eq!(frame.data.len(), WIDTH * HEIGHT);
        });
        floor = floor.min(start.elapsed().as_secs_f64());
    }
    let before = peak_megabytes();
    let start = Instant::now();
    let (measured, _) = measure_session(&session, &MeasureOptions::default(), &Unwatched).unwrap();
    let took = start.elapsed().as_secs_f64();
    let worst = measured.intensities.iter().flat_map(|m| {
        let truth = truth(m.configuration.id);
        (0..3).map(move |c| ((m.mean[c] - truth) / m.standard_error[c]).abs())
    });
    println!(
        "read, hash, decode {floor:.2} s; measure {took:.2} s; ratio {:.2}",
        took / floor
    );
    println!(
        "largest |error| / stated {:.1} of {}; peak memory {:.0} MB (decoding alone {before:.0} MB)",
        worst.fold(0.0, f64::max),
        3 * measured.intensities.len(),
        peak_megabytes()
    );
}

fn peak_megabytes() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|l| l.starts_with("VmHWM:"));
    let kilobytes = line.and_then(|l| l.split_whitespace().nth(1)?.parse::<f64>().ok());
    kilobytes.unwrap_or(f64::NAN) / 1e3
}

/// A session whose frames show evenly bright cloth.
fn write(root: &Path, truth: impl Fn(u32) -> f64) -> SessionFolder {
    let plan = Plan::read(
        &Path::new(env!("CARGO_MANIFEST_DIR")).join("rig_configs/plans/khungurn16.toml"),
    )
    .unwrap();
    let white = WhiteReference {
        configuration: Configuration {
            id: 0,
            ..plan.configurations[2]
        },
        reflectance_factor: [1.0; 3],
        reflectance_factor_se: [0.003; 3],
    };
    let manifest = Manifest {
        format: Manifest::FORMAT.to_owned(),
        program: "bench".to_owned(),
        started_utc: "2024-02-29T12:00:00Z".to_owned(),
        note: String::new(),
        synthetic: true,
        rig: "bench".to_owned(),
        camera: CameraFacts {
            name: "bench".to_owned(),
            width: WIDTH,
            height: HEIGHT,
            pixel_mm: 0.01,
            center_px: [0.5 * WIDTH as f64, 0.5 * HEIGHT as f64],
            lens: Default::default(),
        },
        sample_square_mm: 10.0,
        exposures_ms: EXPOSURES_MS.to_vec(),
        provenance: Default::default(),
        white: white.clone(),
    };
    let (session, mut journal) = SessionFolder::create(root, &manifest, &plan, "").unwrap();
    let ready = Event::Ready {
        firmware: String::new(),
        utc: None,
    };
    journal.append(0.0, ready).unwrap();
    // A stock of normal numbers, begun at another place in every row.
    let mut random = Random::keyed(&[7]);
    let normal: Vec<f32> = (0..1 << 20).map(|_| random.normal() as f32).collect();
    let white_radiance = white.configuration.light.theta.cos();
    let mut shots = Vec::new();
    for ms in EXPOSURES_MS {
        shots.extend((0..2).map(|r| (FrameKind::Dark, None, ms, r, 0.0)));
    }
    shots.extend((0..2).map(|r| (FrameKind::White, None, 45.0, r, white_radiance)));
    for c in &plan.configurations {
        let shot = |ms| (FrameKind::Sample, Some(c.id), ms, 0, truth(c.id));
        shots.extend(EXPOSURES_MS.map(shot));
    }
    for (number, (kind, config, exposure_ms, repeat, radiance)) in shots.into_iter().enumerate() {
        let bytes = frame(radiance, exposure_ms, number as u64, &normal);
        let record = FrameRecord {
            file: FrameRecord::standard_name(number, kind, config, exposure_ms, "dng"),
            kind,
            config,
            exposure_ms,
            requested_ms: None,
            repeat,
            visit: 0,
            filter: None,
            exposed: None,
            utc: None,
            axes_deg: Default::default(),
            sha256: String::new(),
        };
        session
            .add_frame(&mut journal, number as f64, record, &bytes)
            .unwrap();
    }
    session
}

fn frame(radiance: f64, exposure_ms: f64, number: u64, normal: &[f32]) -> Vec<u8> {
    let cfa = CfaPattern::Rggb;
    let mut data = vec![0_u16; WIDTH * HEIGHT];
    data.par_chunks_mut(WIDTH).enumerate().for_each(|(y, row)| {
        let start = Random::keyed(&[number, y as u64]).bits() as usize;
        for (x, value) in row.iter_mut().enumerate() {
            let signal = RATE[cfa.channel(y, x)] * radiance * exposure_ms;
            let sigma = (SLOPE * signal + READ * READ).sqrt() as f32;
            let noise = sigma * normal[(start + x) % normal.len()];
            *value = ((BLACK + signal) as f32 + noise)
                .round()
                .clamp(0.0, 16383.0) as u16;
        }
    });
    write_dng(&DngImage {
        width: WIDTH,
        height: HEIGHT,
        data: &data,
        bits: BitDepth::Sixteen,
        cfa,
        black: [BLACK; 4],
        white: 16383,
        make: "bench",
        model: "bench",
        exposure_ms: Some(exposure_ms),
        iso: Some(100),
        date_time: None,
    })
    .unwrap()
}
