//! A fit's render pairs in a file, so that a fit that ended early goes on where it was.
//!
//! A search is a deterministic function of its render pairs: of their estimates, and of the seconds they report where time
//! is limited. A pair is a function of what was asked: index, parameters, paths, shares, and the seed. So the file holds
//! one line per whole pair, in full precision, after a header with everything else a fit depends on. To resume is to
//! search anew with recorded pairs in place of renders; the first pair that the file lacks is rendered. Limits may
//! change on the way: then a pair that is asked for otherwise than before is rendered anew. Does not keep what is rendered
//! after an interrupt, and knows nothing of the search's state.

mod pair;

use super::options::{Budget, Options};
use crate::base::{Context, Error, Result};
use crate::render::Estimates;
use crate::scatter::Parametric;
pub(super) use pair::Asked;
use pair::{Columns, PairLine};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap};
use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// What a fit was begun with: the journal's first line. Stands again further down when the limits changed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JournalHeader {
    /// Always [`JournalHeader::FORMAT`].
    pub format: String,
    /// Program version.
    pub program: String,
    /// The scattering model.
    pub model: String,
    /// The user's seed.
    pub seed: u64,
    /// What the caller says of the inputs, by name: hashes of files, or words.
    pub inputs: BTreeMap<String, String>,
    /// Flat parameters at the start; none for the model's defaults.
    pub start: Option<Vec<f64>>,
    /// All other options but the limits, as text.
    pub options: String,
    /// Seconds, paths and accuracy to end at.
    pub limits: serde_json::Value,
    /// The command line of the fit, word by word; filled in by the caller.
    pub arguments: Vec<String>,
    /// The folder its paths are relative to; filled in by the caller.
    pub folder: String,
}

impl JournalHeader {
    /// The value of [`JournalHeader::format`].
    pub const FORMAT: &'static str = "goniofit-renders-1";

    /// The header of a fit with these options; without a command line.
    pub fn new(
        model: &dyn Parametric,
        options: &Options,
        inputs: BTreeMap<String, String>,
    ) -> Self {
        let others = Options {
            budget: Budget::default(),
            seed: 0,
            start: None,
            ..options.clone()
        };
        let budget = options.budget;
        Self {
            format: Self::FORMAT.to_owned(),
            program: env!("CARGO_PKG_VERSION").to_owned(),
            model: model.name().to_owned(),
            seed: options.seed,
            inputs,
            start: options.start.as_ref().map(|s| s.values().to_vec()),
            options: format!("{others:#?}"),
            limits: serde_json::json!({
                "time_s": budget.time_s, "paths": budget.paths, "accuracy": budget.accuracy,
            }),
            arguments: Vec::new(),
            folder: String::new(),
        }
    }

    /// The header of the journal at `path`; the latest where limits changed.
    ///
    /// # Errors
    /// When the file cannot be read, its first line is not whole, or a line but the last is damaged.
    pub fn read(path: &Path) -> Result<Self> {
        let what = || format!("journal {}", path.display());
        let bytes = std::fs::read(path).context(|| format!("{} cannot be read", what()))?;
        Ok(Content::parse(&bytes).context(what)?.header)
    }

    /// In words, the first thing but limits and places in which a fit that begins `now` differs.
    pub fn difference(&self, now: &Self) -> Option<String> {
        let names = self.inputs.keys().chain(now.inputs.keys());
        let inputs = names.map(|name| (name.as_str(), self.inputs.get(name), now.inputs.get(name)));
        let other_input = inputs.into_iter().find(|(_, then, now)| then != now);
        for (what, then, now) in [
            ("format", &self.format, &now.format),
            ("program version", &self.program, &now.program),
            ("model", &self.model, &now.model),
            ("seed", &self.seed.to_string(), &now.seed.to_string()),
        ] {
            if then != now {
                return Some(format!("{what} ({then} then, {now} now)"));
            }
        }
        if let Some((name, _, _)) = other_input {
            return Some(name.to_owned());
        }
        if self.start != now.start {
            return Some("start".to_owned());
        }
        (self.options != now.options).then(|| {
            let mut lines = self.options.lines().zip(now.options.lines());
            let clean = |line: &str| line.trim().trim_end_matches(',').to_owned();
            match lines.find(|(then, now)| then != now) {
                Some((then, now)) => format!("options ({} then, {} now)", clean(then), clean(now)),
                None => "options".to_owned(),
            }
        })
    }
}

/// A pair that was read.
struct Kept {
    line: PairLine,
    /// Whether it was rendered under the present limits: then the same must be asked for again.
    binding: bool,
}

/// A journal as it was read.
struct Content {
    header: JournalHeader,
    pairs: HashMap<(u64, u64), Kept>,
    /// Bytes of all whole lines.
    whole: usize,
}

/// How a header's line begins, and no pair's.
const HEADER_BEGINS: &[u8] = b"{\"format\"";

impl Content {
    fn parse(bytes: &[u8]) -> Result<Self> {
        let whole = bytes.iter().rposition(|&b| b == b'\n').map_or(0, |i| i + 1);
        let mut lines = bytes[..whole].split_inclusive(|&b| b == b'\n');
        let first = lines.next().ok_or_else(|| {
            Error::new("it has no whole line, so nothing was rendered")
                .with_hint("begin the fit anew with --force")
        })?;
        let mut content = Self {
            header: read_line(first, 1)?,
            pairs: HashMap::new(),
            whole,
        };
        for (i, line) in lines.enumerate() {
            if line.starts_with(HEADER_BEGINS) {
                content.header = read_line(line, i + 2)?;
                content.loosen();
            } else {
                let line: PairLine = read_line(line, i + 2)?;
                let binding = true;
                (content.pairs).insert(line.asked.key(), Kept { line, binding });
            }
        }
        Ok(content)
    }

    /// The limits changed: what is kept may be used, and need not be.
    fn loosen(&mut self) {
        self.pairs.values_mut().for_each(|k| k.binding = false);
    }
}

fn read_line<'a, T: Deserialize<'a>>(line: &'a [u8], number: usize) -> Result<T> {
    serde_json::from_slice(line)
        .context(|| format!("line {number} is damaged"))
        .map_err(|e| {
            e.with_hint(
                "only a torn last line is tolerated; restore the file from a copy, or begin the fit anew with --force",
            )
        })
}

/// An open journal: answers with the pairs it has, and is given those that it has not.
pub struct Journal {
    path: PathBuf,
    state: Mutex<State>,
    torn: bool,
}

struct State {
    file: File,
    pairs: HashMap<(u64, u64), Kept>,
    recalled: usize,
    recalled_cpu_s: f64,
    added: usize,
}

impl Journal {
    /// Begins the journal of a new fit; one that is there already is replaced when `replace` says so.
    ///
    /// # Errors
    /// When the file exists and is not to be replaced, another process has it, or it cannot be written.
    pub fn create(path: &Path, header: &JournalHeader, replace: bool) -> Result<Self> {
        if path.exists() && !replace {
            return Err(
                Error::new(format!("{} exists already", path.display())).with_hint(
                    "an earlier fit was begun there: --resume goes on with it, --force begins anew",
                ),
            );
        }
        let journal = Self::open(path, true)?;
        let cleared = journal.state().file.set_len(0);
        cleared.context(|| journal.refused())?;
        journal.append(header)?;
        Ok(journal)
    }

    /// Opens the journal of an earlier fit to go on with it `now`. A torn last line is cut off. When the limits are
    /// others, `now` is written below.
    ///
    /// # Errors
    /// When the fit differs in anything but its limits, another process has the file, a line but the last is damaged, or
    /// the file cannot be read and written.
    pub fn resume(path: &Path, now: &JournalHeader) -> Result<Self> {
        let mut journal = Self::open(path, false)?;
        let mut bytes = Vec::new();
        let read = journal.state().file.read_to_end(&mut bytes);
        read.context(|| format!("journal {} cannot be read", path.display()))?;
        let mut content =
            Content::parse(&bytes).context(|| format!("journal {}", path.display()))?;
        if let Some(difference) = content.header.difference(now) {
            return Err(Error::new(format!(
                "journal {} is of another fit: other {difference}",
                path.display()
            ))
            .with_hint("begin a new fit with another --out, or with --force"));
        }
        journal.torn = content.whole < bytes.len();
        let cut = journal.state().file.set_len(content.whole as u64);
        cut.context(|| journal.refused())?;
        if content.header.limits != now.limits {
            content.loosen();
            journal.append(now)?;
        }
        journal.state().pairs = content.pairs;
        Ok(journal)
    }

    fn open(path: &Path, create: bool) -> Result<Self> {
        use rustix::fs::{FlockOperation, flock};
        let mut options = OpenOptions::new();
        options.read(true).append(true).create(create);
        let file = options
            .open(path)
            .context(|| format!("journal {} cannot be opened", path.display()))?;
        flock(&file, FlockOperation::NonBlockingLockExclusive)
            .context(|| format!("journal {} is in use", path.display()))
            .map_err(|e| e.with_hint("another process is at this fit; wait for it or stop it"))?;
        Ok(Self {
            path: path.to_owned(),
            state: Mutex::new(State {
                file,
                pairs: HashMap::new(),
                recalled: 0,
                recalled_cpu_s: 0.0,
                added: 0,
            }),
            torn: false,
        })
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn refused(&self) -> String {
        format!("journal {} cannot be written", self.path.display())
    }

    /// Whether the last line was torn, and cut off.
    pub fn torn(&self) -> bool {
        self.torn
    }

    /// Pairs the file had when it was opened, and the CPU seconds they took.
    pub fn found(&self) -> (usize, f64) {
        let state = self.state();
        let renders = state.pairs.values().flat_map(|k| &k.line.renders);
        (state.pairs.len(), renders.map(|r| r.cpu_s).sum())
    }

    /// Pairs that were taken from the file, and pairs that were added to it.
    pub fn used(&self) -> (usize, usize) {
        let state = self.state();
        (state.recalled, state.added)
    }

    /// CPU seconds of the pairs that were taken from the file.
    pub fn recalled_cpu_s(&self) -> f64 {
        self.state().recalled_cpu_s
    }

    /// The pair that was rendered when this was asked, if it was.
    ///
    /// # Errors
    /// When a pair of this index is there that should be the same and is not.
    pub(super) fn recall(&self, asked: &Asked) -> Result<Option<[Estimates; 2]>> {
        let mut state = self.state();
        let Some(kept) = state.pairs.get(&asked.key()) else {
            return Ok(None);
        };
        let what = || format!("journal {}: pair {}", self.path.display(), asked.index);
        if kept.line.asked != *asked {
            if !kept.binding {
                return Ok(None);
            }
            let difference = kept.line.asked.difference(asked);
            return Err(Error::new(format!("{}: {difference}", what())).with_hint(
                "the search went another way than before: with another program or on another kind of machine a fit cannot \
                 be resumed; begin a new one with another --out, or with --force",
            ));
        }
        let [a, b] = &kept.line.renders;
        let (Some(a), Some(b)) = (a.estimates(), b.estimates()) else {
            return Err(Error::new(format!("{}: lists of unequal length", what())));
        };
        state.recalled += 1;
        state.recalled_cpu_s += a.cpu_s + b.cpu_s;
        Ok(Some([a, b]))
    }

    /// Adds a pair that was rendered.
    ///
    /// # Errors
    /// When the disk refuses; the pairs before it are safe.
    pub(super) fn keep(&self, asked: Asked, renders: [&Estimates; 2]) -> Result<()> {
        let renders = renders.map(Columns::of);
        self.append(&PairLine { asked, renders })?;
        self.state().added += 1;
        Ok(())
    }

    /// Adds a line and waits until it is on the disk.
    fn append(&self, line: &impl Serialize) -> Result<()> {
        let mut text = serde_json::to_vec(line).context(|| self.refused())?;
        text.push(b'\n');
        let state = &mut *self.state();
        let whole = state.file.metadata().context(|| self.refused())?.len();
        let written = state
            .file
            .write_all(&text)
            .and_then(|()| state.file.sync_data());
        if written.is_err() {
            // A torn line may only be the last one; if this fails too, it is.
            let _ = state.file.set_len(whole);
        }
        written.context(|| self.refused()).map_err(|e| {
            e.with_hint(
                "is the disk full? what was rendered before is kept: make room, then go on with --resume",
            )
        })
    }
}
