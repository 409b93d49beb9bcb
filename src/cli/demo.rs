//! `goniofit demo`: the whole main job on the recorded session.

use super::output::data;
use super::simulate::{Truth, read_truth};
use super::{Outcome, fit as fit_command, measure as measure_command, render, terminal::Terminal};
use crate::base::{Context, Error, Result};
use crate::fit::{Budget, FitResult, Options, fit};
use crate::measure::{MeasureOptions, decode_file, measure_session};
use crate::report::{Picture, Provenance, Section, page};
use crate::rig::capture::CaptureOptions;
use crate::rig::simulated::capture_over_pty;
use crate::rig::{ReplayCamera, RigDescription};
use crate::scatter;
use crate::session::{FrameKind, Layout, Measurements, Projection, Quantity, SessionFolder, files};
use std::path::{Path, PathBuf};

/// The whole main job on the recorded session: capture, measure, fit, report
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  goniofit demo
  goniofit demo --out /tmp/demo --seed 7

A simulated controller on a pseudo-terminal is driven through the plan by the real serial code while the camera replays the
recorded RAW frames; the frames are measured, nine parameters are fitted, and the page is written. The recorded session is
synthetic: its truth is known, and the demo says how close it came. Exit code 1: the fit missed the truth by more than 3 %.

An earlier demo in --out is replaced; any other folder is left alone.")]
pub(crate) struct Arguments {
    /// Where to leave session, measurements, fit and page
    #[arg(long, value_name = "DIR", default_value = "goniofit-demo")]
    out: PathBuf,
    /// Recorded session to replay [default: mocks/khungurn16_gabardine]
    #[arg(long, value_name = "DIR")]
    session: Option<PathBuf>,
    /// Selects the random streams of the fit
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Longest time for the fit's renders, seconds
    #[arg(long, value_name = "S", default_value_t = 80.0)]
    fit_time: f64,
}

const RECORDED: &str = "mocks/khungurn16_gabardine";
/// Marks a folder as made by this command, so that it may be replaced.
const MARKER: &str = ".goniofit-demo";
/// The simulated controller's time runs this many times faster than ours.
const SPEED: f64 = 40.0;
/// Largest acceptable weighted rms of the fitted intensities against the truth.
const GOAL_PERCENT: f64 = 3.0;
/// Configurations whose frames the page shows.
const SHOWN: [u32; 4] = [1, 2, 9, 16];

pub(crate) fn run(a: Arguments) -> Result<Outcome> {
    measure_command::quiet_decoder_panics();
    if !(1.0..=86_400.0).contains(&a.fit_time) {
        return Err(Error::new(format!(
            "--fit-time {}: expected 1 to 86400 seconds",
            a.fit_time
        )));
    }
    let root = project_root(a.session.as_deref())?;
    let recorded = a.session.clone().unwrap_or_else(|| root.join(RECORDED));
    let truth = read_truth(&recorded)?.ok_or_else(|| {
        Error::new(format!("{} has no truth.json", recorded.display()))
            .with_hint("the demo judges itself; for a real session use `goniofit measure session` and `goniofit fit`")
    })?;
    prepare_folder(&a.out)?;
    let terminal = Terminal::new()?;
    terminal.say(
        "goniofit demo: SYNTHETIC data. A virtual camera photographed a fabric rendered by this program, so the truth is known.",
    );
    let session = capture(&a, &recorded, &terminal)?;
    let measurements = measure(&a, &session, &truth, &terminal)?;
    let result = fit_and_report(&a, &root, &session, &measurements, &truth, &terminal)?;

    fit_command::print_table(&result);
    let Some(judged) = &result.truth else {
        return Ok(Outcome::Done);
    };
    let (rms, se) = (judged.weighted_rms_percent, judged.weighted_rms_se_percent);
    // Near zero the unbiased estimate may even be negative: then say what is surely not exceeded.
    let distance = if rms < 2.0 * se {
        format!("below {:.2} % (95 %)", rms + 2.0 * se)
    } else {
        format!("{rms:.2} +- {se:.2} %")
    };
    data!(
        "against the noise-free truth: {distance} weighted rms over {} numbers (goal {GOAL_PERCENT} %)",
        3 * result.configs.len()
    );
    let out = a.out.display();
    data!(
        "look at {out}/report.html; data in {out}/session, {out}/measurements.csv, {out}/fit.json"
    );
    let good = judged.weighted_rms_percent <= GOAL_PERCENT;
    Ok(if good {
        Outcome::Done
    } else {
        Outcome::OutsideTolerance
    })
}

/// Where `mocks/` and `fabrics/` lie: here, or where the program was built.
fn project_root(session: Option<&Path>) -> Result<PathBuf> {
    let here = PathBuf::from(".");
    let built = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let holds = |root: &PathBuf| {
        root.join("fabrics").is_dir() && (session.is_some() || root.join(RECORDED).is_dir())
    };
    [here, built].into_iter().find(holds).ok_or_else(|| {
        Error::new(format!("no {RECORDED} and fabrics/ here"))
            .with_hint("run the demo from the project's folder")
    })
}

fn prepare_folder(out: &Path) -> Result<()> {
    let what = || format!("{} cannot be prepared", out.display());
    if out.exists() {
        let empty = std::fs::read_dir(out).context(what)?.next().is_none();
        if !out.join(MARKER).exists() && !empty {
            return Err(Error::new(format!(
                "{} exists and was not made by the demo",
                out.display()
            ))
            .with_hint("nothing was touched; choose another folder with --out"));
        }
        std::fs::remove_dir_all(out).context(what)?;
    }
    std::fs::create_dir_all(out).context(what)?;
    files::write_atomic(
        &out.join(MARKER),
        b"made by goniofit demo; may be replaced by it\n",
    )
}

fn capture(a: &Arguments, recorded: &Path, terminal: &Terminal) -> Result<SessionFolder> {
    let source = SessionFolder::open(recorded)?;
    let (plan, manifest) = (source.plan()?, source.manifest()?);
    let rig = RigDescription::read(&recorded.join("rig.toml"))?;
    terminal.say(format!(
        "1/4 capture: plan '{}' ({} configurations) on rig '{}', simulated controller on a pseudo-terminal, frames replayed",
        plan.name,
        plan.configurations.len(),
        rig.name
    ));
    let options = CaptureOptions {
        note: format!("demo: frames replayed from {}", recorded.display()),
        synthetic: manifest.synthetic,
        ..CaptureOptions::default()
    };
    let mut camera = ReplayCamera::open(recorded)?;
    let out = a.out.join("session");
    let summary = capture_over_pty(&rig, &plan, &mut camera, &out, &options, SPEED, terminal)?;
    if !summary.finished() {
        return Err(Error::new("interrupted during capture").with_hint(format!(
            "{} frames are in {}",
            summary.frames,
            out.display()
        )));
    }
    terminal.say(format!(
        "    {} frames in {} ({:.0} s of rig time)",
        summary.frames,
        out.display(),
        SPEED * summary.elapsed
    ));
    Ok(summary.session)
}

fn measure(
    a: &Arguments,
    session: &SessionFolder,
    truth: &Truth,
    terminal: &Terminal,
) -> Result<Measurements> {
    terminal.say("2/4 measure: RAW frames to normalized radiance");
    let (measurements, report) = measure_session(session, &MeasureOptions::default(), terminal)?;
    let path = a.out.join("measurements.csv");
    let csv = measurements.to_stated_csv(Quantity::NormalizedRadiance, report.synthetic)?;
    files::write_atomic(&path, csv.as_bytes())?;
    let pulls: Vec<f64> = measurements
        .intensities
        .iter()
        .flat_map(|i| {
            let row = truth
                .configs
                .iter()
                .find(|t| t.config == i.configuration.id);
            (0..3).filter_map(move |c| {
                row.map(|t| ((i.mean[c] - t.mean[c]) / i.standard_error[c]).powi(2))
            })
        })
        .collect();
    terminal.say(format!(
        "    {} frames, {} intensities in {}; rms distance from the truth {:.2} stated standard errors",
        report.frames,
        measurements.n_numbers(),
        path.display(),
        (pulls.iter().sum::<f64>() / pulls.len() as f64).sqrt()
    ));
    report
        .warnings
        .iter()
        .for_each(|w| terminal.say(format!("    warning: {w}")));
    Ok(measurements)
}

fn fit_and_report(
    a: &Arguments,
    root: &Path,
    session: &SessionFolder,
    measurements: &Measurements,
    truth: &Truth,
    terminal: &Terminal,
) -> Result<FitResult> {
    terminal.say(format!(
        "3/4 fit: {} on {}, at most {:.0} s",
        truth.model,
        truth.fabric.display(),
        a.fit_time
    ));
    let model = scatter::model(&truth.model)?;
    let options = render::surroundings_of(session)?;
    let scene = render::fiber_scene(&root.join(&truth.fabric), model, options)?;
    let budget = Budget {
        time_s: Some(a.fit_time),
        ..Budget::default()
    };
    let mut result = fit(
        &scene,
        measurements,
        &Options::new(a.seed, budget),
        terminal,
    )?;
    result.fabric = truth.fabric.display().to_string();
    result.measurements = a.out.join("measurements.csv").display().to_string();
    result.synthetic = Some(true);
    result.command = fit_command::command_line();
    let true_means = measurements.intensities.iter().map(|i| {
        let row = truth
            .configs
            .iter()
            .find(|t| t.config == i.configuration.id);
        row.map(|t| t.mean).ok_or_else(|| {
            Error::new(format!(
                "truth.json lacks configuration {}",
                i.configuration.id
            ))
        })
    });
    result.add_truth(truth.parameters.clone(), true_means.collect::<Result<_>>()?)?;
    result.write(&a.out.join("fit.json"), false)?;

    terminal.say("4/4 report");
    let provenance = Provenance {
        title: Some("goniofit demo".to_owned()),
        sections: vec![frames_section(session)?],
        ..Provenance::default()
    };
    files::write_atomic(
        &a.out.join("report.html"),
        page(&result, &provenance).as_bytes(),
    )?;
    Ok(result)
}

/// Some of the frames, with the outline of the measured square.
fn frames_section(session: &SessionFolder) -> Result<Section> {
    let (manifest, plan, frames) = (session.manifest()?, session.plan()?, session.frames()?);
    let mut pictures = Vec::new();
    for id in SHOWN {
        let Some(configuration) = plan.configuration(id) else {
            continue;
        };
        let longest = frames
            .iter()
            .filter(|f| f.kind == FrameKind::Sample && f.config == Some(id));
        // The brightest exposure that is not washed out: the middle of the bracket.
        let Some(frame) = longest.clone().nth(longest.count() / 2) else {
            continue;
        };
        let raw = decode_file(&session.frame_path(&frame.file))?;
        let corners = Projection::new(&manifest.camera, configuration)
            .quadrilateral(manifest.sample_square_mm);
        let (width, height, pixels) = preview(&raw, &corners);
        let [tl, tc] = [configuration.light.theta, configuration.camera.theta].map(f64::to_degrees);
        let caption = format!(
            "configuration {id}: light {tl:.0}, camera {tc:.0} degrees, {} ms",
            frame.exposure_ms
        );
        pictures.push(Picture::from_rgb(
            caption,
            width as u32,
            height as u32,
            &pixels,
        )?);
    }
    Ok(Section {
        title: "Frames (synthetic)".to_owned(),
        paragraphs: vec![
            "RAW frames of the session, decoded, brightened for the eye, with the outline of the 1 cm square whose mean is \
             measured. They were made by a virtual camera from renders of the fabric."
                .to_owned(),
        ],
        pictures,
        ..Section::default()
    })
}

/// Half-size RGB of a frame, scaled so that its 99th percentile is white, with an outline.
fn preview(raw: &crate::measure::RawFrame, corners: &[[f64; 2]; 4]) -> (usize, usize, Vec<u8>) {
    let (width, height) = (raw.width / 2, raw.height / 2);
    let mut linear = vec![0.0_f64; 3 * width * height];
    for y in 0..2 * height {
        for x in 0..2 * width {
            for (channel, index) in raw.values_at(x, y) {
                let share = match raw.layout {
                    Layout::Bayer(_) if channel == 1 => 0.5,
                    Layout::Bayer(_) => 1.0,
                    Layout::Mono | Layout::Rgb => 0.25,
                };
                let value = raw.fraction(raw.data[index], index).max(0.0);
                let at = 3 * ((y / 2) * width + x / 2);
                linear[at + channel] += share * value;
            }
        }
    }
    if raw.layout == Layout::Mono {
        for pixel in linear.chunks_exact_mut(3) {
            pixel.fill(pixel[0]);
        }
    }
    let mut sorted = linear.clone();
    sorted.sort_by(f64::total_cmp);
    let white = sorted
        .get(sorted.len() * 99 / 100)
        .copied()
        .unwrap_or(1.0)
        .max(1e-4);
    let mut pixels: Vec<u8> = linear
        .iter()
        .map(|v| (255.0 * (v / white).min(1.0).powf(1.0 / 2.2)) as u8)
        .collect();
    for (i, from) in corners.iter().enumerate() {
        let to = corners[(i + 1) % 4];
        for step in 0..=400 {
            let t = f64::from(step) / 400.0;
            let at = [0, 1].map(|k| ((1.0 - t) * from[k] + t * to[k]) / 2.0);
            if (0.0..width as f64).contains(&at[0]) && (0.0..height as f64).contains(&at[1]) {
                let index = 3 * (at[1] as usize * width + at[0] as usize);
                pixels[index..index + 3].copy_from_slice(&[80, 220, 255]);
            }
        }
    }
    (width, height, pixels)
}
