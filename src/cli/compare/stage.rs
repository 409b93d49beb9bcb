//! A part of the work, made once: what it was made with lies beside its files.

use crate::base::{Context, Error, Result, Watch};
use crate::cli::inputs;
use crate::cli::terminal::Terminal;
use crate::session::files;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Where everything goes, and what may be replaced.
pub(super) struct Order<'a> {
    pub(super) out: PathBuf,
    pub(super) force: bool,
    pub(super) terminal: &'a Terminal,
}

/// A part to be made in a folder.
pub(super) struct Stage {
    pub(super) folder: PathBuf,
    /// Name of the file that says what it was made with; written last.
    pub(super) record: &'static str,
    /// What the person is told.
    pub(super) title: String,
    /// All that the result depends on.
    pub(super) asked: Value,
}

/// The record of a part that was made.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Made {
    format: String,
    asked: Value,
    /// SHA-256 of `asked` as it was written: parts that follow name it.
    pub(super) key: String,
    /// What there is to say of the result.
    pub(super) found: Value,
    pub(super) wall_s: f64,
    pub(super) cpu_s: f64,
}

const FORMAT: &str = "goniofit-compare-stage-1";
/// The usual name of a record.
pub(super) const RECORD: &str = "made.json";

impl Stage {
    /// The part as an earlier run left it if it was asked for the same, else as `work` makes it now.
    ///
    /// # Errors
    /// It was made with other options and may not be replaced, or `work` fails.
    pub(super) fn made(
        &self,
        order: &Order<'_>,
        work: impl FnOnce(&Path) -> Result<Value>,
    ) -> Result<Made> {
        let key = files::sha256(self.asked.to_string().as_bytes());
        let record = self.folder.join(self.record);
        if record.exists() {
            match read(&record) {
                Ok(earlier) if earlier.key == key => {
                    let title = &self.title;
                    order
                        .terminal
                        .say(format!("{title}: there already, {}", record.display()));
                    return Ok(earlier);
                }
                earlier if !order.force => return Err(self.refused(earlier)),
                _ => std::fs::remove_file(&record)
                    .context(|| format!("{} cannot be replaced", record.display()))?,
            }
        }
        inputs::prepare_folder(&self.folder)?;
        order.terminal.say(&self.title);
        let (begun, cpu) = (Instant::now(), cpu_seconds());
        let found = work(&self.folder);
        order.terminal.finish_stage();
        let found = found?;
        if order.terminal.cancelled() {
            return Err(Error::new("interrupted"));
        }
        let made = Made {
            format: FORMAT.to_owned(),
            asked: self.asked.clone(),
            key,
            found,
            wall_s: begun.elapsed().as_secs_f64(),
            cpu_s: cpu_seconds() - cpu,
        };
        let json = serde_json::to_value(&made)
            .context(|| format!("{} cannot be written", record.display()))?;
        files::write_atomic(&record, format!("{json:#}\n").as_bytes())?;
        Ok(made)
    }

    fn refused(&self, earlier: Result<Made>) -> Error {
        let folder = self.folder.display();
        let hint =
            "--force makes it, and what follows from it, again; or choose another --out folder";
        match earlier {
            Ok(earlier) => Error::new(format!(
                "{folder} was made with other options: {}",
                difference(&earlier.asked, &self.asked)
            ))
            .with_hint(hint),
            Err(error) => error.with_hint(hint),
        }
    }
}

fn read(record: &Path) -> Result<Made> {
    let what = || format!("{} is no record of a part", record.display());
    let made: Made = serde_json::from_str(&files::read_text(record)?).context(what)?;
    if made.format != FORMAT {
        return Err(Error::new(what()));
    }
    Ok(made)
}

/// The first option that differs, in words.
fn difference(then: &Value, now: &Value) -> String {
    let names = now.as_object().into_iter().flat_map(|m| m.keys());
    let mut differing = names.filter(|name| then[name.as_str()] != now[name.as_str()]);
    match differing.next() {
        Some(name) => {
            let [then, now] = [then, now].map(|v| short(&v[name.as_str()]));
            format!("{name} {then} then, {now} now")
        }
        None => "options this version does not have".to_owned(),
    }
}

/// A value in a few words.
fn short(value: &Value) -> String {
    let text = value.to_string();
    match text.char_indices().nth(24) {
        Some((at, _)) => format!("{}...", &text[..at]),
        None => text,
    }
}

/// CPU time of the process so far, seconds.
fn cpu_seconds() -> f64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    t.tv_sec as f64 + t.tv_nsec as f64 * 1e-9
}

/// SHA-256 of a file.
pub(super) fn hash(path: &Path) -> Result<String> {
    let bytes = std::fs::read(path).context(|| format!("{} cannot be read", path.display()))?;
    Ok(files::sha256(&bytes))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn what_differs_is_named() {
        let (then, now) = (
            json!({"a": 1, "noise": 0.1}),
            json!({"a": 1, "noise": 0.25}),
        );
        assert_eq!(difference(&then, &now), "noise 0.1 then, 0.25 now");
        assert_eq!(short(&json!("x".repeat(40))).len(), 27);
    }
}
