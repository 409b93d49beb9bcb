//! The list of work: a TOML file, and the tasks it stands for.
//!
//! A task's id depends on what it names (paths as written, model, seed, the options' name) and on nothing else in the
//! list, so a list can grow without moving what is done.

use crate::base::{Context, Error, Result};
use crate::cli::fit::{self, Asked};
use crate::cli::{inputs, render};
use crate::fit::{Bounds, Loss, Method, TAU};
use crate::scatter::{AnyModel, Parameters};
use crate::session::files;
use serde::Deserialize;
use std::collections::HashSet;
use std::path::{Path, PathBuf};

/// More are taken for a mistake.
const MAX_TASKS: usize = 100_000;
/// Longest part of an id that a name may take.
const MAX_NAME: usize = 40;
const HINT: &str = "docs/batch.md lists the keys";

/// One fit of the list.
#[derive(Debug, Clone)]
pub(super) struct Task {
    /// Its place in the list, from 0.
    pub(super) number: usize,
    /// Names it for good; also its folder.
    pub(super) id: String,
    /// The name of its options, if they have one.
    pub(super) options: Option<String>,
    /// The fit, paths as seen from here.
    pub(super) asked: Asked,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ListFile {
    #[serde(default)]
    measurements: Vec<String>,
    #[serde(default)]
    fabrics: Vec<String>,
    #[serde(default = "default_models")]
    models: Vec<String>,
    #[serde(default = "default_seeds")]
    seeds: Vec<u64>,
    #[serde(default)]
    options: Vec<OptionSet>,
    #[serde(default)]
    tasks: Vec<Entry>,
    #[serde(default)]
    exclude: Vec<Exclude>,
}

fn default_models() -> Vec<String> {
    vec![fit::MODEL.to_owned()]
}

fn default_seeds() -> Vec<u64> {
    vec![fit::SEED]
}

/// The options of `goniofit fit`, by the same names.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct OptionSet {
    name: Option<String>,
    paths: Option<u64>,
    time: Option<Quantity>,
    accuracy: Option<Quantity>,
    method: Option<String>,
    start: Option<String>,
    tolerance: Option<Quantity>,
    iteration_paths: Option<u64>,
    iterations: Option<u32>,
    #[serde(default)]
    rates: Vec<f64>,
    loss: Option<String>,
    gain_prior: Option<Quantity>,
    tau: Option<Quantity>,
    #[serde(default)]
    bound: Vec<String>,
    plate: Option<String>,
}

/// A number, or a text with its unit as on a command line.
#[derive(Debug, Clone, Deserialize)]
#[serde(untagged)]
enum Quantity {
    Number(f64),
    Text(String),
}

impl Quantity {
    fn read(&self, name: &str, parse: fn(&str) -> Result<f64, String>) -> Result<f64> {
        let read = match self {
            Self::Number(x) => parse(&x.to_string()),
            Self::Text(text) => parse(text),
        };
        read.map_err(|message| Error::new(format!("{name}: {message}")))
    }
}

/// A task by itself; without options of its own it takes each of the list's.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    measurements: String,
    fabric: String,
    model: Option<String>,
    seed: Option<u64>,
    options: Option<OptionSet>,
}

/// Combinations to leave out: those that agree in all that is given.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Exclude {
    measurements: Option<String>,
    fabric: Option<String>,
    model: Option<String>,
    seed: Option<u64>,
    options: Option<String>,
}

/// A task as the list writes it.
#[derive(Clone)]
struct Combination<'a> {
    measurements: &'a str,
    fabric: &'a str,
    model: &'a str,
    seed: u64,
    options: &'a OptionSet,
}

/// Reads a list and writes out its tasks: the combinations first (measurements change slowest, options fastest), then the
/// single entries, both in the order of the file.
///
/// # Errors
/// The file cannot be read or has an unknown key, a value that no fit takes, a task twice, an exclusion that excludes
/// nothing, or no task. That files it names exist is not asked here: that is the task's own failure.
pub(super) fn read(path: &Path) -> Result<Vec<Task>> {
    let folder = path.parent().unwrap_or(Path::new(""));
    parse(&files::read_text(path)?, folder).context(|| format!("list {}", path.display()))
}

fn parse(text: &str, folder: &Path) -> Result<Vec<Task>> {
    let list: ListFile = toml::from_str(text).map_err(|e: toml::de::Error| {
        let before = |span: std::ops::Range<usize>| &text[..span.start.min(text.len())];
        let line = e.span().map_or(0, |s| before(s).matches('\n').count()) + 1;
        let message = e.message().trim().replace('\n', " ");
        Error::new(format!("line {line}: {message}")).with_hint(HINT)
    })?;
    let plain = OptionSet::default();
    let option_sets: Vec<&OptionSet> = match list.options.len() {
        0 => vec![&plain],
        _ => list.options.iter().collect(),
    };
    let mut combinations = crossed(&list, &option_sets);
    leave_out(&mut combinations, &list.exclude)?;
    combinations.extend(single(&list, &option_sets));
    if combinations.is_empty() || combinations.len() > MAX_TASKS {
        return Err(Error::new(format!(
            "{} tasks, where 1 to {MAX_TASKS} were expected",
            combinations.len()
        ))
        .with_hint(
            "a list needs measurements and fabrics, or [[tasks]]; docs/batch.md has examples",
        ));
    }
    let mut seen = HashSet::new();
    let of_number = |(number, c): (usize, &Combination<'_>)| {
        let task = c.task(number, folder)?;
        if !seen.insert(task.id.clone()) {
            return Err(Error::new(format!("task {} occurs twice", task.id)).with_hint(
                "the same measurements, fabric, model and seed need options with different names",
            ));
        }
        Ok(task)
    };
    combinations.iter().enumerate().map(of_number).collect()
}

fn crossed<'a>(list: &'a ListFile, option_sets: &[&'a OptionSet]) -> Vec<Combination<'a>> {
    let mut all = Vec::new();
    for measurements in &list.measurements {
        for fabric in &list.fabrics {
            for model in &list.models {
                for &seed in &list.seeds {
                    all.extend(option_sets.iter().map(|&options| Combination {
                        measurements,
                        fabric,
                        model,
                        seed,
                        options,
                    }));
                    if all.len() > MAX_TASKS {
                        return all;
                    }
                }
            }
        }
    }
    all
}

fn single<'a>(
    list: &'a ListFile,
    option_sets: &'a [&'a OptionSet],
) -> impl Iterator<Item = Combination<'a>> {
    list.tasks.iter().flat_map(move |entry| {
        let own: Vec<&OptionSet> = match &entry.options {
            Some(own) => vec![own],
            None => option_sets.to_vec(),
        };
        own.into_iter().map(move |options| Combination {
            measurements: &entry.measurements,
            fabric: &entry.fabric,
            model: entry.model.as_deref().unwrap_or(fit::MODEL),
            seed: entry.seed.unwrap_or(fit::SEED),
            options,
        })
    })
}

fn leave_out(combinations: &mut Vec<Combination<'_>>, excluded: &[Exclude]) -> Result<()> {
    for (i, exclude) in excluded.iter().enumerate() {
        let before = combinations.len();
        combinations.retain(|c| !exclude.holds(c));
        if combinations.len() == before {
            return Err(
                Error::new(format!("exclude {} excludes nothing", i + 1)).with_hint(
                    "it names measurements, fabric, model, seed or options exactly as the list does",
                ),
            );
        }
    }
    Ok(())
}

impl Exclude {
    fn holds(&self, c: &Combination<'_>) -> bool {
        let same = |given: &Option<String>, own: &str| given.as_deref().is_none_or(|g| g == own);
        let empty = self.measurements.is_none()
            && self.fabric.is_none()
            && self.model.is_none()
            && self.seed.is_none()
            && self.options.is_none();
        !empty
            && same(&self.measurements, c.measurements)
            && same(&self.fabric, c.fabric)
            && same(&self.model, c.model)
            && self.seed.is_none_or(|seed| seed == c.seed)
            && same(&self.options, c.options.name.as_deref().unwrap_or(""))
    }
}

impl Combination<'_> {
    /// The task, with everything checked that needs no file.
    fn task(&self, number: usize, folder: &Path) -> Result<Task> {
        let model = AnyModel::named(self.model)?.parametric();
        let o = self.options;
        Bounds::parse(&o.bound)?.over(&Parameters::defaults(model))?;
        let method = o.method.as_deref().unwrap_or(fit::METHOD);
        let schedule = fit::Schedule {
            iteration_paths: o.iteration_paths,
            iterations: o.iterations,
            rates: o.rates.clone(),
        };
        schedule.check(Method::named(method)?)?;
        let loss = o.loss.as_deref().unwrap_or(fit::LOSS);
        Loss::named(loss)?;
        let read = |quantity: &Option<Quantity>, name: &str, parse: fn(&str) -> _| {
            quantity.as_ref().map(|q| q.read(name, parse)).transpose()
        };
        let tolerance = match read(&o.tolerance, "tolerance", inputs::fraction)? {
            Some(given) => given,
            None => inputs::fraction(fit::TOLERANCE).map_err(Error::new)?,
        };
        let plate = render::plate(o.plate.as_deref().unwrap_or(fit::PLATE));
        Ok(Task {
            number,
            id: self.id(),
            options: o.name.clone(),
            asked: Asked {
                measurements: folder.join(self.measurements),
                fabric: folder.join(self.fabric),
                model: self.model.to_owned(),
                per_system: false,
                method: method.to_owned(),
                seed: self.seed,
                start: o.start.as_ref().map(|start| folder.join(start)),
                time: read(&o.time, "time", fit::seconds)?,
                paths: o.paths,
                accuracy: read(&o.accuracy, "accuracy", inputs::fraction)?,
                tolerance,
                loss: loss.to_owned(),
                gain_prior: read(&o.gain_prior, "gain_prior", inputs::fraction)?,
                tau: read(&o.tau, "tau", fit::tau)?.unwrap_or(TAU),
                bounds: o.bound.clone(),
                plate: plate.map_err(|fault| Error::new(format!("plate: {fault}")))?,
                schedule,
            },
        })
    }

    /// Words for people, then eight digits that tell apart what the words do not.
    fn id(&self) -> String {
        let options = self.options.name.as_deref();
        let key = serde_json::json!([
            self.measurements,
            self.fabric,
            self.model,
            self.seed,
            options
        ]);
        let digits = &files::sha256(key.to_string().as_bytes())[..8];
        let mut words = vec![
            file_word(self.measurements),
            file_word(self.fabric),
            word(self.model),
            format!("s{}", self.seed),
        ];
        words.extend(options.map(word));
        format!("{}-{digits}", words.join("-"))
    }
}

/// What a file is called among others of its kind: `measurements.csv` has the name of its session's folder.
fn file_word(path: &str) -> String {
    let path = PathBuf::from(path);
    let places = path.with_extension("");
    let names = places.ancestors().filter_map(|p| p.file_name()?.to_str());
    let telling = |name: &&str| !["measurements", "session"].contains(name);
    let own = path.file_stem().and_then(|s| s.to_str());
    word(names.into_iter().find(telling).or(own).unwrap_or(""))
}

/// Letters, digits and `._`, not too many.
fn word(text: &str) -> String {
    let plain = |c: char| {
        if c.is_ascii_alphanumeric() || "._".contains(c) {
            c
        } else {
            '_'
        }
    };
    let word: String = text.chars().map(plain).take(MAX_NAME).collect();
    word.trim_start_matches('.').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::fit_all::inputs::{Hashes, Inputs};

    fn ids(text: &str) -> Vec<String> {
        let tasks = parse(text, Path::new("lists")).unwrap();
        tasks.into_iter().map(|t| t.id).collect()
    }

    #[test]
    fn combinations_keep_their_ids_when_the_list_grows() {
        let small = "measurements = ['n1/measurements.csv']\nfabrics = ['twill.toml']\n";
        let large = "measurements = ['n0/measurements.csv', 'n1/measurements.csv']\nfabrics = ['silk.toml', 'twill.toml']\n\
                     models = ['khungurn', 'chiang']\nseeds = [2, 1]\n[[options]]\n[[options]]\nname = 'fine'\npaths = 9\n";
        let (one, all) = (ids(small), ids(large));
        assert_eq!((one.len(), all.len()), (1, 32));
        assert!(all.contains(&one[0]), "{one:?} {all:?}");
        assert!(one[0].starts_with("n1-twill-khungurn-s1-"), "{one:?}");
        // Options say how a task is done, not which it is.
        assert_eq!(one, ids(&format!("{small}[[options]]\npaths = 7\n")));
        // Fixed for good: folders of finished work carry it.
        assert_eq!(one[0], "n1-twill-khungurn-s1-caa47e8b");
        // Measurements change slowest, options fastest.
        assert!(all[0].starts_with("n0-silk-khungurn-s2-"), "{all:?}");
        assert!(all[1].starts_with("n0-silk-khungurn-s2-fine-"), "{all:?}");
        assert!(all[2].starts_with("n0-silk-khungurn-s1-"), "{all:?}");
    }

    #[test]
    fn entries_exclusions_and_options_are_applied() {
        let text = "measurements = ['a.csv', 'b.csv']\nfabrics = ['x.toml', 'y.toml']\n\
                    [[options]]\ntime = '2m'\naccuracy = 0.02\nstart = 'p.json'\ntolerance = '3%'\n\
                    [[exclude]]\nmeasurements = 'a.csv'\nfabric = 'y.toml'\n\
                    [[tasks]]\nmeasurements = '/far/c.csv'\nfabric = 'x.toml'\nseed = 9\noptions = { paths = 5 }\n";
        let tasks = parse(text, Path::new("lists")).unwrap();
        let names: Vec<&str> = tasks
            .iter()
            .map(|t| t.id.rsplit_once('-').unwrap().0)
            .collect();
        assert_eq!(
            names,
            [
                "a-x-khungurn-s1",
                "b-x-khungurn-s1",
                "b-y-khungurn-s1",
                "c-x-khungurn-s9"
            ]
        );
        let crossed = &tasks[0].asked;
        assert_eq!(crossed.measurements, Path::new("lists/a.csv"));
        assert_eq!(crossed.start.as_deref(), Some(Path::new("lists/p.json")));
        let budget = crossed.budget();
        assert_eq!((budget.time_s, budget.accuracy), (Some(120.0), Some(0.02)));
        let own = &tasks[3].asked;
        assert_eq!(own.measurements, Path::new("/far/c.csv"));
        assert_eq!((own.paths, own.time, own.seed), (Some(5), None, 9));
    }

    #[test]
    fn any_other_option_makes_other_inputs() {
        let head = "measurements = ['a.csv']\nfabrics = ['x.toml']\n[[options]]\nmethod = 'adam'\n";
        let inputs = |more: &str| {
            let tasks = parse(&format!("{head}{more}\n"), Path::new("")).unwrap();
            Inputs::of(&tasks[0].asked, &mut Hashes::default())
        };
        let plain = inputs("");
        assert!(inputs("").changed_since(&plain).is_empty());
        // What is written out as it is anyhow is no change.
        let usual = inputs("loss = 'squared'\ntolerance = 0.05");
        assert!(usual.changed_since(&plain).is_empty());
        for other in [
            "paths = 5",
            "time = 9",
            "accuracy = 0.02",
            "tolerance = 0.04",
            "iteration_paths = 9",
            "iterations = 7",
            "rates = [0.2]",
            "loss = 'huber:2'",
            "gain_prior = 0.05",
        ] {
            let changed = inputs(other).changed_since(&plain);
            assert_eq!(changed, ["options"], "{other}");
        }
    }

    #[test]
    fn faults_in_a_list_are_named() {
        let head = "measurements = ['a.csv']\nfabrics = ['x.toml']\n";
        for (rest, fault) in [
            ("seed = [1]\n", "line 3: unknown field `seed`"),
            ("models = ['marschner']\n", "unknown model 'marschner'"),
            ("[[options]]\ntime = 'long'\n", "time: 'long' is not a time"),
            (
                "[[options]]\naccuracy = 2\n",
                "accuracy: '2' is not a fraction",
            ),
            ("[[options]]\nmethod = 'guess'\n", "unknown method 'guess'"),
            (
                "[[options]]\niteration_paths = 9\n",
                "gauss-newton has no schedule",
            ),
            (
                "[[options]]\nmethod = 'adam'\nrates = [1.0, 2.0]\n",
                "adam takes one learning rate",
            ),
            (
                "[[options]]\nmethod = 'sgd'\nrates = [-1.0]\n",
                "learning rates must be positive",
            ),
            ("[[options]]\ntau = 0\n", "tau: '0' is not"),
            (
                "[[options]]\nbound = ['c_x=0..1']\n",
                "bound c_x: the model has no such parameter",
            ),
            ("[[options]]\nplate = 'gray'\n", "plate: 'gray' is not"),
            ("[[options]]\n[[options]]\npaths = 3\n", "occurs twice"),
            ("seeds = [1, 1]\n", "occurs twice"),
            ("[[exclude]]\nseed = 2\n", "exclude 1 excludes nothing"),
            ("[[exclude]]\n", "exclude 1 excludes nothing"),
            ("[[exclude]]\nseed = 1\n", "0 tasks"),
        ] {
            let report = parse(&format!("{head}{rest}"), Path::new(""))
                .unwrap_err()
                .report();
            assert!(report.contains(fault), "{rest}: {report}");
        }
    }

    #[test]
    fn ids_are_plain_file_names() {
        for (path, expected) in [
            ("night1/measurements.csv", "night1"),
            ("demo/session/measurements.json", "demo"),
            ("measurements.csv", "measurements"),
            ("../../x/cloth 7.csv", "cloth_7"),
            ("../measurements.csv", "measurements"),
        ] {
            assert_eq!(file_word(path), expected, "{path}");
        }
    }
}
