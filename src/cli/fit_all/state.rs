//! How far a task is, as its folder says: the file `task.json`, the fit beside it, and the lock.

use super::inputs::{Hashes, Inputs};
use super::list::Task;
use super::lock::{self, Found, Holder};
use crate::base::{Context, Result};
use crate::cli::fit::files_in;
use crate::fit::FitResult;
use crate::session::files;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// How a try at a task ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Ending {
    /// There is a fit, converged or not.
    Finished,
    /// There is a fit, the best when the program was told to stop.
    Interrupted,
    /// There is an error.
    Failed,
}

/// The content of `task.json`: written last, it says what the files beside it are.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Record {
    format: String,
    pub(super) id: String,
    pub(super) ending: Ending,
    /// The failure, with its hints.
    pub(super) error: Option<String>,
    pub(super) inputs: Inputs,
    /// SHA-256 of the `fit.json` it speaks of.
    pub(super) fit: Option<String>,
    /// Who made it.
    pub(super) by: Holder,
    /// Seconds it took, reading included.
    pub(super) elapsed_s: f64,
}

/// Where a task's record lies.
fn path_in(folder: &Path) -> PathBuf {
    folder.join("task.json")
}

impl Record {
    const FORMAT: &'static str = "goniofit-task-1";

    pub(super) fn new(id: &str, inputs: Inputs) -> Self {
        Self {
            format: Self::FORMAT.to_owned(),
            id: id.to_owned(),
            ending: Ending::Failed,
            error: None,
            inputs,
            fit: None,
            by: Holder::me(),
            elapsed_s: 0.0,
        }
    }

    /// None when there is none, or none that this program understands.
    fn read(folder: &Path) -> Option<Self> {
        let text = std::fs::read_to_string(path_in(folder)).ok()?;
        let record: Self = serde_json::from_str(&text).ok()?;
        (record.format == Self::FORMAT).then_some(record)
    }

    /// Writes it whole or not at all.
    pub(super) fn write(&self, folder: &Path) -> Result<()> {
        let path = path_in(folder);
        let text = serde_json::to_string_pretty(self)
            .context(|| format!("{} cannot be written", path.display()))?;
        files::write_atomic(&path, (text + "\n").as_bytes())
    }
}

/// What a person wants to know of a task.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum State {
    /// Fitted and converged.
    Done,
    /// Fitted, with a reason why the result is not to be trusted.
    NotConverged,
    /// Ended with an error, or never ended because its process did.
    Failed,
    /// To be done: never tried, interrupted, or made from other inputs.
    Waiting,
    /// A process is at it.
    Running,
}

impl State {
    /// In words.
    pub(super) fn words(self) -> &'static str {
        match self {
            Self::Done => "done",
            Self::NotConverged => "not converged",
            Self::Failed => "failed",
            Self::Waiting => "waiting",
            Self::Running => "running",
        }
    }
}

/// How far a task is.
pub(super) struct Standing {
    pub(super) state: State,
    /// Why, where that needs words.
    pub(super) note: Option<String>,
    /// The fit of a task that is done or not converged.
    pub(super) result: Option<FitResult>,
}

impl Standing {
    fn new(state: State, note: impl Into<Option<String>>) -> Self {
        Self {
            state,
            note: note.into(),
            result: None,
        }
    }
}

/// Looks how far a task is.
///
/// # Errors
/// When its lock cannot be looked at.
pub(super) fn look(task: &Task, folder: &Path, hashes: &mut Hashes) -> Result<Standing> {
    let found = lock::look(folder)?;
    if let Found::Held(holder) = found {
        let note = holder.map(|h| h.words());
        return Ok(Standing::new(State::Running, note));
    }
    let standing = recorded(folder, &Inputs::of(&task.asked, hashes));
    match (found, standing.state) {
        (Found::Left(holder), State::Waiting | State::Failed) => Ok(Standing::new(
            State::Failed,
            format!("ended without a result: {}", holder.words()),
        )),
        _ => Ok(standing),
    }
}

/// How far a task with these inputs is, by its record alone.
pub(super) fn recorded(folder: &Path, inputs: &Inputs) -> Standing {
    let waiting = |note: String| Standing::new(State::Waiting, note);
    let [fit_path, _] = files_in(folder);
    let Some(record) = Record::read(folder) else {
        let unknown = fit_path.exists();
        let note = unknown.then(|| "its fit.json does not say what it was made from".to_owned());
        return Standing::new(State::Waiting, note);
    };
    let changed = inputs.changed_since(&record.inputs);
    if !changed.is_empty() {
        return waiting(format!(
            "changed since it was tried: {}",
            changed.join(", ")
        ));
    }
    match record.ending {
        Ending::Failed => Standing::new(State::Failed, record.error),
        Ending::Interrupted => waiting("interrupted; fit.json has the best so far".to_owned()),
        Ending::Finished => {
            let hash = std::fs::read(&fit_path).map(|bytes| files::sha256(&bytes));
            match FitResult::read(&fit_path) {
                Ok(result) if hash.ok() == record.fit => finished(result),
                _ => waiting("its fit.json is missing or not the one that was made".to_owned()),
            }
        }
    }
}

/// The standing of a task with this fit.
pub(super) fn finished(result: FitResult) -> Standing {
    let state = if result.converged {
        State::Done
    } else {
        State::NotConverged
    };
    let note = (!result.converged).then(|| result.reason.clone());
    Standing {
        state,
        note,
        result: Some(result),
    }
}
