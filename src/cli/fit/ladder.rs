//! `goniofit fit --model auto`: the simplest model that the measurements need.

use super::resume::{header, journal_in, working_folder};
use super::{Asked, LOSS, Loss, command_line, write};
use crate::base::{Context, Error, Result, Watch};
use crate::cli::output::data;
use crate::cli::woven::cloth::segments;
use crate::cli::{Outcome, inputs, terminal::Terminal};
use crate::fabric::{Draft, voxel_file, weave_of};
use crate::fit::ladder::{
    Evidence, Facts, Ladder, LadderOptions, Rung, Sparing, SurfaceRung, climb, evidence,
};
use crate::fit::surface::SurfaceOptions;
use crate::fit::{Journal, JournalHeader, Refit, TAU, validate};
use crate::report::{ladder_page, ladder_table};
use crate::scatter::surface::woven::{Layout, preset};
use crate::scatter::surface::{model, models};
use crate::scatter::{AnyModel, Parameters};
use crate::session::{Measurements, files};
use std::path::{Path, PathBuf};

/// The name that asks for the whole ladder.
const AUTO: &str = "auto";
/// Camera paths per camera direction and render for the errors at unseen geometries of a path-traced model.
const LEAVE_OUT_PATHS: u64 = 10_000;
/// Distance of yarns where a weave is named without one: the BRDF depends on ratios alone.
const PITCHES_MM: [f64; 2] = [0.4, 0.4];

/// What only the ladder is asked.
#[derive(Debug, Clone, clap::Args)]
pub(super) struct LadderArguments {
    /// --model auto: try every model for which there are enough numbers, path-traced ones too
    #[arg(long, conflicts_with = "resume")]
    all_rungs: bool,
    /// --model auto: yarn segments of a published fabric or a weave [default: those of --fabric, plain where it has none]
    #[arg(long, value_name = "NAME", conflicts_with = "resume")]
    segments: Option<String>,
}

impl LadderArguments {
    /// Refuses them with a model that is no ladder.
    pub(super) fn refuse(&self) -> Result<()> {
        if self.all_rungs || self.segments.is_some() {
            return Err(Error::new(
                "--all-rungs and --segments belong to --model auto",
            ));
        }
        Ok(())
    }
}

/// Whether a model's name asks for the ladder, or for one of its rungs that are formulas.
pub(super) fn is_meant(name: &str) -> bool {
    let plain = Layout::plain(PITCHES_MM[0]);
    name == AUTO || plain.is_ok_and(|plain| model(name, &plain).is_ok())
}

/// A path-traced model as a rung.
struct Traced<'a> {
    model: &'static str,
    free: usize,
    asked: &'a Asked,
    folder: PathBuf,
    force: bool,
}

impl Rung for Traced<'_> {
    fn name(&self) -> String {
        self.model.to_owned()
    }

    fn free(&self) -> usize {
        self.free
    }

    fn traced(&self) -> bool {
        true
    }

    fn climb(&self, facts: &Facts<'_>, _: &[Evidence], watch: &dyn Watch) -> Result<Evidence> {
        let asked = Asked {
            model: self.model.to_owned(),
            ..self.asked.clone()
        };
        let ready = asked.read()?;
        inputs::prepare_folder(&self.folder)?;
        let header = JournalHeader {
            arguments: asked.words(&self.folder),
            folder: working_folder(),
            ..header(&asked, &ready)
        };
        let journal = Journal::create(&journal_in(&self.folder), &header, self.force)?;
        let result = asked.fit(&ready, asked.command(&self.folder), &journal, watch)?;
        write(&result, &self.folder, self.force)?;
        let id = |row: &usize| facts.measurements.intensities[*row].configuration.id;
        let folds: Vec<Vec<u32>> = facts
            .geometries
            .iter()
            .map(|g| g.iter().map(id).collect())
            .collect();
        let refit = Refit::Linear {
            paths: LEAVE_OUT_PATHS,
        };
        // Where too little is left to predict from there is no such error, but there is a fit.
        let unseen = validate(
            &*ready.scene,
            &ready.measurements,
            &result,
            &folds,
            &refit,
            asked.seed,
            watch,
        )
        .ok();
        evidence(facts, &result, unseen.as_ref())
    }
}

pub(super) fn run(
    asked: &Asked,
    out: &Path,
    a: &super::Arguments,
    terminal: &Terminal,
) -> Result<Outcome> {
    check(asked)?;
    let [json_path, page_path] = ["ladder.json", "ladder.html"].map(|name| out.join(name));
    inputs::refuse_overwriting(&json_path, a.force)?;
    let measurements = Measurements::read(&asked.measurements)?;
    let rungs = rungs(asked, out, a)?;
    inputs::prepare_folder(out)?;
    let options = LadderOptions {
        tolerance: asked.accuracy.unwrap_or(1.0).min(asked.tolerance),
        all_rungs: a.ladder.all_rungs,
    };
    let climbed = climb(&rungs, &measurements, &options, &Sparing, terminal);
    terminal.finish_stage();
    if climbed.is_err() && terminal.cancelled() {
        return Ok(Outcome::Interrupted);
    }
    let ladder = climbed?;
    let text = serde_json::to_string_pretty(&ladder)
        .context(|| "the ladder cannot be written as JSON")?
        + "\n";
    files::write_atomic(&json_path, text.as_bytes())?;
    let title = format!("Models for {}", asked.measurements.display());
    files::write_atomic(
        &page_path,
        ladder_page(&ladder, &title, &command_line()).as_bytes(),
    )?;
    if a.json {
        data!("{}", text.trim_end());
    } else {
        print(&ladder);
    }
    terminal.say(format!(
        "wrote {} and {}",
        json_path.display(),
        page_path.display()
    ));
    Ok(match ladder.choice.adequate {
        true => Outcome::Done,
        false => Outcome::OutsideTolerance,
    })
}

/// Refuses what belongs to one path-traced model.
fn check(asked: &Asked) -> Result<()> {
    let wrong = [
        ("--per-system", asked.per_system),
        ("--start", asked.start.is_some()),
        ("--bound", !asked.bounds.is_empty()),
        ("--gain-prior", asked.gain_prior.is_some()),
        ("--loss", Loss::named(&asked.loss)? != Loss::named(LOSS)?),
        ("--tau", (asked.tau - TAU).abs() > 0.0),
    ];
    match wrong.iter().find(|w| w.1) {
        None => Ok(()),
        Some((name, _)) => Err(Error::new(format!(
            "{name} does not go with --model {}",
            asked.model
        ))
        .with_hint("models are compared alike; --model khungurn takes it")),
    }
}

/// The rungs asked for, from cheap to costly.
fn rungs<'a>(
    asked: &'a Asked,
    out: &Path,
    a: &super::Arguments,
) -> Result<Vec<Box<dyn Rung + 'a>>> {
    let layout = layout(&asked.fabric, a.ladder.segments.as_deref())?;
    let mut list: Vec<Box<dyn Rung + 'a>> = Vec::new();
    for model in models(&layout) {
        if asked.model == AUTO || asked.model == model.name() {
            let options = SurfaceOptions {
                seed: asked.seed,
                ..SurfaceOptions::default()
            };
            list.push(Box::new(SurfaceRung { model, options }));
        }
    }
    if asked.model != AUTO {
        return Ok(list);
    }
    let traced: &[&'static str] = match voxel_file(&asked.fabric) {
        Some(_) => &["microflake", "khungurn-volume"],
        None => &["khungurn"],
    };
    for &name in traced {
        list.push(Box::new(Traced {
            model: name,
            free: Parameters::defaults(AnyModel::named(name)?.parametric())
                .values()
                .len(),
            asked,
            folder: out.join(name),
            force: a.force,
        }));
    }
    Ok(list)
}

/// The yarn segments of the woven models.
fn layout(fabric: &Path, name: Option<&str>) -> Result<Layout> {
    let Some(name) = name else {
        return match weave_of(fabric) {
            Some((draft, pitches)) => segments(&draft, pitches).layout(),
            None => Layout::plain(PITCHES_MM[0]),
        };
    };
    if let Ok(published) = preset(name) {
        let layout = published.repeat().layout()?;
        return Ok(layout.with_smoothing(published.shape(0).smoothing));
    }
    let draft = Draft::named(name).context(|| {
        format!("--segments '{name}': neither a published fabric (goniofit woven list) nor a weave")
    })?;
    segments(&draft, PITCHES_MM).layout()
}

fn print(ladder: &Ladder) {
    let table = ladder_table(ladder);
    let lines: Vec<&Vec<String>> = std::iter::once(&table.head).chain(&table.rows).collect();
    let width = |k: usize| {
        lines
            .iter()
            .map(|l| l[k].chars().count())
            .max()
            .unwrap_or(0)
    };
    let widths: Vec<usize> = (0..table.head.len()).map(width).collect();
    for line in lines {
        let cells: Vec<String> = line
            .iter()
            .zip(&widths)
            .map(|(c, w)| format!("{c:<w$}"))
            .collect();
        data!("{}", cells.join("  ").trim_end());
    }
    data!("\n{}", ladder.advice);
    for warning in &ladder.warnings {
        data!("warning: {warning}");
    }
    if let Some(e) = ladder.chosen() {
        data!("parameters of {}: {}", e.model, e.parameters);
    }
}
