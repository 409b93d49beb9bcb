//! `goniofit fit`.

mod ladder;
pub(crate) mod resume;
mod schedule;

use super::output::data;
use super::{Outcome, inputs, render, terminal::Terminal};
use crate::base::{Error, Result, Watch};
use crate::fit::{
    Bounds, Budget, FitResult, Journal, Loss, Method, Options, TAU, fit_with_journal,
};
use crate::render::{FiberSceneOptions, Plate, Scene};
use crate::report::{Provenance, page};
use crate::scatter::{AnyModel, Parameters, Parametric};
use crate::session::{Measurements, files};
use resume::{Begun, What};
pub(crate) use schedule::Schedule;
use std::path::{Path, PathBuf};

/// Find the model parameters that reproduce measured intensities
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  goniofit fit --measurements session/measurements.csv --fabric fabrics/gabardine.toml --out fit
  goniofit fit --measurements M.csv --fabric F.toml --seed 7 --paths 5000000 --out fit --json
  goniofit fit --measurements M.csv --fabric F.toml --accuracy 1% --time 10m --start fit/fit.json --out finer
  goniofit fit --measurements M.csv --fabric F.toml --loss huber:2 --gain-prior 5% --out trusting
  goniofit fit --measurements M.csv --fabric F.toml --per-system --start fit/fit.json --out warp_and_weft
  goniofit fit --measurements M.csv --fabric F.toml --method sgd --paths 50000000 --out published
  goniofit fit --measurements M.csv --fabric F.toml --bound c_r=0.04..1 --tau 0.05 --plate white --out velvet
  goniofit fit --measurements M.csv --fabric voxels.toml --model microflake --method binary-search --out flakes
  goniofit fit --measurements M.csv --fabric F.toml --model auto --tolerance 3% --out ladder
  goniofit fit --resume published
  goniofit fit --resume fit --time 10m
  goniofit fit --measurements M.csv --fabric F.toml --method adam --rates 0.2 --iterations 300 --time 10m --out adam

Methods: gauss-newton; sgd, the search of Khungurn et al. 2015 (six learning rates a of 60 iterations each, in rescaled
parameters; in full size --iteration-paths 8388608 --paths 6200000000); adam (Kingma and Ba 2015); binary-search, the published
27 renders for --model microflake (docs/fit.md). The last three work off a fixed schedule: the limit shares out the paths of an iteration, unless --iteration-paths says how many.

--model auto takes no more model than the measurements need (docs/ladder.md): Lambert, GGX, woven BRDFs, and only when none of
them is good enough path-traced ones, each with the limits given. Good enough is what reaches the noise or --tolerance (or
--accuracy, where that is smaller). It writes ladder.json, ladder.html and a folder per path-traced model; exit code 1 when no
model is good enough. --model lambert, ggx, woven-9, woven-11 or woven-19 tries that one alone.

--bound keeps a parameter (docs/models.md: c_r, or one channel, c_r.g; angles in degrees) inside narrower bounds than the
model's own; several hold together. Intervals, verdicts, fit.json and refits keep to them.

Cells of measurements.csv that are empty were not measured; a camera with one channel has columns g, g_se only. --loss huber:K
lets configurations count less whose residual is more than K times a usual one; --gain-prior fits a scale of all measurements.

Without a limit a fit ends after 60 seconds, or earlier when Monte Carlo noise adds little to the measurement errors.
The same seed and --paths give the same numbers on any number of threads; a fit limited by time does not repeat exactly.
Writes fit.json, report.html and renders.jsonl, all render pairs, into --out. --resume goes on from that file after an
interrupt or a crash, to the same result. Limits given with it replace all earlier ones: the result is that of a fit begun
with them, and every pair that it shares with the earlier one is not rendered again.
Exit code 1: finished, but not converged, or interrupted with the best so far; fit.json says why. 130: interrupted before
there was any result.")]
pub(crate) struct Arguments {
    #[command(flatten)]
    what: What,
    /// Folder for fit.json, report.html and renders.jsonl
    #[arg(long, value_name = "DIR", required_unless_present = "resume")]
    out: Option<PathBuf>,
    /// Replace an earlier fit in --out
    #[arg(long)]
    force: bool,
    /// Print fit.json (--model auto: ladder.json) instead of a table
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    ladder: ladder::LadderArguments,
}

/// A fit as it is asked for, on a command line or in a list of work.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct Asked {
    /// Measured intensities: measurements.csv or measurements.json
    #[arg(long, value_name = "M.csv|M.json")]
    pub(crate) measurements: PathBuf,
    /// Fabric: description (TOML), fibers (.csv) or voxels (.nrrd)
    #[arg(long, value_name = "F")]
    pub(crate) fabric: PathBuf,
    /// Scattering model; auto: the simplest that the measurements need
    #[arg(long, default_value = MODEL)]
    pub(crate) model: String,
    /// Parameters of their own for warp and weft: the model called <MODEL>-per-system
    #[arg(long)]
    pub(crate) per_system: bool,
    /// How to search: gauss-newton, sgd, adam, or binary-search (microflakes)
    #[arg(long, default_value = METHOD)]
    pub(crate) method: String,
    /// Selects the random streams
    #[arg(long, default_value_t = SEED)]
    pub(crate) seed: u64,
    /// Where to begin: a parameter file or an earlier fit.json; the published defaults when left out
    #[arg(long, value_name = "P.json")]
    pub(crate) start: Option<PathBuf>,
    /// Rendering time, e.g. 60s, 5m or 1h
    #[arg(long, value_name = "T", value_parser = seconds)]
    pub(crate) time: Option<f64>,
    /// Camera paths in all: reproducible
    #[arg(long, value_name = "N")]
    pub(crate) paths: Option<u64>,
    /// Monte Carlo part of the weighted rms error of the fitted intensities to reach, e.g. 1% or 0.01
    #[arg(long, value_name = "A", value_parser = inputs::fraction)]
    pub(crate) accuracy: Option<f64>,
    /// Weighted rms residual above which the model is said not to explain the measurements
    #[arg(long, value_name = "A", value_parser = inputs::fraction, default_value = TOLERANCE)]
    pub(crate) tolerance: f64,
    /// How residuals count: squared, or huber:K, which lets outlying configurations count less
    #[arg(long, default_value = LOSS)]
    pub(crate) loss: String,
    /// Fit a gain common to all measurements too, known beforehand to be 1 within this, e.g. 5%
    #[arg(long, value_name = "S", value_parser = inputs::fraction)]
    pub(crate) gain_prior: Option<f64>,
    /// Brightness below which configurations get no more weight (Khungurn 2015 eq. 20)
    #[arg(long, value_name = "T", value_parser = tau, default_value_t = TAU)]
    pub(crate) tau: f64,
    /// Bounds of a parameter narrower than the model's own, e.g. c_r=0.04..1; repeat for others
    #[arg(long = "bound", value_name = "NAME=LOW..HIGH")]
    pub(crate) bounds: Vec<String>,
    /// Under the cloth: black, open (nothing), white, or a diffuse surface of albedo A or R,G,B
    #[arg(long, value_name = "P", default_value = PLATE, value_parser = render::plate)]
    pub(crate) plate: Plate,
    #[command(flatten)]
    pub(crate) schedule: Schedule,
}

/// What is fitted, and how, when nothing is said.
pub(crate) const MODEL: &str = "khungurn";
pub(crate) const METHOD: &str = "gauss-newton";
pub(crate) const SEED: u64 = 1;
pub(crate) const TOLERANCE: &str = "5%";
pub(crate) const LOSS: &str = "squared";
pub(crate) const PLATE: &str = "black";

/// Parses `60s`, `5m`, `1h` or plain seconds.
pub(crate) fn seconds(text: &str) -> Result<f64, String> {
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

/// Parses where the weight of dark configurations stops growing.
pub(crate) fn tau(text: &str) -> Result<f64, String> {
    match text.trim().parse::<f64>() {
        Ok(x) if x > 0.0 && x <= 1.0 => Ok(x),
        _ => Err(format!(
            "'{text}' is not a normalized radiance above 0 and at most 1; the published value is {TAU}"
        )),
    }
}

/// A fit's inputs, read and checked.
pub(crate) struct Ready {
    scene: Box<dyn Scene>,
    measurements: Measurements,
    options: Options,
    synthetic: Option<bool>,
    /// What bounds change that would surprise.
    pub(crate) notes: Vec<String>,
}

impl Ready {
    fn model(&self) -> &'static dyn Parametric {
        self.scene.model()
    }
}

impl Asked {
    /// The limits asked for, completed: a minute when there are none, ten when only an accuracy is given.
    pub(crate) fn budget(&self) -> Budget {
        let time_s = match (self.time, self.paths, self.accuracy) {
            (None, None, None) => Some(60.0),
            (None, None, Some(_)) => Some(600.0),
            (time, _, _) => time,
        };
        Budget {
            time_s,
            paths: self.paths,
            accuracy: self.accuracy,
        }
    }

    /// Reads everything the fit needs and builds its scene.
    pub(crate) fn read(&self) -> Result<Ready> {
        let mut any = AnyModel::named(&self.model)?;
        if self.per_system {
            any = any.per_system()?;
        }
        let model = any.parametric();
        let start = self.start.as_deref();
        let mut options = Options {
            method: Method::named(&self.method)?,
            start: start.map(|p| inputs::parameters(p, model)).transpose()?,
            tolerance: self.tolerance,
            loss: Loss::named(&self.loss)?,
            tau: self.tau,
            bounds: Bounds::parse(&self.bounds)?,
            gain_prior: self.gain_prior,
            ..Options::new(self.seed, self.budget())
        };
        self.schedule.apply(&mut options)?;
        let defaults = Parameters::defaults(model);
        let notes = (options.bounds).notes(options.start.as_ref().unwrap_or(&defaults))?;
        let (measurements, stated) = Measurements::read_with_origin(&self.measurements)?;
        let (surroundings, of_session) = self.surroundings()?;
        Ok(Ready {
            scene: render::scene(&self.fabric, any, surroundings)?,
            measurements,
            options,
            notes,
            // Either may say so: the file, wherever it lies, or the session it lies in.
            synthetic: match (stated, of_session) {
                (Some(a), Some(b)) => Some(a || b),
                (a, b) => a.or(b),
            },
        })
    }

    /// See [`surroundings_of`].
    pub(crate) fn surroundings(&self) -> Result<(FiberSceneOptions, Option<bool>)> {
        surroundings_of(&self.measurements, self.plate)
    }

    /// The fit of what was read; `command` is the one that repeats it.
    pub(crate) fn fit(
        &self,
        ready: &Ready,
        command: String,
        journal: &Journal,
        watch: &dyn Watch,
    ) -> Result<FitResult> {
        let Ready {
            scene,
            measurements,
            options,
            ..
        } = ready;
        let result = fit_with_journal(&**scene, measurements, options, Some(journal), watch)?;
        Ok(FitResult {
            fabric: self.fabric.display().to_string(),
            measurements: self.measurements.display().to_string(),
            plate: Some(render::plate_in_words(self.plate)),
            synthetic: ready.synthetic,
            command,
            ..result
        })
    }

    /// Takes relative paths as seen from `folder`.
    fn seen_from(&mut self, folder: &Path) {
        self.measurements = folder.join(&self.measurements);
        self.fabric = folder.join(&self.fabric);
        self.start = self.start.as_ref().map(|start| folder.join(start));
    }

    /// The command line that does this fit.
    pub(crate) fn command(&self, out: &Path) -> String {
        quoted(self.words(out).into_iter())
    }

    /// The words of that command line.
    pub(crate) fn words(&self, out: &Path) -> Vec<String> {
        let mut words = vec!["fit".to_owned()];
        let mut option = |name: &str, value: Option<String>| {
            words.extend(
                value
                    .map(|v| [format!("--{name}"), v])
                    .into_iter()
                    .flatten(),
            );
        };
        let path = |p: &Path| Some(p.display().to_string());
        option("measurements", path(&self.measurements));
        option("fabric", path(&self.fabric));
        option("model", Some(self.model.clone()));
        option("method", Some(self.method.clone()));
        option("seed", Some(self.seed.to_string()));
        option("start", self.start.as_deref().and_then(path));
        option("time", self.time.map(|t| format!("{t}s")));
        option("paths", self.paths.map(|n| n.to_string()));
        option("accuracy", self.accuracy.map(|a| a.to_string()));
        option("tolerance", Some(self.tolerance.to_string()));
        option("loss", Some(self.loss.clone()));
        option("gain-prior", self.gain_prior.map(|s| s.to_string()));
        option("tau", Some(self.tau.to_string()));
        for bound in &self.bounds {
            option("bound", Some(bound.clone()));
        }
        option("plate", Some(render::plate_in_words(self.plate)));
        let schedule = &self.schedule;
        option(
            "iteration-paths",
            schedule.iteration_paths.map(|n| n.to_string()),
        );
        option("iterations", schedule.iterations.map(|n| n.to_string()));
        let rates: Vec<String> = schedule.rates.iter().map(f64::to_string).collect();
        option("rates", (!rates.is_empty()).then(|| rates.join(",")));
        option("out", path(out));
        if self.per_system {
            words.push("--per-system".to_owned());
        }
        words
    }
}

/// The light and the sample square, those of the session the measurements lie in or beside, if any; and whether that session
/// is synthetic. Under the cloth is `plate`.
pub(crate) fn surroundings_of(
    measurements: &Path,
    plate: Plate,
) -> Result<(FiberSceneOptions, Option<bool>)> {
    let folder = measurements.parent();
    let folder = folder.filter(|p| !p.as_os_str().is_empty());
    let session = inputs::session(folder.unwrap_or(Path::new("."))).ok();
    let options = session.as_ref().map(render::surroundings_of).transpose()?;
    let manifest = session.and_then(|s| s.manifest().ok());
    let options = FiberSceneOptions {
        plate,
        ..options.unwrap_or_default()
    };
    Ok((options, manifest.map(|m| m.synthetic)))
}

/// What lay under the cloth in an earlier fit.
pub(crate) fn plate_of(result: &FitResult) -> Result<Plate> {
    let text = result.plate.as_deref().unwrap_or(PLATE);
    render::plate(text).map_err(|fault| Error::new(format!("the fit's plate: {fault}")))
}

/// Where a fit's files lie in its folder: `fit.json` and `report.html`.
pub(crate) fn files_in(folder: &Path) -> [PathBuf; 2] {
    ["fit.json", "report.html"].map(|name| folder.join(name))
}

/// Writes both files of a fit, each whole or not at all.
pub(crate) fn write(result: &FitResult, folder: &Path, force: bool) -> Result<()> {
    let [fit_path, page_path] = files_in(folder);
    result.write(&fit_path, force)?;
    files::write_atomic(&page_path, page(result, &Provenance::default()).as_bytes())
}

pub(crate) fn run(a: Arguments) -> Result<Outcome> {
    let terminal = Terminal::new()?;
    if let (What::New(asked), Some(out)) = (&a.what, &a.out)
        && ladder::is_meant(&asked.model)
    {
        return ladder::run(asked, out, &a, &terminal);
    }
    a.ladder.refuse()?;
    let begun = match (a.what, a.out) {
        (What::Resume(again), _) => Begun::again(again, &terminal)?,
        (What::New(asked), out) => Begun::new(*asked, out.unwrap_or_default(), a.force)?,
    };
    for note in &begun.ready.notes {
        terminal.say(note);
    }
    let (asked, command) = (&begun.asked, begun.command.clone());
    let fitted = asked.fit(&begun.ready, command, &begun.journal, &terminal);
    terminal.finish_stage();
    let resuming = begun.resuming();
    let result = match fitted {
        Err(error) if terminal.cancelled() => {
            terminal.say(format!(
                "interrupted before there was a result: {}",
                error.report()
            ));
            terminal.say(format!("what was rendered is kept; {resuming} goes on"));
            return Ok(Outcome::Interrupted);
        }
        fitted => fitted?,
    };
    write(&result, &begun.folder, begun.replace)?;
    if a.json {
        data!("{}", result.to_json()?.trim_end());
    } else {
        print_table(&result);
    }
    let [fit_path, page_path] = files_in(&begun.folder);
    terminal.say(format!(
        "wrote {} and {}",
        fit_path.display(),
        page_path.display()
    ));
    Ok(if result.converged {
        Outcome::Done
    } else {
        terminal.say(format!("not converged: {}", result.reason));
        if terminal.cancelled() {
            terminal.say(format!("{resuming} goes on"));
        }
        Outcome::OutsideTolerance
    })
}

/// The command as typed, quoted for a shell.
pub(crate) fn command_line() -> String {
    let words = std::env::args_os().skip(1);
    quoted(words.map(|w| w.to_string_lossy().into_owned()))
}

/// A command line of this program, quoted for a shell.
fn quoted(words: impl Iterator<Item = String>) -> String {
    let quoted = |word: String| {
        let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=:,%+@".contains(c);
        if !word.is_empty() && word.chars().all(plain) {
            word
        } else {
            format!("'{}'", word.replace('\'', "'\\''"))
        }
    };
    std::iter::once("goniofit".to_owned())
        .chain(words.map(quoted))
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
            "{:<13} {:>8.4} {:>9.4} to {:<9.4} {:>7.3} to {:<7.3} {:<3} {}",
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
    if let Some(gain) = &result.gain {
        data!("{}", gain.sentence);
    }
    if let Some(outliers) = result.outliers_in_words() {
        data!("{outliers}");
    }
    let o = &result.objective;
    data!(
        "weighted rms residual {:.2} +- {:.2} % over {} numbers; measurement errors alone leave {:.2} %",
        o.weighted_rms_percent,
        o.weighted_rms_se_percent,
        o.n,
        o.measurement_rms_percent
    );
    if let Some(goodness) = &result.goodness {
        data!("{}", goodness.sentence);
    }
    for pattern in result.patterns.iter().filter(|p| p.significant) {
        data!("{}", pattern.sentence);
    }
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
    fn tau_is_a_normalized_radiance() {
        for (text, expected) in [("0.02", 0.02), ("1", 1.0), ("1e-4", 1e-4)] {
            assert!((tau(text).unwrap() - expected).abs() < 1e-12, "{text}");
        }
        for bad in ["0", "-0.02", "nan", "inf", "1.01", "2%", ""] {
            assert!(tau(bad).is_err(), "{bad}");
        }
    }

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
