//! The fits of the models, and what they predict.

use super::stage::{Order, RECORD, Stage, hash};
use super::truth::Data;
use crate::base::{Context, Error, Result, Watch};
use crate::cli::fit::resume::{header, journal_in, working_folder};
use crate::cli::fit::{self, Asked, Ready, Schedule, surroundings_of, write};
use crate::cli::render;
use crate::fit::{
    Comparison, FitResult, FittedModel, Journal, JournalHeader, TAU, compare, predict,
};
use crate::render::{Effort, Pictured, Plate};
use crate::scatter::AnyModel;
use crate::session::{Configuration, Measurements};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// What all fits have in common.
pub(super) struct Fits {
    pub(super) data: Data,
    pub(super) time: Option<f64>,
    pub(super) paths: Option<u64>,
    pub(super) seed: u64,
    /// Weighted rms standard error of each of the two renders that residuals come from.
    pub(super) accuracy: f64,
    /// The true parameters.
    pub(super) truth: Option<Value>,
}

/// One model on one fabric.
pub(super) struct Contestant {
    pub(super) name: &'static str,
    pub(super) folder: PathBuf,
    pub(super) model: &'static str,
    pub(super) fabric: PathBuf,
    /// Key of what the fabric was made with.
    pub(super) key: String,
}

impl Contestant {
    pub(super) fn fit_file(&self) -> PathBuf {
        self.folder.join("fit.json")
    }
}

impl Fits {
    /// Fits a model and compares it with the measurements, where that is not done yet.
    pub(super) fn fitted(&self, order: &Order<'_>, who: &Contestant) -> Result<FittedModel> {
        let asked = self.asked(who);
        let budget = asked.budget();
        let measurements = hash(&self.data.measurements)?;
        let stage = Stage {
            folder: who.folder.clone(),
            record: RECORD,
            title: format!(
                "fit-{}: model {} on {}",
                who.name,
                who.model,
                who.fabric.display()
            ),
            asked: json!({
                "measurements": &measurements,
                "fabric": who.key,
                "model": who.model,
                "time_s": budget.time_s,
                "paths": budget.paths,
                "seed": self.seed,
            }),
        };
        stage.made(order, |folder| {
            let result = searched(&asked, folder, order)?;
            if order.terminal.cancelled() {
                return Err(Error::new("interrupted"));
            }
            write(&result, folder, true)?;
            Ok(json!({"converged": result.converged}))
        })?;
        let validation = self.data.validation.as_deref();
        let stage = Stage {
            folder: who.folder.clone(),
            record: "compared.json",
            title: format!("fit-{}: rendering what it predicts", who.name),
            asked: json!({
                "fit": hash(&who.fit_file())?,
                "measurements": measurements,
                "validation": validation.map(hash).transpose()?,
                "accuracy": self.accuracy,
                "seed": self.seed,
            }),
        };
        let made = stage.made(order, |_| self.compared(order, who))?;
        serde_json::from_value(made.found).context(|| {
            format!(
                "{} cannot be read",
                who.folder.join("compared.json").display()
            )
        })
    }

    fn asked(&self, who: &Contestant) -> Asked {
        Asked {
            measurements: self.data.measurements.clone(),
            fabric: who.fabric.clone(),
            model: who.model.to_owned(),
            per_system: false,
            method: fit::METHOD.to_owned(),
            seed: self.seed,
            start: None,
            time: self.time,
            paths: self.paths,
            accuracy: None,
            tolerance: 0.05,
            loss: fit::LOSS.to_owned(),
            gain_prior: None,
            tau: TAU,
            bounds: Vec::new(),
            plate: Plate::Black,
            schedule: Schedule::default(),
        }
    }

    /// Fresh renders at the fitted parameters beside the measurements.
    fn compared(&self, order: &Order<'_>, who: &Contestant) -> Result<Value> {
        let result = FitResult::read(&who.fit_file())?;
        let scene = scene_of(&self.data.measurements, who)?;
        let against = |file: &Path| -> Result<Comparison> {
            let measurements = Measurements::read(file)?;
            let rows = measurements.intensities.iter();
            let poses: Vec<Configuration> = rows.map(|i| i.configuration).collect();
            let effort = Effort::Accuracy(self.accuracy);
            let watch = order.terminal;
            let found = predict(&*scene, &result, &poses, &effort, self.seed, watch)?;
            compare(&found, &measurements, result.tau)
        };
        let fitted = against(&self.data.measurements)?;
        let validation = self.data.validation.as_deref().map(against).transpose()?;
        let truth = self.truth.as_ref();
        let model = FittedModel::new(who.name, &result, truth, &fitted, validation.as_ref());
        serde_json::to_value(model).context(|| "the comparison cannot be written as JSON")
    }
}

/// The scene a model is fitted in.
fn scene_of(measurements: &Path, who: &Contestant) -> Result<Box<dyn Pictured>> {
    let (surroundings, _) = surroundings_of(measurements, Plate::Black)?;
    render::scene(&who.fabric, AnyModel::named(who.model)?, surroundings)
}

/// The fit, going on with render pairs of an earlier run.
fn searched(asked: &Asked, folder: &Path, order: &Order<'_>) -> Result<FitResult> {
    let ready = asked.read()?;
    let journal = journal(asked, &ready, folder, order)?;
    asked.fit(&ready, asked.command(folder), &journal, order.terminal)
}

fn journal(asked: &Asked, ready: &Ready, folder: &Path, order: &Order<'_>) -> Result<Journal> {
    let path = journal_in(folder);
    let now = JournalHeader {
        arguments: asked.words(folder),
        folder: working_folder(),
        ..header(asked, ready)
    };
    let same =
        path.exists() && JournalHeader::read(&path).is_ok_and(|h| h.difference(&now).is_none());
    if !same {
        return Journal::create(&path, &now, true);
    }
    let journal = Journal::resume(&path, &now)?;
    let (pairs, cpu_s) = journal.found();
    order.terminal.say(format!(
        "going on with {pairs} render pairs from {} ({cpu_s:.1} s CPU)",
        path.display()
    ));
    Ok(journal)
}
