//! `goniofit fit`.

use super::output::data;
use super::{Outcome, inputs, render, terminal::Terminal};
use crate::base::{Error, Result};
use crate::fit::{Budget, FitResult, Method, Options, fit, refuse_existing};
use crate::report::{Provenance, page};
use crate::scatter;
use crate::session::{Measurements, SessionFolder, files};
use std::path::{Path, PathBuf};

/// Find the model parameters that reproduce measured intensities
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  goniofit fit --measurements session/measurements.csv --fabric fabrics/gabardine.toml --out fit
  goniofit fit --measurements M.csv --fabric F.toml --seed 7 --paths 5000000 --out fit --json
  goniofit fit --measurements M.csv --fabric F.toml --accuracy 1% --time 10m --start fit/fit.json --out finer
  goniofit fit --measurements M.csv --fabric F.toml --method sgd --paths 50000000 --out published
  goniofit fit --measurements M.csv --fabric F.toml --method adam --rates 0.2 --iterations 300 --time 10m --out adam

Methods: gauss-newton; sgd, the search of Khungurn et al. 2015 (six learning rates a of 60 iterations each, in rescaled
parameters; in full size --iteration-paths 8388608 --paths 6200000000); adam (Kingma and Ba 2015). The last two work off a
fixed schedule: the limit shares out the paths of an iteration, unless --iteration-paths says how many.

Without a limit a fit ends after 60 seconds, or earlier when Monte Carlo noise adds little to the measurement errors.
The same seed and --paths give the same numbers on any number of threads; a fit limited by time does not repeat exactly.
Writes fit.json and report.html into --out. Exit code 1: finished, but not converged; fit.json says why.")]
pub(crate) struct Arguments {
    /// Measured intensities: measurements.csv or measurements.json
    #[arg(long, value_name = "M.csv|M.json")]
    measurements: PathBuf,
    /// Fabric description (TOML)
    #[arg(long, value_name = "F.toml")]
    fabric: PathBuf,
    /// Scattering model
    #[arg(long, default_value = "khungurn")]
    model: String,
    /// How to search: gauss-newton, sgd or adam
    #[arg(long, default_value = "gauss-newton")]
    method: String,
    #[command(flatten)]
    schedule: Schedule,
    /// Selects the random streams
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Where to begin: a parameter file or an earlier fit.json; the published defaults when left out
    #[arg(long, value_name = "P.json")]
    start: Option<PathBuf>,
    /// Rendering time, e.g. 60s, 5m or 1h
    #[arg(long, value_name = "T", value_parser = seconds)]
    time: Option<f64>,
    /// Camera paths in all: reproducible
    #[arg(long, value_name = "N")]
    paths: Option<u64>,
    /// Monte Carlo part of the weighted rms error of the fitted intensities to reach, e.g. 1% or 0.01
    #[arg(long, value_name = "A", value_parser = inputs::fraction)]
    accuracy: Option<f64>,
    /// Weighted rms residual above which the model is said not to explain the measurements
    #[arg(long, value_name = "A", value_parser = inputs::fraction, default_value = "5%")]
    tolerance: f64,
    /// Folder for fit.json and report.html
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Replace an earlier fit in --out
    #[arg(long)]
    force: bool,
    /// Print fit.json instead of a table
    #[arg(long)]
    json: bool,
}

const SCHEDULE: &str = "Schedule (sgd and adam)";

/// What only the methods with a fixed schedule are asked.
#[derive(clap::Args)]
struct Schedule {
    /// Camera paths of one iteration, both renders together [default: so that all iterations fit in the limit]
    #[arg(long, value_name = "N", help_heading = SCHEDULE)]
    iteration_paths: Option<u64>,
    /// Iterations of each run [default: 60 for sgd, 200 for adam]
    #[arg(long, value_name = "N", help_heading = SCHEDULE)]
    iterations: Option<u32>,
    /// Learning rates: the multipliers a that sgd tries, or adam's first step [default: 0.25,1,4,16,64,256 or 0.3]
    #[arg(long, value_name = "A,...", value_delimiter = ',', help_heading = SCHEDULE)]
    rates: Vec<f64>,
}

impl Schedule {
    fn apply(&self, options: &mut Options) -> Result<()> {
        options.iteration_paths = self.iteration_paths;
        let asked = self.iterations.is_some() || !self.rates.is_empty();
        match (options.method, self.rates.as_slice()) {
            (Method::GaussNewton, _) if asked || self.iteration_paths.is_some() => {
                return Err(
                    Error::new("gauss-newton has no schedule of iterations and rates").with_hint(
                        "--iteration-paths, --iterations and --rates go with --method sgd or adam",
                    ),
                );
            }
            (Method::Sgd, rates) if !rates.is_empty() => options.sgd.rates = rates.to_vec(),
            (Method::Adam, [rate]) => options.adam.rate = *rate,
            (Method::Adam, [_, _, ..]) => {
                return Err(Error::new("adam takes one learning rate, not a list")
                    .with_hint("write e.g. --rates 0.3"));
            }
            _ => {}
        }
        if let Some(iterations) = self.iterations {
            options.sgd.iterations = iterations;
            options.adam.iterations = iterations;
        }
        Ok(())
    }
}

/// Parses `60s`, `5m`, `1h` or plain seconds.
fn seconds(text: &str) -> Result<f64, String> {
    let scale = |suffix: &str| match suffix {
        "s" => 1.0,
        "m" => 60.0,
        _ => 3600.0,
    };
    let (number, scale) = ["s", "m", "h"]
        .into_iter()
        .find_map(|unit| Some((text.strip_suffix(unit)?, scale(unit))))
        .unwrap_or((text, 1.0));
    match number.trim_end().parse::<f64>() {
        Ok(x) if (1e-3..1e9).contains(&(x * scale)) => Ok(x * scale),
        _ => Err(format!("'{text}' is not a time; write 60s, 5m or 1h")),
    }
}

/// The limits asked for, completed: a minute when there are none, ten when only an accuracy is given.
fn budget(a: &Arguments) -> Budget {
    let time_s = match (a.time, a.paths, a.accuracy) {
        (None, None, None) => Some(60.0),
        (None, None, Some(_)) => Some(600.0),
        (time, _, _) => time,
    };
    Budget {
        time_s,
        paths: a.paths,
        accuracy: a.accuracy,
    }
}

pub(crate) fn run(a: Arguments) -> Result<Outcome> {
    let (fit_path, page_path) = (a.out.join("fit.json"), a.out.join("report.html"));
    if !a.force {
        refuse_existing(&fit_path)?;
    }
    let model = scatter::model(&a.model)?;
    let mut options = Options {
        method: Method::named(&a.method)?,
        start: a.start.as_deref().map(|p| start(p, model)).transpose()?,
        tolerance: a.tolerance,
        ..Options::new(a.seed, budget(&a))
    };
    a.schedule.apply(&mut options)?;
    let (measurements, synthetic) = Measurements::read_with_origin(&a.measurements)?;
    inputs::prepare_folder(&a.out)?;
    let terminal = Terminal::new()?;
    // The light and the sample square are those of the session the measurements lie in or beside.
    let session = session(&a.measurements);
    let surroundings = session
        .as_ref()
        .map(render::surroundings_of)
        .transpose()?
        .unwrap_or_default();
    let scene = render::fiber_scene(&a.fabric, model, surroundings)?;
    let mut result = fit(&scene, &measurements, &options, &terminal)?;
    terminal.finish_stage();
    result.fabric = a.fabric.display().to_string();
    result.measurements = a.measurements.display().to_string();
    // Either may say so: the file, wherever it lies, or the session it lies in.
    let of_session = session.and_then(|s| s.manifest().ok()).map(|m| m.synthetic);
    result.synthetic = match (synthetic, of_session) {
        (Some(a), Some(b)) => Some(a || b),
        (a, b) => a.or(b),
    };
    result.command = command_line();

    result.write(&fit_path, a.force)?;
    files::write_atomic(&page_path, page(&result, &Provenance::default()).as_bytes())?;
    if a.json {
        data!("{}", result.to_json()?.trim_end());
    } else {
        print_table(&result);
    }
    terminal.say(format!(
        "wrote {} and {}",
        fit_path.display(),
        page_path.display()
    ));
    Ok(if result.converged {
        Outcome::Done
    } else {
        terminal.say(format!("not converged: {}", result.reason));
        Outcome::OutsideTolerance
    })
}

/// Reads a parameter file, or the parameters of an earlier fit.
fn start(path: &Path, model: &dyn scatter::Model) -> Result<scatter::Parameters> {
    inputs::parameters(path, model)
}

/// The session the measurements lie in or beside, if any.
fn session(measurements: &Path) -> Option<SessionFolder> {
    let folder = measurements.parent().filter(|p| !p.as_os_str().is_empty());
    inputs::session(folder.unwrap_or(Path::new("."))).ok()
}

/// The command as typed, quoted for a shell.
pub(crate) fn command_line() -> String {
    let quoted = |word: String| {
        let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=:,%+@".contains(c);
        if !word.is_empty() && word.chars().all(plain) {
            word
        } else {
            format!("'{}'", word.replace('\'', "'\\''"))
        }
    };
    let words = std::env::args_os()
        .skip(1)
        .map(|w| quoted(w.to_string_lossy().into_owned()));
    std::iter::once("goniofit".to_owned())
        .chain(words)
        .collect::<Vec<_>>()
        .join(" ")
}

/// The fit as a table for people.
pub(crate) fn print_table(result: &FitResult) {
    if result.synthetic == Some(true) {
        data!("SYNTHETIC measurements: rendered, not photographed");
    }
    data!("parameter        value     95 % interval        bounds            verdict");
    for p in &result.uncertainty {
        let unit = if p.unit == "1" { "" } else { "deg" };
        data!(
            "{:<10} {:>11.4} {:>9.4} to {:<9.4} {:>7.3} to {:<7.3} {:<3} {}",
            p.name,
            p.value,
            p.interval_95[0],
            p.interval_95[1],
            p.lower_bound,
            p.upper_bound,
            unit,
            p.verdict.words()
        );
    }
    let o = &result.objective;
    data!(
        "weighted rms residual {:.2} +- {:.2} % over {} numbers; measurement errors alone leave {:.2} %",
        o.weighted_rms_percent,
        o.weighted_rms_se_percent,
        o.n,
        o.measurement_rms_percent
    );
    data!(
        "{}: {} ({} camera paths, {:.1} s, {:.1} s CPU)",
        if result.converged {
            "converged"
        } else {
            "not converged"
        },
        result.reason,
        result.time.paths,
        result.time.wall_s,
        result.time.cpu_s
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_wear_units() {
        for (text, expected) in [("60s", 60.0), ("5m", 300.0), ("1h", 3600.0), ("2.5", 2.5)] {
            assert!((seconds(text).unwrap() - expected).abs() < 1e-9, "{text}");
        }
        for bad in ["", "s", "-3s", "nan", "5 days", "0"] {
            assert!(seconds(bad).is_err(), "{bad}");
        }
    }
}
