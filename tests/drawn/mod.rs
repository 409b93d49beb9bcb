//! Sessions whose frames a test draws value by value, and whether stated errors are right.
#![allow(dead_code, unreachable_pub, missing_docs, clippy::unwrap_used)]

use goniofit::math::statistics::{Running, sidak_level};
use goniofit::session::{
    BitDepth, CameraFacts, CfaPattern, Configuration, DngImage, FrameKind, FrameRecord, Manifest,
    Plan, SessionFolder, WhiteReference, write_dng,
};
use statrs::distribution::{ContinuousCDF, Normal, StudentsT};
use std::path::Path;

pub const CFA: CfaPattern = CfaPattern::Rggb;
pub const BLACK: [f64; 4] = [100.0, 103.0, 97.0, 101.0];

pub fn seed(default: u64) -> u64 {
    std::env::var("SEED").map_or(default, |s| s.parse().unwrap())
}

/// A temporary folder, in memory where there is one (journals are fsynced).
pub fn folder() -> tempfile::TempDir {
    tempfile::tempdir_in("/dev/shm").unwrap_or_else(|_| tempfile::tempdir().unwrap())
}

/// A frame: what it shows, its configuration, its exposure, its raw values.
pub struct Drawn {
    pub kind: FrameKind,
    pub config: Option<u32>,
    pub exposure_ms: f64,
    pub data: Vec<u16>,
}

/// What the manifest says; the white's geometry is that of the first configuration.
pub fn manifest(camera: CameraFacts, white: Configuration) -> Manifest {
    Manifest {
        format: Manifest::FORMAT.to_owned(),
        program: "test".to_owned(),
        started_utc: "2024-02-29T12:00:00Z".to_owned(),
        note: String::new(),
        synthetic: true,
        rig: "virtual".to_owned(),
        camera,
        white: WhiteReference {
            configuration: white,
            reflectance_factor: [1.02, 0.99, 0.96],
            reflectance_factor_se: [1e-6; 3],
        },
        sample_square_mm: 4.0,
        exposures_ms: vec![10.0],
        provenance: Default::default(),
    }
}

pub fn record(
    root: &Path,
    manifest: &Manifest,
    configurations: &[Configuration],
    frames: &[Drawn],
) -> SessionFolder {
    let plan = Plan {
        name: "test".to_owned(),
        description: String::new(),
        shows: goniofit::session::FrameKind::Sample,
        configurations: configurations.to_vec(),
    };
    let (session, mut journal) = SessionFolder::create(root, manifest, &plan, "").unwrap();
    for (number, frame) in frames.iter().enumerate() {
        let bytes = write_dng(&DngImage {
            width: manifest.camera.width,
            height: manifest.camera.height,
            data: &frame.data,
            bits: BitDepth::Sixteen,
            cfa: CFA,
            black: BLACK,
            white: 4095,
            make: "test",
            model: "camera",
            exposure_ms: Some(frame.exposure_ms),
            iso: Some(100),
            date_time: None,
        });
        let (kind, config, ms) = (frame.kind, frame.config, frame.exposure_ms);
        let record = FrameRecord {
            file: FrameRecord::standard_name(number, kind, config, ms, "dng"),
            kind,
            config,
            exposure_ms: ms,
            requested_ms: None,
            repeat: 0,
            visit: 0,
            filter: None,
            exposed: None,
            utc: None,
            axes_deg: Default::default(),
            sha256: String::new(),
        };
        let at_s = number as f64;
        session
            .add_frame(&mut journal, at_s, record, &bytes.unwrap())
            .unwrap();
    }
    session
}

/// What is wrong with the pulls, (found - truth) / standard error, if anything, at a family-wise level of 1e-3: one list
/// per session, which are the independent unit. The session means of pull and of pull^2 are tested against 0 and 1 by
/// Student's t, and so is each cell's mean over the sessions.
pub fn verdict(pulls: &[Vec<f64>]) -> Result<String, String> {
    let cells = pulls[0].len();
    let level = sidak_level(1e-3, cells + 2);
    let n = pulls.len() as f64;
    let student = StudentsT::new(0.0, 1.0, n - 1.0).unwrap();
    let t_limit = student.inverse_cdf(1.0 - 0.5 * level);
    let normal_limit = Normal::standard().inverse_cdf(1.0 - 0.5 * level);
    let (mut mean, mut square) = (Running::default(), Running::default());
    for session in pulls {
        mean.push(session.iter().sum::<f64>() / cells as f64);
        square.push(session.iter().map(|p| p * p).sum::<f64>() / cells as f64);
    }
    let cell = |c: usize| {
        let mut of = Running::default();
        pulls.iter().for_each(|p| of.push(p[c]));
        of
    };
    let per_cell: Vec<String> = (0..cells)
        .map(|c| format!("{:.2} sd {:.2}", cell(c).mean(), cell(c).variance().sqrt()))
        .collect();
    let text = format!(
        "mean pull {:.3} +- {:.3}, mean square pull {:.3} +- {:.3}, n = {n} sessions; by cell: {}",
        mean.mean(),
        mean.standard_error(),
        square.mean(),
        square.standard_error(),
        per_cell.join(", ")
    );
    let unbiased = mean.mean().abs() < t_limit * mean.standard_error();
    let honest = (square.mean() - 1.0).abs() < t_limit * square.standard_error();
    if !unbiased {
        return Err(format!("biased: {text}"));
    }
    if !honest {
        return Err(format!("wrong standard errors: {text}"));
    }
    match (0..cells).find(|&c| cell(c).mean().abs() * n.sqrt() >= normal_limit) {
        Some(c) => Err(format!("cell {c} is biased: {text}")),
        None => Ok(text),
    }
}
