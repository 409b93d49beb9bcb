//! `goniofit woven`: cloth as a surface of yarn segments: models and published fabrics, pictures, fits.

pub(super) mod cloth;
mod fit;
mod picture;

use super::Outcome;
use super::output::data;
use crate::base::Result;
use crate::scatter::Parameters;
use crate::scatter::surface::woven::{Layout, PRESETS};
use crate::scatter::surface::{SurfaceModel, models};
use crate::scatter::{ParameterInfo, Unit};
use clap::Subcommand;
use serde_json::{Value, json};

/// Reflectance of woven cloth without path tracing: models, pictures, fits
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  goniofit woven list
  goniofit woven picture --fabric denim --repeats 3,12,48 --out denim.png
  goniofit woven fit measurements.csv --weave '2/1 twill'

docs/woven.md has the formulas and what the models leave out.")]
pub(crate) struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    List(ListArguments),
    Picture(picture::Arguments),
    Fit(fit::Arguments),
}

/// List the reflectance models with their parameters, and the published fabrics
#[derive(clap::Args)]
#[command(after_help = "Examples:
  goniofit woven list
  goniofit woven list --json")]
struct ListArguments {
    /// Print JSON instead of tables
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: Arguments) -> Result<Outcome> {
    match arguments.command {
        Command::List(a) => list(&a)?,
        Command::Picture(a) => return picture::run(&a),
        Command::Fit(a) => return fit::run(&a),
    }
    Ok(Outcome::Done)
}

/// A value as files have it.
fn shown(info: &ParameterInfo, value: f64) -> f64 {
    match info.unit {
        Unit::One => value,
        Unit::Angle => (value.to_degrees() * 1e9).round() / 1e9,
    }
}

fn list(a: &ListArguments) -> Result<()> {
    let models = models(&Layout::plain(0.4)?);
    if a.json {
        let models: Vec<Value> = models.iter().map(|m| model_json(m.as_ref())).collect();
        let fabrics: Vec<Value> = PRESETS
            .iter()
            .map(|p| json!({"name": p.name, "description": p.description, "weave": p.weave}))
            .collect();
        data!("{:#}", json!({"models": models, "fabrics": fabrics}));
        return Ok(());
    }
    for model in &models {
        data!(
            "{} ({} numbers)",
            model.name(),
            Parameters::defaults(&**model).values().len()
        );
        for info in model.parameters() {
            let [low, high, default] =
                [info.lower, info.upper, info.default].map(|v| shown(info, v));
            let colors = if info.per_channel {
                ", per channel"
            } else {
                ""
            };
            data!(
                "  {:<22} {low} .. {high}, default {default}{colors}",
                info.file_key()
            );
        }
    }
    data!("fabrics");
    for p in PRESETS {
        data!("  {:<22} {}; {}", p.name, p.weave, p.description);
    }
    Ok(())
}

fn model_json(model: &dyn SurfaceModel) -> Value {
    let parameters: Vec<Value> = model
        .parameters()
        .iter()
        .map(|info| {
            json!({
                "name": info.file_key(),
                "per_channel": info.per_channel,
                "lower": shown(info, info.lower),
                "upper": shown(info, info.upper),
            })
        })
        .collect();
    json!({
        "name": model.name(),
        "numbers": Parameters::defaults(model).values().len(),
        "parameters": parameters,
        "defaults": Parameters::defaults(model).to_json(),
    })
}
