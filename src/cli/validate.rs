//! `goniofit validate`.

use super::output::data;
use super::predict::{comparison_json, print_comparison, summary};
use super::{Outcome, fit as fit_command, inputs, render, terminal::Terminal};
use crate::base::{Error, Result};
use crate::fit::{Budget, Comparison, FitResult, Options, Refit, fit, validate};
use crate::render::Plate;
use crate::report::prediction_chart;
use crate::scatter::AnyModel;
use crate::session::{Measurements, files};
use std::path::PathBuf;

/// Seconds of the fit of all measurements when nothing is said.
const USUAL_S: f64 = 60.0;
/// A refit begins at the full fit's result: this part of its paths brings it to rest again.
const REFIT_SHARE: f64 = 0.25;

/// Does the fit predict what it has not seen? Leave configurations out, predict them from the others, compare
///
/// Every configuration is left out in turn (leave one out), or those of --hold-out together. Without --fit all measurements
/// are fitted first. Each refit starts from that result with a quarter of its paths; --fast uses a linear model around it
/// instead (seconds).
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  goniofit validate --measurements M.csv --fabric F.toml --fit fit --fast
  goniofit validate --measurements M.csv --fabric F.toml --fit fit --hold-out 3,7 --json
  goniofit validate --measurements M.csv --fabric F.toml --svg predicted.svg > predicted.csv

Prints a line per configuration left out: predicted and measured means with their errors, residual and z. The rms over all
of them stands beside the rms of the fit itself: how much larger it is tells how much the fit leans on single poses.")]
pub(crate) struct Arguments {
    /// Measured intensities: measurements.csv or measurements.json
    #[arg(long, value_name = "M.csv|M.json")]
    measurements: PathBuf,
    /// Fabric: description (TOML), fibers (.csv) or voxels (.nrrd)
    #[arg(long, value_name = "F")]
    fabric: PathBuf,
    /// The fit of all these measurements (fit.json, or the folder that holds it)
    #[arg(long, value_name = "FIT")]
    fit: Option<PathBuf>,
    /// Scattering model of the fit that is made without --fit
    #[arg(long, default_value = "khungurn", conflicts_with = "fit")]
    model: String,
    /// Leave these configurations out together, instead of each in turn
    #[arg(long, value_name = "ID,..", value_delimiter = ',')]
    hold_out: Vec<u32>,
    /// A linear model around the fit instead of refits
    #[arg(long)]
    fast: bool,
    /// Camera paths of the fit that is made without --fit [default: as many as 60 seconds allow]
    #[arg(long, value_name = "N", conflicts_with = "fit")]
    paths: Option<u64>,
    /// Camera paths of each refit [default: a quarter of the full fit's]
    #[arg(long, value_name = "N", conflicts_with = "fast")]
    refit_paths: Option<u64>,
    /// Camera paths per configuration and render of the predictions (--fast: of the linear model)
    #[arg(long, value_name = "N", default_value_t = 30_000)]
    predict_paths: u64,
    /// Under the cloth: black, open (nothing), white, or an albedo A or R,G,B [default: the fit's, black without one]
    #[arg(long, value_name = "P", value_parser = render::plate)]
    plate: Option<Plate>,
    /// Selects the random streams
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print JSON instead of CSV
    #[arg(long)]
    json: bool,
    /// Draw predicted against measured means
    #[arg(long, value_name = "P.svg")]
    svg: Option<PathBuf>,
    /// Replace an existing drawing
    #[arg(long)]
    force: bool,
}

pub(crate) fn run(a: Arguments) -> Result<Outcome> {
    if let Some(svg) = &a.svg {
        inputs::refuse_overwriting(svg, a.force)?;
    }
    let measurements = Measurements::read(&a.measurements)?;
    let given = a.fit.as_deref().map(inputs::fit_result).transpose()?;
    if let Some(given) = &given {
        check_same(given, &measurements)?;
    }
    let model = AnyModel::named(given.as_ref().map_or(&a.model, |fit| &fit.model))?;
    let plate = match (a.plate, &given) {
        (Some(plate), _) => plate,
        (None, Some(fit)) => fit_command::plate_of(fit)?,
        (None, None) => Plate::Black,
    };
    let (surroundings, _) = fit_command::surroundings_of(&a.measurements, plate)?;
    let scene = render::scene(&a.fabric, model, surroundings)?;
    let terminal = Terminal::new()?;
    let full = match given {
        Some(full) => full,
        None => {
            let budget = Budget {
                time_s: a.paths.is_none().then_some(USUAL_S),
                paths: a.paths,
                accuracy: None,
            };
            fit(
                &*scene,
                &measurements,
                &Options::new(a.seed, budget),
                &terminal,
            )?
        }
    };
    let folds: Vec<Vec<u32>> = if a.hold_out.is_empty() {
        let ids = measurements.intensities.iter();
        ids.map(|i| vec![i.configuration.id]).collect()
    } else {
        vec![a.hold_out.clone()]
    };
    let comparison = validate(
        &*scene,
        &measurements,
        &full,
        &folds,
        &refit(&a, &full),
        a.seed,
        &terminal,
    )?;
    terminal.finish_stage();
    tell(&a, &full, &comparison, &terminal);
    if let Some(svg) = &a.svg {
        files::write_atomic(svg, prediction_chart(&comparison).as_bytes())?;
        terminal.say(format!("wrote {}", svg.display()));
    }
    Ok(Outcome::Done)
}

fn refit(a: &Arguments, full: &FitResult) -> Refit {
    if a.fast {
        return Refit::Linear {
            paths: a.predict_paths,
        };
    }
    let usual = (REFIT_SHARE * full.time.paths as f64) as u64;
    Refit::Search {
        budget: Budget {
            paths: Some(a.refit_paths.unwrap_or(usual)),
            ..Budget::default()
        },
        paths: a.predict_paths,
    }
}

/// Refuses a fit of other configurations.
fn check_same(full: &FitResult, measurements: &Measurements) -> Result<()> {
    let fitted = full.configs.iter().map(|c| c.configuration.id);
    let measured = measurements.intensities.iter().map(|i| i.configuration.id);
    if fitted.eq(measured) {
        return Ok(());
    }
    Err(
        Error::new("the fit is not of these measurements: its configurations are others")
            .with_hint("leave out --fit to fit them here"),
    )
}

fn tell(a: &Arguments, full: &FitResult, comparison: &Comparison, terminal: &Terminal) {
    let o = &full.objective;
    if a.json {
        let mut object = comparison_json(comparison);
        object["fitted_rms_percent"] = o.weighted_rms_percent.into();
        object["fitted_rms_se_percent"] = o.weighted_rms_se_percent.into();
        object["fast"] = a.fast.into();
        data!("{object}");
        return;
    }
    print_comparison(comparison);
    terminal.say(format!("left out: {}", summary(comparison)));
    terminal.say(format!(
        "fitted:   weighted rms residual {:.2} +- {:.2} % over {} configurations",
        o.weighted_rms_percent,
        o.weighted_rms_se_percent,
        full.configs.len()
    ));
}
