//! A model of either kind, for those who know it by name alone.

use super::media::{self, MediumModel};
use super::{Model, Parametric, model, models, per_system};
use crate::base::{Error, Result};

/// A model of single fibers or of media.
#[derive(Clone, Copy)]
pub enum AnyModel {
    /// Of fibers.
    Fibers(&'static dyn Model),
    /// Of media: volumes of fibers.
    Medium(&'static dyn MediumModel),
}

impl AnyModel {
    /// The model with this name, see [`model`] and [`media::model`].
    ///
    /// # Errors
    /// When there is none; the hint lists those that exist.
    pub fn named(name: &str) -> Result<Self> {
        if let Ok(found) = media::model(name) {
            return Ok(Self::Medium(found));
        }
        model(name).map(Self::Fibers).map_err(|_| {
            let fibers: Vec<_> = models().iter().map(|m| m.name()).collect();
            let media: Vec<_> = media::models().iter().map(|m| m.name()).collect();
            Error::new(format!("unknown model '{name}'")).with_hint(format!(
                "known models: {} (or with parameters for each yarn system {}-per-system); of volumes: {} (or with the \
                 density {}-density)",
                fibers.join(", "),
                fibers[0],
                media.join(", "),
                media[0]
            ))
        })
    }

    /// Its name and parameters.
    pub fn parametric(self) -> &'static dyn Parametric {
        match self {
            Self::Fibers(model) => model,
            Self::Medium(model) => model,
        }
    }

    /// The same with parameters for each yarn system.
    ///
    /// # Errors
    /// When there is no such model.
    pub fn per_system(self) -> Result<Self> {
        match self {
            Self::Fibers(model) => per_system(model).map(Self::Fibers),
            Self::Medium(model) => Err(Error::new(format!(
                "model {} has no parameters per yarn system",
                model.name()
            ))),
        }
    }
}
