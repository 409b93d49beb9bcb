//! `goniofit woven fit`.

use super::cloth::Cloth;
use crate::base::{Error, Result};
use crate::cli::Outcome;
use crate::cli::output::data;
use crate::cli::terminal::Terminal;
use crate::fit::surface::{SurfaceOptions, SurfaceResult, surface_ladder};
use crate::scatter::surface::{directional_albedo, model, models};
use crate::scatter::{CHANNELS, Parameters, Unit};
use crate::session::Measurements;
use serde_json::{Value, json};
use std::path::PathBuf;

/// Residual up to which a model is said to explain the cloth.
const ADEQUATE: f64 = 0.05;

/// Fit reflectance models of a woven cloth to measurements
#[derive(clap::Args)]
#[command(after_help = "\
Without --model all models are fitted, from Lambert's law to yarns of two kinds, and the one that says most per number is marked. It
is the best of these, not a good one: the residual says that. The sizes of the segments come from the cloth and are not fitted.

Exit code 1 when the residual of the best model is above 5 %.

Examples:
  goniofit woven fit measurements.csv --weave '2/1 twill' --pitch-mm 0.4,0.35
  goniofit woven fit measurements.csv --fabric gabardine --model woven-19 --json > fit.json
  goniofit woven fit measurements.csv --weave plain --smoothing 0.5 --model woven-9 --hold twist_deg=0")]
pub(super) struct Arguments {
    /// Mean intensities, measurements.csv
    measurements: PathBuf,
    #[command(flatten)]
    cloth: Cloth,
    /// One model (see `goniofit woven list`) instead of all
    #[arg(long)]
    model: Option<String>,
    /// Keep a parameter of --model as measured otherwise, such as twist_deg=-30; may be repeated
    #[arg(long, value_name = "NAME=VALUE", requires = "model")]
    hold: Vec<String>,
    /// Seed of the random starts
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print JSON instead of tables
    #[arg(long)]
    json: bool,
}

/// `twist_deg=-30` as name and value inside.
fn held(text: &str) -> Result<(String, f64)> {
    let parts = text
        .split_once('=')
        .map(|(name, v)| (name.trim(), v.trim().parse::<f64>()));
    let Some((name, Ok(value))) = parts else {
        return Err(Error::new(format!("--hold '{text}': expected NAME=VALUE"))
            .with_hint("for example --hold twist_deg=-30"));
    };
    Ok(match name.strip_suffix("_deg") {
        Some(own) => (own.to_owned(), value.to_radians()),
        None => (name.to_owned(), value),
    })
}

pub(super) fn run(a: &Arguments) -> Result<Outcome> {
    let measurements = Measurements::read(&a.measurements)?;
    let layout = a
        .cloth
        .repeat()?
        .layout()?
        .with_smoothing(a.cloth.smoothing()?);
    let options = SurfaceOptions {
        seed: a.seed,
        held: a.hold.iter().map(|h| held(h)).collect::<Result<_>>()?,
        ..SurfaceOptions::default()
    };
    let models = match &a.model {
        Some(name) => vec![model(name, &layout)?],
        None => models(&layout),
    };
    // Measured: half a millisecond per number and model on two cores.
    let expected_s = 5e-4 * (measurements.n_numbers() * models.len()) as f64;
    let terminal = Terminal::new()?;
    let (results, best) = terminal.with_progress("fitting", expected_s, || {
        surface_ladder(&models, &measurements, &options)
    })?;
    let albedos: Vec<[f64; CHANNELS]> = results
        .iter()
        .map(|r| {
            let surface = model(r.model, &layout)?.prepare(&r.parameters)?;
            Ok(directional_albedo(surface.as_ref(), glam::DVec3::Z, 24))
        })
        .collect::<Result<_>>()?;
    if a.json {
        let all: Vec<Value> = results
            .iter()
            .zip(&albedos)
            .map(|(r, a)| in_json(r, a))
            .collect();
        data!("{:#}", json!({"models": all, "best": results[best].model}));
    } else {
        print(&results, &albedos, best);
    }
    Ok(if results[best].residual > ADEQUATE {
        Outcome::OutsideTolerance
    } else {
        Outcome::Done
    })
}

/// Value and half width as files have them, by flat name.
fn shown(parameters: &Parameters, place: usize, value: f64) -> f64 {
    let (row, _) = parameters.places()[place];
    match parameters.infos()[row].unit {
        Unit::One => value,
        Unit::Angle => value.to_degrees(),
    }
}

fn in_json(r: &SurfaceResult, albedo: &[f64; CHANNELS]) -> Value {
    let intervals: Vec<Value> = r
        .intervals
        .iter()
        .enumerate()
        .map(|(k, i)| {
            json!({
                "name": i.name,
                "value": shown(&r.parameters, k, i.value),
                "half_width_95": i.half_width.map(|h| shown(&r.parameters, k, h)),
                "at_bound": i.at_bound,
                "identified": i.identified,
            })
        })
        .collect();
    let rivals: Vec<Value> = r
        .rivals
        .iter()
        .map(|v| json!({"parameters": v.parameters.to_json(), "residual": v.residual, "swapped": v.swapped}))
        .collect();
    json!({
        "model": r.model,
        "parameters": r.parameters.to_json(),
        "residual": r.residual,
        "adequate": r.residual <= ADEQUATE,
        "aicc": r.aicc,
        "numbers": r.counts[0],
        "numbers_at_distinct_geometries": r.counts[1],
        "free_parameters": r.counts[2],
        "starts": r.starts[0],
        "starts_that_agree": r.starts[1],
        "albedo_at_normal_incidence": albedo,
        "intervals": intervals,
        "rivals": rivals,
    })
}

fn print(results: &[SurfaceResult], albedos: &[[f64; CHANNELS]], best: usize) {
    data!("model      numbers  residual      AICc  starts that agree");
    for (k, r) in results.iter().enumerate() {
        let mark = if k == best {
            "  <- says most per number"
        } else {
            ""
        };
        data!(
            "{:<10} {:>7} {:>8.2} % {:>9.1}  {} of {}{mark}",
            r.model,
            r.counts[2],
            100.0 * r.residual,
            r.aicc,
            r.starts[1],
            r.starts[0]
        );
    }
    let r = &results[best];
    let verdict = if r.residual <= ADEQUATE {
        "explains"
    } else {
        "does not explain"
    };
    data!(
        "\n{} {verdict} the measurements to {} %",
        r.model,
        100.0 * ADEQUATE
    );
    for (k, i) in r.intervals.iter().enumerate() {
        let value = shown(&r.parameters, k, i.value);
        let (row, _) = r.parameters.places()[k];
        let unit = match r.parameters.infos()[row].unit {
            Unit::One => "",
            Unit::Angle => " deg",
        };
        let known = match (i.half_width, i.at_bound) {
            (_, true) => "at its bound".to_owned(),
            (Some(h), _) => {
                let note = if i.identified { "" } else { ", not identified" };
                format!("+- {:.3}{note}", shown(&r.parameters, k, h))
            }
            (None, _) => "held, or not determined".to_owned(),
        };
        data!("  {:<20} {value:>9.4}{unit:<4} {known}", i.name);
    }
    let [red, green, blue] = albedos[best];
    data!("  albedo at normal incidence {red:.3} {green:.3} {blue:.3}");
    if albedos[best].iter().any(|a| *a > 1.0) {
        data!("  above 1: the measurements do not hold the highlights in check");
    }
    for v in &r.rivals {
        let what = if v.swapped {
            ", warp and weft exchanged"
        } else {
            ""
        };
        data!(
            "  another optimum at {:.2} %{what}: {}",
            100.0 * v.residual,
            v.parameters.to_json()
        );
    }
}
