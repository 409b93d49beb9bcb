//! The list of frames to import.

use super::Seen;
use crate::base::{Context, Error, Result};
use crate::session::{Filter, FrameKind, FrameRecord, Layout, Plan};
use serde::Deserialize;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// A row as the file has it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    file: String,
    kind: FrameKind,
    #[serde(default)]
    config: Option<u32>,
    #[serde(default)]
    exposure_ms: Option<f64>,
    #[serde(default)]
    repeat: Option<u32>,
    #[serde(default)]
    visit: Option<u32>,
    #[serde(default)]
    filter: Option<Filter>,
    #[serde(default)]
    elapsed_s: Option<f64>,
    #[serde(default)]
    utc: Option<String>,
}

/// A frame to import.
#[derive(Debug)]
pub(super) struct Row {
    /// 1 for the first row below the header.
    number: usize,
    pub(super) path: PathBuf,
    pub(super) kind: FrameKind,
    config: Option<u32>,
    exposure_ms: Option<f64>,
    repeat: Option<u32>,
    visit: u32,
    filter: Option<Filter>,
    pub(super) elapsed_s: Option<f64>,
    pub(super) utc: Option<String>,
}

impl Row {
    /// How messages call it.
    pub(super) fn title(&self) -> String {
        format!("row {} ({})", self.number, self.path.display())
    }
}

/// Reads and checks a list; in the order of time, where it is stated.
pub(super) fn read(path: &Path, plan: &Plan) -> Result<Vec<Row>> {
    let what = || format!("list {}", path.display());
    let hint = "`goniofit session import --help` lists the columns";
    let reader = csv::ReaderBuilder::new()
        .trim(csv::Trim::All)
        .from_path(path);
    let mut reader = reader.context(what)?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let mut rows = Vec::new();
    for (i, line) in reader.deserialize().enumerate() {
        let number = i + 1;
        let line: Line = line
            .context(|| format!("{}, row {number}", what()))
            .map_err(|e| e.with_hint(hint))?;
        rows.push(Row {
            number,
            path: folder.join(&line.file),
            kind: line.kind,
            config: line.config,
            exposure_ms: line.exposure_ms,
            repeat: line.repeat,
            visit: line.visit.unwrap_or(0),
            filter: line.filter,
            elapsed_s: line.elapsed_s,
            utc: line.utc.filter(|t| !t.is_empty()),
        });
    }
    if rows.is_empty() {
        return Err(Error::new(format!("{} has no frames", what())).with_hint(hint));
    }
    for row in &rows {
        check(row, plan).context(what)?;
    }
    check_together(&rows).context(what)?;
    rows.sort_by(|a, b| {
        let time = |row: &Row| row.elapsed_s.unwrap_or(0.0);
        time(a).total_cmp(&time(b))
    });
    Ok(rows)
}

fn check(row: &Row, plan: &Plan) -> Result<()> {
    use FrameKind::{Board, Chart, Flat, Sample};
    let bad = |what: String, hint: &str| {
        Err(Error::new(format!("{}: {what}", row.title())).with_hint(hint))
    };
    match (row.kind, row.config) {
        (Sample | Flat | Chart | Board, Some(id)) if plan.configuration(id).is_none() => {
            return bad(
                format!("the plan has no configuration {id}"),
                "config is the number of a pose in the plan file",
            );
        }
        (Sample, None) => {
            return bad(
                "a sample frame without config".to_owned(),
                "config is the number of a pose in the plan file",
            );
        }
        (Sample | Flat | Chart | Board, _) | (_, None) => {}
        (kind, Some(id)) => {
            return bad(
                format!("a {} frame with config {id}", kind.name()),
                "whites and references are shot at the white's geometry, darks anywhere: leave config empty",
            );
        }
    }
    if row.visit > 0 && row.kind != FrameKind::Reference {
        return bad(
            format!("a {} frame with visit {}", row.kind.name(), row.visit),
            "only reference frames have visits",
        );
    }
    if row.exposure_ms.is_some_and(|ms| !(1e-6..1e9).contains(&ms)) {
        return bad(
            "exposure_ms out of range".to_owned(),
            "expected milliseconds, more than 0",
        );
    }
    if row.elapsed_s.is_some_and(|s| !(0.0..1e9).contains(&s)) {
        return bad(
            "elapsed_s out of range".to_owned(),
            "expected seconds since the first shot, 0 or more",
        );
    }
    Ok(())
}

fn check_together(rows: &[Row]) -> Result<()> {
    let timed = rows.iter().filter(|r| r.elapsed_s.is_some()).count();
    if timed != 0 && timed != rows.len() {
        return Err(Error::new(format!(
            "elapsed_s is stated in {timed} of {} rows",
            rows.len()
        ))
        .with_hint("state it in all rows or in none"));
    }
    let mut files = HashMap::new();
    for row in rows {
        if let Some(earlier) = files.insert(&row.path, row.number) {
            return Err(Error::new(format!(
                "rows {earlier} and {} name the same file {}",
                row.number,
                row.path.display()
            )));
        }
    }
    Ok(())
}

/// The journal's records of the frames.
pub(super) fn records(rows: &[Row], seen: &[Seen]) -> Result<Vec<FrameRecord>> {
    check_filters(rows, seen[0].layout)?;
    let mut repeats = HashMap::new();
    let mut records = Vec::new();
    for (row, seen) in rows.iter().zip(seen) {
        let exposure_ms = exposure(row, seen)?;
        let key = (
            row.kind,
            row.config,
            row.visit,
            row.filter,
            exposure_ms.to_bits(),
        );
        let counted = repeats.entry(key).or_insert(0_u32);
        let repeat = row.repeat.unwrap_or(*counted);
        *counted += 1;
        let extension = row.path.extension().unwrap_or_default().to_string_lossy();
        records.push(FrameRecord {
            file: FrameRecord::standard_name(
                row.number,
                row.kind,
                row.config,
                exposure_ms,
                &extension.to_lowercase(),
            ),
            kind: row.kind,
            config: row.config,
            exposure_ms,
            requested_ms: None,
            repeat,
            visit: row.visit,
            filter: row.filter,
            exposed: None,
            utc: row.utc.clone(),
            axes_deg: Default::default(),
            sha256: seen.sha256.clone(),
        });
    }
    Ok(records)
}

/// The stated exposure, or EXIF's; cameras round nominal times, so only gross differences are faults.
fn exposure(row: &Row, seen: &Seen) -> Result<f64> {
    match (row.exposure_ms, seen.exposure_ms) {
        (Some(stated), Some(found)) if !(0.85..1.18).contains(&(found / stated)) => {
            Err(Error::new(format!(
                "{}: the list states an exposure of {stated} ms, the file {found} ms",
                row.title()
            ))
            .with_hint("mend exposure_ms, or leave it empty to take the file's"))
        }
        (Some(stated), _) => Ok(stated),
        (None, Some(found)) => Ok(found),
        (None, None) => Err(Error::new(format!(
            "{}: neither the list nor the file states the exposure time",
            row.title()
        ))
        .with_hint("write it into the column exposure_ms")),
    }
}

/// Filters belong to a monochrome camera, and then to all frames but the darks, or to none.
fn check_filters(rows: &[Row], layout: Layout) -> Result<()> {
    let lit = || rows.iter().filter(|r| r.kind != FrameKind::Dark);
    let Some(filtered) = rows.iter().find(|r| r.filter.is_some()) else {
        return Ok(());
    };
    if layout != Layout::Mono {
        return Err(Error::new(format!(
            "{} has a filter, but the camera sees color itself ({layout})",
            filtered.title()
        ))
        .with_hint("leave the column filter empty"));
    }
    match lit().find(|r| r.filter.is_none()) {
        Some(bare) if lit().any(|r| r.filter.is_some()) => Err(Error::new(format!(
            "{} has no filter, others have",
            bare.title()
        ))
        .with_hint("state the filter of every frame but the darks")),
        _ => Ok(()),
    }
}
