//! What a fit was made from, so that a later run can tell whether it still is.

use crate::cli::fit::{self, Asked};
use crate::cli::render::plate_in_words;
use crate::fabric::{fiber_file, voxel_file};
use crate::fit::TAU;
use crate::render::Plate;
use crate::session::files;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

/// Everything that a task's numbers depend on, apart from the program itself. A file that cannot be read has no hash.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Inputs {
    /// SHA-256 of the measurements.
    measurements: Option<String>,
    /// SHA-256 of the fabric description.
    fabric: Option<String>,
    /// SHA-256 of the fibers it points to, if any.
    fibers: Option<String>,
    /// SHA-256 of the file with the start, if any.
    start: Option<String>,
    /// What the session around the measurements says of light and sample, and what lies under the cloth.
    session: String,
    /// Limits, method, tolerance, schedule, loss, gain.
    options: serde_json::Value,
}

/// Hashes of files, each read once.
#[derive(Default)]
pub(crate) struct Hashes(HashMap<PathBuf, Option<String>>);

impl Hashes {
    fn of(&mut self, path: &Path) -> Option<String> {
        let hash = || Some(files::sha256(&std::fs::read(path).ok()?));
        self.0.entry(path.to_owned()).or_insert_with(hash).clone()
    }
}

impl Inputs {
    /// The inputs of a fit as they are now.
    pub(crate) fn of(asked: &Asked, hashes: &mut Hashes) -> Self {
        let budget = asked.budget();
        let fibers = fiber_file(&asked.fabric).or_else(|| voxel_file(&asked.fabric));
        let mut options = serde_json::json!({
            "method": asked.method,
            "time_s": budget.time_s,
            "paths": budget.paths,
            "accuracy": budget.accuracy,
            "tolerance": asked.tolerance,
        });
        // Named only where given: records of earlier versions stay true.
        if asked.loss != fit::LOSS {
            options["loss"] = asked.loss.clone().into();
        }
        if let Some(prior) = asked.gain_prior {
            options["gain_prior"] = prior.into();
        }
        if asked.tau.to_bits() != TAU.to_bits() {
            options["tau"] = asked.tau.into();
        }
        if !asked.bounds.is_empty() {
            options["bound"] = asked.bounds.clone().into();
        }
        let schedule = &asked.schedule;
        if let Some(paths) = schedule.iteration_paths {
            options["iteration_paths"] = paths.into();
        }
        if let Some(iterations) = schedule.iterations {
            options["iterations"] = iterations.into();
        }
        if !schedule.rates.is_empty() {
            options["rates"] = schedule.rates.clone().into();
        }
        Self {
            measurements: hashes.of(&asked.measurements),
            fabric: hashes.of(&asked.fabric),
            fibers: fibers.and_then(|path| hashes.of(&path)),
            start: asked.start.as_ref().and_then(|path| hashes.of(path)),
            session: match asked.surroundings() {
                Ok((o, synthetic)) => {
                    let plate = match o.plate {
                        Plate::Black => String::new(),
                        other => format!(", plate {}", plate_in_words(other)),
                    };
                    format!(
                        "light {:?} mm at {:?} mm, square {:?} mm, synthetic {synthetic:?}{plate}",
                        o.light.side, o.light.distance, o.sample_square
                    )
                }
                Err(error) => error.to_string(),
            },
            options,
        }
    }

    /// What is known of each file and of the session, by name; of options nothing.
    pub(crate) fn by_name(&self) -> BTreeMap<String, String> {
        let files = [
            ("measurements", &self.measurements),
            ("fabric", &self.fabric),
            ("fibers", &self.fibers),
            ("start", &self.start),
        ];
        let session = ("session".to_owned(), self.session.clone());
        let files = files.into_iter().filter_map(|(name, hash)| {
            let hash = hash.as_ref()?;
            Some((name.to_owned(), hash.clone()))
        });
        files.chain([session]).collect()
    }

    /// The names of what differs from `earlier`.
    pub(super) fn changed_since(&self, earlier: &Self) -> Vec<&'static str> {
        [
            ("measurements", self.measurements != earlier.measurements),
            ("fabric", self.fabric != earlier.fabric),
            ("fibers", self.fibers != earlier.fibers),
            ("start", self.start != earlier.start),
            ("session", self.session != earlier.session),
            ("options", self.options != earlier.options),
        ]
        .into_iter()
        .filter_map(|(name, differs)| differs.then_some(name))
        .collect()
    }
}
