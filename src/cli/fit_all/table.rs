//! Tables of tasks: for people, for programs, for a spreadsheet.

use super::list::Task;
use super::state::Standing;
use crate::base::{Context, Result};
use crate::cli::output::data;
use crate::fit::{FitResult, ParameterResult};
use crate::session::files;
use serde_json::json;
use std::path::Path;

/// What is to be said of a task in one line.
pub(super) fn line(task: &Task, standing: &Standing) -> String {
    let residual = standing.result.as_ref().map(|r| {
        let percent = r.objective.weighted_rms_percent;
        format!(", residual {percent:.2} %, {:.0} s", r.time.wall_s)
    });
    let note = standing.note.as_ref().map(|note| format!(": {note}"));
    format!(
        "{}: {}{}{}",
        task.id,
        standing.state.words(),
        residual.unwrap_or_default(),
        note.unwrap_or_default()
    )
}

/// Prints how far every task is.
pub(super) fn print(tasks: &[&Task], standings: &[Standing], as_json: bool) {
    if as_json {
        let all: Vec<_> = tasks
            .iter()
            .zip(standings)
            .map(|(t, s)| row(t, s))
            .collect();
        data!("{}", json!(all));
        return;
    }
    data!("task  state          residual      time  id");
    for (task, standing) in tasks.iter().zip(standings) {
        let (residual, time) = match &standing.result {
            Some(r) => (
                format!("{:.2} %", r.objective.weighted_rms_percent),
                format!("{:.1} s", r.time.wall_s),
            ),
            None => ("-".to_owned(), "-".to_owned()),
        };
        let state = standing.state.words();
        data!(
            "{:4}  {state:<13} {residual:>9} {time:>9}  {}",
            task.number,
            task.id
        );
        if let Some(note) = &standing.note {
            // Of a failure with hints the first line.
            data!("{:37}{}", "", note.lines().next().unwrap_or(""));
        }
    }
}

fn row(task: &Task, standing: &Standing) -> serde_json::Value {
    let result = standing.result.as_ref();
    json!({
        "task": task.number,
        "id": task.id,
        "state": standing.state,
        "note": standing.note,
        "measurements": task.asked.measurements,
        "fabric": task.asked.fabric,
        "model": task.asked.model,
        "seed": task.asked.seed,
        "options": task.options,
        "weighted_rms_percent": result.map(|r| r.objective.weighted_rms_percent),
        "weighted_rms_se_percent": result.map(|r| r.objective.weighted_rms_se_percent),
        "wall_s": result.map(|r| r.time.wall_s),
        "cpu_s": result.map(|r| r.time.cpu_s),
        "paths": result.map(|r| r.time.paths),
    })
}

/// Columns of the summary before the parameters.
const COLUMNS: [&str; 15] = [
    "task",
    "id",
    "state",
    "note",
    "measurements",
    "fabric",
    "model",
    "seed",
    "options",
    "weighted_rms_percent",
    "weighted_rms_se_percent",
    "wall_s",
    "cpu_s",
    "paths",
    "synthetic",
];

/// Writes a CSV file: a row for every task, of every parameter that any model has the value, both ends of the 95 %
/// interval and the verdict (angles in degrees); empty where there is no fit.
pub(super) fn write_summary(path: &Path, tasks: &[&Task], standings: &[Standing]) -> Result<()> {
    let what = || format!("{} cannot be written", path.display());
    let mut names: Vec<String> = Vec::new();
    for p in standings.iter().flat_map(parameters) {
        let name = column(p);
        if !names.contains(&name) {
            names.push(name);
        }
    }
    let mut head: Vec<String> = COLUMNS.map(str::to_owned).to_vec();
    for name in &names {
        let of_one = ["", "_low_95", "_high_95", "_verdict"];
        head.extend(of_one.map(|suffix| format!("{name}{suffix}")));
    }
    let mut writer = csv::Writer::from_writer(Vec::new());
    writer.write_record(&head).context(what)?;
    for (task, standing) in tasks.iter().zip(standings) {
        let mut cells = facts(task, standing);
        for name in &names {
            let p = parameters(standing).find(|p| column(p) == *name);
            cells.extend(p.map_or_else(Default::default, |p| {
                [
                    p.value.to_string(),
                    p.interval_95[0].to_string(),
                    p.interval_95[1].to_string(),
                    p.verdict.words().to_owned(),
                ]
            }));
        }
        writer.write_record(&cells).context(what)?;
    }
    files::write_atomic(path, &writer.into_inner().context(what)?)
}

fn parameters(standing: &Standing) -> impl Iterator<Item = &ParameterResult> {
    standing.result.iter().flat_map(|r| &r.uncertainty)
}

/// A parameter's column: angles wear their unit.
fn column(p: &ParameterResult) -> String {
    match p.unit.as_str() {
        "degrees" => format!("{}_deg", p.name),
        _ => p.name.clone(),
    }
}

/// A row's cells under [`COLUMNS`].
fn facts(task: &Task, standing: &Standing) -> Vec<String> {
    let of_fit =
        |cell: fn(&FitResult) -> String| standing.result.as_ref().map_or_else(String::new, cell);
    vec![
        task.number.to_string(),
        task.id.clone(),
        standing.state.words().to_owned(),
        standing.note.clone().unwrap_or_default(),
        task.asked.measurements.display().to_string(),
        task.asked.fabric.display().to_string(),
        task.asked.model.clone(),
        task.asked.seed.to_string(),
        task.options.clone().unwrap_or_default(),
        of_fit(|r| r.objective.weighted_rms_percent.to_string()),
        of_fit(|r| r.objective.weighted_rms_se_percent.to_string()),
        of_fit(|r| r.time.wall_s.to_string()),
        of_fit(|r| r.time.cpu_s.to_string()),
        of_fit(|r| r.time.paths.to_string()),
        of_fit(|r| r.synthetic.map_or_else(String::new, |s| s.to_string())),
    ]
}
