//! `goniofit simulate`: a synthetic capture session of a rendered fabric.

use super::output::data;
use super::render::{fiber_scene, surroundings};
use super::{Outcome, inputs, terminal::Terminal};
use crate::base::{Context, Error, Result};
use crate::render::{
    Effort, Estimate, FiberScene, Picture, PictureEffort, PictureRequest, Pictured, Request, Scene,
};
use crate::rig::capture::{CaptureOptions, white_id};
use crate::rig::simulated::capture_in_process;
use crate::rig::virtual_camera::PixelFaults;
use crate::rig::{Appearance, RigDescription, SensorModel, VirtualCamera, white_radiance};
use crate::scatter::{self, Parameters};
use crate::session::{Configuration, FrameKind, Plan, SessionFolder, WhiteReference, files};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Farthest distance on the sample of the points whose radiance a pixel averages, millimeters: some texels.
const SPACING_MM: f64 = 0.02;

/// Make a synthetic session: a virtual camera photographs a rendered fabric
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  goniofit simulate --fabric fabrics/gabardine.toml --params fabrics/params/gabardine.json --out my-session
  goniofit simulate --fabric fabrics/silk_satin.toml --params P.json --plan PLAN.toml --accuracy 0.3% \\
      --read-noise 4 --out noisy-session

The path tracer estimates each configuration's mean to --accuracy: that is the truth, kept in truth.json. A picture of the
fabric with fewer paths is then rescaled so that its exact mean over the sample square equals it, photographed
by a virtual camera (black level, shot and read noise, dark current, vignetting, unequal pixels, non-linearity,
quantization, exposure bracket), and
recorded through the whole capture loop with a simulated controller. The session says that it is synthetic.")]
pub(crate) struct Arguments {
    /// Fabric description (TOML)
    #[arg(long, value_name = "F.toml")]
    fabric: PathBuf,
    /// Scattering model
    #[arg(long, default_value = "khungurn")]
    model: String,
    /// True model parameters (JSON)
    #[arg(long, value_name = "P.json")]
    params: PathBuf,
    /// Configurations to visit (TOML)
    #[arg(
        long,
        value_name = "PLAN.toml",
        default_value = "rig_configs/plans/khungurn16.toml"
    )]
    plan: PathBuf,
    /// Rig description (TOML): axes, exposures, white standard
    #[arg(
        long,
        value_name = "RIG.toml",
        default_value = "rig_configs/virtual.toml"
    )]
    rig: PathBuf,
    /// New session folder
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Selects the random streams of renders and noise
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Weighted rms standard error of the true means
    #[arg(long, value_name = "A", default_value = "1%", value_parser = inputs::fraction)]
    accuracy: f64,
    /// Take the true means from an earlier session's truth.json of the same fabric, model, parameters and plan
    #[arg(long, value_name = "TRUTH.json", conflicts_with = "accuracy")]
    truth: Option<PathBuf>,
    /// Texels per side of a tile's picture
    #[arg(long, value_name = "N", default_value_t = 40)]
    texels: usize,
    /// Camera paths per texel of the pictures
    #[arg(long, value_name = "N", default_value_t = 100)]
    texel_paths: u64,
    /// Electrons per raw value
    #[arg(long, value_name = "E", default_value_t = 2.5)]
    gain: f64,
    /// Read noise, raw values
    #[arg(long, value_name = "DN", default_value_t = 2.0)]
    read_noise: f64,
    /// Dark current, raw values per millisecond
    #[arg(long, value_name = "DN", default_value_t = 0.004)]
    dark_current: f64,
    /// Light lost at the image corners, fraction
    #[arg(long, value_name = "V", default_value_t = 0.04)]
    vignetting: f64,
    /// By how much raw values fall short of proportionality at the white level, fraction (they bend as a parabola)
    #[arg(
        long,
        value_name = "N",
        default_value_t = 0.0,
        allow_hyphen_values = true
    )]
    nonlinearity: f64,
    /// Relative standard deviation of the response from pixel to pixel
    #[arg(long, value_name = "P", default_value_t = 0.0)]
    prnu: f64,
    /// Relative change of the lamp's brightness while capturing (63 % of it over the first 50 frames with light)
    #[arg(
        long,
        value_name = "D",
        default_value_t = 0.0,
        allow_hyphen_values = true
    )]
    lamp_drift: f64,
    /// Bits per sample of the RAW frames
    #[arg(long, value_name = "BITS", default_value = "12", value_parser = ["12", "16"])]
    bits: String,
    /// Note for the manifest
    #[arg(long, default_value = "")]
    note: String,
    /// Print a JSON summary
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(a: Arguments) -> Result<Outcome> {
    let model = scatter::model(&a.model)?;
    let parameters = inputs::parameters(&a.params, model)?;
    let plan = Plan::read(&a.plan)?;
    let rig = RigDescription::read(&a.rig)?;
    rig.plan_angles(&plan)?;
    SessionFolder::refuse_existing(&a.out)?;
    let terminal = Terminal::new()?;
    let scene = fiber_scene(&a.fabric, model, surroundings(&rig)?)?;

    let truth = match &a.truth {
        Some(path) => earlier_truth(path, &a, &parameters, &plan)?,
        None => render_truth(&a, &scene, &parameters, &plan, &terminal)?,
    };
    let mut camera = virtual_camera(&a, &scene, &plan, &parameters, &rig, &terminal)?;
    for (configuration, row) in plan.configurations.iter().zip(&truth.configs) {
        camera.rescale_to(configuration, rig.camera.sample_square_mm, row.mean)?;
    }
    terminal.say("capturing with the virtual camera on a simulated controller");
    let options = CaptureOptions {
        note: a.note.clone(),
        synthetic: true,
        ..CaptureOptions::default()
    };
    let summary = capture_in_process(&rig, &plan, &mut camera, &a.out, &options, &terminal)?;
    terminal.finish_stage();
    let text = serde_json::to_string_pretty(&truth).context(|| "truth.json cannot be written")?;
    files::write_atomic(&a.out.join("truth.json"), (text + "\n").as_bytes())?;
    terminal.say(format!(
        "{} frames in {} (synthetic)",
        summary.frames,
        a.out.display()
    ));
    if a.json {
        data!(
            "{}",
            json!({"session": a.out, "frames": summary.frames, "synthetic": true, "truth": truth})
        );
    }
    Ok(if summary.finished() {
        Outcome::Done
    } else {
        Outcome::OutsideTolerance
    })
}

/// What a synthetic session was made from: `truth.json`.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Truth {
    pub(crate) synthetic: bool,
    pub(crate) fabric: PathBuf,
    pub(crate) model: String,
    pub(crate) parameters: Value,
    pub(crate) configs: Vec<TrueMean>,
    pub(crate) weighted_rms_se: f64,
    pub(crate) seed: u64,
    pub(crate) program: String,
}

/// The true mean of one configuration, and how well the renderer knows it.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct TrueMean {
    pub(crate) config: u32,
    pub(crate) mean: [f64; 3],
    pub(crate) se: [f64; 3],
}

fn render_truth(
    a: &Arguments,
    scene: &FiberScene,
    parameters: &Parameters,
    plan: &Plan,
    terminal: &Terminal,
) -> Result<Truth> {
    terminal.say(format!(
        "rendering the true means to {:.2} %",
        100.0 * a.accuracy
    ));
    let request = Request {
        configurations: &plan.configurations,
        parameters,
        effort: Effort::Accuracy(a.accuracy),
        seed: a.seed,
        stream: 0,
    };
    let estimates = scene.estimate(&request, terminal)?;
    let weighted_rms_se = estimates.weighted_rms_error();
    terminal.say(format!(
        "true means known to {:.2} % after {:.0} s",
        100.0 * weighted_rms_se,
        estimates.wall_s
    ));
    let true_mean = |e: &Estimate| TrueMean {
        config: e.config,
        mean: e.mean,
        se: e.standard_error,
    };
    Ok(Truth {
        synthetic: true,
        fabric: a.fabric.clone(),
        model: a.model.clone(),
        parameters: parameters.to_json(),
        configs: estimates.configurations.iter().map(true_mean).collect(),
        weighted_rms_se,
        seed: a.seed,
        program: format!("goniofit {}", env!("CARGO_PKG_VERSION")),
    })
}

/// Reads the true means of an earlier session, which must have been made from the same things.
fn earlier_truth(
    path: &Path,
    a: &Arguments,
    parameters: &Parameters,
    plan: &Plan,
) -> Result<Truth> {
    let truth: Truth = serde_json::from_str(&files::read_text(path)?)
        .context(|| format!("{} is damaged", path.display()))?;
    let differs = if truth.fabric != a.fabric {
        "fabric"
    } else if truth.model != a.model || truth.parameters != parameters.to_json() {
        "model or its parameters"
    } else if truth
        .configs
        .iter()
        .map(|c| c.config)
        .ne(plan.configurations.iter().map(|c| c.id))
    {
        "plan"
    } else {
        return Ok(truth);
    };
    Err(Error::new(format!(
        "{}: the {differs} differs from what is asked for",
        path.display()
    ))
    .with_hint("leave out --truth to render the true means anew"))
}

/// Reads the truth of a session folder, if it is a synthetic one.
pub(crate) fn read_truth(session: &Path) -> Result<Option<Truth>> {
    let path = session.join("truth.json");
    if !path.exists() {
        return Ok(None);
    }
    serde_json::from_str(&files::read_text(&path)?)
        .context(|| format!("{} is damaged", path.display()))
        .map(Some)
}

/// Renders the pictures and puts them in front of the sensor.
fn virtual_camera(
    a: &Arguments,
    scene: &FiberScene,
    plan: &Plan,
    parameters: &Parameters,
    rig: &RigDescription,
    terminal: &Terminal,
) -> Result<VirtualCamera> {
    let mut configurations = plan.configurations.clone();
    if rig.lamp.reference_every > 0 {
        configurations.push(rig.white.configuration(white_id(plan)));
    }
    terminal.say(format!("rendering {} pictures", configurations.len()));
    let request = PictureRequest {
        configurations: &configurations,
        parameters,
        region: scene.tile(),
        resolution: [a.texels; 2],
        effort: PictureEffort::PathsPerPixel(a.texel_paths),
        derivatives: &[],
        seed: a.seed,
    };
    let pictures = scene.pictures(&request, terminal)?;
    let pictures = pictures.into_iter().map(|p| (p.config, p)).collect();
    let white = WhiteReference {
        configuration: rig.white.configuration(0),
        reflectance_factor: rig.white.reflectance_factor,
        reflectance_factor_se: rig.white.reflectance_factor_se,
    };
    let sensor = SensorModel {
        pixel_mm: rig.camera.pixel_mm,
        gain: a.gain,
        read_noise: a.read_noise,
        dark_current: a.dark_current,
        vignetting: a.vignetting,
        faults: PixelFaults {
            nonlinearity: [a.nonlinearity, 0.0],
            response_sd: a.prnu,
            pattern_seed: a.seed,
            ..PixelFaults::default()
        },
        spacing_mm: SPACING_MM,
        bits: if a.bits == "16" {
            crate::session::BitDepth::Sixteen
        } else {
            crate::session::BitDepth::Twelve
        },
        ..SensorModel::default()
    };
    let swatch = Swatch {
        pictures,
        white: white_radiance(&white),
    };
    let camera = VirtualCamera::new(sensor, Box::new(swatch), a.seed)?;
    let (drift, mut lit) = (a.lamp_drift, 0.0_f64);
    Ok(camera.with_lamp(Box::new(move |_| {
        let level = 1.0 + drift * (1.0 - (-lit / 50.0).exp());
        lit += 1.0;
        [level; 3]
    })))
}

/// The fabric's pictures, and the white standard.
struct Swatch {
    pictures: BTreeMap<u32, Picture>,
    white: [f64; 3],
}

impl Appearance for Swatch {
    fn radiance(&self, kind: FrameKind, pose: &Configuration, point_mm: [f64; 2]) -> [f64; 3] {
        match kind {
            FrameKind::White => self.white,
            FrameKind::Sample | FrameKind::Reference => self
                .pictures
                .get(&pose.id)
                .map_or([0.0; 3], |p| p.at(point_mm)),
            FrameKind::Dark | FrameKind::Flat | FrameKind::Chart | FrameKind::Board => [0.0; 3],
        }
    }
}
