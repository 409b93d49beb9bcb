//! `goniofit fit-all`: many fits from one list, each in a folder of its own, done once.
//!
//! Keeps a list and does what is left of it, one machine at a time. It is no scheduler: `--task` does one entry, for
//! whatever queue a cluster has.

pub(crate) mod inputs;
mod list;
mod lock;
mod state;
mod table;
mod work;

use super::output::data;
use super::{Outcome, terminal::Terminal};
use crate::base::{Error, Result};
use inputs::Hashes;
use list::Task;
use state::{Standing, State};
use std::path::PathBuf;

/// Do many fits from a list, going on where an earlier run ended
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  goniofit fit-all --list work.toml --out fits
  goniofit fit-all --list work.toml --out fits --jobs 4
  goniofit fit-all --list work.toml --out fits --status
  goniofit fit-all --list work.toml --out fits --summary fits.csv
  sbatch --array=0-$(( $(goniofit fit-all --list work.toml --count) - 1 )) docs/fit_all.sbatch work.toml fits

A list names measurements, fabrics, models, seeds and options; every combination is a task (paths are relative to the list):
  measurements = [\"night1/measurements.csv\", \"night2/measurements.csv\"]
  fabrics = [\"fabrics/gabardine.toml\"]
  seeds = [1, 2]
  [[options]]
  paths = 5000000
docs/batch.md has the rest. Each task writes fit.json, report.html, log.txt and task.json into --out/ID. What is finished is
left alone unless its inputs have changed; what failed is tried again with --retry. Ctrl-C keeps the best of the running fits
and stops. Exit code 1: something did not converge, or is not done yet; 2: something failed.")]
pub(crate) struct Arguments {
    /// The list of work (TOML)
    #[arg(long, value_name = "WORK.toml")]
    list: PathBuf,
    /// Folder in which every task has its own
    #[arg(long, value_name = "DIR", required_unless_present = "count")]
    out: Option<PathBuf>,
    /// Fits at once; they share the threads
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    jobs: u16,
    /// Try again what failed, and what a process that is gone left unfinished
    #[arg(long)]
    retry: bool,
    /// Do this task alone: its number (from 0) or id
    #[arg(long, value_name = "N|ID")]
    task: Option<String>,
    /// Print how many tasks there are
    #[arg(long, group = "look", conflicts_with_all = ["task", "retry", "json"])]
    count: bool,
    /// Print how far every task is, and do nothing
    #[arg(long, group = "look", conflicts_with = "retry")]
    status: bool,
    /// Write a row for every task with parameters and intervals, and do nothing else
    #[arg(long, group = "look", value_name = "S.csv", conflicts_with_all = ["retry", "json"])]
    summary: Option<PathBuf>,
    /// Replace an existing --summary
    #[arg(long, requires = "summary")]
    force: bool,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(a: Arguments) -> Result<Outcome> {
    let tasks = list::read(&a.list)?;
    let Some(out) = a.out.as_deref().filter(|_| !a.count) else {
        data!("{}", tasks.len());
        return Ok(Outcome::Done);
    };
    let chosen = match &a.task {
        Some(which) => vec![find(&tasks, which)?],
        None => tasks.iter().collect(),
    };
    let look = || {
        let mut hashes = Hashes::default();
        let standing = |task: &&Task| state::look(task, &out.join(&task.id), &mut hashes);
        chosen.iter().map(standing).collect::<Result<Vec<_>>>()
    };
    if let Some(path) = &a.summary {
        super::inputs::refuse_overwriting(path, a.force)?;
        table::write_summary(path, &chosen, &look()?)?;
        return Ok(Outcome::Done);
    }
    if a.status {
        table::print(&chosen, &look()?, a.json);
        return Ok(Outcome::Done);
    }
    super::inputs::prepare_folder(out)?;
    let terminal = Terminal::new()?;
    let order = work::Order {
        out,
        jobs: usize::from(a.jobs),
        retry: a.retry,
        alone: a.task.is_some(),
    };
    work::run(&chosen, &order, &terminal)?;
    terminal.finish_stage();
    let standings = look()?;
    table::print(&chosen, &standings, a.json);
    outcome(&standings, &terminal)
}

fn find<'a>(tasks: &'a [Task], which: &str) -> Result<&'a Task> {
    let number = which.parse::<usize>().ok();
    let mut both = tasks.iter().enumerate();
    let found = both.find(|(i, task)| Some(*i) == number || task.id == which);
    found.map(|(_, task)| task).ok_or_else(|| {
        Error::new(format!("the list has no task {which}")).with_hint(format!(
            "tasks are 0 to {}; --status lists them",
            tasks.len() - 1
        ))
    })
}

/// What the whole list has come to.
fn outcome(standings: &[Standing], terminal: &Terminal) -> Result<Outcome> {
    let count = |state: State| standings.iter().filter(|s| s.state == state).count();
    let of = standings.len();
    let failed = count(State::Failed);
    if failed > 0 {
        return Err(
            Error::new(format!("{failed} of {of} fits failed")).with_hint(
                "log.txt in the task's folder says how; --retry tries again, as does a changed input",
            ),
        );
    }
    let (waiting, running) = (count(State::Waiting), count(State::Running));
    if waiting + running > 0 {
        terminal.say(format!(
            "{waiting} of {of} fits are left, {running} are being done elsewhere; the same command goes on"
        ));
    }
    Ok(if count(State::Done) == of {
        Outcome::Done
    } else {
        Outcome::OutsideTolerance
    })
}
