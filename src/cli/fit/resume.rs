//! Beginning a fit, and going on with one from its journal of render pairs.

use super::{Arguments, Asked, Ready, command_line, files_in, quoted};
use crate::base::{Context, Error, Result};
use crate::cli::fit_all::inputs::{Hashes, Inputs};
use crate::cli::{self, inputs, terminal::Terminal};
use crate::fit::{Journal, JournalHeader, refuse_existing};
use clap::{ArgMatches, Parser};
use std::path::{Path, PathBuf};

/// What to fit: said on the command line, or in the journal of an earlier fit.
pub(crate) enum What {
    New(Box<Asked>),
    Resume(Again),
}

/// An earlier fit to go on with.
pub(crate) struct Again {
    folder: PathBuf,
    limits: Limits,
}

/// Limits given anew: seconds, paths, accuracy.
type Limits = (Option<f64>, Option<u64>, Option<f64>);

/// Their names; every other argument of a fit comes from the journal.
const LIMITS: [&str; 3] = ["time", "paths", "accuracy"];
const RESUME: &str = "resume";

impl clap::FromArgMatches for What {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let Some(folder) = matches.get_one::<PathBuf>(RESUME) else {
            return Ok(Self::New(Box::new(Asked::from_arg_matches(matches)?)));
        };
        let [time, paths, accuracy] = LIMITS;
        Ok(Self::Resume(Again {
            folder: folder.clone(),
            limits: (
                matches.get_one(time).copied(),
                matches.get_one(paths).copied(),
                matches.get_one(accuracy).copied(),
            ),
        }))
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

impl clap::Args for What {
    /// The arguments of [`Asked`], which are not needed with `--resume`, and of which it takes the limits alone.
    fn augment_args(command: clap::Command) -> clap::Command {
        let asked = Asked::augment_args(clap::Command::new("asked"));
        let names = asked.get_arguments().map(|a| a.get_id().clone());
        let barred = names.filter(|id| !LIMITS.contains(&id.as_str()));
        let resume = clap::Arg::new(RESUME)
            .long(RESUME)
            .value_name("DIR")
            .value_parser(clap::value_parser!(PathBuf))
            .conflicts_with_all(barred)
            .conflicts_with_all(["out", "force"])
            .help("Go on with the fit in this folder; only limits may be given anew");
        Asked::augment_args(command)
            .mut_args(|a| match a.is_required_set() {
                true => a.required(false).required_unless_present(RESUME),
                false => a,
            })
            .arg(resume)
    }

    fn augment_args_for_update(command: clap::Command) -> clap::Command {
        Self::augment_args(command)
    }
}

/// Where the journal of a fit lies in its folder.
pub(crate) fn journal_in(folder: &Path) -> PathBuf {
    folder.join("renders.jsonl")
}

/// A fit that is ready to run.
pub(super) struct Begun {
    pub(super) asked: Asked,
    pub(super) ready: Ready,
    pub(super) folder: PathBuf,
    /// The command that repeats it from its start.
    pub(super) command: String,
    pub(super) journal: Journal,
    /// Whether a fit in the folder is replaced.
    pub(super) replace: bool,
}

impl Begun {
    pub(super) fn new(asked: Asked, folder: PathBuf, force: bool) -> Result<Self> {
        let [fit_path, _] = files_in(&folder);
        if !force {
            refuse_existing(&fit_path)?;
        }
        let ready = asked.read()?;
        inputs::prepare_folder(&folder)?;
        let arguments = std::env::args_os().skip(1);
        let header = JournalHeader {
            arguments: arguments.map(|w| w.to_string_lossy().into()).collect(),
            folder: working_folder(),
            ..header(&asked, &ready)
        };
        Ok(Self {
            journal: Journal::create(&journal_in(&folder), &header, force)?,
            asked,
            ready,
            folder,
            command: command_line(),
            replace: force,
        })
    }

    /// Reads how an earlier fit was begun, and everything it was begun with.
    pub(super) fn again(again: Again, terminal: &Terminal) -> Result<Self> {
        let Again { folder, limits } = again;
        let path = journal_in(&folder);
        if !path.exists() {
            return Err(
                Error::new(format!("{} is not there", path.display())).with_hint(
                    "--resume takes the --out folder of a fit that was begun by this version or a later one",
                ),
            );
        }
        let earlier = JournalHeader::read(&path)?;
        let mut arguments = earlier.arguments.clone();
        if limits != (None, None, None) {
            arguments = with_limits(&arguments, limits);
        }
        let mut asked = parsed(&arguments)
            .context(|| format!("the command in {} cannot be read", path.display()))?;
        if earlier.folder != working_folder() {
            asked.seen_from(Path::new(&earlier.folder));
        }
        let ready = asked.read()?;
        let command = quoted(arguments.iter().cloned());
        let header = JournalHeader {
            arguments,
            folder: earlier.folder,
            ..header(&asked, &ready)
        };
        let journal = Journal::resume(&path, &header)?;
        if journal.torn() {
            terminal.say(format!(
                "the last line of {} was torn and is dropped",
                path.display()
            ));
        }
        let (pairs, cpu_s) = journal.found();
        terminal.say(format!(
            "going on with {pairs} render pairs from {} ({cpu_s:.1} s CPU)",
            path.display()
        ));
        Ok(Self {
            asked,
            ready,
            folder,
            command,
            journal,
            replace: true,
        })
    }

    /// The command that goes on with this fit.
    pub(super) fn resuming(&self) -> String {
        let folder = self.folder.display().to_string();
        quoted(["fit".to_owned(), "--resume".to_owned(), folder].into_iter())
    }
}

/// All that a fit's journal must know of it but the command.
pub(crate) fn header(asked: &Asked, ready: &Ready) -> JournalHeader {
    let inputs = Inputs::of(asked, &mut Hashes::default()).by_name();
    JournalHeader::new(ready.model(), &ready.options, inputs)
}

pub(crate) fn working_folder() -> String {
    std::env::current_dir().map_or_else(|_| String::new(), |d| d.display().to_string())
}

/// The fit that these words ask for.
fn parsed(words: &[String]) -> Result<Asked> {
    let line = std::iter::once("goniofit").chain(words.iter().map(String::as_str));
    let read = cli::Arguments::try_parse_from(line);
    match read.context(|| "it is not understood")?.command {
        cli::Command::Fit(Arguments {
            what: What::New(asked),
            ..
        }) => Ok(*asked),
        _ => Err(Error::new("it does not begin a fit")),
    }
}

/// The same words with other limits.
fn with_limits(words: &[String], (time, paths, accuracy): Limits) -> Vec<String> {
    let names = LIMITS.map(|name| format!("--{name}"));
    let mut kept = Vec::new();
    let mut words = words.iter();
    while let Some(word) = words.next() {
        let begins = |name: &String| word.strip_prefix(name.as_str());
        match names.iter().find_map(begins) {
            Some("") => drop(words.next()),
            Some(rest) if rest.starts_with('=') => {}
            _ => kept.push(word.clone()),
        }
    }
    let [time_name, paths_name, accuracy_name] = names;
    let mut add = |name: String, value: Option<String>| {
        kept.extend(value.map(|v| [name, v]).into_iter().flatten());
    };
    add(time_name, time.map(|t| format!("{t}s")));
    add(paths_name, paths.map(|n| n.to_string()));
    add(accuracy_name, accuracy.map(|a| a.to_string()));
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(line: &str) -> Vec<String> {
        line.split(' ').map(str::to_owned).collect()
    }

    #[test]
    fn limits_are_replaced_in_both_spellings() {
        let line = "fit --time 5m --measurements m.csv --paths=7 --fabric f.toml --out o --force";
        let again = with_limits(&words(line), (None, Some(900), Some(0.01)));
        let plain =
            "fit --measurements m.csv --fabric f.toml --out o --force --paths 900 --accuracy 0.01";
        assert_eq!(again, words(plain));
        let asked = parsed(&again).unwrap();
        assert_eq!(
            (asked.time, asked.paths, asked.accuracy),
            (None, Some(900), Some(0.01))
        );
    }

    #[test]
    fn resume_takes_limits_and_nothing_else() {
        let parse = |line: &str| cli::Arguments::try_parse_from(words(line)).map(|_| ());
        parse("goniofit fit --resume o --time 5m --json").unwrap();
        parse("goniofit fit --measurements m --fabric f --out o").unwrap();
        for bad in [
            "goniofit fit --resume o --seed 3",
            "goniofit fit --resume o --out p",
            "goniofit fit --resume o --tau 0.02",
            "goniofit fit --resume o --bound c_r=0.04..1",
            "goniofit fit --resume o --plate white",
            "goniofit fit --measurements m --fabric f --out o --tau 0",
            "goniofit fit --measurements m --fabric f --out o --plate gray",
            "goniofit fit --resume o --iteration-paths 900",
            "goniofit fit --measurements m --fabric f",
            "goniofit fit --out o",
        ] {
            assert!(parse(bad).is_err(), "{bad}");
        }
    }
}
