//! Models with parameters of their own for each yarn system: warp and weft of different fibers.
//!
//! The rows are those of the model it is made of, once for each system, named `warp.c_r`, ..., `weft.beta_tt`: whoever knows
//! parameters by name needs to know nothing more. Instead of one scattering function there is one for each system.

use super::{Model, ParameterInfo, Parameters, Parametric, Scattering, models};
use crate::base::{Context, Error, Result};
use std::sync::LazyLock;

/// Names of the yarn systems that can have parameters of their own, in the order of their numbers in a fabric.
pub const YARN_SYSTEMS: [&str; 2] = ["warp", "weft"];

/// What is added to a model's name when each yarn system has parameters of its own.
const SUFFIX: &str = "-per-system";

/// One of [`models`] with a set of parameters for each of [`YARN_SYSTEMS`].
struct PerSystem {
    of: &'static dyn Model,
    name: &'static str,
    infos: &'static [ParameterInfo],
}

/// All of them, made once: names and descriptions of parameters live as long as the program.
static ALL: LazyLock<Vec<PerSystem>> =
    LazyLock::new(|| models().iter().map(|m| PerSystem::new(*m)).collect());

/// The model with the parameters of `model` for each of [`YARN_SYSTEMS`]; a model that has them already is itself.
///
/// # Errors
/// When `model` is none of [`models`].
pub fn per_system(model: &'static dyn Model) -> Result<&'static dyn Model> {
    if !model.systems().is_empty() {
        return Ok(model);
    }
    named(&format!("{}{SUFFIX}", model.name())).ok_or_else(|| {
        let name = model.name();
        Error::new(format!("model {name} has no parameters per yarn system"))
    })
}

/// Whether there is a model with parameters per yarn system made of the one with this name.
pub(super) fn has_per_system(name: &str) -> bool {
    models().iter().any(|m| m.name() == name)
}

/// The model per yarn system with this name.
pub(super) fn named(name: &str) -> Option<&'static dyn Model> {
    let found = ALL.iter().find(|m| m.name == name)?;
    Some(found)
}

impl PerSystem {
    fn new(of: &'static dyn Model) -> Self {
        let rows = |system: &'static str| {
            of.parameters().iter().map(move |info| ParameterInfo {
                name: format!("{system}.{}", info.name).leak(),
                ..*info
            })
        };
        let infos: Vec<ParameterInfo> = YARN_SYSTEMS.into_iter().flat_map(rows).collect();
        Self {
            of,
            name: format!("{}{SUFFIX}", of.name()).leak(),
            infos: infos.leak(),
        }
    }
}

impl Parametric for PerSystem {
    fn name(&self) -> &'static str {
        self.name
    }

    fn parameters(&self) -> &'static [ParameterInfo] {
        self.infos
    }

    fn systems(&self) -> &'static [&'static str] {
        &YARN_SYSTEMS
    }
}

impl Model for PerSystem {
    fn prepare(&self, _: &Parameters) -> Result<Box<dyn Scattering>> {
        Err(Error::new(format!(
            "model {} has a scattering function for each yarn system, not one",
            self.name
        ))
        .with_hint(format!(
            "ask for one system's with model {}",
            self.of.name()
        )))
    }

    fn prepare_each(&self, parameters: &Parameters) -> Result<Vec<Box<dyn Scattering>>> {
        let set = Parameters::defaults(self.of);
        let sets = parameters.values().chunks(set.values().len());
        let prepare = |(system, values): (&&str, &[f64])| {
            let own = set.with_values(values.to_vec());
            let what = || format!("the {system}'s parameters cannot be used");
            self.of.prepare(&own).context(what)
        };
        YARN_SYSTEMS.iter().zip(sets).map(prepare).collect()
    }

    fn wider(&self, row: usize, value: f64, factor: f64) -> f64 {
        let own = row % self.of.parameters().len();
        self.of.wider(own, value, factor)
    }
}
